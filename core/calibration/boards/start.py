"""Initial values from nothing but the corners and the size of the squares: lenses, poses of the cameras, positions of the board.

1  each camera by itself: f and the radial distortion κ on a grid, with the poses of the board from its homographies (IPPE, Collins &
   Bartoli 2014); the best is adjusted robustly with f, k1, then k2 and the principal point;
2  each pair of cameras: every position of the board that both show proposes their relative pose, once for each of the two poses that a
   plane may have in each image and each order of its corners; the proposal wins that predicts the corners of most other positions;
3  the pairs that agree in most positions form a tree, along which the cameras are chained;
4  each position: the pose with which most cameras agree. A camera that disagrees was not synchronised there; what it shows becomes a
   position of its own, which still supports its lens.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...foundation.errors import InputError
from ...geometry.camera import INTERIOR, Camera
from ...geometry.robust import masked_median
from ..bars import undistorted
from ..bundle import LevenbergMarquardt, adjust
from ..network import BoardNetwork
from ..reference_bar import COARSE_CAUCHY_PX, FOCAL_GRID, KAPPAS, ROUGH_FOCALS, lens_prior
from .board import Lens
from .detection import FEWEST_CORNERS
from .observations import BoardObservations

GRID_POSITIONS = 24  # from which the lens of a camera is found
LENS_POSITIONS = 60  # with which it is adjusted
WILD_FISHEYE = 0.6  # the same for a fisheye lens, whose images of a plane are bent
FISHEYE_GRID = np.geomspace(0.2, 1.0, 14)  # focal lengths in widths
WIDE_ANGLE = 0.75  # widths: a camera with a shorter focal length may have a fisheye lens
CLEAR = 20.0  # 2 n ln(cost / cost): the lens that fits n image points better is clear
WIDEST = 1.5  # radians from the axis
WILD = 0.25  # of a square's side: corners that are further from the homography of their view are not used
PROPOSALS = 40  # positions that propose the relative pose of a pair
JUDGES = 80  # positions that judge the proposals
AGREES = 0.02  # of the focal length: median distance of predicted corners
FEWEST_SHARED = 4  # positions in which two cameras agree
SOLUTIONS = 2  # poses of a plane


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Started:
    """Initial values, and the observations with their corners in order and unsynchronised views apart."""

    network: BoardNetwork
    observations: BoardObservations


def without_wild(observations: BoardObservations, wild: float = WILD) -> BoardObservations:
    """The observations without corners that do not fit the homography of their view, and without views with too few corners."""
    xy = observations.xy_px.copy()
    plane = observations.board.corners_m[:, :2]
    for i, c in np.argwhere(observations.views(observations.visible)):
        shown = np.isfinite(xy[i, c, :, 0])
        F, fits = cv2.findHomography(
            plane[shown] / observations.board.square_m, xy[i, c, shown], cv2.RANSAC, _tolerance_px(xy[i, c], observations, wild)
        )
        keep = np.zeros(len(plane), dtype=bool)
        if F is not None:
            keep[np.flatnonzero(shown)[fits.ravel() > 0]] = True
        xy[i, c, ~keep] = np.nan
    visible = np.isfinite(xy[..., 0])
    return observations.changed(np.where(observations.supported(visible)[..., None], xy, np.nan))


def _tolerance_px(xy_px: np.ndarray, observations: BoardObservations, wild: float) -> float:
    columns, rows = observations.board.grid
    grid = xy_px.reshape(rows, columns, 2)
    sides = np.concatenate([np.linalg.norm(np.diff(grid, axis=a), axis=-1).ravel() for a in (0, 1)])
    sides = sides[np.isfinite(sides)]
    return max(1.0, wild * float(np.median(sides))) if len(sides) else 1.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Lenses:
    """The first values of the lenses."""

    interior: np.ndarray  # (C, 10)
    fisheye: np.ndarray  # (C,)


def with_lenses(observations: BoardObservations, focal_px: float | None, lens: Lens) -> tuple[BoardObservations, Lenses]:
    """The observations without wild corners, and the lens of each camera from its own images.

    A wide-angle camera has the model that fits its images better; which views of a board a homography fits depends on it.
    """
    plain = without_wild(observations, WILD_FISHEYE if lens is Lens.FISHEYE else WILD)
    every = [plain.of_camera(c) for c in range(len(observations.names))]
    if lens is not Lens.AUTO:
        curved = lens is Lens.FISHEYE
        interior = np.stack([_lens(part, focal_px, curved)[0] for part in every])
        return plain, Lenses(interior=interior, fisheye=np.full(len(every), curved))
    lenses = _fitting(every, focal_px)
    return without_wild(observations, WILD_FISHEYE) if lenses.fisheye.any() else plain, lenses


def _fitting(every: list[BoardObservations], focal_px: float | None) -> Lenses:
    """The lens of each camera that fits its images better; where this is not clear, that of the other wide-angle cameras."""
    brown = [_lens(one, focal_px, False) for one in every]
    wide = [interior[0] < WIDE_ANGLE * one.size_px[0, 0] for (interior, _), one in zip(brown, every)]
    both = [[_lens(one, focal_px, curved, True) for curved in (False, True)] if w else [] for one, w in zip(every, wide)]
    better = np.array([2 * one.visible.sum() * np.log(b[0][1] / b[1][1]) if b else 0.0 for one, b in zip(every, both)])
    fisheye = np.array(wide) & np.where(np.abs(better) > CLEAR, better > 0, better.sum() > CLEAR)
    interior = [b[1][0] if curved else first for b, curved, (first, _) in zip(both, fisheye, brown)]
    return Lenses(interior=np.stack(interior), fisheye=fisheye)


def initial_network(observations: BoardObservations, lenses: Lenses) -> Started:
    """Lenses, poses and positions.

    Raises:
        InputError: a camera never shows the board, or shares too few positions with the others.
    """
    interior = lenses.interior
    identity = np.zeros((len(interior), 3, 3)) + np.eye(3)
    rough = BoardNetwork(
        interior=interior, R=identity, t=np.zeros((len(interior), 3)), fisheye=lenses.fisheye, corners_m=observations.board.corners_m,
        R_board=np.zeros((0, 3, 3)), t_board=np.zeros((0, 3)),
    )  # fmt: skip
    cameras = rough.cameras(observations.names, observations.size_px)
    plane = _plane_poses(observations, cameras)
    R, t = _chained(observations, cameras, plane)
    return _positions(observations, replace(rough, R=R, t=t), plane)


def _lens(one: BoardObservations, focal_px: float | None, fisheye: bool, whole: bool = False) -> tuple[np.ndarray, float]:
    """The interior unknowns (10,) of a camera from its own images, and the cost of the robust adjustment per image point."""
    width, height = one.size_px[0]
    some = one.part(_spread(one, GRID_POSITIONS))
    grid = focal_px * ROUGH_FOCALS if focal_px is not None else (FISHEYE_GRID if fisheye else FOCAL_GRID) * float(width)
    best = (np.inf, float(np.median(grid)), 0.0)
    for kappa in (0.0,) if fisheye else KAPPAS:
        u = undistorted(some.xy_px[:, 0], one.size_px[0], kappa)
        for f in grid:
            images = _flat(u / f) if fisheye else u / f
            cost = sum(_ippe(one.board.corners_m, x)[0][2] * f for x in images)
            best = min(best, (float(cost), float(f), kappa))
    interior = np.zeros(len(INTERIOR))
    interior[:4] = best[1], (width - 1) / 2, (height - 1) / 2, best[2] / (float(one.size_px[0] @ one.size_px[0]) / 4 / best[1] ** 2)
    more = one.part(_spread(one, LENS_POSITIONS))
    network = single_camera(more, interior, fisheye)
    prior = lens_prior(more.size_px, network.interior[:, 0], network.fisheye)
    cost = np.inf
    for names in (("f", "k1"), ("f", "cx", "cy", "k1", "k2"), ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2"))[: 3 if whole else 2]:
        done = adjust(
            network, more.xy_px, more.visible, prior.only(*names), cauchy_px=COARSE_CAUCHY_PX, unit_px=0.3,
            iteration=LevenbergMarquardt(max_iterations=12, tolerance=1e-2),
        )  # fmt: skip
        network, cost = done.network, done.cost
    return np.asarray(network.interior[0]), cost / max(int(more.visible.sum()), 1)


def _flat(angles: np.ndarray) -> np.ndarray:
    """Image points (…, 2) of a central projection with focal length 1, from those of an equidistant lens, θ = r."""
    theta = np.linalg.norm(angles, axis=-1, keepdims=True)
    near = np.minimum(theta, WIDEST)
    return np.asarray(angles * np.where(theta > 1e-9, np.tan(near) / np.maximum(theta, 1e-9), 1.0))


def single_camera(one: BoardObservations, interior: np.ndarray, fisheye: bool) -> BoardNetwork:
    """One camera at the origin with its positions of the board."""
    network = BoardNetwork(
        interior=interior[None], R=np.eye(3)[None], t=np.zeros((1, 3)), fisheye=np.array([fisheye]), corners_m=one.board.corners_m,
        R_board=np.zeros((0, 3, 3)), t_board=np.zeros((0, 3)),
    )  # fmt: skip
    camera = network.cameras(one.names, one.size_px)[0]
    poses = [_ippe(one.board.corners_m, n)[0] for n in camera.directions(one.xy_px[:, 0])[..., :2]]
    return replace(network, R_board=np.stack([p[0] for p in poses]), t_board=np.stack([p[1] for p in poses]))


def _spread(one: BoardObservations, count: int) -> np.ndarray:
    """At most `count` positions of one camera that differ most in place, size and shape in the image (farthest points)."""
    xy = one.xy_px[:, 0]
    if len(xy) <= count:
        return np.arange(len(xy))
    with np.errstate(invalid="ignore"):
        middle, low, high = np.nanmean(xy, axis=1), np.nanmin(xy, axis=1), np.nanmax(xy, axis=1)
    size = np.maximum(high - low, 1.0)
    form = np.concatenate([middle / one.size_px[0, 0], np.log(size)], axis=1)
    chosen = [0]
    distance = np.linalg.norm(form - form[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(form - form[chosen[-1]], axis=1))
    return np.array(sorted(chosen))


Pose = tuple[np.ndarray, np.ndarray, float]  # R, t of the board in a camera, and the RMS of its image


def _ippe(corners_m: np.ndarray, image: np.ndarray) -> list[Pose]:
    """The two poses of a plane with these image points (K, 2) of focal length 1, the better one first; far away where there is none."""
    shown = np.isfinite(image[:, 0])
    far = (np.eye(3), np.array([0.0, 0.0, 1e3]), 1.0)
    if shown.sum() < 4:
        return [far, far]
    points = np.ascontiguousarray(corners_m[shown])
    try:
        count, turns, shifts, errors = cv2.solvePnPGeneric(
            points, np.ascontiguousarray(image[shown]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners on one line
        return [far, far]
    found = [(cv2.Rodrigues(r)[0], t.ravel(), float(e)) for r, t, e in zip(turns, shifts, np.ravel(errors)) if t[2] > 0 and np.isfinite(e)]
    found = sorted(found, key=lambda pose: pose[2]) or [far]
    return (found * SOLUTIONS)[:SOLUTIONS] if len(found) < SOLUTIONS else found[:SOLUTIONS]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanePoses:
    """Poses of the board in the frame of each camera, and its image with focal length 1."""

    shown: np.ndarray  # (N, C)
    R: np.ndarray  # (N, C, 2, 3, 3)
    t: np.ndarray  # (N, C, 2, 3)
    image: np.ndarray  # (N, C, K, 2)


def _plane_poses(observations: BoardObservations, cameras: tuple[Camera, ...]) -> PlanePoses:
    N, C = observations.xy_px.shape[:2]
    shown = observations.views(observations.visible)
    image = np.stack([camera.directions(observations.xy_px[:, c])[..., :2] for c, camera in enumerate(cameras)], axis=1)
    R, t = np.zeros((N, C, SOLUTIONS, 3, 3)) + np.eye(3), np.zeros((N, C, SOLUTIONS, 3)) + [0, 0, 1e3]
    for i, c in np.argwhere(shown):
        for s, (turn, shift, _) in enumerate(_ippe(observations.board.corners_m, image[i, c])):
            R[i, c, s], t[i, c, s] = turn, shift
    return PlanePoses(shown=shown, R=R, t=t, image=image)


def _misses(
    corners_m: np.ndarray, R: np.ndarray, t: np.ndarray, image: np.ndarray, symmetries: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Median distance (…,) of the corners of boards with poses R (…, 3, 3), t (…, 3) from an image (…, K, 2), and the order that fits."""
    X = corners_m @ np.swapaxes(R, -1, -2) + t[..., None, :]
    ahead = X[..., 2:] > 0
    x = _angles(np.where(ahead, X[..., :2] / np.where(ahead, X[..., 2:], 1.0), 1e3))
    image = _angles(image)
    with np.errstate(invalid="ignore"):
        every = np.stack([np.linalg.norm(x - image[..., order, :], axis=-1) for order in symmetries])
    known = np.isfinite(every)
    middle = np.where(known.sum(axis=-1) < FEWEST_CORNERS, np.inf, masked_median(every, known))
    return middle.min(axis=0), middle.argmin(axis=0)


