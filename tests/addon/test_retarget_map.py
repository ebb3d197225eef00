"""The mapping's editor in a Blender with the extension: lines, files, steering, and whose lines they are."""

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from mathutils import Euler

from tricap.addon.retarget.build import build_armature
from tricap.core.motion.formats.bvh import write_bvh
from tricap.core.motion.retarget.mapping import RigMap, read_preset
from tricap.core.motion.retarget.rig import Rig

from ..core.motion.persons import flail, person, squat
from .layout import Layout


@pytest.fixture
def props(blender: ModuleType) -> Any:
    """The panel, with a source that squats and a target whose rig was never mapped."""
    saved_maps = importlib.import_module("bl_ext.user_default.tricap.addon.retarget.saved_maps")
    saved_maps.file_of(person()).unlink(missing_ok=True)
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    props = blender.context.scene.tricap_retarget
    props.source, props.target = build_armature(squat(person(), frames=4), "Source"), armature(person(), "Target")
    return props


def armature(rig: Rig, name: str) -> Any:
    return build_armature(flail(rig, frames=3, reach=0.1), name)


def steered() -> dict[str, Any]:
    """A mapping of a person whose bones are controls that follow each other."""
    rig = person()
    follows = {name: rig.names[p] for name, p in zip(rig.names, rig.parents) if p >= 0}
    return {
        "name": "controls",
        "bones": {name: name for name in rig.names},
        "steering": {"follows": follows, "properties": {"hips": {"IK_FK": 1.0}}, "skin": {"foot.L": "foot.R"}},
    }


def test_parts_that_are_missing_for_the_same_reason_are_one_note() -> None:
    reasons = {"hips": "no bone was recognised", "toe.L": "no bone “ball_l”", "shin.L": "no bone was recognised"}
    assert RigMap(bones={}, twist={}, missing=reasons).missing_notes == ("hips, shin.L: no bone was recognised", "toe.L: no bone “ball_l”")


def test_a_saved_mapping_keeps_its_steering(blender: ModuleType, props: Any, tmp_path: Path) -> None:
    ops = blender.ops.tricap
    (tmp_path / "a.json").write_text(json.dumps(steered()))
    assert ops.retarget_load_map(filepath=str(tmp_path / "a.json")) == {"FINISHED"}
    assert ops.retarget_save_map(filepath=str(tmp_path / "b.json")) == {"FINISHED"}
    found = read_preset(tmp_path / "b.json").control_rig
    assert found is not None and found.table() == steered()["steering"]
    props.rows[[row.role for row in props.rows].index("head")].bones = "elsewhere"  # no control
    ops.retarget_save_map(filepath=str(tmp_path / "b.json"))
    assert read_preset(tmp_path / "b.json").control_rig is None
    assert ops.retarget_find_map() == {"FINISHED"} and not props.steering
    with pytest.raises(RuntimeError, match="Cannot read"):
        ops.retarget_load_map(filepath=str(tmp_path / "nowhere.json"))


def test_a_file_that_lies_down_is_put_upright(blender: ModuleType, props: Any, tmp_path: Path) -> None:
    source = squat(person(), frames=4)
    write_bvh(tmp_path / "a.bvh", source)
    props.source, props.file, props.up = None, str(tmp_path / "a.bvh"), "Z"
    assert blender.ops.tricap.retarget() == {"FINISHED"} and "which axis is up" in props.last
    props.up = "Y"
    assert blender.ops.tricap.retarget() == {"FINISHED"} and "which axis is up" not in props.last


def test_lines_are_added_and_removed(blender: ModuleType, props: Any, tmp_path: Path) -> None:
    ops = blender.ops.tricap
    assert not ops.retarget_remove_line.poll()
    assert ops.retarget_add_line() == ops.retarget_add_line() == {"FINISHED"}
    assert [row.role for row in props.rows] == ["hips", "spine"] and props.row == 1
    props.rows[0].bones, props.rows[1].bones, props.rows[1].twist = "hips", "spine, neck", "head"
    ops.retarget_save_map(filepath=str(tmp_path / "a.json"))
    saved = json.loads((tmp_path / "a.json").read_text())
    assert saved["bones"] == {"hips": ["hips"], "spine": ["spine", "neck"]} and saved["twist"] == {"spine": ["head"]}
    props.rows[1].role = "hips"
    with pytest.raises(RuntimeError, match="2 lines for “hips”"):
        ops.retarget()
    ops.retarget_remove_line()
    assert [row.role for row in props.rows] == ["hips"] and props.row == 0 and ops.retarget() == {"FINISHED"}


def test_lines_of_another_target_are_not_used(blender: ModuleType, props: Any) -> None:
    ops = blender.ops.tricap
    ops.retarget_find_map()
    props.target = armature(person(names={role: f"Bip001 {role}" for role in person().names}), "Other")
    assert ops.retarget() == {"FINISHED"}
    assert "the mapping is that of “Target” and was not used" in props.last and props.target.animation_data.action.name == "Source on Other"
    ops.retarget_add_line()
    assert props.rows_of == props.target and len(props.rows) == 1


