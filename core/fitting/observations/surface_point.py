"""Measured surface points attract the body's surface (D'Apuzzo et al. 1999, Eqs. 14, 15).

    paper:  (F(X) − T) · l/l₀ = ε ,                     σ_F = |∇F|_surface σ_n                      (15)
    metric: (√(−½ ln F) − √(½ ln 2)) · l/l₀ = ε ,       σ_D = |∇D| σ_n                              (1)

F is the sum over the balls of the point's part and of the parts that it meets. (1) grows linearly with the distance, near and far, where
(15) saturates. |∇D| is taken at the state at which the points were `scaled` and then held: it is a weight (Eq. 12). But F and D are
relative to the radii: a point that is 1 mm off shows less of it on a thicker limb, so a limb could explain its points' noise by growing.
The mean radius l of the balls at the point, over its value l₀ at the held state, gives both the unit of a length (with a held weight alone
radii run away). Inside, where −½ ln F falls below `LINEAR`, the root is continued by its tangent.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...body.metaballs import THRESHOLD, VISIBLE
from ..part_field import Part
from ..state import CROSS, BodyState

SMALLEST = 1e-250
LINEAR = 0.03
SCALE_RANGE = (0.4, 2.5)  # bounds of |∇D| in units of 1 / (mean l of the part)


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfacePoints:
    """N points, each the surface of one bone's part."""

    xyz_m: np.ndarray  # (N, 3) world
    bone: np.ndarray  # (N,) index of the bone
    sigma_m: np.ndarray  # (N,) of one residual, along the normal
    crowding: np.ndarray | float = 1.0  # (N,) how many times less a point tells than if its error were its own
    form: str = "metric"  # or "paper"
    scale: np.ndarray | None = None  # (N,) |∇D| or |∇F| at the state of `scaled`, 1/m
    shares: np.ndarray | None = None  # (N, M) parts of F that come from each ball, at the same state
    log_radius: np.ndarray | None = None  # (N,) ln l₀
    robust: bool = True

    def scaled(self, state: BodyState) -> "SurfacePoints":
        """The same points with weights for this state.  (12)"""
        scale, shares = np.ones(len(self.bone)), np.zeros((len(self.bone), len(state.balls.weight)))
        for b, rows in self._parts():
            part = Part.of(state, b)
            shares[rows[:, None], part.columns] = part.shares(state, self.xyz_m[rows])
            typical = 1 / part.balls.radii_m[:, CROSS].mean()
            if self.form == "paper":
                scale[rows] = 4 * THRESHOLD * VISIBLE * typical
                continue
            F, gradient = part.gradient(state, self.xyz_m[rows])
            slope = np.linalg.norm(gradient, axis=1) * np.abs(_distance(F)[1])
            scale[rows] = np.clip(slope, SCALE_RANGE[0] * typical, SCALE_RANGE[1] * typical)
        return replace(self, scale=scale, shares=shares, log_radius=shares @ _log_radii(state))

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        value = np.empty(len(self.bone))
        for b, rows in self._parts():
            value[rows] = self._value(Part.of(state, b).field(state, self.xyz_m[rows]))[0]
        return value / self._unit(state)

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(N, D + S) or (N, D)"""
        J = np.zeros((len(self.bone), state.n_motion + (state.n_shape if shape else 0)))
        for b, rows in self._parts():
            F, dF = Part.of(state, b).jacobian(state, self.xyz_m[rows], shape)
            value, slope = self._value(F)
            J[rows] = slope[:, None] * dF
            if shape and self.shares is not None:
                grows = value[:, None] * np.repeat(self.shares[rows] / 2, 2, axis=1)
                J[rows, state.n_motion + len(state.lengths_m) :] += grows
        return J / self._unit(state)[:, None]

    def _parts(self) -> list[tuple[int, np.ndarray]]:
        return [(int(b), np.flatnonzero(self.bone == b)) for b in np.unique(self.bone)]

    def _unit(self, state: BodyState) -> np.ndarray:
        if self.scale is None or self.shares is None:
            raise ValueError("surface points need `scaled(state)` first")
        return self.sigma_m * self.scale * np.exp(self.log_radius - self.shares @ _log_radii(state))

    def _value(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (THRESHOLD - F, np.full_like(F, -1.0)) if self.form == "paper" else _distance(F)


def _log_radii(state: BodyState) -> np.ndarray:
    """ln of the mean cross radius (M,)."""
    return np.log(state.balls.radii_m[:, CROSS]).mean(axis=1)


def _distance(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """D and dD/dF.  (1)"""
    F = np.maximum(F, SMALLEST)
    u = -0.5 * np.log(F)
    root = np.sqrt(np.maximum(u, LINEAR))
    return root + np.minimum(u - LINEAR, 0.0) / (2 * np.sqrt(LINEAR)) - VISIBLE, -0.25 / (F * root)
