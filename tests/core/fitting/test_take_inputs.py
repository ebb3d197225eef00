"""Keypoints and outlines from files: OpenPose, COCO, TRC, CSV; the names of joints; what is refused."""

import json
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.checking.take_check import joint_findings
from tricap.core.fitting.inputs.clicks import check_apart
from tricap.core.fitting.inputs.take_inputs import clicks_in, clicks_left_out, joint_named, missing_for_fit, read_contours, read_source
from tricap.core.foundation.errors import InputError
from tricap.core.images.interlace import FieldLayout
from tricap.core.motion.formats.keypoints_json import LAYOUTS
from tricap.core.motion.formats.markers import Markers
from tricap.core.motion.formats.trc import write_trc
from tricap.core.results.folder import Results
from tricap.core.take.footage import Footage
from tricap.core.take.sources import keypoint_sources
from tricap.core.take.take import JOINTS, FrameClicks


def _footage(folder):
    views = tuple(SimpleNamespace(name=name, offset_frames=n, has_clock=False) for name, n in (("L", 0), ("C", 2)))
    take = SimpleNamespace(folder=folder, views=views, field_layout=FieldLayout(), frames=(0, 12))
    footage = SimpleNamespace(take=take, clocks=(), sequences=[SimpleNamespace(count=14)] * 2, sizes_px=[(768, 576)] * 2)
    footage.frames_of_images = partial(Footage.frames_of_images, footage)
    return footage


def _source(**table):
    return keypoint_sources([table], ["L", "C"], JOINTS, "take.toml")[0]


def _person(x: float, confidence: float = 0.9) -> list[float]:
    return [v for k in range(25) for v in (x + k, 10.0 * k, confidence if k != 11 else 0.0)]


def _openpose(folder, *frames) -> None:
    folder.mkdir()
    for i, people in enumerate(frames):
        (folder / f"C_{i:03d}_keypoints.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": p} for p in people]}))


def test_openpose_follows_one_person_in_the_takes_frames(tmp_path) -> None:
    _openpose(tmp_path / "kp", [_person(0)], [], [_person(500), _person(4)], [_person(8), _person(510)])
    found = read_source(_footage(tmp_path), _source(files="kp/*.json", view="C", sigma=6.0))
    knee = [i for i, joint in enumerate(found.joint) if joint == "knee.R"]
    assert found.frame[knee].tolist() == [-2, 0, 1]  # the view is two frames late; nobody was found in one
    assert found.place[knee, 0].tolist() == [10.0, 14.0, 18.0]
    assert "ankle.R" not in found.joint  # without confidence
    assert found.sigma[knee[0]] == pytest.approx(6.0 / 0.9**0.5)


def test_points_that_are_no_numbers_or_far_from_any_image_are_not_there(tmp_path) -> None:
    far, nowhere = [[value, 5.0, 0.9] * 25 for value in (1e308, float("inf"))]
    _openpose(tmp_path / "kp", [_person(0)], [far, _person(4)], [nowhere], [far[:15] + _person(8)[15:]])
    found = read_source(_footage(tmp_path), _source(files="kp/*.json", view="C"))
    assert set(found.frame.tolist()) == {-2, -1, 1} and np.abs(found.place).max() < 1e4


def test_a_missing_file_shifts_no_other(tmp_path) -> None:
    _openpose(tmp_path / "kp", [_person(0)], [_person(4)], [_person(8)], [_person(12)])
    (tmp_path / "kp" / "C_001_keypoints.json").unlink()
    found = read_source(_footage(tmp_path), _source(files="kp/*.json", view="L"))
    assert sorted(set(found.frame.tolist())) == [0, 2, 3]
    (tmp_path / "kp" / "C_002_keypoints.json").rename(tmp_path / "kp" / "C_b_keypoints.json")  # no number: the order counts
    found = read_source(_footage(tmp_path), _source(files="kp/*.json", view="L"))
    assert sorted(set(found.frame.tolist())) == [0, 1, 2]


def test_two_files_of_one_image_are_refused(tmp_path) -> None:
    """They were counted in the order of their names, so that every later file was shifted."""
    _openpose(tmp_path / "kp", [_person(0)], [_person(4)], [_person(8)])
    (tmp_path / "kp" / "C_1_keypoints.json").write_text((tmp_path / "kp" / "C_001_keypoints.json").read_text())
    with pytest.raises(InputError, match="C_0*1_keypoints.json are both of image 1; remove"):
        read_source(_footage(tmp_path), _source(files="kp/*.json", view="L"))
    for number in range(4):
        (tmp_path / "kp" / f"{number}_camera2.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": _person(number)}]}))
    found = read_source(_footage(tmp_path), _source(files="kp/*_camera2.json", view="L"))
    assert sorted(set(found.frame.tolist())) == [0, 1, 2, 3], "the number of the camera is not that of the image"


