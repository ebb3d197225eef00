"""What is adjusted: observations of frames, of pairs of frames, of the shape and of smoothness, and their normal equations.

    Σ_t Σ_i w_i (r_i(θ_t, s) / σ0)² + Σ_t Σ_i w_i (r_i(θ_t, θ_{t+1}, s) / σ1)² + Σ_j r_j(s)² + Σ_t |θ̈_t / σ_a|²  →  min          (1)

r are residuals of unit weight (D'Apuzzo et al. 1999, Eqs. 9–12). Measured points and tracked points carry robust weights w and scales
σ0, σ1 that are estimated from them, and so do contours and keypoints. Which limb a point belongs to is decided anew at every
linearisation. Holding the shape while the pose is solved is choosing an empty set of free shape parameters.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from ...foundation.progress import Monitor
from ..observations import Block, FromBlocks, MaterialSteps, Observation
from ..robust import robust_scale, robust_weights, variance_factor
from ..state import BodyState, ShapeParameters
from .block_band import NormalEquations

LARGEST_SCALE = {"contours": 1.0}  # a body too thin all around would take that for the outlines' noise, and stay so: outlines are few


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Robust standard deviations of unit-weight residuals, kind by kind: measured points (sigma0), tracked points, contours, keypoints."""

    points: float = 1.0
    steps: float = 1.0
    contours: float = 1.0
    keypoints: float = 1.0

    def of(self, kind: str) -> float:
        """The scale of a kind."""
        return float(getattr(self, kind))

    def renewed(self, residuals: Mapping[str, list[np.ndarray]]) -> "Scales":
        """With the scales of these residuals; what has none keeps its own."""
        found = {kind: robust_scale(np.concatenate(r), self.of(kind)) for kind, r in residuals.items() if r}
        return replace(self, **found)


class Smoothness(Protocol):
    """What ties the frames of a motion (T, D) as a sum of squares that is quadratic in it."""

    def cost(self, motion: np.ndarray) -> float:
        """The sum of squares."""

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """An adjustment. `observe(t, state)` gives frame t's observations, `observe_step(t, a, b)` those from frame t to t + 1."""

    parameters: ShapeParameters
    observe: Callable[[int, BodyState], list[Observation]]
    observe_step: Callable[[int, BodyState, BodyState], MaterialSteps | None] | None = None
    shape_observations: Sequence[Observation] = ()
    shape_weight: float = 1.0
    free_shape: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    smoothness: Smoothness | None = None
    held: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))  # DOFs that keep their values
    robust: str = "geman-mcclure"
    robust_width: float = 3.0
    monitor: Monitor = field(default_factory=Monitor)  # asked at every frame whether to stop

    @cached_property
    def place_of_shape(self) -> np.ndarray:
        """(S,) where each shape parameter stands among the free ones; −1: it is held."""
        place = np.full(len(self.parameters.layout), -1)
        place[self.free_shape] = np.arange(len(self.free_shape))
        return place

    def weights(self, residuals: np.ndarray, scale: float, variance_inflation: np.ndarray | float, largest: float = np.inf) -> np.ndarray:
        """Weights of robust observations in (1); against other kinds they do not count for less than with the `largest` scale."""
        return robust_weights(residuals / scale, self.robust, self.robust_width) / (min(scale, largest) ** 2 * variance_inflation)


@dataclass(eq=False, kw_only=True)
class Linearised:
    """Observations with the weights that they have at one motion and shape; the cost and the normal equations there."""

    observations: list[list[tuple[Observation, np.ndarray | float]]]
    steps: list[tuple[MaterialSteps, np.ndarray] | None]
    equations: NormalEquations
    cost: float = 0.0
    residuals: dict[str, list[np.ndarray]] = field(default_factory=dict)  # of robust observations, by kind

    def scales(self, before: Scales) -> Scales:
        """The scales of the residuals here."""
        return before.renewed(self.residuals)


def linearise(problem: Problem, motion: np.ndarray, vector: np.ndarray, scales: Scales, understated: Scales | None = None) -> Linearised:
    """Weights, cost and normal equations at a motion (T, D) and shape vector (S,).

    `understated`: factors by which the variances of points and steps are understated (`variance_factors`); for covariances only.

    Raises:
        Cancelled: the user asked to stop.
    """
    factor = understated or Scales()
    T, D = motion.shape
    lin = Linearised(observations=[], steps=[], equations=NormalEquations.empty(T, D, len(problem.free_shape)))
    states = problem.parameters.states(motion, vector)
    for t, state in enumerate(states):
        problem.monitor.check()
        _add_frame(problem, lin, t, state, scales, factor)
    for t in range(T - 1):
        problem.monitor.check()
        _add_step(problem, lin, t, states[t], states[t + 1], scales.steps, factor.steps)
    for o in problem.shape_observations if len(problem.free_shape) else ():
        r, J, w = o.residual(states[0]), o.jacobian(states[0])[:, D + problem.free_shape], problem.shape_weight
        lin.equations.corner += w * J.T @ J
        lin.equations.h -= w * J.T @ r
        lin.cost += w * float(r @ r)
    if problem.smoothness is not None:
        problem.smoothness.add_to(lin.equations, motion)
        lin.cost += problem.smoothness.cost(motion)
    lin.equations.hold(problem.held)
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


