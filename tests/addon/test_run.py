"""The operator that runs a take: the same numbers as the command line's, with the panel's settings, and a scene at the end."""

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tricap.core.results.folder import Results
from tricap.core.run import pipeline
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

from .conftest import with_small_texture

NUMBERS = ("motion.csv", "joints.csv", "body.toml", "trajectories.npz", "clouds/0000.ply", "clouds/0001.ply", "skin/0001.ply")


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sample recording."""
    folder = tmp_path_factory.mktemp("recordings") / "sample"
    make_arm_take(folder, ArmTakeSettings(frames=2, width_px=256))
    return with_small_texture(folder)


@pytest.mark.slow
def test_the_operator_gives_the_commands_numbers_and_a_scene(blender: ModuleType, take: Path, tmp_path: Path) -> None:
    overrides = {"growing": {"spacing_px": 6}}
    pipeline.run(take, tmp_path / "command", overrides)
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = blender.context.scene
    scene.tricap.take, scene.tricap.out = str(take), str(tmp_path / "operator")
    scene.tricap.growing.spacing_px = 6
    assert blender.ops.tricap.run() == {"FINISHED"}
    for name in NUMBERS:
        assert (tmp_path / "operator" / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    assert "body fitted" in scene.tricap.last
    assert blender.data.objects["Body"].animation_data.action is not None


def test_a_run_of_all_steps_reports_its_warnings(
    blender: ModuleType, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from bl_ext.user_default.tricap.core.run import pipeline

    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)

    def warned(report: Any, monitor: Any) -> None:
        report.warn("The rays miss each other by 9 px.")

    monkeypatch.setattr(pipeline, "all_stages", warned)
    assert blender.ops.tricap.run(take=str(take), out=str(tmp_path / "out"), build=False) == {"FINISHED"}
    assert "Warning: The rays miss each other by 9 px." in capfd.readouterr().out.splitlines()


def test_a_run_keeps_a_scene_that_somebody_edited_and_says_so(
    blender: ModuleType, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also one that is open here: it stays open, and is saved under its own name again."""
    from bl_ext.user_default.tricap.core.run import pipeline

    monkeypatch.setattr(pipeline, "all_stages", lambda *_: None)
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    out, given = tmp_path / "out", {"take": str(take), "out": str(tmp_path / "out")}
    Results(out).write_run({})  # of other input
    for name in ("body (edited).blend", "body (edited 2).blend"):
        blender.ops.wm.save_as_mainfile(filepath=str(out / "body.blend"))
        edited = (out / "body.blend").read_bytes()
        assert blender.ops.tricap.run(**given, build=False) == {"FINISHED"}
        assert (out / name).read_bytes() == edited and not (out / "body.blend").exists()
        assert f"Warning: {out / 'body.blend'} may have edits of yours and is kept as “{name}”." in capfd.readouterr().out.splitlines()
        assert blender.data.filepath == str(out / "body.blend")


def test_the_output_folder_is_chosen_beside_the_file_or_the_take(blender: ModuleType, take: Path, tmp_path: Path) -> None:
    from bl_ext.user_default.tricap.addon import folders

    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = blender.context.scene
    scene.tricap.take = str(take)
    assert folders.output_folder("", scene) == take.parent / "sample_tricap"
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert folders.output_folder("", scene) == tmp_path / "sample_tricap"
    assert folders.output_folder("//results", scene) == tmp_path / "results"
    assert folders.output_folder("", scene, str(take.parent)) == tmp_path / f"{take.parent.name}_tricap"
    (tmp_path / "file").write_text("")
    with pytest.raises(folders.InputError, match="choose another output folder"):
        folders.check_writable(tmp_path / "file" / "out")


def test_a_take_that_needs_mending_leaves_no_result(blender: ModuleType, take: Path, tmp_path: Path) -> None:
    (tmp_path / "bad").mkdir()
    text = (take / "take.toml").read_text(encoding="utf-8") + "\n[sedes]\nframe = 0\n"
    (tmp_path / "bad" / "take.toml").write_text(text, encoding="utf-8")
    with pytest.raises(RuntimeError, match="sedes"):
        blender.ops.tricap.run(take=str(tmp_path / "bad"), out=str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
