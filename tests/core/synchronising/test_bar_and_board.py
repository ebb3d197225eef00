"""Films of a bar or a board that began one after another: by their sound, the images that were taken at once."""

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.calibrate import open_bar, open_boards
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.images.sequence import ImageSequence
from tricap.core.synchronising.bar_and_board import first_images

from .test_synchronise import heard, world, write_wav

START_S = dict(L=1.2, C=1.0, R=1.52)  # 6, 0 and 16 images of 30 per second after C
COUNT = dict(L=34, C=44, R=26)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Image n of a view has the grey value of the image of C that was taken with it."""
    folder, room = tmp_path_factory.mktemp("films"), world(12.0)
    for view, start_s in START_S.items():
        (folder / view).mkdir()
        for n in range(COUNT[view]):
            grey = np.full((48, 64), 100 + n + round(30 * (start_s - 1.0)), np.uint8)
            cv2.imwrite(str(folder / view / f"{n:04d}.png"), grey)
        write_wav(folder / f"{view}.wav", heard(room, start_s, 9.0, seed=ord(view)).samples)
    return folder


def by_sound(folder: Path, fps: float, names: tuple[str, ...], sequences: tuple[ImageSequence, ...]) -> tuple[int, ...]:
    return first_images(folder, names, sequences, fps, Monitor())[0]


def test_images_that_were_taken_at_once_belong_together(films: Path) -> None:
    with pytest.raises(InputError, match="different numbers of frames"):
        open_bar(films)
    bar, boards = (opened(films, starts=partial(by_sound, films, 30.0)) for opened in (open_bar, open_boards))
    for sequences in (bar.sequences, boards.sequences):
        assert [s.count for s in sequences] == [24, 24, 24]
        assert all(int(s.read(n)[0, 0]) == 116 + n for s in sequences for n in (0, 23))
        assert int(sequences[0].read_colour(2)[0, 0, 0]) == 118 and sequences[0].source and sequences[0].files()
    assert [n.tolist() for n in boards.numbers] == [list(range(24))] * 3


def test_what_cannot_be_brought_together_is_told_in_one_sentence(films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    described = ["--bar-length", "0.5", "--out", str(tmp_path / "rig.toml")]
    assert main(["calibrate", str(films), *described, "--synchronise", "0"]) == 2
    assert "“0” is no frame rate; give the images per second" in capsys.readouterr().err
    assert main(["calibrate", str(films), *described, "--synchronise", "1000"]) == 2
    assert "ended before another view began" in capsys.readouterr().err
    for view in START_S:
        (tmp_path / view).symlink_to(films / view)
    assert main(["calibrate", str(tmp_path), *described, "--synchronise", "30"]) == 2
    error = capsys.readouterr().err
    assert "View L: there is no sound of" in error and error.strip().endswith(
        "Clap once, or switch a lamp, at the beginning of a recording."
    )
