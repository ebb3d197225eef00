"""The fit's input from a take and its run: clicks and limits of take.toml, clouds and trajectories, contours/*.csv in OUT, keypoints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import radians
from pathlib import Path

import numpy as np

from ...body.model_file import read_model, with_limits
from ...body.trunk import suffice_for_pose
from ...foundation import bounded
from ...foundation.errors import InputError
from ...foundation.settings import nearest_name
from ...motion.formats.c3d import read_c3d
from ...motion.formats.keypoints_json import natural_order, read_keypoints
from ...motion.formats.markers import Markers, read_points_csv
from ...motion.formats.trc import read_trc
from ...motion.retarget.points import joint_of
from ...results.folder import Results
from ...take.footage import Footage, footage_frames
from ...take.sources import KeypointSource
from ...take.take import AUTO_BODY, JOINTS, START_ALONE, FrameClicks, Take
from ...tracking.contour import ContourTable
from ...tracking.trajectories import Trajectories
from ..settings import FitSettings
from .clicks import check_apart, initial_clicks, read_clicks
from .cloud_points import Cloud
from .fit_input import BackgroundDistances, ClickedAt, FitInput, JointPlaces, Outline

JOINT_OF_ROLE = {
    "upper_arm": "shoulder",
    "forearm": "elbow",
    "hand": "wrist",
    "thigh": "hip",
    "shin": "knee",
    "foot": "ankle",
    "toe": "toe",
    "clavicle": "clavicle",
    "hips": "pelvis",
    "neck": "neck",
}  # the roles that retargeting recognises in names
LOOSE = {"toe.L": 2.0, "toe.R": 2.0, "neck": 2.0, "pelvis": 2.0}  # factors of the sigma, where detectors place the joint elsewhere
LEAST_CONFIDENCE = 0.2  # of a detector's keypoint
BEYOND = 0.1  # of the image's size: joints so far outside of it are possible


def fit_input(
    footage: Footage,
    clouds: Sequence[Cloud],
    trajectories: Trajectories | None,
    results: Results,
    background: Sequence[BackgroundDistances] = (),
) -> FitInput:
    """The fit's input from a run; clicks outside the footage's frames are omitted.

    Raises:
        InputError: a table of contours or keypoints cannot be read.
    """
    take, frames = footage.take, [c.frame for c in clouds]
    return FitInput(
        rig=footage.rig,
        model=str(take.body_model),
        clouds=clouds,
        frames=frames,
        time_s=take.time_s(np.array(frames)),
        clicks=clicks_in(footage),
        click_frame=take.clicks.frame,
        trajectories=trajectories,  # type: ignore[arg-type]
        contours=read_contours(results, [v.name for v in take.views]),
        keypoints=[read_source(footage, source) for source in take.keypoints],
        background=background,
        locked=take.locked,
        limits={name: (radians(low), radians(high)) for name, (low, high) in take.limits.items()},
    )


def clicks_in(footage: Footage) -> dict[int, ClickedAt]:
    """The clicked joints in the footage's frames, by frame."""
    return {s.frame: _clicked(s) for s in _with_joints(footage.take) if s.frame in footage.frames}


def check_body(footage: Footage, settings: FitSettings) -> None:
    """Check that clicks and degrees of freedom are those of the take's body model, before hours of computation.

    Raises:
        InputError: the model has no such degree of freedom, clicks contradict each other or coincide, or a limb has too few of them.
    """
    take, clicks = footage.take, clicks_in(footage)
    if missing_for_fit(footage):
        return
    model = with_limits(read_model(str(take.joints_model)), take.limits, take.locked)
    names = model.skeleton.joint_names
    for frame, at in clicks.items():
        check_apart({name: views for name, views in at.items() if name in names}, frame)
    places = {frame: read_clicks(footage.rig, names, at, settings.click_sigma_px)[1] for frame, at in clicks.items()}
    if places and not take.keypoints and take.body_model not in START_ALONE:
        initial_clicks(places[_first_clicked(take, places)], names, [])


def _first_clicked(take: Take, places: Mapping[int, np.ndarray]) -> int:
    """The frame of clicks, with places (J, 3) of joints, where a fit begins: that of [seeds], or else the one with most joints."""
    best = max(places, key=lambda frame: int(np.isfinite(places[frame]).sum()))
    return take.clicks.frame if take.clicks.frame in places else best


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ClickedBody:
    """A body in the frame of its clicks: the places (3,) of its joints, NaN of those that are not clicked in two views, and the joints of
    each bone. `begins`: the fit begins there, and not where somebody is found without clicks."""

    frame: int
    places_m: Mapping[str, np.ndarray]
    bones: tuple[tuple[str, str], ...]
    begins: bool


