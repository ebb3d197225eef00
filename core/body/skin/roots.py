"""The intersections of a skin's rays with the implicit surface: a march inwards, then a secant on ln F.

A limb of one chain has the field of its bones, F_b = own + parent's + children's balls, and the surface F_b = T. Where two parts
of a body meet, the sum would bulge, and the maximum would leave a crease; their fields are blended (3, 4),

    G = max blend(M, M_other) ,   M = Σ_b u_b F_b   over a part's bones                                    (1)

with the bones of the other part adjacent to b in M_other. F_b and the next bone's field differ by the balls beyond both, a tenth of the
field at a short neck. So along a chain the weight u passes from bone to bone about their joint X_j,

    u_1 = 1 − S_1 ,   u_2 = S_1 (1 − S_2) , … ,   S_j = smooth((1 + s/h)/2) ,   s = (X − X_j)·(y_j + y_j+1)/(1 + cos β)          (1b)

with h half of the shorter bone, s = 0 on the plane that halves the bend β and the distance from the joint on both axes,
or there would be a step around the neck. Both parts are cast to the same G = T, so overlapping surfaces coincide without a visible seam.
A part ends inside its neighbour:

    first exit of the ray, beyond the outermost F_b = T, from  min( G/T , F_own/(τ T) ) ≥ 1 ,   τ = 0.4    (2)

with F_own the field of its own balls, so its mesh leaves the common surface only where the neighbour's is the body's surface.

One surface where two parts of a body meet: balls common to both are counted once, and the balls of either alone are blended.

    C = Σ min(α, β) f ,   A = Σ α f − C ,   B = Σ β f − C                                                    (3)
    G = C + (A^n + B^n)^(1/n) ,   n = 4                                                                     (4)

f are the fields of the balls at a point, α and β their weights in the two parts. The field of a part's bone includes the balls of adjacent
bones, as in the fit, so near a joint both fields are the same sum: a blend of the whole fields (Ricci 1973, Comput. J. 16) made chest and
pelvis 8 to 13 mm thicker than fitted. (4) is Ricci's blend of the balls that are not common: the fitted surface where the other part is
far, 2^(1/n) times the larger where both are equal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..metaballs import THRESHOLD, active_balls, field, field_and_derivatives
from ..parts import Part
from ..shape import BodyShape
from .rays import SHARPEST_COS, Rays, smooth

BLEND_POWER = 4.0  # n of (4): a fillet of 4 mm on a radius of 60 mm
NOTHING = 1e-300


def blended(terms: np.ndarray, first: np.ndarray, second: np.ndarray, fade: np.ndarray | float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """G (N,) of (4) from fields of balls (N, m) and their weights in either part (N, m), with B times `fade` (N,).

    Also the balls' factors (N, m) in G and in its derivatives: G = Σ factor f, dG = Σ factor df.
    """
    both = np.minimum(first, second)
    return joined(terms, both, first - both, np.reshape(fade, (-1, 1)) * (second - both))


def joined(terms: np.ndarray, both: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(4) from the factors (N, m) of C, A and B."""
    A, B = np.maximum(_sum(terms, a), NOTHING), np.maximum(_sum(terms, b), NOTHING)
    larger = np.maximum(A, B)
    S = larger * ((A / larger) ** BLEND_POWER + (B / larger) ** BLEND_POWER) ** (1 / BLEND_POWER)
    of_a, of_b = (A / S) ** (BLEND_POWER - 1), (B / S) ** (BLEND_POWER - 1)
    return _sum(terms, both) + S, both + of_a[:, None] * a + of_b[:, None] * b


def _sum(terms: np.ndarray, factors: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("nm,nm->n", terms, factors))


OWN_SHARE = 0.4  # τ of (2): below ½, or two parts that reach T together would both stay below it
PASSING = 0.5  # h of (1b) over the shorter bone
FADE_FROM = 0.5  # fraction of a junction's last bone from which on other parts fade
STEP = 0.05  # march, in units of the reach
FINE_STEP = 0.02  # … outwards, where a gap between two parts must not be stepped over
SECANT_STEPS = 7
LEAST_RHO_M = 1e-3  # where the field is too weak to surround the axis

LogField = Callable[[np.ndarray, np.ndarray], np.ndarray]  # ρ (N,), which rays (N,) -> ln of the field over its threshold (N,)


