"""The verdict on a calibration, in sentences: what it will do, and the one thing to do better. Made from the predicted error in space."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .quality import Quality
from .self_calibration import Calibration

GOOD_PART, FAIR_PART = 5e-4, 2e-3  # of the mean distance from the cameras: 1 mm and 4 mm at 2 m
USELESS_PART = 8e-3
FLAT_SCATTER, GOOD_SCATTER = 0.004, 0.05
GOOD_POSITIONS, MIN_POSITIONS = 100, 10
GOOD_COVERAGE, GOOD_DEPTH = 0.45, 1.15
MIRROR = 4.0
MIN_FITTING = 0.4


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """`light` is green, yellow or red; `sentence` says what to expect, `advice` what to do better."""

    light: str
    sentence: str
    advice: str


def positions_used(calibration: Calibration) -> int:
    """Number of positions with both ends in the adjustment."""
    return int((calibration.used.sum(axis=1) >= 2).all(axis=1).sum())


def refuse_if_useless(calibration: Calibration) -> None:
    """Raise InputError if the adjustment itself failed: too little fits.

    Raises:
        InputError: too few positions fit one rig, or a camera has none.
    """
    seen, used = calibration.observations.seen, calibration.used
    for c, name in enumerate(calibration.observations.names):
        if used[:, c].sum() < 2 * MIN_POSITIONS:
            raise InputError(
                f"What camera {name} saw of the bar does not agree with the other cameras (only {int(used[:, c].sum())} of "
                f"{int(seen[:, c].sum())} image points fit); check that its sequence starts at the same instant and shows the same bar."
            )
    fits = used.sum() / max(seen.sum(), 1)
    if fits < MIN_FITTING or positions_used(calibration) < MIN_POSITIONS:
        raise InputError(
            f"Only {positions_used(calibration)} bar positions fit one rig ({100 * fits:.0f} % of the image points); check that the "
            "sequences start at the same instant, and that nothing but the bar's two targets is bright."
        )


def refuse_if_undetermined(calibration: Calibration, quality: Quality) -> None:
    """Raise InputError if the data cannot determine the rig, with the motion that is missing.

    Raises:
        InputError: the bar's directions lie in a plane, the predicted error is useless, or a mirrored rig fits as well.
    """
    if quality.scatter[0] < FLAT_SCATTER:
        raise InputError(
            f"The bar always kept {_kept(calibration, quality)} (smallest direction scatter {quality.scatter[0]:.3f}, "
            f"{GOOD_SCATTER} is good), so the focal lengths are not determined; {_tilt(calibration, quality)}."
        )
    if not quality.predicted.rms_m <= USELESS_PART * _distance(calibration):
        raise InputError(
            f"These bar positions leave an error of about {1e3 * quality.predicted.rms_m:.0f} mm in space, which is useless; "
            f"{advice(calibration, quality)}."
        )
    if quality.mirror < MIRROR:
        raise InputError(
            "A rig seen in a mirror, with near and far exchanged, fits the images as well; "
            "wave the bar nearer to the cameras and further away as well."
        )


def judge(calibration: Calibration, quality: Quality) -> Verdict:
    """The verdict in one sentence, from the predicted error over the volume."""
    error, distance = quality.predicted.rms_m, _distance(calibration)
    light = "green" if error <= GOOD_PART * distance else "yellow" if error <= FAIR_PART * distance else "red"
    word = {"green": "Good", "yellow": "Usable", "red": "Poor"}[light]
    size = " × ".join(f"{s:.1f}" for s in np.ptp(quality.box_m, axis=0))
    tested = quality.held_out
    sentence = (
        f"{word}: the cameras place points within {_mm(error)} (RMS) in the {size} m in which the bar was waved, {distance:.1f} m away; "
        f"the length of bars left out is right within {_mm(tested.rms_m)}."
    )
    if not calibration.converged:
        light, sentence = "red", f"The adjustment did not settle, so its figures may be too good. {sentence}"
    return Verdict(light=light, sentence=sentence, advice=advice(calibration, quality))


def advice(calibration: Calibration, quality: Quality) -> str:
    """The one thing that would improve the calibration most."""
    names, used = calibration.observations.names, positions_used(calibration)
    worst = int(np.argmin(quality.covered))
    wants = [
        (quality.scatter[0] / GOOD_SCATTER, _tilt(calibration, quality)),
        (used / GOOD_POSITIONS, f"wave the bar longer: {used} positions were used, {GOOD_POSITIONS} or more are good"),
        (
            (quality.depth_ratio.min() - 1) / (GOOD_DEPTH - 1),
            "wave the bar nearer to the cameras and further away as well",
        ),
        (
            quality.covered[worst] / GOOD_COVERAGE,
            f"wave the bar {_empty_side(quality.coverage[worst])} of camera {names[worst]}'s image as well",
        ),
    ]
    urgency, text = min(wants, key=lambda want: want[0])
    return text if urgency < 1 else "nothing needs to be better; more positions would lower the error further"


def _mm(metres: float) -> str:
    mm = 1e3 * metres
    return f"{mm:.2f} mm" if mm < 1 else f"{mm:.1f} mm" if mm < 10 else f"{mm:.0f} mm"


def _distance(calibration: Calibration) -> float:
    network = calibration.network
    centres = -np.einsum("cji,cj->ci", network.R, network.t)
    middle = np.median(network.middle[calibration.used.any(axis=(1, 2))], axis=0)
    return float(np.linalg.norm(centres - middle, axis=1).mean())


def _missing(calibration: Calibration, quality: Quality) -> str:
    """Along which direction the bar points least, as seen by the cameras: depth, upright or crosswise."""
    axes = calibration.network.R.mean(axis=0)  # rows: right, down, forward
    return ("crosswise", "upright", "depth")[int(np.argmax(np.abs(axes @ quality.missing_direction)))]


def _kept(calibration: Calibration, quality: Quality) -> str:
    return {
        "depth": "parallel to the image planes",
        "upright": "level",
        "crosswise": "in the plane of the viewing direction and the vertical",
    }[_missing(calibration, quality)]


def _tilt(calibration: Calibration, quality: Quality) -> str:
    return {
        "depth": "tilt the bar towards the cameras as well",
        "upright": "hold the bar upright as well",
        "crosswise": "hold the bar crosswise as well",
    }[_missing(calibration, quality)]


def _empty_side(cells: np.ndarray) -> str:
    """The part of an image with fewest points."""
    h, w = cells.shape
    halves = {
        "in the upper half": cells[: h // 2],
        "in the lower half": cells[h // 2 :],
        "in the left half": cells[:, : w // 2],
        "in the right half": cells[:, w // 2 :],
    }
    return min(halves, key=lambda name: float((halves[name] > 0).mean()))
