"""Bright targets of the bar in an image, measured by least squares matching, and tracked through the images of a view.

    x̄ = Σ (g − T) x / Σ (g − T)                                                (1)   centroid of a blob (D'Apuzzo et al. 2000, §2.2)
    q = | B (x − c) | ,   g(x) + e = g0 + g1 Φ(ρ (1 − q))                       (2)   an ellipse with a soft edge, Φ: normal distribution

(2) is matched by Gauss–Newton with an analytic Jacobian for many targets at once; unknowns c (2), B (3, symmetric), ρ, g0, g1. A saturated
target only has a flat top, which (2) models as well. The sigma of c comes from the adjustment. Images are those of `images.sequence`: grey
values 0…255. Coordinates are pixels of the given image.

Which two of the bright spots are the targets is decided over the whole sequence by dynamic programming (Viterbi 1967). A state of a frame
is an ordered pair of spots, or none; the cheapest sequence of states wins:

    cost of a state = difference of the areas + area below the largest          (3)
    cost of a step  = (path of both targets / expected path)², at most a jump   (4)

Spots that stay in place while others move are reflections and lamps. Where only one target is visible, it keeps its place in the pair.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import permutations

import cv2
import numpy as np

from ..foundation.arrays import frozen
from ..geometry.robust import MAD_TO_SIGMA, mad_sigma

MIN_CONTRAST = 30.0  # grey values between a target's peak and the background
FIRST_CONTRAST = 0.7  # of MIN_CONTRAST: lowest threshold above the background
RELATIVE_THRESHOLD = 0.5  # of a blob's contrast, at which it is outlined
HIGHER_THRESHOLDS = (0.65, 0.8, 0.9)  # where the blob is not compact: targets joined by a bright bar
BRIGHTNESS = 0.35  # of the contrast of the brightest blob that a target has at least
MIN_AREA = 4  # px
MAX_AREA_PART = 0.02  # of the image
MIN_FILL = 0.72  # of the ellipse with the same second moments
MAX_ELONGATION = 3.5
PEAK_PX = 5  # brightest pixels of a blob, whose mean is its peak
MOST_BLOBS = 64  # of an image
MOST_PARTS = 8  # of a blob
WINDOW_SIDES = (9, 13, 19, 27, 39, 57, 83, 121)  # px
ITERATIONS = 16
CONVERGED_PX = 1e-3  # step of the centre
MOST_STEP_PX = 1.5  # of the centre
SETTLED = 5  # iterations after which the outline of the target is known
SECTORS = 24  # of a ring around the target
RING_PX = 3.0  # width of the ring
TOUCHES = 0.015  # of g1: a sector that is brighter than the background by more touches something, such as the bar
MOST_TOUCHED = 0.4  # of the sectors; more means another background
ROBUST = 3.0  # sigmas of the grey values
LEAST_NOISE = 0.3 * MAD_TO_SIGMA  # grey values; the MAD of rounding to whole ones is 0.25
MAX_MISFIT = 0.08  # RMS of the grey values as a part of g1

MOST_SPOTS = 6  # of a frame
STATIC_PX = 1.5  # a spot at the same place within this distance …
STATIC_PART = 0.5  # … in more than this part of the frames is static
STATIC_TARGETS = 0.2  # part of the frames with two moving spots below which the bar itself is static
MIN_STATIC_FRAMES = 8
STATIC_SAMPLES = 80  # frames that are compared, however long the sequence is
EXPECTED_PATH = 0.05  # of the image width, from frame to frame
SMALLEST_WIDTH = 0.6  # of the targets' expected width
JUMP = 6.0  # cost of (4) at most
NO_PAIR = 8.0  # cost of a frame without a pair
LIKE_AREAS = 1.0  # weight of the difference of the areas in (3)
LARGE = 1.0  # weight of the areas below the largest in (3)
GATE = 0.03  # of the image width: distance of a single target from its expected position
MOST_GAP = 3  # frames over which a position is interpolated


class TargetStatus(IntEnum):
    """Whether the position of a target can be used, and why not."""

    OK = 0
    CROPPED = 1  # its window extends beyond the image
    NOT_CONVERGED = 2
    NO_DISC = 3  # it is no disc: merged with another one, or partly occluded


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Targets:
    """M blobs of one image. Pixels of that image."""

    xy_px: np.ndarray  # (M, 2)
    sigma_px: np.ndarray  # (M,) of a coordinate, from the match
    area_px: np.ndarray  # (M,)
    contrast: np.ndarray  # (M,) grey values
    status: np.ndarray  # (M,) TargetStatus

    def __post_init__(self) -> None:
        M = len(self.xy_px)
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (M, 2), name="xy_px"))
        for name, dtype in (("sigma_px", np.float64), ("area_px", np.float64), ("contrast", np.float64), ("status", np.int8)):
            object.__setattr__(self, name, frozen(getattr(self, name), (M,), dtype, name))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Blobs:
    """Outlines at half contrast: centroid (M, 2) of (1), widths along x and y (M, 2), area and contrast (M,), background grey value."""

    xy_px: np.ndarray
    width_px: np.ndarray
    area_px: np.ndarray
    contrast: np.ndarray
    background: float


def find_targets(image: np.ndarray, mask: np.ndarray | None = None) -> Targets:
    """Find and measure the bright round targets of an image (h, w) float32 0…255; `mask` (h, w) is False where there can be none."""
    background = background_of(image)
    return match_discs(image, find_blobs(image if mask is None else np.where(mask, image, np.float32(background))))


def background_of(image: np.ndarray) -> float:
    """The grey value of most of the image."""
    return float(np.median(image[:: max(1, image.shape[0] // 200), :: max(1, image.shape[1] // 200)]))


def find_blobs(image: np.ndarray) -> Blobs:
    """Compact bright blobs, the largest and brightest first, at most `MOST_BLOBS`."""
    background = background_of(image)
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8)
    highest = float(smooth.max()) - background
    rows = []
    if highest >= MIN_CONTRAST:
        threshold = background + max(FIRST_CONTRAST * MIN_CONTRAST, RELATIVE_THRESHOLD * BRIGHTNESS * highest)
        count, labels, statistics, _ = cv2.connectedComponentsWithStats((smooth > threshold).astype(np.uint8), connectivity=8)
        by_area = 1 + np.argsort(-statistics[1:count, cv2.CC_STAT_AREA])[: 4 * MOST_BLOBS]
        for n in by_area[statistics[by_area, cv2.CC_STAT_AREA] <= MAX_AREA_PART * image.size]:
            x, y, w, h, _ = statistics[n]
            for row in _outlines(image[y : y + h, x : x + w], labels[y : y + h, x : x + w] == n, background):
                if row[4] >= BRIGHTNESS * highest:
                    rows.append((row[0] + x, row[1] + y, *row[2:]))
    table = np.array(sorted(rows, key=lambda r: -r[4] * r[5])[:MOST_BLOBS], dtype=np.float64).reshape(-1, 6)
    return Blobs(xy_px=table[:, :2], width_px=table[:, 2:4], area_px=table[:, 5], contrast=table[:, 4], background=background)


def _outlines(grey: np.ndarray, inside: np.ndarray, background: float) -> list[tuple[float, ...]]:
    """The compact parts of a bright area: the area itself, or its parts at a higher threshold."""
    whole = _outlined(grey, inside, background, RELATIVE_THRESHOLD)
    if whole is not None:
        return [whole]
    contrast, best = float(grey[inside].max()) - background, list[tuple[float, ...]]()
    for threshold in HIGHER_THRESHOLDS:
        count, parts = cv2.connectedComponents((inside & (grey > background + threshold * contrast)).astype(np.uint8), connectivity=4)
        found = [_outlined(grey, parts == n, background, threshold) for n in range(1, min(count, MOST_PARTS + 1))]
        compact = [row for row in found if row is not None]
        if len(compact) > max(1, len(best)):
            best = compact
    return best


def _outlined(grey: np.ndarray, inside: np.ndarray, background: float, threshold: float) -> tuple[float, ...] | None:
    """Centroid x y, widths along x and y, contrast and area within the outline at that part of the contrast; None if not compact.  (1)"""
    peak = np.sort(grey[inside])[-min(PEAK_PX, int(inside.sum())) :].mean()
    contrast = float(peak) - background
    core = inside & (grey > background + threshold * contrast)
    area = int(core.sum())
    if area < MIN_AREA:
        return None
    y, x = np.nonzero(core)
    weight = grey[core].astype(np.float64) - background - threshold * contrast
    spread = np.cov(np.stack([x, y]).astype(np.float64), ddof=0) + np.eye(2) / 12
    small, large = np.sqrt(np.linalg.eigvalsh(spread))
    if large > MAX_ELONGATION * small or area < MIN_FILL * 4 * np.pi * small * large:
        return None
    width = 4 * np.sqrt(np.diag(spread))
    return float(np.average(x, weights=weight)), float(np.average(y, weights=weight)), float(width[0]), float(width[1]), contrast, area


def match_discs(image: np.ndarray, blobs: Blobs) -> Targets:
    """Least squares matching (2) of all blobs in their windows."""
    M = len(blobs.xy_px)
    xy, sigma, status = blobs.xy_px.copy(), np.full(M, np.nan), np.full(M, TargetStatus.CROPPED, dtype=np.int8)
    need = 1.35 * blobs.width_px.max(axis=1, initial=0) + 6
    side = np.array(WINDOW_SIDES)[np.minimum(np.searchsorted(WINDOW_SIDES, need), len(WINDOW_SIDES) - 1)]
    h, w = image.shape
    corner = np.round(xy).astype(int) - side[:, None] // 2
    inside = (corner >= 0).all(axis=1) & (corner + side[:, None] <= [w, h]).all(axis=1) & (need <= WINDOW_SIDES[-1])
    for size in np.unique(side[inside]):
        rows = np.flatnonzero(inside & (side == size))
        windows = np.stack([image[y : y + size, x : x + size] for x, y in corner[rows]]).astype(np.float64)
        start = np.concatenate([xy[rows] - corner[rows], blobs.width_px[rows], blobs.contrast[rows, None]], axis=1)
        at, sigma[rows], status[rows] = _matched(windows, start, blobs.background)
        xy[rows] = at + corner[rows]
    return Targets(xy_px=xy, sigma_px=sigma, area_px=blobs.area_px, contrast=blobs.contrast, status=status)


def _matched(windows: np.ndarray, start: np.ndarray, background: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (m, 2) in windows (m, n, n), their sigmas and status; `start` holds x, y, widths and contrast (m, 5).  (2)"""
    m, n, _ = windows.shape
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2).astype(np.float64)
    grey = windows.reshape(m, -1)
    B = 2 / np.maximum(start[:, 2:4], 1.0)
    p = np.stack(
        [start[:, 0], start[:, 1], B[:, 0], B[:, 0] * 0, B[:, 1], 1.4 / B.mean(axis=1), np.full(m, background), start[:, 4]], axis=1
    )
    reach = np.hypot((grid[:, 0] - p[:, 0, None]) * p[:, 2, None], (grid[:, 1] - p[:, 1, None]) * p[:, 4, None])
    near = reach < 1.12 + 1.5 / np.sqrt(p[:, 5, None])  # pixels further out, such as those of the other target, are not used
    active, converged = np.arange(m), np.zeros(m, dtype=bool)
    covariance, sigma0, misfit = np.full((m, 2), np.inf), np.full(m, np.inf), np.full(m, np.inf)
    for iteration in range(ITERATIONS):
        if iteration == SETTLED:
            near &= ~_touched(p, grid, grey)
            active, converged[:] = np.flatnonzero(np.isfinite(p).all(axis=1)), False
        v, J = _disc(p[active], grid, grey[active])
        misfit[active] = np.sqrt(np.sum(v * v * near[active], axis=1) / np.maximum(near[active].sum(axis=1) - 8, 1))
        noise = np.maximum(mad_sigma(v, 1, near[active]), LEAST_NOISE)[:, None]
        weight = near[active] / (1 + (v / (ROBUST * noise)) ** 2)  # outliers: the bar
        J *= weight[:, :, None] ** 0.5
        v *= weight**0.5
        N = J.transpose(0, 2, 1) @ J
        N = N + np.eye(8) * (1e-4 * np.einsum("mii->mi", N)[:, :, None] + 1e-9)
        step = np.linalg.solve(N, np.einsum("mki,mk->mi", J, v)[..., None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -MOST_STEP_PX, MOST_STEP_PX)
        p[active] += step
        p[active, 5] = np.maximum(p[active, 5], 0.3)
        freedom = np.maximum(near[active].sum(axis=1) - 8, 1)
        sigma0[active] = np.sqrt(np.sum(v * v, axis=1) / freedom)
        covariance[active] = np.einsum("mii->mi", np.linalg.inv(N))[:, :2]
        moving = np.abs(step[:, :2]).max(axis=1) >= CONVERGED_PX
        converged[active[~moving]] = True
        active = active[moving & np.isfinite(p[active]).all(axis=1)]
        if not len(active) and iteration >= SETTLED:
            break
    bad = ~converged | (np.abs(p[:, :2] - start[:, :2]) > 0.25 * start[:, 2:4] + 1.0).any(axis=1)
    status = np.where(bad, TargetStatus.NOT_CONVERGED, np.where(misfit > MAX_MISFIT * p[:, 7], TargetStatus.NO_DISC, TargetStatus.OK))
    return np.where(bad[:, None], start[:, :2], p[:, :2]), sigma0 * np.sqrt(covariance.mean(axis=1)), status.astype(np.int8)


def _touched(p: np.ndarray, grid: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Pixels (m, k) in the directions in which something bright touches the target, such as the bar, and would shift its centre.

    The directions are those in which a ring outside the target is brighter than the background.
    """
    ux, uy = grid[:, 0] - p[:, 0, None], grid[:, 1] - p[:, 1, None]
    q = np.hypot(p[:, 2, None] * ux + p[:, 3, None] * uy, p[:, 3, None] * ux + p[:, 4, None] * uy)
    step = 0.5 * (p[:, 2] + p[:, 4])[:, None]  # q per pixel
    inner = 1 + 2.2 / np.maximum(p[:, 5, None], 1.0)
    ring = (q > inner) & (q < inner + RING_PX * step)
    sector = ((np.arctan2(uy, ux) / (2 * np.pi)) % 1.0 * SECTORS).astype(int) % SECTORS
    flat = (np.arange(len(p))[:, None] * SECTORS + sector)[ring]
    count = np.bincount(flat, minlength=len(p) * SECTORS).reshape(-1, SECTORS)
    total = np.bincount(flat, weights=(grey - p[:, 6, None])[ring], minlength=len(p) * SECTORS).reshape(-1, SECTORS)
    mean = np.nan_to_num(total / np.maximum(count, 1))  # NaN of a match that diverged
    level = np.median(mean, axis=1, keepdims=True)
    spread = mad_sigma(mean - level, 1)[:, None]
    bright = (count > 0) & (mean - level > np.maximum(TOUCHES * p[:, 7, None], 4 * spread))
    bright[bright.mean(axis=1) > MOST_TOUCHED] = False
    bright |= np.roll(bright, 1, axis=1) | np.roll(bright, -1, axis=1)
    return np.take_along_axis(bright, sector, axis=1) & (q > 0.5)


def _disc(p: np.ndarray, grid: np.ndarray, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observed − computed (m, k) of (2) and its Jacobian (m, k, 8) at parameters (m, 8)."""
    from scipy.special import ndtr

    cx, cy, b11, b12, b22, rho, g0, g1 = p.T[:, :, None]
    ux, uy = grid[:, 0] - cx, grid[:, 1] - cy
    wx, wy = b11 * ux + b12 * uy, b12 * ux + b22 * uy
    q = np.sqrt(wx * wx + wy * wy + 1e-12)
    z = rho * (1 - q)
    inside = ndtr(z)
    density = g1 * np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    by_q = -density * rho / q
    J = np.empty((*q.shape, 8))
    J[..., 0], J[..., 1] = -by_q * (b11 * wx + b12 * wy), -by_q * (b12 * wx + b22 * wy)
    J[..., 2], J[..., 3], J[..., 4] = by_q * wx * ux, by_q * (wx * uy + wy * ux), by_q * wy * uy
    J[..., 5], J[..., 6], J[..., 7] = density * (1 - q), 1.0, inside
    return grey - (g0 + g1 * inside), J


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarTrack:
    """The targets of the bar in one view: `xy_px` (T, 2, 2), NaN: not visible; in the same order over time, not between views."""

    xy_px: np.ndarray
    spots: np.ndarray  # (T,) number of spots found
    static: bool  # the spots do not move

    def __post_init__(self) -> None:
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (None, 2, 2), name="xy_px"))
        object.__setattr__(self, "spots", frozen(self.spots, (len(self.xy_px),), np.int64, "spots"))


