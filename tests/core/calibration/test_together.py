"""A bar and a board in one adjustment: the bound of both, films that contradict each other, and lenses alone."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.boards.observations import BoardObservations
from tricap.core.calibration.bundle import Unknowns, normal_equations, reduce_to_cameras, residuals
from tricap.core.calibration.calibrate import CalibratedRig, calibrate_rig
from tricap.core.calibration.helmert import partial_network, positioned
from tricap.core.calibration.precision import camera_covariance, predicted_error
from tricap.core.calibration.together import BarAndBoard
from tricap.core.cli.calibrate import _other_rates
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import read_rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.synthetic.bar import BarNoise, BarPictures, WavedBar, benchmark_cameras, fisheye_cameras, waved_bar, write_bar_folder
from tricap.core.synthetic.board import HeldBoard, held_board

from . import test_boards, truth
from .test_boards import CHESSBOARD, SMALL, filmed

BAR_PX, BOARD_PX = 0.05, 0.1


def films(seed: int, of_bar: tuple[Camera, ...], of_board: tuple[Camera, ...], bars: int = 60) -> tuple[WavedBar, HeldBoard]:
    rng = np.random.default_rng(seed)
    waved = waved_bar(of_bar, bars, rng, BarNoise(sigma_px=BAR_PX, unlabelled=True))
    return waved, held_board(of_board, CHESSBOARD.corners_m, 20, rng, sigma_px=BOARD_PX)


def calibrated(waved: WavedBar, boards: BoardObservations, lenses_only: bool = False, **changed: float) -> CalibratedRig:
    bars = replace(truth.observed(waved, labelled=False), **changed)
    return calibrate_rig(BarAndBoard(bars=bars, boards=boards, lenses_only=lenses_only), Monitor())


def bound_m(waved: WavedBar, held: HeldBoard) -> float:
    """The Cramér–Rao bound of both films."""
    network, boards = truth.true_network(waved), test_boards.true_network(held)
    visible = np.isfinite(held.xy_px[..., 0])
    block = partial_network(boards, test_boards.observed(held), visible, BOARD_PX, lenses_only=False).block
    unknowns = Unknowns(free=np.ones(10, bool), expected=network.interior, sigma=np.full(network.interior.shape, 1e6), block=block)
    xy = np.where(waved.swapped[..., None, None], waved.xy_px[:, :, ::-1], waved.xy_px)
    wrong = np.where(waved.swapped[..., None], waved.wrong[:, :, ::-1], waved.wrong)
    used = np.isfinite(xy[..., 0]) & ~wrong
    used &= used.sum(axis=1, keepdims=True) >= 2
    normals = normal_equations(network, residuals(network, xy), used.astype(float), unknowns, BAR_PX)
    covariance = camera_covariance(network, normals, unknowns) * BAR_PX**2
    return predicted_error(waved.cameras, unknowns, covariance, truth.TEST_BARS).rms_m


@pytest.mark.slow
def test_both_reach_the_bound_of_both_and_know_it() -> None:
    """Ratios have measured 0.5 to 1.6 over 30 random rigs, 1.03 by RMS."""
    waved, held = films(3, benchmark_cameras(), benchmark_cameras())
    done = calibrated(waved, test_boards.observed(held))
    bound = bound_m(waved, held)
    assert bound < 0.8 * truth.bound(waved, BAR_PX).rms_m  # the board improves on the bar, the bar on the board
    assert bound < 0.8 * test_boards.bound_m(held, BOARD_PX)
    assert truth.error_m(waved.cameras, done.rig.cameras) < 2 * bound
    assert done.quality.predicted.rms_m == pytest.approx(bound, rel=0.35)
    assert done.verdict.light == "green" and not done.calibration.doubt
    assert done.rig.metadata["bar_length_m"] == 0.5 and done.rig.metadata["board"] == "chessboard"


@pytest.mark.slow
def test_it_is_the_minimum_of_all_image_points() -> None:
    """At the result the gradient of the common sum of squares vanishes: the next step is a small part of a sigma."""
    waved, held = films(4, benchmark_cameras(), benchmark_cameras())
    calibration = calibrated(waved, test_boards.observed(held)).calibration
    other, network, unknowns = calibration.other, calibration.network, calibration.unknowns.alone
    assert other is not None
    boards = positioned(
        replace(other.network, interior=network.interior, R=network.R, t=network.t), other.observations.xy_px, other.used, None
    )
    fresh = partial_network(boards, other.observations, other.used, other.sigma_px, lenses_only=False)
    both = replace(unknowns, block=fresh.block)
    normals = normal_equations(network, calibration.residual_px, calibration.used.astype(float), both, calibration.sigma0_px)
    step = camera_covariance(network, normals, both) @ reduce_to_cameras(normals)[1]
    sigma = np.sqrt(np.maximum(np.diag(calibration.covariance), 1e-20))
    assert np.abs(step / sigma).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ("moved", "were they moved"),
        ("zoomed", "zoom or focus"),
        ("length", "the bar measures 0.99"),
        ("zoomed, lenses only", "; was their zoom or focus changed between"),
    ],
)
def test_films_that_contradict_each_other_are_never_good(spoil: str, said: str) -> None:
    cameras = benchmark_cameras()
    last = cameras[2]
    if spoil == "moved":
        last = replace(last, R_cam_world=rotation_from_vector(np.array([0.002, 0.0, 0.001])) @ last.R_cam_world)
    if spoil.startswith("zoomed"):
        factor = 1.2 if spoil.endswith("only") else 1.01
        last = replace(last, matrix=last.matrix * np.array([[factor, factor, 1], [1, factor, 1], [1, 1, 1]]))
    waved, held = films(5, cameras, (*cameras[:2], last), bars=100)
    longer = {"length_m": 0.504} if spoil == "length" else {}
    done = calibrated(waved, test_boards.observed(held), spoil.endswith("only"), **longer)
    assert done.verdict.light != "green" and said in done.verdict.sentence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turn", "zoom", "message"),
    [
        (0.0, 1.02, r"which is useless; the bar and the board do not fit the same cameras .* between the films\?$"),
        (0.03, 1.0, r"only 0 of .* moved between the films"),
    ],
)
def test_films_of_quite_different_cameras_are_refused_with_the_reason(turn: float, zoom: float, message: str) -> None:
    cameras = benchmark_cameras()
    R = rotation_from_vector(np.array([turn, 0.0, turn / 3])) @ cameras[2].R_cam_world
    other = replace(cameras[2], R_cam_world=R, matrix=cameras[2].matrix * np.array([[zoom, zoom, 1], [1, zoom, 1], [1, 1, 1]]))
    waved, held = films(5, cameras, (*cameras[:2], other), bars=100)
    with pytest.raises(InputError, match=message):
        calibrated(waved, test_boards.observed(held))


def test_lengths_that_no_rig_fits_are_refused() -> None:
    waved, held = films(6, benchmark_cameras(), benchmark_cameras())
    with pytest.raises(InputError, match="The bar measures 0.95.. times its given length"):
        calibrated(waved, test_boards.observed(held), length_m=0.525)


@pytest.mark.slow
def test_lenses_alone_are_taken_from_cameras_that_stood_elsewhere() -> None:
    """The board was filmed by one camera after the other, turned by any angle: its images share nothing but the lenses."""
    cameras = benchmark_cameras()
    waved, held = films(7, cameras, cameras)
    apart = test_boards.observed(held)
    rng = np.random.default_rng(0)
    mixed = np.stack([apart.xy_px[rng.permutation(len(apart.frames)), c] for c in range(3)], axis=1)
    done = calibrated(waved, apart.changed(mixed), lenses_only=True)
    assert truth.error_m(cameras, done.rig.cameras) < 0.8 * truth.bound(waved, BAR_PX).rms_m
    assert done.verdict.light == "green"
    with pytest.raises(InputError, match="do not agree with the other cameras|only 3 positions of the board"):
        calibrated(waved, apart.changed(mixed))


@pytest.mark.slow
def test_bars_before_fisheye_lenses_of_a_board() -> None:
    rng = np.random.default_rng(8)
    cameras = fisheye_cameras(rng)
    waved = waved_bar(cameras, 300, rng, BarNoise(sigma_px=BAR_PX), delay_images=(0.0, 0.4, 2.3), pace=0.3)
    held = held_board(cameras, SMALL.corners_m, 30, rng, sigma_px=BOARD_PX)
    for boards_give_lenses_only in (False, True):
        done = calibrated(waved, test_boards.observed(held, SMALL), boards_give_lenses_only)
        check_late_fisheye(done, cameras)


def check_late_fisheye(done: CalibratedRig, cameras: tuple[Camera, ...]) -> None:
    assert done.calibration.network.curved.all() and done.verdict.light == "green"
    late = [value for value, _ in done.calibration.delays.values()]
    np.testing.assert_allclose(late, [0.4, 2.3], atol=0.002)
    assert truth.error_m(cameras, done.rig.cameras) < 1e-3


def test_other_cameras_are_refused() -> None:
    waved, held = films(9, benchmark_cameras(), benchmark_cameras())
    boards = test_boards.observed(held)
    with pytest.raises(InputError, match="filmed by the cameras L, C, R, the board by L, C, X; name"):
        calibrated(waved, replace(boards, names=("L", "C", "X")))
    with pytest.raises(InputError, match="Camera C filmed the bar with 768×576 pixels and the board with 640×480"):
        calibrated(waved, replace(boards, size_px=np.where([[0], [1], [0]], [640.0, 480.0], boards.size_px)))
    with pytest.raises(InputError, match="Camera L shows only 3 positions of the board; at least 4 are needed"):
        calibrated(waved, boards.changed(np.where(np.arange(20)[:, None, None, None] < 3, boards.xy_px, np.nan)), lenses_only=True)


@pytest.mark.slow
def test_the_command_calibrates_with_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = benchmark_cameras()[:2]
    waved = waved_bar(cameras, 24, np.random.default_rng(2), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0))
    write_bar_folder(tmp_path / "bar", waved, BarPictures(radius_m=0.015))
    filmed(tmp_path / "board", CHESSBOARD, cameras, 8)
    bar = ["calibrate", str(tmp_path / "bar"), "--bar-length", "0.5", "--out", str(tmp_path / "rig.toml")]
    board = ["--with-board", str(tmp_path / "board"), "--board", "chessboard", "--squares", "9x6", "--square", "0.05"]
    assert main([*bar, *board, "--report", str(tmp_path / "report")]) == 0
    assert "of the board take part" in capsys.readouterr().out
    rig = read_rig(tmp_path / "rig.toml")
    assert "light" not in rig.metadata and truth.error_m(cameras, [rig[c.name] for c in cameras]) < 1e-3
    assert (tmp_path / "rig_bar.csv").exists() and "board" in (tmp_path / "report" / "calibration.json").read_text()
    assert main([*bar, *board, "--lenses-only"]) == 0 and "give the lenses only" in capsys.readouterr().out
    for view, rate in (("L", 25.0), ("C", 30.0)):
        film = cv2.VideoWriter(str(tmp_path / f"{view}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), rate, (64, 48))
        film.write(np.zeros((48, 64, 3), np.uint8))
        film.release()
    (tmp_path / "._L.avi").write_bytes(b"of another system")
    (said,) = _other_rates(tmp_path)
    assert "(C 30, L 25 images per second)" in said and "--rates C=30,L=25" in said and not _other_rates(tmp_path / "board")
    for arguments, message in (
        ([*bar, *board[:2]], "--with-board needs the board"),
        ([*bar, "--lenses-only"], "--lenses-only belongs to --with-board"),
        ([*bar[:2], *bar[4:], *board], "The bar's length is missing"),
        ([*bar[:-1], str(tmp_path / "board" / "L" / "000.png"), *board], "must end in .toml"),
    ):
        assert main(arguments) == 2 and message in capsys.readouterr().err