def clicked_body(footage: Footage, settings: FitSettings) -> ClickedBody | None:
    """The clicked body of a take without keypoints; None where no body is wanted, or no joint has a place.

    Raises:
        InputError: clicks contradict each other, or the model has an error.
    """
    take, clicks = footage.take, clicks_in(footage)
    if take.joints_model is None or take.keypoints or not clicks:
        return None
    skeleton = read_model(take.joints_model).skeleton
    names = skeleton.joint_names
    places = {frame: read_clicks(footage.rig, names, at, settings.click_sigma_px)[1] for frame, at in clicks.items()}
    located = [{name for name, place in zip(names, xyz) if np.isfinite(place).all()} for xyz in places.values()]
    frame = _first_clicked(take, places)
    if not np.isfinite(places[frame]).any():
        return None
    return ClickedBody(
        frame=frame,
        places_m=dict(zip(names, places[frame])),
        bones=tuple((bone.head_joint, bone.tail_joint) for bone in skeleton.bones),
        begins=take.body_model != AUTO_BODY and any(suffice_for_pose(joints, skeleton) for joints in located),
    )


def missing_for_fit(footage: Footage) -> str:
    """Why no body can be fitted in these frames, as the end of “take.toml has …”; empty: it can."""
    return 'model = "none" under [body]' if footage.take.body_model is None else ""


def clicks_left_out(footage: Footage) -> list[str]:
    """Warnings about clicked joints outside the footage's frames, and about those that the body does not have."""
    outside = [s.frame for s in _with_joints(footage.take) if s.frame not in footage.frames]
    if missing_for_fit(footage):
        return []
    foreign = clicks_of_no_joint(footage.take)
    if not outside:
        return foreign
    begins = "; the fit begins at other clicks or keypoints, or by itself" if footage.take.clicks.frame in outside else ""
    return [
        f"The joints clicked in {'frame' if len(outside) == 1 else 'frames'} {', '.join(map(str, sorted(outside)))} are not used: only "
        f"frames {footage.frames.start} to {footage.frames.stop - 1} are fitted{begins}.",
        *foreign,
    ]


def clicks_of_no_joint(take: Take) -> list[str]:
    """A warning about clicked joints that the take's body model does not have.

    Raises:
        InputError: there is no such body model.
    """
    if take.joints_model is None:
        return []
    joints = read_model(take.joints_model).skeleton.joint_names
    foreign = [f"{name} (frame {s.frame})" for s in _with_joints(take) for name in s.joints if name not in joints]
    has = f"the body “{take.body_model}” has only {', '.join(joints)}"
    return (
        [f"The clicks of {', '.join(foreign)} are not used: {has}. Choose another `model` under [body], or remove them."] if foreign else []
    )


def _with_joints(take: Take) -> list[FrameClicks]:
    return [s for s in (*take.keyframes, take.clicks) if s.joints]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class EdgesOfTable:
    """The outlines of a table (`fit_input.Outlines`): the vertices on an edge only, read on demand."""

    view: str
    table: ContourTable

    def of_frame(self, frame: int) -> Outline | None:
        """The outline in a frame; None without one.

        Raises:
            InputError: its rows are damaged.
        """
        found = self.table.get(frame)
        if found is None:
            return None
        rows = np.flatnonzero(found.on_edge)
        return (found.xy_px[rows], found.normal[rows], found.sigma_px[rows]) if len(rows) else None


def read_contours(results: Results, views: Sequence[str], folder: str = "contours") -> list[EdgesOfTable]:
    """The outlines that `tricap contour` wrote, or others in a folder of OUT, of the views that have one.

    Raises:
        InputError: a table is damaged.
    """
    tables = [(view, ContourTable(results.path(folder, f"{view}.csv"))) for view in views]
    return [EdgesOfTable(view=view, table=table) for view, table in tables if table]


