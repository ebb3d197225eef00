"""The model of the lenses of cameras that film a bar: Brown's, or a fisheye lens, chosen by the user or by what fits the images better."""

import numpy as np

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from .bars import BarObservations
from .boards.board import Lens
from .boards.start import CLEAR, WIDE_ANGLE
from .self_calibration import GROSS, Calibration, calibrate


def calibrate_bar(observations: BarObservations, monitor: Monitor, focal_px: float | None, lens: Lens) -> Calibration:
    """Calibrate from a bar. AUTO: fisheye lenses, of all cameras, if they clearly fit better.

    They are tried where a camera is wide-angle, or no rig is found.

    Raises:
        InputError: the cameras share too few bars.
    """
    if lens is not Lens.AUTO:
        return calibrate(observations, monitor, focal_px, lens is Lens.FISHEYE)
    try:
        brown = calibrate(observations, monitor, focal_px)
    except InputError as refused:
        try:
            return calibrate(observations, monitor, focal_px, fisheye=True)
        except InputError:
            raise refused from None
    if not (brown.network.interior[:, 0] < WIDE_ANGLE * observations.size_px[:, 0]).any():
        return brown
    try:
        fisheye = calibrate(observations, monitor, focal_px, fisheye=True)
    except InputError:
        return brown
    sigma = min(brown.sigma0_px, fisheye.sigma0_px)
    better = observations.visible.sum() * np.log(_cost(brown, sigma) / _cost(fisheye, sigma))
    return fisheye if better > CLEAR else brown


def _cost(calibration: Calibration, sigma_px: float) -> float:
    """The squares of the residuals of all visible points, those of wrong ones as large as the largest right one."""
    square = np.sum(calibration.residual_px**2, axis=-1)[calibration.observations.visible]
    limit = (GROSS * sigma_px) ** 2
    return float(np.where(np.isfinite(square), np.minimum(square, limit), limit).sum())
