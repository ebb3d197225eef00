"""A whole person whose surface is of another family than the fitted one: tubes of superelliptic sections, bent by linear skinning.

    v = c(s) + ρ(s) (a(s) cos_p φ , b(s) sin_p φ) ,   |cos_p|^p + |sin_p|^p = 1                                     (1)
    v(t) = Σ_b w_b(s) (R_b(t) R_b(0)ᵀ (v − h_b(0)) + h_b(t))                                                       (2)

s runs along a chain of bones that is straight at rest; the half axes a (to the side), b (ahead) and the middle's shift c ahead are
interpolated between the stations of a table, ρ closes both ends like an ellipse, and the weights w pass from bone to bone within
`BLEND` of the shorter one. No sum of fields makes such sections, joints or creases. Bones are longer and shorter than the model's.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..body.model_file import read_model
from ..body.shape import BodyShape, default_shape
from ..body.skeleton import bone_frames
from .figure import BARE_SKIN, CLOTH, Material, Part, superellipsoid, wall
from .subject import Subject

SIDES = ("R", "L")
JOINTS = ("neck", "pelvis", *(f"{joint}.{side}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in SIDES))
LENGTHS = {"spine": 1.05, "chest": 0.97, "upper_arm": 1.04, "forearm": 0.95, "thigh": 1.03, "shin": 0.96}  # of the model's
SHIRT = replace(CLOTH, stretch=2.2, tint=(0.55, 0.80, 0.82))
TROUSERS = replace(CLOTH, mean=118.0, stretch=2.6, offset_m=0.31, tint=(0.62, 0.68, 0.88))
SHOES = replace(CLOTH, mean=105.0, stretch=1.6, offset_m=0.53, tint=(0.85, 0.68, 0.55))
SKIN = replace(BARE_SKIN, contrast=7.0, tint=(0.96, 0.78, 0.68))
HAIR = replace(CLOTH, mean=62.0, contrast=14.0, stretch=0.9, offset_m=0.71, tint=(0.80, 0.66, 0.55))
PLACE_M = np.array([0.0, 0.0, 0.93])  # of the pelvis at time 0
SPEED_M_S = 0.25  # towards the cameras
WALL_Y_M = 1.6
SCALE = 2.8  # distance of the cameras by that for an arm: the whole person is in the picture
BLEND = 0.28  # of the shorter of two bones, on both sides of their joint
RINGS, RAYS, CAP = 72, 40, 0.05  # rings along a tube, points around it, and length [m] of an end that closes


@dataclass(frozen=True, kw_only=True, slots=True)
class Tube:
    """A part along straight bones: stations as (fraction of the chain's length, half width, half depth, shift ahead) in metres."""

    bones: tuple[str, ...]
    stations: tuple[tuple[float, float, float, float], ...]
    power: float = 2.3
    material: Material = SHIRT


TORSO = Tube(
    bones=("pelvis", "spine", "chest"),
    stations=(
        (-0.20, 0.150, 0.105, -0.010), (0.00, 0.172, 0.118, -0.012), (0.18, 0.158, 0.108, -0.004), (0.38, 0.138, 0.098, 0.004),
        (0.60, 0.155, 0.112, 0.004), (0.80, 0.172, 0.116, -0.004), (0.92, 0.150, 0.095, -0.012), (1.00, 0.080, 0.070, -0.015),
    ),
    power=2.6,
)  # fmt: skip
SEAT = Tube(  # of the trousers, over the torso
    bones=TORSO.bones,
    stations=((-0.20, 0.155, 0.110, -0.010), (0.00, 0.177, 0.123, -0.012), (0.10, 0.172, 0.119, -0.009)),
    power=2.6,
    material=TROUSERS,
)
ARM = Tube(
    bones=("upper_arm", "forearm"),
    stations=(
        (-0.08, 0.058, 0.060, 0.0), (0.10, 0.056, 0.058, 0.002), (0.28, 0.047, 0.052, 0.004), (0.48, 0.041, 0.042, 0.0),
        (0.62, 0.045, 0.043, 0.0), (0.80, 0.037, 0.034, 0.0), (1.02, 0.031, 0.024, 0.0),
    ),
)  # fmt: skip
LEG = Tube(
    bones=("thigh", "shin"),
    stations=(
        (-0.08, 0.088, 0.098, -0.008), (0.12, 0.086, 0.092, 0.002), (0.32, 0.072, 0.080, 0.006), (0.48, 0.058, 0.062, 0.004),
        (0.56, 0.055, 0.060, -0.006), (0.68, 0.056, 0.066, -0.022), (0.84, 0.043, 0.048, -0.012), (1.02, 0.036, 0.042, -0.006),
    ),
    material=TROUSERS,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class End:
    """A superellipsoid on a bone: its centre along the bone (fraction) and ahead [m], half axes across, along, ahead [m]."""

    bone: str
    along: float
    half_axes_m: tuple[float, float, float]
    ahead_m: float = 0.0
    power: float = 2.0
    material: Material = SKIN


ENDS = (
    End(bone="neck", along=0.45, half_axes_m=(0.056, 0.075, 0.058)),
    End(bone="head", along=0.55, half_axes_m=(0.074, 0.118, 0.095), power=2.2),
    End(bone="head", along=0.80, half_axes_m=(0.079, 0.082, 0.101), ahead_m=-0.010, power=2.2, material=HAIR),
    End(bone="hand", along=0.75, half_axes_m=(0.042, 0.088, 0.018), power=2.3),
    End(bone="foot", along=0.55, half_axes_m=(0.042, 0.125, 0.038), power=2.3, material=SHOES),
)


def person(swing_s: float) -> Subject:
    """A person who walks slowly towards the cameras, with arms a little away from the body; a step there and back takes `swing_s`."""
    shape = person_shape()
    meshes = rest_parts(shape)
    rest = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))

    def motion(time_s: np.ndarray | float) -> np.ndarray:
        return walk(shape, np.asarray(time_s, dtype=np.float64), swing_s)

    def parts(time_s: float) -> tuple[Part, ...]:
        now = bone_frames(shape.skeleton, shape.lengths_m, motion(time_s))
        return tuple(replace(part, vertices_m=skinned(part.vertices_m, weights, rest, now)) for part, weights in meshes)

    return Subject(
        shape=shape,
        joints=JOINTS,
        motion=motion,
        parts=parts,
        backdrop=wall(WALL_Y_M, cells=110, half_m=4.5, centre_m=(0.0, 1.2)),
        target_m=PLACE_M + [0.0, -0.1, -0.05],
        scale=SCALE,
        is_metaballs=False,
    )


