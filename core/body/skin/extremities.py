"""Anatomical heads, hands and feet for the skin: the fit's three balls of a bone end where the bone does.

The head's bone begins at the atlas, the hand's ends at the knuckles and the foot's at the ball of the foot, so a body of three balls a bone
has no jaw, no fingers, no heel and no toes, and points measured there enlarge its balls. Poses are fitted with this model all the same.
Here the three balls of such a bone are replaced by ellipsoids in their anatomical positions, with anthropometric sizes for the bone's
length, rotated and scaled to the fitted surface, where that is a head's, a hand's or a foot's (not at the jaw, nor the sole):

    √(−½ ln F(X)) = √(½ ln 2) at points X of the fitted surface ± 4 mm ,   ln s_x, ln s_z = 0 ± 0.12 ,   ln s_y = 0 ± 0.03 ,
    pitch = 0 ± 6°                                                                                        (1)

Sizes of a person of 1.75 m in units of the bone (head 158 mm, hand 96 mm, foot 149 mm; Winter 2009, Table 4.1; Gordon et al., ANSUR 1989):
head 228 mm high, 195 long, 154 wide; hand 189 long, 85 wide; foot 266 long, 98 wide, the ankle 82 mm above the sole.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..anatomy import arrangement
from ..metaballs import VISIBLE, Metaballs
from ..parts import SIDES, BoneProfile, bone_profiles, chain_neighbours
from ..shape import BodyShape
from .mesh import SkinSettings

SIZE = 0.12  # sigma of ln s across the bone in (1)
LENGTH = 0.03  # sigma of ln s along the bone
PITCH = np.radians(6.0)  # sigma of the pitch
UNKNOWN = 1e-3  # sigma of ln s_z and of the pitch where the fitted surface does not determine a thickness
NEAR_M = 0.004  # sigma of the distance from the fitted surface
FARTHEST = 30.0  # bound of a residual, in sigmas
LEAST_F = 1e-9  # bounds of F, so that its logarithm …
MOST_F = 0.99
LEAST_ROOT_SQUARED = 1e-3  # … and the derivative of the root stay finite
BOUND = 3.0  # of the parameters, in sigmas
NECK = "neck"
SIMPLE = 3  # balls of a bone fitted without anatomy
SAME = 1e-6  # relative, of the sizes of an end's ellipsoids: they have one scale


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """Centre and visible half axes, in bone lengths and the axes of a right bone: across (x), along (y), across (z)."""

    name: str
    x: float
    y: float
    z: float
    half_x: float
    half_y: float
    half_z: float


@dataclass(frozen=True, slots=True)
class Extremity:
    """The ellipsoids of a bone, and where the fitted surface is theirs, too: stations (of five along the bone) and sides (x, z, −x, −z).

    `tip`: distance of the flesh's end from the bone's head. A fit with visible toes may extend the bone to there, so that its length is no
    measure of size. `drop`: how far below its head the bone ends if y and z of the ellipsoids are level and down, not the bone's axes.
    """

    stations: tuple[int, ...]
    sides: tuple[int, ...]
    balls: tuple[Ellipsoid, ...]
    tip: float | None = None
    drop: float | None = None


# Head: z forwards. Hand: x to the thumb, z to the palm. Foot: x to the other foot, y level ahead, z down.
TABLES: dict[str, Extremity] = {
    "head": Extremity(
        (1, 2, 3, 4),
        (0, 1, 2, 3),
        (
            Ellipsoid("cranium", 0, 0.56, -0.02, 0.48, 0.53, 0.61),
            Ellipsoid("nape", 0, 0.20, -0.18, 0.22, 0.17, 0.19),
            Ellipsoid("face", 0, 0.16, 0.26, 0.31, 0.28, 0.27),
            Ellipsoid("jaw", 0, -0.02, 0.28, 0.21, 0.14, 0.20),
            Ellipsoid("chin", 0, -0.17, 0.44, 0.13, 0.09, 0.12),
            Ellipsoid("nose", 0, 0.15, 0.59, 0.075, 0.13, 0.11),
        ),
    ),
    "hand": Extremity(
        (1, 2, 3),
        (0, 2),
        (
            Ellipsoid("wrist", 0, 0.05, 0, 0.22, 0.20, 0.15),
            Ellipsoid("palm", -0.02, 0.42, 0, 0.33, 0.31, 0.13),
            Ellipsoid("knuckles", -0.03, 0.82, 0, 0.37, 0.26, 0.12),
            Ellipsoid("thenar", 0.26, 0.34, 0.07, 0.12, 0.24, 0.10),
            Ellipsoid("thumb", 0.43, 0.64, 0.09, 0.10, 0.22, 0.095),
            Ellipsoid("thumb's tip", 0.49, 0.88, 0.10, 0.075, 0.13, 0.075),
            Ellipsoid("fingers 1", -0.04, 1.15, 0.01, 0.34, 0.22, 0.10),
            Ellipsoid("fingers 2", -0.03, 1.42, 0.03, 0.31, 0.20, 0.09),
            Ellipsoid("fingers 3", -0.01, 1.66, 0.05, 0.26, 0.15, 0.08),
        ),
    ),
    "foot": Extremity(
        (1, 2, 3),
        (0, 2, 3),
        (
            Ellipsoid("ankle", 0, -0.01, 0.06, 0.17, 0.18, 0.18),
            Ellipsoid("heel", 0, -0.16, 0.33, 0.19, 0.18, 0.19),
            Ellipsoid("tendon", 0, -0.17, 0.08, 0.10, 0.11, 0.13),
            Ellipsoid("instep", 0.05, 0.25, 0.25, 0.21, 0.29, 0.19),
            Ellipsoid("arch", 0.06, 0.52, 0.34, 0.23, 0.27, 0.155),
            Ellipsoid("outer edge", -0.12, 0.36, 0.44, 0.15, 0.22, 0.11),
            Ellipsoid("sole", -0.06, 0.08, 0.43, 0.17, 0.18, 0.12),
            Ellipsoid("ball", 0.13, 0.86, 0.43, 0.17, 0.20, 0.12),
            Ellipsoid("ball, outer", -0.13, 0.76, 0.45, 0.16, 0.19, 0.10),
            Ellipsoid("great toe", 0.15, 1.10, 0.47, 0.11, 0.16, 0.08),
            Ellipsoid("great toe's tip", 0.13, 1.30, 0.49, 0.095, 0.13, 0.07),
            Ellipsoid("toes", -0.07, 1.02, 0.48, 0.20, 0.15, 0.075),
            Ellipsoid("toes' tips", -0.03, 1.19, 0.50, 0.17, 0.11, 0.065),
        ),
        tip=1.40,
        drop=0.447,
    ),
}


def person_shape(shape: BodyShape) -> BodyShape:
    """The body with anatomical head, hands and feet; all other balls stay as fitted. 0.1 s for a whole body.

    Bones of other names, and those of a user's own with another number of balls, keep them; those of the complete model have no face and no
    fingers either. The upper end of the neck, which the fit widens
    towards the jaw, gets the width of the lower end.
    """
    counts = np.bincount(shape.metaballs.bone_index, minlength=len(shape.skeleton.bones))
    ends = {
        b: TABLES[kind]
        for b, bone in enumerate(shape.skeleton.bones)
        if (kind := bone.name.removesuffix(".R").removesuffix(".L")) in TABLES
        and counts[b] in (SIMPLE, len(arrangement(bone.name)))
        and not has_end(shape, b)
    }
    if not ends:
        return shape
    profiles, bones = bone_profiles(shape.skeleton, shape.lengths_m, shape.metaballs, chain_neighbours(shape)), shape.skeleton.bones
    in_units = {b: shape.has_measured_fingers(bones[b].name) for b in ends}  # measured fingers are those of a hand of the bone's length
    found = {b: np.zeros(4) if in_units[b] else _fitted(shape, b, end, profiles[b]) for b, end in ends.items()}
    made = [_placed(shape, b, end, found[b]) for b, end in ends.items()]
    kept = ~np.isin(shape.metaballs.bone_index, list(ends))
    slender = _slender_neck(shape)
    balls = Metaballs(
        **{
            name: np.concatenate([getattr(slender, name)[kept], *(getattr(m, name) for m in made)])
            for name in ("bone_index", "centre", "radii_m", "weight")
        }
    )
    sigma = np.concatenate([shape.radius_sigma_m[kept], np.full((len(balls.weight) - kept.sum(), 3), np.nan)])
    return replace(shape, metaballs=balls, radius_sigma_m=sigma, weight_sigma=None)


@dataclass(frozen=True, eq=False, slots=True)
class Placement:
    """Where a template of an anatomical end is in its bone's axes: `scale` (3,) [m], x with the sign of its side, then `turn` (3, 3)."""

    scale: np.ndarray
    turn: np.ndarray

    def in_bone(self, places: np.ndarray) -> np.ndarray:
        """Positions [m] in the bone's axes of a template's places (…, 3)."""
        return np.asarray((places * self.scale) @ self.turn)

    def from_bone(self, xyz_m: np.ndarray) -> np.ndarray:
        """The places (…, 3) of a template at positions [m] in the bone's axes."""
        return np.asarray((xyz_m @ self.turn.T) / self.scale)


