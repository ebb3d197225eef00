"""A rig that Rigify generated: the keys go onto its FK controls, and what deforms the skin moves as it should."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.addon.retarget import apply
from tricap.addon.retarget.build import build_armature
from tricap.addon.retarget.preview import add_preview, remove_preview
from tricap.addon.retarget.read import read_motion, read_rig
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.motion.retarget.contacts import FeetSettings
from tricap.core.motion.retarget.mapping import apply_preset, read_preset, write_map
from tricap.core.motion.retarget.measure import measure
from tricap.core.motion.retarget.retarget import RetargetSettings

from ..core.motion.persons import mapped, mapped_rig, person, squat

CONTROLS = ("torso", "spine_fk.003", "upper_arm_fk.L", "shin_fk.R", "head", "toe_fk.L", "f_index.02.R")


@pytest.fixture
def generated(empty: ModuleType) -> Iterator[Any]:
    """A human of Rigify, generated in an empty file."""
    import addon_utils

    addon_utils.enable("rigify", default_set=True)
    empty.ops.object.armature_human_metarig_add()
    metarig = empty.context.object
    empty.ops.pose.rigify_generate()
    rig = next(o for o in empty.data.objects if o.type == "ARMATURE" and o is not metarig)
    empty.data.objects.remove(metarig)
    yield rig
    addon_utils.disable("rigify", default_set=True)


@pytest.mark.slow
def test_controls_are_keyed_and_the_deform_bones_follow(generated: Any, tmp_path: Path) -> None:
    source = squat(person(), frames=20)
    moving, goal = mapped(source), apply.read_target(generated)
    assert goal.rig_map.origin == "mapping “Rigify controls”" and not goal.rig_map.missing and set(CONTROLS) <= set(goal.rig.names)
    moved_before = generated.pose.bones["hand_ik.L"]
    moved_before.location = (0.3, 0.0, 0.2)  # left from an earlier pose: put to rest
    result = apply.transfer(moving, goal, RetargetSettings(), FeetSettings(), Monitor())
    outcome = apply.apply(generated, moving, goal, result, "Squat")
    assert not [note for note in outcome.notes if "drives the rig" in note] and outcome.figures.direction_rms_deg < 1.0
    assert outcome.figures.slide_mm < 5.0
    whole = read_rig(generated)
    deforming = apply.map_of(whole)
    assert deforming.control_rig is None and deforming.bones["thigh.L"][0].startswith("DEF-")
    played = read_motion(generated, whole, [int(f) for f in source.frames])
    assert measure(moving, mapped(played, deforming), None).direction_rms_deg < 1.0
    assert generated.pose.bones["thigh_parent.L"]["IK_FK"] == 1.0 and np.abs(moved_before.location).max() == 0
    write_map(tmp_path / "map.json", goal.rig_map, "mine")
    again = apply_preset(whole, read_preset(tmp_path / "map.json"))
    assert again.control_rig is not None and again.control_rig.follows == goal.rig_map.control_rig.follows  # type: ignore[union-attr]
    edited = replace(goal.rig_map, bones={role: chain for role, chain in goal.rig_map.bones.items() if role != "neck"}, control_rig=None)
    kept = apply.read_target(generated, edited=edited)
    assert kept.rig_map.control_rig is not None and "neck" not in kept.rig.names and len(kept.rig.names) == len(goal.rig.names) - 1
    other = replace(edited, bones={**edited.bones, "head": ("DEF-spine.006",)})
    assert apply.read_target(generated, edited=other).rig_map.control_rig is None
    the_preview_gives_back_what_it_set(generated)


def the_preview_gives_back_what_it_set(generated: Any) -> None:
    source = build_armature(squat(person(), frames=4), "Source")
    source_rig, goal = read_rig(source), apply.read_target(generated)
    generated.pose.bones["thigh_parent.L"]["IK_FK"] = 0.25
    assert add_preview(source, mapped_rig(source_rig), generated, goal.mapped) > 15
    assert generated.pose.bones["thigh_parent.L"]["IK_FK"] == 1.0
    assert remove_preview(generated) > 15 and generated.pose.bones["thigh_parent.L"]["IK_FK"] == 0.25


@pytest.mark.parametrize(
    "steering, said",
    [
        ("3", "has no hierarchy of its controls"),
        ('{"follows": {"a": "b", "b": "a"}}', "lets “a” follow itself"),
        ('{"follows": {"a": 3}}', "must have names of bones"),
        ('{"follows": {}, "properties": {"a": {"IK": "x"}}}', "needs numbers by name"),
    ],
)
def test_damaged_steering(tmp_path: Path, steering: str, said: str) -> None:
    (tmp_path / "map.json").write_text(f'{{"bones": {{"hips": "torso"}}, "steering": {steering}}}')
    with pytest.raises(InputError, match=said):
        read_preset(tmp_path / "map.json")
