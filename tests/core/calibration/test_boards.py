"""Boards: printed, found in pictures, calibrated to the bound; views out of step, bent boards, and what is refused."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.boards.board import Board, BoardKind, Lens
from tricap.core.calibration.boards.calibration import _remarks_on_moved_cameras
from tricap.core.calibration.boards.detection import Variant, find_corners, find_variant
from tricap.core.calibration.boards.footage import _even
from tricap.core.calibration.boards.observations import BoardObservations
from tricap.core.calibration.boards.start import with_lenses
from tricap.core.calibration.bundle import Unknowns, design, moved, normal_equations, residuals
from tricap.core.calibration.calibrate import calibrate_rig, open_boards
from tricap.core.calibration.network import BoardNetwork
from tricap.core.calibration.precision import camera_covariance, predicted_error
from tricap.core.calibration.report import parameters
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.synthetic.bar import RIG_KINDS, benchmark_cameras, fisheye_cameras, random_cameras
from tricap.core.synthetic.board import HeldBoard, held_board, picture_of_board, waved_board

from .truth import TEST_BARS, error_m

SMALL = Board(kind=BoardKind.CHESSBOARD, squares=(9, 6), square_m=0.03)
LAST = np.arange(3)[:, None, None] == 2  # of three cameras
CHESSBOARD = Board(kind=BoardKind.CHESSBOARD, squares=(9, 6), square_m=0.05)
CHARUCO = Board(kind=BoardKind.CHARUCO, squares=(5, 4), square_m=0.14, dictionary="DICT_5X5_100", marker_m=0.105)


def observed(held: HeldBoard, board: Board = CHESSBOARD) -> BoardObservations:
    return BoardObservations(
        names=tuple(c.name for c in held.cameras),
        size_px=np.array([c.size_px for c in held.cameras], dtype=float),
        xy_px=held.xy_px,
        frames=np.arange(len(held.xy_px)),
        board=board,
    )


def true_network(held: HeldBoard, board: Board = CHESSBOARD) -> BoardNetwork:
    C = len(held.cameras)
    empty = np.zeros((C, 10)), np.zeros((C, 3, 3)), np.zeros((C, 3))
    made = BoardNetwork(interior=empty[0], R=empty[1], t=empty[2], corners_m=board.corners_m, R_board=held.R, t_board=held.t_m)
    return made.with_cameras(held.cameras)


def bound_m(held: HeldBoard, sigma_px: float, board: Board = CHESSBOARD) -> float:
    """The Cramér–Rao bound over the volume with all unknowns of the lenses free."""
    network = true_network(held, board)
    free = np.arange(10) != (7 if network.curved.any() else -1)
    unknowns = Unknowns(free=free, expected=network.interior, sigma=np.full(network.interior.shape, 1e6))
    used = np.isfinite(held.xy_px[..., 0]) & ~held.wrong
    normals = normal_equations(network, residuals(network, held.xy_px), used.astype(float), unknowns, 1.0)
    return predicted_error(held.cameras, unknowns, camera_covariance(network, normals, unknowns) * sigma_px**2, TEST_BARS).rms_m


def drawn(seed: int, positions: int = 30, **noise: float) -> HeldBoard:
    rng = np.random.default_rng(seed)
    return held_board(random_cameras(rng, RIG_KINDS[seed % len(RIG_KINDS)]), CHESSBOARD.corners_m, positions, rng, **noise)


def mirrored(xy_px: np.ndarray) -> np.ndarray:
    """What a detector finds in mirrored images: it numbers the corners of each row from the other end."""
    return xy_px.reshape(*xy_px.shape[:2], 6, 9, 2)[:, :, :, ::-1].reshape(xy_px.shape) * [-1, 1] + [767, 0]


def test_every_derivative_of_a_board_agrees_with_differences() -> None:
    network = true_network(drawn(0, 5))
    unknowns = Unknowns(free=np.ones(10, bool), expected=network.interior, sigma=np.ones_like(network.interior))
    B = design(network, unknowns)[2]
    for n in range(6):
        step = np.zeros((6, 5))
        step[n] = 1e-6
        ahead, back = (design(moved(network, unknowns, np.zeros(48), s), unknowns)[0] for s in (step, -step))
        assert np.abs((ahead - back) / 2e-6 - B[:, n]).max() < 1e-5 * np.abs(B[:, n]).max(), f"board {n}"


@pytest.mark.slow
def test_random_rigs_reach_the_bound_and_know_it() -> None:
    """Single ratios have measured 0.6 to 1.5 over 10 seeds: one eigen-direction dominates."""
    ratios = []
    for seed in range(2):
        held = drawn(seed, sigma_px=0.1)
        done = calibrate_rig(observed(held), Monitor())
        ratios.append(error_m(held.cameras, done.rig.cameras) / bound_m(held, 0.1))
        assert done.calibration.sigma0_px == pytest.approx(0.1, rel=0.05)
        assert done.verdict.light == "green" and not done.calibration.remarks
    assert max(ratios) < 2.0


@pytest.mark.slow
def test_a_third_of_wrong_corners_does_no_harm() -> None:
    held = drawn(4, sigma_px=0.1, gross=0.3)
    done = calibrate_rig(observed(held), Monitor())
    assert error_m(held.cameras, done.rig.cameras) < 2.5 * bound_m(held, 0.1)


@pytest.mark.slow
def test_views_out_of_step_are_found_and_reported() -> None:
    held = drawn(3, sigma_px=0.1)
    late = drawn(3, sigma_px=0.1).xy_px.copy()
    shown = np.flatnonzero(np.isfinite(late[:, 1, 0, 0]))[::9]
    late[shown, 1] += 4.0  # px
    done = calibrate_rig(observed(replace(held, xy_px=late)), Monitor())
    assert len(done.calibration.remarks) == 1
    assert done.calibration.remarks[0] == (
        f"camera C was not synchronised with the others, or was moved, in {len(shown)} of "
        f"{np.isfinite(late[:, 1, 0, 0]).sum()} images: {', '.join(map(str, shown))}"
    )
    assert error_m(held.cameras, done.rig.cameras) < 2.5 * bound_m(held, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("square_m, marker_m", [(1e-300, 0.0), (0.0, 0.0), (0.04, 1e-300), (0.04, 0.05)])
def test_squares_and_markers_that_no_print_has(square_m: float, marker_m: float) -> None:
    with pytest.raises(InputError, match="are given as"):
        Board(kind=BoardKind.CHARUCO, squares=(7, 5), square_m=square_m, marker_m=marker_m)


@pytest.mark.slow
def test_cameras_that_are_not_in_step_are_calibrated_with_a_waved_board() -> None:
    """Measured over 6 recordings: delays within 0.0003 images, errors 1.0 to 1.6 times the bound of cameras in step."""
    rng, delay = np.random.default_rng(2), (0.0, 0.37, -2.2)
    held = waved_board(benchmark_cameras(), CHESSBOARD.corners_m, 60, rng, delay_images=delay)
    done = calibrate_rig(observed(held), Monitor())
    for (value, sigma), true in zip(done.calibration.delays.values(), delay[1:], strict=True):
        assert abs(value - true) < 0.003 and sigma < 0.001  # 0.1 ms at 30 images per second; the limit is 0.3
    assert error_m(held.cameras, done.rig.cameras) < 2.0 * bound_m(held, 0.1)
    assert done.verdict.light == "green" and not done.calibration.remarks


@pytest.mark.slow
def test_fisheye_lenses_are_recognised_and_calibrated() -> None:
    """Measured over 4 rigs: 0.6 to 0.9 times the bound of all unknowns, of which some are left out."""
    rng = np.random.default_rng(2)
    held = held_board(fisheye_cameras(rng), SMALL.corners_m, 40, rng, sigma_px=0.1)
    done = calibrate_rig(observed(held, SMALL), Monitor())
    assert all(c.fisheye for c in done.rig.cameras) and done.verdict.light == "green"
    assert error_m(held.cameras, done.rig.cameras) < 1.5 * bound_m(held, 0.1, SMALL)
    assert "k4" in {name for name, *_ in parameters(done.calibration, 0)}


def test_brown_lenses_are_not_taken_for_fisheye_lenses() -> None:
    wide = [replace(c, matrix=c.matrix * [[0.6, 1, 1], [1, 0.6, 1], [1, 1, 1]]) for c in benchmark_cameras()]
    held = held_board(wide, CHESSBOARD.corners_m, 30, np.random.default_rng(4), sigma_px=0.1)
    lenses = with_lenses(observed(held), None, Lens.AUTO)[1]
    assert not lenses.fisheye.any() and (lenses.interior[:, 0] < 0.75 * 768).all()


def test_images_are_chosen_in_runs_that_show_motion() -> None:
    assert np.array_equal(_even(np.arange(5), 9), np.arange(5))
    chosen = _even(np.arange(4000), 240)
    assert len(chosen) == 240 and (np.diff(chosen) == 1).sum() == 30 * 7 and chosen[-1] > 3900
    apart = _even(np.arange(0, 4000, 2), 240)
    assert len(apart) == 240 and np.diff(apart).min() > 4 and len(_even(np.arange(9), 0)) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turned", "said"), [(0.01, "camera C, moved, exchanged or not synchronised"), (0.0005, "seems to have been moved")]
)
def test_a_moved_camera_is_never_good(turned: float, said: str) -> None:
    held = drawn(3, sigma_px=0.1)
    xy = held.xy_px.copy()
    other = replace(held.cameras[1], R_cam_world=rotation_from_vector(np.array([0.0, turned, 0.0])) @ held.cameras[1].R_cam_world)
    seen = other.project(true_network(held).points_m[18:])
    xy[18:, 1] = np.where(np.isfinite(xy[18:, 1]), seen + np.random.default_rng(1).normal(0, 0.1, seen.shape), np.nan)
    done = calibrate_rig(observed(replace(held, xy_px=xy)), Monitor())
    assert done.verdict.light != "green" and said in done.verdict.sentence


def test_a_large_change_that_few_views_support_is_never_good() -> None:
    """A camera moved after few positions has shown too little for t > 6; its residuals change by more than those of clean sets."""
    held = drawn(0, 20, sigma_px=0.1)
    done = calibrate_rig(observed(held), Monitor())
    assert not _remarks_on_moved_cameras(done.calibration)[1]
    residual_px = done.calibration.residual_px.copy()
    early = np.argsort(done.calibration.observations.frames)[:4]
    residual_px[early, 1] += np.random.default_rng(0).normal(0.15, 0.1, (4, 1, 1))
    doubts = _remarks_on_moved_cameras(replace(done.calibration, residual_px=residual_px))[1]
    assert len(doubts) == 1 and "moved before frame 4" in doubts[0]


def test_two_cameras_that_disagree_are_never_good() -> None:
    """One is turned halfway: each of them is apart in a quarter of the images, so that neither alone is in doubt."""
    rng = np.random.default_rng(14)
    held = held_board(random_cameras(rng, "parallel")[:2], CHESSBOARD.corners_m, 24, rng, sigma_px=0.1)
    apart = np.arange(24) % 3 == 1
    xy = held.xy_px.copy()
    for c in range(2):
        xy[apart & (np.arange(24) % 2 == c), c] += [12.0, 20.0]
    done = calibrate_rig(observed(replace(held, xy_px=xy)), Monitor())
    assert done.verdict.light != "green" and "the cameras disagree in 8 of 24 images" in done.verdict.sentence


def test_two_cameras_that_disagree_in_a_row_are_never_good() -> None:
    """Exchanged in five images one after another: neither of them has three of these, and together they are less than a quarter."""
    rng = np.random.default_rng(14)
    held = held_board(random_cameras(rng, "parallel")[:2], CHESSBOARD.corners_m, 24, rng, sigma_px=0.1)
    xy = held.xy_px.copy()
    for n in range(5):
        xy[n, n % 2] += [12.0, 20.0]
    done = calibrate_rig(observed(replace(held, xy_px=xy)), Monitor())
    assert done.verdict.light != "green" and "among them all from 0 to 4" in done.verdict.sentence


@pytest.mark.slow
def test_views_that_fit_to_a_hundredth_of_a_pixel_are_synchronised() -> None:
    held = drawn(6, sigma_px=0.002)
    xy = held.xy_px.copy()
    xy[3, 1] += 0.02
    assert not calibrate_rig(observed(replace(held, xy_px=xy)), Monitor()).calibration.remarks


@pytest.mark.slow
def test_cameras_exchanged_towards_the_end_are_never_good() -> None:
    held = drawn(3, sigma_px=0.1)
    xy = held.xy_px.copy()
    xy[25:, [0, 1]] = xy[25:, [1, 0]]
    done = calibrate_rig(observed(replace(held, xy_px=xy)), Monitor())
    assert done.verdict.light != "green" and "exchanged" in done.verdict.sentence


@pytest.mark.slow
def test_a_bent_board_is_measured_and_reported() -> None:
    rng = np.random.default_rng(7)
    corners = CHESSBOARD.corners_m.copy()
    corners[:, 2] = 0.004 * (1 - (corners[:, 0] / corners[:, 0].max()) ** 2)  # bent by 4 mm
    held = held_board(random_cameras(rng, "triangle"), corners, 40, rng, sigma_px=0.1)
    done = calibrate_rig(observed(held), Monitor())
    assert done.verdict.light != "green" and "bent or printed unevenly by 2." in done.verdict.sentence
    assert error_m(held.cameras, done.rig.cameras) < 3 * bound_m(held, 0.1)


@pytest.mark.slow
def test_a_board_that_is_stretched_in_print_is_never_good() -> None:
    rng = np.random.default_rng(4)
    held = held_board(random_cameras(rng, "wide"), CHESSBOARD.corners_m * [1.01, 1.0, 1.0], 30, rng, sigma_px=0.1)
    done = calibrate_rig(observed(held), Monitor())
    assert done.verdict.light != "green" and "the squares are 1.0" in done.verdict.sentence


def test_the_ends_of_a_symmetric_board_are_told_apart_by_the_other_cameras() -> None:
    board = Board(kind=BoardKind.CHESSBOARD, squares=(8, 6), square_m=0.05)
    rng = np.random.default_rng(1)
    held = held_board(random_cameras(rng, "triangle"), board.corners_m, 30, rng, sigma_px=0.1)
    turned = rng.random(held.xy_px.shape[:2]) < 0.5
    held = replace(held, xy_px=np.where(turned[..., None, None], held.xy_px[:, :, ::-1], held.xy_px))
    assert calibrate_rig(observed(held, board), Monitor()).calibration.sigma0_px == pytest.approx(0.1, rel=0.06)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda xy: xy[:3], "Cameras ., . share only 3 positions"),
        (lambda xy: np.where(LAST, np.roll(xy, 12, axis=0), xy), "Camera R does not agree .* same instant"),
        (lambda xy: np.where(LAST, mirrored(xy), xy), "Camera R does not agree .* mirrored"),
    ],
    ids=["three poses", "one camera late", "one camera mirrored"],
)
def test_what_makes_no_rig_is_refused(spoil, message: str) -> None:
    xy = spoil(drawn(3, 30).xy_px)
    held = drawn(3, len(xy))
    with pytest.raises(InputError, match=message):
        calibrate_rig(observed(replace(held, xy_px=xy)), Monitor())


def test_parallel_boards_are_refused() -> None:
    with pytest.raises(InputError, match="board was always parallel to itself .* tilt the board by 20 to 45 degrees"):
        calibrate_rig(observed(drawn(0, tilt=0.0)), Monitor())


def filmed(folder: Path, board: Board, cameras: tuple[Camera, ...], positions: int, inverted: bool = False) -> HeldBoard:
    """Pictures of a board, each camera's in a folder of its own; the first camera lacks one image."""
    rng = np.random.default_rng(11)
    held = held_board(cameras, board.corners_m, positions, rng, tilt=np.radians(35))
    picture, side = board.picture(dpi=25), round(board.square_m / 0.0254 * 25)
    for camera in cameras:
        (folder / camera.name).mkdir(parents=True)
        for n in range(positions):
            if (camera.name, n) != (cameras[0].name, 1):
                image = picture_of_board(camera, 255 - picture if inverted else picture, side, board.square_m, held.R[n], held.t_m[n], rng)
                cv2.imwrite(str(folder / camera.name / f"{n:03}.png"), image)
    return held