def _angles(x: np.ndarray) -> np.ndarray:
    """Points (…, 2) of a central projection with their distance from the axis as an angle, bounded at the edge of wide lenses."""
    r = np.linalg.norm(x, axis=-1, keepdims=True)
    return np.asarray(x * np.arctan(r) / np.maximum(r, 1e-12))


def _pair(observations: BoardObservations, plane: PlanePoses, i: int, j: int) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Positions in which cameras i and j agree, their median distance, and the relative pose x_j = R x_i + t."""
    both = np.flatnonzero(plane.shown[:, i] & plane.shown[:, j])
    nothing = (0, np.inf, np.eye(3), np.zeros(3))
    if not len(both):
        return nothing
    corners, symmetries = observations.board.corners_m, observations.board.symmetries
    judges = both[np.unique(np.linspace(0, len(both) - 1, JUDGES).astype(int))]
    best = nothing
    for n in both[np.unique(np.linspace(0, len(both) - 1, PROPOSALS).astype(int))]:
        for R, t in _proposals(corners, plane, symmetries, n, i, j):
            turned = R @ plane.R[judges, i]  # (m, 2, 3, 3)
            shifted = plane.t[judges, i] @ R.T + t
            miss = _misses(corners, turned, shifted, np.repeat(plane.image[judges, j][:, None], SOLUTIONS, axis=1), symmetries)[0].min(
                axis=1
            )
            agree = miss < AGREES
            rank = (int(agree.sum()), -float(np.median(miss[agree])) if agree.any() else -np.inf)
            if rank > (best[0], -best[1]):
                best = (rank[0], -rank[1], R, t)
    return best[0] * len(both) // len(judges), best[1], best[2], best[3]


def _proposals(
    corners_m: np.ndarray, plane: PlanePoses, symmetries: np.ndarray, n: int, i: int, j: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Relative poses of two cameras from one position of the board."""
    found = []
    for order in symmetries:
        poses = _ippe(corners_m, plane.image[n, j][order]) if len(symmetries) > 1 else list(zip(plane.R[n, j], plane.t[n, j]))
        for pose in poses:
            for s in range(SOLUTIONS):
                R = pose[0] @ plane.R[n, i, s].T
                found.append((R, pose[1] - R @ plane.t[n, i, s]))
    return found


