"""Over the footage: clicks with lines and proposals, dragging by G, a keyframe, undo; overlays; trajectories and regions taken out."""

import importlib
from pathlib import Path
from typing import Any

import bpy
import display
import drive
import numpy as np

CLICKS = "Tricap Clicks"
NEAR_PX = 6.0  # of a proposal from the true joint: clicks need be no better than 5 px, and a limb's thickness is guessed


def module(name: str) -> Any:
    return importlib.import_module(f"bl_ext.user_default.tricap.{name}")


def steps() -> drive.Steps:
    take = drive.HERE / "bras levé"
    joints = film(take)
    bpy.ops.tricap.open_take(directory=str(take))
    scene = bpy.context.scene
    for clip in module("addon.project").clips_of(scene).values():
        module("addon.clicks").clear(clip)
    scene.tricap.out = str(take / "results")
    bpy.ops.ed.undo_push(message="Opened")
    yield from opened()
    yield from clicked(joints)
    yield from a_keyframe(joints)
    bpy.ops.tricap.track()
    yield from watched()
    yield from corrected()


def film(take: Path) -> dict[str, dict[str, list[float]]]:
    """Make a recording; gives where its joints are in the first frame, by joint and view."""
    arm, truth = module("core.synthetic.arm"), module("core.synthetic.truth")
    arm.make_arm_take(take, arm.ArmTakeSettings(frames=4, width_px=384, interlaced="none"))
    rig, places = module("core.geometry.rig").read_rig(take / "rig.toml"), truth.read_truth(take).joints_m
    names = {"shoulder.R": "RightArm", "elbow.R": "RightForeArm", "wrist.R": "RightHand"}
    return {name: {c.name: c.project(places[said][0]).tolist() for c in rig.cameras} for name, said in names.items()}


def views() -> dict[str, bpy.types.Area]:
    """The Clip Editor of every view."""
    canvas = module("addon.overlay.canvas")
    return {canvas.clip_of(area)["tricap_view"]: area for area in canvas.clip_areas(drive.window())}


def opened() -> drive.Steps:
    """A workspace with an editor per view; the user's own stays."""
    before = len(drive.window().screen.areas)
    with drive.override(window=drive.window()):
        bpy.ops.tricap.open_views()
    yield from drive.wait_for(lambda: drive.window().workspace.name == CLICKS and len(views()) == 3, 20, "each view has an editor")
    yield from drive.pause(1.0)
    drive.check(len(bpy.data.workspaces["Layout"].screens[0].areas) == before, "the workspace Layout is as it was")
    yield from drive.settle()


def clicked(joints: dict[str, dict[str, list[float]]]) -> drive.Steps:
    """Click each joint in one view and take the proposals; drag one by G."""
    area = yield from drive.sidebar("CLIP_EDITOR", "Tricap")
    yield from drive.press(area, "tricap.click_joints")
    running = module("addon.session").get_session()
    yield from drive.wait_for(lambda: running.click_operator, 5, "clicking began")
    session = running.click_operator.session
    for name, at in joints.items():
        drive.check(session.name == name, f"it is the turn of {name}")
        yield from drive.click(*display.image_place(views()["L"], *at["L"]))
        yield from drive.wait_for(lambda: len(session.proposals) == 2, 20, f"{name} is proposed in the other views")
        for view, offer in session.proposals.items():
            away = float(np.linalg.norm(offer.xy_px - at[view]))
            drive.check(away < NEAR_PX, f"{name} is proposed in {view} {away:.1f} px from where it is")
        if name == "elbow.R":
            yield from drive.shot("1_proposed")
            yield from dragged(session, at)
        yield from drive.key("RET")
        yield from drive.wait_for(lambda name=name: not running.click_operator or session.name != name, 10, "Return goes on")
    drive.check(not running.click_operator, "after the last joint it ends by itself")
    said = module("addon.project").table(bpy.context.scene)["seeds"]["joints"]
    drive.check({n: set(at) for n, at in said.items()} == {n: {"L", "C", "R"} for n in joints}, "take.toml gets all clicks")


def dragged(session: Any, at: dict[str, list[float]]) -> drive.Steps:
    """G moves the click, and the proposals follow; Backspace and a click put it back."""
    before, (x, y) = session.clicks()["L"].copy(), display.image_place(views()["L"], *at["L"])
    yield from drive.key("G")
    yield from drive.move(x + 8, y)
    yield from drive.move(x + 16, y)
    yield from drive.click(x + 16, y)
    yield from drive.wait_for(lambda: np.linalg.norm(session.clicks()["L"] - before) > 3, 10, "G moves the click while clicking")
    drive.check(session.name == "elbow.R", "and it stays the turn of the elbow")
    yield from drive.click(x, y)
    yield from drive.wait_for(lambda: len(session.proposals) == 2, 20, "the proposals follow")


