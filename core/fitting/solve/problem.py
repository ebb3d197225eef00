"""The adjustment: observations of frames, of pairs of frames, of the shape and of smoothness, and their normal equations.

    Σ_t Σ_i w_i (r_i(θ_t, s) / σ0)² + Σ_t Σ_i w_i (r_i(θ_t, θ_{t+1}, s) / σ1)² + Σ_j r_j(s)² + Σ_t |θ̈_t / σ_a|²  →  min          (1)

r are residuals of unit weight (D'Apuzzo et al. 1999, Eqs. 9–12). Measured points and tracked points carry robust weights w and scales
σ0, σ1 that are estimated from them, and so do contours and keypoints. Points are assigned to limbs anew at every linearisation. Solving
the pose with a fixed shape means an empty set of free shape parameters.

Robust weights of residuals x in units of their robust scale: Geman-McClure or Huber.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from ...foundation.progress import Monitor
from ...geometry.robust import mad_sigma
from ..observations import Block, FromBlocks, Observation, Steps
from ..state import BodyState, ShapeParameters
from .block_band import NormalEquations

SMALLEST_SCALE = 0.05  # of unit-weight residuals: perfect data must not make infinite weights
ENOUGH_FOR_SCALE = 5  # residuals for a median
ENOUGH = 20  # residuals for a variance factor
LEAST_SLOPE = 0.05  # of E[ψ']: mostly outliers, and the factor would be unbounded
FACTOR_RANGE = (0.5, 10.0)


def robust_scale(residuals: np.ndarray, fallback: float = 1.0) -> float:
    """Standard deviation of the good residuals from the median of their absolute values."""
    return max(float(mad_sigma(residuals)), SMALLEST_SCALE) if len(residuals) >= ENOUGH_FOR_SCALE else fallback


def robust_weights(x: np.ndarray, kind: str, width: float) -> np.ndarray:
    """Weights in (0, 1]; Geman-McClure's is ¼ at `width`, so that √w, a residual's pull, is ½ there."""
    return 1 / (1 + (x / width) ** 2) ** 2 if kind == "geman-mcclure" else np.minimum(1.0, width / np.maximum(np.abs(x), 1e-12))


def variance_factor(x: np.ndarray, kind: str, width: float) -> float:
    """Factor from the inverse of the weighted normal equations to the covariance: E[ψ²] E[w] / E[ψ']² (Huber 1981, §7.6)."""
    if len(x) < ENOUGH:
        return 1.0
    w = robust_weights(x, kind, width)
    slope: np.ndarray
    if kind == "geman-mcclure":
        u = (x / width) ** 2
        slope = (1 - 3 * u) / (1 + u) ** 3
    else:
        slope = (np.abs(x) < width).astype(float)
    mean_slope = max(float(np.mean(slope)), LEAST_SLOPE)
    return float(np.clip(np.mean((w * x) ** 2) * np.mean(w) / mean_slope**2, *FACTOR_RANGE))


LARGEST_SCALE = {
    "contours": 1.0,  # outlines are few: a body too thin all around would pass for their noise, and stay thin
    "hands": 1.0,  # a hand that is still turned would pass for theirs, and stay turned
}


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Robust standard deviations of unit-weight residuals, kind by kind: measured points (sigma0), tracked points, contours, keypoints,
    points of hands."""

    points: float = 1.0
    steps: float = 1.0
    contours: float = 1.0
    keypoints: float = 1.0
    hands: float = 1.0

    def of(self, kind: str) -> float:
        """The scale of a kind."""
        return float(getattr(self, kind))

    def renewed(self, residuals: Mapping[str, list[np.ndarray]]) -> "Scales":
        """With the scales of these residuals; kinds without residuals keep theirs."""
        found = {kind: robust_scale(np.concatenate(r), self.of(kind)) for kind, r in residuals.items() if r}
        return replace(self, **found)


class Smoothness(Protocol):
    """What couples the frames of a motion (T, D): a sum of squares that is quadratic in it."""

    def cost(self, motion: np.ndarray) -> float:
        """The sum of squares."""

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate:
    """A motion (T, D) and a shape vector (S,), with the scales of the residuals there (scales.points is sigma0)."""

    motion: np.ndarray
    vector: np.ndarray
    scales: Scales = field(default_factory=Scales)


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """An adjustment. `observe(t, state)` returns frame t's observations, `observe_step(t, a, b)` those from frame t to t + 1."""

    parameters: ShapeParameters
    observe: Callable[[int, BodyState], list[Observation]]
    observe_step: Callable[[int, BodyState, BodyState], Steps | None] | None = None
    shape_observations: Sequence[Observation] = ()
    shape_weight: float = 1.0
    free_shape: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    smoothness: Smoothness | None = None
    fixed: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))  # DOFs that keep their values
    robust: str = "geman-mcclure"
    robust_width: float = 3.0
    monitor: Monitor = field(default_factory=Monitor)  # checked for cancellation at every frame

    @cached_property
    def free_position(self) -> np.ndarray:
        """(S,) the position of each shape parameter among the free ones; −1: it is fixed."""
        place = np.full(len(self.parameters.layout), -1)
        place[self.free_shape] = np.arange(len(self.free_shape))
        return place

    def weights(self, residuals: np.ndarray, scale: float, variance_inflation: np.ndarray | float, largest: float = np.inf) -> np.ndarray:
        """Weights of robust observations in (1); relative to other kinds not less than with the `largest` scale."""
        return robust_weights(residuals / scale, self.robust, self.robust_width) / (min(scale, largest) ** 2 * variance_inflation)


