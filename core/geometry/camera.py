"""The camera: central projection with Brown's distortion and affinity (Brown 1971; D'Apuzzo et al. 2000, §2.2).

    X_c = R_cam_world X + t                                                    (1)
    a = X_c / Z_c ,  b = Y_c / Z_c                                             (2)
    r² = a² + b² ,  L = 1 + k1 r² + k2 r⁴ + k3 r⁶                              (3)
    a' = a L + 2 p1 a b + p2 (r² + 2 a²)
    b' = b L + p1 (r² + 2 b²) + 2 p2 a b                                       (4)  OpenCV's order of p1, p2
    x = fx ((1 + b1) a' + b2 b') + cx ,  y = fy b' + cy                        (5)  b1 scale, b2 shear

Of a fisheye lens, (3) and (4) are those of `fisheye`; in the order of `INTERIOR`, its k4 is in the place of p1, and p2 is 0.

Pixels are (x, y), the centre of the top-left pixel is (0, 0), always in the FULL frame. Space is in metres.

Derivatives of the camera's equations with respect to its own unknowns: 10 of the interior and 6 of the exterior orientation.

With the camera's equations (1)–(5) of `camera`, fx = fy = f (the difference is the affinity b1), and a small turn ω about the
projection centre followed by a shift δ,

    X_c ← exp([ω]×) X_c + δ                                                    (6)
    ∂X_c/∂ω = −[X_c]× ,   ∂X_c/∂δ = I                                          (7)

The interior unknowns are those of Brown (1971) with affinity and shear, in the order of `INTERIOR`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..foundation.arrays import frozen
from . import fisheye as lens
from .rotation import cross_matrix

UNDISTORT_STEPS = 12  # of Newton's method
UNDISTORT_TOLERANCE = 1e-12  # of normalised coordinates
SAME_PX = 0.01
NEAREST_M = 1e-6  # in front of the camera
ROUNDED = 1e-6
LARGEST_SKEW = 0.05  # of a focal length: rows of pixels that are turned by 3 degrees against their columns


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Camera:
    """One calibrated camera. `size_px` is (width, height) of the full frame."""

    name: str
    size_px: tuple[int, int]
    matrix: np.ndarray  # (3, 3) fx 0 cx / 0 fy cy / 0 0 1, pixels
    distortions: np.ndarray = field(default_factory=lambda: np.zeros(5))  # k1 k2 p1 p2 k3; of a fisheye lens k1 k2 k3 k4 0
    affinity: np.ndarray = field(default_factory=lambda: np.zeros(2))  # b1 scale, b2 shear
    R_cam_world: np.ndarray = field(default_factory=lambda: np.eye(3))
    t_cam_world_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    fisheye: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "size_px", (int(self.size_px[0]), int(self.size_px[1])))
        for name, shape in dict(matrix=(3, 3), distortions=(5,), affinity=(2,), R_cam_world=(3, 3), t_cam_world_m=(3,)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))

    def resized(self, size_px: tuple[int, int]) -> "Camera":
        """The camera of images resized to (width, height); the corners of the images stay where they are."""
        scale = np.array(size_px) / self.size_px
        matrix = self.matrix.copy()
        matrix[:2] *= scale[:, None]
        matrix[:2, 2] += (scale - 1) / 2
        return replace(self, size_px=size_px, matrix=matrix)

    @property
    def focal_px(self) -> float:
        """Mean camera constant in pixels."""
        return float((self.matrix[0, 0] + self.matrix[1, 1]) / 2)

    @property
    def centre_m(self) -> np.ndarray:
        """Projection centre (3,) in the world."""
        return -self.R_cam_world.T @ self.t_cam_world_m

    def to_camera(self, xyz_m: np.ndarray) -> np.ndarray:
        """World points (…, 3) in the camera's frame (…, 3): x right, y down, z forward.  (1)"""
        return np.asarray(xyz_m, dtype=np.float64) @ self.R_cam_world.T + self.t_cam_world_m

    def project(self, xyz_m: np.ndarray) -> np.ndarray:
        """Pixels (…, 2) of world points (…, 3); NaN for points that are not in front of the camera."""
        return self._image(_ahead(self.to_camera(xyz_m)))

    def project_with_depth(self, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (…, 2) of world points (…, 3) as from `project`, and their depths z_cam (…,) [m]."""
        p = self.to_camera(xyz_m)
        return self._image(_ahead(p)), p[..., 2]

    def project_with_jacobian(self, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (…, 2) and their derivative to the world point (…, 2, 3), analytic."""
        p = _ahead(self.to_camera(xyz_m))
        a, b, inverse_z = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2], 1 / p[..., 2]
        jacobian = _pixel_jacobian(self._pixel_matrix(), a, b, inverse_z, self._distortion_derivatives(a, b)) @ self.R_cam_world
        return self._image(p), jacobian

    def directions(self, xy_px: np.ndarray, steps: int = UNDISTORT_STEPS) -> np.ndarray:
        """Rays in the camera's frame (…, 3) with z = 1, the inverse of (2)–(5) by Newton's method; not finite where there is none.

        Fewer `steps` than by default give approximate rays.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        inverse = np.linalg.inv(self._pixel_matrix())
        target = (xy - self.matrix[:2, 2]) @ inverse.T
        if self.fisheye:
            d = np.linalg.norm(target, axis=-1)
            stretch = np.tan(lens.angle_of(self.distortions[:4], d)) / np.where(d > 0, d, 1.0)
            return np.concatenate([target * np.where(d > 0, stretch, 1.0)[..., None], np.ones_like(target[..., :1])], axis=-1)
        a, b = target[..., 0], target[..., 1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(steps):
                residual = self._distort(a, b) - target
                u, v = residual[..., 0], residual[..., 1]
                aa, cross, bb = self._distortion_derivatives(a, b)
                determinant = aa * bb - cross * cross
                a, b = a - (bb * u - cross * v) / determinant, b - (aa * v - cross * u) / determinant
                if np.nanmax(np.abs(residual), initial=0.0) < UNDISTORT_TOLERANCE:
                    break
        return np.stack([a, b, np.ones_like(a)], axis=-1)

    @property
    def field_radius(self) -> float:
        """The largest √(a² + b²) in the image: of its corners, or of the edge of a fisheye lens that ends before them."""
        w, h = self.size_px
        corners = self.directions(np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]]))
        radius = np.linalg.norm(corners[:, :2], axis=1)
        return float(np.where(np.isfinite(radius), radius, lens.FARTHEST).max() if self.fisheye else radius.max())

    @property
    def is_invertible(self) -> bool:
        """Whether every point in the middle half of the image has a ray of its own: a lens that folds the image there is none."""
        w, h = self.size_px
        x, y = np.meshgrid(np.linspace(w / 4, 3 * w / 4, 9), np.linspace(h / 4, 3 * h / 4, 9))
        xy = np.stack([x, y], axis=-1)
        with np.errstate(all="ignore"):
            return bool((np.abs(self._image(self.directions(xy)) - xy) < SAME_PX).all())

    def rays(self, xy_px: np.ndarray, steps: int = UNDISTORT_STEPS) -> np.ndarray:
        """Ray directions in the world (…, 3), scaled so that depth z_cam = 1 per unit; `steps` as in `directions`."""
        return self.directions(xy_px, steps) @ self.R_cam_world

    def points_at_depth(self, xy_px: np.ndarray, depth_m: np.ndarray | float) -> np.ndarray:
        """World points (…, 3) on the rays of the pixels at depth z_cam [m]."""
        return self.centre_m + self.rays(xy_px) * np.asarray(depth_m)[..., None]

    def sees(self, xy_px: np.ndarray, margin_px: float = 0.0) -> np.ndarray:
        """Whether pixels (…, 2) lie inside the frame by at least `margin_px`; NaN does not."""
        xy = np.asarray(xy_px)
        w, h = self.size_px
        with np.errstate(invalid="ignore"):
            return (
                (xy[..., 0] >= margin_px)
                & (xy[..., 1] >= margin_px)
                & (xy[..., 0] <= w - 1 - margin_px)
                & (xy[..., 1] <= h - 1 - margin_px)
            )

    def _pixel_matrix(self) -> np.ndarray:
        fx, fy, (b1, b2) = self.matrix[0, 0], self.matrix[1, 1], self.affinity
        return np.array([[fx * (1 + b1), fx * b2 + self.matrix[0, 1]], [0.0, fy]])

    def _image(self, p: np.ndarray) -> np.ndarray:
        return self._distort(p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]) @ self._pixel_matrix().T + self.matrix[:2, 2]  # (5)

    def _distort(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        if self.fisheye:
            return np.stack([a, b], axis=-1) * lens.scale(self.distortions[:4], a, b)[0][..., None]
        return np.stack(_brown(self.distortions, a, b), axis=-1)

    def _distortion_derivatives(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """∂a'/∂a, ∂a'/∂b = ∂b'/∂a and ∂b'/∂b."""
        if self.fisheye:
            S, Q, _ = lens.scale(self.distortions[:4], a, b)
            return S + a * a * Q, a * b * Q, S + b * b * Q
        return _brown_derivatives(self.distortions, a, b)


def is_camera_matrix(matrix: np.ndarray) -> bool:
    """Whether a matrix (3, 3) can be that of a camera, but for rounding: an upper triangle with 1 at its end and hardly any skew."""
    fx, fy = matrix[0, 0], matrix[1, 1]
    rounded = abs(matrix[1, 0]) <= ROUNDED * fx and np.allclose(matrix[2], [0, 0, 1], rtol=0, atol=ROUNDED)
    return bool(fx > 0 and fy > 0 and abs(matrix[0, 1]) <= LARGEST_SKEW * fx and rounded)


def project_all(cameras: Sequence[Camera], xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (K, N, 2) of world points (N, 3) in K cameras, and their derivatives to the points (K, N, 2, 3), as
    `Camera.project_with_jacobian`, all cameras at once unless one has a fisheye lens."""
    if any(camera.fisheye for camera in cameras):
        found = [camera.project_with_jacobian(xyz_m) for camera in cameras]
        return np.stack([x for x, _ in found]), np.stack([J for _, J in found])
    R = np.stack([camera.R_cam_world for camera in cameras])
    p = _ahead(np.asarray(xyz_m, dtype=np.float64) @ R.transpose(0, 2, 1) + np.stack([c.t_cam_world_m for c in cameras])[:, None])
    inverse_z = 1 / p[..., 2]
    a, b = p[..., 0] * inverse_z, p[..., 1] * inverse_z
    distortions = np.stack([camera.distortions for camera in cameras], axis=1)[..., None]  # (5, K, 1)
    pixels = np.stack([camera._pixel_matrix() for camera in cameras])
    centre = np.stack([camera.matrix[:2, 2] for camera in cameras])[:, None]
    xy = np.stack(_brown(distortions, a, b), axis=-1) @ pixels.transpose(0, 2, 1) + centre
    elements = np.moveaxis(pixels, 0, -1)[..., None]  # (2, 2, K, 1)
    return xy, _pixel_jacobian(elements, a, b, inverse_z, _brown_derivatives(distortions, a, b)) @ R[:, None]


