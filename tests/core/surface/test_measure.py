"""Measuring whole takes: from the clicked frame both ways, seeds of every kind, checkpoints, and a resumed run that is the same run."""

import shutil
from dataclasses import fields, replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.geometry.rig import Rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.matching.region_growing import MatchedField
from tricap.core.matching.seeds import Approximations
from tricap.core.results.folder import Results
from tricap.core.run import take_run
from tricap.core.surface import measure, starts
from tricap.core.surface.cloud import PointCloud
from tricap.core.surface.measure import MeasuredFrame
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

from ...waiting import seconds_to_cancel

COARSE = {"growing": {"spacing_px": 8}}


def same(a: MeasuredFrame, b: MeasuredFrame) -> None:
    """Byte-equal fields and clouds."""
    p, q = a.foreground, b.foreground
    assert (a.frame, a.key, p.depth_range_m, p.method) == (b.frame, b.key, q.depth_range_m, q.method)
    assert p.planes.tobytes() == q.planes.tobytes()
    assert a.removed_px.tobytes() == b.removed_px.tobytes() and a.removed_why.tobytes() == b.removed_why.tobytes()
    for one, other, cls in ((a.field, b.field, MatchedField), (a.cloud, b.cloud, PointCloud)):
        for f in fields(cls):
            x, y = getattr(one, f.name), getattr(other, f.name)
            assert x.tobytes() == y.tobytes() and x.dtype == y.dtype if isinstance(x, np.ndarray) else x == y, f.name


def changed(take: Path, folder: Path, more: str) -> Path:
    shutil.copytree(take, folder)
    (folder / "take.toml").write_text((folder / "take.toml").read_text() + more)
    return folder


def test_the_same_input_gives_the_same_bytes(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    one, other = (scenes.measure(plane_take, tmp_path / name, frames=(0, 2)) for name in "ab")
    for a, b in zip(one, other, strict=True):
        same(a, b)


def test_every_frame_has_a_surface_of_its_own(tmp_path: Path, scenes: Any) -> None:
    """A plane that comes nearer by 3 cm a frame: each cloud lies on the plane of its frame."""
    first = scenes.Body(half_m=(0.2, 0.15))
    planes = [first.moved(np.eye(3), [0.0, 0.0, -0.03 * i]) for i in range(3)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane] for plane in planes])
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    assert [m.frame for m in measured] == [m.cloud.frame for m in measured] == [0, 1, 2]
    for m, plane in zip(measured, planes):
        assert len(m.cloud.xyz_m) > 100 and np.median(np.abs(plane.distance_m(m.cloud.xyz_m))) < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("seed_frame", [0, 2])
