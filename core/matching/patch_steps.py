"""One step of least squares matching for many patches at once: the equations (2), (3) and (6) of `least_squares`."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..foundation.threads import in_threads
from ..images.sampling import SplineImage
from .parameter_sets import PARAMETERS
from .patches import compare

SHARED_FROM = 1026  # patches from which on threads share the images
MAX_STEP_PX = 2.0  # px, longer steps are shortened
MIN_DETERMINANT = 0.1  # of I + B; a smaller one has no usable inverse


class StepTemplates(Protocol):
    """The template side of N patches of n pixels."""

    half: tuple[int, int]
    n_pixels: int
    f: np.ndarray  # (N, n)
    fx: np.ndarray  # (N, n)
    fy: np.ndarray  # (N, n)
    contrast: np.ndarray  # (N,)
    q: np.ndarray  # (N, 6)
    inverse: np.ndarray  # (N, 6, 6)


class PatchSteps:
    """The patches of a piece that still move: the rows `place` (m,) of all patches in all images, image after image."""

    def __init__(self, templates: StepTemplates, images: Sequence[SplineImage], place: np.ndarray) -> None:
        t, N = templates, len(templates.contrast)
        cuts = np.searchsorted(place, np.arange(len(images) + 1) * N)
        own = [place[a:b] - k * N for k, (a, b) in enumerate(zip(cuts, cuts[1:]))]  # rows of the templates
        parts = [slice(None) if len(rows) == N else rows for rows in own]  # no copies
        self._views = [
            (image, slice(a, b), (t.f[part], t.fx[part], t.fy[part])) for image, a, b, part in zip(images, cuts, cuts[1:], parts) if b > a
        ]
        self._half, self._dof = t.half, max(1, t.n_pixels - PARAMETERS)
        self._contrast, self._q, self._inverse = (
            np.concatenate([a[part] for part in parts]) if len(parts) > 1 else a[parts[0]] for a in (t.contrast, t.q, t.inverse)
        )

    def step(self, c: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Δp of (2) (m, 6), the correlation ρ (m,) before it, and the step's gain in ρ² where it is small enough to be linear."""

        def compared(of_image: tuple[SplineImage, slice, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
            image, rows, patches = of_image
            return compare(image, c[rows], A[rows], self._half, patches)

        found = in_threads(compared, self._views) if len(c) >= SHARED_FROM else [*map(compared, self._views)]
        power, along, pulled = found[0] if len(found) == 1 else (np.concatenate(parts) for parts in zip(*found))
        gain = self._contrast * along / power  # r1
        rhs = ((pulled - self._q * along[:, None]) * gain[:, None]).astype(np.float64)
        step = np.einsum("nij,nj->ni", self._inverse, rhs)
        explained = np.einsum("ni,ni->n", step, rhs) / np.maximum(self._contrast, 1e-6) ** 2
        return step, along / np.sqrt(power), explained

    def sigma(self, rho: np.ndarray) -> np.ndarray:
        """Standard deviation of the position in the template [px] at correlation rho.  (4)"""
        variance = self._contrast.astype(np.float64) ** 2 * np.clip(1 - rho**2, 0, 1) / self._dof
        return np.asarray(np.sqrt(variance * np.maximum(self._inverse[:, 0, 0], self._inverse[:, 3, 3])))


def compose(c: np.ndarray, A: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (N, 2) and shapes (N, 2, 2) after steps Δp (N, 6), and how far the centres moved (N,) [px].  (3)"""
    s = np.ascontiguousarray(step.T)  # rows over the patches: numpy's products of single 2×2 matrices take several times as long
    s *= np.minimum(1.0, MAX_STEP_PX / np.maximum(np.sqrt(s[0] ** 2 + s[3] ** 2), 1e-9))
    a, b, d, e = s[1] + 1, s[2], s[4], s[5] + 1
    det = a * e - b * d
    inverse = 1 / np.where(np.abs(det) < MIN_DETERMINANT, np.nan, det)
    a, b, d, e = e * inverse, -b * inverse, -d * inverse, a * inverse
    p, q, r, t = np.ascontiguousarray(A.reshape(-1, 4).T)
    turned = np.stack([p * a + q * d, p * b + q * e, r * a + t * d, r * b + t * e])
    move = np.stack([turned[0] * s[0] + turned[1] * s[3], turned[2] * s[0] + turned[3] * s[3]])
    moved = np.sqrt(move[0] ** 2 + move[1] ** 2)
    A_new, move, bad = turned.T.reshape(-1, 2, 2), move.T, ~np.isfinite(moved)
    if bad.any():
        A_new[bad], move[bad] = A[bad], 0.0
    return c - move, A_new, moved
