"""The field library: known radii, slopes against differences, surfaces and derivatives of whole bodies with every field, and the plot."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.fields import EXPONENTIAL, POTENTIALS, VISIBLE, potential_named
from tricap.core.body.metaballs import Metaballs, field, field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.whole_surface import field_grid
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError

# Where f = 1/2: closed forms, of the definitions at the head of fields.py.
THRESHOLD_RADII = {
    "exponential": np.sqrt(np.log(2) / 2),
    "Blinn": 0.5,
    "Wyvill": 0.5,
    "quadric": 1 - 1 / np.sqrt(3),
    "Blender": np.sqrt(1 - 0.5 ** (1 / 3)),
    "Shen": np.sqrt(0.5),
}
NAMES = list(POTENTIALS)


@pytest.mark.parametrize("name", NAMES)
def test_a_field_is_1_inside_falls_and_ends_at_its_radius_of_influence(name: str) -> None:
    p = POTENTIALS[name]
    assert abs(p.threshold_radius() - THRESHOLD_RADII[name]) < 1e-9
    r = np.linspace(0, 1.3, 2000)
    f = p.value(r**2)
    assert f[0] == 1 and (np.diff(f) <= 0).all() and p.influence == 1
    beyond = f[r > p.influence]
    assert (beyond > 0).all() if p.endless else (beyond == 0).all()
    assert p.value(np.array([p.reach**2 * 1.001]))[0] < 0.001
    assert p.threshold_radius(2.0) > p.threshold_radius() and p.threshold_radius(0.4) == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seen", [False, True])
def test_slopes_equal_differences(name: str, seen: bool) -> None:
    p, h = POTENTIALS[name].of_visible_size() if seen else POTENTIALS[name], 1e-7
    d = np.random.default_rng(0).uniform(0.001, 1.9, 400)
    d = d[(np.abs(d / p.stretch**2 - 1) > 1e-5) & (np.abs(d / p.stretch**2 - 1 / 9) > 1e-5)]  # Shen's slope jumps at its end
    assert np.abs((p.value(d + h) - p.value(d - h)) / (2 * h) - p.slope(d)).max() < 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_a_body_equal_differences(name: str) -> None:
    rng, h, p = np.random.default_rng(0), 1e-7, potential_named(name)
    shape = default_shape(read_model("arm.R"))
    balls, L = shape.metaballs, shape.lengths_m
    R, head = bone_frames(shape.skeleton, L, rng.normal(0, 0.4, 8))
    X = head[rng.integers(0, 2, 30)] + rng.normal(0, 0.06, (30, 3))

    def values(radii: np.ndarray, weight: np.ndarray, at: np.ndarray = X) -> np.ndarray:
        other = Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=radii, weight=weight)
        return field(other, L, R, head, at, potential=p)

    F, gradient, to_radii, to_weight = field_and_derivatives(balls, L, R, head, X, potential=p)
    assert np.allclose(F, values(balls.radii_m, balls.weight))
    for i in range(3):
        step = h * np.eye(3)[i]
        difference = (values(balls.radii_m, balls.weight, X + step) - values(balls.radii_m, balls.weight, X - step)) / (2 * h)
        assert np.abs(difference - gradient[:, i]).max() < 1e-5 * np.abs(gradient).max(), f"{name}: in space, axis {i}"
    for m in range(6):
        one = np.eye(6)[m]
        heavier, lighter = values(balls.radii_m, balls.weight + h * one), values(balls.radii_m, balls.weight - h * one)
        assert np.abs((heavier - lighter) / (2 * h) - to_weight[:, m]).max() < 1e-6, f"{name}: to the weight of ball {m}"
        for i in range(3):
            grown, shrunk = (balls.radii_m * np.exp(sign * h * one[:, None] * np.eye(3)[i]) for sign in (1, -1))
            difference = (values(grown, balls.weight) - values(shrunk, balls.weight)) / (2 * h)
            assert np.abs(difference - to_radii[:, m, i]).max() < 1e-5 * np.abs(to_radii).max(), f"{name}: to radius {i} of ball {m}"


def test_a_single_ball_looks_alike_in_every_field() -> None:
    ball = Metaballs(bone_index=np.array([0]), centre=np.zeros((1, 3)), radii_m=np.array([[0.1, 0.2, 0.3]]), weight=np.ones(1))
    X = VISIBLE * np.diag([0.1, 0.2, 0.3])
    for name in NAMES:
        F = field(ball, np.ones(1), np.eye(3)[None], np.zeros((1, 3)), X, potential=potential_named(name))
        assert np.allclose(F, 0.5, atol=1e-8), name
    with pytest.raises(InputError, match="Did you mean “Blender”"):
        potential_named("blendr")


@pytest.mark.parametrize("name", NAMES)
def test_the_grid_of_a_check_mesh_is_the_chosen_field(name: str) -> None:
    shape, p = default_shape(read_model("arm.R")), potential_named(name)
    motion = np.zeros(8)
    grid = field_grid(shape, motion, spacing_m=0.01, potential=p)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    node = np.argwhere((grid.values > 0.2) & (grid.values < 0.8))[::7]
    F = field(shape.metaballs, shape.lengths_m, R, head, grid.origin_m + 0.01 * node, potential=p)
    assert len(node) > 50 and np.abs(F - grid.values[tuple(node.T)]).max() < 2e-3  # what lies beyond `reach` is left out
    if name not in (EXPONENTIAL.name, "Blinn"):  # Blinn's, as large, is the exponential
        fitted = field(shape.metaballs, shape.lengths_m, R, head, grid.origin_m + 0.01 * node)
        assert np.abs(F - fitted).max() > 0.02


def test_the_plot_shows_every_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fields", "--out", str(tmp_path / "fields.svg")]) == 0
    told = capsys.readouterr().out
    root = ElementTree.parse(tmp_path / "fields.svg").getroot()
    words = "".join(root.itertext())
    assert all(name in told and words.count(f"{name}: r_t") == 2 for name in NAMES) and "w_t = 0.5" in words
    svg = "{http://www.w3.org/2000/svg}"
    curves, dots = list(root.iter(f"{svg}polyline")), list(root.iter(f"{svg}circle"))
    assert len(curves) == len(dots) == 2 * len(NAMES)
    for curve, dot in zip(curves, dots):  # the dot, at r_t and w_t, is on its curve, which falls
        xy = np.array([pair.split(",") for pair in curve.attrib["points"].split()], dtype=float)
        assert abs(np.interp(float(dot.attrib["cx"]), *xy.T) - float(dot.attrib["cy"])) < 0.5 and (np.diff(xy[:, 1]) > -1e-6).all()
    assert len({dot.attrib["cx"] for dot in dots[: len(NAMES)]}) > 2 and len({dot.attrib["cx"] for dot in dots[len(NAMES) :]}) == 1
    assert main(["fields", "--out", str(tmp_path / "fields.png")]) == 2 and not (tmp_path / "fields.png").exists()
    assert "is not an .svg" in capsys.readouterr().err