def test_a_resumed_run_is_the_same_run(
    plane_take: Path, tmp_path: Path, scenes: Any, seed_frame: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cancelled in the middle of the third frame, then run again: byte-equal, and what was finished is not computed twice."""
    take = changed(plane_take, tmp_path / "take", f"[seeds]\nframe = {seed_frame}\n")
    whole = scenes.measure(take, tmp_path / "whole", COARSE)

    def stop(stage: str, done: float, total: float) -> None:
        if done >= 2.5:
            monitor.cancel()

    monitor = Monitor(stop)
    with pytest.raises(Cancelled):
        scenes.measure(take, tmp_path / "parts", COARSE, monitor)
    kept = sorted(p.stem for p in (tmp_path / "parts" / "cache" / "surface").iterdir())
    assert kept == {0: ["0000", "0001"], 2: ["0002", "0003"]}[seed_frame]
    computed = []
    once = measure._measure
    monkeypatch.setattr(measure, "_measure", lambda *args: computed.append(args) or once(*args))
    resumed = scenes.measure(take, tmp_path / "parts", COARSE)
    assert len(computed) == 2
    for a, b in zip(whole, resumed):
        same(a, b)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["image", "rig", "setting", "click"])
def test_what_changes_is_measured_again(plane_take: Path, tmp_path: Path, scenes: Any, what: str) -> None:
    """A checkpoint is used only where everything it depends on is as it was: the frame itself, and the frames before it."""
    take = changed(plane_take, tmp_path / "take", "[seeds]\nframe = 0\n")
    before, settings = scenes.measure(take, tmp_path / "out", COARSE), COARSE
    if what == "image":
        path = take / "L" / "0002.png"
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        path.write_bytes(cv2.imencode(".png", 255 - picture)[1].tobytes())
    elif what == "rig":
        text = (take / "rig.toml").read_text()
        (take / "rig.toml").write_text(text.replace("translation = [", "translation = [1e-9, 0.0, 0.0] # ", 1))
    elif what == "setting":
        settings = COARSE | {"matching": {"max_shift_px": 2.9}}
    else:
        (take / "take.toml").write_text((take / "take.toml").read_text() + '"surface" = [{ L = [100, 75], C = [100, 75] }]\n')
    try:
        after = scenes.measure(take, tmp_path / "out", settings)
    except InputError:
        assert what in ("rig", "click")  # nonsense, and noticed
        return
    assert [a.key == b.key for a, b in zip(before, after)] == [what == "image", what == "image", False, False]


def test_a_damaged_checkpoint_is_measured_again(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    before = scenes.measure(plane_take, tmp_path / "out", COARSE)
    path = tmp_path / "out" / "cache" / "surface" / "0001.npz"
    path.write_bytes(path.read_bytes()[:5000])
    for a, b in zip(before, scenes.measure(plane_take, tmp_path / "out", COARSE)):
        same(a, b)


def moving_body_before_a_wall(scenes: Any, frames: int) -> list[list[Any]]:
    """A bare-armed cylinder that stands still for two frames and then moves, before a textured wall that never does."""
    wall = scenes.Body(half_m=(5, 5), t=np.array([0.0, 0.0, 4.3]), seed=9, shortest_m=0.05)
    body = scenes.Body(radius_m=0.09, half_m=(1.0, 0.18), t=np.array([-0.1, 0.0, 2.0]))
    return [[wall, body.moved(np.eye(3), [0.06 * max(0, i - 1), 0.0, 0.0])] for i in range(frames)]


def test_the_person_and_not_the_wall(tmp_path: Path, scenes: Any) -> None:
    bodies = moving_body_before_a_wall(scenes, 4)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), bodies)
    for m, (_, body) in zip(scenes.measure(take, tmp_path / "out"), bodies):
        assert m.foreground.method in ("nearest surface", "frame before")
        distance = body.distance_m(m.cloud.xyz_m)
        assert len(distance) > 200 and np.mean(np.abs(distance) < 0.02) > 0.9 and (m.cloud.xyz_m[:, 2] < 3.2).all()


def test_one_frame_alone_whose_clicks_are_of_another(tmp_path: Path, scenes: Any) -> None:
    """`--frames 3:4` of a take clicked in frame 0: the person is what moved, though she could have got to the wall."""
    rig, bodies = scenes.three_cameras(), moving_body_before_a_wall(scenes, 4)
    take = scenes.write_take(tmp_path / "take", rig, bodies)
    at = ", ".join("{} = [{:.1f}, {:.1f}]".format(c.name, *c.project(np.array([-0.1, 0.0, 2.0]))) for c in rig.cameras)
    text = (take / "take.toml").read_text().replace("fps = 25.0", "fps = 2.0")
    (take / "take.toml").write_text(text + f'[seeds]\nframe = 0\n[seeds.joints]\n"elbow.R" = {{ {at} }}\n')
    footage = take_run.only_frames(open_take(read_take(take)), (3, 4))
    s = take_run.settings_of({}, {}, "take.toml")
    (m,) = measure.measure_frames(footage, replace(starts.MeasureSettings.of(s), enhance=None), Results(tmp_path / "out"), Monitor())
    assert m.foreground.method == "clicks and nearest surface" and m.foreground.depth_range_m[1] < 4
    distance = bodies[3][1].distance_m(m.cloud.xyz_m)
    assert len(distance) > 200 and np.mean(np.abs(distance) < 0.02) > 0.9


@pytest.mark.slow
def test_a_checkpoint_belongs_to_the_frame_that_showed_the_room(tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames 0:2 first and then all of them, into one folder, must give what all of them give at once. The background planes differ
    with the frame that frame 0 is compared with; here the number of seeds that stand still is written into a plane far away."""
    monkeypatch.setattr(starts.fg, "background_planes", lambda static, *_: np.array([[0, 0, -1.0, -20.0 - len(static)]]))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), moving_body_before_a_wall(scenes, 4))
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace("[[views]]", "frames = [0, 2]\n[[views]]", 1))
    scenes.measure(take, tmp_path / "out", COARSE)
    (take / "take.toml").write_text(text)
    for a, b in zip(scenes.measure(take, tmp_path / "out", COARSE), scenes.measure(take, tmp_path / "fresh", COARSE)):
        same(a, b)


