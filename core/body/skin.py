"""The skin of a limb: contours across the bones, each point cast from the axis to the implicit surface (Thalmann, Shen & Chauvineau
1996; D'Apuzzo et al. 1999). The deformation needs no weights: the metaballs move with the bones and the surface is found anew.

The rays of a contour start at a point of the bone's axis, in the direction

    u(φ) = e(φ) + y [ (e(φ)·k_head) h(a/D_head) − (e(φ)·k_tail) h(b/D_tail) ] ,   h(v) = max(0, 1 − v)       (1)

e(φ) is across the bone, y along it, a and b are the contour's distances to the bone's head and tail. With β the bend of a joint between
parent p and child c, cut by its bisecting plane,

    k_tail of p = (y_c − y_p cos β)/(1 + cos β) ,   k_head of c = (−y_p + y_c cos β)/(1 + cos β) ,  |k| = tan(β/2)   (2)

so the contour at the joint lies in the bisecting plane, and the planes of the contours near it form a pencil through one line, at the
distance D/tan(β/2) from the axis on the inner side. Rays end there, so contours never cross. Both bones give the joint the same
contour, because e(φ) is carried over the joint by the smallest rotation; a twist of the child is spread over its length. The
outermost root of F(c + ρ u) = T is found by a march inwards and a secant on ln F.                                             (3)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..geometry.rotation import rotation_from_vector
from ..settings import knob
from ..values import frozen
from .metaballs import THRESHOLD, active_balls, field
from .shape import BodyShape
from .skeleton import bone_frames

REACH = 1.25  # farthest seen radius / largest l across: the sum of many balls stays below T beyond it
CAP_START = 0.85  # the cap's rays start this many limb radii inside the joint
RADIUS_OF_L = 0.65  # seen radius of a limb of three balls / l
TILT_NEEDED = 1.3  # reach of the tilted contours, in limb radii times tan(β/2); > 1, or contours would cross
TILT_LEAST = 0.30  # … and at least this fraction of the bone
SHARPEST_COS = -0.96  # bends beyond 164° are cut as if 164°
STEP = 0.05  # march, in units of the reach
SECANT_STEPS = 7
LEAST_RHO_M = 1e-3  # where the field is too weak to surround the axis
BLEND = 0.2  # half width of the zone of shared bone weights, as a fraction of the bone


@dataclass(frozen=True, kw_only=True, slots=True)
class SkinSettings:
    """How finely the skin is sampled."""

    contours: int = knob(14, "Contours along each bone.", low=4, high=200)
    rays: int = knob(32, "Points on each contour (an even number).", low=8, high=400)
    cap_contours: int = knob(5, "Contours that close each end of the limb.", low=2, high=100)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Skin:
    """A closed mesh, outside counter-clockwise, of the same topology in every posture."""

    vertices_m: np.ndarray  # (V, 3) world: the pole at the base, contour after contour, the pole at the end
    faces: np.ndarray  # (F, 4)
    weights: np.ndarray  # (V, B) share of each bone of the skeleton in a vertex; rows sum to 1
    bone_names: tuple[str, ...]

    def __post_init__(self) -> None:
        v = len(self.vertices_m)
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "faces", frozen(self.faces, (None, 4), np.int64, "faces"))
        object.__setattr__(self, "weights", frozen(self.weights, (v, len(self.bone_names)), name="weights"))

    @property
    def triangles(self) -> np.ndarray:
        """The faces as triangles (2 F, 3)."""
        return np.stack([self.faces[:, [0, 1, 2]], self.faces[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Rays:
    """The rays on which V vertices are looked for, in mesh order."""

    origin: np.ndarray  # (V, 3)
    direction: np.ndarray  # (V, 3) ρ is the distance across the bone
    reach: np.ndarray  # (V,) largest ρ
    bone: np.ndarray  # (V,)
    weights: np.ndarray  # (V, B)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Segment:
    """One bone in one posture, as the contours see it."""

    bone: int
    head: np.ndarray
    y: np.ndarray  # along the bone
    e1: np.ndarray  # across it, φ = 0; fixed to the bone
    length: float
    radius: float  # of the limb, roughly
    reach: float
    delta: float  # angle from e1 to the parent's e1 carried over the joint: the twist, as seen by the skin
    k_head: np.ndarray
    k_tail: np.ndarray
    first: bool
    last: bool

    def tilt_reach(self, k: np.ndarray) -> float:
        """D of (1): how far from the joint contours are tilted."""
        share = 0.8 if self.first or self.last else 0.5
        return min(share * self.length, TILT_LEAST * self.length + TILT_NEEDED * self.radius * float(np.linalg.norm(k)))


def limb_skin(shape: BodyShape, motion: np.ndarray, settings: SkinSettings | None = None) -> Skin:
    """The skin of a limb in one posture. `motion` (D,) rad and metres, in the order of the skeleton's DOFs.

    A vertex lies on F = T, with the field of its bone and of the bones that meet it. Two exceptions: where two segments are pressed
    together the vertex stops at the plane between them, and where the metaballs do not reach around the axis it stays 1 mm from it.
    About 10 ms for two bones at the default settings.

    Raises:
        InputError: the bones with metaballs are no single chain, or the number of rays is odd.
    """
    settings = settings or SkinSettings()
    if settings.rays % 2:
        raise InputError(f"The skin needs an even number of rays, not {settings.rays}; set skin.rays to {settings.rays + 1}.")
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.asarray(motion, dtype=np.float64))
    rays = _cast(_segments(shape, R, head), settings, len(shape.skeleton.bones))
    rho = _outermost_root(shape, R, head, rays)
    return Skin(vertices_m=rays.origin + rho[:, None] * rays.direction, faces=_faces(len(rays.bone), settings.rays),
                weights=rays.weights, bone_names=tuple(bone.name for bone in shape.skeleton.bones))


def _chain(shape: BodyShape) -> list[int]:
    chain = sorted(set(shape.metaballs.bone_index.tolist()))
    for parent, child in zip(chain, chain[1:]):
        if shape.skeleton.parents[child] != parent or not shape.skeleton.starts_at_tail[child]:
            raise InputError(f"The skin of “{shape.model}” cannot be made: its bones are no single chain; use a model of one limb.")
    return chain


def _segments(shape: BodyShape, R: np.ndarray, head: np.ndarray) -> list[_Segment]:
    chain, balls = _chain(shape), shape.metaballs
    rest = np.stack([bone.R_rest for bone in shape.skeleton.bones])
    across = np.array([1.0, 0.0, 0.0])  # φ = 0 in the first bone's axes, carried from bone to bone in the rest pose
    segments: list[_Segment] = []
    for i, b in enumerate(chain):
        y, delta = R[b, :, 1], 0.0
        if i:
            p = chain[i - 1]
            across = rest[b].T @ _swing(rest[p, :, 1], rest[b, :, 1]) @ rest[p] @ across
            carried = R[b].T @ _swing(R[p, :, 1], y) @ segments[-1].e1
            delta = float(np.arctan2(np.cross(across, carried)[1], across @ carried))
        widest = balls.radii_m[balls.bone_index == b][:, [0, 2]].max()
        ahead = chain[i + 1] if i + 1 < len(chain) else None
        segments.append(_Segment(
            bone=b, head=head[b], y=y, e1=R[b] @ across, length=float(shape.lengths_m[b]), radius=RADIUS_OF_L * widest,
            reach=REACH * balls.radii_m[:, [0, 2]].max(), delta=delta,
            k_head=_bend(y, R[chain[i - 1], :, 1], -1) if i else np.zeros(3),
            k_tail=_bend(y, R[ahead, :, 1], 1) if ahead is not None else np.zeros(3), first=i == 0, last=ahead is None))
    return segments


def _swing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns unit vector a into b."""
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    return rotation_from_vector(axis / sine * np.arctan2(sine, a @ b)) if sine > 1e-9 else np.eye(3)


