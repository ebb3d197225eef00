"""The affine warps of patches under least squares matching: where they start, and how a step of the inverse form moves them."""

import numpy as np

MAX_STEP_PX = 2.0  # px, longer steps are shortened
MIN_DETERMINANT = 0.1  # of I + B; a smaller one has no usable inverse


def starts_at_work(start: np.ndarray, alive: np.ndarray, images: int) -> np.ndarray:
    """For each row (N · images, 2) a place among the starts of its image that are `alive`: no other part of it is to be interpolated."""
    by_image, there = start.reshape(images, -1, 2), alive.reshape(images, -1)
    if not there.size:
        return start
    first = np.where(there.any(axis=1)[:, None], by_image[np.arange(images), there.argmax(axis=1)], 0.0)
    return np.repeat(first, there.shape[1], axis=0)


def compose(c: np.ndarray, A: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (N, 2) and shapes (N, 2, 2) after steps Δp (N, 6), and how far the centres moved (N,) [px].

    (3) of `least_squares`.
    """
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
