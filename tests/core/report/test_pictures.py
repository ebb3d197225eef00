"""Graphs and pictures of the report, also of what is empty, single or not finite."""

import xml.etree.ElementTree as ET
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.report import pictures
from tricap.core.report.drawing import GROUND, OF_PANELS, ROOM_PX, ROW_PX, TITLE_PX, with_legend
from tricap.core.report.graphs import MOST_PER_CURVE, curve_graph, thinned, ticks
from tricap.core.report.point_pictures import COLOURS, paths_in_space, paths_over_footage
from tricap.core.surface.cloud import PointCloud
from tricap.core.tracking.trajectories import Trajectories

GREY = np.full((150, 200), 90, np.float32)


def lines(svg: str) -> list[str]:
    return [e.attrib["points"] for e in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}polyline")]


def test_a_graph_is_a_picture_of_its_curve() -> None:
    frames = np.arange(10, 14)
    svg = curve_graph('Angle of "a" & <b>', "°", frames, {"angle": np.array([0.0, 10, 20, 30])}, np.full(4, 2.0))
    (points,) = lines(svg)
    x, y = np.array([p.split(",") for p in points.split()], dtype=float).T
    assert np.allclose(np.diff(x), np.diff(x)[0], atol=0.2) and np.allclose(np.diff(y), np.diff(y)[0], atol=0.2) and np.diff(y)[0] < 0
    assert "frame 10" in svg and "&lt;b&gt;" in svg and svg.count("<polygon") == 1


def test_gaps_interrupt_a_curve() -> None:
    svg = curve_graph("g", "", np.arange(6), {"c": np.array([1.0, 2, np.nan, 3, np.inf, 5])})
    assert [len(p.split()) for p in lines(svg)] == [2, 1, 1] and "nan" not in svg and "inf" not in svg


def test_a_long_curve_keeps_its_peaks_and_its_gaps() -> None:
    curve = np.sin(np.arange(30_000) / 500)
    curve[12_345], curve[20_000:20_100] = 9.0, np.nan
    x, y, band = thinned(np.arange(30_000), curve, np.ones(30_000))
    assert len(x) == len(y) == len(band) < MOST_PER_CURVE and (np.diff(x) > 0).all()
    assert y[x == 12_345] == 9.0 and np.isnan(y).any() and np.nanmin(y) == np.nanmin(curve)
    assert len(curve_graph("g", "", np.arange(30_000), {"c": curve})) < 20_000


@pytest.mark.parametrize("values", [[3.0], [0.0, 0.0], [1e-12, 1e-12], [-5.0, np.nan]])
def test_single_and_constant_curves(values: list[float]) -> None:
    svg = curve_graph("g", "mm", np.arange(len(values)), {"c": np.array(values)}, np.zeros(len(values)))
    assert ET.fromstring(svg) is not None and "nan" not in svg


def test_nothing_gives_no_graph() -> None:
    assert curve_graph("g", "", np.arange(3), {"c": np.full(3, np.nan)}) == ""
    assert curve_graph("g", "", np.arange(0), {"c": np.zeros(0)}) == ""


def cloud(n: int) -> PointCloud:
    random = np.random.default_rng(0)
    return PointCloud(frame=0, xyz_m=random.uniform(-0.1, 0.1, (n, 3)) + [0, 0, 2.16], covariance_m2=np.tile(np.eye(3) * 1e-6, (n, 1, 1)),
                      normals=np.tile([0, 0, -1.0], (n, 1)), intensity=np.full(n, 100), xy_px=random.uniform(0, 150, (n, 3, 2)),
                      residual_px=np.zeros(n), extended=np.zeros(n))  # fmt: skip


@pytest.mark.parametrize("n", [0, 1, 50])
def test_clouds_are_drawn(scenes: Any, n: int) -> None:
    camera, c = scenes.three_cameras()["C"], cloud(n)
    over = pictures.points_over_footage(GREY, c.xy_px[:, 1], 1e3 * c.sigma_m, 1.0)
    assert over.shape == (150, 200, 3) and over.dtype == np.uint8
    assert (np.ptp(over, axis=2) > 0).any() == (n > 0)  # colour is what is measured
    front_and_side = pictures.cloud_views(c, camera, 4)
    assert front_and_side.shape[1] == 2 * (pictures.NARROW_PX if n == 1 else pictures.PANEL_PX)
    top = round(TITLE_PX * OF_PANELS) if n else 0
    bare = front_and_side[top : top + pictures.PANEL_PX]
    assert bare.shape[0] == pictures.PANEL_PX and (bare != GROUND).any() == (n > 0) and not (bare == 255).all(axis=2).any()


