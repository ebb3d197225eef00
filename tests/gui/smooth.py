"""How long the window is held up while a job runs, and how soon Esc ends it, at each stage.

The window is small: without a graphics card, drawing a large one takes as long as what is to be measured.
"""

import time

import bpy
import drive
import numpy as np

SIZE = (640, 480)
GAP_S = 0.1
ESC_S = 1.0  # also the limit of any single gap: a window that is deaf for longer cannot hear Esc in time


def steps() -> drive.Steps:
    yield from drive.sidebar("VIEW_3D", "Tricap")
    with drive.Pulse() as idle:
        yield from drive.pause(5)
    drive.say("without a job:", idle)
    state, seen, gaps = bpy.context.window_manager.tricap, [], []
    for _ in range(20):
        begin()
        with drive.Pulse() as busy:
            yield from drive.wait_for(lambda: state.stage not in ("", "Starting", *seen) or not state.running, 200, "another stage")
            stage = state.stage
            yield from drive.pause(1.5)
        gaps.append(busy.gaps_s())
        if not state.running:
            break
        seen.append(stage)
        drive.say(f"during {stage}:", busy)
        pressed = time.monotonic()
        yield from drive.key("ESC")
        yield from drive.wait_for(lambda: not state.running, 30, f"Esc ends the job during {stage}")
        took = time.monotonic() - pressed
        drive.check(took < ESC_S * drive.slowness(), f"Esc during {stage} took {took:.2f} s (load {drive.slowness():.1f} of each core)")
    late = np.percentile(np.concatenate(gaps), 99) - np.percentile(idle.gaps_s(), 99)
    drive.check(late < GAP_S * drive.slowness(), f"a job holds the window up by {late * 1e3:.0f} ms (99 %)")
    running = np.concatenate(gaps[: len(seen)])  # what follows the end of the job, the making of the scene, is Blender's own thread's
    longest = running.max() - idle.gaps_s().max()
    drive.check(longest < ESC_S * drive.slowness(), f"and at the longest by {longest * 1e3:.0f} ms")
    drive.check(len(seen) > 2, f"stopped by Esc in {', '.join(seen)}")


def begin() -> None:
    """Start the sample as its button does; it goes on where it was stopped."""
    area = drive.area_of("VIEW_3D")
    with bpy.context.temp_override(window=drive.window(), area=area, region=drive.region_of(area)):
        bpy.ops.tricap.load_sample("INVOKE_DEFAULT")
