"""The first body: pose and shape at the click frame (D'Apuzzo et al. 1999, §3.3)."""

from collections.abc import Callable
from itertools import chain

import numpy as np

from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..limb import halton
from ..observations import Observation
from ..observations.shape_priors import clicked_chains
from ..segmentation import SegmentationCache, crop
from ..solve.problem import Estimate, linearise
from ..solve.solver import FURTHEST, Solution, solve
from ..state import BodyState
from .hidden_limbs import reacquired_poses
from .inverse_kinematics import inverse_kinematics, other_poses

REACH_M = 0.20  # of the points that take part, from the surface of the clicked pose
FIRST_GATE = 1.5  # gate_scale as long as the radii are the model's
FIRST_STEPS, MOST_STARTS = 4, 3  # of all starts; and how many of them go on
POSE_STEPS, STEPS = 15, 25
LARGEST_SIGMA0 = 3.0  # of a plausible pose; in front of the limb or past it, sigma0 is larger
KEPT_SCORE = 0.95  # of that with the outlines, by a body without them
ALTERNATIONS, ALTERNATION_STEPS = 8, 5
OTHERS_AROUND, AROUND_RAD, AROUND_M = 6, float(np.radians(20.0)), 0.05  # of new starts: six led to the true arm in all of 20 trials
MOST_OTHERS = 12  # starts for limbs without clicks: those that explain most points
STAGE = "fit the click frame"
FEW_JOINTS = 3  # that a sentence names
DEPTH_SHIFT_M = 0.04  # of two more starts: with a short base, clicks are least precise along the view


def fit_click_frame(fit: FitContext, points: CloudPoints, monitor: Monitor) -> Solution:
    """Pose (1, D) and shape: the best supported of several starts about the clicked pose.

    Raises:
        InputError: neither measured points nor outlines lie near the clicked joints, and there are no keypoints.
    """
    monitor.step(STAGE, 0, 1)
    clicked = inverse_kinematics(fit.parameters, fit.clicks, fit.priors, fit.proportions)
    best, best_score = None, -np.inf
    starts = _best_starts(fit, points, _starts(fit, points, clicked.motion[0], clicked.vector, monitor), clicked.vector, monitor)
    parts = [monitor.part(STAGE, i, len(starts) + 2) for i in range(len(starts) + 2)]
    for part, motion in zip(parts, starts):
        solution = _to_surface(fit, points, motion, clicked.vector, part)
        score = fit.score(fit.click, points, solution.motion[0], solution.vector)
        if score > best_score:
            best, best_score = solution, score
    if best is not None:
        best, best_score = _better_around(fit, points, best, best_score, parts[-2])
    if best is None or not (fit.tracks.joints(fit.click) or _is_seen(fit, points, best)):
        if not len(points.xyz_m):
            raise InputError(
                f"Frame {points.frame} has no measured surface, and no outlines near the clicked joints; check the clicks and the rig, "
                "click in a frame that was measured, or find outlines with `tricap contour`."
            )
        raise InputError(
            f"Frame {points.frame} has no measured points near the clicked joints, and no outlines; check the clicks and the "
            f"rig, or click in a frame where the limb was measured.{_not_clicked(fit)}"
        )
    return _shaped(fit, points, _with_lost_limbs(fit, points, best, best_score, parts[-1]), clicked.vector, monitor)


def _is_seen(fit: FitContext, points: CloudPoints, body: Solution) -> bool:
    """Whether enough points or outlines are about the body, or points that were followed in single views."""
    pose, least = body.motion[0], fit.settings.min_points
    if fit.support(fit.click, points, pose, body.vector) >= least:
        return True
    return fit.in_views is not None and fit.in_views.counts(fit.click, fit.parameters.state(pose, body.vector)).sum() >= least


def _not_clicked(fit: FitContext) -> str:
    """A sentence that names the joints without a place in space, where they are few: without them a limb may point anywhere."""
    names = [name for name, located in zip(fit.model.skeleton.joint_names, fit.clicks.located) if not located]
    return f" Not clicked in two views: {', '.join(names)}." if 0 < len(names) <= FEW_JOINTS else ""


