"""Cameras and footage: Blender sees what the calibrated cameras saw."""

import dataclasses
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tricap.core.geometry.camera import Camera

from .conftest import SIZE, small_rig, write_take

PROJECTION_PX = 2e-3  # measured 3e-4 on 768×576: the single precision of Blender's matrices
FISHEYE_PX = 0.1  # measured 0.044, where the lens shifts points by up to 22
UNDISTORTION_PX = 0.02  # measured 0.005 on these cameras (inverse of Brown's model by iteration in single precision)


def without_distortion(camera: Camera) -> Camera:
    """The ideal camera."""
    return dataclasses.replace(camera, distortions=np.zeros(5), fisheye=False)


def wide(camera: Camera) -> Camera:
    """The same with a fisheye lens of 150° across."""
    matrix = camera.matrix * [[75 / camera.matrix[0, 0], 1, 1], [1, 75 / camera.matrix[1, 1], 1], [1, 1, 1]]
    return dataclasses.replace(camera, matrix=matrix, fisheye=True, distortions=np.array([0.06, -0.02, 0.008, -0.0015, 0.0]))


@pytest.mark.parametrize("fy_over_fx", [1.0, 1.08, 0.9])
def test_blender_cameras_project_like_the_rig(empty: ModuleType, fy_over_fx: float) -> None:
    from tricap.addon.scene import cameras

    random = np.random.default_rng(3)
    scene = empty.context.scene
    for camera in small_rig().cameras:
        matrix = camera.matrix * np.array([[1.0], [fy_over_fx], [1.0]])
        matrix[1, 2] = camera.matrix[1, 2]
        ideal = dataclasses.replace(without_distortion(camera), matrix=matrix, affinity=np.array([0.01, 0.0]))
        cameras.frame_render(scene, ideal)
        seen = cameras.add_camera(scene.collection, ideal)
        empty.context.view_layer.update()
        xy = random.uniform((-20, -20), np.array(SIZE) + 20, (40, 2))
        xyz = ideal.points_at_depth(xy, random.uniform(0.5, 6, 40))
        np.testing.assert_allclose(cameras.projected(scene, seen, xyz, SIZE), xy, atol=PROJECTION_PX)


def test_axes_go_there_and_back() -> None:
    pytest.importorskip("bpy")
    from tricap.addon.scene import axes

    for camera in small_rig().cameras:
        R, t = axes.camera_from_world(axes.camera_to_world(camera))
        np.testing.assert_allclose(R, camera.R_cam_world, atol=1e-12)
        np.testing.assert_allclose(t, camera.t_cam_world_m, atol=1e-12)
    np.testing.assert_allclose(axes.uv_from_pixel(np.array([-0.5, SIZE[1] - 0.5]), SIZE), [0, 0], atol=1e-15)
    xy = np.array([[3.25, 100.5], [0.0, 0.0]])
    np.testing.assert_allclose(axes.pixel_from_uv(axes.uv_from_pixel(xy, SIZE), SIZE), xy, atol=1e-12)


@pytest.mark.parametrize("fisheye", [False, True])
def test_the_clip_undistorts_like_the_camera(empty: ModuleType, tmp_path: Path, fisheye: bool) -> None:
    """Blender's own undistortion of a tracked point, by a Follow Track constraint with and without it, against the camera's."""
    from tricap.addon.scene import axes, cameras, clips

    write_take(tmp_path / "take", small_rig())
    camera = wide(small_rig()["R"]) if fisheye else small_rig()["R"]
    scene = empty.context.scene
    seen = cameras.add_camera(scene.collection, camera)
    clip = clips.load_clip("R", tmp_path / "take" / "R" / "0000.png", camera)
    cameras.frame_render(scene, camera)
    empty.context.view_layer.update()
    random = np.random.default_rng(1)
    xy = random.uniform((3, 3), np.array(SIZE) - 3, (20, 2))
    ideal, shift = without_distortion(camera), []
    if fisheye:  # what Blender's camera shows
        xy = camera.project(ideal.points_at_depth(xy, 2.0))
    for i, point in enumerate(axes.uv_from_pixel(xy, SIZE)):
        track = clip.tracking.tracks.new(name=f"track {i}", frame=1)
        track.markers.find_frame(1).co = point
        pair = [follower(empty, clip, track, seen, undistorted) for undistorted in (True, False)]
        scene.frame_set(1)
        graph = empty.context.evaluated_depsgraph_get()
        places = np.array([follow.evaluated_get(graph).matrix_world.translation for follow in pair])
        shift.append(np.subtract(*ideal.project(places)))
    expected = ideal.project(camera.points_at_depth(xy, 2.0)) - xy
    assert np.linalg.norm(expected, axis=1).max() > 0.5
    np.testing.assert_allclose(shift, expected, atol=FISHEYE_PX if fisheye else UNDISTORTION_PX)


def follower(bpy: ModuleType, clip: object, track: object, camera_object: object, undistorted: bool) -> object:
    """An empty, two metres before the camera, on the ray of a track."""
    from mathutils import Vector

    follow = bpy.data.objects.new("follower", None)
    bpy.context.scene.collection.objects.link(follow)
    follow.location = camera_object.matrix_world @ Vector((0, 0, -2))
    constraint = follow.constraints.new("FOLLOW_TRACK")
    constraint.clip, constraint.track, constraint.camera = clip, track.name, camera_object
    constraint.use_active_clip = False
    constraint.use_undistorted_position, constraint.frame_method = undistorted, "STRETCH"
    return follow


