"""The complete model: an anatomical arrangement with the surface of the simplified body, and what is made of it downstream."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tricap.core.body.anatomy import BONE, FAT, FLESH, MUSCLE, RINGS, TABLES, arrangement, ball_names, kind_of
from tricap.core.body.complete import complete_shape
from tricap.core.body.model_file import read_model
from tricap.core.body.parts import bone_profiles, chain_neighbours
from tricap.core.body.shape import BodyShape, default_shape, read_body, write_body
from tricap.core.body.skin.contour_skin import body_skin


@pytest.fixture(scope="module")
def whole() -> tuple[BodyShape, BodyShape]:
    """A simplified whole body and its complete one."""
    simple = default_shape(read_model("full"))
    return simple, complete_shape(simple)


def test_every_fleshy_bone_of_the_whole_body_has_its_groups(whole: tuple[BodyShape, BodyShape]) -> None:
    simple, complete = whole
    names = [bone.name for bone in simple.skeleton.bones]
    count = {names[b]: int((complete.metaballs.bone_index == b).sum()) for b in np.unique(simple.metaballs.bone_index)}
    assert 100 <= len(complete.metaballs.weight) <= 250 and set(count) == {names[b] for b in complete.metaballs.bone_index}
    assert all(count[name] == len(arrangement(name)) and arrangement(name) is not RINGS for name in count)
    assert arrangement("tail") is RINGS and {ball.name for ball in TABLES["upper_arm"]} > {"deltoid", "biceps, long head"}
    assert all(len({ball.name for ball in table}) == len(table) for table in TABLES.values())


def test_every_ball_has_a_name_and_a_kind(whole: tuple[BodyShape, BodyShape], tmp_path: Path) -> None:
    simple, complete = whole
    names = [bone.name for bone in simple.skeleton.bones]
    found = ball_names(names, complete.metaballs.bone_index)
    arm = [f.name for f, b in zip(found, complete.metaballs.bone_index) if names[b] == "upper_arm.L"]
    assert arm == [ball.name for ball in TABLES["upper_arm"]]
    assert {f.kind for f in found} == {BONE, MUSCLE, FAT} and [f.kind for f in found].count(MUSCLE) > len(found) / 2
    assert (kind_of("core 2"), kind_of("deltoid, front"), kind_of("heel"), kind_of("scapula, left")) == (BONE, MUSCLE, FAT, BONE)
    assert {(f.name, f.kind) for f in ball_names(names, simple.metaballs.bone_index)} == {
        (f"{third} third", FLESH) for third in ("near", "middle", "far")
    }
    assert [f.name for f in ball_names(["tail"], np.array([0, 0]))] == ["ball 1", "ball 2"], "a number of balls that no table has"
    write_body(tmp_path / "body.toml", complete)
    text = (tmp_path / "body.toml").read_text()
    assert text.count('name = "biceps, long head"') == 2 and text.count('kind = "fat"') == [f.kind for f in found].count(FAT)
    assert np.array_equal(read_body(tmp_path / "body.toml").metaballs.radii_m, complete.metaballs.radii_m)


def test_its_surface_is_the_simplified_bodys(whole: tuple[BodyShape, BodyShape]) -> None:
    simple, complete = whole
    counted = chain_neighbours(simple)
    before, after = (bone_profiles(s.skeleton, s.lengths_m, s.metaballs, counted) for s in whole)
    off = {simple.skeleton.bones[b].name: 1e3 * np.abs(after[b].radii_m - before[b].radii_m) for b in before}
    assert max(d.max() for d in off.values()) < 14  # mm; the foot's sole 8, the pelvis 11, the neck 13
    assert all(off[name].max() < 7 for name in ("upper_arm.R", "forearm.L", "thigh.R", "shin.L", "head"))  # 6 at most
    assert np.median(np.concatenate([d.ravel() for d in off.values()])) < 2  # 1.1


def test_left_and_right_are_mirror_images(whole: tuple[BodyShape, BodyShape]) -> None:
    balls, names = whole[1].metaballs, [bone.name for bone in whole[1].skeleton.bones]
    for name in ("thigh", "forearm", "shoulder"):
        right, left = (np.flatnonzero(balls.bone_index == names.index(f"{name}.{side}")) for side in "RL")
        assert np.allclose(balls.centre[right] * [-1, 1, 1], balls.centre[left], atol=1e-9)
        assert np.allclose(balls.radii_m[right], balls.radii_m[left], rtol=1e-3)


def test_the_calf_is_behind_the_shin_and_the_deltoid_outside(whole: tuple[BodyShape, BodyShape]) -> None:
    shape = whole[1]
    names, balls = [bone.name for bone in shape.skeleton.bones], shape.metaballs

    def place(bone: str, ball: str) -> np.ndarray:
        """From the bone's axis, in the world at rest."""
        b = names.index(bone)
        i = np.flatnonzero(balls.bone_index == b)[[g.name for g in arrangement(bone)].index(ball)]
        return shape.skeleton.bones[b].R_rest @ (balls.centres_m(shape.lengths_m)[i] * [1, 0, 1])

    assert all(place(f"shin.{side}", "soleus")[1] > 0.01 for side in "RL")  # the person faces −Y
    assert place("upper_arm.R", "deltoid")[0] < -0.01 and place("upper_arm.L", "deltoid")[0] > 0.01  # the right side is −X
    assert place("thigh.R", "rectus femoris")[1] < -0.01 and place("forearm.R", "brachioradialis")[0] < -0.01


def test_body_file_and_skin_cope_with_it(whole: tuple[BodyShape, BodyShape], tmp_path: Path) -> None:
    simple, complete = whole
    write_body(tmp_path / "body.toml", complete)
    again = read_body(tmp_path / "body.toml")
    assert np.array_equal(again.metaballs.centre, complete.metaballs.centre)
    motion = np.zeros(len(simple.skeleton.dofs))
    motion[simple.skeleton.layout["elbow.R flexion"]] = 1.0
    skins = [body_skin(shape, motion) for shape in (simple, again)]
    d = 1e3 * cKDTree(skins[0].vertices_m).query(skins[1].vertices_m)[0]
    assert np.median(d) < 4 and np.percentile(d, 95) < 20  # 2 and 11: the rest are the ends of chains
