"""`tricap compare`: one take with the published and with the default method, and the same measures of both side by side.

Each method is a run of its own, in DIR/published and DIR/default, and resumes as any run does. The default runs first: of a take without
clicks it finds the joints, or points all over the surface where there is no body, from which the published method then begins. The measures
are computed from the files that both wrote, not from what a method reports about itself, except for times and sigmas. The colours of both
reports have common scales.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.bounded import real_path
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median, mad_sigma
from ..geometry.view_angles import views_alike
from ..motion.formats.ply import read_ply
from ..report.comparison import DEFAULT, HIGHER, LOWER, METHODS, NEITHER, PUBLISHED, Measure, comparison_page, written
from ..results.folder import Results, check_inside, check_separate_folder
from ..results.outputs import check_replaceable
from ..take.take import Clicks, FrameClicks, Take
from . import pipeline
from .joints import pixels_of, with_joints
from .settings import Overrides
from .take_run import Run, open_run

PLACE_M = 0.02  # edge of the cubes in which coverage is counted
SURFACE, TRACKS, BODY, TIME = "Surface", "Trajectories", "Body", "Time"  # groups of measures
CLICKED_POINTS = 6  # of the surface, where nobody clicked any: a person clicks few
NEIGHBOURS = 20  # through which a quadric is fitted, for the noise
FORMAT, TABLE, PAGE = "tricap-comparison", "compare.json", "compare.html"
START = f'{{\n "format": "{FORMAT}"'  # of the table


@dataclass(frozen=True, kw_only=True)
class Halves:
    """The results of both methods; without the published one if it could not run. `notes`: sentences about that."""

    folders: Mapping[str, Path]  # of results, by method, in the order of `METHODS`
    notes: tuple[str, ...] = ()


def run_both(
    take: Path, out: Path, overrides: Overrides, frames: tuple[int, int] | None, monitor: Monitor, *, restart: bool = False
) -> Halves:
    """Run the default and then the published method. What the default found without clicks are clicks for the published one.

    Raises:
        InputError: see `pipeline.run`, of the default method; or the overrides choose a preset, or one of the folders is a link out of
            `out`.
        Cancelled: what is done is kept.
    """
    check_separate_folder(out)
    _check_replaceable(out)
    for method in METHODS:
        check_inside(real_path(out) / method, real_path(out))
    if "preset" in overrides.get("method", {}):
        raise InputError("A comparison runs both presets; leave out --preset.")

    def opened(method: str, clicked: Callable[[Take], Take] | None = None) -> AbstractContextManager[Run]:
        return open_run(take, out / method, {**overrides, "method": {"preset": method}}, frames, restart=restart, clicked=clicked)

    with ExitStack() as both:
        both.callback(_remove_empty, out / PUBLISHED)
        default = both.enter_context(opened(DEFAULT))
        _complete(default, DEFAULT, monitor)
        clicked, note = _stand_in_clicks(default)
        try:
            published = both.enter_context(opened(PUBLISHED, clicked))
            published.pictured = _pictured(out / DEFAULT)
            _complete(published, PUBLISHED, monitor)
        except InputError as error:
            return Halves(folders={DEFAULT: out / DEFAULT}, notes=(*default.notes, *note, f"The published method could not run: {error}"))
        _alike((published, default), monitor)
    notes = (*default.notes, *published.notes, *note)
    return Halves(folders={method: out / method for method in METHODS}, notes=notes)


def _remove_empty(folder: Path) -> None:
    """Remove a folder unless something is in it."""
    with suppress(OSError):
        folder.rmdir()


def _complete(run: Run, method: str, monitor: Monitor) -> None:
    """Run what is not done yet."""
    run.close_ups = False  # the same part of the images in both reports
    if not pipeline.is_complete(run):
        monitor.begin(method)
        pipeline.all_stages(run, monitor)


def _pictured(folder: Path) -> list[int]:
    """The frames of the pictures in a report: those of both reports are beside each other."""
    return sorted(int(path.stem.rpartition("_")[2]) for path in (folder / "report").glob("cloud_*.png"))


def _stand_in_clicks(run: Run) -> tuple[Callable[[Take], Take] | None, tuple[str, ...]]:
    """What a run found without clicks as clicks, joints or else points of the surface, with a sentence about it; nothing if the take's own
    clicks were enough."""
    start, take = run.record["stages"].get("fit", {}).get("start"), run.footage.take
    if start is not None:
        joints = pixels_of(run.footage, {name: np.array(xyz) for name, xyz in start["joints_m"].items()}, start["unsure"])
        note = (
            f"The take has not enough clicks for the published method: it began from {len(joints)} joints that the default method found in "
            f"frame {start['frame']}, as if they had been clicked."
        )
        return partial(with_joints, frame=start["frame"], joints=joints), (note,)
    if take.clicks.named or take.keyframes:
        return None, ()
    frame, surface = _spread_points(run)
    note = (
        f"The take has no clicks for the published method: it began from {len(surface)} points that the default method measured in frame "
        f"{frame}, as if they had been clicked."
    )
    return (partial(_with_surface, clicks=FrameClicks(frame=frame, surface=surface)), (note,)) if surface else (None, ())


def _with_surface(take: Take, clicks: FrameClicks) -> Take:
    return replace(take, clicks=clicks)


def _spread_points(run: Run) -> tuple[int, tuple[Clicks, ...]]:
    """The first frame with measured points, and a few of its good ones, far from each other, in the views that are matched."""
    rig, reference = run.footage.rig, run.footage.take.reference
    cameras = [rig.cameras[k] for k in (reference, *views_alike(rig.cameras, reference))]
    for path in sorted((run.results.folder / "clouds").glob("*.ply")):
        cloud = read_ply(path)
        xyz = cloud.xyz_m[cloud.vertex["sigma"] <= np.median(cloud.vertex["sigma"])] if len(cloud.xyz_m) else cloud.xyz_m
        xyz = xyz[np.all([camera.sees(camera.project(xyz)) for camera in cameras], axis=0)]
        if len(xyz):
            xy = cameras[0].project(xyz)
            chosen = [int(np.argmin(np.linalg.norm(xy - np.median(xy, axis=0), axis=1)))]
            while len(chosen) < min(CLICKED_POINTS, len(xyz)):
                chosen.append(int(np.argmax(np.linalg.norm(xy[:, None] - xy[chosen], axis=2).min(axis=1))))
            return int(path.stem), tuple({c.name: np.round(c.project(xyz[i]), 1) for c in cameras} for i in chosen)
    return 0, ()


def _alike(runs: Sequence[Run], monitor: Monitor) -> None:
    """Make the reports' colours of the same picture mean the same: reports with another scale than the common one are written again."""
    own = [store.read_json(run.results.path("report", "report.json")).get("colour_limits", {}) for run in runs]
    common = {name: max(limits[name] for limits in own) for name in own[0] if name in own[1]}
    for run, limits in zip(runs, own):
        if any(limits[name] != high for name, high in common.items()):
            run.colour_limits = common
            if run.measured or run.surfaceless:
                pipeline.report(run, monitor)
            else:  # it was complete before
                pipeline.all_stages(run, monitor)


