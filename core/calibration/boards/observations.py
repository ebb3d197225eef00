"""Image points of the corners of a board, in all positions and cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ...foundation.arrays import frozen
from ...geometry.camera import Camera
from ...geometry.intersection import forward_intersection
from .board import Board
from .detection import FEWEST_CORNERS

FEWEST_DIAGONALS = 8  # by which a calibration is tested


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardObservations:
    """N positions of a board with K corners in C cameras; a position may be visible to one camera only."""

    names: tuple[str, ...]
    size_px: np.ndarray  # (C, 2) width, height
    xy_px: np.ndarray  # (N, C, K, 2) full-frame pixels, NaN: not visible
    frames: np.ndarray  # (N,) frame numbers; a frame may have several positions, if cameras were not synchronised in it
    board: Board

    noun: ClassVar[str] = "board"
    tested_together: ClassVar[tuple[int, ...]] = (2,)
    fewest_positions: ClassVar[int] = 4
    good_positions: ClassVar[int] = 20

    def __post_init__(self) -> None:
        C, K = len(self.names), len(self.board.corners_m)
        object.__setattr__(self, "size_px", frozen(self.size_px, (C, 2), name="size_px"))
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (None, C, K, 2), name="xy_px"))
        object.__setattr__(self, "frames", frozen(self.frames, (len(self.xy_px),), np.int64, "frames"))

    @property
    def visible(self) -> np.ndarray:
        """(N, C, K) whether a corner is visible."""
        return np.isfinite(self.xy_px).all(axis=-1)

    @property
    def length_m(self) -> float:
        """The diagonal between the outermost corners."""
        return self.board.diagonals[0][2]

    @property
    def described(self) -> dict[str, Any]:
        """The board, for files."""
        return {"board": self.board.kind.value, "squares": list(self.board.squares), "square_m": self.board.square_m}

    @property
    def tested_pairs(self) -> tuple[tuple[int, int, float], ...]:
        """The two diagonals; the sides of all squares where too few positions show a diagonal."""
        ends = [self.visible[:, :, list(pair[:2])] for pair in self.board.diagonals]
        whole = sum(int((shown.sum(axis=1) >= 2).all(axis=1).sum()) for shown in ends)
        return self.board.diagonals if whole >= FEWEST_DIAGONALS else self.board.edges

    def views(self, used: np.ndarray) -> np.ndarray:
        """(N, C) whether enough corners are used."""
        return used.sum(axis=2) >= FEWEST_CORNERS

    def measured(self, used: np.ndarray) -> np.ndarray:
        """(N,) whether two cameras use enough corners."""
        return self.views(used).sum(axis=1) >= 2

    def supported(self, used: np.ndarray) -> np.ndarray:
        """`used` without the views with too few corners."""
        return used & self.views(used)[..., None]

    def meeting(self, cameras: tuple[Camera, ...], tolerance_px: float) -> np.ndarray:
        """The image points (N, C, K) of corners whose rays meet within the tolerance."""
        N, C, K, _ = self.xy_px.shape
        xy = np.moveaxis(self.xy_px, 2, 1).reshape(N * K, C, 2)
        found = forward_intersection(cameras, xy, np.broadcast_to(np.eye(2), (*xy.shape, 2)))
        with np.errstate(invalid="ignore"):
            meet = np.linalg.norm(found.residual_px, axis=-1).max(axis=1, initial=0.0, where=np.isfinite(xy[..., 0])) < tolerance_px
        return self.visible & meet.reshape(N, 1, K)

    def part(self, positions: np.ndarray | Sequence[int]) -> "BoardObservations":
        """Some of the positions: indices or a mask (N,)."""
        return self.changed(self.xy_px[positions], self.frames[positions])

    def changed(self, xy_px: np.ndarray, frames: np.ndarray | None = None) -> "BoardObservations":
        """The same cameras and board with other image points."""
        kept = self.frames if frames is None else frames
        return BoardObservations(names=self.names, size_px=self.size_px, xy_px=xy_px, frames=kept, board=self.board)

    def of_camera(self, camera: int) -> "BoardObservations":
        """What one camera shows, without the positions that it does not show."""
        shown = self.views(self.visible)[:, camera]
        return BoardObservations(
            names=self.names[camera : camera + 1],
            size_px=self.size_px[camera : camera + 1],
            xy_px=self.xy_px[shown, camera : camera + 1],
            frames=self.frames[shown],
            board=self.board,
        )