def track_bar(frames: Sequence[Targets], width_px: float, diameter: float = 0.0) -> BarTrack:
    """The two targets of the bar through the frames of one view.

    `diameter` of the targets relative to the length of the bar: only the bar is foreshortened, so no true pair is smaller.
    """
    spots = np.array([len(t.xy_px) for t in frames])
    usable = [np.flatnonzero(t.status == TargetStatus.OK) for t in frames]
    moving = _moving(frames, usable)
    two = np.mean([len(m) >= 2 for m in moving]) if len(frames) else 0.0
    static = bool(two < STATIC_TARGETS * np.mean([len(u) >= 2 for u in usable])) if len(frames) else False
    chosen = usable if static else moving
    xy = [t.xy_px[c[:MOST_SPOTS]] for t, c in zip(frames, chosen)]
    area = [t.area_px[c[:MOST_SPOTS]] for t, c in zip(frames, chosen)]
    track = _in_one_order(_best_sequence(xy, area, width_px, diameter))
    return BarTrack(xy_px=_with_singles(track, xy, width_px), spots=spots, static=static)


def moved_targets(frames: Sequence[Targets]) -> int:
    """How many targets of the last frame have moved since the frame before."""
    xy = frames[-1].xy_px[frames[-1].status == TargetStatus.OK]
    if len(frames) < 2 or not len(frames[-2].xy_px):
        return len(xy)
    return int((np.linalg.norm(xy[:, None] - frames[-2].xy_px[None], axis=2).min(axis=1) >= STATIC_PX).sum())


