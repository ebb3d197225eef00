"""Self-calibration from image points of a waved bar: start, robust adjustment, outliers, selection of lens parameters, precision.

0  how late each camera is, roughly, if the images fit one another better then (`delays`);
1  initial values from nothing (`reference_bar`), on a part of the positions;
2  f, k1 → + principal point, k2, p1, p2 → all unknowns, robustly, on that part;
3  all positions: order of the ends, intersection, robust adjustment;
   the delays of the cameras are unknowns from here on if they are significant, by the test (3), and LEAST_DELAY or more;
4  least squares; data snooping (Baarda 1968): the worst image point of each bar is removed until no test exceeds its limit,
   w = v / (σ0 √q_vv) ,   q_vv = 1 − a Q_c aᵀ − b U⁻¹ bᵀ ,   a = j − b U⁻¹ Wᵀ                                                 (1)
   j, b: rows of the design matrix;   Σ q_vv = number of observations − number of unknowns = redundancy                         (2)
5  lens parameters that are not significant are left out, one group at a time (Wald's test of the group):
   F = xᵀ Q_xx⁻¹ x / (m σ0²) < F_{1−α}(m, r)                                                                                    (3)
6  the predicted precision accounts for parameters that were left out (`precision.with_left_out`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..foundation.progress import Monitor
from ..geometry.camera import INTERIOR
from ..geometry.robust import mad_sigma
from .bars import BarObservations, labelled_ends, with_bars
from .bundle import (
    DELAY,
    Adjusted,
    AnyNetwork,
    LevenbergMarquardt,
    Unknowns,
    adjust,
    design,
    eliminated,
    inverse_factors,
    normal_equations,
    residuals_of,
)
from .delays import MovingPoints, agreeing_delays, in_order, moving_points, without_jumps
from .fisheye_bar import fisheye_delays, fisheye_network
from .helmert import Partial
from .network import BarNetwork, Network, Observations
from .precision import camera_covariance, group_of, with_left_out
from .reference_bar import COARSE_CAUCHY_PX, initial_network, lens_prior

GROUPS = (("k3",), ("b1", "b2"), ("p1", "p2"), ("k2",), ("cx", "cy"), ("k1",))  # of lens parameters that are tested together
SIGNIFICANCE = 0.05  # α of (3)
CRITICAL_W = 4.1  # |w| beyond it: 1 good point in 5000 (two coordinates)
SMALLEST_Q = 0.02  # of q_vv in (1)
PART = 400  # positions of the refined start
GROSS = 6.5  # sigmas of an image point that does not fit the intersection
ROUNDS = 15  # of data snooping
DELAY_ROUNDS = 3  # of the first adjustment with delays
RETRIED_ROUNDS = 2  # in which all image points are tested again
MIN_SIGMA_PX = 0.004
DELAY_SIGNIFICANCE = 1e-3
CONVINCING = 0.7  # of the visible image points of each camera: first delays with which fewer fit are compared with none
LEAST_DELAY = 0.01  # images: cameras that are less apart count as in step


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Alone:
    """An adjustment without the other object, for comparison."""

    network: Network
    used: np.ndarray  # (N, C, K)
    square_px2: float  # sum of the squares of the residuals
    sigma0_px: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Calibration:
    """An adjusted network, and what its quality is judged by."""

    observations: Observations  # with the points in order
    network: Network
    used: np.ndarray  # (N, C, K) image points that take part
    residual_px: np.ndarray  # (N, C, K, 2)
    unknowns: Unknowns
    sigma0_px: float
    redundancy: float
    covariance: np.ndarray  # (C p, C p) of the camera unknowns, times sigma0², free network
    considered: np.ndarray  # (16 C, 16 C) of all sixteen unknowns per camera, the uncertainty of those left out included
    decisions: tuple[str, ...]  # why unknowns were left out
    converged: bool
    remarks: tuple[str, ...] = ()  # lines of the report
    doubt: str = ""  # why the cameras may be wrong although the figures are good
    other: Partial | None = None  # another object that takes part
    alone: Alone | None = None  # the adjustment without it

    @property
    def described(self) -> dict[str, Any]:
        """What the objects were given as, for files."""
        return {**self.observations.described, **({} if self.other is None else self.other.observations.described)}

    @property
    def delays(self) -> dict[str, tuple[float, float]]:
        """By how many images each camera is later than the first, and its sigma; nothing where all are in step."""
        if self.network.delay_images is None:
            return {}
        columns = list(self.unknowns.columns)
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))[columns.index(DELAY) :: len(columns)]
        names = self.observations.names
        return {name: (float(d), float(s)) for name, d, s in list(zip(names, self.network.delay_images, sigma))[1:]}

    @property
    def every_unknown(self) -> Unknowns:
        """All sixteen unknowns of a camera, to which `considered` belongs."""
        return replace(self.unknowns.in_step, free=np.ones(len(INTERIOR), dtype=bool))


Start = Callable[[BarObservations], BarNetwork]  # the cameras, from nothing
Delays = Callable[[BarObservations], np.ndarray]  # (C,) how late each camera is, roughly


def calibrate(observations: BarObservations, monitor: Monitor, focal_px: float | None = None, fisheye: bool = False) -> Calibration:
    """Calibrate the cameras from image points and the bar's length alone; `fisheye`: all of them have such lenses.

    Raises:
        InputError: the cameras share too few bars.
    """
    if fisheye:
        return calibrate_from(
            lambda some: fisheye_network(some, focal_px).network, observations, monitor, lambda raw: fisheye_delays(raw, focal_px)
        )
    return calibrate_from(lambda some: initial_network(some, focal_px).network, observations, monitor, delays_of_bars)


def delays_of_bars(bars: BarObservations) -> np.ndarray:
    """How late each camera is (C,), if its lens keeps lines nearly straight."""
    return agreeing_delays(moving_points(bars.frames, bars.xy_px), bars.size_px, bars.labelled)


def calibrate_from(
    start: Start, observations: BarObservations, monitor: Monitor, delays: Delays, other: Partial | None = None
) -> Calibration:
    """Calibrate the cameras from the network that `start` finds and the first `delays`, together with another object if there is one.

    Raises:
        InputError: the cameras share too few bars.
    """
    monitor.step("calibration", 0, 5)
    raw = without_jumps(observations.frames, observations.xy_px)
    none = np.zeros(len(observations.names))
    late = delays(observations.changed(raw, labelled=observations.labelled))
    done = _at_delays(start, observations, raw, late, monitor, other) if late.any() else None
    if done is None or not _convincing(done):
        at_once = _at_delays(start, observations, raw, none, monitor, other)
        assert at_once is not None
        done = at_once if done is None or at_once.used.sum() > done.used.sum() else done
    return done


def _convincing(found: Calibration) -> bool:
    """Whether enough image points of every camera fit: delays that were found by chance fit some cameras only."""
    fit, visible = found.used.sum(axis=(0, 2)), found.observations.visible.sum(axis=(0, 2))
    return bool((fit >= CONVINCING * visible).all())


def _at_delays(
    start: Start, observations: BarObservations, raw_px: np.ndarray, late_images: np.ndarray, monitor: Monitor, other: Partial | None
) -> Calibration | None:
    """The calibration that starts from delays (C,); None if these are not 0 and turn out not to be significant: they moved the points."""
    moving = moving_points(observations.frames, raw_px)
    if late_images.any():
        observations = observations.changed(moving.at(late_images)[0], labelled=observations.labelled)
    network = start(observations)
    monitor.step("calibration", 1, 5)
    network, labelled, sigma = refined_start(network, observations, other)
    monitor.step("calibration", 2, 5)
    network, used = with_bars(network, labelled, max(10 * sigma, 1.0))
    first = coarse_adjustment(network, labelled.xy_px, used, _prior(observations, network, other), sigma)
    other = None if other is None else other.at(first.network)
    prior = _prior(observations, network, other)
    monitor.step("calibration", 3, 5)
    ordered = in_order(raw_px, observations.xy_px, labelled.xy_px, late_images)
    points = moving_points(labelled.frames, without_jumps(labelled.frames, ordered), late_images)

    def again(bars: BarNetwork, tolerance_px: float) -> tuple[BarNetwork, np.ndarray]:
        return with_bars(bars, labelled if bars.delay_images is None else labelled.changed(points.at(bars.delay_images)[0]), tolerance_px)

    delayed = with_delays(first, points, prior, sigma, again)
    if delayed is None and late_images.any():
        return None
    moved = None if delayed is None else points
    first, used = delayed or (first, used)
    tested = without_outliers(first, labelled, used, _with_delays(prior, moved), again, moved)
    done = without_insignificant(*tested, labelled, monitor, moved, other)
    if other is None:
        return done
    state, keep, sigma, _ = without_outliers(tested[0], labelled, tested[1], _with_delays(prior.alone, moved), again, moved)
    square = float(np.sum(state.residual_px[keep] ** 2))
    return replace(done, alone=Alone(network=state.network, used=keep, square_px2=square, sigma0_px=sigma))


def _prior(observations: Observations, network: Network, other: Partial | None) -> Unknowns:
    """The prior of the cameras with all unknowns free, and what another object contributes."""
    prior = lens_prior(observations.size_px, network.interior[:, 0], network.fisheye)
    return prior if other is None else replace(prior, block=other.block)


def with_delays(
    first: Adjusted[AnyNetwork],
    points: MovingPoints,
    prior: Unknowns,
    sigma_px: float,
    again: Callable[[AnyNetwork, float], tuple[AnyNetwork, np.ndarray]],
) -> tuple[Adjusted[AnyNetwork], np.ndarray] | None:
    """A robust adjustment with the delays of the cameras as unknowns, and the image points used; None if they are not significant.

    `again` is that of `without_outliers`.
    """
    unknowns = _with_delays(prior, points)
    network = replace(first.network, delay_images=points.expected_images.copy())
    state, sigma = first, sigma_px
    keep, late = np.zeros(0, dtype=bool), np.zeros(0)
    for _ in range(DELAY_ROUNDS):
        network, keep = again(network, max(10 * sigma, 1.0))
        iteration = LevenbergMarquardt(max_iterations=8, tolerance=0.05)
        state = adjust(network, points, keep, unknowns, cauchy_px=3 * sigma, unit_px=sigma, iteration=iteration)
        network, sigma = state.network, robust_sigma(state.residual_px, keep & np.isfinite(state.residual_px).all(axis=-1))
        late = np.zeros(0) if network.delay_images is None else network.delay_images[1:]
        if np.abs(late).max(initial=0.0) < LEAST_DELAY:
            return None
    columns, C = list(unknowns.columns), len(network.R)
    at = np.arange(1, C) * len(columns) + columns.index(DELAY)
    covariance = _covariance(state, keep, unknowns, sigma, points)[np.ix_(at, at)]
    return (state, keep) if _probability(late, covariance, float(keep.sum())) < DELAY_SIGNIFICANCE else None


def _with_delays(unknowns: Unknowns, points: MovingPoints | None) -> Unknowns:
    return unknowns if points is None else replace(unknowns, expected_delay_images=points.expected_images)


def coarse_adjustment(network: AnyNetwork, xy_px: np.ndarray, used: np.ndarray, prior: Unknowns, sigma_px: float) -> Adjusted[AnyNetwork]:
    """A robust adjustment of all positions in a few steps, for image points of this sigma."""
    iteration = LevenbergMarquardt(max_iterations=8, tolerance=0.05)
    return adjust(network, xy_px, used, prior, cauchy_px=3 * sigma_px, unit_px=sigma_px, iteration=iteration)


def refined_start(
    network: BarNetwork, observations: BarObservations, other: Partial | None = None
) -> tuple[BarNetwork, BarObservations, float]:
    """The cameras, adjusted with all unknowns on a part of the positions; all observations with their ends in order; sigma [px]."""
    prior = _prior(observations, network, other)
    some = np.unique(np.linspace(0, len(observations.xy_px) - 1, PART).astype(int))
    cauchy = COARSE_CAUCHY_PX
    for names in (("f", "k1"), ("f", "cx", "cy", "k1", "k2", "p1", "p2"), INTERIOR, INTERIOR):
        part = _ordered(network, observations.part(some), 2 * cauchy)
        network, used = with_bars(network, part, 3 * cauchy)
        done = adjust(
            network,
            part.xy_px,
            used,
            prior.only(*names),
            cauchy_px=cauchy,
            unit_px=0.3 * cauchy,
            iteration=LevenbergMarquardt(max_iterations=8, tolerance=0.1),
        )
        network, sigma = done.network, robust_sigma(done.residual_px, used)
        cauchy = float(np.clip(3 * sigma, 0.3, cauchy))
    return network, _ordered(network, observations, 2 * cauchy), sigma


def _ordered(network: BarNetwork, observations: BarObservations, tolerance_px: float) -> BarObservations:
    return observations if observations.labelled else labelled_ends(network, observations, tolerance_px)


def robust_sigma(residual_px: np.ndarray, used: np.ndarray) -> float:
    """Sigma of an image coordinate from the median of the residuals [px]; a third of outliers does not affect it."""
    return max(MIN_SIGMA_PX, float(mad_sigma(residual_px[used]))) if used.any() else 1.0


def redundant_parts(
    network: Network, used: np.ndarray, unknowns: Unknowns, unit_px: float, points: MovingPoints | None = None
) -> np.ndarray:
    """q_vv (N, C, K, 2) of all image coordinates of weight 1; 1 for those that are not used.  (1), (2)"""
    zero = np.zeros((*used.shape, 2))
    velocity = None if points is None else residuals_of(network, points)[1]
    normals = normal_equations(network, zero, used.astype(np.float64), unknowns, unit_px, velocity)
    root = _root(camera_covariance(network, normals, unknowns)).T
    N, C, K = used.shape
    parts = np.ones((C, 2 * K, N))
    for at, block in network.blocks():
        _, J, B = design(block, unknowns, None if velocity is None else velocity[at])
        rows = J.reshape(C, -1, J[0, 0].size)  # (C, p, 2 K n)
        inverse = inverse_factors(normals.U[..., at])
        by_cameras = root @ eliminated(inverse, normals.W[..., at])  # (q, C p, n)
        b = np.einsum("jkn,ckrn->cjrn", inverse, B.reshape(C, len(inverse), 2 * K, -1))  # L⁻¹ bᵀ
        for c, of in enumerate(np.split(root, C, axis=1)):
            a = (of @ rows[c]).reshape(len(root), 2 * K, -1) - np.einsum("jrn,jqn->qrn", b[c], by_cameras)
            parts[c, :, at] -= np.einsum("qrn,qrn->rn", a, a) + np.einsum("jrn,jrn->rn", b[c], b[c])
    return np.where(used[..., None], parts.reshape(C, 2, K, N).transpose(3, 0, 2, 1), 1.0)


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def without_outliers(
    first: Adjusted[AnyNetwork],
    observations: Observations,
    used: np.ndarray,
    unknowns: Unknowns,
    again: Callable[[AnyNetwork, float], tuple[AnyNetwork, np.ndarray]],
    points: MovingPoints | None = None,
) -> tuple[Adjusted[AnyNetwork], np.ndarray, float, float]:
    """Least squares with data snooping: the adjustment, the image points used, sigma0 and the redundancy.  (1)

    `points` are those of cameras with delays.

    `again` measures the positions with the cameras of a network, and selects the image points that fit within a tolerance [px].
    """
    state, keep = first, used
    sigma = robust_sigma(first.residual_px, used)
    for number in range(ROUNDS):
        network = state.network
        if number < RETRIED_ROUNDS:  # image points that did not fit the cameras of the start are used again
            network, keep = again(network, GROSS * sigma)
        iteration = LevenbergMarquardt(max_iterations=10, tolerance=1e-2)
        state = adjust(network, points or observations.xy_px, keep, unknowns, unit_px=sigma, iteration=iteration)
        keep = keep & np.isfinite(state.residual_px).all(axis=-1)
        parts = redundant_parts(state.network, keep, unknowns, sigma, points)
        square = np.sum(np.where(keep[..., None], state.residual_px, 0.0) ** 2)
        redundancy = max(1.0, float(parts[keep].sum()))
        sigma = max(float(np.sqrt(square / redundancy)), 1e-6)
        w = _tested(state.residual_px, parts, sigma)
        worst = (w > CRITICAL_W) & keep & (w >= np.where(keep, w, 0.0).max(axis=observations.tested_together, keepdims=True))
        if number and not worst.any():
            break
        keep = observations.supported(keep & ~worst)
    return state, keep, sigma, redundancy


def _tested(residual_px: np.ndarray, parts: np.ndarray, sigma: float) -> np.ndarray:
    """w (N, C, K) of the image points, the larger of both coordinates."""
    w = np.abs(residual_px) / (sigma * np.sqrt(np.maximum(parts, SMALLEST_Q)))
    return np.nan_to_num(w.max(axis=-1))


def without_insignificant(
    state: Adjusted[AnyNetwork],
    keep: np.ndarray,
    sigma: float,
    redundancy: float,
    observations: Observations,
    monitor: Monitor,
    points: MovingPoints | None = None,
    other: Partial | None = None,
) -> Calibration:
    """Leave out the groups of lens parameters that are not significant, with a new adjustment after each.  (3)"""
    unknowns = _with_delays(_prior(observations, state.network, other), points)
    decisions: list[str] = []
    first, all_free = state.network, unknowns
    covariance = _covariance(state, keep, unknowns, sigma, points)
    full = _in_step(covariance, unknowns)
    tested_groups = list(GROUPS)
    while tested_groups:
        tests = [(wald(state.network, unknowns, covariance, group, redundancy), group) for group in tested_groups]
        probability, group = max(tests, key=lambda entry: entry[0])
        if probability <= SIGNIFICANCE:
            break
        tested_groups.remove(group)
        decisions.append(f"{', '.join(group)} left out: not significant (p = {probability:.2g})")
        unknowns = replace(unknowns, free=unknowns.free & ~np.isin(INTERIOR, group))
        interior = np.where(unknowns.free, state.network.interior, unknowns.expected)
        fixed = replace(state.network, interior=interior)
        iteration = LevenbergMarquardt(max_iterations=10, tolerance=1e-2)
        state = adjust(fixed, points or observations.xy_px, keep, unknowns, unit_px=sigma, iteration=iteration)
        covariance = _covariance(state, keep, unknowns, sigma, points)
    if other is not None:  # its equations, formed again at the result
        other = other.at(state.network)
        unknowns = replace(unknowns, block=other.block)
        state = adjust(state.network, points or observations.xy_px, keep, unknowns, unit_px=sigma)
        other = other.at(state.network)
    monitor.step("calibration", 5, 5)
    square = float(np.sum(state.residual_px[keep] ** 2))
    sigma = float(np.sqrt(square / redundancy))
    covariance = _covariance(state, keep, unknowns, sigma, points)
    left_out = tuple(group for group in GROUPS if group not in tested_groups)
    late = state.network.delay_images
    return Calibration(
        observations=observations if points is None or late is None else observations.changed(points.at(late)[0]),
        network=state.network,
        used=keep,
        residual_px=state.residual_px,
        unknowns=unknowns,
        sigma0_px=sigma,
        redundancy=redundancy,
        covariance=covariance,
        considered=with_left_out(
            _in_step(covariance, unknowns), unknowns.in_step, full, first.interior - all_free.expected, left_out, bool(first.curved.any())
        ),
        decisions=tuple(decisions),
        converged=state.converged,
        other=other,
    )


def _covariance(
    state: Adjusted[AnyNetwork], keep: np.ndarray, unknowns: Unknowns, sigma: float, points: MovingPoints | None = None
) -> np.ndarray:
    velocity = None if points is None else residuals_of(state.network, points)[1]
    normals = normal_equations(state.network, state.residual_px, keep.astype(np.float64), unknowns, sigma, velocity)
    return camera_covariance(state.network, normals, unknowns) * sigma**2


def _in_step(covariance: np.ndarray, unknowns: Unknowns) -> np.ndarray:
    """The part of a covariance (C p, C p) that does not belong to delays."""
    others = np.flatnonzero(np.tile(unknowns.columns != DELAY, len(covariance) // len(unknowns.columns)))
    return covariance[np.ix_(others, others)]


def wald(network: Network, unknowns: Unknowns, covariance: np.ndarray, group: tuple[str, ...], redundancy: float) -> float:
    """Probability of values as large as those of a group in all cameras if their true values were the expected ones.  (3)"""
    x, Q = group_of(network.interior - unknowns.expected, unknowns, covariance, group)[:2]
    return _probability(x, Q, redundancy)


def _probability(x: np.ndarray, covariance: np.ndarray, redundancy: float) -> float:
    """Probability of values as large as x (m,) if their true values were 0.  (3)"""
    from scipy.special import fdtrc

    return float(fdtrc(len(x), redundancy, x @ np.linalg.solve(covariance, x) / len(x)))
