"""docs/extending.md is followed to the letter: its blocks of code run, and what they make does what the page says."""

import random
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.fitting.context import FitContext
from tricap.core.fitting.stages.sequence import FitInput, fit_sequence
from tricap.core.fitting.state import ShapeParameters
from tricap.core.foundation.errors import InputError
from tricap.core.motion import sources
from tricap.core.motion.formats.markers import Markers
from tricap.core.motion.retarget.mapping import find_map

from .core.fitting.limb_scene import make_scene
from .core.motion.persons import person
from .mutations import mutate

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "extending.md").read_text(encoding="utf-8")
SECTIONS = {part.split("\n", 1)[0]: part for part in re.split(r"^## ", PAGE, flags=re.M)[1:]}
LONGEST = 40


def made(section: str) -> dict[str, Any]:
    """The names that the blocks of a section define."""
    names: dict[str, Any] = {"__name__": "extending"}
    for block in re.findall(r"```python\n(.*?)```", SECTIONS[section], flags=re.S):
        exec(compile(block, section, "exec"), names)
    return names


def test_every_section_is_short_and_has_code() -> None:
    assert list(SECTIONS) == ["An observation for the fit", "A field function", "A rig preset", "A file format"]
    for name, text in SECTIONS.items():
        code = re.findall(r"```python\n(.*?)```", text, flags=re.S)
        assert code and len("".join(code).splitlines()) < LONGEST, name


def test_the_files_that_the_page_names_exist() -> None:
    root = Path(__file__).resolve().parent.parent
    for name in re.findall(r"`((?:core|tests|addon|observations)/[\w./]+)`", PAGE):
        where = root / (f"core/fitting/{name}" if name.startswith("observations") else name)
        assert where.exists(), name


def test_the_observation() -> None:
    parameters = ShapeParameters(default_shape(read_model("arm.R")))
    motion, vector = np.full(len(parameters.skeleton.dofs), 0.1), parameters.vector()
    taped = made("An observation for the fit")["TapedBone"](bone=1, tape_m=0.25, sigma_m=0.01)
    J = taped.jacobian(parameters.state(motion, vector))[0]
    for k in range(len(motion) + len(vector)):
        step = np.zeros(len(motion) + len(vector))
        step[k] = 1e-6
        up, down = (parameters.state(motion + h[: len(motion)], vector + h[len(motion) :]) for h in (step, -step))
        assert abs((taped.residual(up) - taped.residual(down))[0] / 2e-6 - J[k]) < 1e-5 * np.abs(J).max()
    assert taped.jacobian(parameters.state(motion, vector), shape=False).shape == (1, len(motion))


def test_the_field_function() -> None:
    field, shape = made("A field function")["finite_field"], default_shape(read_model("arm.R"))
    balls, skeleton = shape.metaballs, shape.skeleton
    R, head = bone_frames(skeleton, shape.lengths_m, np.full(len(skeleton.dofs), 0.2))
    X = head[1] + R[1][:, 1] * 0.1 + np.random.default_rng(0).normal(0, 0.02, (20, 3))
    F, gradient, to_radii, to_weight = field(balls, shape.lengths_m, R, head, X)
    assert (F > 0.1).all() and to_radii.shape == (20, len(balls.weight), 3) and to_weight.shape == (20, len(balls.weight))
    for axis in range(3):
        h = np.eye(3)[axis] * 1e-6
        difference = (field(balls, shape.lengths_m, R, head, X + h)[0] - field(balls, shape.lengths_m, R, head, X - h)[0]) / 2e-6
        np.testing.assert_allclose(difference, gradient[:, axis], atol=1e-5 * np.abs(gradient).max())


def test_the_observation_moves_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Given to `FitContext.shape_observations`, as the page says: the forearm comes out as long as the tape, and not as it was without."""
    taped, shape_observations = made("An observation for the fit")["TapedBone"], FitContext.shape_observations
    scene = make_scene(frames=1, seed=1, points=120)
    given = FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={0: scene.clicks}, click_frame=0, time_s=scene.time_s)
    free = fit_sequence(given).shape.lengths_m[1]
    tape = taped(bone=1, tape_m=1.08 * free, sigma_m=1e-4)
    monkeypatch.setattr(FitContext, "shape_observations", lambda self, *given: [*shape_observations(self, *given), tape])
    assert abs(fit_sequence(given).shape.lengths_m[1] / free - 1.08) < 0.005


def test_the_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    puppet = made("A rig preset")["preset"]
    names = {"hips": "puppet:Root", "spine": "puppet:Belly", "neck": "puppet:Neck", "head": "puppet:Head"}
    for role, bone in {"upper_arm": "Arm", "forearm": "Elbow", "hand": "Hand", "thigh": "Leg", "shin": "Knee", "foot": "Foot"}.items():
        names |= {f"{role}.{side}": f"puppet:{word}{bone}" for side, word in (("L", "left"), ("R", "right"))}
    found = find_map(person(names=names, without=("clavicle", "toe")), [puppet])
    assert found.bones["forearm.L"] == ("puppet:leftElbow",) and found.bones["foot.R"] == ("puppet:rightFoot",)
    assert "Puppet" in found.origin


def test_the_file_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = made("A file format")
    xyz = np.random.default_rng(0).uniform(-1, 1, (5, 2, 3)).round(6)
    points = Markers(names=("elbow.R", "wrist.R"), fps=25.0, frames=np.arange(5) + 3, xyz_m=xyz, sigma_m=np.full((5, 2), np.nan))
    names["write_xyz"](tmp_path / "a.xyz", points)
    found = names["read_xyz"](tmp_path / "a.xyz")
    assert found.names == points.names and np.array_equal(found.frames, points.frames) and np.allclose(found.xyz_m, xyz)
    monkeypatch.setitem(sources.POINTS, ".xyz", (names["read_xyz"], sources.Z_UP))
    assert len(sources.read_motion_source(tmp_path / "a.xyz", unit="cm").frames) == 5
    whole = (tmp_path / "a.xyz").read_bytes()
    refused = 0
    for number in range(60):
        (tmp_path / "a.xyz").write_bytes(mutate(whole, random.Random(number)))
        try:
            names["read_xyz"](tmp_path / "a.xyz")
        except InputError:
            refused += 1
    assert refused > 20
