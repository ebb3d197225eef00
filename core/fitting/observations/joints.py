"""Observations of joints X: clicked in the views, or located by another system, and those of standing feet.

    (projection(X) − click) / σ = ε ,    σ about 5 px                                                     (1)
    (X − keypoint) / σ = ε ,             each coordinate                                                  (2)
    (up · X − floor − h) / σ = ε                                                                          (3)

(1) is the initialisation of D'Apuzzo et al. 1999, §3.3; keypoints of other systems in images are observed in the same way. (2) is for
keypoints in space. (3) is optional: a standing foot neither sinks into the floor nor hovers, its joints have given heights h above it.

Standing feet, as observations: an ankle, or the ball of a foot, that is slow and low. While it stands the joint has the height that it
has whenever it stands, on either foot. World: Z up, and the floor is level; its height comes from the motion.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from ...geometry.camera import Camera
from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class ClickedJoints:
    """K clicks, each of one joint in one camera.  (1)"""

    cameras: tuple[Camera, ...]  # K
    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    xy_px: np.ndarray  # (K, 2) full-frame pixels
    sigma_px: np.ndarray | float  # (K,) or for all
    kind: str = ""
    variance_inflation: np.ndarray | float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(2K,)"""
        X = state.joint_jacobian[0]
        rows = [(camera.project(X[j]) - xy) / s for camera, j, xy, s in zip(self.cameras, self.joint, self.xy_px, self._sigmas)]
        return np.concatenate(rows) if rows else np.zeros(0)

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(2K, D + S) or (2K, D)"""
        X, dX = state.joint_jacobian
        n = state.layout.size(shape)
        rows = [camera.project_with_jacobian(X[j])[1] @ dX[j, :, :n] / s for camera, j, s in zip(self.cameras, self.joint, self._sigmas)]
        return np.concatenate(rows) if rows else np.zeros((0, n))

    @property
    def _sigmas(self) -> np.ndarray:
        return np.broadcast_to(self.sigma_px, (len(self.joint),))


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """K joints located in space by another system (TRC, C3D, CSV).  (2)"""

    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    xyz_m: np.ndarray  # (K, 3)
    sigma_m: np.ndarray  # (K,)
    kind: str = ""
    variance_inflation: np.ndarray | float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(3K,)"""
        return ((state.joint_jacobian[0][self.joint] - self.xyz_m) / self.sigma_m[:, None]).ravel()

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(3K, D + S) or (3K, D)"""
        J = state.joint_jacobian[1][self.joint] / self.sigma_m[:, None, None]
        J = J.reshape(-1, J.shape[2])
        return J[:, : state.layout.size(shape)]


@dataclass(frozen=True, eq=False, kw_only=True)
class FootOnFloor:
    """K joints at given heights above a plane. `up` is the plane's unit normal, `floor_m` its height along `up`.  (3)"""

    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    height_m: np.ndarray  # (K,) of the joint's centre above the floor when the foot stands
    floor_m: float
    sigma_m: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(K,)"""
        X = state.joint_jacobian[0][self.joint]
        return (X @ np.array(self.up) - self.floor_m - self.height_m) / self.sigma_m

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(K, D + S) or (K, D)"""
        J = np.einsum("i,kic->kc", np.array(self.up), state.joint_jacobian[1][self.joint]) / self.sigma_m
        return J[:, : state.layout.size(shape)]


SLOW_M_S = 0.25  # as in retargeting: a slower foot stands
LOW_M = 0.05  # above the lowest place of the joint
LOWEST_PERCENTILE = 3.0  # of a joint's heights: its lowest place, but for outliers
SPAN_S = 0.1  # speeds are taken over this time, which averages their noise
SIGMA_M = 0.01  # of the height
KINDS = ("ankle", "toe")


class StandingFeet:
    """The standing joints of a motion."""

    def __init__(self, joints_m: np.ndarray, joint_names: Sequence[str], time_s: np.ndarray) -> None:
        """`joints_m` (T, J, 3) of a first motion, at `time_s` (T,)."""
        names, n = list(joint_names), len(time_s)
        self.stands = np.zeros((n, len(names)), dtype=bool)
        self.level_m = np.zeros(len(names))
        for kind in KINDS:
            mine = [names.index(j) for j in (f"{kind}.L", f"{kind}.R") if j in names]
            for j in mine:
                self.stands[:, j] = _stands(joints_m[:, j], time_s)
            heights = joints_m[:, mine, 2][self.stands[:, mine]]
            self.level_m[mine] = np.median(heights) if len(heights) else 0.0

    def stretch(self, frames: Sequence[int]) -> "StandingFeet":
        """Those of some of the frames."""
        part = copy(self)
        part.stands = self.stands[frames]
        return part

    def observe(self, t: int) -> list[FootOnFloor]:
        """The joints that stand in frame index `t`."""
        joint = np.flatnonzero(self.stands[t])
        return [FootOnFloor(joint=joint, height_m=self.level_m[joint], floor_m=0.0, sigma_m=SIGMA_M)] if len(joint) else []


def _stands(places: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Frames (T,) in which a joint at `places` (T, 3) stands; none in a single frame."""
    if len(time_s) < 2:
        return np.zeros(len(time_s), dtype=bool)
    half = max(1, round(SPAN_S / float(np.median(np.diff(time_s))) / 2))
    before, after = np.maximum(np.arange(len(time_s)) - half, 0), np.minimum(np.arange(len(time_s)) + half, len(time_s) - 1)
    speed = np.linalg.norm(places[after] - places[before], axis=1) / (time_s[after] - time_s[before])
    height = places[:, 2] - np.percentile(places[:, 2], LOWEST_PERCENTILE)
    return np.asarray((speed < SLOW_M_S) & (height < LOW_M))
