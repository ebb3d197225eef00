"""Single points in a real Blender: clicked in two views, followed, shown over the footage and in space with velocities; and in one clip."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.truth import Truth, read_truth

from .layout import Layout

ADDON = "bl_ext.user_default.tricap.addon"
FRAMES = 4
DEPTH_M = 4e-3  # 0.3 px of disparity: 14 mm of depth a pixel at 384 px


def module(name: str) -> ModuleType:
    return importlib.import_module(f"{ADDON}.{name}")


@pytest.fixture(scope="module")
def arm_take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("points") / "arm"
    make_arm_take(folder, ArmTakeSettings(frames=FRAMES, width_px=384, interlaced="none"))
    return folder


@pytest.fixture
def scene(blender: ModuleType, arm_take: Path, tmp_path: Path) -> Iterator[Any]:
    """The arm in the scene, with results in a folder of the test's own."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = blender.context.scene
    module("project").open_take(scene, arm_take)
    scene.tricap.out = str(tmp_path / "out")
    scene.frame_set(1)
    yield scene
    module("clicking.finder").close_all()


@pytest.fixture(scope="module")
def truth(arm_take: Path) -> Truth:
    return read_truth(arm_take)


def cloth(truth: Truth, frame: int, which: int) -> int:
    """A vertex of the sleeve that all cameras see in every frame."""
    rows = np.flatnonzero(truth.visible.all(axis=0) & truth.textured & (np.ptp(truth.vertices_m[..., 0], axis=0) > 0.003))
    return int(np.random.default_rng(3).permutation(rows)[which])


def click(blender: ModuleType, scene: Any, truth: Truth, name: str, vertex: int, views: str = "LC") -> None:
    rig = module("project").rig_of(scene)
    for view in views:
        x, y = rig[view].project(truth.vertices_m[scene.frame_current, vertex])
        assert blender.ops.tricap.click_point(name=name, clip=view, x=x, y=y) == {"FINISHED"}


@pytest.mark.slow
def test_points_are_followed_in_space(blender: ModuleType, scene: Any, truth: Truth, tmp_path: Path) -> None:
    """Clicked in frame 1 in two views, they are followed to both ends; the empties are where the cloth is, the arrows have its speed."""
    vertices = {"nose": cloth(truth, 1, 0), "point 1": cloth(truth, 1, 1)}
    for name, vertex in vertices.items():
        click(blender, scene, truth, name, vertex)
    before = module("project").table(scene)
    assert blender.ops.tricap.follow_points() == {"FINISHED"}
    assert (tmp_path / "out" / "points3d.csv").is_file() and module("project").table(scene) == before, "points are no clicks of the take"
    for frame in range(FRAMES):
        scene.frame_set(frame)
        for name, vertex in vertices.items():
            assert np.linalg.norm(np.array(blender.data.objects[name].matrix_world.translation) - truth.vertices_m[frame, vertex]) < DEPTH_M
    arrows = blender.data.objects["Velocities of Points"].data
    speed = np.zeros(len(arrows.vertices), np.float32)
    arrows.attributes["speed"].data.foreach_get("value", speed)
    true = np.linalg.norm(np.gradient(truth.vertices_m[:, list(vertices.values())], 1 / 25.0, axis=0), axis=-1)
    assert np.median(speed) == pytest.approx(np.median(true), rel=0.2)
    assert scene.tricap_overlay.chosen
    run = module("overlay.results").current(scene)
    segments, colours, at = module("overlay.layers").chosen_paths(run, "R", 2)
    assert set(at) == set(vertices) and len(segments) == len(colours) == 2 * 2
    rig = module("project").rig_of(scene)
    assert np.linalg.norm(at["nose"] - rig["R"].project(truth.vertices_m[2, vertices["nose"]])) < 1.0
    with pytest.raises(RuntimeError, match="They are clicked in frame 1"):
        blender.ops.tricap.follow_points()
    scene.frame_set(1)
    assert blender.ops.tricap.follow_points() == {"FINISHED"}
    assert len([c for c in scene.collection.children_recursive if c.name.startswith("Points")]) == 1, "they replace those of before"


def test_a_point_in_one_view_is_followed_there(blender: ModuleType, scene: Any, truth: Truth, tmp_path: Path) -> None:
    """In space it is refused with a sentence; in 2-D it is followed, and joined to another by a line."""
    a, b = cloth(truth, 1, 0), cloth(truth, 1, 1)
    for name, vertex in (("chin", a), ("brow", b)):
        click(blender, scene, truth, name, vertex, "C")
    with pytest.raises(RuntimeError, match="“chin” is clicked in one view only"):
        blender.ops.tricap.follow_points()
    clip = module("project").clips_of(scene)["C"]
    assert blender.ops.tricap.join_points(clip=clip.name, names="chin\nbrow") == {"FINISHED"}
    assert module("points.tracks").joined(clip) == [("chin", "brow")]
    assert blender.ops.tricap.follow_points2d(clip=clip.name) == {"FINISHED"}
    (table,) = (tmp_path / "out" / "planar").glob("*.csv")
    found = importlib.import_module("tricap.core.tracking.point_tables").read_planar(table)
    camera = module("project").rig_of(scene)["C"]
    for n, vertex in enumerate((a, b)):
        miss = np.linalg.norm(found.xy_px[:, n] - camera.project(truth.vertices_m[found.frames, vertex]), axis=1)
        assert found.frames.tolist() == list(range(FRAMES)) and miss.max() < 1.5
    assert "chin – brow" in blender.data.objects and blender.data.objects["Footage"].image_user.frame_start == 0
    assert blender.ops.tricap.join_points(clip=clip.name, names="brow\nchin") == {"FINISHED"}
    assert module("points.tracks").joined(clip) == [], "pressed again, they are separated"


