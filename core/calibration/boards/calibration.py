"""Self-calibration from image points of a board, with the adjustment, tests and selection of lens parameters of `self_calibration`.

0  how late each camera is, roughly, if the board moved and the images fit one another better then (`delays`);
1  initial values from nothing (`start`);
2  f, k1 → + principal point, k2, p1, p2 → all unknowns, robustly;
   the delays of the cameras are unknowns from here on if they are significant;
3  positions again with the cameras fixed: a view that does not fit the others was not synchronised, and becomes a position of its own;
4  the shape of the board, if its deviations from the plan are significant: each corner is adjusted in space with the rest fixed, then the
   rest, several times; a shift, a turn and a scale of the whole are removed, so the squares keep their mean size
   F = ((SS₀ − SS₁) / m) / (SS₁ / r) > F_{1−α}(m, r) ,   m = 3 K − 7                                                              (1)
5  least squares, data snooping, significance, precision as for a bar.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ...geometry.camera import INTERIOR, image_with_derivatives
from ...geometry.robust import masked_median
from ..bundle import NEAREST_M, Adjusted, LevenbergMarquardt, Unknowns, adjust, residuals
from ..delays import MovingPoints, PlacedPoints, first_delays, moving_points, placed_points
from ..helmert import positioned
from ..network import BoardNetwork
from ..reference_bar import COARSE_CAUCHY_PX, lens_prior
from ..self_calibration import GROSS, Calibration, coarse_adjustment, robust_sigma, with_delays, without_insignificant, without_outliers
from .board import Lens
from .observations import BoardObservations
from .start import FEWEST_SHARED, Lenses, initial_network, with_lenses

DELAY_CORNERS = 8  # by which the first delays are found
SHAPE_POSITIONS = 8  # of the board that show its shape
SHAPE_ROUNDS = 6
SHAPE_ALPHA = 1e-3  # α of (1)
FEW_TOGETHER = 0.25  # of the images in which a camera does not agree: those in which it does
MANY_APART = 0.25  # of the images of a camera
LONG_RUN = 3  # images one after another in which a camera does not agree: it was moved or exchanged
FEWEST_SIDE = 3  # views before and after a camera was moved
STEP_T = 5.0  # Student's t of its residuals, the largest of all frames
STEP_PART = 0.3  # of sigma0 by which they must change
CLEAR_T, CLEAR_PART = 4.0, 0.6  # the same for a large change, which few views support
MOST_LISTED = 8  # frames
BENT = 0.004  # of the diagonal
STRETCHED = 1e-3  # makes the scale uncertain by half of it, the limit of a good calibration
APART = 2.5  # times the median residual of views with positions of their own: a view beyond it does not fit the others of its position
LEAST_APART_PX = 0.05  # no corner is located better in a real image
APART_SHARED = 2.0  # times that of views with shared positions, which contains the errors of the lens and of slight asynchrony


def calibrate_boards(
    observations: BoardObservations, monitor: Monitor, focal_px: float | None = None, lens: Lens = Lens.AUTO
) -> Calibration:
    """Calibrate the cameras from the corners and the size of the squares alone. AUTO: each camera has the lens that fits its images.

    Raises:
        InputError: a camera shares too few positions of the board with the others.
    """
    monitor.step("calibration", 0, 5)
    observations, lenses = with_lenses(observations, focal_px, lens)
    moving = moving_board(observations, search=not lenses.fisheye.any())
    first, used, placed, prior = _first_adjustment(observations, moving, monitor, lenses)
    if placed.moving is not None and first.network.delay_images is not None:  # again, so that no view is apart because it was late
        better = replace(placed.moving, expected_images=first.network.delay_images)
        first, used, placed, prior = _first_adjustment(observations, better, monitor, lenses)
    sigma = robust_sigma(first.residual_px, used & np.isfinite(first.residual_px).all(axis=-1))
    network, again = split_apart(first.network, placed.now(first.network), sigma)
    if len(again.frames) > len(placed.labelled.frames):
        placed = _Placed(labelled=again, moving=placed.moving)
        network, used = placed.again(network, max(10 * sigma, 1.0))
        first = adjust(network, placed.points or again.xy_px, used, prior, cauchy_px=3 * sigma, unit_px=sigma)
    labelled = placed.labelled
    monitor.step("calibration", 3, 5)
    first, used = shaped(first, placed, used, prior)
    monitor.step("calibration", 4, 5)
    tested = without_outliers(first, labelled, used, prior, placed.again, placed.points)
    done = without_insignificant(*tested, labelled, monitor, placed.points)
    labelled = labelled.changed(done.observations.xy_px)
    lines, doubts = _remarks_on_shape(labelled.board.corners_m, tested[0].network.corners_m, labelled.length_m)
    for more in (_remarks_on_views(labelled), _remarks_on_moved_cameras(done)):
        lines, doubts = lines + more[0], doubts + more[1]
    return replace(done, remarks=tuple(lines), doubt=", and ".join(doubts))


def _first_adjustment(
    observations: BoardObservations, moving: MovingPoints | None, monitor: Monitor, lenses: Lenses
) -> "tuple[Adjusted[BoardNetwork], np.ndarray, _Placed, Unknowns]":
    """A robust adjustment from nothing: the network, the image points used, the positions, and the prior with delays if they matter."""
    late = moving is not None and bool(moving.expected_images.any())
    at_once = observations
    if moving is not None and late:
        observations = observations.changed(moving.at(moving.expected_images)[0])
    started = initial_network(observations, lenses)
    monitor.step("calibration", 1, 5)
    network, sigma = refined(started.network, started.observations, monitor)
    network, labelled = split_apart(network, started.observations, sigma)
    monitor.step("calibration", 2, 5)
    prior = lens_prior(labelled.size_px, network.interior[:, 0], network.fisheye)
    network, used = with_boards(network, labelled, max(10 * sigma, 1.0))
    first = coarse_adjustment(network, labelled.xy_px, used, prior, sigma)
    placed = _Placed(labelled=labelled, moving=moving)
    delayed = None if placed.points is None else with_delays(first, placed.points, prior, sigma, placed.again)
    if delayed is None and moving is not None and late:  # the delays are not significant, and moved the points
        return _first_adjustment(at_once, replace(moving, expected_images=np.zeros_like(moving.expected_images)), monitor, lenses)
    if delayed is None:
        return first, used, _Placed(labelled=labelled, moving=None), prior
    return *delayed, placed, replace(prior, expected_delay_images=placed.expected_images)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Placed:
    """Observations of which one frame may have several positions, and the paths of their corners if the cameras are not in step."""

    labelled: BoardObservations
    moving: MovingPoints | None

    @property
    def points(self) -> PlacedPoints | None:
        """The corners as functions of the delays of the cameras."""
        shown = self.labelled.views(self.labelled.visible)
        return None if self.moving is None else placed_points(self.moving, self.labelled.frames, shown)

    @property
    def expected_images(self) -> np.ndarray | None:
        """The delays of the cameras before the adjustment."""
        return None if self.moving is None else self.moving.expected_images

    def now(self, network: BoardNetwork) -> BoardObservations:
        """The observations at the delays of a network."""
        points, late = self.points, network.delay_images
        return self.labelled if points is None or late is None else self.labelled.changed(points.at(late)[0])

    def again(self, network: BoardNetwork, tolerance_px: float) -> tuple[BoardNetwork, np.ndarray]:
        """The positions measured again with the cameras of a network, and the image points within a tolerance."""
        return with_boards(network, self.now(network), tolerance_px)


def moving_board(observations: BoardObservations, search: bool = True) -> MovingPoints | None:
    """The paths of the corners, and how late each camera is, roughly, if that is searched; None for images that do not follow one another.

    The corners of a board that looks the same from both ends have no paths: their order may differ from image to image.
    """
    if len(observations.board.symmetries) > 1:
        return None
    moving = moving_points(observations.frames, observations.xy_px)
    if not np.isfinite(moving.coefficients[1]).any():
        return None
    if not search:  # it needs lenses that keep lines nearly straight
        return moving
    often = observations.visible.sum(axis=(0, 1))
    usual = np.flatnonzero(often >= np.median(often))
    some = usual[np.unique(np.linspace(0, len(usual) - 1, DELAY_CORNERS).astype(int))]
    few = replace(moving, coefficients=moving.coefficients[:, :, :, some])
    return replace(moving, expected_images=first_delays(few, observations.size_px, labelled=True))


def _remarks_on_moved_cameras(done: Calibration) -> tuple[list[str], list[str]]:
    """Lines about cameras whose residuals are other ones from some frame on, and the doubt that this raises: the others yield to one.

    The mean residuals of its views before and after a frame are compared (Student's t, at the frame with the largest).
    """
    lines, found = [], []
    shared = done.observations.views(done.used) & done.observations.measured(done.used)[:, None]
    order = np.argsort(done.observations.frames, kind="stable")
    for c, name in enumerate(done.observations.names):
        rows = order[shared[order, c]]
        if len(rows) < 2 * FEWEST_SIDE:
            continue
        kept = done.used[rows, c]
        mean_px = np.where(kept[..., None], done.residual_px[rows, c], 0.0).sum(axis=1) / kept.sum(axis=1)[:, None]
        at, t, jump_px = _largest_step(mean_px)
        if any(t > least and jump_px > part * done.sigma0_px for least, part in ((STEP_T, STEP_PART), (CLEAR_T, CLEAR_PART))):
            frame = done.observations.frames[rows[at]]
            lines.append(f"the residuals of camera {name} change by {jump_px:.2f} px at frame {frame}")
            found.append((t, f"camera {name}, or its neighbour, seems to have been moved before frame {frame}"))
    return lines, [max(found)[1]] if found else []


def _largest_step(values: np.ndarray) -> tuple[int, float, float]:
    """Where a sequence (n, 2) changes most: the first index after the step, its t, and its height."""
    best = (FEWEST_SIDE, 0.0, 0.0)
    for k in range(FEWEST_SIDE, len(values) - FEWEST_SIDE + 1):
        a, b = values[:k], values[k:]
        variance = (np.sum((a - a.mean(axis=0)) ** 2, axis=0) + np.sum((b - b.mean(axis=0)) ** 2, axis=0)) / (len(values) - 2)
        step = np.abs(a.mean(axis=0) - b.mean(axis=0))
        t = float((step / np.sqrt(np.maximum(variance * (1 / len(a) + 1 / len(b)), 1e-18))).max())
        if t > best[1]:
            best = (k, t, float(np.linalg.norm(step)))
    return best


def _remarks_on_views(labelled: BoardObservations) -> tuple[list[str], list[str]]:
    """Lines about views that were not synchronised, and the doubts that they raise.

    Raises:
        InputError: a camera does not agree with the others.
    """
    lines, doubts = [], []
    apart = _apart(labelled)
    views = labelled.views(labelled.visible)
    shown = views.sum(axis=0)
    together = (views & (views.sum(axis=1, keepdims=True) >= 2)).sum(axis=0)
    for c, name in enumerate(labelled.names):
        frames = apart[apart[:, 1] == c, 0]
        if len(frames):
            listed = ", ".join(map(str, frames[:MOST_LISTED])) + (" …" if len(frames) > MOST_LISTED else "")
            lines.append(
                f"camera {name} was not synchronised with the others, or was moved, in {len(frames)} of {shown[c]} images: {listed}"
            )
        if together[c] < max(FEWEST_SHARED, FEW_TOGETHER * len(frames)):
            raise InputError(
                f"Camera {name} does not agree with the other cameras: only {together[c]} positions fit, {len(frames)} do not; "
                "check that the recordings start at the same instant, and that no camera was moved or mirrored."
            )
        run = _longest_run(labelled.frames[views[:, c]], frames)
        if len(frames) > MANY_APART * shown[c] or len(run) >= LONG_RUN:
            where = f"in {len(frames)} of its {shown[c]} images"
            if len(run) >= LONG_RUN:
                where += f", among them all from {run[0]} to {run[-1]}"
            doubts.append(f"camera {name}, moved, exchanged or not synchronised, disagrees with the others {where}")
    return lines, doubts or _shared_out(labelled, apart)


def _shared_out(labelled: BoardObservations, apart: np.ndarray) -> list[str]:
    """The doubt that disagreements raise of which no camera has many: with two cameras, either may be the wrong one."""
    views = labelled.views(labelled.visible)
    shared = np.array([frame for frame in np.unique(labelled.frames) if views[labelled.frames == frame].sum() >= 2])
    some, run = len(np.unique(apart[:, 0])), _longest_run(shared, apart[:, 0])
    if some <= MANY_APART * len(shared) and len(run) < LONG_RUN:
        return []
    where = f"in {some} of {len(shared)} images" + (f", among them all from {run[0]} to {run[-1]}" if len(run) >= LONG_RUN else "")
    return [f"the cameras disagree {where}; was one of them moved, exchanged or not synchronised?"]


def _longest_run(shown: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """The longest series of the frames shown (n,) in which all are apart."""
    frames = np.unique(shown)
    stays = np.flatnonzero(np.concatenate([[True], ~np.isin(frames, apart), [True]]))
    longest = int(np.argmax(np.diff(stays)))
    return frames[stays[longest] : stays[longest + 1] - 1]


def _remarks_on_shape(plan_m: np.ndarray, corners_m: np.ndarray, length_m: float) -> tuple[list[str], list[str]]:
    """Lines about how far the corners (K, 3) of a board of some length are from their plan, and the doubts that this raises."""
    lines, doubts = [], []
    deviation = corners_m - plan_m
    largest = float(np.linalg.norm(deviation, axis=1).max())
    if largest > 0:
        along, across = np.sqrt(np.mean(deviation[:, :2] ** 2)), np.sqrt(np.mean(deviation[:, 2] ** 2))
        lines.append(
            f"the board differs from its plan by {1e3 * along:.3f} mm RMS in the plane and {1e3 * across:.3f} mm RMS across it, at most "
            f"{1e3 * largest:.3f} mm; the adjustment allows for it"
        )
    stretch = _stretch(plan_m, corners_m)
    if stretch > STRETCHED:
        doubts.append(
            f"the squares are {100 * stretch:.2f} % longer one way than the other, so the scale is uncertain; measure them both ways, and "
            "print the board without scaling"
        )
    if largest > BENT * length_m:
        doubts.append(
            f"the board is bent or printed unevenly by {1e3 * largest:.1f} mm; glue it to a flat plate, and measure its squares both ways"
        )
    return lines, doubts


def _stretch(plan_m: np.ndarray, corners_m: np.ndarray) -> float:
    """How much longer the board is in one direction than in the other, less one, relative to its plan."""
    affine = np.linalg.lstsq(plan_m[:, :2] - plan_m[:, :2].mean(axis=0), corners_m[:, :2] - corners_m[:, :2].mean(axis=0), rcond=None)[0]
    longest, shortest = np.linalg.svd(affine, compute_uv=False)
    return float(longest / shortest - 1)


def shaped(
    first: Adjusted[BoardNetwork], placed: _Placed, used: np.ndarray, unknowns: Unknowns
) -> tuple[Adjusted[BoardNetwork], np.ndarray]:
    """The adjustment with the shape of the board, if it is significant, and the image points used.  (1)"""
    from scipy.special import fdtrc

    observations, points = placed.labelled, placed.points
    if observations.measured(used).sum() < SHAPE_POSITIONS:
        return first, used
    sigma = robust_sigma(first.residual_px, used & np.isfinite(first.residual_px).all(axis=-1))
    network, used = placed.again(first.network, GROSS * sigma)
    iteration = LevenbergMarquardt(max_iterations=6, tolerance=0.05)
    flat = state = adjust(network, points or observations.xy_px, used, unknowns, unit_px=sigma, iteration=iteration)
    for _ in range(SHAPE_ROUNDS):
        kept = used & np.isfinite(state.residual_px).all(axis=-1)
        network = replace(state.network, corners_m=_corners(state.network, state.residual_px, kept, observations.board.corners_m))
        state = adjust(network, points or observations.xy_px, used, unknowns, unit_px=sigma, iteration=iteration)
    free = 3 * len(network.corners_m) - 7
    redundancy = 2 * used.sum() - 6 * network.count - (len(INTERIOR) + 6) * len(network.R) - free
    F = (flat.cost - state.cost) / free / (state.cost / max(redundancy, 1))
    return (state, used) if redundancy > 0 and fdtrc(free, redundancy, F) < SHAPE_ALPHA else (flat, used)


def _corners(network: BoardNetwork, residual_px: np.ndarray, used: np.ndarray, plan_m: np.ndarray) -> np.ndarray:
    """The corners (K, 3) in the board's frame after one Gauss–Newton step of each, as similar to the plan as possible."""
    X = network.points_m
    N, b = np.zeros((len(plan_m), 3, 3)), np.zeros((len(plan_m), 3))
    for c, (interior, R, t) in enumerate(zip(network.interior, network.R, network.t)):
        p = X @ R.T + t
        shown = used[:, c] & (p[..., 2] > NEAREST_M)
        _, _, G = image_with_derivatives(interior, np.where(shown[..., None], p, [0.0, 0.0, 1.0]), network.curved[c])
        J = np.where(shown[..., None, None], G @ R @ network.R_board[:, None], 0.0)
        v = np.where(shown[..., None], residual_px[:, c], 0.0)
        N += np.einsum("nkai,nkaj->kij", J, J)
        b += np.einsum("nkai,nka->ki", J, v)
    weak = np.trace(N, axis1=1, axis2=2)[:, None, None] * 1e-6 * np.eye(3) + 1e-9 * np.eye(3)
    moved = network.corners_m + np.linalg.solve(N + weak, b[..., None])[..., 0]
    return _similar(moved, plan_m)


def _similar(moved: np.ndarray, plan_m: np.ndarray) -> np.ndarray:
    """Points (K, 3) after the similarity that brings them closest to the plan (Umeyama 1991)."""
    A, B = moved - moved.mean(axis=0), plan_m - plan_m.mean(axis=0)
    U, _, Vt = np.linalg.svd(A.T @ B)
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    turned = A @ R.T
    return turned * (np.sum(turned * B) / np.sum(turned * turned)) + plan_m.mean(axis=0)


def _apart(labelled: BoardObservations) -> np.ndarray:
    """Frame and camera of every view that is in a position of its own, although another camera shows the board in the frame."""
    shown = labelled.views(labelled.visible)
    rows = []
    for frame in np.unique(labelled.frames):
        at = np.flatnonzero(labelled.frames == frame)
        main = at[np.argmax(shown[at].sum(axis=1))]
        rows += [(frame, c) for n in at if n != main for c in np.flatnonzero(shown[n])]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def refined(network: BoardNetwork, observations: BoardObservations, monitor: Monitor) -> tuple[BoardNetwork, float]:
    """Robust adjustment with more and more unknowns; sigma [px]."""
    prior = lens_prior(observations.size_px, network.interior[:, 0], network.fisheye)
    cauchy, sigma = COARSE_CAUCHY_PX, 1.0
    for names in (("f", "k1"), ("f", "cx", "cy", "k1", "k2", "p1", "p2"), INTERIOR):
        monitor.step("calibration", 1, 5)
        done = adjust(
            network, observations.xy_px, observations.visible, prior.only(*names), cauchy_px=cauchy, unit_px=0.3 * cauchy,
            iteration=LevenbergMarquardt(max_iterations=10, tolerance=0.1),
        )  # fmt: skip
        network, sigma = done.network, robust_sigma(done.residual_px, observations.visible)
        cauchy = float(np.clip(3 * sigma, 0.3, cauchy))
    return network, sigma


def with_boards(network: BoardNetwork, observations: BoardObservations, tolerance_px: float) -> tuple[BoardNetwork, np.ndarray]:
    """The positions adjusted with the cameras fixed, and which image points (N, C, K) lie within the tolerance."""
    network = positioned(network, observations.xy_px, observations.visible, tolerance_px / GROSS * 3)
    off = np.linalg.norm(residuals(network, observations.xy_px), axis=-1)
    with np.errstate(invalid="ignore"):
        return network, observations.supported(observations.visible & (off < tolerance_px))


def view_residuals(network: BoardNetwork, observations: BoardObservations) -> np.ndarray:
    """Median distance [px] of the corners of each view (N, C) from those of the network; 0 where a camera does not show the board."""
    off = np.linalg.norm(residuals(network, observations.xy_px), axis=-1)
    shown = observations.views(observations.visible)
    return np.where(shown, masked_median(off, np.isfinite(off)), 0.0)


def split_apart(network: BoardNetwork, observations: BoardObservations, sigma_px: float) -> tuple[BoardNetwork, BoardObservations]:
    """The observations with every view that does not fit the others of its position as a position of its own."""
    cauchy = 3 * sigma_px
    network = positioned(network, observations.xy_px, observations.visible, cauchy)
    limit = _limit_px(network, observations, cauchy)
    while True:
        shown = observations.views(observations.visible)
        disputed = np.flatnonzero((view_residuals(network, observations) > limit).any(axis=1) & (shown.sum(axis=1) >= 2))
        if not len(disputed):
            return network, observations
        C = shown.shape[1]
        without = np.array([(n, c) for n in disputed for c in range(C) if shown[n, c]])
        left = observations.xy_px[without[:, 0]]
        left[np.arange(len(without)), without[:, 1]] = np.nan
        trial = observations.changed(left, observations.frames[without[:, 0]])
        tried = positioned(network.at(without[:, 0]), trial.xy_px, trial.visible, cauchy)
        cost = view_residuals(tried, trial).max(axis=1)
        drop = np.array([rows[np.argmin(cost[rows])] for n in disputed for rows in [np.flatnonzero(without[:, 0] == n)]])
        network, observations = _moved_apart(network, observations, without[drop], cauchy)


def _limit_px(network: BoardNetwork, observations: BoardObservations, cauchy_px: float) -> float:
    """The median residual beyond which a view does not fit the others of its position."""
    shown = observations.views(observations.visible)
    shared = shown & (shown.sum(axis=1, keepdims=True) >= 2)
    if not shared.any():
        return np.inf
    together = float(np.median(view_residuals(network, observations)[shared]))
    views = np.argwhere(shared)
    alone = np.full((len(views), *observations.xy_px.shape[1:]), np.nan)
    alone[np.arange(len(views)), views[:, 1]] = observations.xy_px[views[:, 0], views[:, 1]]
    single = observations.changed(alone, observations.frames[views[:, 0]])
    own = view_residuals(positioned(network.at(views[:, 0]), alone, single.visible, cauchy_px), single)
    return max(APART * float(np.median(own[np.arange(len(views)), views[:, 1]])), APART_SHARED * together, LEAST_APART_PX)


def _moved_apart(
    network: BoardNetwork, observations: BoardObservations, views: np.ndarray, cauchy_px: float
) -> tuple[BoardNetwork, BoardObservations]:
    """The views (n, 2), position and camera, as positions at the end."""
    xy = observations.xy_px.copy()
    own = np.full((len(views), *xy.shape[1:]), np.nan)
    rows = np.arange(len(views))
    own[rows, views[:, 1]] = xy[views[:, 0], views[:, 1]]
    xy[views[:, 0], views[:, 1]] = np.nan
    frames = np.concatenate([observations.frames, observations.frames[views[:, 0]]])
    observations = observations.changed(np.concatenate([xy, own]), frames)
    first = network.at(np.concatenate([np.arange(network.count), views[:, 0]]))
    return positioned(first, observations.xy_px, observations.visible, cauchy_px), observations
