"""Measured surface points attract the body's surface (D'Apuzzo et al. 1999, Eqs. 14, 15).

    paper:  (F(X) − T) · l/l₀ = ε ,                     σ_F = |∇F|_surface σ_n                      (15)
    metric: (√(−½ ln F) − √(½ ln 2)) · l/l₀ = ε ,       σ_D = |∇D| σ_n                              (1)

F is the sum over the balls of the point's part and of the parts that it meets. (1) grows linearly with the distance, near and far, where
(15) saturates. |∇D| is taken at the state at which the points were `scaled` and then held: it is a weight (Eq. 12). But F and D are
relative to the radii: a point that is 1 mm off shows less of it on a thicker limb, so a limb could explain its points' noise by growing.
The mean radius l of the balls at the point, over its value l₀ at the held state, gives both the unit of a length (with a held weight alone
radii run away). Inside, where −½ ln F falls below `LINEAR`, the root is continued by its tangent.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...body.metaballs import THRESHOLD, VISIBLE
from ..part_field import PartField
from ..state import CROSS, BodyState
from .blocks import Block, FromBlocks

SMALLEST = 1e-250
LINEAR = 0.03
SCALE_RANGE = (0.4, 2.5)  # bounds of |∇D| in units of 1 / (mean l of the part)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scaled:
    """What is held of one part's points since `scaled`."""

    rows: np.ndarray  # (n,) of the points
    bone: int
    field: PartField  # at the state of `scaled`
    scale: np.ndarray  # (n,) |∇D| or |∇F|, 1/m
    log_radius: np.ndarray  # (n,) ln l₀


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfacePoints(FromBlocks):
    """N points, each the surface of one bone's part."""

    xyz_m: np.ndarray  # (N, 3) world
    bone: np.ndarray  # (N,) index of the bone
    sigma_m: np.ndarray  # (N,) of one residual, along the normal
    crowding: np.ndarray | float = 1.0  # (N,) how many times less a point tells than if its error were its own
    form: str = "metric"  # or "paper"
    parts: tuple[_Scaled, ...] | None = None
    moved: bool = False  # since `scaled`
    kind: str = "points"

    def scaled(self, state: BodyState) -> "SurfacePoints":
        """The same points with weights for this state.  (12)"""
        parts = []
        for b in np.unique(self.bone):
            rows = np.flatnonzero(self.bone == b)
            field = PartField(state.parts[b], state, self.xyz_m[rows])
            typical = 1 / state.balls.radii_m[field.part.balls][:, CROSS].mean()
            if self.form == "paper":
                scale = np.full(len(rows), 4 * THRESHOLD * VISIBLE * typical)
            else:
                slope = np.linalg.norm(field.gradient, axis=1) * np.abs(distance(field.F)[1])
                scale = np.clip(slope, SCALE_RANGE[0] * typical, SCALE_RANGE[1] * typical)
            parts.append(_Scaled(rows=rows, bone=int(b), field=field, scale=scale, log_radius=field.shares @ _log_radii(field)))
        return replace(self, parts=tuple(parts))

    def at(self, xyz_m: np.ndarray) -> "SurfacePoints":
        """The same weights at other places (N, 3)."""
        return replace(self, xyz_m=xyz_m, moved=True)

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        value = np.empty(len(self.bone))
        for held in self._held():
            field = self._field(held, state)
            value[held.rows] = self._value(field.F)[0] / self._unit(held, field)
        return value

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, part by part."""
        for held in self._held():
            field = self._field(held, state)
            value, slope = self._value(field.F)
            J = field.jacobian(shape)
            J *= slope[:, None]
            if shape:
                J[:, field.part.of_radii] += value[:, None] * np.repeat(held.field.shares / 2, 2, axis=1)
            J /= self._unit(held, field)[:, None]
            yield held.rows, field.part.columns(shape), J

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def _held(self) -> tuple[_Scaled, ...]:
        if self.parts is None:
            raise ValueError("surface points need `scaled(state)` first")
        return self.parts

    def _field(self, held: _Scaled, state: BodyState) -> PartField:
        if state is held.field.state and not self.moved:
            return held.field
        return PartField(state.parts[held.bone], state, self.xyz_m[held.rows])

    def _unit(self, held: _Scaled, field: PartField) -> np.ndarray:
        return self.sigma_m[held.rows] * held.scale * np.exp(held.log_radius - held.field.shares @ _log_radii(field))

    def _value(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (THRESHOLD - F, np.full_like(F, -1.0)) if self.form == "paper" else distance(F)


def _log_radii(field: PartField) -> np.ndarray:
    """ln of the mean cross radius (m,) of a part's balls."""
    return np.log(field.state.balls.radii_m[field.part.balls][:, CROSS]).mean(axis=1)


def distance(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """D and dD/dF of values (N,) of a field.  (1)"""
    F = np.maximum(F, SMALLEST)
    u = -0.5 * np.log(F)
    root = np.sqrt(np.maximum(u, LINEAR))
    return root + np.minimum(u - LINEAR, 0.0) / (2 * np.sqrt(LINEAR)) - VISIBLE, -0.25 / (F * root)
