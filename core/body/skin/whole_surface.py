"""The fitted surface of a whole body as a field of points, near the seams of its parts: the surface that roots finds along rays.

    G = M_trunk + (Σ E_limb^m)^(1/m) = T ,   E_limb = blend(M_trunk, M_limb) − M_trunk ,   m = 12          (1)

M_part = Σ_b u_b F_b over the part's bones b. F_b is the sum of the balls of bone b and of the adjacent bones, as in the fit; u_b is 1 at
the bone's middle and passes to the next bone's about the joint (1b in roots); a limb is added by `roots.blended`. At a point of
the trunk all its limbs count, at a point of a limb the trunk alone, or two thighs that touch would fuse; from the middle of the limb's
last junction bone to its end the trunk's weight fades to zero. M_trunk is limited to 1/τ times the field of its own balls (τ = 0.4,
roots; smoothly), and the remainder belongs to the limb: two thighs that nearly touch are no trunk.

The field of a whole body on a grid, from which the implicit surface can be meshed or checked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...foundation.arrays import frozen
from ...foundation.progress import Monitor
from ..fields import EXPONENTIAL, Potential
from ..metaballs import THRESHOLD, active_balls
from ..parts import body_parts
from ..shape import BodyShape
from ..skeleton import bone_frames
from .rays import smooth
from .roots import OWN_SHARE, Chain, joined

TOGETHER = 12.0  # m of (1)
BENDING = 8.0  # exponent of the smooth limit of M_trunk
NEWTON_STEPS = 4
LONGEST_STEP_M = 0.005  # of Newton's
CHUNK = 4000  # points at a time, for memory
NOTHING = 1e-20  # a field that is zero
FADE_FROM = 0.5  # fraction of a limb's last junction bone from which on the trunk fades


class WholeSurface:
    """The surface (1) of a body in one pose. `part`: (N,) the part to which each of the points (N, 3) belongs."""

    def __init__(self, shape: BodyShape, motion: np.ndarray) -> None:
        self._shape, self._parts = shape, body_parts(shape)
        self._R, self._head = bone_frames(shape.skeleton, shape.lengths_m, np.asarray(motion, dtype=np.float64))
        balls, neighbours = shape.metaballs, shape.skeleton.neighbours
        axes, head = self._R[balls.bone_index] / balls.radii_m[:, None, :], self._head[balls.bone_index]
        shift = np.einsum("mi,mij->mj", head, axes) + balls.centres_m(shape.lengths_m) / balls.radii_m
        self._axes, self._shift = axes.transpose(1, 0, 2).reshape(3, -1), shift.ravel()  # (3, 3 m), (3 m): q = Xᵀ axes − shift
        self._own = np.stack([np.isin(balls.bone_index, part.bones) for part in self._parts], axis=1).astype(np.float64)
        self._of_bone = {b: active_balls(balls, neighbours, b).astype(np.float64) for part in self._parts for b in part.bones}

    def parent_ratio(self, points: np.ndarray) -> np.ndarray:
        """At points (N, 3), for each part (N, P): the field of its parent part, without the part's own balls, over the field of its own."""
        return np.concatenate([self._parent_ratio(points[i : i + CHUNK]) for i in range(0, len(points), CHUNK)])

    def _parent_ratio(self, points: np.ndarray) -> np.ndarray:
        terms = self._terms(points)[1]
        found = np.zeros((len(points), len(self._parts)))
        for p, part in enumerate(self._parts):
            if part.parent is not None:
                counted = self._factors(self._parts[part.parent].bones, points)
                without = np.einsum("nm,nm->n", terms * (1 - self._own[:, p]), counted)
                if self._parts[part.parent].parent is None:
                    without = np.minimum(without, terms @ self._own[:, part.parent] / OWN_SHARE)
                found[:, p] = without / np.maximum(terms @ self._own[:, p], NOTHING)
        return found

    def projected(self, points: np.ndarray, part: np.ndarray, steps: int = NEWTON_STEPS) -> np.ndarray:
        """Points near the surface, moved onto it by Newton's method."""
        found = np.array(points, dtype=np.float64)
        for first in range(0, len(found), CHUNK):
            rows = slice(first, first + CHUNK)
            for _ in range(steps):
                G, gradient = self._joined(found[rows], part[rows])
                size = np.maximum(np.einsum("nk,nk->n", gradient, gradient), 1e-12)
                step = ((THRESHOLD - G) / size)[:, None] * gradient
                found[rows] += step * np.minimum(1.0, LONGEST_STEP_M / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
        return found

    def distance_m(self, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Distance (N,) of points near the surface from it, outwards positive, to first order."""
        G, gradient = self._joined(points, part)
        return np.asarray((THRESHOLD - G) / np.maximum(np.linalg.norm(gradient, axis=1), 1e-12))

    def slope(self, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """|∇G| (N,) per metre."""
        return np.asarray(np.linalg.norm(self._joined(points, part)[1], axis=1))

    def normals(self, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Outward unit normals (N, 3)."""
        gradient = self._joined(points, part)[1]
        return np.asarray(-gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12))

    def _terms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q (N, 3 m), the coordinates of points in the balls' axes over their radii, ball after ball, and the balls' fields (N, m)."""
        q = points @ self._axes - self._shift
        each = q.reshape(len(points), self._shape.metaballs.weight.size, 3)
        return q, self._shape.metaballs.weight * np.exp(-2 * np.einsum("nmi,nmi->nm", each, each))

    def _joined(self, points: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """G (N,) and ∇G (N, 3), without the gradients of the weights u.  (1)"""
        q, terms = self._terms(points)
        G, of_ball = np.empty(len(points)), np.empty(terms.shape)
        for p in np.unique(part):
            rows = np.flatnonzero(part == p)
            G[rows], factors = self._field_of_part(int(p), points[rows], terms[rows])
            of_ball[rows] = terms[rows] * factors
        return G, -4 * (np.repeat(of_ball, 3, axis=1) * q) @ self._axes.T

    def _field_of_part(self, p: int, points: np.ndarray, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """G (N,) at points of part p, and the balls' factors in it and in its gradient (N, m).  (1)"""
        parts, parent = self._parts, self._parts[p].parent
        trunk = p if parent is None or any(other.parent == p for other in parts) else parent
        limbs = [part.bones if i == p else part.junction for i, part in enumerate(parts) if part.parent == trunk and p in (i, trunk)]
        if trunk == p and parent is not None:
            limbs.append(parts[parent].bones)
        G, factors = self._with_limbs(trunk, limbs, points, terms)
        if trunk == p:
            return G, factors
        own_factors, fade = self._factors(parts[p].bones, points), self._fade(p, points)
        own = np.einsum("nm,nm->n", terms, own_factors)
        return own + fade * (G - own), own_factors + fade[:, None] * (factors - own_factors)

    def _with_limbs(
        self, trunk: int, limbs: Sequence[tuple[int, ...]], points: np.ndarray, terms: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(1) for a trunk and the bones of its limbs."""
        counted = self._factors(self._parts[trunk].bones, points)
        M = np.maximum(np.einsum("nm,nm->n", terms, counted), NOTHING)
        s, slope = self._bounded(trunk, terms, counted, M)
        G, factors = s * M, s[:, None] * counted + M[:, None] * slope
        excess, of_excess = np.full((len(limbs), len(points)), NOTHING), np.zeros((len(limbs), *terms.shape))
        for i, bones in enumerate(limbs):
            limb = self._factors(bones, points)
            both = np.minimum(counted, limb)
            C = np.einsum("nm,nm->n", terms, both)[:, None]
            found, balls = joined(
                terms,
                s[:, None] * both + C * slope,
                s[:, None] * (counted - both) + (M[:, None] - C) * slope,
                limb - s[:, None] * both - C * slope,
            )
            excess[i], of_excess[i] = np.maximum(found - G, NOTHING), balls - factors
        E = (excess**TOGETHER).sum(axis=0) ** (1 / TOGETHER) if len(limbs) else np.zeros(len(points))
        return G + E, factors + np.einsum("ln,lnm->nm", (excess / np.maximum(E, NOTHING)) ** (TOGETHER - 1), of_excess)

    def _bounded(self, trunk: int, terms: np.ndarray, counted: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The factor (N,) that limits M (N,) to 1/τ times the field of the trunk's own balls, and its derivatives to them (N, m)."""
        if self._parts[trunk].parent is not None:
            return np.ones(len(M)), np.zeros(terms.shape)
        own_balls = self._own[:, trunk]
        own = np.maximum(terms @ own_balls, NOTHING)
        lack = (OWN_SHARE * M / own) ** BENDING
        s = (1 + lack) ** (-1 / BENDING)
        return s, (s * lack / (1 + lack))[:, None] * (own_balls / own[:, None] - counted / M[:, None])

    def _factors(self, bones: Sequence[int], points: np.ndarray) -> np.ndarray:
        """The weight of each ball (N, M) in the field of bones of one part."""
        balls = np.stack([self._of_bone[b] for b in bones])
        return Chain.of(bones, self._shape.lengths_m, self._R, self._head).shares(points) @ balls

    def _station(self, b: int, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self._head[b]) @ self._R[b, :, 1] / self._shape.lengths_m[b])

    def _fade(self, p: int, points: np.ndarray) -> np.ndarray:
        part = self._parts[p]
        if part.parent is None or part.junction[-1] == part.bones[-1]:
            return np.ones(len(points))
        return np.asarray(1 - smooth((self._station(part.junction[-1], points) - FADE_FROM) / (1 - FADE_FROM)))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FieldGrid:
    """F at the points origin_m + spacing_m · (i, j, k); the surface is where it is ½."""

    values: np.ndarray  # (I, J, K) float32
    origin_m: np.ndarray  # (3,) world
    spacing_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values, (None, None, None), np.float32, "values"))
        object.__setattr__(self, "origin_m", frozen(self.origin_m, (3,), name="origin_m"))


