"""A run's results as a .blend: built, saved, opened again, played."""

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.__main__ import main
from tricap.core.body.skin.texture import TEXTURE
from tricap.core.foundation.errors import InputError
from tricap.core.results.folder import Results

from .conftest import FPS, FRAMES, SmallRun

JOINT_M, ANGLE_DEG = 1e-4, 0.01


def rows(path: Path) -> list[dict[str, str]]:
    """A table with a header, as any script would read it."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_after_saving_and_opening_the_armature_plays_the_tables(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.scene.build import build_scene

    blend = tmp_path / "sub" / "body.blend"
    report = build_scene(small_run.out, blend)
    assert report.warnings == () and report.counts["frames of motion"] == len(FRAMES)
    assert [path.name for path in blend.parent.iterdir()] == ["body.blend"]
    empty.ops.wm.open_mainfile(filepath=str(blend))
    assert played_joints_m(empty, small_run) < JOINT_M
    assert played_angles_deg(empty, small_run) < ANGLE_DEG


def test_appended_to_another_file_it_plays_the_same(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.scene.build import build_scene

    build_scene(small_run.out, tmp_path / "body.blend")
    empty.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with empty.data.libraries.load(str(tmp_path / "body.blend")) as (source, target):
        target.collections = [name for name in source.collections if name == "Tricap"]
    empty.context.scene.collection.children.link(target.collections[0])
    assert played_joints_m(empty, small_run) < JOINT_M
    assert played_angles_deg(empty, small_run) < ANGLE_DEG


def played_joints_m(bpy: ModuleType, run: SmallRun) -> float:
    """Largest distance of an armature's joint from joints.csv, all frames."""
    worst = 0.0
    for row in rows(run.out / "joints.csv"):
        bpy.context.scene.frame_set(int(row["frame"]))
        pose = bpy.data.objects["Body"].evaluated_get(bpy.context.evaluated_depsgraph_get()).pose
        at = {bone.head_joint: pose.bones[bone.name].head for bone in run.shape.skeleton.bones}
        at |= {bone.tail_joint: pose.bones[bone.name].tail for bone in run.shape.skeleton.bones}
        xyz = np.array([float(row[axis]) for axis in "xyz"])
        worst = max(worst, float(np.linalg.norm(np.array(at[row["joint"]]) - xyz)))
    return worst


def played_angles_deg(bpy: ModuleType, run: SmallRun) -> float:
    """Largest difference of a pose channel from motion.csv, and of a sigma's curve from its column, all frames, in degrees (or dm)."""
    from tricap.addon.scene.armature import channel_of

    body, worst = bpy.data.objects["Body"], 0.0
    for row in rows(run.out / "motion.csv"):
        bpy.context.scene.frame_set(int(row["frame"]))
        for name, (bone, channel, index, *_) in channel_of(run.shape).items():
            unit = np.degrees if channel == "rotation_euler" else float
            pose_bone = body.pose.bones[bone]
            worst = max(worst, abs(unit(getattr(pose_bone, channel)[index]) - float(row[name])))
            worst = max(worst, abs(unit(pose_bone[f"sigma {name}"]) - float(row[f"sigma {name}"])))
    return worst


