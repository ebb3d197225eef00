"""The rays on which the vertices of a skin are found: contours across the bones of one chain, caps at its ends.

The rays of a contour start at a point of the bone's axis, in the direction

    u(φ) = e(φ) + y [ (e(φ)·k_head) h(a/D_head) − (e(φ)·k_tail) h(b/D_tail) ] ,   h(v) = max(0, 1 − v)       (1)

e(φ) is across the bone, y along it, a and b are the contour's distances to the bone's head and tail. With β the bend of a joint between
parent p and child c, cut by its bisecting plane,

    k_tail of p = (y_c − y_p cos β)/(1 + cos β) ,   k_head of c = (−y_p + y_c cos β)/(1 + cos β) ,  |k| = tan(β/2)   (2)

so the contour at the joint lies in the bisecting plane, and the planes of the contours near it form a pencil through one line, at the
distance D/tan(β/2) from the axis on the inner side. Rays end there, so contours never cross. Both bones have the same contour at the joint,
because e(φ) is carried over the joint by the smallest rotation; a twist of the child is spread over its length.

Where flesh continues beyond the last bone (fingers, toes), so do its contours, about a line that bends from the bone's middle to the tips.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import rotation_from_vector
from ..metaballs import VISIBLE
from ..shape import BodyShape
from .mesh import SkinSettings

REACH = 1.25  # farthest visible radius / largest l across: the sum of many balls stays below T beyond it
CAP_START = 0.85  # the cap's rays start this many limb radii inside the joint
DEEPEST_CAP = 0.45  # … but no deeper than this fraction of a stout bone
RADIUS_OF_L = 0.65  # visible radius of a limb of three balls / l
TILT_NEEDED = 1.3  # reach of the tilted contours, in limb radii times tan(β/2); > 1, or contours would cross
TILT_LEAST = 0.30  # … and at least this fraction of the bone
BENT_FROM = 0.5  # fraction of the last bone from which on the contours' middles bend towards the tips
SHARPEST_COS = -0.96  # bends beyond 164° are cut as if 164°


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Rays:
    """The rays on which V vertices are found, in mesh order."""

    origin: np.ndarray  # (V, 3)
    direction: np.ndarray  # (V, 3) ρ is the distance across the bone
    reach: np.ndarray  # (V,) largest ρ
    bone: np.ndarray  # (V,)
    station: np.ndarray  # (V,) [m] from the bone's head to where the vertex' contour meets the bone

    def rows(self, which: np.ndarray) -> "Rays":
        """The rays `which` (N,) alone."""
        return Rays(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Segment:
    """One bone in one pose, with what its contours need."""

    bone: int
    head: np.ndarray
    y: np.ndarray  # along the bone
    e1: np.ndarray  # across it, φ = 0; fixed to the bone
    length: float
    radius: float  # of the limb, roughly
    reach: float
    delta: float  # angle from e1 to the parent's e1 carried over the joint: the twist of the skin
    k_head: np.ndarray
    k_tail: np.ndarray
    first: bool
    last: bool
    beyond: float  # of the last bone: where the cap of its tips, fingers or toes, begins, over its length; counts beyond 1
    aside: np.ndarray  # (3,) from the bone's line to the middle of their tips

    def tilt_reach(self, k: np.ndarray) -> float:
        """D of (1): distance from the joint up to which contours are tilted."""
        share = 0.8 if self.first or self.last else 0.5
        return min(share * self.length, TILT_LEAST * self.length + TILT_NEEDED * self.radius * float(np.linalg.norm(k)))


def segments_of(shape: BodyShape, chain: Sequence[int], R: np.ndarray, head: np.ndarray) -> list[Segment]:
    """The consecutive bones of `chain` in the pose with frames R (B, 3, 3) and heads (B, 3)."""
    balls = shape.metaballs
    reach = float(_reach(shape, chain))
    rest = np.stack([bone.R_rest for bone in shape.skeleton.bones])
    across = np.array([1.0, 0.0, 0.0])  # φ = 0 in the first bone's axes, carried from bone to bone in the rest pose
    segments: list[Segment] = []
    for i, b in enumerate(chain):
        y, delta = R[b, :, 1], 0.0
        if i:
            p = chain[i - 1]
            across = rest[b].T @ swing(rest[p, :, 1], rest[b, :, 1]) @ rest[p] @ across
            carried = R[b].T @ swing(R[p, :, 1], y) @ segments[-1].e1
            delta = float(np.arctan2(np.cross(across, carried)[1], across @ carried))
        widest = balls.radii_m[balls.bone_index == b][:, [0, 2]].max()
        ahead = chain[i + 1] if i + 1 < len(chain) else None
        beyond, aside = _tips(shape, b) if ahead is None else (0.0, np.zeros(3))
        segments.append(
            Segment(
                bone=b,
                head=head[b],
                y=y,
                e1=R[b] @ across,
                length=float(shape.lengths_m[b]),
                radius=RADIUS_OF_L * widest,
                reach=reach,
                delta=delta,
                k_head=_bend(y, R[chain[i - 1], :, 1], -1) if i else np.zeros(3),
                k_tail=_bend(y, R[ahead, :, 1], 1) if ahead is not None else np.zeros(3),
                first=i == 0,
                last=ahead is None,
                beyond=beyond,
                aside=R[b] @ aside,
            )
        )
    return segments


def _tips(shape: BodyShape, b: int) -> tuple[float, np.ndarray]:
    """Where the cap of a bone's last ball begins, as a fraction of the bone's length, and the ball's offset (3,) in the bone's axes."""
    balls, own = shape.metaballs, np.flatnonzero(shape.metaballs.bone_index == b)
    centre, half = balls.centres_m(shape.lengths_m)[own], VISIBLE * balls.radii_m[own]
    tip = int(np.argmax(centre[:, 1] + half[:, 1]))
    end = centre[tip, 1] + half[tip, 1] - CAP_START * half[tip, [0, 2]].min()
    return float(end / shape.lengths_m[b]), centre[tip] * [1.0, 0.0, 1.0]


def _reach(shape: BodyShape, chain: Sequence[int]) -> float:
    """The largest possible distance of a chain's surface from the axis."""
    balls, own = shape.metaballs, np.isin(shape.metaballs.bone_index, chain)
    aside = np.linalg.norm(balls.centres_m(shape.lengths_m)[own][:, [0, 2]], axis=1)
    return float((aside + REACH * balls.radii_m[own][:, [0, 2]].max(axis=1)).max())


