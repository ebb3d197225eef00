"""The button *Find Joints with a Network…*"""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.take.take import read_take
from tricap.core.take.writing import read_table

from ..pose_graphs import drawn, pose_graph
from .conftest import small_rig, write_take

NAME = "bl_ext.user_default.tricap.addon"


@pytest.fixture
def scene(blender: ModuleType, tmp_path: Path) -> Any:
    """A take in which a person of dots stands before the cameras."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    rig = small_rig()
    write_take(tmp_path / "take", rig)
    x, z = np.meshgrid(np.linspace(-0.36, -0.04, 4), np.linspace(-0.25, 0.25, 5))
    for camera in rig.cameras:
        xy = camera.project(np.column_stack([x.ravel(), 0 * x.ravel(), z.ravel()])[:17])
        picture = cv2.imencode(".png", np.rint(drawn(camera.size_px, xy)).astype(np.uint8)[..., ::-1])[1].tobytes()
        for path in (tmp_path / "take" / camera.name).iterdir():
            path.write_bytes(picture)
    importlib.import_module(f"{NAME}.project").open_take(blender.context.scene, tmp_path / "take")
    return blender.context.scene


def test_a_network_that_finds_nobody_changes_nothing(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    (tmp_path / "pose.onnx").write_bytes(pose_graph("simcc", 17, (192, 256), seen=0))
    before = read_table(tmp_path / "take")
    with pytest.raises(RuntimeError, match="The network finds nobody in any image"):
        blender.ops.tricap.find_joints_with_network(filepath=str(tmp_path / "pose.onnx"))
    assert read_table(tmp_path / "take") == before


def test_no_file_and_no_project_are_told(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"Choose the network's \.onnx file"):
        blender.ops.tricap.find_joints_with_network()
    (tmp_path / "pose.onnx").write_bytes(b"no network")
    with pytest.raises(RuntimeError, match="is no ONNX file, or it is damaged"):
        blender.ops.tricap.find_joints_with_network(filepath=str(tmp_path / "pose.onnx"))
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with pytest.raises(RuntimeError, match="Add the footage first"):
        blender.ops.tricap.find_joints_with_network(filepath=str(tmp_path / "pose.onnx"))


def test_what_it_finds_becomes_keypoints_of_the_project(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    (tmp_path / "pose.onnx").write_bytes(pose_graph("simcc", 17, (192, 256)))
    assert blender.ops.tricap.find_joints_with_network(filepath=str(tmp_path / "pose.onnx")) == {"FINISHED"}
    take = read_take(tmp_path / "take")
    assert [source.view for source in take.keypoints] == ["L", "C", "R"]
    assert sorted(p.name for p in (tmp_path / "take" / "keypoints").iterdir()) == [f"{v}.network.json" for v in "CLR"]
    project = importlib.import_module(f"{NAME}.project")
    assert not project.changed_outside(scene)
    project.write(scene)
    assert read_take(tmp_path / "take").keypoints == take.keypoints  # the panel keeps them
