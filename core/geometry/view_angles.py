"""Which views look alike: the angles between the axes of cameras, and the view whose neighbours are nearest.

A patch is matched from the reference view into two other views. The reference view should therefore be the one whose second nearest
neighbour is nearest, as the middle of a row is.
"""

from collections.abc import Sequence

import numpy as np

from .camera import Camera
from .rig import Rig

WIDEST_DEG = 45.0  # between the axes of two views whose patches still look alike
NEAR_DEG = 10.0  # a reference view whose second neighbour is nearer than this is not replaced
CLEARLY = 0.6  # times the angle of the view in the middle of the list, below which another view takes its place


def axis_angles_deg(cameras: Sequence[Camera], reference: int) -> np.ndarray:
    """The angles (K,) between the axis of one camera and those of all."""
    ahead = np.array([camera.R_cam_world[2] for camera in cameras])
    return np.degrees(np.arccos(np.clip(ahead @ ahead[reference], -1.0, 1.0)))


def views_alike(cameras: Sequence[Camera], reference: int) -> list[int]:
    """The numbers of the other views that look alike enough to be matched with the reference view; all others where there are none."""
    others = [k for k in range(len(cameras)) if k != reference]
    degrees = axis_angles_deg(cameras, reference)
    return [k for k in others if degrees[k] <= WIDEST_DEG] or others


def neighbours_deg(cameras: Sequence[Camera], reference: int) -> np.ndarray:
    """The angles (K − 1,) to the other views, ascending."""
    return np.sort(np.delete(axis_angles_deg(cameras, reference), reference))


def no_view_alike(cameras: Sequence[Camera], reference: int) -> bool:
    """Whether no other view looks alike enough to be matched with the reference view: no surface can be measured."""
    return bool(neighbours_deg(cameras, reference)[0] > WIDEST_DEG)


def second_neighbour_deg(cameras: Sequence[Camera], reference: int) -> float:
    """The angle to the second nearest of the other views; of two views, the angle between them."""
    return float(neighbours_deg(cameras, reference)[:2][-1])


def default_reference(names: Sequence[str], rig: Rig | None = None) -> str:
    """The reference view of a take that names none: the middle of its views, or what `middle_view` makes of their cameras in a rig."""
    by_name = {camera.name: camera for camera in rig.cameras} if rig is not None else {}
    known = all(name in by_name for name in names)
    return names[middle_view([by_name[name] for name in names]) if known and names else len(names) // 2]


def middle_view(cameras: Sequence[Camera]) -> int:
    """The number of the reference view of cameras in the order of a take: the middle of the list, unless another view is clearly nearer to
    its neighbours."""
    middle = len(cameras) // 2
    degrees = [second_neighbour_deg(cameras, k) for k in range(len(cameras))]
    best = int(np.argmin(degrees))
    clearly = NEAR_DEG < degrees[middle] and degrees[best] <= min(WIDEST_DEG, CLEARLY * degrees[middle])
    return best if clearly else middle