def _bend(y: np.ndarray, other: np.ndarray, sign: int) -> np.ndarray:
    """k of (2): across the bone y, towards the inner side of its bend with `other` (sign 1: child, −1: parent), tan(β/2) long."""
    cosine = float(y @ other)
    return sign * (other - cosine * y) / (1 + max(cosine, SHARPEST_COS))


def _cast(segments: list[_Segment], settings: SkinSettings, n_bones: int) -> _Rays:
    parts: list[_Rays] = []
    neighbours = [None, *segments, None]
    for before, segment, after in zip(neighbours, segments, neighbours[2:]):
        inset = CAP_START * segment.radius / segment.length
        start, stop = inset if segment.first else 0.0, 1 - inset if segment.last else 1.0
        fraction = np.linspace(start, stop, settings.contours + 1)[0 if segment.first else 1:]
        around = (before.bone if before else None, after.bone if after else None)
        if segment.first:
            parts.append(_contours(segment, np.full(settings.cap_contours, start), -_cap_angles(settings)[::-1], around, settings, n_bones))
        parts.append(_contours(segment, fraction, np.zeros(len(fraction)), around, settings, n_bones))
        if segment.last:
            parts.append(_contours(segment, np.full(settings.cap_contours, stop), _cap_angles(settings), around, settings, n_bones))
    parts = [_pole(segments[0], parts[0], 0), *parts, _pole(segments[-1], parts[-1], -1)]
    return _Rays(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in _Rays.__slots__})


def _cap_angles(settings: SkinSettings) -> np.ndarray:
    return np.arange(1, settings.cap_contours + 1) * (np.pi / 2 / (settings.cap_contours + 1))