def measures_of(halves: Halves, monitor: Monitor) -> list[Measure]:
    """The measures that need no truth, of two results; NaN of a method without one."""
    runs = {method: Results(folder).read_run() for method, folder in halves.folders.items()}
    return [*_of_clouds(halves.folders, monitor), *_of_runs([runs.get(method, {"stages": {}}) for method in METHODS])]


def _check_replaceable(out: Path) -> None:
    """Check that compare.json and compare.html, if they are there, are of an earlier comparison.

    Raises:
        InputError: they are not.
    """
    check_replaceable(out / TABLE, START)
    if not (out / TABLE).exists():
        check_replaceable(out / PAGE)


def write_comparison(out: Path, take: Path, halves: Halves, measures: Sequence[Measure]) -> None:
    """Write DIR/compare.json and DIR/compare.html."""
    rows = [as_row(measure) for measure in measures]
    table = {"format": FORMAT, "version": 1, "take": str(take), "notes": halves.notes, "measures": rows}
    store.write_json(out / TABLE, table)
    store.write_text(out / PAGE, comparison_page(real_path(take).name, measures, halves.folders, halves.notes))


def as_row(measure: Measure) -> dict[str, Any]:
    """A measure for JSON."""
    return asdict(measure) | {"winner": measure.winner}


