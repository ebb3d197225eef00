"""One table over all benchmarks, beside their peers and bounds and the committed baseline. The standard library is all it needs.

    python tests/bench/_table.py RESULTS.json [--save]

RESULTS.json is what `dev.py bench --json FILE` writes. Nearly every row is a ratio that means the same on every machine: a speed over a
peer's in the same run, an error over its bound, a cost over that of half the size. Only memory is in MB, and times are over their goals.
baseline.json holds the figures of the last time that somebody looked at them and found them good (`--save`), and a row is worse when it
left its tolerance on the wrong side.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BASELINE = Path(__file__).with_name("baseline.json")
# How far a figure may leave the baseline: errors do not depend on the machine, ratios of times do a little, memory on its allocator.
TOLERANCE = {"error": 1.15, "speed": 1.6, "cost": 1.5, "memory": 1.3, "time": 2.5}
FRAME_MS, SEQUENCE_MS = 50, 100  # goals for a frame of a whole body on two cores: from frame to frame, and in the whole sequence


@dataclass(frozen=True)
class Row:
    """A figure of a stage. `kind`: speed (more is better), error, cost, time or memory (less is better). `beside`: the peer or bound."""

    stage: str
    what: str
    value: float | None  # None: the peer is missing
    kind: str
    beside: str

    @property
    def name(self) -> str:
        """How the baseline calls it."""
        return f"{self.stage}: {self.what}, {self.beside}" if self.beside else f"{self.stage}: {self.what}"


def matching(rows: list[dict[str, Any]]) -> Iterator[Row]:
    """Against OpenCV's trackers and the Cramér–Rao bound."""
    by = {(row["tool"], row.get("points")): row for row in rows}
    of = {tool: row for (tool, _), row in reversed(by.items())}
    own = of["Tricap 13×13, 1 thread(s)"]
    for name, start in (("PyrLK, 3 levels", "cv2.calcOpticalFlowPyrLK 13×13, 3 levels, 1"), ("ECC", "cv2.findTransformECC"),
                        ("published form", "published form")):  # fmt: skip
        peer = next(row for tool, row in of.items() if tool.startswith(start))
        yield Row("matching", "points a second", own["points_per_s"] / peer["points_per_s"], "speed", name)
        yield Row("matching", "error", own["rms_px"] / peer["rms_px"], "error", name)
    yield Row("matching", "error, 13×13", own["over_bound"], "error", "Cramér–Rao bound")
    both = of["Tricap 13×13, 2 thread(s)"]["points_per_s"]
    yield Row("matching", "two threads", both / own["points_per_s"], "speed", "one thread")
    pyramid = next(row for tool, row in of.items() if tool.startswith("cv2.calcOpticalFlowPyrLK 13×13, 3 levels, 2"))
    yield Row("matching", "points a second, two threads", both / pyramid["points_per_s"], "speed", "PyrLK, 3 levels")
    few, many = (next(r for r in rows if r.get("points") == n) for n in (1000, 10_000))
    yield Row("matching", "cost of a point, 10,000", few["points_per_s"] / many["points_per_s"], "cost", "1,000 points")


def tracking(table: dict[str, Any]) -> Iterator[Row]:
    """Against OpenCV's pyramid, a loop over ECC, and Blender's own tracker where there is one."""
    own, step = table["ours, 2-D mode"], table["a step in three views"]
    for peer in ("PyrLK", "ECC loop"):
        speed = own["points_frames_per_cpu_s"] / table[peer]["points_frames_per_cpu_s"]
        yield Row("tracking", "2-D mode, points a second", speed, "speed", peer)
    yield Row("tracking", "2-D mode, drift", own["drift_px"] / table["PyrLK"]["drift_px"], "error", "PyrLK")
    yield Row("tracking", "2-D mode, 1 + false points per thousand", 1 + 1e3 * own["false"], "error", "")
    same, blender = table["ours, the same points as Blender's"], table["Blender's tracker"]
    for what, name, kind in (("points a second", "points_frames_per_cpu_s", "speed"), ("drift", "drift_px", "error")):
        value = None if isinstance(blender, str) else same[name] / blender[name]
        yield Row("tracking", f"2-D mode, {what}", value, kind, "Blender's tracker")
    yield Row("tracking", "three views, per view", step["of PyrLK's speed per view"], "speed", "PyrLK")
    yield Row("tracking", "three views", step["times an ECC loop over the same five matches a point"], "speed", "ECC loop")
    costs = [(int(n), float(s)) for n, s in table["CPU s of a step in three views"].items()]
    (few, first), (many, last) = min(costs), max(costs)
    yield Row("tracking", f"cost of a point, {many}", last / many / (first / few), "cost", f"{few} points")
    (short, first), *_, (long, last) = sorted((int(n), float(s)) for n, s in table["CPU s of 2-D mode by frames"].items())
    yield Row("tracking", f"cost of a frame, {long}", last / (long - 1) / (first / (short - 1)), "cost", f"{short} frames")


