"""Observations: one error term, one small file. Each has residuals of unit weight and their analytic Jacobian.

Most observe one frame; `MaterialSteps` and `ImageSteps` tie two.
"""

from typing import Protocol

import numpy as np

from ..state import Block, BodyState, FromBlocks
from .background import BackgroundExclusion
from .hand_points import HandPoints
from .joints import ClickedJoints, FootOnFloor, Keypoints
from .material_step import ImageSteps, MaterialSteps, Steps, StepsFromFixed
from .pose_priors import JointLimits, PosePrior
from .self_collision import SelfCollision
from .shape_priors import EqualRadii, Proportions, ShapePrior, Symmetry
from .silhouette_ray import SilhouetteRays
from .surface_point import SurfacePoints

__all__ = [
    "SelfCollision",
    "Block",
    "ClickedJoints",
    "BackgroundExclusion",
    "EqualRadii",
    "FootOnFloor",
    "FromBlocks",
    "HandPoints",
    "ImageSteps",
    "JointLimits",
    "Keypoints",
    "MaterialSteps",
    "PosePrior",
    "Observation",
    "Proportions",
    "ShapePrior",
    "SilhouetteRays",
    "Steps",
    "StepsFromFixed",
    "SurfacePoints",
    "Symmetry",
]


class Observation(Protocol):
    """One kind of observation of one body state."""

    @property
    def kind(self) -> str:
        """The kind (problem.Scales) of residuals that may contain outliers and get robust weights; empty: not robust."""

    @property
    def variance_inflation(self) -> np.ndarray | float:
        """Divides the weights of robust observations: > 1 where neighbouring residuals have correlated errors."""

    def residual(self, state: BodyState) -> np.ndarray:
        """Residuals (n,), divided by their sigmas."""

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """Derivative (n, D + S) of the residuals with respect to pose and shape; (n, D) without shape."""
