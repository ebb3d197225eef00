"""`tricap check rig.toml`: implausible cameras, and the quality that the calibration itself reported.

Does the rig belong to the footage? Matched points must lie on the rig's epipolar lines, in front of both cameras.

Views from very different sides, carpets and rows of chairs produce false matches. So only those pairs of views are used most of whose
matches agree with one epipolar geometry of their own (`PairMatches.inliers`), and of these pairs only the inliers. Clicks in both views
of such a pair can confirm the rig against its matches.
"""

from collections.abc import Sequence
from itertools import combinations, permutations
from pathlib import Path

import numpy as np

from ..calibration.verdict import Light
from ..foundation.errors import InputError
from ..geometry.camera import Camera
from ..geometry.intersection import CLICK_SIGMA_PX
from ..geometry.rig import Rig, read_rig
from ..geometry.view_angles import WIDEST_DEG, axis_angles_deg, no_view_alike
from ..take.take import Take
from .findings import Cause, Checked, Finding, doubtful, wrong
from .view_matches import PairMatches, third_views

FOCAL = (0.4, 12.0)  # of the image's longer side: 103° and 5° of view
OFF_CENTRE = 0.2  # of the image's longer side
FAR_APART_M = 100.0  # longer than any hall
NEAR_M = 0.01  # between all cameras
SAME_PLACE = 0.005  # of the longest base
MOST_COMPARED = 40  # cameras, each with every other one
LARGE_SIGMA0_PX = 1.0
POOR = "Poor"  # first word of a red verdict in a rig.toml that has no `light` yet


def check_rig(path: Path) -> Checked:
    """All checks of a rig that need no footage."""
    try:
        rig = read_rig(path)
    except InputError as error:
        return Checked(subject=str(path), kind="rig", findings=(wrong(Cause.INPUT, str(error)),), figures={})
    findings = [*geometry_findings(rig), *_reported_quality(rig)]
    if len(rig.cameras) < 2:
        findings.append(wrong(Cause.ONE_CAMERA, f"{path.name} has only one camera; depth needs two.", "Calibrate all cameras together."))
    figures = {"cameras": [c.name for c in rig.cameras], "bases_m": _bases(rig.cameras), "metadata": dict(rig.metadata)}
    return Checked(subject=str(path), kind="rig", findings=tuple(findings), figures=figures)


def geometry_findings(rig: Rig) -> list[Finding]:
    """Cameras with implausible interior orientations, cameras at the same position, and cameras without a common field of view."""
    findings = [doubtful(Cause.INPUT, remark, "Correct the file, or calibrate again.") for remark in rig.remarks]
    findings += [finding for camera in rig.cameras for finding in _interior(camera)]
    if len(rig.cameras) > 1:
        longest = max(_bases(rig.cameras).values())
        for pair, base in _bases(rig.cameras).items():
            if base <= SAME_PLACE * longest or longest == 0:
                findings.append(
                    wrong(
                        Cause.SAME_PLACE,
                        f"The cameras {pair} are at the same position; depth needs a distance between them.",
                        "Calibrate again, or remove one of them.",
                        base_m=base,
                    )
                )
        findings += unit_findings(rig)
        if longest > 0 and not _views_overlap(rig.cameras, longest):
            findings.append(
                wrong(
                    Cause.NO_COMMON_VIEW,
                    "No point in space is visible to two of the rig's cameras.",
                    "Is the rig in metres, and are its rotations from the world to the camera?",
                )
            )
    return findings


def wide_findings(cameras: Sequence[Camera], reference: int) -> list[Finding]:
    """Views that look from too far apart for patches to be matched: those that a point needs besides the reference view."""
    degrees = axis_angles_deg(cameras, reference)
    others = sorted((k for k in range(len(cameras)) if k != reference), key=lambda k: degrees[k])[: min(2, len(cameras) - 1)]
    if degrees[others[-1]] <= WIDEST_DEG:
        return []
    nearest = " and ".join(f"{cameras[k].name} ({degrees[k]:.0f}°)" for k in others)
    sentence = (
        f"The views that look most like the reference view {cameras[reference].name} are {nearest}. Texture can be matched up to about "
        f"{WIDEST_DEG:.0f}°, so "
    )
    if no_view_alike(cameras, reference):
        sentence += "no surface is measured: the body is fitted to outlines, clicked joints, and points followed in single views."
        return [doubtful(Cause.FAR_APART, sentence, "For a surface, place neighbouring cameras at most 30° apart.")]
    sentence += "hardly any surface will be measured."
    return [doubtful(Cause.FAR_APART, sentence, "Place neighbouring cameras at most 30° apart.")]