def has_end(shape: BodyShape, b: int) -> bool:
    """Whether bone b has the ellipsoids of an anatomical head, hand or foot (`person_shape`)."""
    name, radii = (
        shape.skeleton.bones[b].name.removesuffix(".R").removesuffix(".L"),
        shape.metaballs.radii_m[shape.metaballs.bone_index == b],
    )
    if name not in TABLES or len(radii) != len(TABLES[name].balls):
        return False
    half = np.array([[e.half_x, e.half_y, e.half_z] for e in TABLES[name].balls])
    return bool(np.allclose(radii / half, radii[0] / half[0], rtol=SAME, atol=0.0))  # a complete head has as many balls


def placement(shape: BodyShape, b: int) -> Placement:
    """The scale and the pitch with which the ellipsoids of bone b were placed. The bone `has_end`."""
    name, balls = shape.skeleton.bones[b].name, np.flatnonzero(shape.metaballs.bone_index == b)
    table = TABLES[name.removesuffix(".R").removesuffix(".L")].balls
    half, at = (np.array([[getattr(e, f"{kind}{axis}") for axis in "xyz"] for e in table]) for kind in ("half_", ""))
    scale = VISIBLE * shape.metaballs.radii_m[balls[0]] / half[0]
    mine = shape.metaballs.centres_m(shape.lengths_m)[balls]
    level, own = (c[:, 1] + 1j * c[:, 2] for c in (at * scale, mine))
    pitch = np.angle((own * np.conj(level)).sum())  # the rotation that takes the table's places to the balls'
    cosine, sine = np.cos(pitch), np.sin(pitch)
    scale[0] *= -1.0 if name.endswith(".L") else 1.0
    return Placement(scale, np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]))


