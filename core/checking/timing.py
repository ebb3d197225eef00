"""How late each view is: whole frames from when things move, parts of a frame from where moving points miss the epipolar lines.

    c(L) = corr(E_r(t), E_k(t + L))                                                      (1)   E: motion energy; candidates of L
    e(s) = e_0 + s (e_+ − e_−) / 2 + s² (e_+ − 2 e_0 + e_−) / 2                          (2)   miss of a point followed in view k
    Σ ρ(e_i(s) − b) → min over s, b ,   late = −(L + s)                                  (3)   ρ: Cauchy's; b: the rig's own miss
    Σ ρ(e_i(s − r (y_i/h − ½)) − b) → min over r, s, b                                   (4)   y: the point's row of h in view k
    z = (artanh c(L) − artanh c(0)) √((n − 3) / 2) ,   n = T / Σ α_r(l) α_k(l)           (5)   α: autocorrelation of the T energies

A point seen in the reference at t and in view k at t + L is followed in view k to the frames before and after; (2) is its signed distance
from the epipolar line as if view k had been exposed s frames later. Points that rest, or move along the line, say nothing of s and much
of b. The sigma of `late` comes from the adjustment (3).

Where no moving points can be followed, (1) alone may tell whole frames: of views not too far apart, for from other sides a motion has
another rhythm, and where L goes together better than 0 by several sigmas (5). One rise and fall of the energy is one sample, however many
frames it takes (Bartlett 1946, doi:10.2307/2983611).

A rolling shutter exposes one row after the other: r in (4) is by how many frames view k takes longer for it, from the first row to the
last, than the view it is compared with. Between alike cameras that see a point in the same row it shows nothing, and harms no rays.
"""

from dataclasses import dataclass, replace
from math import isfinite

import cv2
import numpy as np

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..images.retime import LARGEST, Recent
from ..take.take import Footage
from .survey import Survey, survey
from .view_matches import Features, PairMatches, alike, eight_bits, epipolar_miss_px, find_features, match_features

FRAMES = 6  # looked at for the part of a frame
MOST_LAG = 50
METHODS = ("reference", "rays", "energy", "nothing")  # energy tells whole frames only
BANDS = 8  # of rows, for the sigma of (4)
FEWEST = 10  # moving matches
LEAST = 0.3  # part of the moving matches that must fit
FARTHEST = 0.95  # frames that (2) reaches; what lies beyond belongs to another L
CLEAR = 0.7  # frames within which whole frames need not be looked for
GOES_TOGETHER = 0.7  # correlation of the motion energies
SURE = 4.0  # sigmas by which it must exceed that without a lag
FARTHEST_DEG = 50.0  # between the axes of views whose motion energies are compared
SCALE_PX, MOVES_PX, FITS_PX = 0.5, 0.3, 0.5
LEAST_OFFSET = 0.05  # frames: less does not matter to a measurement
SIGNIFICANT = 4.0  # sigmas
ROUND_TRIP_PX = 0.5
STEPS = 12
FLOW_WINDOW, FLOW_LEVELS = 21, 4


