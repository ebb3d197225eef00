"""The verdict on a calibration, from the predicted error in space, with the one thing that would improve it most; and what is refused."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations

import numpy as np

from ..foundation.errors import InputError
from ..geometry.robust import masked_median
from .network import Observations
from .quality import Quality
from .self_calibration import Calibration

GOOD_PART = 5e-4  # of the mean distance from the cameras: 1 mm at 2 m
FAIR_PART = 2e-3  # of that distance: 4 mm at 2 m
USELESS_PART = 8e-3  # of that distance
FLAT_SCATTER = 0.004  # smallest eigenvalue of the bar's directions below which the focal lengths are not determined
GOOD_SCATTER = 0.05
GOOD_COVERAGE = 0.45  # of the cells of an image
GOOD_DEPTH = 1.15  # largest by smallest depth
MIRROR = 4.0  # times the sum of squares: a mirrored rig must fit worse than that
MIN_FITTING = 0.4  # of the image points
MOST_RATIO = 3.0  # of the errors of left-out lengths to their predicted sigma

WORDS: Mapping[str, Mapping[str, str]] = {
    "bar": {
        "where": "in which the bar was waved",
        "tested": "the length of bars left out",
        "more": "wave the bar for longer: {used} positions were used, {good} or more are good",
        "deeper": "wave the bar closer to the cameras and further away, too",
        "there": "wave the bar {side} of the image of camera {camera}, too",
        "other": "that nothing but the bar's two targets is bright",
        "depth": "always parallel to the image planes",
        "upright": "always level",
        "crosswise": "always in the plane of the viewing direction and the vertical",
        "tilt depth": "tilt the bar towards the cameras, too",
        "tilt upright": "hold the bar upright, too",
        "tilt crosswise": "hold the bar crosswise, too",
    },
    "board": {
        "where": "in which the board was held",
        "tested": "the diagonal of boards left out",
        "more": "hold the board in more positions: {used} were used, {good} or more are good",
        "deeper": "hold the board closer to the cameras and further away, too",
        "there": "hold the board {side} of the image of camera {camera}, too",
        "other": "that the board has the given numbers of squares",
        **dict.fromkeys(("depth", "upright", "crosswise"), "always parallel to itself"),
        **dict.fromkeys(("tilt depth", "tilt upright", "tilt crosswise"), "tilt the board by 20 to 45 degrees, in different directions"),
    },
}


SAME_FOOTAGE_PX = 0.5  # between the image points of two views: a copy that was encoded anew


class Light(StrEnum):
    """Quality of a calibration."""

    GREEN = "green"
    YELLOW = "yellow"
    RED = "red"


LIGHT_WORDS = {Light.GREEN: "Good", Light.YELLOW: "Usable", Light.RED: "Poor"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """`sentence` is the accuracy to expect, `advice` what would improve it most."""

    light: Light
    sentence: str
    advice: str


def positions_used(calibration: Calibration) -> int:
    """Number of positions with both ends in the adjustment."""
    return int(calibration.observations.measured(calibration.used).sum())


def refuse_same_footage(observations: Observations) -> None:
    """Check that no two cameras show the object at the same pixels.

    Raises:
        InputError: two do.
    """
    xy = observations.xy_px
    for i, j in combinations(range(len(observations.names)), 2):
        either = [np.linalg.norm(xy[:, i] - xy[:, j, ::way], axis=-1) for way in (1, -1)]  # the ends of a bar are in any order
        both = np.isfinite(either)
        apart = np.where(both.any(axis=2), masked_median(np.array(either), both), np.inf).min(axis=0)
        shared = apart[np.isfinite(apart)]
        if len(shared) >= observations.fewest_positions and np.median(shared) < SAME_FOOTAGE_PX:
            a, b = observations.names[i], observations.names[j]
            raise InputError(
                f"Views {a} and {b} show the same footage of the {observations.noun}; give each view the images of its own camera."
            )


def refuse_if_useless(calibration: Calibration) -> None:
    """Raise InputError if too few image points fit the adjustment.

    Raises:
        InputError: too few positions fit one rig, or a camera has none.
    """
    visible, used, noun = calibration.observations.visible, calibration.used, calibration.observations.noun
    for c, name in enumerate(calibration.observations.names):
        if calibration.observations.views(used)[:, c].sum() < calibration.observations.fewest_positions:
            raise InputError(
                f"The image points of camera {name} do not agree with the other cameras (only {int(used[:, c].sum())} of "
                f"{int(visible[:, c].sum())} fit); check that its sequence starts at the same instant and shows the same {noun}"
                f"{_or_moved(calibration)}."
            )
    fits = used.sum() / max(visible.sum(), 1)
    if fits < MIN_FITTING or positions_used(calibration) < calibration.observations.fewest_positions:
        raise InputError(
            f"Only {positions_used(calibration)} {noun} positions fit one rig ({100 * fits:.0f} % of the image points); "
            f"check that the sequences start at the same instant, and {_words(calibration)['other']}{_or_moved(calibration)}."
        )


def _or_moved(calibration: Calibration) -> str:
    """What else may be wrong where another object gives the poses of the cameras, too."""
    if calibration.other is None or calibration.other.lenses_only:
        return ""
    return (
        ", and that no camera was moved between the films of the bar and the board; if one was, let the board give the lenses only "
        "(--lenses-only)"
    )


def refuse_if_undetermined(calibration: Calibration, quality: Quality) -> None:
    """Raise InputError if the data do not determine the rig; the message names the missing motion.

    Raises:
        InputError: the directions lie in a plane, the predicted error is useless, or a mirrored rig fits as well.
    """
    noun = calibration.observations.noun
    if quality.scatter[0] < FLAT_SCATTER:
        raise InputError(
            f"The {noun} was {_words(calibration)[_missing(calibration, quality)]} (smallest direction scatter {quality.scatter[0]:.3f}, "
            f"{GOOD_SCATTER} is good), so the focal lengths are not determined; {_tilt(calibration, quality)}."
        )
    if not quality.predicted.rms_m <= USELESS_PART * _distance(calibration):
        raise InputError(
            f"With these {noun} positions the error would be about {1e3 * quality.predicted.rms_m:.0f} mm in space, which is useless; "
            f"{_ended(calibration.doubt or advice(calibration, quality))}"
        )
    if quality.mirror < MIRROR:
        raise InputError(f"A mirrored rig, with near and far swapped, fits the images as well; {_words(calibration)['deeper']}.")


def judge(calibration: Calibration, quality: Quality) -> Verdict:
    """The verdict, from the predicted error over the volume."""
    error, distance = quality.predicted.rms_m, _distance(calibration)
    light = Light.GREEN if error <= GOOD_PART * distance else Light.YELLOW if error <= FAIR_PART * distance else Light.RED
    size = " × ".join(f"{s:.1f}" for s in np.ptp(quality.box_m, axis=0))
    words, tested = _words(calibration), quality.held_out
    doubt = calibration.doubt or _contradiction(calibration, quality)
    if doubt and light is Light.GREEN:
        light = Light.YELLOW
    caution = ""
    if not calibration.converged:
        light, caution = Light.RED, "The adjustment did not converge, so its figures may be too good. "
    sentence = (
        f"{caution}{LIGHT_WORDS[light]}: the cameras place points within {_mm(error)} (RMS) in the {size} m {words['where']}, "
        f"{distance:.1f} m away; {words['tested']} is right within {_ended(_mm(tested.rms_m) + (', but ' + doubt if doubt else ''))}"
    )
    return Verdict(light=light, sentence=sentence, advice=advice(calibration, quality))


def advice(calibration: Calibration, quality: Quality) -> str:
    """The one thing that would improve the calibration most."""
    names, used = calibration.observations.names, positions_used(calibration)
    worst = int(np.argmin(quality.covered))
    good, words = calibration.observations.good_positions, _words(calibration)
    improvements = [
        (quality.scatter[0] / GOOD_SCATTER, _tilt(calibration, quality)),
        (used / good + _positions_of_other(calibration), words["more"].format(used=used, good=good)),
        ((quality.depth_ratio.min() - 1) / (GOOD_DEPTH - 1), words["deeper"]),
        (quality.covered[worst] / GOOD_COVERAGE, words["there"].format(side=_empty_side(quality.coverage[worst]), camera=names[worst])),
    ]
    urgency, text = min(improvements, key=lambda entry: entry[0])
    return text if urgency < 1 else "nothing needs to be improved; more positions would reduce the error further"


def _positions_of_other(calibration: Calibration) -> float:
    """The positions of another object that takes part, relative to a good number."""
    if calibration.other is None:
        return 0.0
    seen, observations = calibration.other.used, calibration.other.observations
    return float(observations.views(seen).any(axis=1).sum()) / observations.good_positions


def _ended(text: str) -> str:
    """The end of a sentence; a question has its mark."""
    return text if text.endswith("?") else f"{text}."


def _mm(metres: float) -> str:
    mm = 1e3 * metres
    return f"{mm:.2f} mm" if mm < 1 else f"{mm:.1f} mm" if mm < 10 else f"{mm:.0f} mm"


def _distance(calibration: Calibration) -> float:
    network = calibration.network
    centres = -np.einsum("cji,cj->ci", network.R, network.t)
    middle = np.median(network.points_m[calibration.used.any(axis=1)], axis=0)
    return float(np.linalg.norm(centres - middle, axis=1).mean())


def _missing(calibration: Calibration, quality: Quality) -> str:
    """The direction in which the bar points least, from the cameras: depth, upright or crosswise."""
    axes = calibration.network.R.mean(axis=0)  # rows: right, down, forward
    return ("crosswise", "upright", "depth")[int(np.argmax(np.abs(axes @ quality.missing_direction)))]


def _tilt(calibration: Calibration, quality: Quality) -> str:
    return _words(calibration)[f"tilt {_missing(calibration, quality)}"]


def _words(calibration: Calibration) -> Mapping[str, str]:
    return WORDS[calibration.observations.noun]


def _contradiction(calibration: Calibration, quality: Quality) -> str:
    """What the lengths that were left out contradict, or nothing."""
    tested, expected = quality.held_out, quality.predicted.length_rms_m
    if not len(tested.residual_m):
        return "no length could be tested"
    ratio = float(np.sqrt(np.median((tested.residual_m / np.hypot(tested.sigma_per_px_m * calibration.sigma0_px, expected)) ** 2)))
    return (
        ""
        if ratio < MOST_RATIO
        else f"that is {ratio:.0f} times as much as the images allow, so the {calibration.observations.noun} is not as given"
    )


def _empty_side(cells: np.ndarray) -> str:
    """The half of an image with the fewest points."""
    h, w = cells.shape
    halves = {
        "in the upper half": cells[: h // 2],
        "in the lower half": cells[h // 2 :],
        "in the left half": cells[:, : w // 2],
        "in the right half": cells[:, w // 2 :],
    }
    return min(halves, key=lambda name: float((halves[name] > 0).mean()))
