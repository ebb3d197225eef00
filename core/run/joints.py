"""The joints of the person in one frame, found without clicks: `tricap joints`."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..fitting.inputs.background import find_background
from ..fitting.inputs.completed_clouds import clouds_for_fit
from ..fitting.inputs.no_surface import empty_clouds
from ..fitting.inputs.start_joints import StartJoints
from ..fitting.inputs.take_inputs import fit_input
from ..fitting.stages.set_up import find_joints
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..results.folder import Results
from ..surface.cloud import PointCloud
from ..surface.measure import NothingMeasured, measure_frames
from ..surface.resolution import measured_footage, person_seen, shows_enough
from ..surface.starts import MeasureSettings
from ..take.footage import Footage, open_take
from ..take.take import FrameClicks, Take, read_take
from ..take.writing import read_table, write_table
from .settings import Overrides, settings_of
from .take_run import only_frames

PLACES, SHORTLY_S = 3, 0.2  # in the recording, where a frame is measured and another one shortly afterwards
CLICKED = ("pelvis", "neck", "head", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")  # what people click


def joints_of_take(take_folder: Path, overrides: Overrides | None, monitor: Monitor) -> tuple[Footage, StartJoints, Mapping[str, Any]]:
    """The footage of a take, the joints that are found in one of its frames, and the settings; a few frames are measured for it.

    Raises:
        InputError: the take needs fixing, or nobody is found.
        Cancelled: the user asked to stop.
    """
    take = read_take(take_folder)
    settings = settings_of(take.settings, overrides or {}, str(take.folder / "take.toml"))
    footage = open_take(take, click_sigma_px=settings["fitting"].click_sigma_px)
    if take.body_model is None:
        raise InputError(
            'take.toml has model = "none" under [body], so there are no joints to find; write "full" or "upper_body", or leave it out.'
        )
    clouds = _some_clouds(footage, settings, monitor.part("surface", 0, 2))
    background = find_background(footage, clouds, monitor) if settings["fitting"].use_background else []
    with tempfile.TemporaryDirectory() as folder:
        results = Results(Path(folder))
        completed = clouds_for_fit(footage, clouds, None, background, settings["fitting"], results, monitor)
        given = fit_input(footage, completed, None, results, background)
        start = find_joints(given, settings["fitting"], monitor.part("find the person", 1, 2))
    if start is None:
        raise InputError(
            "Nobody was found: no frame has enough measured points of a person who is wholly inside the middle view, or cut by nothing but "
            "its lower border."
        )
    return footage, start, settings


def _some_clouds(footage: Footage, settings: Mapping[str, Any], monitor: Monitor) -> Sequence[PointCloud]:
    """Clouds of all frames, measured in a few of them and empty in the others; those with clicked joints are among them."""
    frames = footage.frames
    clicked = sorted({c.frame for c in (footage.take.clicks, *footage.take.keyframes) if c.joints and c.frame in frames})
    shortly = min(round(SHORTLY_S * footage.take.fps), len(frames) - 1)
    places = np.linspace(frames.start, frames.stop - 1 - shortly, PLACES).round().astype(int)
    chosen = clicked or np.unique([places, places + shortly]).tolist()
    measured, measuring = dict[int, PointCloud](), MeasureSettings.of(settings)
    person = person_seen(footage, measuring, monitor)
    for i, frame in enumerate(chosen):
        one = measured_footage(only_frames(footage, (frame, frame + 1)), measuring, None)
        small = measured_footage(one, measuring, person.distance_m if person else None)
        with tempfile.TemporaryDirectory() as folder, Results(Path(folder)).opened() as results:
            try:
                part = monitor.part("surface", i, len(chosen))
                if small.full_size_px and not shows_enough(small, measuring, results, frame, part):
                    small = one
                for found in measure_frames(small, measuring, results, part, frame):
                    measured[frame] = found.cloud
            except NothingMeasured:
                continue  # the person may enter later
    return [measured.get(cloud.frame, cloud) for cloud in empty_clouds(footage)]


def pixels_of(footage: Footage, xyz_m: Mapping[str, np.ndarray], unsure: Sequence[str]) -> dict[str, dict[str, list[float]]]:
    """The found joints (3,) that people click, in the pixels of the views that show them; without those that are `unsure`."""
    found = dict[str, dict[str, list[float]]]()
    for name, xyz in xyz_m.items():
        if name.partition(".")[0] in CLICKED and name not in unsure:
            at = {c.name: c.project(xyz[None])[0] for c in footage.rig.cameras}
            found[name] = {view: np.round(xy, 1).tolist() for view, xy in at.items() if footage.rig[view].sees(xy)}
    return {name: at for name, at in found.items() if len(at) > 1}


def with_joints(take: Take, frame: int, joints: Mapping[str, Mapping[str, Sequence[float]]]) -> Take:
    """The take with joints of a frame [px] as if they had been clicked; its own clicks stay, as in `write_joints_as_clicks`."""
    own, clicked = take.clicks, {key.frame: dict(key.joints) for key in take.keyframes}
    clicked[own.frame] = clicked.get(own.frame, {}) | dict(own.joints)
    found = {name: {view: np.array(xy, dtype=np.float64) for view, xy in at.items()} for name, at in joints.items()}
    clicked[frame] = found | clicked.get(frame, {})
    if own.frame == frame or not own.surface:
        own = replace(own, frame=frame, joints=clicked.pop(frame))
    else:
        own = replace(own, joints=clicked.pop(own.frame))
    return replace(take, clicks=own, keyframes=tuple(FrameClicks(frame=at, joints=there) for at, there in sorted(clicked.items()) if there))


def write_joints_as_clicks(folder: Path, frame: int, joints: Mapping[str, Mapping[str, list[float]]]) -> bool:
    """Write joints of a frame into [seeds.joints] of take.toml. False: nothing changed.

    All clicks stay: those in that frame win over `joints`, those in other frames become [[keyframes]]. If surface seeds of another frame
    are there, [seeds] remains theirs, and `joints` become [[keyframes]].

    Raises:
        InputError: the file cannot be read or written.
    """
    table = dict(read_table(folder))
    seeds = dict(table.get("seeds", {}))
    seeded = seeds.get("frame", 0)
    clicked = {key.get("frame", 0): dict(key.get("joints", {})) for key in table.pop("keyframes", [])}
    clicked[seeded] = clicked.get(seeded, {}) | seeds.pop("joints", {})
    clicked[frame] = {name: dict(at) for name, at in joints.items()} | clicked.get(frame, {})
    if seeded == frame or not seeds.get("surface"):
        seeds |= {"frame": frame, "joints": clicked.pop(frame)}
    keyframes = [{"frame": at, "joints": found} for at, found in sorted(clicked.items()) if found]
    return write_table(folder, {**table, "seeds": seeds, **({"keyframes": keyframes} if keyframes else {})})