def test_the_editor_is_drawn(blender: ModuleType, props: Any, tmp_path: Path) -> None:
    """Every button and property of it exists; whose lines they are is said, twist is shown, and what a file may need."""
    panel = importlib.import_module("bl_ext.user_default.tricap.addon.retarget.panel")

    def drawn() -> Layout:
        layout = Layout()
        panel.draw_retarget(layout, blender.context)
        return layout

    empty = drawn()
    buttons = {"find_map", "load_map", "save_map", "add_line", "remove_line"}
    assert {f"tricap.retarget_{name}" for name in buttons} <= set(empty.operators) and "unit" not in empty.properties
    assert blender.ops.tricap.retarget_find_map() == {"FINISHED"}
    assert [layout.properties.count("twist") for layout in (empty, drawn())] == [1, 2], "the setting alone; and that of the selected line"
    props.target, props.source, props.file = props.source, None, str(tmp_path / "a.trc")
    assert "that of “Target”" in " ".join(drawn().texts) and {"up", "unit"} <= set(drawn().properties)
    assert "choose its armature as the target" not in " ".join(drawn().texts)
    for thing in [thing for thing in blender.data.objects if thing.type == "ARMATURE"]:
        blender.data.objects.remove(thing)
    assert "choose its armature as the target" in " ".join(drawn().texts), "why Retarget is grey"


def test_a_preview_can_be_ended_while_there_is_one(blender: ModuleType, props: Any) -> None:
    panel, ops = importlib.import_module("bl_ext.user_default.tricap.addon.retarget.panel"), blender.ops.tricap

    def offered() -> bool:
        layout = Layout()
        panel.draw_retarget(layout, blender.context)
        return "tricap.retarget_end_preview" in layout.operators

    assert not offered() and ops.retarget_preview() == {"FINISHED"} and offered()
    assert ops.retarget_end_preview() == {"FINISHED"} and not offered()


def test_a_posed_target_is_aligned_and_its_mapping_is_found_again(blender: ModuleType, props: Any, tmp_path: Path) -> None:
    ops, target = blender.ops.tricap, props.target
    saved_maps = importlib.import_module("bl_ext.user_default.tricap.addon.retarget.saved_maps")
    file = saved_maps.file_of(importlib.import_module("bl_ext.user_default.tricap.addon.retarget.read").read_rig(target))
    try:
        target.animation_data_clear()
        assert ops.retarget_find_map() == {"FINISHED"}
        rows = {row.role: row for row in props.rows}
        assert rows["hand.L"].source == rows["hand.L"].bones == "hand.L"
        assert ops.retarget() == {"FINISHED"}
        blender.context.scene.frame_set(2)
        before = target.pose.bones["hand.L"].matrix.copy()
        target.animation_data.action = None
        target.pose.bones["hand.L"].matrix = before @ Euler((0.5, 0.0, 0.0)).to_matrix().to_4x4()
        blender.context.view_layer.update()
        assert ops.retarget_align_pose() == {"FINISHED"}
        rows = {row.role: tuple(row.offset) for row in props.rows if any(row.offset)}
        assert rows["hand.L"] == pytest.approx((0.5, 0.0, 0.0), abs=1e-4)
        assert not {"hand.R", "head", "forearm.L", "upper_arm.R"} & rows.keys()
        assert ops.retarget() == {"FINISHED"}
        blender.context.scene.frame_set(2)
        turned = before.to_3x3().inverted() @ target.pose.bones["hand.L"].matrix.to_3x3()
        assert turned.to_euler().x == pytest.approx(0.5, abs=2e-3)
        props.rows.clear()
        assert ops.retarget_find_map() == {"FINISHED"}
        assert {row.role: row.offset[0] for row in props.rows}["hand.L"] == pytest.approx(0.5, abs=1e-4), "found again"
        assert ops.retarget_find_map() == {"FINISHED"} and not any(any(row.offset) for row in props.rows), "recognised anew"
    finally:
        file.unlink(missing_ok=True)


def test_linked_and_overridden_characters(blender: ModuleType, props: Any, tmp_path: Path) -> None:
    source, target = props.source, props.target
    target.animation_data_clear()
    blender.data.libraries.write(str(tmp_path / "hero.blend"), {target})
    blender.data.objects.remove(target)
    with blender.data.libraries.load(str(tmp_path / "hero.blend"), link=True) as (_, found):
        found.objects = ["Target"]
    linked = found.objects[0]
    blender.context.scene.collection.objects.link(linked)
    props.source, props.target = source, linked
    with pytest.raises(RuntimeError, match="is linked from hero.blend and cannot be animated here"):
        blender.ops.tricap.retarget()
    own = linked.override_create(remap_local_usages=True)
    blender.context.view_layer.update()
    props.target = own
    assert blender.ops.tricap.retarget() == {"FINISHED"}
    assert own.animation_data.action is not None and own.override_library is not None
    blender.context.scene.frame_set(3)
    first = own.pose.bones["thigh.L"].matrix.copy()
    blender.context.scene.frame_set(1)
    assert own.pose.bones["thigh.L"].matrix != first, "it moves"
