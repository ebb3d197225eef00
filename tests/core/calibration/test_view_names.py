"""Cameras named otherwise than the views."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.calibration.view_names import from_left_to_right, names_for_views
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rig import Rig, renamed
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.synthetic.arm import arm_rig


def rig_named(*names: str) -> Rig:
    cameras = arm_rig(512).cameras
    return Rig(cameras=tuple(replace(cameras[i % len(cameras)], name=name) for i, name in enumerate(names)), sigmas={names[0]: {"f": 0.1}})


@pytest.mark.parametrize(
    ("cameras", "wanted"),
    [
        (("R", "C", "L"), {}),
        (("l", "c", "r"), {"l": "L", "c": "C", "r": "R"}),
        (("right cam", "cam left", "cam_center"), {"cam left": "L", "cam_center": "C", "right cam": "R"}),
        (("cam_0", "cam_1", "cam_2"), {"cam_0": "L", "cam_1": "C", "cam_2": "R"}),
        (("left", "right", "centre", "ceiling"), {"left": "L", "centre": "C", "right": "R"}),
    ],
)
def test_cameras_get_the_names_of_their_views(cameras: tuple[str, ...], wanted: dict[str, str]) -> None:
    rig = rig_named(*cameras)
    names = names_for_views(rig, ("L", "C", "R"))
    assert names == wanted
    new = renamed(rig, names)
    assert {"L", "C", "R"} <= {camera.name for camera in new.cameras} and set(new.sigmas) == {names.get(cameras[0], cameras[0])}


def test_too_many_cameras_without_a_name_to_go_by() -> None:
    with pytest.raises(InputError, match="4 cameras .* 3 views"):
        names_for_views(rig_named("a", "b", "d", "e"), ("L", "C", "R"))


@pytest.mark.parametrize(
    "views", [("0", "2", "3"), ("2", "0", "3"), ("cam00", "cam02", "cam03"), ("take1 cam 0", "take1 cam 2", "take1 cam 3")]
)
def test_numbers_go_by_themselves(views: tuple[str, ...]) -> None:
    """As caliscope numbers its cameras, one of which was left out."""
    names = names_for_views(rig_named("cam_0", "cam_1", "cam_2", "cam_3"), views)
    assert {view: camera for camera, view in names.items()} == {view: f"cam_{view[-1]}" for view in views}


def test_the_order_of_the_cameras() -> None:
    rig = arm_rig(512)
    names = [camera.name for camera in rig.cameras]
    assert names == ["L", "C", "R"]
    mixed = replace(rig, cameras=tuple(rig[name] for name in ("R", "L", "C")))
    assert from_left_to_right(mixed) == names
    parallel = [replace(camera, R_cam_world=rig["C"].R_cam_world) for camera in mixed.cameras]
    parallel = [replace(new, t_cam_world_m=-new.R_cam_world @ old.centre_m) for new, old in zip(parallel, mixed.cameras)]
    assert from_left_to_right(replace(rig, cameras=tuple(parallel))) == names
    nearer = rig["C"].centre_m + 0.6 * rig["C"].R_cam_world[2] + 0.3 * (rig["R"].centre_m - rig["C"].centre_m)
    close = replace(rig["C"], t_cam_world_m=-rig["C"].R_cam_world @ nearer)
    assert from_left_to_right(replace(rig, cameras=(rig["R"], close, rig["L"]))) == names
    behind = replace(rig["R"], R_cam_world=rotation_from_vector(np.array([0.0, np.pi, 0.0])) @ rig["R"].R_cam_world)
    around = replace(rig, cameras=(behind, rig["L"], rig["C"]))
    assert from_left_to_right(around) == ["R", "L", "C"], "cameras around a person have no left and right"
