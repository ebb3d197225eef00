"""Points followed in single views as observations: for each pair of successive frames those that meet the same limb in both."""

from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial

import numpy as np

from ...geometry.rig import Rig
from ...tracking.image_points import SIGMA_PX, ImageStep
from ..observations import ImageSteps, StepsFromFixed
from ..segmentation import SegmentationCache, bone_distance
from ..settings import FitSettings
from ..state import BodyState
from .cloud_points import VARIANCE_FLOOR_M2
from .silhouettes import near_rays

LEAST_COSINE = 0.25  # of the surface against the ray: where it is grazed, its place on the ray is uncertain
MARCH, MARCH_STEPS, ARRIVED_M = 0.8, 12, 0.002  # share of the distance to the surface that a step goes along the ray
NEIGHBOURS = 9.0  # points of a view within a patch of the model, which share its error

Met = tuple[np.ndarray, np.ndarray]  # bones (N,), −1 for none; places (N, 3)


class ImageTracks:
    """Points followed in each view, in the order of the fit's frames."""

    def __init__(self, rig: Rig, views: Mapping[str, Sequence[ImageStep]], surface: np.ndarray, settings: FitSettings) -> None:
        """`views`: the steps of each view, T − 1."""
        self._cameras, self._views = [rig[name] for name in views], list(views.values())
        self._surface, self._settings = surface, settings
        self._rows: Sequence[int | None] = range(len(self._views[0]) if views else 0)
        self._cache = SegmentationCache()

    def stretch(self, frames: Sequence[int]) -> "ImageTracks":
        """Those of some of the frames."""
        part = copy(self)
        part._rows = [self._rows[a] if b == a + 1 else None for a, b in zip(frames, frames[1:])]
        part.forget()
        return part

    def steps(self, t: int, a: BodyState, b: BodyState) -> ImageSteps | None:
        """See `PointTracks`."""
        met = [self._met(t, last, body) for last, body in ((False, a), (True, b))]
        return self._observed(t, met[0], met[0][0] == met[1][0], False)

    def from_fixed(self, t: int, other: BodyState, backwards: bool) -> StepsFromFixed | None:
        """See `PointTracks`."""
        met = self._met(t, backwards, other)
        steps = self._observed(t, met, np.ones(len(met[0]), dtype=bool), backwards)
        return None if steps is None else StepsFromFixed(steps=steps, other=other)

    def counts(self, t: int, body: BodyState) -> np.ndarray:
        """How many points of frame t each bone (B,) meets."""
        ahead = t < len(self._rows) and self._rows[t] is not None
        bone = self._meet(t if ahead else t - 1, not ahead, body)[0] if len(self._rows) else np.zeros(0, dtype=np.intp)
        return np.bincount(bone[bone >= 0], minlength=len(body.lengths_m))

    def forget(self) -> None:
        """Assign points to limbs anew: what follows must not depend on what was computed before."""
        self._cache = SegmentationCache()

    def _met(self, t: int, last: bool, body: BodyState) -> Met:
        """Where the body is met by the points of frame t, or of the `last` frame of the step."""
        return self._cache.get((t, last), body, partial(self._meet, t, last, body))  # type: ignore[no-any-return]

    def _meet(self, t: int, last: bool, body: BodyState) -> Met:
        origin, ray, _ = self._rays(t, last)
        bone, place = np.full(len(ray), -1), np.zeros_like(ray)
        rows, bones, X = meets(origin, ray, body, self._surface)
        bone[rows], place[rows] = bones, X
        return bone, place

    def _rays(self, t: int, last: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins (N, 3) and unit directions (N, 3) of the rays of all views, and the angle of a pixel (N,)."""
        origin, ray, pixel = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
        if (row := self._rows[t]) is None:
            return origin[0], ray[0], pixel[0]
        for camera, steps in zip(self._cameras, self._views):
            r = camera.rays(steps[row].to_px if last else steps[row].from_px)
            origin.append(np.broadcast_to(camera.centre_m, r.shape))
            ray.append(r / np.linalg.norm(r, axis=1, keepdims=True))
            pixel.append(np.full(len(r), 1 / camera.focal_px))
        return np.concatenate(origin), np.concatenate(ray), np.concatenate(pixel)

    def _observed(self, t: int, met: Met, same: np.ndarray, backwards: bool) -> ImageSteps | None:
        bone, place = met
        keep = np.flatnonzero((bone >= 0) & same)
        if not len(keep):
            return None
        origin, ray, pixel = (column[keep] for column in self._rays(t, not backwards))
        away = np.linalg.norm(place[keep] - origin, axis=1)
        own, skin = (SIGMA_PX * pixel * away) ** 2 + VARIANCE_FLOOR_M2, self._settings.track_sigma_m**2
        return ImageSteps(
            from_m=place[keep],
            ray_m=origin,
            across=_across(ray),
            bone=bone[keep],
            sigma_m=np.sqrt(own + skin),
            variance_inflation=np.repeat((own + NEIGHBOURS * skin) / (own + skin), 2),
        )


def meets(origin: np.ndarray, ray: np.ndarray, state: BodyState, surface: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (K,) of the rays, from `origin` (N, 3) along unit vectors (N, 3), that meet a limb, the bone (K,) that each meets first, and
    where (K, 3). `surface` as in `segmentation.segment`; rays that graze their limb meet nothing."""
    bones = np.unique(state.balls.bone_index)
    rows, bone, nearest = near_rays(origin, ray, state, 0.0, bones)
    widest = np.zeros(len(state.lengths_m))
    widest[bones] = state.profile_table.radii_m[bones].max(axis=(1, 2))
    u, o = ray[rows], origin[rows]
    last = np.einsum("ni,ni->n", nearest - o, u)
    t = last - 2 * widest[bone]
    for _ in range(MARCH_STEPS):
        t += MARCH * bone_distance(o + t[:, None] * u, -u, state, bone)[0]
        t = np.minimum(t, last)
    X = o + t[:, None] * u
    gap, along, cosine = bone_distance(X, -u, state, bone)
    axial = np.einsum("ni,ni->n", u, state.R[bone, :, 1])
    cosine = cosine * np.sqrt(np.maximum(1 - axial**2, 0.0))  # of the ray itself, not of its part across the bone
    arrived = (np.abs(gap) < ARRIVED_M) & (t > 0)
    order = np.lexsort((np.where(arrived, t, np.inf), rows))
    first = order[np.diff(rows[order], prepend=-1) > 0]  # of each ray
    own = (along >= surface[bone, 0]) & (along <= surface[bone, 1]) & (cosine >= LEAST_COSINE) & arrived
    met = first[own[first]]
    return rows[met], bone[met], X[met]


def _across(ray: np.ndarray) -> np.ndarray:
    """Two unit vectors (N, 2, 3) at right angles to each of unit vectors (N, 3)."""
    least = np.eye(3)[np.argmin(np.abs(ray), axis=1)]
    first = np.cross(ray, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(ray, first)], axis=1)
