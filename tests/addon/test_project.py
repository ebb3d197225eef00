"""The project: take.toml and the scene say the same, exactly, whichever was first; nothing is written in vain or over somebody's change."""

import importlib
import shutil
from pathlib import Path
from types import ModuleType

import pytest

from tricap.core.body.model_file import MODELS
from tricap.core.take.writing import read_table, take_of_table, write_table

from .conftest import small_rig, write_take

CLICKS = {
    "seeds": {"frame": 3, "surface": [{"L": [20.5, 30.0], "C": [21.0, 31.123456789]}],
              "joints": {"elbow.R": {"L": [61.2, 80.5], "R": [59.13, 79.0]}, "wrist.R": {"C": [100.0, 0.0], "R": [190.5, 143.25]}}},
    "keyframes": [{"frame": 6, "joints": {"elbow.R": {"L": [70.7, 80.1], "C": [71.9, 80.0]}}}],
    "settings": {"matching": {"patch_px": 17}, "growing": {"spacing_px": 6}},
}  # fmt: skip


@pytest.fixture
def project(blender: ModuleType) -> ModuleType:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return importlib.import_module("bl_ext.user_default.tricap.addon.project")


@pytest.fixture
def clicks(project: ModuleType) -> ModuleType:
    return importlib.import_module("bl_ext.user_default.tricap.addon.clicks")


@pytest.fixture
def take(tmp_path: Path) -> Path:
    folder = tmp_path / "swing é"
    write_take(folder, small_rig())
    table = read_table(folder)
    table["views"][0]["offset_frames"] = 2
    table["frames"] = [0, 6]
    write_table(folder, table | CLICKS)
    return folder


def test_a_take_goes_into_the_scene_and_out_exactly(project: ModuleType, blender: ModuleType, take: Path) -> None:
    scene = blender.context.scene
    before = (take / "take.toml").read_text(encoding="utf-8")
    project.open_take(scene, take)
    assert [v.name for v in scene.tricap.views] == ["L", "C", "R"] and scene.tricap.seed_frame == 3
    assert scene.tricap.matching.patch_px == 17 and scene.tricap.model == "arm.R" and scene.tricap.last_frame == 5
    assert project.table(scene) == read_table(take)
    assert project.write(scene) == take and (take / "take.toml").read_text(encoding="utf-8") == before, "nothing changed: not rewritten"
    (take / "take.toml").unlink()
    project.write(scene)
    again = read_table(take)
    assert again["seeds"]["joints"] == CLICKS["seeds"]["joints"] and again["keyframes"] == CLICKS["keyframes"]
    project.open_take(scene, take)
    assert project.table(scene) == again


def test_clicks_lie_where_the_image_shows_them(project: ModuleType, clicks: ModuleType, blender: ModuleType, take: Path) -> None:
    scene = blender.context.scene
    project.open_take(scene, take)
    clip = project.clips_of(scene)["L"]  # its image of take frame 3 is number 5, the clip's own 6
    assert clip.frame_start == -2 and clip["tricap_view"] == "L"
    marker = clip.tracking.tracks["elbow.R"].markers.find_frame(6)
    assert marker.co[:] == pytest.approx([(61.2 + 0.5) / 192, 1 - (80.5 + 0.5) / 144], abs=1e-6)
    clicks.set_click(clip, "elbow.R", 3, (62.0, 81.0))
    assert project.table(scene)["seeds"]["joints"]["elbow.R"] == {"L": [62.0, 81.0], "R": [59.13, 79.0]}
    marker.co = (0.5, 0.5)  # as by dragging
    assert clicks.get_click(clip, "elbow.R", 3) == [95.5, 71.5]
    assert clicks.remove_click(clip, "elbow.R", 3) and not clicks.remove_click(clip, "elbow.R", 3)
    assert clicks.remove_click(clip, "elbow.R", 6) and len(clip.tracking.tracks["elbow.R"].markers) == 1, "the last one is only disabled"
    assert clicks.get_click(clip, "elbow.R", 6) is None and clicks.clicked_frames(clip) == {3}
    clicks.set_click(clip, "elbow.R", 4, (1.0, 2.0))
    assert [(m.frame, m.mute) for m in clip.tracking.tracks["elbow.R"].markers] == [(6, True), (7, False), (8, True)]


