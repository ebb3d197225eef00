"""Whole runs of a take without a body: what is left in OUT, what is said, and what is not kept from an earlier run."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.cli import main
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rig import read_rig
from tricap.core.run import pipeline
from tricap.core.take.writing import read_table, write_table


@pytest.fixture(scope="module")
def finished(plane_take: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """OUT of a run of all frames; do not change it, copy it."""
    out = tmp_path_factory.mktemp("run") / "out"
    pipeline.run(plane_take, out)
    return out


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "out"))


def test_a_run_without_a_body(finished: Path) -> None:
    """Clouds, trajectories and a report; no body's files, and run.json says why. Nobody wants a body: that is no warning."""
    assert sorted(p.name for p in (finished / "clouds").iterdir()) == [f"{i:04d}.ply" for i in range(4)]
    run = json.loads((finished / "run.json").read_text())
    assert run["stages"]["fit"]["not_done"] == 'model = "none" under [body]' and run["warnings"] == []
    assert {"measure", "track", "fit", "report"} <= set(run["stages"]) and run["stages"]["measure"]["residual_px"] < 0.3
    assert (finished / "trajectories.npz").exists()
    assert sorted(p.name for p in (finished / "tracked").iterdir()) == [f"{i:04d}.ply" for i in range(4)]
    assert not any((finished / name).exists() for name in ("body.toml", "joints.csv", "motion.csv", "skin"))
    page = (finished / "report" / "report.html").read_text()
    assert "src=" in page and "http://" not in page.replace("http://www.w3.org", "")
    assert not list(finished.rglob("*.part"))


@pytest.mark.slow
def test_where_nobody_is_seen_the_run_says_so(plane_take: Path, tmp_path: Path) -> None:
    """Without [body], whoever is seen is fitted; a plane is nobody."""
    take, out = Path(shutil.copytree(plane_take, tmp_path / "take")), tmp_path / "out"
    write_table(take, {key: value for key, value in read_table(take).items() if key != "body"})
    job = pipeline.run(take, out, frames=(0, 2))
    assert any(w.startswith("No body was fitted: take.toml has no clicked joints.") for w in job.record["warnings"])
    assert job.record["stages"]["fit"]["not_done"] == "no clicked joints" and not (out / "body.toml").exists()
    assert "No body was fitted" in (out / "report" / "report.html").read_text()
    at = {c.name: c.project(np.array([[0.0, 0.0, 2.0]]))[0].tolist() for c in read_rig(take / "rig.toml").cameras}
    write_table(take, read_table(take) | {"seeds": {"frame": 3, "joints": {"neck": at}}})
    assert pipeline.run(take, out, frames=(0, 2)).record["stages"]["fit"]["not_done"] == "no clicked joints in these frames"


def test_running_again_computes_nothing_again(plane_take: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tricap.core.surface import measure

    monkeypatch.setattr(measure, "_measure", lambda *args: pytest.fail("computed again"))
    before = (out / "trajectories.npz").read_bytes()
    pipeline.run(plane_take, out)
    again, _ = store.load(out / "trajectories.npz")
    (out / "trajectories.npz").write_bytes(before)
    for name, array in store.load(out / "trajectories.npz")[0].items():
        assert array.tobytes() == again[name].tobytes(), name


def test_fewer_frames_leave_no_clouds_of_others(plane_take: Path, out: Path) -> None:
    pipeline.run(plane_take, out, frames=(1, 3))
    assert sorted(p.name for p in (out / "clouds").iterdir()) == ["0001.ply", "0002.ply"]
    assert store.load(out / "trajectories.npz")[0]["frames"].tolist() == [1, 2]


def test_one_frame_is_a_run(plane_take: Path, tmp_path: Path) -> None:
    """Nothing can be tracked in one frame; the report is made all the same, without pictures of no trajectories."""
    job = pipeline.run(plane_take, tmp_path / "out", frames=(0, 1))
    assert (tmp_path / "out" / "report" / "report.html").exists() and "1 frames" in str(job)
    assert {path.stem.partition("_")[0] for path in (tmp_path / "out" / "report").glob("*.png")} == {"patches", "surface", "cloud"}


@pytest.mark.slow
def test_restart_measures_anew(plane_take: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tricap.core.surface import measure

    once, computed = measure._measure, []
    monkeypatch.setattr(measure, "_measure", lambda *args: computed.append(args) or once(*args))
    pipeline.run(plane_take, out, frames=(0, 2), restart=True)
    assert len(computed) == 2


def test_restart_helps_over_a_run_of_another_version(plane_take: Path, out: Path) -> None:
    store.write_json(out / "run.json", {"format": "tricap-run", "version": 99})
    with pytest.raises(InputError, match="--restart"):
        pipeline.run(plane_take, out, frames=(0, 1))
    pipeline.run(plane_take, out, frames=(0, 1), restart=True)


def test_an_unknown_body_is_noticed_before_anything_is_computed(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    c, r = (scenes.three_cameras()[v].project([0.0, 0.0, 2.16]).round(1).tolist() for v in "CR")
    write_table(take, read_table(take) | {"seeds": {"frame": 0, "joints": {"elbow.R": {"C": c, "R": r}}}})
    (take / "take.toml").write_text((take / "take.toml").read_text().replace('model = "none"', 'model = "arm.X"'))
    with pytest.raises(InputError, match="no body model “arm.X”"):
        pipeline.run(take, tmp_path / "out", frames=(0, 2))
    assert not (tmp_path / "out" / "clouds").exists()


def test_results_of_other_settings_do_not_stay(plane_take: Path, out: Path) -> None:
    """`tricap measure` with another patch into the folder of a finished run: its trajectories belong to clouds that are gone."""
    assert main.main(["measure", str(plane_take), "--out", str(out), "--set", "matching.patch_px=11", "--quiet"]) == 0
    run = json.loads((out / "run.json").read_text())
    assert not (out / "trajectories.npz").exists() and "track" not in run["stages"]
