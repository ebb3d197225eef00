"""The groups of muscle and fat that shape each bone's surface, as balls around the bone: the tables of the complete model.

Positions and sizes are fractions of the half width there, from the middle of the section: `aside` along the bone's x axis (for bones of the
right side; mirrored on the left), `ahead` along its z axis, `width` of the ball's own visible radius. `along` and `length` (its l along the
bone) are fractions of the bone. The arrangement is that of surface anatomy (after the plates of Gray, 1918); the sizes are starting values
for a fit.

Every ball has a name and a kind (A §3.1: metaballs simulate bone, muscle and fat): cores and the bones under the skin are bone, pads and
the soft parts of face and belly fat, the others muscle. The three balls of a bone's simplified model are flesh: all of these together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BONE, MUSCLE, FAT, FLESH = "bone", "muscle", "fat", "flesh"
KINDS = (BONE, MUSCLE, FAT, FLESH)
BONY = frozenset(("iliac crest", "scapula", "occiput", "temple", "wrist", "metacarpus", "knuckles", "ankle", "instep", "toes"))
FATTY = frozenset(("lower abdomen", "face", "heel", "outer edge", "ball of the foot"))
SIMPLE = {1: ("whole",), 3: ("near third", "middle third", "far third")}  # names by the number of a bone's balls


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


@dataclass(frozen=True, slots=True)
class BallName:
    """What a metaball stands for."""

    name: str
    kind: str  # one of `KINDS`


def ball_names(bone_names: Sequence[str], bone_index: np.ndarray) -> list[BallName]:
    """The names of metaballs (M,) in the order of a body's; `bone_index` (M,) are their bones."""
    found, count = [], np.bincount(bone_index, minlength=len(bone_names))
    for m, b in enumerate(bone_index.tolist()):
        own, total = int((bone_index[:m] == b).sum()), int(count[b])
        table = arrangement(bone_names[b])
        if total == len(table) and total not in SIMPLE:
            found.append(BallName(table[own].name, kind_of(table[own].name)))
        else:
            found.append(BallName(SIMPLE[total][own] if total in SIMPLE else f"ball {own + 1}", FLESH))
    return found


def kind_of(ball: str) -> str:
    """The kind of a ball of the tables by its name."""
    group = ball.partition(",")[0]
    if group.startswith("core ") or group in BONY:
        return BONE
    return FAT if group in FATTY else MUSCLE