def limb_root(shape: BodyShape, R: np.ndarray, head: np.ndarray, rays: Rays) -> np.ndarray:
    """ρ (V,) of the outermost point with F_b = T on each ray within its reach."""
    active = np.stack([active_balls(shape.metaballs, shape.skeleton.neighbours, b) for b in range(len(shape.skeleton.bones))])[rays.bone]

    def log_ratio(rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        points = rays.origin[which] + rho[:, None] * rays.direction[which]
        return np.log(np.maximum(field(shape.metaballs, shape.lengths_m, R, head, points, active[which]), NOTHING) / THRESHOLD)

    return outermost_root(log_ratio, rays.reach)


def limb_normals(shape: BodyShape, R: np.ndarray, head: np.ndarray, rays: Rays, vertices_m: np.ndarray) -> np.ndarray:
    """Outward unit normals (V, 3) of the field of `limb_root`, −∇F/|∇F|."""
    active = np.stack([active_balls(shape.metaballs, shape.skeleton.neighbours, b) for b in range(len(shape.skeleton.bones))])[rays.bone]
    return _unit(-field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, vertices_m, active)[1])


def part_root(
    shape: BodyShape, parts: tuple[Part, ...], index: int, R: np.ndarray, head: np.ndarray, rays: Rays
) -> tuple[np.ndarray, np.ndarray]:
    """ρ (V,) of (2) on the rays of part `index`, and the outward normals of (1) there (V, 3); bone after bone."""
    rho, normals = np.empty(len(rays.bone)), np.empty((len(rays.bone), 3))
    for bone in parts[index].bones:
        own = np.flatnonzero(rays.bone == bone)
        if len(own):
            mine = rays.rows(own)
            near = _joined_field(shape, parts, index, bone, R, head, mine)
            rho[own] = _connected_root(near, mine.reach)
            normals[own] = near.normals(mine.origin + rho[own, None] * mine.direction)
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
    """ρ (N,) of (2): beyond the own surface up to the first gap in the joint one, or an arm close to the flank would be webbed."""
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
    covered = np.flatnonzero(begins < 0)  # only the neighbour's flesh: the part ends deeper inside
    if len(covered):
        rho[covered] = outermost_root(lambda r, which: near.log_ratio(r, covered[which]), inner[covered])
    return rho


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _JoinedField:
    """The fields near one bone, on the rays of N of its vertices."""

    origin: np.ndarray  # (N, 3)
    direction: np.ndarray  # (N, 3)
    fade: np.ndarray  # (N,) weight of other parts
    weight: np.ndarray  # (m,) of the balls in use
    frame: np.ndarray  # (m, 3, 3) columns: a ball's axes in the world over its l
    shift: np.ndarray  # (m, 3) its centre in them
    of_part: np.ndarray  # (m,) 0 or 1: the balls of the part
    own: "Chain"  # the bone and those next to it
    chosen: np.ndarray  # (K, m) 0 or 1: the fields of these
    others: tuple[tuple["Chain", np.ndarray], ...]  # of other parts, with their fields

    def log_ratio(self, rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        """ln of (2) at ρ (N',) on the rays `which` (N',)."""
        points = self.origin[which] + rho[:, None] * self.direction[which]
        terms = self._terms(points)[1]
        own = self.own.shares(points) @ self.chosen
        G = self._blended(points, terms, own, which)[0]
        return _log(np.minimum(G, terms @ self.of_part / OWN_SHARE) if self.others else G)  # (2)

    def log_own(self, rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        """ln of M/T at ρ (N',) on the rays `which` (N',)."""
        points = self.origin[which] + rho[:, None] * self.direction[which]
        return _log(np.einsum("nm,nm->n", self._terms(points)[1], self.own.shares(points) @ self.chosen))

    def normals(self, points: np.ndarray) -> np.ndarray:
        """−∇G/|∇G| (N, 3) at a point of each ray."""
        q, terms = self._terms(points)
        factors = self._blended(points, terms, self.own.shares(points) @ self.chosen, np.arange(len(points)))[1]
        return _unit(np.einsum("nm,mij,nmj->ni", terms * factors, self.frame, q, optimize=True))

    def _terms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = points @ self.frame.transpose(1, 0, 2).reshape(3, -1) - self.shift.ravel()
        q = flat.reshape(len(points), len(self.weight), 3)
        return q, self.weight * np.exp(-2 * np.einsum("nmi,nmi->nm", q, q))

    def _blended(self, points: np.ndarray, terms: np.ndarray, own: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """G (N',) of (1) from the part's own factors (N', m), and the balls' factors in it (N', m)."""
        G, factors = np.einsum("nm,nm->n", terms, own), own
        for chain, chosen in self.others:
            found, balls = blended(terms, own, chain.shares(points) @ chosen, self.fade[which])
            factors = np.where((found > G)[:, None], balls, factors)
            G = np.maximum(found, G)
        return G, factors


@dataclass(frozen=True, eq=False, slots=True)
class Chain:
    """K consecutive bones, and the transition of the field from each to the next: (1b)."""

    across: np.ndarray  # (K − 1, 3) 1/m
    joints: np.ndarray  # (K − 1,) s/h = X·across − joints

    @staticmethod
    def of(bones: Sequence[int], lengths_m: np.ndarray, R: np.ndarray, head: np.ndarray) -> "Chain":
        """The chain of some bones of a part in a pose."""
        chain = list(bones)
        y, h = R[chain, :, 1], PASSING * np.minimum(lengths_m[chain][:-1], lengths_m[chain][1:])
        bend = 1 + np.maximum(np.einsum("ki,ki->k", y[:-1], y[1:]), SHARPEST_COS)
        across = (y[:-1] + y[1:]) / (bend * h)[:, None]
        return Chain(across, np.einsum("ki,ki->k", head[chain[1:]], across))

    def shares(self, points: np.ndarray) -> np.ndarray:
        """u (N, K) of (1b) at points (N, 3); rows sum to 1."""
        shares = np.ones((len(points), len(self.joints) + 1))
        passed = smooth((1 + points @ self.across.T - self.joints) / 2)
        for j, S in enumerate(passed.T):
            shares[:, j + 1] = shares[:, j] * S
            shares[:, j] *= 1 - S
        return shares


def _log(F: np.ndarray) -> np.ndarray:
    return np.asarray(np.log(np.maximum(F, NOTHING) / THRESHOLD))


def _joined_field(
    shape: BodyShape, parts: tuple[Part, ...], index: int, bone: int, R: np.ndarray, head: np.ndarray, rays: Rays
) -> _JoinedField:
    """The fields near one bone of part `index`, on the rays of that bone."""
    neighbours, balls, part = shape.skeleton.neighbours, shape.metaballs, parts[index]
    k = part.bones.index(bone)
    chains = [part.bones[max(k - 1, 0) : k + 2], *_adjacent(parts, index, bone)]
    masks = [np.stack([active_balls(balls, neighbours, b) for b in chain]) for chain in chains]
    used = np.flatnonzero(np.concatenate(masks).any(axis=0))
    own_chain, *others = [
        (Chain.of(chain, shape.lengths_m, R, head), mask[:, used].astype(np.float64)) for chain, mask in zip(chains, masks)
    ]
    of, radii = balls.bone_index[used], balls.radii_m[used]
    frame = R[of] / radii[:, None, :]
    return _JoinedField(
        origin=rays.origin,
        direction=rays.direction,
        fade=_fade(part, bone, rays, shape.lengths_m, head),
        weight=balls.weight[used],
        frame=frame,
        of_part=np.isin(of, part.bones).astype(np.float64),
        shift=np.einsum("mi,mij->mj", head[of], frame) + balls.centres_m(shape.lengths_m)[used] / radii,
        own=own_chain[0],
        chosen=own_chain[1],
        others=tuple(others),
    )


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), NOTHING))


def _adjacent(parts: tuple[Part, ...], index: int, bone: int) -> list[tuple[int, ...]]:
    """The bones of each other part whose field may join that of `bone`."""
    part = parts[index]
    found = [other.junction for other in parts if other.parent == index and _near(part, other.attachment, bone)]
    if part.parent is not None and bone in part.junction:
        found.append(tuple(b for b in parts[part.parent].bones if _near(parts[part.parent], part.attachment, b)))
    return found


def _near(part: Part, attachment: int | None, bone: int) -> bool:
    """Whether `bone` is the bone of its part to which another part is attached, or adjacent to it."""
    return attachment in part.bones and abs(part.bones.index(bone) - part.bones.index(attachment)) <= 1


def _fade(part: Part, bone: int, rays: Rays, lengths_m: np.ndarray, head: np.ndarray) -> np.ndarray:
    """The weight of other parts (N,): from 1 to 0 over the outer half of the junction, at whose end the contour is the limb's own."""
    if part.parent is None or bone != part.junction[-1] or bone == part.bones[-1]:
        return np.ones(len(rays.bone))
    along = np.linalg.norm(rays.origin - head[bone], axis=1) / lengths_m[bone]
    return 1 - smooth((along - FADE_FROM) / (1 - FADE_FROM))
