"""How thick a body is about its bones: equal to the field's own surface, whatever the balls are."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.metaballs import field
from tricap.core.body.model_file import read_model
from tricap.core.body.parts import SIDES, bone_profiles, chain_neighbours
from tricap.core.body.shape import default_shape, one_ball_shape
from tricap.core.body.skeleton import bone_frames


@pytest.mark.parametrize("balls", ["three", "one"])
def test_profiles_lie_on_the_surface_of_the_chain(balls: str) -> None:
    shape = default_shape(read_model("full"))
    shape = shape if balls == "three" else one_ball_shape(shape)
    counted = chain_neighbours(shape)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    profiles = bone_profiles(shape.skeleton, shape.lengths_m, shape.metaballs, counted)
    assert set(profiles) == set(shape.metaballs.bone_index.tolist())
    for b, profile in profiles.items():
        axis = head[b] + (profile.stations * shape.lengths_m[b])[:, None] * R[b, :, 1]
        for side, radii in zip(SIDES, profile.radii_m.T):
            X = axis + radii[:, None] * (R[b] @ side)
            F = field(shape.metaballs, shape.lengths_m, R, head, X, counted[b, shape.metaballs.bone_index])
            there = radii > 0.0031  # else the axis itself is outside
            assert np.abs(F - 0.5)[there].max() < 2e-3, shape.skeleton.bones[b].name
            assert (F[~there] < 0.51).all()


def test_a_neck_is_as_thick_as_the_model_says_and_no_thicker_for_the_shoulders_beside_it() -> None:
    model = read_model("full")
    shape = default_shape(model)
    profiles = bone_profiles(shape.skeleton, shape.lengths_m, shape.metaballs, chain_neighbours(shape))
    for name in ("neck", "forearm.R", "upper_arm.R"):  # measured 1 to 5 %
        b = [bone.name for bone in shape.skeleton.bones].index(name)
        found = np.array([np.interp(model.stations[b, 1], profiles[b].stations, column) for column in profiles[b].radii_m.T])
        through_the_middle = (found[:2] + found[2:]) / 2  # the flesh may lie more on one side of the bone
        assert np.allclose(through_the_middle, model.visible_radii_m[b, 1], rtol=0.07), name


def test_a_place_beside_a_bone_meets_the_quarter_that_it_lies_in() -> None:
    shape = default_shape(read_model("arm.R"))
    centre = shape.metaballs.centre.copy()
    centre[3:, 0] = 0.05  # the forearm's balls lie towards +x
    shape = replace(shape, metaballs=replace(shape.metaballs, centre=centre))
    profile = bone_profiles(shape.skeleton, shape.lengths_m, shape.metaballs, chain_neighbours(shape))[1]
    axes = profile.across(np.array([0.5, 0.5]), np.array([[0.01, 0.0], [-0.01, 0.0]]))
    assert axes[0, 0] - axes[1, 0] > 0.018 and axes[0, 1] == axes[1, 1]  # twice 0.05 of the bone
