"""contours/VIEW.csv, the outline of the person in one view: read frame by frame when it is asked for, so that no length is too long.

The file is gone through once to find where each frame's rows begin and end; the rows of a frame stand one after the other.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import InputError
from .tracking.contour import Contour

HEAD = "frame,vertex,x,y,normal_x,normal_y,sigma,on_edge\n"
COLUMNS = ("x", "y", "normal_x", "normal_y", "sigma", "on_edge")
LARGEST = 1e9


@dataclass(frozen=True, kw_only=True, slots=True)
class _Place:
    """Where the rows of a frame are in the file."""

    start: int
    stop: int
    rows: int


class ContourTable(Mapping[int, Contour]):
    """The outline by frame. Reading a frame raises InputError when its rows are damaged."""

    def __init__(self, path: Path) -> None:
        """Find the frames; without such a file there are none.

        Raises:
            InputError: the file is damaged.
        """
        self._path = Path(path)
        self._columns: list[str] = []
        self._places: dict[int, _Place] = {}
        if self._path.is_file():
            try:
                self._find_frames()
            except (OSError, ValueError, IndexError, OverflowError) as error:
                raise self._damaged() from error

    def _find_frames(self) -> None:
        with self._path.open("rb") as file:
            self._columns = [name.strip() for name in file.readline().decode("utf-8").split(",")]
            if not set(COLUMNS) <= set(self._columns):
                raise ValueError("a column is missing")
            column, frame, start, rows = self._columns.index("frame"), None, file.tell(), 0
            while line := file.readline():
                if not line.strip():
                    continue
                here = int(line.split(b",", column + 1)[column])
                if here != frame:
                    self._note(frame, start, file.tell() - len(line), rows)
                    frame, start, rows = here, file.tell() - len(line), 0
                rows += 1
            self._note(frame, start, file.tell(), rows)

    def _note(self, frame: int | None, start: int, stop: int, rows: int) -> None:
        if frame is None:
            return
        if frame in self._places or abs(frame) > LARGEST:
            raise ValueError(f"the rows of frame {frame} are apart")
        self._places[frame] = _Place(start=start, stop=stop, rows=rows)

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[int]:
        return iter(self._places)

    def vertices(self, frame: int) -> int:
        """How many a frame has."""
        return self._places[frame].rows

    def __getitem__(self, frame: int) -> Contour:
        place = self._places[frame]
        try:
            with self._path.open("rb") as file:
                file.seek(place.start)
                lines = file.read(place.stop - place.start).decode("utf-8").split("\n")
            rows = [line.rstrip("\r").split(",") for line in lines if line.strip()]
            at = [self._columns.index(name) for name in COLUMNS]
            table = np.array([[float(row[i]) for i in at] for row in rows]).reshape(-1, len(COLUMNS))
        except (OSError, ValueError, IndexError) as error:
            raise self._damaged() from error
        if len(table) != place.rows or not np.isfinite(table).all() or (np.abs(table) > LARGEST).any():
            raise self._damaged()
        return Contour(xy_px=table[:, :2], normal=table[:, 2:4], sigma_px=table[:, 4], seen=table[:, 5] > 0)

    def _damaged(self) -> InputError:
        return InputError(f"{self._path} is damaged; run `tricap contour` again.")


class Polygons(Mapping[int, np.ndarray]):
    """The vertices (V, 2) px of a table's outlines in some frames, by frame, where they have corners enough."""

    def __init__(self, table: ContourTable, frames: Sequence[int], least_corners: int) -> None:
        self._table = table
        self._frames = {frame: None for frame in table if frame in frames and table.vertices(frame) >= least_corners}

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames)

    def __getitem__(self, frame: int) -> np.ndarray:
        if frame not in self._frames:
            raise KeyError(frame)
        return self._table[frame].xy_px


def contour_rows(frame: int, contour: Contour) -> str:
    """The lines of a frame."""
    table = np.column_stack([contour.xy_px, contour.normal, contour.sigma_px])
    return "".join(f"{frame},{v}," + ",".join(f"{x:.4f}" for x in row) + f",{int(contour.seen[v])}\n" for v, row in enumerate(table))
