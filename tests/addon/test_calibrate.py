"""Calibration in a real Blender: footage to cameras, undo, other tools' rigs, and the scene's cameras written exactly."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.geometry.rig import read_rig, write_rig
from tricap.core.synthetic.bar import BarNoise, benchmark_cameras, waved_bar
from tricap.core.synthetic.bar_images import BarPictures, write_bar_folder

from .conftest import small_rig


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrate") / "bar"
    waved = waved_bar(benchmark_cameras(), 40, np.random.default_rng(5), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    write_bar_folder(folder, waved, BarPictures(radius_m=0.015))
    return folder


def test_footage_becomes_cameras(blender, empty, bar: Path) -> None:
    props = empty.context.scene.tricap_calibrate
    props.bar, props.length_m = str(bar), 0.5
    assert empty.ops.tricap.calibrate() == {"FINISHED"}
    scene = empty.context.scene
    assert {o["tricap_view"] for o in scene.objects if o.type == "CAMERA"} == {"L", "C", "R"}
    assert props.verdict and props.light and scene.camera is not None
    rig = read_rig(bar.parent / "rig.toml")
    clip = empty.data.movieclips["Bar C"]
    first = clip.tracking.tracks[0].markers
    assert len(clip.tracking.tracks) == 2 and len(first) > 20
    waved = empty.data.objects["Reference bar"].data
    ends = np.array([v.co for v in waved.vertices]).reshape(-1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), 0.5, atol=1e-3)
    assert rig["C"].size_px == tuple(clip.size)


def test_a_mistake_is_told_and_changes_nothing(blender, empty, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="no folder"):
        empty.ops.tricap.calibrate(bar=str(tmp_path / "none"), length_m=0.5)
    with pytest.raises(RuntimeError, match="footage first"):
        empty.ops.tricap.calibrate()
    empty.context.scene.tricap_calibrate.floor = "0, forty"
    with pytest.raises(RuntimeError, match="“0, forty” is no list of frames"):
        empty.ops.tricap.calibrate(bar=str(tmp_path), length_m=0.5)
    assert not [o for o in empty.context.scene.objects if o.type == "CAMERA"]


def test_cameras_go_in_and_come_out_exactly(blender, empty, tmp_path: Path) -> None:
    rig = small_rig()
    write_rig(tmp_path / "rig.toml", rig)
    assert empty.ops.tricap.import_rig(filepath=str(tmp_path / "rig.toml")) == {"FINISHED"}
    empty.context.view_layer.update()
    assert empty.ops.tricap.export_rig(filepath=str(tmp_path / "out.toml")) == {"FINISHED"}
    again = read_rig(tmp_path / "out.toml")
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (100, 3))
    for camera in rig.cameras:
        assert np.nanmax(np.abs(again[camera.name].project(points) - camera.project(points))) < 1e-6


def test_a_camera_that_was_moved_is_read_from_blender(blender, empty, tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", small_rig())
    empty.ops.tricap.import_rig(filepath=str(tmp_path / "rig.toml"))
    moved = next(o for o in empty.context.scene.objects if o.get("tricap_view") == "C")
    before = moved.location.copy()
    moved.location.x += 0.5
    empty.context.view_layer.update()
    empty.ops.tricap.export_rig(filepath=str(tmp_path / "out.toml"))
    assert read_rig(tmp_path / "out.toml")["C"].centre_m[0] == pytest.approx(before.x + 0.5, abs=1e-6)


def test_an_own_camera_of_blender(blender, empty, tmp_path: Path) -> None:
    """Without anything of ours: 50 mm on 36 mm, 1920 × 1080, looking down from 5 m."""
    data = empty.data.cameras.new("mine")
    data.lens, data.sensor_width, data.sensor_fit = 50.0, 36.0, "HORIZONTAL"
    camera = empty.data.objects.new("mine", data)
    camera.location = (0, 0, 5)
    empty.context.scene.collection.objects.link(camera)
    empty.context.scene.render.resolution_x, empty.context.scene.render.resolution_y = 1920, 1080
    empty.context.view_layer.update()
    empty.ops.tricap.export_rig(filepath=str(tmp_path / "out.toml"))
    read = read_rig(tmp_path / "out.toml")["mine"]
    assert read.matrix[0, 0] == pytest.approx(1920 * 50 / 36, rel=1e-6) and read.matrix[:2, 2].tolist() == pytest.approx([959.5, 539.5])
    assert read.project(np.array([1.0, 0.5, 0.0])) == pytest.approx([959.5 + 2666.667 / 5, 539.5 - 2666.667 / 10], abs=1e-3)