def swing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns unit vector a into b."""
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    return rotation_from_vector(axis / sine * np.arctan2(sine, a @ b)) if sine > 1e-9 else np.eye(3)


def _bend(y: np.ndarray, other: np.ndarray, sign: int) -> np.ndarray:
    """k of (2): across the bone y, towards the inner side of its bend with `other` (sign 1: child, −1: parent), tan(β/2) long."""
    cosine = float(y @ other)
    return sign * (other - cosine * y) / (1 + max(cosine, SHARPEST_COS))


def cast(segments: list[Segment], settings: SkinSettings) -> Rays:
    """All rays of a chain: the pole at its base, contour after contour, the pole at its end."""
    parts: list[Rays] = []
    for segment in segments:
        inset = min(CAP_START * segment.radius / segment.length, DEEPEST_CAP)
        start, stop = inset if segment.first else 0.0, 1 - inset if segment.last else 1.0
        stop = segment.beyond if segment.beyond > 1 else stop
        fraction = np.linspace(start, stop, settings.contours + 1)[0 if segment.first else 1 :]
        if segment.first:
            rise = _cap_angles(segment, settings)
            parts.append(_contours(segment, np.full(len(rise), start), -rise[::-1], settings))
        parts.append(_contours(segment, fraction, np.zeros(len(fraction)), settings))
        if segment.last:
            rise = _cap_angles(segment, settings)
            parts.append(_contours(segment, np.full(len(rise), stop), rise, settings))
    parts = [_pole(segments[0], parts[0], 0), *parts, _pole(segments[-1], parts[-1], -1)]
    return Rays(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in Rays.__slots__})


def _cap_angles(segment: Segment, settings: SkinSettings) -> np.ndarray:
    """Angles of the rays of a cap's contours over the contour's plane; a stout bone's cap is wide and has more contours."""
    count = settings.cap_contours * max(1, round(2 * segment.radius / segment.length))
    return np.arange(1, count + 1) * (np.pi / 2 / (count + 1))


def _contours(segment: Segment, fraction: np.ndarray, rise: np.ndarray, settings: SkinSettings) -> Rays:
    """Rays of contours at `fraction` (C,) of the bone; `rise` (C,) turns those of the caps towards the axis (rad, + to the tail)."""
    a, b = fraction * segment.length, (1 - fraction) * segment.length
    phi = np.arange(settings.rays) * (2 * np.pi / settings.rays) + segment.delta * (1 - smooth(fraction))[:, None]
    e = np.cos(phi)[..., None] * segment.e1 + np.sin(phi)[..., None] * np.cross(segment.y, segment.e1)
    tilt, reach = np.zeros(phi.shape), np.full(phi.shape, segment.reach)
    for distance, k, sign in ((a, segment.k_head, 1), (b, segment.k_tail, -1)):
        inner, extent = e @ k, segment.tilt_reach(k)
        tilt += sign * inner * np.maximum(0.0, 1 - distance / extent)[:, None]  # (1)
        limit = np.maximum(distance, extent)[:, None]
        reach = np.where(inner * reach > limit, limit / np.maximum(inner, 1e-9), reach)  # the pencil's line
    u = np.cos(rise)[:, None, None] * (e + tilt[..., None] * segment.y) + np.sin(rise)[:, None, None] * segment.y
    reach = np.where(rise[:, None] == 0, reach, np.maximum(reach, CAP_START * segment.radius + segment.length / 2))
    bent = np.maximum(fraction - BENT_FROM, 0.0) / (segment.beyond - BENT_FROM) if segment.beyond > 1 else 0 * fraction
    origin = segment.head + a[:, None, None] * segment.y + bent[:, None, None] * segment.aside + 0 * u
    return Rays(
        origin=origin.reshape(-1, 3),
        direction=u.reshape(-1, 3),
        reach=reach.ravel(),
        bone=np.full(u[..., 0].size, segment.bone),
        station=np.repeat(a, settings.rays),
    )


def smooth(v: np.ndarray) -> np.ndarray:
    """From 0 to 1 and level at both ends, as v goes from 0 to 1 (Hermite's cubic)."""
    v = np.clip(v, 0.0, 1.0)
    return v * v * (3 - 2 * v)


def _pole(segment: Segment, cap: Rays, at: int) -> Rays:
    direction = segment.y[None] * (-1 if at == 0 else 1)
    return Rays(origin=cap.origin[[at]], direction=direction, reach=cap.reach[[at]], bone=cap.bone[[at]], station=cap.station[[at]])
