"""Board calibrations from spoilt observations: how often a wrong rig is called good.

    .venv/py3.13/bin/python tests/bench/spoilt_boards.py [--sets 1000] [--first SEED] [--seconds S] [--record FILE]

Every set is a random rig (in line, around, two cameras …) with a board held in front of it, spoilt in one of KINDS. A rig is wrong if
points in space are more than WRONG times as far off as the Cramér–Rao bound of the set without the fault and without wrong corners. One
direction of error dominates, so 3 sets in 1000 exceed this by chance; of those called good, the error is printed. A square of another size
than given cannot be found from images of the board alone, and is none of the kinds.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.bench._record import recorded
from tests.core.calibration.test_boards import CHESSBOARD, bound_m, mirrored, observed
from tests.core.calibration.truth import error_m
from tricap.core.calibration.calibrate import calibrate_rig
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.synthetic.bar import RIG_KINDS, random_cameras
from tricap.core.synthetic.board import HeldBoard, held_board

POSITIONS = 24
SIGMA_PX = 0.1
WRONG = 3.0
Spoil = Callable[[HeldBoard, np.random.Generator], np.ndarray]


def _from(held: HeldBoard, rng: np.random.Generator) -> int:
    """The first spoilt position: somewhere in the middle half."""
    return int(rng.integers(len(held.xy_px) // 4, 3 * len(held.xy_px) // 4))


def moved_camera(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """A camera is turned by 0.2 to 20 mrad during the recording."""
    xy, first, c = held.xy_px.copy(), _from(held, rng), int(rng.integers(len(held.cameras)))
    turn = rng.normal(0, 1, 3)
    turn *= 10 ** rng.uniform(-3.7, -1.7) / np.linalg.norm(turn)
    camera = held.cameras[c]
    turned = replace(camera, R_cam_world=rotation_from_vector(turn) @ camera.R_cam_world)
    points = np.einsum("nij,kj->nki", held.R, CHESSBOARD.corners_m) + held.t_m[:, None]
    xy[first:, c] += (turned.project(points) - camera.project(points))[first:]
    return xy


def exchanged_cameras(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """Two cameras are exchanged from some position on, or everywhere for one of three."""
    xy, first = held.xy_px.copy(), _from(held, rng)
    a, b = rng.choice(len(held.cameras), 2, replace=False)
    xy[first:, [a, b]] = xy[first:, [b, a]]
    return xy


def mirrored_camera(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """The images of a camera are mirrored."""
    c, xy = int(rng.integers(len(held.cameras))), held.xy_px.copy()
    xy[:, c] = mirrored(xy)[:, c]
    return xy


def late_camera(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """A camera is 9 to 12 positions late, which no delay of a film explains here."""
    c, xy = int(rng.integers(len(held.cameras))), held.xy_px.copy()
    xy[:, c] = np.roll(xy[:, c], int(rng.integers(9, 13)), axis=0)
    return xy


def wrong_corners(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """30 % of the corners are up to 200 px off."""
    wrong = rng.random(held.xy_px.shape[:3]) < 0.3
    angle, far = rng.uniform(0, 2 * np.pi, wrong.shape), rng.uniform(5, 200, wrong.shape)
    return np.asarray(held.xy_px + (wrong * far)[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def bent_board(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """The board is bent by 0.5 to 10 mm, about one of its sides."""
    return _of_shape(held, lambda X, u: X + [0, 0, 1] * u[:, None] ** 2 * 10 ** rng.uniform(-3.3, -2.0), int(rng.integers(2)))


def stretched_board(held: HeldBoard, rng: np.random.Generator) -> np.ndarray:
    """The board is printed up to 3 % longer one way."""
    factor = 1 + 10 ** rng.uniform(-2.7, -1.5)
    return _of_shape(held, lambda X, _: X * [factor, 1, 1], 0)


def _of_shape(held: HeldBoard, shape: Callable[[np.ndarray, np.ndarray], np.ndarray], axis: int) -> np.ndarray:
    plan = CHESSBOARD.corners_m
    u = plan[:, axis] / np.abs(plan[:, axis]).max()
    at = [np.einsum("nij,kj->nki", held.R, X) + held.t_m[:, None] for X in (plan, shape(plan, u))]
    return held.xy_px + np.stack([c.project(at[1]) - c.project(at[0]) for c in held.cameras], axis=1)


KINDS: dict[str, Spoil] = {
    f.__name__: f for f in (moved_camera, exchanged_cameras, mirrored_camera, late_camera, wrong_corners, bent_board, stretched_board)
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """Kind of the fault, what the calibration said of it, the true and predicted errors, and the bound."""

    kind: str
    light: str
    error_m: float = np.nan
    predicted_m: float = np.nan
    bound_m: float = np.nan

    @property
    def wrong(self) -> bool:
        """Whether the rig is wrong."""
        return self.error_m > WRONG * self.bound_m


def outcome(seed: int) -> Outcome:
    """What is made of one set."""
    rng = np.random.default_rng(seed)
    kind = list(KINDS)[seed % len(KINDS)]
    cameras = random_cameras(rng, RIG_KINDS[seed // len(KINDS) % len(RIG_KINDS)])
    cameras = cameras[:2] if rng.random() < 0.2 else cameras
    held = held_board(cameras, CHESSBOARD.corners_m, POSITIONS, rng, sigma_px=SIGMA_PX)
    spoilt = KINDS[kind](held, rng)
    lost = (spoilt != held.xy_px).any(axis=-1) if kind == "wrong_corners" else held.wrong
    try:
        done = calibrate_rig(observed(replace(held, xy_px=spoilt)), Monitor())
    except InputError:
        return Outcome(kind=kind, light="refused")
    return Outcome(
        kind=kind,
        light=str(done.verdict.light),
        error_m=error_m(cameras, done.rig.cameras),
        predicted_m=done.quality.predicted.rms_m,
        bound_m=bound_m(replace(held, wrong=lost), SIGMA_PX),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=np.inf, help="stop after so much time")
    parser.add_argument("--record", type=Path, help="a file of results, continued by the next call")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.sets)
    rows = recorded(args.record, seeds, lambda seed: asdict(outcome(seed)), args.seconds)
    sets = {seed: Outcome(**row) for seed, row in rows.items()}
    found = Counter[tuple[str, str]]()
    for seed, set_ in sets.items():
        found[set_.kind, f"{set_.light}, wrong" if set_.wrong else set_.light] += 1
        if set_.light == "green" and set_.wrong:
            said = f"{1e3 * set_.error_m:.2f} mm wrong where {1e3 * set_.predicted_m:.2f} are predicted"
            print(f"set {seed}: {set_.kind} green, but {said}, {set_.error_m / set_.bound_m:.1f} times the bound", flush=True)
    for kind in KINDS:
        print(f"{kind:18}", {said: n for (k, said), n in sorted(found.items()) if k == kind})
    print(f"{found.total()} sets, {sum(n for (_, said), n in found.items() if said == 'green, wrong')} wrong ones called good")


if __name__ == "__main__":
    main()
