"""Where the rays of a skin meet the implicit surface: a march inwards, then a secant on ln F.

A limb of one chain has the field of its bones, F_b = own + parent's + children's balls, and the surface F_b = T. Where two parts
of a body meet, the sum would bulge and the larger of the two would leave a crease; their fields are joined by the blend of
constructive solid geometry (Ricci 1973, Comput. J. 16),

    G = (F_b^n + max_q (w_q F_q)^n)^(1/n) ,   n = 4 ,   q: the bones of the other part next to b           (1)

with w_q = 1, but of the bones of the part that it grows out of a limb sees each only beside its own length: w_q falls to 0 where the next
bone's field holds, as it does for that part itself. G is 2^(1/n) of the larger field where both are equal, and the larger field
elsewhere: a fillet of 4 mm on a radius of 60 mm. Both parts are cast to the same G = T, so what overlaps coincides and no seam is seen. A
part ends inside its neighbour:

    first exit of the ray, beyond the outermost F_b = T, from  min( G/T , F_own/(τ T) ) ≥ 1 ,   τ = 0.4    (2)

with F_own the field of its own balls, so its mesh leaves the common surface only where the neighbour's is the body's surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .metaballs import THRESHOLD, active_balls, field, field_and_derivatives
from .shape import BodyShape
from .skin_parts import Part
from .skin_rays import Rays, smooth

BLEND_POWER = 4.0  # n of (1)
OWN_SHARE = 0.4  # τ of (2): below ½, or two that reach T together would both stay below it
BORDER = 0.3  # w_q ends this part of the bone's length beyond its ends
STEP = 0.05  # march, in units of the reach
FINE_STEP = 0.02  # … outwards, where a gap between two parts must not be stepped over
SECANT_STEPS = 7
LEAST_RHO_M = 1e-3  # where the field is too weak to surround the axis
NOTHING = 1e-300

LogField = Callable[[np.ndarray, np.ndarray], np.ndarray]  # ρ (N,), which rays (N,) -> ln of the field over its threshold (N,)


def limb_root(shape: BodyShape, R: np.ndarray, head: np.ndarray, rays: Rays) -> np.ndarray:
    """ρ (V,) of the outermost point with F_b = T on each ray within its reach."""
    active = np.stack([active_balls(shape.metaballs, shape.skeleton.neighbours, b) for b in range(len(shape.skeleton.bones))])[rays.bone]

    def log_ratio(rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        points = rays.origin[which] + rho[:, None] * rays.direction[which]
        return np.log(np.maximum(field(shape.metaballs, shape.lengths_m, R, head, points, active[which]), NOTHING) / THRESHOLD)

    return outermost_root(log_ratio, rays.reach)


def limb_normals(shape: BodyShape, R: np.ndarray, head: np.ndarray, rays: Rays, vertices_m: np.ndarray) -> np.ndarray:
    """Outward unit normals (V, 3) of the field that `limb_root` looked at, −∇F/|∇F|."""
    active = np.stack([active_balls(shape.metaballs, shape.skeleton.neighbours, b) for b in range(len(shape.skeleton.bones))])[rays.bone]
    return _unit(-field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, vertices_m, active)[1])


def part_root(shape: BodyShape, parts: tuple[Part, ...], index: int, R: np.ndarray, head: np.ndarray,
              rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """ρ (V,) of (2) on the rays of part `index`, and the outward normals of (1) there (V, 3); bone after bone."""
    rho, normals = np.empty(len(rays.bone)), np.empty((len(rays.bone), 3))
    for bone in parts[index].bones:
        own = np.flatnonzero(rays.bone == bone)
        if len(own):
            near = _joined_field(shape, parts, index, bone, R, head, rays, own)
            rho[own] = _connected_root(near, rays.reach[own])
            normals[own] = near.normals(rays.origin[own] + rho[own, None] * rays.direction[own])
    return rho, normals


def outermost_root(log_ratio: LogField, reach: np.ndarray) -> np.ndarray:
    """ρ (V,) of the outermost sign change of `log_ratio` on each ray from `reach` (V,) inwards."""
    every = np.arange(len(reach))
    outer, inner, pending = reach.copy(), np.zeros(len(every)), every
    for step in np.arange(1 - STEP, 0, -STEP):
        rho = step * reach[pending]
        inside = log_ratio(rho, pending) >= 0
        inner[pending[inside]], pending = rho[inside], pending[~inside]
        outer[pending] = rho[~inside]
    f_inner, f_outer = log_ratio(inner, every), log_ratio(outer, every)
    rho = _secant(log_ratio, inner, outer, f_inner, f_outer)
    return np.where(f_outer >= 0, outer, np.where(f_inner < 0, LEAST_RHO_M, np.maximum(rho, LEAST_RHO_M)))


def _secant(f: LogField, a: np.ndarray, b: np.ndarray, fa: np.ndarray, fb: np.ndarray) -> np.ndarray:
    """Roots between a and b (V,) with f(a) ≥ 0 > f(b), by the Illinois rule (Dowell & Jarratt 1971)."""
    every = np.arange(len(a))
    for _ in range(SECANT_STEPS):
        middle = np.clip(a + (b - a) * fa / np.where(fa == fb, 1.0, fa - fb), np.minimum(a, b), np.maximum(a, b))
        fm = f(middle, every)
        crossed = fm * fb < 0  # the root lies between the middle and b
        a, fa = np.where(crossed, b, a), np.where(crossed, fb, fa / 2)
        b, fb = middle, fm
    return b


def _connected_root(near: "_JoinedField", reach: np.ndarray) -> np.ndarray:
    """ρ (N,) of (2): beyond the own surface as far as the joint one goes without a gap, or an arm beside the flank would be webbed."""
    if not near.others:
        return outermost_root(near.log_ratio, reach)
    inner = outermost_root(near.log_own, reach)
    every = np.arange(len(reach))
    begins = near.log_ratio(inner, every)
    outer, pending = inner.copy(), np.flatnonzero(begins >= 0)
    step = FINE_STEP * reach
    while len(pending):
        outer[pending] = np.minimum(outer[pending] + step[pending], reach[pending])
        inside = near.log_ratio(outer[pending], pending) >= 0
        pending = pending[inside & (outer[pending] < reach[pending])]
    low = np.where(outer > inner, np.maximum(outer - step, inner), inner)
    f_low, f_outer = near.log_ratio(low, every), near.log_ratio(outer, every)
    rho = np.where(f_outer >= 0, outer, _secant(near.log_ratio, low, outer, f_low, f_outer))
    dives = np.flatnonzero(begins < 0)  # the neighbour's flesh alone is there: the part ends deeper inside
    if len(dives):
        rho[dives] = outermost_root(lambda r, which: near.log_ratio(r, dives[which]), inner[dives])
    return rho


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _JoinedField:
    """The fields near one bone, on the rays of N of its vertices."""

    origin: np.ndarray  # (N, 3)
    direction: np.ndarray  # (N, 3)
    fade: np.ndarray  # (N,) how much other parts count
    weight: np.ndarray  # (m,) of the balls in use
    frame: np.ndarray  # (m, 3, 3) columns: a ball's axes in the world over its l
    shift: np.ndarray  # (m, 3) its centre in them
    chosen: np.ndarray  # (K, m) 0 or 1: row 0 the field of the bone, row 1 of its own part alone, then those of other parts
    head: np.ndarray  # (K − 2, 3) of these
    along: np.ndarray  # (K − 2, 3) 1/m: their axes over their lengths
    open_ends: np.ndarray  # (K − 2, 2) whether they go on before their heads, and beyond their tails

    @property
    def others(self) -> int:
        """How many fields of other parts there are."""
        return len(self.chosen) - 2

    def log_ratio(self, rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        """ln of (2) at ρ (N',) on the rays `which` (N',)."""
        points = self.origin[which] + rho[:, None] * self.direction[which]
        ln = self._logs(self._terms(points)[1])
        joined = self._joined(ln, self._shares(points, self.fade[which]))
        return np.minimum(joined, ln[:, 1] - np.log(OWN_SHARE)) if self.others else joined  # (2)

    def log_own(self, rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        """ln of F_b/T at ρ (N',) on the rays `which` (N',)."""
        terms = self._terms(self.origin[which] + rho[:, None] * self.direction[which])[1]
        return np.asarray(np.log(np.maximum(terms @ self.chosen[0], NOTHING) / THRESHOLD))

    def normals(self, points: np.ndarray) -> np.ndarray:
        """−∇G/|∇G| (N, 3) at a point of each ray."""
        q, terms = self._terms(points)
        ln = self._logs(terms)
        share = np.exp(BLEND_POWER * (ln + np.log(np.column_stack([np.ones((len(ln), 2)), self._shares(points, self.fade)]))))
        share[:, 1] = 0.0
        if self.others:
            share[:, 2:] *= share[:, 2:] == share[:, 2:].max(axis=1, keepdims=True)
        of_ball = terms * ((share / np.exp(ln)) @ self.chosen)
        return _unit(np.einsum("nm,mij,nmj->ni", of_ball, self.frame, q, optimize=True))

    def _terms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = points @ self.frame.transpose(1, 0, 2).reshape(3, -1) - self.shift.ravel()
        q = flat.reshape(len(points), len(self.weight), 3)
        return q, self.weight * np.exp(-2 * np.einsum("nmi,nmi->nm", q, q))

    def _logs(self, terms: np.ndarray) -> np.ndarray:
        return np.asarray(np.log(np.maximum(terms @ self.chosen.T, NOTHING) / THRESHOLD))

    def _shares(self, points: np.ndarray, fade: np.ndarray) -> np.ndarray:
        """How much each field of other parts counts at the points (N, 3): w_q of (1) times `fade` (N,), (N, K − 2)."""
        t = np.einsum("nki,ki->nk", points[:, None] - self.head, self.along)
        past = np.maximum(np.where(self.open_ends[:, 0], 0.0, -t), np.where(self.open_ends[:, 1], 0.0, t - 1.0))
        return np.maximum(fade[:, None] * (1 - smooth(np.maximum(past, 0.0) / BORDER)), NOTHING)

    def _joined(self, ln: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """ln of (1) over T."""
        if not self.others:
            return np.asarray(ln[:, 0])
        return np.asarray(np.logaddexp(BLEND_POWER * ln[:, 0], BLEND_POWER * (ln[:, 2:] + np.log(shares)).max(axis=1)) / BLEND_POWER)


def _joined_field(shape: BodyShape, parts: tuple[Part, ...], index: int, bone: int, R: np.ndarray, head: np.ndarray, rays: Rays,
                  own: np.ndarray) -> _JoinedField:
    neighbours, balls, part = shape.skeleton.neighbours, shape.metaballs, parts[index]
    active = active_balls(balls, neighbours, bone)
    masks = [active, active & np.isin(balls.bone_index, part.bones)]
    others = _adjacent(parts, index, bone)
    masks += [active_balls(balls, neighbours, b) for b in others]
    used = np.flatnonzero(np.any(masks, axis=0))
    of, radii = balls.bone_index[used], balls.radii_m[used]
    frame = R[of] / radii[:, None, :]
    fade = np.maximum(_fade(part, bone, rays, own, shape.lengths_m, head), NOTHING)
    return _JoinedField(
        origin=rays.origin[own], direction=rays.direction[own], fade=fade,
        weight=balls.weight[used], frame=frame, chosen=np.stack(masks)[:, used].astype(np.float64),
        shift=np.einsum("mi,mij->mj", head[of], frame) + balls.centres_m(shape.lengths_m)[used] / radii,
        head=head[others], along=R[others, :, 1] / shape.lengths_m[others, None], open_ends=_open_ends(parts, part, others))


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), NOTHING))


def _adjacent(parts: tuple[Part, ...], index: int, bone: int) -> list[int]:
    """The bones of other parts whose field may join that of `bone`."""
    part = parts[index]
    found = [b for other in parts if other.parent == index and _near(part, other.attachment, bone) for b in other.junction]
    if part.parent is not None and bone in part.junction:
        found += [b for b in parts[part.parent].bones if _near(parts[part.parent], part.attachment, b)]
    return found


def _open_ends(parts: tuple[Part, ...], part: Part, others: list[int]) -> np.ndarray:
    """(K, 2): whether the field of a bone goes on before its head, and beyond its tail; not where its neighbour is one of `others`, too."""
    above = parts[part.parent].bones if part.parent is not None else ()
    ends = []
    for bone in others:
        k = above.index(bone) if bone in above else 0
        beside = (above[max(k - 1, 0):k], above[k + 1:k + 2]) if bone in above else ((), ())
        ends.append([not set(near) & set(others) for near in beside])
    return np.array(ends, dtype=bool).reshape(-1, 2)


def _near(part: Part, attachment: int | None, bone: int) -> bool:
    """Whether `bone` is the bone of its part that another part hangs on, or next to it."""
    return attachment in part.bones and abs(part.bones.index(bone) - part.bones.index(attachment)) <= 1


def _fade(part: Part, bone: int, rays: Rays, own: np.ndarray, lengths_m: np.ndarray, head: np.ndarray) -> np.ndarray:
    """How much other parts count (N,): from 1 to 0 towards the end of the junction, where the contour is the limb's own."""
    if part.parent is None or bone != part.junction[-1] or bone == part.bones[-1]:
        return np.ones(len(own))
    along = np.linalg.norm(rays.origin[own] - head[bone], axis=1) / lengths_m[bone]
    return 1 - smooth((along - 0.5) / 0.5)
