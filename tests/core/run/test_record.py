"""frames.csv: what stands in it, and which frames it calls bad."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.run.record import (
    COLUMNS,
    FrameTable,
    doubt,
    doubtful_frames,
    doubtful_stretches,
    frame_table,
    read_frame_table,
    write_frame_table,
)
from tricap.core.surface.frames import FrameSummary
from tricap.core.tracking.trajectories import with_kinematics


def summary(frame: int, points: int, sigma_m: float, residual: float) -> FrameSummary:
    return FrameSummary(frame=frame, key="", points=points, limit_px=1.0, smoothed_px=0.0, residual_px=residual, sigma_m=sigma_m)


def table() -> FrameTable:
    summaries = [summary(4, 100, 1e-3, 0.1), summary(5, 90, 1e-3, 0.4), summary(6, 0, np.nan, np.nan), summary(7, 110, 1.1e-3, 0.12)]
    summaries.append(summary(8, 100, 1e-3, 0.1))
    xyz = np.zeros((4, 3, 3))
    xyz[2, :2] = np.nan
    tracks = with_kinematics(np.arange(4, 8), np.arange(4, 8) / 25, xyz, np.where(np.isfinite(xyz[..., 0]), 2e-3, np.nan),
                             np.ones((4, 3), dtype=np.int8), 0)  # fmt: skip
    return frame_table(summaries, tracks, None)


def test_what_stands_in_it() -> None:
    made = table()
    assert made.frames.tolist() == [4, 5, 6, 7, 8] and made.values["points"].tolist() == [100, 90, 0, 110, 100]
    assert np.allclose(made.values["sigma_mm"], [1, 1, np.nan, 1.1, 1], equal_nan=True)
    assert np.allclose(made.values["tracks"], [3, 3, 1, 3, np.nan], equal_nan=True)
    assert np.allclose(made.values["track_sigma_mm"], [2, 2, 2, 2, np.nan], equal_nan=True) and made.fit == ("",) * 5


def test_bad_frames_and_why() -> None:
    much, why = table().badness()
    assert why == ("", "large residuals", "few points", "", "") and much.argmax() == 2 and much[0] < 1.2
    fitted = FrameTable(frames=np.arange(2), values={name: np.ones(2) for name in COLUMNS}, fit=("fitted", "bridged"))
    assert fitted.badness()[1] == ("", "fit bridged")
    nothing = FrameTable(frames=np.zeros(0, dtype=int), values={name: np.zeros(0) for name in COLUMNS}, fit=())
    assert nothing.badness()[1] == ()


def test_there_and_back(tmp_path: Path) -> None:
    path, made = tmp_path / "frames.csv", table()
    write_frame_table(path, made)
    again = read_frame_table(path)
    assert again.frames.tolist() == made.frames.tolist() and again.fit == made.fit
    for name in COLUMNS:
        assert np.allclose(again.values[name], made.values[name], rtol=1e-3, equal_nan=True)


@pytest.mark.parametrize("text", ["frame\n1\n", "frame,points\n1,2\n", f"frame,{','.join(COLUMNS)},fit\n1,many,1,1,1,1,1,1,\n"])
def test_a_damaged_table_is_told(tmp_path: Path, text: str) -> None:
    (tmp_path / "frames.csv").write_text(text)
    with pytest.raises(InputError, match="damaged"):
        read_frame_table(tmp_path / "frames.csv")
    with pytest.raises(InputError, match="Cannot read"):
        read_frame_table(tmp_path / "missing.csv")


def test_doubtful_frames() -> None:
    """Contradicted limbs first, then the worst; a state of the fit that most frames share singles out none."""
    frames, values = np.arange(10, 15), {name: np.full(5, np.nan) for name in COLUMNS}
    values["sigma_mm"] = np.array([1.0, 1.0, 4.0, 1.0, 2.0])
    states = FrameTable(frames=frames, values=values, fit=("partial", "partial", "partial", "bridged", "partial"))
    assert doubtful_frames(states, None) == {12: "points uncertain", 13: "fit bridged", 14: "points uncertain"}
    assert doubtful_stretches(states, {}) == [(12, 14, "points uncertain")]
    guessed = {"right arm": (10, 11, 14), "left leg": (11,)}
    stretches = [(10, 11, "right arm guessed"), (11, 11, "left leg guessed"), (12, 14, "points uncertain"), (14, 14, "right arm guessed")]
    assert doubtful_stretches(states, guessed) == stretches
    assert doubtful_stretches(None, guessed) == [row for row in stretches if "guessed" in row[2]]
    badness, why = doubt(states, guessed)
    limbs = ("right arm guessed", "right arm and left leg guessed")
    assert why == (*limbs, "points uncertain", "fit bridged", "right arm guessed") and badness.tolist() == [3.0, 3.0, 4.0, 3.0, 3.0]
    assert doubt(states, {})[1][:2] == ("", ""), "what most frames share makes none of them doubtful"
    motion = SimpleNamespace(frames=frames, joint_names=("wrist.R",), known=(("guessed",), *((("seen",),) * 4)))
    body: Any = SimpleNamespace(contradicted={"upper_arm.R": (11, 12), "shin.L": (12,)}, motion=motion)
    found = doubtful_frames(states, body)
    assert list(found) == [11, 12, 10, 13, 14] and found[10] == "the right arm is guessed"
    assert found[12] == "the images contradict the right arm and the left lower leg"
