"""What is shown over the footage: which run, what each layer holds, where it is drawn, and the table of frames."""

import importlib
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.foundation import store
from tricap.core.matching.proposals import Proposal
from tricap.core.motion.formats.ply import write_mesh
from tricap.core.run.record import COLUMNS, FrameTable, write_frame_table
from tricap.core.tracking.settings import TrackStatus

from .conftest import FRAMES, SIZE, SmallRun

ADDON = "bl_ext.user_default.tricap.addon"


def module(name: str) -> ModuleType:
    return importlib.import_module(f"{ADDON}.{name}")


@pytest.fixture
def scene(blender: ModuleType, empty: ModuleType, small_run: SmallRun) -> Any:
    """The small run in the scene, with trajectories before the filters, a table of frames, a contour and a skin."""
    out, joints = small_run.out, small_run.joints_m
    xyz = np.stack([joints["elbow.R"], joints["wrist.R"]], axis=1)
    status = np.full(xyz.shape[:2], TrackStatus.MEASURED, dtype=np.int8)
    status[:, 1] = TrackStatus.NOT_RIGID
    store.save(out / "trajectories_raw.npz", dict(frames=np.array(FRAMES), xyz_m=xyz, status=status,
                                                  reason=np.array([1, 13], dtype=np.int8)), {})  # fmt: skip
    values = {name: np.ones(len(FRAMES)) for name in COLUMNS}
    values["residual_px"] = np.array([0.1, 0.1, 0.5, 0.1, 0.1, 0.1])
    write_frame_table(out / "frames.csv", FrameTable(frames=np.array(FRAMES), values=values, fit=("fitted",) * len(FRAMES)))
    square_px = "".join(f"3,{i},{x},{y},0,1,0.2,1\n" for i, (x, y) in enumerate([(20, 20), (60, 20), (60, 60), (20, 60)]))
    store.write_text(out / "contours" / "C.csv", "frame,vertex,x,y,normal_x,normal_y,sigma,on_edge\n" + square_px)
    a = joints["elbow.R"][1]
    square = a + 0.1 * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    write_mesh(out / "skin" / "0003.ply", square, np.array([[0, 1, 2, 3]]))
    scene = empty.context.scene
    module("project").open_take(scene, small_run.take)
    scene.tricap.out = str(out)
    scene.frame_set(3)
    module("overlay.results").clear()
    return scene


@pytest.fixture
def run(scene: Any) -> Any:
    found = module("overlay.results").current(scene)
    assert found is not None, module("overlay.results").problem()
    return found


def test_the_run_is_read_once_and_again_when_it_changed(run: Any, scene: Any, small_run: SmallRun) -> None:
    results = module("overlay.results")
    assert list(run.cameras) == ["L", "C", "R"] and run.reference == 1 and run.rows_at(0).step == 2
    assert run.points(3) is run.points(3) and results.current(scene) is run
    write_frame_table(small_run.out / "frames.csv", run.table())
    assert results.current(scene) is not run


def test_nothing_was_measured_yet(scene: Any, small_run: SmallRun) -> None:
    results = module("overlay.results")
    (small_run.out / "run.json").unlink()
    assert results.current(scene) is None and results.problem() == "Nothing was measured yet."
    scene.tricap.take = scene.tricap.out = ""
    scene.tricap.views.clear()
    assert results.current(scene) is None and "Save the Blender file" in results.problem()


def test_a_damaged_file_is_told_and_the_rest_is_shown(run: Any, small_run: SmallRun) -> None:
    (small_run.out / "trajectories_raw.npz").write_bytes(b"PK nonsense")
    (small_run.out / "clouds" / "0003.ply").write_bytes(b"ply\nnonsense")
    assert run.tracks() is None and "damaged" in run.problem
    assert run.points(3) is None and run.points(4) is not None


def test_a_run_json_that_no_run_wrote(scene: Any, small_run: SmallRun) -> None:
    results, sound = module("overlay.results"), {"format": "tricap-run", "version": 1}
    for said in ({"settings": []}, {"settings": {"matching": {"patch_px": "wide"}}}, {"stages": [1]}):
        store.write_json(small_run.out / "run.json", sound | said)
        results.clear()
        assert results.current(scene) is None and "run.json" in results.problem()


