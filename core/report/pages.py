"""report/report.html: one self-contained page, and its pictures as files.

The page begins with what came out and what is doubtful; then come the figures of the papers, graphs, and at the end all numbers.
"""

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..body.limb_words import limb_words, sentence
from ..body.motion import BodyFit
from ..body.skin.contour_skin import SkinSettings, body_skin
from ..body.skin.extremities import shape_with_ends
from ..body.skin.mesh import Skin
from ..body.skin.posed import skins_in
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..results.folder import Results
from ..surface.cloud import PointCloud
from ..take.footage import Footage
from ..tracking.trajectories import Trajectories
from . import pictures
from .document import document, figure, notes, table
from .figures import Row, figure_rows, figures_csv, number, quoted
from .graphs import SCRIPT, curve_graph
from .layers import kinds_shown, layers_picture
from .limb_strip import MEANING, limb_strip
from .overview import LEGEND, body_by_sigma, bone_sigma_mm, strip_frames, verdict, window_px
from .silhouettes import OUTLINE, PERSON, Silhouettes
from .trails import trail_pictures, vector_pictures

LIMBS = {"arm": ("clavicle", "shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle", "toe")}  # joints
KINDS = {  # of pictures
    "Measured surface": ("surface", "cloud"),
    "Trajectories": ("tracks", "vectors", "trails"),
    "Body over the footage": ("body",),
    "Layers of the body": ("layers",),
}
BROAD = ("cloud", "vectors", "trails")  # of two panels
AXES = "Axes of the reference camera: x to the right, y down, z away from it. In the rest pose: x to the person's left, z up."
SIDES = {"L": "Left", "R": "Right"}
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
    doubtful: Mapping[int, str] = field(default_factory=dict)  # frame -> why, the worst first


