"""Tracking and its peers: the same points of a turning, shifting film by our 2-D mode (forwards and backwards, with key templates),
cv2.calcOpticalFlowPyrLK, a loop over cv2.findTransformECC and Blender's own tracker; then the whole step in three views against the number
of points, and the 2-D mode against the number of frames.

    python tests/bench/tracking.py [--json FILE]

All in one thread budget of one run: read the figures as ratios.
"""

import argparse
import json
import resource
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from _blender_tracker import blender_tracks

from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import FieldLayout
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.tracking.planar import track_planar
from tricap.core.tracking.settings import TrackingSettings
from tricap.core.tracking.step import FramePair, TrackingView, track_step
from tricap.core.tracking.templates import cut_tiles, no_templates
from tricap.core.tracking.tracked import born

SIZE, FRAMES, PATCH = (768, 576), 24, 13
FALSE_PX = 3.0


def motion(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Frame i shows own = A⁻¹ (x − b): a turn of 0.4° a frame, and 4 px a frame."""
    a, c = np.radians(0.4 * i), np.array(SIZE) / 2
    A = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return A, c - A @ c + np.array([30 * np.sin(i / 8), 14 * np.sin(i / 5)])


def film() -> list[np.ndarray]:
    """A speckle texture of about 3 px, resampled with Lanczos windows; noise of 2 grey values."""
    random = np.random.default_rng(0)
    texture = cv2.GaussianBlur(random.standard_normal((2 * SIZE[1], 2 * SIZE[0])).astype(np.float32), (0, 0), 3.0)
    texture = 127 + 25 * texture / texture.std()
    frames = []
    for i in range(FRAMES):
        A, b = motion(i)
        M = np.concatenate([A / 2, (b + 0.0)[:, None]], axis=1)  # texture at twice the resolution
        frame = cv2.warpAffine(texture, M, SIZE, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
        frames.append(np.clip(np.rint(frame + 2 * np.random.default_rng(i + 1).standard_normal(frame.shape)), 0, 255).astype(np.float32))
    return frames


def points(step: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(160, SIZE[0] - 160, step), np.arange(140, SIZE[1] - 140, step))
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)


def score(path: np.ndarray, start: np.ndarray) -> dict[str, float]:
    """Drift at the end and false fraction over all frames."""
    A0, b0 = motion(0)
    own = (start - b0) @ np.linalg.inv(A0).T
    off = np.stack([np.linalg.norm(path[i] - (own @ motion(i)[0].T + motion(i)[1]), axis=1) for i in range(len(path))])
    seen = np.isfinite(off)
    good = off[-1][seen[-1] & (np.nan_to_num(off[-1], nan=99) < FALSE_PX)]
    return {"drift_px": float(np.sqrt(np.mean(good**2))), "false": float((off[seen] > FALSE_PX).mean()), "kept": float(seen[-1].mean())}


def ours(frames: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    return track_planar(lambda i: frames[i], range(len(frames)), start, MatchingSettings(), TrackingSettings(), Monitor()).xy_px


def pyramid(frames: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    path, now = [start], start.astype(np.float32)[:, None]
    images = [f.astype(np.uint8) for f in frames]
    for a, b in zip(images, images[1:]):
        now, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, now, None, winSize=(PATCH, PATCH), maxLevel=2)
        now = np.where(ok[:, None] > 0, now, np.nan).astype(np.float32)
        path.append(now[:, 0].astype(float))
    return np.array(path)


def loop(frames: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    """Frame to frame, affine, each point by itself, from where it would be without motion corrected by the truth's whole pixels."""
    path, h = [start.copy()], PATCH // 2
    for i, (a, b) in enumerate(zip(frames, frames[1:])):
        now = np.full_like(start, np.nan)
        own = (path[-1] - motion(i)[1]) @ np.linalg.inv(motion(i)[0]).T
        guess = np.rint(own @ motion(i + 1)[0].T + motion(i + 1)[1])
        for n, (p, g) in enumerate(zip(path[-1], guess)):
            if not np.isfinite(p).all():
                continue
            q, c = np.rint(p).astype(int), g.astype(int)
            template = a[q[1] - h : q[1] + h + 1, q[0] - h : q[0] + h + 1]
            around = b[c[1] - h - 4 : c[1] + h + 5, c[0] - h - 4 : c[0] + h + 5]
            if template.shape != (PATCH, PATCH) or around.shape != (PATCH + 8, PATCH + 8):
                continue
            warp = np.array([[1, 0, 4], [0, 1, 4]], dtype=np.float32)
            try:
                _, warp = cv2.findTransformECC(template, around, warp, cv2.MOTION_AFFINE, (3, 20, 1e-4), None, 1)
            except cv2.error:
                continue
            now[n] = warp @ np.array([*(p - q + h), 1.0]) + c - h - 4
        path.append(now)
    return np.array(path)


def three_views(frames: list[np.ndarray], start: np.ndarray) -> float:
    """CPU seconds of one whole step in three views, without reading and preparing the images."""
    from tricap.core.geometry.camera import Camera

    cameras = tuple(
        Camera(
            name=name,
            size_px=SIZE,
            matrix=np.array([[900.0, 0, SIZE[0] / 2 + 900 * x / 2], [0, 900.0, SIZE[1] / 2], [0, 0, 1]]),
            t_cam_world_m=np.array([-x, 0, 0]),
        )
        for name, x in (("L", -0.3), ("C", 0.0), ("R", 0.3))
    )  # to all three a plane at 2 m looks the same
    view = TrackingView(
        cameras=cameras, reference=1, field_layout=FieldLayout(), matching=MatchingSettings(), tracking=TrackingSettings(), limit_px=1.0
    )
    image, after, n = SplineImage(frames[0]), SplineImage(frames[1]), len(start)
    A, b = motion(1)
    ahead = (start - motion(0)[1]) @ np.linalg.inv(motion(0)[0]).T @ A.T + b
    current = born(0, np.arange(n), np.repeat(start[:, None], 3, axis=1), np.tile(np.eye(2), (n, 3, 1, 1)),
                   cameras[1].points_at_depth(start, 2.0), np.tile(np.eye(3) * 1e-6, (n, 1, 1)))  # fmt: skip
    how = view.matching, 1
    templates = no_templates(*how).with_tiles(cut_tiles(image, np.arange(n), start, *how), *how)
    pair = FramePair(grey=[frames[0]] * 3, spline=[image] * 3, next_grey=[frames[1]] * 3, next_spline=[after] * 3)
    back = replace(current, xyz_m=cameras[1].points_at_depth(2 * start - ahead, 2.0))
    begin = time.process_time()
    step = track_step(view, back, current, templates, pair, 1, Monitor())
    assert len(step.identity) > 0.9 * n
    return time.process_time() - begin


def in_turns(frames: list[np.ndarray], many: np.ndarray, few: np.ndarray) -> dict[str, float]:
    """The step's speed and its ratios to the peers': medians of seven rounds in which each is timed in turn."""
    rounds = []
    for _ in range(7):
        before = three_views(frames, many)
        lk, ecc = (timed(*peer)["points_frames_per_cpu_s"] for peer in ((pyramid, frames[:6], many), (loop, frames[:4], few)))
        step = 2 * len(many) / (before + three_views(frames, many))
        rounds.append((step, 3 * step / lk, 5 * step / ecc))
    names = ("points_per_cpu_s", "of PyrLK's speed per view", "times an ECC loop over the same five matches a point")
    return dict(zip(names, np.median(rounds, axis=0).tolist()))


def timed(method: object, frames: list[np.ndarray], start: np.ndarray) -> dict[str, float]:
    begin = time.process_time()
    path = method(frames, start)  # type: ignore[operator]
    return judged(path, start, time.process_time() - begin)


def judged(path: np.ndarray, start: np.ndarray, seconds: float) -> dict[str, float]:
    return {"points_frames_per_cpu_s": len(start) * (len(path) - 1) / seconds, **score(path, start)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    frames = film()
    many, few = points(9), points(40)
    results: dict[str, object] = {
        "ours, 2-D mode": timed(ours, frames, many),
        "PyrLK": timed(pyramid, frames, many),
        "ECC loop": timed(loop, frames[:6], few),
    }
    results["CPU s of a step in three views"] = {str(len(p)): three_views(frames, p) for p in (points(20), points(14), points(10))}
    results["a step in three views"] = in_turns(frames, many, few)
    blender = blender_tracks(frames, few)
    results["Blender's tracker"] = "not compared: this Python has no bpy module" if blender is None else judged(blender[0], few, blender[1])
    results["ours, the same points as Blender's"] = timed(ours, frames, few)
    memory, seconds = [], {}
    for count in (6, 12, 24):
        begin = time.process_time()
        ours(frames[:count], few)
        seconds[str(count)] = time.process_time() - begin
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    results["CPU s of 2-D mode by frames"] = seconds
    results["largest memory after 6, 12, 24 frames, MB"] = memory
    for name, value in results.items():
        print(f"{name}: {value}")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
