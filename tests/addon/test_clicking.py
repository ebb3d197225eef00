"""Clicking joints, without the window's events: whose turn it is, native tracks, epipolar lines, proposals, undo, the views' workspace."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.truth import Truth, read_truth

ADDON = "bl_ext.user_default.tricap.addon"


def module(name: str) -> ModuleType:
    return importlib.import_module(f"{ADDON}.{name}")


@pytest.fixture(scope="module")
def arm_take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clicking") / "arm é"
    make_arm_take(folder, ArmTakeSettings(frames=3, width_px=384, interlaced="none"))
    return folder


@pytest.fixture
def scene(blender: ModuleType, arm_take: Path) -> Iterator[Any]:
    """The arm in the scene, nothing clicked yet."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = blender.context.scene
    module("project").open_take(scene, arm_take)
    scene.frame_set(0)
    for clip in module("project").clips_of(scene).values():
        module("clicks").clear(clip)
    yield scene
    module("clicking.finder").close_all()


@pytest.fixture
def session(scene: Any) -> Any:
    operators = module("clicking.operators")
    names = lambda context, clips: module("clicking.click_session").joints_of(operators.model_joints(context.scene))  # noqa: E731
    session, said = operators.begin_session(scene, names)
    assert not said
    return session


@pytest.fixture(scope="module")
def truth(arm_take: Path) -> Truth:
    return read_truth(arm_take)


def sleeve_point(session: Any, truth: Truth, which: int) -> np.ndarray:
    """A point of cloth that all cameras see."""
    rows = np.flatnonzero(truth.visible[session.frame] & truth.textured)
    return truth.vertices_m[session.frame, np.random.default_rng(8).permutation(rows)[which]]


@pytest.mark.slow
def test_a_click_gives_lines_and_a_proposal_that_is_right(session: Any, truth: Truth) -> None:
    session.depths_m.clear()  # as of points on the surface
    assert session.names == ["shoulder.R", "elbow.R", "wrist.R"] and session.name == "shoulder.R"
    camera = dict(zip(session.views, session.finder.cameras))
    errors = []
    for which in range(8):
        X = sleeve_point(session, truth, which)
        session.click("C", camera["C"].project(X))
        assert session.asking and list(session.curves("L")) == ["C"] and not session.curves("C")
        answer = session.finder.wait()
        assert answer is not None and session.take_answer(answer)
        errors += [np.linalg.norm(offer.xy_px - camera[view].project(X)) for view, offer in session.proposals.items()]
        assert session.back()
    assert len(errors) >= 12 and np.median(errors) < 0.5 and np.mean(np.array(errors) < 1.0) >= 0.75


def test_a_joint_is_proposed_where_it_is_inside_the_limb(session: Any, truth: Truth) -> None:
    camera = dict(zip(session.views, session.finder.cameras))
    for name, joint in (("shoulder.R", "RightArm"), ("elbow.R", "RightForeArm")):
        session.click("C", camera["C"].project(truth.joints_m[joint][0]))
        assert session.name == name and session.take_answer(session.finder.wait())
        for view in "LR":
            assert np.linalg.norm(session.proposals[view].xy_px - camera[view].project(truth.joints_m[joint][0])) < 2.5
        session.accept()


def test_return_takes_the_proposals_and_goes_on(session: Any, truth: Truth, scene: Any) -> None:
    camera = dict(zip(session.views, session.finder.cameras))
    elbow = truth.joints_m["RightArm"][0]
    session.click("L", camera["L"].project(elbow))
    session.click("R", camera["R"].project(elbow))
    assert set(session.proposals) == {"C"}, "two rays meet: no image is needed"
    assert np.linalg.norm(session.proposals["C"].xy_px - camera["C"].project(elbow)) < 0.1
    session.accept()
    assert session.name == "elbow.R" and set(session.clicks("shoulder.R")) == {"L", "C", "R"}
    clip = module("project").clips_of(scene)["C"]
    track = clip.tracking.tracks["shoulder.R"]
    assert track.select and clip.tracking.tracks.active == track, "G moves it"
    track.markers[0].co = (0.5, 0.5)
    assert np.allclose(session.clicks("shoulder.R")["C"], (np.array(clip.size) - 1) / 2, atol=1e-4)
    table = module("project").table(scene)
    assert set(table["seeds"]["joints"]["shoulder.R"]) == {"L", "C", "R"} and table["seeds"]["frame"] == 0


