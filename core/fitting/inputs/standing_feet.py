"""Standing feet, as observations: an ankle, or the ball of a foot, that is slow and low. While it stands the joint has the height that it
has whenever it stands, on either foot. World: Z up, and the floor is level; its height comes from the motion.
"""

from collections.abc import Sequence
from copy import copy

import numpy as np

from ..observations import FootOnFloor

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
