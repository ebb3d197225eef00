"""The lenses alone, each from its camera's own images of a board: the cameras may have been moved, or have filmed one after another."""

from dataclasses import dataclass, replace

import numpy as np

from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ..helmert import Partial, partial_network
from ..network import BoardNetwork
from ..reference_bar import lens_prior
from ..self_calibration import coarse_adjustment, without_outliers
from .board import Lens
from .calibration import refined, with_boards
from .observations import BoardObservations
from .start import single_camera, with_lenses


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _OwnImages:
    """The adjusted positions of one camera's own images."""

    network: BoardNetwork
    observations: BoardObservations
    used: np.ndarray
    square_px2: float  # sum of the squares of the residuals
    redundancy: float


def calibrate_lenses(observations: BoardObservations, monitor: Monitor, focal_px: float | None, lens: Lens) -> Partial:
    """What the images of each camera by itself contribute to its lens.

    Raises:
        InputError: a camera shows too few positions of the board.
    """
    observations, lenses = with_lenses(observations, focal_px, lens)
    every = []
    for c, name in enumerate(observations.names):
        monitor.step("lenses", c, len(observations.names))
        one = observations.of_camera(c)
        if len(one.frames) < one.fewest_positions:
            raise InputError(
                f"Camera {name} shows only {len(one.frames)} positions of the board; at least {one.fewest_positions} are needed, and "
                f"{one.good_positions} are good: hold the board tilted in different directions, near and far, also in the corners."
            )
        every.append(_adjusted(one, single_camera(one, lenses.interior[c], bool(lenses.fisheye[c])), monitor))
    monitor.step("lenses", len(every), len(every))
    return _joined(observations, every)


def _adjusted(one: BoardObservations, network: BoardNetwork, monitor: Monitor) -> _OwnImages:
    """Least squares of one camera with data snooping."""
    network, sigma = refined(network, one, monitor)
    prior = lens_prior(one.size_px, network.interior[:, 0], network.fisheye)
    network, used = with_boards(network, one, max(10 * sigma, 1.0))
    first = coarse_adjustment(network, one.xy_px, used, prior, sigma)

    def again(boards: BoardNetwork, tolerance_px: float) -> tuple[BoardNetwork, np.ndarray]:
        return with_boards(boards, one, tolerance_px)

    state, keep, _, redundancy = without_outliers(first, one, used, prior, again)
    square = float(np.sum(state.residual_px[keep] ** 2))
    return _OwnImages(network=state.network, observations=one, used=keep, square_px2=square, redundancy=redundancy)


def _joined(observations: BoardObservations, every: list[_OwnImages]) -> Partial:
    """All cameras, each with its own positions."""
    counts = [len(one.used) for one in every]
    of = np.repeat(np.arange(len(every)), counts)
    xy = np.full((len(of), *observations.xy_px.shape[1:]), np.nan)
    used = np.zeros(xy.shape[:3], dtype=bool)
    for c, one in enumerate(every):
        xy[of == c, c], used[of == c, c] = one.observations.xy_px[:, 0], one.used[:, 0]
    networks = [one.network for one in every]
    network = replace(
        networks[0],
        interior=np.concatenate([n.interior for n in networks]),
        R=np.concatenate([n.R for n in networks]),
        t=np.concatenate([n.t for n in networks]),
        fisheye=np.concatenate([n.curved for n in networks]),
        R_board=np.concatenate([n.R_board for n in networks]),
        t_board=np.concatenate([n.t_board for n in networks]),
    )
    sigma = float(np.sqrt(sum(one.square_px2 for one in every) / max(sum(one.redundancy for one in every), 1.0)))
    frames = np.concatenate([one.observations.frames for one in every])
    return partial_network(network, observations.changed(xy, frames), used, max(sigma, 1e-6), lenses_only=True)
