"""What the display shows and where, and how fast the machine and the window are here and now; for drive.py and the scripts."""

import os
import struct
import time
import zlib
from pathlib import Path

import bpy
import numpy as np

SCREEN = Path(__file__).resolve().with_name("screen")
WORK, WORK_S = 500_000, 0.05  # a piece of work, and how long it takes on a free core of the machine for which the limits were set


def pixels() -> np.ndarray:
    """What the display shows: (H, W, 3) u1, top row first."""
    raw = (SCREEN / "Xvfb_screen0").read_bytes()
    header = struct.unpack(">25I", raw[:100])
    size, width, height, line, colours = header[0], header[4], header[5], header[12], header[19]
    start = size + 12 * colours
    return np.frombuffer(raw, np.uint8, height * line, start).reshape(height, line // 4, 4)[:, :width, 2::-1]


def write_png(path: Path, picture: np.ndarray) -> None:
    """An 8-bit RGB picture (H, W, 3) as PNG."""
    height, width = picture.shape[:2]
    rows = np.concatenate([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)], axis=1).tobytes()
    chunks = ((b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows, 6)), (b"IEND", b""))
    coded = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + coded)


def image_place(area: bpy.types.Area, x_px: float, y_px: float) -> tuple[float, float]:
    """Where the centre of a clip's pixel (x right, y down, full frame) is in the window."""
    region, size = next(r for r in area.regions if r.type == "WINDOW"), area.spaces.active.clip.size
    left, bottom = region.view2d.view_to_region(0, 0, clip=False)
    right, top = region.view2d.view_to_region(1, 1, clip=False)
    u, v = (x_px + 0.5) / size[0], 1 - (y_px + 0.5) / size[1]
    return region.x + left + u * (right - left), region.y + bottom + v * (top - bottom)


def pixel_of(area: bpy.types.Area) -> float:
    """How large a pixel of the clip is on the screen."""
    return image_place(area, 1, 0)[0] - image_place(area, 0, 0)[0]


def slowness() -> float:
    """How much longer things take than on a free core of the machine for which the limits were set, 1 at least.

    By the load of the machine, and by how long a piece of work takes here and now.
    """
    began = time.perf_counter()
    sum(i * i for i in range(WORK))
    took = time.perf_counter() - began
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1), took / WORK_S)


class Pulse:
    """How long the window is deaf: `with Pulse() as pulse: yield from …`, then pulse.gaps_s().

    A timer of Blender's asks to be called every 10 ms; it is late while the window draws, handles an event, or waits for Python.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self._beat = lambda: self.times.append(time.monotonic()) or 0.01

    def __enter__(self) -> "Pulse":
        bpy.app.timers.register(self._beat)
        return self

    def __exit__(self, *_: object) -> None:
        bpy.app.timers.unregister(self._beat)

    def gaps_s(self) -> np.ndarray:
        """Seconds between one call and the next."""
        return np.diff(self.times) if len(self.times) > 1 else np.array([np.inf])

    def __str__(self) -> str:
        gaps = 1e3 * self.gaps_s()
        half, most, nearly_all = np.percentile(gaps, [50, 95, 99])
        return (
            f"{len(gaps)} gaps: 50 % {half:.0f} ms, 95 % {most:.0f} ms, 99 % {nearly_all:.0f} ms, longest {np.max(gaps):.0f} ms, "
            f"{(gaps > 100).sum()} over 100 ms (load of the machine {os.getloadavg()[0]:.1f})"
        )