def test_return_goes_on_though_a_view_does_not_show_the_joint(session: Any, truth: Truth) -> None:
    camera = dict(zip(session.views, session.finder.cameras))
    session.click("C", camera["C"].project(truth.joints_m["RightArm"][0]))
    assert session.take_answer(session.finder.wait()) and set(session.proposals) == {"L", "R"}
    del session.proposals["R"]
    session.accept()
    assert session.name == "elbow.R" and set(session.clicks("shoulder.R")) == {"L", "C"}
    assert session.back() and session.name == "shoulder.R" and set(session.clicks()) == {"C"}


def test_the_figure_makes_room_for_what_is_under_it() -> None:
    draw = module("clicking.draw")
    extent, under_left, under_right = np.array([120.0, 190.0]), np.array([60.0, 100.0]), np.array([750.0, 100.0])

    def x(*places: np.ndarray) -> float:
        return float(draw.clear_corner(12.0, 668.0, 34.0, extent, places)[0])

    assert x() == x(np.array([400.0, 100.0])) == x(under_left, under_right) == 12.0 and x(under_left) == 668.0


def test_skip_back_and_undo(session: Any) -> None:
    session.skip()
    assert session.name == "elbow.R" and not session.changed
    session.click("C", np.array([100.0, 80.0]))
    session.click("C", np.array([120.0, 90.0]))
    assert np.allclose(session.clicks()["C"], [120, 90], atol=1e-4) and session.changed
    assert session.back() and np.allclose(session.clicks()["C"], [100, 80], atol=1e-4)
    assert session.back() and not session.clicks() and session.name == "elbow.R"
    assert session.back() and session.name == "shoulder.R" and not session.back()
    session.click("C", np.array([-50.0, 1e4]))
    assert np.allclose(session.clicks()["C"], [-0.5, 287.5], atol=1e-3), "a click beside the image is put at its edge"


def test_a_session_ends_when_every_joint_is_clicked_twice_or_skipped(session: Any) -> None:
    first, *others = session.names
    session.click("C", np.array([100.0, 80.0]))
    for name in others:
        session.go_to(name)
        for view in session.views:
            session.click(view, np.array([150.0, 120.0]))
    assert session.name == first and session.missing() == {first: 1}, "the last joint is done, but one has a single click"
    session.skip()
    assert session.name == "" and session.missing() == {} and session.missing(skipped=True) == {first: 1}
    assert session.back() and session.missing() == {first: 1}


def test_a_skipped_joint_is_not_asked_for_in_the_second_round(session: Any) -> None:
    assert session.names == ["shoulder.R", "elbow.R", "wrist.R"]
    session.accept()
    session.skip()
    session.accept()
    assert session.name == "shoulder.R", "left without a click, so that it is asked for again"
    session.accept()
    assert session.name == "wrist.R"
    session.go_to("elbow.R")
    assert session.name == "elbow.R", "on request it can be clicked all the same"


def test_a_click_near_the_proposal_takes_it(session: Any, truth: Truth) -> None:
    camera = dict(zip(session.views, session.finder.cameras))
    X = sleeve_point(session, truth, 0)
    session.click("C", camera["C"].project(X))
    session.take_answer(session.finder.wait())
    offer = session.proposals["L"].xy_px
    session.click("L", offer + [3.0, 2.0], snap_px=5.0)
    assert np.allclose(session.clicks()["L"], offer, atol=1e-3)
    session.back()
    session.click("L", offer + [30.0, 2.0], snap_px=5.0)
    assert np.allclose(session.clicks()["L"], offer + [30.0, 2.0], atol=1e-3)


