"""Films at different rates: points at common instants, calibrations as good as with one rate, and what is refused."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.calibration import calibrate
from tricap.core.calibration.bars import BarObservations
from tricap.core.calibration.boards.board import Lens
from tricap.core.calibration.boards.observations import BoardObservations
from tricap.core.calibration.calibrate import calibrate_rig
from tricap.core.calibration.clocks import Clocks, at_common_instants, begun_together, corners_at_common_instants, rates_of
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import read_rig
from tricap.core.synthetic.bar import BarNoise, BarPictures, bar_ends, benchmark_cameras, fisheye_cameras, waved_bar, write_bar_folder
from tricap.core.synthetic.board import waved_board

from .test_boards import CHESSBOARD
from .test_boards import observed as observed_boards
from .truth import error_m, observed

RATES = np.array([24.0, 30.0, 60.0])
START_S = np.array([0.0, 0.213, -0.377])
SECONDS = 14.0
SIGMA_PX = 0.05
SLOW = 0.35  # of the pace of the synthetic wave, which is that of 30 images per second


def filmed(cameras: Sequence[Camera], rates: np.ndarray, start_s: np.ndarray, seed: int, sigma_px: float) -> list[np.ndarray]:
    """The ends (n, 2, 2) in each camera's own images."""
    found = []
    for camera, rate, start in zip(cameras, rates, start_s):
        ends = bar_ends(int(SECONDS * rate), np.random.default_rng(seed), 0.5, start * rate, SLOW * 30 / rate)
        xy = camera.project(ends)
        noise = np.random.default_rng((seed, int(rate))).normal(0, sigma_px, xy.shape)
        found.append(np.where(camera.sees(xy)[..., None], xy + noise, np.nan))
    return found


def of_rates(cameras: Sequence[Camera], rates: np.ndarray, start_s: np.ndarray, known_s: np.ndarray, seed: int = 3) -> BarObservations:
    xy = filmed(cameras, rates, start_s, seed, SIGMA_PX)
    clocks = Clocks(start_s=known_s, interval_s=1 / rates)
    frames, together = at_common_instants(clocks, [np.arange(len(x)) for x in xy], xy)
    waved = waved_bar(cameras, 10, np.random.default_rng(0), BarNoise())
    return replace(observed(waved, labelled=False), xy_px=together, frames=frames)


def test_points_between_images_are_those_of_the_path() -> None:
    cameras = benchmark_cameras()
    xy = filmed(cameras, RATES, START_S, 1, 0.0)
    clocks = Clocks(start_s=START_S, interval_s=1 / RATES)
    frames, together = at_common_instants(clocks, [np.arange(len(x)) for x in xy], xy)
    assert clocks.slowest == 0 and len(frames) == int(SECONDS * 24)
    at_once = filmed(cameras, np.full(3, 24.0), np.zeros(3), 1, 0.0)
    for c in range(3):
        off = np.linalg.norm(together[:, c] - at_once[c], axis=-1)
        assert np.isfinite(off).mean() > 0.7 * np.isfinite(at_once[c][..., 0]).mean() and np.nanmax(off) < 0.02


@pytest.mark.slow
def test_three_rates_calibrate_as_well_as_one() -> None:
    """The starts of two films are wrong by 3 and 5 ms, which the adjustment finds: right to 0.3 ms."""
    cameras = benchmark_cameras()
    late_s = np.array([0.0, 0.003, -0.005])
    mixed = calibrate_rig(of_rates(cameras, RATES, START_S + late_s, START_S), Monitor())
    same = calibrate_rig(of_rates(cameras, np.full(3, 24.0), np.zeros(3), np.zeros(3)), Monitor())
    found = [value / 24 for value, _ in mixed.calibration.delays.values()]
    np.testing.assert_allclose(found, late_s[1:], atol=3e-4)
    assert mixed.verdict.light == "green"
    assert error_m(cameras, mixed.rig.cameras) < 1.2 * error_m(cameras, same.rig.cameras) + 2e-5


def test_two_views_of_the_same_footage_and_cameras_that_are_not_determined_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    bars = of_rates(benchmark_cameras(), np.full(3, 24.0), np.zeros(3), np.zeros(3))
    noise_px = np.random.default_rng(0).normal(0, 0.05, bars.xy_px[:, 0].shape)
    turned = np.array(bars.xy_px)
    turned[:, 2] = turned[:, 0, ::-1] + noise_px  # encoded anew, with the ends in the other order
    with pytest.raises(InputError, match="^Views L and R show the same footage of the bar; give each view the images of its own camera"):
        calibrate_rig(replace(bars, xy_px=turned), Monitor())
    held = observed_boards(waved_board(benchmark_cameras()[:2], CHESSBOARD.corners_m, 60, np.random.default_rng(2), delay_images=[0.0] * 2))
    same = np.array(held.xy_px)
    same[:, 1] = same[:, 0]
    same[:, 1, 3] = np.nan  # a corner that one view never shows
    with pytest.raises(InputError, match="show the same footage of the board"):
        calibrate_rig(replace(held, xy_px=same), Monitor())

    def fails(*args: object) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(calibrate, "calibrate_bar", fails)
    with pytest.raises(InputError, match="^The image points do not determine the cameras; check that no camera was moved"):
        calibrate_rig(bars, Monitor())


