"""Whose a measured point is: distances are those from the true surface, whatever balls it is made of."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.metaballs import field, field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, one_ball_shape
from tricap.core.fitting.inputs.cloud_points import CloudPoints
from tricap.core.fitting.segmentation import SegmentationCache, facing_bone, gap_to_bone, segment
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


def test_points_belong_to_the_limb_on_whose_surface_they_lie() -> None:
    """A body with a bent arm before its trunk: points of every limb's surface, in the middle of the bone; and none far from all limbs."""
    shape = default_shape(read_model("full"))
    parameters, motion, names = ShapeParameters(shape), np.zeros(len(shape.skeleton.dofs)), [bone.name for bone in shape.skeleton.bones]
    for dof, degrees in {"shoulder.R flexion": 30, "elbow.R flexion": 100, "knee.L flexion": 40}.items():
        motion[shape.skeleton.layout[dof]] = np.radians(degrees)
    state = parameters.state(motion, parameters.vector())
    of = np.repeat([names.index(n) for n in ("upper_arm.R", "forearm.R", "forearm.L", "thigh.L", "shin.L", "thigh.R", "shin.R")], 60)
    random = np.random.default_rng(0)
    along, angle = random.uniform(0.35, 0.65, len(of)), random.uniform(0, 2 * np.pi, len(of))
    out = np.cos(angle)[:, None] * state.R[of][:, :, 0] + np.sin(angle)[:, None] * state.R[of][:, :, 2]
    axis = state.head_m[of] + (along * state.lengths_m[of])[:, None] * state.R[of][:, :, 1]
    X = axis - gap_to_bone(axis, state, of)[:, None] * out
    X -= gap_to_bone(X, state, of)[:, None] * out  # limbs are not round
    far, surface = X[:1] + [3.0, 0.0, 0.0], np.tile([0.0, 1.0], (len(names), 1))
    normals, sigma = np.concatenate([out, out[:1]]), np.full(len(X) + 1, 0.003)
    points = CloudPoints(frame=0, xyz_m=np.concatenate([X, far]), normals=normals, sigma_m=sigma)
    rows, bone = segment(points, state, surface, 0.03)
    assert len(X) not in rows and len(rows) > 0.9 * len(X)
    assert (bone == of[rows]).mean() > 0.97


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
