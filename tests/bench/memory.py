"""Peak memory against the length of a clip: three cameras, 25 frames a second, so that 20 minutes are 30,000 frames.

    python tests/bench/memory.py [--frames 40 160] [--json FILE]

The clip is 40 pictures a camera shown to and fro, each a hard link, so that a long one takes no more room than a short one. Each length is
run in a process of its own; what grows is told per frame and for 30,000 frames. The fit of a whole body with 4,000 points a frame, 25
clouds to and fro that are made as they are read, may need 2 GB for them: what a frame adds is found with stretches of a third of the
usual length, in a third of the time, and added to what two usual stretches need. The table of trajectories is filled from steps of 1,000
points that are made as they are read.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# glibc otherwise keeps freed memory for each thread, and the peak depends on how they take turns (by 20 MB on a busy machine).
os.environ.update({"MALLOC_ARENA_MAX": "1", "MALLOC_TRIM_THRESHOLD_": "65536", "MALLOC_MMAP_THRESHOLD_": "65536"})

import numpy as np

from tricap.core.fitting.stages.long_sequence import AT_ONCE
from tricap.core.run.record import track_figures
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.tracking.long_tracks import trajectories_of
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.tracked import TrackedFrame, born
from tricap.core.tracking.trajectories import Filtered, Trajectories, filter_trajectories, write_trajectories

CLIP_FRAMES = 30_000
COARSE = ("growing.spacing_px=6", "tracking.spacing_px=12")
STAGES = ("measure", "track", "run", "contour", "outlined")  # the last: the fit with the contours
VIEWS = ("L", "C", "R")
SHORT = AT_ONCE // 3
FIT_LENGTHS, FIT_LIMIT_MB = (3 * SHORT, 9 * SHORT), 2048  # whole stretches
PEAK = """
status = pathlib.Path("/proc/self/status")
if status.exists():  # what getrusage says on Linux contains the process that started this one
    print(next(int(line.split()[1]) / 1024 for line in status.read_text().splitlines() if line.startswith("VmHWM")))
else:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20))
"""
CHILD = f"""
import pathlib, resource, sys
from tricap.core.cli import main as commands
code = commands.main(sys.argv[1:])
{PEAK}
sys.exit(code)
"""
FIT_CHILD = f"""
import pathlib, resource, sys
import memory
memory.long_fit(*map(int, sys.argv[1:]))
{PEAK}
"""
TABLE_CHILD = f"""
import pathlib, resource, sys
import memory
memory.long_table(int(sys.argv[1]))
{PEAK}
"""
KINDS = 25
TABLE_LENGTHS, TABLE_POINTS, TABLE_LIFE = (1500, 6000), 1000, 25


class ToAndFro(Sequence[Any]):
    """So many clouds, made of a few when they are asked for."""

    def __init__(self, clouds: list[Any], frames: int) -> None:
        self._clouds, self._frames = clouds, frames

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: Any) -> Any:
        if not 0 <= index < self._frames:
            raise IndexError
        turn = index % (2 * len(self._clouds) - 2)
        return SimpleNamespace(**{**vars(self._clouds[min(turn, 2 * len(self._clouds) - 2 - turn)]), "frame": index})


def long_fit(frames: int, at_once: int) -> None:
    """A fit of a whole body over so many frames, `at_once` of them in one adjustment."""
    import fit

    from tricap.core.fitting.stages import long_sequence, sequence

    sequence.AT_ONCE = long_sequence.AT_ONCE = at_once
    long_sequence.MARGIN = at_once // 6
    shape, random, rig = fit.default_shape(fit.read_model("full")), np.random.default_rng(0), fit.rig()
    motion = fit.walk(shape, KINDS)
    clouds = ToAndFro([fit.cloud(shape, m, t, random) for t, m in enumerate(motion)], frames)
    clicks = {
        name: {c.name: c.project(X) for c in rig.cameras}
        for name, X in fit.joint_positions(shape.skeleton, shape.lengths_m, motion[0]).items()
    }
    given = fit.FitInput(rig=rig, model="full", clouds=clouds, clicks={0: clicks}, time_s=np.arange(frames) / fit.FPS)
    sequence.fit_sequence(given, fit.FitSettings(sequence_steps=2))


def long_table(frames: int) -> None:
    """Filter and write the trajectories of so many frames: points that rock to and fro, some born and lost in each frame."""
    random = np.random.default_rng(0)
    place = random.uniform(-0.3, 0.3, (frames + TABLE_LIFE, TABLE_POINTS // TABLE_LIFE, 3))

    def steps() -> Iterator[TrackedFrame]:
        for t in range(frames):
            xyz = place[t : t + TABLE_LIFE].reshape(-1, 3) + 0.1 * np.sin(0.2 * t) + 2e-4 * random.standard_normal((TABLE_POINTS, 3))
            first = t * place.shape[1]
            n, gone = len(xyz), np.arange(max(0, first - place.shape[1]), first)
            step = born(t, first + np.arange(n), np.zeros((n, 2, 2)), np.zeros((n, 2, 2, 2)), xyz, np.tile(np.eye(3) * 1e-8, (n, 1, 1)))
            yield replace(step, ended=gone, reason=np.full(len(gone), TrackStatus.NOT_FOUND, dtype=np.int8))

    def decide(raw: Trajectories, rows: range) -> tuple[Filtered, np.ndarray]:
        return filter_trajectories(raw, settings), np.zeros(0, dtype=np.int64)

    settings = TrackingSettings()
    filtered, reasons = trajectories_of(steps(), 25.0, settings, decide)
    with tempfile.TemporaryDirectory() as name:
        write_trajectories(Path(name), filtered, 25.0)
    print(f"{frames} frames: {track_figures(filtered.kept, reasons)[0]}, {filtered.kept.omitted} left out", file=sys.stderr)


def long_take(pictures: Path, folder: Path, frames: int) -> Path:
    """A take of so many frames that shows the pictures of another to and fro."""
    for view in sorted(p for p in pictures.iterdir() if p.is_dir()):
        shown = sorted(view.iterdir())
        (folder / view.name).mkdir(parents=True)
        for i in range(frames):
            turn = i % (2 * len(shown) - 2)
            os.link(shown[min(turn, 2 * len(shown) - 2 - turn)], folder / view.name / f"{i:06d}.png")
    for name in ("take.toml", "rig.toml"):
        (folder / name).write_bytes((pictures / name).read_bytes())
    return folder


def peak_mb(stage: str, take: Path, out: Path) -> float:
    """Peak resident memory [MB] of one command in a process of its own."""
    views = ["--view", *VIEWS] if stage == "contour" else []
    command = "fit" if stage == "outlined" else stage
    argv = [command, str(take), "--out", str(out), "--quiet", *views, *(f"--set={s}" for s in COARSE)]
    done = subprocess.run([sys.executable, "-c", CHILD, *argv], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"tricap {stage} ended with {done.returncode}: {done.stderr}")
    return float(done.stdout.split()[-1])


def fit_peak_mb(frames: int, at_once: int) -> float:
    """Peak resident memory [MB] of a fit of a whole body over so many frames, in stretches of `at_once`."""
    return _child_peak_mb(FIT_CHILD, frames, at_once)


def _child_peak_mb(code: str, *numbers: int) -> float:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])}
    done = subprocess.run([sys.executable, "-c", code, *map(str, numbers)], capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise SystemExit(f"{numbers[0]} frames ended with {done.returncode}: {done.stderr}")
    return float(done.stdout.split()[-1])


def table_row(lengths: tuple[int, int] = TABLE_LENGTHS) -> dict[str, object]:
    """The row of the table of trajectories."""
    few, many = (_child_peak_mb(TABLE_CHILD, frames) for frames in lengths)
    added = 1024 * (many - few) / (lengths[1] - lengths[0])
    return {
        "stage": "table",
        "peak_mb": {str(lengths[0]): round(few, 1), str(lengths[1]): round(many, 1)},
        "kb_per_frame": round(added, 1),
        "mb_20_minutes": round(many + max(0.0, added) * (CLIP_FRAMES - lengths[1]) / 1024),
    }


def fit_growth(lengths: tuple[int, int] = FIT_LENGTHS, at_once: int = SHORT) -> float:
    """What a frame adds to the peak [KB] of the fit."""
    few, many = lengths
    return max(0.0, 1024 * (fit_peak_mb(many, at_once) - fit_peak_mb(few, at_once)) / (many - few))


def fit_row() -> dict[str, object]:
    """The row of the fit of a whole body."""
    frames, added = 2 * AT_ONCE, fit_growth()
    peak = fit_peak_mb(frames, AT_ONCE)
    return {
        "stage": "fit",
        "peak_mb": {str(frames): round(peak, 1)},
        "kb_per_frame": round(added, 1),
        "mb_20_minutes": round(peak + added * (CLIP_FRAMES - frames) / 1024),
    }


def growth(stages: tuple[str, ...], lengths: list[int], width_px: int = 192, pictures: int = 40) -> list[dict[str, object]]:
    """A row per stage: peak memory at each length, what a frame adds between the last two, and what 30,000 frames would need."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_arm_take(folder / "pictures", ArmTakeSettings(frames=pictures, width_px=width_px, interlaced="none"))
        takes = {n: long_take(folder / "pictures", folder / f"take{n}", n) for n in lengths}
        rows = []
        for stage in stages:
            peaks = {n: peak_mb(stage, take, folder / f"out{n}") for n, take in takes.items()}
            added = 1024 * (peaks[lengths[-1]] - peaks[lengths[-2]]) / (lengths[-1] - lengths[-2])
            whole = peaks[lengths[-1]] + max(0.0, added) * (CLIP_FRAMES - lengths[-1]) / 1024
            rows.append(
                {
                    "stage": stage,
                    "peak_mb": {str(n): round(p, 1) for n, p in peaks.items()},
                    "kb_per_frame": round(added, 1),
                    "mb_20_minutes": round(whole),
                }
            )
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[40, 160])
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=STAGES)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = [*growth(tuple(args.stages), sorted(args.frames)), table_row(), fit_row()]
    for row in rows:
        print(f"{row['stage']:<8} peak {row['peak_mb']} MB, {row['kb_per_frame']} KB a frame, 20 minutes: {row['mb_20_minutes']} MB")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if rows[-1]["mb_20_minutes"] > FIT_LIMIT_MB:  # type: ignore[operator]
        raise SystemExit(f"A fit of {CLIP_FRAMES} frames would need {rows[-1]['mb_20_minutes']} MB, more than {FIT_LIMIT_MB}.")


if __name__ == "__main__":
    main()
