"""A control rig for the sample: a curled finger, limbs baked to IK (Esc, then to the end), uncertainty shown under it."""

import bpy
import drive

OPEN_S, MADE_S, BAKED_S = 30.0, 60.0, 100.0  # without a graphics card, while the machine is busy
TO_IK = "tricap.bake_limbs(to='IK'"
FINGER, LIMB = "f_index.03.R", "thigh.L"


def steps() -> drive.Steps:
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    state, steps_shown = bpy.context.window_manager.tricap, bpy.context.window_manager.tricap_steps
    yield from drive.press(area, "tricap.load_sample")
    yield from drive.wait_for(lambda: not state.running and "Body" in bpy.data.objects, OPEN_S, "the sample is opened")
    body, scene = bpy.data.objects["Body"], bpy.context.scene
    steps_shown.rig = True
    yield from drive.settle()
    yield from drive.press(area, "tricap.make_control_rig")
    yield from drive.wait_for(lambda: "Body controls" in bpy.data.objects, MADE_S, "the control rig is made")
    yield from drive.settle()
    yield from drive.shot("1_control_rig")
    rig = bpy.data.objects["Body controls"]
    yield from curled(rig, body)
    switch = rig.pose.bones[f"{LIMB.replace('.', '_parent.')}"]
    keys = key_count(rig)
    yield from drive.press(area, TO_IK)
    yield from drive.wait_for(lambda: state.running and state.progress > 0, 20, "baking tells how far it is")
    yield from drive.move(*drive.middle(area))
    yield from drive.stopped_by_esc("Esc ends baking")
    drive.check(key_count(rig) == keys and switch["IK_FK"] == 1.0, "the control rig is as before")
    wanted = feet(scene, body)
    with drive.override(window=drive.window(), area=area, region=drive.region_of(area, "WINDOW")):
        bpy.ops.tricap.bake_limbs("INVOKE_DEFAULT", to="IK")
    yield from drive.wait_for(lambda: not state.running and key_count(rig) > keys, BAKED_S, "the limbs are baked to IK")
    off = max((a - b).length for before, now in zip(wanted, feet(scene, body)) for a, b in zip(before, now))
    drive.check(off < 1e-3, f"the feet are where they were, to {off * 1e3:.2f} mm")
    scene.frame_set(scene.frame_current)
    drive.check(switch["IK_FK"] == 0.0, "IK moves them")
    scene.tricap.show_uncertainty = True
    yield from drive.settle()
    yield from drive.shot("3_uncertainty")
    for line in drive.reports():
        drive.say("Blender said:", line)


def curled(rig: bpy.types.Object, body: bpy.types.Object) -> drive.Steps:
    """The master of a finger curls it, also on the body."""
    tip = (body.matrix_world @ body.pose.bones[FINGER].tail).copy()
    rig.pose.bones["f_index.01_master.R"].scale.y = 0.7
    bpy.context.view_layer.update()
    moved = (body.matrix_world @ body.pose.bones[FINGER].tail - tip).length
    drive.check(moved > 0.02, f"the finger's tip has moved by {moved * 1e3:.0f} mm")
    yield from drive.settle()
    yield from drive.shot("2_curled")


def key_count(rig: bpy.types.Object) -> int:
    """The keys of the corrections, which the scene plays over the base layer."""
    action = rig.animation_data.action
    return sum(
        len(curve.keyframe_points)
        for layer in action.layers
        for strip in layer.strips
        for bag in strip.channelbags
        for curve in bag.fcurves
    )


def feet(scene: bpy.types.Scene, body: bpy.types.Object) -> list[list]:
    """Where the heels are, in some frames."""
    found, now = [], scene.frame_current
    for frame in range(scene.frame_start, scene.frame_end + 1, 8):
        scene.frame_set(frame)
        found.append([(body.matrix_world @ body.pose.bones[f"foot.{side}"].head).copy() for side in "LR"])
    scene.frame_set(now)
    return found
