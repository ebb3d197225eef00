"""The eight steps: the state of each at every point of the way, what a change makes stale, and what each wrong move is told."""

import importlib
import json
import os
import shutil
import webbrowser
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.__main__ import main
from tricap.core.body.shape import read_body
from tricap.core.geometry.rig import read_rig, renamed, write_rig
from tricap.core.motion.tables import read_joints, read_motion
from tricap.core.run import pipeline
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take.writing import read_table, write_table

from .conftest import with_small_texture

NAME = "bl_ext.user_default.tricap.addon"
QUICK = {"growing": {"spacing_px": 6}}
Words = Callable[[], str]


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Footage, cameras and clicks of an arm."""
    folder = tmp_path_factory.mktemp("recordings") / "arm"
    make_arm_take(folder, ArmTakeSettings(frames=3, width_px=384, interlaced="none"))
    return with_small_texture(folder)


@pytest.fixture
def states(blender: ModuleType) -> ModuleType:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return importlib.import_module(f"{NAME}.steps.states")


@pytest.fixture
def words(states: ModuleType, blender: ModuleType) -> Words:
    """The states' words in a line, after a look."""
    watch = importlib.import_module(f"{NAME}.steps.watch")
    return lambda: " ".join(watch.refresh(blender.context.scene).states[step].status for step in states.STEPS)


@pytest.fixture
def why(states: ModuleType, blender: ModuleType) -> Callable[[str], str]:
    """The sentence of a step."""
    watch = importlib.import_module(f"{NAME}.steps.watch")
    return lambda step: watch.refresh(blender.context.scene).states[step].message


def new_project(blender: ModuleType, sample: Path, folder: Path) -> Any:
    """A saved file with the sample's footage added, as a user would; its calibration is in another folder."""
    shutil.copytree(sample, folder / "film")
    (folder / "film" / "rig.toml").rename(folder / "rig.toml")
    for name in ("take.toml", "truth.npz"):
        (folder / "film" / name).unlink()
    blender.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    assert blender.ops.tricap.add_footage(directory=str(folder / "film")) == {"FINISHED"}
    return blender.context.scene


@pytest.mark.slow
def test_an_opened_take_shows_its_frames(blender: ModuleType, sample: Path, tmp_path: Path) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = opened(blender, sample, tmp_path)
    assert (scene.frame_start, scene.frame_current, scene.frame_end) == (0, 0, 2)


def opened(blender: ModuleType, sample: Path, folder: Path) -> Any:
    """The sample's take opened, with results to be in folder/out."""
    shutil.copytree(sample, folder / "take")
    assert blender.ops.tricap.open_take(directory=str(folder / "take")) == {"FINISHED"}
    scene = blender.context.scene
    scene.tricap.out = str(folder / "out")
    scene.tricap.growing.spacing_px = 6
    return scene


@pytest.mark.slow
def test_the_whole_way_from_footage_to_a_rig(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path) -> None:
    assert words() == "empty empty empty empty empty empty empty empty"
    scene = new_project(blender, sample, tmp_path)
    assert [(v.name, v.images) for v in scene.tricap.views] == [("L", "L/*.png"), ("C", "C/*.png"), ("R", "R/*.png")]
    assert words() == "done ready done empty empty empty empty empty"
    assert why("footage").startswith("3 views, 3 frames of 384×288 pixels, 25 fps. Images have no frame rate; 25 fps is assumed.")
    scene.tricap.fps = 25.0
    assert why("footage") == "3 views, 3 frames of 384×288 pixels, 25 fps."
    assert blender.ops.tricap.cameras_from_file(filepath=str(tmp_path / "rig.toml")) == {"FINISHED"}
    assert "Camera L" in scene.objects and scene.camera.name == "Camera C", "the cameras stand in the viewport"
    scene.tricap.model = "arm.R"
    assert words() == "done done ready ready empty empty empty empty"
    click(blender, read_table(sample)["seeds"]["joints"])
    assert words() == "done done done ready empty empty empty empty" and why("clicks") == "All 3 joints are clicked."
    scene.tricap.growing.spacing_px = 6
    assert blender.ops.tricap.measure() == {"FINISHED"}
    assert words() == "done done done done ready empty empty empty" and "Cloud" in scene.objects
    assert blender.ops.tricap.track() == {"FINISHED"}
    assert words() == "done done done done done ready empty empty" and "Trajectories" in scene.objects
    assert blender.ops.tricap.fit() == {"FINISHED"}
    assert words() == "done done done done done done ready empty"
    assert blender.ops.tricap.build_scene() == {"FINISHED"}
    assert words() == "done done done done done done done ready"
    assert blender.ops.tricap.export(kind="bvh", filepath=str(tmp_path / "motion.bvh")) == {"FINISHED"}
    assert words() == "done done done done done done done done" and (tmp_path / "motion.bvh").stat().st_size > 0
    assert (tmp_path / "shot_tricap" / "results" / "report" / "report.html").exists()
    same_numbers_as_the_command(tmp_path)
    assert len([c for c in blender.data.movieclips]) == 3, "the scene shows the project's own clips"


def click(blender: ModuleType, joints: dict[str, dict[str, list[float]]]) -> None:
    project, clicks = (importlib.import_module(f"{NAME}.{name}") for name in ("project", "clicks"))
    clips = project.clips_of(blender.context.scene)
    for name, at in joints.items():
        for view, xy in at.items():
            clicks.set_click(clips[view], name, 0, xy)


def same_numbers_as_the_command(folder: Path) -> None:
    pipeline.run(folder / "shot_tricap", folder / "command")
    for name in ("motion.csv", "body.toml", "trajectories.npz", "clouds/0002.ply"):
        assert (folder / "command" / name).read_bytes() == (folder / "shot_tricap" / "results" / name).read_bytes(), name


