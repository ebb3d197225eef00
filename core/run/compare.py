"""`tricap compare`: one take with the published and with the default method, and the same measures of both side by side.

Each method is a run of its own, in DIR/published and DIR/default, and resumes as any run does. The measures are computed from the files
that both wrote, not from what a method reports about itself, except for times and sigmas.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.bounded import real_path
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median, mad_sigma
from ..motion.formats.ply import read_ply
from ..report.comparison import DEFAULT, HIGHER, LOWER, METHODS, NEITHER, PUBLISHED, Measure, comparison_page, written
from ..results.folder import Results, check_inside, check_separate_folder
from . import pipeline
from .settings import Overrides
from .take_run import open_run

PLACE_M = 0.02  # edge of the cubes in which coverage is counted
SURFACE, TRACKS, BODY, TIME = "Surface", "Trajectories", "Body", "Time"  # groups of measures
NEIGHBOURS = 20  # through which a quadric is fitted, for the noise


def run_both(
    take: Path, out: Path, overrides: Overrides, frames: tuple[int, int] | None, monitor: Monitor, *, restart: bool = False
) -> tuple[list[Path], list[str]]:
    """Run both methods; the folders of their results, in the order of `METHODS`, and what the user should know of them.

    Raises:
        InputError: see `pipeline.run`; or the overrides choose a preset, or one of the folders is a link out of `out`.
        Cancelled: what is done is kept.
    """
    check_separate_folder(out)
    for method in METHODS:
        check_inside(real_path(out) / method, real_path(out))
    if "preset" in overrides.get("method", {}):
        raise InputError("A comparison runs both presets; leave out --preset.")
    notes = []
    for method in METHODS:
        with open_run(take, out / method, {**overrides, "method": {"preset": method}}, frames, restart=restart) as run:
            if not pipeline.is_complete(run):
                monitor.begin(method)
                run.close_ups = False  # the same part of the images in both reports
                pipeline.all_stages(run, monitor)
            notes += run.notes
    return [out / method for method in METHODS], notes


def measures_of(folders: Sequence[Path], monitor: Monitor) -> list[Measure]:
    """The measures that need no truth, of two results."""
    return [*_of_clouds(folders, monitor), *_of_runs([Results(f).read_run() for f in folders])]


def write_comparison(out: Path, take: Path, folders: Sequence[Path], measures: Sequence[Measure]) -> None:
    """Write DIR/compare.json and DIR/compare.html."""
    rows = [as_row(measure) for measure in measures]
    store.write_json(out / "compare.json", {"format": "tricap-comparison", "version": 1, "take": str(take), "measures": rows})
    store.write_text(out / "compare.html", comparison_page(real_path(take).name, measures, folders))


def as_row(measure: Measure) -> dict[str, Any]:
    """A measure for JSON."""
    return asdict(measure) | {"winner": measure.winner}


def _of_runs(runs: Sequence[dict[str, Any]]) -> list[Measure]:
    """The measures in two run.json. A constraint makes residuals small by definition, and the methods track points of other spacings."""

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
        (TIME, "duration of all stages", "s", LOWER, lambda s: sum(stage.get("seconds", 0.0) for stage in s.values())),
    )
    values = [[float(v) if (v := of(run["stages"])) is not None else float("nan") for run in runs] for *_, of in wanted]
    return [Measure(group=g, name=n, unit=u, published=a, default=b, better=c) for (g, n, u, c, _), (a, b) in zip(wanted, values)]


def _of_clouds(folders: Sequence[Path], monitor: Monitor) -> list[Measure]:
    """Coverage and noise of the written clouds, measured in the same way in both."""
    paths = sorted((folders[0] / "clouds").glob("*.ply"))
    share, noise = [], []
    for i, path in enumerate(paths):
        monitor.step("compare", i, len(paths))
        other = folders[1] / "clouds" / path.name
        if other.is_file():
            clouds = [read_ply(p).xyz_m for p in (path, other)]
            places = [{tuple(p) for p in np.floor(xyz / PLACE_M).astype(int).tolist()} for xyz in clouds]
            either = len(places[0] | places[1])
            share.append([100 * len(p) / either if either else np.nan for p in places])
            noise.append([1e3 * surface_noise_m(xyz) for xyz in clouds])
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
