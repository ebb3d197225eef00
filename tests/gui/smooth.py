"""How long the window is held up while a job runs, and how soon Esc ends it, at each stage.

The window is small: without a graphics card, drawing a large one takes as long as what is to be measured. What is asked of the gaps holds
on a machine that does other work, too: how much longer they are than without a job.
"""

import importlib
import time

import bpy
import display
import drive
import numpy as np

SIZE = (640, 480)
GAP_S = 0.1  # a person does not notice
BUSY = 2.0  # jobs for each core: from there on the window waits longer for its turn than for Python
RARELY = 0.01  # of the gaps may be longer
LONGEST_S = 0.5  # on a machine that does nothing else


def steps() -> drive.Steps:
    take, arm = drive.HERE / "arm", importlib.import_module("bl_ext.user_default.tricap.core.synthetic.arm")
    arm.make_arm_take(take, arm.ArmTakeSettings(frames=12, fps=15.0, width_px=384, interlaced="none"))
    bpy.ops.tricap.open_take(directory=str(take))
    bpy.context.scene.tricap.out = str(take / "results")
    yield from drive.sidebar("VIEW_3D", "Tricap")
    with display.Pulse() as idle:
        yield from redrawn(5)
    drive.say("without a job, the sidebar drawn as often as with one:", idle)
    state, seen, gaps = bpy.context.window_manager.tricap, [], []
    for _ in range(20):
        begin()
        with display.Pulse() as busy:
            yield from drive.wait_for(lambda: state.stage not in ("", "Starting", *seen) or not state.running, 200, "another stage")
            stage = state.stage
            yield from drive.pause(1.5)
        gaps.append(busy.gaps_s())
        if not state.running:
            break
        seen.append(stage)
        drive.say(f"during {stage}:", busy)
        yield from drive.stopped_by_esc(f"Esc ends the job during {stage}")
    judge(np.concatenate(gaps[: len(seen)]), idle.gaps_s())  # the making of the scene, which follows, is Blender's own thread's
    drive.check(len(seen) > 2, f"stopped by Esc in {', '.join(seen)}")


def redrawn(seconds: float) -> drive.Steps:
    """Let Blender live for a while, and draw the sidebar as often as a job's progress is drawn."""
    region, often = drive.region_of(drive.area_of("VIEW_3D"), "UI"), importlib.import_module("bl_ext.user_default.tricap.addon.jobs").SHOW_S
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        region.tag_redraw()
        yield from drive.pause(often)


def judge(running: np.ndarray, idle: np.ndarray) -> None:
    """What the gaps with a job are longer than those without."""
    most = GAP_S * max(1.0, display.slowness() / BUSY)
    for share in (95, 99):
        late = np.percentile(running, share) - np.percentile(idle, share)
        drive.check(late < most, f"a job holds the window up by {late * 1e3:.0f} ms ({share} %)")
    often = (running > GAP_S).mean() - (idle > GAP_S).mean()
    drive.check(often < RARELY, f"by more than {GAP_S * 1e3:.0f} ms in {often:.2%} of {len(running)} gaps")
    longest = running.max() - idle.max()
    drive.check(longest < LONGEST_S * display.slowness(), f"and at the longest by {longest * 1e3:.0f} ms")


def begin() -> None:
    """Start the run as its button does; it goes on where it was stopped."""
    area = drive.area_of("VIEW_3D")
    with drive.override(window=drive.window(), area=area, region=drive.region_of(area)):
        bpy.ops.tricap.run("INVOKE_DEFAULT")
