"""The complete model: metaballs in an anatomical arrangement, made from the simplified body (D'Apuzzo et al. 1999, §3.1, §4).

Every bone gets a core along its axis, and around it balls for the groups of muscle and fat that shape it (`anatomy`), placed and sized by
the bone's profile. Then all cross radii are adjusted together until the surface is the simplified body's:

    √(−½ ln F_complete(X)) = √(−½ ln F_simplified(X)) at points X of the surface and a little outside it,   ln l = its start ± 50 %    (1)

So the refined fit begins with the same body and departs from it only where the data require it. A bone without a table (in a user's own
model) gets rings of four balls. The whole body has 150 balls.

The groups of muscle and fat that shape each bone's surface, as balls around the bone: the tables of the complete model.

Positions and sizes are fractions of the half width there, from the middle of the section: `aside` along the bone's x axis (for bones of the
right side; mirrored on the left), `ahead` along its z axis, `width` of the ball's own visible radius. `along` and `length` (its l along the
bone) are fractions of the bone. The arrangement is that of surface anatomy (after the plates of Gray, 1918); the sizes are starting values
for a fit.
"""

from dataclasses import dataclass, replace

import numpy as np

from .metaballs import STATIONS, VISIBLE, Metaballs, field
from .parts import BoneProfile, bone_profiles, chain_neighbours
from .shape import BodyShape, FieldSamples, root_of, with_radii_for
from .skeleton import bone_frames


@dataclass(frozen=True, slots=True)
class Ball:
    """One ball of a bone's table."""

    name: str
    along: float
    aside: float
    ahead: float
    width: float
    length: float


def _core(width: float = 0.75, places: tuple[float, ...] = (1 / 6, 1 / 2, 5 / 6)) -> tuple[Ball, ...]:
    return tuple(Ball(f"core {i + 1}", along, 0.0, 0.0, width, 0.28) for i, along in enumerate(places))


def _both(name: str, along: float, aside: float, ahead: float, width: float, length: float) -> tuple[Ball, Ball]:
    """A pair on both sides of a bone of the trunk."""
    return Ball(f"{name}, left", along, aside, ahead, width, length), Ball(f"{name}, right", along, -aside, ahead, width, length)


