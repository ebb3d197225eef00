"""Families of metaballs against the fitted surface of the bones."""

import numpy as np

from tricap.core.body.families import families
from tricap.core.body.metaballs import THRESHOLD, active_balls, field
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin_parts import body_parts


def surface_of(shape: BodyShape, bone: str, along: float) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Points (N, 3) around a bone on its fitted surface at rest, outward directions, and the frames."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    b = [each.name for each in shape.skeleton.bones].index(bone)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    out = np.cos(angle)[:, None] * R[b, :, 0] + np.sin(angle)[:, None] * R[b, :, 2]
    axis = head[b] + along * shape.lengths_m[b] * R[b, :, 1]
    active = np.broadcast_to(active_balls(shape.metaballs, shape.skeleton.neighbours, b), (24, len(shape.metaballs.weight)))
    low, high = np.zeros(24), np.full(24, 0.25)
    for _ in range(40):
        middle = (low + high) / 2
        inside = field(shape.metaballs, shape.lengths_m, R, head, axis + middle[:, None] * out, active) > THRESHOLD
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return axis + low[:, None] * out, out, (R, head)


def seen_from(shape: BodyShape, chosen: list[np.ndarray], points: np.ndarray, out: np.ndarray, frames: tuple[np.ndarray, np.ndarray]
              ) -> np.ndarray:
    """How far (N,) outside the points the largest family's surface lies, by the field on the way."""
    beside = np.linspace(-0.06, 0.06, 241)
    F = np.max([[field(shape.metaballs, shape.lengths_m, *frames, points + s * out, np.isin(np.arange(len(shape.metaballs.weight)), own))
                 for s in beside] for own in chosen], axis=0)
    return np.asarray(beside[len(beside) - 1 - (F[::-1] > THRESHOLD).argmax(axis=0)])


def test_hips_are_as_thick_as_fitted() -> None:
    """The thigh just below its joint: there the pelvis' balls count as much as its own."""
    shape = default_shape(read_model("full"))
    points, out, frames = surface_of(shape, "thigh.R", 0.1)
    outer = out[:, 0] < 0.3  # not towards the other leg
    parts_alone = [np.flatnonzero(np.isin(shape.metaballs.bone_index, part.bones)) for part in body_parts(shape)]
    assert np.abs(seen_from(shape, families(shape), points, out, frames)[outer]).max() < 2e-3
    assert seen_from(shape, parts_alone, points, out, frames)[outer].min() < -0.02


def test_arms_beside_the_flank_do_not_melt_into_it() -> None:
    """No family holds balls of a trunk and of an upper arm, nor those of both legs below the hips."""
    shape = default_shape(read_model("full"))
    names = np.array([bone.name for bone in shape.skeleton.bones])[shape.metaballs.bone_index]
    for own in families(shape):
        held = set(names[own])
        assert not held & {"chest", "spine"} or not held & {"upper_arm.R", "upper_arm.L"}
        low = own[np.isin(names[own], ("thigh.R", "thigh.L")) & (shape.metaballs.centre[own, 1] > 0.6)]
        assert len(set(names[low])) <= 1


def test_a_limb_alone_is_one_family() -> None:
    shape = default_shape(read_model("arm.R"))
    assert [own.tolist() for own in families(shape)] == [list(range(len(shape.metaballs.weight)))]
