"""Pictures of a calibration: where each image was covered and what residuals are left, the map of the predicted error, the lengths."""

import cv2
import numpy as np

from .precision import predicted_error
from .quality import CELLS, Quality
from .self_calibration import Calibration

INK, PALE, RED, GREEN, BLUE = (60, 60, 60), (225, 225, 225), (60, 60, 220), (90, 170, 80), (200, 120, 40)
PANEL_PX = 420
MAP_CELLS = 28
FONT = cv2.FONT_HERSHEY_SIMPLEX


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
    """Cells that the bar reached, its image points, and the residuals as arrows."""
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
    """Predicted error in a level and an upright section through the middle of the volume."""
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
    """Indices of the points that are found, which stand in the same order."""
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
    """Length of every bar that was left out, less the known length, over the frames."""
    width, height = 2 * PANEL_PX, PANEL_PX // 2
    mm, frames = quality.held_out.residual_m * 1e3, quality.held_out.frames
    if not len(mm):
        return _panel("no bars were left out", width, height)
    reach = max(float(np.abs(mm).max()), 1e-9)
    image = _panel(
        f"length of bars left out, less the known one: lines at +-{reach:.2g} mm, frames {frames.min()} to {frames.max()}", width, height
    )
    for level in (-1, 0, 1):
        y = 30 + round(height / 2 - level * (height / 2 - 5))
        cv2.line(image, (10, y), (10 + width, y), PALE if level else GREEN, 1)
    for frame, value in zip(frames, mm):
        x = 10 + round((frame - frames.min()) / max(np.ptp(frames), 1) * width)
        cv2.circle(image, (x, 30 + round(height / 2 - value / reach * (height / 2 - 5))), 2, BLUE, -1, cv2.LINE_AA)
    return image