# Axes: a trunk's x is to the person's left, its z forwards. An arm's x is outwards (lateral), its z forwards, a thigh's likewise;
# a shin's x is inwards and its z backwards.
TABLES: dict[str, tuple[Ball, ...]] = {
    "pelvis": (
        *_core(),
        *_both("gluteus maximus", 0.20, 0.45, -0.50, 0.50, 0.26),
        *_both("gluteus medius", 0.55, 0.65, -0.10, 0.40, 0.26),
        *_both("iliac crest", 0.80, 0.60, 0.15, 0.40, 0.22),
        Ball("lower abdomen", 0.60, 0.0, 0.50, 0.50, 0.30),
    ),
    "spine": (
        *_core(),
        *_both("rectus abdominis", 0.50, 0.28, 0.50, 0.45, 0.34),
        *_both("oblique", 0.45, 0.65, 0.10, 0.40, 0.34),
        *_both("erector spinae", 0.50, 0.28, -0.50, 0.45, 0.34),
    ),
    "chest": (
        *_core(0.6),
        *_both("pectoralis", 0.55, 0.38, 0.45, 0.38, 0.22),
        *_both("serratus", 0.30, 0.60, 0.15, 0.35, 0.24),
        *_both("latissimus", 0.30, 0.50, -0.35, 0.38, 0.24),
        *_both("scapula", 0.65, 0.38, -0.45, 0.38, 0.22),
        *_both("trapezius", 0.85, 0.35, -0.25, 0.40, 0.18),
    ),
    "neck": (
        *_core(0.8, (0.3, 0.7)),
        *_both("sternocleidomastoid", 0.45, 0.40, 0.35, 0.45, 0.32),
        *_both("nape", 0.50, 0.30, -0.40, 0.45, 0.32),
    ),
    "head": (
        *_core(0.85, (0.25, 0.6)),
        Ball("face", 0.30, 0.0, 0.40, 0.55, 0.26),
        Ball("occiput", 0.55, 0.0, -0.40, 0.60, 0.26),
        *_both("temple", 0.60, 0.35, 0.10, 0.60, 0.26),
    ),
    "shoulder": (
        *_core(0.8, (0.25, 0.75)),
        Ball("deltoid, front", 0.80, 0.0, 0.45, 0.50, 0.28),
        Ball("deltoid, back", 0.80, 0.0, -0.45, 0.50, 0.28),
        Ball("trapezius", 0.35, -0.40, -0.20, 0.50, 0.28),
    ),
    "upper_arm": (
        *_core(0.7),
        Ball("deltoid", 0.18, 0.45, 0.0, 0.50, 0.22),
        Ball("biceps, long head", 0.50, 0.15, 0.45, 0.50, 0.26),
        Ball("biceps, short head", 0.55, -0.25, 0.42, 0.45, 0.26),
        Ball("brachialis", 0.80, 0.15, 0.35, 0.50, 0.22),
        Ball("triceps, long head", 0.40, -0.25, -0.45, 0.48, 0.28),
        Ball("triceps, lateral head", 0.45, 0.30, -0.42, 0.45, 0.28),
        Ball("triceps, medial head", 0.75, 0.0, -0.40, 0.48, 0.24),
    ),
    "forearm": (
        *_core(0.7),
        Ball("brachioradialis", 0.22, 0.45, 0.20, 0.48, 0.26),
        Ball("flexors, upper", 0.28, -0.35, 0.35, 0.48, 0.24),
        Ball("flexors, lower", 0.60, -0.15, 0.40, 0.48, 0.24),
        Ball("extensors, upper", 0.30, 0.15, -0.45, 0.48, 0.24),
        Ball("extensors, lower", 0.62, 0.10, -0.40, 0.48, 0.24),
    ),
    "hand": (
        Ball("wrist", 0.15, 0.0, 0.0, 0.80, 0.26),
        Ball("thenar", 0.35, 0.50, 0.15, 0.50, 0.28),
        Ball("hypothenar", 0.40, -0.50, 0.10, 0.50, 0.30),
        Ball("metacarpus", 0.55, 0.0, 0.0, 0.75, 0.28),
        Ball("knuckles", 0.85, 0.0, 0.0, 0.85, 0.24),
    ),
    "thigh": (
        *_core(0.7),
        Ball("rectus femoris", 0.45, 0.0, 0.48, 0.48, 0.30),
        Ball("vastus lateralis", 0.55, 0.45, 0.22, 0.48, 0.28),
        Ball("vastus medialis", 0.75, -0.42, 0.25, 0.45, 0.20),
        Ball("biceps femoris", 0.55, 0.28, -0.45, 0.48, 0.28),
        Ball("semitendinosus", 0.55, -0.28, -0.45, 0.48, 0.28),
        Ball("adductors, upper", 0.22, -0.45, 0.0, 0.50, 0.22),
        Ball("adductors, lower", 0.45, -0.45, 0.0, 0.45, 0.24),
        Ball("gluteus", 0.12, 0.20, -0.45, 0.55, 0.20),
    ),
    "shin": (
        *_core(0.7),
        Ball("gastrocnemius, medial head", 0.28, 0.28, 0.45, 0.48, 0.22),
        Ball("gastrocnemius, lateral head", 0.26, -0.30, 0.42, 0.48, 0.22),
        Ball("soleus", 0.52, 0.0, 0.42, 0.48, 0.24),
        Ball("tibialis anterior", 0.35, -0.25, -0.42, 0.48, 0.28),
        Ball("peroneus", 0.50, -0.45, 0.0, 0.45, 0.28),
    ),
    "foot": (
        Ball("ankle", 0.12, 0.0, 0.0, 0.85, 0.24),
        Ball("heel", 0.15, 0.0, 0.40, 0.55, 0.22),
        Ball("instep", 0.40, 0.25, 0.0, 0.70, 0.26),
        Ball("outer edge", 0.50, -0.35, 0.10, 0.60, 0.28),
        Ball("ball of the foot", 0.70, 0.0, 0.0, 0.85, 0.24),
        Ball("toes", 0.92, 0.0, 0.0, 0.75, 0.20),
    ),
}
RINGS = tuple(
    Ball(f"{where} {i + 1}", along, aside, ahead, 0.55, 0.26)
    for i, along in enumerate((1 / 6, 1 / 2, 5 / 6))
    for where, aside, ahead in (("outer", 0.4, 0.0), ("front", 0.0, 0.4), ("inner", -0.4, 0.0), ("back", 0.0, -0.4))
)


