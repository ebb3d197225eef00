"""Does the rig belong to the footage? What looks alike in two views must lie on the rig's epipolar lines, before both cameras.

Views from very different sides, carpets and rows of chairs give matches that are none. So only pairs of views are asked most of whose
matches agree with one epipolar geometry of their own (`PairMatches.inliers`), and of those pairs only the matches that do. What was
clicked in both views of such a pair may speak for the rig against them.
"""

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from ..clicked_points import CLICK_SIGMA_PX
from ..geometry.camera import Camera
from ..take import Take
from .findings import Finding, doubtful, wrong
from .view_matches import PairMatches

LIMIT_PX = 2.0
ENOUGH = 12  # matches of a pair
FEWEST_CLICKS = 6
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


def rig_findings(
    pairs: Sequence[PairMatches], clicks: Sequence[PairMatches], cameras: Sequence[Camera], names: Sequence[str]
) -> list[Finding]:
    """Views that are exchanged, or a rig of another recording; nothing where there is too little to judge by.

    `clicks` are what was clicked in each pair of views (`clicked_pairs`).
    """
    usable = [own for p in pairs if (own := p.consistent()) is not None]
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
    asked = [c for c in clicks if len(c.xi_px) and (c.i, c.j) in {(p.i, p.j) for p in usable}]
    clicked = _misses(asked, cameras) if asked else np.zeros(0)
    vouched = len(clicked) >= FEWEST_CLICKS and np.median(clicked) < min(CLICK_SIGMA_PX, 0.5 * figures["miss_px"])
    if agreeing >= AGREES or vouched:
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


def rig_misses(pairs: Sequence[PairMatches], cameras: Sequence[Camera], names: Sequence[str]) -> dict[str, float]:
    """The median miss [px] of each view's matches in the pair of views that it fits best; views without such a pair are left out."""
    found: dict[str, float] = {}
    for own in (own for p in pairs if (own := p.consistent()) is not None):
        miss = float(np.median(np.abs(own.miss_px(cameras))))
        for name in (names[own.i], names[own.j]):
            found[name] = min(miss, found.get(name, np.inf))
    return found


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


def clicked_pairs(take: Take) -> list[PairMatches]:
    """The joints that were clicked in both of each two views, in all frames with clicks."""
    names = [v.name for v in take.views]
    clicks = [at for seeds in (take.seeds, *take.keyframes) for at in seeds.joints.values()]
    pairs = []
    for i, j in combinations(range(len(names)), 2):
        both = [np.stack([at[names[i]], at[names[j]]]) for at in clicks if names[i] in at and names[j] in at]
        xy = np.array(both, dtype=np.float64).reshape(-1, 2, 2)
        pairs.append(PairMatches(i=i, j=j, xi_px=xy[:, 0], xj_px=xy[:, 1]))
    return pairs