def fit(table: dict[str, Any]) -> Iterator[Row]:
    """Against scipy's solver on one problem; a frame's cost in longer sequences."""
    one, (short, long) = table["one_frame"], table["sequence"]
    yield Row("fit", "solver", one["scipy_2point_s"] / one["ours_s"], "speed", "scipy, differences")
    yield Row("fit", "solver", one["scipy_jacobian_s"] / one["ours_s"], "speed", "scipy, our Jacobian")
    yield Row("fit", "solver, to equal cost", one["scipy_2point_equal_times"], "speed", "scipy, differences")
    yield Row("fit", "solver, to equal cost", one["scipy_jacobian_equal_times"], "speed", "scipy, our Jacobian")
    yield Row("fit", "what is left", one["ours_cost"] / one["scipy_2point_cost"], "error", "scipy, differences")
    whole = [table["sequence_ms_a_frame"] + table["covariance_ms_a_frame"] for table in (short, long)]
    yield Row("fit", f"cost of a frame, {long['frames']}", whole[1] / whole[0], "cost", f"{short['frames']} frames")
    yield Row("fit", "a frame after the other", long["frame_to_frame_ms_a_frame"] / FRAME_MS, "time", f"{FRAME_MS} ms a frame")
    yield Row("fit", "the whole sequence, with covariance", whole[1] / SEQUENCE_MS, "time", f"{SEQUENCE_MS} ms a frame")
    yield Row("fit", "joints [mm]", long["joints_mm"], "error", "truth")
    of = {row["with"].strip(): row for row in table["ablation"]}
    for kind in ("one ellipsoid", "complete"):
        for what, name in (("surface_mm", "surface"), ("depth_mm", "joints in depth")):
            yield Row("fit", f"{name}, {kind}", of[f"muscles: {kind}"][what] / of["muscles: three balls"][what], "error", "three balls")


def constraints(rows: list[dict[str, Any]]) -> Iterator[Row]:
    """On every scene: error and coverage against matching without constraints, and what it costs beside growing."""
    free = {(r["scene"], r["texture"]): r for r in rows if r["constraint"] == "none" and not r["neighbours"]}
    for r in rows:
        if r["constraint"] == "none" or not r["neighbours"]:
            continue
        where, base = f"{r['constraint']} on {r['scene']}, {r['texture']}", free.get((r["scene"], r["texture"]))
        if base:
            yield Row("surface", f"error, {where}", r["rms_mm"] / base["rms_mm"], "error", "no constraint")
        yield Row("surface", f"cost, {where}", r["cpu_s"] / max(r["grow_cpu_s"], 0.01), "cost", "growing")


def calibration(table: dict[str, Any]) -> Iterator[Row]:
    """Errors over the bound, rigs that do not converge, and the peers."""
    for name, case in table["accuracy"].items():
        if isinstance(case, dict):
            yield Row("calibration", f"error, {name}", case["ratio"], "error", "Cramér–Rao bound")
    for name, case in table["random_rigs"].items():
        yield Row("calibration", f"converged, {name}", case["converged"] / case["rigs"], "speed", "all rigs")
    discs = table["targets"]
    yield Row("calibration", "disc's centre, error", discs["matched_rms_px"] / discs["centroid_rms_px"], "error", "centroid")
    peers = dict(table["peers"])
    peers.pop("tricap, from nothing")
    same = peers.pop("tricap, from the same start as the peers, without k3")
    for name, peer in peers.items():
        found = peer.get("seconds") if isinstance(peer, dict) else None
        yield Row("calibration", "the same start, speed", found / same["seconds"] if found else None, "speed", name)