def test_a_clip_without_a_take(empty: ModuleType, arm_take: Path, truth: Truth, tmp_path: Path) -> None:
    """2-D needs neither cameras nor a take: the table is written next to the Blender file, which must be saved."""
    clip = empty.data.movieclips.load(str(sorted((arm_take / "C").glob("*.png"))[0]))
    clip.frame_start = 0
    empty.context.scene.frame_set(0)
    camera, vertex = importlib.import_module("tricap.core.geometry.rig").read_rig(arm_take / "rig.toml")["C"], cloth(truth, 1, 0)
    x, y = camera.project(truth.vertices_m[0, vertex])
    assert empty.ops.tricap.click_point(name="point 1", clip=clip.name, x=x, y=y) == {"FINISHED"}
    with pytest.raises(RuntimeError, match="Save the Blender file first"):
        empty.ops.tricap.follow_points2d(clip=clip.name)
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "face.blend"))
    clip = empty.data.movieclips[0]
    assert empty.ops.tricap.follow_points2d(clip=clip.name) == {"FINISHED"}
    (table,) = (tmp_path / "face_tricap" / "results" / "planar").glob("*.csv")
    found = importlib.import_module("tricap.core.tracking.point_tables").read_planar(table)
    assert np.linalg.norm(found.xy_px[:, 0] - camera.project(truth.vertices_m[:, vertex]), axis=1).max() < 1.5


def test_what_is_told_in_the_end(scene: Any) -> None:
    """The next button; in 2-D there are no other views."""
    operator = SimpleNamespace(session=SimpleNamespace(frame=3), flat=True)
    result = module("points.click").ClickPoints.result
    assert result(operator, 2).startswith("Frame 3: 2 new points. Press Follow in This View (2-D)")
    operator.flat = False
    assert result(operator, 1) == "Frame 3: 1 new point, clicked in two or more views. Press Follow Points."


def test_what_is_refused(blender: ModuleType, scene: Any) -> None:
    with pytest.raises(RuntimeError, match="No points are clicked in frame 1"):
        blender.ops.tricap.follow_points()
    with pytest.raises(RuntimeError, match="another name"):
        blender.ops.tricap.click_point(name="elbow.R", clip="C", x=5, y=5)
    with pytest.raises(RuntimeError, match="outside the image"):
        blender.ops.tricap.click_point(name="nose", clip="C", x=5000, y=5)
    with pytest.raises(RuntimeError, match="no clip “X”"):
        blender.ops.tricap.follow_points2d(clip="X")
    with pytest.raises(RuntimeError, match="Select two points"):
        blender.ops.tricap.join_points(clip=module("project").clips_of(scene)["C"].name)
    with pytest.raises(RuntimeError, match="needs Blender's window"):
        blender.ops.tricap.click_points()


def test_clicking_points_is_endless_and_leaves_the_take_alone(scene: Any, truth: Truth) -> None:
    """The session that the window's operator drives: names in turn, epipolar lines in the other views; 2-D needs one click a point."""
    operators, click_points = module("clicking.operators"), module("points.click")
    clips = module("project").clips_of(scene)
    before = scene.tricap.seed_frame
    session, _ = operators.begin_session(scene, lambda _, views: click_points.free_names(views, 1), seeds=False)
    X = truth.vertices_m[1, cloth(truth, 1, 0)]
    assert session.endless and session.name == "point 1" and scene.tricap.seed_frame == before
    session.click("C", module("project").rig_of(scene)["C"].project(X))
    assert session.curves("L") and session.name == "point 1"
    session.accept()
    assert click_points.free_names(clips, 1)[0] == "point 1", "one view is not enough"
    session.go_to("point 1")
    session.click("L", module("project").rig_of(scene)["L"].project(X))
    assert click_points.free_names(clips, 1)[0] == "point 2"
    flat = module("clicking.click_session").ClickSession({"C": clips["C"]}, click_points.free_names({"C": clips["C"]}, 1), 1, None)
    assert flat.name == "point 2"
    flat.click("C", np.array([30.0, 30.0]))
    assert flat.name == "point 3"


def test_the_panel_names_points_views_and_lines(blender: ModuleType, scene: Any, truth: Truth) -> None:
    """Over a view all buttons, over any other clip those of one image."""
    clips, panel = module("project").clips_of(scene), module("points.panel").TRICAP_PT_points
    click(blender, scene, truth, "nose", cloth(truth, 1, 0))
    click(blender, scene, truth, "chin", cloth(truth, 1, 1), "C")
    blender.ops.tricap.join_points(clip=clips["C"].name, names="nose\nchin")

    def drawn(clip: Any) -> Layout:
        here = SimpleNamespace(scene=scene, space_data=SimpleNamespace(clip=clip), window_manager=blender.context.window_manager)
        return Layout().draw(panel, here)

    over_view = drawn(clips["C"])
    assert {"tricap.click_points", "tricap.follow_points", "tricap.follow_points2d", "tricap.join_points"} <= set(over_view.operators)
    assert {"markers", "chosen"} <= set(over_view.properties)
    assert "nose   L C   – chin" in over_view.texts and "chin   C   – nose" in over_view.texts
    other = blender.data.movieclips.load(str(next(Path(module("folders").absolute(clips["L"].filepath)).parent.glob("*.png"))))
    assert "tricap.follow_points" not in drawn(other).operators and "Open footage in this editor." in drawn(None).texts
