"""Levenberg-Marquardt over one frame or a whole sequence: poses per frame, shape shared, weights from sigmas (D'Apuzzo et al. 1999, Eqs. 9–12).

    Σ_t Σ_i w_i (r_i(θ_t, s) / σ0)² + Σ_j r_j(s)² + Σ_t |θ̈_t / σ_a|²  →  min                                    (1)

r_i are residuals of unit weight; only measured points carry robust weights w_i and the scale σ0, which is estimated from them. Points are
assigned to limbs anew at every step (`observe`). Holding the shape while the pose is solved is choosing an empty set of free shape parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..progress import Monitor
from .block_band import NormalEquations
from .observations import Observation
from .robust import robust_scale, robust_weights, variance_factor
from .state import BodyState, ShapeParameters

START_DAMPING, LARGEST_DAMPING = 1e-3, 1e8
STEP_DONE = 2e-5  # rad, m, relative
COST_DONE = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class Acceleration:
    """Second differences over time: (2/(h1+h2)) ((θ3−θ2)/h2 − (θ2−θ1)/h1) / σ, σ (D,) in rad/s² and m/s²."""

    time_s: np.ndarray  # (T,)
    sigma: np.ndarray  # (D,)

    def coefficients(self) -> np.ndarray:
        """(T−2, 3) of θ1, θ2, θ3."""
        h = np.diff(self.time_s)
        h1, h2 = h[:-1], h[1:]
        return (2 / (h1 + h2))[:, None] * np.stack([1 / h1, -1 / h1 - 1 / h2, 1 / h2], axis=1)

    def cost(self, motion: np.ndarray) -> float:
        """Sum of squares."""
        if len(motion) < 3:
            return 0.0
        c = self.coefficients()
        return float(np.sum(((c[:, 0, None] * motion[:-2] + c[:, 1, None] * motion[1:-1] + c[:, 2, None] * motion[2:]) / self.sigma) ** 2))

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations of these observations."""
        weight = 1 / self.sigma**2
        for t, c in enumerate(self.coefficients() if len(motion) > 2 else ()):
            value = weight * (c @ motion[t : t + 3])
            for i in range(3):
                equations.diagonal[t + i] += np.diag(c[i] ** 2 * weight)
                equations.g[t + i] -= c[i] * value
            equations.next1[t] += np.diag(c[1] * c[0] * weight)
            equations.next1[t + 1] += np.diag(c[2] * c[1] * weight)
            equations.next2[t] += np.diag(c[2] * c[0] * weight)


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """What is to be adjusted. `observe(t, state, sigma0)` gives the observations of frame t for a body near `state`."""

    parameters: ShapeParameters
    observe: Callable[[int, BodyState, float], list[Observation]]
    of_shape: Sequence[Observation] = ()  # observations of the shape alone
    free_shape: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    smoothness: Acceleration | None = None
    robust: str = "geman-mcclure"
    robust_width: float = 3.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """The adjusted motion (T, D) and shape vector (S,), what it cost, and sigma0, the scale of the measured points' residuals."""

    motion: np.ndarray
    vector: np.ndarray
    cost: float
    sigma0: float
    iterations: int
    converged: bool


@dataclass(eq=False)
class _Linearised:
    observations: list[list[Observation]]
    weights: list[list[np.ndarray | float]]
    cost: float
    residuals: np.ndarray  # of the measured points


def solve(problem: Problem, motion: np.ndarray, vector: np.ndarray, *, steps: int, sigma0: float = 1.0,
          monitor: Monitor | None = None, stage: str = "fit") -> Solution:
    """Minimise (1) from a motion (T, D) and a shape vector (S,). Cost is linear in frames.

    Raises:
        Cancelled: the user asked to stop.
    """
    motion, vector = np.array(motion, dtype=np.float64), np.array(vector, dtype=np.float64)
    damping, done, iteration = START_DAMPING, False, 0
    sigma0 = _first_scale(problem, motion, vector, sigma0)
    lin = None
    for iteration in range(1, steps + 1):
        if monitor is not None:
            monitor.step(stage, iteration - 1, steps)
        lin, equations = linearise(problem, motion, vector, sigma0)
        step, damping = _accepted_step(problem, lin, equations, motion, vector, damping)
        if step is None:
            done = True
            break
        motion, vector = step[0], step[1]
        sigma0 = robust_scale(lin.residuals, sigma0)
        if step[2] < STEP_DONE or step[3] < COST_DONE:
            done = True
            break
    cost = lin.cost if lin is not None else float("nan")
    return Solution(motion=motion, vector=vector, cost=cost, sigma0=sigma0, iterations=iteration, converged=done)


