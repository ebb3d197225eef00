"""Retargeting in a real Blender: stick people as armatures, real rigs and motions where they are at hand, bad rigs, the command."""

import json
import struct
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from mathutils import Euler, Matrix, Vector

from tricap.__main__ import main
from tricap.addon.retarget import apply, files
from tricap.addon.retarget.build import build_armature
from tricap.addon.retarget.preview import add_preview, remove_preview
from tricap.addon.retarget.read import action_frames, read_motion, read_rig
from tricap.addon.retarget.write import push_to_strip
from tricap.addon.scene.armature import add_armature
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import angle_of, transposed
from tricap.core.motion.formats.bvh import write_bvh
from tricap.core.motion.retarget.contacts import FeetSettings
from tricap.core.motion.retarget.mapping import find_map
from tricap.core.motion.retarget.measure import measure
from tricap.core.motion.retarget.retarget import RetargetSettings
from tricap.core.motion.retarget.rig import Motion, channels
from tricap.core.motion.sources import read_motion_source

from ..core.motion.persons import flail, mapped, mapped_rig, person, squat
from ..core.motion.test_retarget import recorded
from .conftest import SmallRun

SHARED = Path(__file__).resolve().parents[3] / "shared"
RIGS = (
    "cryptovoxels.vrm",
    "gdquest_mannequiny.glb",
    "kaykit_knight.glb",
    "mpfb_female_mixamo-names.glb",
    "mpfb_male_cmu_mb-names.glb",
    "mpfb_male_game_engine_UE-names.glb",
)
MOTIONS = ("02_01_walk", "02_04_jump_balance")
PLAYED_DEG = 0.02  # single precision of pose matrices; measured 2e-3
PROMISED = {"direction_rms_deg": 1.0, "slide_mm": 5.0, "penetration_mm": 5.0, "largest_step_deg": 90.0}


def armature(rig: Any, name: str) -> Any:
    """A rig as an armature object that moves a little and has an action."""
    return build_armature(flail(rig, frames=4, reach=0.1), name)


