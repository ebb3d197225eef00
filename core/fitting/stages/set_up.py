"""What a fit begins with: its context from the input, and the start from clicks and keypoints, or without them (`start`)."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...body.model_file import BodyModel, read_model, smallest_model, with_limits
from ...body.shape import BodyShape, default_shape, one_ball_shape, scaled_shape
from ...body.trunk import LEAST_TRUNK_JOINTS, suffice_for_pose, trunk_joints
from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ...take.take import AUTO_BODY, WHOLE_BODY
from ..context import FitContext
from ..inputs.background import BackgroundRegions
from ..inputs.clicks import Clicks, initial_clicks, read_clicks
from ..inputs.cloud_points import CloudPoints, thinned
from ..inputs.fit_input import FitInput
from ..inputs.image_tracks import ImageTracks
from ..inputs.keypoints import JointTracks
from ..inputs.material_tracks import MaterialTracks, PointTracks
from ..inputs.silhouettes import Silhouettes
from ..inputs.start_joints import NeedsClick, StartJoints
from ..observations import ClickedJoints, Keypoints, Observation
from ..observations.self_collision import CollisionPairs
from ..settings import FitSettings
from ..solve.time_priors import LEAST, typical_acceleration
from ..start.find import find_start
from ..start.search import Framing
from ..state import ShapeParameters
from .inverse_kinematics import clicked_stature, dof_priors
from .long_sequence import AT_ONCE

FOUND_STATURE_SIGMA = 0.03  # relative, of the start without clicks
LEAST_PERSON = 0.2  # where no model is chosen, what starts with a smaller probability is taken for no person
FOUND = tuple(f"{joint}{side}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in (".L", ".R"))
LEAST_ANGULAR = 0.3  # of the largest sigmas of angular accelerations: 1,800°/s², as elbows and knees have
PERSONS = {Framing.WHOLE: WHOLE_BODY, Framing.UPPER: "upper_body"}  # the models that are looked for, whatever part of them is fitted


class NobodyFound(InputError):
    """There are too few clicks for a start, and no frame in which somebody can be found without them."""


def fit_context(given: FitInput, settings: FitSettings) -> FitContext:
    """What stays the same throughout the fit.

    Raises:
        InputError: see `fit_sequence`.
    """
    model = with_limits(read_model(given.model), given.limits, given.locked)
    names, frames = model.skeleton.joint_names, given.frames
    tracks = JointTracks(given, names)
    clicked, places = clicks_by_frame(given, names, settings)
    wanted = given.click_frame if given.click_frame in given.clicks else None
    if given.start is not None:
        begin = frames.index(given.start.frame)
    else:
        begin = _best_located(places, tracks) if wanted is None else frames.index(wanted)
    located = tracks.located(begin)
    located = np.where(np.isfinite(places[begin]), places[begin], located) if begin in places else located
    measured = [clicked[begin]] if begin in clicked else []
    clicks = Clicks(observations=(*measured, *tracks.observe(begin)), xyz_m=located)
    clicks = _found_clicks(clicks, given.start, names) if given.start is not None else initial_clicks(located, names, clicks.observations)
    priors = dof_priors(model.skeleton, np.radians(settings.limit_sigma_deg), np.nanmean(clicks.xyz_m, axis=0))
    shape = _model_shape(model, settings)
    if given.start is not None:
        stature, stature_sigma = given.start.stature, FOUND_STATURE_SIGMA
    else:
        stature, stature_sigma = clicked_stature(ShapeParameters(shape), clicks, priors)
    own = {"clicks": clicks, "click": begin, "priors": priors, "clicked": clicked, "places": places, "tracks": tracks}
    if given.start is not None:
        own |= {"found": FOUND, "unsure": given.start.unsure}
    where = np.any([np.isfinite(xyz).all(axis=1) for xyz in (*places.values(), located)], axis=0)
    return context_of(given, settings, model, scaled_shape(shape, stature), stature_sigma=stature_sigma, located=where, **own)


def with_start(given: FitInput, settings: FitSettings, monitor: Monitor) -> FitInput:
    """The input with the start that is found without clicks, or with few of them, where the fit needs one.

    Where no model is chosen (`AUTO_BODY`), it is that of what is seen, or else the smallest one that has the clicked joints.

    Raises:
        NobodyFound: no frame has enough points of a person, and there are too few clicks.
        NeedsClick: it is not certain how the person stands.
        Cancelled: the user asked to stop.
    """
    is_chosen = given.model != AUTO_BODY
    if given.start is not None or (is_chosen and not needs_start(given, settings)):
        return given
    start = None if given.keypoints else find_joints(given, settings, monitor)
    if not is_chosen:
        located = _located_joints(given, settings)
        given = of_model(given, start.model if start is not None else smallest_model(located) if located else WHOLE_BODY)
        if not needs_start(given, settings):
            return given
    certain = _is_certain(start, settings)
    if start is None or (given.model not in PERSONS.values() and not certain):  # a limb is started by clicks on it, not elsewhere
        raise NobodyFound(_nobody_found(given.model, is_chosen))
    if not is_chosen and not given.clicks and start.probability < LEAST_PERSON:
        raise NobodyFound(f"It may be no person that is seen. {start.question}")
    if not certain:
        raise NeedsClick(start)
    return replace(given, start=start)


def _nobody_found(model: str, is_chosen: bool) -> str:
    """Why the body of a model cannot start, and what to do."""
    skeleton = read_model(model).skeleton
    trunk = trunk_joints(skeleton)
    many = len(trunk) > LEAST_TRUNK_JOINTS
    joints = f"three of the joints {', '.join(trunk)}" if many else f"two of the joints {', '.join(skeleton.joint_names)}"
    cut = "" if is_chosen and model == WHOLE_BODY else ", or cut by nothing but its lower border"
    limb = "" if is_chosen else ", or choose the limb that is filmed as the model under [body], and click its joints"
    return (
        "The body cannot start by itself: no frame has enough measured points of a person who is wholly inside the middle view"
        f"{cut}. Click at least {joints} in two views each, under [seeds.joints] or in Blender (step 3){limb}."
    )


def of_model(given: FitInput, model: str) -> FitInput:
    """The input for another model: with the limits that it has, too."""
    dofs = {dof.name for dof in read_model(model).skeleton.dofs}
    limits = {name: limit for name, limit in given.limits.items() if name in dofs}
    return replace(given, model=model, limits=limits, locked=tuple(name for name in given.locked if name in dofs))


def _starts_by_clicks(given: FitInput, settings: FitSettings) -> bool:
    """Whether the clicked joints suffice for the smallest model that has them."""
    located = _located_joints(given, settings)
    return bool(located) and not needs_start(of_model(given, smallest_model(located)), settings)


def _located_joints(given: FitInput, settings: FitSettings) -> set[str]:
    """The joints of keypoints, and those that are clicked in two views."""
    names = read_model(WHOLE_BODY).skeleton.joint_names
    clicked = clicks_by_frame(given, names, settings)[1].values()
    located = {name for xyz in clicked for name, place in zip(names, xyz) if np.isfinite(place).all()}
    return located.union(*(source.joint for source in given.keypoints))


def needs_start(given: FitInput, settings: FitSettings) -> bool:
    """Whether clicks and keypoints do not suffice for a start: fewer than two located joints, or than three of a trunk."""
    if given.keypoints:
        return False
    skeleton = with_limits(read_model(given.model), given.limits, given.locked).skeleton
    _, places = clicks_by_frame(given, skeleton.joint_names, settings)
    located = [{name for name, place in zip(skeleton.joint_names, xyz) if np.isfinite(place).all()} for xyz in places.values()]
    return not any(suffice_for_pose(joints, skeleton) for joints in located)


def find_joints(given: FitInput, settings: FitSettings, monitor: Monitor, without: tuple[str, ...] = ()) -> StartJoints | None:
    """The joints of the person in the easiest frame, and how sure they are; None where nobody is found.

    Clicks are observations; where there are some, the start is in one of their frames, unless it is certain in another frame only: there
    they correct what follows. `without`: see `pose_dictionary`.

    Raises:
        InputError: clicks contradict each other.
        Cancelled: the user asked to stop.
    """
    clouds = given.clouds

    @lru_cache(maxsize=64)
    def points_of(t: int) -> CloudPoints:
        return thinned(clouds[t], settings.voxel_m)

    shown_of = {model: {shown} for shown, model in PERSONS.items()}
    if given.clicks and given.model in (AUTO_BODY, PERSONS[Framing.UPPER]) and not _starts_by_clicks(given, settings):
        shown_of[PERSONS[Framing.UPPER]].add(Framing.CUT)  # what people click is a person, even if other borders cut it
    for model, shown in shown_of.items():
        if given.model == WHOLE_BODY != model:
            break  # a whole body is not begun by a part of it
        fit = replace(_without_start(of_model(given, model), settings, points_of), monitor=monitor)
        start = find_start(fit, points_of, given.frames, given.time_s, monitor, shown, without)
        if fit.clicked and not _is_certain(start, settings):
            anywhere = find_start(replace(fit, clicked={}, places={}), points_of, given.frames, given.time_s, monitor, shown, without)
            if anywhere is not None and anywhere.frame not in given.clicks and _is_certain(anywhere, settings):
                start = anywhere
        if start is not None:
            return start
    return None


def _is_certain(start: StartJoints | None, settings: FitSettings) -> bool:
    return start is not None and start.probability >= settings.least_start_probability


def _without_start(given: FitInput, settings: FitSettings, points_of: Callable[[int], CloudPoints]) -> FitContext:
    """A context for a search: the clicks are no start."""
    middle = points_of(len(given.clouds) // 2).xyz_m
    model = with_limits(read_model(given.model), given.limits, given.locked)
    names = model.skeleton.joint_names
    clicked, places = clicks_by_frame(given, names, settings)
    return context_of(
        given,
        settings,
        model,
        _model_shape(model, settings),
        stature_sigma=FOUND_STATURE_SIGMA,
        located=np.zeros(len(names), dtype=bool),
        clicks=Clicks(observations=(), xyz_m=np.full((len(names), 3), np.nan)),
        click=0,
        priors=dof_priors(model.skeleton, np.radians(settings.limit_sigma_deg), np.median(middle, axis=0) if len(middle) else np.zeros(3)),
        clicked=clicked,
        places=places,
        tracks=JointTracks(given, names),
        found=FOUND,
    )


def context_of(given: FitInput, settings: FitSettings, model: BodyModel, shape: BodyShape, **own: object) -> FitContext:
    """A context of this input; `own`: what depends on the start."""
    parameters = ShapeParameters(shape, settings.weights)
    return FitContext(
        cameras=given.rig.cameras,
        model=model,
        parameters=parameters,
        settings=settings,
        frames=1 if settings.balls == "one" else min(len(given.clouds), AT_ONCE),
        silhouettes=Silhouettes(given, model.surface, settings),
        background=BackgroundRegions(given, parameters, settings),
        collisions=CollisionPairs(model.skeleton, shape.metaballs.bone_index),
        in_views=ImageTracks(given.rig, given.image_tracks, model.surface, settings) if given.image_tracks else None,
        **own,  # type: ignore[arg-type]
    )


def point_tracks(given: FitInput, fit: FitContext) -> PointTracks | None:
    """The points that were followed from frame to frame, if there are any: in space, or else in single views."""
    if given.trajectories is None or not fit.settings.use_trajectories:
        return fit.in_views
    return MaterialTracks(given.trajectories, given.frames, fit.model.surface, fit.settings)


def _model_shape(model: BodyModel, settings: FitSettings) -> BodyShape:
    return one_ball_shape(default_shape(model)) if settings.balls == "one" else default_shape(model)


def clicks_by_frame(
    given: FitInput, names: tuple[str, ...], settings: FitSettings
) -> tuple[dict[int, ClickedJoints], dict[int, np.ndarray]]:
    """The clicks of each frame index, and the joints' places (J, 3), NaN without two views."""
    clicked, places = dict[int, ClickedJoints](), dict[int, np.ndarray]()
    for frame, joints in given.clicks.items():
        t = given.frames.index(frame)
        clicked[t], places[t] = read_clicks(given.rig, names, joints, settings.click_sigma_px)
    return clicked, places


