"""Presets for other programs: names, units and axes in the files themselves, and skins, by readers that are not ours."""

import errno
import json
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.__main__ import main
from tricap.addon.retarget.build import build_armature
from tricap.addon.retarget.export import export_file, exporting_played, named_for, points_of
from tricap.addon.retarget.playing import reading_played
from tricap.addon.retarget.read import ended
from tricap.addon.scene.frame_rate import rate_of_gltf
from tricap.addon.scene.standing import Path as Carrier
from tricap.addon.scene.standing import carry_path, dofs_of
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import about, angle_of, transposed, twist_about
from tricap.core.motion.formats.bvh import read_bvh, write_bvh
from tricap.core.motion.formats.c3d import read_c3d, read_segments
from tricap.core.motion.formats.markers import AXES, read_points_csv
from tricap.core.motion.formats.trc import read_trc
from tricap.core.motion.sources import from_run, read_motion_source

from ..core.motion.persons import person, squat
from ..core.motion.test_studio_files import played_by_opensim
from . import test_scene_standing as standing
from .conftest import SmallRun

PLACE_M = 1e-4  # promised: 0.1 mm
FBX = {"plain": (1, 100.0), "mixamo": (1, 1.0), "motionbuilder": (1, 1.0), "unreal": (2, 1.0), "unity": (1, 100.0), "opensim": (1, 100.0)}


def imported(bpy: ModuleType, file: Path, fps: float) -> None:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = 30, 30 / fps
    with rate_of_gltf(scene) if file.suffix == ".glb" else nullcontext():  # Blender's importer has it wrong
        {
            ".fbx": lambda f: bpy.ops.import_scene.fbx(filepath=f),
            ".glb": lambda f: bpy.ops.import_scene.gltf(filepath=f),
            ".usd": lambda f: bpy.ops.wm.usd_import(filepath=f),
            ".usda": lambda f: bpy.ops.wm.usd_import(filepath=f),
            ".abc": lambda f: bpy.ops.wm.alembic_import(filepath=f, as_background_job=False),
        }[file.suffix](str(file))


def skinned(bpy: ModuleType) -> tuple[Any, Any]:
    """The armature and the mesh that hangs on it."""
    skin = next(o for o in bpy.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers))
    return next(m.object for m in skin.modifiers if m.type == "ARMATURE"), skin


def heads(bpy: ModuleType, armature: Any, count: int) -> np.ndarray:
    """Heads (T, B, 3) in the order of `from_run`'s bones of an arm, at the keys: Blender's reader of FBX rounds the frame rate."""
    first, last = armature.animation_data.action.frame_range
    found = []
    for frame in np.linspace(first, last, count):
        bpy.context.scene.frame_set(int(frame + 1e-4), subframe=max(float(frame - int(frame + 1e-4)), 0.0))
        found.append([armature.matrix_world @ bone.head for bone in sorted(armature.pose.bones, key=lambda b: len(b.parent_recursive))])
    return np.array(found)


def fbx_header(file: Path) -> tuple[int, float]:
    """Up axis and centimetres per unit, as the file says."""
    from io_scene_fbx import parse_fbx

    root, _ = parse_fbx.parse(str(file))
    said = next(e for e in root.elems if e.id == b"GlobalSettings")
    rows = {p.props[0]: p.props[-1] for part in said.elems for p in part.elems}
    return rows[b"UpAxis"], rows[b"UnitScaleFactor"]


@pytest.mark.parametrize("preset", FBX)
def test_fbx_by_preset(empty: ModuleType, small_run: SmallRun, tmp_path: Path, preset: str) -> None:
    file, source = tmp_path / "a.fbx", from_run(small_run.out)
    export_file(small_run.out, "fbx", file, preset, Monitor())
    assert fbx_header(file) == pytest.approx(FBX[preset])
    imported(empty, file, source.fps)
    armature, skin = skinned(empty)
    assert np.abs(heads(empty, armature, 6) - source.head_m).max() < PLACE_M
    assert {g.name for g in skin.vertex_groups} == set(armature.data.bones.keys())
    height = float(np.ptp(np.array([skin.matrix_world @ v.co for v in skin.data.vertices])[:, 2]))
    assert 0.1 < height < 1.5, "the skin is as large as the arm"


