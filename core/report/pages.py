"""report/report.html: one self-contained page, and its pictures as files."""

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..body.motion import BodyFit
from ..body.skin.contour_skin import SkinSettings, body_skin
from ..body.skin.extremities import shape_for_skin
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..results.folder import Results
from ..surface.cloud import PointCloud
from ..take.footage import Footage
from ..tracking.trajectories import Trajectories
from . import pictures
from .figures import Row, curve_graph, figure_rows, number, quoted
from .silhouettes import OUTLINE, PERSON, Silhouettes

STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}img,svg{max-width:100%}"
    "table{border-collapse:collapse}td,th{padding:.2em .8em;text-align:left;border-bottom:1px solid #ddd}"
    ".note{background:#fff3d0;padding:.4em .8em}pre{white-space:pre-wrap}"
)
LABELS = {
    "points_per_frame": "points a frame",
    "residual_px": "residual of the rays [px], median",
    "sigma_mm": "sigma of a position [mm], median",
    "joint_sigma_mm": "sigma of a joint's coordinate [mm], median",
    "outline_mm": "outlines from the body [mm], median",
    "mean_length_frames": "mean length [frames]",
}


def check_pictured(frames: range, wanted: Sequence[int]) -> None:
    """Check that all frames of the report's pictures exist.

    Raises:
        InputError: one does not.
    """
    for frame in wanted:
        if frame not in frames:
            raise InputError(f"--pictures {frame} is not among the frames {frames.start} to {frames.stop - 1}; choose others.")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Report:
    """A run as its report shows it: the record of the run, and its results."""

    footage: Footage
    record: Mapping[str, Any]
    clouds: Sequence[PointCloud]
    trajectories: Trajectories | None
    body: BodyFit | None
    silhouettes: Silhouettes


def write_report(results: Results, report: Report, monitor: Monitor, pictured: Sequence[int] = ()) -> None:
    """Write the page and its pictures, of the frames `pictured` (none: the first, a middle and the last).

    Cancelling leaves the report of the run before.
    """
    record, fits = report.record, report.silhouettes.fits
    shown = _pictures(report, monitor, pictured)
    files: dict[str, tuple[str, bytes, bytes]] = {}
    for done, (name, (caption, picture)) in enumerate(shown.items()):
        monitor.step("report", len(shown) + done, 2 * len(shown))
        files[name] = (caption, pictures.png(picture), pictures.jpeg(picture))
    rows = figure_rows(record, report.clouds, report.trajectories, report.body, fits)
    small = {name: (caption, picture) for name, (caption, _, picture) in files.items()}
    page = _page(record, rows, small, _graphs(report) + _silhouette_graphs(report.silhouettes))
    monitor.step("report", 1, 1)
    results.remove("report")
    for name, (_, data, _) in files.items():
        store.write_bytes(results.path("report", name), data)
    per_frame = [asdict(f) | {key: number(getattr(f, key)) for key in ("iou", "inside", "distance_px")} for f in fits]
    table = {"format": "tricap-report", "version": 1, **record, "figures": rows, "silhouettes": per_frame}
    store.write_json(results.path("report", "report.json"), table)
    store.write_text(results.path("report", "report.html"), page)


