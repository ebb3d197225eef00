"""The figures of a run: name, value, sigma, unit. For people in report.html, for programs in report.json and figures.csv."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..body.motion import BodyFit
from ..surface.cloud import PointCloud
from ..tracking.trajectories import Trajectories
from .silhouettes import PERSON, SilhouetteFit

FRAME_TO_FRAME = "scatter from frame to frame"
ESTIMATED = "from the adjustment"
Row = dict[str, Any]


def figure_rows(
    record: Mapping[str, Any],
    clouds: Sequence[PointCloud],
    trajectories: Trajectories | None,
    body: BodyFit | None,
    silhouettes: Sequence[SilhouetteFit] = (),
) -> list[Row]:
    """The rows; `sigma_of` is the origin of each sigma. NaN, where there is none, becomes null in the file."""
    points, residual_px, sigma_mm = list[float](), list[float](), list[float]()
    for cloud in clouds:  # read once: each is in a file
        points.append(float(len(cloud.xyz_m)))
        if len(cloud.xyz_m):
            residual_px.append(float(np.median(cloud.residual_px)))
            sigma_mm.append(1e3 * float(np.median(cloud.sigma_m)))
    per_frame = {
        ("points a frame", "points"): points,
        ("residual of the rays (median)", "px"): residual_px,
        ("sigma of a point (median)", "mm"): sigma_mm,
    }
    if trajectories is not None:
        per_frame["tracked points a frame", "points"] = trajectories.visible.sum(axis=1).astype(float).tolist()
    rows = [_row(name, float(np.median(v)), float(np.std(v)), unit, FRAME_TO_FRAME) for (name, unit), v in per_frame.items() if v]
    for view, offset in record.get("offsets", {}).items():
        if offset["late_frames"] is not None and offset["sigma_frames"] is not None:
            rows.append(_row(f"view {view} is late by", offset["late_frames"], offset["sigma_frames"], "frames", ESTIMATED))
    return rows + _of_silhouettes(silhouettes) + (_of_body(body) if body is not None else [])


def _of_silhouettes(fits: Sequence[SilhouetteFit]) -> list[Row]:
    """The overlap in each view, and the distance of the outlines."""
    rows = []
    for view, person in dict.fromkeys((f.view, f.person) for f in fits):
        mine = [f for f in fits if (f.view, f.person) == (view, person)]
        for name, unit, values in (
            (f"silhouette of view {view}, IoU with {PERSON[person]}", "", [f.iou for f in mine]),
            (f"silhouette of view {view}, share inside {PERSON[person]}", "", [f.inside for f in mine]),
            (f"outline of view {view} from the body's", "px", [f.distance_px for f in mine]),
        ):
            known = [v for v in values if np.isfinite(v)]
            rows += [_row(name, float(np.median(known)), float(np.std(known)), unit, FRAME_TO_FRAME)] if known else []
    return rows


def number(value: float) -> float | None:
    """A number for JSON: null if it is not finite."""
    return float(value) if np.isfinite(value) else None


def _of_body(body: BodyFit) -> list[Row]:
    """Lengths of bones, and the least and the greatest value of each joint angle."""
    skeleton, motion, rows = body.shape.skeleton, body.motion, []
    for bone, length, sigma in zip(skeleton.bones, body.shape.lengths_m, body.shape.length_sigma_m):
        rows.append(_row(f"length of {bone.name}", 1e3 * length, 1e3 * sigma, "mm", ESTIMATED))
    base = set(skeleton.layout.group("base").tolist())
    for d, name in enumerate(motion.dof_names):
        values = np.degrees(motion.values[:, d])
        if d in base or not np.isfinite(values).any():
            continue
        for word, at in (("least", int(np.nanargmin(values))), ("greatest", int(np.nanargmax(values)))):
            label = f"{name}, {word} (frame {motion.frames[at]})"
            rows.append(_row(label, values[at], np.degrees(motion.sigma[at, d]), "°", ESTIMATED))
    return rows


def _row(name: str, value: float, sigma: float, unit: str, sigma_of: str) -> Row:
    return {"name": name, "value": float(value), "sigma": float(sigma), "unit": unit, "sigma_of": sigma_of}


def quoted(value: float, sigma: float) -> tuple[str, str]:
    """Value and sigma as printed: the sigma with two significant digits, the value to the same decimal place."""
    if not np.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}", "–"
    places = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{places}f}", f"{sigma:.{places}f}"


def figures_csv(rows: Sequence[Row]) -> str:
    """The figures as a table: name, value, sigma, unit, sigma_of; empty cells for what is not finite."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ("name", "value", "sigma", "unit", "sigma_of"), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: "" if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()} for row in rows)
    return text.getvalue()