def _moving(frames: Sequence[Targets], usable: list[np.ndarray]) -> list[np.ndarray]:
    """Indices of the spots that are not static."""
    if len(frames) < MIN_STATIC_FRAMES:
        return usable
    points = np.concatenate([t.xy_px[u] for t, u in zip(frames, usable)])
    counts = np.zeros(len(points), dtype=int)
    sampled = np.unique(np.linspace(0, len(frames) - 1, STATIC_SAMPLES).astype(int))
    for xy in (frames[n].xy_px[usable[n]] for n in sampled):
        if len(xy):
            counts += ((points[:, None] - xy[None]) ** 2).sum(axis=2).min(axis=1) < STATIC_PX**2
    static = np.split(counts > STATIC_PART * len(sampled), np.cumsum([len(u) for u in usable])[:-1])
    return [u[~s] for u, s in zip(usable, static)]


def _best_sequence(xy: list[np.ndarray], area: list[np.ndarray], width_px: float, diameter: float) -> np.ndarray:
    """The cheapest ordered pairs (T, 2, 2), NaN where there is none.  (3), (4)"""
    states = [_pairs(points, size, diameter) for points, size in zip(xy, area)]
    total = np.zeros(1)
    back: list[np.ndarray] = []
    before = np.zeros((0, 2, 2))
    for points, size, pairs in zip(xy, area, states):
        here = points[np.array(pairs, dtype=int).reshape(-1, 2)]
        step = np.full((len(before) + 1, len(here) + 1), JUMP / 2)
        path = np.linalg.norm(before[:, None] - here[None], axis=3) / (EXPECTED_PATH * width_px)
        step[:-1, :-1] = np.minimum(np.sum(path**2, axis=2), JUMP)
        cost = total[:, None] + step
        back.append(np.argmin(cost, axis=0))
        total = cost.min(axis=0) + np.append(_own_cost(size, pairs), NO_PAIR)
        before = here
    track = np.full((len(xy), 2, 2), np.nan)
    state = int(np.argmin(total))
    for n in range(len(xy) - 1, -1, -1):
        if state < len(states[n]):
            track[n] = xy[n][list(states[n][state])]
        state = int(back[n][state])
    return track


