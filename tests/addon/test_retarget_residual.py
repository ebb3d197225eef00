"""What a rig cannot show is stored with its action: through the operators, a file and a strip; it is dropped once the action was edited."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.__main__ import main
from tricap.addon.retarget import read
from tricap.addon.retarget.build import build_armature
from tricap.addon.retarget.read import action_frames, read_motion, read_rig
from tricap.addon.retarget.write import push_to_strip
from tricap.addon.scene.action_curves import keys_digest
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rotation import angle_of, transposed
from tricap.core.motion.retarget.rig import Motion

from ..core.motion.persons import flail, person

BACK_DEG = 0.1  # promised: 1°


def scene_with_both() -> tuple[Any, Any]:
    """A moving armature of all bones, and one with fewer and other proportions."""
    full = build_armature(flail(person(roll_seed=1), frames=12, reach=0.5), "Full")
    few = build_armature(flail(person(without=("neck", "clavicle", "toe"), size=0.6, thigh_part=0.55, arms_down_deg=45.0), frames=2), "Few")
    return full, few


def played(armature_object: Any) -> Motion:
    return read_motion(armature_object, read_rig(armature_object), action_frames(armature_object))


def off_deg(a: Motion, b: Motion) -> float:
    return float(np.degrees(angle_of(transposed(a.R) @ b.R)).max())


def test_the_operators_bring_all_bones_back(blender: ModuleType) -> None:
    bpy = blender
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    full, few = scene_with_both()
    twin = build_armature(flail(person(roll_seed=1), frames=2), "Twin")
    assert bpy.ops.tricap.retarget(source="Full", target="Twin") == {"FINISHED"}  # feet are held
    wanted = played(twin)
    assert bpy.ops.tricap.retarget(source="Twin", target="Few") == {"FINISHED"}
    assert bpy.ops.tricap.retarget(source="Few", target="Full") == {"FINISHED"}
    assert off_deg(wanted, played(full)) < BACK_DEG
    point = read.action_with_residual(few).layers[0].strips[0].channelbags[0].fcurves[0].keyframe_points[3]
    point.co[1] += 0.01
    assert bpy.ops.tricap.retarget(source="Few", target="Full") == {"FINISHED"}
    assert off_deg(wanted, played(full)) > 5.0 and "was edited" in bpy.context.scene.tricap_retarget.last
    few.animation_data.action[read.RESIDUAL_KEY] = {"motion": "{", "keys": keys_digest(few.animation_data.action)}
    with pytest.raises(RuntimeError, match="damaged"):
        bpy.ops.tricap.retarget(source="Few", target="Full")


def test_a_file_and_a_strip_keep_the_residual_motion(empty: ModuleType, tmp_path: Path) -> None:
    full, few = scene_with_both()
    few.animation_data_clear()
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "full.blend"), copy=True)
    wanted = played(full)
    empty.data.objects.remove(full)
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "few.blend"), copy=True)
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "full.blend"))
    empty.data.objects.remove(empty.data.objects["Few"])
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "full.blend"), copy=True)
    for source, rig, out in (("full", "few", "there"), ("there", "full", "back")):
        assert (
            main(
                [
                    "retarget",
                    str(tmp_path / f"{source}.blend"),
                    "--rig",
                    str(tmp_path / f"{rig}.blend"),
                    "--out",
                    str(tmp_path / f"{out}.blend"),
                    "--feet",
                    "off",
                    "--quiet",
                ]
            )
            == 0
        )
    assert off_deg(wanted, played(empty.data.objects["Full"])) < BACK_DEG
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "there.blend"))
    few = empty.data.objects["Few"]
    action = few.animation_data.action
    push_to_strip(few, action)
    assert read.action_with_residual(few) == action and read.with_residual_motion(few, played(few)).residual is not None
    few.animation_data.nla_tracks[0].strips[0].scale = 2.0
    assert read.with_residual_motion(few, played(few)).residual is None
    few.animation_data_clear()
    with pytest.raises(InputError, match="no action"):
        played(few)
