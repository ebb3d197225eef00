"""The time offset of each view: whole frames from when motion happens, fractions from where moving points miss the epipolar lines.

    c(L) = corr(E_r(t), E_k(t + L))                                                      (1)   E: motion energy; candidates of L
    e(s) = e_0 + s (e_+ − e_−) / 2 + s² (e_+ − 2 e_0 + e_−) / 2                          (2)   signed distance of a point tracked in view k
    Σ ρ(e_i(s) − b) → min over s, b ,   offset = −(L + s)                                (3)   ρ: Cauchy's; b: the rig's own error
    Σ ρ(e_i(s − r (y_i/h − ½)) − b) → min over r, s, b                                   (4)   y: the point's row of h in view k
    z = (artanh c(L) − artanh c(0)) √((n − 3) / 2) ,   n = T / Σ α_r(l) α_k(l)           (5)   α: autocorrelation of the T energies

A point matched between the reference at t and view k at t + L is tracked in view k to the frames before and after; (2) is its signed
distance from the epipolar line as if view k had been exposed s frames later. Static points, and points that move along the line,
constrain b but not s. The sigma of the offset comes from the adjustment (3). Where the views have clocks (`take.clock`), s starts from
what they predict for each frame, L counts images of view k, and the offset is what is left.

Where no moving points can be tracked, (1) alone may give whole frames: for views whose axes are not too far apart, because the same motion
has another rhythm from another side, and only where L correlates better than 0 by several sigmas (5). One rise and fall of the energy is
one sample, however many frames it takes (Bartlett 1946, doi:10.2307/2983611).

A rolling shutter exposes one row after the other. Where take.toml has the readout, s starts from it for every point, too; r in (4) is by
how many frames the readout of view k, from the first row to the last, takes longer beyond that than that of the view it is compared
with. Between cameras of one kind that see a point in the same row, r has no effect and does no harm.
"""

from dataclasses import dataclass, replace
from math import isfinite

import cv2
import numpy as np

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..images.retime import LARGEST, Recent
from ..take.footage import Footage
from .survey import Survey, survey
from .view_matches import Features, PairMatches, eight_bits, epipolar_distance_px, find_features, match_features, match_pair

FRAMES = 6  # in which points are tracked
MOST_LAG = 50  # frames
METHODS = ("reference", "rays", "energy", "nothing")  # from the most to the least exact; energy gives whole frames only
BANDS = 8  # of rows, for the sigma of (4)
FEWEST_MOVING = 10  # matches
LEAST_FITTING = 0.3  # share of the moving matches
FARTHEST = 0.95  # frames that (2) reaches; an offset beyond belongs to another L
CLEAR = 0.7  # frames: with a smaller offset at L = 0 no other L is tried
BETTER = 1.1  # times as many moving matches must fit at another L
CORRELATED = 0.7  # correlation of the motion energies
SURE = 4.0  # sigmas by which it must exceed the correlation without a lag
FARTHEST_DEG = 50.0  # between the axes of views whose motion energies are compared
SCALE_PX = 0.5  # of Cauchy's ρ
MOVES_PX = 0.3  # per frame across the epipolar line: the point is moving
FITS_PX = 0.5  # distance from the epipolar line after (3)
LEAST_OFFSET = 0.05  # frames: a smaller offset does not matter to a measurement
SIGNIFICANT = 4.0  # sigmas of an offset
DOUBTFUL = 3.0  # sigmas of an offset from motion energies alone
LEAST_READOUT = 0.1  # frames: a smaller difference does not matter to a measurement
SIGNIFICANT_READOUT = 5.0  # sigmas of a difference in readout
LEAST_EFFECT_PX = 0.1  # distance between the rays of moving points that matters to a measurement
ENERGY_SIGMA = 0.5  # frames: energies give whole frames
SPEED_PERCENTILE = 90  # of the fitting points' speeds
ROUND_TRIP_PX = 0.5  # of a point tracked to the next frame and back
STEPS = 12  # of the adjustment
SINGULAR = 1e9  # condition number of the normal matrix
FLOW_WINDOW = 21  # px
FLOW_LEVELS = 4


