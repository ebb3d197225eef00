"""Where the measurement begins when the first frame shows nothing, and which view is its reference when the list is in another order."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.checking.take_check import check_take
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.results.folder import Results
from tricap.core.run import pipeline, take_run
from tricap.core.surface.beginning import Beginning, other_beginning
from tricap.core.surface.measure import NothingMeasured
from tricap.core.surface.starts import MeasureSettings
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

COARSE = {"growing": {"spacing_px": 6}}


@pytest.fixture(scope="module")
def plane(scenes: Any) -> Any:
    return scenes.Body(half_m=(0.26, 0.2), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))


def emptied(take: Path, folder: Path, scenes: Any, frames: range) -> Path:
    """A copy in which these frames show an empty room, evenly darker to the left."""
    shutil.copytree(take, folder)
    for camera in read_rig(folder / "rig.toml").cameras:
        for frame in frames:
            picture = (scenes.render(camera, [], noise=1.0, seed=frame) + np.linspace(-60, 60, 200)).astype(np.uint8)
            (folder / camera.name / f"{frame:04d}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    return folder


def measured(take: Path, out: Path) -> tuple[list[int], dict[str, Any]]:
    """The points of each frame, and the warnings and figures of a run."""
    with take_run.open_run(take, out, COARSE) as run:
        pipeline.measure(run, Monitor())
        return [s.points for s in run.measured.summaries], run.record


@pytest.mark.slow
def test_a_take_whose_first_frames_show_nobody_begins_in_another(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    take = emptied(plane_take, tmp_path / "take", scenes, range(2))
    points, record = measured(take, tmp_path / "out")
    assert points[0] == 0 and min(points[2:]) > 300
    assert "No surface was found in frame 0. The measurement begins in frame 3." in record["warnings"]
    again, same = measured(take, tmp_path / "out")
    assert again == points and same["warnings"] == record["warnings"]


@pytest.mark.slow
def test_a_take_that_shows_nobody_fails(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    take = emptied(plane_take, tmp_path / "take", scenes, range(4))
    with pytest.raises(NothingMeasured, match="frame 0"):
        measured(take, tmp_path / "out")


def begun(take: Path, out: Path, settings: Any, points: int = 0) -> Beginning | None:
    s = take_run.settings_of({}, settings, "take.toml")
    with Results(out).opened() as results:
        return other_beginning(open_take(read_take(take)), MeasureSettings.of(s), results, Monitor(), points)


@pytest.mark.slow
def test_pairs_of_views_are_accepted_where_three_give_too_little(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    """R shows nothing: with three views no frame has points, with two of them all have. Without that defect pairs are not needed."""
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    for path in (take / "R").iterdir():
        path.write_bytes(cv2.imencode(".png", np.full((150, 200), 90, np.uint8))[1].tobytes())
    found = begun(take, tmp_path / "out", COARSE)
    assert found is not None and found.pairs and found.points > 300
    assert "No surface was found in frame 0. Points" in found.sentences(NothingMeasured(0))[0]
    enough, few = begun(take, tmp_path / "out", COARSE, 250), begun(take, tmp_path / "out", COARSE, 50)
    assert enough is not None and not enough.pairs and enough.points == 250 and enough.sentences(NothingMeasured(0, points=250)) == []
    assert (
        few is not None
        and few.pairs
        and "Hardly any surface was found in frame 0. Points" in few.sentences(NothingMeasured(0, points=50))[0]
    )
    assert begun(take, tmp_path / "published", {"growing": COARSE["growing"] | {"seed_spacing_px": 0, "pairs": True}}) is None
    three = begun(plane_take, tmp_path / "three", {"growing": {"spacing_px": 4}})
    assert three is not None and not three.pairs and three.points > 700


@pytest.mark.slow
def test_a_first_frame_with_few_points_that_a_view_contradicts_is_no_beginning(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    """R is calibrated 3 px too low, by which its rays miss nearly as much as a match may. What was found is kept if nothing is better."""
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    lower = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    cameras = [replace(c, matrix=c.matrix + lower * (c.name == "R")) for c in read_rig(take / "rig.toml").cameras]
    write_rig(take / "rig.toml", Rig(cameras=tuple(cameras)))
    with pytest.raises(NothingMeasured) as error:
        scenes.measure(take, tmp_path / "first", COARSE)
    few = error.value.points
    assert 100 < few < 300
    points, record = measured(take, tmp_path / "out")
    assert abs(points[0] - few) < 20 and not any("surface was found" in w for w in record["warnings"])


def far_camera(scenes: Any, near_m: float) -> Camera:
    """F, 80° from C, so far away that the nearest depth by the longest base lies behind the plane."""
    values = {name: getattr(scenes.three_cameras()["C"], name) for name in Camera.__dataclass_fields__}
    R = rotation_from_vector(np.array([0.0, np.radians(80.0), 0.0]))
    centre = np.array([0.0, 0.0, near_m]) - R[2] * 3.0
    return Camera(**values | dict(name="F", R_cam_world=R, t_cam_world_m=-R @ centre))


def test_a_camera_on_the_other_side_does_not_hide_the_person(tmp_path: Path, scenes: Any, plane: Any) -> None:
    """F looks from the side: it is not matched, and the depths that are searched depend on the other cameras."""
    three = scenes.three_cameras()
    rig = Rig(cameras=(three["L"], far_camera(scenes, scenes.depth_m), three["R"], three["C"]))
    alone = scenes.measure(scenes.write_take(tmp_path / "three", three, [[plane]]), tmp_path / "out3", COARSE)[0]
    take = scenes.write_take(tmp_path / "four", rig, [[plane]])
    found = scenes.measure(take, tmp_path / "out4", COARSE)[0]
    assert len(found.cloud.xyz_m) == len(alone.cloud.xyz_m) > 350
    assert np.isnan(found.cloud.xy_px[:, 1]).all() and np.abs(found.cloud.xyz_m - alone.cloud.xyz_m).max() < 1e-5


def test_the_run_and_the_check_report_the_reference_view(plane_take: Path, tmp_path: Path) -> None:
    """The cameras are listed as L, R, C: C is the reference view, and that is reported; a view that take.toml names is not replaced."""
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    text = (take / "take.toml").read_text()
    views = {name: f'[[views]]\nname = "{name}"\nimages = "{name}/*.png"\n' for name in "LCR"}
    (take / "take.toml").write_text(text.replace("".join(views.values()), views["L"] + views["R"] + views["C"]))
    assert open_take(read_take(take)).take.reference_view == "C"
    note = "The reference view is C, not R in the middle of the list: two other views look from within 9° of it, and of R from within 18°."
    points, record = measured(take, tmp_path / "out")
    assert min(points) > 300 and record["reference_view"] == "C" and record["reference_note"].startswith(note)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["reference_note"] == record["reference_note"]
    assert any(note in line for line in check_take(take, Monitor()).notes)
    named = text.replace("[[views]]", 'reference_view = "R"\n[[views]]', 1)
    (take / "take.toml").write_text(named)
    assert (open_take(read_take(take)).take.reference_view, open_take(read_take(take)).reference_note) == ("R", "")
    (take / "take.toml").write_text(text)
    assert open_take(read_take(take)).reference_note == ""


def test_nothing_else_is_tried_where_no_view_looks_from_nearby(tmp_path: Path, scenes: Any, plane: Any) -> None:
    rig = Rig(cameras=(far_camera(scenes, scenes.depth_m), scenes.three_cameras()["C"]))
    take = scenes.write_take(tmp_path / "take", rig, [[plane], [plane]])
    assert begun(take, tmp_path / "out", COARSE) is None
