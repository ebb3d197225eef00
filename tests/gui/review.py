"""The workspace Review: body and footage side by side; a joint is dragged over the footage, and the body is fitted again."""

import importlib
import time
from typing import Any

import bpy
import display
import drive
import numpy as np

REVIEW, PULLED_PX, STAGE_S = "Tricap Review", 14.0, 180.0
TOWARDS_PX = 3.0  # of PULLED_PX: the wrist was right before, and the motion stays smooth
FRAME = 2


def module(name: str) -> Any:
    return importlib.import_module(f"bl_ext.user_default.tricap.{name}")


def steps() -> drive.Steps:
    take, arm = drive.HERE / "arm", module("core.synthetic.arm")
    arm.make_arm_take(take, arm.ArmTakeSettings(frames=4, width_px=384, interlaced="none"))
    bpy.ops.tricap.open_take(directory=str(take))
    bpy.context.scene.tricap.out = str(take / "results")
    bpy.ops.tricap.run()
    drive.need("Body" in bpy.data.objects, "there is a body")
    bpy.context.window_manager.tricap_steps.body = True
    yield from drive.settle()
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    yield from drive.press(area, "tricap.review")
    kinds = lambda: sorted(a.type for a in drive.window().screen.areas if a.type in ("CLIP_EDITOR", "VIEW_3D"))  # noqa: E731
    yield from drive.wait_for(
        lambda: drive.window().workspace.name == REVIEW and kinds() == ["CLIP_EDITOR", "VIEW_3D"], 20, "both are shown"
    )
    yield from drive.pause(1.0)
    bpy.context.scene.frame_set(FRAME)
    yield from drive.settle(10)
    yield from drive.shot("1_side_by_side")
    yield from pulled()
    yield from drive.press(drive.area_of("CLIP_EDITOR"), "back_to_steps()", "HEADER")
    yield from drive.wait_for(lambda: drive.window().workspace.name == "Layout", 10, "the button leads back to the steps")


def wrist_px() -> np.ndarray:
    """Where the middle view shows the fitted wrist."""
    pull = module("addon.correcting.pull_joint")
    places = pull.places_at(pull.fitted_joints(bpy.context.scene), FRAME)
    return np.asarray(pull.cameras_of(bpy.context.scene)["C"].project(places["wrist.R"]))


def taken_back(area: bpy.types.Area, before: np.ndarray, goal: np.ndarray) -> drive.Steps:
    """While the joint is dragged, the limb is shown where it would be; Esc takes it back, and the next joint can be dragged."""
    dragging = drive.drag(display.image_place(area, *before), display.image_place(area, *(before + 3 * (goal - before))))
    shown = lambda: module("addon.session").get_session().file.pulled  # noqa: E731
    while shown() is None:
        next(dragging)
        yield
    for _ in range(10):  # to the end, with the button still pressed
        next(dragging)
        yield
    pulled = shown()
    drive.check(len(pulled.outline_px["C"]) > 20 and len(pulled.bones_px["C"]), "the limb is drawn")
    drive.check(np.linalg.norm(pulled.joint_px["C"][1] - before) > 2 * PULLED_PX, "where it is dragged to")
    yield from drive.shot("2_dragging")
    yield from drive.key("ESC")
    drive.check(shown() is None, "Esc takes it back")
    for _ in dragging:  # the button is released
        yield
    drive.check("keyframes" not in module("addon.project").table(bpy.context.scene), "and makes no keyframe")


def pulled() -> drive.Steps:
    """Drag the wrist; it is a keyframe; fit again: the wrist follows."""
    area, before, scene = drive.area_of("CLIP_EDITOR"), wrist_px(), bpy.context.scene
    goal = before + (0.0, PULLED_PX)
    yield from drive.press(area, "tricap.pull_joint")
    yield from taken_back(area, before, goal)
    yield from drive.drag(display.image_place(area, *before), display.image_place(area, *goal))
    yield from drive.key("ESC")
    said = module("addon.project").table(scene)
    drive.need([k["frame"] for k in said.get("keyframes", [])] == [FRAME], "the dragged joint is a keyframe")
    clicked = np.array(said["keyframes"][0]["joints"]["wrist.R"]["C"])
    drive.check(np.abs(clicked - goal).max() < 2 / display.pixel_of(area) + 1, f"at {clicked}, dragged to {goal}")
    yield from drive.shot("2_pulled")
    began = time.monotonic()
    yield from drive.press(area, "tricap.fit_again")
    yield from drive.wait_for(lambda: not bpy.context.window_manager.tricap.running, STAGE_S, "Fit Again ends")
    drive.say(f"Fit Again took {time.monotonic() - began:.1f} s, at {display.slowness():.1f} times the usual load")
    moved = wrist_px() - before
    drive.check(moved[1] > TOWARDS_PX, f"the wrist went {moved[1]:.1f} of {PULLED_PX:.0f} px along, against the images")
    yield from drive.settle(10)
    yield from drive.shot("3_fitted_again")