def _chained(observations: BoardObservations, cameras: tuple[Camera, ...], plane: PlanePoses) -> tuple[np.ndarray, np.ndarray]:
    """Poses (C, 3, 3), (C, 3) of the cameras, chained along the tree of the pairs that agree in most positions (Prim's algorithm).

    Raises:
        InputError: a camera agrees with the others in too few positions.
    """
    C = len(cameras)
    pairs = {(i, j): _pair(observations, plane, i, j) for i in range(C) for j in range(C) if i < j}
    R, t = np.zeros((C, 3, 3)) + np.eye(3), np.zeros((C, 3))
    joined = [int(np.argmax([sum(p[0] for k, p in pairs.items() if c in k) for c in range(C)]))]
    while len(joined) < C:
        edges = [(p[0], -p[1], k) for k, p in pairs.items() if (k[0] in joined) != (k[1] in joined)]
        count, _, (i, j) = max(edges)
        if count < FEWEST_SHARED:
            _refuse_alone(observations, plane, [c for c in range(C) if c not in joined], joined, count)
        _, _, R_ij, t_ij = pairs[i, j]
        if i in joined:
            R[j], t[j] = R_ij @ R[i], R_ij @ t[i] + t_ij
            joined.append(j)
        else:
            R[i], t[i] = R_ij.T @ R[j], R_ij.T @ (t[j] - t_ij)
            joined.append(i)
    return R, t


