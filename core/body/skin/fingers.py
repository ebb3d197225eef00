"""The bones of fingers and toes: rigid parts of hand and foot for the fit, which has none; in skin and armature an animator may turn them.

    person_shape (extremities) ── a hand of ellipsoids ──▶ with_fingers: three bones a finger, where the hand's template has them

They have no DOFs, so the motion of a body with fingers is that of the same body without. A rigid connection leads from the wrist to the
first joint of each finger, and one from the ankle to the ball, where the bone of all toes begins. Names are Rigify's: thumb.01.R …
f_pinky.03.L, toe.R, toe.L.
"""

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..shape import BodyShape
from ..skeleton import Bone
from .extremities import has_end, placement, shape_with_ends
from .foot_template import JOINT_MM, TOE, TOES_END_MM
from .foot_template import UNIT_MM as FOOT_UNIT_MM
from .hand_template import FINGERS, THUMB, finger_frames
from .mesh import SkinSettings

HAND, FOOT = "hand", "foot"
BALL = "ball"  # the rigid connection from the ankle to the ball of the foot
FINGER_BONE = re.compile(r"(thumb|f_index|f_middle|f_ring|f_pinky)\.0[123]\.[LR]|toe\.[LR]")
RIGID_BONE = re.compile(FINGER_BONE.pattern + r"|palm\.(thumb|index|middle|ring|pinky)\.[LR]|ball\.[LR]")  # all that a fit does not have


@lru_cache(maxsize=4)
def shape_for_skin(shape: BodyShape, settings: SkinSettings) -> BodyShape:
    """The body of which a skin with these settings is made: that of `shape_with_ends`, with the bones of its fingers and toes."""
    return with_fingers(shape_with_ends(shape, settings)) if settings.anatomy else shape


def palm_bone(finger: str, side: str) -> str:
    """The rigid connection from the wrist to a finger's base; `side`: ".R" or ".L"."""
    return f"palm.{finger.removeprefix('f_')}{side}"


def has_digits(shape: BodyShape, b: int) -> bool:
    """Whether bone b is a hand or foot with bones of fingers or toes (`with_fingers`); if not, its skin is of the ellipsoids."""
    name = shape.skeleton.bones[b].name
    base = {HAND: palm_bone(THUMB.name, name[-2:]), FOOT: f"{BALL}{name[-2:]}"}.get(name[:-2])
    return has_end(shape, b) and any(bone.name == base for bone in shape.skeleton.bones)


def with_fingers(shape: BodyShape) -> BodyShape:
    """The body with the bones of its fingers and toes, without DOFs, and bones from wrist and ankle to their bases; the same if it has
    neither hands nor feet with anatomical ellipsoids."""
    skeleton, made, lengths = shape.skeleton, [], []
    present = {bone.name for bone in skeleton.bones}
    for b, bone in enumerate(skeleton.bones):
        if not has_end(shape, b) or bone.name[:-2] not in (HAND, FOOT):
            continue
        chains = _finger_chains(shape, b) if bone.name[:-2] == HAND else [_toe_chain(shape, b)]
        for names, joints, flexes_to in chains:
            if not present.intersection(names):
                bones, sizes = _chain_of_bones(bone, names, joints, flexes_to)
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


_Bones = tuple[list[str], np.ndarray, np.ndarray]  # names, joints (n + 1, 3) [m] in the axes of hand or foot, and (n, 3) where they flex to


def _finger_chains(shape: BodyShape, b: int) -> list[_Bones]:
    scale, name, found = placement(shape, b).scale, shape.skeleton.bones[b].name, []
    for finger in (THUMB, *FINGERS):
        frames = finger_frames(finger, shape.finger_bend(name))
        joints = np.concatenate([np.zeros((1, 3)), frames.joints]) * scale
        flexes_to = np.concatenate([[[0.0, 0.0, 1.0]], frames.axes[:, :, 2]]) * np.sign(scale)
        found.append(([palm_bone(finger.name, name[-2:]), *(f"{finger.name}.0{k}{name[-2:]}" for k in (1, 2, 3))], joints, flexes_to))
    return found


def _toe_chain(shape: BodyShape, b: int) -> _Bones:
    placed, side = placement(shape, b), shape.skeleton.bones[b].name[-2:]
    joints = placed.in_bone(np.array([[0.0, 0.0, 0.0], JOINT_MM, TOES_END_MM]) / FOOT_UNIT_MM)
    return [f"{BALL}{side}", f"{TOE}{side}"], joints, np.tile(placed.turn[2], (2, 1))


def _chain_of_bones(parent: Bone, names: list[str], joints: np.ndarray, flexes_to: np.ndarray) -> tuple[list[Bone], list[float]]:
    bones, lengths = [], []
    for k, (name, start, end, towards) in enumerate(zip(names, joints[:-1], joints[1:], flexes_to)):
        length = float(np.linalg.norm(end - start))
        y = (end - start) / length
        z = towards - (towards @ y) * y
        z /= np.linalg.norm(z)
        bones.append(
            Bone(
                name=name,
                parent=names[k - 1] if k else parent.name,
                head_joint=f"{name} head" if k else parent.head_joint,
                tail_joint=f"{names[k + 1]} head" if k < len(names) - 1 else f"{name} tip",
                nominal_length_m=length,
                R_rest=parent.R_rest @ np.stack([np.cross(y, z), y, z], axis=1),
                rotation_mode="XYZ",
            )
        )
        lengths.append(length)
    return bones, lengths
