"""The surface by semi-global matching, coarse but nearly complete: also where texture is too weak or a limb too thin for a patch.

The reference view is matched with each neighbouring view in rectified images (Hirschmüller 2008, IEEE TPAMI 30(2); OpenCV's
implementation), which minimises over the disparities d of all pixels

    E = Σ_p C(p, d_p) + Σ_{q ∈ N(p)} P₁ [|d_p − d_q| = 1] + P₂ [|d_p − d_q| > 1]                                                (1)

Depths z along a ray of the reference view, and their sigma, follow from the base b and the camera constant f:

    z = f b / d ,   σ_z = z² / (f b) σ_d                                                                                        (2)

A depth counts if two neighbouring views agree on it; where there is only one, if matching it backwards leads to the same pixel. A least
squares patch is ten times as precise, but needs texture all over its 13×13 pixels, and a surface that does not end within them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from ..foundation.arrays import frozen
from ..geometry.camera import Camera
from ..images.interlace import RowGrid

PIXEL_M = 0.0036  # at the person, of the rectified images: finer ones are reduced
LEAST_REDUCTION = 1.3  # of images; less is not worth the loss
FAR_PX = 1e4  # outside every image
SPACING = 4  # pixels, of the points: as far apart as measured ones
DEPTH_MARGIN_M, SIDE_MARGIN_M = 0.3, 0.25  # beyond the measured points, by which a limb may exceed them
PERCENT = (1.0, 99.0)  # of the points' coordinates, that limit the region
FURTHEST_APART = 0.7  # the base over the depth: views of two neighbours that are further apart do not look alike
BLOCK = 3  # pixels, of C in (1)
SMALL_STEP, LARGE_STEP = 8 * BLOCK**2, 32 * BLOCK**2  # P1, P2 in (1), as OpenCV recommends
UNIQUE_PERCENT, BACKWARDS_PX, SPECKLE_PX, SPECKLE_RANGE, CLIPPED = 5, 1, 60, 2, 31
MOST_DISPARITIES = 256
AGREE_M = 0.03  # depths of two pairs of views
SIGMA_PX = 0.5  # of a disparity, with what neighbouring pixels have in common
SMOOTH = 7  # pixels over which the surface is averaged for a normal
FILLED = 0.3  # of these, at least
LARGEST_STEP_M = 0.08  # across them, of a surface that does not end there


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CoarseSurface:
    """N points of one frame, in the world; normals point towards the reference view, zero where they are unknown."""

    xyz_m: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3)
    sigma_m: np.ndarray  # (N,)

    def __post_init__(self) -> None:
        n = len(self.xyz_m)
        for name, shape in dict(xyz_m=(n, 3), normals=(n, 3), sigma_m=(n,)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))


NO_SURFACE = CoarseSurface(xyz_m=np.zeros((0, 3)), normals=np.zeros((0, 3)), sigma_m=np.zeros(0))


def coarse_surface(
    images: Sequence[np.ndarray], cameras: Sequence[Camera], reference: int, near_m: np.ndarray, rows: RowGrid | None = None
) -> CoarseSurface:
    """The surface about points (M, 3) of a person, as the reference view sees it, from grey images (h, w) of all views.

    `rows`: which rows of the frame the images hold. There are no points where no other view is near enough.
    """
    camera, grid = cameras[reference], rows or RowGrid()
    depth = camera.to_camera(near_m)[:, 2]
    if not len(depth) or np.percentile(depth, PERCENT[0]) <= DEPTH_MARGIN_M:
        return NO_SURFACE
    region = _Region.of(camera, near_m, depth)
    others = [other for k, other in enumerate(cameras) if k != reference and _is_near(camera, other, region.middle_m)]
    if not others:
        return NO_SURFACE
    pictures = {c.name: _Picture.of(c, images[k], grid, region.focal_px) for k, c in enumerate(cameras) if c is camera or c in others}
    depths = np.stack([_Pair.of(pictures[camera.name], pictures[other.name], region).depths() for other in others])
    z, count = _agreed(depths)
    sigma = z**2 / region.focal_px * SIGMA_PX / np.mean([np.linalg.norm(o.centre_m - camera.centre_m) for o in others])
    xyz = camera.centre_m + region.rays * z[..., None]
    normals = _normals(xyz, camera.centre_m)
    at = np.zeros(z.shape, dtype=bool)
    at[::SPACING, ::SPACING] = True
    at &= np.isfinite(z) & camera.sees(camera.project(camera.centre_m + region.rays))
    return CoarseSurface(xyz_m=xyz[at], normals=normals[at], sigma_m=sigma[at] / np.sqrt(count[at]))  # (2)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Region:
    """The depths, and a lattice of rays of the reference view without distortion, in which a person is."""

    camera: Camera
    depth_range_m: tuple[float, float]
    corners_m: np.ndarray  # (8, 3) of the box about the person
    middle_m: np.ndarray  # (3,)
    focal_px: float

    @staticmethod
    def of(camera: Camera, near_m: np.ndarray, depth_m: np.ndarray) -> "_Region":
        low, high = np.percentile(near_m, PERCENT, axis=0) + np.array([[-SIDE_MARGIN_M], [SIDE_MARGIN_M]])
        near, far = np.percentile(depth_m, PERCENT)
        middle = float(np.median(depth_m))
        return _Region(
            camera=camera,
            depth_range_m=(float(near) - DEPTH_MARGIN_M, float(far) + DEPTH_MARGIN_M),
            corners_m=np.array(np.meshgrid(*zip(low, high))).reshape(3, -1).T,
            middle_m=np.median(near_m, axis=0),
            focal_px=min(camera.focal_px, middle / PIXEL_M),
        )

    @cached_property
    def rays(self) -> np.ndarray:
        """(h, w, 3) in the world, of depth 1."""
        low, size = self.window(self.camera.R_cam_world)
        x, y = np.meshgrid(np.arange(size[0]) + low[0], np.arange(size[1]) + low[1])
        return np.stack([x / self.focal_px, y / self.focal_px, np.ones_like(x)], axis=-1) @ self.camera.R_cam_world

    def window(self, R: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
        """First pixel (2,) and size of the image that contains the person, of the reference camera turned to R, its axis at (0, 0)."""
        p = (self.corners_m - self.camera.centre_m) @ R.T
        xy = self.focal_px * p[:, :2] / np.maximum(p[:, 2:], self.depth_range_m[0])
        edge = self.focal_px * np.array(self.camera.size_px) / self.camera.focal_px  # no further than the camera sees, and some more
        low, high = np.maximum(np.floor(xy.min(axis=0)), -edge), np.minimum(np.ceil(xy.max(axis=0)), edge)
        width, height = np.maximum(high - low, 1).astype(int)
        return np.floor(low), (int(width), int(height))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Picture:
    """An image of one view, and the camera and rows that belong to it."""

    image: np.ndarray  # (h, w) uint8
    camera: Camera
    rows: RowGrid

    @staticmethod
    def of(camera: Camera, image: np.ndarray, rows: RowGrid, focal_px: float) -> "_Picture":
        """The image, reduced to about a camera constant."""
        factor = camera.focal_px / focal_px
        if factor > LEAST_REDUCTION and rows.step == 1:
            camera = camera.resized((max(1, round(camera.size_px[0] / factor)), max(1, round(camera.size_px[1] / factor))))
            image = cv2.resize(image, camera.size_px, interpolation=cv2.INTER_AREA)
        return _Picture(image=np.clip(np.rint(image), 0, 255).astype(np.uint8), camera=camera, rows=rows)

    def seen_along(self, rays: np.ndarray) -> np.ndarray:
        """The grey values (h, w) uint8 along rays (h, w, 3) in the world."""
        at = np.nan_to_num(self.rows.from_frame(self.camera.project(self.camera.centre_m + rays)), nan=-FAR_PX).clip(-FAR_PX, FAR_PX)
        return np.asarray(cv2.remap(self.image, at.astype(np.float32), None, cv2.INTER_LINEAR))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Pair:
    """The reference view and another one, rectified: both look along z, and their base is along x."""

    base: _Picture
    other: _Picture
    region: _Region
    R: np.ndarray  # (3, 3) world → rectified
    base_m: float
    first: int  # the smallest disparity
    count: int

    @staticmethod
    def of(base: _Picture, other: _Picture, region: _Region) -> "_Pair":
        apart = other.camera.centre_m - base.camera.centre_m
        base_m = float(np.linalg.norm(apart))
        x = -apart / base_m  # so that d > 0: what the reference view sees at u, the other one sees at u + d
        ahead = base.camera.R_cam_world[2] + other.camera.R_cam_world[2]
        z = ahead - (ahead @ x) * x
        z /= np.linalg.norm(z)
        near, far = region.depth_range_m
        first = int(np.floor(region.focal_px * base_m / far)) - 1
        count = int(np.ceil((region.focal_px * base_m / near + 2 - first) / 16) * 16)
        return _Pair(
            base=base,
            other=other,
            region=region,
            R=np.stack([x, np.cross(z, x), z]),
            base_m=base_m,
            first=first,
            count=min(count, MOST_DISPARITIES),
        )

    def depths(self) -> np.ndarray:
        """The depths (h, w) [m] along the region's rays; NaN where none was found."""
        low, (width, height) = self.region.window(self.R)
        f, margin = self.region.focal_px, self.count
        x, y = np.meshgrid(np.arange(-margin, width + margin) + low[0], np.arange(height) + low[1])
        images = [self._image(self.base, x, y), self._image(self.other, x + self.first, y)]
        left, right = (np.ascontiguousarray(image[:, ::-1]) for image in images)  # OpenCV looks for u − d
        found = self._matcher().compute(left, right)[:, ::-1][:, margin : margin + width].astype(np.float64) / 16
        with np.errstate(divide="ignore"):
            along_z = np.where(found > 0, f * self.base_m / (found + self.first), np.nan)  # (2)
        p = self.region.rays @ self.R.T
        at = np.rint(f * p[..., :2] / p[..., 2:] - low).astype(int)
        inside = (at >= 0).all(axis=-1) & (at[..., 0] < width) & (at[..., 1] < height)
        i, j = np.where(inside[..., None], at, 0).transpose(2, 0, 1)
        return np.asarray(np.where(inside, along_z[j, i], np.nan) / p[..., 2])

    def _image(self, picture: _Picture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The rectified image (h, w) at places x, y (h, w)."""
        f = self.region.focal_px
        return picture.seen_along(np.stack([x / f, y / f, np.ones_like(x)], axis=-1) @ self.R)

    def _matcher(self) -> cv2.StereoSGBM:
        return cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=self.count,
            blockSize=BLOCK,
            P1=SMALL_STEP,
            P2=LARGE_STEP,
            disp12MaxDiff=BACKWARDS_PX,
            preFilterCap=CLIPPED,
            uniquenessRatio=UNIQUE_PERCENT,
            speckleWindowSize=SPECKLE_PX,
            speckleRange=SPECKLE_RANGE,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )


def _is_near(camera: Camera, other: Camera, at_m: np.ndarray) -> bool:
    """Whether two views look at a place (3,) from the same side, so that they look alike."""
    depth = [float(c.to_camera(at_m[None])[0, 2]) for c in (camera, other)]
    apart = float(np.linalg.norm(camera.centre_m - other.centre_m))
    return min(depth) > 0 and 0 < apart < FURTHEST_APART * min(depth)


def _agreed(depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean (h, w) of depths (P, h, w) of pairs of views that agree, NaN where fewer than two do (of one pair: where it has none), and
    their number (h, w)."""
    if len(depths) == 1:
        return depths[0], np.ones(depths[0].shape)
    known = np.isfinite(depths)
    filled = np.where(known, depths, np.inf)
    order = np.sort(filled, axis=0)
    middle = order[np.maximum(known.sum(axis=0) - 1, 0) // 2, *np.indices(order.shape[1:])]  # the lower median
    agrees = known & (np.abs(np.where(known, depths, 0.0) - np.where(np.isfinite(middle), middle, np.inf)) < AGREE_M)
    count = agrees.sum(axis=0)
    total = np.where(agrees, depths, 0.0).sum(axis=0)
    return np.where(count > 1, total / np.maximum(count, 1), np.nan), np.maximum(count, 1)


def _normals(xyz_m: np.ndarray, eye_m: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) of a lattice of points (h, w, 3), towards a place (3,); zero where the surface ends."""
    known = np.isfinite(xyz_m[..., 0])
    share = cv2.blur(known.astype(np.float64), (SMOOTH, SMOOTH))
    smooth = np.stack([cv2.blur(np.where(known, c, 0.0), (SMOOTH, SMOOTH)) for c in np.moveaxis(xyz_m, -1, 0)], axis=-1)
    smooth = np.where((share > FILLED)[..., None], smooth / np.maximum(share, FILLED)[..., None], np.nan)
    half = SMOOTH // 2
    right, down = np.full(smooth.shape, np.nan), np.full(smooth.shape, np.nan)
    right[:, half:-half] = smooth[:, 2 * half :] - smooth[:, : -2 * half]
    down[half:-half] = smooth[2 * half :] - smooth[: -2 * half]
    whole = (np.linalg.norm(right, axis=-1) < LARGEST_STEP_M) & (np.linalg.norm(down, axis=-1) < LARGEST_STEP_M)
    normal = np.where(whole[..., None], np.cross(down, right), 0.0)
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    towards = np.einsum("hwc,hwc->hw", normal, np.nan_to_num(eye_m - xyz_m)) < 0
    return np.asarray(np.where(size > 0, normal / np.maximum(size, 1e-300), 0.0) * np.where(towards, -1.0, 1.0)[..., None])
