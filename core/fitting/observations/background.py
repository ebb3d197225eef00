"""A limb does not lie where a view shows the background: the axis of a bone projects into the person's outline.

    r = √(2 (√(1 + u²) − 1)) ,   u = d(x) / σ                                                         (1)

d is the distance of an axis point's image x from the nearest pixel that may show the person, 0 inside. The cost r²/2 grows with u², and
with |u| far outside (pseudo-Huber, Charbonnier et al. 1994), so that a wrong outline does not tear a limb off. Visual hulls (Laurentini
1994) constrain the whole body in the same way; the axis alone needs no thickness of the limb.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.camera import Camera
from ..state import Block, BodyState, FromBlocks

SMALLEST = 1e-9  # of r: at 0 its derivative is the limit, 1


@dataclass(frozen=True, eq=False, kw_only=True)
class DistanceMap:
    """d of (1) in one view, every `step_px` pixels: node (j, i) is at the pixel (first + i · step, first + j · step)."""

    camera: Camera
    values_px: np.ndarray  # (h, w)
    step_px: float
    first_px: float

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
        h, w = self.values_px.shape
        x, y = ((xy_px[:, i] - self.first_px) / self.step_px for i in range(2))
        inside = (x >= 0) & (y >= 0) & (x < w - 1) & (y < h - 1)
        x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
        i, j = x.astype(np.intp), y.astype(np.intp)
        at, flat = j * w + i, self.values_px.reshape(-1)
        corners = tuple(flat.take(at + d).astype(np.float64) for d in (0, 1, w, w + 1))
        return corners, (x - i, y - j), inside


@dataclass(frozen=True, eq=False, kw_only=True)
class BackgroundExclusion(FromBlocks):
    """Points on the axes of bones, each a fraction of the way from joint `head` to joint `tail`, in all views of one frame."""

    views: Sequence[DistanceMap]
    head: np.ndarray  # (P,) index in Skeleton.joint_names
    tail: np.ndarray  # (P,)
    fraction: np.ndarray  # (P,)
    sigma_px: np.ndarray  # (P,)
    kind: str = ""
    variance_inflation: np.ndarray | float = 1.0

    @property
    def size(self) -> int:
        """views · P"""
        return len(self.views) * len(self.head)

    def residual(self, state: BodyState) -> np.ndarray:
        """(views · P,)  (1)"""
        xyz = self._mix(state.joints_m, np.arange(len(self.head)))
        return np.concatenate([_pseudo_huber(view.sampled(view.camera.project(xyz))[0] / self.sigma_px)[0] for view in self.views])

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """One block for each view in which a point is outside: most are inside, where the derivative is zero."""
        xyz = self._mix(state.joints_m, np.arange(len(self.head)))
        for k, view in enumerate(self.views):
            d, gradient = view.sampled(view.camera.project(xyz))
            out = np.flatnonzero(gradient.any(axis=1))
            if not len(out):
                continue
            dX = state.joint_jacobian[1]
            dxyz = self._mix(dX[:, :, : state.layout.size(shape)], out)
            across = (_pseudo_huber(d[out] / self.sigma_px[out])[1] / self.sigma_px[out])[:, None] * gradient[out]
            in_image = view.camera.project_with_jacobian(xyz[out])[1]
            yield k * len(self.head) + out, np.arange(dxyz.shape[2]), np.einsum("pa,pai,pik->pk", across, in_image, dxyz, optimize=True)

    def _mix(self, of_joints: np.ndarray, which: np.ndarray) -> np.ndarray:
        f = self.fraction[which].reshape(-1, *[1] * (of_joints.ndim - 1))
        return np.asarray((1 - f) * of_joints[self.head[which]] + f * of_joints[self.tail[which]])


def _pseudo_huber(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """r of (1) and dr/du."""
    root = np.sqrt(1 + u * u)
    r = u * np.sqrt(2 / (root + 1))  # √(2 (√(1 + u²) − 1)) without cancellation
    return r, np.where(r > SMALLEST, u / (root * np.maximum(r, SMALLEST)), 1.0)