def test_keypoints_of_no_frame_of_the_take_are_refused(tmp_path) -> None:
    """They were ignored without a word."""
    _openpose(tmp_path / "kp", [_person(0)], [_person(4)])
    with pytest.raises(InputError, match="are of the frames -99 to -98 of the take, which has the frames 0 to 11; correct `offset_frames`"):
        read_source(_footage(tmp_path), _source(files="kp/*.json", view="L", offset_frames=99))
    (tmp_path / "p.csv").write_text("frame,time_s,RKnee x,RKnee y,RKnee z\n70,0,1,2,3\n73,1,1,2,3\n")
    with pytest.raises(InputError, match="“p.csv” are of the frames 70 to 73 of the take"):
        read_source(_footage(tmp_path), _source(files="p.csv"))
    assert len(read_source(_footage(tmp_path), _source(files="p.csv", offset_frames=62)).frame) == 2


@pytest.mark.parametrize(
    ("frames", "seeds", "keyframes", "used", "said"),
    [
        (range(0, 9), 2, (5,), [2, 5], ""),
        (range(0, 4), 2, (5,), [2], "in frame 5 are not used: only frames 0 to 3 are fitted."),
        (range(4, 9), 2, (5,), [5], "in frame 2 .* begins at other clicks"),
        (range(6, 9), 2, (5,), [], "in frames 2, 5 are not used.* or by itself"),
    ],
)
def test_clicks_outside_the_frames_are_left_out(frames, seeds, keyframes, used, said) -> None:
    joints = {"knee.R": {"L": np.zeros(2)}}
    take = SimpleNamespace(
        clicks=FrameClicks(frame=seeds, joints=joints),
        keyframes=tuple(FrameClicks(frame=f, joints=joints) for f in keyframes),
        body_model="full",
        joints_model="full",
        keypoints=(),
    )
    footage = SimpleNamespace(take=take, frames=frames)
    assert sorted(clicks_in(footage)) == used
    assert not missing_for_fit(footage)  # without clicks the body starts by itself
    warnings = clicks_left_out(footage)
    assert len(warnings) == bool(said) and all(re.search(said, w) for w in warnings)


def test_clicks_of_joints_that_the_body_does_not_have_are_named() -> None:
    """They were ignored without a word."""
    at = {"L": np.zeros(2), "C": np.zeros(2)}
    clicks = FrameClicks(frame=2, joints={"shoulder.R": at, "elbow.R": at})
    keyframes = (FrameClicks(frame=5, joints={"elbow.R": at, "knee.L": at}),)
    take = SimpleNamespace(clicks=clicks, keyframes=keyframes, body_model="arm.R", joints_model="arm.R", keypoints=())
    (said,) = clicks_left_out(SimpleNamespace(take=take, frames=range(9)))
    assert said.startswith("The clicks of knee.L (frame 5) are not used: the body “arm.R” has only shoulder.R, elbow.R, wrist.R.")
    assert said in [finding.sentence for finding in joint_findings(take)]
    assert clicks_left_out(SimpleNamespace(take=SimpleNamespace(**{**vars(take), "joints_model": "full"}), frames=range(9))) == []


def test_joints_that_are_not_clicked_or_clicked_at_one_place_are_named() -> None:
    at = {"L": np.zeros(2), "C": np.ones(2)}
    clicks = FrameClicks(frame=2, joints={"shoulder.R": at, "elbow.R": {view: xy + 40 for view, xy in at.items()}})
    take = SimpleNamespace(clicks=clicks, keyframes=(), body_model="arm.R", joints_model="arm.R", keypoints=())
    assert [finding.sentence for finding in joint_findings(take)][0].startswith("Not clicked in two views: wrist.R.")
    check_apart(clicks.joints, 2)
    with pytest.raises(
        InputError, match="elbow.R and wrist.R are clicked at the same pixels in frame 2; click each joint at its own place"
    ):
        check_apart({**clicks.joints, "wrist.R": clicks.joints["elbow.R"]}, 2)


def test_coco_annotations_and_results(tmp_path) -> None:
    rows = [{"image_id": f"{i:04d}.jpg", "keypoints": [float(v) for k in range(17) for v in (k, i, 0.8)]} for i in (3, 10)]
    (tmp_path / "results.json").write_text(json.dumps(rows))
    found = read_source(_footage(tmp_path), _source(files="results.json", view="L"))
    assert sorted(set(found.frame.tolist())) == [3, 10]
    assert found.place[found.joint.index("hip.L")].tolist() == [11.0, 3.0]
    table = {
        "images": [{"id": 7, "file_name": "b10.png"}, {"id": 9, "file_name": "b2.png"}],
        "categories": [{"keypoints": ["RKnee"]}],
        "annotations": [{"image_id": 7, "keypoints": [1.0, 2.0, 2]}, {"image_id": 9, "keypoints": [3.0, 4.0, 2]}],
    }
    (tmp_path / "coco.json").write_text(json.dumps(table))
    found = read_source(_footage(tmp_path), _source(files="coco.json", view="L"))
    assert found.joint == ("knee.R", "knee.R")
    assert found.frame.tolist() == [0, 1] and found.place.tolist() == [[3.0, 4.0], [1.0, 2.0]]