@pytest.mark.parametrize(
    ("preset", "hand"), [("plain", "forearm.R"), ("mixamo", "mixamorig:RightForeArm"), ("unreal", "lowerarm_r"), ("maya", "RightForeArm")]
)
def test_glb_keeps_its_skin_under_other_names(empty: ModuleType, small_run: SmallRun, tmp_path: Path, preset: str, hand: str) -> None:
    source = from_run(small_run.out)
    export_file(small_run.out, "glb", tmp_path / "a.glb", preset, Monitor())
    imported(empty, tmp_path / "a.glb", source.fps)
    armature, skin = skinned(empty)
    assert hand in armature.data.bones and hand in skin.vertex_groups and len(empty.data.actions) == 1
    assert np.abs(heads(empty, armature, 6) - source.head_m).max() < PLACE_M


@pytest.mark.parametrize(("preset", "up", "unit"), [("plain", "Z", 1.0), ("maya", "Y", 0.01), ("unity", "Y", 1.0), ("unreal", "Z", 0.01)])
def test_usd_by_preset(empty: ModuleType, small_run: SmallRun, tmp_path: Path, preset: str, up: str, unit: float) -> None:
    file, source = tmp_path / "a.usda", from_run(small_run.out)
    export_file(small_run.out, "usd", file, preset, Monitor())
    said = file.read_text()
    assert f'upAxis = "{up}"' in said and float(re.search(r"metersPerUnit = ([\d.]+)", said)[1]) == unit  # type: ignore[index]
    imported(empty, file, source.fps)
    armature, _ = skinned(empty)
    assert np.abs(heads(empty, armature, 6) - source.head_m).max() < PLACE_M


@pytest.mark.parametrize(("preset", "unit"), [("plain", 1.0), pytest.param("mixamo", 0.01, marks=pytest.mark.slow), ("maya", 0.01)])
def test_alembic_comes_back(empty: ModuleType, small_run: SmallRun, tmp_path: Path, preset: str, unit: float) -> None:
    file, source = tmp_path / "a.abc", from_run(small_run.out)
    export_file(small_run.out, "glb", tmp_path / "a.glb", "plain", Monitor())
    imported(empty, tmp_path / "a.glb", source.fps)
    for modifier in (m for o in empty.data.objects for m in o.modifiers if m.type == "ARMATURE"):
        modifier.use_deform_preserve_volume = True  # glTF cannot say so, Alembic has the places themselves
    wanted = [extent(empty, int(source.frames[0]) + k) for k in range(6)]
    export_file(small_run.out, "abc", file, preset, Monitor())
    imported(empty, file, source.fps)
    found = [extent(empty, int(source.frames[0]) + k) for k in range(6)]
    assert np.ptp([e[0] for e in wanted], axis=0).max() > 0.05
    np.testing.assert_allclose(unit * np.array(found), wanted, atol=PLACE_M)


def extent(bpy: ModuleType, frame: int) -> np.ndarray:
    """Bounds (2, 3) in the world of the one mesh as it is deformed."""
    bpy.context.scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    meshes = [o for o in bpy.data.objects if o.type == "MESH" and len(o.data.vertices) > 100]
    skin = meshes[0].evaluated_get(graph)
    places = np.array([skin.matrix_world @ v.co for v in skin.data.vertices])
    return np.array([places.min(axis=0), places.max(axis=0)])


