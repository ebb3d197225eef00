"""Large images are reduced to what a body's motion needs; everything that leaves the measurement is in pixels of the files' images."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.results.run_json import read_run
from tricap.core.run import pipeline, take_run, workers
from tricap.core.run.engine import Engine
from tricap.core.run.inspection import patch_boxes, read_points, read_removed
from tricap.core.run.settings import settings_of
from tricap.core.run.stages import stage_keys
from tricap.core.run.take_run import Run, open_run
from tricap.core.surface import resolution
from tricap.core.surface.resolution import measured_footage, person_seen, seen_area_m2
from tricap.core.surface.starts import MeasureSettings
from tricap.core.take.footage import Footage, open_take
from tricap.core.take.take import read_take, take_of_text

SIZE, FOCAL_PX, FACTOR = (440, 330), 1320.0, 2.4  # 1.6 mm a pixel: with so few points, 3.9 mm are enough


@pytest.fixture(scope="module")
def limb(scenes: Any) -> Any:
    """An upright cylinder."""
    return scenes.Body(radius_m=0.06, half_m=(0.2, 0.2), shortest_m=0.02)


@pytest.fixture(scope="module")
def large_take(tmp_path_factory: pytest.TempPathFactory, scenes: Any, limb: Any) -> Path:
    """Three frames of the cylinder in large images, with clicked joints of an arm and a mask."""
    rig = scenes.three_cameras(width=SIZE[0], height=SIZE[1], focal=FOCAL_PX)
    ends = {"shoulder.R": [0.0, -0.17, 2.16], "elbow.R": [0.0, 0.0, 2.16], "wrist.R": [0.0, 0.17, 2.16]}
    clicks = "\n".join(
        f'"{joint}" = {{ ' + ", ".join(f"{c.name} = {np.round(c.project(np.array(at)), 2).tolist()}" for c in rig.cameras) + " }"
        for joint, at in ends.items()
    )
    more = f'[body]\nmodel = "arm.R"\n[seeds.joints]\n{clicks}\n'
    frames = [[limb.moved(np.eye(3), [0.004 * t, 0.0, 0.0])] for t in range(3)]
    folder = Path(scenes.write_take(tmp_path_factory.mktemp("large"), rig, frames, more=more))
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[: SIZE[1] // 4] = 0  # not the upper quarter
    (folder / "mask.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    text = (folder / "take.toml").read_text()
    (folder / "take.toml").write_text(text.replace('images = "C/*.png"', 'images = "C/*.png"\nmask = "mask.png"'))
    return folder


@pytest.fixture
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if an arm needed fewer points."""
    monkeypatch.setattr(resolution, "POINTS", resolution.POINTS / 10)


def _tracked(take: Path, out: Path, overrides: Any = None, engine: Engine | None = None) -> Run:
    with open_run(take, out, overrides) as run:
        run.engine = engine
        pipeline.track(run, Monitor())
    return run


def test_a_person_needs_pixels_of_some_millimetres() -> None:
    assert 0.5 < seen_area_m2("full") < 0.7 and 0.04 < seen_area_m2("arm.R") < 0.06  # adults cover about 0.6 m² of a picture


def _measuring(quality: str = "motion", spacing_px: int = 4) -> MeasureSettings:
    return MeasureSettings.of(settings_of({}, {"surface": {"quality": quality}, "growing": {"spacing_px": spacing_px}}, "the test"))


def _reduced(footage: Footage, settings: MeasureSettings) -> Footage:
    """The footage as a run would first try to measure it."""
    person = person_seen(footage, settings, Monitor())
    return measured_footage(footage, settings, person.distance_m if person else None)


def test_only_large_images_of_a_body_are_reduced(large_take: Path, few_points: None) -> None:
    footage = open_take(read_take(large_take))
    small = _reduced(footage, _measuring())
    assert small.reduction == pytest.approx(np.full((3, 2), FACTOR), rel=0.1) and small.click_sigma_px < footage.click_sigma_px
    assert small.read(0)[1].shape[::-1] == small.rig.cameras[1].size_px
    unchanged = [
        _reduced(footage, _measuring("surface")),
        _reduced(footage, _measuring(spacing_px=16)),
        _reduced(_other(footage), _measuring()),
    ]
    assert all(found.full_size_px == () for found in unchanged)


def _with_clicks(take: Path, folder: Path, *joints: str) -> Path:
    """A copy of a take with the clicks of these joints alone."""
    shutil.copytree(take, folder)
    head, clicks = (take / "take.toml").read_text().split("[seeds")[0], (take / "take.toml").read_text().split("[seeds.joints]\n")[1]
    kept = [line for line in clicks.splitlines() if any(joint in line for joint in joints)]
    (folder / "take.toml").write_text("\n".join([head, "[seeds]\nframe = 1\n[seeds.joints]", *kept]) if kept else head)
    return folder


