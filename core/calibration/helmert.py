"""Another object that the same cameras filmed, as a part of their adjustment (Helmert's method of partial networks; Wolf 1978).

Its positions are eliminated by themselves, and the reduced normal equations that remain for the cameras are added to those of the bar,
weighted by the sigmas of the image points (`bundle`, (5)). Formed again at the adjusted cameras, they make one adjustment of all image
points. If the object was filmed at other times or places, it gives the lenses only.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.camera import INTERIOR
from .bundle import AnyNetwork, Block, Unknowns, inverse_factors, normal_equations, reduce_to_cameras, residuals, weights_of
from .network import Network, Observations
from .world_frame import WorldFrame

POSE_STEPS = 8  # of positions with the cameras fixed


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Partial:
    """The adjusted positions of the other object, the image points used, and what they contribute to the cameras."""

    network: Network
    observations: Observations
    used: np.ndarray  # (N, C, K)
    sigma_px: float
    lenses_only: bool
    block: Block

    def at(self, cameras: Network) -> "Partial":
        """The same formed at the cameras of another network, with the positions adjusted to them."""
        there = replace(self.network, interior=cameras.interior, R=cameras.R, t=cameras.t)
        if self.lenses_only:
            there = replace(self.network, interior=cameras.interior)
        there = positioned(there, self.observations.xy_px, self.used, None)
        return partial_network(there, self.observations, self.used, self.sigma_px, self.lenses_only)

    def moved(self, frame: WorldFrame) -> "Partial":
        """The same in another frame of the world; the equations do not change, as the unknowns of the cameras are in their own frames."""
        R = self.network.R @ frame.R.T
        t = self.network.t - R @ frame.shift_m
        network = replace(self.network.transformed(frame.R, frame.shift_m), R=R, t=t)
        return replace(self, network=network, block=replace(self.block, R=R, t=t))


def partial_network(network: Network, observations: Observations, used: np.ndarray, sigma_px: float, lenses_only: bool) -> Partial:
    """The contribution of adjusted positions to their cameras."""
    C, every = len(network.R), len(INTERIOR) + 6
    none = Unknowns(free=np.ones(len(INTERIOR), dtype=bool), expected=network.interior, sigma=np.full(network.interior.shape, np.inf))
    used = used & np.isfinite(observations.xy_px).all(axis=-1)
    normals = normal_equations(network, residuals(network, observations.xy_px), used.astype(np.float64), none, 1.0)
    S, rhs, _ = reduce_to_cameras(normals)
    if lenses_only:
        pose = np.tile(np.arange(every) >= len(INTERIOR), C)
        S[pose], S[:, pose], rhs[pose] = 0.0, 0.0, 0.0
    block = Block(interior=network.interior, R=network.R, t=network.t, S=S, rhs=rhs, sigma_px=sigma_px)
    return Partial(network=network, observations=observations, used=used, sigma_px=sigma_px, lenses_only=lenses_only, block=block)


def positioned(network: AnyNetwork, xy_px: np.ndarray, used: np.ndarray, cauchy_px: float | None) -> AnyNetwork:
    """The positions adjusted with the cameras fixed (Gauss–Newton), robustly if a width is given."""
    none = Unknowns(free=np.zeros(len(INTERIOR), dtype=bool), expected=network.interior, sigma=np.ones_like(network.interior))
    for _ in range(POSE_STEPS):
        v = residuals(network, xy_px)
        weight, _ = weights_of(v, cauchy_px, used)
        normals = normal_equations(network, v, weight, none, 1.0)
        inverse = inverse_factors(normals.U)
        network = network.stepped(np.einsum("jkn,jn->kn", inverse, np.einsum("jkn,kn->jn", inverse, normals.g_b)))
    return network