@pytest.fixture(scope="module")
def results(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes of the sample."""
    out = tmp_path_factory.mktemp("results") / "out"
    pipeline.run(sample, out, QUICK)
    return out


@pytest.fixture
def done(blender: ModuleType, words: Words, sample: Path, results: Path, tmp_path: Path) -> Any:
    """The scene, with everything done."""
    shutil.copytree(results, tmp_path / "out")
    scene = opened(blender, sample, tmp_path)
    assert words() == "done done done done done done ready empty", "what the command did counts here too"
    assert blender.ops.tricap.run() == {"FINISHED"}
    assert words() == "done done done done done done done ready"
    return scene


@pytest.mark.slow
def test_changes_make_the_right_steps_stale_and_only_those(blender: ModuleType, done: Any, words: Words, tmp_path: Path) -> None:
    scene = done
    scene.tricap.fitting.gate_m = 0.04
    assert words() == "done done done done done stale stale ready"
    scene.tricap.fitting.gate_m = 0.035
    assert words() == "done done done done done done done ready"
    scene.tricap.fps = 50.0
    assert words().split()[3:7] == ["done", "stale", "stale", "stale"]
    scene.tricap.fps = 25.0
    clip = scene.tricap.views[0].clip
    marker = clip.tracking.tracks["elbow.R"].markers[0]
    before = marker.co[:]
    marker.co[0] += 0.01
    assert words().split()[2:7] == ["done", "stale", "stale", "stale", "stale"]
    marker.co = before
    assert words() == "done done done done done done done ready"
    clip.tracking.tracks["elbow.R"].markers.insert_frame(3, co=before)  # a keyframe in another frame
    assert words().split()[3:7] == ["done", "done", "stale", "stale"]
    assert blender.ops.tricap.fit() == {"FINISHED"}
    assert words().split()[3:7] == ["done", "done", "done", "stale"]
    assert blender.ops.tricap.run() == {"FINISHED"}
    assert words().split()[3:7] == ["done", "done", "done", "done"]


@pytest.mark.slow
def test_a_fit_that_asks_for_a_click_has_a_button_for_it(
    blender: ModuleType, words: Words, why: Any, sample: Path, results: Path, layout: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It leads to the joint in its frame; surface and tracks stand in the viewport meanwhile."""
    core = NAME.removesuffix("addon") + "core"
    starts, stages = (importlib.import_module(f"{core}.{name}") for name in ("fitting.inputs.start_joints", "run.pipeline"))
    watch, panel = (importlib.import_module(f"{NAME}.steps.{name}") for name in ("watch", "panel"))
    start = starts.StartJoints(frame=2, xyz_m={}, stature=1.0, model="full", probability=0.6, rivals={"front and back": 0.4}, ask="wrist.R")

    def fit(run: Any, monitor: Any) -> None:
        raise starts.NeedsClick(start)

    shutil.copytree(results, tmp_path / "out")
    scene = opened(blender, sample, tmp_path)
    scene.tricap.fitting.gate_m = 0.04
    monkeypatch.setattr(stages, "fit", fit)
    for operator in (blender.ops.tricap.fit, blender.ops.tricap.run):
        with pytest.raises(RuntimeError, match="Click the right wrist in two views of frame 2"):
            operator()
        state = watch.current(scene).states["body"]
        assert words().split()[3:6] == ["done", "done", "asks"] and state.click == ("wrist.R", 2)
        assert {"Camera L", "Cloud", "Trajectories"} <= set(scene.objects.keys())
    offered = type(layout)().draw(panel.TRICAP_PT_main, blender.context).operators
    assert "tricap.click_joints" in offered and "tricap.run" not in offered
    assert scene.tricap.seed_frame == 0
    scene.tricap.views[0].clip.tracking.tracks["wrist.R"].markers.insert_frame(3, co=(0.5, 0.5))
    assert words().split()[3:6] == ["done", "done", "ready"] and watch.current(scene).states["body"].click is None
    assert "tricap.run" in type(layout)().draw(panel.TRICAP_PT_main, blender.context).operators


@pytest.mark.slow
def test_where_the_fit_finds_nobody_the_panel_asks_for_clicks(
    blender: ModuleType, words: Words, why: Any, sample: Path, results: Path, layout: Any, tmp_path: Path
) -> None:
    """Running the same again would end as before. New clicks make the fit the next step."""
    shutil.copytree(results, tmp_path / "out")
    scene, panel = opened(blender, sample, tmp_path), importlib.import_module(f"{NAME}.steps.panel")
    watch, clicks = (importlib.import_module(f"{NAME}.{name}") for name in ("steps.watch", "clicks"))
    scene.tricap.model = "auto"
    for view in scene.tricap.views:
        clicks.clear(view.clip)
    path = tmp_path / "out" / "run.json"
    run, keys = json.loads(path.read_text()), watch.refresh(scene).keys
    run["stages"] = {stage: {**run["stages"][stage], "key": keys[stage]} for stage in ("measure", "track")}
    run["stages"]["fit"] = {"seconds": 0.0, "key": keys["fit"], "not_done": "no clicked joints"}
    path.write_text(json.dumps(run))
    assert words().split()[2:6] == ["asks", "done", "done", "empty"] and watch.current(scene).next == "clicks"
    assert "does not find the person by itself. Click at least three joints of the trunk" in why("clicks")
    drawn = type(layout)().draw(panel.TRICAP_PT_main, blender.context)
    assert drawn.highlighted == ["tricap.click_joints"] and "tricap.run" not in drawn.operators
    click(blender, read_table(sample)["seeds"]["joints"])
    assert words().split()[2:6:3] == ["done", "stale"] and watch.current(scene).can_run


@pytest.mark.slow
def test_a_pulled_joint_is_fitted_again_in_its_frames(blender: ModuleType, done: Any, words: Words, why: Any, tmp_path: Path) -> None:
    """The shape, its skin at rest and the frames' other limbs stay; the keys of the scene's body move, the edited ones with their edits."""
    scene, out = done, tmp_path / "out"
    with pytest.raises(RuntimeError, match="click or pull one first"):
        blender.ops.tricap.fit_again()
    body, kept = scene.objects["Body"], {name: (out / name).read_bytes() for name in ("body.toml", "skin/rest.npz", "trajectories.npz")}
    standing = importlib.import_module(f"{NAME}.scene.standing")
    flexion = body.data["tricap_dofs"]["elbow.R flexion"].to_dict()

    def channel() -> Any:
        return next(
            c
            for c in standing.curves_of(body.animation_data.action)
            if flexion["bone"] in c.data_path and c.array_index == flexion["index"]
        )

    channel().keyframe_points[2].co[1] += 0.5  # an edit of the animator's
    before, was = read_joints(out / "joints.csv"), [channel().evaluate(frame) for frame in range(3)]
    pull = importlib.import_module(f"{NAME}.correcting.pull_joint")
    at = pull.cameras_of(scene)["C"].project(before.joints_m["wrist.R"][1]) + (0.0, 8.0)
    assert blender.ops.tricap.pull_joint(name="wrist.R", view="C", frame=1, x=at[0], y=at[1]) == {"FINISHED"}
    scene.timeline_markers.new("Doubtful 1: right arm guessed", frame=1)
    assert blender.ops.tricap.fit_again() == {"FINISHED"}
    stretches = importlib.import_module(f"{NAME}.scene.contents").doubtful_in(out, [])
    assert [(m.frame, m.name.split(": ")[1]) for m in scene.timeline_markers] == [(first, reason) for first, _, reason in stretches]
    after = read_joints(out / "joints.csv")
    shift = pull.cameras_of(scene)["C"].project(after.joints_m["wrist.R"][1]) - (at - (0.0, 8.0))
    assert shift[1] > 3.0, "towards where it was dragged, against the images"
    assert all((out / name).read_bytes() == content for name, content in kept.items())
    motion = read_motion(out / "motion.csv", read_body(out / "body.toml").skeleton)
    values = motion.values[:, motion.dof_names.index("elbow.R flexion")]
    now = [channel().evaluate(frame) for frame in range(3)]
    assert now[:2] == pytest.approx(values[:2].tolist(), abs=1e-5) and now[2] == pytest.approx(values[2] + 0.5, abs=1e-5) and now != was
    sigmas, own = importlib.import_module(f"{NAME}.editing.uncertainty").sigmas_of(body), after.frame_sigma_m
    wanted = 1e3 * np.maximum(own["elbow.R"], own["wrist.R"])
    assert sigmas["forearm.R"][1] == pytest.approx(wanted, rel=1e-5), "the sigmas are those of a rig that is built anew"
    entry = json.loads((out / "run.json").read_text())["stages"]["fit"]
    assert entry["fitted_again"] == [[0, 2]] and words().split()[5] == "stale", "a whole fit would adjust the shape, too"
    assert why("body").startswith("Frames 0–2 were fitted again to your clicks. Fit Body also adjusts the shape")
    assert why("rig").startswith("The scene plays frames 0–2 as they were fitted again")
    scene.tricap.fitting.gate_m = 0.04
    assert why("body") == "Inputs have changed since this step ran. Run it again."
    assert blender.ops.tricap.fit_again() == {"FINISHED"} and words().split()[5] == "done", "more than clicks has changed: all is fitted"


WRONG = '{"stages": {"fit": {"not_done": "", "fitted_again": [[0]]}}}'


@pytest.mark.parametrize("text", [WRONG, '{"stages": []}', '{"stages": [1]}', '{"settings": []}', '{"stages": {"measure": {"key": 1}}}'])
def test_a_run_json_that_no_run_wrote(
    blender: ModuleType, words: Words, why: Any, sample: Path, results: Path, tmp_path: Path, text: str
) -> None:
    (tmp_path / "out").mkdir()
    opened(blender, sample, tmp_path)
    (tmp_path / "out" / "run.json").write_text(text[:1] + '"format": "tricap-run", "version": 1, ' + text[1:])
    assert words() == "done done done failed empty empty empty empty" and "remove the file and run again" in why("surface")
    with pytest.raises(RuntimeError, match="run.json is damaged"):
        blender.ops.tricap.measure()


def test_a_surface_that_was_left_out_is_no_open_step(blender: ModuleType, done: Any, words: Words, why: Any, tmp_path: Path) -> None:
    path = tmp_path / "out" / "run.json"
    run = json.loads(path.read_text())
    for stage in ("measure", "track"):
        run["stages"][stage] = {"seconds": 0.0, "key": run["stages"][stage]["key"], "not_done": "fitting.use_surface is false"}
    path.write_text(json.dumps(run))
    shutil.rmtree(tmp_path / "out" / "clouds")
    assert words().split()[3:6] == ["done", "done", "done"] and "Skipped" in why("surface")


@pytest.mark.slow
def test_doing_what_is_missing_does_nothing_twice(blender: ModuleType, done: Any, tmp_path: Path, words: Words) -> None:
    run = (tmp_path / "out" / "run.json").stat().st_mtime_ns
    assert blender.ops.tricap.run() == {"FINISHED"} and (tmp_path / "out" / "run.json").stat().st_mtime_ns == run
    image = tmp_path / "take" / "C" / "0001.png"
    written, content = image.stat().st_mtime_ns, image.read_bytes()
    os.utime(image, ns=(written, written + 3_000_000_000))  # as a copy of the project has it
    assert words().split()[3:7] == ["done", "done", "done", "done"]
    image.write_bytes(content[:-20] + bytes(20))  # another one of the same size
    os.utime(image, ns=(written, written + 6_000_000_000))
    assert words().split()[3:7] == ["stale", "stale", "stale", "stale"]
    image.write_bytes(content)
    os.utime(image, ns=(written, written))
    (tmp_path / "out" / "motion.csv").unlink()
    assert words().split()[5] == "ready"
    assert blender.ops.tricap.run() == {"FINISHED"} and (tmp_path / "out" / "motion.csv").exists()


@pytest.mark.slow
def test_a_copy_of_large_footage_is_not_read(
    blender: ModuleType, done: Any, words: Words, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Panel and run would stand still meanwhile; the steps run again, from their checkpoints."""
    from bl_ext.user_default.tricap.core.run import file_digests

    monkeypatch.setattr(file_digests, "MOST_READ", 1000)
    image = tmp_path / "take" / "C" / "0001.png"
    os.utime(image, ns=(1, image.stat().st_mtime_ns + 3_000_000_000))
    assert words().split()[3:7] == ["stale", "stale", "stale", "stale"]
    files = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.ply")}
    assert blender.ops.tricap.run() == {"FINISHED"} and words().split()[3:7] == ["done", "done", "done", "done"]
    now = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.ply")}
    assert files == {path: content for path, content in now.items() if "earlier_body" not in path.parts}
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert not any("content" in stage for stage in run["stages"].values())


def test_objects_and_clips_that_the_user_deleted_or_renamed(blender: ModuleType, done: Any, words: Words, why: Any) -> None:
    scene = done
    body = next(o for o in scene.objects if o.type == "ARMATURE")
    body.name = "Anna"
    scene.tricap.views[1].clip.name = "my film"
    assert words() == "done done done done done done done ready"
    blender.data.objects.remove(body)
    assert words().split()[6] == "stale" and "missing from the scene" in why("rig")
    assert blender.ops.tricap.build_scene() == {"FINISHED"} and words().split()[6] == "done"
    blender.data.movieclips.remove(scene.tricap.views[0].clip)
    assert words().split()[0] == "failed" and "Press Reload Footage" in why("footage")
    with pytest.raises(RuntimeError, match="clip of view L was deleted. Press Reload Footage"):
        blender.ops.tricap.fit()
    assert blender.ops.tricap.reload_footage() == {"FINISHED"}
    assert words() == "done done done done done done done ready"


def test_a_saved_file_opens_with_its_states_and_undo_goes_back(blender: ModuleType, done: Any, words: Words, tmp_path: Path) -> None:
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "again.blend"))
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert words().startswith("empty")
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "again.blend"))
    assert words() == "done done done done done done done ready"
    shutil.move(tmp_path / "take", tmp_path / "hidden")
    assert words().split()[0] == "failed"
    with pytest.raises(RuntimeError, match="does not exist. Move it back, or choose where it is now"):
        blender.ops.tricap.run()


def test_a_step_that_failed_stays_failed_until_its_input_changes(blender: ModuleType, words: Words, why: Any, sample: Path,
                                                                 tmp_path: Path) -> None:  # fmt: skip
    scene = opened(blender, sample, tmp_path)
    blank(tmp_path / "take" / "R")
    with pytest.raises(RuntimeError, match="No surface could be measured"):
        blender.ops.tricap.measure()
    assert words().split()[3] == "failed" and "No surface could be measured in frame 0" in why("surface")
    scene.tricap.matching.patch_px = 17
    assert words().split()[3] == "ready"


def blank(folder: Path) -> None:
    import cv2

    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path)) * 0 + 90)


WRONG = {
    "another size": "was calibrated with images of 640×480 pixels, its footage has 384×288",
    "no camera for a view": "No camera is called R; the calibration has L, C. Press Match Names",
    "no rig at all": "Cannot read the rig",
    "damaged rig": "rig.toml",
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_cameras(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path, kind: str) -> None:
    opened(blender, sample, tmp_path)
    path = tmp_path / "take" / "rig.toml"
    rig = read_rig(path)
    if kind == "another size":
        path.write_text(path.read_text(encoding="utf-8").replace("size = [384, 288]", "size = [640, 480]"), encoding="utf-8")
    elif kind == "no camera for a view":
        write_rig(path, type(rig)(cameras=rig.cameras[:2], metadata={}))
    elif kind == "no rig at all":
        path.unlink()
    else:
        path.write_text("[cam_0", encoding="utf-8")
    assert words().split()[1] == ("ready" if kind == "no rig at all" else "failed") and words().split()[3] == "empty"
    if kind != "no rig at all":
        assert WRONG[kind] in why("cameras")
    with pytest.raises(RuntimeError, match="rig|pixels") as told:
        blender.ops.tricap.run()
    assert "Traceback" not in str(told.value)


def test_wrong_moves_with_footage(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="Save the Blender file first"):
        blender.ops.tricap.add_footage(directory=str(sample))
    (tmp_path / "notes").mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "x.blend"))
    with pytest.raises(RuntimeError, match="holds no footage"):
        blender.ops.tricap.add_footage(directory=str(tmp_path / "notes"))
    (tmp_path / "notes" / "film.mp4").write_bytes(b"no movie")
    with pytest.raises(RuntimeError, match="not a movie that can be decoded"):
        blender.ops.tricap.add_footage(directory=str(tmp_path / "notes"))
    assert not blender.context.scene.tricap.views and not any((tmp_path / "x_tricap").iterdir()), "nothing half made"
    scene = new_project(blender, sample, tmp_path)
    scene.tricap.views[0].offset_frames = 2
    assert words().split()[0] == "failed" and "Press Use Common Frames" in why("footage")
    assert blender.ops.tricap.common_frames() == {"FINISHED"}
    assert words().split()[0] == "done" and why("footage").startswith("3 views, 1 frames")
    scene.tricap.views[1].name = "L"
    assert words().split()[0] == "failed" and "same name" in why("footage")
    scene.tricap.views[1].name = "C"
    scene.tricap.view_index = 2
    assert blender.ops.tricap.remove_view() == {"FINISHED"} and blender.ops.tricap.move_view(up=True) == {"FINISHED"}
    assert [v.name for v in scene.tricap.views] == ["C", "L"]
    (tmp_path / "film" / "C").rename(tmp_path / "film" / "gone")
    assert words().split()[0] == "failed" and "is no longer at" in why("footage")


def test_a_read_only_folder_is_told(blender: ModuleType, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(sample, tmp_path / "film")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "x.blend"))
    monkeypatch.setattr(os, "access", lambda *_: False)  # the tests may be run by root, whom no mode stops
    with pytest.raises(RuntimeError, match="Cannot write into"):
        blender.ops.tricap.add_footage(directory=str(tmp_path / "film"))
    assert not (tmp_path / "x_tricap").exists()


def test_a_click_that_contradicts_itself_is_told_at_its_step(blender: ModuleType, words: Words, why: Any, sample: Path,
                                                             tmp_path: Path) -> None:  # fmt: skip
    scene = opened(blender, sample, tmp_path)
    marker = scene.tricap.views[0].clip.tracking.tracks["wrist.R"].markers[0]
    marker.co = (0.1, 0.1)
    assert words().split()[2] == "failed" and "“wrist.R”" in why("clicks") and "Click the same spot in every view" in why("clicks")
    scene.tricap.fitting.click_sigma_px = 100.0
    assert words().split()[2] == "done"


@pytest.mark.slow
def test_clicks_are_intersected_once(
    blender: ModuleType, states: ModuleType, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not whenever something in the scene changes; again for other clicks and another calibration, and a fault is not forgotten."""
    scene, asked, real = opened(blender, sample, tmp_path), list[str](), states.clicked_depth
    importlib.import_module(f"{NAME}.session").get_session().file.click_problems.clear()
    monkeypatch.setattr(states, "clicked_depth", lambda footage, name, at: asked.append(name) or real(footage, name, at))
    for _ in range(2):
        assert states.compute(scene).states["clicks"].status == "done" and sorted(asked) == ["elbow.R", "shoulder.R", "wrist.R"]
    os.utime(tmp_path / "take" / "rig.toml", ns=(1, 1))
    assert states.compute(scene).states["clicks"].status == "done" and len(asked) == 6
    scene.tricap.views[0].clip.tracking.tracks["wrist.R"].markers[0].co = (0.1, 0.1)
    for _ in range(2):
        found = states.compute(scene).states["clicks"]
        assert found.status == "failed" and "wrist.R" in found.message and asked.count("wrist.R") == 3


@pytest.mark.slow
def test_swapped_views_are_told(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path) -> None:
    scene = opened(blender, sample, tmp_path)
    views = scene.tricap.views
    views[0].images, views[2].images = views[2].images, views[0].images
    views[0].clip, views[2].clip = views[2].clip, views[0].clip
    assert blender.ops.tricap.measure() == {"FINISHED"}
    assert words().split()[3] == "done" and "whether views are swapped" in why("surface")


def test_what_changed_in_take_toml_outside_is_a_choice(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path) -> None:
    scene = opened(blender, sample, tmp_path)
    path = tmp_path / "take" / "take.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("fps = 25.0", "fps = 60.0"), encoding="utf-8")
    assert words().split()[0] == "failed" and "changed outside" in why("footage")
    assert blender.ops.tricap.reload_take() == {"FINISHED"} and scene.tricap.fps == 60.0 and words().split()[0] == "done"
    path.write_text(path.read_text(encoding="utf-8").replace("fps = 60.0", "fps = 70.0"), encoding="utf-8")
    assert blender.ops.tricap.keep_mine() == {"FINISHED"} and read_table(path.parent)["fps"] == 60.0


@pytest.fixture
def layout() -> Iterator[Any]:
    from .layout import Layout

    yield Layout()


@pytest.mark.parametrize("point", ["empty", "opened", "done"])
def test_the_panel_is_drawn_at_every_point(blender: ModuleType, states: ModuleType, layout: Any, sample: Path, tmp_path: Path,
                                           point: str, request: pytest.FixtureRequest) -> None:  # fmt: skip
    if point == "done":
        request.getfixturevalue("done")
    elif point == "opened":
        opened(blender, sample, tmp_path)
    panel = importlib.import_module(f"{NAME}.steps.panel")
    importlib.import_module(f"{NAME}.steps.watch").refresh(blender.context.scene)
    drawn = layout.draw(panel.TRICAP_PT_main, blender.context)
    for n, title in enumerate(states.TITLES, 1):
        assert f"{n}  {title}" in drawn.texts
    assert {"empty": "tricap.open_take", "opened": "tricap.measure", "done": "tricap.export"}[point] in drawn.operators
    assert point == "empty" or drawn.properties.count("model") == {"opened": 2, "done": 1}[point], "the body is shown before the run"
    if point == "done":
        assert "Next: 8 Retarget and Export" in " ".join(drawn.texts) and blender.context.scene.tricap_retarget.source.name == "Body"
        assert drawn.highlighted == [] and blender.ops.tricap.add_robot() == {"FINISHED"}
        assert type(layout)().draw(panel.TRICAP_PT_main, blender.context).highlighted == ["tricap.retarget"], "once there is a target"
        assert drawn.operators.count("tricap.open_views") == 3, "surface, tracks and body can be looked at over the footage"
    elif point == "empty":
        assert " ".join(drawn.texts).count("Save the Blender file first") == 1
        assert drawn.operators[:2] == ["tricap.load_sample", "wm.save_mainfile"]


def test_a_view_through_the_camera_stays_there(blender: ModuleType, done: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the scene is built anew, with another camera."""
    build = importlib.import_module(f"{NAME}.operators.build_scene")
    areas = [area for area in blender.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D"]
    view = areas[0].spaces.active.region_3d
    monkeypatch.setattr(build, "_views", lambda context: [view])
    view.view_perspective = "CAMERA"
    assert blender.ops.tricap.build_scene() == {"FINISHED"} and view.view_perspective == "CAMERA"


def test_results_that_can_hardly_be_right_are_called_doubtful(
    blender: ModuleType, why: Any, done: Any, layout: Any, tmp_path: Path
) -> None:
    panel, path = importlib.import_module(f"{NAME}.steps.panel"), tmp_path / "out" / "run.json"
    run = json.loads(path.read_text())
    assert "doubtful " not in type(layout)().draw(panel.TRICAP_PT_main, blender.context).texts
    run["stages"]["measure"]["residual_px"], run["stages"]["track"]["trajectories"] = 1.4, 0
    run["stages"]["fit"]["limbs"] = {"right arm": {"guessed": 2, "seen": 1}}
    path.write_text(json.dumps(run))
    assert "Rays miss each other by 1.4 px" in why("surface") and why("tracks").startswith("No trajectory is left after the filters")
    texts = type(layout)().draw(panel.TRICAP_PT_main, blender.context).texts
    assert texts.count("doubtful ") == 3 and "Doubtful: 4 Surface, 5 Tracks, 6 Body. Unfold them for the reason." in " ".join(texts)


def test_everything_is_offered_only_when_nothing_else_is_next(blender: ModuleType, layout: Any, sample: Path, tmp_path: Path) -> None:
    panel, watch = (importlib.import_module(f"{NAME}.steps.{name}") for name in ("panel", "watch"))
    scene = opened(blender, sample, tmp_path)
    offered, highlighted = [], []
    for model in ("arm.R", "leg.L", "none"):  # clicked; not clicked; no clicks needed
        scene.tricap.model = model
        watch.refresh(scene)
        drawn = type(layout)().draw(panel.TRICAP_PT_main, blender.context)
        offered.append("tricap.run" in drawn.operators)
        highlighted.append(drawn.highlighted)
    assert offered == [True, False, True]
    assert highlighted == [["tricap.run"], ["tricap.click_joints"], ["tricap.run"]], "one button is the next one to press"


def test_the_report_is_opened_in_the_browser(blender: ModuleType, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also from a folder whose name is no URL; without a report, what makes one is named."""
    opened(blender, sample, tmp_path).tricap.out = str(tmp_path / "mes résultats #1")
    shown: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url, *rest: shown.append(url))
    with pytest.raises(RuntimeError, match="no report yet: it is written at the end of Fit Body"):
        blender.ops.tricap.open_report()
    page = tmp_path / "mes résultats #1" / "report" / "report.html"
    page.parent.mkdir(parents=True)
    page.write_text("<h1>report</h1>")
    assert blender.ops.tricap.open_report() == {"FINISHED"} and shown == [page.as_uri()] and "%231" in shown[0]


def test_the_untouched_cube_makes_room(blender: ModuleType) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    aside, said = importlib.import_module(f"{NAME}.operators.build_scene"), []
    operator = SimpleNamespace(report=lambda kind, words: said.append(words))

    def hidden(**change: Any) -> bool:
        blender.ops.mesh.primitive_cube_add()
        cube = blender.context.object
        for name, value in change.items():
            setattr(cube, name, value)
        blender.context.view_layer.update()
        aside.hide_default_objects(operator, blender.context)
        found = bool(cube.hide_get())
        assert cube.hide_render == found
        blender.data.objects.remove(cube)
        return found

    assert hidden() and len(said) == 1 and "Cube" not in blender.data.objects
    assert not hidden(location=(0, 0, 1)) and not hidden(name="House") and len(said) == 1


def test_changes_by_scripts_and_by_dragging_are_noticed(blender: ModuleType, words: Words, sample: Path, tmp_path: Path) -> None:
    watch = importlib.import_module(f"{NAME}.steps.watch")
    scene = opened(blender, sample, tmp_path)
    marker = scene.tricap.views[0].clip.tracking.tracks["elbow.R"].markers[0]
    changes = [lambda: setattr(scene.tricap.fitting, "gate_m", 0.05), lambda: setattr(scene.tricap, "fps", 50.0),
               lambda: setattr(scene.tricap.views[0], "offset_frames", 1), lambda: setattr(marker, "co", (0.5, 0.5)),
               lambda: os.utime(tmp_path / "take" / "rig.toml", (1, 1))]  # fmt: skip
    for change in changes:
        watch.refresh(scene)
        known = watch.current(scene)
        assert watch._tick() == watch.TICK_S and watch.current(scene) is known, "nothing changed: nothing is computed"
        change()
        blender.context.view_layer.update()
        watch._tick()
        assert watch.current(scene) is not known


def test_a_calibration_in_the_folder_of_the_footage_is_used(
    blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path, capfd: Any
) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    shutil.copytree(sample, tmp_path / "film")
    (tmp_path / "film" / "take.toml").unlink()
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert blender.ops.tricap.add_footage(directory=str(tmp_path / "film")) == {"FINISHED"}
    assert words().startswith("done done") and blender.context.scene.camera.name == "Camera C"
    write_rig(tmp_path / "film" / "rig.toml", renamed(read_rig(tmp_path / "film" / "rig.toml"), {"L": "R", "R": "L"}))
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "turned.blend"))
    capfd.readouterr()
    assert blender.ops.tricap.add_footage(directory=str(tmp_path / "film")) == {"FINISHED"}
    said = capfd.readouterr().out
    assert said.count("from left to right") == 1 and "from left to right: R, C, L." in said, "the order is that of the cameras"
    (tmp_path / "film" / "rig.toml").write_text("damaged")
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    assert blender.ops.tricap.add_footage(directory=str(tmp_path / "film")) == {"FINISHED"}
    assert words().startswith("done ready") and not (tmp_path / "other_tricap" / "rig.toml").exists()