@dataclass(frozen=True, kw_only=True, slots=True)
class TimeOffset:
    """A view's time offset: its images are exposed `delay_frames` frame intervals after those of the reference. NaN: not known."""

    view: str
    delay_frames: float  # of the take, in excess of the view's clock if it has one
    sigma_frames: float
    method: str  # one of METHODS, the least exact in the chain to the reference view
    moving: int = 0  # matches that move across the epipolar lines and fit
    speed_px: float = 0.0  # 90th percentile of their speed across the lines, per frame
    distance_px: float = np.nan  # median distance of the inliers from the epipolar lines, corrected for a significant offset
    readout_frames: float = np.nan  # by which the readout from the first row to the last is longer than the reference view's
    readout_sigma: float = np.inf

    @property
    def significant(self) -> bool:
        """Whether it exceeds its noise, and matters to a measurement."""
        exceeds = abs(self.delay_frames) > max(LEAST_OFFSET, SIGNIFICANT * self.sigma_frames)
        return self.method == "rays" and exceeds and self.effect_px > LEAST_EFFECT_PX

    @property
    def doubtful(self) -> bool:
        """Whether it is significant, or is estimated from motion energies alone and exceeds three sigmas."""
        return self.significant or (self.method == "energy" and abs(self.delay_frames) > DOUBTFUL * self.sigma_frames)

    @property
    def rolls(self) -> bool:
        """Whether its readout differs from the reference view's by more than the noise, and enough to matter."""
        readout = abs(self.readout_frames)
        return (
            self.method == "rays"
            and readout > max(LEAST_READOUT, SIGNIFICANT_READOUT * self.readout_sigma)
            and self.rolling_px > LEAST_EFFECT_PX
        )

    @property
    def rolling_px(self) -> float:
        """Distance between the rays of moving points at the first and last rows that the readout causes."""
        return abs(self.readout_frames) / 2 * self.speed_px

    def to_table(self) -> dict[str, object]:
        """The figures, for JSON; None where there is no estimate."""

        def rounded(value: float, digits: int) -> float | None:
            return round(value, digits) if isfinite(value) else None

        return {
            "late_frames": rounded(self.delay_frames, 4),
            "sigma_frames": rounded(self.sigma_frames, 4),
            "from": self.method,
            "moving_matches": self.moving,
            "miss_px": rounded(self.distance_px, 3),
            "readout_frames": rounded(self.readout_frames, 4),
            "readout_sigma_frames": rounded(self.readout_sigma, 4),
        }

    @property
    def effect_px(self) -> float:
        """Distance between the rays of moving points that the offset causes."""
        return abs(self.delay_frames) * self.speed_px


def estimate_offsets(footage: Footage, monitor: Monitor, film: "Film | None" = None) -> tuple[TimeOffset, ...]:
    """The offset of every view against the reference view, in the order of the views; about a second per view.

    Views without matches in the reference view are compared with a view that has some. The estimates come on top of `offset_frames` of
    take.toml. Of interlaced footage one field is used (`Footage.single`).

    Raises:
        InputError: see `Footage.read`.
    """
    film = film or Film(footage, survey(footage, monitor))
    names = [v.name for v in footage.take.views]
    reference = footage.take.reference
    zero = TimeOffset(view=names[reference], delay_frames=0.0, sigma_frames=0.0, method="reference", readout_frames=0.0, readout_sigma=0.0)
    known = {reference: zero}
    while len(known) < len(names):
        base, k = film.best_link(set(known))
        link = _between(film, base, k, names[k], monitor.part("synchronization", len(known) - 1, len(names) - 1))
        known[k] = TimeOffset(
            view=names[k],
            delay_frames=link.delay_frames + known[base].delay_frames,
            sigma_frames=float(np.hypot(link.sigma_frames, known[base].sigma_frames)),
            method=max(link.method, known[base].method, key=METHODS.index),
            moving=link.moving,
            speed_px=link.speed_px,
            distance_px=link.distance_px,
            readout_frames=link.readout_frames + known[base].readout_frames,
            readout_sigma=float(np.hypot(link.readout_sigma, known[base].readout_sigma)),
        )
    return tuple(known[k] for k in range(len(names)))


