"""Which bone of the fitted body each point belongs to, for the attribute `segment` of cloud and trajectories."""

import bpy
import numpy as np

from ...core.fitting.cloud_points import CloudPoints
from ...core.fitting.segmentation import segment
from ...core.fitting.state import ShapeParameters
from .contents import Contents

NAMES_KEY = "tricap_segments"  # custom property of the object: the bones' names, in the order of the attribute's numbers
NOBODY = -1
GATE_M = 0.04  # a point further from every limb's surface is nobody's


class Segments:
    """The bones of points in any frame; nobody's where the frame has no posture."""

    def __init__(self, contents: Contents) -> None:
        shape, motion = contents.shape, contents.motion
        self.names: list[str] = []
        self._states = {}
        if shape is not None and motion is not None:
            parameters = ShapeParameters(shape)
            known = np.isfinite(motion.values).all(axis=1)
            states = parameters.states(motion.values[known], parameters.vector(shape))
            self.names = [bone.name for bone in shape.skeleton.bones]
            self._states = dict(zip(motion.frames[known].tolist(), states))
        self._whole = np.tile([0.0, 1.0], (len(self.names), 1))

    def of(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        """Numbers (N,) of the bones to which points (N, 3) of a frame belong, `NOBODY` where none is near."""
        owner = np.full(len(xyz_m), NOBODY)
        if frame in self._states and len(xyz_m):
            unknown = np.zeros((len(xyz_m), 3))
            points = CloudPoints(frame=frame, xyz_m=np.asarray(xyz_m, dtype=np.float64), normals=unknown, sigma_m=unknown[:, 0])
            rows, bones = segment(points, self._states[frame], self._whole, GATE_M)
            owner[rows] = bones
        return owner

    def name(self, thing: bpy.types.Object) -> None:
        """Say on an object which bone each number is."""
        if self.names:
            thing[NAMES_KEY] = self.names
