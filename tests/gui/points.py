"""Single points: clicked in two views, followed, shown over the footage and in space."""

import importlib
from pathlib import Path
from typing import Any

import bpy
import display
import drive
import numpy as np
import over_footage

FRAMES = 4
NEAR_M = 6e-3  # half a pixel of disparity
SEEN_PX = 60  # pixels of the window in which paths of a few frames differ from the footage


def module(name: str) -> Any:
    return importlib.import_module(f"bl_ext.user_default.tricap.{name}")


def steps() -> drive.Steps:
    take = drive.HERE / "face"
    over_footage.film(take)
    bpy.ops.tricap.open_take(directory=str(take))
    scene = bpy.context.scene
    scene.tricap.out = str(take / "results")
    bpy.ops.ed.undo_push(message="Opened")
    unfolded()
    yield from over_footage.opened()
    places = cloth(take)
    yield from clicked(places)
    yield from followed(take, places)
    yield from in_space()


def unfolded() -> None:
    """The panel is closed at first, and a header does not report what it is: here it is open from the start."""
    panel = bpy.types.TRICAP_PT_points
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()
    bpy.utils.register_class(panel)


def cloth(take: Path) -> np.ndarray:
    """The places (T, 2, 3) of two vertices of the sleeve that all views see in every frame, far apart."""
    truth = module("core.synthetic.truth").read_truth(take)
    rows = np.flatnonzero(truth.visible.all(axis=0) & truth.textured)
    along = truth.vertices_m[0, rows, 2]
    return np.stack([truth.vertices_m[:, rows[np.argsort(along)[len(rows) * k // 4]]] for k in (1, 3)], axis=1)


def window_place(view: str, at_m: np.ndarray) -> tuple[float, float]:
    camera = module("addon.project").rig_of(bpy.context.scene)[view]
    return display.image_place(over_footage.views()[view], *camera.project(at_m))


def clicked(places: np.ndarray) -> drive.Steps:
    """Each point in one view and again in another; Return goes on, Esc ends."""
    area = yield from drive.sidebar("CLIP_EDITOR", "Tricap")
    yield from drive.press(area, "tricap.click_points")
    running = module("addon.session").get_session()
    yield from drive.wait_for(lambda: running.click_operator, 5, "clicking points began")
    session = running.click_operator.session
    for k in range(2):
        name = f"point {k + 1}"
        drive.check(session.name == name, f"it is the turn of {name}")
        yield from drive.click(*window_place("L", places[0, k]))
        yield from drive.wait_for(lambda: session.curves("R"), 20, f"{name}: the other views have its line")
        yield from drive.shot(f"1_line_{k + 1}")
        yield from drive.click(*window_place("R", places[0, k]))
        yield from drive.key("RET")
        yield from drive.wait_for(lambda name=name: session.name != name, 10, "Return goes on")
    yield from drive.key("ESC")
    yield from drive.wait_for(lambda: not running.click_operator, 10, "Esc ends clicking")
    yield from drive.shot("2_clicked")


def followed(take: Path, places: np.ndarray) -> drive.Steps:
    """The button follows them; the paths are seen over the footage, the empties are where the cloth is."""
    area = yield from drive.sidebar("CLIP_EDITOR", "Tricap")
    yield from drive.press(area, "tricap.follow_points")
    table = take / "results" / "points3d.csv"
    yield from drive.wait_for(lambda: table.is_file() and not bpy.context.window_manager.tricap.running, 120, "the points are followed")
    scene = bpy.context.scene
    for frame in (0, FRAMES - 1):
        scene.frame_set(frame)
        for k in range(2):
            away = np.linalg.norm(np.array(bpy.data.objects[f"point {k + 1}"].matrix_world.translation) - places[frame, k])
            drive.check(away < NEAR_M, f"point {k + 1} is {1e3 * away:.1f} mm from the cloth in frame {frame}")
    drive.check(scene.tricap_overlay.chosen, "their paths are shown over the footage")
    yield from drive.settle()
    with_paths = display.pixels()
    yield from drive.shot("3_followed")
    scene.tricap_overlay.chosen = False
    yield from drive.settle()
    drive.check((display.pixels() != with_paths).any(axis=2).sum() > SEEN_PX, "and are seen there")
    scene.tricap_overlay.chosen = True


def in_space() -> drive.Steps:
    """Points and velocities in the 3D view."""
    yield from drive.wait_for(lambda: "Layout" in bpy.data.workspaces, 5, "there is a workspace with a 3D view")
    drive.window().workspace = bpy.data.workspaces["Layout"]
    yield from drive.wait_for(lambda: any(a.ui_type == "VIEW_3D" for a in drive.window().screen.areas), 20, "the 3D view is open")
    area = drive.area_of("VIEW_3D")
    bpy.context.scene.frame_set(1)
    with drive.override(window=drive.window(), area=area, region=drive.region_of(area)):
        for thing in bpy.context.view_layer.objects:
            thing.select_set(thing.name.startswith(("point ", "Velocities of Points")))
        bpy.ops.view3d.view_selected()
        bpy.ops.view3d.view_axis(type="FRONT")
    drive.check("Velocities of Points" in bpy.data.objects, "the velocities are arrows in space")
    yield from drive.shot("4_in_space")
