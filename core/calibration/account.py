"""The account of a calibration: a page of text for people and the same figures as JSON for programs."""

from typing import Any

import numpy as np

from ..geometry.camera_derivatives import EXTERIOR, INTERIOR
from .quality import Lengths, Quality
from .self_calibration import Calibration
from .verdict import Verdict, positions_used


def figures(calibration: Calibration, quality: Quality, verdict: Verdict) -> dict[str, Any]:
    """All figures as plain values, lengths in metres."""
    observations = calibration.observations
    return {
        "format": "tricap-calibration",
        "version": 1,
        "light": verdict.light,
        "verdict": verdict.sentence,
        "advice": verdict.advice,
        "bar_length_m": observations.length_m,
        "positions": len(observations.xy_px),
        "positions_used": positions_used(calibration),
        "image_points": int(observations.seen.sum()),
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
        "decisions": list(calibration.decisions),
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
    """Name, value and sigma of a camera's interior unknowns; sigma 0 for those that were left out."""
    columns = list(calibration.unknowns.columns)
    p = len(columns)
    sigma = np.sqrt(np.maximum(np.diag(calibration.covariance), 0.0))
    return [
        (name, float(calibration.network.interior[camera, n]), float(sigma[camera * p + columns.index(n)]) if n in columns else 0.0)
        for n, name in enumerate(INTERIOR)
    ]


def exterior_sigmas(calibration: Calibration, camera: int) -> dict[str, float]:
    """Sigmas of a camera's pose about its own axes, in the free network: turn x … [rad], shift x … [m]."""
    p = len(calibration.unknowns.columns)
    sigma = np.sqrt(np.maximum(np.diag(calibration.covariance)[camera * p : (camera + 1) * p], 0.0))
    return {name: float(value) for name, value in zip(EXTERIOR, sigma[-len(EXTERIOR) :])}


def camera_sigmas(calibration: Calibration) -> dict[str, dict[str, float]]:
    """Sigmas of all unknowns of the adjustment, by camera; those that were left out have none."""
    return {
        name: {n: sigma for n, _, sigma in parameters(calibration, c) if sigma} | exterior_sigmas(calibration, c)
        for c, name in enumerate(calibration.observations.names)
    }


def _camera_figures(calibration: Calibration, quality: Quality, c: int) -> dict[str, Any]:
    return {
        "rms_px": float(quality.rms_px[c]),
        "covered": float(quality.covered[c]),
        "depth_ratio": float(quality.depth_ratio[c]),
        "image_points": int(calibration.observations.seen[:, c].sum()),
        "image_points_used": int(calibration.used[:, c].sum()),
        "bars_shared": {name: int(n) for name, n in zip(calibration.observations.names, quality.shared[c])},
        "pose_sigma": exterior_sigmas(calibration, c),
        "parameters": {
            name: {"value": value, "sigma": sigma, "significance": abs(value) / sigma if sigma else None}
            for name, value, sigma in parameters(calibration, c)
        },
    }


def page(calibration: Calibration, quality: Quality, verdict: Verdict) -> str:
    """The account as text."""
    observations = calibration.observations
    lines = [
        verdict.sentence,
        f"To do better: {verdict.advice}.",
        "",
        f"{positions_used(calibration)} of {len(observations.xy_px)} bar positions, {int(calibration.used.sum())} of "
        f"{int(observations.seen.sum())} image points; sigma0 {calibration.sigma0_px:.4f} px, redundancy {calibration.redundancy:.0f}.",
        f"Predicted error in space {1e3 * quality.predicted.rms_m:.3f} mm RMS, largest {1e3 * quality.predicted.sigma_m.max():.3f} mm; "
        f"of a bar's length {1e3 * quality.predicted.length_rms_m:.3f} mm.",
        _length_line("Bars left out of the adjustment", quality.held_out),
        _length_line("The same with bars that were taken for blunders though their rays meet", quality.held_out_untested),
        _length_line("Bars of the adjustment", quality.used_lengths),
        f"{quality.rejected} bars that two cameras saw whole were rejected as blunders.",
        f"Two cameras at least see {100 * quality.seen_by_two:.0f} % of the volume; "
        f"the bar came through {100 * quality.visited:.0f} % of it.",
        f"Scatter of the bar's directions {quality.scatter.round(3).tolist()} (smallest: 0.05 is good, 0 fails); "
        f"a mirrored rig fits {quality.mirror:.3g} times worse.",
        *(f"{decision[0].upper()}{decision[1:]}." for decision in calibration.decisions),
        "",
        *(line for c in range(len(observations.names)) for line in _camera_lines(calibration, quality, c)),
        *(f"Camera {name}: {a} and {b} are correlated by {rho:+.3f}." for name, a, b, rho in quality.correlations),
    ]
    return "\n".join(lines) + "\n"


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
