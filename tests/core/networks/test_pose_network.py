"""Pose networks of the user's own: every layout sees dots that were drawn; what is no such network is refused with the reason."""

import time
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.networks.onnx_file import input_shape
from tricap.core.networks.pose_network import PoseNetwork

from ...pose_graphs import SEEN, constant_maps, costly_graph, drawn, external_graph, pose_graph, tiny_graph

PICTURE, BOX = (520, 400), (196.0, 80.0, 326.0, 298.0)


def opened(folder: Path, data: bytes) -> PoseNetwork:
    return PoseNetwork.of(data, folder / "pose.onnx")


def places(count: int, seed: int = 3) -> np.ndarray:
    """Places in the box, no two of them near each other."""
    nodes = np.stack(np.meshgrid(np.linspace(205, 317, 5), np.linspace(90, 288, 6)), axis=-1).reshape(-1, 2)
    random = np.random.default_rng(seed)
    return random.permutation(nodes)[:count] + random.uniform(-3, 3, (count, 2))


@pytest.mark.parametrize("count", [17, 26])
@pytest.mark.parametrize(
    ("layout", "size", "within"),
    [("heat maps", (192, 256), 0.6), ("heat maps", (256, 192), 1.0), ("simcc", (192, 256), 0.9), ("simcc", (256, 256), 0.9)],
)
def test_dots_are_found_where_they_were_drawn(tmp_path: Path, layout: str, size: tuple[int, int], within: float, count: int) -> None:
    network = opened(tmp_path, pose_graph(layout, count, size, batch="batch"))
    xy = places(min(count, SEEN))
    xy[4] = np.nan  # is not in the picture
    found = network.joints(drawn(PICTURE, xy, radius_px=5.0), BOX)
    seen = np.flatnonzero(np.isfinite(xy[:, 0]))
    assert len(network.names) == count and network.names[5] == "left_shoulder"
    assert np.abs(found[seen, :2] - xy[seen]).max() < within
    assert found[seen, 2].min() > 0.2 > 0.1 > found[4, 2]


def test_the_landmarks_of_mediapipe_are_read(tmp_path: Path) -> None:
    network = opened(tmp_path, pose_graph("mediapipe", 39, (256, 256)))
    xy = places(SEEN)
    found = network.joints(drawn(PICTURE, xy, radius_px=5.0), BOX)
    assert len(network.names) == 33 and network.names[23] == "left_hip"
    assert np.abs(found[:SEEN, :2] - xy).max() < 1.0
    assert found[:SEEN, 2] == pytest.approx(0.9 / (1 + np.exp(-6)) ** 2, abs=1e-3)


def test_the_body_of_a_whole_body_layout_is_used(tmp_path: Path) -> None:
    network = opened(tmp_path, pose_graph("simcc", 133, (192, 256)))
    assert len(network.names) == 17 and network.joints(drawn(PICTURE, places(17)), BOX).shape == (17, 3)


def test_a_box_at_the_edge_and_an_empty_one_are_no_problem(tmp_path: Path) -> None:
    network = opened(tmp_path, pose_graph("simcc", 17, (288, 384)))
    xy = places(17)
    picture = drawn(PICTURE, xy, radius_px=5)
    for box in ((150.0, -80.0, 340.0, 330.0), (0.0, 0.0, *map(float, PICTURE))):
        found = network.joints(picture, box)
        assert np.abs(found[:, :2] - xy).max() < 2.0, box
    assert network.joints(picture, (9.0, 9.0, 9.0, 9.0))[:, 2].max() < 0.1


REFUSED = {
    "empty": (lambda whole: b"", "no ONNX file, or it is damaged: it has no graph"),
    "text": (lambda whole: b"a pose network", "no ONNX file, or it is damaged"),
    "half of it": (lambda whole: whole[: len(whole) // 2], "no ONNX file, or it is damaged: a field goes beyond its end"),
    "two inputs": (lambda whole: tiny_graph((1, 3, 64, 64), inputs=2), "a network with 2 inputs"),
    "any size": (lambda whole: tiny_graph((1, 3, "h", "w")), "takes 1 × 3 × any × any; give a network that takes one colour image"),
    "many images": (lambda whole: tiny_graph((8, 3, 64, 64)), "takes 8 × 3 × 64 × 64"),
    "grey": (lambda whole: tiny_graph((1, 1, 64, 64)), "takes 1 × 1 × 64 × 64"),
    "huge": (lambda whole: tiny_graph((1, 3, 40000, 64)), "takes 1 × 3 × 40000 × 64"),
    "a list": (lambda whole: tiny_graph((7,)), "takes 7;"),
    "other outputs": (lambda whole: tiny_graph((1, 3, 64, 64)), "returns 1 × 3 × 64 × 64; known are heat maps"),
    "weights in any file": (lambda whole: external_graph("/etc/passwd"), "has its weights in other files"),
    "weights in a file, in a second part": (lambda whole: external_graph("w.bin", parts=2), "has its weights in other files"),
    "weights in a file, in a branch": (lambda whole: external_graph("w.bin", branch=True), "has its weights in other files"),
    "more nodes than any network": (lambda whole: costly_graph(1, 10_000), "a network of more than 10000 nodes; use a smaller one"),
    "field 0": (lambda whole: whole + b"\x00\x00", "a field has no number"),
    "unknown operation": (lambda whole: whole.replace(b"Relu", b"Rolu"), "OpenCV cannot read the network"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_pose_network_is_refused(tmp_path: Path, case: str) -> None:
    made, said = REFUSED[case]
    with pytest.raises(InputError) as error:
        opened(tmp_path, made(pose_graph("heat maps", 17, (64, 64))))
    assert said in str(error.value) and "pose.onnx" in str(error.value)


@pytest.mark.parametrize("part", [b"\x0a\0", b"\x2a\0", b"\x5a\0", b"\x7a\0", b"\x08\1"])
def test_a_megabyte_of_empty_parts_is_read_in_a_moment(tmp_path: Path, part: bytes) -> None:
    """Nodes, tensors, inputs, sparse tensors and what is unknown, of two bytes each."""
    data = b"\x3a\xa0\xe8\x3b" + 490_000 * part
    began = time.process_time()
    with pytest.raises(InputError, match="it has more than 100000 nodes, tensors and inputs|a network with 0 inputs"):
        input_shape(data, tmp_path / "pose.onnx")
    assert time.process_time() - began < 1.5


def test_a_large_network_may_have_thousands_of_nodes(tmp_path: Path) -> None:
    assert input_shape(costly_graph(1, 9_000), tmp_path / "pose.onnx") == (1, 3, 64, 48)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_maps_that_are_no_numbers_find_nobody(tmp_path: Path, value: float) -> None:
    network = opened(tmp_path, constant_maps(value))
    assert not network.joints(np.zeros((64, 64, 3), np.float32), (0.0, 0.0, 64.0, 64.0))[:, 2].any()