@dataclass(frozen=True, kw_only=True, slots=True)
class TimeOffset:
    """A view's offset in time: its image that should show a moment shows `late_frames` later. NaN where that cannot be told."""

    view: str
    delay_frames: float
    sigma_frames: float
    method: str  # one of METHODS, the weakest on the way to the reference view
    moving: int = 0  # matches that move across the epipolar lines and fit
    speed_px: float = 0.0  # the speed across them that a tenth exceeds, per frame
    miss_px: float = np.nan  # median of matches that are certainly right, once a significant offset is allowed for
    readout_frames: float = np.nan  # what its rows take longer than the reference view's, from the first to the last
    readout_sigma: float = np.inf

    @property
    def significant(self) -> bool:
        """Larger than its noise, and than what matters to a measurement."""
        return (
            self.method == "rays" and abs(self.delay_frames) > max(LEAST_OFFSET, SIGNIFICANT * self.sigma_frames) and self.effect_px > 0.1
        )

    @property
    def doubtful(self) -> bool:
        """Significant, or told from the motion's rhythm alone by more than three times its sigma."""
        return self.significant or (self.method == "energy" and abs(self.delay_frames) > 3 * self.sigma_frames)

    @property
    def rolls(self) -> bool:
        """Whether its rows are read out otherwise than the reference view's, by more than noise and than what matters."""
        readout = abs(self.readout_frames)
        return self.method == "rays" and readout > max(0.1, 5 * self.readout_sigma) and self.rolling_px > 0.1

    @property
    def rolling_px(self) -> float:
        """By how much that makes the rays of moving points at the first and last rows miss each other."""
        return abs(self.readout_frames) / 2 * self.speed_px

    def to_table(self) -> dict[str, object]:
        """The figures, for JSON; what is not known is None."""

        def rounded(value: float, digits: int) -> float | None:
            return round(value, digits) if isfinite(value) else None

        return {
            "late_frames": rounded(self.delay_frames, 4),
            "sigma_frames": rounded(self.sigma_frames, 4),
            "from": self.method,
            "moving_matches": self.moving,
            "miss_px": rounded(self.miss_px, 3),
            "readout_frames": rounded(self.readout_frames, 4),
            "readout_sigma_frames": rounded(self.readout_sigma, 4),
        }

    @property
    def effect_px(self) -> float:
        """By how much it makes the rays of moving points miss each other."""
        return abs(self.delay_frames) * self.speed_px


def estimate_offsets(footage: Footage, monitor: Monitor, film: "Film | None" = None) -> tuple[TimeOffset, ...]:
    """The offset of every view against the reference view, in the order of the views; about a second per view.

    Views that have nothing in common with the reference are compared with a view that has. `offset_frames` of take.toml is in force: what
    is found comes on top of it. Of interlaced footage one field is looked at (`Footage.single`).

    Raises:
        InputError: see `Footage.read`.
    """
    film = film or Film(footage, survey(footage, monitor))
    names = [v.name for v in footage.take.views]
    reference = footage.take.reference
    none = TimeOffset(view=names[reference], delay_frames=0.0, sigma_frames=0.0, method="reference", readout_frames=0.0, readout_sigma=0.0)
    found = {reference: none}
    while len(found) < len(names):
        base, k = film.best_link(set(found))
        link = _between(film, base, k, names[k], monitor.part("synchronization", len(found) - 1, len(names) - 1))
        late, sigma = link.delay_frames + found[base].delay_frames, float(np.hypot(link.sigma_frames, found[base].sigma_frames))
        found[k] = TimeOffset(
            view=names[k],
            delay_frames=late,
            sigma_frames=sigma,
            method=max(link.method, found[base].method, key=METHODS.index),
            moving=link.moving,
            speed_px=link.speed_px,
            miss_px=link.miss_px,
            readout_frames=link.readout_frames + found[base].readout_frames,
            readout_sigma=float(np.hypot(link.readout_sigma, found[base].readout_sigma)),
        )
    return tuple(found[k] for k in range(len(names)))


def synchronised(footage: Footage, monitor: Monitor) -> tuple[Footage, dict[str, dict[str, object]]]:
    """The footage with every late view put to the moment of the reference view (`images.retime`), and a table of the offsets by view.

    Raises:
        InputError: a view is late by more than can be interpolated.
    """
    offsets = estimate_offsets(footage.single(), monitor)
    for o in offsets:
        if o.doubtful and abs(o.delay_frames) > LARGEST:
            raise InputError(
                f"View {o.view} is {o.delay_frames:+.2f} frames late, too much to interpolate; add {-round(o.delay_frames):+d} to its "
                "`offset_frames` in take.toml, the rest is then corrected."
            )
    late = tuple(round(o.delay_frames, 4) if o.significant else 0.0 for o in offsets)
    sequences = tuple(Recent(s) if t else s for s, t in zip(footage.sequences, late))
    return replace(footage, sequences=sequences, delay_images=late), {o.view: o.to_table() for o in offsets}


