"""`tricap check rig.toml`: cameras that no calibration should have given, and what the calibration said of itself.

Does the rig belong to the footage? What looks alike in two views must lie on the rig's epipolar lines, before both cameras.

Views from very different sides, carpets and rows of chairs give matches that are none. So only pairs of views are asked most of whose
matches agree with one epipolar geometry of their own (`PairMatches.inliers`), and of those pairs only the matches that do. What was
clicked in both views of such a pair may speak for the rig against them.
"""

from collections.abc import Sequence
from itertools import combinations, permutations
from pathlib import Path

import numpy as np

from ..foundation.errors import InputError
from ..geometry.camera import Camera
from ..geometry.intersection import CLICK_SIGMA_PX
from ..geometry.rig import Rig, read_rig
from ..take.take import Take
from .findings import Checked, Finding, doubtful, wrong
from .view_matches import PairMatches

FOCAL = (0.4, 12.0)  # of the image's longer side: 103° and 5° of view
OFF_CENTRE = 0.2  # of the image's longer side
FAR_APART_M = 100.0
SAME_PLACE = 0.005  # of the longest base
SIGMA0_PX = 1.0


def check_rig(path: Path) -> Checked:
    """Everything that can be said of a rig without footage."""
    try:
        rig = read_rig(path)
    except InputError as error:
        return Checked(subject=str(path), kind="rig", findings=(wrong("input", str(error)),), figures={})
    found = [*geometry_findings(rig), *_own_word(rig)]
    if len(rig.cameras) < 2:
        found.append(wrong("one camera", f"{path.name} has one camera only; depth needs two.", "Calibrate all cameras together."))
    figures = {"cameras": [c.name for c in rig.cameras], "bases_m": _bases(rig.cameras), "metadata": dict(rig.metadata)}
    return Checked(subject=str(path), kind="rig", findings=tuple(found), figures=figures)


def geometry_findings(rig: Rig) -> list[Finding]:
    """Cameras with impossible or doubtful interiors, at one place, or that look at nothing together."""
    found = [finding for camera in rig.cameras for finding in _interior(camera)]
    if len(rig.cameras) > 1:
        longest = max(_bases(rig.cameras).values())
        for pair, base in _bases(rig.cameras).items():
            if base <= SAME_PLACE * longest or longest == 0:
                found.append(
                    wrong(
                        "same place",
                        f"The cameras {pair} stand at the same place; depth needs a distance between them.",
                        "Calibrate again, or take one of them out.",
                        base_m=base,
                    )
                )
        found += unit_findings(rig)
        if longest > 0 and not _look_together(rig.cameras, longest):
            found.append(
                wrong(
                    "no common view",
                    "No place in space is seen by two of the rig's cameras.",
                    "Is the rig in metres, and are its rotations from the world to the camera?",
                )
            )
    return found


def unit_findings(rig: Rig) -> list[Finding]:
    """Cameras that stand further apart than any hall is long: their places are in another unit than it says."""
    longest = max(_bases(rig.cameras).values(), default=0.0)
    if longest < FAR_APART_M:
        return []
    said = f"The cameras stand up to {longest:.0f} m apart: rig.toml seems to be in millimetres or centimetres, not in metres."
    return [wrong("unit", said, 'Write its unit, such as unit = "mm", under [metadata] of rig.toml.', base_m=longest)]


def _interior(camera: Camera) -> list[Finding]:
    side = max(camera.size_px)
    focal, centre = camera.focal_px / side, np.abs(camera.matrix[:2, 2] - (np.array(camera.size_px) - 1) / 2).max() / side
    said = []
    if not FOCAL[0] < focal < FOCAL[1]:
        said.append(f"a focal length of {camera.focal_px:.0f} px, {focal:.2g} times its image's width")
    if centre > OFF_CENTRE:
        said.append(f"a principal point {centre * side:.0f} px off the image's middle")
    if _folds(camera):
        said.append("a distortion that folds the image over before its corners")
    return (
        [
            doubtful(
                "odd camera",
                f"Camera {camera.name} has {' and '.join(said)}.",
                "Was it calibrated in the footage's resolution, not cropped or scaled since? Calibrate again.",
                focal_px=camera.focal_px,
                off_centre_px=float(centre * side),
            )
        ]
        if said
        else []
    )


def _folds(camera: Camera) -> bool:
    """Whether the radial distortion stops growing outwards inside the image:  d/dr (r L(r)) ≤ 0."""
    k1, k2, _, _, k3 = camera.distortions
    w, h = camera.size_px
    corners = np.abs(np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]) - camera.matrix[:2, 2]) / np.diag(camera.matrix)[:2]
    reached, want = 0.0, float(np.linalg.norm(corners, axis=1).max())
    for r in np.linspace(0, 2 * want, 400):
        if 1 + 3 * k1 * r**2 + 5 * k2 * r**4 + 7 * k3 * r**6 <= 0:
            return reached < want
        reached = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
        if reached >= want:
            return False
    return reached < want


def _bases(cameras: Sequence[Camera]) -> dict[str, float]:
    return {f"{a.name}-{b.name}": float(np.linalg.norm(a.centre_m - b.centre_m)) for i, a in enumerate(cameras) for b in cameras[i + 1 :]}


def _look_together(cameras: Sequence[Camera], base_m: float) -> bool:
    """Whether some place before one camera, at any depth that could be meant, is inside another camera's image."""
    for a in cameras:
        w, h = a.size_px
        xy = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 9)), axis=-1).reshape(-1, 1, 2)
        points = a.points_at_depth(xy, np.broadcast_to(np.geomspace(0.3, 100, 24) * base_m, (len(xy), 24)))
        if any(b.sees(b.project(points)).any() for b in cameras if b is not a):
            return True
    return False


def _own_word(rig: Rig) -> list[Finding]:
    """What the calibration wrote about itself."""
    found = []
    sigma0, error = rig.metadata.get("sigma0_px"), rig.metadata.get("predicted_error_m")
    verdict = rig.metadata.get("verdict")
    if isinstance(verdict, str) and verdict.startswith("Poor"):
        found.append(
            doubtful(
                "poor calibration",
                f"The calibration said of itself: {verdict}",
                "Calibrate again; `tricap calibrate --report` says what to do better.",
                predicted_error_m=error,
            )
        )
    if isinstance(sigma0, float) and sigma0 > SIGMA0_PX:
        found.append(
            doubtful(
                "poor calibration",
                f"The calibration's residuals are {sigma0:.1f} px (sigma0).",
                "Were the cameras in step and the targets in focus? Calibrate again.",
                sigma0_px=sigma0,
            )
        )
    return found


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
    pairs: Sequence[PairMatches],
    clicks: Sequence[PairMatches],
    cameras: Sequence[Camera],
    names: Sequence[str],
    click_sigma_px: float = CLICK_SIGMA_PX,
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
    vouched = len(clicked) >= FEWEST_CLICKS and np.median(clicked) < min(click_sigma_px, 0.5 * figures["miss_px"])
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
    clicks = [at for frame in (take.clicks, *take.keyframes) for at in frame.joints.values()]
    pairs = []
    for i, j in combinations(range(len(names)), 2):
        both = [np.stack([at[names[i]], at[names[j]]]) for at in clicks if names[i] in at and names[j] in at]
        xy = np.array(both, dtype=np.float64).reshape(-1, 2, 2)
        pairs.append(PairMatches(i=i, j=j, xi_px=xy[:, 0], xj_px=xy[:, 1]))
    return pairs
