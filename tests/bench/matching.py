"""Least squares matching beside its peers, all in one run on one synthetic pair whose warp is known exactly.

    python dev.py bench matching [--json FILE]

Times are medians of several runs. The bound is Cramér and Rao's for eight parameters, from the gradients of the pictures without noise.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from tricap.core.foundation import threads as shared
from tricap.core.foundation.progress import Monitor
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.least_squares import MatchingSettings, SearchImage, TemplatePoints, match_patches
from tricap.core.matching.patches import patch_offsets
from tricap.core.results.folder import Results
from tricap.core.run.take_run import settings_of
from tricap.core.surface.measure import measure_frames
from tricap.core.surface.starts import MeasureSettings
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

SHAPE, SPACING, NOISE, RUNS, FINE, BORDER = (576, 768), 4, 2.0, 7, 4, 24
START_ERROR_PX = 0.5
ECC_POINTS, PLAIN_POINTS = 800, 150


class Pair:
    """Speckle g, and f(x) = g(x + d(x)) with a smooth d of up to 3 px; both with noise of 2 grey values."""

    def __init__(self, seed: int = 1) -> None:
        random = np.random.default_rng(seed)
        h, w = SHAPE
        dots = random.choice([-1.0, 1.0], ((h + 2 * BORDER) * FINE, (w + 2 * BORDER) * FINE))
        texture = gaussian_filter(dots, 1.6 * FINE)
        self._spline = spline_filter(texture / texture.std() * 45, 5)
        y, x = np.mgrid[:h, :w].astype(float)
        self.warp = np.stack([2 * np.sin(x / 150) + np.cos(y / 110), 1.5 * np.cos(x / 130)], axis=-1)
        self.pure = self._value(x, y)
        step = 1e-3
        self.gradient = [
            (self._value(x + step, y) - self._value(x - step, y)) / (2 * step),
            (self._value(x, y + step) - self._value(x, y - step)) / (2 * step),
        ]
        self.f = self.pure + random.normal(size=SHAPE) * NOISE
        self.g = self._texture(x, y) + random.normal(size=SHAPE) * NOISE
        j, i = np.mgrid[20 : h - 20 : SPACING, 20 : w - 20 : SPACING]
        self.xy = np.stack([i.ravel(), j.ravel()], axis=1).astype(float)
        self.true = self.xy + self.warp[j.ravel(), i.ravel()]
        self.start = self.true + random.uniform(-START_ERROR_PX, START_ERROR_PX, self.true.shape)

    def _texture(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return map_coordinates(self._spline, [(y + BORDER) * FINE, (x + BORDER) * FINE], order=5, prefilter=False) + 128

    def _value(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._texture(x + 2 * np.sin(x / 150) + np.cos(y / 110), y + 1.5 * np.cos(x / 130))

    def bound(self, patch_px: int) -> float:
        """RMS over the points of the least standard deviation of x and y [px]."""
        half, variances = patch_px // 2, []
        u, v, _ = patch_offsets(patch_px, 1)
        for x, y in self.xy[::29].astype(int):
            part = np.s_[y - half : y + half + 1, x - half : x + half + 1]
            a, b, f = (image[part].ravel() for image in (*self.gradient, self.pure))
            J = np.stack([a, a * u, a * v, b, b * u, b * v, np.ones_like(a), f], axis=1)
            variances += list(np.linalg.inv(J.T @ J)[[0, 3], [0, 3]] * 2 * NOISE**2)
        return float(np.sqrt(np.mean(variances)))


def timed(*works: Callable[[], object]) -> list[float]:
    """Median seconds of each, of several rounds after one to warm up. They take turns: what else the machine does meets all alike."""
    seconds: list[list[float]] = [[] for _ in works]
    for _ in range(RUNS + 1):
        for work, taken in zip(works, seconds):
            began = time.perf_counter()
            work()
            taken.append(time.perf_counter() - began)
    return [statistics.median(taken[1:]) for taken in seconds]


def rms(xy: np.ndarray, true: np.ndarray, ok: np.ndarray) -> float:
    return float(np.sqrt(np.mean((xy - true)[ok] ** 2)))


Work = Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]  # positions, which were found, covariances


def our_work(pair: Pair, patch_px: int, threads: int, points: int | None = None) -> Work:
    F, G = SplineImage(pair.f), SplineImage(pair.g)
    settings, rows = MatchingSettings(patch_px=patch_px, max_shift_px=5.0), slice(0, points)
    shape = np.tile(np.eye(2), (len(pair.xy), 1, 1))

    def work() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shared.THREADS = threads
        cv2.setNumThreads(threads)
        search = SearchImage(image=G, start=pair.start[rows], shape=shape[rows])
        found = match_patches(TemplatePoints(image=F, xy=pair.xy[rows]), [search], settings)[0]
        shared.THREADS = 2
        cv2.setNumThreads(-1)
        return found.xy, found.ok, found.covariance

    return work


def ours(pair: Pair, patch_px: int, threads: int, points: int | None = None, seconds: float | None = None) -> dict[str, object]:
    work, rows = our_work(pair, patch_px, threads, points), slice(0, points)
    xy, ok, K = work()
    z = (xy - pair.true[rows])[ok] / np.sqrt(K[ok][:, [0, 1], [0, 1]])
    return row(
        f"Tricap {patch_px}×{patch_px}, {threads} thread(s)",
        len(xy) / (seconds or timed(work)[0]),
        rms(xy, pair.true[rows], ok),
        pair.bound(patch_px),
        1 - ok.mean(),
        z_rms=float(np.sqrt(np.mean(z**2))),
        points=len(xy),
    )


def pyramid_work(pair: Pair, levels: int, threads: int) -> Work:
    f, g = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (pair.f, pair.g))
    start = pair.xy.astype(np.float32)

    def work() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        cv2.setNumThreads(threads)
        xy, status, _ = cv2.calcOpticalFlowPyrLK(f, g, start, None, winSize=(13, 13), maxLevel=levels - 1, criteria=(3, 20, 0.01))
        cv2.setNumThreads(-1)
        return xy, status.ravel() == 1, np.zeros((0, 2, 2))

    return work


def lucas_kanade(pair: Pair, levels: int, threads: int, seconds: float) -> dict[str, object]:
    xy, ok, _ = pyramid_work(pair, levels, threads)()
    return row(
        f"cv2.calcOpticalFlowPyrLK 13×13, {levels} levels, {threads} thread(s)",
        len(xy) / seconds,
        rms(xy, pair.true, ok),
        pair.bound(13),
        1 - ok.mean(),
    )


def race(pair: Pair) -> list[dict[str, object]]:
    """Ours and OpenCV's pyramid on one thread and on two, in turns."""
    own, pyramids = (1, 2), ((3, 1), (3, 2), (1, 1))
    seconds = timed(*(our_work(pair, 13, t) for t in own), *(pyramid_work(pair, levels, t) for levels, t in pyramids))
    rows = [ours(pair, 13, t, seconds=s) for t, s in zip(own, seconds)]
    return rows + [lucas_kanade(pair, levels, t, s) for (levels, t), s in zip(pyramids, seconds[len(own) :])]


