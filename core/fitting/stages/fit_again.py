"""Fit a few frames of a fitted body again, after joints were clicked in them: seconds instead of the minutes of a whole fit.

The shape stays, and so do the limbs of which no joint was clicked. The frames around a click are adjusted together, with all observations
of a whole fit; the new clicks have a tenth of their usual sigma, so that the limb goes where it was pulled. At both ends `HELD` frames keep
their poses, so that the motion stays continuous. The adjustment starts from the earlier motion with the limbs led to the clicks, a change
that fades out towards both ends.

The covariance of the shape is diagonal here, for body.toml has only its sigmas. A joint's sigma is divided by what the earlier fit found
common to all frames:

    frame_t² = max(s_t² − common², 0) + elsewhere_t² + CLOTH_M²                                                             (1)
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...body.model_file import read_model, with_limits
from ...body.motion import BodyMotion
from ...body.shape import BodyShape
from ...foundation.progress import Monitor
from ..context import NO_SHAPE, FitContext
from ..hands import BACK
from ..inputs.clicks import Clicks
from ..inputs.cloud_points import thinned
from ..inputs.fit_input import FitInput
from ..inputs.keypoints import JointTracks
from ..limb import Limb, whole_limbs
from ..observations import Observation, PosePrior
from ..settings import FitSettings
from ..solve.problem import Estimate, Problem
from ..solve.solver import solve
from ..state import BodyState, ShapeParameters, free_bones
from .contradicted import contradicted_joints
from .inverse_kinematics import dof_priors, pose_as_clicked
from .long_sequence import FrameResults, Recording, frame_results
from .sequence import PATCH, SLIGHT_SIGMAS, frame_statuses, posterior, standing, whole_sequence
from .set_up import acceleration_sigmas, clicks_by_frame, context_of, point_tracks
from .sigma_parts import CLOTH_M, known
from .turned_hands import angles_of_hands

REACH_S = 0.4  # from a click to the last frame that it may change
HELD = 2  # frames at each end: accelerations tie three
HELD_SIGMA = 1e-5  # rad, m
UNMEASURED = float(np.radians(1.0))  # sigma of the prior of a DOF that the fit keeps at its mean
PULLED = 0.1  # of the sigma of a click that was changed since the earlier fit
STAGE = "fit around the clicks"


@dataclass(frozen=True, eq=False, kw_only=True)
class EarlierFit:
    """A fitted body: its shape, its motion (T, D) in frames (T,) of the take, and the part (J,) [m] of its joints' sigmas that is common
    to all frames."""

    shape: BodyShape
    frames: np.ndarray
    time_s: np.ndarray
    values: np.ndarray
    common_m: np.ndarray


def around(clicked: Sequence[int], frames: np.ndarray, time_s: np.ndarray) -> list[range]:
    """Rows of the frames (T,) that clicks in some of them change, as ranges that do not touch: `REACH_S` to both sides."""
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else REACH_S
    reach, found = max(1, round(REACH_S / step)), list[range]()
    for row in sorted(np.flatnonzero(np.isin(frames, clicked)).tolist()):
        first, last = max(0, row - reach), min(len(frames), row + reach + 1)
        if found and first <= found[-1].stop + HELD:
            found[-1] = range(found[-1].start, last)
        else:
            found.append(range(first, last))
    return found


def with_held(rows: range, count: int) -> range:
    """The rows with those that are held at both ends, of `count`."""
    return range(max(0, rows.start - HELD), min(count, rows.stop + HELD))


def fit_again(
    given: FitInput, earlier: EarlierFit, rows: range, joints: Collection[str], settings: FitSettings, monitor: Monitor
) -> BodyMotion:
    """The motion of the frames in `rows` of an earlier fit, after some `joints` were clicked. `given` has these frames `with_held`.

    Raises:
        InputError: clicks contradict each other.
        Cancelled: the user asked to stop.
    """
    wider = with_held(rows, len(earlier.frames))
    before, own = earlier.values[wider], range(rows.start - wider.start, rows.stop - wider.start)
    part = _obeying(_recording(given, earlier, settings, own, before, monitor), joints)
    vector = part.fit.parameters.vector()
    limbs = limbs_with(part.fit.parameters, joints)
    problem = _held(whole_sequence(part), own, before)
    stays = problem.fixed if not limbs else np.setdiff1d(np.arange(before.shape[1]), np.concatenate([limb.columns for limb in limbs]))
    motion = _as_clicked(part.fit, before, vector, own)
    motion[:, stays] = before[:, stays]  # whatever was clicked before in these frames
    start = Estimate(motion=motion, vector=vector)
    adjusted = replace(problem, free_shape=NO_SHAPE, fixed=stays)
    solution = solve(adjusted, start, steps=settings.sequence_steps, monitor=monitor, stage=STAGE, slight_sigmas=SLIGHT_SIGMAS)
    covariance = posterior(part, problem, solution, _shape_covariance(part.fit, earlier.shape))
    results = frame_results(part, solution, covariance, own, limbs or None)
    return _motion(part, results, earlier, rows)


def _recording(given: FitInput, earlier: EarlierFit, settings: FitSettings, own: range, before: np.ndarray, monitor: Monitor) -> Recording:
    """The frames of `given` about the earlier motion (T, D) in them."""
    model = with_limits(read_model(given.model), given.limits, given.locked)
    names, settings = model.skeleton.joint_names, replace(settings, model_patch_m=PATCH * settings.model_patch_m)
    clicked, places = clicks_by_frame(given, names, settings)
    body = ShapeParameters(earlier.shape, settings.weights)
    middle = body.state(before[len(before) // 2], body.vector()).joints_m.mean(axis=0)
    priors = [_about_earlier(p, before) for p in dof_priors(model.skeleton, np.radians(settings.limit_sigma_deg), middle)]
    fit = context_of(
        given,
        settings,
        model,
        earlier.shape,
        stature_sigma=1.0,
        located=np.zeros(len(names), dtype=bool),
        clicks=Clicks(observations=(), xyz_m=np.full((len(names), 3), np.nan)),
        click=own.start + len(own) // 2,
        priors=priors,
        clicked=clicked,
        places=places,
        tracks=JointTracks(given, names),
    )
    points = [thinned(cloud, settings.voxel_m) for cloud in given.clouds]
    fit = replace(fit, monitor=monitor, turned=angles_of_hands(fit, before)).with_exact_outlines(points)
    observed = np.ones(earlier.values.shape, dtype=bool)
    whole = Recording(
        fit=fit,
        frames=given.frames,
        points=points,
        time_s=given.time_s,
        sigma=acceleration_sigmas(fit, earlier.values, observed, earlier.time_s),
        tracks=point_tracks(given, fit),
        lengths=(body.vector()[body.layout.group("lengths")], np.full(len(earlier.shape.lengths_m), np.inf)),
        feet=standing(fit, before, body.vector(), given.time_s),
    )
    return whole.stretch(range(len(before)), before, body.vector())


def _about_earlier(prior: Observation, before: np.ndarray) -> Observation:
    """The prior with the earlier values (T, D) of what the fit does not measure: the face has told it (`skin.facing`)."""
    if not isinstance(prior, PosePrior):
        return prior
    return replace(prior, mean=np.where(prior.sigma < UNMEASURED, before.mean(axis=0), prior.mean))


def _obeying(part: Recording, joints: Collection[str]) -> Recording:
    """The same with clicks of some `joints` that outweigh the images: whoever pulls a joint has seen that these were misread."""
    pulled = [part.fit.model.skeleton.joint_names.index(joint) for joint in joints]
    clicked = {
        t: replace(clicks, sigma_px=np.where(np.isin(clicks.joint, pulled), PULLED, 1.0) * clicks.sigma_px)
        for t, clicks in part.fit.clicked.items()
    }
    return replace(part, fit=replace(part.fit, clicked=clicked))


def _held(problem: Problem, own: range, before: np.ndarray) -> Problem:
    """The problem with the poses (T, D) of all frames outside of `own` held."""
    observe = problem.observe

    def held(t: int, state: BodyState) -> list[Observation]:
        return observe(t, state) if t in own else [PosePrior(mean=before[t], sigma=np.full(before.shape[1], HELD_SIGMA))]

    return replace(problem, observe=held)


def limbs_with(parameters: ShapeParameters, joints: Collection[str]) -> list[Limb]:
    """The limbs to which some joints belong; none if one of them belongs to the trunk, which carries all limbs."""
    skeleton, found = parameters.skeleton, dict[int, Limb]()
    for joint in joints:
        ends = [b for b, bone in enumerate(skeleton.bones) if bone.tail_joint == joint]
        limb = next((limb for limb in whole_limbs(parameters) if set(ends) & set(limb.outer.tolist())), None)
        if limb is None:
            return []
        found[int(limb.bones[0])] = limb
    return list(found.values())


def _as_clicked(fit: FitContext, before: np.ndarray, vector: np.ndarray, own: range) -> np.ndarray:
    """The motion (T, D) with the limbs led to the clicks in each clicked frame, a change that fades out between them and the ends."""
    clicked = [t for t in sorted(fit.places) if t in own and np.isfinite(fit.places[t]).any()]
    if not clicked:
        return before.copy()
    none = np.zeros((1, before.shape[1]))
    change = np.concatenate(
        [none, *(pose_as_clicked(fit.parameters, fit.places[t], before[t], vector)[None] - before[t] for t in clicked), none]
    )
    at = [own.start - 1, *clicked, own.stop]
    return before + np.stack([np.interp(np.arange(len(before)), at, column) for column in change.T], axis=1)


def _shape_covariance(fit: FitContext, shape: BodyShape) -> np.ndarray:
    """The covariance (S, S) of the shape vector, from the sigmas of body.toml."""
    at, sigma = fit.parameters.layout, np.zeros(len(fit.parameters.layout))
    sigma[at.group("lengths")] = shape.length_sigma_m / shape.lengths_m
    sigma[at.group("radii")] = (shape.radius_sigma_m / shape.metaballs.radii_m)[:, [0, 2]].ravel()
    bends = [shape.finger_bends.get(shape.skeleton.bones[b].name) for b in at.hands]
    sigma[at.group("bends")] = [0.0 if bend is None else bend.sigma / (bend.value + BACK) for bend in bends]
    return np.diag(np.nan_to_num(sigma) ** 2)


def _motion(part: Recording, results: FrameResults, earlier: EarlierFit, rows: range) -> BodyMotion:
    """The results of the frames `rows` as a motion."""
    fit, skeleton = part.fit, part.fit.model.skeleton
    observed = (results.evidence >= fit.few_points) | ~free_bones(fit.parameters)
    own = np.maximum(results.joint_sigma_m**2 - earlier.common_m**2, 0.0) + results.elsewhere_m2 + CLOTH_M**2  # (1)
    return BodyMotion(
        frames=earlier.frames[rows],
        time_s=earlier.time_s[rows],
        dof_names=skeleton.dof_names,
        values=results.values,
        covariance=results.covariance,
        joint_names=skeleton.joint_names,
        joints_m=results.joints_m,
        joint_sigma_m=np.sqrt(own + earlier.common_m**2),
        joint_frame_sigma_m=np.sqrt(own),
        known=known(skeleton, observed, contradicted_joints(fit.parameters, results.misplaced), np.sqrt(own)),
        status=frame_statuses(fit, results.evidence, results.sigma0),
        sigma0=results.sigma0,
    )
