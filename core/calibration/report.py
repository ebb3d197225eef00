"""The report of a calibration: a page of text, the same figures as JSON, and pictures.

The pictures show the coverage of each image with its residuals, a map of the
predicted error, and the lengths that were left out.
"""

from typing import Any

import cv2
import numpy as np

from ..geometry.camera import EXTERIOR, INTERIOR
from .precision import predicted_error
from .quality import CELLS, Lengths, Quality
from .self_calibration import Calibration
from .verdict import Verdict, positions_used

INK, PALE, RED, GREEN, BLUE = (60, 60, 60), (225, 225, 225), (60, 60, 220), (90, 170, 80), (200, 120, 40)  # BGR
PANEL_PX = 420
MAP_CELLS = 28  # along each side of the error map
FONT = cv2.FONT_HERSHEY_SIMPLEX
FORMAT = "tricap-calibration"
START = f'{{\n "format": "{FORMAT}"'  # of the figures as a file


def figures(calibration: Calibration, quality: Quality, verdict: Verdict) -> dict[str, Any]:
    """All figures as plain values, lengths in metres."""
    observations = calibration.observations
    return {
        "format": FORMAT,
        "version": 1,
        "light": verdict.light.value,
        "verdict": verdict.sentence,
        "advice": verdict.advice,
        **observations.described,
        "positions": len(observations.xy_px),
        "positions_used": positions_used(calibration),
        "image_points": int(observations.visible.sum()),
        "image_points_used": int(calibration.used.sum()),
        "redundancy": calibration.redundancy,
        "sigma0_px": calibration.sigma0_px,
        "converged": calibration.converged,
        "predicted_error_m": quality.predicted.rms_m,
        "predicted_length_error_m": quality.predicted.length_rms_m,
        "held_out_lengths": _length_figures(quality.held_out),
        "held_out_lengths_untested": _length_figures(quality.held_out_untested),
        "used_lengths": _length_figures(quality.used_lengths),
        "direction_scatter": quality.scatter.tolist(),
        "mirrored_sum_of_squares": _finite(quality.mirror),
        "box_m": quality.box_m.tolist(),
        "volume_visited": quality.visited,
        "volume_seen_by_two": quality.seen_by_two,
        "bars_rejected": quality.rejected,
        "delays_images": {name: {"value": value, "sigma": sigma} for name, (value, sigma) in calibration.delays.items()},
        "decisions": list(calibration.decisions),
        "remarks": list(calibration.remarks),
        "correlations": [list(entry) for entry in quality.correlations],
        "cameras": {name: _camera_figures(calibration, quality, c) for c, name in enumerate(observations.names)},
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _length_figures(lengths: Lengths) -> dict[str, Any]:
    return {
        "bars": len(lengths.residual_m),
        "mean_m": _finite(lengths.mean_m),
        "rms_m": _finite(lengths.rms_m),
        "median_m": _finite(lengths.median_m),
        "drift_m": [_finite(d) for d in lengths.drift_m],
    }


def parameters(calibration: Calibration, camera: int) -> list[tuple[str, float, float]]:
    """Name, value and sigma of the interior unknowns of a camera; sigma 0 for those that were left out."""
    columns = list(calibration.unknowns.columns)
    p = len(columns)
    sigma = np.sqrt(np.maximum(np.diag(calibration.covariance), 0.0))
    fisheye = bool(calibration.network.curved[camera])
    return [
        (
            "k4" if fisheye and name == "p1" else name,
            float(calibration.network.interior[camera, n]),
            float(sigma[camera * p + columns.index(n)]) if n in columns else 0.0,
        )
        for n, name in enumerate(INTERIOR)
        if not (fisheye and name == "p2")
    ]


def exterior_sigmas(calibration: Calibration, camera: int) -> dict[str, float]:
    """Sigmas of the pose of a camera about its own axes, in the free network: turn x … [rad], shift x … [m]."""
    p = len(calibration.unknowns.columns)
    sigma = np.sqrt(np.maximum(np.diag(calibration.covariance)[camera * p : (camera + 1) * p], 0.0))
    return {name: float(value) for name, value in zip(EXTERIOR, sigma[-len(EXTERIOR) :])}


def camera_sigmas(calibration: Calibration) -> dict[str, dict[str, float]]:
    """Sigmas of all unknowns of the adjustment, by camera, without those that were left out."""
    return {
        name: {n: sigma for n, _, sigma in parameters(calibration, c) if sigma} | exterior_sigmas(calibration, c)
        for c, name in enumerate(calibration.observations.names)
    }


def _camera_figures(calibration: Calibration, quality: Quality, c: int) -> dict[str, Any]:
    return {
        "rms_px": float(quality.rms_px[c]),
        "covered": float(quality.covered[c]),
        "depth_ratio": float(quality.depth_ratio[c]),
        "image_points": int(calibration.observations.visible[:, c].sum()),
        "image_points_used": int(calibration.used[:, c].sum()),
        "bars_shared": {name: int(n) for name, n in zip(calibration.observations.names, quality.shared[c])},
        "pose_sigma": exterior_sigmas(calibration, c),
        "parameters": {
            name: {"value": value, "sigma": sigma, "significance": abs(value) / sigma if sigma else None}
            for name, value, sigma in parameters(calibration, c)
        },
    }


def page(calibration: Calibration, quality: Quality, verdict: Verdict) -> str:
    """The report as text."""
    observations = calibration.observations
    lines = [
        verdict.sentence,
        f"To improve: {verdict.advice}.",
        "",
        f"{positions_used(calibration)} of {len(observations.xy_px)} {observations.noun} positions, {int(calibration.used.sum())} of "
        f"{int(observations.visible.sum())} image points; sigma0 {calibration.sigma0_px:.4f} px, redundancy {calibration.redundancy:.0f}.",
        f"Predicted error in space {1e3 * quality.predicted.rms_m:.3f} mm RMS, largest {1e3 * quality.predicted.sigma_m.max():.3f} mm; "
        f"of a {observations.noun}'s length {1e3 * quality.predicted.length_rms_m:.3f} mm.",
        _length_line(f"{observations.noun.capitalize()}s left out of the adjustment", quality.held_out),
        _length_line(
            f"The same with {observations.noun}s that were rejected as outliers although their rays meet", quality.held_out_untested
        ),
        _length_line(f"{observations.noun.capitalize()}s of the adjustment", quality.used_lengths),
        f"{quality.rejected} {observations.noun}s visible to two cameras were rejected as outliers.",
        f"{100 * quality.seen_by_two:.0f} % of the volume is visible to two cameras or more; "
        f"the {observations.noun} reached {100 * quality.visited:.0f} % of it.",
        f"Scatter of the {observations.noun}'s directions {quality.scatter.round(3).tolist()} (smallest: 0.05 is good, 0 fails); "
        f"a mirrored rig fits {quality.mirror:.3g} times worse.",
        *(_delay_line(calibration.observations.names[0], name, *delay) for name, delay in calibration.delays.items()),
        *(f"{line[0].upper()}{line[1:]}." for line in (*calibration.decisions, *calibration.remarks)),
        "",
        *(line for c in range(len(observations.names)) for line in _camera_lines(calibration, quality, c)),
        *(f"Camera {name}: {a} and {b} are correlated by {rho:+.3f}." for name, a, b, rho in quality.correlations),
    ]
    return "\n".join(lines) + "\n"


def _delay_line(first: str, name: str, value: float, sigma: float) -> str:
    when = "later" if value > 0 else "earlier"
    interval = f"{abs(value):.4f} ± {sigma:.4f} of their interval"
    return f"Camera {name} took its images {interval} {when} than camera {first}; the adjustment allows for it."


def _length_line(label: str, lengths: Lengths) -> str:
    drift = ", ".join(f"{1e3 * d:+.2f}" for d in lengths.drift_m)
    return (
        f"{label}: {len(lengths.residual_m)} lengths, mean {1e3 * lengths.mean_m:+.3f} mm, median {1e3 * lengths.median_m:.3f} mm, "
        f"RMS {1e3 * lengths.rms_m:.3f} mm, drift over the volume in x, y, z {drift} mm."
    )


def _camera_lines(calibration: Calibration, quality: Quality, c: int) -> list[str]:
    name = calibration.observations.names[c]
    lines = [
        f"Camera {name}: RMS {quality.rms_px[c]:.4f} px, {100 * quality.covered[c]:.0f} % of the image covered, "
        f"depths 1 : {quality.depth_ratio[c]:.2f}"
    ]
    for parameter, value, sigma in parameters(calibration, c):
        lines.append(f"    {parameter:3} {value:12.6g}" + (f" ± {sigma:.2g}" if sigma else "   (left out)"))
    sigmas = np.array(list(exterior_sigmas(calibration, c).values()))
    turn, shift = (", ".join(f"{v:.2g}" for v in part) for part in (np.degrees(sigmas[:3]), 1e3 * sigmas[3:]))
    return [*lines, f"    its pose about its own axes: ± {turn}° turned, ± {shift} mm shifted", ""]


def pictures(calibration: Calibration, quality: Quality) -> dict[str, np.ndarray]:
    """File names and BGR pictures."""
    return {
        "coverage.png": np.hstack([_coverage(calibration, quality, c) for c in range(len(calibration.observations.names))]),
        "error_map.png": _error_map(calibration, quality),
        "lengths.png": _lengths(quality),
    }


def _panel(title: str, width: int, height: int) -> np.ndarray:
    image = np.full((height + 40, width + 20, 3), 255, np.uint8)
    cv2.putText(image, title, (10, 20), FONT, 0.42, INK, 1, cv2.LINE_AA)
    return image


def _coverage(calibration: Calibration, quality: Quality, c: int) -> np.ndarray:
    """The cells that the object reached, its image points, and the residuals as arrows."""
    size = calibration.observations.size_px[c]
    scale = PANEL_PX / size[0]
    height = round(size[1] * scale)
    longest = max(5 * float(quality.rms_px[c]), 1e-9)
    name = calibration.observations.names[c]
    image = _panel(f"{name}: {100 * quality.covered[c]:.0f} % covered, arrows of 20 px = {longest:.2g} px", PANEL_PX, height)
    origin = np.array([10, 30])
    step = np.array([PANEL_PX / CELLS[0], height / CELLS[1]])
    for row, col in np.argwhere(quality.coverage[c] > 0):
        a = (origin + step * (col, row)).astype(int)
        cv2.rectangle(image, a.tolist(), (a + step - 2).astype(int).tolist(), (220, 240, 220), -1)
    cv2.rectangle(image, origin.tolist(), (origin + (PANEL_PX, height)).tolist(), PALE, 1)
    used = calibration.used[:, c]
    for xy, v in zip(calibration.observations.xy_px[:, c][used], calibration.residual_px[:, c][used]):
        p = (origin + xy * scale).astype(int)
        cv2.line(image, p.tolist(), (p + v * 20 / longest).astype(int).tolist(), RED, 1, cv2.LINE_AA)
        cv2.circle(image, p.tolist(), 1, INK, -1)
    return image


def _error_map(calibration: Calibration, quality: Quality) -> np.ndarray:
    """Predicted error in a horizontal and a vertical section through the middle of the volume."""
    panels = []
    box = quality.box_m
    for title, (a, b) in (("from above", (0, 1)), ("from the front", (0, 2))):
        points, shape = _section(box, a, b)
        cameras = calibration.network.cameras(calibration.observations.names, calibration.observations.size_px)
        pairs = np.stack([points, points], axis=1)
        predicted = predicted_error(cameras, calibration.every_unknown, calibration.considered, pairs + np.array([[0.0], [1e-6]]))
        values = np.full(len(points), np.nan)
        values[_index_of(points, predicted.xyz_m[0::2])] = predicted.sigma_m[0::2]
        panels.append(_heat_panel(f"predicted error, section {title}", values.reshape(shape)[::-1] * 1e3))
    height = max(p.shape[0] for p in panels)
    return np.hstack([cv2.copyMakeBorder(p, 0, height - p.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=(255, 255, 255)) for p in panels])


def _section(box: np.ndarray, a: int, b: int) -> tuple[np.ndarray, tuple[int, int]]:
    u, v = (np.linspace(box[0, k], box[1, k], MAP_CELLS) for k in (a, b))
    points = np.tile(box.mean(axis=0), (MAP_CELLS * MAP_CELLS, 1))
    points[:, b], points[:, a] = (g.ravel() for g in np.meshgrid(v, u, indexing="ij"))
    return points, (MAP_CELLS, MAP_CELLS)


def _index_of(points: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Indices of the points that are among `found`, which has the same order."""
    return np.flatnonzero((np.abs(points[:, None] - found[None]).max(axis=2) < 1e-9).any(axis=1))


def _heat_panel(title: str, mm: np.ndarray) -> np.ndarray:
    low, high = (float(np.nanmin(mm)), float(np.nanmax(mm))) if np.isfinite(mm).any() else (0.0, 1.0)
    grey = np.clip((np.nan_to_num(mm, nan=low) - low) / max(high - low, 1e-12) * 255, 0, 255).astype(np.uint8)
    heat = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    heat[~np.isfinite(mm)] = 255
    image = _panel(f"{title}: {low:.2g} to {high:.2g} mm", PANEL_PX, PANEL_PX)
    image[30 : 30 + PANEL_PX, 10 : 10 + PANEL_PX] = cv2.resize(heat, (PANEL_PX, PANEL_PX), interpolation=cv2.INTER_NEAREST)
    return image


def _lengths(quality: Quality) -> np.ndarray:
    """Every length that was left out, minus the known length, over the frames."""
    width, height = 2 * PANEL_PX, PANEL_PX // 2
    mm, frames = quality.held_out.residual_m * 1e3, quality.held_out.frames
    if not len(mm):
        return _panel("nothing was left out", width, height)
    reach = max(float(np.abs(mm).max()), 1e-9)
    image = _panel(
        f"lengths left out, less the known one: lines at +-{reach:.2g} mm, frames {frames.min()} to {frames.max()}", width, height
    )
    for level in (-1, 0, 1):
        y = 30 + round(height / 2 - level * (height / 2 - 5))
        cv2.line(image, (10, y), (10 + width, y), PALE if level else GREEN, 1)
    for frame, value in zip(frames, mm):
        x = 10 + round((frame - frames.min()) / max(np.ptp(frames), 1) * width)
        cv2.circle(image, (x, 30 + round(height / 2 - value / reach * (height / 2 - 5))), 2, BLUE, -1, cv2.LINE_AA)
    return image