def test_clicks_are_shown_in_their_frames_alone(project: ModuleType, clicks: ModuleType, blender: ModuleType, take: Path) -> None:
    """Blender draws the marker that `find_frame` finds, unless it is disabled."""
    project.open_take(blender.context.scene, take)
    clip = project.clips_of(blender.context.scene)["L"]
    clicks.clear(clip)

    def shown() -> list[int]:
        markers = clip.tracking.tracks["elbow.R"].markers
        return [frame for frame in range(-2, 9) if not markers.find_frame(clicks.clip_frame(clip, frame), exact=False).mute]

    for frames, change in (
        ([3], lambda: clicks.set_click(clip, "elbow.R", 3, (62.0, 81.0))),
        ([3, 5], lambda: clicks.set_click(clip, "elbow.R", 5, (63.0, 82.0))),
        ([3, 4, 5], lambda: clicks.set_click(clip, "elbow.R", 4, (64.0, 83.0))),
        ([4, 5], lambda: clicks.remove_click(clip, "elbow.R", 3)),
        ([4], lambda: clicks.remove_click(clip, "elbow.R", 5)),
        ([], lambda: clicks.remove_click(clip, "elbow.R", 4)),
        ([-2], lambda: clicks.set_click(clip, "elbow.R", -2, (62.0, 81.0))),  # the first image
    ):
        change()
        assert shown() == frames == sorted(frame for frame in clicks.clicked_frames(clip))
    assert clicks.get_click(clip, "elbow.R", -2) == [62.0, 81.0]


def test_what_the_panel_does_not_edit_stays(project: ModuleType, blender: ModuleType, take: Path) -> None:
    scene = blender.context.scene
    extra = {"corrections": [{"kind": "trajectory", "view": "C", "frame": 4, "xy": [1.5, 2.5]}],
             "body": {"model": "arm.R", "locked": ["elbow.R twist"], "limits": {"elbow.R flexion": [0.0, 120.0]}}}  # fmt: skip
    views = [view | ({"mask": "mask.png"} if view["name"] == "C" else {}) for view in read_table(take)["views"]]
    write_table(take, read_table(take) | extra | {"views": views})
    project.open_take(scene, take)
    scene.tricap.fps = 50.0
    project.write(scene)
    said = read_table(take)
    assert said["fps"] == 50.0 and {k: said[k] for k in extra} == extra and said["views"] == views
    project.edit(scene, lambda table: table["body"].update(locked=[]))
    assert read_table(take)["body"]["locked"] == []
    with pytest.raises(project.InputError, match="must be a table"):
        project.edit(scene, lambda table: table.update(body=3))
    assert read_table(take)["body"]["model"] == "arm.R"


