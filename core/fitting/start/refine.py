"""From a hypothesis to an adjusted pose, and to the rival that explains the same limbs with the sides exchanged."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.clicks import Clicks
from ..inputs.cloud_points import CloudPoints
from ..inputs.start_joints import StartJoints
from ..observations import Keypoints, Observation
from ..segmentation import SegmentationCache, crop
from ..solve.problem import Estimate
from ..solve.solver import FURTHEST, solve
from ..stages.hidden_limbs import reacquired_poses
from ..stages.inverse_kinematics import inverse_kinematics
from ..state import BodyState
from .search import click_penalty, scaled_vector

REACH_M = 0.25  # of the points that take part, from the body
ROUNDS = ((2.5, 6), (1.5, 6))  # gate_scale, steps
FOLLOWING, STRIDE = ((1.5, 4),), 3  # the same where an explanation is followed through frames, and how many frames at a time
LENGTH_STEPS = 8
CLOSE = 250.0  # voxels less than the best: limbs of a rival that explains less are not looked for
LEAST_POINTS, MOST_POINTS = 100, 700  # of a frame
EXCHANGES = {
    "front and back": ("hip", "knee", "ankle", "clavicle", "shoulder", "elbow", "wrist", "knuckles"),
    "the left and the right leg": ("knee", "ankle"),
}
LEFT_OUT = ("toe", "crown")  # of an exchange: they depend on where the person faces
SIGMA_M = 0.03  # of the joints of a rival
STAGE = "find the person"


@dataclass(frozen=True, eq=False, kw_only=True)
class Explanation:
    """A pose (D,) of a body with the shape vector (S,) in frame index `t`, and how much it explains [voxels]."""

    t: int
    pose: np.ndarray
    vector: np.ndarray
    score: float
    joints_m: np.ndarray  # (J, 3)


def exchanges_of(fit: FitContext) -> dict[str, tuple[str, ...]]:
    """The exchanges (`EXCHANGES`) that change anything of a body: not those of legs that it does not have."""
    parts = {name.partition(".")[0] for name in fit.model.skeleton.joint_names}
    return {name: joints for name, joints in EXCHANGES.items() if parts & {*joints}}


def explanation(fit: FitContext, t: int, points: CloudPoints, pose: np.ndarray, vector: np.ndarray) -> Explanation:
    """A pose with its score: `FitContext.score`, less the penalty for missed clicks."""
    joints, score = fit.parameters.state(pose, vector).joints_m, fit.score(t, points, pose, vector)
    if t in fit.clicked:
        clicks = fit.clicked[t]
        score -= sum(float(click_penalty(clicks, j, joints[j][None])[0]) for j in np.unique(clicks.joint).tolist())
    return Explanation(t=t, pose=pose, vector=vector, score=score, joints_m=joints)


def thinned_points(points: CloudPoints) -> CloudPoints:
    """Not more than `MOST_POINTS`, evenly from the order of the voxels."""
    return points.take(np.arange(0, len(points.xyz_m), 1 + (len(points.xyz_m) - 1) // MOST_POINTS)) if len(points.xyz_m) else points


def adjusted(
    fit: FitContext,
    points: CloudPoints,
    start: Explanation,
    rounds: Sequence[tuple[float, int]] = ROUNDS,
    monitor: Monitor | None = None,
    free: str | None = None,
) -> Explanation:
    """The pose adjusted to what is seen in its frame; with `free` also these parameters of the shape.

    Raises:
        Cancelled: the user asked to stop.
    """
    near = crop(points, fit.parameters.state(start.pose, start.vector), REACH_M)
    found = Estimate(motion=start.pose[None], vector=start.vector)
    for gate_scale, steps in rounds:
        cache = SegmentationCache()

        def observe(_: int, state: BodyState, scale: float = gate_scale, cache: SegmentationCache = cache) -> list[Observation]:
            return [
                *fit.surface_observations(start.t, near, state, scale, cache),
                *fit.joints(start.t),
                *fit.background.observe(start.t),
                *fit.pose_observations(state),
            ]

        found = solve(fit.problem(observe, free), found, steps=steps, furthest=FURTHEST, monitor=monitor, stage=STAGE)
    return explanation(fit, start.t, points, found.motion[0], found.vector)


def carried(fit: FitContext, points_of: Callable[[int], CloudPoints], found: Explanation, to: int, monitor: Monitor) -> Explanation:
    """The explanation in frame index `to`: the pose is adjusted there, and on the way in some of the frames between; limbs that were lost
    on the way are looked for."""
    one, stride = found, STRIDE if to > found.t else -STRIDE
    for t in (*range(found.t + stride, to, stride), to):
        points = thinned_points(points_of(t))
        if len(points.xyz_m) >= LEAST_POINTS:
            one = adjusted(fit, points, explanation(fit, t, points, one.pose, one.vector), ROUNDS if t == to else FOLLOWING, monitor)
    return with_limbs(fit, thinned_points(points_of(to)), one, monitor) if one.t == to else one


def with_limbs(fit: FitContext, points: CloudPoints, found: Explanation, monitor: Monitor) -> Explanation:
    """The same, or better with limbs that were looked for all around where they explain what no other part does."""
    best = found
    for pose in reacquired_poses(fit, found.t, points, found.pose, found.vector, monitor):
        best = max(best, *with_limb(fit, points, found, pose, monitor), key=lambda one: one.score)
    return best


def with_limb(fit: FitContext, points: CloudPoints, found: Explanation, pose: np.ndarray, monitor: Monitor) -> list[Explanation]:
    """An explanation with the pose (D,) in which a limb was found elsewhere, as it is and adjusted: near other limbs an adjustment may draw
    it to their points."""
    there = explanation(fit, found.t, points, pose, found.vector)
    return [there, adjusted(fit, points, there, ROUNDS[-1:], monitor)]


def exchanged(
    fit: FitContext,
    points: CloudPoints,
    found: Explanation,
    parts: Sequence[str],
    monitor: Monitor,
    close: float = CLOSE,
) -> Explanation:
    """The rival with the sides of some joints (by their names without the side) exchanged, adjusted in the same way.

    If hips and shoulders are among them, the person faces the other way. Its limbs are looked for unless it explains less by
    `close` [voxels] and more.
    """
    skeleton, names = fit.model.skeleton, list(fit.model.skeleton.joint_names)
    places = np.array(found.joints_m)
    for j, name in enumerate(names):
        part, _, side = name.partition(".")
        if side and part in parts:
            places[j] = found.joints_m[names.index(f"{part}.{'L' if side == 'R' else 'R'}")]
        if part in LEFT_OUT:
            places[j] = np.nan
    rows = np.flatnonzero(np.isfinite(places).all(axis=1))
    there = Keypoints(joint=rows, xyz_m=places[rows], sigma_m=np.full(len(rows), SIGMA_M))
    clicks = Clicks(observations=(there,), xyz_m=places)
    pose = inverse_kinematics(fit.parameters, clicks, fit.priors, fit.proportions).motion[0]
    pose[skeleton.locked] = found.pose[skeleton.locked]
    rival = adjusted(fit, points, explanation(fit, found.t, points, pose, found.vector), monitor=monitor)
    return with_limbs(fit, points, rival, monitor) if found.score - rival.score < close else rival


def with_lengths(fit: FitContext, points: CloudPoints, found: Explanation, monitor: Monitor) -> tuple[Explanation, float]:
    """Pose and bone lengths adjusted together, unless that explains less, and the stature over the template's, by bones that are no
    limb's."""
    near = adjusted(fit, points, found, ((1.5, LENGTH_STEPS),), monitor, "lengths")
    lengths = fit.parameters.layout.group("lengths")
    of_trunk = [not {bone.head_joint, bone.tail_joint} <= set(fit.found) for bone in fit.model.skeleton.bones]
    stature = float(np.exp(np.mean((near.vector[lengths] - fit.parameters.vector()[lengths])[of_trunk])))
    return max(found, near, key=lambda one: one.score), stature


