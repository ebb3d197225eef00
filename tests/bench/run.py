"""The whole path from images to report: seconds of every stage for two sizes and both qualities, beside peers on the same frames; cost
against points, frames, cameras and workers, and peak memory.

    python tests/bench/run.py [--json FILE]

Each figure is a ratio of CPU times of two runs that differ in one thing: 1 means that the cost grows with that thing and no faster.
Workers: elapsed time of two takes one by one over that with two workers (at best 2, on an idle machine with two cores).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parent))

import _stages

from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

CHILD = """
import json, pathlib, sys, time
from tricap.core.cli import main as commands
began = time.process_time()
code = commands.main(sys.argv[1:])
spent = time.process_time() - began
status = pathlib.Path("/proc/self/status")
lines = status.read_text().splitlines() if status.exists() else []
peak = next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), None)
print(json.dumps({"cpu_s": spent, "peak_mb": peak}))
sys.exit(code)
"""
FRAMES, WIDTH_PX = 3, 192


def cost(take: Path, out: Path, *more: str) -> dict[str, float]:
    """CPU seconds and peak memory of one run, its points and its frames."""
    line = [sys.executable, "-c", CHILD, "run", str(take), "--out", str(out), "--quiet", *more]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    stages = json.loads((out / "run.json").read_text())["stages"]
    return json.loads(done.stdout.splitlines()[-1]) | {"points": stages["measure"]["points_per_frame"] * stages["measure"]["frames"]}


def two_views(take: Path, folder: Path) -> Path:
    """The same take without its right camera."""
    folder.mkdir()
    for name in ("L", "C", "rig.toml"):
        (folder / name).symlink_to(take / name)
    text = (take / "take.toml").read_text()
    head, seeds = text.split("[body]")
    views = head.split("[[views]]")
    lines = [line.split(", R = ")[0] + " }" if ", R = " in line else line for line in seeds.splitlines()]
    (folder / "take.toml").write_text("[[views]]".join(v for v in views if 'name = "R"' not in v) + "[body]" + "\n".join(lines) + "\n")
    return folder


def elapsed_s(takes: list[Path], out: Path, workers: int) -> float:
    """Seconds of a batch by the clock."""
    began = time.perf_counter()
    line = [sys.executable, "-m", "tricap", "batch", *map(str, takes), "--out", str(out), "--workers", str(workers), "--quiet"]
    subprocess.run(line, check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_arm_take(folder / "take", ArmTakeSettings(frames=2 * FRAMES, width_px=WIDTH_PX, interlaced="none"))
        some = ("--frames", f"0:{FRAMES}")
        base = cost(folder / "take", folder / "base", *some)
        twice = cost(folder / "take", folder / "twice")
        dense = cost(folder / "take", folder / "dense", *some, "--set", "growing.spacing_px=3")
        two = cost(two_views(folder / "take", folder / "two"), folder / "of_two", *some)
        takes = [two_views(folder / "take", folder / f"take{i}") for i in range(2)]
        alone, together = (elapsed_s(takes, folder / f"batch{n}", n) for n in (1, 2))
        stages = dict(_stages.tables(folder))
    print("\n".join(_stages.lines(stages)))
    result = {
        "twice the frames: cost of a frame": twice["cpu_s"] / base["cpu_s"] / 2,
        "finer grid: cost of a point": dense["cpu_s"] / base["cpu_s"] / (dense["points"] / base["points"]),
        "three cameras over two: cost": base["cpu_s"] / two["cpu_s"],
        "two workers: times faster": alone / together,
        "peak_mb": base["peak_mb"],
        "cpu_s_a_frame": base["cpu_s"] / FRAMES,
        "stages": stages,
    }
    for what, value in result.items():
        if what != "stages":
            print(f"{what}: {value:.3f}" if value is not None else f"{what}: unknown here")
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
