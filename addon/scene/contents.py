"""The results in a run's output folder, read for the scene. No bpy here: they may be read on a worker thread.

A part that is missing, because its stage did not run or its files were moved, is None or empty, with a sentence in `warnings`.
A damaged part is an InputError.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...core.body.shape import BodyShape, read_body
from ...core.body.skin.contour_skin import body_skin
from ...core.body.skin.fingers import shape_for_skin
from ...core.body.skin.mesh import SkinSettings
from ...core.body.skin.person_skin import REST
from ...core.body.skin.texture import TEXTURE
from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.foundation.settings import from_table
from ...core.motion.formats.ply import Ply, read_ply
from ...core.motion.tables import JointTable, MotionTable, read_guessed, read_joints, read_motion
from ...core.results.folder import check_complete, with_fewer_files
from ...core.results.run_json import read_run
from ...core.run.record import doubtful_stretches, read_frame_table
from ...core.take.bar_file import read_bar
from ...core.take.footage import Footage, open_take
from ...core.take.take import read_take
from ...core.tracking.settings import TrackStatus
from .prepare import Prepared, prepare

TABLES = ("body.toml", "motion.csv", "joints.csv", "frames.csv")
SKIN = "skin"
FOLDERS = ("clouds", SKIN)  # of results, with files that the scene shows
DEFAULT_FPS = 25.0  # of a scene whose take is missing


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameSkins:
    """The skin cast in every frame: frames (T,) ascending, vertices_m (T, V, 3) float32, and the settings of the sampling."""

    frames: np.ndarray
    vertices_m: np.ndarray
    settings: SkinSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class Contents:
    """The parts of OUT. `shape`: as shown by its skin; `clouds`: by frame; `trajectories`: arrays of their file."""

    out: Path
    run: Mapping[str, Any]
    footage: Footage | None = None
    clouds: Mapping[int, Ply] = field(default_factory=dict)
    trajectories: Mapping[str, np.ndarray] | None = None
    raw: Mapping[str, np.ndarray] | None = None  # the trajectories before the filters, only on request
    shape: BodyShape | None = None
    motion: MotionTable | None = None  # radians, metres
    joints: JointTable | None = None  # with their sigmas
    skin_settings: SkinSettings = field(default_factory=SkinSettings)
    skins: FrameSkins | None = None  # only on request
    prepared: Prepared = field(default_factory=Prepared)
    doubtful: tuple[tuple[int, int, str], ...] = ()  # stretches of doubtful frames: first, last, reason
    bar: tuple[np.ndarray, np.ndarray] | None = None  # frames (T,) of its own recording, and ends (T, 2, 3) [m] of the reference bar
    warnings: tuple[str, ...] = ()

    @property
    def fps(self) -> float:
        """The take's frame rate."""
        return self.footage.take.fps if self.footage else DEFAULT_FPS

    @property
    def frames(self) -> tuple[int, int]:
        """First and last frame with results, in the take's frame numbers."""
        known = [*self.clouds, *(self.motion.frames if self.motion else ()), *(self.trajectories["frames"] if self.trajectories else ())]
        if not known and self.footage:
            known = [self.footage.frames.start, self.footage.frames.stop - 1]
        return (int(min(known)), int(max(known))) if known else (0, 0)


def read_contents(out: Path, monitor: Monitor, *, skins: bool = False, removed: bool = False) -> Contents:
    """Read the folder OUT of a run, and the take it was made from; on request also the skin of every frame, and trajectories as they were
    before the filters.

    Raises:
        InputError: OUT is no folder of results, or a file in it is damaged.
        Cancelled: the monitor was cancelled.
    """
    out = Path(out)
    if not (out / "run.json").is_file():
        raise InputError(f"{out} has no results of Tricap (no run.json); choose the output folder of a run.")
    run = read_run(out / "run.json")
    check_complete(out, [name for name in TABLES if (out / name).is_file()])
    warnings: list[str] = []
    footage = _footage(run, out, warnings)
    clouds = _clouds(out / "clouds", monitor, warnings)
    monitor.step("reading results", 1, 3)
    trajectories = _optional(out / "trajectories.npz", "trajectories", _arrays, warnings)
    monitor.step("reading results", 2, 3)
    shape = _optional(out / "body.toml", "armature and metaballs", read_body, warnings)
    motion = _motion(out / "motion.csv", shape, warnings)
    monitor.step("reading results", 3, 3)
    settings = from_table(SkinSettings, run.get("settings", {}).get("skin", {}), "[skin] of run.json")
    warnings += _fewer_files(out, run, settings)
    person = None if shape is None else shape_for_skin(shape, settings)
    prepared = prepare(clouds, trajectories, person, motion, settings, out / SKIN / REST, monitor)
    return Contents(
        out=out,
        run=run,
        footage=footage,
        clouds=clouds,
        trajectories=trajectories,
        raw=_optional(out / "trajectories_raw.npz", "removed trajectories", _raw, warnings) if removed else None,
        shape=person,
        motion=motion,
        joints=_joints(out / "joints.csv", warnings),
        skin_settings=settings,
        prepared=prepared,
        skins=_skins(person, motion, settings, monitor, warnings) if skins else None,
        doubtful=doubtful_in(out, warnings),
        bar=_bar(footage, warnings),
        warnings=tuple(warnings),
    )


