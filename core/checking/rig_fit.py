"""Does the rig belong to the footage? What looks alike in two views must lie on the rig's epipolar lines, before both cameras."""

from collections.abc import Sequence
from itertools import combinations, permutations

import cv2
import numpy as np

from ..geometry.camera import Camera
from .findings import Finding, doubtful, wrong
from .view_matches import PairMatches

LIMIT_PX = 2.0
ENOUGH = 12  # matches of a pair
AGREES, AGREES_SWAPPED, AGREES_WELL, MORE = 0.5, 0.7, 0.9, 0.15  # share of the matches
SAME_PLACE_PX, SAME_SHARE = 0.7, 0.8
MOST_PERMUTED = 5  # views of which every order is tried; of more, every pair is exchanged
STALE_PX = 1.0


def same_views(pairs: Sequence[PairMatches], names: Sequence[str]) -> list[Finding]:
    """Pairs of views that show the same picture."""
    found = []
    for pair in pairs:
        shift = np.linalg.norm(pair.xi_px - pair.xj_px, axis=1)
        if len(shift) >= ENOUGH and np.mean(shift < SAME_PLACE_PX) > SAME_SHARE:
            a, b = names[pair.i], names[pair.j]
            found.append(
                wrong(
                    "identical views",
                    f"Views {a} and {b} show the same picture: {len(shift)} points lie at the same pixels in both.",
                    f"Give view {a} or {b} the footage of its own camera in take.toml.",
                    matches=len(shift),
                    median_shift_px=float(np.median(shift)),
                )
            )
    return found


def share(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> float:
    """The part of all matches that the cameras, in this order, agree with."""
    total = sum(len(p.xi_px) for p in pairs)
    return float(sum(p.agreeing(cameras, LIMIT_PX).sum() for p in pairs) / total) if total else 0.0


def rig_findings(pairs: Sequence[PairMatches], cameras: Sequence[Camera], names: Sequence[str]) -> list[Finding]:
    """Views that are exchanged, or a rig of another recording; nothing where there is too little to judge by."""
    usable = [p for p in pairs if len(p.xi_px) >= ENOUGH]
    agreeing = share(usable, cameras)
    if not usable or agreeing >= AGREES_WELL:
        return []
    order, best = _best_order(usable, cameras)
    misses = _misses(usable, cameras)
    figures = {"matches": len(misses), "agreeing_share": agreeing, "miss_px": float(np.median(misses))}
    better = np.median(_misses(usable, [cameras[k] for k in order])) < 0.5 * np.median(misses)
    if best > max(AGREES_SWAPPED, agreeing + MORE) and better:
        moved = [k for k in range(len(names)) if order[k] != k]
        said = ", ".join(f"view {names[k]} fits camera {cameras[order[k]].name}" for k in moved)
        swapped = " and ".join(names[k] for k in moved)
        return [
            wrong(
                "swapped views",
                f"The views {swapped} are swapped: {said} ({100 * best:.0f} % of {len(misses)} "
                f"matches agree, {100 * agreeing:.0f} % as it stands).",
                "Exchange their footage in take.toml, or the cameras' names in rig.toml.",
                **(figures | {"agreeing_swapped_share": best}),
            )
        ]
    if agreeing >= AGREES or _own_geometry(usable) < AGREES:
        return []
    return [
        wrong(
            "foreign rig",
            f"Matches lie {np.median(misses):.0f} px off the epipolar lines (median "
            f"of {len(misses)}), though they agree with each other: rig.toml does not belong to this recording, or a camera was "
            "moved.",
            "Use the calibration of this recording, or calibrate again.",
            **figures,
        )
    ]


def _misses(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> np.ndarray:
    return np.abs(np.concatenate([p.miss_px(cameras) for p in pairs]))


def stale_finding(miss_px: dict[str, float]) -> list[Finding]:
    """A rig that nearly fits: `miss_px` is each view's median miss where time plays no part."""
    worst = max(miss_px, key=lambda name: miss_px[name], default=None)
    if worst is None or not miss_px[worst] > STALE_PX:
        return []
    return [
        doubtful(
            "stale calibration",
            f"Matches of view {worst} lie {miss_px[worst]:.1f} px off the epipolar lines (median): the calibration is not "
            "quite that of this footage.",
            "A camera may have been knocked or refocused since; calibrate again.",
            miss_px=miss_px[worst],
        )
    ]


def _best_order(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> tuple[tuple[int, ...], float]:
    """The order of the cameras that most matches agree with, and their share."""
    count = len(cameras)
    own = tuple(range(count))
    orders = list(permutations(own)) if count <= MOST_PERMUTED else [_exchanged(own, a, b) for a, b in combinations(own, 2)]
    shares = [share(pairs, [cameras[k] for k in order]) for order in orders]
    return orders[int(np.argmax(shares))], max(shares)


def _exchanged(order: tuple[int, ...], a: int, b: int) -> tuple[int, ...]:
    changed = list(order)
    changed[a], changed[b] = order[b], order[a]
    return tuple(changed)


def _own_geometry(pairs: Sequence[PairMatches]) -> float:
    """The part of the matches that agree with a fundamental matrix of its own, in the best pair: no noise (MAGSAC++)."""
    best = 0.0
    for pair in pairs:
        F, inlier = cv2.findFundamentalMat(
            np.ascontiguousarray(pair.xi_px), np.ascontiguousarray(pair.xj_px), cv2.USAC_MAGSAC, LIMIT_PX, 0.999, 4000
        )
        if F is not None and inlier is not None:
            best = max(best, float(np.mean(inlier)))
    return best
