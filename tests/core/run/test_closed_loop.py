"""The loop of tracking and fitting: for whom it is closed, and a run that goes through it and resumes."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.fitting.settings import FitSettings
from tricap.core.run import closed_loop, pipeline
from tricap.core.run.closed_loop import OFF, OUTLINES, TRACKS, loop_of
from tricap.core.run.settings import settings_of
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.truth import read_truth
from tricap.core.tracking.contour import ContourTable


def test_the_loop_is_closed_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """By default it is open; auto may close it for whole bodies only."""
    whole, arm = (read_model(name).skeleton for name in ("full", "arm.R"))
    assert [loop_of(FitSettings(closed_loop=word), arm) for word in (OFF, TRACKS, OUTLINES)] == [OFF, TRACKS, OUTLINES]
    assert loop_of(FitSettings(), arm) == OFF == loop_of(FitSettings(), whole)
    monkeypatch.setattr(closed_loop, "FOR_WHOLE_BODIES", TRACKS)
    assert loop_of(FitSettings(), arm) == OFF and loop_of(FitSettings(), whole) == TRACKS
    assert settings_of({}, {"method": {"preset": "published"}}, "take.toml")["fitting"].closed_loop == OFF


@pytest.mark.slow
def test_a_run_through_the_loop(tmp_path: Path) -> None:
    """Outlines in every view that lie on the arm, a fit with both, and the same bytes when the run is repeated from its checkpoints."""
    make_arm_take(tmp_path / "take", ArmTakeSettings(frames=4, width_px=320, interlaced="none"))
    settings = {"growing": {"spacing_px": 6}, "fitting": {"closed_loop": OUTLINES}}
    out = tmp_path / "out"
    first = pipeline.run(tmp_path / "take", out, settings)
    truth, rig = read_truth(tmp_path / "take"), first.footage.rig
    assert first.body is not None and first.record["stages"]["fit"]["tracked_again"]["trajectories"] > 0
    elbow = np.stack([first.body.motion.joints_m[t, first.body.motion.joint_names.index("elbow.R")] for t in range(4)])
    assert np.linalg.norm(elbow - truth.joints_m["RightForeArm"], axis=1).max() < 0.02
    for camera in rig.cameras:
        table = ContourTable(out / "outlines" / f"{camera.name}.csv")
        assert sorted(table) == [0, 1, 2, 3] and table[0].on_edge.mean() > 0.4
        sleeve = camera.project(truth.vertices_m[0, truth.textured & truth.visible[0]])
        sleeve = sleeve[np.linalg.norm(sleeve - camera.project(elbow[0]), axis=1) < 15]
        apart = np.linalg.norm(table[0].xy_px[:, None] - sleeve, axis=2).min(axis=1)
        assert apart.min() < 3.0
    assert first.record["stages"]["fit"]["closed_loop"] == OUTLINES
    shown = {path.name for path in (out / "report").glob("outlines_*.png")}
    assert shown == {f"outlines_0002_{camera.name}.png" for camera in rig.cameras}
    page = (out / "report" / "report.html").read_text()
    assert ">The closed loop</h2>" in page and f"closed once (fitting.closed_loop = {OUTLINES})" in page
    kept = (out / "joints.csv").read_bytes()
    (out / "joints.csv").unlink()
    pipeline.run(tmp_path / "take", out, settings)
    assert (out / "joints.csv").read_bytes() == kept and not (out / "contours").exists()