def doubtful_in(out: Path, warnings: list[str]) -> tuple[tuple[int, int, str], ...]:
    """The doubtful stretches of the results in OUT: first and last frame, and the reason; those of tables that there are.

    Raises:
        InputError: frames.csv is damaged.
    """
    frames, joints = out / "frames.csv", out / "joints.csv"
    table, guessed = read_frame_table(frames) if frames.is_file() else None, dict[str, tuple[int, ...]]()
    try:
        guessed = read_guessed(joints) if joints.is_file() else guessed
    except InputError as error:
        warnings.append(f"No markers of guessed limbs in the scene: {error}")
    return tuple(doubtful_stretches(table, guessed))


def _bar(footage: Footage | None, warnings: list[str]) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        return read_bar(footage.take.rig_path, footage.rig) if footage is not None else None
    except InputError as error:
        warnings.append(f"No reference bar in the scene: {error}")
        return None


def _footage(run: Mapping[str, Any], out: Path, warnings: list[str]) -> Footage | None:
    try:
        if "take" not in run:
            raise InputError(f"{out / 'run.json'} does not name the take.")
        return open_take(read_take(Path(run["take"])))
    except InputError as error:
        warnings.append(f"No cameras and footage in the scene, and its rate is {DEFAULT_FPS:g} fps: {error}")
        return None


def _clouds(folder: Path, monitor: Monitor, warnings: list[str]) -> dict[int, Ply]:
    missing = f"{folder} has no clouds"
    try:
        paths = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        paths, missing = [], f"cannot read {folder}: {error.strerror or error}"
    files = {int(path.stem): path for path in paths if path.suffix == ".ply" and path.stem.isdecimal()}
    if not files:
        warnings.append(f"No point cloud in the scene: {missing}.")
    clouds = {}
    for i, (frame, path) in enumerate(sorted(files.items())):
        monitor.step("reading clouds", i, len(files))
        clouds[frame] = read_ply(path)
    return clouds


def _skins(
    shape: BodyShape | None, motion: MotionTable | None, settings: SkinSettings, monitor: Monitor, warnings: list[str]
) -> FrameSkins | None:
    if shape is None or motion is None:
        warnings.append("No exact skin in the scene: the run has no body; run the fit again.")
        return None
    vertices = []
    try:
        for i, pose in enumerate(motion.values):
            monitor.step("casting skins", i, len(motion.frames))
            vertices.append(body_skin(shape, pose, settings).vertices_m.astype("<f4"))
    except InputError as error:
        warnings.append(f"No exact skin in the scene: {error}")
        return None
    return FrameSkins(frames=motion.frames, vertices_m=np.stack(vertices), settings=settings)


def _fewer_files(out: Path, run: Mapping[str, Any], settings: SkinSettings) -> list[str]:
    """A sentence for each folder of results, if there is one, from which files were removed; for the skin's colours one of their own."""
    sentences = []
    for name in with_fewer_files(out, run, [name for name in FOLDERS if (out / name).is_dir()]):
        said = f"{out / name} has fewer files than the run wrote there"
        if name == SKIN and settings.texture_px and not (out / name / TEXTURE).is_file():
            said = f"No colours on the skin in the scene: {TEXTURE} is no file in {out / name}"
        sentences.append(f"{said}; repeat the run, which makes it again.")
    return sentences


def _optional(path: Path, what: str, read: Callable[[Path], Any], warnings: list[str]) -> Any:
    if path.is_file():
        return read(path)
    warnings.append(f"No {what} in the scene: {path.name} is not in {path.parent}.")
    return None


def _motion(path: Path, shape: BodyShape | None, warnings: list[str]) -> MotionTable | None:
    if shape is None and path.is_file():
        warnings.append(f"No action in the scene: {path.name} needs body.toml in the same folder.")
        return None
    return _optional(path, "action", lambda file: read_motion(file, shape.skeleton), warnings)


def _joints(path: Path, warnings: list[str]) -> JointTable | None:
    try:
        return read_joints(path) if path.is_file() else None
    except InputError as error:
        warnings.append(f"No sigmas of joints in the scene: {error}")
        return None


def _arrays(path: Path) -> dict[str, np.ndarray]:
    arrays, _ = store.load(path)
    vectors = dict.fromkeys(("xyz_m", "velocity_m_s", "acceleration_m_s2"), ("f", "TN3"))
    store.check_layout(path, arrays, frames=("iu", "T"), sigma_m=("f", "TN"), **vectors)
    return arrays


def _raw(path: Path) -> dict[str, np.ndarray]:
    arrays, _ = store.load(path)
    store.check_layout(path, arrays, frames=("iu", "T"), xyz_m=("f", "TN3"), status=("iu", "TN"))
    if not np.isin(arrays["status"], list(TrackStatus)).all():
        raise InputError(f"{path} is damaged (invalid states); run the tracking again.")
    return arrays
