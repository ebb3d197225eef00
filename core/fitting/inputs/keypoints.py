"""Keypoints from another system, frame by frame, as observations of the model's joints.

A detector's errors are correlated over time: keypoints of the frames within `CORRELATION_S` weigh together as one. A detector's hip is not
the centre of the hip: the sigmas include that, and outliers lose their weight.
"""

from collections.abc import Sequence
from copy import copy

import numpy as np

from ...geometry.camera import Camera
from ...geometry.intersection import intersect_clicks
from ..observations import ClickedJoints, Keypoints, Observation
from .fit_input import FitInput, JointPlaces

CORRELATION_S = 0.2  # of a detector's errors


class JointTracks:
    """The keypoints of all frames. Joints that the model does not have are ignored."""

    def __init__(self, given: FitInput, joint_names: Sequence[str]) -> None:
        self._names = list(joint_names)
        self._frames, self._rig = given.frames, given.rig
        step = float(np.median(np.diff(given.time_s))) if len(given.time_s) > 1 else CORRELATION_S
        self._inflation = max(1.0, CORRELATION_S / step)
        self._tables = [
            (table, np.array([self._names.index(j) if j in self._names else -1 for j in table.joint], dtype=np.intp))
            for table in given.keypoints
        ]

    def stretch(self, frames: Sequence[int]) -> "JointTracks":
        """Those of some of the frames."""
        part = copy(self)
        part._frames = [self._frames[t] for t in frames]
        return part

    def observe(self, t: int) -> list[Observation]:
        """Observations of the joints in frame index `t`."""
        found: list[Observation] = []
        cameras: list[Camera] = []
        index, xy, sigma = [], [], []
        for table, joint, rows in self._rows(t):
            if table.view:
                cameras += [self._rig[table.view]] * len(rows)
                index.append(joint[rows])
                xy.append(table.place[rows])
                sigma.append(table.sigma[rows])
            else:
                found.append(
                    Keypoints(
                        joint=joint[rows],
                        xyz_m=table.place[rows],
                        sigma_m=table.sigma[rows],
                        kind="keypoints",
                        variance_inflation=self._inflation,
                    )
                )
        if cameras:
            found.append(
                ClickedJoints(
                    cameras=tuple(cameras),
                    joint=np.concatenate(index),
                    xy_px=np.concatenate(xy),
                    sigma_px=np.concatenate(sigma),
                    kind="keypoints",
                    variance_inflation=self._inflation,
                )
            )
        return found

    def located(self, t: int) -> np.ndarray:
        """The places of the joints (J, 3) in frame index `t`: from keypoints in space, or from two views; NaN without either."""
        places = np.full((len(self._names), 3), np.nan)
        in_views: dict[int, list[tuple[Camera, np.ndarray]]] = {}
        for table, joint, rows in self._rows(t):
            if not table.view:
                places[joint[rows]] = table.place[rows]
                continue
            for j, xy in zip(joint[rows].tolist(), table.place[rows]):
                in_views.setdefault(j, []).append((self._rig[table.view], xy))
        for j, views in in_views.items():
            if len(views) > 1 and not np.isfinite(places[j]).all():
                places[j] = intersect_clicks([camera for camera, _ in views], np.array([[xy for _, xy in views]])).xyz_m[0]
        return places

    def joints(self, t: int) -> list[int]:
        """The joints that have a keypoint in frame index `t`."""
        return sorted({int(j) for _, joint, rows in self._rows(t) for j in joint[rows]})

    @property
    def of_any_frame(self) -> list[int]:
        """The joints of the model that any table of keypoints has."""
        return sorted({int(j) for _, joint in self._tables for j in joint[joint >= 0]})

    def best_frame(self) -> int:
        """The frame index in which most joints are located."""
        return int(np.argmax([np.isfinite(self.located(t)).all(axis=1).sum() for t in range(len(self._frames))]))

    def _rows(self, t: int) -> list[tuple[JointPlaces, np.ndarray, np.ndarray]]:
        rows = [
            (table, joint, np.flatnonzero((table.frame == self._frames[t]) & (joint >= 0) & np.isfinite(table.place).all(axis=1)))
            for table, joint in self._tables
        ]
        return [row for row in rows if len(row[2])]
