"""Clouds completed by the coarse surface of the person: where no patch could be matched, semi-global matching still sees the limb.

Its points count inside the person's outline in all views, and where no measured point is near.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ...foundation.progress import Monitor
from ...geometry.rig import Rig
from ...matching.semi_global import CoarseSurface
from ...results.folder import Results
from ...surface.cloud import PointCloud
from ...surface.coarse import coarse_surfaces
from ...take.footage import Footage
from ...tracking.trajectories import Trajectories
from ..settings import FitSettings
from .cloud_points import Cloud, tracked_clouds
from .fit_input import BackgroundDistances

EDGE = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))  # cells at the outline: a person's depth there reaches over the background
NEAR_M = 0.014  # a measured point so near is the better one


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CompletedCloud:
    """The measured points of one frame, then those of the coarse surface."""

    frame: int
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    normals: np.ndarray  # (N, 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class CompletedClouds(Sequence[Cloud]):
    """Those of all frames, each made on access."""

    clouds: Sequence[PointCloud]
    coarse: Sequence[CoarseSurface]
    rig: Rig
    background: Sequence[BackgroundDistances]

    def __len__(self) -> int:
        return len(self.clouds)

    def __getitem__(self, index: int) -> Cloud:  # type: ignore[override]
        cloud, coarse = self.clouds[index], self.coarse[index]
        rows = np.flatnonzero(self._of_the_person(cloud.frame, coarse.xyz_m))
        rows = rows[_far(coarse.xyz_m[rows], cloud.xyz_m)]
        return CompletedCloud(
            frame=cloud.frame,
            xyz_m=np.concatenate([cloud.xyz_m, coarse.xyz_m[rows]]),
            covariance_m2=np.concatenate([cloud.covariance_m2, coarse.sigma_m[rows, None, None] ** 2 * np.eye(3)]),
            normals=np.concatenate([cloud.normals, coarse.normals[rows]]),
        )

    def _of_the_person(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        """Whether points (N, 3) are inside the person's outline, and not at it, in all views in which the background is known."""
        inside, known = np.ones(len(xyz_m), dtype=bool), False
        for view in self.background:
            distance = view.of_frame(frame)
            if distance is None:
                continue
            known = True
            within = cv2.erode((distance == 0).astype(np.uint8), EDGE, borderType=cv2.BORDER_CONSTANT, borderValue=1)
            at = np.floor((self.rig[view.view].project(xyz_m) + 0.5) / view.step_px)
            with np.errstate(invalid="ignore"):
                visible = (at >= 0).all(axis=1) & (at < distance.shape[::-1]).all(axis=1)
            i, j = np.where(visible[:, None], at, 0).astype(int).T
            inside &= visible & (within[j, i] > 0)
        return inside & known


def clouds_for_fit(
    footage: Footage,
    clouds: Sequence[PointCloud],
    trajectories: Trajectories | None,
    background: Sequence[BackgroundDistances],
    settings: FitSettings,
    results: Results,
    monitor: Monitor,
) -> Sequence[Cloud]:
    """The clouds that attract the body: the measured ones, completed by the coarse surface where a view shows a still background; or those
    that tracking cleaned.

    Raises:
        InputError: the images cannot be read.
        Cancelled: the user asked to stop.
    """
    if settings.cloud == "tracked" and trajectories is not None:
        return tracked_clouds(trajectories, footage.frames)
    if not settings.complete_surface or not background:
        return clouds
    coarse = coarse_surfaces(footage, clouds, results, monitor)
    return CompletedClouds(clouds=clouds, coarse=coarse, rig=footage.rig, background=background)


def _far(xyz_m: np.ndarray, from_m: np.ndarray) -> np.ndarray:
    """Whether no other point (M, 3) is near points (N, 3)."""
    from scipy.spatial import cKDTree

    if not len(from_m) or not len(xyz_m):
        return np.ones(len(xyz_m), dtype=bool)
    return np.asarray(cKDTree(from_m).query(xyz_m, distance_upper_bound=NEAR_M)[0] > NEAR_M)
