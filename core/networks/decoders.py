"""Joints from the outputs of a pose network, in the pixels of its input. The layout is recognised by the shapes of the outputs.

heat maps   (1, K, h, w): the largest value, refined by a parabola through the logarithms beside it (Zhang et al. 2020, DARK); a cell
            counts W/w pixels (HRNet, ViTPose, SimpleBaseline)
SimCC       (1, K, n W) and (1, K, n H): a distribution along x and one along y (Li et al. 2022; RTMPose: Jiang et al. 2023, n = 2)
MediaPipe   (1, 5 K): x, y, z, and the logits of visibility and presence (BlazePose: Bazarevsky et al. 2020), 33 points first; a second
            output (1, 1) is the confidence in the person
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..motion.formats.keypoints_json import COCO, LAYOUTS, WHOLE_BODY

BLAZEPOSE = (
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear mouth_left mouth_right "
    "left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky right_pinky left_index right_index left_thumb "
    "right_thumb left_hip right_hip left_knee right_knee left_ankle right_ankle left_heel right_heel left_foot_index right_foot_index"
).split()
OF_BLAZEPOSE = 5  # numbers of a point
LEAST, MOST = 1e-6, 1e6  # of a heat map, for its logarithm
IMAGENET = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)  # mean and standard deviation of RGB, 0 to 255 (as mmpose and timm use them)
UNIT = (0.0, 0.0, 0.0), (255.0, 255.0, 255.0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layout:
    """What a network takes and returns: the colours (RGB) that become 0 and ±1, the K points, and what makes (K, 3) of the outputs: x and y
    in the input's pixels, and the confidence, 0 to 1."""

    names: tuple[str, ...]
    colours: tuple[tuple[float, ...], tuple[float, ...]]
    decode: Callable[[Sequence[np.ndarray]], np.ndarray]


def layout_of(outputs: Sequence[np.ndarray], size_px: tuple[int, int]) -> Layout | None:
    """The layout of a network with outputs like these and an input of (width, height); None if it is not known."""
    width, height = size_px
    flat = [o for o in outputs if o.ndim == 2 and o.shape[0] == 1 and o.shape[1] >= OF_BLAZEPOSE * len(BLAZEPOSE)]
    if len(outputs) == 1 and outputs[0].ndim == 4 and (names := _names(outputs[0].shape[1])):
        return Layout(names=names, colours=IMAGENET, decode=lambda found: _from_heat_maps(found[0], size_px)[: len(names)])
    if len(outputs) == 2 and all(o.ndim == 3 for o in outputs) and outputs[0].shape[1] == outputs[1].shape[1]:
        names, (along_x, along_y) = _names(outputs[0].shape[1]), (o.shape[2] for o in outputs)
        if names and along_x * height == along_y * width:
            bins = along_x / width
            return Layout(names=names, colours=IMAGENET, decode=lambda found: _from_distributions(found[0], found[1], bins)[: len(names)])
    if flat and flat[0].shape[1] % OF_BLAZEPOSE == 0:
        rank = [o.shape for o in outputs].index(flat[0].shape)
        sure = next((i for i, o in enumerate(outputs) if o.size == 1), None)
        return Layout(
            names=tuple(BLAZEPOSE),
            colours=UNIT,
            decode=lambda found: _from_blazepose(found[rank], 1.0 if sure is None else float(found[sure].ravel()[0])),
        )
    return None


def _names(count: int) -> tuple[str, ...]:
    return COCO if count == WHOLE_BODY else LAYOUTS.get(count, ())


def _from_heat_maps(maps: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    _, count, h, w = maps.shape
    best = maps[0].reshape(count, -1).argmax(axis=1)
    y, x = np.divmod(best, w)
    each = np.arange(count)
    value = maps[0, each, y, x]
    logs = np.log(np.clip(np.nan_to_num(maps[0], nan=LEAST), LEAST, MOST))
    fine_x = x + _peak(logs[each, y, np.maximum(x - 1, 0)], logs[each, y, x], logs[each, y, np.minimum(x + 1, w - 1)])
    fine_y = y + _peak(logs[each, np.maximum(y - 1, 0), x], logs[each, y, x], logs[each, np.minimum(y + 1, h - 1), x])
    return _points(fine_x * size_px[0] / w, fine_y * size_px[1] / h, value)


def _peak(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where, −½ to ½, the parabola through three values is largest."""
    curve = before - 2 * here + after
    return np.clip(np.where(curve < 0, (before - after) / (2 * np.where(curve < 0, curve, 1.0)), 0.0), -0.5, 0.5)


def _from_distributions(along_x: np.ndarray, along_y: np.ndarray, bins_per_pixel: float) -> np.ndarray:
    value = np.minimum(along_x[0].max(axis=1), along_y[0].max(axis=1))
    return _points(along_x[0].argmax(axis=1) / bins_per_pixel, along_y[0].argmax(axis=1) / bins_per_pixel, value)


def _from_blazepose(numbers: np.ndarray, person: float) -> np.ndarray:
    table = numbers.reshape(-1, OF_BLAZEPOSE)[: len(BLAZEPOSE)].astype(np.float64)
    visible, present = 1 / (1 + np.exp(-np.clip(table[:, 3:].T, -50, 50)))
    return _points(table[:, 0], table[:, 1], visible * present * person)


def _points(x: np.ndarray, y: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """(K, 3), with confidence 0 where anything is no number."""
    table = np.stack([x, y, confidence], axis=1).astype(np.float64)
    table[~np.isfinite(table).all(axis=1)] = 0.0
    table[:, 2] = np.clip(table[:, 2], 0.0, 1.0)
    return table