def person_shape() -> BodyShape:
    """The bones, longer and shorter than the model's; the metaballs in it are the model's, and no truth."""
    shape = default_shape(read_model("full"))
    factor = [LENGTHS.get(bone.name.partition(".")[0], 1.0) for bone in shape.skeleton.bones]
    return replace(shape, lengths_m=shape.lengths_m * factor, length_sigma_m=np.zeros(len(factor)))


def walk(shape: BodyShape, time_s: np.ndarray, swing_s: float) -> np.ndarray:
    """Values (…, D) of the degrees of freedom [m, rad]."""
    phase = 2 * np.pi * time_s / swing_s
    columns: dict[str, np.ndarray] = {
        "pelvis x": PLACE_M[0] + 0.012 * np.sin(phase),
        "pelvis y": PLACE_M[1] - SPEED_M_S * time_s,
        "pelvis z": PLACE_M[2] + 0.012 * np.cos(2 * phase),
        "pelvis rotation": np.radians(6 * np.sin(phase)),
        "spine twist": np.radians(-8 * np.sin(phase)),
        "chest flexion": np.radians(3.0 + 0 * phase),
        "head rotation": np.radians(8 * np.sin(0.5 * phase)),
    }
    for side, sign in zip(SIDES, (1.0, -1.0)):
        swing = sign * np.sin(phase)
        columns |= {
            f"hip.{side} flexion": np.radians(8 + 22 * swing),
            f"knee.{side} flexion": np.radians(12 + 26 * np.clip(sign * np.cos(phase), 0, None) ** 2 + 6 * (1 + swing) / 2),
            f"ankle.{side} flexion": np.radians(-4 * swing),
            f"shoulder.{side} flexion": np.radians(6 - 22 * swing),
            f"shoulder.{side} abduction": np.radians(sign * 14.0) + 0 * phase,
            f"elbow.{side} flexion": np.radians(32 - 14 * swing),
        }
    return np.stack([columns.get(name, 0 * phase) + 0 * phase for name in shape.skeleton.dof_names], axis=-1)


def rest_parts(shape: BodyShape) -> list[tuple[Part, np.ndarray]]:
    """The parts in the rest pose, each with its weights (V, B)."""
    names = [bone.name for bone in shape.skeleton.bones]
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    found = [tube_part(tube, tube.bones, names, shape.lengths_m, R, head) for tube in (TORSO, SEAT)]
    for tube in (ARM, LEG):
        found += [tube_part(tube, tuple(f"{b}.{side}" for b in tube.bones), names, shape.lengths_m, R, head) for side in SIDES]
    for end in ENDS:
        for name in (n for n in names if n.partition(".")[0] == end.bone):
            b = names.index(name)
            centre = np.array([0.0, end.along * shape.lengths_m[b], end.ahead_m])
            own, triangles = superellipsoid(centre, np.array(end.half_axes_m), end.power, 36, 40)
            vertices = own @ R[b].T + head[b]
            weights = np.zeros((len(vertices), len(names)))
            weights[:, b] = 1.0
            found.append((Part(vertices_m=vertices, triangles=triangles, rest_m=vertices, material=end.material), weights))
    return found


