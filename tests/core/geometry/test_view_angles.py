"""The reference view of a take that names none, and the views that are matched with it."""

from collections.abc import Sequence

import numpy as np
import pytest

from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.geometry.view_angles import default_reference, middle_view, second_neighbour_deg, views_alike

AWAY_M = 3.0


def around(degrees: Sequence[float]) -> list[Camera]:
    """Cameras c0, c1, … on a circle about a point, at these angles."""
    cameras = []
    for i, angle in enumerate(degrees):
        R = rotation_from_vector(np.array([0.0, np.radians(angle), 0.0]))
        matrix = np.array([[600.0, 0, 100], [0, 600.0, 75], [0, 0, 1]])
        t = np.array([0.0, 0.0, AWAY_M])
        cameras.append(Camera(name=f"c{i}", size_px=(200, 150), matrix=matrix, distortions=np.zeros(5), R_cam_world=R, t_cam_world_m=t))
    return cameras


@pytest.mark.parametrize(
    ("degrees", "chosen"),
    [
        ((-9, 0, 9), 1),  # in their order
        ((-9, 9, 0), 2),  # the middle one is last
        ((0, -9, 9), 0),
        ((-6, -1, 6), 1),  # nearly even
        ((-4, 4, 0), 1),  # all of them are near
        ((0, 20), 1),  # of two views none is better
        ((0, 0, 0), 1),
        ((0, 84, 25, 12), 3),  # one on the other side
        ((0, 84, 33, 11), 2),  # somewhat nearer: a recording has more points with the middle one
        ((0, 90, 180, 270), 2),  # none can be matched
        ((0, 50, 110, 55), 2),  # one would be nearer, but is too far from its second neighbour all the same
    ],
)
def test_the_view_nearest_to_its_neighbours_is_chosen_where_it_is_clear(degrees: Sequence[float], chosen: int) -> None:
    cameras = around(degrees)
    assert middle_view(cameras) == chosen
    names = [camera.name for camera in cameras]
    assert default_reference(names, Rig(cameras=tuple(cameras[::-1]))) == names[chosen]
    assert default_reference(names) == names[len(names) // 2] == default_reference(names, Rig(cameras=tuple(cameras[1:])))


def test_the_angle_of_a_view_is_that_to_its_second_neighbour() -> None:
    cameras = around((0, 84, 33, 11))
    assert [round(second_neighbour_deg(cameras, k)) for k in range(4)] == [33, 73, 33, 22]
    assert round(second_neighbour_deg(around((0, 20)), 1)) == 20


def test_views_from_another_side_are_not_matched_unless_there_is_no_other() -> None:
    assert views_alike(around((0, 84, 33, 11)), 3) == [0, 2]
    assert views_alike(around((0, 84, 33, 11)), 0) == [2, 3]
    assert views_alike(around((0, 90, 180)), 1) == [0, 2]