def linearise(problem: Problem, motion: np.ndarray, vector: np.ndarray, sigma0: float,
              variance: float = 1.0) -> tuple[_Linearised, NormalEquations]:
    """Observations, weights, cost and normal equations at a motion and shape. `variance` divides the weight of measured points."""
    free = problem.free_shape
    T, D = motion.shape
    equations = NormalEquations.empty(T, D, len(free))
    lin = _Linearised([], [], 0.0, np.zeros(0))
    measured = []
    for t in range(T):
        state = problem.parameters.state(motion[t], vector)
        observations, weights = problem.observe(t, state, sigma0), []
        for o in observations:
            r, J = o.residual(state), o.jacobian(state, shape=len(free) > 0)
            w: np.ndarray | float = 1.0
            if o.robust:
                measured.append(r)
                w = robust_weights(r / sigma0, problem.robust, problem.robust_width) / (sigma0**2 * variance)
            weights.append(w)
            lin.cost += float(np.sum(w * r * r))
            _add(equations, t, D, free, r, J, w)
        lin.observations.append(observations)
        lin.weights.append(weights)
    state = problem.parameters.state(motion[0], vector)
    for o in problem.of_shape if len(free) else ():
        r, J = o.residual(state), o.jacobian(state)[:, D + free]
        equations.corner += J.T @ J
        equations.h -= J.T @ r
        lin.cost += float(r @ r)
    if problem.smoothness is not None:
        problem.smoothness.add_to(equations, motion)
        lin.cost += problem.smoothness.cost(motion)
    lin.residuals = np.concatenate(measured) if measured else lin.residuals
    return lin, equations


def final_equations(problem: Problem, solution: Solution) -> tuple[np.ndarray, NormalEquations]:
    """Residuals of the measured points and the normal equations whose inverse is the covariance, at the solution."""
    lin, _ = linearise(problem, solution.motion, solution.vector, solution.sigma0)
    factor = variance_factor(lin.residuals / solution.sigma0, problem.robust, problem.robust_width)
    return lin.residuals, linearise(problem, solution.motion, solution.vector, solution.sigma0, factor)[1]


def _add(equations: NormalEquations, t: int, D: int, free: np.ndarray, r: np.ndarray, J: np.ndarray, w: np.ndarray | float) -> None:
    weighted = J * (w[:, None] if isinstance(w, np.ndarray) else w)
    M = J[:, :D]
    equations.diagonal[t] += weighted[:, :D].T @ M
    equations.g[t] -= weighted[:, :D].T @ r
    if len(free):
        S = J[:, D + free]
        equations.border[t] += weighted[:, :D].T @ S
        equations.corner += weighted[:, D + free].T @ S
        equations.h -= weighted[:, D + free].T @ r


def _accepted_step(problem: Problem, lin: _Linearised, equations: NormalEquations, motion: np.ndarray, vector: np.ndarray,
                   damping: float) -> tuple[tuple[np.ndarray, np.ndarray, float, float] | None, float]:
    """The first damped step that lowers the cost: new motion, new vector, size, relative gain; None if there is none."""
    while damping < LARGEST_DAMPING:
        try:
            dx, ds = equations.solve(damping)
        except np.linalg.LinAlgError:
            damping *= 10
            continue
        new_motion, new_vector = motion + dx, vector.copy()
        new_vector[problem.free_shape] += ds
        cost = _cost(problem, lin, new_motion, new_vector)
        if cost <= lin.cost:
            size = max(float(np.abs(dx).max()), float(np.abs(ds).max(initial=0.0)))
            return (new_motion, new_vector, size, (lin.cost - cost) / max(lin.cost, 1e-300)), max(damping / 10, 1e-9)
        damping *= 10
    return None, damping


def _cost(problem: Problem, lin: _Linearised, motion: np.ndarray, vector: np.ndarray) -> float:
    total = 0.0
    for t, (observations, weights) in enumerate(zip(lin.observations, lin.weights)):
        state = problem.parameters.state(motion[t], vector)
        for o, w in zip(observations, weights):
            total += float(np.sum(w * o.residual(state) ** 2))
    if len(problem.free_shape):
        state = problem.parameters.state(motion[0], vector)
        total += sum(float(np.sum(o.residual(state) ** 2)) for o in problem.of_shape)
    return total + (problem.smoothness.cost(motion) if problem.smoothness is not None else 0.0)


def _first_scale(problem: Problem, motion: np.ndarray, vector: np.ndarray, sigma0: float) -> float:
    residuals = [o.residual(state) for t in range(len(motion)) for state in [problem.parameters.state(motion[t], vector)]
                 for o in problem.observe(t, state, sigma0) if o.robust]
    return robust_scale(np.concatenate(residuals), sigma0) if residuals else sigma0
