"""The table of `dev.py bench`: what it makes of results, and what it says beside the baseline."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCH = Path(__file__).with_name("bench")
MATCHING = [
    {"tool": "Tricap 13×13, 1 thread(s)", "points_per_s": 3000, "rms_px": 0.01, "over_bound": 1.2, "points": 900},
    {"tool": "Tricap 13×13, 2 thread(s)", "points_per_s": 5400, "rms_px": 0.01, "over_bound": 1.2, "points": 900},
    {"tool": "cv2.calcOpticalFlowPyrLK 13×13, 3 levels, 1 thread(s)", "points_per_s": 6000, "rms_px": 0.04},
    {"tool": "cv2.calcOpticalFlowPyrLK 13×13, 3 levels, 2 thread(s)", "points_per_s": 7200, "rms_px": 0.04},
    {"tool": "cv2.findTransformECC 13×13, affine, per point", "points_per_s": 1000, "rms_px": 0.02},
    {"tool": "published form, per point (numpy, scipy)", "points_per_s": 100, "rms_px": 0.01},
    {"tool": "Tricap 13×13, 1 thread(s)", "points_per_s": 2000, "rms_px": 0.01, "over_bound": 1.2, "points": 1000},
    {"tool": "Tricap 13×13, 1 thread(s)", "points_per_s": 4000, "rms_px": 0.01, "over_bound": 1.2, "points": 10_000},
]


@pytest.fixture(scope="module")
def table() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench_table", BENCH / "_table.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_table"] = module
    spec.loader.exec_module(module)
    return module


def test_rows_are_ratios_to_peers_bounds_and_sizes(table: ModuleType) -> None:
    rows = {row.name: row.value for row in table.rows_of({"matching": MATCHING})}
    assert rows["matching: points a second, PyrLK, 3 levels"] == 0.5 and rows["matching: error, ECC"] == 0.5
    assert rows["matching: points a second, published form"] == 30 and rows["matching: error, 13×13, Cramér–Rao bound"] == 1.2
    assert rows["matching: points a second, two threads, PyrLK, 3 levels"] == 0.75
    assert rows["matching: two threads, one thread"] == 1.8 and rows["matching: cost of a point, 10,000, 1,000 points"] == 0.5


def test_drift_and_false_points_of_tracking_stand_beside_their_peers(table: ModuleType) -> None:
    def tool(speed: float, drift: float, false: float = 0.0) -> dict[str, float]:
        return {"points_frames_per_cpu_s": speed, "drift_px": drift, "false": false, "kept": 1.0}

    results = {
        "ours, 2-D mode": tool(10_000, 0.03, 0.002), "PyrLK": tool(200_000, 0.3), "ECC loop": tool(8000, 0.08),
        "a step in three views": {"of PyrLK's speed per view": 0.3, "times an ECC loop over the same five matches a point": 15},
        "CPU s of a step in three views": {"345": 0.02, "1350": 0.06}, "CPU s of 2-D mode by frames": {"6": 0.5, "24": 2.3},
        "ours, the same points as Blender's": tool(1500, 0.03), "Blender's tracker": tool(3000, 0.06),
    }  # fmt: skip
    rows = {row.name.removeprefix("tracking: "): row.value for row in table.rows_of({"tracking": results})}
    assert round(rows["2-D mode, drift, PyrLK"], 9) == 0.1 and rows["2-D mode, 1 + false points per thousand"] == 3.0
    assert rows["2-D mode, drift, Blender's tracker"] == rows["2-D mode, points a second, Blender's tracker"] == 0.5
    assert round(rows["cost of a frame, 24, 6 frames"], 9) == 1.0
    results["Blender's tracker"] = "not compared"  # type: ignore[assignment]
    missing = [row for row in table.rows_of({"tracking": results}) if row.value is None]
    assert len(missing) == 2 and all(row.beside == "Blender's tracker" for row in missing)


def test_what_is_worse_is_told(table: ModuleType) -> None:
    def said(value: float | None, kind: str) -> str:
        return str(table.verdict(table.Row("fit", "solver", value, kind, "scipy"), {"fit: solver, scipy": 10.0})).split(" (")[0]

    assert [said(v, "speed") for v in (10.0, 7.0, 5.0, 20.0)] == ["as before", "as before", "WORSE", "better"]
    assert [said(v, "error") for v in (10.0, 11.0, 12.0, 8.0)] == ["as before", "as before", "WORSE", "better"]
    assert [said(v, "cost") for v in (14.0, 16.0)] == ["as before", "WORSE"] and said(None, "speed") == "peer missing"
    assert table.verdict(table.Row("fit", "other", 1.0, "speed", ""), {"fit: solver, scipy": 10.0}) == "new"


def test_worse_ends_with_1_and_save_makes_a_baseline(table: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "BASELINE", tmp_path / "baseline.json")
    worse = [dict(row, rms_px=0.02) if "Tricap" in row["tool"] else row for row in MATCHING]
    for name, rows in (("good.json", MATCHING), ("worse.json", worse)):
        (tmp_path / name).write_text(json.dumps({"matching": rows}))
    codes = []
    for argv in (["good.json", "--save"], ["good.json"], ["worse.json"]):
        monkeypatch.setattr(sys, "argv", ["_table.py", str(tmp_path / argv[0]), *argv[1:]])
        codes.append(table.main())
    assert codes == [0, 0, 1]


def test_the_committed_baseline_belongs_to_the_table(table: ModuleType) -> None:
    baseline = json.loads((BENCH / "baseline.json").read_text(encoding="utf-8"))
    assert {name.split(":")[0] for name in baseline} <= set(table.STAGES) | {"surface"}
    assert all(value > 0 for value in baseline.values()) and len(baseline) > 10