def tube_part(
    tube: Tube, bones: tuple[str, ...], names: list[str], lengths_m: np.ndarray, R: np.ndarray, head: np.ndarray
) -> tuple[Part, np.ndarray]:
    """One tube in the rest pose, with its weights (V, B).  (1)"""
    index = [names.index(bone) for bone in bones]
    chain = float(lengths_m[index].sum())
    at, *half = np.array(tube.stations).T
    first, last = at[0] * chain - CAP, at[-1] * chain + CAP
    s = np.linspace(first, last, RINGS + 2)[1:-1]
    a, b, ahead = (np.interp(s / chain, at, column) for column in half)
    to_end = np.minimum(s - first, last - s) / (2 * CAP)
    a, b = (column * np.sqrt(np.clip(1 - np.clip(1 - to_end, 0, 1) ** 2, 1e-4, 1)) for column in (a, b))
    angle = np.arange(RAYS) * (2 * np.pi / RAYS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    circle /= (np.abs(circle) ** tube.power).sum(axis=1, keepdims=True) ** (1 / tube.power)
    side, forwards, axis = R[index[0]][:, 0], R[index[0]][:, 2], R[index[0]][:, 1]
    ring = axis * s[:, None, None] + side * (a[:, None] * circle[:, 0])[..., None]
    ring = ring + forwards * (b[:, None] * circle[:, 1] + ahead[:, None])[..., None]
    vertices = head[index[0]] + np.concatenate([[axis * first], ring.reshape(-1, 3), [axis * last]])
    weights = np.zeros((len(vertices), len(names)))
    weights[:, index] = chain_weights(np.concatenate([[first], np.repeat(s, RAYS), [last]]), lengths_m[index])
    return Part(vertices_m=vertices, triangles=tube_triangles(), rest_m=vertices, material=tube.material), weights


def tube_triangles() -> np.ndarray:
    """The triangles (F, 3) of `RINGS` rings of `RAYS` points between two poles, outward for a right-handed (side, axis, ahead)."""
    i, j = np.meshgrid(np.arange(RINGS - 1), np.arange(RAYS), indexing="ij")
    a, b = 1 + i * RAYS + j, 1 + i * RAYS + (j + 1) % RAYS
    sides = [np.stack([a, a + RAYS, b], -1).reshape(-1, 3), np.stack([b, a + RAYS, b + RAYS], -1).reshape(-1, 3)]
    s, e, low, pole = np.arange(RAYS), (np.arange(RAYS) + 1) % RAYS, 1 + (RINGS - 1) * RAYS, 1 + RINGS * RAYS
    return np.concatenate([*sides, np.stack([0 * s, 1 + s, 1 + e], 1), np.stack([0 * s + pole, low + e, low + s], 1)])


def chain_weights(s: np.ndarray, lengths_m: np.ndarray) -> np.ndarray:
    """Weights (V, K) of the bones of a chain at lengths s (V,) along it."""
    joints = np.cumsum(lengths_m)[:-1]
    beyond = np.ones((len(s), len(lengths_m) + 1))  # the share of the bones from the k-th on
    beyond[:, -1] = 0.0
    for k, (joint, before, after) in enumerate(zip(joints, lengths_m[:-1], lengths_m[1:]), 1):
        t = np.clip((s - joint) / (2 * BLEND * min(before, after)) + 0.5, 0, 1)
        beyond[:, k] = t * t * (3 - 2 * t)
    return beyond[:, :-1] - beyond[:, 1:]


Frames = tuple[np.ndarray, np.ndarray]  # R (B, 3, 3), heads (B, 3)


def skinned(vertices_m: np.ndarray, weights: np.ndarray, rest: Frames, now: Frames) -> np.ndarray:
    """Vertices (V, 3) of the rest pose in another one.  (2)"""
    turn = now[0] @ rest[0].transpose(0, 2, 1)
    shift = now[1] - np.einsum("bij,bj->bi", turn, rest[1])
    used = np.flatnonzero(weights.any(axis=0))
    moved = np.einsum("bij,vj->vbi", turn[used], vertices_m) + shift[used]
    return np.asarray(np.einsum("vb,vbi->vi", weights[:, used], moved))