def _shaped(fit: FitContext, points: CloudPoints, found: Solution, vector: np.ndarray, monitor: Monitor) -> Solution:
    """The solution with its shape adjusted anew from a vector (S,), without outlines against the background, where the points suffice."""
    if not fit.background.known or not len(points.xyz_m):
        return found
    again = _to_surface(fit.with_exact_outlines([points]), points, found.motion[0], vector, monitor)
    least = fit.score(fit.click, points, found.motion[0], found.vector) * KEPT_SCORE
    return again if fit.score(fit.click, points, again.motion[0], again.vector) > least else found


def _with_lost_limbs(fit: FitContext, points: CloudPoints, best: Solution, best_score: float, monitor: Monitor) -> Solution:
    """The solution, or a better one from a start where a limb without points explains points that no other part does.

    With a short base, clicks hardly determine a limb's depth: bent towards the cameras it looks as bent away from them.
    """
    found = reacquired_poses(fit, fit.click, points, best.motion[0], best.vector, _try(monitor, 0))
    for i, start in enumerate(found):
        solution = _to_surface(fit, points, start, best.vector, _try(monitor, i + 1))
        score = fit.score(fit.click, points, solution.motion[0], solution.vector)
        if score > best_score + fit.least_gain:
            best, best_score = solution, score
    return best


def fit_pose_and_shape(
    fit: FitContext, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, monitor: Monitor | None = None
) -> Solution:
    """Adjust a pose (D,) and shape (S,) to the points and outlines.

    When the residuals stay too large, also from the clicked pose and from others around it; the best supported wins.

    Raises:
        Cancelled: the user asked to stop.
    """
    monitor = monitor or Monitor()
    first = _to_surface(fit, points, motion, vector, _try(monitor, 0))
    return _better_around(fit, points, first, fit.score(fit.click, points, first.motion[0], first.vector), monitor)[0]


def _better_around(fit: FitContext, points: CloudPoints, best: Solution, best_score: float, monitor: Monitor) -> tuple[Solution, float]:
    """The solution and its score, where its residuals are too large a better one from the clicked pose or from others around it."""
    if _plausible(best) or not fit.settings.search_limbs:
        return best, best_score
    clicked = inverse_kinematics(fit.parameters, fit.clicks, fit.priors, fit.proportions)
    for i, start in enumerate(_around(fit, clicked.motion[0])):
        solution = _to_surface(fit, points, start, clicked.vector, _try(monitor, i + 1))
        score = fit.score(fit.click, points, solution.motion[0], solution.vector)
        if score > best_score:
            best, best_score = solution, score
        if _plausible(best):
            break
    return best, best_score


def _try(monitor: Monitor, number: int) -> Monitor:
    """The monitor of one of an unknown number of tries: each counts for half of what remains."""
    return monitor.part(STAGE, 2 ** (number + 1) - 2, 2 ** (number + 1))


def _plausible(solution: Solution) -> bool:
    return max(solution.scales.points, solution.scales.contours) < LARGEST_SIGMA0


def _around(fit: FitContext, motion: np.ndarray) -> np.ndarray:
    """The pose (D,) and others evenly around it (K, D) within the joints' limits, the same in every run; fixed DOFs stay."""
    skeleton = fit.model.skeleton
    spread = np.full(len(motion), AROUND_RAD)
    spread[skeleton.layout.group("base")] = AROUND_M
    spread[skeleton.locked] = 0.0
    low, high = np.array([dof.limits for dof in skeleton.dofs]).T
    moved = motion + spread * (2 * halton(len(motion), OTHERS_AROUND + 1)[1:] - 1)  # the first point is a corner
    within = np.where(spread > 0, np.clip(moved, np.minimum(low, motion), np.maximum(high, motion)), motion)
    return np.concatenate([motion[None], within])


