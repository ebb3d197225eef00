"""Levenberg-Marquardt over one frame or a whole sequence (D'Apuzzo et al. 1999, Eqs. 9–13, with Marquardt's damping of the diagonal).

    (A + λ diag A + μ_t I) x = g                                                                          (1)

Marquardt's damping λ is relative: a limb's twist, which points from one side hardly constrain, may still turn by radians in one step, far
beyond where the linearisation is valid, and end in another pose. So from a start that may be far off, frames get Levenberg's absolute
damping μ_t, each as much as it takes for no DOF to go further than `FURTHEST`.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...foundation.progress import Monitor
from .block_band import NormalEquations
from .problem import Estimate, Linearised, Observed, Problem, cost, first_scales, linearise, observed

START_DAMPING = 1e-3  # λ
LARGEST_DAMPING = 1e8  # of λ: from here on no step lowers the cost
SMALLEST_DAMPING = 1e-9  # of λ
DAMPING_FACTOR = 10.0  # of λ and of μ, from one try to the next
FURTHEST = 0.2  # rad, m: a step of any DOF from a start that may be far off
FIRST_MU, LARGEST_MU = 10.0, 1e12  # 1/rad², 1/m²
POOR, GOOD = 0.25, 0.5  # gain of a step over the predicted gain (Madsen, Nielsen & Tingleff 2004, §3.2)
STEP_DONE = 1e-4  # rad, m, relative
COST_DONE = 1e-4
SIGMAS_DONE = 0.01  # root mean square over the parameters: a step that gains (0.01 σ)² each needs no other
SLIGHT_STEPS = 2  # in a row: a single slight step may lie before points change limbs, and the next one may gain much


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution(Estimate):
    """The adjusted motion and shape vector, their cost and scales.

    converged: the cost is finite, and the last step was small or gained next to nothing, or the last two gained little.
    """

    cost: float
    iterations: int
    converged: bool


def solve(
    problem: Problem,
    start: Estimate,
    *,
    steps: int,
    monitor: Monitor | None = None,
    stage: str = "fit",
    furthest: float = np.inf,
    slight_sigmas: float = 0.0,
) -> Solution:
    """Minimise the problem's cost. Time and memory are linear in frames.

    `furthest` [rad, m]: the largest change of a DOF in one step; `FURTHEST` from a start that may be far off. `slight_sigmas`: root mean
    square over the parameters; after `SLIGHT_STEPS` hardly damped steps in a row that gain less, the adjustment ends.

    Raises:
        Cancelled: the user asked to stop.
    """
    now = Estimate(motion=np.array(start.motion, dtype=np.float64), vector=np.array(start.vector, dtype=np.float64), scales=start.scales)
    given: Observed | None = (first := observed(problem, now))
    now = replace(now, scales=first_scales(problem, now, first))
    damping, done, iteration, last, slight = START_DAMPING, False, 0, float("nan"), 0
    while iteration < steps and not done:
        if monitor is not None:
            monitor.step(stage, iteration, steps)
        iteration += 1
        lin, given = linearise(problem, now, given=given), None
        last = lin.cost
        new, damping = _accepted_step(problem, lin, now, damping, furthest)
        if new is None:
            done = _at_minimum(lin)
            break
        motion, vector, last = new
        size = max(float(np.abs(motion - now.motion).max()), float(np.abs(vector - now.vector).max()))
        parameters = motion.size + len(problem.free_shape)
        gain = lin.cost - last
        slight = slight + 1 if gain < slight_sigmas**2 * parameters and damping <= START_DAMPING else 0
        done = size < STEP_DONE or gain < max(COST_DONE * lin.cost, SIGMAS_DONE**2 * parameters) or slight == SLIGHT_STEPS
        now = Estimate(motion=motion, vector=vector, scales=lin.scales(now.scales))
    converged = done and bool(np.isfinite(last))
    return Solution(motion=now.motion, vector=now.vector, scales=now.scales, cost=last, iterations=iteration, converged=converged)


def _at_minimum(lin: Linearised) -> bool:
    """Whether a place from which no step lowers the cost is a minimum: the undamped step would be small, or gain next to nothing."""
    try:
        dx, ds = lin.equations.solve(START_DAMPING)
    except np.linalg.LinAlgError:
        return False
    size = max(float(np.abs(dx).max(initial=0.0)), float(np.abs(ds).max(initial=0.0)))
    gain = float(np.sum(dx * lin.equations.g) + ds @ lin.equations.h)
    return bool(np.isfinite(lin.cost)) and (size < STEP_DONE or gain < COST_DONE * lin.cost)


def _accepted_step(
    problem: Problem, lin: Linearised, now: Estimate, damping: float, furthest: float
) -> tuple[tuple[np.ndarray, np.ndarray, float] | None, float]:
    """The first damped step that does not raise the cost: new motion, new vector, new cost; None if there is none."""
    while damping < LARGEST_DAMPING:
        try:
            dx, ds = bounded_step(lin.equations, damping, furthest)
        except np.linalg.LinAlgError:
            damping *= DAMPING_FACTOR
            continue
        motion, vector = now.motion + dx, now.vector.copy()
        vector[problem.free_shape] += ds
        value = cost(problem, lin, motion, vector)
        if value <= lin.cost:
            predicted = float(np.sum(dx * lin.equations.g) + ds @ lin.equations.h)
            return (motion, vector, value), _next_damping(damping, lin.cost - value, predicted)
        damping *= DAMPING_FACTOR
    return None, damping


def bounded_step(equations: NormalEquations, damping: float, furthest: float) -> tuple[np.ndarray, np.ndarray]:
    """The damped step (T, D), (S,) in which no DOF of a frame changes by more than `furthest`.  (1)"""
    mu = np.zeros(len(equations.g))
    while True:
        dx, ds = equations.solve(damping, mu)
        far = np.abs(dx).max(axis=1, initial=0.0) > furthest
        if not far.any() or mu.max() > LARGEST_MU:
            return dx, ds
        mu[far] = np.maximum(DAMPING_FACTOR * mu[far], FIRST_MU)


def _next_damping(damping: float, gain: float, predicted: float) -> float:
    """Less after a step that gained as predicted, more after one that gained far less (Madsen, Nielsen & Tingleff 2004)."""
    if gain < POOR * predicted:
        return damping * DAMPING_FACTOR
    return max(damping / DAMPING_FACTOR, SMALLEST_DAMPING) if gain > GOOD * predicted else damping
