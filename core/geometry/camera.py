"""The camera: central projection with Brown's distortion and affinity (Brown 1971; D'Apuzzo et al. 2000, §2.2).

    X_c = R_cam_world X + t                                                    (1)
    a = X_c / Z_c ,  b = Y_c / Z_c                                             (2)
    r² = a² + b² ,  L = 1 + k1 r² + k2 r⁴ + k3 r⁶                              (3)
    a' = a L + 2 p1 a b + p2 (r² + 2 a²)
    b' = b L + p1 (r² + 2 b²) + 2 p2 a b                                       (4)  OpenCV's order of p1, p2
    x = fx ((1 + b1) a' + b2 b') + cx ,  y = fy b' + cy                        (5)  b1 scale, b2 shear

Pixels are (x, y), the centre of the top-left pixel is (0, 0), always in the FULL frame. Space is in metres.
"""

from dataclasses import dataclass, field

import numpy as np

from ..values import frozen

UNDISTORT_STEPS = 12
UNDISTORT_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Camera:
    """One calibrated camera. `size_px` is (width, height) of the full frame."""

    name: str
    size_px: tuple[int, int]
    matrix: np.ndarray  # (3, 3) fx 0 cx / 0 fy cy / 0 0 1, pixels
    distortions: np.ndarray = field(default_factory=lambda: np.zeros(5))  # k1 k2 p1 p2 k3
    affinity: np.ndarray = field(default_factory=lambda: np.zeros(2))  # b1 scale, b2 shear
    R_cam_world: np.ndarray = field(default_factory=lambda: np.eye(3))
    t_cam_world_m: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        object.__setattr__(self, "size_px", (int(self.size_px[0]), int(self.size_px[1])))
        for name, shape in dict(matrix=(3, 3), distortions=(5,), affinity=(2,), R_cam_world=(3, 3), t_cam_world_m=(3,)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))

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
        """Pixels (…, 2) of world points (…, 3); NaN for points that do not lie before the camera."""
        return self._image(_ahead(self.to_camera(xyz_m)))

    def project_with_jacobian(self, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (…, 2) and their derivative to the world point (…, 2, 3), analytic."""
        p = _ahead(self.to_camera(xyz_m))
        a, b, inverse_z = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2], 1 / p[..., 2]
        zero = np.zeros_like(a)
        to_ab = np.stack([inverse_z, zero, -a * inverse_z, zero, inverse_z, -b * inverse_z], -1).reshape(*a.shape, 2, 3)
        jacobian = self._pixel_matrix() @ self._distortion_jacobian(a, b) @ to_ab @ self.R_cam_world
        return self._image(p), jacobian

    def directions(self, xy_px: np.ndarray) -> np.ndarray:
        """Rays in the camera's frame (…, 3) with z = 1, the inverse of (2)–(5) by Newton's method; not finite where there is none."""
        xy = np.asarray(xy_px, dtype=np.float64)
        inverse = np.linalg.inv(self._pixel_matrix())
        target = (xy - self.matrix[:2, 2]) @ inverse.T
        a, b = target[..., 0], target[..., 1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(UNDISTORT_STEPS):
                residual = self._distort(a, b) - target
                u, v = residual[..., 0], residual[..., 1]
                aa, cross, bb = self._distortion_derivatives(a, b)
                determinant = aa * bb - cross * cross
                a, b = a - (bb * u - cross * v) / determinant, b - (aa * v - cross * u) / determinant
                if np.nanmax(np.abs(residual), initial=0.0) < UNDISTORT_TOLERANCE:
                    break
        return np.stack([a, b, np.ones_like(a)], axis=-1)

    def rays(self, xy_px: np.ndarray) -> np.ndarray:
        """Ray directions in the world (…, 3), scaled so that depth z_cam = 1 per unit."""
        return self.directions(xy_px) @ self.R_cam_world

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
        k1, k2, p1, p2, k3 = self.distortions
        r2 = a * a + b * b
        L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))  # (3)
        return np.stack([a * L + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b * L + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b], axis=-1)  # (4)

    def _distortion_jacobian(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        aa, cross, bb = self._distortion_derivatives(a, b)
        return np.stack([aa, cross, cross, bb], axis=-1).reshape(*a.shape, 2, 2)

    def _distortion_derivatives(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """∂a'/∂a, ∂a'/∂b = ∂b'/∂a and ∂b'/∂b."""
        k1, k2, p1, p2, k3 = self.distortions
        r2 = a * a + b * b
        L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dL = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # dL/da = a dL, dL/db = b dL
        cross = a * b * dL + 2 * p1 * a + 2 * p2 * b
        return L + a * a * dL + 2 * p1 * b + 6 * p2 * a, cross, L + b * b * dL + 6 * p1 * b + 2 * p2 * a


def _ahead(p: np.ndarray) -> np.ndarray:
    return np.where(p[..., 2:] > 1e-6, p, np.nan)
