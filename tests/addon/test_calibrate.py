"""Calibration in a real Blender: footage to cameras, undo, other tools' rigs, and the scene's cameras written exactly."""

import importlib
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.boards.board import Board, BoardKind
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.synthetic.bar import BarNoise, BarPictures, benchmark_cameras, waved_bar, write_bar_folder
from tricap.core.synthetic.board import held_board, picture_of_board
from tricap.core.take.bar_file import read_bar

from ..core.calibration.test_boards import filmed
from ..core.synchronising.test_synchronise import heard, world, write_wav
from .conftest import small_rig
from .layout import Layout

FRAMES = 30
ADDON = "bl_ext.user_default.tricap.addon"


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrate") / "bar"
    waved = waved_bar(benchmark_cameras(), FRAMES, np.random.default_rng(7), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    write_bar_folder(folder, waved, BarPictures(radius_m=0.015))
    return folder


@pytest.mark.slow
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
    assert len(clip.tracking.tracks) == 2 and len(first) > FRAMES // 2
    waved = empty.data.objects["Reference bar"].data
    ends = np.array([v.co for v in waved.vertices]).reshape(-1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), 0.5, atol=1e-3)
    kept = read_bar(bar.parent / "rig.toml", rig)
    assert kept is not None
    np.testing.assert_allclose(kept[1], ends, atol=1e-5)
    assert rig["C"].size_px == tuple(clip.size)


@pytest.mark.slow
def test_cameras_that_were_started_one_by_one(blender, empty, bar: Path, tmp_path: Path) -> None:
    """R began three images after the others; its sound says so."""
    room = world(12.0)
    for view, first in (("L", 0), ("C", 0), ("R", 3)):
        (tmp_path / "loose" / view).mkdir(parents=True)
        for n, file in enumerate(sorted((bar / view).glob("*.png"))[first:]):
            (tmp_path / "loose" / view / f"{n:04d}.png").symlink_to(file)
        write_wav(tmp_path / "loose" / f"{view}.wav", heard(room, 1.0 + first / 25, 9.0, seed=ord(view)).samples)
    props = empty.context.scene.tricap_calibrate
    props.bar, props.length_m, props.started_fps = str(tmp_path / "loose"), 0.5, 25.0
    assert empty.ops.tricap.calibrate() == {"FINISHED"}
    assert props.light != "red"
    clips = empty.data.movieclips
    assert [clips[f"Bar {view}"].frame_start for view in "LCR"] == [-3, -3, 0]
    places = {}
    for view, first in (("L", 3), ("R", 0)):
        markers = clips[f"Bar {view}"].tracking.tracks[0].markers
        assert min(m.frame for m in markers) == first + 1 and max(m.frame for m in markers) <= first + 37
        places[view] = len(markers)
    assert min(places.values()) > 20


@pytest.mark.slow
def test_cameras_at_different_rates(blender, empty, bar: Path, tmp_path: Path) -> None:
    """L takes every second image of the others."""
    for view in "LCR":
        (tmp_path / "mixed" / view).mkdir(parents=True)
        for n, file in enumerate(sorted((bar / view).glob("*.png"))[:: 2 if view == "L" else 1]):
            (tmp_path / "mixed" / view / f"{n:04d}.png").symlink_to(file)
    props = empty.context.scene.tricap_calibrate
    props.bar, props.length_m, props.rates = str(tmp_path / "mixed"), 0.5, "L=12.5, C=25"
    with pytest.raises(RuntimeError, match="lacks the view R"):
        empty.ops.tricap.calibrate()
    props.rates = "L=12.5, C=25, R=25"
    assert empty.ops.tricap.calibrate() == {"FINISHED"}
    assert read_rig(tmp_path / "rig.toml").metadata["positions"] <= FRAMES // 2


@pytest.mark.slow
def test_both_fields_are_shown_image_by_image(blender, empty, bar: Path, tmp_path: Path) -> None:
    """The bar stands in both fields of these images, so twice as many frames are measured as the clip has."""
    props = empty.context.scene.tricap_calibrate
    props.bar, props.length_m, props.interlaced = str(bar), 0.5, "both"
    assert empty.ops.tricap.calibrate(out=str(tmp_path / "rig.toml")) == {"FINISHED"}
    kept = read_bar(tmp_path / "rig.toml", read_rig(tmp_path / "rig.toml"))
    assert kept is not None and len(kept[0]) > 1.5 * FRAMES and kept[0].max() == 2 * FRAMES - 1
    track = empty.data.movieclips["Bar C"].tracking.tracks[0].markers
    assert FRAMES // 2 < len(track) <= FRAMES + 1 and max(m.frame for m in track) <= FRAMES + 1
    assert len(empty.data.objects["Reference bar"].data.vertices) <= 2 * FRAMES


