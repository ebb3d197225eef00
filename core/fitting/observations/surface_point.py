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
from dataclasses import dataclass, field, replace

import numpy as np

from ...body.metaballs import THRESHOLD, VISIBLE, Metaballs
from ..part_field import PartField
from ..state import CROSS, Block, BodyState, FromBlocks

SCALE_RANGE = (0.4, 2.5)  # bounds of |∇D| in units of 1 / (mean l of the part)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scaled:
    """What is held of one part's points since `scaled`."""

    rows: np.ndarray  # (n,) of the points
    bone: int
    balls: Metaballs  # of the state of `scaled`
    shares: np.ndarray  # (n, m) which part of F came from which of the part's balls
    scale: np.ndarray  # (n,) |∇D| or |∇F|, 1/m
    log_radius: np.ndarray  # (n,) ln l₀


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfacePoints(FromBlocks):
    """N points, each the surface of one bone's part."""

    xyz_m: np.ndarray  # (N, 3) world
    bone: np.ndarray  # (N,) index of the bone
    sigma_m: np.ndarray  # (N,) of one residual, along the normal
    variance_inflation: np.ndarray | float = 1.0  # (N,) how many times less a point tells than if its error were its own
    form: str = "metric"  # or "paper"
    parts: tuple[_Scaled, ...] | None = None
    kind: str = "points"
    _last: dict[int, PartField] = field(default_factory=dict, init=False, repr=False)  # by bone, at the last state that was asked for

    def scaled(self, state: BodyState) -> "SurfacePoints":
        """The same points with weights for this state.  (12)"""
        groups = [(held.bone, held.rows) for held in self.parts] if self.parts is not None else _by_bone(self.bone)
        parts = tuple(self._weighed(b, rows, state) for b, rows in groups)
        again = replace(self, parts=parts)
        again._last.update(self._last)
        self._last.clear()
        return again

    def _weighed(self, bone: int, rows: np.ndarray, state: BodyState) -> _Scaled:
        there = self._field(bone, rows, state)
        typical = 1 / state.balls.radii_m[there.part.balls][:, CROSS].mean()
        if self.form == "paper":
            scale = np.full(len(rows), 4 * THRESHOLD * VISIBLE * typical)
        else:
            gradient = there.gradient
            slope = np.sqrt(np.einsum("ni,ni->n", gradient, gradient)) * np.abs(there.distance[1])
            scale = np.clip(slope, SCALE_RANGE[0] * typical, SCALE_RANGE[1] * typical)
        return _Scaled(
            rows=rows,
            bone=bone,
            balls=state.balls,
            shares=there.shares,
            scale=scale,
            log_radius=there.shares @ state.log_radii[there.part.balls],
        )

    def at(self, xyz_m: np.ndarray) -> "SurfacePoints":
        """The same weights at other places (N, 3)."""
        return replace(self, xyz_m=xyz_m)

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        value = np.empty(len(self.bone))
        for held in self._held():
            there = self._field(held.bone, held.rows, state)
            value[held.rows] = self._value(there)[0] / self._unit(held, there)
        return value

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, part by part. The fields are let go: what follows derivatives is a cost at another state."""
        for held in self._held():
            there = self._field(held.bone, held.rows, state)
            value, slope = self._value(there)
            unit = self._unit(held, there)
            J = there.jacobian(shape)
            J *= (slope / unit)[:, None]
            if shape:
                J[:, there.part.of_radii] += (value / unit)[:, None] * np.repeat(held.shares / 2, 2, axis=1)
            self._last.pop(held.bone, None)
            yield held.rows, there.part.columns(shape), J

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def _held(self) -> tuple[_Scaled, ...]:
        if self.parts is None:
            raise ValueError("surface points need `scaled(state)` first")
        return self.parts

    def _field(self, bone: int, rows: np.ndarray, state: BodyState) -> PartField:
        known = self._last.get(bone)
        if known is None or known.state is not state:
            known = self._last[bone] = PartField(state.parts[bone], state, self.xyz_m[rows])
        return known

    def _unit(self, held: _Scaled, there: PartField) -> np.ndarray:
        unit = self.sigma_m[held.rows] * held.scale
        if there.state.balls is held.balls:
            return np.asarray(unit)
        return np.asarray(unit * np.exp(held.log_radius - held.shares @ there.state.log_radii[there.part.balls]))

    def _value(self, there: PartField) -> tuple[np.ndarray, np.ndarray]:
        return (THRESHOLD - there.F, np.full_like(there.F, -1.0)) if self.form == "paper" else there.distance


def _by_bone(bone: np.ndarray) -> list[tuple[int, np.ndarray]]:
    return [(b, np.flatnonzero(bone == b)) for b in np.unique(bone).tolist()]
