"""What is empty in the views of a filmed take: the wall, and nothing of the person."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.fitting.inputs.background import STEP_PX, find_background
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take.take import open_take, read_take


def test_nothing_of_a_moving_arm_is_empty(tmp_path: Path) -> None:
    make_arm_take(tmp_path, ArmTakeSettings(frames=8, width_px=384, interlaced="none"), Monitor())
    truth, footage = np.load(tmp_path / "truth.npz"), open_take(read_take(tmp_path))
    seen = np.unpackbits(truth["visible"], axis=1)[:, : truth["vertices_m"].shape[1]].astype(bool)
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=truth["vertices_m"][t][seen[t]][::40]) for t in range(8)]
    views = find_background(footage, clouds, Monitor())
    assert [view.view for view in views] == ["L", "C", "R"]
    for view in views:
        camera = footage.rig[view.view]
        for t in (0, 4, 7):
            distance = view.of_frame(t)
            assert distance is not None and 0.2 < (distance > 0).mean() < 0.9
            at = np.floor(camera.project(truth["vertices_m"][t][seen[t]]) / STEP_PX).astype(int)
            assert (distance[at[:, 1], at[:, 0]] > 0).mean() < 0.01
    assert find_background(footage, clouds[:4], Monitor()) == []  # too few to find what stands still
    assert views[0].of_frame(99) is None


def test_who_never_moves_is_told_by_the_background_in_take_toml(tmp_path: Path, scenes: Any) -> None:
    """A board that hangs in the room through all frames is taken for the room where no background is given, and nowhere else."""
    rig, board = scenes.three_cameras(), scenes.Body(half_m=(0.2, 0.15))
    take = scenes.write_take(tmp_path, rig, [[board]] * 6, more='[body]\nmodel = "arm.R"')
    text = (take / "take.toml").read_text().replace('images = "C/*.png"', 'images = "C/*.png"\nbackground = "empty.png"')
    (take / "take.toml").write_text(text)
    cv2.imwrite(str(take / "empty.png"), scenes.render(rig["C"], [], noise=1.0, seed=99))
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=np.zeros((0, 3))) for t in range(6)]
    board_px = (scenes.render(rig["C"], [board], background=-1.0) >= 0)[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX]
    empty = {view.view: view.of_frame(3)[: len(board_px)] > 0 for view in find_background(open_take(read_take(take)), clouds, Monitor())}
    board_px = board_px[: len(empty["C"])]
    assert not empty["C"][board_px].any() and empty["C"][~cv2.dilate(board_px.astype(np.uint8), np.ones((5, 5))).astype(bool)].all()
    assert empty["L"].mean() > 0.95
    assert [view.view for view in find_background(open_take(read_take(take)), clouds[:2], Monitor())] == ["C"]  # the others are too few
    cv2.imwrite(str(take / "empty.png"), scenes.render(rig["C"], [], background=200.0))
    with pytest.raises(InputError, match="is nothing like view C in any frame"):
        find_background(open_take(read_take(take)), clouds, Monitor())