def test_footage_stands_behind_the_cameras_in_the_takes_frames(empty: ModuleType, tmp_path: Path) -> None:
    from tricap.addon.scene import cameras, clips

    write_take(tmp_path / "take", small_rig())
    camera = small_rig()["C"]
    files = sorted((tmp_path / "take" / "C").glob("*.png"))
    seen = cameras.add_camera(empty.context.scene.collection, camera)
    clip = clips.load_clip("C", files[0], camera)
    clips.show_behind(seen.data, clip)
    assert (clip.source, clip.frame_duration, clip.frame_start) == ("SEQUENCE", len(files), 0)
    assert clips.clip_faults(clip, camera, files, "view C") == []
    background = seen.data.background_images[0]
    assert background.clip == clip and background.clip_user.use_render_undistorted


def test_footage_that_blender_cannot_show_is_told(empty: ModuleType, tmp_path: Path) -> None:
    from tricap.addon.scene import clips

    write_take(tmp_path / "take", small_rig())
    camera = small_rig()["C"]
    files = sorted((tmp_path / "take" / "C").glob("*.png"))
    files[3].unlink()
    clip = clips.load_clip("C", files[0], dataclasses.replace(camera, size_px=(100, 50)))
    size, gap = clips.clip_faults(clip, dataclasses.replace(camera, size_px=(100, 50)), files, "view C")
    assert "192×144" in size and "100×50" in size
    assert "only 3 of the 8" in gap


@pytest.mark.parametrize(("fisheye", "movie"), [(False, False), (True, False), (False, True)])
def test_renders_show_the_undistorted_footage_of_their_frame(empty: ModuleType, tmp_path: Path, fisheye: bool, movie: bool) -> None:
    """The screen before the camera, rendered, against the image undistorted by the camera's own model."""
    import cv2

    from tricap.addon.scene import cameras, clips, footage_plane, surroundings
    from tricap.addon.scene.preview import undistorted

    camera = wide(small_rig()["R"]) if fisheye else small_rig()["R"]
    scene, files = empty.context.scene, [tmp_path / f"{frame:04d}.png" for frame in (3, 4, 5)]
    y, x = np.indices(SIZE[::-1])
    for i, file in enumerate(files):
        cv2.imwrite(str(file), (90 + 30 * i + 30 * np.sin(x / 9) * np.cos(y / 7)).astype(np.uint8))
    images = [cv2.imread(str(file)) for file in files]
    if movie:
        files = [tmp_path / "R.avi"]
        writer = cv2.VideoWriter(str(files[0]), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
        for image in images:
            writer.write(image)
        writer.release()
    seen = cameras.add_camera(scene.collection, camera)
    clip = clips.load_clip("R", files[0], camera)
    clip.frame_start, scene.camera = 10, seen
    footage_plane.add_screen(scene.collection, seen, camera, clip, files)
    floor = surroundings.add_floor(scene.collection)
    assert not footage_plane.shown(scene)
    before = scene.view_settings.view_transform
    footage_plane.show(scene, True)
    assert footage_plane.shown(scene) and floor.hide_render
    cameras.frame_render(scene, camera)
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.cycles.pixel_filter_type = "BOX"
    scene.render.filepath, scene.render.image_settings.file_format = str(tmp_path / "out.png"), "PNG"
    scene.frame_set(11)
    empty.ops.render.render(write_still=True)
    got, wanted = (
        cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_GRAYSCALE),
        undistorted(images[1][..., 0], camera),
    )
    inside = np.s_[6:-6, 6:-6]
    difference = got[inside].astype(float) - wanted[inside]
    assert np.median(np.abs(difference)) < 2.0 and abs(difference.mean()) < 1.0  # of 255; the next frame is brighter by 30
    footage_plane.show(scene, False)
    assert not footage_plane.shown(scene) and not floor.hide_render and scene.view_settings.view_transform == before


def test_a_fisheye_lens_survives_the_scene(empty: ModuleType, tmp_path: Path) -> None:
    """The clip has the nearest lens of Brown's; the calibrated one comes back as long as nobody changes that."""
    from tricap.addon.calibrate.cameras import EXACT, camera_of, exact_values
    from tricap.addon.scene import cameras, clips
    from tricap.core.foundation.errors import InputError
    from tricap.core.geometry.rig import Rig

    write_take(tmp_path / "take", small_rig())
    camera = wide(small_rig().cameras[0])
    scene = empty.context.scene
    cameras.frame_render(scene, camera)
    shown = cameras.add_camera(scene.collection, camera)
    shown[EXACT] = exact_values(camera)
    clip = clips.load_clip("L", tmp_path / "take" / "L" / "0000.png", camera)
    for behind in (False, True):
        if behind:
            clips.show_behind(shown.data, clip)
        empty.context.view_layer.update()
        again = camera_of(scene, shown)
        assert again.fisheye and again.distortions.tolist() == camera.distortions.tolist()
    clip.tracking.camera.brown_k1 += 0.01
    with pytest.raises(InputError, match="coefficient K4"):
        camera_of(scene, shown)
    assert not cameras.frame_faults(Rig(cameras=(camera,)), camera)
    wider = dataclasses.replace(camera, matrix=camera.matrix * [[0.4, 1, 1], [1, 0.4, 1], [1, 1, 1]])
    assert "up to 0.9 px off" in cameras.frame_faults(Rig(cameras=(wider,)), wider)[0]