@pytest.mark.slow
def test_a_board_beside_the_wand(blender, empty, bar: Path, tmp_path: Path) -> None:
    board = Board(kind=BoardKind.CHESSBOARD, squares=(9, 6), square_m=0.05)
    filmed(tmp_path / "board", board, benchmark_cameras(), 5)
    panel, props = importlib.import_module(f"{ADDON}.calibrate.panel"), empty.context.scene.tricap_calibrate
    props.bar, props.length_m = str(bar), 0.5
    drawn = Layout()
    panel.draw_calibrate(drawn, empty.context)
    assert "board_footage" in drawn.properties and "squares" not in drawn.properties
    props.board_footage, props.board_kind, props.squares, props.square_m = str(tmp_path / "board"), "chessboard", (9, 6), 0.05
    props.lenses_only = True
    assert empty.ops.tricap.calibrate(out=str(tmp_path / "rig.toml")) == {"FINISHED"}
    assert "give the lenses only" in (tmp_path / "rig_report" / "calibration.txt").read_text(encoding="utf-8")
    assert read_rig(tmp_path / "rig.toml").metadata["square_m"] == 0.05 and (tmp_path / "rig_bar.csv").exists()
    drawn = Layout()
    panel.draw_calibrate(drawn, empty.context)
    assert {"board_kind", "squares", "lenses_only"} <= set(drawn.properties)
    assert any("L: 4 of 4 images show the board" in text for text in drawn.texts), drawn.texts
    (tmp_path / "board" / "R").rename(tmp_path / "board" / "X")
    with pytest.raises(RuntimeError, match="name the folders or movies of both like the cameras"):
        empty.ops.tricap.calibrate()


def test_a_mistake_is_told_and_changes_nothing(blender, empty, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="no folder"):
        empty.ops.tricap.calibrate(bar=str(tmp_path / "none"), length_m=0.5)
    with pytest.raises(RuntimeError, match="footage first"):
        empty.ops.tricap.calibrate()
    empty.context.scene.tricap_calibrate.floor = "0, forty"
    with pytest.raises(RuntimeError, match="“0, forty” is not a list of frames"):
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


@pytest.mark.slow
def test_a_rig_calibrated_anew_stays_where_the_scene_has_it(blender, empty, bar: Path, tmp_path: Path) -> None:
    empty.ops.tricap.calibrate(bar=str(bar), length_m=0.5)
    cameras = {o["tricap_view"]: o for o in empty.context.scene.objects if o.type == "CAMERA"}
    for camera in cameras.values():
        camera.location.x += 3.0
    empty.context.view_layer.update()
    there = {name: camera.matrix_world.translation.copy() for name, camera in cameras.items()}
    empty.context.scene.tricap_calibrate.like_scene = True
    empty.ops.tricap.calibrate(bar=str(bar), length_m=0.5)
    for o in empty.context.scene.objects:
        if o.type == "CAMERA":
            assert (o.matrix_world.translation - there[o["tricap_view"]]).length < 1e-3


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(1920, 1080, 1.0), (1080, 1920, 1.0), (768, 720, 1.25)], ids=["wide", "upright", "PAL"])
def test_every_sensor_fit_is_read_as_blender_projects(blender, empty, tmp_path: Path, fit: str, size: tuple[int, int, float]) -> None:
    """Against Blender's own projection matrix, with shifted lens, upright images and pixels that are no squares."""
    width, height, aspect = size
    data = empty.data.cameras.new("mine")
    data.lens, data.sensor_width, data.sensor_height, data.sensor_fit, data.shift_x, data.shift_y = 40.0, 30.0, 20.0, fit, 0.07, -0.11
    camera = empty.data.objects.new("mine", data)
    empty.context.scene.collection.objects.link(camera)
    render = empty.context.scene.render
    render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y = width, height, 1.0, aspect
    empty.context.view_layer.update()
    empty.ops.tricap.export_rig(filepath=str(tmp_path / "out.toml"))
    point = np.array([0.3, -0.2, -4.0])
    matrix = camera.calc_matrix_camera(empty.context.evaluated_depsgraph_get(), x=width, y=height, scale_x=1.0, scale_y=aspect)
    clip = np.array(matrix) @ [*point, 1.0]
    u, v = (clip[:2] / clip[3] + 1) / 2
    assert read_rig(tmp_path / "out.toml")["mine"].project(point) == pytest.approx([u * width - 0.5, (1 - v) * height - 0.5], abs=2e-3)


