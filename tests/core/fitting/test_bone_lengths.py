"""The prior of bone lengths: clicked ones are free, the others follow the person's size and the model's proportions."""

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, scaled_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.inputs.clicks import initial_clicks, read_clicks
from tricap.core.fitting.inputs.silhouettes import Rays, near_rays, touched
from tricap.core.fitting.observations import Proportions
from tricap.core.fitting.observations.shape_priors import clicked_chains, proportions
from tricap.core.fitting.stages.inverse_kinematics import clicked_stature, dof_priors
from tricap.core.fitting.state import ShapeParameters

from .limb_scene import front_rig

CLICKED = ["neck", "head", *(f"{joint}.{side}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in "LR")]


@pytest.fixture(scope="module")
def full():
    return read_model("full")


def _located(model) -> np.ndarray:
    return np.isin(model.skeleton.joint_names, CLICKED)


def _prior(model) -> tuple[dict[str, int], Proportions]:
    names = [bone.name for bone in model.skeleton.bones]
    prior = proportions(model, default_shape(model).lengths_m, _located(model), 0.15, 0.04)
    return {name: i for i, name in enumerate(names)}, prior


def _updated(prior: Proportions, rows: list[int], by: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean change and sigma (B,) of all lengths' logarithms when those of some bones are seen to be `by` larger."""
    K = prior.covariance
    gain = K[:, rows] @ np.linalg.inv(K[np.ix_(rows, rows)])
    return gain @ np.full(len(rows), by), np.sqrt(np.maximum(np.diag(K - gain @ K[rows]), 0.0))


def test_bones_between_clicks_are_chains_and_those_beyond_are_none(full) -> None:
    names = [bone.name for bone in full.skeleton.bones]
    chains = {frozenset(names[b] for b in chain) for chain in clicked_chains(full.skeleton, _located(full))}
    assert frozenset({"pelvis", "spine", "chest"}) in chains and frozenset({"collar.R", "shoulder.R"}) in chains
    assert {frozenset({bone}) for bone in ("neck", "hip.L", "upper_arm.L", "forearm.R", "thigh.R", "shin.L")} <= chains
    assert not {"head", "hand.R", "foot.L"} & set().union(*chains)
    assert clicked_chains(full.skeleton, np.zeros(len(full.skeleton.joint_names), dtype=bool)) == []


def test_what_nobody_clicked_follows_the_size_that_the_clicked_limbs_have(full) -> None:
    at, prior = _prior(full)
    limbs = [at[f"{bone}.{side}"] for bone in ("thigh", "shin", "upper_arm", "forearm") for side in "LR"]
    change, sigma = _updated(prior, limbs, 0.08)
    assert 0.04 < change[at["head"]] < 0.08 and abs(change[at["head"]] - change[at["hand.R"]]) < 1e-12
    assert 0.04 < sigma[at["head"]] < 0.06  # its own 4 %, and what is left open of the size


def test_arms_of_somebody_who_was_not_clicked_follow_the_legs_and_not_the_trunk(full) -> None:
    """Short legs are seen; arms that one frame hides are then short, too, and the trunk keeps its size."""
    lengths, nobody = default_shape(full).lengths_m, np.zeros(len(full.skeleton.joint_names), dtype=bool)
    prior = proportions(full, lengths, nobody, 0.15, 0.01, 0.01, found=[name for name in CLICKED if name not in ("neck", "head")])
    at = {bone.name: b for b, bone in enumerate(full.skeleton.bones)}
    change, sigma = _updated(prior, [at[f"{bone}.{side}"] for bone in ("thigh", "shin") for side in "LR"], -0.12)
    assert -0.12 < change[at["forearm.R"]] < -0.09 and abs(change[at["spine"]]) < 0.01 and sigma[at["forearm.R"]] < 0.08
    clicked = proportions(full, lengths, nobody, 0.15, 0.01, 0.01)
    assert (np.diag(prior.covariance) > np.diag(clicked.covariance)).sum() == 8  # of limbs alone


def test_one_clicked_bone_does_not_pull_the_others(full) -> None:
    at, prior = _prior(full)
    change, _ = _updated(prior, [at["forearm.R"]], -0.12)
    assert abs(change[at["head"]]) < 0.03
    assert np.sqrt(prior.covariance[at["forearm.R"], at["forearm.R"]]) > 0.13  # what was clicked is free


def test_a_chain_shares_what_its_ends_say_and_a_short_one_is_held(full) -> None:
    at, prior = _prior(full)
    change, _ = _updated(prior, [at["chest"]], 0.10)
    assert change[at["spine"]] > 0.08 and change[at["pelvis"]] > 0.08  # the three are seen as one length
    free = {bone: prior.covariance[at[bone], at[bone]] for bone in ("shoulder.R", "hip.R", "thigh.R")}
    assert free["hip.R"] < free["shoulder.R"] < free["thigh.R"]  # the shoulder's chain is collarbone and shoulder


def test_a_neck_is_as_long_as_the_heads_surface_says_and_the_head_keeps_its_size(full) -> None:
    at, prior = _prior(full)
    K, rows = prior.covariance, np.array([at["neck"], at["head"]])
    lower = default_shape(full).lengths_m[rows]  # the crown is seen 40 mm lower than proportions have it
    gain = K[:, rows] @ lower / (lower @ K[np.ix_(rows, rows)] @ lower)
    change = -0.04 * gain
    assert change[at["neck"]] < -0.3 and -0.02 < change[at["head"]] - change[at["hand.R"]] < 0


def test_lengths_that_are_known_leave_the_neck_no_freedom(full) -> None:
    known = proportions(full, default_shape(full).lengths_m, _located(full), 0.001, 0.001)
    assert np.sqrt(np.diag(known.covariance)).max() < 0.003


def test_an_outline_beyond_the_hand_is_the_fingers_and_one_over_the_crown_is_the_heads(full) -> None:
    parameters = ShapeParameters(default_shape(full))
    state = parameters.state(np.zeros(len(full.skeleton.dofs)), parameters.vector())
    at = {bone.name: i for i, bone in enumerate(full.skeleton.bones)}

    def owners(bone: str, along: float) -> np.ndarray:
        b = at[bone]
        X = state.head_m[b] + along * state.lengths_m[b] * state.R[b][:, 1] + 0.04 * state.R[b][:, 0]
        view = state.R[b][:, 2]
        rays = Rays(
            origin_m=(X - 3 * view)[None],
            direction=view[None],
            outward=state.R[b][:, 0][None],
            angle=np.full(1, 1e-3),
            patch=np.ones(1),
            model_m=np.full(1, 0.004),
        )
        return touched(rays, state, full.surface, 0.1)[1]

    assert owners("hand.R", 0.6).tolist() == [at["hand.R"]] and not len(owners("hand.R", 1.2))
    assert owners("head", 1.1).tolist() == [at["head"]]


def test_pairs_of_rays_and_bones_are_those_within_reach(full) -> None:
    """Against places all along both."""
    parameters, rng = ShapeParameters(default_shape(full)), np.random.default_rng(3)
    state = parameters.state(np.zeros(len(full.skeleton.dofs)), parameters.vector())
    bones = np.unique(state.balls.bone_index)
    origin = np.array([0.0, -3.0, 1.0]) + rng.normal(0, 0.1, (40, 3))
    direction = state.head_m[rng.choice(bones, 40)] + rng.normal(0, 0.1, (40, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rows, bone, X = near_rays(origin, direction, state, 0.05, bones)
    assert (np.diff(rows) >= 0).all()
    t, share = np.linspace(2.0, 4.0, 401), np.linspace(0.0, 1.0, 51)
    found = set(zip(rows.tolist(), bone.tolist()))
    for b in bones.tolist():
        segment = state.head_m[b] + (share * state.lengths_m[b])[:, None] * state.R[b, :, 1]
        reach = state.profile_table.radii_m[b].max() + 0.05
        for n in range(40):
            along = origin[n] + t[:, None] * direction[n]
            away = np.linalg.norm(along[:, None] - segment[None], axis=2).min()
            if abs(away - reach) > 0.005:
                assert ((n, b) in found) == (away < reach)
    nearest = np.einsum("ki,ki->k", X - origin[rows], direction[rows])
    np.testing.assert_allclose(X, origin[rows] + nearest[:, None] * direction[rows], atol=1e-12)


@pytest.mark.parametrize("small", [0.7, 0.88, 1.0])
def test_clicks_that_scatter_along_the_view_do_not_lengthen_the_person(full, small: float) -> None:
    shape, rng, rig = scaled_shape(default_shape(full), small), np.random.default_rng(3), front_rig()
    motion = np.zeros(len(full.skeleton.dofs))
    motion[1] = 2.0  # further from the cameras: 1 px is 20 mm along the view
    joints = joint_positions(full.skeleton, shape.lengths_m, motion)
    clicked = {name: {c.name: c.project(joints[name]) + rng.normal(0, 3, 2) for c in rig.cameras} for name in CLICKED}
    observed, places = read_clicks(rig, full.skeleton.joint_names, clicked, 5.0)
    clicks = initial_clicks(places, full.skeleton.joint_names, [observed])
    found, sigma = clicked_stature(ShapeParameters(default_shape(full)), clicks, dof_priors(full.skeleton, 0.035, motion[:3]))
    assert abs(np.log(found / small)) < 2 * sigma


def test_a_head_that_is_seen_too_long_makes_no_other_person_of_one_whose_joints_were_clicked(full) -> None:
    names, lengths = [bone.name for bone in full.skeleton.bones], default_shape(full).lengths_m
    at = [names.index(name) for name in ("head", "hand.R")]
    changes = [_updated(proportions(full, lengths, _located(full), 0.15, 0.01, sigma), at[:1], 0.15)[0][at[1]] for sigma in (0.02, 0.07)]
    assert changes[0] < 0.13 < changes[1]