def test_a_robot_to_try_it_on(blender: ModuleType) -> None:
    """The button adds a target, which the next press lets move; what was active and selected stays, also in pose mode."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    source = armature(person(), "Person")
    blender.context.view_layer.objects.active = source
    chosen = set(blender.context.selected_objects)
    blender.ops.object.mode_set(mode="POSE")
    assert blender.ops.tricap.add_robot() == {"FINISHED"}
    robot, props = blender.data.objects["Robot"], blender.context.scene.tricap_retarget
    assert props.target == robot and blender.context.view_layer.objects.active == source and set(blender.context.selected_objects) == chosen
    props.source = source
    assert blender.ops.tricap.retarget() == {"FINISHED"} and robot.animation_data.action is not None
    assert not apply.read_target(robot).rig_map.missing_notes, "all of its bones are recognised"
    assert blender.ops.tricap.add_robot() == {"FINISHED"} and props.target.name == "Robot.001"


@pytest.mark.parametrize(("origin_m", "lifted_m", "floor_m"), [(0, 0, 0), (0, -0.9, 0), (1, 1, 1), (1.9, 1, 1), (0, 1, 1), (0, -3, -3)])
def test_the_floor_under_a_rig(origin_m: float, lifted_m: float, floor_m: float) -> None:
    """It is at the origin or under the feet; a rig with its pelvis at the scene's origin comes to stand on the scene's floor."""
    rig = person()
    up = np.array([0.0, 0.0, lifted_m])
    rig = replace(rig, head_m=rig.head_m + up, tail_m=rig.tail_m + up)
    assert apply._floor_m(rig, find_map(rig, []), origin_m) == pytest.approx(floor_m, abs=0.03)


def test_a_rig_with_its_pelvis_at_the_origin_stands_on_the_floor(blender: ModuleType) -> None:
    source = squat(person())
    rig = person(size=1.2)
    up = np.array([0.0, 0.0, -rig.head_m[0, 2]])
    target = build_armature(flail(replace(rig, head_m=rig.head_m + up, tail_m=rig.tail_m + up), frames=4, reach=0.1), "Pelvis")
    onto(target, source)
    motion = played(target, (0, 45, 89))
    ankles_m = motion.head_m[:, [motion.rig.index[f"foot.{side}"] for side in "LR"], 2]
    assert (ankles_m > 0).all() and ankles_m.max() < 0.2, ankles_m


def played(target: Any, frames: Any) -> Any:
    return read_motion(target, read_rig(target), [int(f) for f in frames])


def onto(target: Any, source: Any, tolerance_deg: float = 0.0, **feet: Any) -> apply.Outcome:
    goal, moving = apply.read_target(target), mapped(source)
    result = apply.transfer(moving, goal, RetargetSettings(), FeetSettings(**feet), Monitor())
    return apply.apply(target, moving, goal, result, "Test", tolerance_deg)


@pytest.mark.parametrize("mode", ["QUATERNION", "XYZ", "ZYX", "AXIS_ANGLE"])
def test_blender_plays_what_was_meant(empty: ModuleType, mode: str) -> None:
    target = armature(person(roll_seed=2, arms_down_deg=45.0), "Target")
    target.matrix_world = Matrix.LocRotScale(Vector((0.3, 0.2, 0.0)), Euler((0.0, 0.0, 2.1)), Vector((1.7, 1.7, 1.7)))
    for bone in target.pose.bones:
        bone.rotation_mode = mode
    empty.context.view_layer.update()
    outcome = onto(target, squat(person()))
    wanted = outcome.result.motion
    found = played(target, wanted.frames)
    assert np.degrees(angle_of(transposed(found.R) @ wanted.R)).max() < PLAYED_DEG
    np.testing.assert_allclose(found.head_m, wanted.head_m, atol=1e-5)
    assert outcome.figures.direction_rms_deg < 1.0 and outcome.figures.slide_mm < 1.0
    assert not any("drives the rig" in note for note in outcome.notes)


def test_a_new_action_and_the_old_one_kept(empty: ModuleType) -> None:
    target = armature(person(), "Target")
    former = target.animation_data.action
    before = [tuple(point.co) for curve in curves(former) for point in curve.keyframe_points]
    outcome = onto(target, squat(person(), frames=10))
    assert target.animation_data.action == outcome.written.action != former and former.use_fake_user
    assert [tuple(point.co) for curve in curves(former) for point in curve.keyframe_points] == before


def test_channels_are_grouped_by_their_bones(empty: ModuleType) -> None:
    """As those of the body: in the Dope Sheet and the Graph Editor they fold into bones."""
    target = armature(person(roll_seed=2), "Target")
    outcome = onto(target, flail(person(), frames=4), tolerance_deg=1.0)
    for action in (outcome.written.action, outcome.written.raw):
        found = curves(action)
        assert len(found) > 20 and not [c.data_path for c in found if c.group is None or c.group.name != c.data_path.split('"')[1]]


def test_few_keys_and_all_of_them(empty: ModuleType) -> None:
    target = armature(person(roll_seed=2), "Target")
    target.pose.bones["head"].scale = (1.0, 2.0, 1.0)  # left from an earlier pose: both actions put it to rest
    source = squat(person(), frames=30)
    outcome = onto(target, source, tolerance_deg=1.0)
    written = outcome.written
    assert not any("drives the rig" in note for note in outcome.notes)
    assert written.raw is not None and written.raw.use_fake_user and written.raw.name == "Test (every frame)"
    assert target.animation_data.action == written.action and target.pose.bones["head"].scale[1] == 1.0
    few, every = ({c.data_path + str(c.array_index): len(c.keyframe_points) for c in curves(a)} for a in (written.action, written.raw))
    assert set(few) == set(every) and sum(few.values()) < 0.7 * sum(every.values())
    assert every['pose.bones["shin.L"].rotation_quaternion1'] == 30
    assert every['pose.bones["head"].scale1'] == few['pose.bones["head"].scale1'] == 1
    wanted = played(target, source.frames)
    target.animation_data.action = written.raw
    found = played(target, source.frames)
    off = transposed(channels(wanted.rig, wanted.R)) @ channels(found.rig, found.R)
    assert 0.2 < np.degrees(angle_of(off)).max() < 1.0, "each bone against its parent"


def test_an_action_in_a_strip_plays_the_same(empty: ModuleType) -> None:
    target, source = armature(person(roll_seed=2), "Target"), squat(person(), frames=12)
    outcome = onto(target, source)
    strip = push_to_strip(target, outcome.written.action)
    assert target.animation_data.action is None and strip.action == outcome.written.action
    assert (strip.frame_start, strip.frame_end) == (0.0, 11.0)
    found, wanted = played(target, source.frames), outcome.result.motion
    assert np.degrees(angle_of(transposed(found.R) @ wanted.R)).max() < PLAYED_DEG
    np.testing.assert_allclose(found.head_m, wanted.head_m, atol=1e-5)


def test_a_thousand_frames_are_written_in_seconds(empty: ModuleType) -> None:
    target, source = armature(person(thigh_part=0.55), "Target"), squat(person(), frames=1000)
    began = time.perf_counter()
    outcome = onto(target, source, tolerance_deg=0.5)
    assert time.perf_counter() - began < 15.0 and len(outcome.result.motion.frames) == 1000  # measured 2 s on one slow core


def test_what_the_vrm_addon_says_is_taken(empty: ModuleType) -> None:
    """Its tables of VRM 0 and 1, as properties of the same shape."""
    bpy = empty
    text, classes = bpy.props.StringProperty, []

    def group(name: str, **properties: Any) -> Any:
        cls = type(name, (bpy.types.PropertyGroup,), {"__annotations__": properties})
        bpy.utils.register_class(cls)
        classes.append(cls)
        return bpy.props.PointerProperty(type=cls)

    node = group("Node", bone_name=text())
    group("Row0", bone=text(), node=node)
    humanoid0 = group("Humanoid0", human_bones=bpy.props.CollectionProperty(type=classes[-1]))
    humanoid1 = group("Humanoid1", human_bones=group("Bones1", left_upper_arm=group("Row1", node=node)))
    bpy.types.Armature.vrm_addon_extension = group("Said", vrm0=group("Vrm0", humanoid=humanoid0), vrm1=group("Vrm1", humanoid=humanoid1))
    try:
        for version in ("vrm0", "vrm1"):
            target = armature(person(), version)
            bones = getattr(target.data.vrm_addon_extension, version).humanoid.human_bones
            row = bones.add() if version == "vrm0" else bones.left_upper_arm
            if version == "vrm0":
                row.bone = "leftUpperArm"
            row.node.bone_name = "forearm.L"
            assert read_rig(target).roles == {"upper_arm.L": "forearm.L"}
    finally:
        del bpy.types.Armature.vrm_addon_extension
        for cls in reversed(classes):
            bpy.utils.unregister_class(cls)


def curves(action: Any) -> list[Any]:
    return [curve for layer in action.layers for strip in layer.strips for bag in strip.channelbags for curve in bag.fcurves]


def test_an_action_is_a_source_and_comes_back(empty: ModuleType) -> None:
    first = build_armature(flail(person(roll_seed=1), frames=12), "First")
    second = armature(person(roll_seed=2, arms_down_deg=40.0, size=0.7), "Second")
    source = read_motion(first, read_rig(first), action_frames(first))
    onto(second, source, mode="off")
    there = played(second, source.frames)
    third = armature(person(roll_seed=1), "Third")
    onto(third, there, mode="off")
    back = played(third, source.frames)
    ours = [b for b, name in enumerate(source.rig.names) if not name.startswith(("forearm",))]  # forearms share the hands' twist
    assert np.degrees(angle_of(transposed(source.R) @ back.R))[:, ours].max() < 0.1


def it_begins_where_it_stands(bpy: ModuleType, target: Any, props: Any) -> None:
    hips = next(row.bones.partition(",")[0] for row in props.rows if row.role == "hips")
    bpy.context.scene.frame_set(int(target.animation_data.action.frame_range[0]))
    rest = target.data.bones[hips].head_local
    assert props.place == "SIDE" and (target.pose.bones[hips].matrix.translation - rest).xy.length == pytest.approx(1.0, abs=1e-4), (
        "beside the source, in which it stands"
    )
    target.location.x = 2.0
    assert bpy.ops.tricap.retarget() == {"FINISHED"}
    assert (target.pose.bones[hips].matrix.translation - rest).xy.length < 1e-4


def test_the_operator_undoes_in_one_step_and_leaves_the_source(blender: ModuleType) -> None:
    bpy = blender
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    source = build_armature(squat(person(), frames=10), "Source")
    target = armature(person(thigh_part=0.55, roll_seed=3), "Target")
    former = target.animation_data.action.name
    kept = [tuple(p.co) for curve in curves(source.animation_data.action) for p in curve.keyframe_points]
    props = bpy.context.scene.tricap_retarget
    props.source, other = source, armature(person(), "Other")
    with pytest.raises(RuntimeError, match="Choose an armature as the target"):
        bpy.ops.tricap.retarget()
    bpy.data.objects.remove(other)
    assert props.target is None and bpy.ops.tricap.retarget_find_map() == {"FINISHED"} and len(props.rows) == 20
    assert props.target == target, "the only other armature"
    assert bpy.ops.tricap.retarget() == {"FINISHED"}
    assert target.animation_data.action.name != former and "limb directions" in props.last
    assert [tuple(p.co) for curve in curves(source.animation_data.action) for p in curve.keyframe_points] == kept
    it_begins_where_it_stands(bpy, target, props)
    the_step_is_undone(bpy, former)
    props = bpy.context.scene.tricap_retarget
    props.rows[0].bones = "nowhere"
    with pytest.raises(RuntimeError, match="no bone “nowhere”"):
        bpy.ops.tricap.retarget()
    with pytest.raises(RuntimeError, match="both source and target"):
        bpy.ops.tricap.retarget(source="Target")


def the_step_is_undone(bpy: ModuleType, former: str) -> None:
    """One undo takes the new action, its keys and what the panel says of them back."""

    def state() -> Any:
        target = bpy.data.objects["Target"]
        return target.animation_data.action.name, sorted(bpy.data.actions.keys()), bpy.context.scene.tricap_retarget.last

    bpy.data.objects["Target"].animation_data.action = bpy.data.actions[former]
    before = state()
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.tricap.retarget() == {"FINISHED"} and state() != before
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    assert state() == before
    assert "UNDO" in bpy.types.TRICAP_OT_retarget.bl_options


def test_the_preview_points_alike_and_goes_away(empty: ModuleType) -> None:
    source = build_armature(squat(person(), frames=10), "Source")
    target = armature(person(arms_down_deg=45.0, heading_deg=180.0, roll_seed=3), "Target")
    rigs = read_rig(source), read_rig(target)
    maps = find_map(rigs[0]), find_map(rigs[1])
    target.animation_data_clear()
    assert add_preview(source, mapped_rig(rigs[0], maps[0]), target, mapped_rig(rigs[1], maps[1])) > 15
    figures = measure(mapped(played(source, range(9)), maps[0]), mapped(played(target, range(9)), maps[1]), None)
    assert figures.direction_worst_deg < PLAYED_DEG, figures
    assert remove_preview(target) > 15 and not [c for bone in target.pose.bones for c in bone.constraints]
    assert len(empty.data.objects) == 2


def test_bad_rigs_are_said_and_the_scene_is_unchanged(empty: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bvh(tmp_path / "move.bvh", squat(person(), frames=6))
    made = {
        "none.blend": lambda: None,
        "two.blend": lambda: (armature(person(), "A"), armature(person(), "B")),
        "names.blend": lambda: build_armature(
            flail(
                person(names={role: f"b{i}" for i, role in enumerate(person().names)}, without=("thigh", "shin", "foot", "toe")), frames=3
            ),
            "C",
        ),
    }
    for name, make in made.items():
        empty.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        make()
        empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / name))
    (tmp_path / "broken.glb").write_bytes(b"glTF" + b"\xff" * 40)
    (tmp_path / "huge.glb").write_bytes(b"glTF\x02\0\0\0\xff\xff\xff\xbf\xff\xff\xff\xbfJSON{}")
    loop = b'{"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"children": [0]}]}  '
    (tmp_path / "loop.glb").write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(loop), len(loop), 0x4E4F534A) + loop)
    (tmp_path / "broken.fbx").write_bytes(b"Kaydara FBX Binary  \0\x1a\0" + b"\x01" * 90)
    (tmp_path / "broken.blend").write_bytes(b"BLENDER-v405" + b"\0" * 50)
    for name, word in (
        ("none.blend", "no armature"),
        ("two.blend", "2 armatures"),
        ("names.blend", "recognised"),
        ("broken.glb", "export it"),
        ("huge.glb", "export it"),
        ("loop.glb", "a node is in itself"),
        ("broken.fbx", "export it"),
        ("broken.blend", "export it"),
        ("nothing.glb", "no file"),
        ("move.txt", "no file"),
    ):
        capsys.readouterr()
        out = tmp_path / "out.blend"
        assert main(["retarget", str(tmp_path / "move.bvh"), "--rig", str(tmp_path / name), "--out", str(out), "--quiet"]) == 2, name
        said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tricap: ")]
        assert len(said) == 1 and word in said[0] and "Location:" not in said[0], (name, said)
        assert not out.exists()


def test_a_bvh_file_is_a_rig_too(empty: ModuleType, tmp_path: Path) -> None:
    write_bvh(tmp_path / "rig.bvh", flail(person(arms_down_deg=45.0), frames=5), unit_m=0.01)
    files.open_rig(tmp_path / "rig.bvh")
    target = files.the_armature("", "rig.bvh")
    assert abs(target.data.bones["thigh.L"].length - 0.43) < 1e-5
    assert target.animation_data is None or target.animation_data.action is None
    assert onto(target, squat(person())).figures.direction_rms_deg < 0.01


def test_uneven_scale_is_said(empty: ModuleType) -> None:
    target = armature(person(), "Target")
    target.scale = (1, 1, 2)
    empty.context.view_layer.update()
    with pytest.raises(InputError, match="unevenly"):
        apply.read_target(target)


def test_the_command_with_a_run_a_map_and_a_report(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    armature(person(arms_down_deg=45.0), "Target")
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"))
    (tmp_path / "map.json").write_text(json.dumps({"name": "mine", "bones": {"upper_arm.R": "upper_arm.R", "forearm.R": ["forearm.R"]}}))
    out = tmp_path / "out.blend"
    assert (
        main(
            [
                "retarget",
                str(small_run.out),
                "--rig",
                str(tmp_path / "rig.blend"),
                "--out",
                str(out),
                "--map",
                str(tmp_path / "map.json"),
                "--report",
                "--quiet",
                "--twist",
                "off",
                "--scale",
                "2",
            ]
        )
        == 0
    )
    table = json.loads((tmp_path / "out.json").read_text())
    assert table["scale"] == 2.0 and table["direction_worst_deg"] < 0.01
    assert table["mapped_by"] == "mapping “mine”" and (tmp_path / "out.png").stat().st_size > 1000
    empty.ops.wm.open_mainfile(filepath=str(out))
    scene = empty.context.scene
    assert (scene.frame_start, scene.frame_end) == (2, 7)
    source = read_motion_source(small_run.out)
    found = played(empty.data.objects["Target"], source.frames)
    assert measure(mapped(source), mapped(found), None).direction_worst_deg < PLAYED_DEG


def test_a_run_of_one_frame_moves_the_clavicle(empty: ModuleType, full_run: Path, tmp_path: Path) -> None:
    armature(person(arms_down_deg=45.0), "Target")
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"))
    out, stranger = tmp_path / "out.blend", tmp_path / "out.png"
    command = ["retarget", str(full_run), "--rig", str(tmp_path / "rig.blend"), "--out", str(out), "--report", "--quiet"]
    stranger.write_bytes(b"holiday")
    assert main(command) == 2 and stranger.read_bytes() == b"holiday" and not out.exists()
    stranger.unlink()
    assert main(command) == 0
    assert main(command) == 0  # its own report is replaced
    for name, content in (("out.png", b"repainted"), ("out.json", b'{"name": "my mapping"}')):
        (tmp_path / name).write_bytes(content)
        assert main(command) == 2 and (tmp_path / name).read_bytes() == content
    empty.ops.wm.open_mainfile(filepath=str(out))
    target = empty.data.objects["Target"]
    assert abs(np.degrees(angle_of(np.array(target.pose.bones["clavicle.R"].matrix_basis)[:3, :3])) - 30.0) < PLAYED_DEG


def test_our_own_armature_says_what_its_bones_are(empty: ModuleType) -> None:
    target = add_armature(empty.context.scene.collection, default_shape(read_model("full")))
    found = apply.read_target(target).rig_map
    assert found.bones["clavicle.R"] == ("shoulder.R",) and found.bones["hips"] == ("pelvis",) and not found.missing
    assert onto(target, squat(person(), frames=8)).figures.direction_rms_deg < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
def test_real_rigs_walk_and_jump(empty: ModuleType, rig: str, tmp_path: Path) -> None:
    if not (SHARED / "rigs" / rig).is_file():
        pytest.skip("the rigs are not on this machine (no folder shared/rigs beside the repository)")
    without_actions(SHARED / "rigs" / rig, tmp_path / rig)
    files.open_rig(tmp_path / rig)
    target = files.the_armature("", rig)
    for name in MOTIONS:
        source = thinned(recorded(name))
        outcome = onto(target, source)
        some = slice(None, None, 12)
        found = played(target, source.frames[some])
        assert np.degrees(angle_of(transposed(found.R) @ outcome.result.motion.R[some]))[:, outcome.result.driven].max() < PLAYED_DEG
        figures = {key: getattr(outcome.figures, key) for key in PROMISED}
        assert all(figures[key] <= bound for key, bound in PROMISED.items()), (rig, name, figures)
        assert not [note for note in outcome.notes if "drives the rig" in note]


def thinned(motion: Motion) -> Motion:
    """40 frames a second are enough."""
    R = motion.R[::3]
    return Motion(rig=motion.rig, fps=motion.fps / 3, frames=np.arange(len(R)) + 1, R=R, head_m=motion.head_m[::3])


def without_actions(file: Path, copy: Path) -> None:
    """A binary glTF file without its animations, of which one has 76 that take longer to read than all the rest."""
    data = file.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    table = json.loads(data[20 : 20 + size])
    table.pop("animations", None)
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    whole = len(text).to_bytes(4, "little") + data[16:20] + text + data[20 + size :]
    copy.write_bytes(data[:8] + (12 + len(whole)).to_bytes(4, "little") + whole)