@dataclass(eq=False, kw_only=True)
class Linearised:
    """Observations with their weights at one motion and shape; the cost and the normal equations there."""

    observations: list[list[tuple[Observation, np.ndarray | float]]]
    steps: list[tuple[Steps, np.ndarray] | None]
    equations: NormalEquations
    cost: float = 0.0
    residuals: dict[str, list[np.ndarray]] = field(default_factory=dict)  # of robust observations, by kind

    def scales(self, before: Scales) -> Scales:
        """The scales of the residuals here."""
        return before.renewed(self.residuals)


@dataclass(frozen=True, eq=False, kw_only=True)
class Observed:
    """All observations of the frames and of the steps between them, made at one motion and shape."""

    frames: list[list[Observation]]  # T
    steps: list[Steps | None]  # T − 1


def observed(problem: Problem, at: Estimate) -> Observed:
    """The observations at a motion and shape vector.

    Raises:
        Cancelled: the user asked to stop.
    """
    states, frames, steps = problem.parameters.states(at.motion, at.vector), [], []
    for t, state in enumerate(states):
        problem.monitor.check()
        frames.append(problem.observe(t, state))
    for t, (a, b) in enumerate(zip(states, states[1:])):
        problem.monitor.check()
        steps.append(_step(problem, t, a, b))
    return Observed(frames=frames, steps=steps)


def _step(problem: Problem, t: int, a: BodyState, b: BodyState) -> Steps | None:
    return problem.observe_step(t, a, b) if problem.observe_step is not None else None


def linearise(problem: Problem, at: Estimate, factors: Scales | None = None, given: Observed | None = None) -> Linearised:
    """Weights, cost and normal equations at a motion and shape vector, of the observations there, which may be `given`.

    Those that are not given are made frame by frame: what was evaluated for them is released before the next frame is observed.

    `factors`: variance factors of the kinds of observations (`variance_factors`), for covariances only.

    Raises:
        Cancelled: the user asked to stop.
    """
    factors, layout = factors or Scales(), problem.parameters.layout
    T, D = at.motion.shape
    lin = Linearised(observations=[], steps=[], equations=NormalEquations.empty(T, D, len(problem.free_shape)))
    states = problem.parameters.states(at.motion, at.vector)
    for t, state in enumerate(states):
        problem.monitor.check()
        _add_frame(problem, lin, t, state, given.frames[t] if given else problem.observe(t, state), at.scales, factors)
    for t, (a, b) in enumerate(zip(states, states[1:])):
        problem.monitor.check()
        _add_step(problem, lin, t, a, b, given.steps[t] if given else _step(problem, t, a, b), at.scales.steps, factors.steps)
    for o in problem.shape_observations if len(problem.free_shape) else ():
        r, J, w = o.residual(states[0]), o.jacobian(states[0])[:, layout.shape_columns(problem.free_shape)], problem.shape_weight
        lin.equations.corner += w * J.T @ J
        lin.equations.h -= w * J.T @ r
        lin.cost += w * float(r @ r)
    if problem.smoothness is not None:
        problem.smoothness.add_to(lin.equations, at.motion)
        lin.cost += problem.smoothness.cost(at.motion)
    lin.equations.fix(problem.fixed)
    return lin


def cost(problem: Problem, lin: Linearised, motion: np.ndarray, vector: np.ndarray) -> float:
    """(1) at another motion and shape, with the observations and weights of `lin`."""
    states = problem.parameters.states(motion, vector)
    total = 0.0
    for state, frame in zip(states, lin.observations):
        problem.monitor.check()
        for o, w in frame:
            total += float(np.sum(w * o.residual(state) ** 2))
    total += sum(float(np.sum(step[1] * step[0].residual(a, b) ** 2)) for a, b, step in zip(states, states[1:], lin.steps) if step)
    if len(problem.free_shape):
        total += problem.shape_weight * sum(float(np.sum(o.residual(states[0]) ** 2)) for o in problem.shape_observations)
    return total + (problem.smoothness.cost(motion) if problem.smoothness is not None else 0.0)


