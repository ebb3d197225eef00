"""contours/VIEW.csv is read frame by frame, on access."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.tracking.contour import HEAD, Contour, ContourTable, Polygons, contour_rows


def contour(frame: int, vertices: int = 4) -> Contour:
    xy = frame + np.arange(2.0 * vertices).reshape(-1, 2)
    return Contour(xy_px=xy, normal=np.tile([0.0, 1.0], (vertices, 1)), sigma_px=np.full(vertices, 0.25), on_edge=np.arange(vertices) > 0)


def test_what_was_written_comes_back_frame_by_frame(tmp_path: Path) -> None:
    path = tmp_path / "C.csv"
    assert not ContourTable(path)
    path.write_text(HEAD + "".join(contour_rows(f, contour(f, v)) for f, v in ((3, 4), (5, 2), (-2, 3))))
    table = ContourTable(path)
    assert list(table) == [3, 5, -2] and [table.vertices(f) for f in table] == [4, 2, 3] and 4 not in table
    for frame in table:
        a, b = table[frame], contour(frame, table.vertices(frame))
        assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("xy_px", "normal", "sigma_px", "on_edge"))
    polygons = Polygons(table, range(0, 9), least_corners=3)
    assert list(polygons) == [3] and np.array_equal(polygons[3], contour(3).xy_px) and polygons.get(5) is None


HUGE = f"1{'0' * 400},0,1,2,0,1,0.2,1"
APART = "1,0,1,2,0,1,0.2,1\n2,0,1,2,0,1,0.2,1\n1,1,1,2,0,1,0.2,1"


@pytest.mark.parametrize("row", [HUGE, "1,0,nan,2,0,1,0.2,1", "1,0,1e300,2,0,1,0.2,1", "1,0,\0,2,0,1,0.2,1", "1,2", APART])
def test_damage_is_reported(tmp_path: Path, row: str) -> None:
    (tmp_path / "C.csv").write_text(f"{HEAD}{row}\n")
    with pytest.raises(InputError, match="damaged"):
        list(ContourTable(tmp_path / "C.csv").values())
    (tmp_path / "C.csv").write_text("frame,vertex,x,y,on_edge\n1,0,1,2,1\n")
    with pytest.raises(InputError, match="damaged"):
        ContourTable(tmp_path / "C.csv")


def test_no_frame_stays_in_memory(tmp_path: Path) -> None:
    path, many = tmp_path / "C.csv", 100
    rows = "".join(contour_rows(0, contour(0, many)).splitlines(keepends=True))
    path.write_text(HEAD + "".join(rows.replace("\n0,", f"\n{f},").replace("0,0,", f"{f},0,", 1) for f in range(300)))
    tracemalloc.start()
    try:
        assert sum(len(c.xy_px) for c in ContourTable(path).values()) == 300 * many
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < path.stat().st_size / 2  # 0.2 MB of 1.6: an index of the frames
