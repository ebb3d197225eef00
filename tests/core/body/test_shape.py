"""body.toml and model files: round trips, and what they refuse."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.body.model_file import model_files, model_names, read_model
from tricap.core.body.shape import MOST_BALLS, MOST_BONES, FingerBend, default_shape, read_body, write_body
from tricap.core.foundation.errors import InputError


@pytest.mark.parametrize("model", model_names())
def test_body_comes_back_to_the_last_bit(model: str, tmp_path: Path) -> None:
    shape = default_shape(read_model(model))
    write_body(tmp_path / "body.toml", shape)
    again = read_body(tmp_path / "body.toml")
    assert again.skeleton.dof_names == shape.skeleton.dof_names and again.skeleton.joint_names == shape.skeleton.joint_names
    assert np.array_equal(again.lengths_m, shape.lengths_m)
    for name in ("bone_index", "centre", "radii_m", "weight"):
        assert np.array_equal(getattr(again.metaballs, name), getattr(shape.metaballs, name))
    for a, b in zip(again.skeleton.bones, shape.skeleton.bones):
        assert np.array_equal(a.R_rest, b.R_rest) and (a.parent, a.rotation_mode) == (b.parent, b.rotation_mode)
        assert np.allclose([d.limits for d in a.dofs], [d.limits for d in b.dofs])
    assert np.isnan(again.length_sigma_m).all()


def test_weights_that_were_fitted_keep_their_sigmas(tmp_path: Path) -> None:
    shape = default_shape(read_model("arm.R"))
    write_body(tmp_path / "body.toml", shape)
    assert read_body(tmp_path / "body.toml").weight_sigma is None
    write_body(tmp_path / "body.toml", replace(shape, weight_sigma=0.01 * np.arange(6)))
    again = read_body(tmp_path / "body.toml").weight_sigma
    assert again is not None and np.array_equal(again, 0.01 * np.arange(6))
    text = (tmp_path / "body.toml").read_text()
    (tmp_path / "body.toml").write_text(text.replace("weight_sigma = 0.0\n", ""))
    with pytest.raises(InputError, match="weight_sigma"):
        read_body(tmp_path / "body.toml")


def test_measured_fingers_come_back_and_fists_have_a_limit(tmp_path: Path) -> None:
    shape, path = default_shape(read_model("upper_body")), tmp_path / "body.toml"
    write_body(path, replace(shape, finger_bends={"hand.L": FingerBend(0.25, 0.1), "hand.R": FingerBend(1.5, 0.9)}))
    again = read_body(path)
    assert again.finger_bends == {"hand.L": (0.25, 0.1), "hand.R": (1.5, 0.9)} and (
        again.finger_bend("hand.L"),
        again.finger_bend("hand.R"),
    ) == (0.25, 1.0)
    text = path.read_text()
    path.write_text(text.replace("finger_bend_sigma = 0.1\n", ""))
    assert np.isnan(read_body(path).finger_bends["hand.L"].sigma)
    for wrong in ("9.0", "-0.25", "nan", '"much"'):
        path.write_text(text.replace("finger_bend = 0.25", f"finger_bend = {wrong}"))
        with pytest.raises(InputError, match="run the fit again"):
            read_body(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("tricap-body", "other"),
        ("version = 1", "version = 9"),
        ("head =", "heed ="),
        ("[[bones]]", "[[bonse]]"),
        ("= [", "= [["),
        ("weight = 1.0", 'weight = "much"'),
        ("length_m = 0", "length_m = -0"),
        ("radii_m = [0", "radii_m = [1e300"),
        ("centre = [0", "centre = [nan"),
    ],
)
def test_faulty_bodies_are_refused(old: str, new: str, tmp_path: Path) -> None:
    path = tmp_path / "body.toml"
    write_body(path, default_shape(read_model("arm.R")))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match="run the fit again"):
        read_body(path)


@pytest.mark.parametrize(("entry", "most"), [("[[bones]]", MOST_BONES), ("[[metaballs]]", MOST_BALLS)])
def test_a_body_of_thousands_of_bones_or_metaballs_is_refused(entry: str, most: int, tmp_path: Path) -> None:
    """Blender would be given each of them: 6000 metaballs took 13 s and a gigabyte."""
    path = tmp_path / "body.toml"
    write_body(path, default_shape(read_model("arm.R")))
    first, *others = path.read_text().split(f"{entry}\n")
    last, end = others[-1].split("\n\n", 1)
    more = [re.sub('name = ".*"', f'name = "copy {i}"', last, count=1) for i in range(most - len(others))]
    path.write_text(f"{entry}\n".join([first, *others[:-1], last + "\n\n", *(f"{one}\n\n" for one in more)]) + end)
    if entry == "[[metaballs]]":
        assert len(read_body(path).metaballs.weight) == most
    path.write_text(path.read_text().replace(f"{entry}\n", f"{entry}\n{last}\n\n{entry}\n", 1))
    with pytest.raises(InputError, match="more than 500 bones or 2000 metaballs"):
        read_body(path)


def test_a_model_of_thousands_of_bones_is_refused() -> None:
    model = read_model("arm.R")
    bones = (model.skeleton.bones[0],) * (MOST_BONES + 1)
    with pytest.raises(InputError, match="“arm.R” has 501 bones, more than 500; use another"):
        default_shape(SimpleNamespace(name=model.name, skeleton=SimpleNamespace(bones=bones)))  # type: ignore[arg-type]


def test_a_metaball_of_no_bone_is_named(tmp_path: Path) -> None:
    path = tmp_path / "body.toml"
    write_body(path, default_shape(read_model("arm.R")))
    path.write_text(path.read_text().replace('bone = "forearm.R"', 'bone = "nose"'))
    with pytest.raises(InputError, match="the bone “nose”, which does not exist"):
        read_body(path)


def test_a_missing_body_or_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="body.toml"):
        read_body(tmp_path / "body.toml")
    with pytest.raises(InputError, match="arm.R"):
        read_model("arm.X")
    text = 'format = "tricap-model"\nversion = 1\nname = "mine"\nstature_m = 1.7\nbase = "a"\nbones = [{ name = "b" }]\n'
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(InputError, match="mine.toml"):
        read_model(tmp_path / "mine.toml")


def _own(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(f'format = "tricap-model"\nversion = 1\nname = "{name}"\n{text}\n')
    return folder / name


def test_a_model_is_made_from_one_beside_it(tmp_path: Path) -> None:
    part = _own(tmp_path, "part.toml", 'part_of = "upper_body"\nwithout = ["head"]')
    whole = _own(tmp_path, "mirror.toml", 'mirror_of = "part.toml"')
    model = read_model(whole)
    assert model.name == "mirror.toml" and "head" not in [bone.name for bone in model.skeleton.bones]
    assert model_files(whole)[:2] == [whole, part] and len(model_files(whole)) == 4


def test_a_model_of_thousands_of_files_and_one_from_elsewhere_are_refused(tmp_path: Path) -> None:
    """Each file was compared with all before it."""
    for i in range(40):
        _own(tmp_path, f"{i}.toml", f'part_of = "{i + 1}.toml"')
    _own(tmp_path, "40.toml", 'part_of = "arm.R"')
    assert read_model(tmp_path / "30.toml").skeleton.bones
    with pytest.raises(InputError, match="is made from more than 16 others in a row"):
        read_model(tmp_path / "0.toml")
    (tmp_path / "take").mkdir()
    for elsewhere in ("../40.toml", str(tmp_path / "40.toml").replace("\\", "/")):
        with pytest.raises(InputError, match="the file must be in the same folder"):
            read_model(_own(tmp_path / "take", "a.toml", f'part_of = "{elsewhere}"'))


@pytest.mark.parametrize("text", ['mirror_of = "a.toml"', 'part_of = "b.toml"', "mirror_of = 3", 'mirror_of = "nobody"'])
def test_a_model_made_from_itself_is_refused(text: str, tmp_path: Path) -> None:
    _own(tmp_path, "b.toml", 'mirror_of = "a.toml"')
    with pytest.raises(InputError, match="made from|no body model"):
        read_model(_own(tmp_path, "a.toml", text))


def test_calves_lie_behind_and_outside_of_their_bones() -> None:
    shape = default_shape(read_model("full"))
    names, balls = [bone.name for bone in shape.skeleton.bones], shape.metaballs
    for side, outwards in (("R", -1.0), ("L", 1.0)):
        b = names.index(f"shin.{side}")
        mine = balls.bone_index == b
        world = (balls.centre[mine] * [1, 0, 1]) @ shape.skeleton.bones[b].R_rest.T  # the person faces -Y, the right side is -X
        mass = np.prod(balls.radii_m[mine][:, [0, 2]], axis=1)
        centre = mass @ world / mass.sum()
        assert centre[1] == pytest.approx(0.0485, abs=0.004) and outwards * centre[0] == pytest.approx(0.019, abs=0.002)
    assert not balls.centre[balls.bone_index == names.index("forearm.L")][:, [0, 2]].any()


def test_a_model_whose_balls_lie_aside_of_nothing_is_refused(tmp_path: Path) -> None:
    text = model_files("leg.R")[0].read_text()
    (tmp_path / "mine.toml").write_text(text.replace("[-0.015, 0.022]]", "]"))
    with pytest.raises(InputError, match="lacks an entry or has a wrong value"):
        read_model(tmp_path / "mine.toml")