def write_report(results: Results, report: Report, monitor: Monitor, pictured: Sequence[int] = ()) -> None:
    """Write the page and its pictures, of the frames `pictured` (none: the first, a middle and the last).

    Cancelling leaves the report of the run before.
    """
    record, fits = report.record, report.silhouettes.fits
    trails = trail_pictures(results.path("trajectories_raw.npz"), report.footage.rig.cameras[report.footage.take.reference])
    skin_at = _skin(report)
    shown = _pictures(report, monitor, pictured, skinned=skin_at is not None) | {
        f"trails_{n}.png": trail for n, trail in zip(("all", "removed", "kept"), trails)
    }
    if report.trajectories is not None:
        tracks, camera = report.trajectories, report.footage.rig.cameras[report.footage.take.reference]
        vectors = vector_pictures(tracks, camera, len(tracks.frames) // 2)
        shown |= {f"vectors_{name}.png": picture for name, picture in zip(("velocity", "acceleration"), vectors)}
    shown |= _layers(report, skin_at)
    files: dict[str, tuple[str, bytes, bytes]] = {}
    for done, (name, (caption, picture)) in enumerate(shown.items()):
        monitor.step("report", len(shown) + done, 2 * len(shown))
        files[name] = (caption, pictures.png(picture), pictures.jpeg(picture))
    rows = figure_rows(record, report.clouds, report.trajectories, report.body, fits)
    small = {name: (caption, picture) for name, (caption, _, picture) in files.items()}
    page = _page(report, rows, small, _strip(report, skin_at, monitor))
    monitor.step("report", 1, 1)
    results.remove("report")
    for name, (_, data, _) in files.items():
        store.write_bytes(results.path("report", name), data)
    per_frame = [asdict(f) | {key: number(getattr(f, key)) for key in ("iou", "inside", "distance_px")} for f in fits]
    numbers = {"format": "tricap-report", "version": 1, **record, "figures": rows, "silhouettes": per_frame}
    store.write_json(results.path("report", "report.json"), numbers)
    store.write_text(results.path("report", "figures.csv"), figures_csv(rows))
    store.write_text(results.path("report", "report.html"), page)


def _skin(report: Report) -> Callable[[np.ndarray], Skin] | None:
    """The skin in a pose; None without a body, or for a body without a skin, of which the run has warned."""
    if report.body is None:
        return None
    settings = SkinSettings(**report.record["settings"]["skin"])
    try:
        return skins_in(shape_with_ends(report.body.shape, settings), report.body.motion.values, settings)
    except InputError:
        return None


def _pictures(report: Report, monitor: Monitor, pictured: Sequence[int], *, skinned: bool) -> dict[str, tuple[str, np.ndarray]]:
    """File name → (caption, picture), for the frames `pictured`, or the first, a middle and the last."""
    footage, record, clouds, trajectories = report.footage, report.record, report.clouds, report.trajectories
    body, silhouettes = report.body, report.silhouettes
    ref = footage.take.reference
    camera, view = footage.rig.cameras[ref], footage.take.views[ref].name
    settings = SkinSettings(**record["settings"]["skin"])
    found: dict[str, tuple[str, np.ndarray]] = {}
    chosen = [footage.frames.index(frame) for frame in sorted(set(pictured))] or _first_middle_last(report)
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
        add(f"surface_{frame:04d}.png", f"Frame {frame}, view {view}: {measured}", pictures.with_scale(on_image, camera, cloud.xyz_m))
        from_sides = pictures.cloud_views(cloud, camera, record["settings"]["growing"]["spacing_px"])
        add(f"cloud_{frame:04d}.png", f"Frame {frame}: the cloud from the front and from its right side", from_sides)
        if trajectories is not None:
            caption = f"Frame {frame}, view {view}: trajectories of the last {pictures.TAIL_FRAMES} frames, red is fast"
            on_image = pictures.tracks_over_footage(images[ref], camera, trajectories, i)
            add(f"tracks_{frame:04d}.png", caption, pictures.with_scale(on_image, camera, cloud.xyz_m))
        if body is not None and skinned:
            skin = body_skin(shape_with_ends(body.shape, settings), body.motion.values[i], settings)  # exact, as the silhouettes' figures
            for image, cam, name in zip(images, footage.rig.cameras, (v.name for v in footage.take.views)):
                person = silhouettes.outlines.get(name, {}).get(frame)
                picture = pictures.body_over_footage(image, cam, body.shape, body.motion.values[i], skin, person)
                pictures.with_scale(picture, cam, body.motion.joints_m[i])
                agreement = _agreement_caption(silhouettes, name, frame)
                add(f"body_{frame:04d}_{name}.png", f"Frame {frame}, view {name}: the fitted body{agreement}", picture)
    return found


def _first_middle_last(report: Report) -> list[int]:
    """Indices of three frames; the middle one is near the middle, and one of those whose silhouettes were compared."""
    count, frames = len(report.clouds), report.footage.frames
    compared = {frames.index(fit.frame) for fit in report.silhouettes.fits if fit.frame in frames} or {count // 2}
    return sorted({0, min(sorted(compared), key=lambda i: abs(i - count // 2)), count - 1})


def _layers(report: Report, skin_at: Callable[[np.ndarray], Skin] | None) -> dict[str, tuple[str, np.ndarray]]:
    """The picture of the body's layers; none without a skin."""
    if report.body is None or skin_at is None:
        return {}
    shape = report.body.shape
    rest = skin_at(np.zeros(len(shape.skeleton.dofs)))
    words = "The fitted body in its rest pose, from the front: skeleton; metaballs, each as the ellipsoid that it shows alone "
    caption = f"{words}({kinds_shown(shape)}); polygons of the skin that blends them; the skin shaded"
    return {"layers.png": (caption, layers_picture(shape, rest))}


def _agreement_caption(silhouettes: Silhouettes, view: str, frame: int) -> str:
    """The silhouette's part of a caption."""
    found = [f for f in silhouettes.fits if (f.view, f.frame) == (view, frame)]
    if not found:
        return ""
    drawn = " (red)" if found[0].person == OUTLINE else ""
    fit = found[0]
    agreement = f"IoU {fit.iou:.3f} with" if silhouettes.whole else f"{100 * fit.inside:.1f} % of it inside"
    return f" and its outline (green); {agreement} {PERSON[fit.person]}{drawn}"


def _strip(report: Report, skin_at: Callable[[np.ndarray], Skin] | None, monitor: Monitor) -> list[tuple[str, bytes]]:
    """Captions and pictures of the body over the footage of the reference view, in frames all over the recording and in doubtful ones."""
    body, footage = report.body, report.footage
    if body is None or skin_at is None:
        return []
    k = footage.take.reference
    camera, frames = footage.rig.cameras[k], body.motion.frames.tolist()
    chosen = strip_frames(len(frames), [frames.index(frame) for frame in report.doubtful if frame in frames])
    found = []
    for i in chosen:
        monitor.step("report", 1, 2)
        centre, grey = camera.project(body.motion.joints_m[i]), footage.read(frames[i])[k]
        middle = 0.5 * (np.nanmin(centre, axis=0) + np.nanmax(centre, axis=0))
        skin, side = skin_at(body.motion.values[i]), window_px(camera, body.motion.joints_m[i])
        picture = body_by_sigma(grey, camera, skin, bone_sigma_mm(body, i), middle, side)
        why = f": {report.doubtful[frames[i]]}" if frames[i] in report.doubtful else ""
        found.append((f"Frame {frames[i]}{why}", pictures.jpeg(picture)))
    return found


def _silhouette_graphs(silhouettes: Silhouettes) -> list[str]:
    """The overlap over the frames, view by view."""
    fits, measure = silhouettes.fits, "IoU of the silhouette" if silhouettes.whole else "Share of the silhouette inside the person's"
    views = list(dict.fromkeys(f.view for f in fits))
    tables = {view: np.array([(f.frame, f.overlap) for f in fits if f.view == view]) for view in views}
    return [curve_graph(f"{measure}, view {view}", "", t[:, 0].astype(int), {view: t[:, 1]}) for view, t in tables.items()]


def _measurement_graphs(report: Report) -> list[str]:
    clouds, trajectories = report.clouds, report.trajectories
    rows = [(c.frame, len(c.xyz_m), finite_median(c.residual_px), 1e3 * finite_median(c.sigma_m)) for c in clouds]
    frames, points, residual, sigma = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    graphs = [
        curve_graph("Measured points", "", frames, {"points": points}),
        curve_graph("Residual of the rays (median)", "px", frames, {"residual": residual}),
        curve_graph("Sigma of the points (median)", "mm", frames, {"sigma": sigma}),
    ]
    if trajectories is not None:
        graphs.append(curve_graph("Tracked points", "", trajectories.frames, {"points": trajectories.visible.sum(axis=1).astype(float)}))
        for title, unit, vectors in (
            ("Speed of the tracked points: median (red), 95 % (blue)", "m/s", trajectories.velocity_m_s),
            ("Acceleration of the tracked points: median (red), 95 % (blue)", "m/s²", trajectories.acceleration_m_s2),
        ):
            graphs.append(curve_graph(title, unit, trajectories.frames, _typical(vectors)))
    return graphs


def _typical(vectors: np.ndarray) -> dict[str, np.ndarray]:
    """The median and the 95th percentile (T,) of the size of vectors (T, N, 3) in each frame; NaN in a frame without any."""
    found = np.full((2, len(vectors)), np.nan)
    for t, row in enumerate(vectors):
        size = np.linalg.norm(row, axis=1)
        size = size[np.isfinite(size)]
        if len(size):
            found[:, t] = np.percentile(size, [50, 95])
    return {"median": found[0], "95 %": found[1]}


def _limbs(body: BodyFit | None) -> str:
    """In which frames each limb was seen, inferred or guessed."""
    if body is None:
        return ""
    frames, words = body.motion.frames.tolist(), limb_words(body.motion.joint_names, body.motion.known)
    lines = "<br>".join(html.escape(sentence(limb, frames, row)) for limb, row in words.items())
    return f'<h2>Limbs</h2>{limb_strip(frames, words)}<p class="soft">{MEANING}</p><p class="soft">{lines}</p>'


def _limb_graphs(report: Report) -> dict[str, list[str]]:
    """The degrees of freedom over the frames with a band of one sigma, by limb; dashed: limits of the joint, frames with clicks."""
    body = report.body
    if body is None:
        return {}
    take, motion, base = report.footage.take, body.motion, set(body.shape.skeleton.layout.group("base").tolist())
    marks = [k.frame for k in (take.clicks, *take.keyframes) if k.joints]
    graphs: dict[str, list[str]] = {}
    for i, dof in enumerate(body.shape.skeleton.dofs):
        name, metres = motion.dof_names[i], i in base and motion.dof_names[i].rpartition(" ")[2] in ("x", "y", "z")
        values, sigma, limits = motion.values[:, i], motion.sigma[:, i], np.array(dof.limits)
        if not metres:
            values, sigma, limits = np.degrees(values), np.degrees(sigma), np.degrees(limits)
        limit = (float(limits[0]), float(limits[1])) if i not in base else (-np.inf, np.inf)
        graph = curve_graph(name, "m" if metres else "°", motion.frames, {name: values}, sigma, limits=limit, marks=marks)
        graphs.setdefault("Place and direction of the body" if i in base else limb_of(name), []).append(graph)
    return graphs


def limb_of(dof: str) -> str:
    """The limb of a degree of freedom, by its joint: "elbow.R flexion" -> "Right arm"."""
    joint, _, side = dof.partition(" ")[0].partition(".")
    limb = next((limb for limb, joints in LIMBS.items() if joint in joints), "")
    return f"{SIDES[side]} {limb}" if limb and side in SIDES else "Trunk and head"


def _page(report: Report, rows: Sequence[Row], files: Mapping[str, tuple[str, bytes]], strip: Sequence[tuple[str, bytes]]) -> str:
    """The whole page. Names of the take, its views and its files are text, wherever they come from."""
    record, take = report.record, html.escape(report.record["take"].rsplit("/", 1)[-1])
    facts = (
        f"{len(record['views'])} views ({', '.join(record['views'])}), frames {record['frames'][0]} to {record['frames'][1] - 1}, "
        f"{record['fps']:g} frames/s, interlaced: {record['interlaced']}"
    )
    cells = "".join(figure(caption, picture) for caption, picture in strip)
    found = {
        kind: [figure(*files[name]) for name in files if name.startswith((f"{kind}_", f"{kind}."))] for kind in sum(KINDS.values(), ())
    }
    shown = "".join(
        f"<h2>{title}</h2>{''.join(_picture_row(kind, found[kind]) for kind in kinds if found[kind])}"
        for title, kinds in KINDS.items()
        if any(found[kind] for kind in kinds)
    )
    limbs = "".join(_folded(limb, _grid(graphs)) for limb, graphs in _limb_graphs(report).items() if any(graphs))
    settings = "\n".join(f"[{group}] " + ", ".join(f"{k} = {v}" for k, v in table.items()) for group, table in record["settings"].items())
    graphs = _grid(_measurement_graphs(report) + _silhouette_graphs(report.silhouettes))
    stages = "".join(f"<tr><th>{html.escape(stage)}</th><td>{_figures(figures)}</td></tr>" for stage, figures in record["stages"].items())
    body = (
        f'<h1>{take}</h1><p class="verdict">{html.escape(verdict(record, report.body, len(report.doubtful)))}</p>'
        f'<p class="soft">{html.escape(facts)}</p>'
        + (f'<div class="row cells">{cells}</div><p class="soft">{LEGEND}</p>' if cells else "")
        + notes([*filter(None, [record.get("reference_note")]), *record["warnings"]])
        + _limbs(report.body)
        + f'{shown}<p class="soft">{AXES}</p><h2>Over time</h2><p class="soft">Point at a curve to read it, drag over '
        "a range to enlarge it, double-click to see all. Bands: one sigma. Dashed: limits of the joint, and frames with clicks.</p>"
        f"{graphs}{limbs}<h2>All figures</h2>"
        + _folded("Figures (also in report.json and figures.csv)", _quotable(rows))
        + _folded("Stages", f"<table>{stages}</table>")
        + _folded("To repeat it", f"<pre>{html.escape(str(record.get('repeat', '')))}</pre>")
        + _folded("Settings", f"<pre>{html.escape(settings)}</pre>")
    )
    return document(f"Tricap: {report.record['take'].rsplit('/', 1)[-1]}", body, SCRIPT)


def _picture_row(kind: str, figures: Sequence[str]) -> str:
    """Figures beside each other; those that have two or four panels are wider."""
    width = "single" if len(figures) == 1 else "broad" if kind in BROAD else ""
    return f'<div class="row {width}">{"".join(figures)}</div>'


def _grid(graphs: Sequence[str]) -> str:
    return f'<div class="row graphs">{"".join(graphs)}</div>'


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def _quotable(rows: Sequence[Row]) -> str:
    """The table of the figures."""
    cells = []
    for row in rows:
        value, sigma = quoted(row["value"], row["sigma"])
        cells.append([html.escape(row["name"]), value, f"± {sigma}", html.escape(row["unit"]), html.escape(row["sigma_of"])])
    return table(["", "value", "sigma", "unit", "the sigma is"], cells)


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