def _of_a_person(take: Path, folder: Path) -> Path:
    """A copy of the take whose cylinder is said to be a person, with clicks on three joints of the trunk."""
    text = (_with_clicks(take, folder, "shoulder.R", "elbow.R", "wrist.R") / "take.toml").read_text()
    text = text.replace('model = "arm.R"', 'model = "full"').replace("elbow.R", "hip.R").replace("wrist.R", "hip.L")
    (folder / "take.toml").write_text(text)
    return folder


def test_without_clicks_seeds_show_how_far_the_person_is(
    large_take: Path, few_points: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    footage = open_take(read_take(_with_clicks(large_take, tmp_path / "take")))
    assert person_seen(footage, _measuring(), Monitor()) is None  # a person who fills so low an image needs every pixel,
    monkeypatch.setattr(resolution, "TALL_M", 0.4)  # a cylinder does not
    person = person_seen(footage, _measuring(), Monitor())
    assert person is not None and person.distance_m == pytest.approx(2.1, abs=0.1)
    assert _reduced(footage, _measuring()).reduction == pytest.approx(np.full((3, 2), FACTOR), rel=0.1)


@pytest.mark.slow
def test_clicks_that_are_no_start_leave_the_measured_surface_alone(
    large_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resolution, "LEAST_SHARE", 0.02)  # for it is a cylinder,
    monkeypatch.setattr(resolution, "TALL_M", 0.4)  # not a person
    whole = _of_a_person(large_take, tmp_path / "whole")
    bare, lone = _with_clicks(whole, tmp_path / "bare"), _with_clicks(whole, tmp_path / "lone", "shoulder.R", "hip.R")
    first = _tracked(bare, tmp_path / "out")
    measured = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "cache").rglob("*.npz")}
    (bare / "take.toml").write_text((lone / "take.toml").read_text())
    again = _tracked(bare, tmp_path / "out")
    assert measured == {path: path.stat().st_mtime_ns for path in measured} and first.measured_footage.full_size_px
    assert first.keys["track"] == again.keys["track"] and first.keys["fit"] != again.keys["fit"]
    assert again.distance_m == first.distance_m and np.array_equal(again.clouds[2].xyz_m, first.clouds[2].xyz_m)

    def key(take: Path, spacing_px: int = 24) -> str:
        settings = first.settings | {"growing": replace(first.settings["growing"], seed_spacing_px=spacing_px)}
        return stage_keys(open_take(read_take(take)), settings, tmp_path)["measure"]

    none = _with_clicks(large_take, tmp_path / "none")
    (none / "take.toml").write_text((none / "take.toml").read_text().replace('model = "arm.R"', 'model = "full"'))
    assert key(lone) == key(none) != key(whole)
    assert key(lone, 0) != key(none, 0)  # without automatic seeds all clicks are needed


def _other(footage: Footage) -> Footage:
    text = (footage.take.folder / "take.toml").read_text().replace('model = "arm.R"', 'model = "none"')
    return open_take(take_of_text(text, footage.take.folder / "take.toml"))


def test_a_reduced_camera_sees_the_same_corners(large_take: Path) -> None:
    camera = open_take(read_take(large_take)).rig.cameras[0]
    small, X = camera.resized((110, 100)), np.array([[0.05, -0.1, 2.2], [-0.2, 0.15, 1.9]])
    scale = np.array([110, 100]) / camera.size_px
    assert np.allclose(small.project(X) + 0.5, (camera.project(X) + 0.5) * scale)


@pytest.mark.slow
def test_a_reduced_image_gives_fewer_points_as_good_in_full_pixels(large_take: Path, limb: Any, few_points: None, tmp_path: Path) -> None:
    run, whole = _tracked(large_take, tmp_path / "motion"), _tracked(large_take, tmp_path / "surface", {"surface": {"quality": "surface"}})
    for t in range(3):
        few, many = run.clouds[t], whole.clouds[t]
        assert 100 < len(few.xyz_m) < 0.4 * len(many.xyz_m)
        away = limb.moved(np.eye(3), [0.004 * t, 0.0, 0.0]).distance_m(few.xyz_m)
        assert np.abs(np.median(away)) < 5e-4 and np.median(np.abs(away)) < 1e-3
        for cloud in (few, many):
            apart = np.stack([c.project(cloud.xyz_m) for c in run.footage.rig.cameras], axis=1) - cloud.xy_px
            assert np.median(np.linalg.norm(apart, axis=2)) < 0.3
            assert cloud.xy_px[:, 1, 1].min() > SIZE[1] / 4 - 6  # the mask holds
    assert run.trajectories is not None and (run.trajectories.visible.sum(axis=0) == 3).sum() > 25
    moved = np.diff(run.trajectories.xyz_m[[0, 2]], axis=0)[0]
    assert np.nanmedian(moved, axis=0) == pytest.approx([0.008, 0.0, 0.0], abs=8e-4)
    assert read_run(tmp_path / "motion" / "run.json")["stages"]["measure"]["reduction"] == pytest.approx(FACTOR, rel=0.1)
    assert read_run(tmp_path / "surface" / "run.json")["stages"]["measure"]["reduction"] == 1


