"""`tricap joints TAKE --model FILE.onnx`: a network finds the joints in every image; rays of the views are compared; the fit reads them."""

import json
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.fitting.inputs.take_inputs import read_source
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.geometry.rig import write_rig
from tricap.core.networks.pose_network import PoseNetwork
from tricap.core.run.network_joints import joints_by_file, joints_by_network, without_contradictions, write_network_joints
from tricap.core.run.network_process import open_network
from tricap.core.take.footage import Footage, open_take
from tricap.core.take.take import read_take

from ...pose_graphs import costly_graph, drawn, greedy_graph, pose_graph
from ..conftest import Scenes

FRAMES, JOINTS = 6, 17
SIZE = (256, 192)


def person_m(frame: int) -> np.ndarray:
    """The places (17, 3) of the points in space, 4 cm further in each frame."""
    nodes = np.stack(np.meshgrid(np.linspace(-0.12, 0.12, 3), np.linspace(-0.2, 0.2, 6)), axis=-1).reshape(-1, 2)[:JOINTS]
    depth = 0.03 * np.sin(np.arange(JOINTS))
    return np.column_stack([nodes[:, 0] + 0.02 * frame, nodes[:, 1], depth])


@pytest.fixture(scope="module")
def take(scenes: Scenes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A person of dots, who walks before three cameras."""
    folder = tmp_path_factory.mktemp("dots")
    rig = scenes.three_cameras()
    for camera in rig.cameras:
        (folder / camera.name).mkdir()
        for t in range(FRAMES):
            xy = camera.project(person_m(t) + [0.0, 0.0, scenes.depth_m])
            picture = np.rint(drawn(camera.size_px, xy, radius_px=4.0)).astype(np.uint8)
            (folder / camera.name / f"{t:04d}.png").write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    write_rig(folder / "rig.toml", rig)
    more = '[body]\nmodel = "full"\n[[keypoints]]\nfiles = "kp/*.json"\nview = "C"\n'
    scenes.write_take_toml(folder, [c.name for c in rig.cameras], more=more)
    (folder / "pose.onnx").write_bytes(pose_graph("simcc", JOINTS, SIZE))
    return folder


@pytest.fixture(scope="module")
def footage(take: Path) -> Footage:
    return open_take(read_take(take))


def true_px(footage: Footage, scenes: Scenes) -> np.ndarray:
    """(V, N, K, 2)"""
    moved = [person_m(t) + [0.0, 0.0, scenes.depth_m] for t in range(FRAMES)]
    return np.array([[camera.project(xyz) for xyz in moved] for camera in footage.rig.cameras])


def test_the_joints_of_all_images_become_keypoints_of_the_take(take: Path, footage: Footage, scenes: Scenes) -> None:
    assert main(["joints", str(take), "--model", str(take / "pose.onnx"), "--write", "--quiet"]) == 0
    again = read_take(take)
    assert [source.files for source in again.keypoints] == ["kp/*.json", *(f"keypoints/{v}.network.json" for v in "LCR")]
    truth = true_px(footage, scenes)
    for k, source in enumerate(again.keypoints[1:]):
        places = read_source(footage, source)
        row = {name: i for i, name in enumerate(("shoulder.L", "shoulder.R", "elbow.L", "elbow.R", "wrist.L", "wrist.R"), 5)}
        off = [places.place[n] - truth[k, f, row[j]] for n, (f, j) in enumerate(zip(places.frame, places.joint)) if j in row]
        assert len(off) == FRAMES * len(row) and np.abs(off).max() < 1.5 and source.sigma >= 2.0
    before = (take / "take.toml").read_bytes()
    assert main(["joints", str(take), "--model", str(take / "pose.onnx"), "--write", "--quiet"]) == 0
    assert (take / "take.toml").read_bytes() == before


def test_without_write_nothing_is_written_and_counts_are_shown(take: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    files = {path: path.stat().st_mtime_ns for path in take.rglob("*")}
    assert main(["joints", str(take), "--model", str(take / "pose.onnx"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["images"] == FRAMES and told["views"]["C"]["points"] > 0.9 * FRAMES * JOINTS
    assert files == {path: path.stat().st_mtime_ns for path in take.rglob("*")}


def test_a_point_whose_rays_miss_is_given_up_in_the_wrong_view(footage: Footage, scenes: Scenes) -> None:
    xy = true_px(footage, scenes)
    points = np.concatenate([xy, np.ones((*xy.shape[:3], 1))], axis=3)
    points[2, 3, 7, 1] += 25.0  # R is wrong
    points[0, 4, 8, 2] = 0.0  # L does not see it …
    points[1, 4, 8, 1] += 25.0  # … and of C and R nobody knows which is wrong
    kept, lost = without_contradictions(footage, points, np.full(3, 2.0))
    assert lost.tolist() == [0, 1, 2]
    assert kept[:2, 3, 7, 2].all() and not kept[2, 3, 7].any() and not kept[1:, 4, 8].any()
    assert (kept[..., 2] > 0).sum() == points[..., 2].sum() - 3


def test_nobody_is_told_and_cancelling_stops(take: Path, footage: Footage, tmp_path: Path) -> None:
    network = PoseNetwork.of((take / "pose.onnx").read_bytes(), take / "pose.onnx")
    blind = PoseNetwork.of(pose_graph("simcc", JOINTS, SIZE, seen=0), tmp_path / "blind.onnx")
    with pytest.raises(InputError, match="finds nobody in any image"):
        joints_by_network(footage, blind, Monitor())
    monitor = Monitor()
    monitor.cancel()
    with pytest.raises(Cancelled):
        joints_by_network(footage, network, monitor)
    with pytest.raises(Cancelled), open_network(take / "pose.onnx", monitor):
        pass


def test_a_network_on_which_opencv_crashes_is_refused(tmp_path: Path) -> None:
    whole = pose_graph("simcc", JOINTS, SIZE)
    (tmp_path / "pose.onnx").write_bytes(whole.replace(b"\x12\x04maps", b"\x12\x04seen", 1))  # a node's output is its own input
    with pytest.raises(InputError, match="OpenCV crashes when it runs .*pose.onnx"), open_network(tmp_path / "pose.onnx", Monitor()):
        pass
    with pytest.raises(InputError, match="Cannot read .*nothing.onnx"), open_network(tmp_path / "nothing.onnx", Monitor()):
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
@pytest.mark.parametrize(
    ("copies", "layers", "said"),
    [(10_000, 0, "Failed to allocate"), pytest.param(1_000, 300, "computes longer than a network of its size", marks=pytest.mark.slow)],
)
def test_a_small_network_that_asks_for_gigabytes_or_minutes_is_refused(tmp_path: Path, copies: int, layers: int, said: str) -> None:
    (tmp_path / "pose.onnx").write_bytes(costly_graph(copies, layers))
    with pytest.raises(InputError, match=said), open_network(tmp_path / "pose.onnx", Monitor()):
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
def test_a_network_that_asks_for_gigabytes_when_it_sees_the_image_is_refused(footage: Footage, tmp_path: Path) -> None:
    (tmp_path / "pose.onnx").write_bytes(greedy_graph(3e8))
    with open_network(tmp_path / "pose.onnx", Monitor()) as network:
        assert len(network.names) == 17  # the black image of the trial costs nothing
        before = len(threading.enumerate())
    assert len(threading.enumerate()) == before - 2
    with pytest.raises(InputError, match="OpenCV cannot run the network: Failed to allocate"):
        joints_by_file(footage, tmp_path / "pose.onnx", Monitor())


def test_a_link_out_of_the_take_is_not_followed(take: Path, footage: Footage, tmp_path: Path) -> None:
    found = joints_by_network(footage, PoseNetwork.of((take / "pose.onnx").read_bytes(), take / "pose.onnx"), Monitor())
    folder, outside = tmp_path / "take", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (folder / "take.toml").write_bytes((take / "take.toml").read_bytes())
    (folder / "keypoints").symlink_to(outside)
    with pytest.raises(InputError, match="leads out of the take's folder"):
        write_network_joints(folder, found)
    assert not list(outside.iterdir())
    (folder / "keypoints").unlink()
    (folder / "keypoints").mkdir()
    (folder / "keypoints" / "C.network.json").write_text("mine")
    with pytest.raises(InputError, match="C.network.json would be overwritten"):
        write_network_joints(folder, found)
    assert [path.read_text() for path in (folder / "keypoints").iterdir()] == ["mine"]
