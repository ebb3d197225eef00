"""A clip of any length, such as 20 minutes (30,000 frames) of three cameras, through the whole run: resident memory against the frames.

    python tests/bench/clip.py [--frames 300] [--out DIR] [--json FILE]

The pictures are made as they are read: an arm that swings to and fro, painted once for each of the 34 frames of a swing, with the
sensors' noise of the frame itself. Nothing of the run is left out or replaced; the points are few, so that a frame takes a quarter of a
second. DIR keeps the run, so that the same command goes on where it was stopped, and memory.csv: a line for every second of the run. The
peak of a stage is that of the process that ends it, which may have begun from checkpoints.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from tricap.core.foundation.progress import Monitor
from tricap.core.run import pipeline, take_run
from tricap.core.synthetic import arm
from tricap.core.synthetic.film import digitize, expose, paint
from tricap.core.take.footage import open_take
from tricap.core.take.take import Take

FPS, WIDTH_PX = 25.0, 192
SWING = round(arm.SWING_S * FPS)  # frames
SETTINGS: dict[str, dict[str, Any]] = {
    "growing": {"spacing_px": 6, "seed_spacing_px": 12, "attempts": 1, "bigger_patches": 0},
    "matching": {"constraint": "none", "neighbours": False, "max_iterations": 8},
    "surface": {"correct_curvature": False, "min_island": 3},
    "tracking": {"spacing_px": 12, "wait_frames": 0},
    "fitting": {"sequence_steps": 3, "frame_steps": 3, "voxel_m": 0.02},
}
STAGES = {"measure": pipeline.measure, "track": pipeline.track, "fit": pipeline.fit, "report": pipeline.report}


class Swinging:
    """One camera's sequence (`images.sequence.Sequence`) of so many frames."""

    def __init__(self, view: int, frames: int, expected: np.ndarray, file: Path) -> None:
        self.count, self.source = frames, f"a swinging arm, view {view}"
        self._view, self._expected, self._file = view, expected, file

    def files(self) -> tuple[Path, ...]:
        """The file that stands for the frames."""
        return (self._file,)

    def read(self, index: int) -> np.ndarray:
        """The picture (h, w) float32 of frame `index`, its noise drawn anew."""
        noise = np.random.default_rng([index, self._view])
        return digitize(self._expected[index % SWING], _sensor(self._view), 1.0, noise).astype(np.float32)


def _sensor(view: int) -> Any:
    return arm.SENSORS[arm.VIEWS[view]]


def painted(folder: Path) -> np.ndarray:
    """What each view shows in each frame of a swing, without noise (views, frames, h, w); painted by a process of its own, which takes
    more memory than the run."""
    path = folder / "swing.npy"
    if not path.exists():
        subprocess.run([sys.executable, __file__, "--paint", path], check=True)
    return np.load(path)  # type: ignore[no-any-return]


def paint_swing(path: Path) -> None:
    """Paint all views of a swing."""
    arm.make_arm_take(path.parent / "take", arm.ArmTakeSettings(frames=2, width_px=WIDTH_PX, interlaced="none", fps=FPS))
    studio = arm._studio(arm.ArmTakeSettings(width_px=WIDTH_PX, interlaced="none", fps=FPS))
    bodies = [studio.body(frame / FPS) for frame in range(SWING)]
    np.save(path, [[expose(paint(camera, body, studio.noise, studio.backdrops[k]), _sensor(k)) for body in bodies]
                   for k, camera in enumerate(studio.rig.cameras)])  # fmt: skip


def resident_mb() -> tuple[float, float]:
    """Resident memory [MB] of this process: now, and the most until now."""
    lines = Path("/proc/self/status").read_text().splitlines()
    table = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
    return int(table["VmRSS"]) / 1024, int(table["VmHWM"]) / 1024


class Watch:
    """Writes a line a second: seconds, stage, done, total, MB resident."""

    def __init__(self, path: Path) -> None:
        self._file, self._began, self._last = path.open("a", encoding="utf-8", buffering=1), time.monotonic(), 0.0

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Called by the monitor."""
        if time.monotonic() - self._last >= 1.0:
            self._last = time.monotonic()
            self._file.write(f"{self._last - self._began:.0f},{stage},{done:.0f},{total:.0f},{resident_mb()[0]:.1f}\n")


def run_clip(folder: Path, frames: int, until: str) -> list[dict[str, Any]]:
    """The run of so many frames until a stage: a row for each stage."""
    take, pictures, rows = folder / "take", painted(folder), list[dict[str, Any]]()

    def opened(take: Take) -> Any:
        views = enumerate(arm.VIEWS)
        return open_take(take, tuple(Swinging(k, frames, pictures[k], take.folder / name / "0000.png") for k, name in views))

    take_run.open_take = opened
    watch = Watch(folder / "memory.csv")
    with take_run.open_run(take, folder / f"out{frames}", SETTINGS) as job:
        for name in list(STAGES)[: list(STAGES).index(until) + 1]:
            began = time.process_time()
            STAGES[name](job, Monitor(watch))
            spent = round(time.process_time() - began, 1)
            rows.append({"stage": name, "frames": frames, "peak_mb": round(resident_mb()[1], 1), "cpu_s": spent})
            sys.stdout.write(f"{rows[-1]}\n")
            sys.stdout.flush()
    return rows


def growth(path: Path) -> dict[str, float]:
    """What a frame adds to the resident memory [KB] of each kind of step, over its second half: the first fills buffers."""
    samples: dict[str, list[tuple[float, float]]] = {}
    with path.open(encoding="utf-8") as file:
        for _, stage, done, _, mb in csv.reader(file):
            samples.setdefault(stage, []).append((float(done), float(mb)))
    found = {}
    for stage, pairs in samples.items():
        done, mb = np.array(pairs)[len(pairs) // 2 :].T
        if np.ptp(done) >= 100:
            found[stage] = round(float(np.polyfit(done, 1024 * mb, 1)[0]), 2)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--until", choices=STAGES, default="report")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--paint", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.paint:
        return paint_swing(args.paint)
    with tempfile.TemporaryDirectory() as name:
        folder = args.out or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        rows = run_clip(folder, args.frames, args.until)
        added = growth(folder / "memory.csv")
    sys.stdout.write("a frame adds [KB]: " + ", ".join(f"{stage} {kb}" for stage, kb in added.items()) + "\n")
    if args.json:
        args.json.write_text(json.dumps({"stages": rows, "kb_per_frame": added}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