def test_points_in_space(tmp_path) -> None:
    X = np.random.default_rng(0).normal(size=(4, 2, 3))
    markers = Markers(names=("RKnee", "myhip"), fps=50.0, frames=np.arange(5, 9), xyz_m=X, sigma_m=np.full((4, 2), np.nan))
    write_trc(tmp_path / "a.trc", markers)
    source = _source(files="a.trc", names={"myhip": "hip.R"}, offset_frames=5, sigma=0.03)
    found = read_source(_footage(tmp_path), source)
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3] and found.joint[:2] == ("knee.R", "hip.R") and found.view == ""
    assert np.allclose(found.place.reshape(4, 2, 3), X, atol=1e-6) and (found.sigma == 0.03).all()


@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("RKnee", "knee.R"),
        ("left_hip", "hip.L"),
        ("MidHip", "pelvis"),
        ("Neck", "neck"),
        ("LBigToe", "toe.L"),
        ("LHeel", ""),
        ("Nose", ""),
        ("crown", ""),
        ("right_wrist", "wrist.R"),
        ("elbow.L", "elbow.L"),
        ("left_eye", ""),
    ],
)
def test_names_of_joints(name: str, joint: str) -> None:
    assert joint_named(name) == joint


def test_every_layout_has_the_limbs() -> None:
    for count, names in LAYOUTS.items():
        assert len(names) == count
        assert {f"{j}.{s}" for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in "LR"} <= {joint_named(n) for n in names}


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (dict(files="kp/*.json"), "must name its view"),
        (dict(files="kp/*.json", view="X"), "must name its view"),
        (dict(files="a.trc", view="C"), "has no view"),
        (dict(files="../a.trc"), "inside the take"),
        (dict(files="a.txt"), "are read from"),
        (dict(files="a.trc", names={"a": "kne.R"}), "knee.R"),
        (dict(files="a.trc", sigmas=3), "sigma"),
        (dict(files="a.trc", sigma=-1), "positive"),
        (dict(files="a.trc", sigma=1e-308), "0.0001 to 10000"),
        (dict(files="kp/*.json", view="C", sigma=float("nan")), "0.0001 to 10000"),
    ],
)
def test_bad_sources_are_refused(table, sentence) -> None:
    with pytest.raises(InputError, match=sentence):
        _source(**table)


@pytest.mark.parametrize(("shift", "scale", "confidence", "sentence"), [
    (5000, 1, 0.9, "of view C lie outside of its images of 768×576"),
    (0, 1e-3, 0.9, "of view C lie between −1 and 1"),
    (100, 1, 0.1, "have no joint of the body with a place of a confidence of 0.2 or more"),
])  # fmt: skip
def test_keypoints_that_no_image_can_have_are_refused(tmp_path, shift: float, scale: float, confidence: float, sentence: str) -> None:
    """They were taken, counted for nothing, and nobody was told."""
    person = np.array(_person(shift, confidence)).reshape(-1, 3) * [scale, scale, 1]
    _openpose(tmp_path / "kp", [person.ravel().tolist()], [person.ravel().tolist()])
    with pytest.raises(InputError, match=sentence):
        read_source(_footage(tmp_path), _source(files="kp/*.json", view="C"))


def test_bad_files_are_refused(tmp_path) -> None:
    footage = _footage(tmp_path)
    with pytest.raises(InputError, match="There are no keypoints"):
        read_source(footage, _source(files="kp/*.json", view="C"))
    for text, sentence in (
        ("{", "no JSON"),
        ("[1]", "no known kind"),
        ('{"people": [{"pose_keypoints_2d": [1, 2]}]}', "x, y, confidence"),
        ('{"people": []}', "no person"),
        ('{"people": [{"pose_keypoints_2d": [1, 2, 1]}]}', "no known layout"),
        ('[{"image_id": 1, "keypoints": "abc"}]', "x, y, confidence"),
    ):
        (tmp_path / "k.json").write_text(text)
        with pytest.raises(InputError, match=sentence):
            read_source(footage, _source(files="k.json", view="C"))
    (tmp_path / "p.csv").write_text("frame,time_s,a x,a y,a z\n0,0,1,2,3\n")
    with pytest.raises(InputError, match="is a joint of the body; map them"):
        read_source(footage, _source(files="p.csv"))
    with pytest.raises(InputError, match="no point “b”"):
        read_source(footage, _source(files="p.csv", names={"b": "knee.R"}))


def test_contours_are_read_where_they_stand_on_an_edge(tmp_path) -> None:
    results = Results(tmp_path)
    path = results.path("contours", "C.csv")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("frame,vertex,x,y,normal_x,normal_y,sigma,on_edge\n3,0,1,2,0,1,0.4,1\n3,1,5,6,1,0,3,0\n")
    found = read_contours(results, ["L", "C"])
    xy, normal, sigma = found[0].of_frame(3)
    assert [c.view for c in found] == ["C"] and (xy.tolist(), normal.tolist(), sigma.tolist()) == ([[1.0, 2.0]], [[0.0, 1.0]], [0.4])
    assert found[0].of_frame(2) is None
    path.write_text("frame,x\n1,a\n")
    with pytest.raises(InputError, match="tricap contour"):
        read_contours(results, ["C"])
