"""Boards held before random rigs: how many are calibrated from nothing, how near the bound, and how well they predict their error.

    .venv/py3.13/bin/python tests/bench/board_rigs.py [--rigs 200] [--first SEED] [--seconds S] [--record FILE]

Every fifth rig has two cameras, every fifth fisheye lenses of 150°; the others are those of `RIG_KINDS`. One direction of error dominates,
so single ratios scatter; their RMS is that of the object points in units of the bound.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.bench._record import recorded
from tests.core.calibration.test_boards import CHESSBOARD, SMALL, bound_m, observed
from tests.core.calibration.truth import TEST_BARS, error_m, rigid
from tricap.core.calibration.calibrate import calibrate_rig
from tricap.core.calibration.precision import predicted_error
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.synthetic.bar import RIG_KINDS, fisheye_cameras, random_cameras
from tricap.core.synthetic.board import held_board

POSITIONS = 40
SIGMA_PX = 0.1
CONVERGED = 4.0  # times the bound


def one(seed: int) -> dict[str, Any]:
    """Kind of the rig, error and predicted error as multiples of the bound (NaN: refused), and the verdict's light."""
    kind, error, predicted, light = _calibrated(seed)
    return {"kind": kind, "error": error, "predicted": predicted, "light": light}


def _calibrated(seed: int) -> tuple[str, float, float, str]:
    rng = np.random.default_rng(seed)
    kind = "fisheye" if seed % 5 == 4 else RIG_KINDS[seed // 5 % len(RIG_KINDS)]
    cameras = fisheye_cameras(rng) if kind == "fisheye" else random_cameras(rng, kind)
    if seed % 5 == 3:
        kind, cameras = "two cameras", cameras[:2]
    board = SMALL if kind == "fisheye" else CHESSBOARD
    held = held_board(cameras, board.corners_m, POSITIONS, rng, sigma_px=SIGMA_PX)
    bound = bound_m(held, SIGMA_PX, board)
    try:
        done = calibrate_rig(observed(held, board), Monitor())
    except InputError as error:
        return kind, np.nan, np.nan, str(error)
    made, calibration = done.rig.cameras, done.calibration
    R, t = rigid(np.stack([c.centre_m for c in cameras]), np.stack([c.centre_m for c in made]))
    if len(cameras) == 2:
        R = made[0].R_cam_world.T @ cameras[0].R_cam_world
        t = made[0].centre_m - R @ cameras[0].centre_m
    back = calibration.network.cameras(calibration.observations.names, calibration.observations.size_px)
    move = back[0].R_cam_world.T @ made[0].R_cam_world, back[0].centre_m
    volume = ((TEST_BARS @ R.T + t) - made[0].centre_m) @ move[0].T + move[1]
    predicted = predicted_error(back, calibration.every_unknown, calibration.considered, volume).rms_m
    seen = np.sum([c.sees(c.project(TEST_BARS)) for c in cameras], axis=0) >= 2
    points = TEST_BARS[seen.all(axis=1)].reshape(-1, 3)  # those of the bound and of the prediction
    return kind, error_m(cameras, made, points) / bound, predicted / bound, str(done.verdict.light)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=np.inf, help="stop after so much time")
    parser.add_argument("--record", type=Path, help="a file of results, continued by the next call")
    args = parser.parse_args()
    found = recorded(args.record, range(args.first, args.first + args.rigs), one, args.seconds)
    rows = [tuple(row.values()) for row in found.values()]
    for seed, row in found.items():
        if not row["error"] < CONVERGED:
            print(f"rig {seed}: {row}", flush=True)
    for kind in (*sorted({row[0] for row in rows}), "all"):
        some = [row for row in rows if kind in (row[0], "all")]
        ratio, predicted = np.array([row[1:3] for row in some if row[1] < CONVERGED]).reshape(-1, 2).T
        rms, foretold = np.sqrt(np.mean(ratio**2)), np.sqrt(np.mean(predicted**2))
        print(
            f"{kind:12} {len(ratio)} of {len(some)} rigs; error {rms:.3f} times the bound (median {np.median(ratio):.2f}); "
            f"predicted {foretold / rms:.3f} times the error"
        )


if __name__ == "__main__":
    main()