def test_masks_and_backgrounds_of_the_views(project: ModuleType, blender: ModuleType, take: Path, tmp_path: Path) -> None:
    import cv2
    import numpy as np

    scene, ops = blender.context.scene, blender.ops.tricap
    project.open_take(scene, take)
    size = tuple(scene.tricap.views[0].clip.size)
    (tmp_path / "painted").mkdir()
    for name, shape in (("person.png", size[::-1]), ("painted/0.png", size[::-1]), ("small.png", (8, 8))):
        cv2.imwrite(str(tmp_path / name), np.full(shape, 255, np.uint8))

    def said() -> list[dict[str, str]]:
        return [{k: v for k, v in view.items() if k in ("mask", "masks", "background")} for view in read_table(take)["views"]]

    assert ops.person_from(kind="mask", view="L", filepath=str(tmp_path / "person.png")) == {"FINISHED"}
    assert ops.person_from(kind="masks", view="C", filepath=str(tmp_path / "painted" / "0.png")) == {"FINISHED"}
    scene.tricap.view_index = 2
    assert ops.person_from(kind="background", filepath=str(tmp_path / "person.png")) == {"FINISHED"}
    assert said() == [{"mask": "L_mask.png"}, {"masks": "C_masks/*.png"}, {"background": "R_background.png"}]
    assert (take / "C_masks" / "0.png").exists() and [view.person for view in scene.tricap.views] == ["mask", "masks", "background"]
    scene.tricap.views[0].name = "left"
    project.write(scene)
    assert said()[0] == {"mask": "L_mask.png"}, "a view keeps its mask under another name"
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros(size[::-1], np.uint8))
    assert ops.person_from(kind="background", filepath=str(other)) == {"FINISHED"} and said()[2] == {"background": "R_background_2.png"}
    assert ops.person_from(kind="none", view="C") == {"FINISHED"} and said()[1] == {}
    for wrong, why in (("small.png", "8×8 pixels"), ("none.png", "none.png")):
        with pytest.raises(RuntimeError, match=why):
            ops.person_from(kind="mask", view="C", filepath=str(tmp_path / wrong))
    with pytest.raises(RuntimeError, match="no view “X”"):
        ops.person_from(kind="mask", view="X", filepath=str(other))
    assert said()[1] == {}


def test_a_model_of_ones_own_tells_which_joints_to_click(project: ModuleType, blender: ModuleType, take: Path) -> None:
    own = (MODELS / "arm.R.toml").read_text(encoding="utf-8")
    (take / "my arm é.toml").write_text(own, encoding="utf-8")
    write_table(take, read_table(take) | {"body": {"model": "my arm é.toml"}})
    project.open_take(blender.context.scene, take)
    assert blender.context.scene.tricap.model == "own"
    bodies = importlib.import_module("bl_ext.user_default.tricap.addon.steps.bodies")
    assert [name for name, _ in bodies.clicked_views(blender.context)] == ["shoulder.R", "elbow.R", "wrist.R"]


def test_no_body_is_read_and_written(project: ModuleType, blender: ModuleType, take: Path) -> None:
    """The panel writes that no body is wanted; a file that says nothing of a body stays as it is: what is seen decides."""
    scene = blender.context.scene
    without = {key: value for key, value in read_table(take).items() if key != "body"}
    for said, shown, then in ((without, "auto", None), (without | {"body": {"model": "none"}}, "none", {"model": "none"})):
        write_table(take, said)
        project.open_take(scene, take)
        assert scene.tricap.model == shown and project.table(scene).get("body") == then
        assert project.joints_model(scene) == {"auto": "full", "none": None}[shown]
    scene.tricap.model = "arm.R"
    project.write(scene)
    scene.tricap.model = "none"
    project.write(scene)
    assert read_table(take)["body"] == {"model": "none"} and take_of_table(take, read_table(take)).body_model is None


def test_the_quality_is_a_key_of_the_take(project: ModuleType, blender: ModuleType, take: Path) -> None:
    """It stands where a reader looks first, and nowhere else; so does the preset."""
    scene = blender.context.scene
    write_table(take, read_table(take) | {"preset": "published", "quality": "surface"})
    project.open_take(scene, take)
    assert (scene.tricap.surface.quality, scene.tricap.method.preset) == ("surface", "published")
    assert project.table(scene) == read_table(take)
    scene.tricap.surface.property_unset("quality")
    scene.tricap.method.property_unset("preset")
    assert project.table(scene) == {key: value for key, value in read_table(take).items() if key not in ("preset", "quality")}


def test_somebody_elses_change_is_not_written_over(project: ModuleType, blender: ModuleType, take: Path) -> None:
    scene = blender.context.scene
    project.open_take(scene, take)
    write_table(take, read_table(take) | {"fps": 100.0})
    with pytest.raises(project.InputError, match="changed outside Blender. Reload Take"):
        project.write(scene)
    assert read_table(take)["fps"] == 100.0
    project.write(scene, overwrite=True)
    assert read_table(take)["fps"] == 29.97
    scene.tricap.fps, scene.tricap.take_digest = 60.0, "of an older state, after undo"
    project.write(scene)
    assert read_table(take)["fps"] == 60.0


