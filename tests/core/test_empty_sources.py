"""What is empty in the views of a filmed take: the wall, and nothing of the person."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from tricap.core.empty_sources import STEP_PX, find_empty
from tricap.core.progress import Monitor
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take import open_take, read_take


def test_nothing_of_a_moving_arm_is_empty(tmp_path: Path) -> None:
    make_arm_take(tmp_path, ArmTakeSettings(frames=8, width_px=384, interlaced="none"), Monitor())
    truth, footage = np.load(tmp_path / "truth.npz"), open_take(read_take(tmp_path))
    seen = np.unpackbits(truth["visible"], axis=1)[:, : truth["vertices_m"].shape[1]].astype(bool)
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=truth["vertices_m"][t][seen[t]][::40]) for t in range(8)]
    views = find_empty(footage, clouds, Monitor())
    assert [view.view for view in views] == ["L", "C", "R"]
    for view in views:
        camera = footage.rig[view.view]
        for t in (0, 4, 7):
            distance = view.of_frame(t)
            assert distance is not None and 0.2 < (distance > 0).mean() < 0.9
            at = np.floor(camera.project(truth["vertices_m"][t][seen[t]]) / STEP_PX).astype(int)
            assert (distance[at[:, 1], at[:, 0]] > 0).mean() < 0.01
    assert find_empty(footage, clouds[:4], Monitor()) == []  # too few to tell what stands still
    assert views[0].of_frame(99) is None
