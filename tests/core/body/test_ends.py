"""Heads, hands and feet of a skin: where anatomy has them, as large as fitted, and nothing else moved."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tricap.core.body.complete import complete_shape
from tricap.core.body.model_file import read_model
from tricap.core.body.parts import bone_profiles, chain_neighbours
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.contour_skin import body_skin
from tricap.core.body.skin.extremities import TABLES, has_end, person_shape, placement
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.mesh import SkinSettings


@cache
def simple() -> BodyShape:
    return default_shape(read_model("full"))


@cache
def vertices() -> np.ndarray:
    """Of a standing person; the pelvis at the origin, who faces −Y."""
    return body_skin(person_shape(simple()), np.zeros(len(simple().skeleton.dof_names))).vertices_m


def joint(name: str) -> np.ndarray:
    shape = simple()
    _, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    return np.asarray(head[[bone.name for bone in shape.skeleton.bones].index(name)])


def test_feet_are_as_long_as_feet_with_heels_behind_the_ankle_and_tapered_toes() -> None:
    ankle = joint("foot.R")
    foot = vertices()[(vertices()[:, 0] < 0) & (vertices()[:, 2] < ankle[2])] - ankle
    length, height = np.ptp(foot[:, 1]), -foot[:, 2].min()
    assert 0.24 < length < 0.31 and 0.065 < height < 0.12  # 266 and 82 mm in anthropometry
    assert 0.04 < foot[:, 1].max() < 0.08  # the heel
    tips = foot[foot[:, 1] < foot[:, 1].min() + 0.03]
    assert np.ptp(tips[:, 2]) < 0.05 and np.ptp(tips[:, 0]) < 0.10


def test_a_head_has_a_chin_below_the_atlas_and_hands_have_fingers() -> None:
    atlas, wrist, v = joint("head"), joint("hand.R"), vertices()
    front = v[(np.abs(v[:, 0]) < 0.02) & (v[:, 1] < atlas[1] - 0.08)]
    assert front[:, 2].min() < atlas[2] - 0.02 and v[:, 2].max() == pytest.approx(atlas[2] + 0.16, abs=0.03)
    assert 0.16 < np.linalg.norm(v - wrist, axis=1)[v[:, 0] < wrist[0]].max() < 0.22  # 189 mm


def test_left_and_right_are_mirror_images_and_other_bones_keep_their_balls() -> None:
    shape, person = simple(), person_shape(simple())
    names = [bone.name for bone in shape.skeleton.bones]
    for kind in ("hand", "foot"):
        right, left = (np.flatnonzero(person.metaballs.bone_index == names.index(f"{kind}.{side}")) for side in "RL")
        assert len(right) == len(TABLES[kind].balls)
        np.testing.assert_allclose(person.metaballs.centre[right] * [-1, 1, 1], person.metaballs.centre[left], atol=1e-6)
        np.testing.assert_allclose(person.metaballs.radii_m[right], person.metaballs.radii_m[left], atol=1e-6)
    others = [names.index(name) for name in ("thigh.R", "shin.L", "spine", "forearm.R")]
    same = (np.isin(s.metaballs.bone_index, others) for s in (shape, person))
    a, b = (s.metaballs.radii_m[chosen] for s, chosen in zip((shape, person), same))
    np.testing.assert_array_equal(a, b)


def test_the_complete_model_gets_head_hands_and_feet_once() -> None:
    """Its head has as many balls as an anatomical one, which they are not."""
    complete = complete_shape(simple())
    person = person_shape(complete)
    for b, bone in enumerate(complete.skeleton.bones):
        kind = bone.name.partition(".")[0]
        assert not has_end(complete, b) and has_end(person, b) == (kind in TABLES)
    assert np.array_equal(person_shape(person).metaballs.radii_m, person.metaballs.radii_m)
    head = [bone.name for bone in complete.skeleton.bones].index("head")
    assert np.abs(np.degrees(np.arccos(placement(person, head).turn[1, 1]))) < 8.0, "the face looks ahead"


def test_a_wider_head_stays_wider() -> None:
    shape = simple()
    head = [bone.name for bone in shape.skeleton.bones].index("head")

    def width(wider: float) -> float:
        radii = shape.metaballs.radii_m.copy()
        radii[shape.metaballs.bone_index == head, 0] *= wider
        person = person_shape(replace(shape, metaballs=replace(shape.metaballs, radii_m=radii)))
        profile = bone_profiles(shape.skeleton, shape.lengths_m, person.metaballs, chain_neighbours(shape))[head]
        return float(profile.across(np.array([0.6]), np.array([[1.0, 1.0]]))[0, 0])

    assert width(1.15) / width(1.0) > 1.08


def test_a_foot_that_was_fitted_out_to_its_toes_is_not_made_longer() -> None:
    shape = simple()
    feet = [b for b, bone in enumerate(shape.skeleton.bones) if bone.name.startswith("foot")]
    lengths = shape.lengths_m.copy()
    lengths[feet] *= 1.35

    def reach_m(body: BodyShape) -> float:
        balls = person_shape(body).metaballs
        return float(np.linalg.norm(balls.centres_m(body.lengths_m)[balls.bone_index == feet[0]], axis=1).max())

    assert reach_m(replace(shape, lengths_m=lengths)) < 1.1 * reach_m(shape)


def test_toes_do_not_turn_up_where_the_balls_at_the_ankle_are_thick() -> None:
    """As of a man who walked on a beam: what is measured about the heel and the ankle tells nothing of the sole's angle."""
    shape = simple()
    balls, b = shape.metaballs, [bone.name for bone in shape.skeleton.bones].index("foot.R")
    radii = balls.radii_m.copy()
    radii[balls.bone_index == b] *= [[1.3, 1, 1.7], [0.8, 1, 0.8], [1.1, 1, 0.95]]

    def sole(person: BodyShape) -> float:
        """Angle of the line from heel to great toe, about the bone's x axis."""
        mine = person.metaballs.bone_index == b
        names = [ball.name for ball in TABLES["foot"].balls]
        toe, heel = (person.metaballs.centre[mine][names.index(name), 1:] for name in ("great toe", "heel"))
        return float(np.degrees(np.arctan2(toe[1] - heel[1], toe[0] - heel[0])))

    swollen = person_shape(replace(shape, metaballs=replace(balls, radii_m=radii)))
    assert abs(sole(swollen) - sole(person_shape(shape))) < 5.0


def test_refined_bodies_and_other_models_keep_what_they_have_and_the_knob_is_read() -> None:
    arm = default_shape(read_model("arm.R"))
    assert person_shape(arm) is arm
    assert shape_for_skin(simple(), SkinSettings(anatomy=False)) is simple()
    assert len(shape_for_skin(simple(), SkinSettings()).metaballs.weight) > len(simple().metaballs.weight)
    person = person_shape(simple())
    assert person_shape(person) is person
