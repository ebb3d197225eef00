"""*Export* writes what plays: edited keys, layers, the character; files are read back by Blender's importers and by our readers."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.addon.retarget.build import build_armature
from tricap.addon.retarget.playing import exported_rig, played_frames
from tricap.addon.retarget.write import push_to_strip
from tricap.core.geometry.rotation import angle_of, transposed
from tricap.core.motion.formats.bvh import read_bvh
from tricap.core.motion.formats.c3d import read_c3d, read_segments
from tricap.core.motion.formats.markers import AXES, read_points_csv
from tricap.core.motion.formats.ply import read_ply
from tricap.core.motion.formats.trc import read_trc
from tricap.core.motion.sources import from_run

from ..core.motion.persons import person, squat
from ..core.motion.test_studio_files import played_by_opensim
from .conftest import FPS, SmallRun
from .test_export_programs import imported

PLACE_M, ANGLE_DEG = 1e-4, 0.1  # promised
Played = tuple[tuple[str, ...], np.ndarray, np.ndarray]


@pytest.fixture
def edited(blender: ModuleType, small_run: SmallRun) -> Any:
    """The arm of a run with every key of the forearm's flexion moved by 1 rad, and a layer that lifts the upper arm by 20°."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    body = blender.data.objects["Body"]
    curve = body.animation_data.action.fcurve_ensure_for_datablock(body, 'pose.bones["forearm.R"].rotation_euler', index=0)
    for point in curve.keyframe_points:
        point.co.y += 1.0
    curve.update()
    layer(blender, body)
    return body


def layer(bpy: ModuleType, body: Any) -> None:
    """Push the action down, and add a layer with a rotation of the upper arm over it."""
    data, path = body.animation_data, body.pose.bones["upper_arm.R"].path_from_id("rotation_euler")
    push_to_strip(body, data.action)
    data.action = correction = bpy.data.actions.new("Correction")
    correction.fcurve_ensure_for_datablock(body, path, index=2).keyframe_points.insert(2.0, np.radians(20.0))
    strip = push_to_strip(body, correction)
    strip.blend_type, strip.extrapolation = "COMBINE", "HOLD"


def played(bpy: ModuleType, armature: Any, names: tuple[str, ...] | None = None, times: np.ndarray | None = None) -> Played:
    """Names, world rotations (T, B, 3, 3) since the first frame and heads (T, B, 3) of an armature, at these times or in every frame."""
    names = names or exported_rig(armature).names
    R, head = [], []
    for time in times if times is not None else np.array(played_frames(bpy.context.scene), dtype=float):
        whole = int(time + 1e-4)
        bpy.context.scene.frame_set(whole, subframe=max(float(time - whole), 0.0))
        M = np.array([armature.matrix_world @ armature.pose.bones[name].matrix for name in names])
        R.append(M[:, :3, :3] / np.linalg.norm(M[:, :3, :3], axis=1, keepdims=True))
        head.append(M[:, :3, 3])
    R_all = np.array(R)
    return names, R_all @ transposed(R_all[:1]), np.array(head)


def played_file(bpy: ModuleType, file: Path, names: tuple[str, ...], count: int, fps: float = FPS) -> tuple[Played, Any]:
    """The same of the armature in a file."""
    imported(bpy, file, fps)
    armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
    scene, action = bpy.context.scene, armature.animation_data.action
    first, last = action.frame_range if action else (scene.frame_start, scene.frame_end)
    scene.frame_start, times = round(first), np.linspace(first, last, count)  # Blender's reader of FBX rounds the frame rate
    known = {name.replace(".", "_"): name for name in armature.pose.bones.keys()}
    return played(bpy, armature, tuple(known[name.replace(".", "_")] for name in names), times), armature


def check_same(found: Played, wanted: Played) -> None:
    assert np.abs(found[2] - wanted[2]).max() < PLACE_M
    assert np.degrees(angle_of(transposed(found[1]) @ wanted[1])).max() < ANGLE_DEG