def unit_findings(rig: Rig) -> list[Finding]:
    """Cameras further apart than any hall is long, or nearer to each other than their lenses are wide: their positions are in another unit
    than the file states."""
    longest = max(_bases(rig.cameras).values(), default=0.0)
    if 0 < longest < NEAR_M:
        sentence = (
            f"The cameras are only up to {1000 * longest:.2g} mm apart: rig.toml seems to be in metres, and `unit` to be another one."
        )
        return [wrong(Cause.UNIT, sentence, 'Write unit = "m" under [metadata] of rig.toml, or the unit that it is in.', base_m=longest)]
    if longest < FAR_APART_M:
        return []
    sentence = f"The cameras are up to {longest:.0f} m apart: rig.toml seems to be in millimetres or centimetres, not in metres."
    return [wrong(Cause.UNIT, sentence, 'Write its unit, such as unit = "mm", under [metadata] of rig.toml.', base_m=longest)]


def _interior(camera: Camera) -> list[Finding]:
    side = max(camera.size_px)
    focal, centre = camera.focal_px / side, np.abs(camera.matrix[:2, 2] - (np.array(camera.size_px) - 1) / 2).max() / side
    faults = []
    if not FOCAL[0] < focal < FOCAL[1]:
        faults.append(f"a focal length of {camera.focal_px:.0f} px, {focal:.2g} times its image's width")
    if centre > OFF_CENTRE:
        faults.append(f"a principal point {centre * side:.0f} px off the image's centre")
    if _folds(camera):
        faults.append("a distortion that folds the image over before its corners")
    return (
        [
            doubtful(
                Cause.ODD_CAMERA,
                f"Camera {camera.name} has {' and '.join(faults)}.",
                "Was it calibrated at the footage's resolution, and the footage not cropped or scaled since? Calibrate again.",
                focal_px=camera.focal_px,
                off_centre_px=float(centre * side),
            )
        ]
        if faults
        else []
    )


def _folds(camera: Camera) -> bool:
    """Whether the distorted radius stops increasing inside the image:  d/dr (r L(r)) ≤ 0."""
    if camera.fisheye:
        t = np.linspace(0, np.arctan(camera.field_radius), 400) ** 2
        return bool((1 + sum((2 * n + 3) * k * t ** (n + 1) for n, k in enumerate(camera.distortions[:4])) <= 0).any())
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


def _views_overlap(cameras: Sequence[Camera], base_m: float) -> bool:
    """Whether any point in front of one camera, at any plausible depth, projects into another camera's image. Of many cameras, some are
    compared."""
    cameras = cameras[:: -(-len(cameras) // MOST_COMPARED)]
    for a in cameras:
        w, h = a.size_px
        xy = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 9)), axis=-1).reshape(-1, 1, 2)
        points = a.points_at_depth(xy, np.broadcast_to(np.geomspace(0.3, 100, 24) * base_m, (len(xy), 24)))
        if any(b.sees(b.project(points)).any() for b in cameras if b is not a):
            return True
    return False


def _reported_quality(rig: Rig) -> list[Finding]:
    """A poor quality that the calibration itself reported."""
    findings = []
    sigma0, error = rig.metadata.get("sigma0_px"), rig.metadata.get("predicted_error_m")
    verdict, light = str(rig.metadata.get("verdict", "")), rig.metadata.get("light")
    if light == Light.RED or (light is None and verdict.startswith(POOR)):
        findings.append(
            doubtful(
                Cause.POOR_CALIBRATION,
                f"The calibration reported: {verdict}",
                "Calibrate again; `tricap calibrate --report` tells what would improve it.",
                predicted_error_m=error,
            )
        )
    if isinstance(sigma0, float) and sigma0 > LARGE_SIGMA0_PX:
        findings.append(
            doubtful(
                Cause.POOR_CALIBRATION,
                f"The calibration's residuals are {sigma0:.1f} px (sigma0).",
                "Were the cameras synchronised and the targets in focus? Calibrate again.",
                sigma0_px=sigma0,
            )
        )
    return findings


