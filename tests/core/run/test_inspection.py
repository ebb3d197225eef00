"""Results read back for inspection: the matched points, their patches, tails, outlines."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.motion.formats.ply import write_mesh
from tricap.core.report.drawing import STRIP_PX, TITLE_PX
from tricap.core.report.patch_picture import FOUND, LETTERS, START, patch_picture
from tricap.core.run import pipeline
from tricap.core.run.inspection import body_outline, example_of_matching, patch_boxes, read_points, read_tracks
from tricap.core.take.footage import Footage
from tricap.core.tracking.settings import TrackStatus

TOP, STRIP = round(TITLE_PX * LETTERS), round(STRIP_PX * LETTERS)  # of a picture, without the image


@pytest.fixture(scope="module")
def run(plane_take: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Footage, Path]:
    out = tmp_path_factory.mktemp("inspection") / "out"
    made = pipeline.run(plane_take, out)
    return made.footage, out


@pytest.mark.slow
def test_points_lie_where_they_were_matched(run: tuple[Footage, Path]) -> None:
    footage, out = run
    cameras, rows = footage.rig.cameras, footage.take.rows_at(0)
    points = read_points(out, 2, cameras, rows)
    assert points is not None and len(points.xyz_m) > 300 and np.isfinite(points.residual_px).all()
    apart = np.linalg.norm(points.xy_px - np.stack([c.project(points.xyz_m) for c in cameras], axis=1), axis=2)
    assert np.median(apart) < 0.1 and points.correlation.min() > 0.5
    assert read_points(out, 77, cameras, rows) is None


def test_patches_show_the_same_texture_in_all_views(run: tuple[Footage, Path]) -> None:
    footage, out = run
    cameras, rows = footage.rig.cameras, footage.take.rows_at(0)
    points, images = read_points(out, 1, cameras, rows), footage.read(1)
    assert points is not None
    likeness = {"start": [], "found": []}  # type: ignore[var-annotated]
    for row in range(0, len(points.xyz_m), 37):
        start, found = patch_boxes(points, row, cameras, 1, rows, 13)
        assert np.allclose(start[1], found[1], atol=1e-6) and np.allclose(np.ptp(found[1], axis=0), 12)
        for name, boxes in (("start", start), ("found", found)):
            cut = [_cut(image, box) for image, box in zip(images, boxes)]
            likeness[name] += [np.corrcoef(cut[1], cut[k])[0, 1] for k in (0, 2)]
    assert np.median(likeness["found"]) > 0.97 and np.median(likeness["found"]) > np.median(likeness["start"])


def test_an_example_of_matching_is_one_point_in_three_views(run: tuple[Footage, Path], tmp_path: Path) -> None:
    """The middle view first, where start and result are the same; its picture shows one texture within the white outlines."""
    footage, out = run
    example = example_of_matching(out, 1, footage, 13)
    assert example is not None and example.views == (1, 0, 2) and example.frame == 1
    assert np.allclose(example.start_px[0], example.found_px[0], atol=1e-6)
    assert (np.abs(example.start_px - example.found_px).max(axis=(1, 2))[1:] > 0.2).all()
    images = footage.read(1)
    cut = [_cut(images[k], box) for k, box in zip(example.views, example.found_px)]
    assert min(np.corrcoef(cut[0], other)[0, 1] for other in cut[1:]) > 0.9
    caption, picture = patch_picture(example, images, ("left", "middle", "right"))
    assert caption.startswith("Frame 1: least squares matching of one point.") and "faces view middle" in caption
    white, black = ((picture == tint).all(axis=2)[TOP:-STRIP] for tint in (FOUND, START))
    assert all(part.sum() > 300 for part in np.hsplit(white, 3)) and [part.sum() > 50 for part in np.hsplit(black, 3)] == [
        False,
        True,
        True,
    ]
    shutil.copytree(out / "clouds", tmp_path / "clouds")
    assert example_of_matching(tmp_path, 1, footage, 13) is None, "without checkpoints"


def _cut(image: np.ndarray, box: np.ndarray) -> np.ndarray:
    u = np.linspace(0, 1, 13)
    at = box[0] + u[None, :, None] * (box[1] - box[0]) + u[:, None, None] * (box[3] - box[0])
    return cv2.remap(image.astype(np.float32), at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_CUBIC).ravel()


def test_without_the_cache_the_cloud_is_shown_alone(run: tuple[Footage, Path], tmp_path: Path) -> None:
    footage, out = run
    shutil.copytree(out / "clouds", tmp_path / "clouds")
    cameras, rows = footage.rig.cameras, footage.take.rows_at(0)
    points = read_points(tmp_path, 1, cameras, rows)
    assert points is not None and np.isnan(points.residual_px).all() and np.isnan(patch_boxes(points, 0, cameras, 1, rows, 13)[1]).all()
    assert np.allclose(points.xy_px[:, 1], cameras[1].project(points.xyz_m))


def test_tails_end_at_the_points_of_the_frame(run: tuple[Footage, Path]) -> None:
    footage, out = run
    history, camera = read_tracks(out), footage.rig.cameras[2]
    assert history is not None and not (history.kept & history.removed).any()
    segments, owner, age = history.tails(camera, 3, 2, history.kept)
    assert len(segments) > 100 and age.min() == 0.0 and age.max() == 0.5
    xy, status = history.at(camera, 3)
    assert np.allclose(segments[age == 0, 1], xy[owner[age == 0]]) and (status[owner[age == 0]] == TrackStatus.MEASURED).all()
    assert not len(history.tails(camera, 99, 2, history.kept)[0]) and np.isnan(history.at(camera, 99)[0]).all()


def test_the_outline_of_a_ball_is_a_circle(run: tuple[Footage, Path], tmp_path: Path) -> None:
    footage, _ = run
    camera, centre = footage.rig.cameras[1], np.array([0.02, 0.01, 2.1])
    v, u = np.mgrid[0 : np.pi : 41j, 0 : 2 * np.pi : 81j]
    ball = centre + 0.1 * np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    i = np.arange(40)[:, None] * 81 + np.arange(80)
    write_mesh(tmp_path / "skin" / "0004.ply", ball, np.stack([i, i + 81, i + 82, i + 1], axis=-1).reshape(-1, 4))
    (loop,) = body_outline(tmp_path, 4, camera)
    radius = np.linalg.norm(loop - camera.project(centre), axis=1)
    expected = 0.1 / np.sqrt(2.1**2 - 0.1**2) * camera.focal_px
    assert abs(radius.mean() - expected) < 0.8 and radius.std() < 0.6  # the outermost pixels' middles
    assert body_outline(tmp_path, 5, camera) == []


@pytest.mark.parametrize(("name", "array"), [
    ("frames", None), ("frames", np.arange(3)), ("frames", np.array([0, 2, 2, 3])), ("xyz_m", np.zeros((4, 5))), ("status", None),
    ("xyz_m", np.zeros((4, 6, 3))), ("status", np.full((4, 5), 99, np.int8)), ("status", np.zeros((4, 5), np.float32)),
])  # fmt: skip
def test_trajectories_that_no_run_wrote(tmp_path: Path, name: str, array: np.ndarray | None) -> None:
    arrays = {"frames": np.arange(4), "xyz_m": np.zeros((4, 5, 3)), "status": np.ones((4, 5), np.int8)}
    store.save(tmp_path / "trajectories_raw.npz", arrays, {})
    assert read_tracks(tmp_path) is not None
    store.save(tmp_path / "trajectories_raw.npz", {n: a for n, a in (arrays | {name: array}).items() if a is not None}, {})
    with pytest.raises(InputError, match="trajectories_raw.npz (is damaged|has no)"):
        read_tracks(tmp_path)
