"""Whole stages as a user meets them: CPU and elapsed seconds a frame, for two sizes of images and both qualities, and the least that
anybody would do with the same frames.

Peers: OpenCV's PyrLK from the reference view into the others and into the next frame, and an ECC loop over patches, both triangulated.
"""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tricap.core.foundation.progress import Monitor
from tricap.core.foundation.threads import one_thread_in_linear_algebra
from tricap.core.geometry.intersection import forward_intersection
from tricap.core.run import pipeline, take_run
from tricap.core.run.engine import of_this_machine
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

SIZES, QUALITIES, FRAMES = (768, 1920), ("motion", "surface"), 13  # px wide; frames: enough for workers
POINTS, ECC_PATCHES, PATCH_PX = 2000, 60, 13
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
Times = dict[str, tuple[float, float]]  # by stage or peer: CPU and elapsed seconds a frame


def timed(work: Callable[[], Any], frames: int) -> tuple[float, float]:
    """CPU seconds, with those of worker processes, and elapsed seconds a frame."""
    before, began = sum(os.times()[:4]), time.perf_counter()
    work()
    return (sum(os.times()[:4]) - before) / frames, (time.perf_counter() - began) / frames


def of_stages(take: Path, out: Path, quality: str) -> Times:
    """A run without the Blender file, stage by stage."""
    times: Times = {}
    with one_thread_in_linear_algebra(), take_run.open_run(take, out, {"surface": {"quality": quality}}) as job:
        job.engine = of_this_machine()
        for stage in (pipeline.measure, pipeline.track, pipeline.fit, pipeline.report):
            times[stage.__name__] = timed(lambda run=stage: run(job, Monitor()), len(job.footage.frames))
    times["all"] = sum(cpu for cpu, _ in times.values()), sum(wall for _, wall in times.values())
    return times


def of_peers(take: Path) -> Times:
    """Flow and ECC on the frames of a take."""
    footage = open_take(read_take(take))
    frames = list(footage.frames)

    def images(frame: int) -> list[np.ndarray]:
        return [image.astype(np.uint8) for image in footage.read(frame)]

    def flow() -> None:
        ref, now = footage.take.reference, images(frames[0])
        for frame in frames[1:]:
            later = images(frame)
            at = cv2.goodFeaturesToTrack(now[ref], POINTS, 0.01, 5)
            found = [at if k == ref else cv2.calcOpticalFlowPyrLK(now[ref], image, at, None)[0] for k, image in enumerate(now)]
            for k, xy in enumerate(found):
                cv2.calcOpticalFlowPyrLK(now[k], later[k], xy, None)
            triangulated(np.concatenate(found, axis=1))
            now = later

    def ecc() -> None:
        ref, now = footage.take.reference, images(frames[0])
        half, at = PATCH_PX // 2, cv2.goodFeaturesToTrack(now[footage.take.reference], ECC_PATCHES, 0.01, 20)[:, 0]
        found = np.full((len(at), len(now), 2), np.nan)
        for i, (x, y) in enumerate(np.rint(at).astype(int)):
            template = now[ref][y - half : y + half + 1, x - half : x + half + 1]
            found[i, ref] = x, y
            for k in (k for k in range(len(now)) if k != ref and template.shape == (PATCH_PX, PATCH_PX)):
                warp = np.array([[1.0, 0, x - half], [0, 1.0, y - half]], np.float32)
                try:
                    _, warp = cv2.findTransformECC(template, now[k], warp, cv2.MOTION_AFFINE, CRITERIA)
                except cv2.error:
                    continue
                found[i, k] = warp @ (half, half, 1)
        triangulated(found)

    def triangulated(xy: np.ndarray) -> None:
        forward_intersection(footage.rig.cameras, xy.astype(float), np.tile(np.eye(2), (*xy.shape[:2], 1, 1)))

    cpu, wall = timed(ecc, 1)
    return {
        f"PyrLK, {POINTS} points": timed(flow, len(frames) - 1),
        f"ECC loop, {POINTS} points": (cpu * POINTS / ECC_PATCHES, wall * POINTS / ECC_PATCHES),
    }


def tables(folder: Path) -> Iterator[tuple[str, Times]]:
    """Each size and quality, and the peers of each size."""
    for width in SIZES:
        take = folder / f"take{width}"
        make_arm_take(take, ArmTakeSettings(frames=FRAMES, width_px=width, interlaced="none"))
        for quality in QUALITIES:
            yield f"{width} px, {quality}", of_stages(take, folder / f"{width}_{quality}", quality)
        yield f"{width} px, peers", of_peers(take)


def lines(found: dict[str, Times]) -> list[str]:
    """The table to print."""
    head = f"{'s a frame: CPU (elapsed)':<26}"
    return [head, *(f"{name:<22} " + "  ".join(f"{k} {c:.2f} ({w:.2f})" for k, (c, w) in times.items()) for name, times in found.items())]