@pytest.mark.parametrize(
    ("preset", "unit", "axes", "elbow"),
    [
        ("unreal", "cm", "Z up", "lowerarm_r"),
        ("maya", "cm", "Y up", "RightForeArm"),
        ("unity", "m", "Y up", "RightLowerArm"),
        ("opensim", "", "OpenSim", "elbow.R"),
    ],
)
def test_points_by_preset(small_run: SmallRun, tmp_path: Path, preset: str, unit: str, axes: str, elbow: str) -> None:
    wanted = points_of(small_run.out)
    for kind, own, read in (("trc", "m", read_trc), ("c3d", "mm", read_c3d), ("csv", "m", read_points_csv)):
        file = tmp_path / f"a.{kind}"
        export_file(small_run.out, kind, file, preset, Monitor())
        found = read(file, axes=axes, unit=unit or own)  # type: ignore[operator]
        assert found.names[1] == elbow and len(set(found.names)) == len(wanted.names), found.names
        np.testing.assert_allclose(found.xyz_m, wanted.xyz_m, atol=2e-6)
    text = (tmp_path / "a.trc").read_text().splitlines()[2].split("\t")
    assert text[4] == (unit or "m")
    first = np.array([float(x) for x in (tmp_path / "a.csv").read_text().splitlines()[1].split(",")[3:6]])
    np.testing.assert_allclose(first, AXES[axes] @ wanted.xyz_m[0, 0] * {"cm": 100.0}.get(unit, 1.0), atol=2e-4)


def test_bvh_as_motionbuilder_turns(small_run: SmallRun, tmp_path: Path) -> None:
    export_file(small_run.out, "bvh", tmp_path / "a.bvh", "motionbuilder", Monitor())
    said = (tmp_path / "a.bvh").read_text()
    assert "ROOT RightArm" in said and "Xposition Yposition Zposition Zrotation Yrotation Xrotation" in said
    source, found = from_run(small_run.out), read_bvh(tmp_path / "a.bvh", unit_m=0.01)
    np.testing.assert_allclose(found.head_m, source.head_m, atol=1e-6)


@pytest.mark.parametrize("kind", ["bvh", "csv", "glb", "fbx"])
def test_a_blend_file_goes_out(empty: ModuleType, tmp_path: Path, kind: str) -> None:
    source = squat(person(), frames=8)
    build_armature(source, "Mover")
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    file = tmp_path / f"out.{kind}"
    assert main(["export", str(tmp_path / "a.blend"), "--format", kind, "--out", str(file), "--preset", "mixamo", "--quiet"]) == 0
    if kind in ("glb", "fbx"):
        imported(empty, file, source.fps)
        armature = next(o for o in empty.data.objects if o.type == "ARMATURE")
        knee = armature.pose.bones["mixamorig:LeftLeg"]
        empty.context.scene.frame_set(round(armature.animation_data.action.frame_range[0]) + 4)
        np.testing.assert_allclose(armature.matrix_world @ knee.head, source.head_m[4, source.rig.index["shin.L"]], atol=PLACE_M)
    elif kind == "bvh":
        np.testing.assert_allclose(read_motion_source(file).head_m[:, 0], source.head_m[:, 0], atol=1e-5)


def test_points_go_from_file_to_file_whole(small_run: SmallRun, tmp_path: Path) -> None:
    """Not as a skeleton that they suggest, which has fewer joints."""
    first, again, table = (tmp_path / name for name in ("a.trc", "b.c3d", "c.csv"))
    export_file(small_run.out, "trc", first, "plain", Monitor())
    export_file(first, "c3d", again, "plain", Monitor())
    export_file(again, "csv", table, "plain", Monitor())
    wanted, found = points_of(small_run.out), points_of(table)
    assert found.names == wanted.names and np.allclose(found.xyz_m, wanted.xyz_m, atol=2e-6)


def test_a_file_that_was_not_named_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine.bvh").write_text("a motion of somebody")
    with pytest.raises(InputError, match=r"mine\.bvh exists already"):
        named_for("bvh", tmp_path / "mine", None)
    assert named_for("bvh", tmp_path / "mine.bvh", None) == tmp_path / "mine.bvh"


