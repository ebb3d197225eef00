"""The world's frame: metres, Z up. A calibration is free to rotate and shift; here it is put where the user wants it:

on the floor under the bar, level with the bar, through three clicked points, or where another rig is.

    X' = R X + s ,   R_cam' = R_cam Rᵀ ,   t_cam' = t_cam − R_cam' s               (1)

Without such a choice, up is the mean direction of the cameras' tops, the cameras look along +Y (a person who faces them faces −Y), and the
origin is the middle of the volume in which the bar was waved.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..foundation.arrays import frozen
from ..foundation.errors import InputError
from ..geometry.camera import Camera
from ..geometry.intersection import clicks_contradict, intersect_clicks
from ..geometry.rig import Rig

LEAST_ARM_M = 0.1  # at which directions of cameras are compared, at least
OTHER_RIG = 0.3  # of that arm: rigs that differ by more are not the same
MIN_FLOOR_SPREAD = 0.02  # of the largest extent: points that are closer to a line have no plane
MIN_LEVEL_SPREAD = 0.02  # ratio of the second to the largest eigenvalue: bars that spread less are parallel
PARALLEL = 1e-3  # sine of the angle between directions that count as parallel
POINTS = ("origin", "x", "y")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WorldFrame:
    """A rigid motion of space: X' = R X + shift_m.  (1)"""

    R: np.ndarray
    shift_m: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", frozen(self.R, (3, 3), name="R"))
        object.__setattr__(self, "shift_m", frozen(self.shift_m, (3,), name="shift_m"))

    def points(self, xyz_m: np.ndarray) -> np.ndarray:
        """Points (…, 3) in the new frame."""
        return xyz_m @ self.R.T + self.shift_m

    def camera(self, camera: Camera) -> Camera:
        """The camera in the new frame."""
        R = camera.R_cam_world @ self.R.T
        return replace(camera, R_cam_world=R, t_cam_world_m=camera.t_cam_world_m - R @ self.shift_m)


def frame_of_cameras(cameras: Sequence[Camera], points_m: np.ndarray) -> WorldFrame:
    """The frame from the cameras alone: their tops are up, they look along +Y, the origin is the middle of the points."""
    up = -np.mean([c.R_cam_world[1] for c in cameras], axis=0)
    return upright(up, cameras, np.median(points_m.reshape(-1, 3), axis=0))