def test_what_is_dragged_is_looked_for_again(session: Any, truth: Truth, scene: Any) -> None:
    camera = dict(zip(session.views, session.finder.cameras))
    session.click("C", camera["C"].project(sleeve_point(session, truth, 0)))
    session.take_answer(session.finder.wait())
    before = session.proposals["L"].xy_px
    assert not session.poll()
    to = camera["C"].project(sleeve_point(session, truth, 1))
    module("clicks").set_click(module("project").clips_of(scene)["C"], session.name, 0, (float(to[0]), float(to[1])))  # as G does
    assert session.poll() and session.asking and not session.proposals
    assert session.take_answer(session.finder.wait()) and np.linalg.norm(session.proposals["L"].xy_px - before) > 5


def test_a_late_answer_is_not_taken_for_another_joint(session: Any) -> None:
    session.click("C", np.array([150.0, 120.0]))
    late = session.finder.wait()
    session.skip()
    assert late is not None and not session.take_answer(late) and not session.proposals


def test_all_done_and_another_frame(session: Any, scene: Any) -> None:
    for _ in session.names:
        for view in session.views:
            session.click(view, np.array([150.0, 120.0]))
    assert session.name == "" and session.next_view() is None
    session.accept()
    session.skip()
    session.click("C", np.array([1.0, 1.0]))
    session.show_frame(2)
    assert session.name == "shoulder.R" and not session.clicks()
    session.click("C", np.array([151.0, 120.0]))
    session.click("R", np.array([150.0, 120.0]))
    keyframes = module("project").table(scene)["keyframes"]
    assert keyframes == [{"frame": 2, "joints": {"shoulder.R": {"C": [151.0, 120.0], "R": [150.0, 120.0]}}}]
    assert session.back() and session.back() and session.back() and session.frame == 2


def test_the_first_clicks_say_the_frame(blender: ModuleType, scene: Any) -> None:
    operators, clips = module("clicking.operators"), module("project").clips_of(scene)
    scene.frame_set(2)
    operators.set_click_frame(scene, clips, 2)
    assert scene.tricap.seed_frame == 2
    assert blender.ops.tricap.click(name="elbow.R", view="C", x=430.3 / 2, y=100.1, frame=1) == {"FINISHED"}
    assert scene.tricap.seed_frame == 1
    assert module("project").table(scene)["seeds"]["joints"] == {"elbow.R": {"C": [215.15, 100.1]}}
    assert blender.ops.tricap.click(name="wrist.R", view="C", x=5, y=5) == {"FINISHED"}
    assert scene.tricap.seed_frame == 1 and module("project").table(scene)["keyframes"][0]["frame"] == 2
    assert blender.ops.tricap.click(name="elbow.R", view="C", frame=1, remove=True) == {"FINISHED"}
    assert blender.ops.tricap.click(name="elbow.R", view="C", frame=1, remove=True) == {"CANCELLED"}


def test_surface_seeds_belong_to_the_frame_of_the_first_clicks(blender: ModuleType, scene: Any) -> None:
    operators = module("clicking.operators")
    blender.ops.tricap.click(name="elbow.R", view="C", x=200, y=100)
    scene.frame_set(2)
    names = lambda context, clips: operators.ClickSeeds.names(None, context, clips)  # noqa: E731
    session, _ = operators.begin_session(scene, names)
    assert scene.frame_current == session.frame == 0 and session.name == "seed 1"
    session.click("C", np.array([250.0, 200.0]))
    session.click("L", np.array([250.0, 200.0]))
    session.skip()
    assert session.name == "seed 2" and module("project").table(scene)["seeds"]["surface"] == [{"L": [250, 200], "C": [250, 200]}]
    scene.frame_set(1)
    with pytest.raises(module("jobs").InputError, match="Go back to frame 0"):
        operators.ClickSeeds.follow(SimpleNamespace(session=session), blender.context)


@pytest.mark.parametrize(("wrong", "why"), [
    ({"name": "elbow"}, "is not a joint"), ({"name": "elbow.R", "view": "X"}, "no view “X”"),
    ({"name": "elbow.R", "view": "C", "x": 1e4}, "outside the image")])  # fmt: skip