def test_a_file_is_named_as_its_format(blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not UTF-8; rename it"):
        named_for("glb", tmp_path / "a\udcff.glb", None)
    named = {("bvh", "a"): "a.bvh", ("usd", "a.usda"): "a.usda", ("glb", "a.GLB"): "a.GLB", ("csv", "a.txt"): "a.txt", ("ply", "a"): "a"}
    assert {key: named_for(key[0], Path(key[1]), tmp_path).name for key in named} == named
    with pytest.raises(InputError, match="q.xyz does not end in .usd or .usda or .usdc or .usdz; write the name with that ending"):
        named_for("usd", Path("q.xyz"), tmp_path)
    with pytest.raises(InputError, match="a.gltf does not end in .glb"):  # of which Blender makes a.gltf.glb
        named_for("glb", Path("a.gltf"), tmp_path)
    with pytest.raises(InputError, match="a.fbx has the ending of another format; let it end in .trc"):
        named_for("trc", Path("a.fbx"), tmp_path)
    for slip in ("0000.png", "take.toml", "film.MP4", "body.blend"):
        with pytest.raises(InputError, match="has the ending of another format; let it end in .csv"):
            named_for("csv", Path(slip), tmp_path)
    (tmp_path / "take.toml").write_text("")
    for kind, name in (("ply", "take.toml"), ("bvh", "take.toml/a.bvh")):
        with pytest.raises(InputError, match="belongs to the take"):
            named_for(kind, tmp_path / name, None)
    file, out = tmp_path / "moved", str(small_run.out)
    assert blender.ops.tricap.export(kind="bvh", out=out, filepath=str(file)) == {"FINISHED"} and file.with_suffix(".bvh").is_file()
    with pytest.raises(RuntimeError, match="another format"):
        blender.ops.tricap.export(kind="trc", out=out, filepath=str(tmp_path / "b.fbx"))
    assert main(["export", out, "--format", "trc", "--out", str(tmp_path / "b.fbx")]) == 2 and not (tmp_path / "b.fbx").exists()


def test_no_export_takes_the_place_of_what_it_reads(blender: ModuleType, small_run: SmallRun, tmp_path: Path, capfd: Any) -> None:
    out = small_run.out
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    write_bvh(tmp_path / "walk.bvh", squat(person(), frames=2))
    walk = (tmp_path / "walk.bvh").read_bytes()
    for what, kind, file in ((out, "csv", out / "joints.csv"), (out, "ply", out / "clouds"), (out, "ply", out / "skin" / ".." / "skin"),
                             (out, "csv", out / "cache" / "a.csv"), (tmp_path / "walk.bvh", "bvh", tmp_path / "walk")):  # fmt: skip
        assert main(["export", str(what), "--format", kind, "--out", str(file), "--quiet"]) == 2
        assert "is also an input; choose another name" in capfd.readouterr().err
    with pytest.raises(RuntimeError, match="is also an input"):
        blender.ops.tricap.export(kind="csv", out=str(out), filepath=str(out / "motion.csv"))
    argv = ["retarget", str(tmp_path / "walk.bvh"), "--rig", str(tmp_path / "rig.blend"), "--out", str(tmp_path / "rig.blend"), "--quiet"]
    (tmp_path / "rig.blend").write_text("a rig")
    assert main(argv) == 2 and (tmp_path / "rig.blend").read_text() == "a rig" and (tmp_path / "walk.bvh").read_bytes() == walk
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == before
    assert main(["export", str(out), "--format", "csv", "--out", str(out / "for Maya.csv"), "--quiet"]) == 0
    (out / "for Maya.csv").unlink()


def test_a_folder_that_cannot_be_written_is_told_before_blender_tries(
    empty: ModuleType, small_run: SmallRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    """Its exporters print a traceback there."""

    opened = os.open

    def refused(path: Any, *args: Any, **more: Any) -> int:
        if str(path).startswith(str(tmp_path / ".a.")):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return opened(path, *args, **more)

    monkeypatch.setattr(os, "open", refused)
    for argv in (["export", "--format", "fbx", "--out", "a.fbx"], ["scene", "--blend", "a.blend"]):
        argv[-1] = str(tmp_path / argv[-1])
        assert main([argv[0], str(small_run.out), *argv[1:], "--quiet"]) == 2
        assert capfd.readouterr().err.startswith(f"tricap: Cannot write {argv[-1]}: Read-only file system. Choose another")


def test_the_panel_exports_and_leaves_the_scene(blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    mine = build_armature(squat(person(), frames=4), "a")
    kinds = ("scenes", "objects", "armatures", "meshes", "actions", "materials", "collections")
    before = {kind: list(getattr(blender.data, kind).keys()) for kind in kinds}
    for kind in ("glb", "fbx", "usd", "abc"):
        file = tmp_path / f"a.{kind}"
        assert blender.ops.tricap.export(kind=kind, preset="unreal", out=str(small_run.out), filepath=str(file)) == {"FINISHED"}
        assert file.stat().st_size > 1000
    assert {kind: list(getattr(blender.data, kind).keys()) for kind in kinds} == before
    assert blender.context.scene.name == before["scenes"][0] and mine.name in blender.context.scene.objects
    assert blender.context.scene.tricap_retarget.last_export.startswith("Exported ")


@pytest.mark.slow
def test_nothing_of_blenders_own_is_written_among_the_answers(small_run: SmallRun, tmp_path: Path) -> None:
    """Its exporters print, and it tells of every file that it saves: programs read our standard output."""
    write_bvh(tmp_path / "rig.bvh", squat(person(), frames=2))
    walk, fbx = str(tmp_path / "rig.bvh"), str(tmp_path / "a.fbx")
    lines = {"retarget": [walk, "--rig", walk, "--out", str(tmp_path / "a.blend"), "--json"],
             "export": [str(small_run.out), "--format", "fbx", "--out", fbx]}  # fmt: skip
    said = {}
    for command, more in lines.items():
        done = subprocess.run([sys.executable, "-m", "tricap", command, *more], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        said[command] = done.stdout
    assert json.loads(said["retarget"])["frames"] == 2 and said["export"] == f"{fbx}: 2 bones in 6 frames\n"
    quiet = subprocess.run([sys.executable, "-m", "tricap", "export", *lines["export"], "--quiet"], capture_output=True, text=True)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


@pytest.fixture
def walker(empty: ModuleType) -> Any:
    """A person that plays a squat while it walks a metre and turns by 90°."""
    motion = squat(person(arms_down_deg=40.0))
    turned = about(np.array([0.0, 0.0, 1.0]), np.linspace(0, np.pi / 2, len(motion.frames)))
    path_m = np.linspace(0, 1, len(motion.frames))[:, None] * (0.0, -1.0, 0.0)
    head_m = np.einsum("tij,tbj->tbi", turned, motion.head_m) + path_m[:, None]
    return build_armature(replace(motion, R=turned[:, None] @ motion.R, head_m=head_m), "Walker")


@pytest.mark.parametrize(("preset", "root", "hips"), [("unreal", "root", "pelvis"), ("unity", "Root", "Hips")])
def test_engines_get_a_root_bone_that_carries_the_path(
    empty: ModuleType, walker: Any, tmp_path: Path, preset: str, root: str, hips: str
) -> None:
    wanted = ended(reading_played(walker))
    ended(exporting_played(walker, "fbx", tmp_path / "a.fbx", preset, Monitor()))
    imported(empty, tmp_path / "a.fbx", wanted.fps)
    armature = next(o for o in empty.data.objects if o.type == "ARMATURE")
    assert [b.name for b in armature.data.bones if b.parent is None] == [root] and armature.data.bones[hips].parent.name == root
    found = {name: [] for name in (root, hips)}
    first, last = armature.animation_data.action.frame_range
    for frame in np.linspace(first, last, len(wanted.frames)):
        empty.context.scene.frame_set(int(frame + 1e-4), subframe=max(float(frame - int(frame + 1e-4)), 0.0))
        for name, places in found.items():
            places.append(armature.matrix_world @ armature.pose.bones[name].head)
    hips_m = wanted.head_m[:, wanted.rig.index["hips"]]
    assert np.abs(np.array(found[hips]) - hips_m).max() < PLACE_M
    assert np.abs(np.array(found[root])[:, :2] - hips_m[:, :2]).max() < PLACE_M


@pytest.mark.parametrize("path", ["BONE", "OBJECT"])
@pytest.mark.parametrize(("kind", "preset", "root", "hips"), [("fbx", "unreal", "root", "pelvis"), ("glb", "unity", "Root", "Hips")])
def test_the_root_of_our_own_body_carries_path_and_heading(
    empty: ModuleType, tmp_path: Path, kind: str, preset: str, root: str, hips: str, path: str
) -> None:
    """The body turns by 200°, more than a rotation of half a turn can tell; hips move in the world as before."""
    body = standing.walker(empty)
    height = next(dof for dof in dofs_of(body).values() if dof["path"] == "location" and dof["bone"] == "pelvis")
    turn = body.animation_data.action.fcurve_ensure_for_datablock(body, 'pose.bones["pelvis"].rotation_euler', index=height["index"])
    for k, point in enumerate(turn.keyframe_points):
        point.co.y = np.radians(200.0) * k / (standing.FRAMES - 1)
    turn.update()
    carry_path(empty.context.scene, Carrier(path))
    wanted = ended(reading_played(body))
    file = tmp_path / f"a.{kind}"
    ended(exporting_played(body, kind, file, preset, Monitor()))
    imported(empty, file, wanted.fps)
    armature = next(o for o in empty.data.objects if o.type == "ARMATURE")
    first, last = armature.animation_data.action.frame_range
    found = []
    for frame in np.linspace(first, last, len(wanted.frames)):
        empty.context.scene.frame_set(int(frame + 1e-4), subframe=max(float(frame - int(frame + 1e-4)), 0.0))
        found.append([armature.matrix_world @ armature.pose.bones[name].matrix for name in (root, hips)])
    place_m, R = np.array(found)[..., :3, 3], np.array(found)[..., :3, :3]
    R /= np.linalg.norm(R, axis=-2, keepdims=True)
    since_first, hips_R = R @ transposed(R[:1]), wanted.R[:, wanted.rig.index["pelvis"]]
    hips_m = wanted.head_m[:, wanted.rig.index["pelvis"]]
    assert np.abs(place_m[:, 1] - hips_m).max() < PLACE_M and np.abs(place_m[:, 0, :2] - hips_m[:, :2]).max() < PLACE_M
    assert np.ptp(place_m[:, 0, 2]) < PLACE_M and np.degrees(angle_of(transposed(since_first[:, 1]) @ hips_R @ hips_R[0].T)).max() < 0.01
    up = np.array([0.0, 0.0, 1.0])
    assert np.degrees(angle_of(since_first[:, 0]) - np.abs(twist_about(since_first[:, 0], up))).max() < 0.01, "a yaw only"
    heading_deg = np.degrees(np.unwrap(twist_about(since_first[:, 0], up)))
    assert abs(heading_deg[-1]) == pytest.approx(200.0, abs=0.05) and np.abs(np.diff(heading_deg)).max() < 25.0


def test_opensim_and_segments_of_what_plays(empty: ModuleType, walker: Any, tmp_path: Path) -> None:
    wanted = ended(reading_played(walker))
    done = ended(exporting_played(walker, "mot", tmp_path / "a.mot", "opensim", Monitor()))
    assert "their model a.osim" in done
    _, R, origin_m = played_by_opensim(tmp_path / "a.osim", tmp_path / "a.mot")
    A = AXES["OpenSim"]
    assert np.abs(origin_m - wanted.head_m @ A.T).max() < PLACE_M
    assert np.degrees(angle_of(transposed(R) @ A @ wanted.R @ transposed(wanted.rig.R_rest) @ A.T)).max() < 0.1
    assert "20 segments" in ended(exporting_played(walker, "c3d", tmp_path / "a.c3d", "plain", Monitor()))
    found = read_segments(tmp_path / "a.c3d")
    assert found is not None and np.abs(found.origin_m - wanted.head_m).max() < PLACE_M
    assert np.degrees(angle_of(transposed(found.R) @ wanted.R)).max() < 0.1


def test_segments_of_a_run(small_run: SmallRun, tmp_path: Path) -> None:
    source = from_run(small_run.out)
    assert "segments" in export_file(small_run.out, "c3d", tmp_path / "a.c3d", "plain", Monitor())
    found = read_segments(tmp_path / "a.c3d")
    assert found is not None and found.names == source.rig.names
    assert np.abs(found.origin_m[np.isin(found.frames, source.frames)] - source.head_m).max() < PLACE_M
