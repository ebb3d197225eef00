"""The layers of the body in a real Blender: ellipsoids with names and kinds that follow the bones, and the switch that shows one layer."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tricap.core.body.anatomy import KINDS, MUSCLE
from tricap.core.body.complete import complete_shape
from tricap.core.body.ellipsoids import ellipsoids
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.foundation import store

from .conftest import write_result
from .test_scene_body import world_vertices

FRAMES = 3


@pytest.fixture
def complete() -> BodyShape:
    return complete_shape(default_shape(read_model("arm.R")))


@pytest.fixture
def out(complete: BodyShape, tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    values = 0.4 * np.sin(np.arange(FRAMES)[:, None] + np.arange(len(complete.skeleton.dof_names)))
    store.write_json(folder / "run.json", {"format": "tricap-run", "version": 1, "take": str(tmp_path / "none")})
    write_result(folder, complete, np.arange(FRAMES), values, np.full(values.shape, 1e-3))
    return folder


def test_balls_have_names_and_kinds_and_follow_the_bones(blender: ModuleType, empty: ModuleType, complete: BodyShape, out: Path) -> None:
    from tricap.addon.scene.build import build_scene
    from tricap.core.motion.tables import read_motion

    build_scene(out)
    scene, balls = empty.context.scene, empty.data.objects["Ellipsoids"]
    group = balls.vertex_groups["upper_arm.R: biceps, long head"]
    found = ellipsoids(complete, np.zeros(len(complete.skeleton.dofs)))
    mine = [v.index for v in balls.data.vertices if group.index in [g.group for g in v.groups]]
    assert len(mine) == (found.ball == found.ball[mine[0]]).sum()
    faces = [face for face in balls.data.polygons if face.vertices[0] in set(mine)]
    assert {balls.data.materials[face.material_index].name.partition(".")[0] for face in faces} == {f"Tricap {MUSCLE}"}
    scene.tricap.body_layer = "BALLS"
    motion = read_motion(out / "motion.csv", complete.skeleton)
    for row in range(FRAMES):
        scene.frame_set(row)
        true = ellipsoids(complete, motion.values[row])
        seen = world_vertices(empty, balls)
        lift = (seen - true.vertices_m).mean(axis=0)
        assert np.abs(seen - true.vertices_m - lift * [0, 0, 1]).max() < 1e-3
    assert {KINDS[k] for k in found.kind} >= {MUSCLE}


def test_one_layer_is_shown_at_a_time(blender: ModuleType, empty: ModuleType, out: Path) -> None:
    from tricap.addon.retarget.playing import skins_of
    from tricap.addon.scene.build import build_scene

    build_scene(out)
    scene, balls, skin, body = empty.context.scene, *(empty.data.objects[name] for name in ("Ellipsoids", "Skin", "Body"))
    assert scene.tricap.body_layer == "SKIN" and balls.hide_viewport and not skin.hide_viewport
    shown = {}
    for layer in ("SKELETON", "BALLS", "POLYGONS", "SKIN"):
        scene.tricap.body_layer = layer
        assert scene.tricap.body_layer == layer
        shown[layer] = (not balls.hide_viewport, not skin.hide_viewport, skin.display_type)
        assert skins_of(body) == [skin], "exports take the skin, whatever is shown"
    assert shown == {
        "SKELETON": (False, False, "TEXTURED"),
        "BALLS": (True, False, "TEXTURED"),
        "POLYGONS": (False, True, "WIRE"),
        "SKIN": (False, True, "TEXTURED"),
    }
