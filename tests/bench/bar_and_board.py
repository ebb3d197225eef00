"""A bar and a board in one adjustment: how near the bound, and how often films that contradict each other are called good.

    .venv/py3.13/bin/python tests/bench/bar_and_board.py [--sets 210] [--first SEED] [--seconds S] [--record FILE]

Every set is a random rig with 60 bars and 20 boards. One of KINDS spoils the cameras of the board, the length of the bar or the squares, by
0.03 to 3 %. A rig is wrong if points in space are more than WRONG times as far off as the Cramér–Rao bound without the fault, and
by more than FAR_PART of their distance: less is not told apart from the systematic errors of image points.
"""

import argparse
import sys
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.bench._record import recorded
from tests.core.calibration import test_boards, truth
from tests.core.calibration.test_together import BAR_PX, BOARD_PX, bound_m
from tricap.core.calibration.calibrate import calibrate_rig
from tricap.core.calibration.together import FAR_PART, BarAndBoard
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.synthetic.bar import RIG_KINDS, VOLUME_CENTRE_M, BarNoise, random_cameras, waved_bar
from tricap.core.synthetic.board import held_board

BARS, BOARDS = 60, 20
WRONG = 3.0
KINDS = ("none", "moved", "zoomed", "bar length", "squares", "lenses only", "lenses only, zoomed")


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """Kind of the fault, what the calibration said of it, the true and predicted errors, the bound, and the distance of the volume."""

    kind: str
    light: str
    error_m: float = np.nan
    predicted_m: float = np.nan
    bound_m: float = np.nan
    distance_m: float = np.nan

    @property
    def wrong(self) -> bool:
        """Whether the rig is wrong."""
        return self.error_m > max(WRONG * self.bound_m, FAR_PART * self.distance_m)


def of_board(cameras: tuple[Camera, ...], kind: str, size: float, rng: np.random.Generator) -> tuple[Camera, ...]:
    """The cameras as they were when they filmed the board."""
    last, turn = cameras[-1], rng.normal(0, 1, 3)
    if kind == "moved":
        last = replace(last, R_cam_world=rotation_from_vector(turn * size / np.linalg.norm(turn)) @ last.R_cam_world)
    if kind.endswith("zoomed"):
        last = replace(last, matrix=last.matrix * np.array([[1 + size, 1 + size, 1], [1, 1 + size, 1], [1, 1, 1]]))
    return (*cameras[:-1], last)


def outcome(seed: int) -> Outcome:
    """What is made of one set."""
    rng = np.random.default_rng(seed)
    kind, size = KINDS[seed % len(KINDS)], 10 ** rng.uniform(-3.5, -1.5)
    cameras = random_cameras(rng, RIG_KINDS[seed // len(KINDS) % len(RIG_KINDS)])
    waved = waved_bar(cameras, BARS, rng, BarNoise(sigma_px=BAR_PX, unlabelled=True))
    plan = test_boards.CHESSBOARD
    held = held_board(of_board(cameras, kind, size, rng), plan.corners_m, BOARDS, rng, sigma_px=BOARD_PX)
    bars, boards = truth.observed(waved, labelled=False), test_boards.observed(held)
    bars = replace(bars, length_m=bars.length_m * (1 + size * (kind == "bar length")))
    boards = replace(boards, board=replace(plan, square_m=plan.square_m * (1 + size * (kind == "squares"))))
    if only := kind.startswith("lenses only"):
        boards = boards.changed(boards.xy_px[rng.permutation(BOARDS)])
    try:
        done = calibrate_rig(BarAndBoard(bars=bars, boards=boards, lenses_only=only), Monitor())
    except InputError:
        return Outcome(kind=kind, light="refused")
    return Outcome(
        kind=kind,
        light=str(done.verdict.light),
        error_m=truth.error_m(cameras, done.rig.cameras),
        predicted_m=done.quality.predicted.rms_m,
        bound_m=truth.bound(waved, BAR_PX).rms_m if only else bound_m(waved, held),
        distance_m=float(np.mean([np.linalg.norm(c.centre_m - VOLUME_CENTRE_M) for c in cameras])),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=210)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=np.inf, help="stop after so much time")
    parser.add_argument("--record", type=Path, help="a file of results, continued by the next call")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.sets)
    rows = recorded(args.record, seeds, lambda seed: asdict(outcome(seed)), args.seconds)
    sets = {seed: Outcome(**row) for seed, row in rows.items()}
    for seed, one in sets.items():
        if one.light == "green" and one.wrong:
            print(f"set {seed}: {one}", flush=True)
    for kind in KINDS:
        some = [one for one in sets.values() if one.kind == kind]
        found = Counter(f"{one.light}, wrong" if one.wrong else one.light for one in some)
        error, predicted, bound = np.array([(one.error_m, one.predicted_m, one.bound_m) for one in some if one.error_m > 0]).T
        error, predicted = (np.sqrt(np.mean((values / bound) ** 2)) for values in (error, predicted))
        print(
            f"{kind:20} error {error:.2f} times the bound, predicted {predicted / error:.2f} times the error; {dict(sorted(found.items()))}"
        )
    bad = sum(one.light == "green" and one.wrong for one in sets.values())
    print(f"{len(sets)} sets, {bad} wrong ones called good (lenses only: the bound is that of the bar alone)")


if __name__ == "__main__":
    main()
