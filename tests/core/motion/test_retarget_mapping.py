"""Recognition of rigs by names, by shape, and by presets."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.motion.retarget import shape
from tricap.core.motion.retarget.mapping import NEEDED, apply_preset, best_preset, by_names, find_map, fit_of, read_preset, write_map
from tricap.core.motion.retarget.rig import Rig
from tricap.core.motion.retarget.roles import ROLES, parent_role, part_of, read_name, side_of, sided
from tricap.core.motion.retarget.shape import by_shape

from .persons import person
from .test_retarget import in_three

PRESETS = sorted((Path(__file__).resolve().parents[3] / "addon" / "presets").glob("*.json"))
BODY = tuple(role for role in ROLES if "." not in part_of(role))


def named(central: dict[str, str], limbs: dict[str, str], left: str, right: str) -> dict[str, str]:
    """Names by role; limbs' names hold {s} for the side."""
    return central | {sided(part, s): name.replace("{s}", word) for part, name in limbs.items() for s, word in (("L", left), ("R", right))}


FAMILIES = {
    "mixamo": named(
        {"hips": "mixamorig7:Hips", "spine": "mixamorig7:Spine", "neck": "mixamorig7:Neck", "head": "mixamorig7:Head"},
        {
            "clavicle": "mixamorig7:{s}Shoulder",
            "upper_arm": "mixamorig7:{s}Arm",
            "forearm": "mixamorig7:{s}ForeArm",
            "hand": "mixamorig7:{s}Hand",
            "thigh": "mixamorig7:{s}UpLeg",
            "shin": "mixamorig7:{s}Leg",
            "foot": "mixamorig7:{s}Foot",
            "toe": "mixamorig7:{s}ToeBase",
        },
        "Left",
        "Right",
    ),
    "collar": named(
        {"hips": "Hips", "spine": "Chest", "neck": "Neck", "head": "Head"},
        {
            "clavicle": "{s}Collar",
            "upper_arm": "{s}Shoulder",
            "forearm": "{s}Elbow",
            "hand": "{s}Wrist",
            "thigh": "{s}Hip",
            "shin": "{s}Knee",
            "foot": "{s}Ankle",
            "toe": "{s}Toe",
        },
        "Left",
        "Right",
    ),
    "spoken": named(
        {"hips": "Hips", "spine": "Spine", "neck": "Neck", "head": "Head"},
        {
            "clavicle": "{s} shoulder",
            "upper_arm": "{s} arm",
            "forearm": "{s} elbow",
            "hand": "{s} wrist",
            "thigh": "{s} leg",
            "shin": "{s} knee",
            "foot": "{s} ankle",
            "toe": "{s} toe",
        },
        "Left",
        "Right",
    ),
    "asf": named(
        {"hips": "root", "spine": "thorax", "neck": "lowerneck", "head": "head"},
        {
            "clavicle": "{s}clavicle",
            "upper_arm": "{s}humerus",
            "forearm": "{s}radius",
            "hand": "{s}wrist",
            "thigh": "{s}femur",
            "shin": "{s}tibia",
            "foot": "{s}foot",
            "toe": "{s}toes",
        },
        "l",
        "r",
    ),
    "biped": named(
        {"hips": "Bip001 Pelvis", "spine": "Bip001 Spine", "neck": "Bip001 Neck", "head": "Bip001 Head"},
        {
            "clavicle": "Bip001 {s} Clavicle",
            "upper_arm": "Bip001 {s} UpperArm",
            "forearm": "Bip001 {s} Forearm",
            "hand": "Bip001 {s} Hand",
            "thigh": "Bip001 {s} Thigh",
            "shin": "Bip001 {s} Calf",
            "foot": "Bip001 {s} Foot",
            "toe": "Bip001 {s} Toe0",
        },
        "L",
        "R",
    ),
    "smpl": named(
        {"hips": "m_avg_Pelvis", "spine": "m_avg_Spine3", "neck": "m_avg_Neck", "head": "m_avg_Head"},
        {
            "clavicle": "m_avg_{s}_Collar",
            "upper_arm": "m_avg_{s}_Shoulder",
            "forearm": "m_avg_{s}_Elbow",
            "hand": "m_avg_{s}_Wrist",
            "thigh": "m_avg_{s}_Hip",
            "shin": "m_avg_{s}_Knee",
            "foot": "m_avg_{s}_Ankle",
            "toe": "m_avg_{s}_Foot",
        },
        "L",
        "R",
    ),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_families_are_recognised_by_their_names(family: str) -> None:
    names = FAMILIES[family]
    found = find_map(person(names=names), [read_preset(path) for path in PRESETS])
    assert {role: found.bones[role][0] for role in BODY if role in found.bones} == {role: names[role] for role in BODY}, found


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"arms_down_deg": 45.0},
        {"heading_deg": 180.0},
        {"heading_deg": 90.0, "size": 0.02},
        {"without": ("clavicle",)},
        {"legs_apart_deg": 10.0, "roll_seed": 4},
    ],
    ids=str,
)
def test_a_rig_without_telling_names_is_recognised_by_its_shape(change: dict[str, object]) -> None:
    plain = person(**change)  # type: ignore[arg-type]
    names = {role: f"joint{i * 7 % 31}" for i, role in enumerate(plain.names)}
    found = find_map(person(names=names, **change))  # type: ignore[arg-type]
    for role in NEEDED:
        assert found.bones[role][0] == names[role], role
    assert any("shape" in note for note in found.notes)


