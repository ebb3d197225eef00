"""Outlines of the person in the views as rays that touch the body, frame by frame, and the limb that each touches.

The outlines are those of `tricap contour`; in the other views those of the region that covers the still background.

A ray of the outline touches the limb that it enters deepest, or passes nearest: a ray inside any limb would be inside the outline. It
touches none when it is further from every limb than the gate, when it meets the limb far beyond its ends, or when the outline faces the
other way than the limb.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from ...geometry.camera import Camera
from ..observations import SilhouetteRays
from ..segmentation import SegmentationCache, facing_bone, owners
from ..settings import FitSettings
from ..state import BodyState
from .cloud_points import VARIANCE_FLOOR_M2
from .fit_input import UNKNOWN, BackgroundDistances, FitInput, Outline, Outlines

SPACING_M, COARSE_SPACING_M = 0.012, 0.03  # of the rays at the body: of a drawn outline, and of one against the background
BEYOND = 0.35  # of a bone: an outline passes over joints, shoulders and the crown, where the parts' fields meet
OUTLINE_PATCHES = 3  # an outline follows a wrong edge for about so many patches of the model's error, and does so in all similar views
CACHED_FRAMES = 500  # with their rays: more than are adjusted at once
# sigma of a body from its metaballs where these meet, and of clothes, hair and fingers, which are no metaballs
COARSE_SIGMA_M = 0.006
SMALLEST = 40  # cells along the outline of a region or of a hole in it
SMOOTHED = 2.0  # cells along an outline, over which its steps are averaged
EDGE, EDGE_SIGMA = 0.5, 1.0  # cells: how far the edge is outside the middles of a region's outermost cells, and its sigma
AT_BORDER = 2  # cells
SIMILAR = float(np.cos(np.radians(40.0)))  # views whose directions are closer than this have the same outline


@dataclass(frozen=True, eq=False, kw_only=True)
class Rays:
    """N rays through the outlines of one frame."""

    origin_m: np.ndarray  # (N, 3)
    direction: np.ndarray  # (N, 3) unit
    outward: np.ndarray  # (N, 3) unit, away from the person and across the ray
    angle: np.ndarray  # (N,) sigma across the ray, rad
    patch: np.ndarray  # (N,) rays of all similar views on 1 m of the outline, whose errors of the model are one
    model_m: np.ndarray  # (N,) sigma of a real body from its metaballs


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonOutlines:
    """The outlines of the region that covers the still background of a view (`fit_input.Outlines`), made on demand."""

    regions: BackgroundDistances
    beside_unknown: bool = True  # also where it is unknown whether the cells beyond show the background

    @property
    def view(self) -> str:
        """The view's name."""
        return self.regions.view

    def of_frame(self, frame: int) -> Outline | None:
        """That of a frame; None where nothing is known of the background, or the person is not seen."""
        distance = self.regions.of_frame(frame)
        if distance is None or distance.all() or not distance.any():
            return None
        unknown = np.zeros(distance.shape, dtype=bool)
        if not self.beside_unknown:
            unknown = cv2.dilate((distance == UNKNOWN).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        parts = [_smooth_outline(c[:, 0], unknown) for c in _contours(distance == 0) if len(c) >= SMALLEST]
        if not parts:
            return None
        xy, normal = (np.concatenate(column) for column in zip(*parts))
        size = self.regions.step_px
        return xy * size + (size - 1) / 2, normal, np.full(len(xy), EDGE_SIGMA * size)


@dataclass(frozen=True, eq=False, kw_only=True)
class _View:
    """The outlines of one view, and how their rays are weighted."""

    camera: Camera
    outlines: Outlines
    drawn: bool  # by `tricap contour`; not found against the background
    spacing_m: float  # of the rays at the body
    model_m: float  # sigma of a real body from its metaballs

    def rays(self, outline: Outline, about_m: np.ndarray, similar: int) -> Rays:
        """The rays of one of its outlines, spaced at a place (3,) of the body; `similar` views have about the same outline."""
        xy_px, normal, sigma_px = outline
        pixel_m = np.linalg.norm(about_m - self.camera.centre_m) / self.camera.focal_px
        gap = np.median(np.linalg.norm(np.diff(xy_px, axis=0), axis=1)) * pixel_m if len(xy_px) > 1 else self.spacing_m
        keep = np.arange(0, len(xy_px), max(1, round(self.spacing_m / max(gap, 1e-9))))
        direction, outside = (_unit(self.camera.rays(xy)) for xy in (xy_px[keep], xy_px[keep] + normal[keep]))
        outward = _unit(outside - np.einsum("ni,ni->n", outside, direction)[:, None] * direction)
        return Rays(
            origin_m=np.broadcast_to(self.camera.centre_m, direction.shape),
            direction=direction,
            outward=outward,
            angle=sigma_px[keep] / self.camera.focal_px,
            patch=np.full(len(keep), similar * OUTLINE_PATCHES / self.spacing_m),
            model_m=np.full(len(keep), self.model_m),
        )


class Silhouettes:
    """The rays of all frames, as observations of a body."""

    def __init__(self, given: FitInput, surface: np.ndarray, settings: FitSettings) -> None:
        self._surface, self._settings = (_closed(surface) if settings.balls == "one" else surface), settings
        drawn = [*given.contours] if settings.use_contours else []
        others = [regions for regions in given.background if regions.view not in {outlines.view for outlines in drawn}]
        exact, coarse = settings.model_sigma_m, max(settings.model_sigma_m, COARSE_SIGMA_M)
        self._views = [_View(camera=given.rig[d.view], outlines=d, drawn=True, spacing_m=SPACING_M, model_m=exact) for d in drawn]
        self._views += [
            _View(
                camera=given.rig[o.view],
                # without measured points the body rests on these outlines, and wrong ones would shape it
                outlines=PersonOutlines(regions=o, beside_unknown=not given.image_tracks),
                drawn=False,
                spacing_m=COARSE_SPACING_M,
                model_m=coarse,
            )
            for o in (others if settings.use_background else ())
        ]
        self._frames = given.frames
        self._rays: dict[int, Rays | None] = {}

    def stretch(self, frames: Sequence[int]) -> "Silhouettes":
        """Those of some of the frames; their rays are made on demand."""
        part = copy(self)
        part._frames, part._rays = [self._frames[t] for t in frames], {}
        return part

    def anew(self) -> "Silhouettes":
        """The same, without rays that depend on what was computed before."""
        part = copy(self)
        part._rays = {}
        return part

    def drawn_only(self) -> "Silhouettes":
        """Those of `tricap contour`. The others include hair, fingers and clothes: good enough to find a limb, but not to shape it."""
        part = self.anew()
        part._views = [view for view in self._views if view.drawn]
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

        observe = partial(self._observed, rays, state)
        found = observe(*find()) if cache is None else cache.observed(("rays", t), state, find, observe)
        return [found] if found.size else []

    def _observed(self, rays: Rays, state: BodyState, rows: np.ndarray, bone: np.ndarray) -> SilhouetteRays:
        """Some rays (rows), each with the bone that it touches."""
        away = np.linalg.norm(state.head_m[bone] - rays.origin_m[rows], axis=1)
        own, model = (rays.angle[rows] * away) ** 2 + VARIANCE_FLOOR_M2, rays.model_m[rows] ** 2
        in_patch = np.maximum(1.0, rays.patch[rows] * self._settings.model_patch_m)
        return SilhouetteRays.about(
            state,
            origin_m=rays.origin_m[rows],
            direction=rays.direction[rows],
            bone=bone,
            sigma_m=np.sqrt(own + model),
            variance_inflation=(own + in_patch * model) / (own + model),
        )

    def _of_frame(self, t: int, state: BodyState) -> Rays | None:
        ahead = np.array([view.camera.R_cam_world[2] for view in self._views]).reshape(-1, 3)
        parts = [
            view.rays(outline, state.head_m.mean(axis=0), int((ahead @ view.camera.R_cam_world[2] > SIMILAR).sum()))
            for view in self._views
            if (outline := view.outlines.of_frame(self._frames[t])) is not None
        ]
        if not parts:
            return None
        columns: Mapping[str, np.ndarray] = {
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in ("origin_m", "direction", "outward", "angle", "patch", "model_m")
        }
        return Rays(**columns)


def _contours(person: np.ndarray) -> list[np.ndarray]:
    """The outlines (V, 1, 2) of a mask (h, w) and of its holes, the person on the same side of all."""
    return list(cv2.findContours(person.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0])


def _smooth_outline(corners: np.ndarray, unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 2) in cells and unit outward normals (V, 2) of a closed outline of cells (V, 2), without those at the image's border or
    in cells beyond which it is `unknown` (h, w) whether they show the background.

    OpenCV follows the outside of a region counter-clockwise and a hole clockwise, in an image whose y points down.
    """
    reach = int(3 * SMOOTHED)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTHED) ** 2)
    around = np.concatenate([corners[-reach:], corners, corners[:reach]]).astype(np.float64)
    xy = np.stack([np.convolve(column, weight / weight.sum(), mode="valid") for column in around.T], axis=1)
    along = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    size = np.linalg.norm(normal, axis=1)
    h, w = unknown.shape
    kept = (
        (size > 0)
        & ~unknown[corners[:, 1], corners[:, 0]]
        & (corners >= AT_BORDER).all(axis=1)
        & (corners[:, 0] < w - AT_BORDER)
        & (corners[:, 1] < h - AT_BORDER)
    )
    outward = normal[kept] / size[kept, None]
    return xy[kept] + EDGE * outward, outward


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
    rows, bone, X = near_rays(rays.origin_m, rays.direction, state, float(gate.max()), np.unique(state.balls.bone_index))
    gap, along, facing = facing_bone(X, rays.outward[rows], state, bone)
    return owners(rows, bone, gap, (along >= first[bone]) & (along <= last[bone]) & facing & (np.abs(gap) < gate[bone]))


def near_rays(
    origin: np.ndarray, direction: np.ndarray, state: BodyState, reach_m: float, bones: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of a ray (K,) of those from `origin` (N, 3) along unit vectors (N, 3), and one of some `bones` (K,), ordered by rays, and the
    point (K, 3) where the ray comes nearest to the bone; without pairs that are further apart than `reach_m` from the bone's surface."""
    head, axis, length = state.head_m[bones], state.R[bones, :, 1], state.lengths_m[bones]
    w, b = origin[:, None] - head, direction @ axis.T
    d, e, squares = np.einsum("nbi,ni->nb", w, direction), np.einsum("nbi,bi->nb", w, axis), np.einsum("nbi,nbi->nb", w, w)
    along = np.clip((e - b * d) / np.maximum(1 - b * b, 1e-9), 0.0, length)
    at = along * b - d
    reach = state.profile_table.radii_m[bones].max(axis=(1, 2)) + reach_m
    rows, column = np.nonzero(squares + along * (along - 2 * e) - at * at <= reach * reach)
    return rows, bones[column], origin[rows] + at[rows, column, None] * direction[rows]


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
