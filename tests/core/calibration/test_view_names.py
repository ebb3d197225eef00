"""Cameras named otherwise than the views."""

from dataclasses import replace

import pytest

from tricap.core.calibration.view_names import names_for_views
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rig import Rig, renamed
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
