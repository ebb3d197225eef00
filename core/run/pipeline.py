"""The stages of a run, each a page: measure → track → fit → (scene, in Blender). What a run did stands in run.json.

Every stage asks the stages before it for their results; what is checkpointed is not computed again, so a stopped run goes on where it was.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..body.model_file import read_model
from ..body.motion import BodyFit
from ..body.shape import write_body
from ..body.skin.contour_skin import SkinSettings, body_skin
from ..body.skin.extremities import shape_for_skin
from ..checking.fit_check import check_fit
from ..checking.take_check import causes_of_failure, doubts, with_cause
from ..checking.timing import synchronised
from ..fitting.inputs.no_surface import can_do_without, empty_clouds, empty_views, known_silhouettes
from ..fitting.inputs.take_inputs import check_body, clicks_left_out, fit_input, missing_for_fit
from ..fitting.inputs.track_guide import BodyGuide
from ..fitting.settings import FitSettings
from ..fitting.stages.sequence import fit_sequence
from ..foundation.errors import InputError
from ..foundation.progress import Cancelled, Monitor
from ..foundation.settings import current_tables, from_table
from ..images.enhance import EnhanceSettings
from ..images.retime import TimingSettings
from ..matching.least_squares import MatchingSettings
from ..matching.region_growing import GrowingSettings
from ..motion.formats.ply import write_mesh
from ..motion.tables import write_joints, write_motion
from ..report.pages import Report, check_pictured, write_report
from ..report.silhouettes import Silhouettes, by_view, silhouettes_of
from ..results.folder import FitCheckpoints, Results, check_separate_folder
from ..surface.cloud import PointCloud, SurfaceSettings, as_written, write_cloud
from ..surface.frames import MeasuredFrames, note_of
from ..surface.measure import MeasureSettings, NothingMeasured, measure_frames
from ..take.clicked_points import clicked_depth
from ..take.take import Footage, open_take, read_take
from ..tracking.contour import ContourSettings
from ..tracking.corrections import corrected_cloud, corrected_tracks, missed_clicks
from ..tracking.long_tracks import trajectories_of
from ..tracking.lost_points import Guide
from ..tracking.settings import KeyPointSettings, TrackingSettings
from ..tracking.track import TrackingRules, track_frames
from ..tracking.trajectories import Filtered, Trajectories, write_trajectories
from .record import frame_table, median, new_record, track_figures, write_frame_table
from .stages import STAGE_FILES, STAGE_INPUTS, STAGES, stage_keys, valid_stages

SETTINGS: dict[str, type] = {
    "timing": TimingSettings,
    "enhance": EnhanceSettings,
    "matching": MatchingSettings,
    "growing": GrowingSettings,
    "surface": SurfaceSettings,
    "tracking": TrackingSettings,
    "key_points": KeyPointSettings,
    "contour": ContourSettings,
    "fitting": FitSettings,
    "skin": SkinSettings,
}
Overrides = Mapping[str, Mapping[str, Any]]


@dataclass(kw_only=True)
class Run:
    """A run under way: an opened take, its settings, and the folder for its results. `record` becomes run.json."""

    footage: Footage
    settings: dict[str, Any]
    results: Results
    keys: Mapping[str, str] = field(default_factory=dict)  # of the stages: see stages.py
    record: dict[str, Any] = field(default_factory=dict)
    measured: MeasuredFrames = field(init=False)
    trajectories: Trajectories | None = None
    body: BodyFit | None = None
    surfaceless: bool = False  # nothing could be measured, or nothing is to be
    silhouettes: Silhouettes = field(default_factory=Silhouettes)
    pictured: Sequence[int] = ()  # the frames of the report's pictures; none: the first, a middle and the last

    def __post_init__(self) -> None:
        self.measured = MeasuredFrames(footage=self.footage, results=self.results)

    @property
    def clouds(self) -> Sequence[PointCloud]:
        """The clouds in the order of time, as the user corrected them; without points where nothing was measured."""
        return self.measured.clouds(self.corrected) if self.measured else empty_clouds(self.footage)

    def corrected(self, cloud: PointCloud) -> PointCloud:
        """A cloud without what the user took out."""
        return corrected_cloud(cloud, self.footage.take.corrections, self.footage.rig)

    def warn(self, *sentences: str) -> None:
        """Note what the user should know."""
        self.record["warnings"].extend(s for s in dict.fromkeys(sentences) if s not in self.record["warnings"])

    def finish_stage(self, stage: str, began: float, **figures: Any) -> None:
        """Note what a stage took and found, and write run.json."""
        key = self.keys.get(stage, self.keys.get("fit", ""))
        self.record["stages"][stage] = {"seconds": round(time.perf_counter() - began, 2), "key": key, **figures}
        write_frame_table(self.results.path("frames.csv"), frame_table(self.measured.notes, self.trajectories, self.body))
        self.results.write_run(self.record)

    def do_without_surface(self, why: str) -> None:
        """Note that there are no clouds and no trajectories."""
        self.surfaceless = True
        self.results.remove("clouds", "trajectories.npz", "trajectories_raw.npz")
        for stage in ("measure", "track"):
            self.finish_stage(stage, time.perf_counter(), not_done=why)

    def __str__(self) -> str:
        """One line for a panel."""
        stages = self.record["stages"]
        parts = [f"{len(self.footage.frames)} frames"]
        if "points_per_frame" in stages.get("measure", {}):
            parts.append(f"{stages['measure']['points_per_frame']:.0f} points a frame (sigma {stages['measure']['sigma_mm']:.2f} mm)")
        if "trajectories" in stages.get("track", {}):
            parts.append(f"{stages['track']['trajectories']} trajectories")
        if "fit" in stages and "not_done" not in stages["fit"]:
            parts.append("body fitted")
        return ", ".join(parts)


def settings_of(take_settings: Overrides, overrides: Overrides, where: str) -> dict[str, Any]:
    """All settings of a run: the defaults, then take.toml's, then the command's or the panel's.

    Raises:
        InputError: an unknown table or name, or a value that cannot be.
    """
    groups: dict[str, dict[str, Any]] = {name: {} for name in SETTINGS}
    for source, place in ((take_settings, f" in {where}"), (overrides, "")):
        for name, table in current_tables(source, SETTINGS, place).items():
            groups[name].update(table)
    return {name: from_table(cls, groups[name], f"[{name}]") for name, cls in SETTINGS.items()}


@contextmanager
def open_run(
    take_folder: Path, out: Path, overrides: Overrides | None = None, frames: tuple[int, int] | None = None, *,
    restart: bool = False, ignore_contours: bool = False, pictures: Sequence[int] = ()) -> Iterator[Run]:  # fmt: skip
    """Open a take and the folder for its results, into which no other run can write meanwhile. What can be checked beforehand is checked.

    What an earlier run of other input left in OUT is removed (with `ignore_contours` not for new contours alone); `restart` removes it all.
    `pictures`: the frames of the report's, by default a few.

    Raises:
        InputError: the take, the rig, the settings or the folder need mending, or another run is at work in the folder.
    """
    take = read_take(take_folder)
    settings = settings_of(take.settings, overrides or {}, str(take.folder / "take.toml"))
    footage = open_take(take)
    if frames is not None:
        footage = only_frames(footage, frames)
    for name, at in take.seeds.joints.items():
        clicked_depth(footage, name, at)
    if take.body_model is not None:
        read_model(take.body_model)
    check_separate_folder(out, take.folder, (s.files()[0] for s in footage.sequences))
    check_pictured(footage.frames, pictures)
    keys = stage_keys(footage, settings, Path(out))
    with Results(out).opened() as results:
        if restart:
            results.remove("clouds", *STAGE_FILES, "cache")  # the cache last: it marks the folder as ours
        before = {} if restart else results.read_run()
        record = new_record(footage, settings)
        record["stages"] = kept = valid_stages(before, keys, ignore_contours=ignore_contours)
        if before:  # what was made otherwise must not stand beside the new
            results.remove(*(name for stage, c in STAGE_INPUTS.items() if stage not in kept for name in c.files))
        yield Run(footage=footage, settings=settings, results=results, keys=keys, record=record, pictured=pictures)


def only_frames(footage: Footage, frames: tuple[int, int]) -> Footage:
    """The footage with only these frames, half-open.

    Raises:
        InputError: the take has not all of them.
    """
    if frames[0] not in footage.frames or frames[1] - 1 not in footage.frames or frames[0] >= frames[1]:
        raise InputError(
            f"Frames {frames[0]}:{frames[1]} are not among the take's frames {footage.frames.start}:{footage.frames.stop}; choose others."
        )
    return replace(footage, frames=range(*frames))


def measure(run: Run, monitor: Monitor) -> None:
    """The surface of every frame: clouds/NNNN.ply. That nothing can be measured is a warning where outlines or keypoints can stand for it.

    Raises:
        InputError: the footage cannot be read, or nothing can be measured.
        Cancelled: the frames measured so far are kept.
    """
    began, s = time.perf_counter(), run.settings
    run.results.remove_other_clouds(run.footage.frames)
    done, room = [], None
    if s["timing"].correct and not run.footage.delay_images:
        run.footage, run.record["offsets"] = synchronised(run.footage, monitor)
    try:
        for m in measure_frames(run.footage, MeasureSettings.of(s), run.results, monitor):
            write_cloud(run.results.cloud_path(m.frame), as_written(run.corrected(m.cloud), s["surface"]))
            done.append(note_of(m))
            room = room or m.foreground
    except Cancelled as stop:
        of = len(run.footage.frames)
        raise Cancelled(f"Stopped: the surface of {len(done)} of {of} frames is kept; run it again to go on.") from stop
    except NothingMeasured as error:
        if can_do_without(run.footage, run.results):
            run.warn(f"{error} The body rests on outlines and keypoints.")
            return run.do_without_surface("nothing could be measured")
        cause = next(iter(causes_of_failure(run.footage, monitor)), None)
        if cause is None:
            raise
        raise NothingMeasured(error.frame, f"{cause.sentence} {cause.advice}".strip()) from error
    notes = tuple(sorted(done, key=lambda n: n.frame))
    run.measured = MeasuredFrames(footage=run.footage, results=run.results, notes=notes)
    residual = median([n.residual_px for n in notes])
    run.warn(*doubts(run.footage, [n.frame for n in notes], [n.points for n in notes], [n.residual_px for n in notes], monitor))
    run.finish_stage(
        "measure",
        began,
        frames=len(notes),
        points_per_frame=float(np.mean([n.points for n in notes])),
        residual_px=residual,
        sigma_mm=1e3 * median([n.sigma_m for n in notes]),
        foreground=room.method if room else "",
        background_planes=len(room.planes) if room else 0,
    )


def track(run: Run, monitor: Monitor) -> None:
    """The trajectories of the surface's points: trajectories.npz. Measures first where that is needed.

    Raises:
        InputError: see `measure`.
        Cancelled: what is done is kept.
    """
    if not run.measured and not run.surfaceless:
        measure(run, monitor)
    if run.surfaceless:
        return
    began = time.perf_counter()
    run.finish_stage("track", began, **_follow(run, monitor))


def _follow(run: Run, monitor: Monitor, guide: Guide | None = None) -> dict[str, Any]:
    """Write the trajectories, of lost points with a guide or without; gives figures for run.json.

    Raises:
        Cancelled: what is done is kept.
    """
    s, take, hit = run.settings, run.footage.take, set[int]()

    def decide(raw: Trajectories, rows: range) -> tuple[Filtered, np.ndarray]:
        filtered, clicked = corrected_tracks(raw, take.corrections, run.footage.rig, s["tracking"], monitor, rows)
        hit.update(clicked)
        return filtered, np.array([*clicked.values()], dtype=np.int64)

    try:
        rules = TrackingRules(matching=s["matching"], tracking=s["tracking"], enhance=s["enhance"], limit_px=run.measured.limit_px)
        steps = track_frames(run.footage, run.measured, rules, run.results, monitor, guide)
        filtered, reasons = trajectories_of(steps, take.fps, s["tracking"], decide)
    except Cancelled as stop:
        raise Cancelled("Stopped: the surface of all frames is kept, and the tracks as far as they are; run it again to go on.") from stop
    run.trajectories = filtered.kept
    write_trajectories(run.results.folder, filtered, take.fps)
    figures, warnings = track_figures(filtered.kept, reasons)
    run.warn(*(*missed_clicks(take.corrections, hit), *warnings))
    return figures


def fit(run: Run, monitor: Monitor) -> None:
    """The body's shape and motion: body.toml, joints.csv, motion.csv, skin/. Measures and tracks first where that is needed.

    A take without a model or clicked joints has no body; run.json says so.

    Raises:
        InputError: the clicks contradict each other, or the limb has no points.
        Cancelled: surface and tracks are kept.
    """
    check_body(run.footage, run.settings["fitting"])
    if not run.settings["fitting"].use_surface and not run.surfaceless:
        run.do_without_surface("fitting.use_surface is false")
    if run.trajectories is None:
        track(run, monitor)
    began = time.perf_counter()
    run.results.remove("body.toml", "joints.csv", "motion.csv", "skin")
    missing = missing_for_fit(run.footage)
    run.warn(*clicks_left_out(run.footage))
    if missing:
        if not run.footage.take.no_body:
            run.warn(f"No body was fitted: take.toml has {missing}.")
        run.finish_stage("fit", began, not_done=missing)
        return
    try:
        empty = empty_views(run.footage, run.results, run.clouds, run.settings["fitting"], monitor)
        given = fit_input(run.footage, run.clouds, run.trajectories, run.results, empty)
        run.body = body = fit_sequence(given, run.settings["fitting"], monitor, FitCheckpoints(run.results, run.keys["fit"]))
        _write_body(run, body, monitor)
        guided = run.settings["fitting"].track_again and run.measured
        again = _follow(run, monitor, BodyGuide(body, run.footage)) if guided else {}
        run.results.remove("cache/fit")
        known = known_silhouettes(run.footage, run.results, run.settings["fitting"])
        run.silhouettes = silhouettes_of(run.footage, body, run.settings["skin"], *known, monitor)
    except Cancelled as stop:
        run.results.remove("body.toml", "joints.csv", "motion.csv", "skin")
        raise Cancelled("Stopped during the fit: surface and tracks are kept; run it again to go on.") from stop
    except InputError as error:
        raise with_cause(error, run.footage, run.measured.notes[0].frame) if run.measured else error from error
    states = _told_states(run, body)
    run.warn(*check_fit(given, body, run.settings["fitting"].click_sigma_px))
    run.finish_stage(
        "fit",
        began,
        frames=states,
        iterations=body.iterations,
        converged=body.converged,
        sigma0=median(body.motion.sigma0),
        joint_sigma_mm=1e3 * median(body.motion.joint_sigma_m),
        **({"outline_mm": 1e3 * median(body.outline_m)} if len(body.outline_m) else {}),
        **({"silhouettes": by_view(run.silhouettes.fits)} if run.silhouettes.fits else {}),
        **({"tracked_again": again} if again else {}),
    )


def _told_states(run: Run, body: BodyFit) -> dict[str, int]:
    """How many frames are in each state; what is doubtful is said."""
    states = {word: body.motion.status.count(word) for word in sorted(set(body.motion.status))}
    doubtful = ", ".join(f"{n} {word}" for word, n in states.items() if word != "fitted")
    if doubtful:
        run.warn(f"Frames in which the body rests partly on prediction: {doubtful}.")
    if not body.converged:
        run.warn(f"The body has not settled after {body.iterations} steps: look at the pictures, and raise fitting.sequence_steps.")
    return states


def report(run: Run, monitor: Monitor) -> None:
    """report/report.html with its pictures."""
    began = time.perf_counter()
    run.record["stages"].pop("report", None)  # a page does not tell of the page before it
    shown = Report(
        footage=run.footage,
        record=run.record,
        clouds=run.clouds,
        trajectories=run.trajectories,
        body=run.body,
        silhouettes=run.silhouettes,
    )
    write_report(run.results, shown, monitor, run.pictured)
    run.finish_stage("report", began)


def run(
    take_folder: Path,
    out: Path,
    overrides: Overrides | None = None,
    monitor: Monitor | None = None,
    *,
    restart: bool = False,
    frames: tuple[int, int] | None = None,
) -> Run:
    """Everything that needs no Blender, from the images to the report. A stopped run goes on where it was; `restart` begins anew.

    Raises:
        InputError: something of the input needs mending; nothing that was computed is lost.
        Cancelled: what is done is kept.
    """
    with open_run(take_folder, out, overrides, frames, restart=restart) as job:
        all_stages(job, monitor or Monitor())
    return job


def all_stages(run: Run, monitor: Monitor) -> None:
    """Measure, track, fit and report, as `run` does, of an opened take."""
    check_body(run.footage, run.settings["fitting"])
    for stage in (measure, track, fit, report) if run.settings["fitting"].use_surface else (fit, report):
        stage(run, monitor)


def is_complete(run: Run) -> bool:
    """Whether everything was done with the same input before, and still lies in the folder."""
    done = run.record["stages"]
    body = () if "not_done" in done.get("fit", {}) else ("body.toml", "joints.csv", "motion.csv")
    surface = () if "not_done" in done.get("measure", {}) else ("clouds", "trajectories.npz")
    files = ("report", *surface, *body)
    return {*STAGES, "report"} <= set(done) and all(run.results.path(name).exists() for name in files)


def _write_body(run: Run, body: BodyFit, monitor: Monitor) -> None:
    person = shape_for_skin(body.shape, run.settings["skin"])
    for i, (frame, values) in enumerate(zip(body.motion.frames, body.motion.values)):
        monitor.step("skin", i, len(body.motion.frames))
        try:
            skin = body_skin(person, values, run.settings["skin"])
        except InputError as no_skin:
            run.warn(f"No skin was made: {no_skin}")
            run.results.remove("skin")
            break
        write_mesh(run.results.path("skin", f"{frame:04d}.ply"), skin.vertices_m, skin.faces)
    write_joints(run.results.path("joints.csv"), body.motion)
    write_motion(run.results.path("motion.csv"), body.motion, body.shape.skeleton)
    write_body(run.results.path("body.toml"), body.shape)