def correlation_coefficient(pair: Pair) -> dict[str, object]:
    """cv2.findTransformECC, a loop over points, affine, started like ours."""
    f, g = pair.f.astype(np.float32), pair.g.astype(np.float32)
    chosen = np.linspace(0, len(pair.xy) - 1, ECC_POINTS).astype(int)
    xy, ok = np.full((len(chosen), 2), np.nan), np.zeros(len(chosen), dtype=bool)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 1e-4)
    began = time.perf_counter()
    for n, i in enumerate(chosen):
        (x, y), corner = pair.xy[i].astype(int), np.rint(pair.start[i]).astype(int) - 12
        template = f[y - 6 : y + 7, x - 6 : x + 7]
        search = g[corner[1] : corner[1] + 25, corner[0] : corner[0] + 25]
        shift = pair.start[i] - corner - 6
        try:
            _, M = cv2.findTransformECC(
                template, search, np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32), cv2.MOTION_AFFINE, criteria, None, 1
            )
        except cv2.error:
            continue  # it throws where it does not converge: the point is lost
        xy[n], ok[n] = M @ (6, 6, 1) + corner, True
    seconds = time.perf_counter() - began
    return row(
        "cv2.findTransformECC 13×13, affine, per point",
        len(chosen) / seconds,
        rms(xy, pair.true[chosen], ok),
        pair.bound(13),
        1 - ok.mean(),
    )


