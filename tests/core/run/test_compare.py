"""The published and the default method side by side: the measures, the page, and what is refused."""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.foundation import store
from tricap.core.foundation.progress import Monitor
from tricap.core.report.comparison import DEFAULT, HIGHER, LOWER, METHODS, PUBLISHED, Measure, comparison_page, written
from tricap.core.report.pictures import png
from tricap.core.run import pipeline
from tricap.core.run.compare import NEIGHBOURS, run_both, surface_noise_m
from tricap.core.run.joints import with_joints
from tricap.core.run.take_run import Run
from tricap.core.take.take import FrameClicks


@dataclass(frozen=True)
class Given:
    """What of a take says where it was clicked."""

    clicks: FrameClicks
    keyframes: tuple[FrameClicks, ...]


@pytest.mark.parametrize("sigma_m", [0.0002, 0.001])
def test_noise_of_a_point_on_a_round_limb(sigma_m: float) -> None:
    """Independent noise along the normals of a limb of 45 mm, 4 mm apart: its sigma, not the limb's shape, is measured."""
    angle, z = np.meshgrid(np.arange(-0.8, 0.8, 0.09), np.arange(0, 0.2, 0.004))
    radius = 0.045 + np.random.default_rng(3).normal(0, sigma_m, angle.shape)
    xyz = np.stack([radius * np.sin(angle), -radius * np.cos(angle), z], axis=-1).reshape(-1, 3)
    assert surface_noise_m(xyz) == pytest.approx(sigma_m, rel=0.12)  # ± 4 % by the number of points; the limb's shape adds 0.00002 m
    assert np.isnan(surface_noise_m(xyz[:NEIGHBOURS]))


def test_the_better_value() -> None:
    """By direction; none within 2 %, without a value, or where no value is better than another."""

    def winner(a: float, b: float, better: str) -> str:
        return Measure(name="", unit="", published=a, default=b, better=better).winner

    assert (winner(1.0, 2.0, HIGHER), winner(1.0, 2.0, LOWER)) == (DEFAULT, PUBLISHED)
    assert [winner(*v) for v in ((1.0, 1.01, HIGHER), (np.nan, 1.0, LOWER), (1.0, 2.0, ""), (0.0, 0.0, LOWER))] == [""] * 4


def test_names_are_text_in_the_page(tmp_path: Path) -> None:
    page = comparison_page(
        "<script>kick", [Measure(name="a < b", unit="<i>", published=1.0, default=np.nan)], dict.fromkeys(METHODS, tmp_path)
    )
    assert "<script>kick" not in page and "&lt;script&gt;kick" in page and "a &lt; b" in page and "&lt;i&gt;" in page and "–" in page


def test_the_page_groups_measures_and_describes_pictures(tmp_path: Path) -> None:
    """A measure that neither has is left out; pictures of the same name are a row, with what they show in words."""
    for method in (PUBLISHED, DEFAULT):
        (tmp_path / method / "report").mkdir(parents=True)
        for name in ("body_0007_C.png", "trails_removed.png", "layers.png"):
            (tmp_path / method / "report" / name).write_bytes(png(np.zeros((4, 4, 3), np.uint8)))
    shared = dict(unit="mm", better=LOWER)
    measures = [
        Measure(name="a", group="Surface", published=2.0, default=0.00002, **shared),
        Measure(name="b", group="Surface", published=1.0, default=1.0, **shared),
        Measure(name="c", group="Body", published=np.nan, default=np.nan, **shared),
    ]
    page = comparison_page("kick", measures, {method: tmp_path / method for method in METHODS})
    assert page.count(">Surface</span>") == 1 and "Body</span>" not in page and "&lt; 0.001" in page
    assert "default: the fitted body, frame 7, view C" in page and "published: the layers of the body in its rest pose" in page
    assert "removed by the filters" in page and page.count("<img") == 6


