"""report/report.html: one self-contained page, and its pictures as files.

The page begins with what came out and what is doubtful; then come the figures of the papers, graphs, and at the end all numbers.
"""

import html
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..body.limb_words import limb_words, sentence
from ..body.motion import BodyFit
from ..body.skin.contour_skin import SkinSettings, body_skin
from ..body.skin.extremities import shape_with_ends
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..results.folder import Results
from ..results.run_json import notes_of
from ..surface.cloud import PointCloud
from ..take.footage import Footage
from ..tracking.trajectories import Trajectories
from . import film_strip, graphs, pictures
from .arrangement import arrangement, plan, words
from .body_pictures import BodyPictures
from .close_up import close_up
from .document import SCRIPT, document, figure, notes, table
from .figures import Row, figure_rows, figures_csv, number, quoted
from .film_strip import CELL_PX, Shot, chosen_frames
from .graphs import curve_graph
from .layers import kinds_shown, layers_picture
from .limb_strip import MEANING, limb_strip
from .loop_pictures import loop_words, outline_pictures
from .overview import WHY, about_joints, body_by_sigma, bone_sigma_mm, headline, verdict
from .patch_picture import MatchedPatch, patch_picture
from .person import SkinAt, coloured_skin, skin_in
from .silhouettes import Silhouettes
from .trails import VECTORS, longest_vectors, trail_pictures, vector_pictures

LIMBS = {"arm": ("clavicle", "shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle", "toe")}  # joints
LOOP = "The closed loop"
KINDS = {  # of pictures
    "Measured surface": ("patches", "surface", "cloud"),
    "Trajectories": ("tracks", "vectors", "trails"),
    "Body over the footage": ("body",),
    LOOP: ("outlines",),
    "Layers of the body": ("layers",),
}
BROAD = ("vectors",)  # two pictures of two panels
SINGLE = ("patches", "layers")  # one picture of several panels
DOT = 0.3  # radius of a measured point in a picture, by the distance of neighbouring points
AXES = "Axes of the camera: x to the right, y down, z away from it. Scales are those at the person's distance."
REST_AXES = "Axes: x to the person's left, z up."
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
    close_ups: bool = True  # pictures show the person as large as they can; otherwise whole images, for pages beside each other
    patch: MatchedPatch | None = None  # an example of matching
    colour_limits: Mapping[str, float] = field(default_factory=dict)  # upper ends of bars of colours, by picture; the others are its own


