"""The first body: posture and shape at the frame in which the joints were clicked (D'Apuzzo et al. 1999, §3.3)."""

from collections.abc import Callable

import numpy as np

from ..errors import InputError
from ..progress import Monitor
from .cloud_points import CloudPoints
from .conditions import Conditions
from .inverse_kinematics import inverse_kinematics, other_postures
from .observations import Observation
from .problem import linearise
from .segmentation import crop
from .solver import Solution, solve
from .state import BodyState

REACH_M = 0.20  # points further than this from the clicked limb's surface are not looked at
WIDE = 1.5  # the gate, as long as the radii are the model's
POSE_STEPS, STEPS = 15, 25
SUSPICIOUS = 3.0  # sigma0 of a posture behind the limb or beside it
ALTERNATIONS, ALTERNATION_STEPS = 6, 5
MOST_OTHERS = 12  # of the starts for limbs that nobody clicked, those that explain most points
DEPTH_SHIFT_M = 0.04  # clicks from a short base are least certain along the view


def fit_click_frame(fit: Conditions, points: CloudPoints, monitor: Monitor) -> Solution:
    """Motion (1, D) and shape: the best supported of several starts about the clicked posture.

    Raises:
        InputError: no measured points lie near the clicked joints.
    """
    clicked = inverse_kinematics(fit.parameters, fit.clicks, fit.priors, fit.settings.length_sigma)
    best, best_support = None, -1.0
    starts = _starts(fit, points, clicked.motion[0], clicked.vector)
    for i, motion in enumerate(starts):
        monitor.step("fit the click frame", i, len(starts))
        solution = fit_posture_and_shape(fit, points, motion, clicked.vector)
        support = fit.support(points, solution.motion[0], solution.vector)
        if support > best_support:
            best, best_support = solution, support
    if best is None or best_support < fit.settings.min_points:
        raise InputError(f"Frame {points.frame} has no measured points near the clicked joints; check the clicks and the rig, "
                         "or click in a frame where the limb was measured.")
    return best


def fit_posture_and_shape(fit: Conditions, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> Solution:
    """From a motion (D,) and shape (S,) to the points; when the residuals stay suspiciously large, again by way of the clicks alone."""
    solution = _to_points(fit, points, motion, vector)
    if solution.scales.points < SUSPICIOUS:
        return solution
    clicked = inverse_kinematics(fit.parameters, fit.clicks, fit.priors, fit.settings.length_sigma)
    again = _to_points(fit, points, clicked.motion[0], clicked.vector)
    better = fit.support(points, again.motion[0], again.vector) > fit.support(points, solution.motion[0], solution.vector)
    return again if better else solution


def _to_points(fit: Conditions, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> Solution:
    """First the posture, then posture and shape, together or in turns as published."""
    near = crop(points, fit.parameters.state(motion, vector), REACH_M)
    solution = solve(fit.problem(_observe(fit, near, WIDE)), motion[None], vector, steps=POSE_STEPS)
    if fit.settings.method == "joint":
        for wide in (WIDE, 1.0):
            problem = fit.problem(_observe(fit, near, wide), "shape")
            solution = solve(problem, solution.motion, solution.vector, steps=STEPS, scales=solution.scales)
        return solution
    for _ in range(ALTERNATIONS):
        for free in ("flesh", None):
            problem = fit.problem(_observe(fit, near, 1.0), free)
            solution = solve(problem, solution.motion, solution.vector, steps=ALTERNATION_STEPS, scales=solution.scales)
    return solution


def clicked_lengths(fit: Conditions, points: CloudPoints, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """ln of the bone lengths (B,) and their sigmas, as the click frame knows them."""
    near = crop(points, fit.parameters.state(solution.motion[0], solution.vector), REACH_M)
    problem = fit.problem(_observe(fit, near, 1.0), "shape")
    covariance = linearise(problem, solution.motion, solution.vector, solution.scales).equations.covariance()[2]
    lengths = fit.parameters.layout.set("lengths")
    return solution.vector[lengths], np.sqrt(np.diag(covariance)[lengths])


def _starts(fit: Conditions, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> list[np.ndarray]:
    others = other_postures(fit.parameters, fit.clicks, motion)
    if len(others) > MOST_OTHERS:
        support = [fit.support(points, other, vector) for other in others]
        others = [others[i] for i in np.argsort(support)[::-1][:MOST_OTHERS]]
    starts = [motion, *others]
    view = np.mean([camera.R_cam_world[2] for camera in fit.cameras], axis=0)
    for shift in (-DEPTH_SHIFT_M, DEPTH_SHIFT_M):
        moved = motion.copy()
        moved[fit.model.skeleton.layout.set("base")] += shift * view
        starts.append(moved)
    return starts


def _observe(fit: Conditions, points: CloudPoints, wide: float) -> Callable[[int, BodyState], list[Observation]]:
    return lambda t, state: [fit.surface(points, state, wide), *fit.joints(fit.click), *fit.beliefs(state)]
