"""Every operator with paths that nothing can be made of ends in a sentence; fifty steps back and forth change nothing."""

import os
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from .conftest import SmallRun

NO_PATHS = {"filename", "filter_glob", "armature", "target", "name", "view", "only", "limbs", "polygon"}


def path_arguments(bpy: ModuleType) -> Iterator[tuple[str, str]]:
    """Operators, and each of their arguments that is a path."""
    for name in dir(bpy.ops.tricap):
        for argument in getattr(bpy.ops.tricap, name).get_rna_type().properties:
            if argument.type == "STRING" and argument.identifier not in NO_PATHS:
                yield name, argument.identifier


def odd_paths(folder: Path) -> tuple[Path, ...]:
    """Paths that nothing can be made of: too long names, no file, a link to itself."""
    odd = (folder / ("a" * 500), folder / "/".join(["b" * 200] * 30))
    if os.name != "posix":
        return odd
    os.mkfifo(folder / "pipe")
    (folder / "circle").symlink_to("circle")
    return *odd, folder / "pipe", folder / "pipe" / "x", folder / "circle" / "x"


def test_operators_with_paths_that_are_none(blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    refused = set[str]()
    for path in odd_paths(tmp_path):
        blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
        for name, argument in path_arguments(blender):
            try:
                getattr(blender.ops.tricap, name)(**{argument: str(path)})
            except (RuntimeError, TypeError) as error:
                said = str(error).strip()
                assert not [word for word in ("Internal error", "Traceback") if word in said] and said.count("\n") == 0, (name, said)
                refused.add(name)
    assert len(refused) > 15


@pytest.mark.parametrize("ending", [".blend", ".glb", ".vrm", ".fbx", ".bvh"])
def test_a_rig_that_cannot_be_opened_is_told_in_plain_words(
    blender: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    from tricap.addon.retarget import files
    from tricap.core.foundation.errors import InputError

    (tmp_path / f"large{ending}").write_bytes(b"x" * 2000)
    monkeypatch.setattr(files.bounded, "ARRAYS_BYTES", 1000)
    cases = {"large": "Cannot read .*large.*: it is larger than 0 MB, .*; choose another file", "none": "There is no file .*none"}
    if os.name == "posix":
        os.mkfifo(tmp_path / f"pipe{ending}")
        cases["pipe"] = "Cannot read .*pipe.*: it is a device, a pipe or a socket, not a file; choose another file"
    for name, said in cases.items():
        with pytest.raises(InputError, match=said) as refused:
            files.open_rig(tmp_path / f"{name}{ending}")
        assert "Errno" not in str(refused.value)


@pytest.mark.slow
def test_fifty_steps_back_and_forth(blender: ModuleType, small_run: SmallRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """The results, the frame and the panel's settings go with the steps, and everything works afterwards."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    monkeypatch.setattr(blender.context.preferences.edit, "undo_steps", 120)
    blender.ops.ed.undo_push(message="empty")
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    blender.ops.ed.undo_push(message="built")
    for i in range(50):
        blender.context.scene.tricap.fps = 4 + i
        if i % 10 == 5:
            blender.ops.tricap.build_scene(out=str(small_run.out))
        blender.ops.ed.undo_push(message=f"step {i}")
    for i in reversed(range(50)):
        assert blender.context.scene.tricap.fps == 4 + i
        blender.ops.ed.undo()
    built = sorted(o.name for o in blender.context.scene.objects)
    assert built
    blender.ops.ed.undo()
    assert not blender.context.scene.objects
    for _ in range(51):
        blender.ops.ed.redo()
    assert blender.context.scene.tricap.fps == 53
    assert sorted(o.name for o in blender.context.scene.objects) == built
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    assert sorted(o.name for o in blender.context.scene.objects) == built