def test_nothing_like_a_body_is_said() -> None:
    rig = person(names={role: f"b{i}" for i, role in enumerate(person().names)}, without=("thigh", "shin", "foot", "toe"))
    assert by_shape(rig) is None
    with pytest.raises(InputError, match="recognised"):
        find_map(rig)


def test_a_bone_with_hundreds_of_limbs_is_no_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not every two of them are compared."""
    compared = list[tuple[object, ...]]()
    monkeypatch.setattr(shape, "_mirrored", lambda *pair: compared.append(pair) or False)
    n = 300
    tail_m = np.stack([np.cos(np.arange(n)), np.sin(np.arange(n)), np.full(n, 0.2)], axis=1)
    star = Rig(
        names=tuple(f"b{i}" for i in range(n)), parents=np.array([-1] + [0] * (n - 1)), R_rest=np.tile(np.eye(3), (n, 1, 1)),
        head_m=np.zeros((n, 3)), tail_m=tail_m, connected=np.zeros(n, dtype=bool), inherits_rotation=np.ones(n, dtype=bool),
    )  # fmt: skip
    assert by_shape(star) is None and not compared


def test_presets_read_write_and_fit_their_own(tmp_path: Path) -> None:
    assert len(PRESETS) >= 12
    presets = [read_preset(path) for path in PRESETS]
    assert all(role in preset.bones for preset in presets for role in NEEDED)
    rig = person(names=FAMILIES["mixamo"])
    found = by_names(rig)
    write_map(tmp_path / "mine.json", found, "mine")
    again = apply_preset(rig, read_preset(tmp_path / "mine.json"))
    assert again.bones == found.bones and fit_of(rig, read_preset(tmp_path / "mine.json"))[0] == 1.0


def test_of_several_families_the_one_that_says_most(tmp_path: Path) -> None:
    """A mannequin of five spine bones has all names of the one of three, too; a trunk goes on to the arms if a family's stops earlier."""
    presets = [read_preset(path) for path in sorted(PRESETS)]
    older, newer = (next(p for p in presets if mark in p.name) for mark in ("UE4", "UE5"))
    bones = {name: i for i, name in enumerate(name for chain in newer.bones.values() for name in chain)}
    assert best_preset(SimpleNamespace(index=bones), presets) is newer  # type: ignore[arg-type]
    del bones["spine_05"], bones["spine_04"], bones["neck_02"]
    assert best_preset(SimpleNamespace(index=bones), presets) is older  # type: ignore[arg-type]
    write_map(tmp_path / "one.json", by_names(person()), "of one spine bone")
    assert find_map(in_three(person(), 0.3, 0.6), [read_preset(tmp_path / "one.json")]).bones["spine"] == ("spine", "spine_2", "spine_3")