def test_corners_are_found_to_a_tenth_of_a_pixel(tmp_path: Path) -> None:
    """Also with the board turned over the edge of the image: a ChArUco board needs only a part of it."""
    rng = np.random.default_rng(0)
    camera = benchmark_cameras()[1].resized((512, 384))
    for board in (CHESSBOARD, CHARUCO):
        side = round(board.square_m / 0.0254 * 50)
        R = rotation_from_vector(np.array([0.3, -0.4, 2.0]))
        for x, whole in ((0.0, True), (0.65, False)):
            t = np.array([x, 0.05, 1.6])
            image = picture_of_board(camera, board.picture(dpi=50), side, board.square_m, R, t, rng)
            true = camera.project(board.corners_m @ R.T + t)
            found = find_corners(image.astype(np.float32), board)
            shown = np.isfinite(found[:, 0])
            assert shown.all() if whole else 0 < shown.sum() < len(shown) if board is CHARUCO else not shown.any()
            if shown.any():
                assert np.sqrt(np.mean((found[shown] - true[shown]) ** 2)) < 0.12
    inverted = 255.0 - image.astype(np.float32)
    assert find_variant([inverted], CHARUCO)[0] == Variant(inverted=True)


@pytest.mark.slow
def test_the_command_calibrates_from_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = tuple(c.resized((384, 288)) for c in benchmark_cameras()[:2])
    filmed(tmp_path / "board", CHARUCO, cameras, 10, inverted=True)
    described = ["--board", "charuco", "--squares", "5x4", "--square", "0.14", "--marker", "0.105", "--dictionary", "DICT_5X5_100"]
    out = tmp_path / "rig.toml"
    assert main(["calibrate", str(tmp_path / "board"), *described, "--out", str(out), "--report", str(tmp_path / "report")]) == 0
    shown = capsys.readouterr().out
    assert "in which the board was held" in shown and out.is_file() and (tmp_path / "report" / "lengths.png").is_file()
    assert not list(tmp_path.glob("*_bar.csv"))
    for picture in (tmp_path / "board").glob("*/00[3-9].png"):
        picture.unlink()
    described[-1] = "DICT_4X4_50"
    assert main(["calibrate", str(tmp_path / "board"), *described, "--out", str(tmp_path / "no.toml")]) == 2
    assert "give --dictionary DICT_5X5_" in capsys.readouterr().err and not (tmp_path / "no.toml").exists()


