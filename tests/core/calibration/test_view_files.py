"""The images of all cameras in one folder are told apart by their names."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.calibrate import open_bar, open_boards
from tricap.core.calibration.view_files import cameras_of_files
from tricap.core.foundation.errors import InputError


@pytest.mark.parametrize(
    ("files", "names"),
    [
        ([f"{n:05d}_cam{k}_{v}.jpg" for n in (1, 137, 273, 409) for k, v in enumerate("LMR")], ["cam0_L", "cam1_M", "cam2_R"]),
        ([f"cam{k}_{n:03d}.png" for n in range(12) for k in range(4)], ["cam0", "cam1", "cam2", "cam3"]),
        ([f"{side}{n:02d}.jpg" for n in range(14) for side in ("left", "right")], ["left", "right"]),
        ([f"[{view}] {n}.png" for n in range(3) for view in "ab"], ["[a]", "[b]"]),
        ([f"{n}_L.png" for n in range(9)] + [f"{n}_cam_L.png" for n in range(9)], []),  # the pattern *_L.png is that of both
        ([f"img{n:03d}.png" for n in range(12)], []),
        (["a.png", "b.png"], []),
        (["L_1.png", "R_1.png"], []),
        ([f"L_{n}.png" for n in range(9)] + ["note.png"], []),
        ([], []),
    ],
)
def test_the_names_of_files_name_the_cameras(files: list[str], names: list[str]) -> None:
    assert sorted(cameras_of_files(files)) == names


def test_images_of_all_cameras_in_one_folder_are_opened(tmp_path: Path) -> None:
    for n in range(3):
        for c, view in enumerate(("L", "[R]")):
            cv2.imwrite(str(tmp_path / f"{n:03d}_{view}.png"), np.full((8, 8), 10 * n + c, np.uint8))
    for footage in (open_bar(tmp_path), open_boards(tmp_path)):
        assert footage.names == ("L", "[R]") and [s.count for s in footage.sequences] == [3, 3]
        assert int(footage.sequences[1].read(2)[0, 0]) == 21
    for file in tmp_path.glob("*R*"):
        file.unlink()
    with pytest.raises(InputError, match="no views; it needs a folder of images, or a movie, for each"):
        open_bar(tmp_path)