def _refuse_alone(observations: BoardObservations, plane: PlanePoses, alone: list[int], joined: list[int], count: int) -> None:
    names = ", ".join(observations.names[c] for c in alone)
    who, share, do = (f"Camera {names}", "shares", "does") if len(alone) == 1 else (f"Cameras {names}", "share", "do")
    shared = max(int((plane.shown[:, c] & plane.shown[:, d]).sum()) for c in alone for d in joined)
    if shared < FEWEST_SHARED:
        raise InputError(
            f"{who} {share} only {shared} positions of the board with the other cameras; at least {FEWEST_SHARED} are needed, and "
            "20 are good: hold the board where several cameras see it at the same instant."
        )
    raise InputError(
        f"{who} {do} not agree with the other cameras: of {shared} positions of the board that are shared with one of them, only "
        f"{count} fit one rig; check that the recordings start at the same instant, and that no camera was moved or mirrored."
    )


def _positions(observations: BoardObservations, network: BoardNetwork, plane: PlanePoses) -> Started:
    """The positions, each with the pose with which most cameras agree; what does not agree becomes a position of its own."""
    corners, symmetries = observations.board.corners_m, observations.board.symmetries
    R_board, t_board, xy, frames = [], [], [], []
    for n, frame in enumerate(observations.frames):
        left = set(np.flatnonzero(plane.shown[n]).tolist())
        while left:
            best: tuple[int, float, np.ndarray, np.ndarray, dict[int, int]] | None = None
            for c in sorted(left):
                for s in range(SOLUTIONS):
                    R = network.R[c].T @ plane.R[n, c, s]
                    t = network.R[c].T @ (plane.t[n, c, s] - network.t[c])
                    agree, total = _agreeing(corners, network, plane, n, sorted(left), R, t, symmetries)
                    if best is None or (len(agree), -total) > (best[0], -best[1]):
                        best = (len(agree), total, R, t, agree)
            assert best is not None
            chosen = best[4] or {min(left): 0}
            row = np.full(observations.xy_px.shape[1:], np.nan)
            for c, order in chosen.items():
                row[c] = observations.xy_px[n, c][symmetries[order]]
            left -= set(chosen)
            R_board.append(best[2])
            t_board.append(best[3])
            xy.append(row)
            frames.append(int(frame))
    split = observations.changed(np.stack(xy), np.array(frames))
    return Started(network=replace(network, R_board=np.stack(R_board), t_board=np.stack(t_board)), observations=split)


def _agreeing(
    corners_m: np.ndarray, network: BoardNetwork, plane: PlanePoses, n: int, cameras: list[int], R: np.ndarray, t: np.ndarray,
    symmetries: np.ndarray,
) -> tuple[dict[int, int], float]:  # fmt: skip
    """The cameras that agree with a pose of the board in the world, each with the order of its corners, and the sum of their distances."""
    turned = network.R[cameras] @ R
    miss, order = _misses(corners_m, turned, network.R[cameras] @ t + network.t[cameras], plane.image[n, cameras], symmetries)
    agree = miss < AGREES
    return {c: int(o) for c, o, a in zip(cameras, order, agree) if a}, float(miss[agree].sum())