def test_images_belong_together_by_their_number(tmp_path: Path) -> None:
    for view, numbers in (("L", (1, 2, 4)), ("R", (2, 3, 4))):
        (tmp_path / view).mkdir()
        for n in numbers:
            cv2.imwrite(str(tmp_path / view / f"{n:05}_cam0.png"), np.zeros((48, 64), np.uint8))
    assert [n.tolist() for n in open_boards(tmp_path).numbers] == [[1, 2, 4], [2, 3, 4]]


def test_what_cannot_be_printed_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Markers without a pixel for each of their cells ended in OpenCV's words."""
    board = ["calibrate", "--board", "charuco", "--squares", "7x5", "--square", "0.04", "--print", str(tmp_path / "b.png")]
    for more, said in ((["--marker", "0.0001"], "too small to be drawn"), (["--out", "rig.toml"], "--out belongs to a calibration")):
        assert main([*board, *more]) == 2 and said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [".png", ".pdf"])
def test_a_board_is_printed_in_its_size(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"board{ending}"
    assert main(["calibrate", "--board", "chessboard", "--squares", "9x6", "--square", "0.0254", "--print", str(path)]) == 0
    data = path.read_bytes()
    if ending == ".png":
        at = data.index(b"pHYs") + 4
        assert struct.unpack(">IIB", data[at : at + 9]) == (11811, 11811, 1)  # 300 dpi
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (9 * 300, 12 * 300)
    else:
        assert b"/MediaBox [0 0 864.0000 648.0000]" in data  # 12 × 9 inches


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--squares", "9x6"], "give --board"),
        (["--marker", "0.02"], "give --board"),
        (["--board", "chessboard", "--square", "0.01"], "--squares, such as 9x6"),
        (["--board", "chessboard", "--squares", "9x6", "--square", "-1"], "measure the side of a square"),
        (["--board", "chessboard", "--squares", "2x6", "--square", "0.1"], "3 to 60"),
        (["--board", "charuco", "--squares", "9x6", "--square", "0.1", "--dictionary", "DICT_4X4_5"], "Did you mean “DICT_4X4_50”"),
        (["--board", "charuco", "--squares", "20x20", "--square", "0.1"], "200 markers"),
        (["--board", "charuco", "--squares", "5x5", "--square", "0.1", "--marker", "0.2"], "smaller than the squares"),
        (["--board", "chessboard", "--squares", "9x6", "--square", "0.1", "--bar-length", "1"], "belongs to a bar"),
        (["--board", "chessboard", "--squares", "9x6", "--square", "0.1", "--marker", "0.02"], "a chessboard has none"),
        (["--board", "charuco", "--squares", "5x5", "--square", "0.1", "--marker", "0"], "--marker 0 is no side of a marker"),
    ],
)
def test_what_is_no_board_is_refused(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(tmp_path), *arguments, "--out", str(tmp_path / "rig.toml")]) == 2
    assert message in capsys.readouterr().err


