"""The corners of a board in an image, by OpenCV's own detectors (chessboard: Duda & Frese 2018; ChArUco: Garrido-Jurado et al. 2014).

A chessboard is located in the reduced image and measured in its part of the full image, which is as accurate and much faster. A ChArUco
board may be partly hidden; its picture may be inverted, or of the pattern of OpenCV before 4.6: what the images show is tried once for
all images of a recording (`find_variant`). Several exposures of one marker, or too few of them, give no corners.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .board import Board, BoardKind

LOCATE_PX = 1000  # longer side of the image in which a chessboard is located
MARGIN = 1.5  # squares around the corners that are measured again
SMALLEST_SIDE_PX = 5.0  # of a square that is measured
REFINE_PART = 0.4  # of a square's side: half the window in which a corner is refined
REFINE_PX = (2, 11)
REFINED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
FEWEST_CORNERS = 6  # of a board that is used


@dataclass(frozen=True, kw_only=True, slots=True)
class Variant:
    """How a board looks in the images."""

    inverted: bool = False  # black and white are exchanged
    legacy: bool = False  # the ChArUco pattern of OpenCV before 4.6
    mirrored: bool = False  # left and right are exchanged: an error of the recording


VARIANTS = tuple(Variant(inverted=i, legacy=e) for e in (False, True) for i in (False, True))
MIRRORED = tuple(Variant(inverted=v.inverted, legacy=v.legacy, mirrored=True) for v in VARIANTS)


def find_corners(grey: np.ndarray, board: Board, variant: Variant = Variant(), thorough: bool = False) -> np.ndarray:  # noqa: B008  frozen
    """The corners (K, 2) [px] of the board in a grey image (h, w) of 0…255, NaN where a corner is not visible.

    `thorough` searches longer for a chessboard.
    """
    image: np.ndarray = np.clip(grey, 0, 255).astype(np.uint8)
    image = 255 - image if variant.inverted else image
    image = np.ascontiguousarray(image[:, ::-1]) if variant.mirrored else image
    return _chessboard(image, board, thorough) if board.kind is BoardKind.CHESSBOARD else _charuco(image, board, variant)


def find_variant(images: Sequence[np.ndarray], board: Board, variants: Sequence[Variant] = VARIANTS) -> tuple[Variant, int]:
    """The variant in which most corners are found in some images, and their number."""
    counts = [sum(int(np.isfinite(find_corners(image, board, v)[:, 0]).sum()) for image in images) for v in variants]
    best = int(np.argmax(counts))
    return variants[best], counts[best]


def _chessboard(image: np.ndarray, board: Board, thorough: bool) -> np.ndarray:
    none = np.full((len(board.corners_m), 2), np.nan)
    scale = min(1.0, LOCATE_PX / max(image.shape))
    small = image if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    located = _sb(small, board, 0)
    if located is None and thorough:
        located = _sb(small, board, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE)
    if located is None:
        return none
    located = (located + 0.5) / scale - 0.5
    side = _side_px(located, board)
    low = np.maximum(np.floor(located.min(axis=0) - MARGIN * side), 0).astype(int)
    high = np.minimum(np.ceil(located.max(axis=0) + MARGIN * side), image.shape[::-1]).astype(int)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    measured = _sb(part, board, cv2.CALIB_CB_ACCURACY)  # normalised images have more noise
    if measured is None:
        measured = _refined(part, located - low, side)
    if side < SMALLEST_SIDE_PX:
        return none
    return _oriented(image, measured + low, board)


def _sb(image: np.ndarray, board: Board, flags: int) -> np.ndarray | None:
    ok, corners = cv2.findChessboardCornersSB(image, board.grid, flags=flags)
    return corners.reshape(-1, 2).astype(np.float64) if ok and len(corners) == len(board.corners_m) else None


def _refined(image: np.ndarray, xy_px: np.ndarray, side_px: float) -> np.ndarray:
    half = int(np.clip(REFINE_PART * side_px, *REFINE_PX))
    corners = np.ascontiguousarray(xy_px, dtype=np.float32).reshape(-1, 1, 2)
    return cv2.cornerSubPix(image, corners, (half, half), (-1, -1), REFINED).reshape(-1, 2).astype(np.float64)


def _side_px(xy_px: np.ndarray, board: Board) -> float:
    """Shortest mean side of the squares along rows or columns [px]."""
    columns, rows = board.grid
    grid = xy_px.reshape(rows, columns, 2)
    sides = [np.nanmedian(np.linalg.norm(np.diff(grid, axis=axis), axis=-1)) for axis in (0, 1)]
    return float(np.nanmin(sides))


def _oriented(image: np.ndarray, xy_px: np.ndarray, board: Board) -> np.ndarray:
    """The corners in the order in which the square before the first corner is the darker one, where half a turn exchanges the colours."""
    columns, rows = board.grid
    if (columns + rows) % 2 == 0:
        return xy_px
    grid = xy_px.reshape(rows, columns, 2)
    middles = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    at = np.clip(np.round(middles).astype(int), 0, np.array(image.shape[::-1]) - 1)
    grey = image[at[..., 1], at[..., 0]].astype(np.float64)
    even = np.indices(grey.shape).sum(axis=0) % 2 == 0
    return xy_px if grey[even].mean() < grey[~even].mean() else xy_px[::-1]


def _charuco(image: np.ndarray, board: Board, variant: Variant) -> np.ndarray:
    found, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco(variant.legacy)).detectBoard(image)
    xy = np.full((len(board.corners_m), 2), np.nan)
    if ids is None or len(ids) < FEWEST_CORNERS:
        return xy
    xy[ids.ravel()] = found.reshape(-1, 2)
    return xy if _side_px(xy, board) >= SMALLEST_SIDE_PX else np.full_like(xy, np.nan)
