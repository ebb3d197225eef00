"""The trunk's outline: as wide as the model says, without bands and ledges."""

import numpy as np

from tricap.core.body.metaballs import field
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, stout_chain
from tricap.core.body.skeleton import bone_frames


def _half_widths(shape, bone: int, along: np.ndarray, axis: int) -> np.ndarray:
    """From a bone's axis to the surface of the trunk alone, at fractions of the bone."""
    skeleton, balls = shape.skeleton, shape.metaballs
    R, head = bone_frames(skeleton, shape.lengths_m, np.zeros(len(skeleton.dofs)))
    chain = [b.name in ("pelvis", "spine", "chest", "neck", "head") for b in skeleton.bones]
    active = skeleton.neighbours[bone, balls.bone_index] & np.array(chain)[balls.bone_index]
    low, high = np.zeros(len(along)), np.full(len(along), 0.4)
    for _ in range(30):
        middle = (low + high) / 2
        X = head[bone] + (along * shape.lengths_m[bone])[:, None] * R[bone][:, 1] + middle[:, None] * R[bone][:, axis]
        inside = field(balls, shape.lengths_m, R, head, X, active) > 0.5
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return low


def test_the_trunk_is_as_wide_as_the_model_says_and_has_no_bands() -> None:
    model = read_model("full")
    shape, lengths = default_shape(model), default_shape(model).lengths_m
    names = [bone.name for bone in model.skeleton.bones]
    assert [names[b] for b in stout_chain(model.skeleton, lengths, model.visible_radii_m)] == ["pelvis", "spine", "chest", "neck", "head"]
    for b, axis in ((b, axis) for b in range(3) for axis in (0, 2)):
        found = _half_widths(shape, b, model.stations[b], axis)
        assert np.abs(found / model.visible_radii_m[b, :, axis // 2] - 1).max() < 0.1, (names[b], axis)  # measured 0.04
    for axis in (0, 2):  # from the hips to the shoulders the outline bends inwards once, at the waist, and outwards once, at the chest
        outline = np.concatenate([_half_widths(shape, b, np.linspace(0.0, 0.95, 40), axis) for b in range(3)])
        turns = np.flatnonzero(np.diff(np.sign(np.diff(outline))))
        assert len(turns) <= 4, (axis, turns)  # measured 3 and 2


def test_limbs_are_left_alone() -> None:
    model = read_model("arm.R")
    assert stout_chain(model.skeleton, default_shape(model).lengths_m, model.visible_radii_m) == []
