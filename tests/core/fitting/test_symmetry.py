"""The prior that both sides of a person are alike."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.context import FitContext
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.observations import ShapePrior, Symmetry
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.sequence import fit_context, fit_sequence

from .limb_scene import front_rig, measured_cloud


def clicked_person(right_shin: float) -> FitInput:
    """Clicks of a person one of whose shins is so many times as long, and a few points of one whose shins are alike."""
    shape, rig = default_shape(read_model("full")), front_rig()
    rest, names = np.zeros(len(shape.skeleton.dof_names)), [bone.name for bone in shape.skeleton.bones]
    joints = joint_positions(shape.skeleton, np.where([name == "shin.R" for name in names], right_shin, 1.0) * shape.lengths_m, rest)
    clicks = {name: {c.name: c.project(at) for c in rig.cameras} for name, at in joints.items()}
    cloud = measured_cloud(shape, rest, 0, np.random.default_rng(0), points=200, noise=0.001, gross=0.0)
    return FitInput(rig=rig, model="full", clouds=[cloud], time_s=np.zeros(1), clicks={0: clicks})


def symmetry(fit: FitContext) -> Symmetry:
    (found,) = (x for x in fit.shape_observations() if isinstance(x, Symmetry))
    return found


def test_bones_are_more_alike_than_flesh_and_the_more_so_the_more_frames_share_an_error() -> None:
    fit = fit_context(clicked_person(1.0), FitSettings())
    names = [fit.parameters.layout.names[i] for i in symmetry(fit).left]
    bones = np.array([name.startswith("length") for name in names])
    assert 0 < bones.sum() < len(bones)
    for frames in (1, 16):
        sigma = symmetry(replace(fit, frames=frames)).sigma
        assert np.allclose(sigma[bones], 0.015 / np.sqrt(frames)) and np.allclose(sigma[~bones], 0.03)


@pytest.mark.slow
def test_clicks_make_one_shin_longer_only_where_people_may_be_uneven() -> None:
    longer = []
    for settings in (FitSettings(symmetry_sigma=1.0), FitSettings()):
        fit = fit_sequence(clicked_person(1.12), settings)
        names = [bone.name for bone in fit.shape.skeleton.bones]
        right, left = (fit.shape.lengths_m[names.index(f"shin.{side}")] for side in "RL")
        longer.append(right / left - 1)
    assert longer[0] > 0.03 and abs(longer[1]) < longer[0] / 2


def test_skulls_are_more_alike_than_flesh() -> None:
    """A bowed head was blown up by a third: its radii were as free as a belly's."""
    fit = fit_context(clicked_person(1.0), FitSettings(radius_sigma=0.3))
    prior = next(x for x in fit.shape_observations() if isinstance(x, ShapePrior))
    balls = fit.parameters.template.metaballs
    bones = np.array([bone.name for bone in fit.model.skeleton.bones])[balls.bone_index]
    sigma = prior.sigma[fit.parameters.layout.group("radii")].reshape(len(bones), 2)
    for name, own in (("head", 0.06), ("neck", 0.08), ("thigh.L", 0.3), ("chest", 0.3)):
        assert (sigma[bones == name] == own).all(), name