def _pictures(report: Report, monitor: Monitor, pictured: Sequence[int]) -> dict[str, tuple[str, np.ndarray]]:
    """File name → (caption, picture), for the frames `pictured`, or the first, a middle and the last."""
    footage, record, clouds, trajectories = report.footage, report.record, report.clouds, report.trajectories
    body, silhouettes = report.body, report.silhouettes
    ref = footage.take.reference
    camera, view = footage.rig.cameras[ref], footage.take.views[ref].name
    settings = SkinSettings(**record["settings"]["skin"])
    found: dict[str, tuple[str, np.ndarray]] = {}
    chosen = [footage.frames.index(frame) for frame in sorted(set(pictured))] or sorted({0, len(clouds) // 2, len(clouds) - 1})
    total = 2 * len(chosen) * (3 + len(footage.rig.cameras))

    def add(name: str, caption: str, picture: np.ndarray) -> None:
        found[name] = (caption, picture)
        monitor.step("report", len(found), total)

    for i in chosen:
        cloud = clouds[i]
        images, sigma, frame = footage.read(cloud.frame), 1e3 * cloud.sigma_m, cloud.frame
        high = float(np.percentile(sigma, 95)) if len(sigma) else 1.0
        measured = f"{len(sigma)} measured points, sigma from 0 (blue) to {high:.2f} mm (red)"
        on_image = pictures.points_over_footage(images[ref], cloud.xy_px[:, ref], sigma, 0.0, high)
        add(f"surface_{frame:04d}.png", f"Frame {frame}, view {view}: {measured}", on_image)
        from_sides = pictures.cloud_views(cloud, camera, record["settings"]["growing"]["spacing_px"])
        add(f"cloud_{frame:04d}.png", f"Frame {frame}: the cloud from the front and from its right side", from_sides)
        if trajectories is not None:
            caption = f"Frame {frame}, view {view}: trajectories of the last {pictures.TAIL_FRAMES} frames, red is fast"
            add(f"tracks_{frame:04d}.png", caption, pictures.tracks_over_footage(images[ref], camera, trajectories, i))
        if body is not None:
            skin = body_skin(shape_for_skin(body.shape, settings), body.motion.values[i], settings)
            for image, cam, name in zip(images, footage.rig.cameras, (v.name for v in footage.take.views)):
                person = silhouettes.outlines.get(name, {}).get(frame)
                picture = pictures.body_over_footage(image, cam, body.shape, body.motion.values[i], skin, person)
                agreement = _agreement_caption(silhouettes, name, frame)
                add(f"body_{frame:04d}_{name}.png", f"Frame {frame}, view {name}: the fitted body{agreement}", picture)
    return found


def _agreement_caption(silhouettes: Silhouettes, view: str, frame: int) -> str:
    """The silhouette's part of a caption."""
    found = [f for f in silhouettes.fits if (f.view, f.frame) == (view, frame)]
    if not found:
        return ""
    drawn = " (red)" if found[0].person == OUTLINE else ""
    fit = found[0]
    agreement = f"IoU {fit.iou:.3f} with" if silhouettes.whole else f"{100 * fit.inside:.1f} % of it inside"
    return f" and its outline (green); {agreement} {PERSON[fit.person]}{drawn}"


def _silhouette_graphs(silhouettes: Silhouettes) -> list[str]:
    """The overlap over the frames, view by view."""
    fits, measure = silhouettes.fits, "IoU of the silhouette" if silhouettes.whole else "Share of the silhouette inside the person's"
    views = list(dict.fromkeys(f.view for f in fits))
    tables = {view: np.array([(f.frame, f.overlap) for f in fits if f.view == view]) for view in views}
    return [curve_graph(f"{measure}, view {view}", "", t[:, 0].astype(int), {view: t[:, 1]}) for view, t in tables.items()]


def _graphs(report: Report) -> list[str]:
    clouds, trajectories, body = report.clouds, report.trajectories, report.body
    rows = [(c.frame, len(c.xyz_m), finite_median(c.residual_px), 1e3 * finite_median(c.sigma_m)) for c in clouds]
    frames, points, residual, sigma = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    graphs = [
        curve_graph("Measured points", "", frames, {"points": points}),
        curve_graph("Residual of the rays (median)", "px", frames, {"residual": residual}),
        curve_graph("Sigma of the points (median)", "mm", frames, {"sigma": sigma}),
    ]
    if trajectories is not None:
        graphs.append(curve_graph("Tracked points", "", trajectories.frames, {"points": trajectories.visible.sum(axis=1).astype(float)}))
    if body is not None:
        angles = [i for i, dof in enumerate(body.shape.skeleton.dofs) if i not in set(body.shape.skeleton.layout.group("base").tolist())]
        for i in angles:
            name = body.motion.dof_names[i]
            graphs.append(
                curve_graph(
                    name, "°", body.motion.frames, {name: np.degrees(body.motion.values[:, i])}, np.degrees(body.motion.sigma[:, i])
                )
            )
    return graphs


def _page(record: Mapping[str, Any], rows: Sequence[Row], files: Mapping[str, tuple[str, bytes]], graphs: Sequence[str]) -> str:
    notes = "".join(f'<p class="note">{html.escape(w)}</p>' for w in record["warnings"])
    stages = "".join(f"<tr><th>{html.escape(stage)}</th><td>{_figures(figures)}</td></tr>" for stage, figures in record["stages"].items())
    shown = "".join(
        f'<figure><img alt="" src="data:image/jpeg;base64,{base64.b64encode(small).decode()}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, small in files.values()
    )
    settings = html.escape(
        "\n".join(f"[{group}] " + ", ".join(f"{k} = {v}" for k, v in table.items()) for group, table in record["settings"].items())
    )
    repeat = html.escape(str(record.get("repeat", "")))
    take = html.escape(record["take"].rsplit("/", 1)[-1])
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Tricap: {take}</title><style>{STYLE}</style><h1>{take}</h1>'
        f"<p>{len(record['views'])} views ({html.escape(', '.join(record['views']))}), "
        f"frames {record['frames'][0]} to {record['frames'][1] - 1}, {record['fps']:g} frames/s, "
        f"interlaced: {record['interlaced']}</p>{notes}<h2>Figures</h2>{_quotable(rows)}<h2>Stages</h2><table>{stages}</table>"
        f"<h2>Over time</h2>{''.join(graphs)}<h2>Pictures</h2>{shown}"
        f"<h2>To repeat it</h2><pre>{repeat}</pre><h2>Settings</h2><pre>{settings}</pre></html>\n"
    )


def _quotable(rows: Sequence[Row]) -> str:
    """The table of the figures."""
    cells = []
    for row in rows:
        value, sigma = quoted(row["value"], row["sigma"])
        texts = (value, f"± {sigma}", row["unit"], row["sigma_of"])
        cells.append(f"<tr><th>{html.escape(row['name'])}</th>{''.join(f'<td>{t}</td>' for t in texts)}</tr>")
    return f"<table><tr><th></th><th>value</th><th>sigma</th><th>unit</th><th>the sigma is</th></tr>{''.join(cells)}</table>"


def _figures(figures: Mapping[str, Any]) -> str:
    rows = []
    for name, value in figures.items():
        if isinstance(value, dict) and any(isinstance(v, dict) for v in value.values()):
            continue  # a table of its own among the figures
        text = (
            f"{value:.3g}" if isinstance(value, float) and abs(value) < 1000 else f"{value:.0f}" if isinstance(value, float) else str(value)
        )
        rows.append(f"{html.escape(LABELS.get(name, name.replace('_', ' ')))}: {html.escape(text)}")
    return "; ".join(rows)
