"""The trunk's outline: as wide as the model says, without bands and ledges."""

import numpy as np

from tricap.core.body.metaballs import field
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, stout_chain
from tricap.core.body.skeleton import bone_frames


def _half_widths(shape, bone: int, along: np.ndarray, aside: np.ndarray, axis: int) -> np.ndarray:
    """Half of the body's width at fractions of a bone of the trunk; `aside` (N, 2): its middle there, off the bone, in bone lengths."""
    skeleton, balls = shape.skeleton, shape.metaballs
    R, head = bone_frames(skeleton, shape.lengths_m, np.zeros(len(skeleton.dofs)))
    active = skeleton.neighbours[bone, balls.bone_index]
    middle = head[bone] + shape.lengths_m[bone] * (along[:, None] * R[bone][:, 1] + aside @ R[bone][:, [0, 2]].T)
    found = []
    for side in (R[bone][:, axis], -R[bone][:, axis]):
        low, high = np.zeros(len(along)), np.full(len(along), 0.4)
        for _ in range(30):
            half = (low + high) / 2
            inside = field(balls, shape.lengths_m, R, head, middle + half[:, None] * side, active) > 0.5
            low, high = np.where(inside, half, low), np.where(inside, high, half)
        found.append(low)
    return np.mean(found, axis=0)


def test_the_trunk_is_as_wide_as_the_model_says_and_has_no_bands() -> None:
    model = read_model("full")
    shape, lengths = default_shape(model), default_shape(model).lengths_m
    names = [bone.name for bone in model.skeleton.bones]
    assert [names[b] for b in stout_chain(model.skeleton, lengths, model.visible_radii_m)] == ["pelvis", "spine", "chest", "neck", "head"]
    seen = {"pelvis": (slice(1, 3), (0, 2)), "spine": (slice(0, 3), (0, 2)), "chest": (slice(0, 2), (2,))}  # not within hips and shoulders
    for name, (stations, axes) in seen.items():
        b = names.index(name)
        for axis in axes:
            found = _half_widths(shape, b, model.stations[b, stations], model.aside[b, stations], axis)
            assert np.abs(found / model.visible_radii_m[b, stations, axis // 2] - 1).max() < 0.1, (name, axis)  # measured 0.05
    for axis, most in ((0, 2), (2, 4)):  # the outline bends inwards once, at the waist, and outwards once, at the chest
        outline = np.concatenate([_half_widths(shape, b, np.linspace(0.2, 0.95, 40), np.zeros((40, 2)), axis) for b in range(2)])
        turns = np.flatnonzero(np.diff(np.sign(np.diff(outline))))
        assert len(turns) <= most, (axis, turns)


def test_limbs_are_left_alone() -> None:
    model = read_model("arm.R")
    assert stout_chain(model.skeleton, default_shape(model).lengths_m, model.visible_radii_m) == []