def test_points_are_coloured_by_sigma(run: Any, small_run: SmallRun) -> None:
    layers = module("overlay.layers")
    found = layers.coloured_points(run, "L", 3, 2.0)
    points = run.points(3)
    assert np.allclose(found.xy_px, small_run.rig["L"].project(points.xyz_m), atol=1e-3) and found.red_mm == 2.0
    assert np.allclose(found.colours, layers.heat_colours(np.array([0.5]))), "1 mm of 2 mm"
    assert layers.coloured_points(run, "L", 3, 0.0).red_mm == pytest.approx(1.0, rel=1e-5)
    blue, red = layers.heat_colours(np.array([0.0, 7.0]))
    assert blue[2] == 1.0 and red[0] == 1.0 and red[2] < 0.2
    assert layers.coloured_points(run, "L", 99, 0.0) is None


def test_tails_before_and_after_the_filters(run: Any, small_run: SmallRun) -> None:
    layers = module("overlay.layers")
    counts = {which: len(layers.tails(run, "C", 7, 3, which)[0]) for which in ("before", "kept", "removed", "both")}
    assert counts == {"before": 6, "kept": 3, "removed": 3, "both": 6}
    segments, colours = layers.tails(run, "C", 7, 3, "kept")
    elbow = small_run.rig["C"].project(small_run.joints_m["elbow.R"][-4:])
    assert np.allclose(segments[:, 1], elbow[1:], atol=1e-3) and (np.diff(colours[:, 3]) > 0).all(), "the older the paler"
    assert layers.removal_counts(run.tracks(), 7) == [("not rigid", 1)] and layers.removal_counts(run.tracks(), 70) == []


def test_one_filter_at_a_time(run: Any) -> None:
    layers = module("overlay.layers")
    history = run.tracks()
    history.status[5, 1] = TrackStatus.TOO_SHORT  # frame 7
    both = {by: len(layers.tails(run, "C", 7, 3, "before", by)[0]) for by in (layers.ALL, "TOO_SHORT", "NOT_RIGID", "TOO_FAST")}
    assert both == {layers.ALL: 6, "TOO_SHORT": 4, "NOT_RIGID": 5, "TOO_FAST": 3}
    assert layers.removal_counts(history, 7, "TOO_SHORT") == [("too short", 1)] and not layers.removal_counts(history, 7, "NOT_RIGID")


def test_points_before_the_filters_of_the_surface(run: Any, small_run: SmallRun) -> None:
    layers = module("overlay.layers")
    xy = np.arange(18.0).reshape(3, 3, 2).astype(np.float32)
    xy[2, 1] = np.nan  # C did not see it
    store.save(small_run.out / "cache" / "surface" / "0003.npz", dict(removed_px=xy, removed_why=np.array([1, 2, 2], np.uint8)), {})
    seen, counts = layers.removed_points(run, "C", 3)
    assert np.array_equal(seen, xy[:2, 1]) and counts == [("outlier", 1), ("small island", 2)]
    seen, counts = layers.removed_points(run, "L", 3, "2")
    assert np.array_equal(seen, xy[1:, 0]) and counts == [("small island", 2)]
    assert not len(layers.removed_points(run, "L", 4)[0]), "no checkpoint"


def test_looking_closer_tells_why(run: Any, small_run: SmallRun) -> None:
    layers = module("overlay.layers")
    wrist = small_run.rig["C"].project(small_run.joints_m["wrist.R"][1])
    assert layers.inspect(run, "C", 3, wrist, 3.0).lines == ("trajectory 1: removed here (not rigid)",)
    elbow = small_run.rig["C"].project(small_run.joints_m["elbow.R"][1])
    found = layers.inspect(run, "C", 3, elbow, 8.0)
    assert found.lines[0] == "point: sigma 1.00 mm" and found.lines[-1] == "trajectory 0: kept" and set(found.xy_px) == {"L", "C", "R"}
    assert not found.matched_boxes and "cache" in found.lines[1]
    assert layers.inspect(run, "C", 3, np.array([2.0, 2.0]), 3.0) is None and layers.inspect(run, "C", 99, elbow, 3.0) is None


def test_the_table_of_frames_has_guessed_limbs(run: Any, scene: Any, small_run: SmallRun) -> None:
    """They are in the list of the worst frames, the graph and the markers of the scene."""
    from tricap.core.motion.tables import read_joints

    results, joints = module("overlay.results"), small_run.out / "joints.csv"
    bad = FRAMES[2]
    assert [reason for reason in run.doubt()[1] if reason] == ["large residuals"]
    lines = joints.read_text().splitlines()
    guessed = [line.replace(",seen", ",guessed") if line.split(",")[0] in ("4", "5") and ",wrist.R," in line else line for line in lines]
    joints.write_text("\n".join(guessed))
    assert read_joints(joints).known["wrist.R"].count("guessed") == 2
    reasons = dict(zip(FRAMES, results.current(scene).doubt()[1]))
    assert {frame: reason for frame, reason in reasons.items() if reason} == {
        bad: "large residuals", 4: "right arm guessed", 5: "right arm guessed"}  # fmt: skip
    contents, warnings = module("scene.contents"), list[str]()
    assert contents.doubtful_in(small_run.out, warnings) == ((bad, bad, "large residuals"), (4, 5, "right arm guessed")) and not warnings
    joints.write_text("\n".join(guessed).replace("guessed", "perhaps"))
    assert contents.doubtful_in(small_run.out, warnings) == ((bad, bad, "large residuals"),) and "“perhaps”" in warnings[0]