def run(table: dict[str, Any]) -> Iterator[Row]:
    """The whole path against frames, points, cameras and workers, and its memory."""
    for what, value in table.items():
        if what in ("cpu_s_a_frame", "stages"):  # seconds: the benchmark itself prints them
            continue
        kind = "speed" if "faster" in what else "memory" if what == "peak_mb" else "cost"
        yield Row("run", what.replace("peak_mb", "peak memory [MB]"), value, kind, "")


def memory(rows: list[dict[str, Any]]) -> Iterator[Row]:
    """The peak of the longest clip that was run, in which a kept picture or cloud a frame would show, and what a fit of 20 minutes needs.

    What 20 minutes need rests on small differences of the peaks: the benchmark itself prints it.
    """
    for row in rows:
        frames, peak = max((int(n), mb) for n, mb in row["peak_mb"].items())
        if row["stage"] == "fit":
            yield Row("memory", "20 minutes of a body, fit [MB]", row["mb_20_minutes"], "memory", "")
        else:
            yield Row("memory", f"{frames} frames, {row['stage']} [MB]", peak, "memory", "")


def clip(table: dict[str, Any]) -> Iterator[Row]:
    """The peak of each stage of a whole run of a clip."""
    for row in table["stages"]:
        yield Row("clip", f"{row['frames']} frames, {row['stage']} [MB]", row["peak_mb"], "memory", "")


def texture(rows: list[dict[str, Any]]) -> Iterator[Row]:
    """Weak and strong texture, beside semi-global matching."""
    of = {(row["what"], row["method"]): row for row in rows}
    for what in ("contrast 2 %", "contrast 8 %", "contrast 30 %", "contrast 8 %, noise 8", "contrast 8 %, blur 6 px"):
        own, peer = of[what, "default"], of[what, "StereoSGBM, both pairs"]
        yield Row("texture", f"median error, {what}", own.get("median [mm]", 1e3) / peer["median [mm]"], "error", "StereoSGBM")
        yield Row("texture", f"not covered, {what}", 1 - own["coverage"], "error", "")


STAGES: dict[str, Callable[[Any], Iterator[Row]]] = {
    f.__name__: f for f in (matching, constraints, texture, tracking, fit, calibration, run, memory, clip)
}


def rows_of(results: dict[str, Any]) -> list[Row]:
    """The rows of all benchmarks in a results file; one that is not known here has none."""
    return [row for stage, read in STAGES.items() if stage in results for row in read(results[stage])]


def verdict(row: Row, baseline: dict[str, float]) -> str:
    """What the baseline says of a row: as before, better, WORSE, new; missing where there was no peer to compare with."""
    if row.value is None:
        return "peer missing"
    before = baseline.get(row.name)
    if before is None:
        return "new"
    ratio = row.value / before if before else float("inf")
    good = ratio if row.kind == "speed" else 1 / ratio if ratio else float("inf")
    limit = TOLERANCE[row.kind]
    return f"{'WORSE' if good < 1 / limit else 'better' if good > limit else 'as before'} ({ratio:.2f} of {before:.3g})"


def main() -> int:
    """Print the table; 1 if something is worse than the baseline."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--save", action="store_true", help="make these figures the baseline")
    args = parser.parse_args()
    rows = rows_of(json.loads(args.results.read_text(encoding="utf-8")))
    baseline = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    told = [verdict(row, baseline) for row in rows]
    for row, said in zip(rows, told):
        beside = f"× {row.beside}" if row.beside else ""
        value = "-" if row.value is None else f"{row.value:.3g}"
        sys.stdout.write(f"{row.stage:<12} {row.what:<58} {value:>8} {beside:<24} {said}\n")
    if args.save:
        figures = baseline | {row.name: round(row.value, 4) for row in rows if row.value is not None}
        BASELINE.write_text(json.dumps(figures, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return 1 if any(said.startswith("WORSE") for said in told) else 0


if __name__ == "__main__":
    sys.exit(main())
