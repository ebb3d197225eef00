"""Contours of the views as rays that touch the body, frame by frame, and the limb that each touches.

A ray of the outline touches the limb that it enters deepest, or passes nearest: a ray inside any limb would be inside the outline. It
touches none when it is further from every limb than the gate, when it meets the limb far beyond its ends, or when the outline faces the
other way than the limb.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from ...geometry.camera import Camera
from ..observations import SilhouetteRays
from ..segmentation import SegmentationCache, facing_bone
from ..settings import FitSettings
from ..state import BodyState
from .cloud_points import VARIANCE_FLOOR_M2
from .fit_input import FitInput

SPACING_M = 0.012  # of the rays, at the body
BEYOND = 0.35  # of a bone: an outline passes over joints, shoulders and the crown, where the parts' fields meet
OUTLINE_PATCHES = 3  # an outline follows a wrong edge for about so many patches of the model's error, and does so in all similar views
CACHED_FRAMES = 500  # with their rays: more than are adjusted at once
SIMILAR = float(np.cos(np.radians(40.0)))  # views whose directions are closer than this have the same outline


@dataclass(frozen=True, eq=False, kw_only=True)
class Rays:
    """N rays through the outlines of one frame."""

    origin_m: np.ndarray  # (N, 3)
    direction: np.ndarray  # (N, 3) unit
    outward: np.ndarray  # (N, 3) unit, away from the person and across the ray
    angle: np.ndarray  # (N,) sigma across the ray, rad
    similar_views: np.ndarray  # (N,) number of views with about the same outline


class Silhouettes:
    """The rays of all frames, as observations of a body."""

    def __init__(self, given: FitInput, surface: np.ndarray, settings: FitSettings) -> None:
        self._surface, self._settings = (_closed(surface) if settings.balls == "one" else surface), settings
        used = given.contours if settings.use_contours else ()
        self._tables = [(given.rig[c.view], c) for c in used]
        self._frames = given.frames
        self._rays: dict[int, Rays | None] = {}

    def stretch(self, frames: Sequence[int]) -> "Silhouettes":
        """Those of some of the frames; their rays are made on demand."""
        part = copy(self)
        part._frames, part._rays = [self._frames[t] for t in frames], {}
        return part

    def observe(
        self, t: int, state: BodyState, cache: SegmentationCache | None = None, gate_scale: np.ndarray | float = 1.0
    ) -> list[SilhouetteRays]:
        """The rays of frame index `t` that touch a limb of the body near its state; `gate_scale` (B,) or for all multiplies the gate."""
        if t not in self._rays:
            self._rays[t] = self._of_frame(t, state)
            if len(self._rays) > CACHED_FRAMES:
                del self._rays[next(iter(self._rays))]
        rays = self._rays[t]
        if rays is None:
            return []

        def find() -> tuple[np.ndarray, np.ndarray]:
            return touched(rays, state, self._surface, self._settings.outline_gate_m * gate_scale)

        rows, bone = find() if cache is None else cache.get(("rays", t), state, find)
        if not len(rows):
            return []
        away = np.linalg.norm(state.head_m[bone] - rays.origin_m[rows], axis=1)
        own, model = (rays.angle[rows] * away) ** 2 + VARIANCE_FLOOR_M2, self._settings.model_sigma_m**2
        in_patch = np.maximum(1.0, rays.similar_views[rows] * OUTLINE_PATCHES * self._settings.model_patch_m / SPACING_M)
        found = SilhouetteRays.about(
            state,
            origin_m=rays.origin_m[rows],
            direction=rays.direction[rows],
            bone=bone,
            sigma_m=np.sqrt(own + model),
            variance_inflation=(own + in_patch * model) / (own + model),
        )
        return [found]

    def _of_frame(self, t: int, state: BodyState) -> Rays | None:
        ahead = np.array([camera.R_cam_world[2] for camera, _ in self._tables]).reshape(-1, 3)
        parts = [
            _view_rays(camera, *outline, state.head_m.mean(axis=0), int((ahead @ camera.R_cam_world[2] > SIMILAR).sum()))
            for camera, table in self._tables
            if (outline := table.of_frame(self._frames[t])) is not None
        ]
        if not parts:
            return None
        columns: Mapping[str, np.ndarray] = {
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in ("origin_m", "direction", "outward", "angle", "similar_views")
        }
        return Rays(**columns)


def _view_rays(camera: Camera, xy_px: np.ndarray, normal: np.ndarray, sigma_px: np.ndarray, about_m: np.ndarray, similar: int) -> Rays:
    """The rays of one view, thinned to `SPACING_M` at a place (3,) of the body; `similar` views have about the same outline."""
    pixel_m = np.linalg.norm(about_m - camera.centre_m) / camera.focal_px
    gap = np.median(np.linalg.norm(np.diff(xy_px, axis=0), axis=1)) * pixel_m if len(xy_px) > 1 else SPACING_M
    keep = np.arange(0, len(xy_px), max(1, round(SPACING_M / max(gap, 1e-9))))
    direction, outside = (_unit(camera.rays(xy)) for xy in (xy_px[keep], xy_px[keep] + normal[keep]))
    outward = _unit(outside - np.einsum("ni,ni->n", outside, direction)[:, None] * direction)
    return Rays(
        origin_m=np.broadcast_to(camera.centre_m, direction.shape),
        direction=direction,
        outward=outward,
        angle=sigma_px[keep] / camera.focal_px,
        similar_views=np.full(len(keep), similar),
    )


def _closed(surface: np.ndarray) -> np.ndarray:
    """The parts (B, 2) of bones of one ellipsoid each: it closes at the bone's end, and only outlines beyond constrain its length."""
    return np.maximum(surface, [-np.inf, 1.0])


def touched(rays: Rays, state: BodyState, surface: np.ndarray, gate_m: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the rays that touch a limb, and its bone (K,). `surface` (B, 2) and `gate_m` as in `segmentation.segment`."""
    gate = np.broadcast_to(gate_m, (len(state.lengths_m),))
    first, last = surface[:, 0] - BEYOND, surface[:, 1] + BEYOND
    has_fingers = np.isin(np.arange(len(gate)), state.skeleton.parents, invert=True) & (
        surface[:, 1] < 1
    )  # its outline continues in fingers, which are no bones
    last = np.where(has_fingers, surface[:, 1], last)
    n = len(rays.direction)
    nearest, owner, own = np.full(n, np.inf), np.zeros(n, dtype=np.intp), np.zeros(n, dtype=bool)
    for b in np.unique(state.balls.bone_index).tolist():
        X = nearest_to_segment(rays.origin_m, rays.direction, state.head_m[b], state.R[b][:, 1], state.lengths_m[b])
        gap, along, facing = facing_bone(X, rays.outward, state, b)
        closer = gap < nearest
        nearest[closer], owner[closer] = gap[closer], b
        own[closer] = ((along >= first[b]) & (along <= last[b]) & facing)[closer]
    rows = np.flatnonzero(own & (np.abs(nearest) < gate[owner]))
    return rows, owner[rows]


def nearest_to_segment(origin: np.ndarray, direction: np.ndarray, head: np.ndarray, axis: np.ndarray, length: float) -> np.ndarray:
    """The points (N, 3) of rays that come nearest to a segment from `head` (3,) along the unit vector `axis` (3,)."""
    w = origin - head
    b, d, e = direction @ axis, np.einsum("ni,ni->n", direction, w), w @ axis
    along = np.clip((e - b * d) / np.maximum(1 - b * b, 1e-9), 0.0, length)
    return origin + (along * b - d)[:, None] * direction


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
