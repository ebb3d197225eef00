"""What the scene needs that takes long to compute and needs no bpy. Computed on the worker thread, so that the window stays responsive.

The bone of the fitted body that each point belongs to, the velocity of the nearest tracked point, and the skin of the rest pose.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...core.body.shape import BodyShape
from ...core.body.skin.closed_skin import OneSkin
from ...core.body.skin.mesh import SkinSettings
from ...core.body.skin.person_skin import read_skin, rest_skin
from ...core.fitting.inputs.cloud_points import CloudPoints
from ...core.fitting.segmentation import segment
from ...core.fitting.state import ShapeParameters
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.formats.ply import Ply
from ...core.motion.tables import MotionTable

NO_BONE = -1
GATE_M = 0.04  # a point farther from the surface of every limb belongs to no bone
NEAR_M = 0.03  # a cloud point takes the velocity of the nearest tracked point within this distance
STAGE = "preparing the scene"


@dataclass(frozen=True, eq=False, kw_only=True)
class Prepared:
    """For each cloud, by frame: velocities (N, 3) [m/s], 0 = unknown, and bone numbers (N,). For the trajectories: bone numbers (T, N)."""

    bones: tuple[str, ...] = ()  # names by number; empty without a pose in any frame
    velocity_m_s: Mapping[int, np.ndarray] = field(default_factory=dict)
    segment: Mapping[int, np.ndarray] = field(default_factory=dict)
    track_segment: np.ndarray | None = None
    skin: OneSkin | None = None  # None: the body has no metaballs


def prepare(
    clouds: Mapping[int, Ply],
    trajectories: Mapping[str, np.ndarray] | None,
    shape: BodyShape | None,
    motion: MotionTable | None,
    settings: SkinSettings,
    skin_file: Path,
    monitor: Monitor,
) -> Prepared:
    """Compute all of it. `skin_file`: the run's skin of the rest pose; without it a skin is made, without relief.

    Raises:
        InputError: that file is damaged.
        Cancelled: the monitor was cancelled.
    """
    segmentation, velocity, segment_of = _Segmentation(shape, motion), {}, {}
    tracks = _Tracks(trajectories)
    for i, (frame, ply) in enumerate(clouds.items()):
        monitor.step(STAGE, i, len(clouds) + 1)
        xyz = ply.xyz_m
        both = segmentation.of(frame, np.concatenate([xyz, tracks.of(frame)]))  # one evaluation of the pose for both
        velocity[frame], segment_of[frame] = velocity_nearby(frame, xyz, trajectories), both[: len(xyz)]
        tracks.set(frame, both[len(xyz) :])
    for frame in sorted(tracks.rows.keys() - clouds.keys()):
        tracks.set(frame, segmentation.of(frame, tracks.of(frame)))
    monitor.step(STAGE, len(clouds), len(clouds) + 1)
    return Prepared(
        bones=segmentation.names,
        velocity_m_s=velocity,
        segment=segment_of,
        skin=_rest_skin(shape, settings, skin_file),
        track_segment=None if trajectories is None else tracks.segment,
    )


def velocity_nearby(frame: int, xyz_m: np.ndarray, trajectories: Mapping[str, np.ndarray] | None) -> np.ndarray:
    """Velocity (N, 3) of the nearest tracked point in the frame; 0 where none is within NEAR_M."""
    from scipy.spatial import cKDTree

    at = np.flatnonzero(trajectories["frames"] == frame) if trajectories is not None else np.zeros(0, dtype=int)
    if trajectories is None or not len(at) or not len(xyz_m):
        return np.zeros((len(xyz_m), 3))
    place, velocity = trajectories["xyz_m"][at[0]], trajectories["velocity_m_s"][at[0]]
    known = np.isfinite(place).all(axis=1) & np.isfinite(velocity).all(axis=1)
    if not known.any():
        return np.zeros((len(xyz_m), 3))
    distance, nearest = cKDTree(place[known]).query(xyz_m, distance_upper_bound=NEAR_M)
    return np.where(np.isfinite(distance)[:, None], velocity[known][np.minimum(nearest, known.sum() - 1)], 0.0)


class _Tracks:
    """The bones (T, N) of trajectories, filled frame by frame; `NO_BONE` where a point was not visible."""

    def __init__(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        self._xyz_m = arrays["xyz_m"] if arrays is not None else np.zeros((0, 0, 3))
        self._visible = np.isfinite(self._xyz_m).all(axis=-1)
        self.rows = {int(frame): row for row, frame in enumerate(arrays["frames"])} if arrays is not None else {}
        self.segment = np.full(self._visible.shape, NO_BONE)

    def of(self, frame: int) -> np.ndarray:
        """Positions (N', 3) of the points that are visible in a frame."""
        row = self.rows.get(frame)
        return np.zeros((0, 3)) if row is None else np.asarray(self._xyz_m[row][self._visible[row]])

    def set(self, frame: int, bones: np.ndarray) -> None:
        """Set the bones of the points that are visible in a frame."""
        if frame in self.rows:
            self.segment[self.rows[frame], self._visible[self.rows[frame]]] = bones


def _rest_skin(shape: BodyShape | None, settings: SkinSettings, file: Path) -> OneSkin | None:
    if shape is not None and file.is_file():
        return read_skin(file, shape)
    try:
        return None if shape is None else rest_skin(shape, settings)
    except InputError:
        return None


class _Segmentation:
    """Assigns points to bones in any frame; to none where the frame has no pose."""

    def __init__(self, shape: BodyShape | None, motion: MotionTable | None) -> None:
        self.names: tuple[str, ...] = ()
        self._states = {}
        if shape is not None and motion is not None:
            parameters = ShapeParameters(shape)
            known = np.isfinite(motion.values).all(axis=1)
            states = parameters.states(motion.values[known], parameters.vector(shape))
            self.names = tuple(bone.name for bone in shape.skeleton.bones)
            self._states = dict(zip(motion.frames[known].tolist(), states))
        self._whole = np.tile([0.0, 1.0], (len(self.names), 1))

    def of(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        """Numbers (N,) of the bones that points (N, 3) of a frame belong to, `NO_BONE` where none is near."""
        owner = np.full(len(xyz_m), NO_BONE)
        if frame in self._states and len(xyz_m):
            unknown = np.zeros((len(xyz_m), 3))
            points = CloudPoints(frame=frame, xyz_m=np.asarray(xyz_m, dtype=np.float64), normals=unknown, sigma_m=unknown[:, 0])
            rows, bones = segment(points, self._states[frame], self._whole, GATE_M)
            owner[rows] = bones
        return owner
