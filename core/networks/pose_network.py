"""A pose network of the user's own: an ONNX file that finds the joints of one person in the part of an image that shows the person."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..foundation.errors import InputError
from .decoders import layout_of
from .onnx_file import input_shape

MARGIN = 1.25  # size of the cut-out over the person's box, as in mmpose's and BlazePose's training
LARGEST_SIDE = 2048  # pixels of an input
CHANNELS = 3
KNOWN = "heat maps (HRNet, ViTPose), SimCC (RTMPose) with 17, 26 or 133 points, or MediaPipe's pose landmarks"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PoseNetwork:
    """An opened network, in this process or in another one."""

    names: tuple[str, ...]  # of its K points
    size_px: tuple[int, int]  # width and height of its input
    channels_last: bool
    colours: tuple[tuple[float, ...], tuple[float, ...]]  # RGB that become 0 and ±1
    points: Callable[[np.ndarray], np.ndarray]  # (K, 3) x, y and confidence of an input of `input_shape`, in its pixels

    @staticmethod
    def of(data: bytes, path: Path) -> "PoseNetwork":
        """The network that is the content of a file, after one run. OpenCV may crash on a damaged one (see run.network_joints).

        Raises:
            InputError: it cannot be read or run, or the layout of its input or output is not known.
        """
        shape = input_shape(data, path)
        batch, *rest = shape if len(shape) == 4 else (0, 0, 0, 0)
        last = rest[2] == CHANNELS and rest[0] != CHANNELS
        height, width = (rest[0], rest[1]) if last else (rest[1], rest[2])
        if CHANNELS not in (rest[0], rest[2]) or batch > 1 or not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
            shown = " × ".join(str(n) if n else "any" for n in shape) or "nothing"
            raise InputError(f"{path} takes {shown}; give a network that takes one colour image of fixed width and height.")
        try:
            net = cv2.dnn.readNetFromONNX(np.frombuffer(data, dtype=np.uint8))  # from memory: it can open no other file
        except cv2.error as error:
            raise InputError(f"OpenCV cannot read the network {path}: {_reason(error)}.") from error
        outputs = _run(net, np.zeros((1, height, width, 3) if last else (1, 3, height, width), dtype=np.float32), path)
        layout = layout_of(outputs, (width, height))
        if layout is None:
            shapes = ", ".join(" × ".join(map(str, o.shape)) for o in outputs)
            raise InputError(f"{path} returns {shapes}; known are {KNOWN}.")
        return PoseNetwork(
            names=layout.names,
            size_px=(width, height),
            channels_last=last,
            colours=layout.colours,
            points=lambda blob: layout.decode(_run(net, blob, None)),
        )

    @staticmethod
    def described(table: Mapping[str, Any], points: Callable[[np.ndarray], np.ndarray]) -> "PoseNetwork":
        """The network of a `description`, which runs where `points` is computed."""
        zero, one = table["colours"]
        return PoseNetwork(
            names=tuple(table["names"]),
            size_px=(table["size_px"][0], table["size_px"][1]),
            channels_last=table["channels_last"],
            colours=(tuple(zero), tuple(one)),
            points=points,
        )

    def description(self) -> dict[str, Any]:
        """All but the computation, as JSON has it."""
        return {"names": self.names, "size_px": self.size_px, "channels_last": self.channels_last, "colours": self.colours}

    @property
    def input_shape(self) -> tuple[int, int, int, int]:
        """The shape of an input, float32."""
        width, height = self.size_px
        return (1, height, width, CHANNELS) if self.channels_last else (1, CHANNELS, height, width)

    def joints(self, image: np.ndarray, box_px: tuple[float, float, float, float]) -> np.ndarray:
        """(K, 3) x, y and confidence, 0 to 1, in an RGB image (h, w, 3) float32, 0 to 255, that shows the person in a box (left, top,
        right, bottom).

        Raises:
            InputError: OpenCV cannot run the network.
            Cancelled: as `points` does.
        """
        width, height = self.size_px
        left, top, right, bottom = box_px
        middle = np.array([left + right, top + bottom]) / 2
        scale = MARGIN * max((right - left) / width, (bottom - top) / height, 1e-6)  # pixels of the image for one of the input
        centre = (np.array(self.size_px) - 1) / 2
        warp = np.column_stack([np.eye(2) / scale, centre - middle / scale])
        part = cv2.warpAffine(image, warp, self.size_px, flags=cv2.INTER_LINEAR)
        zero, one = self.colours
        part = (part - zero) / one
        blob = (part if self.channels_last else part.transpose(2, 0, 1))[None].astype(np.float32)
        found = self.points(np.ascontiguousarray(blob))
        found[:, :2] = (found[:, :2] - centre) * scale + middle
        return found


def _run(net: cv2.dnn.Net, blob: np.ndarray, path: Path | None) -> list[np.ndarray]:
    try:
        net.setInput(blob)
        return [np.asarray(output) for output in net.forward(net.getUnconnectedOutLayersNames())]
    except cv2.error as error:
        raise InputError(f"OpenCV cannot run the network{f' {path}' if path else ''}: {_reason(error)}.") from error


def _reason(error: cv2.error) -> str:
    """OpenCV's own words without the place in its code."""
    return str(error.err or error).strip().splitlines()[0].rstrip(".")[:200]