@pytest.mark.parametrize("n", [0, 1, 20])
def test_tracks_are_drawn(scenes: Any, n: int) -> None:
    random = np.random.default_rng(1)
    xyz = np.cumsum(random.normal(0, 0.01, (5, n, 3)), axis=0) + [0, 0, 2.16]
    xyz[:2, : n // 2] = np.nan
    velocity = np.where(np.isnan(xyz), np.nan, 0.3)
    tracks = Trajectories(frames=np.arange(5), time_s=np.arange(5) / 25, xyz_m=xyz, velocity_m_s=velocity, acceleration_m_s2=velocity,
                          sigma_m=xyz[..., 0] * 0 + 1e-3, status=np.isfinite(xyz[..., 0]))  # fmt: skip
    for index in (0, 4):
        high = pictures.high_speed(tracks, index)
        assert np.isfinite(high) == bool(tracks.visible[index].any())
        picture = pictures.tracks_over_footage(GREY, scenes.three_cameras()["C"], tracks, index, high)
        assert picture.shape == (150, 200, 3) and (np.ptp(picture, axis=2) > 0).any() == bool(tracks.visible[index].any())


@pytest.mark.parametrize("size", [(640, 480), (640, 538), (576, 720), (1920, 1080), (150, 200), (480, 640)])
def test_nothing_lies_on_the_person(scenes: Any, size: tuple[int, int]) -> None:
    """The picture stays as it is, whatever part of it the person takes; bar, scale and axes are under it and do not touch each other."""
    picture = np.random.default_rng(5).integers(0, 255, (*size, 3)).astype(np.uint8)
    drawn = pictures.with_scale(picture, scenes.three_cameras()["C"], np.array([[0.0, 0.0, 2.16]]), (4.9, "speed, m/s"))
    assert np.array_equal(drawn[: size[0]], picture)
    strip = drawn[size[0] :]
    shown = (strip != GROUND).any(axis=2)
    assert shown.any() and not shown[0].any() and not shown[-1].any() and not shown[:, 0].any() and not shown[:, -1].any()
    gaps = np.diff(np.flatnonzero(np.diff(np.concatenate([[1], shown.any(axis=0), [1]]))))[::2]  # widths of the empty columns
    k = min(max(1.0, max(size) / 400), size[1] / ROOM_PX)
    assert (gaps[1:-1] >= 4 * k).sum() >= 2, "between the bar, the scale and the axes"
    colourful = np.ptp(strip.astype(int), axis=2) > 60
    assert colourful.any() and np.flatnonzero(colourful.any(axis=0)).max() < 0.4 * size[1]


def test_a_legend_has_a_swatch_of_every_colour() -> None:
    """In as many rows as its words need, under a picture that stays as it is."""
    meanings = [((10 * n, 200, 30), f"meaning {n}") for n in range(9)]
    picture = np.zeros((40, 360, 3), np.uint8)
    drawn = with_legend(picture, meanings)
    assert not drawn[:40].any() and all((drawn[40:] == colour).all(axis=2).sum() > 50 for colour, _ in meanings)
    shown = (drawn[40:] != GROUND).any(axis=2)
    assert not shown[:, 0].any() and not shown[:, -2:].any() and len(drawn) - 40 >= 3 * ROW_PX


def test_png_and_grey() -> None:
    picture = pictures.colour(np.array([[-5.0, 300.0]]))
    assert picture[0].tolist() == [[0, 0, 0], [255, 255, 255]]
    assert np.array_equal(cv2.imdecode(np.frombuffer(pictures.png(picture), np.uint8), cv2.IMREAD_COLOR), picture)


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [(0.00753, 0.00898, ["0.0080", "0.0085"]), (1800.0, 2600.0, ["1800", "2000", "2200", "2400", "2600"]),
     (-3.2, 1.1, ["-3", "-2", "-1", "0", "1"]), (0.82, 0.89, ["0.82", "0.84", "0.86", "0.88"]),
     (2.0, 2e7, ["5e+06", "1e+07", "1.5e+07", "2e+07"])],
)  # fmt: skip
def test_the_scale_has_round_values(low: float, high: float, labels: list[str]) -> None:
    found = ticks(low, high)
    assert [text for _, text in found] == labels and all(low <= value <= high for value, _ in found)


def test_chosen_points_are_joined_and_have_names_within_the_image() -> None:
    """A name at the right edge is written to the left; a line with an end that is not there is left out."""
    xy = np.array([[[20.0, 60.0], [190.0, 60.0], [np.nan, np.nan]]])
    plain, joined, gone = (paths_over_footage(GREY, ("a", "rightmost", "b"), xy, 0, j) for j in ((), (("a", "rightmost"),), (("a", "b"),)))
    assert np.array_equal(plain, gone) and (joined != plain).any(axis=2)[58:63, 40:100].any(axis=0).all()
    name = (np.abs(plain.astype(int) - COLOURS[1]).max(axis=2) < 60)[40:56]
    assert name[:, :184].sum() > 30 and not name[:, 192:].any()


@pytest.mark.parametrize("step", [-4.0, 4.0])
def test_a_name_lies_where_its_path_does_not(step: float) -> None:
    """Left of a path that goes to the left, right of one that goes to the right."""
    path = np.stack([100 + step * np.arange(10), np.full(10, 60.0)], axis=1)[:, None]
    bare, named = (paths_over_footage(GREY, (name,), path, 9).astype(int) for name in ("", "nose"))
    columns = np.flatnonzero(np.abs(named - bare).max(axis=2).any(axis=0))
    assert columns.max() < path[-1, 0, 0] if step < 0 else columns.min() > path[-1, 0, 0]


def test_paths_of_chosen_points_have_names(scenes: Any) -> None:
    """In both panels, where a point was last seen; a point that never was has none."""
    xyz = np.stack([np.linspace([-0.05, 0, 2.0], [0.05, 0, 2.0], 4), np.linspace([0, 0.05, 2.0], [0, 0.1, 2.1], 4)], axis=1)
    tracked = SimpleNamespace(xyz_m=xyz, status=np.ones((4, 2), dtype=np.int8))
    bare, named, nobody = (paths_in_space(names, tracked, scenes.three_cameras()["C"]) for names in (("", ""), ("tip", "é"), ("tip", "")))  # type: ignore[arg-type]
    assert bare is not None and named is not None and nobody is not None
    for half, other in zip(np.hsplit(named != bare, 2), np.hsplit(nobody != bare, 2)):
        assert 20 < other.any(axis=2).sum() < half.any(axis=2).sum()
    gone = SimpleNamespace(xyz_m=np.full_like(xyz, np.nan), status=tracked.status)
    assert paths_in_space(("a", "b"), gone, scenes.three_cameras()["C"]) is None  # type: ignore[arg-type]