def write_report(results: Results, report: Report, monitor: Monitor, pictured: Sequence[int] = ()) -> None:
    """Write the page and its pictures, of the frames `pictured` (none: the first, a middle and the last).

    Cancelling leaves the report of the run before.
    """
    record, fits = report.record, report.silhouettes.fits
    trails = trail_pictures(results.path("trajectories_raw.npz"), report.footage.rig.cameras[report.footage.take.reference])
    skin_at = skin_in(results.path("skin"), report.body, SkinSettings(**record["settings"]["skin"]))
    chosen = [report.footage.frames.index(frame) for frame in sorted(set(pictured))] or _first_middle_last(report)
    limits = _colour_limits(report, chosen)
    limits |= {name: high for name, high in report.colour_limits.items() if name in limits}
    shown = _pictures(report, skin_at, monitor, chosen, limits) | {
        f"trails_{n}.png": trail for n, trail in zip(("all", "removed", "kept"), trails)
    }
    if report.trajectories is not None:
        tracks, camera = report.trajectories, report.footage.rig.cameras[report.footage.take.reference]
        longest = {name: limits[f"vectors_{name}.png"] for name in VECTORS if f"vectors_{name}.png" in limits}
        vectors = vector_pictures(tracks, camera, len(tracks.frames) // 2, longest)
        shown |= {f"vectors_{name}.png": picture for name, picture in vectors.items()}
    if loop_words(record["stages"]):
        shown |= outline_pictures(results, report.footage, report.trajectories, report.close_ups)
    if (patch := report.patch) is not None:
        names = [view.name for view in report.footage.take.views]
        shown[f"patches_{patch.frame:04d}.png"] = patch_picture(patch, report.footage.read_whole(patch.frame), names)
    shown |= _layers(report, results.path("skin"), skin_at)
    files: dict[str, tuple[str, bytes, bytes]] = {}
    for done, (name, (caption, picture)) in enumerate(shown.items()):
        monitor.step("report", len(shown) + done, 2 * len(shown))
        files[name] = (caption, pictures.png(picture), pictures.jpeg(picture))
    rows = figure_rows(record, report.clouds, report.trajectories, report.body, fits)
    small = {name: (caption, picture) for name, (caption, _, picture) in files.items()}
    page = _page(report, rows, small, _shots(report, skin_at, monitor))
    monitor.step("report", 1, 1)
    results.remove("report")
    for name, (_, data, _) in files.items():
        store.write_bytes(results.path("report", name), data)
    per_frame = [asdict(f) | {key: number(getattr(f, key)) for key in ("iou", "inside", "distance_px")} for f in fits]
    numbers = {"format": "tricap-report", "version": 1, **record, "figures": rows, "silhouettes": per_frame, "colour_limits": limits}
    store.write_json(results.path("report", "report.json"), numbers)
    store.write_text(results.path("report", "figures.csv"), figures_csv(rows))
    store.write_text(results.path("report", "report.html"), page)


def _colour_limits(report: Report, chosen: Sequence[int]) -> dict[str, float]:
    """The upper end of the bar of colours of every picture that has one; of the frames `chosen` (indices)."""
    limits, frames, tracks = dict[str, float](), report.footage.frames, report.trajectories
    for i in chosen:
        sigma = report.clouds[i].sigma_m
        if len(sigma):
            limits[f"surface_{frames[i]:04d}.png"] = 1e3 * float(np.percentile(sigma, 95))
        if tracks is not None and np.isfinite(fast := pictures.high_speed(tracks, i)):
            limits[f"tracks_{frames[i]:04d}.png"] = fast
    if tracks is not None:
        limits |= {f"vectors_{name}.png": high for name, high in longest_vectors(tracks, len(tracks.frames) // 2).items()}
    return limits


def _pictures(
    report: Report, skin_at: SkinAt | None, monitor: Monitor, chosen: Sequence[int], limits: Mapping[str, float]
) -> dict[str, tuple[str, np.ndarray]]:
    """File name → (caption, picture), for the frames `chosen` (indices). `limits`: upper ends of the bars of colours."""
    footage, clouds, trajectories = report.footage, report.clouds, report.trajectories
    ref = footage.take.reference
    camera, view = footage.rig.cameras[ref], footage.take.views[ref].name
    spacing = report.record["settings"]["growing"]["spacing_px"]
    found: dict[str, tuple[str, np.ndarray]] = {}
    near = close_up(camera, [clouds[i].xyz_m for i in chosen] if report.close_ups else [])
    bodies = BodyPictures(report.body, report.silhouettes, skin_at, footage.rig, chosen, near=report.close_ups)
    for n, i in enumerate(chosen):
        monitor.step("report", n, 2 * len(chosen))
        cloud = clouds[i]
        images, sigma, frame, part = footage.read_whole(cloud.frame), 1e3 * cloud.sigma_m, cloud.frame, near.around(cloud.xyz_m)
        name, grey = f"surface_{frame:04d}.png", part.image(images[ref])
        high = limits.get(name, float("nan"))
        at, radius = part.pixels(cloud.xy_px[:, ref]), max(1, round(DOT * spacing * part.scale))
        over = pictures.points_over_footage(grey, at, sigma, high, radius)
        caption = f"Frame {frame}, view {view}: {len(sigma):,} measured points, coloured by their sigma; red: {high:.2g} mm or more"
        found[f"surface_{frame:04d}.png"] = (
            caption,
            pictures.with_scale(over, part.camera, cloud.xyz_m, (high, "sigma, mm") if len(sigma) else None),
        )
        from_sides = pictures.cloud_views(cloud, camera, spacing)
        found[f"cloud_{frame:04d}.png"] = (f"Frame {frame}: the cloud from the reference camera and from its right side", from_sides)
        if trajectories is not None and trajectories.visible.any():
            caption = f"Frame {frame}, view {view}: the paths of the points over the last {pictures.TAIL_FRAMES} frames, coloured by speed"
            name = f"tracks_{frame:04d}.png"
            fast = limits.get(name, float("nan"))
            over = pictures.tracks_over_footage(grey, part.camera, trajectories, i, fast)
            found[name] = (caption, pictures.with_scale(over, part.camera, cloud.xyz_m, (fast, "speed, m/s")))
        found |= bodies.of_frame(i, images)
    return found


def _first_middle_last(report: Report) -> list[int]:
    """Indices of three frames; the middle one is near the middle, and one of those whose silhouettes were compared."""
    count, frames = len(report.clouds), report.footage.frames
    compared = {frames.index(fit.frame) for fit in report.silhouettes.fits if fit.frame in frames} or {count // 2}
    return sorted({0, min(sorted(compared), key=lambda i: abs(i - count // 2)), count - 1})


def _layers(report: Report, folder: Path, skin_at: SkinAt | None) -> dict[str, tuple[str, np.ndarray]]:
    """The picture of the body's layers; none without a skin. `folder`: that of the skin."""
    if report.body is None or skin_at is None:
        return {}
    shape, rest = report.body.shape, np.zeros(len(report.body.shape.skeleton.dofs))
    settings = SkinSettings(**report.record["settings"]["skin"])
    words = "The fitted body in its rest pose, from the front: skeleton; metaballs, each as the ellipsoid that it shows alone "
    caption = f"{words}({kinds_shown(shape)}); polygons of the surface that blends them; the finished skin"
    coloured = coloured_skin(folder, report.body, settings)
    caption += "" if coloured is None else "; the same with the colours of the footage"
    metaballs = body_skin(shape_with_ends(shape, settings), rest, settings)
    return {"layers.png": (caption, layers_picture(shape, metaballs, skin_at(rest), coloured))}


def _shots(report: Report, skin_at: SkinAt | None, monitor: Monitor) -> list[Shot]:
    """The body over the footage of the reference view, in frames all over the recording and in doubtful ones."""
    body, footage = report.body, report.footage
    if body is None or skin_at is None:
        return []
    k = footage.take.reference
    camera, frames = footage.rig.cameras[k], body.motion.frames.tolist()
    chosen, keys = chosen_frames(len(frames), [frames.index(frame) for frame in report.doubtful if frame in frames])
    about = [about_joints(camera, body.motion.joints_m[i]) for i in chosen]
    near = close_up(camera, about, CELL_PX)
    found = []
    for n, i in enumerate(chosen):
        monitor.step("report", len(chosen) + n, 2 * len(chosen))
        part = near.around(about[n])
        grey = part.image(footage.read_whole(frames[i])[k])
        picture = pictures.jpeg(body_by_sigma(grey, part.camera, skin_at(body.motion.values[i]), bone_sigma_mm(body, i)))
        reason = report.doubtful.get(frames[i], "")
        why = f": {WHY.get(reason, reason)}" if reason else ""
        found.append(Shot(frame=frames[i], caption=f"Frame {frames[i]}{why}", picture=picture, key=i in keys))
    return found


def _silhouette_graphs(silhouettes: Silhouettes) -> list[str]:
    """The overlap over the frames, all views in one graph."""
    fits, measure = silhouettes.fits, "IoU of the silhouette" if silhouettes.whole else "Share of the silhouette inside the person's"
    frames = sorted({f.frame for f in fits})
    curves = {f"view {view}": np.full(len(frames), np.nan) for view in dict.fromkeys(f.view for f in fits)}
    for fit in fits:
        curves[f"view {fit.view}"][frames.index(fit.frame)] = fit.overlap
    return [curve_graph(measure, "", np.array(frames), curves)] if curves else []


def _measurement_graphs(report: Report) -> list[str]:
    clouds, trajectories = report.clouds, report.trajectories
    rows = [(c.frame, len(c.xyz_m), finite_median(c.residual_px), 1e3 * finite_median(c.sigma_m)) for c in clouds]
    frames, points, residual, sigma = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    found = [
        curve_graph("Measured points", "", frames, {"points": points}),
        curve_graph("Residual of the rays (median)", "px", frames, {"residual": residual}),
        curve_graph("Sigma of the points (median)", "mm", frames, {"sigma": sigma}),
    ]
    if trajectories is not None:
        found.append(curve_graph("Tracked points", "", trajectories.frames, {"points": trajectories.visible.sum(axis=1).astype(float)}))
        for title, unit, vectors in (
            ("Speed of the tracked points", "m/s", trajectories.velocity_m_s),
            ("Acceleration of the tracked points", "m/s²", trajectories.acceleration_m_s2),
        ):
            found.append(curve_graph(title, unit, trajectories.frames, _typical(vectors)))
    return found


def _typical(vectors: np.ndarray) -> dict[str, np.ndarray]:
    """The median and the 95th percentile (T,) of the size of vectors (T, N, 3) in each frame; NaN in a frame without any."""
    found = np.full((2, len(vectors)), np.nan)
    for t, row in enumerate(vectors):
        size = np.linalg.norm(row, axis=1)
        size = size[np.isfinite(size)]
        if len(size):
            found[:, t] = np.percentile(size, [50, 95])
    return {"median": found[0], "95 %": found[1]}


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


def _page(report: Report, rows: Sequence[Row], files: Mapping[str, tuple[str, bytes]], shots: Sequence[Shot]) -> str:
    """The whole page. Names of the take, its views and its files are text, wherever they come from."""
    record, take = report.record, report.record["take"].rsplit("/", 1)[-1]
    sections = [
        *_picture_sections(files, loop_words(record["stages"])),
        ("Over time", _over_time(report)),
        ("All figures", _all_figures(record, rows)),
    ]
    if recorded := _recording(report):
        sections.insert(0, ("Cameras and person", recorded))
    links = " · ".join(f'<a href="#part{n}">{title}</a>' for n, (title, _) in enumerate(sections))
    body = (
        f'<h1>{html.escape(take)}</h1><p class="verdict"><b>{html.escape(headline(record, report.body, len(report.doubtful)))}</b> '
        f'{html.escape(verdict(record, report.body))}</p><p class="soft">{html.escape(_facts(record))}</p>'
        + notes([*notes_of(record), *record["warnings"]])
        + _first_screen(report, shots)
        + f"<nav>{links}</nav>"
        + "".join(f'<h2 id="part{n}">{title}</h2>{content}' for n, (title, content) in enumerate(sections))
    )
    return document(f"Tricap: {take}", body, f"{SCRIPT}{graphs.SCRIPT}{film_strip.SCRIPT}")


def _facts(record: Mapping[str, Any]) -> str:
    """What was recorded, in a line."""
    (first, end), fps, lines = record["frames"], record["fps"], record["interlaced"]
    how = "" if lines == "none" else f" · interlaced video, {'both fields' if lines == 'both' else f'its {lines} lines'}"
    views = f"{len(record['views'])} views ({', '.join(record['views'])})"
    span = f"frames {first} to {end - 1}, {(end - first) / fps:.2f} s at {fps:g} frames/s" if end - first > 1 else f"frame {first}"
    return f"{views} · {span}{how}"


def _first_screen(report: Report, shots: Sequence[Shot]) -> str:
    """The film of the body with the limbs beside it; the limbs alone for a body without a skin."""
    if report.body is None:
        return ""
    frames, words = report.body.motion.frames.tolist(), limb_words(report.body.motion.joint_names, report.body.motion.known)
    lines = "<br>".join(html.escape(sentence(limb, frames, row)) for limb, row in words.items())
    limbs = f'{limb_strip(frames, words)}<p class="soft">{MEANING}</p><p class="soft">{lines}</p>'
    if not shots:
        return limbs
    start = next((frame for frame in report.doubtful if frame in frames), frames[len(frames) // 2])
    return film_strip.film(shots, report.record["fps"], start, f"{film_strip.legend()}{limbs}")


def _recording(report: Report) -> str:
    """Cameras and person from above; "" if nothing was measured."""
    footage = report.footage
    shown = arrangement(footage.rig, footage.take.reference, report.clouds) if len(report.clouds) else None
    return f'<div class="first">{plan(shown)}<p>{html.escape(words(shown))}</p></div>' if shown else ""


def _picture_sections(files: Mapping[str, tuple[str, bytes]], loop: str) -> list[tuple[str, str]]:
    """Titles and pictures of the papers' figures; that of the closed loop begins with the words about it."""
    found = {
        kind: [figure(*files[name]) for name in files if name.startswith((f"{kind}_", f"{kind}."))] for kind in sum(KINDS.values(), ())
    }
    sections = list[tuple[str, str]]()
    for title, kinds in KINDS.items():
        content = "".join(_picture_row(kind, found[kind]) for kind in kinds if found[kind])
        axes = f'<p class="soft">{REST_AXES if "layers" in kinds else AXES}</p>' if content else ""
        said = f"<p>{html.escape(loop)}</p>" if title == LOOP and loop else ""
        if content or said:
            sections.append((title, f"{said}{content}{axes}"))
    return sections


def _over_time(report: Report) -> str:
    """The graphs, those of limbs folded."""
    limbs = "".join(_folded(limb, _grid(curves)) for limb, curves in _limb_graphs(report).items() if any(curves))
    curves = _grid(_measurement_graphs(report) + _silhouette_graphs(report.silhouettes))
    return (
        '<p class="soft">Point at a curve to read it, drag over a range to enlarge it, double-click to see all. Bands: one sigma. Dashed: '
        f"limits of the joint, and frames with clicks.</p>{curves}{limbs}"
    )


def _all_figures(record: Mapping[str, Any], rows: Sequence[Row]) -> str:
    settings = "\n".join(f"[{group}] " + ", ".join(f"{k} = {v}" for k, v in table.items()) for group, table in record["settings"].items())
    stages = "".join(f"<tr><th>{html.escape(stage)}</th><td>{_figures(figures)}</td></tr>" for stage, figures in record["stages"].items())
    return (
        _folded("Figures (also in report.json and figures.csv)", _quotable(rows))
        + _folded("Stages", f'<div class="wide"><table>{stages}</table></div>')
        + _folded("To repeat it", f"<pre>{html.escape(str(record.get('repeat', '')))}</pre>")
        + _folded("Settings", f"<pre>{html.escape(settings)}</pre>")
    )


def _picture_row(kind: str, figures: Sequence[str]) -> str:
    """Figures beside each other; those that have several panels are wider."""
    width = "single" if kind in SINGLE else "broad" if kind in BROAD or len(figures) < 3 else ""
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