def test_bones_that_mark_an_end_are_no_parts() -> None:
    """Files from Blender's own FBX exporter end every limb with one."""
    names = {role: f"joint{i * 7 % 31}" for i, role in enumerate(person().names)}
    rig = person(names=names, without=("neck", "toe"))
    ends = [b for b in range(len(rig.names)) if not rig.children[b]]
    n = len(rig.names) + len(ends)
    longer = Rig(
        names=(*rig.names, *(f"{rig.names[b]}_end" for b in ends)),
        parents=np.array([*rig.parents, *ends]),
        R_rest=np.concatenate([rig.R_rest, rig.R_rest[ends]]),
        head_m=np.concatenate([rig.head_m, rig.tail_m[ends]]),
        tail_m=np.concatenate([rig.tail_m, 2 * rig.tail_m[ends] - rig.head_m[ends]]),
        connected=np.zeros(n, dtype=bool),
        inherits_rotation=np.ones(n, dtype=bool),
    )
    assert find_map(longer).bones == find_map(rig).bones and find_map(rig).origin == "shape"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[]", "no mapping"),
        ("{", "not a JSON"),
        ('{"bones": {"elbow": "x"}}', "no part of the body"),
        ('{"bones": {"hips": 3}}', "no bones"),
        ('{"bones": {}, "sides": {"L": 1}}', "sides"),
        ('{"bones": {}, "prefixes": 5}', "prefixes"),
        ('{"bones": {}, "prefixes": null}', "prefixes"),
        ('{"bones": {}, "prefixes": []}', "prefixes"),
        (json.dumps({"bones": {"hips": ["{s}"] * 8000}}), "no bones"),  # tried with every prefix: 17 s
        (json.dumps({"bones": {}, "prefixes": [""] * 60000}), "prefixes"),
        (json.dumps({"bones": {"hand.{s}": "{s}" * 100}, "sides": {"L": "x" * 300000, "R": "y"}}), "sides"),  # 30 MB for a name
        ('{"bones": {"hips": "nowhere"}}', "None of the bones"),
    ],
)
def test_bad_mappings_are_said(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "map.json").write_text(text)
    with pytest.raises(InputError, match=word):
        apply_preset(person(), read_preset(tmp_path / "map.json"))


@pytest.mark.parametrize(
    ("name", "side", "part"),
    [
        ("DEF-upper_arm.L", "L", "upper_arm"),
        ("ValveBiped.Bip01_R_Calf", "R", "shin"),
        ("J_Bip_R_LowerArm", "R", "forearm"),
        ("lShldrBend", "L", "upper_arm"),
        ("CC_Base_L_Thigh", "L", "thigh"),
        ("thigh_r", "R", "thigh"),
        ("IK-foot.l", "L", ""),
        ("control-toe-roll.r", "R", ""),
        ("Head_End", "", ""),
        ("pelvis.L", "L", ""),
        ("Neo_LeftUpLeg", "L", "thigh"),
    ],
)
def test_what_a_name_says(name: str, side: str, part: str) -> None:
    reading = read_name(name)
    assert (reading.side, reading.part) == (side, part)


@pytest.mark.parametrize(
    ("name", "finger"),
    [
        ("LeftHandIndex1", "index.1"),
        ("thumb_02_l", "thumb.2"),
        ("leftLittleDistal", "pinky.3"),
        ("f_ring.03.R", "ring.3"),
        ("LeftInHandMiddle", "middle.0"),
    ],
)
def test_fingers(name: str, finger: str) -> None:
    assert read_name(name).finger == finger


def test_roles_hang_together() -> None:
    for role in ROLES:
        above = parent_role(role)
        assert above in ROLES or (role, above) == ("hips", "")
        assert not above or side_of(above) in ("", side_of(role))