@pytest.mark.slow
def test_images_that_show_nothing_when_they_are_reduced_are_measured_as_they_are(
    large_take: Path, few_points: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resolution, "LEAST_SHARE", 10.0)
    run = _tracked(large_take, tmp_path / "out")
    assert not run.measured_footage.full_size_px and take_run.IN_FULL_SIZE in run.record["warnings"]
    assert run.record["stages"]["measure"]["reduction"] == 1
    whole = {path: path.read_bytes() for path in (tmp_path / "out" / "cache" / "surface").iterdir()}
    monkeypatch.setattr(take_run, "shows_enough", None)  # decided once
    again = _tracked(large_take, tmp_path / "out")
    assert not again.measured_footage.full_size_px and take_run.IN_FULL_SIZE in again.record["warnings"]
    assert whole == {path: path.read_bytes() for path in (tmp_path / "out" / "cache" / "surface").iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.02, 10.0], ids=["reduced", "in full size"])
def test_workers_measure_images_of_the_same_size(large_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    monkeypatch.setattr(resolution, "LEAST_SHARE", share)
    take = _of_a_person(large_take, tmp_path / "take")
    one = _tracked(take, tmp_path / "one")
    monkeypatch.setattr(workers, "FEWEST", 1)
    two = _tracked(take, tmp_path / "two", engine=Engine(workers=2, retries=1))
    assert bool(one.measured_footage.full_size_px) == bool(two.measured_footage.full_size_px) == (share < 1)
    for name in sorted(path.name for path in (tmp_path / "one" / "cache" / "surface").iterdir()):
        assert (tmp_path / "one" / "cache" / "surface" / name).read_bytes() == (tmp_path / "two" / "cache" / "surface" / name).read_bytes()


@pytest.mark.slow
def test_checkpoints_of_reduced_images_are_shown_in_full_pixels(large_take: Path, few_points: None, tmp_path: Path) -> None:
    run = _tracked(large_take, tmp_path / "out")
    first, cameras, rows = run.clouds[0], run.footage.rig.cameras, run.footage.take.rows_at(0)
    again = _tracked(large_take, tmp_path / "out")
    assert np.array_equal(again.clouds[0].xy_px, first.xy_px) and np.array_equal(
        again.trajectories.xyz_m, run.trajectories.xyz_m, equal_nan=True
    )  # type: ignore[union-attr]
    points = read_points(tmp_path / "out", 0, cameras, rows)
    assert points is not None and np.isfinite(points.middle_px).all()
    apart = points.xy_px - np.stack([c.project(points.xyz_m) for c in cameras], axis=1)
    assert np.median(np.linalg.norm(apart, axis=2)) < 0.3
    begun, found = patch_boxes(points, len(points.xyz_m) // 2, cameras, 1, rows, 13)
    assert np.ptp(found[1], axis=0) == pytest.approx(12 * points.reduction[1]) and np.allclose(begun[1], found[1], atol=1e-6)
    removed, _ = read_removed(tmp_path / "out", 0)
    assert not len(removed) or np.nanmax(removed[:, 1, 0]) > SIZE[0] / FACTOR  # of the full size


def test_the_quality_is_chosen_in_the_file_or_by_an_option(large_take: Path, few_points: None, tmp_path: Path, capsys: Any) -> None:
    text, path = (large_take / "take.toml").read_text(), large_take / "take.toml"
    asked = text.replace("fps =", 'quality = "surface"\nfps =')
    assert take_of_text(asked, path).settings == {"surface": {"quality": "surface"}}
    with pytest.raises(InputError, match="sets `quality` twice"):
        take_of_text(asked + '[settings.surface]\nquality = "motion"\n', path)
    assert main(["measure", str(large_take), "--out", str(tmp_path / "out"), "--frames", "0:1", "--quality", "surface", "--quiet"]) == 0
    assert read_run(tmp_path / "out" / "run.json")["stages"]["measure"]["reduction"] == 1
    assert main(["measure", str(large_take), "--out", str(tmp_path / "out"), "--quality", "quick", "--quiet"]) == 2
    assert "choose one of: motion, surface" in capsys.readouterr().err
