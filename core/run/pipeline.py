"""The stages of a run, each a page: measure → track → fit → report. What a run did is recorded in run.json.

Every stage asks the stages before it for their results. What has a checkpoint is not computed again, so a stopped run resumes.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..body.motion import FITTED, PARTIAL, BodyFit
from ..body.shape import write_body
from ..body.skin import texture
from ..body.skin.contour_skin import body_skin
from ..body.skin.facing import facing_ahead
from ..body.skin.feet_place import with_feet_in_place
from ..body.skin.fingers import shape_for_skin
from ..body.skin.head_place import registered_head
from ..body.skin.mesh import SkinSettings
from ..body.skin.person_skin import REST, cage, rest_skin, with_relief, write_skin
from ..body.skin.posed import Poser
from ..body.skin.relief import MOST_FRAMES, SurfacePoints
from ..checking.rig_check import wide_findings
from ..checking.run_check import check_fit
from ..checking.take_check import causes_of_failure, check_clouds, with_cause
from ..checking.timing import synchronised
from ..fitting.inputs.completed_clouds import clouds_for_fit
from ..fitting.inputs.fit_input import FitInput
from ..fitting.inputs.no_surface import background_regions, can_fit_without_surface, outline_polygons, points_in_views
from ..fitting.inputs.start_joints import NeedsClick
from ..fitting.inputs.take_inputs import check_body, clicks_in, clicks_left_out, fit_input, missing_for_fit
from ..fitting.inputs.track_guide import BodyGuide
from ..fitting.stages.rough_motion import rough_bodies
from ..fitting.stages.sequence import fit_and_start, fit_from
from ..fitting.stages.set_up import NobodyFound, of_model, with_start
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.view_angles import no_view_alike
from ..matching.foreground import Foreground
from ..motion.formats.ply import write_mesh
from ..motion.tables import write_joints, write_motion
from ..report.pages import Report, write_report
from ..report.person import skin_in
from ..report.silhouettes import by_view, silhouettes_of
from ..results.folder import FitCheckpoints
from ..results.run_json import UNTIL
from ..surface.beginning import other_beginning
from ..surface.cloud import as_written, write_cloud
from ..surface.frames import FrameSummary, MeasuredFrames, summary_of
from ..surface.measure import NothingMeasured, measure_frames
from ..surface.starts import MeasureSettings
from ..take.take import AUTO_BODY
from ..tracking.corrections import corrected_tracks, missed_clicks
from ..tracking.long_tracks import trajectories_of
from ..tracking.lost_points import Guide
from ..tracking.track import TrackingRules, track_frames
from ..tracking.trajectories import Filtered, Trajectories, write_tracked_clouds, write_trajectories
from .around_clicks import FITTED_WITH, besides_clicks, fitted_with
from .closed_loop import FOLDER, OFF, OUTLINES, loop_of, predicted_outlines
from .engine import Engine
from .file_digests import reads_content
from .fitted_body import FittedBody, can_be_read, read_fitted, write_fitted
from .inspection import example_of_matching
from .phases import course_of
from .record import doubtful_frames, fit_figures, fit_warnings, frame_table, start_figures, surface_figures, track_figures
from .settings import Overrides
from .stages import CONTENT, STAGES
from .take_run import FIT_STEPS, SURFACE, Run, open_run
from .workers import measure_at_once

BODY_FILES = ("body.toml", "joints.csv", "motion.csv", "skin", "outlines")  # of the fit, besides the report


def measure(run: Run, monitor: Monitor) -> None:
    """The surface of every frame: clouds/NNNN.ply. If nothing can be measured, outlines or keypoints may replace it, with a warning; where
    all views look from too far apart, that is not even tried for a body.

    Raises:
        InputError: the footage cannot be read, or nothing can be measured.
        Cancelled: the frames measured so far are kept.
    """
    if _does_without_surface(run):
        run.warn(*(finding.sentence for finding in wide_findings(run.footage.rig.cameras, run.footage.take.reference)))
        return run.do_without_surface("the views look from too far apart")
    began, summaries, kept, frames = time.perf_counter(), list[FrameSummary](), set[int](), run.footage.frames
    run.results.remove_other_clouds(frames)
    if run.settings["timing"].correct and not run.footage.delay_images:
        run.footage, run.record["offsets"] = synchronised(run.footage, monitor)
    try:
        with run.resumable(
            stopped=lambda: (
                f"Stopped: the surface of {len(kept.union(s.frame for s in summaries))} of {len(frames)} frames is kept; "
                "run it again to go on."
            )
        ):
            foreground = _measured_from_somewhere(run, summaries, kept, monitor)
    except NothingMeasured as error:
        return _no_surface(run, error, monitor)
    summaries.sort(key=lambda summary: summary.frame)
    run.measured = MeasuredFrames(footage=run.measured_footage, results=run.results, summaries=tuple(summaries))
    run.warn(
        *check_clouds(run.footage, [f.frame for f in summaries], [f.points for f in summaries], [f.residual_px for f in summaries], monitor)
    )
    run.note_surface(surface := store.digest(*(summary.key for summary in summaries)))
    figures = surface_figures(summaries, foreground, float(run.measured_footage.reduction.mean()), run.distance_m)
    run.finish_stage("measure", began, **figures, **{SURFACE: surface})


def track(run: Run, monitor: Monitor) -> None:
    """The trajectories of the surface's points: trajectories.npz. Measures first where that is needed.

    Raises:
        InputError: see `measure`.
        Cancelled: what is done is kept.
    """
    if not run.measured and not run.surfaceless:
        measure(run, monitor)
    if not run.surfaceless:
        began = time.perf_counter()
        run.finish_stage("track", began, **_track_points(run, monitor))


def fit(run: Run, monitor: Monitor) -> None:
    """The body's shape and motion: body.toml, joints.csv, motion.csv, skin/. Measures and tracks first where that is needed.

    A take with model = "none" has no body; run.json says so. Without clicked joints the body starts by itself where that is certain.

    Raises:
        InputError: the clicks contradict each other, more are needed for a start, or the limb has no points.
        Cancelled: surface and tracks are kept.
    """
    _prepare_fit(run, monitor)
    began = time.perf_counter()
    run.remove_body(BODY_FILES)
    run.warn(*clicks_left_out(run.footage))
    if missing := missing_for_fit(run.footage):
        return _no_body(run, missing, began)
    try:
        with run.resumable(*BODY_FILES, stopped=lambda: "Stopped during the fit: surface and tracks are kept; run it again to go on."):
            given, body, tracked_again = _fit_body(run, monitor)
    except NobodyFound as error:
        if clicks_in(run.footage):
            raise
        return _no_body(run, "no clicked joints" + " in these frames" * bool(run.footage.take.clicks.joints), began, str(error))
    except NeedsClick:
        raise
    except InputError as error:
        raise with_cause(error, run.footage, run.measured.summaries[0].frame) if run.measured else error from error
    run.warn_if_replaced()
    run.warn(*fit_warnings(body), *check_fit(given, body, run.settings["fitting"].click_sigma_px))
    noted: dict[str, Any] = {"start": start_figures(given.start)} if given.start is not None else {}
    if run.footage.take.body_model == AUTO_BODY:
        noted["chosen_model"] = given.model
    if tracked_again and (loop := loop_of(run.settings["fitting"], body.shape.skeleton)) != OFF:
        noted["closed_loop"] = loop
    given_to = run.footage, run.settings, run.results.folder
    content = {CONTENT: besides_clicks(*given_to, run.digests.stamp)} if reads_content(run.footage) else {}
    noted[FITTED_WITH] = {**fitted_with(*given_to), **content}
    run.finish_stage("fit", began, **fit_figures(body, by_view(run.silhouettes.fits), tracked_again), **noted)


def report(run: Run, monitor: Monitor) -> None:
    """report/report.html with its pictures."""
    began = time.perf_counter()
    run.warn_if_replaced()
    run.record["stages"].pop("report", None)  # a page does not report on the page before it
    shown = Report(
        footage=run.footage,
        record=run.record,
        clouds=run.clouds,
        trajectories=run.trajectories,
        body=run.body,
        silhouettes=run.silhouettes,
        patch=example_of_matching(run.results.folder, _example_frame(run), run.footage, run.settings["matching"].patch_px),
        doubtful=doubtful_frames(frame_table(run.measured.summaries, run.trajectories, run.body), run.body),
        close_ups=run.close_ups,
        colour_limits=run.colour_limits,
    )
    write_report(run.results, shown, monitor, run.pictured)
    run.finish_stage("report", began)


def _example_frame(run: Run) -> int:
    """The frame of which a point's matching is shown: one that is pictured, or the middle one."""
    frames = run.footage.frames
    return run.pictured[len(run.pictured) // 2] if run.pictured else frames[len(frames) // 2]


def run(
    take_folder: Path,
    out: Path,
    overrides: Overrides | None = None,
    monitor: Monitor | None = None,
    *,
    restart: bool = False,
    frames: tuple[int, int] | None = None,
    engine: Engine | None = None,
) -> Run:
    """Everything that needs no Blender, from the images to the report. A stopped run goes on where it was; `restart` begins anew.
    `engine`: where the frames are measured; by default in this process.

    Raises:
        InputError: something of the input needs mending; nothing that was computed is lost.
        Cancelled: what is done is kept.
    """
    with open_run(take_folder, out, overrides, frames, restart=restart) as job:
        job.engine = engine
        all_stages(job, monitor or Monitor())
    return job


def all_stages(run: Run, monitor: Monitor) -> None:
    """Measure, track, fit and report, as `run` does, of an opened take."""
    do_stages(run, ("measure", "track", "fit", "report") if run.settings["fitting"].use_surface else ("fit", "report"), monitor)
    monitor.course = None


def do_stages(run: Run, names: Sequence[str], monitor: Monitor) -> None:
    """Some stages of an opened take, one after the other, with one progress for all of them."""
    if "fit" in names:
        check_body(run.footage, run.settings["fitting"])
    run.record[UNTIL] = names[-1]
    surface = run.settings["fitting"].use_surface and not _does_without_surface(run)
    monitor.course = course_of(names, len(run.footage.frames), surface=surface)
    stages = {"measure": measure, "track": track, "fit": fit, "report": report}
    for name in names:
        monitor.begin(name)
        stages[name](run, monitor)


def is_complete(run: Run) -> bool:
    """Whether everything was done with the same input before, and still lies in the folder, undamaged."""
    done = run.record["stages"]
    body = () if "not_done" in done.get("fit", {}) else BODY_FILES[:3]
    surface = () if "not_done" in done.get("measure", {}) else ("clouds", "trajectories.npz")
    there = {*STAGES, "report"} <= set(done) and all(run.results.path(name).exists() for name in ("report", *surface, *body))
    return there and (not body or can_be_read(run.results))


# ---- the steps of the stages ---------------------------------------------------------------------------------------------


def _does_without_surface(run: Run) -> bool:
    """Whether a body is wanted, and all views look from too far apart for a surface."""
    return no_view_alike(run.footage.rig.cameras, run.footage.take.reference) and not missing_for_fit(run.footage)


def _measured_from_somewhere(run: Run, summaries: list[FrameSummary], kept: set[int], monitor: Monitor) -> Foreground | None:
    """As `_measure_frames`; if the first frame shows hardly anything, for no certain cause, from another one, or with pairs of views."""
    run.choose_image_size(monitor)
    try:
        return _measure_frames(run, summaries, kept, monitor)
    except NothingMeasured as error:
        if not error.points and any(cause.certain for cause in causes_of_failure(run.footage, monitor)):
            raise
        begin = other_beginning(run.measured_footage, MeasureSettings.of(run.settings), run.results, monitor, error.points)
        if begin is None:
            raise
        run.warn(*begin.sentences(error))
        run.begin, growing = begin.frame, run.settings["growing"]
        run.settings["growing"] = replace(growing, pairs=growing.pairs or begin.pairs)
        return _measure_frames(run, summaries, kept, monitor)


def _measure_frames(run: Run, summaries: list[FrameSummary], kept: set[int], monitor: Monitor) -> Foreground | None:
    """Write the clouds, summarise each frame in `summaries`; gives the first frame's foreground. `kept`: see `measure_at_once`."""
    s, foreground = run.settings, None
    if run.engine is not None:
        measure_at_once(run, run.engine, monitor, kept)
    for m in measure_frames(run.measured_footage, MeasureSettings.of(s), run.results, monitor, run.begin):
        write_cloud(run.results.cloud_path(m.frame), as_written(run.corrected(m.cloud), s["surface"]))
        summaries.append(summary_of(m))
        foreground = foreground or m.foreground
    return foreground


def _no_surface(run: Run, error: NothingMeasured, monitor: Monitor) -> None:
    """Go on with outlines and keypoints where there are some; otherwise the error, with its cause if that is certain."""
    if can_fit_without_surface(run.footage, run.results):
        run.warn(f"{error} The body rests on outlines and keypoints.")
        return run.do_without_surface("nothing could be measured")
    cause = next(iter(causes_of_failure(run.footage, monitor)), None)
    if cause is None:
        raise error
    raise NothingMeasured(error.frame, f"{cause.sentence} {cause.advice}".strip()) from error


def _track_points(run: Run, monitor: Monitor, guide: Guide | None = None) -> dict[str, Any]:
    """Write the trajectories; a guide predicts where lost points reappear. Gives figures for run.json."""
    s, take, hit = run.settings, run.footage.take, set[int]()

    def decide(raw: Trajectories, rows: range) -> tuple[Filtered, np.ndarray]:
        filtered, clicked = corrected_tracks(raw, take.corrections, run.footage.rig, s["tracking"], monitor, rows)
        hit.update(clicked)
        return filtered, np.array([*clicked.values()], dtype=np.int64)

    kept = "Stopped: the surface of all frames is kept, and the tracks as far as they are; run it again to go on."
    with run.resumable(stopped=lambda: kept):
        rules = TrackingRules.of(s, run.measured)
        steps = track_frames(run.measured_footage, run.measured, rules, run.results, monitor, guide)
        filtered, reasons = trajectories_of(steps, take.fps, s["tracking"], decide)
    run.trajectories = filtered.kept
    run.results.remove("tracked")
    write_tracked_clouds(run.results.folder, filtered.kept, monitor)
    write_trajectories(run.results.folder, filtered, take.fps)
    figures, warnings = track_figures(filtered.kept, reasons)
    run.warn(*missed_clicks(take.corrections, hit), *warnings)
    return figures


def _prepare_fit(run: Run, monitor: Monitor) -> None:
    """Everything that comes before the fit."""
    check_body(run.footage, run.settings["fitting"])
    if not run.settings["fitting"].use_surface and not run.surfaceless:
        run.do_without_surface("fitting.use_surface is false")
    if run.trajectories is None:
        track(run, monitor)


def _no_body(run: Run, missing: str, began: float, why: str = "") -> None:
    """Record that there is nothing to fit; a take that wants no body is not warned."""
    if run.footage.take.body_model is not None:
        run.warn(f"No body was fitted: take.toml has {missing}. {why}".strip())
    run.finish_stage("fit", began, not_done=missing)


def _fit_body(run: Run, monitor: Monitor) -> tuple[FitInput, BodyFit, dict[str, Any]]:
    """Fit the body and write it, track once more with its help, and compare silhouettes; gives the figures of the tracks, too."""
    fitting = run.settings["fitting"]
    background = background_regions(run.footage, run.results, run.clouds, fitting, monitor)
    clouds = clouds_for_fit(run.footage, run.clouds, run.trajectories, background, fitting, run.results, monitor)
    given = fit_input(run.footage, clouds, run.trajectories, run.results, background)
    if run.trajectories is None and fitting.use_trajectories:
        given = _with_image_tracks(run, given, monitor)
    if (fitted := read_fitted(run.results, run.body_key)) is not None:
        given, body, tracked_again = replace(of_model(given, fitted.model), start=fitted.start), fitted.body, dict[str, Any]()
    else:
        given, body, tracked_again = _fit_to(run, given, monitor)
    run.body = body = _write_body(run, body, monitor)
    run.results.remove(*FIT_STEPS)
    outlines = {**outline_polygons(run.footage, run.results, FOLDER), **outline_polygons(run.footage, run.results)}
    skin_at = skin_in(run.results.path("skin"), body, run.settings["skin"])
    run.silhouettes = silhouettes_of(run.footage, body, skin_at, outlines, given.background, monitor)
    return given, body, tracked_again


def _with_image_tracks(run: Run, given: FitInput, monitor: Monitor) -> FitInput:
    """The input with points that are followed in single views, and with the background as it is then known (`rough_motion`)."""
    fitting, parts = run.settings["fitting"], [monitor.part("follow points", i, 4) for i in range(4)]
    given = replace(given, image_tracks=points_in_views(run.footage, given.background, parts[0]))
    if not given.image_tracks or not any(region.estimated for region in given.background):
        return given
    bodies = rough_bodies(given, fitting, parts[1], FitCheckpoints(run.results, run.body_key, "fit_rough"))
    background = background_regions(run.footage, run.results, run.clouds, fitting, parts[2], bodies=bodies)
    return replace(given, background=background, image_tracks=points_in_views(run.footage, background, parts[3], bodies))


def _fit_to(run: Run, given: FitInput, monitor: Monitor) -> tuple[FitInput, BodyFit, dict[str, Any]]:
    """Fit the body, and track once more with its help; a body whose trajectories stay has a checkpoint."""
    fitting = run.settings["fitting"]
    given = with_start(given, fitting, monitor)
    body, start = fit_and_start(given, fitting, monitor, FitCheckpoints(run.results, run.body_key))
    loop = loop_of(fitting, body.shape.skeleton) if run.measured else OFF
    if not (run.measured and (fitting.track_again or loop != OFF)):
        write_fitted(run.results, run.body_key, FittedBody(body=body, model=given.model, start=given.start))
        return given, body, {}
    tracked_again = _track_points(run, monitor, BodyGuide(body, run.measured_footage))
    if loop != OFF:
        clouds = clouds_for_fit(run.footage, run.clouds, run.trajectories, given.background, fitting, run.results, monitor)
        contours = predicted_outlines(run, body, monitor) if loop == OUTLINES else given.contours
        given = replace(given, clouds=clouds, trajectories=run.trajectories, contours=contours)
        body = fit_from(given, start, fitting, monitor, FitCheckpoints(run.results, run.body_key, "fit_again"))
    return given, body, tracked_again


def _write_body(run: Run, body: BodyFit, monitor: Monitor) -> BodyFit:
    """Write skin, joints, motion and shape; gives the body with a head that looks where the face does."""
    try:
        body = _write_skins(run, body, monitor)
    except InputError as no_skin:
        run.warn(f"No skin was made: {no_skin}")
        run.results.remove("skin")
    write_joints(run.results.path("joints.csv"), body.motion)
    write_motion(run.results.path("motion.csv"), body.motion, body.shape.skeleton)
    write_body(run.results.path("body.toml"), body.shape)
    return body


def _write_skins(run: Run, body: BodyFit, monitor: Monitor) -> BodyFit:
    """The person's skin in the rest pose, with relief, and its cage in every frame's pose; gives the body that it belongs to.

    Raises:
        InputError: the body has no skin.
    """
    settings: SkinSettings = run.settings["skin"]
    person = shape_for_skin(body.shape, settings)
    points = _surface_points(run, body) if settings.relief else []
    skin = with_feet_in_place(rest_skin(person, settings), person, points)
    if points:
        place = registered_head(skin, person, points)
        skin = with_relief(skin, person, points, place, settings.mirror, monitor)
        if place is not None and place.facing is not None:
            body, skin, person = facing_ahead(body, skin, person, place.facing, run.footage.take.clicked_joints)
    write_skin(run.results.path("skin", REST), skin)
    if settings.texture_px:
        _write_texture(run, body, texture.TextureBaker(skin, person, settings.texture_px, len(run.footage.rig.cameras)), monitor)
    rows, faces = cage(skin)
    poser, vertices = Poser(person, skin.weights[rows]), skin.vertices_m[rows]
    for i, (frame, values) in enumerate(zip(body.motion.frames, body.motion.values)):
        monitor.step("skin", i, len(body.motion.frames))
        cast = body_skin(person, values, settings) if settings.exact else None
        mesh = (cast.vertices_m, cast.faces) if cast else (poser.posed(vertices, values), faces)
        write_mesh(run.results.path("skin", f"{frame:04d}.ply"), *mesh)
    return body


def _write_texture(run: Run, body: BodyFit, baker: texture.TextureBaker, monitor: Monitor) -> None:
    """skin/texture.png from all views."""
    rows = _known_poses(body, texture.MOST_FRAMES)
    for done, row in enumerate(rows):
        monitor.step("texture", done, len(rows))
        images = run.footage.read_colour(int(body.motion.frames[row]))
        views = [texture.View(camera=camera, rgb=rgb) for camera, rgb in zip(run.footage.rig.cameras, images)]
        baker.add(body.motion.values[row], views)
    if rows:
        texture.write_texture(run.results.path("skin"), baker.finished(monitor))


def _known_poses(body: BodyFit, most: int) -> list[int]:
    """Frames whose pose is known, as rows of the motion, evenly over the take."""
    known = np.flatnonzero(np.isin(body.motion.status, (FITTED, PARTIAL)))
    return known[np.unique(np.linspace(0, len(known) - 1, min(most, len(known))).round().astype(int))].tolist() if len(known) else []


def _surface_points(run: Run, body: BodyFit) -> list[SurfacePoints]:
    """What was measured in frames whose pose is known."""
    found, patch_px = [], run.settings["matching"].patch_px
    camera = run.measured_footage.rig.cameras[run.footage.take.reference]
    for row in _known_poses(body, MOST_FRAMES):
        cloud = run.clouds[row]
        if len(cloud.xyz_m):
            sigma = np.sqrt(np.einsum("ni,nij,nj->n", cloud.normals, cloud.covariance_m2, cloud.normals))
            patch_m = patch_px * float(np.median(camera.to_camera(cloud.xyz_m)[:, 2])) / camera.focal_px
            points = SurfacePoints(motion=body.motion.values[row], xyz_m=cloud.xyz_m, normals=cloud.normals, sigma_m=sigma, patch_m=patch_m)
            found.append(points)
    return found