def _found_clicks(clicks: Clicks, start: StartJoints, names: tuple[str, ...]) -> Clicks:
    """The clicks, with the other joints where the start has them, as observations with its sigma.

    Raises:
        InputError: the start has fewer than two joints of the model.
    """
    places, observations = np.array(clicks.xyz_m), list[Observation](clicks.observations)
    rows = [j for j, name in enumerate(names) if name in start.xyz_m and not np.isfinite(places[j]).all()]
    if rows:
        places[rows] = [start.xyz_m[names[j]] for j in rows]
        sigma = np.array([start.sigma_m(names[j]) for j in rows])
        observations.append(Keypoints(joint=np.array(rows), xyz_m=places[rows], sigma_m=sigma))
    return initial_clicks(places, names, observations)


def _best_located(places: Mapping[int, np.ndarray], tracks: JointTracks) -> int:
    """The frame index with most clicked joints; without clicks, the one with most keypoints."""
    return max(places, key=lambda t: int(np.isfinite(places[t]).sum())) if places else tracks.best_frame()


def acceleration_sigmas(fit: FitContext, motion: np.ndarray, observed: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """The sigmas (D,) of accelerations, by a motion (T, D) where it is observed, and not less than the least, however steady it is."""
    s, skeleton = fit.settings, fit.model.skeleton
    largest, share = np.full(len(skeleton.dofs), np.radians(s.acceleration_deg_s2)), np.full(len(skeleton.dofs), LEAST_ANGULAR)
    base = skeleton.layout.group("base")
    largest[base], share[base] = s.acceleration_m_s2, LEAST
    return typical_acceleration(motion, observed, time_s, largest, share)