def _contours(segment: _Segment, fraction: np.ndarray, rise: np.ndarray, around: tuple[int | None, int | None], settings: SkinSettings,
              n_bones: int) -> _Rays:
    """Rays of contours at `fraction` (C,) of the bone; `rise` (C,) turns those of the caps towards the axis (rad, + to the tail)."""
    a, b = fraction * segment.length, (1 - fraction) * segment.length
    phi = np.arange(settings.rays) * (2 * np.pi / settings.rays) + segment.delta * (1 - _smooth(fraction))[:, None]
    e = np.cos(phi)[..., None] * segment.e1 + np.sin(phi)[..., None] * np.cross(segment.y, segment.e1)
    tilt, reach = np.zeros(phi.shape), np.full(phi.shape, segment.reach)
    for distance, k, sign in ((a, segment.k_head, 1), (b, segment.k_tail, -1)):
        inner, extent = e @ k, segment.tilt_reach(k)
        tilt += sign * inner * np.maximum(0.0, 1 - distance / extent)[:, None]  # (1)
        limit = np.maximum(distance, extent)[:, None]
        reach = np.where(inner * reach > limit, limit / np.maximum(inner, 1e-9), reach)  # the pencil's line
    u = np.cos(rise)[:, None, None] * (e + tilt[..., None] * segment.y) + np.sin(rise)[:, None, None] * segment.y
    reach = np.where(rise[:, None] == 0, reach, np.maximum(reach, CAP_START * segment.radius + segment.length / 2))
    weights = np.zeros((len(fraction), n_bones))
    for distance, other in ((a, around[0]), (b, around[1])):
        if other is not None:
            weights[:, other] = 0.5 * (1 - _smooth(distance / (BLEND * segment.length)))
    weights[:, segment.bone] = 1 - weights.sum(axis=1)
    origin = segment.head + a[:, None, None] * segment.y + 0 * u
    return _Rays(origin=origin.reshape(-1, 3), direction=u.reshape(-1, 3), reach=reach.ravel(), bone=np.full(u[..., 0].size, segment.bone),
                 weights=np.repeat(weights, settings.rays, axis=0))


def _smooth(v: np.ndarray) -> np.ndarray:
    v = np.clip(v, 0.0, 1.0)
    return v * v * (3 - 2 * v)


def _pole(segment: _Segment, cap: _Rays, at: int) -> _Rays:
    direction = segment.y[None] * (-1 if at == 0 else 1)
    return _Rays(origin=cap.origin[[at]], direction=direction, reach=cap.reach[[at]], bone=cap.bone[[at]], weights=cap.weights[[at]])


def _outermost_root(shape: BodyShape, R: np.ndarray, head: np.ndarray, rays: _Rays) -> np.ndarray:
    """ρ (V,) of the outermost point with F = T on each ray within its reach.  (3)"""
    active = np.stack([active_balls(shape.metaballs, shape.skeleton.neighbours, b) for b in range(len(shape.skeleton.bones))])[rays.bone]

    def log_ratio(rho: np.ndarray, which: np.ndarray) -> np.ndarray:
        points = rays.origin[which] + rho[:, None] * rays.direction[which]
        return np.log(np.maximum(field(shape.metaballs, shape.lengths_m, R, head, points, active[which]), 1e-300) / THRESHOLD)

    every = np.arange(len(rays.bone))
    outer, inner, pending = rays.reach.copy(), np.zeros(len(every)), every
    for step in np.arange(1 - STEP, 0, -STEP):
        rho = step * rays.reach[pending]
        inside = log_ratio(rho, pending) >= 0
        inner[pending[inside]], pending = rho[inside], pending[~inside]
        outer[pending] = rho[~inside]
    f_inner, f_outer = log_ratio(inner, every), log_ratio(outer, every)
    rho = _secant(log_ratio, inner, outer, f_inner, f_outer)
    return np.where(f_outer >= 0, outer, np.where(f_inner < 0, LEAST_RHO_M, np.maximum(rho, LEAST_RHO_M)))


def _secant(f: Callable[[np.ndarray, np.ndarray], np.ndarray], a: np.ndarray, b: np.ndarray, fa: np.ndarray, fb: np.ndarray) -> np.ndarray:
    """Roots between a and b (V,) with f(a) ≥ 0 > f(b), by the Illinois rule (Dowell & Jarratt 1971)."""
    every = np.arange(len(a))
    for _ in range(SECANT_STEPS):
        middle = np.clip(a + (b - a) * fa / np.where(fa == fb, 1.0, fa - fb), np.minimum(a, b), np.maximum(a, b))
        fm = f(middle, every)
        crossed = fm * fb < 0  # the root lies between the middle and b
        a, fa = np.where(crossed, b, a), np.where(crossed, fb, fa / 2)
        b, fb = middle, fm
    return b


def _faces(n_vertices: int, rays: int) -> np.ndarray:
    """Quadrilaterals between contours; at the poles each spans two edges of the contour."""
    contours = (n_vertices - 2) // rays
    i, j = np.meshgrid(np.arange(contours - 1), np.arange(rays), indexing="ij")
    here, on = 1 + i * rays + j, 1 + i * rays + (j + 1) % rays
    sides = np.stack([here, on, on + rays, here + rays], axis=-1).reshape(-1, 4)
    k = np.arange(0, rays, 2)
    first, last = 1 + np.stack([k, k + 1, (k + 2) % rays], axis=1), n_vertices - 1 - rays + np.stack([k, k + 1, (k + 2) % rays], axis=1)
    start = np.column_stack([np.zeros(len(k), dtype=np.int64), first[:, ::-1]])
    end = np.column_stack([np.full(len(k), n_vertices - 1), last])
    return np.concatenate([start, sides, end])
