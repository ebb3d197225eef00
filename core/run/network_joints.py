"""Joints by a pose network of the user's own, in every image of a take: `tricap joints TAKE --model FILE.onnx`.

    images ── person's box (background, or the joints of the frame before) ── network ── rays of the views compared ──▶ [[keypoints]]

Points whose rays miss each other by more than clicks may are given up in the view without which the others agree; with two views, in both.
"""

import glob
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..fitting.inputs.background import find_background
from ..fitting.inputs.fit_input import BackgroundDistances
from ..fitting.inputs.no_surface import empty_clouds
from ..fitting.inputs.take_inputs import LEAST_CONFIDENCE
from ..foundation import store
from ..foundation.bounded import real_path
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.intersection import doubtful_view, intersect_clicks, joint_clicks_contradict
from ..networks.pose_network import PoseNetwork
from ..results.outputs import check_replaceable
from ..take.footage import Footage
from ..take.writing import read_table, write_table
from .network_process import open_network

FOLDER, ENDING = "keypoints", ".network.json"  # in the take's folder
COCO_START = '{"categories": [{"id": 1, "name": "person"'  # of `_coco`
SIGMA_OF_HEIGHT, LEAST_SIGMA_PX = 0.02, 2.0  # of a confident point, about the person's height: 35 mm of a person of 1.75 m
LEAST_HEIGHT = 0.15  # of the image's, of a region that may be the person
OVERLAP = 0.7  # of two boxes, below which the network looks again
Box = tuple[float, float, float, float]  # left, top, right, bottom


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NetworkJoints:
    """K points of the person in N frames of V views."""

    names: tuple[str, ...]
    views: tuple[str, ...]
    numbers: np.ndarray  # (V, N) of the images
    points: np.ndarray  # (V, N, K, 3) x, y in full-frame pixels and confidence; 0 where nothing was found or the rays contradict
    contradicted: np.ndarray  # (V,) points given up, for their rays miss those of other views
    sigma_px: np.ndarray  # (V,) of a point of confidence 1

    @property
    def found(self) -> np.ndarray:
        """(V,) points that can be used."""
        return np.asarray((self.points[..., 2] >= LEAST_CONFIDENCE).sum(axis=(1, 2)))


def joints_by_file(footage: Footage, path: Path, monitor: Monitor) -> NetworkJoints:
    """The joints in all images, by the network in a file.

    Raises:
        InputError: see `open_network` and `joints_by_network`.
        Cancelled: the user asked to stop.
    """
    with open_network(path, monitor) as network:
        return joints_by_network(footage, network, monitor)


def joints_by_network(footage: Footage, network: PoseNetwork, monitor: Monitor) -> NetworkJoints:
    """The joints in all images.

    Raises:
        InputError: an image cannot be read, the network cannot be run, it finds nobody, or no two views agree.
        Cancelled: the user asked to stop.
    """
    frames = range(footage.frames.start, footage.frames.stop, footage.take.field_layout.per_image)
    background = {b.view: b for b in find_background(footage, empty_clouds(footage), monitor.part("background", 0, 3))}
    views = [view.name for view in footage.take.views]
    points = np.zeros((len(views), len(frames), len(network.names), 3))
    heights: list[list[float]] = [[] for _ in views]
    looking = monitor.part("find the joints", 1, 3)
    for n, frame in enumerate(frames):
        looking.step("joints", n, len(frames))
        for k, image in enumerate(footage.read_colour(frame)):
            looking.check()
            seen = _box_before(background[views[k]], frame) if views[k] in background else None
            points[k, n] = _looked_twice(network, image, [seen, _box_of(points[k, n - 1]) if n else None])
            if (box := _box_of(points[k, n])) is not None:
                heights[k].append(box[3] - box[1])
    if not any(heights):
        raise InputError("The network finds nobody in any image; is it a pose network for one person, and is the person in view?")
    sigma = np.array([max(LEAST_SIGMA_PX, SIGMA_OF_HEIGHT * float(np.median(h))) if h else LEAST_SIGMA_PX for h in heights])
    points, contradicted = without_contradictions(footage, points, sigma)
    if contradicted.any() and not (points[..., 2] >= LEAST_CONFIDENCE).any():
        raise InputError("Every point of the network lies elsewhere in the other views; do the cameras belong to this footage?")
    numbers = np.array([[footage.number(k, frame) for frame in frames] for k in range(len(views))])
    return NetworkJoints(names=network.names, views=tuple(views), numbers=numbers, points=points, contradicted=contradicted, sigma_px=sigma)


