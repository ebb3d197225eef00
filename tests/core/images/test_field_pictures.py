"""Pictures of single fields: the right rows, made once, and made again when the footage or the order of the fields is another."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.images.interlace import BOTH, MADE_FROM, field_layout, field_pictures
from tricap.core.images.sequence import open_sequence


def test_fields_as_pictures(tmp_path: Path) -> None:
    for i in range(2):
        woven = np.full((6, 8), 40 * i, np.uint8)
        woven[1::2] += 20
        (tmp_path / "C").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "C" / f"{i}.png"), woven)
    sequence = open_sequence(tmp_path, images="C/*.png", movie=None, view="C")

    def made(first: str) -> tuple[list[int], list[Any]]:
        paths = field_pictures(sequence, field_layout(BOTH, first), tmp_path / "fields")
        pictures = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]
        assert all(picture.shape == (6, 8) and np.ptp(picture) == 0 for picture in pictures)
        return [int(picture[0, 0]) for picture in pictures], [path.stat().st_mtime_ns for path in paths]

    odd, when = made("odd")
    assert odd == [0, 20, 40, 60] and made("odd") == (odd, when)
    assert made("even")[0] == [20, 0, 60, 40]
    cv2.imwrite(str(tmp_path / "C" / "1.png"), np.full((6, 8), 99, np.uint8))
    os.utime(tmp_path / "C" / "1.png", ns=(1, 1))
    assert made("even")[0] == [20, 0, 99, 99]


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
@pytest.mark.parametrize("link", ["fields", "fields/C"])
def test_pictures_are_not_written_through_links(tmp_path: Path, link: str) -> None:
    (tmp_path / "C").mkdir()
    cv2.imwrite(str(tmp_path / "C" / "0.png"), np.zeros((6, 8), np.uint8))
    sequence = open_sequence(tmp_path, images="C/*.png", movie=None, view="C")
    (tmp_path / "elsewhere" / "C").mkdir(parents=True)
    (tmp_path / link).parent.mkdir(exist_ok=True)
    (tmp_path / link).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="is a link"):
        field_pictures(sequence, field_layout(BOTH, "odd"), tmp_path / "fields" / "C")
    assert [path.name for path in (tmp_path / "elsewhere").rglob("*")] == ["C"]


def test_pictures_of_somebody_else_are_not_replaced(tmp_path: Path) -> None:
    """Footage that lay in a folder “fields” of the results was overwritten."""
    for folder in ("C", "fields/C"):
        (tmp_path / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / folder / "000000.png"), np.full((6, 8), 7, np.uint8))
    sequence = open_sequence(tmp_path, images="C/*.png", movie=None, view="C")
    with pytest.raises(InputError, match="000000.png is not a picture of a field that Tricap wrote"):
        field_pictures(sequence, field_layout(BOTH, "odd"), tmp_path / "fields" / "C")
    assert [path.name for path in (tmp_path / "fields" / "C").iterdir()] == ["000000.png"]
    (tmp_path / "fields" / "C" / MADE_FROM).write_text("{}")  # of a run that was killed
    assert len(field_pictures(sequence, field_layout(BOTH, "odd"), tmp_path / "fields" / "C")) == 2
