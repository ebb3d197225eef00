"""A whole body for tests of the skin and of the scene, whatever models there are: trunk, arms on clavicles, legs on hips without flesh."""

import numpy as np

from tricap.core.body.metaballs import Metaballs, three_balls
from tricap.core.body.model_file import rest_frame
from tricap.core.body.shape import BodyShape
from tricap.core.body.skeleton import Bone, Dof, Skeleton

UP, DOWN, FRONT, BACK = (0.0, 0, 1), (0.0, 0, -1), (0.0, -1, 0), (0.0, 1, 0)
# name, parent, head, tail, length, y, z, axes of DOFs, seen radii at three stations: across in x and z (or both)
TRUNK = (
    ("pelvis", None, "pelvis", "spine", 0.12, UP, FRONT, "xyz", [(0.165, 0.11), (0.155, 0.105), (0.145, 0.10)]),
    ("spine", "pelvis", "spine", "chest", 0.20, UP, FRONT, "xyz", [(0.14, 0.10), (0.14, 0.10), (0.15, 0.105)]),
    ("chest", "spine", "chest", "neck", 0.22, UP, FRONT, "xyz", [(0.155, 0.11), (0.165, 0.115), (0.12, 0.09)]),
    ("neck", "chest", "neck", "head", 0.08, UP, FRONT, "xz", [0.058, 0.055, 0.055]),
    ("head", "neck", "head", "crown", 0.19, UP, FRONT, "xz", [(0.062, 0.07), (0.075, 0.095), (0.065, 0.08)]),
)
LIMBS = (
    ("shoulder.R", "chest", "neck", "shoulder.R", 0.19, (-1.0, 0, -0.25), FRONT, "xz", [0.06, 0.058, 0.058]),
    ("upper_arm.R", "shoulder.R", "shoulder.R", "elbow.R", 0.30, (-1.0, 0, -1.0), FRONT, "xyz", [0.056, 0.048, 0.042]),
    ("forearm.R", "upper_arm.R", "elbow.R", "wrist.R", 0.255, (-1.0, 0, -1.0), FRONT, "xy", [0.043, 0.038, 0.030]),
    ("hand.R", "forearm.R", "wrist.R", "fingertips.R", 0.18, (-1.0, 0, -1.0), FRONT, "xz", [(0.034, 0.025), (0.042, 0.022), (0.03, 0.016)]),
    ("hip.R", "pelvis", "pelvis", "hip.R", 0.11, (-1.0, 0, -0.3), FRONT, "", None),
    ("thigh.R", "hip.R", "hip.R", "knee.R", 0.43, DOWN, FRONT, "xyz", [0.082, 0.074, 0.058]),
    ("shin.R", "thigh.R", "knee.R", "ankle.R", 0.42, DOWN, BACK, "xy", [0.058, 0.054, 0.038]),
    ("foot.R", "shin.R", "ankle.R", "toe.R", 0.21, (-0.1, -1.0, -0.35), UP, "xz", [(0.038, 0.042), (0.042, 0.036), (0.042, 0.022)]),
)


def whole_body() -> BodyShape:
    """The shape in its A-pose; the base is the pelvis."""
    table = [*TRUNK, *LIMBS, *(_mirrored(row) for row in LIMBS)]
    bones = tuple(
        Bone(
            name=name,
            parent=parent,
            head_joint=head,
            tail_joint=tail,
            nominal_length_m=length,
            R_rest=rest_frame(y, z),
            dofs=tuple(Dof(name=f"{name} {axis}", axis=axis, limits=(-3.0, 3.0)) for axis in "xzy" if axis in axes),
        )
        for name, parent, head, tail, length, y, z, axes, _ in table
    )
    base = tuple(Dof(name=f"pelvis at {axis}", axis=axis) for axis in "xyz")
    skeleton = Skeleton(name="whole", bones=bones, base_dofs=base)
    lengths = np.array([row[4] for row in table])
    fleshy = [i for i, row in enumerate(table) if row[8] is not None]
    seen = [[np.broadcast_to(r, 2) for r in table[i][8]] for i in fleshy]
    balls = _trunk_of_round_balls(three_balls(np.array(fleshy), lengths, np.array(seen, dtype=float)))
    return BodyShape(
        model="whole",
        skeleton=skeleton,
        lengths_m=lengths,
        metaballs=balls,
        length_sigma_m=np.full(len(lengths), np.nan),
        radius_sigma_m=np.full((len(balls.weight), 3), np.nan),
    )


def _trunk_of_round_balls(balls: Metaballs) -> Metaballs:
    """The trunk's bones are shorter than it is wide: balls longer and weaker along it, the pelvis' lower ball below its bone."""
    trunk = balls.bone_index < 3
    radii, centre, weight = balls.radii_m.copy(), balls.centre.copy(), balls.weight.copy()
    radii[trunk, 1] *= 2.0
    weight[trunk] *= 0.55
    pelvis = balls.bone_index == 0
    weight[pelvis], centre[pelvis, 1] = 0.9, (-0.25, 0.3, 0.8)
    return Metaballs(bone_index=balls.bone_index, centre=centre, radii_m=radii, weight=weight)


def posture(shape: BodyShape, **angles_deg: float) -> np.ndarray:
    """Motion (D,) standing at (0.1, −0.2, 1.0) with the named DOFs turned; “forearm_R_x” stands for “forearm.R x”."""
    motion = np.zeros(len(shape.skeleton.dof_names))
    motion[:3] = 0.1, -0.2, 1.0
    for name, angle in angles_deg.items():
        bone, _, axis = name.rpartition("_")
        bone = bone[:-2] + "." + bone[-1] if bone[-2:] in ("_R", "_L") else bone
        motion[shape.skeleton.layout[f"{bone} {axis}"]] = np.radians(angle)
    return motion


def _mirrored(row: tuple) -> tuple:
    name, parent, head, tail, length, y, z, axes, radii = row
    other = [word[:-2] + ".L" if word.endswith(".R") else word for word in (name, parent, head, tail)]
    return (*other, length, (-y[0], *y[1:]), (-z[0], *z[1:]), axes, radii)
