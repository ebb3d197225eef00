"""A new user's first minutes: Load Sample, a person who walks; Compute It Again, Esc, again."""

import os
import time

import bpy
import drive

LONG = 20_000  # frames
OPEN_S, SAMPLE_S = 30.0, 300.0  # without a graphics card, while the machine is busy


def steps() -> drive.Steps:
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    yield from drive.shot("1_first_run")
    state = bpy.context.window_manager.tricap
    began = time.monotonic()
    yield from drive.press(area, "tricap.load_sample")
    yield from drive.wait_for(lambda: not state.running and "Body" in bpy.data.objects, OPEN_S, "the sample is opened")
    drive.say(f"it took {time.monotonic() - began:.1f} s, load of the machine {os.getloadavg()[0]:.1f}")
    yield from drive.settle()
    yield from drive.shot("2_opened")
    yield from moves(bpy.data.objects["Body"])
    yield from metaballs(area)
    yield from drive.press(area, "tricap.compute_sample")
    yield from drive.wait_for(lambda: state.running and state.progress > 0, 20, "a job runs and tells how far it is")
    yield from drive.shot("3_running")
    yield from stopped_by_esc(area)
    yield from drive.quiet()
    began = time.monotonic()
    yield from drive.press(area, "tricap.compute_sample")
    drive.check(state.running, "the job was started again")
    yield from drive.wait_for(lambda: not state.running, SAMPLE_S, "the sample is measured and fitted")
    drive.say(f"it took {time.monotonic() - began:.1f} s, load of the machine {os.getloadavg()[0]:.1f}")
    yield from moves(bpy.data.objects["Body"])
    for line in drive.reports():
        drive.say("Blender said:", line)
    yield from export_stopped_by_esc(area)


def export_stopped_by_esc(area: bpy.types.Area) -> drive.Steps:
    """An export of many frames, begun from the file browser: Esc stops it and leaves no file; without Esc it is written."""
    scene, file, last = bpy.context.scene, drive.HERE / "long.bvh", bpy.context.scene.frame_end
    state = bpy.context.window_manager.tricap
    for frames, stopped in ((LONG, True), (30, False)):
        scene.frame_end = scene.frame_start + frames - 1
        now = scene.frame_current
        yield from drive.move(*drive.middle(area))
        with drive.override(window=drive.window(), area=area, region=drive.region_of(area, "WINDOW")):
            bpy.ops.tricap.export("INVOKE_DEFAULT", kind="bvh")
        yield from drive.choose("export", file.parent, file.name)
        if stopped:
            yield from drive.wait_for(lambda: state.running and state.progress > 0, 20, "the export tells how far it is")
            yield from drive.shot("5_exporting")
            yield from stopped_by_esc(drive.area_of("VIEW_3D"))
        else:
            yield from drive.wait_for(file.is_file, 60, "the file is written")
        drive.check(file.is_file() != stopped, "no file was written" if stopped else "it is there")
        drive.check(scene.frame_current == now, "the scene is in its frame")
        area = drive.area_of("VIEW_3D")
    scene.frame_end = last


def metaballs(area: bpy.types.Area) -> drive.Steps:
    """The switch in step 7 shows the metaballs, and hides them again."""
    part = next(thing for thing in bpy.data.objects if thing.type == "META")
    drive.check(part.name not in bpy.context.view_layer.objects, "the metaballs are excluded")
    bpy.context.window_manager.tricap_steps.rig = True
    yield from drive.settle()
    yield from drive.press(area, "show_metaballs")
    drive.check(part.name in bpy.context.view_layer.objects and part.visible_get(), "the switch shows them")
    yield from drive.shot("4_metaballs")
    yield from drive.press(area, "show_metaballs")
    drive.check(part.name not in bpy.context.view_layer.objects, "and hides them again")


def stopped_by_esc(area: bpy.types.Area) -> drive.Steps:
    """Esc ends the job within a second, with a message, and leaves the scene as it was."""
    before = set(bpy.data.objects.keys())
    yield from drive.move(*drive.middle(area))
    yield from drive.stopped_by_esc("Esc ends the job")
    drive.check(set(bpy.data.objects.keys()) == before, "the scene is as it was")
    yield from drive.settle()
    drive.check(any("Stopped" in line for line in drive.reports()), "the message says that it was stopped")


def moves(body: bpy.types.Object) -> drive.Steps:
    """The right arrow key goes through the frames, and a wrist with it."""
    scene, area = bpy.context.scene, drive.area_of("VIEW_3D")
    yield from drive.move(*drive.middle(area))
    bone = body.pose.bones["forearm.R"]
    start, frame = (body.matrix_world @ bone.tail).copy(), scene.frame_current
    for _ in range(6):
        yield from drive.key("RIGHT_ARROW")
    yield from drive.settle()
    path = (body.matrix_world @ bone.tail - start).length
    drive.check(scene.frame_current == frame + 6 and path > 0.02, f"six frames on, {bone.name} has moved by {path * 1e3:.0f} mm")