def read_source(footage: Footage, source: KeypointSource) -> JointPlaces:
    """The keypoints of one [[keypoints]] entry, in the take's frames.

    Raises:
        InputError: there are no such files, they cannot be read, or none of their names is a joint, or of their frames one of the take.
    """
    folder = footage.take.folder
    paths = sorted((p for p in bounded.matching(folder, source.files) if p.is_file()), key=lambda p: natural_order(p.name))
    if not paths:
        raise InputError(f"There are no keypoints “{source.files}” in {folder}; correct `files` under [[keypoints]].")
    if source.view:
        points = read_keypoints(paths)
        view = [v.name for v in footage.take.views].index(source.view)
        frames = footage.frames_of_images(view, points.number - source.offset_frames)
        found = _places(source, points.names, frames, points.xy_px, points.confidence, paths[0])
        _check_pixels(source, found.place, footage.sizes_px[view])
        return _check_frames(footage, source, found)
    if len(paths) > 1:
        raise InputError(f"“{source.files}” in {folder} are {len(paths)} files; keypoints in space are one file.")
    markers = _markers(paths[0], source.axes)
    frames = markers.frames - source.offset_frames
    found = _places(source, markers.names, frames, markers.xyz_m, np.ones(markers.sigma_m.shape), paths[0])
    return _check_frames(footage, source, found)


def _check_pixels(source: KeypointSource, xy_px: np.ndarray, size_px: tuple[int, int]) -> None:
    outside = ((xy_px < -BEYOND * np.array(size_px)) | (xy_px > (1 + BEYOND) * np.array(size_px))).any(axis=1)
    where = ""
    if outside.all():
        where = f"outside of its images of {size_px[0]}×{size_px[1]}"
    elif (np.abs(xy_px) <= 1).all():
        where = "between −1 and 1"
    if where:
        raise InputError(
            f"All points of the keypoints “{source.files}” of view {source.view} lie {where}; give pixels of the images that the take has."
        )


def _check_frames(footage: Footage, source: KeypointSource, found: JointPlaces) -> JointPlaces:
    take = footage_frames(footage.take, footage.sequences)
    if not ((found.frame >= take.start) & (found.frame < take.stop)).any():
        raise InputError(
            f"The keypoints “{source.files}” are of the frames {found.frame.min()} to {found.frame.max()} of the take, "
            f"which has the frames {take.start} to {take.stop - 1}; correct `offset_frames` under [[keypoints]]."
        )
    return found


def _markers(path: Path, axes: str | None) -> Markers:
    if path.suffix.lower() == ".csv":
        return read_points_csv(path)
    read = read_trc if path.suffix.lower() == ".trc" else read_c3d
    return read(path) if axes is None else read(path, axes=axes)


def _places(
    source: KeypointSource, names: Sequence[str], frames: np.ndarray, places: np.ndarray, confidence: np.ndarray, path: Path
) -> JointPlaces:
    """The joints of a file, one row per place; the sigma of a point of confidence c is divided by √c."""
    for name in source.names:
        if name not in names:
            raise InputError(f"{path} has no point “{name}”.{nearest_name(name, list(names))} Correct `names` under [[keypoints]].")
    joints = [source.names.get(name, joint_named(name)) for name in names]
    rows = [
        (t, n)
        for t in range(len(frames))
        for n, joint in enumerate(joints)
        if joint and confidence[t, n] >= LEAST_CONFIDENCE and np.isfinite(places[t, n]).all()
    ]
    if not rows and any(joints):
        lacking = f" of a confidence of {LEAST_CONFIDENCE:g} or more" if source.view else ""
        raise InputError(f"The keypoints “{source.files}” have no joint of the body with a place{lacking}; detect the joints again.")
    if not rows:
        raise InputError(f"None of the points in {path} ({', '.join(names[:6])} …) is a joint of the body; map them under `names`.")
    t, n = np.array(rows).T
    loose = np.array([LOOSE.get(joint, 1.0) for joint in joints])
    return JointPlaces(
        view=source.view,
        frame=frames[t],
        joint=tuple(joints[i] for i in n),
        place=places[t, n],
        sigma=source.sigma * loose[n] / np.sqrt(confidence[t, n]),
    )


def joint_named(name: str) -> str:
    """The model's joint for another system's name: "RKnee", "left_hip" -> "knee.R", "hip.L"; "" if there is none."""
    if name in JOINTS:
        return name
    part, dot, side = joint_of(name).partition(".")
    return JOINT_OF_ROLE.get(part, "") + (dot + side if part in JOINT_OF_ROLE else "")


def _clicked(clicks: FrameClicks) -> ClickedAt:
    return {name: {view: xy.tolist() for view, xy in at.items()} for name, at in clicks.joints.items()}
