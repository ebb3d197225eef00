"""Correction of patch matches for the curvature of a body that turns.

A patch is matched with an affine shape, which follows the mean of the surface that the patch covers. On a round body this mean lies below
the surface at the patch's middle, by the sag

    f = ½ (Dxx s_x² + Dyy s_y²)                                                                                  (1)

with the curvatures of the depth D and the variances s² of a patch's pixels, in full-frame pixels of the reference view. When the body turns
by R from the template's frame to the present one, the mean appears shifted against the surface's own point by f (R13, R23). The matched
shape A and the slopes g and h of the depth, measured in the two frames, determine R: the tangents (e, g·e) become (A e, h·A e), and the
normal n(g) becomes s n(h) with s² the growth of area on the surface, so that the match is biased by

    b = f (s n_xy(h) / √(1 + g²) + A g / (1 + g²)) ,   n(h) = (−h, 1) / √(1 + h²)                                (2)

b is subtracted from the match; half of it enters its sigma. On a thigh of 20 px radius b reaches a third of a pixel per radian, on a wrist
a whole pixel. Seen from the front, (1) is what flattens a cloud (surface/local_surface.py).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..geometry.camera import Camera
from ..matching.least_squares import Matches
from ..matching.region_growing import MatchedField
from ..surface.cloud import PointCloud
from ..surface.local_surface import curvatures

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

NEAREST_POINTS = 4  # of the cloud, whose normals give the slopes at a place
REMAINING_PART = 0.5  # of a correction: its standard deviation
MAX_SLOPE = 3.0  # px of depth per px across; a steeper one is limited to it
MIN_FACING = 1e-3  # cosine between a normal and the ray, below which a slope would be unbounded


@dataclass(frozen=True, eq=False, kw_only=True)
class CurvatureCorrection:
    """The measured surface of a frame as the reference view sees it.

    The local surface (3,) at a place consists of the slopes g of its depth and its sag f of (1), in full-frame pixels.
    """

    field: MatchedField
    cloud: PointCloud
    camera: Camera
    reference: int
    half_patch: tuple[int, int]  # columns and rows, of the frame's rows

    @cached_property
    def _tree(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self.field.grid.rows.to_frame(self.field.xy[:, self.reference]))

    def local_surface(self, xy: np.ndarray) -> np.ndarray:
        """The local surface (N, 3) at places (N, 2) in rows' pixels; zeros where none was measured."""
        return np.column_stack([self.slopes(xy), self._sag(xy)])

    def slopes(self, xy: np.ndarray) -> np.ndarray:
        """Slopes (N, 2) of the depth about places (N, 2), from the normals of the nearest points; zeros for NaN."""
        good, distance, near = self._nearest(xy, NEAREST_POINTS)
        normal = self.cloud.normals[near] @ self.camera.R_cam_world.T
        facing = np.einsum("nki,ni->nk", normal, self.camera.directions(self.field.grid.rows.to_frame(xy[good])))
        slope = -normal[..., :2] / np.minimum(facing, -MIN_FACING)[..., None]  # normals point towards the camera
        weight = 1 / np.maximum(distance, 1.0) ** 2
        mean = np.einsum("nk,nki->ni", weight, slope) / weight.sum(axis=1, keepdims=True)
        slopes = np.zeros((len(xy), 2))
        slopes[good] = mean * np.minimum(1.0, MAX_SLOPE / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9))
        return slopes

    def _sag(self, xy: np.ndarray) -> np.ndarray:
        """f (N,) of (1) from the nearest point's quadric, at most that of a ball as wide as the patch: a rounder quadric follows noise."""
        good, _, near = self._nearest(xy, 1)
        rows, at = np.unique(near, return_inverse=True)
        half = np.array(self.half_patch)
        variance = half * (half + 1) / 3 * (1.0, self.field.grid.rows.step**2)
        largest = 0.5 * variance.sum() / half[0]
        sag = 0.5 * curvatures(self.field, self.camera, self.reference, rows) @ variance
        f = np.zeros(len(xy))
        f[good] = np.clip(sag, -largest, largest)[at.ravel()]
        return f

    def _nearest(self, xy: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which places are numbers, and for those the distance and rows (n, count) of the nearest points."""
        good = np.isfinite(xy).all(axis=1) & (len(self.field.cell) > 0)
        if not good.any():
            return good, np.ones((0, count)), np.zeros((0, count), dtype=np.int64)
        return good, *nearest_points(self._tree, self.field.grid.rows.to_frame(xy[good]), count)

    def corrected(self, match: Matches, template: np.ndarray) -> Matches:
        """Matches in this frame without b of (2); `template` (N, 3) is the local surface where the templates were cut."""
        scale = np.array([1.0, self.field.grid.rows.step])
        b = turning_bias(match.shape * scale[:, None] / scale, template, self.slopes(match.xy)) / scale
        return replace(match, xy=match.xy - b, covariance=match.covariance + REMAINING_PART**2 * b[:, :, None] * b[:, None])


def nearest_points(tree: "cKDTree", at: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and rows (N, k) of the points in a tree nearest to places (N, 2): `count`, or all if there are fewer."""
    k = min(count, tree.n)
    distance, near = tree.query(at, k=k)
    return distance.reshape(-1, k), near.reshape(-1, k)


def turning_bias(A: np.ndarray, template: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """b (N, 2) of (2) [px], for shapes A (N, 2, 2), the templates' local surfaces (N, 3) and present slopes (N, 2); zero if undefined."""
    g, f, h = template[:, :2], template[:, 2], slopes
    tangents = np.concatenate([A, np.einsum("ni,nij->nj", h, A)[:, None]], axis=1)  # (N, 3, 2), those of the patch's axes
    area = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=1)
    long2 = 1 + (g**2).sum(axis=1)
    s = np.sqrt(area / np.sqrt(long2))
    turned = -h * (s / np.sqrt(long2 * (1 + (h**2).sum(axis=1))))[:, None] + np.einsum("nij,nj->ni", A, g) / long2[:, None]
    turned /= np.maximum(1.0, np.linalg.norm(turned, axis=1, keepdims=True))  # at most a right angle
    return np.nan_to_num(turned * f[:, None])
