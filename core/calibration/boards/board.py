"""The board: a chessboard or a ChArUco board of known squares, and its picture for a printer."""

import math
import struct
import zlib
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from ...foundation import store
from ...foundation.errors import InputError
from ...foundation.settings import nearest_name

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name == name.upper()))
MARKER_PART = 0.75  # of a square's side, where the size of the markers is not given
MOST_SQUARES = 60  # along a side
SMALLEST_M = 1e-5  # of a square or a marker, under a microscope
LARGEST_SQUARE_M = 5.0
PRINT_DPI = 300
POINTS_PER_M = 72 / 0.0254  # of PDF
LARGEST_PRINT_PX = 12_000


class Lens(StrEnum):
    """The model of the lenses."""

    AUTO = "auto"
    BROWN = "brown"
    FISHEYE = "fisheye"


class BoardKind(StrEnum):
    """What is printed."""

    CHESSBOARD = "chessboard"
    CHARUCO = "charuco"


@dataclass(frozen=True, kw_only=True, slots=True)
class Board:
    """A flat board. `squares`: columns and rows of inner corners of a chessboard (OpenCV's pattern size), of squares of a ChArUco board.

    Raises:
        InputError: the numbers are impossible, or the dictionary is unknown or too small.
    """

    kind: BoardKind
    squares: tuple[int, int]
    square_m: float
    dictionary: str = "DICT_4X4_50"
    marker_m: float = 0.0  # side of a marker; 0: MARKER_PART of a square

    def __post_init__(self) -> None:
        least = 3  # two rows of inner corners have no interior
        if min(self.squares) < least or max(self.squares) > MOST_SQUARES:
            counted = "inner corners" if self.kind is BoardKind.CHESSBOARD else "squares"
            raise InputError(
                f"The board has {self.label}; give the number of {counted} across and down, {least} to {MOST_SQUARES}, as in 9x6."
            )
        if not (math.isfinite(self.square_m) and SMALLEST_M <= self.square_m < LARGEST_SQUARE_M):
            raise InputError(f"The board's squares are given as {self.square_m:g} m; measure the side of a square in metres, such as 0.03.")
        if self.kind is BoardKind.CHARUCO:
            self._check_markers()

    def _check_markers(self) -> None:
        if self.dictionary not in DICTIONARIES:
            hint = nearest_name(self.dictionary, list(DICTIONARIES))
            raise InputError(f"There is no dictionary “{self.dictionary}” of markers.{hint} Give the one that the board was made with.")
        if self.marker_m != 0 and not SMALLEST_M <= self.marker_m < self.square_m:
            raise InputError(f"The markers are given as {self.marker_m:g} m; they must be smaller than the squares, {self.square_m:g} m.")
        needed, there = self.squares[0] * self.squares[1] // 2, len(self.markers.bytesList)
        if needed > there:
            raise InputError(
                f"A board of {self.label} squares has {needed} markers, and {self.dictionary} has only {there}; choose a larger one."
            )

    @property
    def label(self) -> str:
        """Such as “9×6”."""
        return f"{self.squares[0]}×{self.squares[1]}"

    @property
    def markers(self) -> cv2.aruco.Dictionary:
        """OpenCV's dictionary of markers."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of inner corners."""
        columns, rows = self.squares
        return (columns, rows) if self.kind is BoardKind.CHESSBOARD else (columns - 1, rows - 1)

    @property
    def corners_m(self) -> np.ndarray:
        """(K, 3) the inner corners in rows, in the board's frame: x along a row, y down, z = 0, the middle of the board is the origin."""
        return _corners(self.grid, self.square_m)

    @property
    def diagonals(self) -> tuple[tuple[int, int, float], ...]:
        """The corners at both ends of the two diagonals, and their length [m]."""
        columns, rows = self.grid
        length = self.square_m * math.hypot(columns - 1, rows - 1)
        return ((0, columns * rows - 1, length), (columns - 1, columns * (rows - 1), length))

    @property
    def edges(self) -> tuple[tuple[int, int, float], ...]:
        """Neighbouring corners, one square apart."""
        columns, rows = self.grid
        at = np.arange(columns * rows).reshape(rows, columns)
        pairs = [*zip(at[:, :-1].ravel(), at[:, 1:].ravel()), *zip(at[:-1].ravel(), at[1:].ravel())]
        return tuple((int(a), int(b), self.square_m) for a, b in pairs)

    @property
    def symmetries(self) -> np.ndarray:
        """(S, K) orders of the corners in which the detector may find them, the identity first.

        The colours tell both ends of a chessboard with an even and an odd number of corners along its sides; markers always do.
        """
        columns, rows = self.grid
        at = np.arange(columns * rows).reshape(rows, columns)
        if self.kind is BoardKind.CHARUCO or (columns + rows) % 2:
            return at.reshape(1, -1)
        turns = (0, 1, 2, 3) if columns == rows else (0, 2)
        return np.stack([np.rot90(at, k).ravel() for k in turns])

    def charuco(self, legacy: bool = False) -> cv2.aruco.CharucoBoard:
        """OpenCV's board; `legacy`: the pattern of OpenCV before 4.6, which differs for an even number of rows."""
        made = cv2.aruco.CharucoBoard(self.squares, self.square_m, self.marker_m or MARKER_PART * self.square_m, self.markers)
        made.setLegacyPattern(legacy)
        return made

    def picture(self, dpi: float = PRINT_DPI) -> np.ndarray:
        """The board as it is printed, with a white margin of one square (h, w) uint8.

        Raises:
            InputError: the picture would be too large, or its squares or markers too small.
        """
        side = round(self.square_m / 0.0254 * dpi)
        columns, rows = (n + (self.kind is BoardKind.CHESSBOARD) for n in self.squares)
        size = ((columns + 2) * side, (rows + 2) * side)
        if max(size) > LARGEST_PRINT_PX or side < 8:
            raise InputError(
                f"A board of {self.label} with squares of {self.square_m:g} m cannot be drawn as a picture of {size[0]}×{size[1]} pixels."
            )
        if self.kind is BoardKind.CHARUCO:
            least = self.markers.markerSize + 2  # pixels, one for each cell and the border
            if (self.marker_m or MARKER_PART * self.square_m) * side < least * self.square_m:
                raise InputError(f"The markers are too small to be drawn at {dpi:g} dpi; choose larger ones, or larger squares.")
            return np.asarray(self.charuco().generateImage(size, marginSize=side, borderBits=1))
        dark = np.indices((rows, columns)).sum(axis=0) % 2 == 0
        squares = np.where(dark, 0, 255).astype(np.uint8)
        return np.pad(squares.repeat(side, axis=0).repeat(side, axis=1), side, constant_values=255)


