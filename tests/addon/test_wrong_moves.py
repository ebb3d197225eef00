"""What people do wrong: each ends in one sentence that says what to do, and the scene can be used as before."""

import errno
import importlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tricap.core.run import pipeline
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

from .conftest import with_small_texture

ADDON = "bl_ext.user_default.tricap.addon"
STAGES = ("surface", "tracks", "fit the click frame", "skin", "report")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sample recording, with its results in out/."""
    folder = tmp_path_factory.mktemp("wrong") / "kick"
    make_arm_take(folder, ArmTakeSettings(frames=2, width_px=256, interlaced="none"))
    pipeline.run(with_small_texture(folder, "[settings.growing]\nspacing_px = 6\n"), folder.with_name("out"))
    return folder


@pytest.fixture
def take(recording: Path, tmp_path: Path) -> Path:
    """A recording of one's own to spoil."""
    return Path(shutil.copytree(recording, tmp_path / "kick"))


@pytest.fixture
def scene(blender: ModuleType, recording: Path) -> Iterator[ModuleType]:
    """bpy with results in the scene. Afterwards everything must still work: the same results can be built, once."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    results = str(recording.with_name("out"))
    assert blender.ops.tricap.build_scene(out=results) == {"FINISHED"}
    yield blender
    assert importlib.import_module(f"{ADDON}.session").get_session().job is None
    assert blender.ops.tricap.build_scene(out=results) == {"FINISHED"}
    ours = [o for o in blender.context.scene.objects if o.type == "ARMATURE" and o.animation_data and o.animation_data.action]
    assert len(ours) == 1


def refused(act: Callable[[], object], *words: str) -> None:
    """`act` is answered by one sentence with these words, for a person: no traceback, no mistake of ours."""
    with pytest.raises(RuntimeError) as caught:
        act()
    said = str(caught.value).strip()
    assert said.startswith("Error: ") and said.count("\n") == 0 and "Traceback" not in said and "Internal error in Tricap" not in said, said
    assert all(word in said for word in words), said


def run(bpy: ModuleType, take: Path, out: Path) -> Callable[[], object]:
    """Pressing Run, with names of objects compared before and after."""

    def pressed() -> object:
        before = sorted(bpy.data.objects.keys())
        try:
            return bpy.ops.tricap.run(take=str(take), out=str(out))
        except RuntimeError:
            assert sorted(bpy.data.objects.keys()) == before, "what was in the scene stays there"
            raise

    return pressed


def replace(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def no_take(take: Path) -> None:
    (take / "take.toml").unlink()


def damaged_take(take: Path) -> None:
    (take / "take.toml").write_text("format = tricap", encoding="utf-8")


def no_calibration(take: Path) -> None:
    (take / "rig.toml").unlink()


def other_calibration(take: Path) -> None:
    replace(take / "rig.toml", 'name = "L"', 'name = "left"')


def calibration_of_other_pictures(take: Path) -> None:
    make_arm_take(take.with_name("large"), ArmTakeSettings(frames=2, width_px=384, interlaced="none"))
    shutil.copy(take.with_name("large") / "rig.toml", take / "rig.toml")


def no_movie(take: Path) -> None:
    (take / "left.mp4").write_text("a letter to my aunt", encoding="utf-8")
    replace(take / "take.toml", 'images = "L/*.png"', 'movie = "left.mp4"')


def missing_view(take: Path) -> None:
    shutil.rmtree(take / "R")


def a_text_among_the_pictures(take: Path) -> None:
    (take / "C" / "0001.png").write_text("a letter to my aunt", encoding="utf-8")


def swapped_views(take: Path) -> None:
    (take / "L").rename(take / "x")
    (take / "R").rename(take / "L")
    (take / "x").rename(take / "R")


def one_view_clicked(take: Path) -> None:
    lines = (take / "take.toml").read_text(encoding="utf-8").splitlines()
    kept = [line.split(", C =")[0] + " }" if line.startswith('"elbow.R"') else line for line in lines]
    (take / "take.toml").write_text("\n".join(kept), encoding="utf-8")


def click_on_the_background(take: Path) -> None:
    lines = (take / "take.toml").read_text(encoding="utf-8").splitlines()
    wall = '"elbow.R" = { L = [200.0, 30.0], C = [190.0, 30.0], R = [180.0, 30.0] }'
    (take / "take.toml").write_text("\n".join(wall if line.startswith('"elbow.R"') else line for line in lines), encoding="utf-8")


def click_outside(take: Path) -> None:
    replace(take / "take.toml", "frame = 0", "frame = 400")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (no_take, ("take.toml",)),
        (damaged_take, ("take.toml",)),
        (no_calibration, ("rig.toml", "calibrat")),
        (other_calibration, ("L",)),
        (calibration_of_other_pictures, ("256", "384")),
        (no_movie, ("left.mp4",)),
        (missing_view, ("R",)),
        (a_text_among_the_pictures, ("0001.png",)),
        (swapped_views, ("L and R are swapped",)),
        (one_view_clicked, ("elbow.R", "two views")),
        (click_on_the_background, ("clicked joints",)),
        (click_outside, ("400",)),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_wrong_input(scene: ModuleType, take: Path, spoil: Callable[[Path], None], words: tuple[str, ...]) -> None:
    spoil(take)
    refused(run(scene, take, take.with_name("results")), *words)


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_esc(
    scene: ModuleType, take: Path, recording: Path, monkeypatch: pytest.MonkeyPatch, stage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """At each stage: a warning, the scene as it was, and the next run goes on to the same numbers."""
    jobs = importlib.import_module(f"{ADDON}.jobs")

    class Stopped(jobs.WaitingMonitor):  # type: ignore[misc,name-defined]
        def step(self, name: str, done: float, total: float) -> None:
            if name == stage:
                self.cancel()
            super().step(name, done, total)

    with monkeypatch.context() as patch:
        patch.setattr(jobs, "WaitingMonitor", Stopped)
        before = sorted(scene.data.objects.keys())
        assert run(scene, take, take.with_name("results"))() == {"CANCELLED"}
        assert sorted(scene.data.objects.keys()) == before
    said = [line for line in capfd.readouterr().out.splitlines() if line.startswith("Warning: Stopped")]
    assert len(said) == 1, said
    assert run(scene, take, take.with_name("results"))() == {"FINISHED"}
    results = take.with_name("results") / "motion.csv"
    assert results.read_bytes() == (recording.with_name("out") / "motion.csv").read_bytes()


def test_no_take_is_chosen(scene: ModuleType) -> None:
    refused(lambda: scene.ops.tricap.run(), "Choose the take")


def test_a_relative_folder_in_a_file_that_was_never_saved(scene: ModuleType, take: Path) -> None:
    refused(lambda: scene.ops.tricap.run(take=str(take), out="//results"), "never saved")


def test_the_output_is_a_file(scene: ModuleType, take: Path) -> None:
    take.with_name("results").write_text("")
    refused(run(scene, take, take.with_name("results")), "choose another output folder")


def test_a_read_only_folder(scene: ModuleType, take: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda *_: False)
        refused(run(scene, take, take.with_name("results")), "Cannot write into", "choose another output folder")


@pytest.mark.slow
@pytest.mark.parametrize("files", [0, 3, 12])
def test_the_disk_is_full(scene: ModuleType, take: Path, monkeypatch: pytest.MonkeyPatch, files: int) -> None:
    left, real = [files], os.replace

    def full(*args: str) -> None:
        if left[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left[0] -= 1
        real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        refused(run(scene, take, take.with_name("results")), "No space left", "free some space")
    assert run(scene, take, take.with_name("results"))() == {"FINISHED"}, "with room again it goes on"


def test_nothing_to_retarget_onto_or_to_export(scene: ModuleType, tmp_path: Path) -> None:
    assert scene.context.scene.tricap_retarget.source.name == "Body"
    refused(lambda: scene.ops.tricap.retarget(), "as the target")
    scene.context.scene.tricap_retarget.target = scene.data.objects["Body"]
    refused(lambda: scene.ops.tricap.retarget(), "both source and target")
    nowhere = {"filepath": str(tmp_path / "a.bvh"), "out": str(tmp_path / "none")}
    refused(lambda: scene.ops.tricap.export(kind="bvh", **nowhere), "no file or folder", "none")
    refused(lambda: scene.ops.tricap.export(kind="bvh"), "Choose the file")


def test_another_job_is_running(scene: ModuleType, take: Path) -> None:
    """In another process: it holds the folder."""
    lock = importlib.import_module("tricap.core.foundation.lock")
    take.with_name("results").mkdir()
    with lock.locked(take.with_name("results")):
        refused(run(scene, take, take.with_name("results")), "Another run")


def delete_the_body(bpy: ModuleType) -> None:
    bpy.data.objects.remove(bpy.data.objects["Body"])


def delete_everything(bpy: ModuleType) -> None:
    bpy.data.batch_remove(list(bpy.data.objects))


def delete_the_collection(bpy: ModuleType) -> None:
    bpy.data.collections.remove(bpy.data.collections["Tricap"])


def rename_everything(bpy: ModuleType) -> None:
    for data in (*bpy.data.objects, *bpy.data.collections, *bpy.data.actions, *bpy.data.movieclips):
        data.name = "élan " + data.name[::-1]


def purge(bpy: ModuleType) -> None:
    bpy.data.batch_remove(list(bpy.data.objects))
    bpy.data.orphans_purge(do_recursive=True)


def delete_actions_and_materials(bpy: ModuleType) -> None:
    bpy.data.batch_remove([*bpy.data.actions, *bpy.data.materials, *bpy.data.node_groups])


def stay_in_pose_mode(bpy: ModuleType) -> None:
    bpy.context.view_layer.objects.active = next(o for o in bpy.data.objects if o.type == "ARMATURE")
    bpy.ops.object.mode_set(mode="POSE")


@pytest.mark.parametrize(
    "meddle",
    [delete_the_body, delete_everything, delete_the_collection, rename_everything, purge, delete_actions_and_materials, stay_in_pose_mode],
    ids=lambda f: f.__name__,
)
def test_our_objects_are_meddled_with(scene: ModuleType, take: Path, recording: Path, meddle: Callable[[ModuleType], None]) -> None:
    """Nothing to complain of: the scene is built anew. (`scene` then builds it once more.)"""
    meddle(scene)
    assert scene.ops.tricap.build_scene(out=str(recording.with_name("out"))) == {"FINISHED"}
    assert sum(o.type == "ARMATURE" for o in scene.context.scene.objects) == 1


def no_results(out: Path) -> None:
    shutil.rmtree(out)


def results_of_something_else(out: Path) -> None:
    (out / "run.json").unlink()


def half_a_motion(out: Path) -> None:
    data = (out / "motion.csv").read_bytes()
    (out / "motion.csv").write_bytes(data[: len(data) // 2])


def half_a_cloud(out: Path) -> None:
    data = (out / "clouds" / "0001.ply").read_bytes()
    (out / "clouds" / "0001.ply").write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (no_results, ("results",)),
        (results_of_something_else, ("run.json",)),
        (half_a_motion, ("motion.csv",)),
        (half_a_cloud, ("0001.ply",)),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_wrong_results(scene: ModuleType, recording: Path, tmp_path: Path, spoil: Callable[[Path], None], words: tuple[str, ...]) -> None:
    out = Path(shutil.copytree(recording.with_name("out"), tmp_path / "results"))
    spoil(out)
    before = sorted(scene.data.objects.keys())
    refused(lambda: scene.ops.tricap.build_scene(out=str(out)), *words)
    assert sorted(scene.data.objects.keys()) == before
