"""The unknowns of the adjustment, cameras and the positions of an object of known shape: a bar with two ends, or a board with corners.

    bar      X_i± = M_i ± (L / 2) d_i                                           (1)   5 unknowns: M, and d on the unit sphere
    board    X_ik = R_i x_k + T_i                                               (2)   6 unknowns: a small turn about T_i, and T

The length of the bar and the shape of the board hold exactly; no weight mixes millimetres with pixels.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from ..geometry.camera import Camera, camera_of, interior_of
from ..geometry.rotation import rotation_from_vector

BLOCK = 512  # object points
SMALLEST_BLOCK = 16  # positions


class Observations(Protocol):
    """Image points of N positions of an object with K points in C cameras."""

    noun: ClassVar[str]  # what the object is called in messages
    tested_together: ClassVar[tuple[int, ...]]  # axes of (N, C, K) over which data snooping removes one point at a time
    fewest_positions: ClassVar[int]  # without which no rig is determined
    good_positions: ClassVar[int]

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras."""

    @property
    def size_px(self) -> np.ndarray:
        """(C, 2) width, height."""

    @property
    def xy_px(self) -> np.ndarray:
        """(N, C, K, 2) full-frame pixels, NaN: not visible."""

    @property
    def frames(self) -> np.ndarray:
        """(N,) frame numbers."""

    @property
    def visible(self) -> np.ndarray:
        """(N, C, K) whether a point is visible."""

    def views(self, used: np.ndarray) -> np.ndarray:
        """Which cameras (N, C) show the object well enough to compare them, by the points `used` (N, C, K)."""

    def measured(self, used: np.ndarray) -> np.ndarray:
        """Which positions (N,) were measured by two cameras or more."""

    def supported(self, used: np.ndarray) -> np.ndarray:
        """`used` (N, C, K) without the points that too few others support."""

    @property
    def length_m(self) -> float:
        """The object's size."""

    @property
    def described(self) -> Mapping[str, Any]:
        """What the object was given as, for files."""

    @property
    def tested_pairs(self) -> tuple[tuple[int, int, float], ...]:
        """Pairs of points and their true distance [m], by which a calibration is tested."""

    def meeting(self, cameras: tuple[Camera, ...], tolerance_px: float) -> np.ndarray:
        """The image points (N, C, K) whose rays meet within the tolerance, whatever the shape of the object."""

    def part(self, positions: np.ndarray | Sequence[int]) -> Self:
        """Some of the positions: indices or a mask (N,)."""

    def changed(self, xy_px: np.ndarray) -> Self:
        """The same cameras and object with other image points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Network:
    """Cameras and N positions of an object with K points. Subclasses define the object."""

    interior: np.ndarray  # (C, 10), see INTERIOR
    R: np.ndarray  # (C, 3, 3) world → camera
    t: np.ndarray  # (C, 3) m
    fisheye: np.ndarray | bool = False  # (C,) which cameras have a fisheye lens
    delay_images: np.ndarray | None = None  # (C,) by which each camera is later than the first; None: all at once

    unknowns: ClassVar[int]  # q, of a position

    @property
    def count(self) -> int:
        """N."""
        raise NotImplementedError

    @property
    def points_m(self) -> np.ndarray:
        """(N, K, 3) the object's points in the world."""
        return np.moveaxis(self.columns_m, (0, 1, 2), (2, 1, 0))

    @property
    def columns_m(self) -> np.ndarray:
        """The same with the positions last, (3, K, N)."""
        raise NotImplementedError

    @property
    def spread(self) -> np.ndarray:
        """(N, 3, 3) mean of d dᵀ over the unit vectors d in the object."""
        raise NotImplementedError

    def derivatives(self, GR: np.ndarray) -> np.ndarray:
        """Derivatives (C, q, 2, K, N) of image points to the unknowns of their position, from those to the points, (C, 3, 2, K, N)."""
        raise NotImplementedError

    def stepped(self, step: np.ndarray) -> Self:
        """The positions after a step (q, N) of their unknowns."""
        raise NotImplementedError

    def transformed(self, R: np.ndarray, shift_m: np.ndarray) -> Self:
        """The positions, without the cameras, after X' = R X + shift; R may be a reflection."""
        raise NotImplementedError

    def at(self, positions: np.ndarray | slice | Sequence[int]) -> Self:
        """Some of the positions."""
        raise NotImplementedError

    def blocks(self) -> Iterator[tuple[slice, Self]]:
        """Blocks of positions, each with its part of the network."""
        size = max(SMALLEST_BLOCK, BLOCK // self.columns_m.shape[1])
        for start in range(0, self.count, size):
            at = slice(start, start + size)
            yield at, self.at(at)

    def cameras(self, names: Sequence[str], size_px: np.ndarray) -> tuple[Camera, ...]:
        """The cameras as values of the geometry package."""
        return tuple(
            camera_of(name, (int(size[0]), int(size[1])), p, R, t, bool(curved))
            for name, size, p, R, t, curved in zip(
                names, size_px, self.interior, self.R, self.t, np.broadcast_to(self.fisheye, len(self.R))
            )
        )

    @property
    def curved(self) -> np.ndarray:
        """(C,) which cameras have a fisheye lens."""
        return np.broadcast_to(self.fisheye, len(self.R))

    def with_cameras(self, cameras: Sequence[Camera]) -> Self:
        """The same positions with other cameras."""
        return replace(
            self,
            interior=np.stack([interior_of(c) for c in cameras]),
            R=np.stack([c.R_cam_world for c in cameras]),
            t=np.stack([c.t_cam_world_m for c in cameras]),
            fisheye=np.array([c.fisheye for c in cameras]),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarNetwork(Network):
    """Cameras and positions of a bar.  (1)"""

    middle: np.ndarray  # (N, 3) m
    direction: np.ndarray  # (N, 3) unit vectors from end 1 to end 0
    length_m: float

    unknowns: ClassVar[int] = 5

    @property
    def count(self) -> int:
        """N."""
        return len(self.middle)

    @property
    def ends_m(self) -> np.ndarray:
        """(N, 2, 3) the bar's ends."""
        return self.points_m

    @property
    def columns_m(self) -> np.ndarray:
        """(3, 2, N)  (1)"""
        half = self.direction.T * (self.length_m / 2)
        return np.stack([self.middle.T + half, self.middle.T - half], axis=1)

    @property
    def spread(self) -> np.ndarray:
        """(N, 3, 3) d dᵀ."""
        return self.direction[:, :, None] * self.direction[:, None, :]

    def derivatives(self, GR: np.ndarray) -> np.ndarray:
        """(C, 5, 2, 2, N): the middle, and the direction along its two tangents."""
        B = np.empty((len(GR), 5, *GR.shape[2:]))
        B[:, :3] = GR
        for i, tangent in enumerate(tangents(self.direction) * (self.length_m / 2)):
            B[:, 3 + i] = GR[:, 0] * tangent[0] + GR[:, 1] * tangent[1] + GR[:, 2] * tangent[2]
        B[:, 3:, :, 1] *= -1
        return B

    def stepped(self, step: np.ndarray) -> Self:
        """The bars after a step (5, N)."""
        first, second = tangents(self.direction)
        direction = self.direction + (first * step[3] + second * step[4]).T
        return replace(self, middle=self.middle + step[:3].T, direction=direction / np.linalg.norm(direction, axis=1, keepdims=True))

    def transformed(self, R: np.ndarray, shift_m: np.ndarray) -> Self:
        """The bars after X' = R X + shift."""
        return replace(self, middle=self.middle @ R.T + shift_m, direction=self.direction @ R.T)

    def at(self, positions: np.ndarray | slice | Sequence[int]) -> Self:
        """Some of the bars."""
        return replace(self, middle=self.middle[positions], direction=self.direction[positions])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardNetwork(Network):
    """Cameras and positions of a board.  (2)"""

    corners_m: np.ndarray  # (K, 3) in the board's frame, z = 0
    R_board: np.ndarray  # (N, 3, 3) board → world
    t_board: np.ndarray  # (N, 3) m

    unknowns: ClassVar[int] = 6

    @property
    def count(self) -> int:
        """N."""
        return len(self.R_board)

    @property
    def columns_m(self) -> np.ndarray:
        """(3, K, N)  (2)"""
        return self._turned + self.t_board.T[:, None]

    @property
    def _turned(self) -> np.ndarray:
        return np.einsum("nij,kj->ikn", self.R_board, self.corners_m)

    @property
    def spread(self) -> np.ndarray:
        """(N, 3, 3) mean of d dᵀ over all directions in the plane of the board: (I − n nᵀ) / 2."""
        n = self.R_board[:, :, 2]
        return (np.eye(3) - n[:, :, None] * n[:, None, :]) / 2

    def derivatives(self, GR: np.ndarray) -> np.ndarray:
        """(C, 6, 2, K, N): the shift, and the turn about the board's origin, ∂X/∂ω = −[R x]×."""
        x, y, z = self._turned
        gx, gy, gz = GR[:, 0], GR[:, 1], GR[:, 2]
        return np.stack([gx, gy, gz, y * gz - z * gy, z * gx - x * gz, x * gy - y * gx], axis=1)

    def stepped(self, step: np.ndarray) -> Self:
        """The boards after a step (6, N)."""
        return replace(self, R_board=rotation_from_vector(step[3:].T) @ self.R_board, t_board=self.t_board + step[:3].T)

    def transformed(self, R: np.ndarray, shift_m: np.ndarray) -> Self:
        """The boards after X' = R X + shift; a mirrored plane is the same plane, seen from behind."""
        sign = np.sign(np.linalg.det(R))
        return replace(self, R_board=R @ self.R_board * [1.0, 1.0, sign], t_board=self.t_board @ R.T + shift_m)

    def at(self, positions: np.ndarray | slice | Sequence[int]) -> Self:
        """Some of the boards."""
        return replace(self, R_board=self.R_board[positions], t_board=self.t_board[positions])


def tangents(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3, N) perpendicular to each direction (N, 3) and to each other (Duff et al. 2017)."""
    x, y, z = direction.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])
