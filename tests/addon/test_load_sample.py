"""Load Sample and Run: offline, beside the .blend or among the extension's files, and the command line's surface."""

from pathlib import Path
from types import ModuleType

import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.run import pipeline, take_run
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.score import score_run


@pytest.fixture
def small(blender: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The operator's module, with a recording that is quicker to make."""
    from bl_ext.user_default.tricap.addon.operators import run

    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    monkeypatch.setattr(run, "SAMPLE", {**run.SAMPLE, "frames": 2, "width_px": 192})
    measure, texture = run.measure, {"skin": {"texture_px": 64}}
    monkeypatch.setattr(run, "measure", lambda take, out, overrides, *rest: measure(take, out, overrides | texture, *rest))
    return run


@pytest.mark.slow
def test_beside_the_file_with_the_commands_surface(blender: ModuleType, small: ModuleType, tmp_path: Path) -> None:
    folder = tmp_path / "mon élan"
    folder.mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    assert blender.ops.tricap.load_sample() == {"FINISHED"}
    out = folder / "tricap_sample" / "results"
    make_arm_take(tmp_path / "sample", ArmTakeSettings(**small.SAMPLE))
    with take_run.open_run(tmp_path / "sample", tmp_path / "out") as job:  # of all stages: test_run.py
        pipeline.measure(job, Monitor())
    assert (out / "clouds" / "0001.ply").read_bytes() == (tmp_path / "out" / "clouds" / "0001.ply").read_bytes()
    scene = blender.context.scene
    assert scene.tricap.take == "//tricap_sample" and len(scene.tricap.views) == 3 and "body fitted" in scene.tricap.last
    assert blender.data.objects["Body"].animation_data.action is not None
    (folder / "tricap_sample" / "take.toml").write_text((folder / "tricap_sample" / "take.toml").read_text() + "# mine\n")
    assert blender.ops.tricap.load_sample() == {"FINISHED"}
    assert (folder / "tricap_sample" / "take.toml").read_text().endswith("# mine\n"), "a sample that is there is kept"


def test_without_a_file_it_lies_among_the_extensions_own(blender: ModuleType, small: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    from bl_ext.user_default.tricap.core.run import pipeline

    monkeypatch.setattr(pipeline, "all_stages", pipeline.measure)  # it is the place that matters
    assert blender.ops.tricap.load_sample() == {"FINISHED"}
    place = Path(blender.utils.extension_path_user("bl_ext.user_default.tricap"))
    assert Path(blender.context.scene.tricap.take) == place / "tricap_sample"
    assert (place / "tricap_sample" / "results" / "clouds" / "0001.ply").is_file()


def test_a_folder_of_the_users_is_left_alone(blender: ModuleType, small: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "tricap_sample").mkdir()
    (tmp_path / "tricap_sample" / "precious.txt").write_text("mine")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    with pytest.raises(RuntimeError, match="holds no sample recording"):
        blender.ops.tricap.load_sample()
    assert [path.name for path in (tmp_path / "tricap_sample").iterdir()] == ["precious.txt"]


def test_a_file_with_footage_is_left_alone(blender: ModuleType, small: ModuleType, tmp_path: Path) -> None:
    make_arm_take(tmp_path / "mine", ArmTakeSettings(**small.SAMPLE))
    from bl_ext.user_default.tricap.addon import project

    project.open_take(blender.context.scene, tmp_path / "mine")
    with pytest.raises(RuntimeError, match="already has footage"):
        blender.ops.tricap.load_sample()
    assert Path(blender.context.scene.tricap.take) == tmp_path / "mine"


@pytest.mark.slow
def test_the_whole_sample_is_close_to_its_truth(blender: ModuleType, tmp_path: Path) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert blender.ops.tricap.load_sample() == {"FINISHED"}
    score = score_run(tmp_path / "tricap_sample", tmp_path / "tricap_sample" / "results")
    assert score.joints is not None and score.joints.mpjpe_mm < 10, str(score)