@pytest.mark.slow
def test_a_lens_that_was_cleared_or_cannot_be_read_is_noticed(blender, empty, bar: Path, tmp_path: Path) -> None:
    empty.ops.tricap.calibrate(bar=str(bar), length_m=0.5)
    lens = empty.data.movieclips["Bar C"].tracking.camera
    empty.ops.tricap.export_rig(filepath=str(tmp_path / "kept.toml"))
    assert abs(read_rig(tmp_path / "kept.toml")["C"].distortions[0]) > 0.1
    lens.brown_k1 = lens.brown_k2 = lens.brown_k3 = lens.brown_p1 = lens.brown_p2 = 0.0
    empty.ops.tricap.export_rig(filepath=str(tmp_path / "cleared.toml"))
    assert not read_rig(tmp_path / "cleared.toml")["C"].distortions.any()
    lens.brown_k4 = 0.1
    with pytest.raises(RuntimeError, match="K4"):
        empty.ops.tricap.export_rig(filepath=str(tmp_path / "k4.toml"))
    assert not (tmp_path / "k4.toml").exists()


FLOOR = {"World origin": [0.2, 0.5, 2.5], "World X": [0.45, 0.5, 2.6], "World Y": [0.1, 0.5, 2.9]}  # in the frame of the true cameras


def with_footage_and_clicks(bpy, bar: Path, tmp_path: Path) -> list:
    """The true cameras with their footage, and the three points clicked in every clip."""
    cameras = benchmark_cameras()
    write_rig(tmp_path / "rig é.toml", Rig(cameras=tuple(cameras)))
    assert bpy.ops.tricap.import_rig(filepath=str(tmp_path / "rig é.toml")) == {"FINISHED"}
    for camera in cameras:
        clip = bpy.data.movieclips.load(str(sorted((bar / camera.name).iterdir())[0]))
        clip.frame_start = 0
        behind = next(o for o in bpy.context.scene.objects if o.get("tricap_view") == camera.name).data.background_images.new()
        behind.source, behind.clip = "MOVIE_CLIP", clip
        importlib.import_module(f"{ADDON}.scene.clips").set_lens(clip, camera)
        for name, at in FLOOR.items():
            x, y = camera.project(np.array([at]))[0]
            w, h = clip.size
            clip.tracking.tracks.new(name=name, frame=1).markers.insert_frame(1, co=((x + 0.5) / w, 1 - (y + 0.5) / h))
    bpy.context.scene.frame_set(3)
    bpy.context.view_layer.update()
    return cameras


def test_three_tracks_put_the_world_there_and_undo_takes_it_back(blender, empty, bar: Path, tmp_path: Path) -> None:
    cameras = with_footage_and_clicks(empty, bar, tmp_path)
    before = {o["tricap_view"]: np.array(o.matrix_world) for o in empty.context.scene.objects if o.type == "CAMERA"}
    empty.ops.ed.undo_push(message="before")
    assert empty.ops.tricap.set_world() == {"FINISHED"}
    empty.ops.ed.undo_push(message="after")
    empty.context.view_layer.update()
    empty.ops.tricap.export_rig(filepath=str(tmp_path / "out.toml"))
    moved = read_rig(tmp_path / "out.toml")
    origin, x, y = (np.array(at) for at in FLOOR.values())
    length = np.linalg.norm(x - origin)
    for camera in cameras:
        expected = camera.project(np.array([origin, x]))
        assert np.abs(moved[camera.name].project(np.array([[0.0, 0, 0], [length, 0, 0]])) - expected).max() < 1e-2
        along = moved[camera.name].centre_m[2] - abs(camera.centre_m[1] - 0.5)  # the floor lies 0.5 m below along +y
        assert abs(along) < 1e-3
    empty.ops.ed.undo()
    back = {o["tricap_view"]: np.array(o.matrix_world) for o in empty.context.scene.objects if o.type == "CAMERA"}
    for name, matrix in before.items():
        np.testing.assert_allclose(back[name], matrix, atol=1e-6)