def test_a_wrong_click_is_told(blender: ModuleType, scene: Any, wrong: dict[str, Any], why: str) -> None:
    with pytest.raises(RuntimeError, match=why):
        blender.ops.tricap.click(**wrong)


def test_clicking_needs_footage_model_and_window(blender: ModuleType, scene: Any) -> None:
    with pytest.raises(RuntimeError, match="needs Blender's window"):
        blender.ops.tricap.click_joints()
    scene.tricap.model = "none"
    with pytest.raises(module("jobs").InputError, match="a body in step 3 first"):
        module("clicking.operators").model_joints(scene)
    scene.tricap.views.clear()
    with pytest.raises(module("jobs").InputError, match="footage first"):
        module("clicking.operators").begin_session(scene, lambda context, clips: ["elbow.R"])
    assert not blender.ops.tricap.open_views.poll()


def test_without_a_rig_one_can_click_but_nothing_is_proposed(blender: ModuleType, scene: Any, arm_take: Path) -> None:
    rig = arm_take / "rig.toml"
    rig.rename(arm_take / "other.toml")
    try:
        session, said = module("clicking.operators").begin_session(scene, lambda context, clips: ["elbow.R"])
    finally:
        (arm_take / "other.toml").rename(rig)
    assert "rig" in said and session.finder is None
    session.click("C", np.array([20.0, 20.0]))
    assert not session.curves("L") and not session.proposals and not session.asking


def test_undo_takes_the_clicks_back(blender: ModuleType, scene: Any) -> None:
    blender.ops.ed.undo_push(message="before")
    blender.ops.tricap.click(name="elbow.R", view="C", x=20, y=20)
    blender.ops.ed.undo_push(message="after")
    blender.ops.ed.undo()
    scene = blender.context.scene
    assert "seeds" not in module("project").table(scene)
    blender.ops.ed.redo()
    assert module("project").table(blender.context.scene)["seeds"]["joints"] == {"elbow.R": {"C": [20.0, 20.0]}}


def test_a_deleted_clip_is_told(blender: ModuleType, session: Any, scene: Any) -> None:
    blender.data.movieclips.remove(module("project").clips_of(scene)["L"])
    assert not session.has_all_clips and session.view_of(None) is None
    with pytest.raises(module("jobs").InputError, match="view L was deleted"):
        session.clicks()


def test_unreadable_images_are_told_and_take_no_click(session: Any, arm_take: Path) -> None:
    images = arm_take / "C"
    images.rename(arm_take / "gone")
    try:
        session.show_frame(2)  # the images of the first frame may be read already
        session.click("C", np.array([150.0, 120.0]))
        assert session.take_answer(session.finder.wait())
    finally:
        (arm_take / "gone").rename(images)
    assert "Cannot read the image" in session.problem and not session.proposals and "C" in session.clicks() and session.curves("L")


def lay_out(window: Any, clips: list[Any]) -> list[str]:
    return list(module("clicking.open_views").lay_out(window, clips))


def test_the_views_share_the_largest_area(blender: ModuleType, scene: Any) -> None:
    window = blender.context.window_manager.windows[0]
    clips = list(module("project").clips_of(scene).values())
    others = {area.type for area in window.screen.areas} - {"VIEW_3D"}
    assert list(lay_out(window, clips[:2]))[-2:] == ["columns", "shown"]  # before them "rows", unless another test opened views
    shown = [area.spaces.active.clip for area in window.screen.areas if area.type == "CLIP_EDITOR"]
    assert set(shown) == set(clips[:2]) and len(shown) == 2
    lay_out(window, clips)
    editors = [area for area in window.screen.areas if area.type == "CLIP_EDITOR"]
    assert {a.spaces.active.clip for a in editors} == set(clips) and len(editors) == 3
    assert all(area.spaces.active.mode == "TRACKING" for area in editors) and others <= {area.type for area in window.screen.areas}


