"""Initial values of cameras with fisheye lenses from a waved bar.

For each guess of the focal length, the image points are those of an equidistant lens, θ = r / f, and are mapped to a central projection:

    x' = c + f tan(θ) (x − c) / r ,   θ < NARROW                                                 (1)

The search for cameras without such lenses (`reference_bar`) finds the poses from these points; they are adjusted with the fisheye lens and
the original points, and the guess with the smallest robust sum of squares wins.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..foundation.errors import InputError
from .bars import BarObservations, labelled_ends, with_bars
from .bundle import Adjusted, Block, LevenbergMarquardt, adjust
from .delays import first_delays, misfit, moving_points
from .network import BarNetwork
from .reference_bar import COARSE_CAUCHY_PX, GATE, ROUGH_FOCALS, WIDE_GATE, initial_network, lens_prior

FOCAL_PARTS = np.geomspace(0.22, 0.8, 7)  # focal lengths in widths
NARROW = np.radians(65)  # from the axis: points further out are not used for the start
POSITIONS = 120
WIDE = 4  # times WIDE_GATE, the first tolerance


def fisheye_network(observations: BarObservations, focal_px: float | None = None) -> Adjusted[BarNetwork]:
    """The best start, adjusted on a part of the positions.

    Raises:
        InputError: the cameras share too few bars.
    """
    best: Adjusted[BarNetwork] | None = None
    problem: InputError | None = None
    for f in _focal_lengths(observations, focal_px):
        try:
            flat = initial_network(_flat(observations, float(f)), float(f))
        except InputError as error:
            problem = error
            continue
        trial = _trial(observations, flat.network, float(f))
        if best is None or trial.cost < best.cost:
            best = trial
    if best is None:
        assert problem is not None
        raise problem
    return best


def fisheye_delays(observations: BarObservations, focal_px: float | None = None) -> np.ndarray:
    """How late each camera is (C,): of the delays found with each guess of the focal length, those at which a guess fits best."""
    size, labelled = observations.size_px, observations.labelled
    moving = [moving_points(observations.frames, _flat(observations, float(f)).xy_px) for f in _focal_lengths(observations, focal_px)]
    found = np.unique([first_delays(guess, size, labelled) for guess in moving], axis=0)
    return min(found, key=lambda late: min(misfit(guess, size, late, labelled) for guess in moving))


def _focal_lengths(observations: BarObservations, focal_px: float | None) -> np.ndarray:
    return focal_px * ROUGH_FOCALS if focal_px is not None else FOCAL_PARTS * float(np.median(observations.size_px[:, 0]))


def _flat(observations: BarObservations, focal_px: float) -> BarObservations:
    """The observations as those of a central projection, without points far from the axis.  (1)"""
    middle = (observations.size_px[:, None] - 1) / 2  # (C, 1, 2)
    from_middle = observations.xy_px - middle
    theta = np.linalg.norm(from_middle, axis=-1, keepdims=True) / focal_px
    with np.errstate(invalid="ignore"):
        stretch = np.where(theta < NARROW, np.tan(theta) / np.maximum(theta, 1e-9), np.nan)
    return observations.changed(middle + from_middle * stretch, labelled=observations.labelled)


def _trial(observations: BarObservations, flat: BarNetwork, focal_px: float) -> Adjusted[BarNetwork]:
    """A short robust adjustment of fisheye lenses from the poses of a network of other cameras."""
    interior = np.zeros_like(flat.interior)
    interior[:, 0], interior[:, 1:3] = focal_px, (observations.size_px - 1) / 2
    network = replace(flat, interior=interior, fisheye=np.ones(len(interior), dtype=bool))
    return adjusted_start(network, observations, ("f", "k1"), (WIDE * WIDE_GATE, WIDE_GATE, GATE))


def adjusted_start(
    network: BarNetwork, observations: BarObservations, names: Sequence[str], gates: Sequence[float], block: Block | None = None
) -> Adjusted[BarNetwork]:
    """A short robust adjustment on a part of the positions, with these unknowns of the lenses, and tolerances that become narrower."""
    some = observations.part(np.unique(np.linspace(0, len(observations.xy_px) - 1, POSITIONS).astype(int)))
    prior = replace(lens_prior(some.size_px, network.interior[:, 0], network.fisheye).only(*names), block=block)
    for gate in gates:
        tolerance = gate * COARSE_CAUCHY_PX
        part = some if some.labelled else labelled_ends(network, some, tolerance)
        network, used = with_bars(network, part, tolerance)
        done = adjust(
            network, part.xy_px, used, prior, cauchy_px=COARSE_CAUCHY_PX, unit_px=0.3,
            iteration=LevenbergMarquardt(max_iterations=8, tolerance=1e-2),
        )  # fmt: skip
        network = done.network
    left_out = int(part.visible.sum() - used.sum())
    return replace(done, cost=done.cost + left_out * COARSE_CAUCHY_PX**2 * float(np.log1p(GATE**2)))
