"""Measured surface points attract the body's surface (D'Apuzzo et al. 1999, Eqs. 14, 15).

    paper:  (F(X) − T) · l/l₀ = ε ,                     σ_F = |∇F|_surface σ_n                      (1)
    metric: (√(−½ ln F) − √(½ ln 2)) · l/l₀ = ε ,       σ_D = |∇D| σ_n                              (2)

F is the sum over the balls of the point's part and of the parts that it meets. (2) grows linearly with the distance, near and far, where
(1), their Eq. 15, saturates. |∇D| belongs to the weight (their Eq. 12): it is evaluated at a reference state and constant from then on. But
F and D are relative to the radii: the same distance in mm makes a smaller residual on a thicker limb, so a limb could explain its points'
noise by growing. The mean radius l of the balls at the point, over its value l₀ at the reference state, gives both the unit of a length
(with a constant weight alone radii run away). Inside, where −½ ln F falls below `LINEAR`, the root is continued by its tangent.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ...body.metaballs import THRESHOLD, VISIBLE, Metaballs
from ..part_field import PartField
from ..state import CROSS, Block, BodyState, FromBlocks

SLOPE_RANGE = (0.4, 2.5)  # bounds of |∇D| in units of 1 / (mean l of the part)


@dataclass(frozen=True, eq=False, kw_only=True)
class _PartWeights:
    """What is constant of one part's points: evaluated at the reference state."""

    rows: np.ndarray  # (n,) of the points
    bone: int
    balls: Metaballs  # at the reference state
    shares: np.ndarray  # (n, m) each ball's share of F
    slope: np.ndarray  # (n,) |∇D| or |∇F|, 1/m
    log_radius: np.ndarray  # (n,) ln l₀


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfacePoints(FromBlocks):
    """N points, each on the surface of one bone's part, with weights from a reference state (`SurfacePoints.about`)."""

    xyz_m: np.ndarray  # (N, 3) world
    bone: np.ndarray  # (N,) index of the bone
    sigma_m: np.ndarray  # (N,) of one residual, along the normal
    variance_inflation: np.ndarray | float  # (N,) 1: the point's error is independent of its neighbours'
    form: str
    parts: tuple[_PartWeights, ...]
    kind: str = "points"
    _last: dict[int, PartField] = field(default_factory=dict, init=False, repr=False)  # by bone, at the state evaluated last

    @staticmethod
    def about(
        reference: BodyState,
        *,
        xyz_m: np.ndarray,
        bone: np.ndarray,
        sigma_m: np.ndarray,
        variance_inflation: np.ndarray | float = 1.0,
        form: str = "metric",
    ) -> "SurfacePoints":
        """The observations of points (N, 3) of bones (N,), with weights from a reference state."""
        points = SurfacePoints(xyz_m=xyz_m, bone=bone, sigma_m=sigma_m, variance_inflation=variance_inflation, form=form, parts=())
        return points._weighted(reference, [(b, np.flatnonzero(bone == b)) for b in np.unique(bone).tolist()])

    def reweighted(self, reference: BodyState) -> "SurfacePoints":
        """The same points with weights from another reference state."""
        return self._weighted(reference, [(part.bone, part.rows) for part in self.parts])

    def moved(self, xyz_m: np.ndarray) -> "SurfacePoints":
        """The same weights at other places (N, 3)."""
        return replace(self, xyz_m=xyz_m)

    def _weighted(self, reference: BodyState, rows_of_bones: list[tuple[int, np.ndarray]]) -> "SurfacePoints":
        again = replace(self, parts=tuple(self._weights(b, rows, reference) for b, rows in rows_of_bones))
        again._last.update(self._last)
        self._last.clear()
        return again

    def _weights(self, bone: int, rows: np.ndarray, reference: BodyState) -> _PartWeights:
        there = self._field(bone, rows, reference)
        typical = 1 / reference.balls.radii_m[there.part.balls][:, CROSS].mean()
        if self.form == "paper":
            slope = np.full(len(rows), 4 * THRESHOLD * VISIBLE * typical)
        else:
            gradient = there.gradient
            steepness = np.sqrt(np.einsum("ni,ni->n", gradient, gradient)) * np.abs(there.distance[1])
            slope = np.clip(steepness, SLOPE_RANGE[0] * typical, SLOPE_RANGE[1] * typical)
        return _PartWeights(
            rows=rows,
            bone=bone,
            balls=reference.balls,
            shares=there.shares,
            slope=slope,
            log_radius=there.shares @ reference.log_radii[there.part.balls],
        )

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        value = np.empty(len(self.bone))
        for part in self.parts:
            there = self._field(part.bone, part.rows, state)
            value[part.rows] = self._value(there)[0] / self._unit(part, there)  # (1), (2)
        return value

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, part by part. The cached fields are released: after derivatives, the cost is evaluated at another state."""
        for part in self.parts:
            there = self._field(part.bone, part.rows, state)
            value, slope = self._value(there)
            unit = self._unit(part, there)
            J = there.jacobian(shape)
            J *= (slope / unit)[:, None]
            if shape:
                J[:, there.part.radius_columns] += (value / unit)[:, None] * np.repeat(part.shares / 2, 2, axis=1)
            self._last.pop(part.bone, None)
            yield part.rows, there.part.columns(shape), J

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def _field(self, bone: int, rows: np.ndarray, state: BodyState) -> PartField:
        last = self._last.get(bone)
        if last is None or last.state is not state:
            last = self._last[bone] = PartField(state.parts[bone], state, self.xyz_m[rows])
        return last

    def _unit(self, part: _PartWeights, there: PartField) -> np.ndarray:
        """σ_F or σ_D · l₀/l (n,)."""
        unit = self.sigma_m[part.rows] * part.slope
        if there.state.balls is part.balls:
            return np.asarray(unit)
        return np.asarray(unit * np.exp(part.log_radius - part.shares @ there.state.log_radii[there.part.balls]))

    def _value(self, there: PartField) -> tuple[np.ndarray, np.ndarray]:
        return (THRESHOLD - there.F, np.full_like(there.F, -1.0)) if self.form == "paper" else there.distance