def test_images_without_a_board_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for view in "LR":
        (tmp_path / view).mkdir()
        cv2.imwrite(str(tmp_path / view / "0.png"), np.random.default_rng(0).integers(0, 255, (96, 128)).astype(np.uint8))
    assert (
        main(
            ["calibrate", str(tmp_path), "--board", "chessboard", "--squares", "9x6", "--square", "0.1", "--out", str(tmp_path / "r.toml")]
        )
        == 2
    )
    assert "View L" in (shown := capsys.readouterr().err) and "never shows the chessboard of 9×6 inner corners" in shown


@pytest.mark.slow
def test_a_charuco_board_whose_sides_were_exchanged_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    filmed(tmp_path / "board", CHARUCO, tuple(c.resized((384, 288)) for c in benchmark_cameras()[:2]), 4)
    described = ["--board", "charuco", "--squares", "4x5", "--square", "0.14", "--dictionary", "DICT_5X5_100"]
    assert main(["calibrate", str(tmp_path / "board"), *described, "--out", str(tmp_path / "rig.toml")]) == 2
    assert "but one of 5×4; give 5×4" in capsys.readouterr().err


@pytest.mark.slow
def test_a_board_whose_squares_were_counted_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = tuple(c.resized((384, 288)) for c in benchmark_cameras()[:2])
    filmed(tmp_path / "board", CHESSBOARD, cameras, 3)
    described = ["--board", "chessboard", "--squares", "10x7", "--square", "0.05", "--out", str(tmp_path / "r.toml")]
    assert main(["calibrate", str(tmp_path / "board"), *described]) == 2
    assert "10×7 inner corners, but one of 9×6: inner corners are where four squares meet; give 9×6." in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2])
def test_real_boards_of_three_cameras(number: int, shared_takes: Path, tmp_path: Path) -> None:
    """Boards of 9×6 corners whose left camera is out of step in half of the first set."""
    for path in (shared_takes / "face_3cam_twente" / f"board{number}").glob("*.jpg"):
        (folder := tmp_path / path.stem.split("_")[-1]).mkdir(exist_ok=True)
        (folder / path.name).symlink_to(path)
    described = ["--board", "chessboard", "--squares", "9x6", "--square", "0.01", "--report", str(tmp_path / "report")]
    assert main(["calibrate", str(tmp_path), *described, "--out", str(tmp_path / "rig.toml"), "--quiet"]) == 0
    figures = json.loads((tmp_path / "report" / "calibration.json").read_text())
    assert figures["sigma0_px"] < 0.06 and figures["held_out_lengths"]["rms_m"] < 1e-4
    assert any("camera L was not synchronised" in line for line in figures["remarks"]) == (number == 1)
