"""The recording from above, as SVG: cameras, their fields of view, the measured person and its path, with a scale; and the figures that
decide how accurate a surface can be.

    s = z / f                                size of a pixel at the person, z its distance                                      (1)
    γ = ∠(C_i − X, C_k − X)                  largest angle between the rays of two cameras at the person                         (2)
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.camera import Camera
from ..geometry.rig import Rig
from ..surface.cloud import PointCloud
from .drawing import LONGEST, length_words, round_length

WIDTH, HEIGHT, MARGIN = 520, 340, 34
MOST_POINTS = 600  # of the person
MOST_FRAMES = 100  # of its path
FIELD = 1.2  # how far a field of view is drawn, by the distance of the farthest point
TEXT = 'font-family="sans-serif" font-size="12" fill="currentColor"'
PERSON, PATH, VIEW = "#2e86c1", "#d1495b", "#c98a1b"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Arrangement:
    """What is drawn, in the axes of the reference camera [m]: x to the right, z away from it."""

    cameras: tuple[Camera, ...]
    reference: Camera
    person_m: np.ndarray  # (N, 3) points of one frame, in the world
    path_m: np.ndarray  # (T, 3) the middle of the points in each frame, in the world

    @property
    def middle_m(self) -> np.ndarray:
        """The middle (3,) of the person over all frames."""
        return np.asarray(np.median(self.path_m, axis=0))


def arrangement(rig: Rig, reference: int, clouds: Sequence[PointCloud]) -> Arrangement | None:
    """From the clouds of a run; None if no frame has points."""
    count = len(clouds)
    places = [clouds[i].xyz_m for i in np.unique(np.linspace(0, count - 1, min(MOST_FRAMES, count)).round().astype(int)).tolist()]
    places = [xyz for xyz in places if len(xyz)]
    if not places:
        return None
    middles, person = [np.median(xyz, axis=0) for xyz in places], places[len(places) // 2]
    every = max(1, len(person) // MOST_POINTS)
    return Arrangement(cameras=rig.cameras, reference=rig.cameras[reference], person_m=person[::every], path_m=np.array(middles))


def words(shown: Arrangement) -> str:
    """The caption: distances, angles and the size of a pixel at the person.  (1), (2)"""
    centres, middle = np.array([c.centre_m for c in shown.cameras]), shown.middle_m
    depth = float(shown.reference.to_camera(middle)[2])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    rays = (centres - middle) / np.linalg.norm(centres - middle, axis=1, keepdims=True)
    angle = float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)).max()))
    return (
        f"The recording from above. The person is {depth:.2f} m in front of camera {shown.reference.name}; blue are the measured points of "
        f"one frame, and the red line is where their middle goes. The cameras are up to {apart.max():.2f} m apart, and their rays meet at "
        f"up to {angle:.0f}° at the person. "
        f"A pixel is {1e3 * depth / shown.reference.focal_px:.1f} mm wide at the person."
    )


def plan(shown: Arrangement) -> str:
    """The picture as SVG, in the colours of the page."""

    def above(xyz_m: np.ndarray) -> np.ndarray:
        return shown.reference.to_camera(xyz_m)[..., [0, 2]]

    centres = above(np.array([c.centre_m for c in shown.cameras]))
    fields = [
        above(_edges(camera, FIELD * float(np.linalg.norm(shown.person_m - camera.centre_m, axis=1).max()))) for camera in shown.cameras
    ]
    everything = np.concatenate([centres, above(shown.person_m), above(shown.path_m)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    px_per_m = float(min((WIDTH - 2 * MARGIN) / max(high[0] - low[0], 0.1), (HEIGHT - 2 * MARGIN) / max(high[1] - low[1], 0.1)))
    centre = 0.5 * (low + high)

    def px(xz: np.ndarray) -> np.ndarray:  # z, away from the cameras, is up
        return np.array([WIDTH / 2, HEIGHT / 2]) + (xz - centre) * [px_per_m, -px_per_m]

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" xmlns="http://www.w3.org/2000/svg" role="img" aria-label="plan" {TEXT}>']
    for field, place in zip(fields, centres):
        parts.append(f'<polygon points="{_points(px(np.stack([field[0], place, field[1]])))}" fill="{VIEW}" opacity="0.10"/>')
    parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.4" fill="{PERSON}" opacity="0.6"/>' for x, y in px(above(shown.person_m)).tolist()]
    parts.append(f'<polyline points="{_points(px(above(shown.path_m)))}" fill="none" stroke="{PATH}" stroke-width="2"/>')
    for camera, place in zip(shown.cameras, centres):
        x, y = px(place).tolist()
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="currentColor"/>')
        parts.append(f'<text x="{x:.1f}" y="{y + 18:.1f}" text-anchor="middle">{html.escape(camera.name)}</text>')
    return "".join([*parts, _scale_and_axes(px_per_m), "</svg>"])


def _edges(camera: Camera, far_m: float) -> np.ndarray:
    """Points (2, 3) at the left and the right edge of the image, as far away."""
    (w, h), at = camera.size_px, np.array([0.0, 1.0])
    ray = camera.rays(np.stack([at * (w - 1), np.full(2, h / 2)], axis=1))
    return np.asarray(camera.centre_m + far_m * ray / np.linalg.norm(ray, axis=1, keepdims=True))


def _scale_and_axes(px_per_m: float) -> str:
    bar = round_length(LONGEST * WIDTH / px_per_m)
    left, y, right, arm = 12, HEIGHT - 12, WIDTH - 50, 26
    line = '<line x1="{}" y1="{}" x2="{:.1f}" y2="{:.1f}" stroke="currentColor" stroke-width="{}"/>'
    return (
        line.format(left, y, left + bar * px_per_m, y, 3)
        + f'<text x="{left}" y="{y - 7}">{length_words(bar)}</text>'
        + line.format(right, y, right + arm, y, 1.5)
        + line.format(right, y, right, y - arm, 1.5)
        + f'<text x="{right + arm + 4}" y="{y + 4}">x</text><text x="{right + 4}" y="{y - arm + 4}">z</text>'
    )


def _points(xy: np.ndarray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in xy.tolist())