def test_the_curve_of_a_graph() -> None:
    from tricap.addon.overlay.layers import graph_curve

    height, usual = graph_curve(np.array([1.0, 2.0, np.nan, 2.0, 9.0]))
    assert usual == 2.0 and np.allclose(height, [0.25, 0.5, np.nan, 0.5, 1.0], equal_nan=True)
    assert graph_curve(np.array([np.nan]))[1] == 0.0 and graph_curve(np.zeros(2))[0].tolist() == [0.5, 0.5]


def test_switches_are_saved_and_off_at_first(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    shown = scene.tricap_overlay
    assert not (shown.points or shown.tracks or shown.contour or shown.body or shown.graph)
    shown.tracks, shown.which, shown.tail = True, "removed", 5
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a é.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "a é.blend"))
    shown = blender.context.scene.tricap_overlay
    assert shown.tracks and shown.which == "removed" and shown.tail == 5


def test_going_to_a_frame(blender: ModuleType, scene: Any) -> None:
    assert blender.ops.tricap.go_to_frame(frame=5) == {"FINISHED"} and scene.frame_current == 5
    assert not blender.ops.tricap.look_closer.poll()


@pytest.fixture
def drawn(blender: ModuleType, run: Any, scene: Any) -> Any:
    """Draws overlays of view C into a picture, 3 region pixels per image pixel; gives its RGB (H, W, 3), top row first."""
    if blender.app.version < (5, 0, 0):
        pytest.skip("Blender 4.5 draws only in a window")
    import gpu
    from mathutils import Matrix

    gpu.init()
    zoom, width, height = 3, 3 * SIZE[0], 3 * SIZE[1]
    view2d = SimpleNamespace(region_to_view=lambda x, y: (x / width, y / height))
    sheet = module("overlay.canvas").Canvas(SimpleNamespace(view2d=view2d, width=width, height=height, x=0, y=0), SIZE)
    assert sheet.zoom == zoom

    def draw(**switches: Any) -> np.ndarray:
        for name, value in switches.items():
            setattr(scene.tricap_overlay, name, value)
        target = gpu.types.GPUOffScreen(width, height)
        with target.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 1.0))
            with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
                gpu.matrix.load_matrix(Matrix.Identity(4))
                to_clip = Matrix.Translation((-1, -1, 0)) @ Matrix.Diagonal((2 / width, 2 / height, 1, 1))
                gpu.matrix.load_projection_matrix(to_clip)
                module("overlay.draw").draw_overlays(run, scene.tricap_overlay, "C", 3, sheet)
            picture = np.array(gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 3, 0, "FLOAT").to_list())
        target.free()
        return picture[::-1]

    return draw


def lit(picture: np.ndarray, xy_px: np.ndarray) -> np.ndarray:
    """The brightest colour within a region pixel or two of an image pixel."""
    column, row = np.rint(3 * (np.asarray(xy_px) + 0.5)).astype(int)
    return picture[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3].reshape(-1, 3).max(axis=0)