def test_clicked_depths(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    """Clicks on joints choose the depths; a clicked surface seed far from the swept ones is one more seed."""
    rig = scenes.three_cameras()
    X = np.array([0.05, 0.02, 2.1])
    at = "{ " + ", ".join(f"{c.name} = [{c.project(X)[0]:.2f}, {c.project(X)[1]:.2f}]" for c in rig.cameras) + " }"
    joints = changed(plane_take, tmp_path / "joints", f'[seeds.joints]\n"elbow.R" = {at}\n')
    surface = changed(plane_take, tmp_path / "surface", f"[seeds]\nsurface = [{at}]\n")
    for take in (joints, surface):
        first = scenes.measure(take, tmp_path / f"out {take.name}", frames=(0, 1))[0]
        near, far = first.foreground.depth_range_m
        assert first.foreground.method == "clicks" and near < 2.1 < far and far - near < 1.3
        assert len(first.cloud.xyz_m) > 200
    only_l = f"{{ L = [{rig['L'].project(X)[0]:.2f}, {rig['L'].project(X)[1]:.2f}], R = [{rig['R'].project(X)[0]:.2f}, 75.0] }}"
    seed = changed(plane_take, tmp_path / "without C", f"[seeds]\nsurface = [{only_l}]\n")
    assert len(scenes.measure(seed, tmp_path / "out seed", frames=(0, 1))[0].cloud.xyz_m) > 200


def no_seeds(*args: Any, **kwargs: Any) -> Approximations:
    return Approximations(xy=np.zeros((0, 3, 2)), shape=np.zeros((0, 3, 2, 2)), depth_m=np.zeros(0))


@pytest.mark.slow
@pytest.mark.parametrize(("views", "off_px"), [("LR", (0, 0)), ("LR", (4, -4)), ("LCR", (-4, 4))])
def test_one_clicked_seed_is_enough(
    plane_take: Path, tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch, views: str, off_px: tuple[int, int]
) -> None:
    """Without any automatic seed: a click far from the middle, in views that converge, wrong by 4 px along the row in L and R."""
    monkeypatch.setattr(starts, "sweep_seeds", no_seeds)
    rig, plane = scenes.three_cameras(), scenes.Body(R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))
    ray = rig["C"].rays(np.array([150.0, 110.0]))
    X = ray * plane.hit(np.zeros(3), ray[None])[0][0]
    wrong = {"L": off_px[0], "C": 0, "R": off_px[1]}
    at = ", ".join("{} = [{:.2f}, {:.2f}]".format(v, *(rig[v].project(X) + (wrong[v], 0))) for v in views)
    take = changed(plane_take, tmp_path / "take", f"[seeds]\nsurface = [{{ {at} }}]\n")
    footage = take_run.only_frames(open_take(read_take(take)), (0, 1))
    s = take_run.settings_of({}, {}, "take.toml")
    (m,) = measure.measure_frames(footage, replace(starts.MeasureSettings.of(s), enhance=None), Results(tmp_path / "out"), Monitor())
    assert len(m.cloud.xyz_m) > 200 and np.median(np.abs(plane.distance_m(m.cloud.xyz_m))) < 0.001


def test_seeds_follow_the_reference_and_the_settings(tmp_path: Path, scenes: Any) -> None:
    """`tricap seeds` covers a reference view that is larger than the first view, and uses enhanced images where they are set."""
    small, large = scenes.three_cameras(width=120, height=90), scenes.three_cameras()
    rig = Rig(cameras=(small["L"], large["C"], large["R"]))
    footage = open_take(read_take(scenes.write_take(tmp_path / "take", rig, [[scenes.Body()]])))
    s = take_run.settings_of({}, {"enhance": {"wallis": "on"}}, "take.toml")
    plain, enhanced = (
        starts.first_seeds(footage, replace(starts.MeasureSettings.of(s), enhance=enhance), 0, Monitor())[1]
        for enhance in (None, s["enhance"])
    )
    assert plain.xy[:, 1, 0].max() > 120 and len(enhanced.depth_m)
    both = [np.flatnonzero((plain.xy[:, 1] == at).all(axis=1)) for at in enhanced.xy[:, 1]]
    assert any(len(i) and plain.depth_m[i[0]] != enhanced.depth_m[n] for n, i in enumerate(both))


