"""The bones of the fingers: rigid parts of the hand for the fit, which knows no fingers; in skin and armature an animator may turn them.

    person_shape (extremities) ── a hand of ellipsoids ──▶ with_fingers: three bones a finger, where the hand's template has them

They have no DOFs, so the motion of a body with fingers is that of the same body without. A rigid connection leads from the wrist to the
first joint of each finger. Names are Rigify's: thumb.01.R … f_pinky.03.L.
"""

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..metaballs import VISIBLE
from ..shape import BodyShape
from ..skeleton import Bone
from .extremities import TABLES, shape_with_ends
from .hand_template import FINGERS, THUMB, finger_frames
from .mesh import SkinSettings

HAND = "hand"
FINGER_BONE = re.compile(r"(thumb|f_index|f_middle|f_ring|f_pinky)\.0[123]\.[LR]")
RIGID_HAND_BONE = re.compile(FINGER_BONE.pattern + r"|palm\.(thumb|index|middle|ring|pinky)\.[LR]")  # all that a fit does not know


@lru_cache(maxsize=4)
def shape_for_skin(shape: BodyShape, settings: SkinSettings) -> BodyShape:
    """The body of which a skin with these settings is made: that of `shape_with_ends`, with the bones of its fingers."""
    return with_fingers(shape_with_ends(shape, settings)) if settings.anatomy else shape


def palm_bone(finger: str, side: str) -> str:
    """The rigid connection from the wrist to a finger's base; `side`: ".R" or ".L"."""
    return f"palm.{finger.removeprefix('f_')}{side}"


def has_hand(shape: BodyShape, b: int) -> bool:
    """Whether bone b is a hand with anatomical ellipsoids (`person_shape`)."""
    balls = shape.metaballs.bone_index == b
    return shape.skeleton.bones[b].name[:-2] == HAND and int(balls.sum()) == len(TABLES[HAND].balls)


def has_fingers(shape: BodyShape, b: int) -> bool:
    """Whether the hand's bone b has bones of fingers (`with_fingers`); without them the skin ends in the ellipsoids' surface."""
    side = shape.skeleton.bones[b].name[-2:]
    return has_hand(shape, b) and any(bone.name == palm_bone(THUMB.name, side) for bone in shape.skeleton.bones)


def hand_scale(shape: BodyShape, b: int) -> np.ndarray:
    """(3,) [m]: the template's unit along the axes of a hand's bone, x with the sign of its side."""
    ellipsoid = TABLES[HAND].balls[0]
    half = np.array([ellipsoid.half_x, ellipsoid.half_y, ellipsoid.half_z])
    scale = VISIBLE * shape.metaballs.radii_m[np.flatnonzero(shape.metaballs.bone_index == b)[0]] / half
    return np.asarray(scale * [-1.0 if shape.skeleton.bones[b].name.endswith(".L") else 1.0, 1.0, 1.0])


def with_fingers(shape: BodyShape) -> BodyShape:
    """The body with the bones of its fingers, without DOFs, and bones from the wrist to their bases; the same if it has no such hands."""
    skeleton, made, lengths = shape.skeleton, [], []
    for b, bone in enumerate(skeleton.bones):
        if has_hand(shape, b) and not has_fingers(shape, b):
            bones, sizes = _finger_bones(bone, hand_scale(shape, b))
            made += bones
            lengths += sizes
    if not made:
        return shape
    unknown = np.full(len(made), np.nan)
    return replace(
        shape,
        skeleton=replace(skeleton, bones=(*skeleton.bones, *made)),
        lengths_m=np.concatenate([shape.lengths_m, lengths]),
        length_sigma_m=np.concatenate([shape.length_sigma_m, unknown]),
    )


def _finger_bones(hand: Bone, scale: np.ndarray) -> tuple[list[Bone], list[float]]:
    bones, lengths, side = [], [], hand.name[-2:]
    for finger in (THUMB, *FINGERS):
        frames = finger_frames(finger)
        joints = np.concatenate([np.zeros((1, 3)), frames.joints]) * scale
        flexes_to = np.concatenate([[[0.0, 0.0, 1.0]], frames.axes[:, :, 2]]) * np.sign(scale)
        names = [palm_bone(finger.name, side), *(f"{finger.name}.0{k}{side}" for k in (1, 2, 3))]
        for k, (name, start, end, towards) in enumerate(zip(names, joints[:-1], joints[1:], flexes_to)):
            length = float(np.linalg.norm(end - start))
            y = (end - start) / length
            z = towards - (towards @ y) * y
            z /= np.linalg.norm(z)
            bones.append(
                Bone(
                    name=name,
                    parent=names[k - 1] if k else hand.name,
                    head_joint=f"{name} head" if k else hand.head_joint,
                    tail_joint=f"{names[k + 1]} head" if k < len(names) - 1 else f"{finger.name} tip{side}",
                    nominal_length_m=length,
                    R_rest=hand.R_rest @ np.stack([np.cross(y, z), y, z], axis=1),
                    rotation_mode="XYZ",
                )
            )
            lengths.append(length)
    return bones, lengths
