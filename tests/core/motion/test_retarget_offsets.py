"""Rotation offsets of a mapping, found from a pose; rigs that have nothing in common."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rotation import matrix_from_euler, transposed
from tricap.core.motion.retarget.mapping import MappedMotion, MappedRig, read_preset, write_map
from tricap.core.motion.retarget.retarget import retarget
from tricap.core.motion.retarget.transfer import offsets_of_pose

from .persons import flail, mapped, mapped_rig, person


def test_rotation_offsets_turn_parts_and_are_found_from_a_pose() -> None:
    source, target = mapped(flail(person(arms_down_deg=30.0), reach=0.5)), mapped_rig(person(roll_seed=3, arms_down_deg=10.0))
    plain = retarget(source, target)
    offsets = {"hand.L": (20.0, -10.0, 5.0), "upper_arm.R": (0.0, 30.0, 0.0)}
    moved = MappedRig(rig=target.rig, map=replace(target.map, offsets_deg=offsets))
    result = retarget(source, moved)
    for role, angles in offsets.items():
        b = target.rig.index[role]
        turned = transposed(plain.motion.R[:, b]) @ result.motion.R[:, b]
        assert np.abs(turned - matrix_from_euler(np.radians(angles), "XYZ")).max() < 1e-9
    still = [target.rig.index[role] for role in ("hand.R", "thigh.L", "hips", "forearm.R")]
    assert np.abs(result.motion.R[:, still] - plain.motion.R[:, still]).max() < 1e-9, "other parts keep their directions"
    pose = replace(result.motion, frames=result.motion.frames[7:8], R=result.motion.R[7:8], head_m=result.motion.head_m[7:8], residual=None)
    found = offsets_of_pose(source, 7, MappedMotion(motion=pose, map=target.map))
    arms = {role: angles for role, angles in found.items() if role.split(".")[0] not in ("thigh", "shin", "foot", "toe", "hips")}
    assert arms.keys() == offsets.keys() and all(np.allclose(arms[role], offsets[role], atol=1e-6) for role in offsets)


def test_rigs_without_a_common_part_are_named() -> None:
    arm, leg = mapped(flail(person())), mapped_rig(person())
    source = MappedMotion(motion=arm.motion, map=replace(arm.map, bones={"upper_arm.R": ("upper_arm.R",)}))
    target = MappedRig(rig=leg.rig, map=replace(leg.map, bones={"thigh.L": ("thigh.L",)}))
    with pytest.raises(InputError, match="the source has upper_arm.R, the target thigh.L"):
        retarget(source, target)
    assert any("the source has no hips, only upper_arm.R" in note for note in retarget(source, leg).notes)


def test_offsets_are_kept_in_the_file_of_a_mapping(tmp_path: Path) -> None:
    rig_map = replace(mapped_rig(person()).map, offsets_deg={"hand.L": (20.0, -10.0, 5.0)})
    write_map(tmp_path / "a.json", rig_map, "kick")
    assert read_preset(tmp_path / "a.json").offsets_deg == rig_map.offsets_deg
    for wrong in ('{"hand.L": [1, 2]}', '{"tail": [1, 2, 3]}', '{"hand.L": [1, 2, 1e9]}', '{"hand.L": "x"}'):
        (tmp_path / "b.json").write_text('{"bones": {"hips": "hips"}, "offsets_deg": ' + wrong + "}")
        with pytest.raises(InputError, match="three angles"):
            read_preset(tmp_path / "b.json")