@pytest.mark.parametrize("kind", ["fbx", "glb", "usd"])
def test_edited_keys_and_layers_are_exported(edited: Any, blender: ModuleType, small_run: SmallRun, tmp_path: Path, kind: str) -> None:
    wanted, file = played(blender, edited), tmp_path / f"a.{kind}"
    assert np.abs(wanted[2][:, 1:] - from_run(small_run.out).head_m).max() > 0.1  # it is another motion than the measured one
    assert blender.ops.tricap.export(kind=kind, filepath=str(file)) == {"FINISHED"}
    assert blender.data.objects["Body"] == edited and "upper_arm.R" in edited.pose.bones
    found, armature = played_file(blender, file, wanted[0], len(wanted[2]))
    check_same(found, wanted)
    skins = [
        o for o in blender.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" and m.object == armature for m in o.modifiers)
    ]
    assert len(skins) == 1 and len(skins[0].data.vertices) > 100


def test_edited_motion_as_bvh_and_points(edited: Any, blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    names, R, head = played(blender, edited)
    for kind in ("bvh", "csv", "trc", "c3d"):
        assert blender.ops.tricap.export(kind=kind, filepath=str(tmp_path / f"a.{kind}")) == {"FINISHED"}
    found = read_bvh(tmp_path / "a.bvh", unit_m=1.0, up="Y")
    assert found.rig.names == names and np.abs(found.head_m - head).max() < PLACE_M
    check_same((names, found.R @ transposed(found.R[:1]), found.head_m), (names, R, head))
    for markers in (read_points_csv(tmp_path / "a.csv"), read_trc(tmp_path / "a.trc"), read_c3d(tmp_path / "a.c3d")):
        assert markers.names == ("shoulder.R", "elbow.R", "wrist.R")
        assert np.abs(markers.xyz_m[:, :2] - head[:, 1:]).max() < PLACE_M
        assert np.isnan(markers.sigma_m).all(), "an edited motion has no sigmas"


def test_edited_motion_as_segments_and_for_opensim(edited: Any, blender: ModuleType, tmp_path: Path) -> None:
    wanted = played(blender, edited)
    for kind in ("c3d", "mot"):
        assert blender.ops.tricap.export(kind=kind, filepath=str(tmp_path / f"a.{kind}")) == {"FINISHED"}
    found = read_segments(tmp_path / "a.c3d")
    assert found is not None and found.names == wanted[0]
    check_same((found.names, found.R @ transposed(found.R[:1]), found.origin_m), wanted)
    names, R, origin_m = played_by_opensim(tmp_path / "a.osim", tmp_path / "a.mot")
    assert len(names) == len(wanted[0])
    back = AXES["OpenSim"].T
    R = back @ R @ back.T
    check_same((wanted[0], R @ transposed(R[:1]), origin_m @ back.T), wanted)


def test_the_skin_as_alembic_as_it_plays(edited: Any, blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    def shown() -> np.ndarray:
        graph = blender.context.evaluated_depsgraph_get()
        skin = max((o for o in blender.data.objects if o.type == "MESH" and o.visible_get()), key=lambda o: len(o.data.vertices))
        mesh = skin.evaluated_get(graph)
        return np.array([mesh.matrix_world @ v.co for v in mesh.data.vertices])

    frames = played_frames(blender.context.scene)
    assert blender.ops.tricap.export(kind="abc", filepath=str(tmp_path / "a.abc")) == {"FINISHED"}
    wanted = []
    for hidden in ("Measured", "Cameras", "Lights"):
        blender.context.view_layer.layer_collection.children["Tricap"].children[hidden].exclude = True
    for frame in frames:
        blender.context.scene.frame_set(frame)
        wanted.append(shown())
    imported(blender, tmp_path / "a.abc", FPS)
    for frame, places in zip(frames, wanted):
        blender.context.scene.frame_set(frame)
        np.testing.assert_allclose(shown(), places, atol=PLACE_M)


def test_the_measured_motion_is_a_choice(edited: Any, blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    blender.context.scene.tricap.out = str(small_run.out)
    assert blender.ops.tricap.export(kind="bvh", source="MEASURED", filepath=str(tmp_path / "a.bvh")) == {"FINISHED"}
    assert np.abs(read_bvh(tmp_path / "a.bvh", unit_m=1.0, up="Y").head_m - from_run(small_run.out).head_m).max() < PLACE_M


def test_the_skin_of_every_frame_as_it_plays(edited: Any, blender: ModuleType, tmp_path: Path) -> None:
    assert blender.ops.tricap.export(kind="ply", filepath=str(tmp_path / "skins")) == {"FINISHED"}
    files = sorted((tmp_path / "skins").glob("*.ply"))
    assert [int(file.stem) for file in files] == list(played_frames(blender.context.scene))
    blender.context.scene.frame_set(int(files[-1].stem))
    skin = blender.data.objects["Skin"].evaluated_get(blender.context.evaluated_depsgraph_get())
    wanted = np.array([skin.matrix_world @ v.co for v in skin.data.vertices])
    np.testing.assert_allclose(read_ply(files[-1]).xyz_m, wanted, atol=1e-6)


@pytest.mark.parametrize("kind", ["fbx", "glb", "bvh"])
def test_a_character_goes_out_as_it_stands(blender: ModuleType, tmp_path: Path, kind: str) -> None:
    """A scaled armature object that moves, a control bone, a mesh on a bone: the file has the bones that deform, and both meshes."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    hero = build_armature(squat(person(size=100.0), frames=8), "Hero")
    hero.scale = (0.01, 0.01, 0.01)
    hero.location.x = 1.0
    hero.keyframe_insert("location", frame=0)
    hero.location.x = 2.0
    hero.keyframe_insert("location", frame=7)
    for name in ("toe.L", "spine"):  # a control at the end, and one in the middle
        hero.data.bones[name].use_deform = False
    hat = blender.data.objects.new("Hat", blender.data.meshes.new("Hat"))
    hat.data.from_pydata([(0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 10)], [], [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
    blender.context.scene.collection.objects.link(hat)
    hat.parent, hat.parent_type, hat.parent_bone = hero, "BONE", "head"
    blender.context.scene.frame_set(5)
    hat_m = np.array([hat.matrix_world @ v.co for v in hat.data.vertices])
    wanted = played(blender, hero)
    assert "toe.L" not in wanted[0] and "spine" not in wanted[0] and "neck" in wanted[0]
    blender.context.scene.tricap_retarget.export = hero
    assert blender.ops.tricap.export(kind=kind, filepath=str(tmp_path / f"a.{kind}")) == {"FINISHED"}
    if kind == "bvh":
        found = read_bvh(tmp_path / "a.bvh", unit_m=1.0, up="Y")
        rows = [found.rig.index[name] for name in wanted[0]]
        check_same((wanted[0], (found.R @ transposed(found.R[:1]))[:, rows], found.head_m[:, rows]), wanted)
        return
    same, _ = played_file(blender, tmp_path / f"a.{kind}", wanted[0], 8, 30.0)
    check_same(same, wanted)
    blender.context.scene.frame_set(blender.context.scene.frame_start + 5)
    copy = blender.data.objects["Hat"].evaluated_get(blender.context.evaluated_depsgraph_get())
    corners = np.array([copy.matrix_world @ v.co for v in copy.data.vertices])
    assert np.abs(corners[:, None] - hat_m).max(axis=2).min(axis=0).max() < PLACE_M


def test_what_cannot_be_exported_is_refused(blender: ModuleType, tmp_path: Path) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    export = blender.ops.tricap.export
    with pytest.raises(RuntimeError, match="no armature to export. Build the rig"):
        export(kind="bvh", filepath=str(tmp_path / "a.bvh"))
    first = build_armature(squat(person(), frames=2), "First")
    with pytest.raises(RuntimeError, match="deforms no mesh"):
        export(kind="ply", filepath=str(tmp_path / "skins"))
    blender.context.scene.frame_end = blender.context.scene.frame_start - 1
    build_armature(squat(person(), frames=2), "Second")
    with pytest.raises(RuntimeError, match="2 armatures. Choose the one"):
        export(kind="bvh", filepath=str(tmp_path / "a.bvh"))
    blender.context.scene.collection.objects.unlink(first)
    with pytest.raises(RuntimeError, match="“First” is not in this scene"):
        export(kind="bvh", armature="First", filepath=str(tmp_path / "a.bvh"))
    assert not list(tmp_path.iterdir())
