"""A body model of the take's own, from the footage to the scene."""

from pathlib import Path
from types import ModuleType

import pytest

from tricap.core.body.model_file import MODELS
from tricap.core.body.shape import read_body
from tricap.core.run import pipeline, take_run
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take.writing import read_table, write_table

from .conftest import with_small_texture


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small recording of an arm whose body is mine.toml, a part of theirs.toml."""
    folder = tmp_path_factory.mktemp("own") / "take"
    make_arm_take(folder, ArmTakeSettings(width_px=256, frames=2, interlaced="none"))
    theirs = (MODELS / "arm.R.toml").read_text(encoding="utf-8").replace('name = "arm.R"', 'name = "theirs"')
    (folder / "theirs.toml").write_text(theirs, encoding="utf-8")
    (folder / "mine.toml").write_text('part_of = "theirs.toml"\n', encoding="utf-8")
    write_table(folder, read_table(folder) | {"body": {"model": "mine.toml"}})
    return with_small_texture(folder)


@pytest.mark.slow
def test_a_run_with_a_model_of_ones_own_ends_in_a_scene(
    empty: ModuleType, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tricap.addon.scene.build import build_scene

    monkeypatch.chdir(tmp_path)  # paths are relative to the take, not to the working folder
    job = pipeline.run(take, tmp_path / "out", {"growing": {"spacing_px": 6}}, frames=(0, 2))
    assert job.body is not None and read_body(tmp_path / "out" / "body.toml").model == "mine"
    build_scene(tmp_path / "out", tmp_path / "body.blend")
    assert set(empty.data.objects["Body"].pose.bones.keys()) >= {"upper_arm.R", "forearm.R"}
    again = pipeline.run(take, tmp_path / "out", {"growing": {"spacing_px": 6}}, frames=(0, 2))
    assert again.record["stages"]["fit"]["key"] == job.record["stages"]["fit"]["key"]


def test_another_file_of_the_model_makes_the_fit_stale(take: Path, tmp_path: Path) -> None:
    with take_run.open_run(take, tmp_path / "out", frames=(0, 2)) as job:
        before = dict(job.keys)
    theirs = take / "theirs.toml"
    theirs.write_text(theirs.read_text(encoding="utf-8").replace("stature_m = 1.75", "stature_m = 1.60"), encoding="utf-8")
    with take_run.open_run(take, tmp_path / "out", frames=(0, 2)) as job:
        assert job.keys["fit"] != before["fit"] and job.keys["track"] == before["track"]
