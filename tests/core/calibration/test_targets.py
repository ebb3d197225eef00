"""Targets in images: accuracy against drawn discs, speed, what is no target, and the whole way from pictures to a rig."""

import json
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.calibrate import calibrate_rig, measure_bar, open_bar, write_report
from tricap.core.calibration.targets import Targets, TargetStatus, find_blobs, find_targets, track_bar
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.synthetic.bar import BarNoise, BarPictures, benchmark_cameras, draw_disc, picture, waved_bar, write_bar_folder

from .truth import error_m


def discs(rng: np.random.Generator, grey: float, squeeze: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """An image with 48 discs of 6–20 px diameter, and where they are."""
    image = np.full((480, 640), 20.0, np.float32)
    places = np.stack(np.meshgrid(np.arange(8) * 76 + 50, np.arange(6) * 74 + 50), axis=-1).reshape(-1, 2) + rng.uniform(-3, 3, (48, 2))
    for place in places:
        draw_disc(image, place, rng.uniform(3, 10), grey, 0.7, squeeze)
    return np.clip(np.round(image + rng.normal(0, 2, image.shape)), 0, 255).astype(np.float32), places


def errors(found: np.ndarray, places: np.ndarray) -> np.ndarray:
    nearest = np.linalg.norm(found[:, None] - places[None], axis=2).argmin(axis=1)
    return found - places[nearest]


@pytest.mark.parametrize(("grey", "squeeze"), [(200.0, 1.0), (330.0, 1.0), (200.0, 0.7)], ids=["round", "saturated", "oblique"])
def test_positions_are_right_to_a_hundredth_of_a_pixel(grey: float, squeeze: float) -> None:
    match, centroid = [], []
    for seed in range(3):
        image, places = discs(np.random.default_rng(seed), grey, squeeze)
        targets = find_targets(image)
        assert len(targets.xy_px) == 48 and (targets.status == TargetStatus.OK).all()
        match.append(errors(targets.xy_px, places))
        centroid.append(errors(find_blobs(image).xy_px, places))
    assert np.sqrt(np.mean(np.square(match))) < 0.015
    assert np.sqrt(np.mean(np.square(centroid))) < 0.03
    assert np.abs(np.mean(np.concatenate(match), axis=0)).max() < 0.005


def test_five_hundred_targets_a_second() -> None:
    image, _ = discs(np.random.default_rng(0), 200.0)
    find_targets(image)
    start = time.process_time()
    for _ in range(5):
        find_targets(image)
    assert 5 * 48 / (time.process_time() - start) > 250  # half of what is promised: machines differ


def test_what_is_no_disc_is_said() -> None:
    image = np.full((200, 300), 20.0, np.float32)
    draw_disc(image, np.array([60.0, 100.0]), 8, 220, 0.7)
    draw_disc(image, np.array([3.0, 50.0]), 8, 220, 0.7)  # leaves the image
    cv2.rectangle(image, (150, 20), (160, 120), 220, -1)  # a lamp
    draw_disc(image, np.array([220.0, 100.0]), 7, 220, 0.7)
    draw_disc(image, np.array([232.0, 103.0]), 7, 220, 0.7)  # two merged
    targets = find_targets(image)
    good = targets.xy_px[targets.status == TargetStatus.OK]
    assert good.shape == (1, 2) and np.abs(good[0] - [60, 100]).max() < 0.02
    assert len(find_targets(np.zeros((100, 100), np.float32)).xy_px) == 0
    assert len(find_targets(np.random.default_rng(0).normal(20, 3, (200, 300)).astype(np.float32)).xy_px) == 0


@pytest.mark.parametrize(("bar", "least"), [(60.0, 0.9), (110.0, 0.9)])
def test_a_bright_bar_hides_no_target(bar: float, least: float) -> None:
    waved = waved_bar(benchmark_cameras(), 12, np.random.default_rng(5), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    rng, look = np.random.default_rng(0), BarPictures(radius_m=0.015, bar=bar, reflections=0)
    off, places = [], 0
    for n in range(12):
        targets = find_targets(picture(waved, n, 1, look, rng).astype(np.float32))
        true = waved.xy_px[n, 1][np.isfinite(waved.xy_px[n, 1]).all(axis=1)]
        places += len(true)
        off += [np.linalg.norm(true - xy, axis=1).min() for xy in targets.xy_px[targets.status == TargetStatus.OK]]
    assert len(off) >= least * places and np.median(off) < 0.02
    assert max(off) < 0.3, "the bar itself is no target"


def spots(*xy: tuple[float, float], area: float = 80.0) -> Targets:
    n = len(xy)
    points = np.array(xy, dtype=float).reshape(n, 2)
    return Targets(xy_px=points, sigma_px=np.full(n, 0.01), area_px=np.full(n, area), contrast=np.full(n, 200.0), status=np.zeros(n, int))


def test_tracks_leave_out_reflections_and_keep_the_order() -> None:
    frames = []
    for t in range(30):
        a, b = (100 + 8 * t, 200 + 3 * t), (180 + 4 * t, 320 - 5 * t)
        seen = [(600.0, 50.0), b, a] if t % 2 else [a, b, (600.0, 50.0)]
        frames.append(spots(*([(600.0, 50.0)] if t == 12 else [a, (600.0, 50.0)] if t == 5 else seen)))
    track = track_bar(frames, 768.0)
    assert not track.static and np.isnan(track.xy_px[12]).all()
    ends = track.xy_px[[t for t in range(30) if t not in (5, 12)]]
    assert (np.linalg.norm(np.diff(ends, axis=0), axis=2) < 40).all()
    assert np.isfinite(track.xy_px[5]).all(axis=1).sum() == 1
    assert not (np.nanmin(np.abs(track.xy_px - [600.0, 50.0]).sum(axis=2)) < 1)


def test_with_their_diameter_known_small_reflections_are_left_out() -> None:
    """Two small reflections that wander quietly beside one end of a bar that leaps: without the diameter they are the likelier pair."""
    frames = []
    for t in range(30):
        leap = 150 * (t % 2)
        bar, small = [(100.0 + leap, 200.0), (400.0 - leap, 420.0 - leap)], [(500.0 + 4 * t, 60.0), (500.0 + 4 * t, 360.0)]
        area = np.array([300.0, 300.0, 30.0, 30.0])
        frames.append(replace(spots(*bar, *small), area_px=area))
    alone, known = track_bar(frames, 768.0), track_bar(frames, 768.0, diameter=0.05)
    assert np.nanmin(alone.xy_px[..., 0]) > 450 > np.nanmax(known.xy_px[..., 0])
    with pytest.raises(InputError, match="diameter is given as 0.6 m"):
        measure_bar(None, 0.5, Monitor(), diameter_m=0.6)


@pytest.mark.slow
def test_a_mask_for_each_camera(bar_folder, tmp_path: Path) -> None:
    folder, waved = bar_folder
    masks = tmp_path / "masks"
    masks.mkdir()
    shown = np.full(waved.cameras[0].size_px[::-1], 255, np.uint8)
    shown[:, :384] = 0
    cv2.imwrite(str(masks / "C.png"), shown)
    footage = open_bar(folder, mask=masks)
    assert [m is not None for m in footage.masks] == [name == "C" for name in footage.names]
    seen = measure_bar(footage, 0.5, Monitor()).observations.xy_px
    assert np.nanmin(seen[:, footage.names.index("C"), :, 0]) > 384 > np.nanmin(seen[:, footage.names.index("L"), :, 0])
    cv2.imwrite(str(masks / "X.png"), shown)
    with pytest.raises(InputError, match="the mask X.png, and there is no camera of that name"):
        open_bar(folder, mask=masks)


def test_reflections_alone_are_no_bar(tmp_path: Path) -> None:
    waved = waved_bar(benchmark_cameras(), 12, np.random.default_rng(5), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    hidden = replace(waved, xy_px=np.full_like(waved.xy_px, np.nan))
    write_bar_folder(tmp_path / "bar", hidden, BarPictures(bar=14.0, reflections=4))
    counts: list[int] = []
    with pytest.raises(InputError, match="or only lamps and reflections are visible there"):
        measure_bar(open_bar(tmp_path / "bar"), 0.5, Monitor(), lambda name, frames, whole: counts.append(whole))
    assert max(counts) <= 1  # what stands still is not counted; the first image has none before it


@pytest.fixture(scope="module")
def bar_folder(tmp_path_factory: pytest.TempPathFactory):
    waved = waved_bar(benchmark_cameras(), 50, np.random.default_rng(5), BarNoise(sigma_px=0.0, gross=0.0, missing=0.05))
    folder = tmp_path_factory.mktemp("bar")
    write_bar_folder(folder, waved, BarPictures(radius_m=0.015))
    return folder, waved


@pytest.mark.slow
def test_from_pictures_to_a_rig(bar_folder, tmp_path: Path) -> None:
    folder, waved = bar_folder
    out = tmp_path / "rig.toml"
    code = main(["calibrate", str(folder), "--bar-length", "0.5", "--out", str(out), "--report", str(tmp_path / "report"), "--quiet"])
    assert code == 0 and {p.name for p in (tmp_path / "report").iterdir()} >= {"calibration.txt", "calibration.json", "coverage.png"}
    from tricap.core.geometry.rig import read_rig

    rig = read_rig(out)
    assert set(rig.sigmas) == set("LCR") and 0 < rig.sigmas["C"]["f"] < 5 and 0 < rig.sigmas["C"]["shift z"] < 0.01
    said = json.loads((tmp_path / "report" / "calibration.json").read_text())
    assert 0.2 < said["volume_visited"] <= 1 and 0.9 < said["volume_seen_by_two"] <= 1 and said["bars_rejected"] <= 3
    estimated = [rig[c.name] for c in waved.cameras]
    assert error_m(waved.cameras, estimated, waved.ends_m.reshape(-1, 3)) < 0.5e-3


@pytest.mark.slow
@pytest.mark.parametrize(("lines", "first"), [("odd", 0), ("both", 0), ("both", 1)])
def test_an_interlaced_bar(tmp_path: Path, lines: str, first: int) -> None:
    """The other field holds another instant: only the field's own rows may be used, of both fields each for its own frame.

    The film of one field is short: a delay of −7.5 images fits two of its cameras, and is not believed.
    """
    waved = waved_bar(benchmark_cameras(), 40, np.random.default_rng(6), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    per = 2 if lines == "both" else 1
    rng, look = np.random.default_rng(0), BarPictures(radius_m=0.02, reflections=1)
    for c, camera in enumerate(waved.cameras):
        (tmp_path / camera.name).mkdir()
        for n in range(40 // per - 2 + per):
            frame = picture(waved, per * n + first, c, look, rng)
            frame[1::2] = picture(waved, per * n + 1 - first, c, look, rng)[1::2]
            cv2.imwrite(str(tmp_path / camera.name / f"{n:03d}.png"), frame)
    measured = measure_bar(open_bar(tmp_path, lines, first_field=("odd", "even")[first]), 0.5, Monitor())
    shown = waved.ends_m[: len(measured.observations.frames)]
    assert len(shown) == (40 if per == 2 else 39)
    true = np.stack([waved.cameras["LCR".index(v)].project(shown) for v in measured.observations.names], axis=1)
    off = np.linalg.norm(measured.observations.xy_px[:, :, :, None] - true[:, :, None], axis=-1).min(axis=-1)
    assert np.nanmedian(off) < 0.05
    done = calibrate_rig(measured.observations, Monitor())
    assert done.quality.held_out.rms_m < 1e-3
    assert write_report(tmp_path / "report", done)


@pytest.mark.slow
def test_the_recorded_bar(shared_takes: Path, tmp_path: Path) -> None:
    """The recording beside the repository: from its images alone."""
    from tricap.core.geometry.rig import read_rig

    truth = np.load(shared_takes / "bar_dev" / "truth.npz")
    ends = np.concatenate([truth["A"], truth["B"]])
    true = read_rig(shared_takes / "dev_arm" / "rig.toml")
    done = calibrate_rig(measure_bar(open_bar(shared_takes / "bar_dev"), 0.4, Monitor()).observations, Monitor())
    assert done.quality.held_out.rms_m < 0.3e-3
    assert error_m([true[c.name] for c in done.rig.cameras], done.rig.cameras, ends) < 0.5e-3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("three", "In only 3 bar positions"),
        ("static", "does not move"),
        ("unseen", "view R"),
        ("black", "No bright target"),
        ("one view", "only the view"),
        ("lengths", "different numbers of frames"),
    ],
)
def test_refusals_are_one_sentence_and_leave_no_file(change: str, says: str, bar_folder, tmp_path: Path, capsys) -> None:
    folder, _ = bar_folder
    bar = tmp_path / "bar"
    for view in "LCR" if change != "one view" else "L":
        (bar / view).mkdir(parents=True)
        for n in {"three": (0, 20, 40), "static": (7,) * 15, "lengths": range(12 if view == "L" else 13)}.get(change, range(12)):
            image = cv2.imread(str(folder / view / f"{n:04d}.png"), cv2.IMREAD_UNCHANGED)
            if change == "black" or (change == "unseen" and view == "R"):
                image = np.zeros_like(image)
            count = len(list((bar / view).iterdir()))
            cv2.imwrite(str(bar / view / f"{count:04d}.png"), image)
    out = tmp_path / "rig.toml"
    assert main(["calibrate", str(bar), "--bar-length", "0.5", "--out", str(out), "--quiet"]) == 2
    message = capsys.readouterr().err.strip()
    assert says in message and "\n" not in message and not out.exists()


def test_a_bar_parallel_to_the_images_is_refused_by_the_command(tmp_path: Path, capsys) -> None:
    """From its pictures: the sentence says which motion is missing, and no file is left."""
    waved = waved_bar(benchmark_cameras(), 20, np.random.default_rng(6), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    d = (waved.ends_m[:, 0] - waved.ends_m[:, 1]) * [1, 1, 0]
    half = waved.length_m / 2 * d / np.linalg.norm(d, axis=1, keepdims=True)
    middle = waved.ends_m.mean(axis=1)
    write_bar_folder(tmp_path / "bar", replace(waved, ends_m=np.stack([middle + half, middle - half], axis=1)), BarPictures(radius_m=0.015))
    out = tmp_path / "rig.toml"
    assert main(["calibrate", str(tmp_path / "bar"), "--bar-length", "0.5", "--out", str(out), "--quiet"]) == 2
    message = capsys.readouterr().err.strip()
    assert "tilt the bar towards the cameras" in message and "\n" not in message and not out.exists()


@pytest.mark.parametrize("length", ["0", "-1", "nan", "1e9"])
def test_a_wrong_length_is_refused(length: str, bar_folder, tmp_path: Path, capsys) -> None:
    assert main(["calibrate", str(bar_folder[0]), f"--bar-length={length}", "--out", str(tmp_path / "r.toml"), "--quiet"]) == 2
    assert "length" in capsys.readouterr().err


def test_missing_folder_and_missing_arguments(tmp_path: Path, capsys) -> None:
    assert main(["calibrate", str(tmp_path / "none"), "--bar-length", "1", "--out", str(tmp_path / "r.toml")]) == 2
    assert main(["calibrate", str(tmp_path), "--out", str(tmp_path / "r.toml")]) == 2
    assert main(["calibrate", "--out", str(tmp_path / "r.toml")]) == 2
    with pytest.raises(InputError):
        open_bar(tmp_path / "none")


def test_a_folder_as_the_rig_to_write_is_told_before_anything_is_measured(tmp_path: Path, capsys) -> None:
    """There is no bar either: that would be told later."""
    assert main(["calibrate", str(tmp_path / "none"), "--bar-length", "1", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err.strip()
    assert said == f"tricap: --out {tmp_path} is a folder; give the file of the rig to write, such as {tmp_path / 'rig.toml'}."