LIMIT_PX = 2.0  # distance from the epipolar line at which a match agrees with the rig
FEWEST_MATCHES = 12  # of a pair of views, to compare them
FEWEST_CLICKS = 6  # of a pair of views, to confirm a rig
AGREES = 0.5  # share of the matches: below, the rig is foreign
AGREES_WELL = 0.9  # share of the matches: above, nothing is in doubt
AGREES_SWAPPED = 0.7  # share of the matches that swapped views must reach
SWAPPED_GAIN = 0.15  # by which the share must rise when the views are swapped
SWAPPED_DISTANCE = 0.5  # times the distance from the epipolar lines as it stands, at most, when the views are swapped
SAME_PLACE_PX = 0.7  # two views are identical when so many matches are displaced by less
SAME_SHARE = 0.8  # of the matches
CLICKS_CONFIRM = 0.5  # times the distance of the matches: clicks that are nearer than that confirm the rig
MOST_PERMUTED = 5  # views of which every order is tried; of more, every pair is exchanged
MOVED_PX = 2.0  # along the epipolar lines of a third view; sound rigs have 0.1, with real cameras up to 1.1, and 1 cm makes 2 to 16
MOVED_SPREADS = 2.0  # of the median deviations: a moving person of a late view has larger ones
STALE_PX = 1.0  # median distance from the epipolar lines; a sound rig has 0.4 to 0.8


def same_views(pairs: Sequence[PairMatches], names: Sequence[str]) -> list[Finding]:
    """Pairs of views that show the same image."""
    findings = []
    for pair in pairs:
        shift = np.linalg.norm(pair.xi_px - pair.xj_px, axis=1)
        if len(shift) >= FEWEST_MATCHES and np.mean(shift < SAME_PLACE_PX) > SAME_SHARE:
            a, b = names[pair.i], names[pair.j]
            findings.append(
                wrong(
                    Cause.IDENTICAL_VIEWS,
                    f"Views {a} and {b} show the same image: {len(shift)} points lie at the same pixels in both.",
                    f"Give view {a} or {b} the footage of its own camera in take.toml.",
                    matches=len(shift),
                    median_shift_px=float(np.median(shift)),
                )
            )
    return findings