def _to_surface(fit: FitContext, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, monitor: Monitor) -> Solution:
    """First the pose, then pose and shape: together, or alternating as published, each with the other fixed."""
    near = crop(points, fit.parameters.state(motion, vector), REACH_M)
    rounds = 2 if fit.settings.method == "joint" else 2 * ALTERNATIONS
    parts = iter([monitor.part(STAGE, i, 1 + rounds) for i in range(1 + rounds)])
    pose_only, start = fit.problem(_observe(fit, near, FIRST_GATE)), Estimate(motion=motion[None], vector=vector)
    solution = solve(pose_only, start, steps=POSE_STEPS, furthest=FURTHEST, monitor=next(parts))
    if fit.settings.method == "joint":
        for gate_scale, part in zip((FIRST_GATE, 1.0), parts):
            solution = solve(fit.problem(_observe(fit, near, gate_scale), "shape"), solution, steps=STEPS, monitor=part)
        return solution
    for _ in range(ALTERNATIONS):
        for free, part in zip(("shape", None), parts):
            problem = fit.problem(_observe(fit, near, 1.0), free, fix_pose=free is not None)
            solution = solve(problem, solution, steps=ALTERNATION_STEPS, monitor=part)
    return solution


def clicked_lengths(fit: FitContext, points: CloudPoints, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """ln of the bone lengths (B,) and their sigmas from the click frame; infinite for bones that are not between clicks."""
    near = crop(points, fit.parameters.state(solution.motion[0], solution.vector), REACH_M)
    problem = fit.problem(_observe(fit, near, 1.0), "shape")
    covariance = linearise(problem, solution).equations.covariance()[2]
    lengths = fit.parameters.layout.group("lengths")
    between = np.isin(lengths, list(chain.from_iterable(clicked_chains(fit.model.skeleton, fit.located))))
    return solution.vector[lengths], np.where(between, np.sqrt(np.diag(covariance)[lengths]), np.inf)


def _starts(fit: FitContext, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, monitor: Monitor) -> list[np.ndarray]:
    others = other_poses(fit.parameters, fit.clicks, motion)
    if len(others) > MOST_OTHERS:
        support = []
        for other in others:
            monitor.step(STAGE, 0, 1)
            support.append(fit.support(fit.click, points, other, vector))
        others = [others[i] for i in np.argsort(support)[::-1][:MOST_OTHERS]]
    starts = [motion, *others]
    view = np.mean([camera.R_cam_world[2] for camera in fit.cameras], axis=0)
    for shift in (-DEPTH_SHIFT_M, DEPTH_SHIFT_M):
        moved = motion.copy()
        moved[fit.model.skeleton.layout.group("base")] += shift * view
        starts.append(moved)
    return starts


def _best_starts(fit: FitContext, points: CloudPoints, starts: list[np.ndarray], vector: np.ndarray, monitor: Monitor) -> list[np.ndarray]:
    """The `MOST_STARTS` whose poses explain most after a few steps with the shape fixed."""
    if len(starts) <= MOST_STARTS:
        return starts
    score = []
    for motion in starts:
        near = crop(points, fit.parameters.state(motion, vector), REACH_M)
        problem, start = fit.problem(_observe(fit, near, FIRST_GATE)), Estimate(motion=motion[None], vector=vector)
        pose = solve(problem, start, steps=FIRST_STEPS, furthest=FURTHEST, monitor=monitor, stage=STAGE).motion[0]
        score.append(fit.score(fit.click, points, pose, vector))
    return [starts[i] for i in np.sort(np.argsort(-np.array(score), kind="stable")[:MOST_STARTS])]


def _observe(fit: FitContext, points: CloudPoints, gate_scale: float) -> Callable[[int, BodyState], list[Observation]]:
    cache = SegmentationCache()
    return lambda t, state: [
        *fit.surface_observations(fit.click, points, state, gate_scale, cache),
        *fit.joints(fit.click),
        *fit.pose_observations(state),
    ]