@lru_cache(maxsize=4)
def shape_with_ends(shape: BodyShape, settings: SkinSettings) -> BodyShape:
    """The body of which contours with these settings are cast; its bones are those of the fit."""
    return person_shape(shape) if settings.anatomy else shape


def _slender_neck(shape: BodyShape) -> Metaballs:
    balls, names = shape.metaballs, [bone.name for bone in shape.skeleton.bones]
    neck = np.flatnonzero(balls.bone_index == (names.index(NECK) if NECK in names else -1))
    radii = balls.radii_m.copy()
    if len(neck) == SIMPLE:
        lowest, *_, top = neck[np.argsort(balls.centre[neck, 1])]
        radii[top] = np.minimum(radii[top], radii[lowest])
    return replace(balls, radii_m=radii)


def _fitted(shape: BodyShape, b: int, end: Extremity, profile: BoneProfile) -> np.ndarray:
    """(4,) ln s_x, ln s_y, ln s_z and the pitch of (1)."""
    from scipy.optimize import least_squares

    radii = profile.radii_m[list(end.stations)][:, list(end.sides)]
    across = radii[..., None] * SIDES[list(end.sides)]
    points = (across + np.outer(profile.stations[list(end.stations)] * shape.lengths_m[b], [0.0, 1.0, 0.0])[:, None]).reshape(-1, 3)
    thick = any(SIDES[side][2] for side in end.sides)
    sigma = np.array([SIZE, LENGTH, SIZE if thick else UNKNOWN, PITCH if thick else UNKNOWN])

    def residuals(x: np.ndarray) -> np.ndarray:
        balls = _placed(shape, b, end, x)
        q = (points[:, None] - balls.centres_m(shape.lengths_m)) / balls.radii_m
        F = np.exp(-2 * np.einsum("nmi,nmi->nm", q, q)).sum(axis=1)
        off = np.sqrt(np.maximum(-0.5 * np.log(np.clip(F, LEAST_F, MOST_F)), LEAST_ROOT_SQUARED)) / VISIBLE - 1
        return np.asarray(np.concatenate([np.clip(off * radii.ravel() / NEAR_M, -FARTHEST, FARTHEST), x / sigma]))

    return np.asarray(least_squares(residuals, np.zeros(4), loss="soft_l1", bounds=(-BOUND * sigma, BOUND * sigma)).x)


def _unit_m(shape: BodyShape, b: int, end: Extremity) -> float:
    """The unit of the table's numbers: the bone's length, or, if the bone may be too long, the length expected from its parent's."""
    length, parent = float(shape.lengths_m[b]), int(shape.skeleton.parents[b])
    if end.tip is None or parent < 0:
        return length
    bones = shape.skeleton.bones
    of_parent = float(shape.lengths_m[parent]) / bones[parent].nominal_length_m * bones[b].nominal_length_m
    return max(min(length, of_parent), length / end.tip)


def _placed(shape: BodyShape, b: int, end: Extremity, x: np.ndarray) -> Metaballs:
    """Balls with the visible size of the table's ellipsoids if each were alone, for parameters (4,) of (1)."""
    side = -1.0 if shape.skeleton.bones[b].name.endswith(".L") else 1.0  # a left bone's x axis is the right one's mirror image
    unit, n = _unit_m(shape, b, end), len(end.balls)
    at = np.array([[side * e.x, e.y, e.z] for e in end.balls]) * np.exp(x[:3])
    half = np.array([[e.half_x, e.half_y, e.half_z] for e in end.balls]) * np.exp(x[:3])
    down = x[3] + (np.arcsin(end.drop * min(unit / shape.lengths_m[b], 1.0)) if end.drop is not None else 0.0)
    cosine, sine = np.cos(down), np.sin(down)
    at[:, 1:] = at[:, 1:] @ np.array([[cosine, -sine], [sine, cosine]])
    return Metaballs(bone_index=np.full(n, b), centre=at * unit / shape.lengths_m[b], radii_m=half * unit / VISIBLE, weight=np.ones(n))
