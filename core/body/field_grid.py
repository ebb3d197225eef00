"""The implicit surface of a whole body on a grid: what a mesh of it, or any other check, is made from."""

from dataclasses import dataclass

import numpy as np

from ..progress import Monitor
from ..values import frozen
from .fields import EXPONENTIAL, Potential
from .shape import BodyShape
from .skeleton import bone_frames
from .skin_parts import body_parts


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
    """The field of a body in one posture, `motion` (D,) rad and metres, around everything that it reaches.

    The balls of a part (`skin_parts`: an arm, a leg, the trunk) add, and of the parts' fields the largest counts: the surface is the
    union of the parts', as the metaball skin in Blender is. A whole body at 5 mm: 16 million points, 1.5 s.

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
            there = q[0][:, None, None] + q[1][None, :, None] + q[2][None, None, :]
            box = tuple(slice(a, b) for a, b in zip(first, last))
            field[box] += (balls.weight[m] * potential.value(np.einsum("ijkc,ijkc->ijk", there, there))).astype(np.float32)
        np.maximum(values, field, out=values)
    return FieldGrid(values=values, origin_m=low, spacing_m=spacing_m)