def _looked_twice(network: PoseNetwork, image: np.ndarray, boxes: Sequence[Box | None]) -> np.ndarray:
    """(K, 3), from the first known box, else from the whole image; looked at again in the box of what was found, if that is another one."""
    height, width = image.shape[:2]
    box = next((b for b in boxes if b is not None), (0.0, 0.0, float(width), float(height)))
    first = network.joints(image, box)
    again = _box_of(first)
    if again is None or _overlap(box, again) >= OVERLAP:
        return first
    second = network.joints(image, again)
    return second if second[:, 2].sum() > first[:, 2].sum() else first


def _box_before(background: BackgroundDistances, frame: int) -> Box | None:
    """The box of the largest region of the person's in a frame, in pixels; None without one."""
    distance = background.of_frame(frame)
    if distance is None or not distance.any():
        return None
    _, _, stats, _ = cv2.connectedComponentsWithStats((distance == 0).astype(np.uint8))
    if len(stats) < 2:
        return None
    left, top, width, height, _ = stats[1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())] * background.step_px
    return (left, top, left + width, top + height) if height >= LEAST_HEIGHT * len(distance) * background.step_px else None


def _box_of(points: np.ndarray) -> Box | None:
    """The box of the points (K, 3) that can be used; None with fewer than three."""
    good = points[points[:, 2] >= LEAST_CONFIDENCE, :2]
    if len(good) < 3:
        return None
    (left, top), (right, bottom) = good.min(axis=0).tolist(), good.max(axis=0).tolist()
    return left, top, right, bottom


def _overlap(a: Box, b: Box) -> float:
    """The area of two boxes together over that of either."""
    both = max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
    either = sum((c[2] - c[0]) * (c[3] - c[1]) for c in (a, b)) - both
    return both / max(either, 1e-9)


def without_contradictions(footage: Footage, points: np.ndarray, sigma_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (V, N, K, 3) without those whose rays miss those of other views, and how many of each view (V,) these were.

    `sigma_px` (V,).
    """
    V, N, K, _ = points.shape
    cameras, kept = footage.rig.cameras, points.copy()
    used = kept[..., 2] >= LEAST_CONFIDENCE
    for _ in range(V - 1):  # each round gives up one view of a point
        xy = np.where(used[..., None], kept[..., :2], np.nan).reshape(V, N * K, 2).transpose(1, 0, 2)
        several = used.reshape(V, -1).sum(axis=0) > 1
        wrong = several & joint_clicks_contradict(cameras, intersect_clicks(cameras, xy, sigma_px[None]), float(sigma_px.max()))
        for row in np.flatnonzero(wrong).tolist():
            views = np.flatnonzero(np.isfinite(xy[row, :, 0]))
            out = [views[doubtful_view([cameras[v] for v in views], xy[row, views])]] if len(views) > 2 else views
            used.reshape(V, -1)[out, row] = False
    lost = (points[..., 2] >= LEAST_CONFIDENCE) & ~used
    kept[lost] = 0.0
    return kept, lost.sum(axis=(1, 2))


def write_network_joints(folder: Path, joints: NetworkJoints) -> list[Path]:
    """Write keypoints/VIEW.network.json in a take's folder and name them under [[keypoints]] in its take.toml; other entries stay.

    Raises:
        InputError: something cannot be written, or a file that is not of an earlier call is there; take.toml is unchanged then.
    """
    target = folder / FOLDER
    if real_path(target).parent != real_path(folder):
        raise InputError(f"{target} leads out of the take's folder; remove that link.")
    paths = [target / f"{view}{ENDING}" for view in joints.views]
    for path in paths:
        check_replaceable(path, COCO_START)
    try:
        target.mkdir(exist_ok=True)
        for k, path in enumerate(paths):
            store.write_text(path, _coco(joints, k))
    except OSError as error:
        raise InputError(f"Cannot write into {target}: {error.strerror or error}.") from error
    own = {f"{FOLDER}/{glob.escape(path.name)}": k for k, path in enumerate(paths)}
    table = dict(read_table(folder))
    others = [entry for entry in table.get("keypoints", []) if entry["files"] not in own]
    ours = [
        {"files": files, "view": joints.views[k], "sigma": round(float(joints.sigma_px[k]), 1)}
        for files, k in own.items()
        if joints.found[k]
    ]
    write_table(folder, {**table, "keypoints": [*others, *ours]})
    return paths


def _coco(joints: NetworkJoints, view: int) -> str:
    """The points of a view as COCO's annotations."""
    rows = zip(joints.numbers[view].tolist(), np.round(joints.points[view], 3).reshape(joints.numbers.shape[1], -1).tolist())
    annotations = [{"image_id": number, "category_id": 1, "keypoints": points} for number, points in rows]
    person = {"id": 1, "name": "person", "keypoints": list(joints.names)}
    return json.dumps({"categories": [person], "annotations": annotations})