def with_clicks(fit: FitContext, points: CloudPoints, found: Explanation, monitor: Monitor) -> Explanation:
    """The same, or what begins with the clicked joints of its frame where they were clicked, if it misses them less."""
    if found.t not in fit.clicked:
        return found
    names, joint = fit.model.skeleton.joint_names, np.unique(fit.clicked[found.t].joint)
    others = np.setdiff1d(np.arange(len(names)), joint)
    sigma = np.array([StartJoints.sigma_m(names[j]) for j in others.tolist()])
    there = Keypoints(joint=others, xyz_m=found.joints_m[others], sigma_m=sigma)
    at = fit.places[found.t]
    places = np.where(np.isfinite(at).all(axis=1)[:, None], at, found.joints_m)
    clicks = Clicks(observations=(there, fit.clicked[found.t]), xyz_m=places)
    pose = inverse_kinematics(fit.parameters, clicks, fit.priors, fit.proportions).motion[0]
    pose[fit.model.skeleton.locked] = found.pose[fit.model.skeleton.locked]
    start = explanation(fit, found.t, points, pose, found.vector)
    return min(found, adjusted(fit, points, start, ROUNDS[-1:], monitor), key=lambda one: missed_m(fit, one))


def missed_m(fit: FitContext, found: Explanation) -> float:
    """The distance [m] across the view by which the most distant clicked joint of its frame misses its click."""
    if found.t not in fit.clicked:
        return 0.0
    clicks, distance = fit.clicked[found.t], [0.0]
    for camera, joint, xy in zip(clicks.cameras, clicks.joint.tolist(), clicks.xy_px):
        X = found.joints_m[joint][None]
        off = float(np.linalg.norm(camera.project(X)[0] - xy)) * float(camera.to_camera(X)[0, 2]) / camera.focal_px
        distance.append(off if np.isfinite(off) else np.inf)
    return max(distance)


def of_hypothesis(fit: FitContext, t: int, pose: np.ndarray, stature: float) -> Explanation:
    """A hypothesis of the search, not adjusted, and not judged yet."""
    vector = scaled_vector(fit.parameters, stature)
    return Explanation(t=t, pose=pose, vector=vector, score=-np.inf, joints_m=fit.parameters.state(pose, vector).joints_m)