def _of_runs(runs: Sequence[dict[str, Any]]) -> list[Measure]:
    """The measures in two run.json. A constraint makes residuals small by definition, and the methods track points of other spacings.

    A single frame has no trajectories.
    """

    def removed(track: dict[str, Any]) -> float:
        started = track.get("started", 0)
        return 100 * (1 - track.get("reasons", {}).get("measured", 0) / started) if started else float("nan")

    wanted = (
        (SURFACE, "points a frame", "", HIGHER, lambda s: s.get("measure", {}).get("points_per_frame")),
        (SURFACE, "residual of the rays (median)", "px", NEITHER, lambda s: s.get("measure", {}).get("residual_px")),
        (TRACKS, "trajectories", "", NEITHER, lambda s: s.get("track", {}).get("trajectories")),
        (TRACKS, "length of a trajectory (mean)", "frames", HIGHER, lambda s: s.get("track", {}).get("mean_length_frames")),
        (TRACKS, "trajectories removed or lost by tests", "%", NEITHER, lambda s: removed(s.get("track", {}))),
        (BODY, "reported sigma of a joint (median)", "mm", NEITHER, lambda s: s.get("fit", {}).get("joint_sigma_mm")),
        (TIME, "duration of all stages", "s", LOWER, lambda s: sum(v.get("seconds", 0.0) for v in s.values()) if s else None),
    )
    single = [run["frames"][1] - run["frames"][0] == 1 if "frames" in run else False for run in runs]
    stages = [{k: v for k, v in run["stages"].items() if k != "track" or not one} for run, one in zip(runs, single)]
    values = [[float(v) if (v := of(s)) is not None else float("nan") for s in stages] for *_, of in wanted]
    return [Measure(group=g, name=n, unit=u, published=a, default=b, better=c) for (g, n, u, c, _), (a, b) in zip(wanted, values)]


def _of_clouds(folders: Mapping[str, Path], monitor: Monitor) -> list[Measure]:
    """Coverage and noise of the written clouds, measured in the same way in both."""
    paths = sorted((folders[DEFAULT] / "clouds").glob("*.ply"))
    share, noise = [], []
    for i, path in enumerate(paths):
        monitor.step("compare", i, len(paths))
        files = [folders[method] / "clouds" / path.name for method in METHODS if method in folders]
        if len(files) == len(METHODS) and all(file.is_file() for file in files):
            clouds = [read_ply(file).xyz_m for file in files]
            places = [{tuple(p) for p in np.floor(xyz / PLACE_M).astype(int).tolist()} for xyz in clouds]
            either = len(places[0] | places[1])
            share.append([100 * len(p) / either if either else np.nan for p in places])
            noise.append([1e3 * surface_noise_m(xyz) for xyz in clouds])
        elif len(files) == 1:
            share.append([np.nan, np.nan])
            noise.append([np.nan, 1e3 * surface_noise_m(read_ply(path).xyz_m)])
    columns = np.array([share, noise]).reshape(2, -1, 2)
    (a, b), (c, d) = ([finite_median(table[:, k]) for k in (0, 1)] for table in columns)
    return [
        Measure(group=SURFACE, name="coverage of the places that either measured", unit="%", published=a, default=b, better=HIGHER),
        Measure(
            group=SURFACE, name="noise of a point about the surface through its neighbours", unit="mm", published=c, default=d, better=LOWER
        ),
    ]


def surface_noise_m(xyz_m: np.ndarray) -> float:
    """Robust sigma [m] of points (N, 3) about quadrics through their nearest neighbours, themselves left out; NaN for fewer than 21."""
    from scipy.spatial import cKDTree

    if len(xyz_m) <= NEIGHBOURS:
        return float("nan")
    near = xyz_m[cKDTree(xyz_m).query(xyz_m, NEIGHBOURS + 1)[1][:, 1:]] - xyz_m[:, None]
    axes = np.linalg.svd(near - near.mean(axis=1, keepdims=True), full_matrices=False)[2]
    u, v, w = np.einsum("nki,nai->ank", near, axes)
    scale = np.maximum(np.sqrt(u**2 + v**2).max(axis=1, keepdims=True), 1e-9)
    u, v = u / scale, v / scale
    A = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    normal = np.einsum("nki,nkj->nij", A, A) + 1e-9 * np.eye(6)
    inverse = np.linalg.inv(normal)[:, 0]
    height = np.einsum("ni,nki,nk->n", inverse, A, w)  # of the quadric above the point
    return float(mad_sigma(height / np.sqrt(1 + inverse[:, 0]), 0))


def as_lines(measures: Sequence[Measure]) -> list[str]:
    """The measures as a table of text."""
    width = max(len(m.name) for m in measures)
    rows = [f"{'':<{width}}  {PUBLISHED:>10}  {DEFAULT:>10}"]
    return rows + [f"{m.name:<{width}}  {written(m.published):>10}  {written(m.default):>10}  {m.unit}" for m in measures]