def plain(pair: Pair) -> dict[str, object]:
    """The published form: one point after the other, forward, eight parameters, cubic resampling."""
    chosen = np.linspace(0, len(pair.xy) - 1, PLAIN_POINTS).astype(int)
    spline = spline_filter(pair.g, 3)
    v, u = np.mgrid[-6:7, -6:7].astype(float)
    xy, ok = np.zeros((len(chosen), 2)), np.zeros(len(chosen), dtype=bool)
    began = time.perf_counter()
    for n, i in enumerate(chosen):
        x, y = pair.xy[i].astype(int)
        f = pair.f[y - 6 : y + 7, x - 6 : x + 7].ravel()
        p = np.array([pair.start[i][0], 1, 0, pair.start[i][1], 0, 1, 0, 1.0])
        for _ in range(20):
            X, Y = p[0] + p[1] * u + p[2] * v, p[3] + p[4] * u + p[5] * v
            g, gx, gy = (map_coordinates(spline, [Y + b, X + a], order=3, prefilter=False) for a, b in ((0, 0), (0.5, 0), (0, 0.5)))
            gx, gy = (
                (gx - map_coordinates(spline, [Y, X - 0.5], order=3, prefilter=False)),
                (gy - map_coordinates(spline, [Y - 0.5, X], order=3, prefilter=False)),
            )
            A = np.stack(
                [p[7] * gx, p[7] * gx * u, p[7] * gx * v, p[7] * gy, p[7] * gy * u, p[7] * gy * v, np.ones_like(g), g], axis=-1
            ).reshape(-1, 8)
            step = np.linalg.lstsq(A, f - (p[6] + p[7] * g.ravel()), rcond=None)[0]
            p += step
            if np.hypot(step[0], step[3]) < 0.01:
                ok[n] = True
                break
        xy[n] = p[[0, 3]]
    seconds = time.perf_counter() - began
    return row(
        "published form, per point (numpy, scipy)", len(chosen) / seconds, rms(xy, pair.true[chosen], ok), pair.bound(13), 1 - ok.mean()
    )


def triplet() -> dict[str, object]:
    """A dense triplet end to end, reading included: seeds, growth, intersection, filters, cloud."""
    with tempfile.TemporaryDirectory() as folder:
        make_arm_take(Path(folder, "take"), ArmTakeSettings(frames=2))
        footage = open_take(read_take(Path(folder, "take")))
        s = settings_of({}, {}, "bench")
        began, points, results = time.perf_counter(), 0, Results(Path(folder, "out"))
        for measured in measure_frames(footage, replace(MeasureSettings.of(s), enhance=None), results, Monitor()):
            points += len(measured.cloud.xyz_m)
        return dict(tool="dense triplet of 768×576, end to end", points=points // 2, seconds_per_frame=(time.perf_counter() - began) / 2)


def row(tool: str, rate: float, error: float, bound: float, lost: float, **more: object) -> dict[str, object]:
    return dict(
        tool=tool, points_per_s=round(rate), rms_px=round(error, 5), over_bound=round(error / bound, 3), lost=round(float(lost), 4), **more
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    pair = Pair()
    rows = [
        *race(pair),
        correlation_coefficient(pair),
        plain(pair),
        *(ours(pair, size, 1) for size in (9, 17, 21, 25)),
        *(ours(pair, 13, 1, n) for n in (1000, 3000, 10_000)),
        triplet(),
    ]
    for entry in rows:
        sys.stdout.write("  ".join(f"{k} {v}" if k != "tool" else f"{v:<58}" for k, v in entry.items()) + "\n")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