def field_grid(
    shape: BodyShape, motion: np.ndarray, spacing_m: float = 0.005, monitor: Monitor | None = None, potential: Potential = EXPONENTIAL
) -> FieldGrid:
    """The field of a body in one pose, `motion` (D,) rad and metres, over its whole extent.

    The balls of a part (`parts`: an arm, a leg, the trunk) are summed, and the field is the maximum of the parts': the surface is the
    union of theirs, as the metaball skin in Blender. A whole body at 5 mm: 16 million points, 1.5 s.

    Raises:
        Cancelled: the monitor was cancelled.
    """
    monitor = monitor or Monitor()
    balls = shape.metaballs
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.asarray(motion, dtype=np.float64))
    turn = R[balls.bone_index]  # (M, 3, 3), columns: the bone's axes
    centre = head[balls.bone_index] + np.einsum("mij,mj->mi", turn, balls.centres_m(shape.lengths_m))
    reach = potential.reach * np.sqrt(np.einsum("mij,mj->mi", turn**2, balls.radii_m**2))
    low, high = (centre - reach).min(axis=0), (centre + reach).max(axis=0)
    size = np.ceil((high - low) / spacing_m).astype(int) + 1
    values = np.zeros(size, dtype=np.float32)
    parts = body_parts(shape)
    for done, part in enumerate(parts):
        monitor.step("implicit surface", done, len(parts))
        field = np.zeros(size, dtype=np.float32)
        for m in np.flatnonzero(np.isin(balls.bone_index, part.bones)):
            first = np.floor((centre[m] - reach[m] - low) / spacing_m).astype(int)
            last = np.minimum(np.ceil((centre[m] + reach[m] - low) / spacing_m).astype(int) + 1, size)
            axes = [low[i] + spacing_m * np.arange(first[i], last[i]) - centre[m, i] for i in range(3)]
            # q = Rᵀ (x − c) / l is a sum of one term for each axis of the grid.
            q = [turn[m, i] / balls.radii_m[m] * axes[i][:, None] for i in range(3)]
            grid_q = q[0][:, None, None] + q[1][None, :, None] + q[2][None, None, :]
            box = tuple(slice(a, b) for a, b in zip(first, last))
            field[box] += (balls.weight[m] * potential.value(np.einsum("ijkc,ijkc->ijk", grid_q, grid_q))).astype(np.float32)
        np.maximum(values, field, out=values)
    return FieldGrid(values=values, origin_m=low, spacing_m=spacing_m)
