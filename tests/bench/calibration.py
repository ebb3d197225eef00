"""Calibration: accuracy against the Cramér–Rao bound, speed, memory, random rigs, targets, and peers on the same data in the same run.

Peers are no dependencies: give the Python that has them (gtsam, pycolmap, aniposelib) in the environment variable TRICAP_PEERS; without it
they are said to be missing. CPU seconds are those of one BLAS thread.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "core" / "calibration"))

from truth import TEST_BARS, bound, error_m, observed, rigid

from tricap.core.calibration.bars import enough_rays, with_bars
from tricap.core.calibration.bundle import LevenbergMarquardt, adjust
from tricap.core.calibration.network import Network
from tricap.core.calibration.precision import predicted_error
from tricap.core.calibration.reference_bar import initial_network, lens_prior
from tricap.core.calibration.self_calibration import GROSS, PART, calibrate
from tricap.core.calibration.targets import find_blobs, find_targets
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import INTERIOR, camera_of
from tricap.core.synthetic.bar import RIG_KINDS, BarNoise, WavedBar, benchmark_cameras, draw_disc, random_cameras, waved_bar

CASES = ((100, 0.05), (1000, 0.05), (5000, 0.05), (100, 0.3), (1000, 0.3), (5000, 0.3))
SEEDS = 5
CONVERGED_RATIO = 3.0
NEAR = 1e-8  # damping for a start that is close: nearly the step of Gauss and Newton
PEERS = {"gtsam": "gtsam_bar.py", "pycolmap": "colmap_bar.py", "aniposelib": "anipose_bar.py"}


def one(waved: WavedBar, sigma_px: float, free: np.ndarray | None = None) -> dict[str, float]:
    """Error, its ratio to the bound, predicted by actual error, and CPU seconds of one calibration from nothing."""
    start = time.process_time()
    done = calibrate(observed(waved, labelled=not waved.swapped.any()), Monitor())
    seconds = time.process_time() - start
    cameras = done.network.cameras(done.observations.names, done.observations.size_px)
    known = (done.used.sum(axis=1) >= 2).all(axis=1)
    R, t = rigid(waved.ends_m.mean(axis=1)[known], done.network.middle[known])
    predicted = predicted_error(cameras, done.every_unknown, done.considered, TEST_BARS @ R.T + t).rms_m
    actual = error_m(waved.cameras, cameras)
    return dict(mm=1e3 * actual, ratio=actual / bound(waved, sigma_px, free).rms_m, predicted=predicted / actual, seconds=seconds)


def medians(runs: list[dict[str, float]]) -> dict[str, float]:
    """The median of each figure; of the prediction the root mean square of the actual errors counts."""
    table = _medians(runs)
    table["predicted_rms"] = float(1 / np.sqrt(np.mean([1 / run["predicted"] ** 2 for run in runs])))
    return table


def accuracy() -> dict[str, Any]:
    """The benchmark's cases, and a lens with f and k1 only against the bound of that small model."""
    out: dict[str, Any] = {}
    for positions, sigma in CASES:
        runs = [one(_benchmark(positions, sigma, seed), sigma) for seed in range(SEEDS)]
        out[f"{positions} positions, {sigma} px"] = medians(runs)
    small = np.isin(INTERIOR, ("f", "k1"))
    runs = [one(waved_bar(benchmark_cameras(True), 1000, np.random.default_rng(s), BarNoise()), 0.05, small) for s in range(SEEDS)]
    out["1000 positions, 0.05 px, lens of f and k1"] = medians(runs)
    out["memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return out


def _benchmark(positions: int, sigma: float, seed: int) -> WavedBar:
    """Ends in any order, as targets in images are."""
    return waved_bar(benchmark_cameras(), positions, np.random.default_rng(seed), BarNoise(sigma_px=sigma, unlabelled=True))


def random_rigs(count: int) -> dict[str, Any]:
    """How many random rigs converge: as they are, with 30 % wrong points, with half of them missing, with the ends mixed up."""
    kinds = {
        "plain": BarNoise(gross=0.03),
        "30 % wrong": BarNoise(gross=0.30),
        "50 % missing": BarNoise(gross=0.03, missing=0.50),
        "unlabelled": BarNoise(gross=0.03, unlabelled=True),
    }
    out = {}
    for name, noise in kinds.items():
        ratios = [_random_ratio(seed, noise) for seed in range(count if name == "plain" else max(10, count // 3))]
        out[name] = dict(rigs=len(ratios), converged=int(np.sum(np.array(ratios) < CONVERGED_RATIO)), median_ratio=float(np.median(ratios)))
    return out


def _random_ratio(seed: int, noise: BarNoise) -> float:
    from dataclasses import replace

    rng = np.random.default_rng(seed)
    cameras, sigma = random_cameras(rng, RIG_KINDS[seed % len(RIG_KINDS)]), float(rng.uniform(0.05, 0.3))
    waved = waved_bar(cameras, 200, rng, replace(noise, sigma_px=sigma))
    return one(waved, sigma)["ratio"]


def targets() -> dict[str, float]:
    """Position errors of discs of 6–20 px, and targets per second."""
    match, centroid, seconds = [], [], 0.0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        image = np.full((480, 640), 20.0, np.float32)
        places = np.stack(np.meshgrid(np.arange(8) * 76 + 50, np.arange(6) * 74 + 50), axis=-1).reshape(-1, 2) + rng.uniform(-3, 3, (48, 2))
        for place in places:
            draw_disc(image, place, rng.uniform(3, 10), 200.0, 0.7)
        image = np.clip(np.round(image + rng.normal(0, 2, image.shape)), 0, 255).astype(np.float32)
        start = time.process_time()
        found = find_targets(image).xy_px
        seconds += time.process_time() - start
        for errors, xy in ((match, found), (centroid, find_blobs(image).xy_px)):
            errors.append(xy - places[np.linalg.norm(xy[:, None] - places[None], axis=2).argmin(axis=1)])
    return dict(
        matched_rms_px=float(np.sqrt(np.mean(np.square(np.concatenate(match))))),
        centroid_rms_px=float(np.sqrt(np.mean(np.square(np.concatenate(centroid))))),
        per_second=48 * SEEDS / seconds,
    )


def peers(positions: int, sigma: float) -> dict[str, Any]:
    """The peers on the benchmark's recordings, started from our initial values, beside our whole way from nothing; medians."""
    python, runs = os.environ.get("TRICAP_PEERS"), dict[str, list[Any]]()
    for seed in range(SEEDS):
        waved = waved_bar(benchmark_cameras(), positions, np.random.default_rng(seed), BarNoise(sigma_px=sigma))  # peers need ends in order
        start = initial_network(observed(waved)).network
        runs.setdefault("tricap, from nothing", []).append(one(waved, sigma))
        runs.setdefault("tricap, from the same start as the peers, without k3", []).append(same_steps(waved, start, sigma))
        for name, script in PEERS.items():
            runs.setdefault(name, []).append(_peer(python, script, waved, start, sigma) if python else "missing: set TRICAP_PEERS")
    return {name: next((r for r in each if isinstance(r, str)), None) or _medians(each) for name, each in runs.items()}


def _medians(runs: list[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.median([run[key] for run in runs])) for key in runs[0]}


def same_steps(waved: WavedBar, start: Network, sigma: float) -> dict[str, float]:
    """What the GTSAM script does, with our adjustment and all unknowns but k3: robust, on a part of the positions as `calibrate` does it,
    then least squares on all, trimmed, and again."""
    seconds = time.process_time()
    observations = observed(waved)
    unknowns = lens_prior(observations.size_px, start.interior[:, 0])
    unknowns = unknowns.only(*(name for name in INTERIOR if name != "k3"))
    part = observations.part(np.unique(np.linspace(0, len(waved.xy_px) - 1, PART // 2).astype(int)))
    network, keep = with_bars(start, part, 30.0)
    done = adjust(
        network,
        part.xy_px,
        keep,
        unknowns,
        cauchy_px=3 * sigma,
        unit_px=sigma,
        iteration=LevenbergMarquardt(max_iterations=30, tolerance=1.0),
    )
    network, keep = with_bars(done.network, observations, GROSS * sigma)
    for tolerance in (1.0, 1e-3):  # the first only has to tell the blunders that the bars' own intersection did not
        done = adjust(
            network,
            waved.xy_px,
            keep,
            unknowns,
            unit_px=sigma,
            iteration=LevenbergMarquardt(max_iterations=30, tolerance=tolerance, damping=NEAR),
        )
        network = done.network
        keep = enough_rays(keep & (np.abs(np.nan_to_num(done.residual_px, nan=np.inf)).max(axis=-1) < 6 * sigma))
    seconds = time.process_time() - seconds
    actual = error_m(waved.cameras, network.cameras(observations.names, observations.size_px))
    return dict(mm=1e3 * actual, ratio=actual / bound(waved, sigma).rms_m, seconds=seconds)


def _peer(python: str, script: str, waved: WavedBar, start: Any, sigma: float) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "given.npz", Path(folder) / "made.npz"
        size = np.array(waved.cameras[0].size_px)
        arrays = dict(xy_px=waved.xy_px, length_m=waved.length_m, interior=start.interior, R=start.R, t=start.t, sigma=sigma, size_px=size)
        np.savez(given, **arrays)
        ran = subprocess.run([python, HERE / "peers" / script, given, made], capture_output=True, text=True, timeout=900)
        if ran.returncode or not made.exists():
            return f"missing: {(ran.stderr.strip().splitlines() or ['it failed'])[-1]}"
        result = np.load(made)
        cameras = [camera_of(c.name, c.size_px, p, R, t) for c, p, R, t in zip(waved.cameras, result["interior"], result["R"], result["t"])]
        actual = error_m(waved.cameras, cameras)
        return dict(mm=1e3 * actual, ratio=actual / bound(waved, sigma).rms_m, seconds=float(result["seconds"]))


def main() -> None:
    """Run everything; print it, and write it as JSON on request."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--rigs", type=int, default=60, help="number of random rigs (300 for the full sweep)")
    args = parser.parse_args()
    result = dict(accuracy=accuracy(), random_rigs=random_rigs(args.rigs), targets=targets(), peers=peers(1000, 0.05))
    text = json.dumps(result, indent=1, default=float)
    sys.stdout.write(text + "\n")
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