class Film:
    """Pictures and their features, read once."""

    def __init__(self, footage: Footage, seen: Survey) -> None:
        self.footage, self.seen = footage, seen
        self.rows, self.cameras = footage.take.rows_at(0), footage.rig.cameras
        self._pictures: dict[tuple[int, int], np.ndarray] = {}
        self._features: dict[tuple[int, int], Features] = {}

    def holds(self, k: int, frame: int) -> bool:
        """Whether view k has an image of that frame of the take."""
        return 0 <= self.footage.number(k, frame) < self.footage.sequences[k].count

    def picture(self, k: int, frame: int) -> np.ndarray:
        """The measured rows (h, w) uint8 of view k."""
        if (k, frame) not in self._pictures:
            image = self.footage.sequences[k].read(self.footage.number(k, frame))
            self._pictures[k, frame] = eight_bits(self.rows.rows(image))
        return self._pictures[k, frame]

    def features(self, k: int, frame: int) -> Features:
        """The keypoints of view k."""
        if (k, frame) not in self._features:
            self._features[k, frame] = find_features(self.picture(k, frame))
        return self._features[k, frame]

    def frames(self) -> list[int]:
        """Frames in which most moves, apart from each other, in the order of time; none of fewer than three."""
        if len(self.seen.frames) < 3:
            return []
        energy = np.nan_to_num(self.seen.energy / np.maximum(np.nanmedian(self.seen.energy, axis=1, keepdims=True), 1e-6)).min(axis=0)
        apart, chosen = max(1, len(energy) // (2 * FRAMES)), list[int]()
        for t in np.argsort(-energy):
            if 0 < t < len(energy) - 1 and all(abs(t - c) >= apart for c in chosen) and len(chosen) < FRAMES:
                chosen.append(int(t))
        return sorted(self.seen.frames[t] for t in chosen)

    def best_link(self, known: set[int]) -> tuple[int, int]:
        """A view that is known and one that is not, with most in common in the middle frame."""
        frame = self.seen.frames[len(self.seen.frames) // 2]
        links = [(i, k) for i in sorted(known) for k in range(len(self.cameras)) if k not in known]
        return max(links, key=lambda link: len(alike(self.features(link[0], frame), self.features(link[1], frame))[0]))

    def matches(self) -> list[PairMatches]:
        """What looks alike in every pair of views, in the first, a middle and the last frame that `frames` chose."""
        chosen = self.frames() or [self.seen.frames[0]]
        chosen = sorted({chosen[0], chosen[len(chosen) // 2], chosen[-1]})
        return match_features([[self.features(k, f) for k in range(len(self.cameras))] for f in chosen], self.rows)


def _between(film: Film, base: int, k: int, name: str, monitor: Monitor) -> TimeOffset:
    """How late view k is against view `base`: the whole frames at which most moving matches fit, and the rest by (3)."""
    lags, correlation = energy_lags(film.seen.energy[base], film.seen.energy[k])
    best: TimeOffset | None = None
    for n, lag in enumerate(dict.fromkeys([0, *lags])):
        monitor.step("synchronization", n, len(lags) + 1)
        followed = [m for f in film.frames() if (m := _followed_matches(film, base, k, f, lag)) is not None]
        offset = _fit(followed, lag, name) if followed else None
        if offset is not None and (best is None or offset.moving > 1.1 * best.moving):
            best = offset
        if lag == 0 and best is not None and abs(best.delay_frames) < CLEAR:
            break
    if best is not None:
        return best
    ca, cb = film.cameras[base], film.cameras[k]
    near = float(ca.R_cam_world[2] @ cb.R_cam_world[2]) > np.cos(np.radians(FARTHEST_DEG))
    if near and correlation > GOES_TOGETHER and (not lags[0] or lag_sigmas(film.seen.energy[base], film.seen.energy[k], lags[0]) > SURE):
        return TimeOffset(view=name, delay_frames=float(-lags[0]), sigma_frames=0.5, method="energy")
    return TimeOffset(view=name, delay_frames=np.nan, sigma_frames=np.inf, method="nothing")


def energy_lags(a: np.ndarray, b: np.ndarray) -> tuple[list[int], float]:
    """Whole-frame lags L (best first, then its neighbours) at which the motion energies a(t) and b(t + L) (T,) go together, and how
    well the best of them does.  (1)"""
    most = min(MOST_LAG, len(a) // 3)
    scores = {lag: _correlation(*_shifted(a, b, lag)) for lag in range(-most, most + 1)}
    best = max(scores, key=lambda lag: (scores[lag], -abs(lag)))
    return [best, best - 1, best + 1], scores[best]


def lag_sigmas(a: np.ndarray, b: np.ndarray, lag: int) -> float:
    """By how many sigmas the motion energies a(t) and b(t + lag) (T,) go together better than a(t) and b(t).  (5)"""
    x, y = _shifted(a, b, lag)
    alpha = [np.correlate(v, v, "full") / (v @ v) for v in (x, y)]
    samples = min(len(x) / max(float(alpha[0] @ alpha[1]), 1e-9), len(x))
    more = np.arctanh(min(_correlation(x, y), 0.999)) - np.arctanh(np.clip(_correlation(*_shifted(a, b, 0)), -0.999, 0.999))
    return float(more * np.sqrt(max(samples - 3, 0.0) / 2))


def _shifted(a: np.ndarray, b: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """a(t) and b(t + lag) (n,) without their means, where both are known."""
    x, y = a[max(0, -lag) : len(a) - max(0, lag)], b[max(0, lag) : len(b) - max(0, -lag)]
    known = np.isfinite(x) & np.isfinite(y)
    return (x[known] - x[known].mean(), y[known] - y[known].mean()) if known.any() else (x[known], y[known])


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Of series (n,) without means; 0 of too short or constant ones."""
    length = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / length if len(x) > 4 and length > 1e-9 else 0.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Followed:
    """Matches of one frame, followed in the second view to the frames before and after."""

    matches: PairMatches
    misses: np.ndarray  # (m, 4) e_−, e_0, e_+ in full-frame pixels, and y/h − ½


def _followed_matches(film: Film, base: int, k: int, frame: int, lag: int) -> _Followed | None:
    """What can be followed of the matches of one frame; None without any."""
    if not film.holds(base, frame) or not all(film.holds(k, frame + lag + step) for step in (-1, 0, 1)):
        return None
    a, b = film.features(base, frame), film.features(k, frame + lag)
    i, j = alike(a, b)
    if not len(i):
        return None
    here = film.picture(k, frame + lag)
    places = [_followed(here, film.picture(k, frame + lag + step), b.xy[j]) if step else b.xy[j] for step in (-1, 0, 1)]
    good = np.isfinite(np.stack(places)).all(axis=(0, 2))
    xa = film.rows.to_frame(a.xy[i[good]])
    ca, cb = film.cameras[base], film.cameras[k]
    xb = film.rows.to_frame(places[1][good])
    y = xb[:, 1] / cb.size_px[1] - 0.5
    misses = np.stack([*(epipolar_miss_px(ca, cb, xa, film.rows.to_frame(place[good])) for place in places), y], axis=1)
    return _Followed(matches=PairMatches(i=base, j=k, xi_px=xa, xj_px=xb), misses=misses)


def _followed(here: np.ndarray, there: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Points (m, 2) in the next picture by the method of Lucas and Kanade, NaN where the way back does not end where it began."""
    start = np.ascontiguousarray(xy, dtype=np.float32).reshape(-1, 1, 2)
    options = dict(winSize=(FLOW_WINDOW, FLOW_WINDOW), maxLevel=FLOW_LEVELS)
    end, found, _ = cv2.calcOpticalFlowPyrLK(here, there, start, None, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(there, here, end, None, **options)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (np.linalg.norm((back - start).reshape(-1, 2), axis=1) < ROUND_TRIP_PX)
    return np.where(good[:, None], end.reshape(-1, 2).astype(np.float64), np.nan)


def _fit(followed: list[_Followed], lag: int, name: str) -> TimeOffset | None:
    """The offset from the matches of some frames at one whole-frame lag, or None where too few moving matches fit.  (3)"""
    e = np.concatenate([f.misses for f in followed])
    rate, bend = (e[:, 2] - e[:, 0]) / 2, (e[:, 2] - 2 * e[:, 1] + e[:, 0]) / 2

    def miss(s: float) -> np.ndarray:
        return np.asarray(e[:, 1] + s * rate + s * s * bend)  # (2)

    moving = np.abs(rate) > MOVES_PX
    if moving.sum() < FEWEST:
        return None
    grid = np.linspace(-1, 1, 81)
    s, b = float(grid[np.argmin([np.log1p((miss(g) / SCALE_PX) ** 2).sum() for g in grid])]), 0.0
    for _ in range(STEPS):
        v = miss(s) - b
        w = 1 / (1 + (v / SCALE_PX) ** 2)
        A = np.stack([rate + 2 * s * bend, -np.ones_like(rate)], axis=1)
        normal = (A * w[:, None]).T @ A
        if np.linalg.cond(normal) > 1e9:
            return None
        ds, db = np.linalg.solve(normal, -(A * w[:, None]).T @ v)
        s, b = float(np.clip(s + ds, -1, 1)), b + float(db)
    good = moving & (np.abs(miss(s) - b) < FITS_PX)
    if abs(s) > FARTHEST or good.sum() < max(FEWEST, LEAST * moving.sum()):
        return None
    frame = np.repeat(np.arange(len(followed)), [len(f.misses) for f in followed])
    sigma = _sigma(A, w, miss(s) - b, frame)
    readout, readout_sigma = _readout(e, s, b, frame)
    certain, by = _inliers(followed), s if abs(s) > max(LEAST_OFFSET, SIGNIFICANT * sigma) else 0.0
    return TimeOffset(
        view=name,
        delay_frames=-(lag + s),
        sigma_frames=sigma,
        method="rays",
        moving=int(good.sum()),
        speed_px=float(np.percentile(np.abs(rate[good]), 90)),
        miss_px=float(np.median(np.abs(miss(by)[certain]))) if len(certain) else np.nan,
        readout_frames=readout,
        readout_sigma=readout_sigma,
    )


def _inliers(followed: list[_Followed]) -> np.ndarray:
    """Rows (n,) of all frames' matches, concatenated, that agree with one epipolar geometry of their own; empty if most do not."""
    first = followed[0].matches
    xi, xj = (np.concatenate([getattr(f.matches, name) for f in followed]) for name in ("xi_px", "xj_px"))
    rows = PairMatches(i=first.i, j=first.j, xi_px=xi, xj_px=xj).inliers()
    return np.zeros(0, dtype=int) if rows is None else rows


def _readout(e: np.ndarray, s: float, b: float, frame: np.ndarray) -> tuple[float, float]:
    """r in frames, and its sigma, from the misses (m, 4) and the solution of (3); not known where all moves in the same row.  (4)"""
    rate, bend, y = (e[:, 2] - e[:, 0]) / 2, (e[:, 2] - 2 * e[:, 1] + e[:, 0]) / 2, e[:, 3]
    unknowns = np.array([0.0, s, b])
    for _ in range(STEPS):
        at = unknowns[1] - unknowns[0] * y
        v = e[:, 1] + at * rate + at**2 * bend - unknowns[2]
        w = 1 / (1 + (v / SCALE_PX) ** 2)
        slope = rate + 2 * at * bend
        A = np.stack([-y * slope, slope, -np.ones_like(rate)], axis=1)
        normal = (A * w[:, None]).T @ A
        if np.linalg.cond(normal) > 1e9:
            return np.nan, np.inf
        unknowns += np.linalg.solve(normal, -(A * w[:, None]).T @ v)
        unknowns[:2] = np.clip(unknowns[:2], -1, 1)
    band = np.floor(BANDS * (y + 0.5))  # what one part of the body shows otherwise than another, it shows in all frames, at its rows
    return float(unknowns[0]), max(_sigma(A, w, v, frame), _sigma(A, w, v, band))


def _sigma(A: np.ndarray, w: np.ndarray, v: np.ndarray, frame: np.ndarray) -> float:
    """Sigma of the first unknown: the larger one of the adjustment's and, of more than one, of what leaving out single frames does.

    In the place of frames other groups may stand.
    """
    normal, gradient = (A * w[:, None]).T @ A, A * (w * v)[:, None]
    changes, groups = list[float](), np.unique(frame)  # of the first unknown, when a group is left out: the jackknife (Tukey 1958)
    for f in groups if len(groups) > 1 else ():
        own = frame == f
        rest = normal - (A[own] * w[own, None]).T @ A[own]
        if np.linalg.cond(rest) > 1e9:
            return np.inf
        changes.append(float(np.linalg.solve(rest, gradient[own].sum(axis=0))[0]))
    between = (1 - 1 / len(groups)) * float(np.square(changes).sum())
    within = float(np.linalg.inv(normal)[0, 0] * (w * v**2).sum() / max(w.sum() - 2, 1))
    return float(np.sqrt(max(between, within)))