def a_keyframe(joints: dict[str, dict[str, list[float]]]) -> drive.Steps:
    """A click in another frame is a keyframe; Esc ends, wherever the pointer is; one undo takes it back."""
    project, running = module("addon.project"), module("addon.session").get_session()
    bpy.context.scene.frame_set(2)
    area = yield from drive.sidebar("CLIP_EDITOR", "Tricap")
    yield from drive.press(area, "tricap.click_joints")
    for view in "LR":
        yield from drive.click(*display.image_place(views()[view], *joints["shoulder.R"][view]))
    yield from drive.key("ESC")
    yield from drive.wait_for(lambda: not running.click_operator, 10, "Esc ends clicking")
    said = project.table(bpy.context.scene)
    drive.check([k["frame"] for k in said["keyframes"]] == [2], "frame 2 became a keyframe")
    yield from drive.key("Z", ctrl=True)
    yield from drive.wait_for(lambda: "keyframes" not in project.table(bpy.context.scene), 10, "one undo takes the keyframe back")
    drive.check(len(project.table(bpy.context.scene)["seeds"]["joints"]) == 3, "and leaves the rest")


def watched() -> drive.Steps:
    """Every overlay is drawn; pointing at the sleeve tells what is known there."""
    scene = bpy.context.scene
    bpy.ops.tricap.go_to_frame(frame=2)
    yield from drive.settle(10)
    drive.check({area.spaces.active.clip_user.frame_current for area in views().values()} == {2}, "that of the overlays")
    shown = scene.tricap_overlay
    yield from drive.settle()
    plain = display.pixels()
    shown.which_points = "both"
    for name in ("points", "tracks", "graph"):
        setattr(shown, name, True)
        yield from drive.settle()
        drive.check((display.pixels() != plain).any(axis=2).sum() > 500, f"{name} are seen")
        yield from drive.shot(f"2_{name}")
        setattr(shown, name, False)
    with drive.override(window=drive.window()):
        bpy.ops.tricap.open_views(show="tracks")
    yield from drive.wait_for(lambda: drive.region_of(views()["R"], "UI").width > 1, 20, "the views open with the switches beside them")
    drive.check(shown.tracks, "and with the trajectories")
    yield from drive.shot("2_opened_with_tracks")
    views()["R"].spaces.active.show_region_ui = False
    area = yield from drive.sidebar("CLIP_EDITOR", "Tricap")
    yield from drive.press(area, "tricap.look_closer")
    yield from drive.move(*track_place("R"))
    shown_inspection = module("addon.overlay.draw").shown_inspection
    yield from drive.wait_for(lambda: shown_inspection(2) is not None, 10, "there is something under the pointer")
    found = shown_inspection(2)
    drive.say(*found.lines)
    drive.check(set(found.matched_boxes) == {"L", "C", "R"}, "its patch is known in all views")
    yield from drive.settle()
    yield from drive.shot("3_looked")
    yield from drive.key("ESC")


def track_place(view: str) -> tuple[float, float]:
    """Where a kept trajectory is in the window."""
    run = module("addon.overlay.results").current(bpy.context.scene)
    history, points = run.tracks(), run.points(2)
    xy, status = history.at(run.cameras[view], 2)
    near = np.linalg.norm(xy[:, None] - points.xy_px[None, :, list(run.cameras).index(view)], axis=2).min(axis=1)
    row = int(np.flatnonzero((status == 1) & (near < 2))[5])
    return display.image_place(views()[view], *xy[row])


def corrected() -> drive.Steps:
    """A click takes a trajectory out, four a region; both stand in take.toml, and the tracks follow."""
    project = module("addon.project")
    area = yield from drive.sidebar("CLIP_EDITOR", "Tricap")

    def taken() -> int:
        return len(bpy.context.scene.tricap_correcting.corrections)

    yield from drive.press(area, "tricap.remove_trajectory")
    yield from drive.click(*track_place("R"))
    yield from drive.key("ESC")
    yield from drive.wait_for(lambda: taken() == 1, 10, "a trajectory is taken out")
    yield from drive.press(area, "tricap.remove_region")
    for x, y in ((220, 120), (300, 120), (300, 200)):
        yield from drive.click(*display.image_place(views()["R"], x, y))
    yield from drive.key("RET")
    yield from drive.wait_for(lambda: taken() == 2, 10, "a region is taken out")
    yield from drive.shot("4_corrected")
    said = project.table(bpy.context.scene).get("corrections", [])
    drive.check([c["kind"] for c in said] == ["trajectory", "region"], "take.toml gets both corrections")
    bpy.ops.tricap.track()
    run = module("addon.overlay.results").current(bpy.context.scene)
    words = dict(module("addon.overlay.layers").removal_counts(run.tracks(), 2))
    drive.check(words.get("removed by user", 0) > 1, f"the tracks are made without them: {words}")
