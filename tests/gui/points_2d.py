"""Single points in one clip without cameras (2-D): clicked in its editor, joined by a line, followed in its images."""

import importlib
from pathlib import Path
from typing import Any

import bpy
import display
import drive
import numpy as np
import over_footage
from points import cloth, unfolded

FRAMES = 4
NEAR_PX = 1.5
NAMES = ("point 1", "point 2")


def module(name: str) -> Any:
    return importlib.import_module(f"bl_ext.user_default.tricap.{name}")


def steps() -> drive.Steps:
    take = drive.HERE / "one camera"
    over_footage.film(take)
    camera = module("core.geometry.rig").read_rig(take / "rig.toml")["C"]
    at = np.stack([camera.project(xyz) for xyz in cloth(take)])  # (T, 2, 2)
    bpy.ops.wm.save_as_mainfile(filepath=str(take / "face.blend"))
    clip = bpy.data.movieclips.load(str(sorted((take / "C").glob("*.png"))[0]))
    clip.frame_start = 0
    bpy.context.scene.frame_set(0)
    unfolded()
    area = drive.area_of("VIEW_3D")
    area.ui_type = "CLIP_EDITOR"
    area.spaces.active.clip = clip
    yield from drive.settle()
    with drive.override(window=drive.window(), area=area, region=drive.region_of(area)):
        bpy.ops.clip.view_all(fit_view=True)
    yield from clicked(area, at)
    yield from joined(area, clip, at)
    yield from followed(area, take, clip, at)


def clicked(area: bpy.types.Area, at: np.ndarray) -> drive.Steps:
    """One click a point, then it is the turn of the next; Backspace undoes one, Esc ends."""
    yield from drive.sidebar("CLIP_EDITOR", "Tricap")
    yield from drive.press(area, "tricap.click_points")
    running = module("addon.session").get_session()
    yield from drive.wait_for(lambda: running.click_operator, 5, "clicking points began")
    session = running.click_operator.session
    for k, name in enumerate(NAMES):
        drive.check(session.name == name, f"it is the turn of {name}")
        yield from drive.click(*display.image_place(area, *at[0, k]))
        yield from drive.wait_for(lambda name=name: session.name != name, 10, "the next one follows")
    yield from drive.click(*display.image_place(area, 20, 20))
    yield from drive.key("BACK_SPACE")
    yield from drive.wait_for(lambda: session.name == "point 3", 10, "Backspace takes a stray click back")
    yield from drive.key("ESC")
    yield from drive.wait_for(lambda: not running.click_operator, 10, "Esc ends clicking")
    said = [line for line in drive.reports() if "new points" in line]
    drive.check(len(said) == 1 and "2 new points" in said[0] and "2-D" in said[0], f"it says what to press next: {said}")
    yield from drive.shot("1_clicked")


def joined(area: bpy.types.Area, clip: bpy.types.MovieClip, at: np.ndarray) -> drive.Steps:
    """Selected as in any Clip Editor, by a click and a Shift-click."""
    own = module("addon.points.tracks").points_of(clip, 0)
    drive.check(
        all(np.linalg.norm(np.array(own[n]) - at[0, k]) < 2.0 for k, n in enumerate(NAMES)), "the points are where they were clicked"
    )
    for k in range(2):
        yield from drive.click(*display.image_place(area, *at[0, k]), shift=k > 0)
        yield from drive.settle()
    drive.check({t.name for t in clip.tracking.tracks if t.select} == {*NAMES}, "both are selected")
    yield from drive.press(area, "tricap.join_points")
    drive.check(module("addon.points.tracks").joined(clip) == [NAMES], "the selected points are joined")
    yield from drive.shot("2_joined")


def followed(area: bpy.types.Area, take: Path, clip: bpy.types.MovieClip, at: np.ndarray) -> drive.Steps:
    """The table has their places in every image, and the scene their line over the footage."""
    yield from drive.press(area, "tricap.follow_points2d")
    yield from drive.wait_for(lambda: " – ".join(NAMES) in bpy.data.objects, 120, "they are followed, and their line is in the scene")
    tables = list(take.rglob("planar/*.csv"))
    drive.need(len(tables) == 1, f"there is one table: {tables}")
    found = module("core.tracking.point_tables").read_planar(tables[0])
    drive.check(found.frames.tolist() == list(range(FRAMES)), "of all images")
    away = np.linalg.norm(found.xy_px - at, axis=2).max()
    drive.check(away < NEAR_PX, f"they are {away:.2f} px from the cloth at most")
    area.ui_type = "VIEW_3D"
    yield from drive.settle()
    drive.check(bpy.data.objects["Cube"].hide_get(), "Blender's cube makes room")
    with drive.override(window=drive.window(), area=area, region=drive.region_of(area)):
        module("addon.operators.build_scene").frame_in_views(None, bpy.context, bpy.data.objects["Footage"], front=True)
    yield from drive.pause(0.5)
    view = area.spaces.active.region_3d
    drive.check(abs(view.view_rotation.to_euler().x - np.pi / 2) < 1e-3, "the picture is seen from the front")
    drive.check(0.5 < view.view_distance / bpy.data.objects["Footage"].empty_display_size < 4, "… and fills the view")
    yield from drive.shot("3_in_the_scene")
