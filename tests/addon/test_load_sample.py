"""Load Sample and Compute It Again: offline, beside the .blend or among the extension's files."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.motion.tables import read_joints
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

NAME = "tricap_sample"


@pytest.fixture
def saved(blender: ModuleType, tmp_path: Path) -> Path:
    """The folder of a saved empty file."""
    folder = tmp_path / "mon élan"
    folder.mkdir()
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    blender.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    return folder


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """What lies in the results when they would be computed again."""
    from bl_ext.user_default.tricap.addon.operators import run
    from bl_ext.user_default.tricap.core.run.take_run import open_run

    found = list[list[str]]()

    def measure(take: Path, out: Path, *rest: Any, restart: bool) -> tuple[Any, None]:
        with open_run(take, out, restart=restart) as opened:
            found.append(sorted(path.name for path in out.iterdir()))
            return opened, None

    monkeypatch.setattr(run, "measure", measure)
    return found


@pytest.mark.slow
def test_a_finished_project_is_opened_beside_the_file(blender: ModuleType, saved: Path, quick: list[list[str]]) -> None:
    assert blender.ops.tricap.load_sample() == {"FINISHED"} and not quick, "nothing is computed"
    scene = blender.context.scene
    assert scene.tricap.take == f"//{NAME}" and len(scene.tricap.views) == 3 and "body fitted" in scene.tricap.last
    assert blender.data.objects["Body"].animation_data.action is not None and scene.camera is not None
    (colours,) = [image for image in blender.data.images if tuple(image.size) == (640, 640)]
    assert colours.packed_file and len(blender.data.objects["Skin"].data.polygons) > 10_000
    robot, body = blender.data.objects["Robot"], blender.data.objects["Body"]
    for frame in (scene.frame_start, scene.frame_end):
        scene.frame_set(frame)
        for name in ("forearm.L", "thigh.R"):
            ours, theirs = (np.array(thing.matrix_world @ thing.pose.bones[name].matrix)[:3, 1] for thing in (robot, body))
            assert ours @ theirs > 0.999, "the robot moves like the person"
        hips = [np.array(thing.matrix_world @ thing.pose.bones[name].head) for thing, name in ((robot, "hips"), (body, "pelvis"))]
        assert np.linalg.norm(hips[0] - hips[1]) > 0.5, "beside it"
    take = saved / NAME / "take.toml"
    take.write_text(take.read_text() + "# mine\n")
    assert blender.ops.tricap.load_sample() == {"FINISHED"} and not quick and "Robot.001" not in blender.data.objects
    assert take.read_text().endswith("# mine\n"), "a sample that is there is kept"


@pytest.mark.slow
def test_it_is_computed_again_from_the_beginning(blender: ModuleType, saved: Path, quick: list[list[str]]) -> None:
    assert not blender.ops.tricap.compute_sample.poll()
    blender.ops.tricap.load_sample()
    assert blender.ops.tricap.compute_sample() == {"FINISHED"}
    (left,) = quick
    assert not {"clouds", "body.toml", "motion.csv", "skin", "trajectories.npz"} & set(left)
    (saved / NAME / "results" / "kept").mkdir()
    assert blender.ops.tricap.compute_sample() == {"FINISHED"} and "kept" in quick[1], "a stopped one goes on"
    assert blender.ops.tricap.load_sample() == {"FINISHED"} and len(quick) == 3, "and is computed to its end when it is opened"


def test_without_a_file_it_lies_among_the_extensions_own(blender: ModuleType) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert blender.ops.tricap.load_sample() == {"FINISHED"}
    place = Path(blender.utils.extension_path_user("bl_ext.user_default.tricap"))
    assert Path(blender.context.scene.tricap.take) == place / NAME
    assert (place / NAME / "results" / "clouds" / "0001.ply").is_file()


def test_a_folder_of_the_users_is_left_alone(blender: ModuleType, saved: Path) -> None:
    (saved / NAME).mkdir()
    (saved / NAME / "precious.txt").write_text("mine")
    with pytest.raises(RuntimeError, match="holds no sample recording"):
        blender.ops.tricap.load_sample()
    assert [path.name for path in (saved / NAME).iterdir()] == ["precious.txt"]


def test_a_file_with_footage_is_left_alone(blender: ModuleType, saved: Path) -> None:
    make_arm_take(saved / "mine", ArmTakeSettings(frames=2, width_px=192, interlaced="none"))
    from bl_ext.user_default.tricap.addon import project

    project.open_take(blender.context.scene, saved / "mine")
    with pytest.raises(RuntimeError, match="already has footage"):
        blender.ops.tricap.load_sample()
    assert project.folder_of(blender.context.scene) == saved / "mine"


@pytest.mark.slow
def test_the_same_is_computed_again(blender: ModuleType, saved: Path) -> None:
    blender.ops.tricap.load_sample()
    joints = saved / NAME / "results" / "joints.csv"
    shipped = read_joints(joints)
    assert blender.ops.tricap.compute_sample() == {"FINISHED"}
    again = read_joints(joints).joints_m
    apart = {name: np.linalg.norm(again[name] - places, axis=1) for name, places in shipped.joints_m.items()}
    for name, far in apart.items():  # other machines round otherwise, and what the images hardly show may end elsewhere
        assert (far < np.maximum(0.005, 3 * shipped.sigma_m[name])).all(), name
    assert np.mean(np.concatenate([*apart.values()]) < 0.005) > 0.9
    assert (joints.parent / "report" / "report.html").is_file()
