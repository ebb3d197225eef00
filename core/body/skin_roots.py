"""Where the rays of a skin meet the implicit surface: a march inwards, then a secant on ln F.

A limb of one chain has the field of its bones, F_b = own + parent's + children's balls, and the surface F_b = T. Where two parts
of a body meet, the sum would bulge and the larger of the two would leave a crease; their fields are joined by the blend of
constructive solid geometry (Ricci 1973, Comput. J. 16),

    G = (Σ_p F_p^n)^(1/n) ,   n = 8                                                                        (1)

which differs from the larger field by ln 2 / n where both are equal and by nothing elsewhere: a fillet of less than 4 mm on a radius of
60 mm. Both parts are cast to the same G = T, so what overlaps coincides and no seam is seen. A part ends inside its neighbour:

    outermost root of  min( G/T , F_own/(τ T) ) = 1 ,   τ = 0.7                                            (2)

with F_own the field of its own balls, so its mesh leaves the common surface only where the neighbour's is the body's surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .metaballs import THRESHOLD, Metaballs, active_balls, field
from .shape import BodyShape
from .skin_parts import Part
from .skin_rays import Rays, smooth

BLEND_POWER = 8.0  # n of (1)
OWN_SHARE = 0.7  # τ of (2)
STEP = 0.05  # march, in units of the reach
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


def part_root(shape: BodyShape, parts: tuple[Part, ...], index: int, R: np.ndarray, head: np.ndarray, rays: Rays) -> np.ndarray:
    """ρ (V,) of (2) on the rays of part `index`, bone after bone."""
    rho = np.empty(len(rays.bone))
    for bone in parts[index].bones:
        own = np.flatnonzero(rays.bone == bone)
        if len(own):
            rho[own] = outermost_root(_bone_field(shape, parts, index, bone, R, head, rays, own), rays.reach[own])
    return rho


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


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sums:
    """Which balls make which field near one bone: rows of `chosen` (K, m) over the m balls in use."""

    balls: Metaballs  # the m balls in use, numbered by the bones in use
    bones: np.ndarray  # bones in use
    chosen: np.ndarray  # (K, m) 0 or 1: row 0 the field of the bone, row 1 of its own part alone, then those of other parts
    part: np.ndarray  # (K − 2,) which other part a row belongs to


def _bone_field(shape: BodyShape, parts: tuple[Part, ...], index: int, bone: int, R: np.ndarray, head: np.ndarray, rays: Rays,
                own: np.ndarray) -> LogField:
    sums = _sums(shape, parts, index, bone)
    lengths, frames, heads = shape.lengths_m[sums.bones], R[sums.bones], head[sums.bones]
    fade = np.maximum(_fade(parts[index], bone, rays, own, shape.lengths_m, head), NOTHING)

    def log_ratio(rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        points = rays.origin[own[which]] + rho[:, None] * rays.direction[own[which]]
        ln = np.log(np.maximum(_terms(sums.balls, lengths, frames, heads, points) @ sums.chosen.T, NOTHING) / THRESHOLD)
        if not len(sums.part):
            return np.asarray(ln[:, 0])
        joined = BLEND_POWER * ln[:, 0]
        for part in np.unique(sums.part):
            other = ln[:, 2:][:, sums.part == part].max(axis=1) + np.log(fade[which])
            joined = np.logaddexp(joined, BLEND_POWER * other)  # (1)
        return np.minimum(joined / BLEND_POWER, ln[:, 1] - np.log(OWN_SHARE))  # (2)

    return log_ratio


def _terms(balls: Metaballs, lengths_m: np.ndarray, R: np.ndarray, head: np.ndarray, points: np.ndarray) -> np.ndarray:
    """w exp(−2 d) (N, m); each ball's frame as one affine map."""
    frame = R[balls.bone_index] / balls.radii_m[:, None, :]  # columns: axes over l
    shift = np.einsum("mi,mij->mj", head[balls.bone_index], frame) + balls.centres_m(lengths_m) / balls.radii_m
    q = points @ frame.transpose(1, 0, 2).reshape(3, -1) - shift.ravel()
    return np.asarray(balls.weight * np.exp(-2 * np.einsum("nmi,nmi->nm", *[q.reshape(len(points), len(balls.weight), 3)] * 2)))


def _sums(shape: BodyShape, parts: tuple[Part, ...], index: int, bone: int) -> _Sums:
    neighbours, balls, part = shape.skeleton.neighbours, shape.metaballs, parts[index]
    active = active_balls(balls, neighbours, bone)
    masks, owners = [active, active & np.isin(balls.bone_index, part.bones)], []
    for other, bones in _adjacent(parts, index, bone):
        masks += [active_balls(balls, neighbours, b) for b in bones]
        owners += [other] * len(bones)
    used = np.flatnonzero(np.any(masks, axis=0))
    bones_used, number = np.unique(balls.bone_index[used], return_inverse=True)
    kept = Metaballs(bone_index=number, centre=balls.centre[used], radii_m=balls.radii_m[used], weight=balls.weight[used])
    return _Sums(balls=kept, bones=bones_used, chosen=np.stack(masks)[:, used].astype(np.float64), part=np.array(owners, dtype=np.int64))


def _adjacent(parts: tuple[Part, ...], index: int, bone: int) -> list[tuple[int, tuple[int, ...]]]:
    """Other parts whose surface joins that of `bone`, each with the bones whose field it may have there."""
    part = parts[index]
    found = [(i, other.junction) for i, other in enumerate(parts) if other.parent == index and _near(part, other.attachment, bone)]
    if part.parent is not None and bone in part.junction:
        found.append((part.parent, tuple(b for b in parts[part.parent].bones if _near(parts[part.parent], part.attachment, b))))
    return found


def _near(part: Part, attachment: int | None, bone: int) -> bool:
    """Whether `bone` is the bone of its part that another part hangs on, or next to it."""
    return attachment in part.bones and abs(part.bones.index(bone) - part.bones.index(attachment)) <= 1


def _fade(part: Part, bone: int, rays: Rays, own: np.ndarray, lengths_m: np.ndarray, head: np.ndarray) -> np.ndarray:
    """How much other parts count (N,): from 1 to 0 towards the end of the junction, where the contour is the limb's own."""
    if part.parent is None or bone != part.junction[-1] or bone == part.bones[-1]:
        return np.ones(len(own))
    along = np.linalg.norm(rays.origin[own] - head[bone], axis=1) / lengths_m[bone]
    return 1 - smooth((along - 0.5) / 0.5)