def agreeing_share(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> float:
    """The share of all matches that agree with the cameras in this order."""
    total = sum(len(p.xi_px) for p in pairs)
    return float(sum(p.agreeing(cameras, LIMIT_PX).sum() for p in pairs) / total) if total else 0.0


def rig_findings(
    pairs: Sequence[PairMatches],
    clicks: Sequence[PairMatches],
    cameras: Sequence[Camera],
    names: Sequence[str],
    click_sigma_px: float = CLICK_SIGMA_PX,
) -> list[Finding]:
    """Swapped views, or the rig of another recording; nothing where there are too few matches to judge by.

    `clicks` are the points clicked in both views of each pair (`clicked_pairs`).
    """
    usable = [own for p in pairs if (own := p.consistent()) is not None]
    agreeing = agreeing_share(usable, cameras)
    if not usable or agreeing >= AGREES_WELL:
        return []
    order, best = _best_order(usable, cameras)
    distances = _distances(usable, cameras)
    figures = {"matches": len(distances), "agreeing_share": agreeing, "miss_px": float(np.median(distances))}
    better = np.median(_distances(usable, [cameras[k] for k in order])) < SWAPPED_DISTANCE * np.median(distances)
    if best > max(AGREES_SWAPPED, agreeing + SWAPPED_GAIN) and better:
        moved = [k for k in range(len(names)) if order[k] != k]
        pairing = ", ".join(f"view {names[k]} fits camera {cameras[order[k]].name}" for k in moved)
        swapped = " and ".join(names[k] for k in moved)
        return [
            wrong(
                Cause.SWAPPED_VIEWS,
                f"The views {swapped} are swapped: {pairing} ({100 * best:.0f} % of {len(distances)} "
                f"matches agree, {100 * agreeing:.0f} % in the present order).",
                "Swap their footage in take.toml, or the names of the cameras in rig.toml.",
                **(figures | {"agreeing_swapped_share": best, "camera_of": {names[k]: cameras[order[k]].name for k in range(len(names))}}),
            )
        ]
    of_pairs = [c for c in clicks if len(c.xi_px) and (c.i, c.j) in {(p.i, p.j) for p in usable}]
    clicked = _distances(of_pairs, cameras) if of_pairs else np.zeros(0)
    confirmed = len(clicked) >= FEWEST_CLICKS and np.median(clicked) < min(click_sigma_px, CLICKS_CONFIRM * figures["miss_px"])
    if agreeing >= AGREES or confirmed:
        return []
    return [
        wrong(
            Cause.FOREIGN_RIG,
            f"Matches lie {np.median(distances):.0f} px off the epipolar lines (median "
            f"of {len(distances)}), although they agree with each other: rig.toml does not belong to this recording, or a camera was "
            "moved.",
            "Use the calibration of this recording, or calibrate again.",
            **figures,
        )
    ]


def _distances(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> np.ndarray:
    return np.abs(np.concatenate([p.epipolar_distance_px(cameras) for p in pairs]))


def rig_distances(pairs: Sequence[PairMatches], cameras: Sequence[Camera], names: Sequence[str]) -> dict[str, float]:
    """Median distance [px] of each view's inliers from the epipolar lines, in its best pair; views without inliers are left out."""
    distance: dict[str, float] = {}
    for own in (own for p in pairs if (own := p.consistent()) is not None):
        median = float(np.median(np.abs(own.epipolar_distance_px(cameras))))
        for name in (names[own.i], names[own.j]):
            distance[name] = min(median, distance.get(name, np.inf))
    return distance


def stale_finding(distance_px: dict[str, float]) -> list[Finding]:
    """A rig that nearly fits: `distance_px` is each view's median distance from the epipolar lines, free of time offsets."""
    worst = max(distance_px, key=lambda name: distance_px[name], default=None)
    if worst is None or not distance_px[worst] > STALE_PX:
        return []
    return [
        doubtful(
            Cause.STALE_CALIBRATION,
            f"Matches of view {worst} lie {distance_px[worst]:.1f} px off the epipolar lines (median): the calibration does "
            "not quite fit this footage.",
            "A camera may have been knocked or refocused since; calibrate again.",
            miss_px=distance_px[worst],
        )
    ]


def moved_findings(pairs: Sequence[PairMatches], cameras: Sequence[Camera], names: Sequence[str]) -> list[Finding]:
    """A camera that was moved along its base: every pair of views agrees with the rig, but not three views with each other."""
    usable = [own for p in pairs if (own := p.consistent()) is not None]
    off = [t for t in third_views(usable, cameras) if abs(t.along_px) > max(MOVED_PX, MOVED_SPREADS * t.spread_px)]
    if not off:
        return []
    worst = max(off, key=lambda t: abs(t.along_px))
    a, b, c = (names[k] for k in worst.views)
    return [
        doubtful(
            Cause.STALE_CALIBRATION,
            f"Points that views {a} and {b} place in space lie {abs(worst.along_px):.1f} px off in view {c}, along the epipolar lines "
            f"(median of {worst.points}), although every two of these views agree: the distances of the cameras are not as in rig.toml.",
            "A camera may have been moved towards another one or refocused since; calibrate again.",
            along_px=worst.along_px,
            points=worst.points,
        )
    ]


def _best_order(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> tuple[tuple[int, ...], float]:
    """The order of the cameras with which most matches agree, and their share."""
    count = len(cameras)
    own = tuple(range(count))
    orders = list(permutations(own)) if count <= MOST_PERMUTED else [_exchanged(own, a, b) for a, b in combinations(own, 2)]
    shares = [agreeing_share(pairs, [cameras[k] for k in order]) for order in orders]
    return orders[int(np.argmax(shares))], max(shares)


def _exchanged(order: tuple[int, ...], a: int, b: int) -> tuple[int, ...]:
    changed = list(order)
    changed[a], changed[b] = order[b], order[a]
    return tuple(changed)


def clicked_pairs(take: Take) -> list[PairMatches]:
    """The joints clicked in both views of each pair, in all frames with clicks."""
    names = [v.name for v in take.views]
    clicks = [at for frame in (take.clicks, *take.keyframes) for at in frame.joints.values()]
    pairs = []
    for i, j in combinations(range(len(names)), 2):
        both = [np.stack([at[names[i]], at[names[j]]]) for at in clicks if names[i] in at and names[j] in at]
        xy = np.array(both, dtype=np.float64).reshape(-1, 2, 2)
        pairs.append(PairMatches(i=i, j=j, xi_px=xy[:, 0], xj_px=xy[:, 1]))
    return pairs
