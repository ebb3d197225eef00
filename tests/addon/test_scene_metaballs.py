"""The metaballs cost nothing until they are shown: a collection that the view layers exclude, and the switch in the panel."""

import importlib
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError

from .conftest import SmallRun, write_result
from .test_scene_body import world_vertices

FRAMES, TRIES = 12, 3
MOST_S = 8e-3  # CPU time of a frame of a whole body; measured 1.5 to 4 ms, and 150 ms with the metaballs
MOST_SHARE = 0.08  # of that with the metaballs, where other work makes all of it slower


@pytest.fixture
def whole_body(tmp_path: Path) -> Path:
    """The results of a whole body that moves."""
    shape, out = default_shape(read_model("full")), tmp_path / "whole"
    values = 0.3 * np.sin(np.arange(FRAMES)[:, None] / 5 + np.arange(len(shape.skeleton.dof_names)))
    store.write_json(out / "run.json", {"format": "tricap-run", "version": 1, "take": str(tmp_path / "none")})
    write_result(out, shape, np.arange(FRAMES), values, np.full(values.shape, 1e-3))
    return out


def frame_s(scene: object, tries: int = TRIES) -> float:
    """CPU time of one frame: the median of the frames after the first, in the quietest of some tries."""
    medians = []
    for _ in range(tries):
        scene.frame_set(0)
        taken = []
        for frame in range(1, FRAMES):
            begun = time.process_time()
            scene.frame_set(frame)
            taken.append(time.process_time() - begun)
        medians.append(float(np.median(taken)))
    return min(medians)


def seen(bpy: ModuleType) -> set[str]:
    """The objects of the metaballs that the view layer shows."""
    return {o.name for o in bpy.context.view_layer.objects if o.type == "META" and o.visible_get()}


@pytest.mark.slow
def test_a_whole_body_plays_fast_until_its_metaballs_are_shown(blender: ModuleType, empty: ModuleType, whole_body: Path) -> None:
    from tricap.addon.scene.build import build_scene

    build_scene(whole_body)
    scene = empty.context.scene
    parts = {o.name for o in empty.data.objects if o.type == "META"}
    assert len(parts) > 30 and seen(empty) == set() and not scene.tricap.show_metaballs
    hidden_s = frame_s(scene)
    skin = empty.data.objects["Skin"]
    scene.frame_set(0)
    before = world_vertices(empty, skin)
    scene.frame_set(FRAMES - 1)
    assert np.abs(world_vertices(empty, skin) - before).max() > 0.05, "what plays fast is the moving skin"
    scene.tricap.show_metaballs = True
    assert seen(empty) == parts and scene.tricap.show_metaballs
    assert len(world_vertices(empty, empty.data.objects["Flesh pelvis"])) > 100
    shown_s = frame_s(scene, 1)
    scene.tricap.show_metaballs = False
    assert seen(empty) == set()
    assert max(hidden_s, frame_s(scene)) <= max(MOST_S, MOST_SHARE * shown_s), f"{shown_s:.3f} s with the metaballs"


def test_the_switch_is_undone_saved_and_for_every_view_layer(
    blender: ModuleType, empty: ModuleType, small_run: SmallRun, tmp_path: Path
) -> None:
    from tricap.addon.scene.build import build_scene

    def excluded() -> list[bool]:
        layers = [
            layer.layer_collection.children["Tricap"].children["Body"].children["Metaballs"] for layer in empty.context.scene.view_layers
        ]
        return [layer.exclude for layer in layers]

    empty.context.scene.view_layers.new("Second")
    build_scene(small_run.out)
    assert excluded() == [True, True]
    empty.ops.ed.undo_push(message="before")
    empty.context.scene.tricap.show_metaballs = True
    empty.ops.ed.undo_push(message="after")
    assert excluded() == [False, False]
    empty.ops.ed.undo()
    assert excluded() == [True, True] and not empty.context.scene.tricap.show_metaballs
    empty.ops.ed.redo()
    assert excluded() == [False, False]
    build_scene(small_run.out, tmp_path / "body.blend")
    assert [c.name for c in empty.data.collections if c.name.endswith("balls")] == ["Metaballs"] and excluded() == [True, True]
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "body.blend"))
    assert excluded() == [True, True] and seen(empty) == set()


def test_a_scene_of_an_earlier_version_opens_and_is_built_again(
    blender: ModuleType, empty: ModuleType, small_run: SmallRun, tmp_path: Path
) -> None:
    """There the metaballs were among the other objects, hidden by the eye icon."""
    from tricap.addon.scene.build import build_scene

    from .layout import Layout

    bodies = importlib.import_module("bl_ext.user_default.tricap.addon.steps.bodies")
    build_scene(small_run.out)
    inner, outer = (empty.data.collections[name] for name in ("Metaballs", "Body"))
    for part in list(inner.objects):
        outer.objects.link(part)
        part.hide_set(True)
    empty.data.collections.remove(inner)
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "old.blend"))
    scene = empty.context.scene
    drawn = Layout()
    bodies.rig(drawn, empty.context, False)
    scene.tricap.show_metaballs = True
    assert not scene.tricap.show_metaballs and seen(empty) == set() and "show_metaballs" not in drawn.properties
    build_scene(small_run.out)
    bodies.rig(drawn, empty.context, False)
    assert "body_layer" in drawn.properties
    assert "show_metaballs" in drawn.properties and [o.name for o in empty.data.objects if o.type == "META"][0] == "Flesh"
    assert not any(o.type == "META" for o in empty.data.collections["Body"].objects)


def test_without_a_skin_the_metaballs_are_shown(empty: ModuleType, small_run: SmallRun, monkeypatch: pytest.MonkeyPatch) -> None:
    from tricap.addon.scene import build, skin

    def refuse(*_: object, **__: object) -> None:
        raise InputError("It cannot be.")

    monkeypatch.setattr(skin, "add_skin", refuse)
    report = build.build_scene(small_run.out)
    assert any("No polygonal skin" in warning for warning in report.warnings)
    assert seen(empty) and not empty.data.objects["Flesh"].hide_render