def test_body_and_footage_share_the_largest_area(blender: ModuleType, scene: Any) -> None:
    window = blender.context.window_manager.windows[0]
    for area in window.screen.areas:  # other tests open the views
        if area.type == "CLIP_EDITOR":
            area.type = "TEXT_EDITOR"
    review, clip = module("correcting.review"), module("project").clips_of(scene)["C"]
    assert not blender.ops.tricap.review.poll(), "there is no body"
    assert list(review.lay_out(window, clip.name)) == ["split", "shown"]
    shown = {area.type: area for area in window.screen.areas if area.type in ("CLIP_EDITOR", "VIEW_3D")}
    assert len(shown) == 2 and shown["CLIP_EDITOR"].spaces.active.clip == clip
    assert list(review.lay_out(window, clip.name)) == [], "a second time nothing is split"
    blender.ops.mesh.primitive_cube_add(location=(3.0, 0.0, 1.0))
    blender.context.view_layer.update()
    view = shown["VIEW_3D"].spaces.active.region_3d
    review.frame(view, blender.context.object)
    assert tuple(view.view_location) == pytest.approx((3.0, 0.0, 1.0)) and view.view_distance == pytest.approx(1.5 * 12**0.5, rel=1e-5)


class _Region(SimpleNamespace):
    """A region as the window has it; one that was never drawn does not know where its picture lies."""

    x, y, width, height = 100, 50, 700, 500

    @property
    def view2d(self) -> Any:
        return SimpleNamespace(region_to_view=lambda x, y: ((x - 60) / 576, (y - 30) / 432))