def frame_like(cameras: Sequence[Camera], there: Sequence[Camera]) -> WorldFrame:
    """The frame in which the cameras fit those of the same names best, in centres and axes, without a change of scale.

    Raises:
        InputError: no name is the same, or the relative positions of the cameras differ.
    """
    other = {camera.name: camera for camera in there}
    pairs = [(camera, other[camera.name]) for camera in cameras if camera.name in other]
    if not pairs:
        raise InputError(f"None of the cameras {', '.join(c.name for c in cameras)} is among {', '.join(other)}; give them the same names.")
    centres = np.array([camera.centre_m for camera, _ in pairs])
    arm = max(float(np.linalg.norm(np.ptp(centres, axis=0))), LEAST_ARM_M)
    A, B = (np.concatenate([c.centre_m + arm * np.vstack([np.zeros(3), c.R_cam_world]) for c in each]) for each in zip(*pairs))
    U, _, Vt = np.linalg.svd((B - B.mean(axis=0)).T @ (A - A.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    frame = WorldFrame(R=R, shift_m=B.mean(axis=0) - R @ A.mean(axis=0))
    off = np.linalg.norm(frame.points(A) - B, axis=1).max()
    if off > OTHER_RIG * arm:
        raise InputError(f"The cameras differ from those of the same names by {1e3 * off:.0f} mm; were they moved or swapped?")
    return frame


def upright(up: np.ndarray, cameras: Sequence[Camera], origin_m: np.ndarray) -> WorldFrame:
    """The frame with Z along `up`, its origin at `origin_m`, and the mean viewing direction in the plane of Y and Z."""
    z = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    view = np.mean([c.R_cam_world[2] for c in cameras], axis=0)
    y = view - z * (z @ view)
    if np.linalg.norm(y) < PARALLEL:  # the cameras look straight down or up
        y = -np.mean([c.R_cam_world[1] for c in cameras], axis=0)
        y -= z * (z @ y)
    y /= np.linalg.norm(y)
    R = np.stack([np.cross(y, z), y, z])
    return WorldFrame(R=R, shift_m=-R @ origin_m)


def frame_on_floor(floor_m: np.ndarray, cameras: Sequence[Camera]) -> WorldFrame:
    """The frame whose plane z = 0 is that of points (n, 3) on the floor, its origin their middle; the cameras are above it.

    Raises:
        InputError: fewer than three points, or all on one line.
    """
    if len(floor_m) < 3:
        raise InputError(f"{len(floor_m)} points on the floor do not make a plane; give at least three, not on one line.")
    middle = floor_m.mean(axis=0)
    _, size, axes = np.linalg.svd(floor_m - middle, full_matrices=False)
    if size[1] < MIN_FLOOR_SPREAD * size[0]:
        raise InputError("The points on the floor lie on one line; lay the bar down in two directions at least.")
    up = axes[2] if np.mean([axes[2] @ (c.centre_m - middle) for c in cameras]) > 0 else -axes[2]
    return upright(up, cameras, middle)


def frame_of_level_bar(directions: np.ndarray, cameras: Sequence[Camera], origin_m: np.ndarray) -> WorldFrame:
    """The frame in which bars of directions (n, 3) are level, as held against a spirit level in two directions at least.

    Raises:
        InputError: all bars were parallel.
    """
    values, axes = np.linalg.eigh(directions.T @ directions)
    if len(directions) < 2 or values[1] < MIN_LEVEL_SPREAD * values[2]:
        raise InputError("The level bars are parallel; hold the bar level in two directions across each other.")
    tops = -np.mean([c.R_cam_world[1] for c in cameras], axis=0)
    return upright(axes[:, 0] * np.sign(axes[:, 0] @ tops), cameras, origin_m)


def frame_of_points(origin_m: np.ndarray, x_m: np.ndarray, y_m: np.ndarray) -> WorldFrame:
    """The frame of three points: the origin, one on the X axis, and one in the plane of X and Y on the side of +Y.

    Raises:
        InputError: the points lie on one line.
    """
    x, across = x_m - origin_m, y_m - origin_m
    z = np.cross(x, across)
    if np.linalg.norm(z) < PARALLEL * np.linalg.norm(x) * np.linalg.norm(across) or not np.linalg.norm(x):
        raise InputError("The origin, the point on X and the point towards Y lie on one line; choose a third one off that line.")
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    R = np.stack([x, np.cross(z, x), z])
    return WorldFrame(R=R, shift_m=-R @ origin_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class WorldChoice:
    """At most one of the four; without any, the cameras' tops are up."""

    floor_frames: tuple[int, ...] = ()  # in which the bar lies on the floor
    level_frames: tuple[int, ...] = ()  # in which the bar is held level
    points: Mapping[str, Mapping[str, Sequence[float]]] = field(default_factory=dict)  # "origin", "x", "y": pixels [x, y] by view
    like: Rig | None = None  # cameras of the same names stay where they are in this rig

    def __post_init__(self) -> None:
        if sum(map(bool, (self.floor_frames, self.level_frames, self.points, self.like))) > 1:
            raise InputError("The world's frame is given twice; choose the floor, level bars or boards, three points, or another rig.")

    @property
    def on_floor(self) -> bool:
        """Whether z = 0 is the floor, or the plane of the user's points."""
        return bool(self.floor_frames or self.points or (self.like is not None and self.like.metadata.get("floor") is True))


def frame_of_bar(choice: WorldChoice, cameras: Sequence[Camera], frames: np.ndarray, ends_m: np.ndarray) -> WorldFrame:
    """The chosen frame, from the points of the bar or the board (T, K, 3) in the frames (T,) in which they were measured.

    Raises:
        InputError: the chosen frames do not show the bar, or do not determine a frame.
    """
    if choice.like is not None:
        return frame_like(cameras, choice.like.cameras)
    if choice.points:
        return frame_of_clicks(cameras, choice.points)
    for wanted, doing in ((choice.floor_frames, "to lie on the floor"), (choice.level_frames, "to be level")):
        missing = sorted(set(wanted) - set(frames.tolist()))
        if missing:
            raise InputError(
                f"Frame {missing[0]}, in which the bar or board is supposed {doing}, does not show enough of it; choose another."
            )
    if choice.floor_frames:
        return frame_on_floor(ends_m[np.isin(frames, choice.floor_frames)].reshape(-1, 3), cameras)
    if choice.level_frames:
        level = ends_m[np.isin(frames, choice.level_frames)]
        along = np.concatenate([level[:, k] - level[:, 0] for k in {1, level.shape[1] - 1}])
        return frame_of_level_bar(along / np.linalg.norm(along, axis=1, keepdims=True), cameras, np.median(ends_m.reshape(-1, 3), axis=0))
    return frame_of_cameras(cameras, ends_m)


def frame_of_clicks(cameras: Sequence[Camera], points: Mapping[str, Mapping[str, Sequence[float]]]) -> WorldFrame:
    """The frame through three clicked points: "origin", "x" on the X axis, "y" on the side of +Y.

    Raises:
        InputError: a point is missing, is in an unknown view or in one view only, or its clicks contradict each other.
    """
    names = [camera.name for camera in cameras]
    xy = np.full((3, len(cameras), 2), np.nan)
    for i, point in enumerate(POINTS):
        at = points.get(point, {})
        for view, pixel in at.items():
            if view not in names:
                raise InputError(f"The point “{point}” of the world's frame is in view “{view}”, which the rig does not have.")
            xy[i, names.index(view)] = pixel
        if len(at) < 2:
            raise InputError(f"The point “{point}” of the world's frame is clicked in {len(at)} view(s); click it in two at least.")
    found = intersect_clicks(cameras, xy)
    for point, miss, contradicting in zip(POINTS, found.rms_residual_px, clicks_contradict(found)):
        if contradicting:
            raise InputError(
                f"The clicks of the point “{point}” of the world's frame miss each other by {miss:.0f} px; click the same "
                "point in every view."
            )
    return frame_of_points(*found.xyz_m)
