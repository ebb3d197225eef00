"""A bar and a board in one adjustment: the bar measures the volume, the board the lenses and, if the cameras were not moved, their poses.

1  the boards by themselves (`boards.calibration`); if they give the lenses only, each view is a position of its own;
2  the bars from the lenses, or cameras, of the boards, with the boards' normal equations added (`helmert`);
3  whether both agree: the lengths of the bars that the cameras of the boards measure,
   m = median(l / L − 1) ,                                                                                                     (1)
   and how much better the bars and the boards fit cameras of their own, with u unknowns of the cameras less 6,
   F = (ΔSS_bar / σ_bar² + ΔSS_board / σ_board²) / u ,   expected 1 at most                                                    (2)
   A larger F multiplies all covariances. If the volume is so far from where either alone would place it that it matters, displaced by
   D Δc (`precision`, (2) and (3)),                                                                                            (3)
   the verdict is not green.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.camera import INTERIOR
from ..geometry.robust import mad_sigma
from .bars import BarObservations, met_ends
from .boards.board import Lens
from .boards.calibration import calibrate_boards
from .boards.lenses import calibrate_lenses
from .boards.observations import BoardObservations
from .bundle import change_of_cameras
from .fisheye_bar import NARROW, WIDE, adjusted_start
from .helmert import Partial, partial_network
from .network import BarNetwork
from .precision import displaced
from .quality import lengths_of
from .reference_bar import COARSE_CAUCHY_PX, GATE, WIDE_GATE, initial_network
from .self_calibration import Calibration, calibrate_from, delays_of_bars
from .verdict import refuse_if_useless

OTHER_SCALE = 0.02  # by which bars and boards differ in length: no rig fits both
SCALE_PART = 5e-4  # that makes points as wrong as a good calibration may be
SCALE_SIGMAS = 4.0
SIGNIFICANT = 2.5  # F of (2), of which 30 unknowns or more have a scatter of 0.26
LEAST_PX = 0.03  # of which systematic errors of image points are no contradiction
FAR_PART = 2.5e-4  # of the distance from the cameras: half of what a good calibration may be off
LOST = 0.02  # of the image points of the bar: so many more that fit without the boards are no chance


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarAndBoard:
    """Image points of a bar and of a board that the same cameras filmed."""

    bars: BarObservations
    boards: BoardObservations
    lenses_only: bool = False  # the cameras were moved between the films, or filmed the board one after another


def calibrate_together(both: BarAndBoard, monitor: Monitor, focal_px: float | None, lens: Lens) -> Calibration:
    """Calibrate from a bar and a board in one adjustment; the result is that of the bar, with the board as its `other`.

    Raises:
        InputError: either of them gives no rig, or they do not belong to the same cameras or lengths.
    """
    boards = _of_cameras(both)
    remarks, doubt = tuple[str, ...](), ""
    if both.lenses_only:
        board = calibrate_lenses(boards, monitor, focal_px, lens)
    else:
        alone = calibrate_boards(boards, monitor, focal_px, lens)
        refuse_if_useless(alone)
        board = partial_network(alone.network, alone.observations, alone.used, alone.sigma0_px, lenses_only=False)
        remarks, doubt = alone.remarks, alone.doubt
    done = calibrate_from(lambda some: _start(some, board), both.bars, monitor, lambda raw: delays_of_bars(_flat(raw, board)), board)
    F = _variance_factor(done, board)
    doubts = [doubt, _scale_doubt(done, board), _contradiction(done, board)]
    if F > SIGNIFICANT:
        remarks = (*remarks, f"bar and board differ by {np.sqrt(F):.1f} times their sigmas, by which all sigmas were multiplied")
        done = replace(done, covariance=done.covariance * F, considered=done.considered * F)
    return replace(done, remarks=(*remarks, *_board_lines(done)), doubt=", and ".join(filter(None, doubts)))


def _of_cameras(both: BarAndBoard) -> BoardObservations:
    """The boards with the cameras in the order of the bars.

    Raises:
        InputError: the cameras or the sizes of their images differ.
    """
    bars, boards = both.bars, both.boards
    check_names(bars.names, boards.names)
    order = [boards.names.index(name) for name in bars.names]
    for name, one, other in zip(bars.names, bars.size_px, boards.size_px[order]):
        if (one != other).any():
            raise InputError(
                f"Camera {name} filmed the bar with {one[0]:.0f}×{one[1]:.0f} pixels and the board with {other[0]:.0f}×{other[1]:.0f}; "
                "film both with the same settings."
            )
    return BoardObservations(
        names=bars.names, size_px=boards.size_px[order], xy_px=boards.xy_px[:, order], frames=boards.frames, board=boards.board
    )


def check_names(of_bar: tuple[str, ...], of_board: tuple[str, ...]) -> None:
    """Raise InputError unless the same cameras filmed the bar and the board."""
    if set(of_bar) != set(of_board):
        raise InputError(
            f"The bar was filmed by the cameras {', '.join(of_bar)}, the board by {', '.join(of_board)}; name the folders or "
            "movies of both like the cameras."
        )


def _flat(bars: BarObservations, board: Partial) -> BarObservations:
    """The bars as cameras without distortion would show them, all with the same focal length; points far from the axis are left out."""
    cameras = board.network.cameras(bars.names, bars.size_px)
    f = _focal_px(board)
    flat = np.stack([c.directions(bars.xy_px[:, n])[..., :2] for n, c in enumerate(cameras)], axis=1)
    with np.errstate(invalid="ignore"):
        flat[~(np.linalg.norm(flat, axis=-1) < np.tan(NARROW))] = np.nan
    return bars.changed((bars.size_px[:, None] - 1) / 2 + f * flat, labelled=bars.labelled)


def _focal_px(board: Partial) -> float:
    return float(np.median(board.network.interior[:, 0]))


def _start(bars: BarObservations, board: Partial) -> BarNetwork:
    """The cameras of the boards; or their lenses, with poses from the bars."""
    cameras, empty = board.network, np.zeros((0, 3))
    R, t = cameras.R, cameras.t
    if board.lenses_only:
        found = initial_network(_flat(bars, board), _focal_px(board)).network
        R, t = found.R, found.t
    start = BarNetwork(
        interior=cameras.interior, R=R, t=t, fisheye=cameras.fisheye, middle=empty, direction=empty, length_m=bars.length_m
    )  # fmt: skip
    return adjusted_start(start, bars, INTERIOR, (WIDE * WIDE_GATE, WIDE_GATE, GATE), board.block).network


def _scale_doubt(done: Calibration, board: Partial) -> str:
    """What the boards say of the length of the bars, if they contradict.  (1)

    Raises:
        InputError: their lengths are so different that no rig fits both.
    """
    if board.lenses_only:
        return ""
    bars = done.observations
    assert isinstance(bars, BarObservations)
    cameras = board.network.cameras(bars.names, bars.size_px)
    ends, used = met_ends(cameras, bars, WIDE_GATE * COARSE_CAUCHY_PX)
    whole = (used.sum(axis=1) >= 2).all(axis=1)
    if not whole.any():
        return ""
    ratio = np.linalg.norm(ends[whole, 0] - ends[whole, 1], axis=1) / bars.length_m - 1
    m, sigma = float(np.median(ratio)), float(mad_sigma(ratio)) / np.sqrt(whole.sum())
    said = f"the bar measures {1 + m:.4f} times its given length where the squares of the board have theirs"
    if abs(m) > OTHER_SCALE:
        raise InputError(f"{said[0].upper()}{said[1:]}; measure the bar and the squares, and check the numbers given.")
    return said if abs(m) > max(SCALE_PART, SCALE_SIGMAS * sigma) else ""


def _variance_factor(done: Calibration, board: Partial, least_px: float = 0.0) -> float:
    """F of (2), for image points of this sigma at least."""
    alone, used = done.alone, done.used
    assert alone is not None
    square = float(np.sum(done.residual_px[used] ** 2)) * alone.used.sum() / used.sum()
    of_board = replace(board.block, sigma_px=max(board.sigma_px, least_px)).cost(done.network, 1.0)
    apart = (square - alone.square_px2) / max(alone.sigma0_px, least_px) ** 2 + of_board
    return max(float(apart) / max(len(done.covariance) - 6, 1), 0.0)


def _contradiction(done: Calibration, board: Partial) -> str:
    """What speaks against the same cameras in both films: points in space that either would place elsewhere.  (3)"""
    assert done.alone is not None
    network, every = done.network, done.every_unknown
    cameras = network.cameras(done.observations.names, done.observations.size_px)
    points = network.points_m[done.used.any(axis=1)]
    apart = [displaced(cameras, every, change_of_cameras(network, done.alone.network), points)]
    if not board.lenses_only:
        apart.append(displaced(cameras, every, change_of_cameras(network, board.network), points))
    centres = np.stack([camera.centre_m for camera in cameras])
    distance = float(np.linalg.norm(points.mean(axis=0) - centres, axis=1).mean())
    lost = 1 - done.used.sum() / done.alone.used.sum()
    if lost < LOST and (_variance_factor(done, board, LEAST_PX) < SIGNIFICANT or max(apart) < FAR_PART * distance):
        return ""
    asked = "was their zoom or focus changed" if board.lenses_only else "were they moved, or was their zoom or focus changed"
    return f"the bar and the board do not fit the same cameras ({1e3 * max(apart):.1f} mm in space); {asked} between the films?"


def _board_lines(done: Calibration) -> tuple[str, ...]:
    """What the boards contributed, and their lengths as measured by the cameras of both."""
    assert done.other is not None
    board, bars = done.other, done.observations
    count = f"{len(board.used)} {'views' if board.lenses_only else 'positions'} of the board take part, sigma0 {board.sigma_px:.4f} px"
    if board.lenses_only:
        return (f"{count}; they give the lenses only",)
    lengths = lengths_of(board.observations, board.used, board.network.cameras(bars.names, bars.size_px), np.ones(len(board.used), bool))
    return (f"{count}; its {len(lengths.residual_m)} lengths are right within {1e3 * lengths.rms_m:.3f} mm (RMS)",)