def synchronised(footage: Footage, monitor: Monitor) -> tuple[Footage, dict[str, dict[str, object]]]:
    """The footage with every view interpolated to the moment of the reference view (`images.retime`), and a table of the offsets by view.

    Raises:
        InputError: an offset is larger than can be interpolated.
    """
    offsets = estimate_offsets(footage.single(), monitor)
    for o in offsets:
        if o.doubtful and abs(o.delay_frames) > LARGEST:
            raise InputError(
                f"View {o.view} has a time offset of {o.delay_frames:+.2f} frames, too large to correct; add {-round(o.delay_frames):+d} "
                "to its `offset_frames` in take.toml, the rest is corrected then."
            )
    delays = tuple(round(o.delay_frames / footage.single().interval_frames(k), 4) if o.significant else 0.0 for k, o in enumerate(offsets))
    sequences = tuple(Recent(s) if t and not isinstance(s, Recent) else s for s, t in zip(footage.sequences, delays))
    return replace(footage, sequences=sequences, delay_images=delays), {o.view: o.to_table() for o in offsets}


class Film:
    """The images of a take and their features, each read once."""

    def __init__(self, footage: Footage, survey: Survey) -> None:
        self.footage, self.survey = footage, survey
        self.rows, self.cameras = footage.take.rows_at(0), footage.rig.cameras
        self._pictures: dict[tuple[int, int], np.ndarray] = {}
        self._features: dict[tuple[int, int], Features] = {}

    def has(self, k: int, number: int) -> bool:
        """Whether view k has an image of that number."""
        return 0 <= number < self.footage.sequences[k].count

    def picture(self, k: int, number: int) -> np.ndarray:
        """The measured rows (h, w) uint8 of an image of view k."""
        if (k, number) not in self._pictures:
            self._pictures[k, number] = eight_bits(self.rows.rows(self.footage.sequences[k].read(number)))
        return self._pictures[k, number]

    def features(self, k: int, number: int) -> Features:
        """The keypoints of an image of view k."""
        if (k, number) not in self._features:
            self._features[k, number] = find_features(self.picture(k, number))
        return self._features[k, number]

    def of_frame(self, k: int, frame: int) -> Features:
        """The keypoints of view k in a frame of the take."""
        return self.features(k, self.footage.number(k, frame))

    def frames(self) -> list[int]:
        """The frames with most motion, some distance apart, in temporal order; none if there are fewer than three."""
        if len(self.survey.frames) < 3:
            return []
        energy = np.nan_to_num(self.survey.energy / np.maximum(np.nanmedian(self.survey.energy, axis=1, keepdims=True), 1e-6)).min(axis=0)
        apart, chosen = max(1, len(energy) // (2 * FRAMES)), list[int]()
        for t in np.argsort(-energy):
            if 0 < t < len(energy) - 1 and all(abs(t - c) >= apart for c in chosen) and len(chosen) < FRAMES:
                chosen.append(int(t))
        return sorted(self.survey.frames[t] for t in chosen)

    def best_link(self, known: set[int]) -> tuple[int, int]:
        """A view that is known and one that is not, with most in common in the middle frame."""
        frame = self.survey.frames[len(self.survey.frames) // 2]
        links = [(i, k) for i in sorted(known) for k in range(len(self.cameras)) if k not in known]
        return max(links, key=lambda link: len(match_pair(self.of_frame(link[0], frame), self.of_frame(link[1], frame))[0]))

    def matches(self) -> list[PairMatches]:
        """Matches of every pair of views, in the first, the middle and the last frame of `frames`."""
        chosen = self.frames() or [self.survey.frames[0]]
        chosen = sorted({chosen[0], chosen[len(chosen) // 2], chosen[-1]})
        return match_features([[self.of_frame(k, f) for k in range(len(self.cameras))] for f in chosen], self.rows)


def _between(film: Film, base: int, k: int, name: str, monitor: Monitor) -> TimeOffset:
    """The offset of view k against view `base`: the whole frames at which most moving matches fit, and the rest by (3)."""
    lags, correlation = energy_lags(film.survey.energy[base], film.survey.energy[k])
    interval = film.footage.interval_frames(k)
    best: TimeOffset | None = None
    for n, lag in enumerate(dict.fromkeys([0, *(round(lag / interval) for lag in lags)])):
        monitor.step("synchronization", n, len(lags) + 1)
        tracked = [m for f in film.frames() if (m := _track_matches(film, base, k, f, lag)) is not None]
        offset = _fit(tracked, lag, name, interval) if tracked else None
        if offset is not None and (best is None or offset.moving > BETTER * best.moving):
            best = offset
        if lag == 0 and best is not None and abs(best.delay_frames) < CLEAR:
            break
    if best is not None:
        return best
    ca, cb = film.cameras[base], film.cameras[k]
    near = float(ca.R_cam_world[2] @ cb.R_cam_world[2]) > np.cos(np.radians(FARTHEST_DEG))
    if near and correlation > CORRELATED and (not lags[0] or lag_sigmas(film.survey.energy[base], film.survey.energy[k], lags[0]) > SURE):
        return TimeOffset(view=name, delay_frames=float(-lags[0]), sigma_frames=ENERGY_SIGMA, method="energy")
    return TimeOffset(view=name, delay_frames=np.nan, sigma_frames=np.inf, method="nothing")


def energy_lags(a: np.ndarray, b: np.ndarray) -> tuple[list[int], float]:
    """Whole-frame lags L, the best first, then its neighbours, at which the motion energies a(t) and b(t + L) (T,) correlate, and the
    correlation at the best.  (1)"""
    most = min(MOST_LAG, len(a) // 3)
    scores = {lag: _correlation(*_shifted(a, b, lag)) for lag in range(-most, most + 1)}
    best = max(scores, key=lambda lag: (scores[lag], -abs(lag)))
    return [best, best - 1, best + 1], scores[best]


def lag_sigmas(a: np.ndarray, b: np.ndarray, lag: int) -> float:
    """By how many sigmas the motion energies a(t) and b(t + lag) (T,) correlate better than a(t) and b(t).  (5)"""
    x, y = _shifted(a, b, lag)
    alpha = [np.correlate(v, v, "full") / (v @ v) for v in (x, y)]
    samples = min(len(x) / max(float(alpha[0] @ alpha[1]), 1e-9), len(x))
    more = np.arctanh(min(_correlation(x, y), 0.999)) - np.arctanh(np.clip(_correlation(*_shifted(a, b, 0)), -0.999, 0.999))
    return float(more * np.sqrt(max(samples - 3, 0.0) / 2))


def _shifted(a: np.ndarray, b: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """a(t) and b(t + lag) (n,) minus their means, where both are finite."""
    x, y = a[max(0, -lag) : len(a) - max(0, lag)], b[max(0, lag) : len(b) - max(0, -lag)]
    known = np.isfinite(x) & np.isfinite(y)
    return (x[known] - x[known].mean(), y[known] - y[known].mean()) if known.any() else (x[known], y[known])


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation of zero-mean series (n,); 0 if they are too short or constant."""
    length = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / length if len(x) > 4 and length > 1e-9 else 0.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Tracked:
    """Matches of one frame, tracked in the second view to the frames before and after."""

    matches: PairMatches
    distances: np.ndarray  # (m, 5) e_−, e_0, e_+ in full-frame pixels, y/h − ½, and s as the clocks predict it


def _track_matches(film: Film, base: int, k: int, frame: int, lag: int) -> _Tracked | None:
    """The matches of one frame that can be tracked in view k, `lag` images later; None without matches."""
    shown, number = film.footage.number(base, frame), film.footage.number(k, frame) + lag
    if not film.has(base, shown) or not all(film.has(k, number + step) for step in (-1, 0, 1)):
        return None
    a, b = film.features(base, shown), film.features(k, number)
    i, j = match_pair(a, b)
    if not len(i):
        return None
    here = film.picture(k, number)
    xy = [_flow(here, film.picture(k, number + step), b.xy[j]) if step else b.xy[j] for step in (-1, 0, 1)]
    good = np.isfinite(np.stack(xy)).all(axis=(0, 2))
    xa = film.rows.to_frame(a.xy[i[good]])
    ca, cb = film.cameras[base], film.cameras[k]
    xb = film.rows.to_frame(xy[1][good])
    y = xb[:, 1] / cb.size_px[1] - 0.5
    predicted = film.footage.delay(base, frame) * film.footage.interval_frames(base) / film.footage.interval_frames(k)
    predicted -= film.footage.delay(k, frame)
    ya = xa[:, 1] / ca.size_px[1] - 0.5
    rolled = (_readout_s(film.footage, base) * ya - _readout_s(film.footage, k) * y) / _period_s(film.footage, k)
    distances = np.stack([*(epipolar_distance_px(ca, cb, xa, film.rows.to_frame(at[good])) for at in xy), y, predicted + rolled], axis=1)
    return _Tracked(matches=PairMatches(i=base, j=k, xi_px=xa, xj_px=xb), distances=distances)


def _readout_s(footage: Footage, view: int) -> float:
    """The known readout of a view."""
    return footage.clocks[view].readout_s if footage.clocks else 0.0


def _period_s(footage: Footage, view: int) -> float:
    """The time between two images of a view."""
    return footage.interval_frames(view) / footage.take.fps


def _flow(here: np.ndarray, there: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Points (m, 2) in the next image by the method of Lucas and Kanade, NaN where tracking back does not return to the start."""
    start = np.ascontiguousarray(xy, dtype=np.float32).reshape(-1, 1, 2)
    options = dict(winSize=(FLOW_WINDOW, FLOW_WINDOW), maxLevel=FLOW_LEVELS)
    end, found, _ = cv2.calcOpticalFlowPyrLK(here, there, start, None, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(there, here, end, None, **options)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (np.linalg.norm((back - start).reshape(-1, 2), axis=1) < ROUND_TRIP_PX)
    return np.where(good[:, None], end.reshape(-1, 2).astype(np.float64), np.nan)


def _fit(tracked: list[_Tracked], lag: int, name: str, interval: float = 1.0) -> TimeOffset | None:
    """The offset from the matches of some frames, at a lag in whole images that are `interval` frames of the take apart, or None where too
    few moving matches fit.  (3)"""
    e = np.concatenate([m.distances for m in tracked])
    rate, curvature = (e[:, 2] - e[:, 0]) / 2, (e[:, 2] - 2 * e[:, 1] + e[:, 0]) / 2

    def distance(s: float) -> np.ndarray:
        at = e[:, 4] + s
        return np.asarray(e[:, 1] + at * rate + at * at * curvature)  # (2)

    moving = np.abs(rate) > MOVES_PX
    if moving.sum() < FEWEST_MOVING:
        return None
    grid = np.linspace(-1, 1, 81)
    s, b = float(grid[np.argmin([np.log1p((distance(g) / SCALE_PX) ** 2).sum() for g in grid])]), 0.0
    for _ in range(STEPS):
        v = distance(s) - b
        w = 1 / (1 + (v / SCALE_PX) ** 2)
        A = np.stack([rate + 2 * (e[:, 4] + s) * curvature, -np.ones_like(rate)], axis=1)
        normal = (A * w[:, None]).T @ A
        if np.linalg.cond(normal) > SINGULAR:
            return None
        ds, db = np.linalg.solve(normal, -(A * w[:, None]).T @ v)
        s, b = float(np.clip(s + ds, -1, 1)), b + float(db)
    good = moving & (np.abs(distance(s) - b) < FITS_PX)
    if abs(s) > FARTHEST or good.sum() < max(FEWEST_MOVING, LEAST_FITTING * moving.sum()):
        return None
    frame = np.repeat(np.arange(len(tracked)), [len(m.distances) for m in tracked])
    sigma = _sigma(A, w, distance(s) - b, frame)
    readout, readout_sigma = _readout(e, s, b, frame)
    inliers, by = _inliers(tracked), s if abs(s) > max(LEAST_OFFSET, SIGNIFICANT * sigma) else 0.0
    return TimeOffset(
        view=name,
        delay_frames=-(lag + s) * interval,
        sigma_frames=sigma * interval,
        method="rays",
        moving=int(good.sum()),
        speed_px=float(np.percentile(np.abs(rate[good]), SPEED_PERCENTILE)) / interval,
        distance_px=float(np.median(np.abs(distance(by)[inliers]))) if len(inliers) else np.nan,
        readout_frames=readout * interval,
        readout_sigma=readout_sigma * interval,
    )


def _inliers(tracked: list[_Tracked]) -> np.ndarray:
    """Rows (n,) of all frames' matches, concatenated, that agree with one epipolar geometry of their own; empty if most do not."""
    first = tracked[0].matches
    xi, xj = (np.concatenate([getattr(m.matches, name) for m in tracked]) for name in ("xi_px", "xj_px"))
    rows = PairMatches(i=first.i, j=first.j, xi_px=xi, xj_px=xj).inliers()
    return np.zeros(0, dtype=int) if rows is None else rows


def _readout(e: np.ndarray, s: float, b: float, frame: np.ndarray) -> tuple[float, float]:
    """r in frames, and its sigma, from the distances (m, 5) and the solution of (3); NaN where all motion is in the same row.  (4)"""
    rate, curvature, y = (e[:, 2] - e[:, 0]) / 2, (e[:, 2] - 2 * e[:, 1] + e[:, 0]) / 2, e[:, 3]
    unknowns = np.array([0.0, s, b])
    for _ in range(STEPS):
        at = e[:, 4] + unknowns[1] - unknowns[0] * y
        v = e[:, 1] + at * rate + at**2 * curvature - unknowns[2]
        w = 1 / (1 + (v / SCALE_PX) ** 2)
        slope = rate + 2 * at * curvature
        A = np.stack([-y * slope, slope, -np.ones_like(rate)], axis=1)
        normal = (A * w[:, None]).T @ A
        if np.linalg.cond(normal) > SINGULAR:
            return np.nan, np.inf
        unknowns += np.linalg.solve(normal, -(A * w[:, None]).T @ v)
        unknowns[:2] = np.clip(unknowns[:2], -1, 1)
    band = np.floor(BANDS * (y + 0.5))  # systematic errors of a part of the body recur in all frames at its rows
    return float(unknowns[0]), max(_sigma(A, w, v, frame), _sigma(A, w, v, band))


def _sigma(A: np.ndarray, w: np.ndarray, v: np.ndarray, frame: np.ndarray) -> float:
    """Sigma of the first unknown: the adjustment's, or the jackknife's over frames (or other groups) if that is larger."""
    normal, gradient = (A * w[:, None]).T @ A, A * (w * v)[:, None]
    changes, groups = list[float](), np.unique(frame)  # of the first unknown, when a group is left out (Tukey 1958)
    for f in groups if len(groups) > 1 else ():
        own = frame == f
        rest = normal - (A[own] * w[own, None]).T @ A[own]
        if np.linalg.cond(rest) > SINGULAR:
            return np.inf
        changes.append(float(np.linalg.solve(rest, gradient[own].sum(axis=0))[0]))
    between = (1 - 1 / len(groups)) * float(np.square(changes).sum())
    within = float(np.linalg.inv(normal)[0, 0] * (w * v**2).sum() / max(w.sum() - 2, 1))
    return float(np.sqrt(max(between, within)))
