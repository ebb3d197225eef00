"""Which two of an image's bright spots are the bar's targets: followed through the sequence by dynamic programming.

A state of a frame is an ordered pair of spots, or none; the cheapest sequence of states is found (Viterbi 1967):

    cost of a state = unlike areas + smaller spots than the largest             (1)
    cost of a step  = (way of both targets / expected way)², at most a jump     (2)

Spots that stay where they are while others move are reflections and lamps. Where only one target is seen, it keeps its place in the pair.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from ..values import frozen
from .targets import Targets, TargetStatus

MOST_SPOTS = 6
STILL_PX, STILL_PART = 1.5, 0.5  # a spot within STILL_PX in more than this part of the frames stands still
MIN_STILL_FRAMES, FRAMES_ASKED = 8, 80  # so many frames tell what stands still, however long the sequence is
EXPECTED_WAY = 0.05  # of the image width, from frame to frame
SMALLEST_WIDTH = 0.6  # of the targets' expected width
JUMP, NOTHING = 6.0, 8.0  # costs
LIKE_AREAS, LARGE = 1.0, 1.0  # weights of (1)
GATE = 0.03  # of the image width: a single target lies this near to where it is expected
MOST_GAP = 3  # frames over which a place is expected


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarTrack:
    """The bar's targets in one view: `xy_px` (T, 2, 2), NaN: not seen; the order of the two holds over time but not between views."""

    xy_px: np.ndarray
    spots: np.ndarray  # (T,) number of spots found
    still: bool  # the spots do not move

    def __post_init__(self) -> None:
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (None, 2, 2), name="xy_px"))
        object.__setattr__(self, "spots", frozen(self.spots, (len(self.xy_px),), np.int64, "spots"))


def track_bar(frames: Sequence[Targets], width_px: float, diameter: float = 0.0) -> BarTrack:
    """Follow the bar's two targets through the frames of one view.

    `diameter` of the targets as a part of the bar's length: what is foreshortened is the bar, so no true pair is smaller for its distance.
    """
    spots = np.array([len(t.xy_px) for t in frames])
    usable = [np.flatnonzero(t.status == TargetStatus.OK) for t in frames]
    moving = _moving(frames, usable)
    two = np.mean([len(m) >= 2 for m in moving]) if len(frames) else 0.0
    still = bool(two < 0.2 * np.mean([len(u) >= 2 for u in usable])) if len(frames) else False
    chosen = usable if still else moving
    xy = [t.xy_px[c[:MOST_SPOTS]] for t, c in zip(frames, chosen)]
    area = [t.area_px[c[:MOST_SPOTS]] for t, c in zip(frames, chosen)]
    track = _in_one_order(_best_sequence(xy, area, width_px, diameter))
    return BarTrack(xy_px=_with_singles(track, xy, width_px), spots=spots, still=still)


def moved_targets(frames: Sequence[Targets]) -> int:
    """How many targets of the last of the frames were not at their place in the one before."""
    xy = frames[-1].xy_px[frames[-1].status == TargetStatus.OK]
    if len(frames) < 2 or not len(frames[-2].xy_px):
        return len(xy)
    return int((np.linalg.norm(xy[:, None] - frames[-2].xy_px[None], axis=2).min(axis=1) >= STILL_PX).sum())


def _moving(frames: Sequence[Targets], usable: list[np.ndarray]) -> list[np.ndarray]:
    """Indices of the spots that do not stand still in most frames."""
    if len(frames) < MIN_STILL_FRAMES:
        return usable
    points = np.concatenate([t.xy_px[u] for t, u in zip(frames, usable)])
    counts = np.zeros(len(points), dtype=int)
    asked = np.unique(np.linspace(0, len(frames) - 1, FRAMES_ASKED).astype(int))
    for xy in (frames[n].xy_px[usable[n]] for n in asked):
        if len(xy):
            counts += ((points[:, None] - xy[None]) ** 2).sum(axis=2).min(axis=1) < STILL_PX**2
    stands = np.split(counts > STILL_PART * len(asked), np.cumsum([len(u) for u in usable])[:-1])
    return [u[~s] for u, s in zip(usable, stands)]


def _best_sequence(xy: list[np.ndarray], area: list[np.ndarray], width_px: float, diameter: float) -> np.ndarray:
    """The cheapest ordered pairs (T, 2, 2), NaN where there is none.  (1), (2)"""
    states = [_pairs(points, size, diameter) for points, size in zip(xy, area)]
    total = np.zeros(1)
    back: list[np.ndarray] = []
    before = np.zeros((0, 2, 2))
    for points, size, pairs in zip(xy, area, states):
        here = points[np.array(pairs, dtype=int).reshape(-1, 2)]
        step = np.full((len(before) + 1, len(here) + 1), JUMP / 2)
        way = np.linalg.norm(before[:, None] - here[None], axis=3) / (EXPECTED_WAY * width_px)
        step[:-1, :-1] = np.minimum(np.sum(way**2, axis=2), JUMP)
        cost = total[:, None] + step
        back.append(np.argmin(cost, axis=0))
        total = cost.min(axis=0) + np.append(_own_cost(size, pairs), NOTHING)
        before = here
    track = np.full((len(xy), 2, 2), np.nan)
    state = int(np.argmin(total))
    for n in range(len(xy) - 1, -1, -1):
        if state < len(states[n]):
            track[n] = xy[n][list(states[n][state])]
        state = int(back[n][state])
    return track


def _pairs(xy: np.ndarray, area: np.ndarray, diameter: float) -> list[tuple[int, int]]:
    """Ordered pairs of spots that are not too small for their distance, for targets of that part of the bar's length."""
    width = 2 * np.sqrt(area / np.pi)
    return [
        (i, j)
        for i, j in permutations(range(len(xy)), 2)
        if min(width[i], width[j]) >= SMALLEST_WIDTH * diameter * np.linalg.norm(xy[i] - xy[j])
    ]


def _in_one_order(track: np.ndarray) -> np.ndarray:
    """The track with its pairs turned round where that is the shorter way across a gap."""
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
    """The track with single targets where the other one is not seen, if they lie where they are expected."""
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
