"""A cloud as the fit uses it: finite points, thinned to one per voxel, with a sigma along the surface normal."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...tracking.trajectories import Trajectories

VARIANCE_FLOOR_M2 = 1e-12  # of points, rays and steps whose sigma is 0
LEAST_AGREEMENT = 0.3  # length of a voxel's mean normal; of a shorter one the direction is unknown
HALF = 0.5  # between the length of a normal, 1, and that of an unknown one, 0


class Cloud(Protocol):
    """The fields of a measured cloud that the fit reads."""

    @property
    def frame(self) -> int:
        """Frame number of the take."""

    @property
    def xyz_m(self) -> np.ndarray:
        """(N, 3) world."""

    @property
    def covariance_m2(self) -> np.ndarray:
        """(N, 3, 3)."""

    @property
    def normals(self) -> np.ndarray:
        """(N, 3) unit vectors, pointing to the cameras; NaN or zero where unknown."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CloudPoints:
    """P points of one frame, ready for the fit. A normal of zeros is unknown."""

    frame: int
    xyz_m: np.ndarray  # (P, 3)
    normals: np.ndarray  # (P, 3)
    sigma_m: np.ndarray  # (P,) along the normal

    def take(self, rows: np.ndarray) -> "CloudPoints":
        """Some of the points."""
        return CloudPoints(frame=self.frame, xyz_m=self.xyz_m[rows], normals=self.normals[rows], sigma_m=self.sigma_m[rows])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackedCloud:
    """The tracked points of one frame as a cloud, without normals."""

    frame: int
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)

    @property
    def normals(self) -> np.ndarray:
        """(N, 3) zero: unknown."""
        return np.zeros_like(self.xyz_m)


def tracked_clouds(trajectories: Trajectories, frames: Sequence[int]) -> list[TrackedCloud]:
    """The clouds of the kept trajectories in these frames, cleaned by tracking; empty in frames without tracks.

    A sigma is that of the whole vector; its direction is not known, so a third of the variance belongs to each axis.
    """
    found, at = [], {frame: t for t, frame in enumerate(trajectories.frames.tolist())}
    for frame in frames:
        seen = trajectories.visible[at[frame]] if frame in at else np.zeros(trajectories.sigma_m.shape[1], dtype=bool)
        t = at.get(frame, 0)
        variance = trajectories.sigma_m[t, seen] ** 2 / 3
        found.append(TrackedCloud(frame=frame, xyz_m=trajectories.xyz_m[t, seen], covariance_m2=variance[:, None, None] * np.eye(3)))
    return found


def thinned(cloud: Cloud, voxel_m: float) -> CloudPoints:
    """The centre of gravity of the points in every voxel, in the order of the voxels; points that are not finite are left out.

    The sigma is that of one point: neighbours share their errors.
    """
    xyz, normals = np.asarray(cloud.xyz_m, dtype=np.float64).reshape(-1, 3), np.asarray(cloud.normals, dtype=np.float64).reshape(-1, 3)
    covariance = np.asarray(cloud.covariance_m2, dtype=np.float64).reshape(-1, 3, 3)
    good = np.isfinite(xyz).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    xyz, normals, covariance = xyz[good], np.nan_to_num(normals[good]), covariance[good]
    sigma = _sigma_along(normals, covariance)
    cells = np.floor(xyz / voxel_m).astype(np.int64)
    if not len(cells):
        return CloudPoints(frame=int(cloud.frame), xyz_m=xyz, normals=normals, sigma_m=sigma)
    _, which, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    mean = [
        np.stack([np.bincount(which, column) for column in table.T], axis=1) / count[:, None] for table in (xyz, normals, sigma[:, None])
    ]
    length = np.linalg.norm(mean[1], axis=1, keepdims=True)
    normals = mean[1] / np.where(length > LEAST_AGREEMENT, length, np.inf)
    return CloudPoints(frame=int(cloud.frame), xyz_m=mean[0], normals=normals, sigma_m=mean[2][:, 0])


def _sigma_along(normals: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    along = np.einsum("ni,nij,nj->n", normals, covariance, normals)
    mean = np.trace(covariance, axis1=1, axis2=2) / 3
    return np.sqrt(np.maximum(np.where(np.linalg.norm(normals, axis=1) > HALF, along, mean), 0.0))