@lru_cache(maxsize=16)
def _corners(grid: tuple[int, int], square_m: float) -> np.ndarray:
    columns, rows = grid
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    corners = np.stack([x.ravel(), y.ravel(), np.zeros(columns * rows)], axis=1) * square_m
    corners.setflags(write=False)
    return corners


def write_board(path: Path, board: Board) -> None:
    """Write the board for a printer, in its true size: a PNG file with its resolution, or a PDF page.

    Raises:
        InputError: the ending is another one, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".png", ".pdf"):
        raise InputError(f"A board is printed as .png or .pdf, not as {path.name}.")
    side = round(board.square_m / 0.0254 * PRINT_DPI)
    picture = board.picture()
    per_m = side / board.square_m
    store.write_bytes(path, _pdf(picture, per_m) if path.suffix.lower() == ".pdf" else _png(picture, per_m))


def _png(picture: np.ndarray, per_m: float) -> bytes:
    """PNG with a pHYs chunk, so that it is printed in its size."""
    data = cv2.imencode(".png", picture)[1].tobytes()
    body = b"pHYs" + struct.pack(">IIB", round(per_m), round(per_m), 1)
    chunk = struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body))
    header = 8 + 25  # signature and IHDR
    return data[:header] + chunk + data[header:]


def _pdf(picture: np.ndarray, per_m: float) -> bytes:
    """PDF 1.4 of one page as large as the picture, without scaling."""
    h, w = picture.shape
    size = f"{w / per_m * POINTS_PER_M:.4f} {h / per_m * POINTS_PER_M:.4f}"
    draw = f"q {size.split()[0]} 0 0 {size.split()[1]} 0 0 cm /B Do Q".encode()
    image = zlib.compress(picture.tobytes(), 9)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size}] /Contents 4 0 R /Resources << /XObject << /B 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(draw), draw),
        b"<< /Type /XObject /Subtype /Image /Width %d /Height %d /ColorSpace /DeviceGray /BitsPerComponent 8 /Filter /FlateDecode "
        b"/Length %d >>\nstream\n%s\nendstream" % (w, h, len(image), image),
    ]
    out, places = bytearray(b"%PDF-1.4\n"), []
    for number, content in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
    return bytes(out)