def test_events_become_actions(blender: ModuleType, session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    window = blender.context.window_manager.windows[0]
    lay_out(window, list(session.clips.values()))
    area = next(a for a in window.screen.areas if module("overlay.canvas").clip_of(a) == session.clips["C"])
    operators = module("clicking.operators")
    operator = SimpleNamespace(session=session, _turn_to_next=lambda area, window: None)
    region = _Region()
    monkeypatch.setattr(operators.canvas, "window_region", lambda area: region)

    def event(key: str, value: str = "PRESS", **more: Any) -> Any:
        held = dict(ctrl=False, alt=False, shift=False, oskey=False, mouse_x=region.x + 30, mouse_y=region.y + 40)
        return SimpleNamespace(type=key, value=value, **held | more)

    act = operators.ClickOperator._act_in
    for key in ("MIDDLEMOUSE", "WHEELUPMOUSE", "G", "SPACE", "NUMPAD_1", "FOUR"):
        assert not act(operator, area, "C", event(key)), f"{key} is Blender's"
    assert not act(operator, area, "C", event("LEFTMOUSE", ctrl=True)) and act(operator, area, "C", event("LEFTMOUSE", "RELEASE"))
    assert not session.changed
    assert act(operator, area, "C", event("LEFTMOUSE"))
    assert np.allclose(session.clicks()["C"], [-0.5, 287.5 - 10 / 1.5], atol=1e-3)
    assert session.changed and act(operator, area, "C", event("BACK_SPACE")) and not session.clicks()
    assert act(operator, area, "C", event("S")) and session.name == "elbow.R"
    assert act(operator, area, "C", event("TAB")) and area.spaces.active.clip == session.clips["R"]
    assert act(operator, area, "C", event("ONE")) and area.spaces.active.clip == session.clips["L"]


def test_the_canvas_goes_there_and_back(blender: ModuleType) -> None:
    sheet = module("overlay.canvas").Canvas(_Region(), (384, 288))
    xy = np.array([[0.0, 0.0], [383.0, 287.0], [20.25, 100.5]])
    assert np.allclose(sheet.to_image(sheet.to_region(xy)), xy, atol=1e-9) and sheet.zoom == pytest.approx(1.5)
    assert np.allclose(sheet.to_region(np.array([0.0, 0.0])), [60.75, 30 + 432 - 0.75]), "the top left pixel's middle"


def test_the_figure_stands_upright_with_its_right_on_the_left() -> None:
    from tricap.addon.clicking.draw import figure

    shape = figure()
    assert shape.triangles.reshape(-1, 2).min() >= 0 and shape.triangles[..., 1].max() == pytest.approx(1.0)
    at = shape.joints
    assert at["wrist.R"][0] < at["shoulder.R"][0] < at["neck"][0] < at["shoulder.L"][0] < at["wrist.L"][0] < shape.width
    assert at["ankle.R"][1] < at["knee.R"][1] < at["hip.R"][1] < at["shoulder.R"][1] < at["head"][1]
    for name in ("elbow.L", "knee.R", "head", "pelvis"):
        inside = any(_holds(triangle, at[name]) for triangle in shape.triangles)
        assert inside, f"{name} lies on the body"


def _holds(t: np.ndarray, p: np.ndarray) -> bool:
    sides = [np.cross(np.append(t[(i + 1) % 3] - t[i], 0), np.append(p - t[i], 0))[2] for i in range(3)]
    return min(sides) >= 0 or max(sides) <= 0


def test_the_order_of_the_joints(blender: ModuleType) -> None:
    joints_of, needed_first = (getattr(module("clicking.click_session"), name) for name in ("joints_of", "needed_first"))
    from tricap.core.body.model_file import read_model

    every = read_model("full").skeleton.joint_names
    asked = joints_of(every)
    assert needed_first(["head", "shoulder.R", "hip.R", "knee.R"], "knee.R") == ["knee.R", "shoulder.R", "hip.R", "head"]
    assert asked[0] == "head" and "chest" not in asked and "crown" not in asked and "chest" in joints_of(every, hidden=True)
    assert joints_of(read_model("leg.L").skeleton.joint_names) == ["hip.L", "knee.L", "ankle.L"]


@pytest.mark.parametrize("height_px", [600.0, 150.0, 60.0])
def test_names_of_joints_lie_over_nothing(blender: ModuleType, height_px: float) -> None:
    """On a small figure some names are left out rather than written over others."""
    labels, shape = module("clicking.draw"), module("clicking.draw").figure()
    marks = np.array([300.0, 60.0]) + height_px * np.array([*shape.joints.values()])
    widths = np.array([7.0 * len(name) for name in shape.joints])
    corners = labels.place_labels(marks, widths, 11.0, (800, 700))
    placed = np.flatnonzero(np.isfinite(corners).all(axis=1))
    low, high = corners[placed], corners[placed] + np.stack([widths[placed], np.full(len(placed), 11.0)], axis=1)
    boxes = np.concatenate([low, high], axis=1)
    others = np.concatenate([boxes, np.concatenate([marks - labels.MARK, marks + labels.MARK], axis=1)])
    over = (boxes[:, None, :2] < others[:, 2:]).all(axis=2) & (others[:, :2] < boxes[:, None, 2:]).all(axis=2)
    assert over.sum() == len(placed), "each lies over itself alone"
    assert (low >= 0).all() and (high <= (800, 700)).all()
    assert len(placed) >= {600.0: len(marks), 150.0: 10, 60.0: 4}[height_px]


def test_names_that_have_no_room_are_seen_under_the_mouse(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    draw = module("clicking.draw")
    joints = list(session.names)
    clicks = {name: {"C": np.array([100.0 + 2 * i, 80.0])} for i, name in enumerate(joints)}
    monkeypatch.setattr(type(session), "clicks", lambda self, name=None: clicks.get(name, {}))
    sheet = SimpleNamespace(region=SimpleNamespace(width=130, height=130, x=0, y=0), to_region=lambda xy: np.asarray(xy, dtype=float))
    told: list[str] = []
    monkeypatch.setattr(draw.canvas, "text", lambda words, *rest, **more: told.append(words))
    for name in ("draw_lines", "line_batch", "fill"):
        monkeypatch.setattr(draw.canvas, name, lambda *rest: None)
    monkeypatch.setattr(draw, "place_labels", lambda marks, *rest: np.full((len(marks), 2), np.nan))
    draw._draw_others(session, "C", sheet, np.array([500.0, 500.0]))
    assert told == []
    draw._draw_others(session, "C", sheet, clicks[joints[1]]["C"])
    assert told == [joints[1]]