def test_the_rate_of_images_is_asked_for(blender: ModuleType, why: Any, sample: Path, tmp_path: Path) -> None:
    shutil.copytree(sample, tmp_path / "film")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert blender.ops.tricap.add_footage(directory=str(tmp_path / "film"), fps=120.0) == {"FINISHED"}
    assert blender.context.scene.tricap.fps == 120.0 and why("footage").endswith("120 fps.")


def test_the_remaining_steps_are_run_from_the_views(
    blender: ModuleType, sample: Path, layout: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside Back to Steps above the first view, where a run can begin; the operator goes back first."""
    views, watch = (importlib.import_module(f"{NAME}.{name}") for name in ("clicking.open_views", "steps.watch"))
    scene, window = opened(blender, sample, tmp_path), blender.context.window_manager.windows[0]
    area = max(window.screen.areas, key=lambda area: area.width * area.height)
    area.type = "CLIP_EDITOR"
    area.spaces.active.clip = scene.tricap.views[0].clip
    session, offered = importlib.import_module(f"{NAME}.session").get_session(), []
    check, stage = (SimpleNamespace(job=object(), gives_way=gives_way) for gives_way in (True, False))
    for name, job_operator in (("Mine", None), (views.NAME, None), (views.NAME, check), (views.NAME, stage)):
        window.workspace.name = name
        assert watch.refresh(scene).can_run
        monkeypatch.setattr(session, "job_operator", job_operator)
        with blender.context.temp_override(window=window, area=area):
            header = SimpleNamespace(layout=type(layout)())
            views.draw_back(header, blender.context)
            offered.append(header.layout.operators)
    monkeypatch.undo()
    both = ["tricap.back_to_steps", "tricap.back_to_steps"]
    assert offered == [[], both, both, ["tricap.back_to_steps"]], "also while a check runs, which gives way; not during another job"
    (tmp_path / "take" / "rig.toml").unlink()
    with pytest.raises(RuntimeError, match=r"rig\.toml"):  # it runs
        blender.ops.tricap.back_to_steps(run=True)
    assert not watch.refresh(scene).can_run


def test_an_assumed_rate_is_shown_beside_the_button_that_runs(
    blender: ModuleType, sample: Path, layout: Any, why: Any, tmp_path: Path
) -> None:
    """Step 1 is done and folded then, and nobody would see it there."""
    watch, panel = (importlib.import_module(f"{NAME}.steps.{name}") for name in ("watch", "panel"))
    shutil.copytree(sample, tmp_path / "film")
    (tmp_path / "film" / "take.toml").unlink()
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert blender.ops.tricap.add_footage(directory=str(tmp_path / "film")) == {"FINISHED"}
    count = []
    for _ in range(2):
        assert watch.refresh(blender.context.scene).next == "surface"
        count.append(type(layout)().draw(panel.TRICAP_PT_main, blender.context).properties.count("fps"))
        blender.context.scene.tricap.fps = blender.context.scene.tricap.fps  # entered, although it is the same
    assert count[0] == count[1] + 1 and "assumed" not in why("footage")


def recorded_at_30(sample: Path, folder: Path) -> Path:
    """A take at 30 images a second, of which the right camera started one image earlier; its views are listed from right to left."""
    shutil.copytree(sample, folder)
    table = read_table(folder)
    views = [{**view, **({"offset_frames": 1} if view["name"] == "R" else {})} for view in reversed(table["views"])]
    write_table(folder, {**table, "fps": 30.0, "interlaced": "odd", "views": views, "frames": [0, 2]})
    return folder


@pytest.mark.parametrize("chosen", [[], [{"name": name} for name in ("take.toml", "L", "C", "R")]])
def test_a_take_brings_its_values_with_its_footage(
    blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path, chosen: list[Any]
) -> None:
    film = recorded_at_30(sample, tmp_path / "film")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert blender.ops.tricap.add_footage(directory=str(film), files=chosen) == {"FINISHED"}
    scene, made = blender.context.scene, read_table(tmp_path / "shot_tricap")
    assert made == read_table(film) and scene.tricap.fps == 30.0 and scene.tricap.interlaced == "odd"
    assert [(view.name, view.offset_frames) for view in scene.tricap.views] == [("R", 1), ("C", 0), ("L", 0)]
    assert words().startswith("done done done") and why("footage").endswith("30 fps.")
    assert (tmp_path / "shot_tricap" / "rig.toml").read_bytes() == (film / "rig.toml").read_bytes()
    scene.tricap.views[0].offset_frames = 0
    assert blender.ops.tricap.keep_mine() == {"FINISHED"} and read_table(film)["views"][0]["offset_frames"] == 1, (
        "the recording stays as it is"
    )


def test_a_part_of_a_take_is_footage_alone(blender: ModuleType, sample: Path, tmp_path: Path) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    film = recorded_at_30(sample, tmp_path / "film")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert blender.ops.tricap.add_footage(directory=str(film), files=[{"name": "L"}, {"name": "C"}]) == {"FINISHED"}
    assert [view.name for view in blender.context.scene.tricap.views] == ["L", "C"] and blender.context.scene.tricap.fps == 25.0


def test_moved_footage_is_found_again(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path) -> None:
    scene = new_project(blender, sample, tmp_path)
    assert blender.ops.tricap.click(name="elbow.R", view="L", x=100, y=100) == {"FINISHED"}
    (tmp_path / "film").rename(tmp_path / "other film")
    assert words().startswith("failed") and why("footage").endswith("Move it back, or press Find Footage.")
    assert str(tmp_path / "film" / "L") in why("footage"), "where it was, not the link in the project"
    with pytest.raises(RuntimeError, match="does not contain L, C, R"):
        blender.ops.tricap.find_footage(directory=str(tmp_path / "shot_tricap"))
    assert blender.ops.tricap.find_footage(directory=str(tmp_path / "other film")) == {"FINISHED"}
    assert words().startswith("done") and len(scene.tricap.views) == 3
    clip = scene.tricap.views[0].clip
    assert "elbow.R" in clip.tracking.tracks and clip.size[0] == 384


def test_while_a_run_goes_on_its_finished_steps_are_seen(blender: ModuleType, words: Words, sample: Path, tmp_path: Path,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    watch, jobs, session = (importlib.import_module(f"{NAME}.{name}") for name in ("steps.watch", "jobs", "session"))
    scene = opened(blender, sample, tmp_path)
    monkeypatch.setattr(session.get_session(), "job_operator", SimpleNamespace(job=jobs.Job(lambda monitor: None)))
    known = watch.refresh(scene)
    watch.mark()
    watch._tick()
    assert watch.current(scene) is known, "a run is not disturbed by what happens in the scene"
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text("{}")
    watch._tick()
    assert watch.current(scene) is not known


@pytest.mark.slow
def test_a_run_goes_through_the_steps_from_top_to_bottom(
    blender: ModuleType, states: ModuleType, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = importlib.import_module(f"{NAME}.jobs")
    seen, plain = [], jobs.Job._note

    def noting(self: Any, stage: str, done: float, total: float) -> None:
        plain(self, stage, done, total)
        seen.append(self.step)

    monkeypatch.setattr(jobs.Job, "_note", noting)
    opened(blender, sample, tmp_path)
    assert blender.ops.tricap.run() == {"FINISHED"}
    assert [step for step, _ in groupby(seen)] == ["surface", "tracks", "body", "rig"]


def test_undo_and_redo_take_the_states_along(blender: ModuleType, words: Words, sample: Path, tmp_path: Path) -> None:
    opened(blender, sample, tmp_path)
    blender.ops.ed.undo_push(message="opened")
    assert words().split()[0] == "done"
    blender.context.scene.tricap.views[0].offset_frames = 1
    blender.ops.ed.undo_push(message="shifted")
    assert words().split()[0] == "failed"
    blender.ops.ed.undo()
    assert words().split()[0] == "done" and blender.context.scene.tricap.views[0].offset_frames == 0
    blender.ops.ed.redo()
    assert words().split()[0] == "failed"
    blender.ops.ed.undo()
    assert blender.ops.tricap.measure.poll()


def test_a_scene_appended_to_another_file_brings_its_project(blender: ModuleType, words: Words, sample: Path, tmp_path: Path) -> None:
    opened(blender, sample, tmp_path)
    blend = tmp_path / "one.blend"
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    blender.ops.wm.append(directory=f"{blend}/Scene/", filename="Scene")
    blender.context.window.scene = next(scene for scene in blender.data.scenes if len(scene.tricap.views))
    assert words() == "done done done ready empty empty empty empty"
    blender.context.scene.name = "Kick"
    assert words().startswith("done done done ready")


def test_the_check_is_kept_until_its_input_changes(blender: ModuleType, words: Words, layout: Any, sample: Path, tmp_path: Path) -> None:
    check, panel = (importlib.import_module(f"{NAME}.steps.{name}") for name in ("check", "panel"))
    scene = opened(blender, sample, tmp_path)
    assert blender.ops.tricap.check() == {"FINISHED"}
    said = scene.tricap.check_said.splitlines()
    words()
    assert said and said[0].split()[0] in " ".join(layout.draw(panel.TRICAP_PT_main, blender.context).texts)
    assert "tricap.mend_offsets" not in type(layout)().draw(panel.TRICAP_PT_main, blender.context).operators
    mends = importlib.import_module(f"{NAME}.session").get_session().file.mends
    mends[scene.tricap.check_key] = check.Mends(late_frames={"L": 0, "C": 0, "R": 1})
    assert "tricap.mend_offsets" in type(layout)().draw(panel.TRICAP_PT_main, blender.context).operators
    assert blender.ops.tricap.mend_offsets() == {"FINISHED"}
    assert [view.offset_frames for view in scene.tricap.views] == [0, 0, -1]
    assert not blender.ops.tricap.mend_offsets.poll() or scene.tricap.check_key in mends


def test_the_panel_names_buttons_and_settings_instead_of_files_and_options(blender: ModuleType) -> None:
    check = importlib.import_module(f"{NAME}.steps.check")
    findings = importlib.import_module(f"{NAME.removesuffix('.addon')}.core.checking.findings")
    cause = findings.Cause
    late = findings.wrong(cause.NOT_SYNCHRONISED, "View R is late.", "Add -1 to `offset_frames` of view R in take.toml.", view="R")
    weak = findings.doubtful(cause.WEAK_TEXTURE, "Poor.", "Use more light; or try --set matching.patch_px=21.")
    half = findings.doubtful(cause.NOT_SYNCHRONISED, "View C is late.", "Use --set timing.correct=true, which helps.", view="C")
    checked = findings.Checked(subject="kick", kind="take", findings=(late, weak, half), figures={})
    assert check.in_panel(checked, check.Mends(late_frames={"R": 1, "C": 0})) == [
        "Wrong: View R is late. Press Set Offsets, and check again.",
        "Doubtful: Poor. Use more light; or try Patch [px] 21 (step 4 Surface).",
        "Doubtful: View C is late. Use Correct true (step 4 Surface), which helps.",
    ]
    assert "offset_frames" in check.in_panel(checked, check.Mends())[0], "without a button the file is named"
    remarked = findings.Checked(subject="kick", kind="take", findings=(), figures={}, notes=("Note: a frame is repeated.",))
    assert check.in_panel(remarked, check.Mends()) == [check.GOOD, "Note: a frame is repeated."]


@pytest.mark.parametrize("step", ["surface", *(pytest.param(name, marks=pytest.mark.slow) for name in ("tracks", "fit"))])
def test_stopping_at_each_stage_says_what_is_kept_and_goes_on(
    blender: ModuleType, words: Words, why: Callable[[str], str], sample: Path, tmp_path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After Esc, the panel too says how far the stopped step came, until its input changes or it is done."""
    jobs = importlib.import_module(f"{NAME}.jobs")
    opened(blender, sample, tmp_path).tricap.growing.spacing_px = 10
    plain = jobs.Job._note

    def stopping(self: Any, stage: str, done: float, total: float) -> None:
        plain(self, stage, done, total)
        if stage.startswith(step) and done >= 1:
            self.monitor.cancel()

    with monkeypatch.context() as patch:
        patch.setattr(jobs.Job, "_note", stopping)
        assert blender.ops.tricap.fit() == {"CANCELLED"}
    assert "failed" not in words() and words().startswith("done done done")
    kept = {"surface": "the surface of 1 of 3 frames is kept", "tracks": "the surface of all frames is kept", "fit": "surface and tracks"}
    panel = {"surface": "surface", "tracks": "tracks", "fit": "body"}[step]
    assert kept[step] in why(panel) and "run it again to go on" in why(panel)
    blender.context.scene.tricap.growing.spacing_px = 11
    assert "kept" not in why(panel)


def test_time_left(blender: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = importlib.import_module(f"{NAME}.jobs")
    clock = [100.0]
    monkeypatch.setattr(jobs.time, "monotonic", lambda: clock[0])
    job = jobs.Job(lambda monitor: None)
    assert job.seconds_left is None
    for done in range(6):
        job._note("surface", done, 20)
        clock[0] += 2.0
    assert job.seconds_left == pytest.approx(15 * 2 - 2)
    clock[0] += 20.0
    assert job.seconds_left == pytest.approx(8), "it does not grow while nothing is heard"
    clock[0] += 20.0
    assert job.seconds_left is None and job.left_text == "", "nothing is told once it is over"
    job._note("tracks", 0, 20)
    assert job.seconds_left is None, "another stage, another pace"
    clock[0] += 5.0
    job._note("tracks", 0.04, 20)
    assert job.seconds_left is None, "how the first frame begins says nothing of the others"
    job.monitor.course = SimpleNamespace(fraction=0.25, seconds_left=40.0)
    assert job.fraction == 0.25 and job.left_text == "40 s left", "of the whole run"
    assert [jobs.time_text(s) for s in (40.2, 100, 3600, 7260)] == ["40 s", "2 min", "60 min", "2 h 1 min"]


@pytest.mark.slow
def test_the_script_in_the_readme_runs(blender: ModuleType, words: Words, sample: Path, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    script = next(part for part in text.split("```python\n")[1:] if "add_footage" in part).split("```")[0]
    shutil.copytree(sample, tmp_path / "films" / "kick")
    (tmp_path / "films" / "kick" / "take.toml").unlink()
    shutil.copytree(sample, tmp_path / "takes" / "jump")
    exec(script.replace('"/films', f'"{tmp_path}/films').replace('"/takes', f'"{tmp_path}/takes'), {})
    assert words().startswith("done done done done done empty")
    assert (tmp_path / "takes" / "jump_out" / "trajectories.npz").exists()


def test_both_fields_are_shown_one_by_one(blender: ModuleType, why: Callable[[str], str], sample: Path, tmp_path: Path) -> None:
    """Clips get twice the frames, clicks and frames other numbers; and back again."""
    scene = opened(blender, sample, tmp_path)
    project = importlib.import_module(f"{NAME}.project")
    before, folder = read_table(tmp_path / "take"), tmp_path / "take"
    scene.tricap.interlaced = "both"
    assert "Press Reload Footage" in why("footage")
    with pytest.raises(project.InputError, match="Press Reload Footage"):
        project.write(scene)
    assert read_table(folder) == before and blender.ops.tricap.reload_footage() == {"FINISHED"}
    clip = scene.tricap.views["C"].clip
    assert clip.frame_duration == 6 and tuple(clip.size) == (384, 288)
    assert why("footage") == "3 views, 6 frames of 384×288 pixels, 50 fps."
    said = read_table(folder)
    assert said["interlaced"] == "both" and said["seeds"]["joints"] == before["seeds"]["joints"] and said["fps"] == before["fps"]
    scene.tricap.views["C"].offset_frames = 1
    assert clip.frame_start == -2
    scene.tricap.views["C"].offset_frames, scene.tricap.interlaced = 0, "odd"
    assert blender.ops.tricap.reload_footage() == {"FINISHED"} and scene.tricap.views["C"].clip.frame_duration == 3
    assert read_table(folder) == {**before, "interlaced": "odd", "settings": QUICK | before["settings"]}


@pytest.fixture(scope="module")
def built(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a take, and results of two of its frames, with other settings, as `tricap run` writes them: with body.blend."""
    folder = tmp_path_factory.mktemp("built")
    shutil.copytree(sample, folder / "take")
    chosen = [f"--set={knob}" for knob in ("growing.spacing_px=12", "skin.relief=false", "skin.texture_px=0", "skin.contours=6")]
    assert main(["run", str(folder / "take"), "--out", str(folder / "out"), "--frames", "0:2", *chosen, "--quiet"]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("moved", ["nothing", "results", "results and take"])
def test_the_commands_scene_shows_the_finished_project(
    blender: ModuleType, built: Path, tmp_path: Path, words: Words, why: Any, moved: str
) -> None:
    folder = tmp_path if "results" in moved else built
    for name in ("out", "take"):
        if ("results", "take")[name == "take"] in moved:
            shutil.copytree(built / name, tmp_path / name)
    take = (folder if (folder / "take").exists() else built) / "take"
    before = {path: path.stat().st_mtime_ns for path in take.rglob("*")}
    assert blender.ops.wm.open_mainfile(filepath=str(folder / "out" / "body.blend")) == {"FINISHED"}
    assert words() == "done done done done done done done ready", why("footage")
    scene = blender.context.scene
    assert Path(blender.path.abspath(scene.tricap.take)).resolve() == take
    assert Path(blender.path.abspath(scene.tricap.out)).resolve() == folder / "out"
    assert (scene.tricap.growing.spacing_px, scene.tricap.first_frame, scene.tricap.last_frame) == (12, 0, 1)
    assert (scene.tricap.skin.relief, scene.tricap.skin.texture_px, scene.tricap.skin.contours) == (False, 0, 6)
    assert scene.tricap_retarget.source.name == scene.tricap_retarget.export.name == "Body"
    clips = {view.clip for view in scene.tricap.views}
    assert clips == set(blender.data.movieclips) and len(clips) == 3, "those behind the cameras are used"
    shown = {Path(blender.path.abspath(clip.filepath)).resolve() for clip in clips}
    assert all(file.is_file() and file.is_relative_to(take) for file in shown) and {clip.size[0] for clip in clips} == {384}
    assert before == {path: path.stat().st_mtime_ns for path in take.rglob("*")}, "opening a file writes nothing"


@pytest.mark.slow
def test_a_scene_whose_take_is_gone_says_so(blender: ModuleType, built: Path, tmp_path: Path, words: Words, why: Any) -> None:
    lost = (built / "take").rename(built / "renamed")
    try:
        blender.ops.wm.open_mainfile(filepath=str(built / "out" / "body.blend"))
        assert words().endswith("empty empty empty done ready") and why("footage").endswith("Press Open Take and choose where it is now.")
        assert blender.ops.tricap.open_take(directory=str(lost)) == {"FINISHED"}
        scene = blender.context.scene.tricap
        scene.growing.spacing_px, scene.all_frames, scene.last_frame = 12, False, 1
        scene.skin.relief, scene.skin.texture_px, scene.skin.contours = False, 0, 6
        assert words() == "done done done done done done done ready"
    finally:
        lost.rename(built / "take")


def test_what_the_check_finds_is_mended_by_a_press(blender: ModuleType, words: Words, why: Any, sample: Path, tmp_path: Path) -> None:
    """Cameras with foreign names are matched as they are imported; swapped ones and interlaced footage by a button."""
    scene = opened(blender, sample, tmp_path)
    path = tmp_path / "take" / "rig.toml"
    true = {camera.name: camera.t_cam_world_m for camera in read_rig(path).cameras}
    foreign = tmp_path / "foreign.toml"
    write_rig(foreign, renamed(read_rig(path), {"L": "cam_0", "C": "cam_1", "R": "cam_2"}))
    assert blender.ops.tricap.cameras_from_file(filepath=str(foreign)) == {"FINISHED"}
    assert {camera.name: camera.t_cam_world_m.tolist() for camera in read_rig(path).cameras} == {n: t.tolist() for n, t in true.items()}
    write_rig(path, renamed(read_rig(path), {"L": "cam_0"}))
    assert words().split()[1] == "failed" and blender.ops.tricap.match_names() == {"FINISHED"}
    assert words().split()[1] == "done"
    write_rig(path, renamed(read_rig(path), {"L": "C", "C": "L"}))
    words()
    assert blender.ops.tricap.check() == {"FINISHED"} and "are swapped" in scene.tricap.check_said
    assert blender.ops.tricap.match_names() == {"FINISHED"}
    assert {camera.name: camera.t_cam_world_m.tolist() for camera in read_rig(path).cameras} == {n: t.tolist() for n, t in true.items()}
    assert not blender.ops.tricap.set_fields.poll()
    words()
    check, session = (importlib.import_module(f"{NAME}.{name}") for name in ("steps.check", "session"))
    session.get_session().file.mends[scene.tricap.check_key] = check.Mends(first_field="even")
    assert blender.ops.tricap.set_fields() == {"FINISHED"}
    assert (scene.tricap.interlaced, scene.tricap.first_field) == ("both", "even") and scene.frame_end == 5


def test_the_check_begins_by_itself_once_for_each_input(blender: ModuleType, words: Words, sample: Path, tmp_path: Path) -> None:
    check, session = (importlib.import_module(f"{NAME}.{name}") for name in ("steps.check", "session"))
    scene = opened(blender, sample, tmp_path)
    words()
    assert check.should_begin(scene)
    session.get_session().file.changed = True
    assert not check.should_begin(scene), "the user is still typing"
    words()
    session.get_session().file.checked_keys.add(importlib.import_module(f"{NAME}.steps.watch").current(scene).keys["measure"])
    assert not check.should_begin(scene)
