"""Levenberg-Marquardt over one frame or a whole sequence (D'Apuzzo et al. 1999, Eqs. 9–13, with Marquardt's damping of the diagonal).

Marquardt's damping is relative: a limb's twist, of which one-sided points tell little, may still turn by radians in one step, far beyond
what the linearisation knows, and end in another posture. So from a start that may be far off, frames are held back by Levenberg's absolute
damping, each as much as it takes for no DOF to go further than `FURTHEST`.
"""

from dataclasses import dataclass

import numpy as np

from ...foundation.progress import Monitor
from .block_band import NormalEquations
from .problem import Linearised, Problem, Scales, cost, first_scales, linearise

START_DAMPING, LARGEST_DAMPING = 1e-3, 1e8
FURTHEST = 0.2  # rad, m: a step of any DOF from a start that may be far off
HELD_BACK, MOST_HELD_BACK = 10.0, 1e12  # 1/rad², 1/m²: first, and where it ends
POOR, GOOD = 0.25, 0.5  # gain of a step over what was foreseen
STEP_DONE = 1e-4  # rad, m, relative
COST_DONE = 1e-4
SIGMAS_DONE = 0.01  # root mean square over the parameters: as much as a step gains, (0.01 σ)² each, is not worth another


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """The adjusted motion (T, D) and shape vector (S,), what it cost, and the scales of the residuals (scales.points is sigma0).

    converged: the cost is finite, and the last step was small or gained next to nothing.
    """

    motion: np.ndarray
    vector: np.ndarray
    cost: float
    scales: Scales
    iterations: int
    converged: bool


def solve(
    problem: Problem,
    motion: np.ndarray,
    vector: np.ndarray,
    *,
    steps: int,
    scales: Scales | None = None,
    monitor: Monitor | None = None,
    stage: str = "fit",
    furthest: float = np.inf,
) -> Solution:
    """Minimise the problem's cost from a motion (T, D) and a shape vector (S,). Time and memory are linear in frames.

    `furthest` [rad, m]: no DOF goes further in one step; `FURTHEST` from a start that may be far off.

    Raises:
        Cancelled: the user asked to stop.
    """
    motion, vector = np.array(motion, dtype=np.float64), np.array(vector, dtype=np.float64)
    scales = first_scales(problem, motion, vector, scales or Scales())
    damping, done, iteration, last = START_DAMPING, False, 0, float("nan")
    while iteration < steps and not done:
        if monitor is not None:
            monitor.step(stage, iteration, steps)
        iteration += 1
        lin = linearise(problem, motion, vector, scales)
        last = lin.cost
        new, damping = _accepted_step(problem, lin, motion, vector, damping, furthest)
        if new is None:
            done = _at_minimum(lin)
            break
        size = max(float(np.abs(new[0] - motion).max()), float(np.abs(new[1] - vector).max()))
        parameters = motion.size + len(problem.free_shape)
        done = size < STEP_DONE or (lin.cost - new[2]) < max(COST_DONE * lin.cost, SIGMAS_DONE**2 * parameters)
        motion, vector, last = new
        scales = lin.scales(scales)
    converged = done and bool(np.isfinite(last))
    return Solution(motion=motion, vector=vector, cost=last, scales=scales, iterations=iteration, converged=converged)


def _at_minimum(lin: Linearised) -> bool:
    """Whether a linearisation from which no step lowers the cost is at its minimum: a whole step would be small, or gain nothing."""
    try:
        dx, ds = lin.equations.solve(START_DAMPING)
    except np.linalg.LinAlgError:
        return False
    size = max(float(np.abs(dx).max(initial=0.0)), float(np.abs(ds).max(initial=0.0)))
    gain = float(np.sum(dx * lin.equations.g) + ds @ lin.equations.h)
    return bool(np.isfinite(lin.cost)) and (size < STEP_DONE or gain < COST_DONE * lin.cost)


def _accepted_step(
    problem: Problem, lin: Linearised, motion: np.ndarray, vector: np.ndarray, damping: float, furthest: float
) -> tuple[tuple[np.ndarray, np.ndarray, float] | None, float]:
    """The first damped step that does not raise the cost: new motion, new vector, new cost; None if there is none."""
    while damping < LARGEST_DAMPING:
        try:
            dx, ds = bounded_step(lin.equations, damping, furthest)
        except np.linalg.LinAlgError:
            damping *= 10
            continue
        new_vector = vector.copy()
        new_vector[problem.free_shape] += ds
        value = cost(problem, lin, motion + dx, new_vector)
        if value <= lin.cost:
            foreseen = float(np.sum(dx * lin.equations.g) + ds @ lin.equations.h)
            return (motion + dx, new_vector, value), _next_damping(damping, lin.cost - value, foreseen)
        damping *= 10
    return None, damping


def bounded_step(equations: NormalEquations, damping: float, furthest: float) -> tuple[np.ndarray, np.ndarray]:
    """The damped step (T, D), (S,) in which no DOF of a frame goes further than `furthest`."""
    held_back = np.zeros(len(equations.g))
    while True:
        dx, ds = equations.solve(damping, held_back)
        far = np.abs(dx).max(axis=1, initial=0.0) > furthest
        if not far.any() or held_back.max() > MOST_HELD_BACK:
            return dx, ds
        held_back[far] = np.maximum(10 * held_back[far], HELD_BACK)


def _next_damping(damping: float, gain: float, foreseen: float) -> float:
    """Less after a step that gained what was foreseen, more after one that gained far less (Madsen, Nielsen & Tingleff 2004)."""
    if gain < POOR * foreseen:
        return damping * 10
    return max(damping / 10, 1e-9) if gain > GOOD * foreseen else damping