def test_frames_rate_and_footage_are_the_takes(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene.build import build_scene

    build_scene(small_run.out)
    scene = empty.context.scene
    assert (scene.frame_start, scene.frame_end) == (FRAMES.start, FRAMES.stop - 1)
    assert scene.render.fps / scene.render.fps_base == pytest.approx(FPS, rel=1e-6)
    assert scene.camera["tricap_view"] == "C" and scene.camera["tricap_interlaced"] == "odd"
    assert sorted(clip.name for clip in empty.data.movieclips) == ["Footage C", "Footage L", "Footage R"]
    assert scene.active_clip.name == "Footage C"


def test_footage_that_starts_later_is_shifted(empty: ModuleType, small_run: SmallRun) -> None:
    """Image 0 of view L belongs to take frame 1: its number is the frame's − 1."""
    from tricap.addon.scene.build import build_scene

    path = small_run.take / "take.toml"
    path.write_text(path.read_text(encoding="utf-8").replace('"L/*.png"', '"L/*.png", offset_frames = -1'), encoding="utf-8")
    assert build_scene(small_run.out).warnings == ()
    assert {clip.name: clip.frame_start for clip in empty.data.movieclips} == {"Footage L": 1, "Footage C": 0, "Footage R": 0}


def test_cloud_and_trails_show_the_current_frame(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene import excluded
    from tricap.addon.scene.build import build_scene
    from tricap.addon.scene.options import POINTS_KEY

    build_scene(small_run.out)
    excluded.show(empty.context.scene, POINTS_KEY, True)
    for i, frame in enumerate(FRAMES):
        empty.context.scene.frame_set(frame)
        graph = empty.context.evaluated_depsgraph_get()
        shown = empty.data.objects["Cloud"].evaluated_get(graph).evaluated_geometry()
        points = shown.pointcloud
        assert len(points.points) == 40 + i
        assert {"frame", "sigma", "normal", "intensity"} <= set(points.attributes.keys())
        assert {value.value for value in points.attributes["frame"].data} == {frame}
        trail = empty.data.objects["Trajectories"].evaluated_get(graph).data
        assert (len(trail.polygons) > 0) == (i > 0)
    empty.context.scene.frame_set(FRAMES.stop + 5)
    shown = empty.data.objects["Cloud"].evaluated_get(empty.context.evaluated_depsgraph_get()).evaluated_geometry()
    assert len(shown.pointcloud.points) == 0
    mesh = empty.data.objects["Trajectories"].data
    assert (len(mesh.vertices), len(mesh.edges)) == (2 * len(FRAMES) - 1, 2 * len(FRAMES) - 3)  # the wrist was not seen in the first frame


def test_building_again_replaces_and_nothing_piles_up(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene.build import build_scene

    def census() -> dict[str, list[str]]:
        kinds = "objects meshes armatures actions metaballs materials node_groups movieclips cameras collections".split()
        return {kind: sorted(each.name for each in getattr(empty.data, kind)) for kind in kinds}

    mine = empty.data.objects.new("my own", None)
    empty.context.scene.collection.objects.link(mine)
    build_scene(small_run.out)
    first = census()
    build_scene(small_run.out)
    assert census() == first and "my own" in first["objects"]


@pytest.mark.parametrize(
    "missing, said",
    [
        ("clouds", "No point cloud"),
        ("trajectories.npz", "No trajectories"),
        ("body.toml", "No armature"),
        ("motion.csv", "No action"),
    ],
)
def test_what_is_missing_is_left_out_and_said(empty: ModuleType, small_run: SmallRun, missing: str, said: str) -> None:
    from tricap.addon.scene.build import build_scene

    path = small_run.out / missing
    path.rename(path.with_name("elsewhere"))
    report = build_scene(small_run.out)
    assert [warning for warning in report.warnings if said in warning]
    assert report.counts["cameras"] == 3


@pytest.mark.parametrize(("gone", "said"), [
    ("skin/texture.png", "No colours on the skin in the scene: texture.png is no file in {out}/skin; repeat the run"),
    ("skin/0002.ply", "{out}/skin has fewer files than the run wrote there; repeat the run"),
    ("clouds/0003.ply", "{out}/clouds has fewer files than the run wrote there; repeat the run"),
])  # fmt: skip
def test_a_file_of_a_folder_that_is_gone_is_said(empty: ModuleType, small_run: SmallRun, gone: str, said: str) -> None:
    """Also where a pipe is in its place, which nobody opens."""
    from tricap.addon.scene.build import build_scene

    (small_run.out / "skin" / TEXTURE).write_bytes(cv2.imencode(".png", np.full((16, 16, 3), 200, np.uint8))[1].tobytes())
    results = Results(small_run.out)
    results.write_run(results.read_run())
    assert build_scene(small_run.out).warnings == ()
    (small_run.out / gone).unlink()
    said = said.replace("{out}/", f"{small_run.out}{os.sep}")
    assert [w.startswith(said) for w in build_scene(small_run.out).warnings] == [True]
    if hasattr(os, "mkfifo") and "clouds" not in gone:  # a cloud is read, and refused
        os.mkfifo(small_run.out / gone)
        assert [w.startswith(said) for w in build_scene(small_run.out).warnings] == [True]


def test_a_skin_without_a_texture_is_as_it_was_wanted(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene.build import build_scene

    results = Results(small_run.out)
    results.write_run({**results.read_run(), "settings": {"skin": {"texture_px": 0}}})
    assert build_scene(small_run.out).warnings == ()


def test_a_take_that_was_moved_costs_only_cameras_and_footage(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene.build import build_scene

    small_run.take.rename(small_run.take.with_name("moved"))
    report = build_scene(small_run.out)
    assert report.counts["cameras"] == 0 and report.counts["bones"] == 2
    assert "No cameras and footage" in report.warnings[0] and "take.toml" in report.warnings[0]


@pytest.mark.parametrize("damaged", ["body.toml", "motion.csv", "trajectories.npz", "clouds/0003.ply", "run.json"])
def test_damaged_results_leave_the_scene_alone(empty: ModuleType, small_run: SmallRun, tmp_path: Path, damaged: str) -> None:
    from tricap.addon.scene.build import build_scene

    (small_run.out / damaged).write_bytes(b"\x00nonsense")
    with pytest.raises(InputError, match=Path(damaged).name):
        build_scene(small_run.out, tmp_path / "body.blend")
    assert not (tmp_path / "body.blend").exists() and not empty.data.collections


def test_a_place_that_cannot_be_written_is_told(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.scene.build import build_scene

    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InputError, match="Cannot write .*body.blend"):
        build_scene(small_run.out, tmp_path / "file" / "body.blend")
    with pytest.raises(InputError, match="let it end in .blend"):
        build_scene(small_run.out, tmp_path / "body.obj")


def test_a_file_that_is_there_is_kept_as_blender_keeps_it(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    """It may be the user's own, with clicks in it; only a run's body.blend is replaced, as long as nobody saved it."""
    from tricap.addon.scene.build import save_blend

    for name in ("mine.blend", "body.blend"):
        (tmp_path / name).write_text("clicks")
        save_blend(tmp_path / name)
        assert (tmp_path / name).with_suffix(".blend1").read_text() == "clicks" and (tmp_path / name).stat().st_size > 1000
        (tmp_path / name).with_suffix(".blend1").unlink()
    (tmp_path / "folder.blend").mkdir()
    with pytest.raises(InputError, match="folder.blend is a folder"):
        save_blend(tmp_path / "folder.blend")
    assert (tmp_path / "folder.blend").is_dir()
    shutil.copy(small_run.out / "run.json", tmp_path)
    save_blend(tmp_path / "body.blend")
    assert not list(tmp_path.glob("*.blend1")) and (tmp_path / "body (edited).blend").exists(), "nobody noted who wrote the one before"
    assert save_blend(tmp_path / "body.blend") == "" and len(list(tmp_path.glob("body*.blend"))) == 2


@pytest.mark.slow
def test_edits_in_the_scene_of_a_run_are_kept(blender: ModuleType, empty: ModuleType, small_run: SmallRun) -> None:
    """Keyed, saved in Blender, and built again: by the command, from the open file itself, and with the button."""
    from tricap.addon.scene.build import build_scene

    out = small_run.out
    assert not [w for w in build_scene(out, out / "body.blend").warnings if "edits" in w]
    for n, name in enumerate(("body (edited).blend", "body (edited 2).blend", "body (edited 3).blend")):
        empty.ops.wm.open_mainfile(filepath=str(out / "body.blend"))
        body = next(o for o in empty.data.objects if o.type == "ARMATURE")
        body["my_edit"] = n
        empty.ops.wm.save_mainfile()
        edited, said = (out / "body.blend").read_bytes(), f"{out / 'body.blend'} may have edits of yours and is kept as “{name}”."
        if n == 0:
            line = [sys.executable, "-m", "tricap", "scene", str(out), "--blend", str(out / "body.blend")]
            done = subprocess.run(line, capture_output=True, text=True, timeout=120)
            assert done.returncode == 0 and done.stdout.splitlines()[0] == said, done.stdout + done.stderr
        elif n == 1:
            assert build_scene(out, out / "body.blend").warnings[-1] == said
        else:
            assert blender.ops.tricap.build_scene(out=str(out), blend=str(out / "body.blend")) == {"FINISHED"}
        assert (out / name).read_bytes() == edited and (out / "body.blend").read_bytes() != edited
    empty.ops.wm.open_mainfile(filepath=str(out / "body (edited 2).blend"))
    assert next(o for o in empty.data.objects if o.type == "ARMATURE")["my_edit"] == 1
    assert len(list(out.glob("*.blend"))) == 4


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_saving_does_not_follow_links_that_a_stranger_made_for_it(empty: ModuleType, tmp_path: Path) -> None:
    """Blender writes NAME@ first. A stranger's folder may contain a link for every number of a process."""
    from tricap.addon.scene.build import save_blend

    out, letter = tmp_path / "out", tmp_path / "letter.txt"
    out.mkdir()
    letter.write_text("mine")
    for end in ("", "@"):
        (out / f".x.{os.getpid()}.part.blend{end}").symlink_to(letter if end else tmp_path / "not there")
    save_blend(out / "x.blend")
    assert (out / "x.blend").stat().st_size > 1000 and letter.read_text() == "mine" and not (tmp_path / "not there").exists()


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_what_blender_writes_replaces_a_link_of_its_name(empty: ModuleType, tmp_path: Path) -> None:
    """As what we write: a folder from somebody else may have links under the names of its files."""
    from tricap.addon.retarget.by_blender import write_whole
    from tricap.addon.scene.build import save_blend

    out, letters = tmp_path / "out", tmp_path / "letters"
    out.mkdir(), letters.mkdir()
    for name in ("x.blend", "x.fbx"):
        (letters / name).write_text("mine")
        (out / name).symlink_to(letters / name)
    save_blend(out / "x.blend")
    write_whole(out / "x.fbx", lambda part: Path(part).write_text("motion"))
    assert {path.name: path.read_text() for path in letters.iterdir()} == {"x.blend": "mine", "x.fbx": "mine"}
    assert not (out / "x.blend").is_symlink() and (out / "x.fbx").read_text() == "motion" and not (out / "x.fbx").is_symlink()


def test_the_operator_builds_saves_and_keeps_the_open_file(blender: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert blender.ops.tricap.build_scene(out=str(small_run.out), blend=str(tmp_path / "copy.blend")) == {"FINISHED"}
    assert blender.data.filepath == "" and (tmp_path / "copy.blend").is_file()
    assert "Tricap" in blender.data.collections


@pytest.mark.slow
def test_the_command(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "tricap", "scene", str(small_run.out), "--blend", str(tmp_path / "c.blend")]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and (tmp_path / "c.blend").is_file(), done.stdout + done.stderr
    assert done.stdout.splitlines() == [done.stdout.strip()] and "2 bones" in done.stdout  # nothing of Blender's own
    wrong = subprocess.run([*line[:4], str(tmp_path), *line[5:]], capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 2 and "Traceback" not in wrong.stderr and "no run.json" in wrong.stderr


def test_quiet_keeps_back_nothing_that_a_scene_lacks(small_run: SmallRun, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A killed run leaves no body, and its scene was written without a word."""
    out = Path(shutil.copytree(small_run.out, tmp_path / "copied"))
    (out / "body.toml").unlink()
    assert main(["scene", str(out), "--blend", str(tmp_path / "a.blend"), "--quiet"]) == 0
    assert "No armature and metaballs in the scene: body.toml is not in" in capfd.readouterr().out


@pytest.mark.parametrize(("more", "said"), [
    (["--frame", "99", "--preview", "a.png"], "--frame 99 is not among the frames 2 to 7"),
    (["--simplify", "-1"], "--simplify -1 is out of range"),
    (["--simplify", "nan"], "is out of range"), (["--preview", "a.jpg"], "--preview a.jpg is not a .png file"),
    (["--film", "a.mpg"], "is not a .mp4 file"), (["--turn", "nan"], "--turn nan is out of range"),
    (["--elevation", "-86"], "choose an angle of -85 to 85 degrees"), (["--from", "361"], "--from 361 is out of range"),
    (["--from", "30"], "--from moves the camera of --film, which was not given; leave it out"),
    (["--field", "Wyvill"], "--field is the field function of --implicit, which was not given"),
    (["--turntable", "a"], "is not a .mp4 file"), (["--turntable", "a\udcff.mp4"], "is not UTF-8; rename it"),
])  # fmt: skip
def test_what_a_scene_cannot_be_made_of_is_told_before_it_is_written(
    empty: ModuleType, small_run: SmallRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any, more: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["scene", str(small_run.out), "--blend", "a.blend", *more, "--quiet"]) == 2
    assert said in capfd.readouterr().err and not list(tmp_path.glob("a*"))


def test_clips_that_were_deleted_are_made_again(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene.build import build_scene
    from tricap.addon.scene.clips import clip_behind

    build_scene(small_run.out)
    for clip in list(empty.data.movieclips):
        empty.data.movieclips.remove(clip)
    cameras = [o.data for o in empty.data.objects if o.type == "CAMERA"]
    assert len(cameras) == 3 and all(clip_behind(camera) is None and not camera.background_images for camera in cameras)
    build_scene(small_run.out)
    assert sorted(clip.name for clip in empty.data.movieclips) == ["Footage C", "Footage L", "Footage R"]
    assert all(clip_behind(o.data) is not None for o in empty.data.objects if o.type == "CAMERA")
