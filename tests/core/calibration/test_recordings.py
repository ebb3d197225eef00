"""Recordings of real cameras beside the repository: what was not used for the calibration says how good it is."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.calibration.bars import BarObservations
from tricap.core.calibration.calibrate import CalibratedRig, calibrate_rig
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.intersection import forward_intersection

SAME_INSTANT_S = 0.02
OUTER_M, FIRST_M, SECOND_M = 0.39, 0.13, 0.26  # between the lamps of ewand's wand


def lamps_of(folder: Path) -> tuple[np.ndarray, tuple[tuple[int, int], ...]]:
    """ewand's recording: pixels (T, 4, 3, 2) of three lamps in a line at the instants of camera 0, and the images' sizes."""
    times, pixels = [], []
    for c in range(4):
        rows = np.genfromtxt(folder / f"frame_{c}.csv", delimiter=";")
        times.append(rows[:, 0] * 1e-9)
        pixels.append(np.where(rows[:, 1:] < 0, np.nan, rows[:, 1:]).reshape(-1, 3, 2))
    xy = np.full((len(times[0]), 4, 3, 2), np.nan)
    for c in range(4):
        nearest = np.abs(times[c][:, None] - times[0]).argmin(axis=0)
        close = np.abs(times[c][nearest] - times[0]) < SAME_INSTANT_S
        xy[close, c] = pixels[c][nearest[close]]
    return xy, ((1280, 1024),) * 4


@pytest.fixture(scope="module")
def wand(shared_takes: Path) -> tuple[np.ndarray, CalibratedRig]:
    """The lamps, and the cameras calibrated from the outer two of them."""
    xy, sizes = lamps_of(shared_takes / "wand_4cam_ewand")
    bar = BarObservations(
        names=tuple("0123"),
        size_px=np.array(sizes, dtype=float),
        xy_px=xy[:, :, [0, 2]],
        length_m=OUTER_M,
        frames=np.arange(len(xy)),
        labelled=True,
    )
    return xy, calibrate_rig(bar, Monitor())


def test_a_wand_of_lamps_from_its_outer_two(wand: tuple[np.ndarray, CalibratedRig]) -> None:
    """Its own authors' adjustment, with the lenses known, had residuals of 1.2 px RMS."""
    done = wand[1]
    assert done.verdict.light in ("green", "yellow") and done.calibration.sigma0_px < 0.7
    assert done.quality.held_out.rms_m < 2e-3


def test_the_lamp_in_between_took_no_part_and_is_where_it_must_be(wand: tuple[np.ndarray, CalibratedRig]) -> None:
    xy, done = wand
    shown = np.where(done.calibration.used.any(axis=2)[:, :, None, None], xy, np.nan)
    flat = np.moveaxis(shown, 2, 1).reshape(-1, 4, 2)
    found = forward_intersection(done.rig.cameras, flat, np.broadcast_to(np.eye(2), (*flat.shape, 2)))
    lamps = found.xyz_m.reshape(-1, 3, 3)
    for a, b, length in ((0, 1, FIRST_M), (1, 2, SECOND_M)):
        measured = np.linalg.norm(lamps[:, a] - lamps[:, b], axis=1)
        assert np.isfinite(measured).sum() > 300 and np.nanmedian(measured) == pytest.approx(length, abs=1.5e-3)
