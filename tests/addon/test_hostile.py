"""Hostile scenes and names: each operator that writes a file replaces a link of the chosen name; each ends in a sentence."""

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from .conftest import SmallRun, make_small_run
from .test_wrong_moves import ADDON, refused

EXPORTED = ("bvh", "c3d", "trc", "csv", "mot", "fbx", "glb", "usd", "abc")


@pytest.fixture(scope="module")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> SmallRun:
    """One for all tests, which only read it."""
    return make_small_run(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def file(blender: ModuleType, small_run: SmallRun) -> Path:
    """A file with its scene."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    built = small_run.out.with_name("built.blend")
    blender.ops.wm.save_as_mainfile(filepath=str(built), copy=True)
    return built


@pytest.fixture
def built(blender: ModuleType, file: Path) -> ModuleType:
    """bpy with that scene, in a file that was never saved."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with blender.data.libraries.load(str(file)) as (there, here):
        here.scenes = there.scenes
    former, blender.context.window.scene = blender.context.scene, here.scenes[0]
    blender.data.scenes.remove(former)
    return blender


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_link_of_the_chosen_name_is_replaced_and_not_followed(built: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    ops = built.ops.tricap
    (tmp_path / "outside").mkdir()
    (tmp_path / "w").mkdir()

    def written(name: str, write: Callable[[str], set[str]]) -> None:
        outside, chosen = tmp_path / "outside" / name, tmp_path / "w" / name
        outside.write_text("mine")
        chosen.symlink_to(outside)
        assert write(str(chosen)) == {"FINISHED"}, name
        assert outside.read_text() == "mine" and not chosen.is_symlink() and chosen.stat().st_size > 4, name

    for kind in EXPORTED:
        written(f"a.{kind}", lambda file, kind=kind: ops.export(kind=kind, source="PLAYED", filepath=file))  # type: ignore[misc]
    written("measured.bvh", lambda file: ops.export(kind="bvh", source="MEASURED", filepath=file, out=str(small_run.out)))
    written("rig.toml", lambda file: ops.export_rig(filepath=file))
    built.context.scene.tricap_calibrate.target = "charuco"
    written("board.pdf", lambda file: ops.print_board(filepath=file))
    written("a.blend", lambda file: ops.build_scene(out=str(small_run.out), blend=file))


def test_no_name_and_a_name_beside_no_file(built: ModuleType, small_run: SmallRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that was never saved has no folder: what is relative to it is not written into the working folder instead."""
    monkeypatch.chdir(tmp_path)
    ops, props = built.ops.tricap, built.context.scene.tricap_retarget
    props.target = props.source = built.data.objects["Body"]
    props.rows.add().role, props.rows_of = "head", props.target
    before = sorted(tmp_path.iterdir())
    refused(ops.retarget_save_map, "Choose the file to write")
    refused(lambda: ops.export(kind="bvh"), "Choose the file to write")
    refused(ops.export_rig, "Choose the file to write")
    refused(lambda: ops.build_scene(out=str(small_run.out), blend="//a.blend"), "was never saved")
    refused(lambda: ops.retarget(file="//a.bvh"), "was never saved")
    assert sorted(tmp_path.iterdir()) == before


def test_cameras_before_the_footage(built: ModuleType, small_run: SmallRun) -> None:
    refused(built.ops.tricap.cameras_from_scene, "Add the footage first")
    refused(lambda: built.ops.tricap.cameras_from_file(filepath=str(small_run.take / "rig.toml")), "Add the footage first")


LEAVE = {"load_sample", "open_report"}  # they take long, or open another program
OTHER_KINDS = (7, "x\n\U0001f600", [1, 2, 3], {"a": {"b": 1}, "bone": "x"}, float("nan"))


def every_operator(bpy: ModuleType, file: Path) -> set[str]:
    """Press each button once: it ends, or refuses in one sentence. The names of those that ended."""
    ended = set[str]()
    for name in sorted(set(dir(bpy.ops.tricap)) - LEAVE):
        arguments = {"kind": "bvh", "filepath": str(file)} if name == "export" else {}
        try:
            if getattr(bpy.ops.tricap, name)(**arguments) == {"FINISHED"}:
                ended.add(name)
        except RuntimeError as error:
            said = str(error).strip()
            assert "Traceback" not in said and "Internal error" not in said and "\n" not in said, (name, said)
    importlib.import_module(f"{ADDON}.steps.watch").refresh(bpy.context.scene)  # what the panel draws
    return ended


def tamper(bpy: ModuleType, value: object) -> int:
    """Give each of our custom properties this value, and the body those that it lacks; how many."""
    body, count = bpy.data.objects["Body"], 0
    body["tricap_control_rig"] = body["tricap_measured_motion"] = bpy.context.scene["tricap_floor_m"] = 0
    blocks = ("objects", "armatures", "collections", "scenes", "actions", "cameras", "movieclips", "workspaces")
    for thing in (thing for kind in blocks for thing in getattr(bpy.data, kind)):
        for key in [key for key in thing.keys() if key.startswith("tricap_") and key not in thing.bl_rna.properties]:
            thing[key] = value
            count += 1
    return count


@pytest.mark.parametrize("value", OTHER_KINDS, ids=lambda value: type(value).__name__)
def test_custom_properties_of_other_kinds(built: ModuleType, tmp_path: Path, value: object) -> None:
    """A stranger's file may hold anything in them."""
    assert tamper(built, value) > 10
    built.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    built.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert "export" in every_operator(built, tmp_path / "a.bvh")


def without_slot(bpy: ModuleType) -> None:
    bpy.data.objects["Body"].animation_data.action_slot = None


def without_a_number(bpy: ModuleType) -> None:
    body = bpy.data.objects["Body"]
    for bag in (bag for layer in body.animation_data.action.layers for strip in layer.strips for bag in strip.channelbags):
        bag.fcurves[-1].keyframe_points[2].co[1] = float("nan")


def without_armature(bpy: ModuleType) -> None:
    bpy.data.objects.remove(bpy.data.objects["Body"])


def in_a_million_frames(bpy: ModuleType) -> None:
    """What reads the motion frame by frame would never end."""
    bpy.context.scene.frame_end = 1_000_000


def at_an_absurd_rate(bpy: ModuleType) -> None:
    bpy.context.scene.render.fps, bpy.context.scene.render.fps_base = 32767, 1e-5


def in_edit_mode(bpy: ModuleType) -> None:
    bpy.context.view_layer.objects.active = bpy.data.objects["Body"]
    bpy.ops.object.mode_set(mode="EDIT")


def linked(bpy: ModuleType) -> None:
    """The scene's collection from another file."""
    file = Path(bpy.app.tempdir) / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.context.scene.frame_end = 4
    with bpy.data.libraries.load(str(file), link=True) as (there, here):
        here.collections = ["Tricap"]
    bpy.context.scene.collection.children.link(here.collections[0])
    assert bpy.data.objects["Body"].library is not None and len(there.collections) > 1


def linked_scene(bpy: ModuleType) -> None:
    """The whole scene from another file, shown."""
    file = Path(bpy.app.tempdir) / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(file), link=True) as (there, here):
        here.scenes = there.scenes
    bpy.context.window.scene = here.scenes[0]


def overridden(bpy: ModuleType) -> None:
    linked(bpy)
    bpy.context.scene.collection.children[0].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)


SPOILT = (
    without_slot, without_a_number, without_armature, in_a_million_frames,
    at_an_absurd_rate, in_edit_mode, linked, linked_scene, overridden,
)  # fmt: skip


@pytest.mark.parametrize("spoil", SPOILT, ids=lambda spoil: spoil.__name__)
def test_scenes_that_somebody_changed(built: ModuleType, tmp_path: Path, spoil: Callable[[ModuleType], None]) -> None:
    spoil(built)
    every_operator(built, tmp_path / "a.bvh")


def test_a_linked_body_is_exported_with_its_skin(built: ModuleType, tmp_path: Path) -> None:
    linked(built)
    body = next(thing for thing in built.context.scene.objects if thing.type == "ARMATURE")
    assert built.ops.tricap.export(kind="fbx", filepath=str(tmp_path / "a.fbx"), armature=body.name) == {"FINISHED"}
    names = {thing.name for thing in built.data.objects}
    built.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    built.ops.import_scene.fbx(filepath=str(tmp_path / "a.fbx"))
    assert {thing.type for thing in built.data.objects} == {"ARMATURE", "MESH"} and "Skin" in names & {o.name for o in built.data.objects}


@pytest.mark.parametrize("off", ["excluded", "hidden collection", "disabled", "another scene"])
def test_an_armature_that_is_switched_off_is_not_exported_standing_still(built: ModuleType, tmp_path: Path, off: str) -> None:
    """Blender leaves it in its old pose, and the file would have no motion."""
    body, layer = built.data.objects["Body"], built.context.view_layer.layer_collection.children[0]
    for thing in [thing for thing in built.data.objects if thing != body]:  # what follows it would make Blender move it
        built.data.objects.remove(thing)
    if off == "excluded":
        layer.exclude = True
    if off == "hidden collection":
        layer.collection.hide_viewport = True
    body.hide_viewport = off == "disabled"
    if off == "another scene":
        built.context.window.scene = built.data.scenes.new("Other")
    props = built.context.scene.tricap_retarget
    refused(lambda: built.ops.tricap.export(kind="bvh", filepath=str(tmp_path / "a.bvh"), armature="Body"), "Body")
    target = built.data.objects.new("Target", body.data.copy())
    built.context.scene.collection.objects.link(target)
    props.source, props.target = body, target
    refused(built.ops.tricap.retarget, "does not play “Body”")
    assert not (tmp_path / "a.bvh").exists() and target.animation_data is None


def test_a_frame_beyond_all_frames(built: ModuleType) -> None:
    """Blender 5.2 crashed, where an object had a scale that is no number."""
    built.data.objects["Body"].scale = (float("nan"),) * 3
    assert built.ops.tricap.go_to_frame(frame=2**31 - 1) == {"FINISHED"}
    assert built.context.scene.frame_current == 1_048_574
