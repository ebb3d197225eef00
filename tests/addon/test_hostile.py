"""Hostile scenes and names: each operator that writes a file replaces a link of the chosen name; each ends in a sentence."""

import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from .conftest import SmallRun
from .test_wrong_moves import refused

EXPORTED = ("bvh", "c3d", "trc", "csv", "mot", "fbx", "glb", "usd", "abc")


@pytest.fixture
def built(blender: ModuleType, small_run: SmallRun) -> ModuleType:
    """bpy with the scene of a small run."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
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