@pytest.mark.slow
def test_it_is_drawn_where_it_is(drawn: Any, run: Any, small_run: SmallRun) -> None:
    assert drawn().max() == 0.0, "everything is off"
    picture = drawn(points=True, most_sigma_mm=2.0)
    for xy in small_run.rig["C"].project(run.points(3).xyz_m)[:10]:
        assert lit(picture, xy)[1] > 0.8
    store.save(
        small_run.out / "cache" / "surface" / "0003.npz",
        dict(removed_px=np.array([[[10, 9], [12, 9], [14, 9]]], np.float32), removed_why=np.ones(1, np.uint8)),
        {},
    )
    assert lit(drawn(), [12, 9]).max() == 0.0
    assert lit(drawn(which_points="both"), [12, 9])[0] > 0.9 and lit(drawn(which_points="before"), [12, 9])[2] > 0.9
    picture = drawn(which_points="removed")
    kept = small_run.rig["C"].project(run.points(3).xyz_m)[:10]
    assert lit(picture, [12, 9])[0] > 0.9 and not any(lit(picture, xy)[1] > 0.8 for xy in kept)
    assert lit(drawn(point_filter="2"), [12, 9]).max() == 0.0, "another filter took it out"
    picture = drawn(points=False, which_points="kept", point_filter="ALL", body=True)
    corners = small_run.rig["C"].project(small_run.joints_m["elbow.R"][1] + 0.1 * np.array([[-1, 0, 0], [1, 0, 0]]))
    for xy in corners:
        assert lit(picture, xy)[0] > 0.8 and lit(picture, xy)[2] < 0.4
    picture = drawn(body=False, contour=True)
    assert lit(picture, [40, 20])[2] > 0.8 and lit(picture, [20, 40])[0] > 0.8 and lit(picture, [40, 40]).max() < 0.2
    picture = drawn(contour=False, tracks=True, which="both")
    way = small_run.rig["C"].project(small_run.joints_m["elbow.R"][:2]).mean(axis=0)
    assert lit(picture, way)[2] > 0.6
    module("overlay.draw").show_inspection(3, module("overlay.layers").inspect(run, "C", 3, corners.mean(axis=0), 9.0))
    assert drawn(tracks=False, graph=True).max() > 0.5
    module("overlay.draw").show_inspection(-1, None)


def test_the_clicks_are_drawn_where_they_are(blender: ModuleType, drawn: Any, scene: Any, run: Any) -> None:
    draw, sessions = module("clicking.draw"), module("clicking.click_session")
    finder = SimpleNamespace(cameras=list(run.cameras.values()), ask=id)
    session = sessions.ClickSession(module("project").clips_of(scene), ["elbow.R"], 3, finder)
    session.click("L", np.array([60.0, 70.0]))
    session.proposals = {"C": Proposal(xy_px=np.array([100.0, 50.0]), sigma_px=0.5, correlation=0.9)}
    curve = session.curves("C")["L"]
    overlays = module("overlay.draw")
    before = overlays.draw_overlays
    overlays.draw_overlays = lambda run, shown, view, frame, sheet: draw.draw_session(session, view, sheet, (30, 30))
    try:
        picture = drawn()
    finally:
        overlays.draw_overlays = before
    inside = curve[(curve > 8).all(axis=1) & (curve < np.array(SIZE) - 8).all(axis=1)]
    assert len(inside) > 5 and all(lit(picture, xy)[2] > 0.5 for xy in inside)
    assert lit(picture, np.array([100.0 + 11 / 3, 50.0]))[1] > 0.8, "the ring of the proposal"


@pytest.mark.slow
def test_a_real_run_is_looked_at_and_corrected(blender: ModuleType, empty: ModuleType, tmp_path: Path) -> None:
    from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

    make_arm_take(tmp_path / "arm", ArmTakeSettings(frames=3, width_px=384, interlaced="none"))
    scene, ops, layers = empty.context.scene, empty.ops.tricap, module("overlay.layers")
    module("project").open_take(scene, tmp_path / "arm")
    scene.tricap.out = str(tmp_path / "out")
    assert ops.track() == {"FINISHED"}
    run = module("overlay.results").current(scene)
    points, history = run.points(1), run.tracks()
    assert len(points.xyz_m) > 500 and np.isfinite(points.correlation).all() and history.kept.sum() > 100
    number = int(np.flatnonzero(history.kept[1])[10])
    xy = history.at(run.cameras["L"], 1)[0][number]
    found = layers.inspect(run, "L", 1, points.xy_px[100, 0], 4.0)
    assert set(found.matched_boxes) == {"L", "C", "R"} and np.isfinite(found.matched_boxes["R"]).all()
    assert ops.remove_trajectory(view="L", frame=1, x=float(xy[0]), y=float(xy[1])) == {"FINISHED"}
    assert ops.track() == {"FINISHED"}
    run = module("overlay.results").current(scene)
    status = run.tracks().status[:, number]
    assert set(status[np.isfinite(run.tracks().xyz_m[:, number, 0])]) == {TrackStatus.REMOVED_BY_USER}
    assert ops.follow_contours(view="C") == {"FINISHED"} and scene.tricap_overlay.contour
    contour = module("overlay.results").current(scene).contour("C", 1)
    outline, on_edge = contour.xy_px, contour.on_edge
    assert len(outline) > 50 and on_edge.mean() > 0.4
    scene.tricap.contour.spacing_px = 8.0
    assert ops.follow_contours(view="C") == {"FINISHED"}
    assert len(module("overlay.results").current(scene).contour("C", 1).xy_px) == pytest.approx(len(outline) / 2, rel=0.1)
    with pytest.raises(RuntimeError, match="no fitted body"):
        ops.follow_contours(view="C", from_body=True)
