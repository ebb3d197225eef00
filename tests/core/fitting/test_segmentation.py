"""Whose a measured point is: distances are those from the true surface, whatever balls it is made of."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.metaballs import field, field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, one_ball_shape
from tricap.core.fitting.segmentation import SegmentationCache, facing_bone
from tricap.core.fitting.state import ShapeParameters


@pytest.mark.parametrize("balls", ["three", "one"])
@pytest.mark.parametrize("name", ["neck", "forearm.R", "thigh.L"])
def test_points_of_the_surface_are_no_distance_from_it(name: str, balls: str) -> None:
    shape = default_shape(read_model("full"))
    parameters = ShapeParameters(shape if balls == "three" else one_ball_shape(shape))
    state = parameters.state(np.zeros(len(shape.skeleton.dofs)), parameters.vector())
    b = [bone.name for bone in shape.skeleton.bones].index(name)
    counted, across = parameters.neighbours[b, state.balls.bone_index], np.linspace(0.0, 0.2, 2001)
    for f in (0.3, 0.5, 0.7):
        for side in (state.R[b][:, 0], state.R[b][:, 2]):
            ray = state.head_m[b] + f * state.lengths_m[b] * state.R[b][:, 1] + across[:, None] * side
            inside = field(state.balls, state.lengths_m, state.R, state.head_m, ray, counted) > 0.5
            X = ray[np.flatnonzero(inside)[-1:]]
            normal = -field_and_derivatives(state.balls, state.lengths_m, state.R, state.head_m, X, counted)[1]
            gap, along, facing = facing_bone(X, normal, state, np.full(len(X), b))
            assert abs(gap[0]) < 2e-3 and abs(along[0] - f) < 1e-9 and facing[0]  # it was 12 mm off at the neck


def test_held_segments_are_found_anew_when_the_body_grows() -> None:
    parameters = ShapeParameters(default_shape(read_model("arm.R")))
    motion, held, asked = np.zeros(8), SegmentationCache(), []

    def get(grown: float) -> None:
        vector = parameters.vector()
        vector[parameters.layout.group("radii")] += grown
        held.get("frame", parameters.state(motion, vector), lambda: asked.append(grown))

    get(0.0)
    get(0.01)
    assert asked == [0.0]
    get(0.2)
    assert asked == [0.0, 0.2]


def test_profiles_follow_the_shape() -> None:
    parameters = ShapeParameters(default_shape(read_model("arm.R")))
    thin, thick = parameters.vector(), parameters.vector()
    thick[parameters.layout.group("radii")] += 0.3
    states = [parameters.state(np.zeros(8), v) for v in (thin, thick)]
    radii = [s.profiles[1].radii_m.mean() for s in (*states, states[0])]
    assert radii[1] > 1.3 * radii[0] and radii[2] == radii[0]
    assert replace(states[0], motion=states[0].motion).profiles[1] is states[0].profiles[1]
