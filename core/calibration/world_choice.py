"""Where the user wants the world's frame: on the floor under the bar, level with a bar, through three clicked points, or another rig's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.intersection import forward_intersection
from ..geometry.rig import Rig
from .world_frame import WorldFrame, frame_like, frame_of_cameras, frame_of_level_bar, frame_of_points, frame_on_floor

POINTS = ("origin", "x", "y")
CLICK_PX = 5.0  # rays of a clicked point that miss each other by more than twice this contradict each other


@dataclass(frozen=True, kw_only=True, slots=True)
class WorldChoice:
    """One of the four, or nothing: then up is where the cameras' tops are."""

    floor_frames: tuple[int, ...] = ()  # in which the bar lies on the floor
    level_frames: tuple[int, ...] = ()  # in which the bar is held level
    points: Mapping[str, Mapping[str, Sequence[float]]] = field(default_factory=dict)  # "origin", "x", "y": pixels [x, y] by view
    like: Rig | None = None  # cameras of the same names, which stay where they are there

    def __post_init__(self) -> None:
        if sum(map(bool, (self.floor_frames, self.level_frames, self.points, self.like))) > 1:
            raise InputError("The world's frame is given twice; choose the floor, level bars, three points, or another rig's.")

    @property
    def on_floor(self) -> bool:
        """Whether z = 0 is the floor, or the plane that the user's points lie in."""
        return bool(self.floor_frames or self.points or (self.like is not None and self.like.metadata.get("floor") is True))


def frame_of_bar(choice: WorldChoice, cameras: Sequence[Camera], frames: np.ndarray, ends_m: np.ndarray) -> WorldFrame:
    """The frame that was chosen, from the bar's ends (T, 2, 3) in the frames (T,) in which they were measured.

    Raises:
        InputError: the frames do not show the bar, or what they show makes no frame.
    """
    if choice.like is not None:
        return frame_like(cameras, choice.like.cameras)
    if choice.points:
        return frame_of_clicks(cameras, choice.points)
    for wanted, doing in ((choice.floor_frames, "to lie on the floor"), (choice.level_frames, "to be level")):
        unseen = sorted(set(wanted) - set(frames.tolist()))
        if unseen:
            raise InputError(f"Frame {unseen[0]}, in which the bar is said {doing}, does not show both of its ends; choose another.")
    if choice.floor_frames:
        return frame_on_floor(ends_m[np.isin(frames, choice.floor_frames)].reshape(-1, 3), cameras)
    if choice.level_frames:
        level = ends_m[np.isin(frames, choice.level_frames)]
        along = level[:, 1] - level[:, 0]
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
    found = forward_intersection(cameras, xy, np.broadcast_to(CLICK_PX**2 * np.eye(2), (3, len(cameras), 2, 2)))
    for point, miss in zip(POINTS, found.rms_residual_px):
        if not miss < 2 * CLICK_PX:
            raise InputError(
                f"The clicks of the point “{point}” of the world's frame miss each other by {miss:.0f} px; click the same "
                "point in every view."
            )
    return frame_of_points(*found.xyz_m)
