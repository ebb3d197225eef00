"""A limb does not lie where a view shows the background: the axis of a bone projects into the person's outline.

    r = √(2 (√(1 + u²) − 1)) ,   u = d(x) / σ                                                         (1)

d is the distance of an axis point's image x from the nearest pixel that may show the person, 0 inside. The cost r²/2 grows with u², and
with |u| far outside (pseudo-Huber, Charbonnier et al. 1994), so that a wrong outline does not tear a limb off. Visual hulls (Laurentini
1994) constrain the whole body in the same way; the axis alone needs no thickness of the limb.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...geometry.camera import Camera
from ..state import Block, BodyState, FromBlocks

SMALLEST = 1e-9  # of r: at 0 its derivative is the limit, 1


@dataclass(frozen=True, eq=False, kw_only=True)
class DistanceMap:
    """d of (1) in one view, every `step_px` pixels: node (j, i) is at the pixel (first + i · step, first + j · step)."""

    camera: Camera
    table: np.ndarray  # (h, w) in units of `unit_px`
    step_px: float
    first_px: float
    unit_px: float = 1.0

    def sampled(self, xy_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """d (N,) and its gradient (N, 2) at pixels (N, 2), bilinear; 0 outside the image, where nothing is known."""
        (a, b, c, e), (fx, fy), inside = self._around(xy_px)
        value = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * e)
        gradient = np.stack([(1 - fy) * (b - a) + fy * (e - c), (1 - fx) * (c - a) + fx * (e - b)], axis=1) / self.step_px
        return value * inside, gradient * inside[:, None]

    def values(self, xy_px: np.ndarray) -> np.ndarray:
        """d (N,) of `sampled` without the gradient."""
        (a, b, c, e), (fx, fy), inside = self._around(xy_px)
        return np.asarray(((1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * e)) * inside)

    def _around(self, xy_px: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, np.ndarray], np.ndarray]:
        """d at the four nodes about each of N pixels, the pixel's fractions between them, and whether it is inside the image."""
        h, w = self.table.shape
        x, y = ((xy_px[:, i] - self.first_px) / self.step_px for i in range(2))
        inside = (x >= 0) & (y >= 0) & (x < w - 1) & (y < h - 1)
        x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
        i, j = x.astype(np.intp), y.astype(np.intp)
        at, flat = j * w + i, self.table.reshape(-1)
        corners = tuple(flat.take(at + d) * self.unit_px for d in (0, 1, w, w + 1))
        return corners, (x - i, y - j), inside


@dataclass(frozen=True, eq=False, kw_only=True)
class BackgroundExclusion(FromBlocks):
    """Points on the axes of bones, each a fraction of the way from joint `head` to joint `tail`, in all views of one frame."""

    views: Sequence[DistanceMap]
    head: np.ndarray  # (P,) index in Skeleton.joint_names
    tail: np.ndarray  # (P,)
    fraction: np.ndarray  # (P,)
    sigma_px: float
    kind: str = ""
    variance_inflation: np.ndarray | float = 1.0
    _last: list[tuple[BodyState, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]] = field(default_factory=list, init=False, repr=False)

    @property
    def size(self) -> int:
        """views · P"""
        return len(self.views) * len(self.head)

    def residual(self, state: BodyState) -> np.ndarray:
        """(views · P,)  (1)"""
        return np.concatenate([_pseudo_huber(d / self.sigma_px)[0] for d, _ in self._sampled(state)[1]])

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """One block for each view in which a point is outside: most are inside, where the derivative is zero."""
        xyz, sampled = self._sampled(state)
        for k, (view, (d, gradient)) in enumerate(zip(self.views, sampled)):
            out = np.flatnonzero(gradient.any(axis=1))
            if not len(out):
                continue
            dX = state.joint_jacobian[1]
            dxyz = self._mix(dX[:, :, : state.layout.size(shape)], out)
            across = (_pseudo_huber(d[out] / self.sigma_px)[1] / self.sigma_px)[:, None] * gradient[out]
            in_image = view.camera.project_with_jacobian(xyz[out])[1]
            yield k * len(self.head) + out, np.arange(dxyz.shape[2]), np.einsum("pa,pai,pik->pk", across, in_image, dxyz, optimize=True)

    def _sampled(self, state: BodyState) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
        """The points (P, 3), and d (P,) with its gradient (P, 2) in each view; those of the last state are cached."""
        if not self._last or self._last[0][0] is not state:
            xyz = self._mix(state.joints_m, np.arange(len(self.head)))
            self._last[:] = [(state, xyz, [view.sampled(view.camera.project(xyz)) for view in self.views])]
        return self._last[0][1:]

    def _mix(self, of_joints: np.ndarray, which: np.ndarray) -> np.ndarray:
        f = self.fraction[which].reshape(-1, *[1] * (of_joints.ndim - 1))
        return np.asarray((1 - f) * of_joints[self.head[which]] + f * of_joints[self.tail[which]])


def _pseudo_huber(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """r of (1) and dr/du."""
    root = np.sqrt(1 + u * u)
    r = u * np.sqrt(2 / (root + 1))  # √(2 (√(1 + u²) − 1)) without cancellation
    return r, np.where(r > SMALLEST, u / (root * np.maximum(r, SMALLEST)), 1.0)