@pytest.mark.slow
def test_fisheye_cameras_at_three_rates() -> None:
    cameras = fisheye_cameras(np.random.default_rng(5))
    late_s = np.array([0.0, 0.011, -0.017])
    done = calibrate_rig(of_rates(cameras, RATES, START_S + late_s, START_S), Monitor(), lens=Lens.FISHEYE)
    found = [value / 24 for value, _ in done.calibration.delays.values()]
    np.testing.assert_allclose(found, late_s[1:], atol=3e-4)
    assert all(c.fisheye for c in done.rig.cameras) and error_m(cameras, done.rig.cameras) < 3e-4


@pytest.mark.slow
def test_a_waved_board_at_two_rates() -> None:
    cameras = benchmark_cameras()[:2]
    found = []
    for c, (rate, start) in enumerate(((24.0, 0.0), (60.0, 0.31))):
        paced = {"delay_images": [start * rate] * 2, "pace": 0.3 * 30 / rate}
        held = waved_board(cameras, CHESSBOARD.corners_m, int(10 * rate), np.random.default_rng(2), **paced)
        shown = np.isfinite(held.xy_px[:, c, :, 0]).all(axis=1)
        found.append({int(n): held.xy_px[n, c] for n in np.flatnonzero(shown)})
    clocks = Clocks(start_s=np.array([0.0, 0.31]), interval_s=1 / np.array([24.0, 60.0]))
    together = corners_at_common_instants(clocks, found, CHESSBOARD.symmetries)
    frames = sorted(set(together[0]) & set(together[1]))
    xy = np.stack([[of_view[n] for of_view in together] for n in frames])
    boards = observed_boards(held)
    made = BoardObservations(names=boards.names, size_px=boards.size_px, xy_px=xy, frames=np.array(frames), board=CHESSBOARD)
    done = calibrate_rig(made, Monitor())
    assert len(frames) > 80 and done.verdict.light == "green" and error_m(cameras, done.rig.cameras) < 1e-3


def test_a_board_that_looks_the_same_from_both_ends_keeps_its_order() -> None:
    corners = np.stack(np.meshgrid(np.arange(4.0), np.arange(2.0)), axis=-1).reshape(-1, 2) * 10
    symmetries = np.stack([np.arange(8), np.arange(8)[::-1]])
    found = [{n: (corners + n)[symmetries[flip[n]]] for n in range(12)} for flip in ([0, 1] * 6, [1, 1, 0] * 4)]
    first, second = corners_at_common_instants(begun_together(np.array([30.0, 30.0])), found, symmetries)
    for n in range(4, 8):
        np.testing.assert_allclose(first[n], corners + n, atol=1e-9)
        np.testing.assert_allclose(second[n], (corners + n)[::-1], atol=1e-9)


@pytest.mark.slow
def test_the_command_takes_the_rate_of_each_view(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """L takes every second image of the others."""
    cameras = benchmark_cameras()
    waved = waved_bar(cameras, 40, np.random.default_rng(2), BarNoise(sigma_px=0.0, gross=0.0, missing=0.0), pace=0.6)
    write_bar_folder(tmp_path / "bar", waved, BarPictures(radius_m=0.015))
    for n in range(1, 40, 2):
        (tmp_path / "bar" / "L" / f"{n:04d}.png").unlink()
    for n in range(1, 20):
        (tmp_path / "bar" / "L" / f"{2 * n:04d}.png").rename(tmp_path / "bar" / "L" / f"{n:04d}.png")
    command = ["calibrate", str(tmp_path / "bar"), "--bar-length", "0.5", "--out", str(tmp_path / "rig.toml")]
    assert main([*command, "--rates", "L=15,C=30,R=30"]) == 0
    rig = read_rig(tmp_path / "rig.toml")
    assert rig.metadata["positions"] > 12 and error_m(cameras, [rig[c.name] for c in cameras]) < 2e-3
    for arguments, message in (
        (["--rates", "30"], "--rates is 30; give the images per second of each view"),
        (["--rates", "L=15,C=30,R=30", "--synchronise", "30"], "not with both"),
        (["--rates", "L=15,C=30"], "lacks the view R"),
        (["--synchronise", "thirty"], "“thirty” is no frame rate"),
        (["--synchronise", "L=15,C=30,R=30"], "there is no sound of"),
        ([], "different numbers of frames"),
    ):
        assert main([*command, *arguments]) == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("L=24,C=x", "gives no images"),
        ("=24", "gives no images"),
        ("L=24,C=30", "lacks the view R"),
        ("L=1,C=2,R=3,X=4", "names the view X"),
        ("L=0,C=2,R=3", "gives no images"),
        ("L=nan,C=2,R=3", "gives no images"),
    ],
)
def test_what_are_no_rates_is_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        rates_of(text, ("L", "C", "R"))
    assert rates_of("L = 24, C=29.97,R=60", ("L", "C", "R")).tolist() == [24.0, 29.97, 60.0]


def test_films_without_a_common_instant_are_refused() -> None:
    late = Clocks(start_s=np.array([0.0, 0.0, 20.0]), interval_s=1 / RATES)
    with pytest.raises(InputError, match="film of view R has no instant in common"):
        late.check_overlap(("L", "C", "R"), (240, 300, 600))
    xy = filmed(benchmark_cameras(), RATES, START_S, 1, 0.0)
    with pytest.raises(InputError, match="No instant is common"):
        at_common_instants(late, [np.arange(len(x)) for x in xy], [xy[0], np.full_like(xy[1], np.nan), xy[2]])
