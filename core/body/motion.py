"""The results of a fit: a body's shape, and its motion with the quality of every number."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..foundation.arrays import frozen
from .shape import BodyShape

FITTED, PARTIAL, BRIDGED, SUSPECT = "fitted", "partial", "bridged", "suspect"
STATUSES = (FITTED, PARTIAL, BRIDGED, SUSPECT)
SEEN, INFERRED, GUESSED = "seen", "inferred", "guessed"
KNOWN = (SEEN, INFERRED, GUESSED)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BodyMotion:
    """T frames of D DOFs and J joints.

    status, the most serious that applies: "bridged": no observations, the whole pose is predicted; "suspect": far larger residuals or far
    fewer observations than in the other frames; "partial": a limb has hardly any observations and rests on prediction; "fitted".

    known, of each joint: "seen": observed, and its place follows; "inferred": it follows from the frames and limbs around, or roughly;
    "guessed": the images contradict it, or it could be far away.
    """

    frames: np.ndarray  # (T,) the take's frame numbers
    time_s: np.ndarray  # (T,)
    dof_names: tuple[str, ...]  # D
    values: np.ndarray  # (T, D) rad; metres for the base
    covariance: np.ndarray  # (T, D, D)
    joint_names: tuple[str, ...]  # J
    joints_m: np.ndarray  # (T, J, 3) world
    joint_sigma_m: np.ndarray  # (T, J) mean standard deviation of a coordinate
    joint_frame_sigma_m: np.ndarray  # (T, J) the part of it that is not common to all frames
    known: tuple[tuple[str, ...], ...]  # (T, J) of KNOWN
    status: tuple[str, ...]  # T
    sigma0: np.ndarray  # (T,) robust standard deviation of unit-weight residuals: of points, or else outlines; NaN without

    def __post_init__(self) -> None:
        t, d, j = len(self.frames), len(self.dof_names), len(self.joint_names)
        object.__setattr__(self, "frames", frozen(self.frames, (t,), np.int64, "frames"))
        shapes = dict(time_s=(t,), values=(t, d), covariance=(t, d, d), joints_m=(t, j, 3), joint_sigma_m=(t, j), sigma0=(t,))
        shapes |= dict(joint_frame_sigma_m=(t, j))
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))
        if len(self.status) != t or not set(self.status) <= set(STATUSES):
            raise ValueError(f"status needs {t} words of {STATUSES}")
        if len(self.known) != t or any(len(row) != j or not set(row) <= set(KNOWN) for row in self.known):
            raise ValueError(f"known needs {t} rows of {j} words of {KNOWN}")

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of every value (T, D)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BodyFit:
    """The person's shape and motion, and the quality of the fit."""

    shape: BodyShape
    motion: BodyMotion
    iterations: int  # of the adjustment over the whole sequence
    converged: bool
    points: np.ndarray  # (T, B) number of points on each bone's surface in each frame
    outline_m: np.ndarray  # (K,) distances of the views' outlines from the limbs that they touch; empty without contours
    contradicted: Mapping[str, tuple[int, ...]] = field(default_factory=dict)  # first bone of a limb -> frames whose images contradict it