def variance_factors(problem: Problem, lin: Linearised, scales: Scales) -> Scales:
    """By how much the weights understate variances (`robust.variance_factor`)."""
    return Scales(
        **{
            kind: variance_factor(np.concatenate(r) / scales.of(kind), problem.robust, problem.robust_width)
            * max(1.0, scales.of(kind) / LARGEST_SCALE.get(kind, np.inf)) ** 2
            for kind, r in lin.residuals.items()
            if r
        }
    )


def first_scales(problem: Problem, motion: np.ndarray, vector: np.ndarray, before: Scales) -> Scales:
    """The scales of the residuals before the first step."""
    states, residuals = problem.parameters.states(motion, vector), dict[str, list[np.ndarray]]()
    for t, state in enumerate(states):
        problem.monitor.check()
        for o in problem.observe(t, state):
            if o.kind:
                residuals.setdefault(o.kind, []).append(o.residual(state))
    for t, (a, b) in enumerate(zip(states, states[1:])):
        step = problem.observe_step(t, a, b) if problem.observe_step is not None else None
        if step is not None:
            residuals.setdefault("steps", []).append(step.residual(a, b))
    return before.renewed(residuals)


def blocks_of(observation: Observation, state: BodyState, shape: bool) -> Iterable[Block]:
    """The Jacobian in blocks; one that is not sparse is one block."""
    if isinstance(observation, FromBlocks):
        return observation.blocks(state, shape)
    J = observation.jacobian(state, shape)
    return [(np.arange(len(J)), np.arange(J.shape[1]), J)]


def _add_frame(problem: Problem, lin: Linearised, t: int, state: BodyState, scales: Scales, factor: Scales) -> None:
    e, free, D, frame = lin.equations, problem.free_shape, state.n_motion, []
    for o in problem.observe(t, state):
        r = o.residual(state)
        w: np.ndarray | float = 1.0
        if o.kind:
            lin.residuals.setdefault(o.kind, []).append(r)
            w = problem.weights(r, scales.of(o.kind), o.variance_inflation, LARGEST_SCALE.get(o.kind, np.inf)) / factor.of(o.kind)
        frame.append((o, w))
        lin.cost += float(np.sum(w * r * r))
        for rows, columns, J in blocks_of(o, state, len(free) > 0):
            weighted, columns, J = _free_columns(problem, D, w, rows, columns, J)
            H, g = weighted @ J, weighted @ r[rows]
            n = int(np.searchsorted(columns, D))  # its DOFs
            d, s = columns[:n], columns[n:] - D
            e.diagonal[t][d[:, None], d] += H[:n, :n]
            e.g[t][d] -= g[:n]
            if len(s):
                e.border[t][d[:, None], s] += H[:n, n:]
                e.corner[s[:, None], s] += H[n:, n:]
                e.h[s] -= g[n:]
    lin.observations.append(frame)


def _add_step(problem: Problem, lin: Linearised, t: int, a: BodyState, b: BodyState, scale: float, factor: float) -> None:
    step = problem.observe_step(t, a, b) if problem.observe_step is not None else None
    if step is None:
        lin.steps.append(None)
        return
    e, D = lin.equations, a.n_motion
    r = step.residual(a, b)
    w = problem.weights(r, scale, step.variance_inflation) / factor
    lin.steps.append((step, w))
    lin.residuals.setdefault("steps", []).append(r)
    lin.cost += float(np.sum(w * r * r))
    for rows, columns, J in step.blocks(a, b, len(problem.free_shape) > 0):
        weighted, columns, J = _free_columns(problem, 2 * D, w, rows, columns, J)
        H, g = weighted @ J, weighted @ r[rows]
        n = int(np.searchsorted(columns, D))  # its DOFs
        d, s = columns[:n], columns[2 * n :] - 2 * D
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


def _free_columns(
    problem: Problem, motion: int, w: np.ndarray | float, rows: np.ndarray, columns: np.ndarray, J: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted transpose (c, n), columns (c,) and J (n, c) of a block without the shape parameters that are held."""
    if len(columns) and columns[-1] >= motion and len(problem.free_shape) < len(problem.place_of_shape):
        place = np.where(columns < motion, columns, motion + problem.place_of_shape[np.maximum(columns - motion, 0)])
        keep = place >= np.where(columns < motion, 0, motion)
        columns, J = place[keep], J[:, keep]
    return J.T * (w if np.ndim(w) == 0 else np.asarray(w)[rows]), columns, J