def _pairs(xy: np.ndarray, area: np.ndarray, diameter: float) -> list[tuple[int, int]]:
    """Ordered pairs of spots that are not too small for their distance, for targets of that part of the length of the bar."""
    width = 2 * np.sqrt(area / np.pi)
    return [
        (i, j)
        for i, j in permutations(range(len(xy)), 2)
        if min(width[i], width[j]) >= SMALLEST_WIDTH * diameter * np.linalg.norm(xy[i] - xy[j])
    ]


def _in_one_order(track: np.ndarray) -> np.ndarray:
    """The track with pairs swapped where that makes the path across a gap shorter."""
    ordered = track.copy()
    known = np.flatnonzero(np.isfinite(track).all(axis=(1, 2)))
    for before, n in zip(known[:-1], known[1:]):
        straight, crossed = (np.linalg.norm(pair - ordered[before], axis=1).sum() for pair in (ordered[n], ordered[n, ::-1]))
        if crossed < straight:
            ordered[n] = ordered[n, ::-1].copy()
    return ordered


def _own_cost(size: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    if not pairs:
        return np.zeros(0)
    both = np.log(size[np.array(pairs)])
    return LIKE_AREAS * np.abs(both[:, 0] - both[:, 1]) + LARGE * (np.log(size.max()) - both).sum(axis=1)


def _with_singles(track: np.ndarray, xy: list[np.ndarray], width_px: float) -> np.ndarray:
    """The track with single targets added near their expected positions where the other target is not visible."""
    full = np.isfinite(track).all(axis=(1, 2))
    known = np.flatnonzero(full)
    filled = track.copy()
    for n in np.flatnonzero(~full):
        earlier, later = known[known < n], known[known > n]
        if not len(earlier) or not len(later) or later[0] - earlier[-1] > MOST_GAP or not len(xy[n]):
            continue
        a, b = earlier[-1], later[0]
        expected = track[a] + (track[b] - track[a]) * (n - a) / (b - a)
        distance = np.linalg.norm(expected[:, None] - xy[n][None], axis=2)
        end, spot = np.unravel_index(np.argmin(distance), distance.shape)
        if distance[end, spot] < GATE * width_px and distance[1 - end, spot] > 2 * GATE * width_px:
            filled[n, end] = xy[n][spot]
    return filled