def test_a_saved_file_knows_its_project_and_both_can_be_moved(project: ModuleType, blender: ModuleType, take: Path, tmp_path: Path) -> None:
    blend = tmp_path / "a" / "shot.blend"
    blend.parent.mkdir()
    shutil.move(str(take), blend.parent / "kick")
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    project.open_take(blender.context.scene, blend.parent / "kick")
    said = project.table(blender.context.scene)
    blender.ops.wm.save_mainfile()
    shutil.move(str(tmp_path / "a"), tmp_path / "b")
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "shot.blend"))
    scene = blender.context.scene
    assert project.folder_of(scene) == tmp_path / "b" / "kick" and project.table(scene) == said
    assert project.clips_of(scene)["C"].size[:] == (192, 144)
    shutil.move(str(tmp_path / "b" / "kick"), tmp_path / "elsewhere")
    with pytest.raises(project.InputError, match="does not exist. Move it back, or choose where it is now"):
        project.write(scene)


def test_where_a_new_project_lies(project: ModuleType, blender: ModuleType, tmp_path: Path) -> None:
    scene = blender.context.scene
    with pytest.raises(project.InputError, match="Save the Blender file first"):
        project.make_folder(scene)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "my shot é.blend"))
    scene = blender.context.scene
    assert project.make_folder(scene) == tmp_path / "my shot é_tricap" and (tmp_path / "my shot é_tricap").is_dir()
    assert (scene.tricap.take, scene.tricap.out) == ("//my shot é_tricap", "//my shot é_tricap/results")
    write_take(tmp_path / "other", small_rig())
    scene.tricap.take = str(tmp_path / "other")
    with pytest.raises(project.InputError, match="already contains a take. Press Open Take"):
        project.make_folder(scene)


def test_a_deleted_clip_is_told_and_a_wrong_take_changes_nothing(project: ModuleType, blender: ModuleType, take: Path) -> None:
    scene = blender.context.scene
    project.open_take(scene, take)
    (take / "broken").mkdir()
    for text, words in (("", "no take.toml"), ("[settings.maching]\n", "Did you mean “matching”")):
        if text:
            shutil.copy(take / "take.toml", take / "broken" / "take.toml")
            with open(take / "broken" / "take.toml", "a", encoding="utf-8") as file:
                file.write("\n" + text)
        with pytest.raises(project.InputError, match=words):
            project.open_take(scene, take / "broken")
    assert project.folder_of(scene) == take
    blender.data.movieclips.remove(project.clips_of(scene)["C"])
    with pytest.raises(project.InputError, match="clip of view C was deleted. Press Reload Footage"):
        project.table(scene)


def test_clocks_of_views_survive_the_panel(project: ModuleType, blender: ModuleType, take: Path) -> None:
    """Keys that set a view's clock stay in take.toml, its clip starts with the frame that shows its first image, and no clicks are
    accepted in views that Blender shows at another rate."""
    scene, table = blender.context.scene, read_table(take) | {"keyframes": [], "seeds": {}, "frames": [4, 6]}
    table["views"][0] |= {"start": 0.0812, "drift_ppm": 12.5, "readout": 0.016, "offset_frames": 0}
    write_table(take, table)
    project.open_take(scene, take)
    written = project.table(scene)
    assert {k: written["views"][0][k] for k in ("start", "drift_ppm", "readout")} == {"start": 0.0812, "drift_ppm": 12.5, "readout": 0.016}
    assert scene.tricap.views[0].clip.frame_start == round(0.0812 * table["fps"]) == 2
    project.check_rates(scene)
    scene.tricap.views[2].fps = 2 * table["fps"]
    assert project.table(scene)["views"][2]["fps"] == 2 * table["fps"]
    with pytest.raises(Exception, match="View R does not have 29.97 images per second"):
        project.check_rates(scene)