def variance_factors(problem: Problem, at: Estimate) -> Scales:
    """The variance factors of the kinds at a motion and shape (`variance_factor`)."""
    scales = at.scales
    return Scales(
        **{
            kind: variance_factor(np.concatenate(r) / scales.of(kind), problem.robust, problem.robust_width)
            * max(1.0, scales.of(kind) / LARGEST_SCALE.get(kind, np.inf)) ** 2
            for kind, r in _residuals(problem, at, observed(problem, at)).items()
            if r
        }
    )


def first_scales(problem: Problem, start: Estimate, given: Observed) -> Scales:
    """The scales of the residuals of the observations before the first step."""
    return start.scales.renewed(_residuals(problem, start, given))


def _residuals(problem: Problem, at: Estimate, given: Observed) -> dict[str, list[np.ndarray]]:
    """The residuals of robust observations, by kind."""
    states, residuals = problem.parameters.states(at.motion, at.vector), dict[str, list[np.ndarray]]()
    for state, frame in zip(states, given.frames):
        problem.monitor.check()
        for o in frame:
            if o.kind:
                residuals.setdefault(o.kind, []).append(o.residual(state))
    for a, b, step in zip(states, states[1:], given.steps):
        if step is not None:
            residuals.setdefault("steps", []).append(step.residual(a, b))
    return residuals


def blocks_of(observation: Observation, state: BodyState, shape: bool) -> Iterable[Block]:
    """The Jacobian in blocks; a dense one is one block."""
    if isinstance(observation, FromBlocks):
        return observation.blocks(state, shape)
    J = observation.jacobian(state, shape)
    return [(np.arange(len(J)), np.arange(J.shape[1]), J)]


def _add_frame(
    problem: Problem, lin: Linearised, t: int, state: BodyState, observations: list[Observation], scales: Scales, factor: Scales
) -> None:
    e, free, frame = lin.equations, problem.free_shape, []
    for o in observations:
        r = o.residual(state)
        w: np.ndarray | float = 1.0
        if o.kind:
            lin.residuals.setdefault(o.kind, []).append(r)
            w = problem.weights(r, scales.of(o.kind), o.variance_inflation, LARGEST_SCALE.get(o.kind, np.inf)) / factor.of(o.kind)
        frame.append((o, w))
        lin.cost += float(np.sum(w * r * r))
        for rows, columns, J in blocks_of(o, state, len(free) > 0):
            d, s, J = _free_columns(problem, 1, columns, J)
            weighted, n = _weighted(J, w, rows), len(d)
            H, g = weighted @ J, weighted @ r[rows]
            e.diagonal[t][d[:, None], d] += H[:n, :n]
            e.g[t][d] -= g[:n]
            if len(s):
                e.border[t][d[:, None], s] += H[:n, n:]
                e.corner[s[:, None], s] += H[n:, n:]
                e.h[s] -= g[n:]
    lin.observations.append(frame)


def _add_step(
    problem: Problem, lin: Linearised, t: int, a: BodyState, b: BodyState, step: Steps | None, scale: float, factor: float
) -> None:
    if step is None:
        lin.steps.append(None)
        return
    e, r = lin.equations, step.residual(a, b)
    w = problem.weights(r, scale, step.variance_inflation) / factor
    lin.steps.append((step, w))
    lin.residuals.setdefault("steps", []).append(r)
    lin.cost += float(np.sum(w * r * r))
    for rows, columns, J in step.blocks(a, b, len(problem.free_shape) > 0):
        both, s, J = _free_columns(problem, 2, columns, J)
        weighted, n = _weighted(J, w, rows), len(both) // 2
        H, g, d = weighted @ J, weighted @ r[rows], both[:n]
        A, B, S = slice(0, n), slice(n, 2 * n), slice(2 * n, None)
        dd, ds = (d[:, None], d), (d[:, None], s)
        e.diagonal[t][dd] += H[A, A]
        e.diagonal[t + 1][dd] += H[B, B]
        e.next1[t][dd] += H[B, A]
        e.g[t][d] -= g[A]
        e.g[t + 1][d] -= g[B]
        e.border[t][ds] += H[A, S]
        e.border[t + 1][ds] += H[B, S]
        e.corner[s[:, None], s] += H[S, S]
        e.h[s] -= g[S]


def _free_columns(problem: Problem, frames: int, columns: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose columns (p,), positions (s,) among the free shape parameters, and J (n, p + s) of a block, without fixed shape parameters."""
    pose, shape = problem.parameters.layout.split(columns, frames)
    if len(shape) and len(problem.free_shape) < len(problem.free_position):
        position = problem.free_position[shape]
        keep = np.concatenate([np.ones(len(pose), dtype=bool), position >= 0])
        shape, J = position[position >= 0], J[:, keep]
    return pose, shape, J


def _weighted(J: np.ndarray, w: np.ndarray | float, rows: np.ndarray) -> np.ndarray:
    """JᵀW (c, n) of some rows (n,)."""
    return np.asarray(J.T * (w if np.ndim(w) == 0 else np.asarray(w)[rows]))