@pytest.fixture
def clicked_take(plane_take: Path, tmp_path: Path, scenes: Any) -> Path:
    """The plane with a point of its surface clicked in the first frame."""
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    pixels = ", ".join(
        "{} = [{:.1f}, {:.1f}]".format(c.name, *c.project([0.0, 0.0, scenes.depth_m])) for c in scenes.three_cameras().cameras
    )
    (take / "take.toml").write_text((take / "take.toml").read_text() + f"[seeds]\nsurface = [{{ {pixels} }}]\n")
    return take


def test_values_are_short() -> None:
    assert [written(v) for v in (np.nan, 0.0, 12_345.6, 98.163, 0.25, 100.0)] == ["–", "0", "12,346", "98.2", "0.250", "100"]


def test_found_joints_are_clicks_of_the_published_method(
    plane_take: Path, tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The default runs first, and the published method begins from what it found; both reports get the larger end of each scale."""
    pictured = dict[str, list[int]]()
    ran, drawn, ends = list[tuple[str, dict[str, float], int]](), list[tuple[str, dict[str, float]]](), {DEFAULT: 4.3, PUBLISHED: 6.0}

    def stages(run: Run, monitor: Monitor) -> None:
        method, take = run.settings["method"].preset, run.footage.take
        at = {name: float(xy["C"][0]) for name, xy in take.clicks.joints.items()}
        ran.append((method, at, take.clicks.frame))
        pictured[method] = [*run.pictured]
        store.write_bytes(run.results.path("report", "cloud_0001.png"), b"")
        start = {"frame": 1, "unsure": ["wrist.L"], "joints_m": {"neck": [0.0, 0.1, scenes.depth_m], "wrist.L": [0.1, 0.1, 2.0]}}
        run.record["stages"]["fit"] = {"start": start} if method == DEFAULT else {}
        run.surfaceless = True
        limits = {"surface_0000.png": ends[method], "tracks_0000.png": 1.5, f"{method}.png": 1.0}
        store.write_json(run.results.path("report", "report.json"), {"colour_limits": limits})

    monkeypatch.setattr(pipeline, "all_stages", stages)
    monkeypatch.setattr(pipeline, "report", lambda run, _: drawn.append((run.results.folder.name, dict(run.colour_limits))))
    halves = run_both(plane_take, tmp_path / "out", {}, (0, 2), Monitor())
    neck = scenes.three_cameras()["C"].project(np.array([0.0, 0.1, scenes.depth_m]))[0]
    assert ran == [(DEFAULT, {}, 0), (PUBLISHED, {"neck": pytest.approx(neck, abs=0.06)}, 1)]
    assert pictured == {DEFAULT: [], PUBLISHED: [1]}, "the same frames are shown"
    assert drawn == [(DEFAULT, {"surface_0000.png": 6.0, "tracks_0000.png": 1.5})], "of the other the scale is the common one"
    assert list(halves.folders) == list(METHODS) and "it began from 1 joints" in halves.notes[0] and "in frame 1" in halves.notes[0]


def test_found_joints_do_not_replace_clicks() -> None:
    """The user's own win in the same frame; surface seeds of another frame stay in theirs."""

    def take(clicks: FrameClicks, *keyframes: FrameClicks) -> Any:
        return Given(clicks=clicks, keyframes=keyframes)

    own, found = {"C": np.array([5.0, 5.0])}, {"neck": {"C": [1.0, 1.0]}, "pelvis": {"C": [2.0, 2.0]}}
    here = with_joints(take(FrameClicks(frame=3, joints={"neck": own})), 3, found)
    assert here.clicks.joints["neck"] is own and here.clicks.joints["pelvis"]["C"].tolist() == [2.0, 2.0] and here.keyframes == ()
    seeded = with_joints(take(FrameClicks(frame=0, surface=(own,))), 3, found)
    assert seeded.clicks.frame == 0 and len(seeded.clicks.surface) == 1 and not seeded.clicks.joints
    assert [(k.frame, sorted(k.joints)) for k in seeded.keyframes] == [(3, ["neck", "pelvis"])]
    moved = with_joints(take(FrameClicks(frame=0, joints={"head": own}), FrameClicks(frame=3, joints={"neck": own})), 3, found)
    assert moved.clicks.frame == 3 and moved.clicks.joints["neck"] is own
    assert [(k.frame, sorted(k.joints)) for k in moved.keyframes] == [(0, ["head"])]


def test_where_the_published_method_cannot_run(clicked_take: Path, tmp_path: Path, capsys: Any) -> None:
    """A plane that was clicked in a frame that is left out: the default's results alone, and the page says why."""
    out = tmp_path / "out"
    assert main(["compare", str(clicked_take), "--out", str(out), "--frames", "1:2"]) == 0
    said, page, table = capsys.readouterr().out, (out / "compare.html").read_text(), json.loads((out / "compare.json").read_text())
    assert table["notes"][0].startswith("The published method could not run: ") and table["notes"][0] in said
    assert "Only the default method ran." in page and "could not run" in page and "published: " not in page
    assert page.count("<img") == len(list((out / DEFAULT / "report").glob("*.png"))) > 0
    rows = {row["name"]: row for row in table["measures"]}
    assert rows["points a frame"]["default"] > 100 and rows["points a frame"]["published"] is None
    assert rows["noise of a point about the surface through its neighbours"]["default"] > 0
    assert rows["duration of all stages"]["published"] is None and not (out / PUBLISHED).exists()


@pytest.mark.slow
def test_without_a_body_and_clicks_measured_points_are_clicks(plane_take: Path, tmp_path: Path, capsys: Any) -> None:
    """The published method covers most of the plane from them, and a single frame has no measures of trajectories."""
    out = tmp_path / "out"
    assert main(["compare", str(plane_take), "--out", str(out), "--frames", "0:1", "--json", "--quiet"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    (note,) = json.loads((out / "compare.json").read_text())["notes"]
    assert "began from 6 points" in note and "in frame 0" in note and note[:30] in (out / "compare.html").read_text()
    assert rows["points a frame"]["published"] > 0.7 * rows["points a frame"]["default"] > 70
    assert {rows[name][method] for name in rows if "traj" in name for method in METHODS} == {None}


@pytest.mark.slow
def test_both_methods_on_a_take(clicked_take: Path, tmp_path: Path, scenes: Any, capsys: Any) -> None:
    """Two runs in folders of their own, one page and one table; a second call computes nothing."""
    take, out = clicked_take, tmp_path / "out"
    command = ["compare", str(take), "--out", str(out), "--frames", "0:2", "--json", "--quiet"]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row for row in first}
    assert rows["points a frame"]["published"] > 100 and rows["reported sigma of a joint (median)"]["default"] is None
    for method, scan in ((PUBLISHED, "published"), (DEFAULT, "fronts")):
        run = json.loads((out / method / "run.json").read_text())
        assert run["settings"]["method"]["preset"] == method and run["settings"]["growing"]["method"] == scan
    assert json.loads((out / "compare.json").read_text())["measures"] == first
    page = (out / "compare.html").read_text()
    assert page.count("<img") == 2 * len(list((out / PUBLISHED / "report").glob("*.png"))) and "://" not in page
    ends = [json.loads((out / method / "report" / "report.json").read_text())["colour_limits"] for method in METHODS]
    assert "surface_0000.png" in ends[0] and ends[0] == ends[1]
    before = (out / DEFAULT / "run.json").stat().st_mtime_ns
    assert main(command) == 0 and (out / DEFAULT / "run.json").stat().st_mtime_ns == before
    assert main([*command, "--set", "method.preset=published"]) == 2 and "leave out --preset" in capsys.readouterr().err
    assert main(["compare", str(take), "--out", str(take)]) == 2 and "is itself a take" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_method_s_folder_that_leads_elsewhere_is_refused(plane_take: Path, tmp_path: Path, capsys: Any) -> None:
    for method in (PUBLISHED, DEFAULT):
        (tmp_path / method / "elsewhere").mkdir(parents=True)
        (tmp_path / method / "out").mkdir()
        (tmp_path / method / "out" / method).symlink_to(tmp_path / method / "elsewhere")
        assert main(["compare", str(plane_take), "--out", str(tmp_path / method / "out"), "--frames", "0:1", "--quiet"]) == 2
        assert "is a link to a place outside" in capsys.readouterr().err and not any((tmp_path / method / "elsewhere").iterdir())