def _brown(distortions: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3 = distortions
    r2 = a * a + b * b
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))  # (3)
    return a * L + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b * L + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b  # (4)


def _brown_derivatives(distortions: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """∂a'/∂a, ∂a'/∂b = ∂b'/∂a and ∂b'/∂b of (3) and (4)."""
    k1, k2, p1, p2, k3 = distortions
    r2 = a * a + b * b
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dL = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # dL/da = a dL, dL/db = b dL
    cross = a * b * dL + 2 * p1 * a + 2 * p2 * b
    return L + a * a * dL + 2 * p1 * b + 6 * p2 * a, cross, L + b * b * dL + 6 * p1 * b + 2 * p2 * a


def _pixel_jacobian(
    pixels: np.ndarray, a: np.ndarray, b: np.ndarray, inverse_z: np.ndarray, derivatives: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> np.ndarray:
    """Derivatives (…, 2, 3) of pixels to a point in the camera's frame, element by element: numpy's products of single small matrices take
    several times as long."""
    aa, cross, bb = derivatives
    out = np.empty((*a.shape, 2, 3))
    for i, (x, y) in enumerate(pixels):
        u, v = (x * aa + y * cross) * inverse_z, (x * cross + y * bb) * inverse_z
        out[..., i, 0], out[..., i, 1], out[..., i, 2] = u, v, -(a * u + b * v)
    return out


def _ahead(p: np.ndarray) -> np.ndarray:
    return np.where(p[..., 2:] > NEAREST_M, p, np.nan)


INTERIOR = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
EXTERIOR = ("turn x", "turn y", "turn z", "shift x", "shift y", "shift z")


def interior_of(camera: Camera) -> np.ndarray:
    """The ten interior unknowns (10,) of a camera, in the order of `INTERIOR`; pixels for f, cx, cy."""
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    k1, k2, p1, p2, k3 = camera.distortions[[0, 1, 3, 4, 2]] if camera.fisheye else camera.distortions
    b1 = fx * (1 + camera.affinity[0]) / fy - 1
    b2 = (fx * camera.affinity[1] + camera.matrix[0, 1]) / fy
    return np.array([fy, camera.matrix[0, 2], camera.matrix[1, 2], k1, k2, k3, p1, p2, b1, b2])


def camera_of(
    name: str, size_px: tuple[int, int], interior: np.ndarray, R_cam_world: np.ndarray, t_cam_world_m: np.ndarray, fisheye: bool = False
) -> Camera:
    """The camera with these interior unknowns (10,) and pose."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = interior
    return Camera(
        name=name,
        size_px=size_px,
        matrix=np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]),
        distortions=np.array([k1, k2, k3, p1, 0.0] if fisheye else [k1, k2, p1, p2, k3]),
        fisheye=fisheye,
        affinity=np.array([b1, b2]),
        R_cam_world=R_cam_world,
        t_cam_world_m=t_cam_world_m,
    )


Kinds = np.ndarray | bool  # (…,) which cameras have a fisheye lens


def _fisheye_terms(interior: np.ndarray, a: np.ndarray, b: np.ndarray) -> lens.Terms:
    return lens.scale(np.moveaxis(interior[..., [3, 4, 5, 6]], -1, 0)[..., None], a, b)


def image_of(interior: np.ndarray, xyz_cam_m: np.ndarray, fisheye: Kinds = False) -> np.ndarray:
    """Pixels (…, M, 2) of points (…, M, 3) in the frames of cameras with interior unknowns (…, 10)."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = np.moveaxis(interior, -1, 0)[..., None]
    a, b = xyz_cam_m[..., 0] / xyz_cam_m[..., 2], xyz_cam_m[..., 1] / xyz_cam_m[..., 2]
    r2, ab2 = a * a + b * b, 2 * a * b
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    a1 = a * L + p1 * ab2 + p2 * (r2 + 2 * a * a)
    b1_ = b * L + p1 * (r2 + 2 * b * b) + p2 * ab2
    if np.any(fisheye):
        S = _fisheye_terms(interior, a, b)[0]
        a1, b1_ = (np.where(np.asarray(fisheye)[..., None], v * S, brown) for v, brown in ((a, a1), (b, b1_)))
    return np.stack([f * ((1 + b1) * a1 + b2 * b1_) + cx, f * b1_ + cy], axis=-1)


def image_with_derivatives(
    interior: np.ndarray, xyz_cam_m: np.ndarray, fisheye: Kinds = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (…, M, 2), their derivatives to the interior unknowns (…, M, 2, 10) and to the points (…, M, 2, 3), analytic.

    `interior` (…, 10), `xyz_cam_m` (…, M, 3) in front of the cameras (z > 0).
    """
    image, J, G = columns_of_derivatives(interior, np.moveaxis(xyz_cam_m, -1, -2), fisheye)
    return np.moveaxis(image, -1, -2), np.moveaxis(J, -1, -3).swapaxes(-1, -2), np.moveaxis(G, -1, -3)


def columns_of_derivatives(
    interior: np.ndarray, xyz_cam_m: np.ndarray, fisheye: Kinds = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same with the points last, for vectorisation: from (…, 3, M) the pixels (…, 2, M), (…, 10, 2, M), (…, 2, 3, M)."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = np.moveaxis(interior, -1, 0)[..., None]
    w = 1 / xyz_cam_m[..., 2, :]
    a, b = xyz_cam_m[..., 0, :] * w, xyz_cam_m[..., 1, :] * w
    aa, bb, ab2 = a * a, b * b, 2 * a * b
    r2 = aa + bb
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    a1 = a * L + p1 * ab2 + p2 * (r2 + 2 * aa)
    b1_ = b * L + p1 * (r2 + 2 * bb) + p2 * ab2
    curved = np.asarray(fisheye)[..., None] if np.any(fisheye) else None
    if curved is not None:
        S, Q, per_r = _fisheye_terms(interior, a, b)
        a1, b1_ = np.where(curved, a * S, a1), np.where(curved, b * S, b1_)
    fs, fb = f * (1 + b1), f * b2
    x0 = (1 + b1) * a1 + b2 * b1_
    J = np.zeros((*a.shape[:-1], len(INTERIOR), 2, a.shape[-1]))
    x, y = J[..., 0, :], J[..., 1, :]
    x[..., 0, :], y[..., 0, :] = x0, b1_
    x[..., 1, :] = y[..., 2, :] = 1.0
    x[..., 3, :], y[..., 3, :] = (fs * a + fb * b) * r2, f * b * r2
    for column in (4, 5):
        np.multiply(J[..., column - 1, :, :], r2[..., None, :], out=J[..., column, :, :])
    x[..., 6, :], y[..., 6, :] = fs * ab2 + fb * (r2 + 2 * bb), f * (r2 + 2 * bb)
    x[..., 7, :], y[..., 7, :] = fs * (r2 + 2 * aa) + fb * ab2, f * ab2
    x[..., 8, :], x[..., 9, :] = f * a1, f * b1_
    dL = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    cross = a * b * dL + 2 * p1 * a + 2 * p2 * b
    da_a, db_b = L + aa * dL + 2 * p1 * b + 6 * p2 * a, L + bb * dL + 6 * p1 * b + 2 * p2 * a
    if curved is not None:
        t = (per_r * per_r) * r2  # θ²
        for n, column in enumerate((3, 4, 5, 6), start=1):
            by_k = per_r * t**n
            x[..., column, :] = np.where(curved, (fs * a + fb * b) * by_k, x[..., column, :])
            y[..., column, :] = np.where(curved, f * b * by_k, y[..., column, :])
        x[..., 7, :], y[..., 7, :] = np.where(curved, 0.0, x[..., 7, :]), np.where(curved, 0.0, y[..., 7, :])
        da_a, cross, db_b = (np.where(curved, *pair) for pair in ((S + aa * Q, da_a), (a * b * Q, cross), (S + bb * Q, db_b)))
    G = np.empty((*a.shape[:-1], 2, 3, a.shape[-1]))
    G[..., 0, 0, :], G[..., 0, 1, :] = (fs * da_a + fb * cross) * w, (fs * cross + fb * db_b) * w
    G[..., 1, 0, :], G[..., 1, 1, :] = f * cross * w, f * db_b * w
    G[..., 2, :] = -(a[..., None, :] * G[..., 0, :] + b[..., None, :] * G[..., 1, :])
    return np.stack([f * x0 + cx, f * b1_ + cy], axis=-2), J, G


def exterior_derivatives(G: np.ndarray, xyz_cam_m: np.ndarray) -> np.ndarray:
    """Derivatives (…, 2, 6) of pixels to turn and shift (6), from those to the point in the camera's frame (…, 2, 3).  (7)"""
    return np.concatenate([-G @ cross_matrix(xyz_cam_m), G], axis=-1)


def columns_of_exterior(G: np.ndarray, xyz_cam_m: np.ndarray) -> np.ndarray:
    """The same with the points last: (…, 6, 2, M) from (…, 2, 3, M) and (…, 3, M)."""
    x, y, z = (xyz_cam_m[..., None, n, :] for n in range(3))
    gx, gy, gz = (G[..., n, :] for n in range(3))
    return np.stack([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx, gx, gy, gz], axis=-3)  # −g [X]× = X × g