def test_the_rig_of_the_project_says_the_new_world(blender, empty, bar: Path, tmp_path: Path) -> None:
    shutil.copytree(bar, tmp_path / "film")
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert empty.ops.tricap.add_footage(directory=str(tmp_path / "film")) == {"FINISHED"}
    cameras = with_footage_and_clicks(empty, bar, tmp_path)
    assert empty.ops.tricap.cameras_from_file(filepath=str(tmp_path / "rig é.toml")) == {"FINISHED"}
    path = importlib.import_module(f"{ADDON}.project").take(empty.context.scene).rig_path
    before = path.read_bytes()
    for clip in empty.data.movieclips:
        for track in clip.tracking.tracks:
            track.markers[0].mute = track.name == "World Y"
    with pytest.raises(RuntimeError, match="“World Y”"):
        empty.ops.tricap.set_world()
    assert path.read_bytes() == before
    for clip in empty.data.movieclips:
        for track in clip.tracking.tracks:
            track.markers[0].mute = False
    assert empty.ops.tricap.set_world() == {"FINISHED"}
    rig = read_rig(path)
    assert rig.metadata["floor"] is True
    for camera in cameras:
        ends = camera.project(np.array([FLOOR["World origin"]]))
        assert np.abs(rig[camera.name].project(np.zeros((1, 3))) - ends).max() < 1e-2


def test_tracks_that_make_no_world_are_told(blender, empty, bar: Path, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="no camera"):
        empty.ops.tricap.set_world()
    write_rig(tmp_path / "rig.toml", small_rig())
    empty.ops.tricap.import_rig(filepath=str(tmp_path / "rig.toml"))
    with pytest.raises(RuntimeError, match="No camera of the scene has a movie clip"):
        empty.ops.tricap.set_world()
    with_footage_and_clicks(empty, bar, tmp_path)
    for clip in list(empty.data.movieclips)[:2]:
        clip.tracking.tracks["World X"].markers[0].mute = True
        clip.tracking.tracks["World X"].name = "else"
    with pytest.raises(RuntimeError, match="“World X” must be in the clips of at least two cameras; it is in 1"):
        empty.ops.tricap.set_world()


@pytest.mark.slow
def test_undo_takes_calibrated_and_imported_cameras_away(blender, empty, bar: Path, tmp_path: Path) -> None:
    def cameras() -> int:
        return sum(o.type == "CAMERA" for o in empty.context.scene.objects)

    write_rig(tmp_path / "rig.toml", small_rig())
    for name, run in (
        ("calibrate", lambda: empty.ops.tricap.calibrate(bar=str(bar), length_m=0.5)),
        ("import", lambda: empty.ops.tricap.import_rig(filepath=str(tmp_path / "rig.toml"))),
    ):
        empty.ops.ed.undo_push(message=f"before {name}")
        assert run() == {"FINISHED"} and cameras() == 3
        empty.ops.ed.undo_push(message=f"after {name}")
        empty.ops.ed.undo()
        assert cameras() == 0, name
        empty.ops.ed.redo()
        assert cameras() == 3, name
        empty.ops.ed.undo()


@pytest.mark.slow
def test_a_board_becomes_cameras_and_a_page(blender, empty, tmp_path: Path) -> None:
    props = empty.context.scene.tricap_calibrate
    props.target, props.squares, props.square_m, props.dictionary = "charuco", (5, 4), 0.14, "DICT_5X5_100"
    drawn = Layout()
    importlib.import_module(f"{ADDON}.calibrate.panel").draw_calibrate(drawn, empty.context)
    assert {"squares", "square_m", "dictionary"} <= set(drawn.properties) and "length_m" not in drawn.properties
    assert empty.ops.tricap.print_board(filepath=str(tmp_path / "board.pdf")) == {"FINISHED"}
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    board = Board(kind=BoardKind.CHARUCO, squares=(5, 4), square_m=0.14, dictionary="DICT_5X5_100")
    cameras = [c.resized((512, 384)) for c in benchmark_cameras()[:2]]
    rng = np.random.default_rng(11)
    held = held_board(cameras, board.corners_m, 12, rng, tilt=np.radians(35))
    for camera in cameras:
        (tmp_path / "film" / camera.name).mkdir(parents=True)
        for n in range(12):
            image = picture_of_board(camera, board.picture(dpi=25), 138, board.square_m, held.R[n], held.t_m[n], rng)
            cv2.imwrite(str(tmp_path / "film" / camera.name / f"{n}.png"), image)
    props.bar = str(tmp_path / "film")
    assert empty.ops.tricap.calibrate() == {"FINISHED"}
    assert "in which the board was held" in props.verdict and {c.name for c in read_rig(tmp_path / "rig.toml").cameras} == {"L", "C"}
    assert not (tmp_path / "rig_bar.csv").exists() and "Reference bar" not in empty.data.objects
    props.target = "WAND"
    with pytest.raises(RuntimeError, match="a wand is not printed"):
        empty.ops.tricap.print_board(filepath=str(tmp_path / "wand.pdf"))