@pytest.mark.parametrize("where", ["joints", "surface"])
def test_clicks_that_have_no_place_in_space(plane_take: Path, tmp_path: Path, scenes: Any, where: str) -> None:
    line = '[seeds.joints]\n"elbow.R" = {}\n' if where == "joints" else "[seeds]\nsurface = [{}]\n"
    for i, (at, said) in enumerate(
        (
            ("{ L = [100.0, 75.0] }", "is clicked in 1 view.* Click it in two views at least"),
            ("{ L = [100.0, 60.0], C = [100.0, 95.0] }", "miss each other by .* px. Click the same spot in every view, and check"),
            ("{ L = [100.0, 140.0], C = [100.0, 75.0], R = [100.0, 75.0] }", "in every view; look at view L first, and check"),
            ("{ L = [0.0, 75.0], C = [199.0, 75.0] }", "has no position in space"),  # rays that diverge
        )
    ):
        take = changed(plane_take, tmp_path / f"take{i}", line.replace("{}", at))
        with pytest.raises(InputError, match=said):
            scenes.measure(take, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.*"))


def test_swapped_views_are_noticed(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    (take / "L").rename(take / "X")
    (take / "R").rename(take / "L")
    (take / "X").rename(take / "R")
    with pytest.raises(InputError, match="No surface could be measured in frame 0.* Check that rig.toml belongs to this footage"):
        scenes.measure(take, tmp_path / "out")


def test_a_person_who_leaves_is_not_the_end(tmp_path: Path, scenes: Any) -> None:
    """Frames without any surface in the middle: empty clouds, and measured again when there is something to see."""
    plane = scenes.Body(half_m=(0.2, 0.15), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane], [], [], [plane]])
    points = [len(m.cloud.xyz_m) for m in scenes.measure(take, tmp_path / "out", COARSE)]
    assert points[1:3] == [0, 0] and points[3] > 0.9 * points[0] > 75
    again = scenes.measure(take, tmp_path / "out", COARSE)  # empty clouds are checkpoints too
    assert [len(m.cloud.xyz_m) for m in again] == points


def test_two_views_are_enough(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    scenes.write_take_toml(take, ["C", "L"])
    first = scenes.measure(take, tmp_path / "out", frames=(0, 1))[0]
    assert len(first.cloud.xyz_m) > 200 and first.cloud.xy_px.shape[1] == 2


def test_pictures_smaller_than_a_patch(tmp_path: Path, scenes: Any) -> None:
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(width=10, height=9), [[scenes.Body()]])
    with pytest.raises(InputError, match="No surface could be measured"):
        scenes.measure(take, tmp_path / "out")


@pytest.mark.slow
def test_the_finest_seeds_that_can_be_asked_for(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    first = scenes.measure(plane_take, tmp_path / "out", {"growing": {"seed_spacing_px": 4, "spacing_px": 2}})[0]
    assert len(first.cloud.xyz_m) > 2000


def test_cancelling_takes_less_than_a_second(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    numbers = count()
    assert seconds_to_cancel(lambda monitor: scenes.measure(plane_take, tmp_path / f"out{next(numbers)}", monitor=monitor)) < 1.0
    assert not list(tmp_path.rglob("*.part"))


def test_the_person_is_followed_by_seeds_of_any_spacing(plane_take: Path, tmp_path: Path) -> None:
    with take_run.open_run(plane_take, tmp_path / "out", {"growing": {"seed_spacing_px": 54}}) as job:
        found = starts.FrameStarts(job.measured_footage, starts.MeasureSettings.of(job.settings), job.results)
        start, _ = found.at(found.first, Monitor())
    assert len(start.person_m) >= max(4, len(start.seeds.depth_m) // 2)


@pytest.mark.slow
@pytest.mark.parametrize("noise, smoothed", [(1.0, False), (20.0, True)])
def test_noise_that_hides_the_texture_is_smoothed(
    tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch, noise: float, smoothed: bool
) -> None:
    """Where clearly more seeds match in smoothed images, all is measured in these; elsewhere nothing changes."""
    plane = scenes.Body(half_m=(0.26, 0.2), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane]], noise=noise)
    now = scenes.measure(take, tmp_path / "now")[0]
    assert np.median(np.abs(plane.distance_m(now.cloud.xyz_m))) < 0.6 * scenes.pixel_m
    monkeypatch.setattr(measure, "FEWEST_MORE", 10_000)
    if smoothed:
        assert len(now.cloud.xyz_m) > 500
        with pytest.raises(measure.NothingMeasured):
            scenes.measure(take, tmp_path / "without")
    else:
        same(now, scenes.measure(take, tmp_path / "without")[0])