def arrangement(bone: str) -> tuple[Ball, ...]:
    """The table of a bone by its name, of either side; rings of four balls for a bone that has none."""
    return TABLES.get(bone.removesuffix(".R").removesuffix(".L"), RINGS)


ALONG = 9  # points of the simplified surface along a bone …
AROUND = 12  # … and around it
OUTSIDE = 1.25  # distance from the axis of the points outside, in radii
OUTSIDE_WEIGHT = 0.2  # of the points outside
LEAST_F = 1e-4  # of the field at the points, for its logarithm
FREE = 0.2  # sigma of ln l in (1): muscles keep their part of the surface
SEGMENT = 2 / 3  # span of the three balls of a limb, from 1/6 to 5/6 of the bone
ROUND = 0.9  # on stout bones, where the tables' balls would be flat: l along the bone over l across it, at least


def complete_shape(shape: BodyShape) -> BodyShape:
    """The same body of balls in an anatomical arrangement. Cost: about 2 s for a whole body."""
    lengths, simple = shape.lengths_m, shape.metaballs
    counted = chain_neighbours(shape)
    profiles = bone_profiles(shape.skeleton, lengths, simple, counted)
    start = _placed(shape, profiles)
    R, head = bone_frames(shape.skeleton, lengths, np.zeros(len(shape.skeleton.dofs)))
    places = {b: _about(profile, R[b], head[b], float(lengths[b])) for b, profile in profiles.items()}
    X, bone = np.concatenate(list(places.values())), np.repeat(list(places), 2 * ALONG * AROUND)
    F = np.maximum(field(simple, lengths, R, head, X, counted[bone][:, simple.bone_index]), LEAST_F)
    weight = np.tile(np.repeat([1.0, OUTSIDE_WEIGHT], ALONG * AROUND), len(places))
    samples = FieldSamples(xyz_m=X, active=counted[bone][:, start.bone_index], root=root_of(F), weight=weight)
    balls = with_radii_for(start, np.arange(len(start.weight)), lengths, R, head, samples, FREE)
    return replace(shape, metaballs=balls, radius_sigma_m=np.full(balls.radii_m.shape, np.nan), weight_sigma=None)


def _placed(shape: BodyShape, profiles: dict[int, BoneProfile]) -> Metaballs:
    """The balls placed by the profile; their sizes are fractions of its radii there."""
    bone_index, centre, radii = [], [], []
    for b, profile in profiles.items():
        name, length = shape.skeleton.bones[b].name, float(shape.lengths_m[b])
        side = -1.0 if name.endswith(".L") else 1.0  # a left bone's x axis is the right one's mirror image
        for ball in arrangement(name):
            along = _on_bone(profile, ball)
            ahead, behind = profile.across(np.full(2, along), np.array([[1.0, 1.0], [-1.0, -1.0]]))
            half = (ahead + behind) / 2
            at = (ahead - behind) / 2 + np.array([side * ball.aside, ball.ahead]) * half  # a calf lies off its bone
            bone_index.append(b)
            centre.append([at[0] / length, along, at[1] / length])
            cross = ball.width / VISIBLE * half
            radii.append([cross[0], max(ball.length * _span(profile) * length, ROUND * cross.mean()), cross[1]])
    return Metaballs(bone_index=np.array(bone_index), centre=np.array(centre), radii_m=np.array(radii), weight=np.ones(len(bone_index)))


def _span(profile: BoneProfile) -> float:
    """The span of a bone's balls by that of a limb's three balls."""
    return float(profile.stations[-1] - profile.stations[0]) / SEGMENT


def _on_bone(profile: BoneProfile, ball: Ball) -> float:
    """The ball's fraction along this bone; its table is that of a limb with balls from 1/6 to 5/6."""
    return float(profile.stations[0] + (ball.along - STATIONS[0]) * _span(profile))


def _about(profile: BoneProfile, R: np.ndarray, head: np.ndarray, length: float) -> np.ndarray:
    """Points (2 · ALONG · AROUND, 3) on the profile and outside it."""
    along = np.repeat(np.linspace(profile.stations[0], profile.stations[-1], ALONG), AROUND)
    angle = np.tile(2 * np.pi * np.arange(AROUND) / AROUND, ALONG)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = profile.across(along, direction) * direction
    rows = [np.stack([far * across[:, 0], along * length, far * across[:, 1]], axis=1) for far in (1.0, OUTSIDE)]
    return np.asarray(head + np.concatenate(rows) @ R.T)
