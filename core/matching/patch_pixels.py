"""The pixels of many patches: looked up, and summed up to the few products that least squares matching needs of them.

Threads wait for each other between the calls of numpy, and the fewer rows a call has, the more of its time is such waiting. Everything of a
pixel is therefore done here, in pieces that stay in the cache, and everything of a patch (`least_squares`) on many more patches at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..images.sampling import SplineImage, difference

PIECE = 1 << 17  # pixels of a piece
NOISE_ENERGY = 4.0  # of a gradient [grey values² / px²]: less is noise, not texture
UPPER = np.triu_indices(3)  # of the products of 1, u, v


@lru_cache(maxsize=64)
def patch_offsets(patch_px: int, row_step: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Patch coordinates u, v (n,) float32 about the centre, and the half size; `row_step` 2 halves the rows (a field)."""
    half_w, half_h = patch_px // 2, max(2, round((patch_px / row_step - 1) / 2))
    _, u, v = patch_basis(half_w, half_h)
    return u, v, (half_w, half_h)


@lru_cache(maxsize=64)
def patch_basis(half_w: int, half_h: int) -> np.ndarray:
    """Rows 1, u, v (3, n) float32 of a patch's pixels."""
    v, u = np.mgrid[-half_h : half_h + 1, -half_w : half_w + 1].astype(np.float32)
    basis = np.stack([np.ones(u.size, np.float32), u.ravel(), v.ravel()])
    basis.setflags(write=False)
    return basis


@dataclass(eq=False, kw_only=True, slots=True)
class TemplatePixels:
    """N patches of n pixels, free of their mean and of unit length, their gradients, and the products of these. float32."""

    f: np.ndarray  # (N, n) f̂
    fx: np.ndarray  # (N, n)
    fy: np.ndarray  # (N, n)
    contrast: np.ndarray  # (N,) the length that was taken out
    q: np.ndarray  # (N, 6) Jᵀ f̂
    mean: np.ndarray  # (N, 6) Jᵀ 1
    second: np.ndarray  # (3, N, 6) sums of fx fx, fx fy, fy fy times 1, u, v, u², u v, v²
    energy: np.ndarray  # (N, 4) means of u, v, u², v², weighted by the gradients' energy above their noise


def template_pixels(image: SplineImage, xy: np.ndarray, shape: np.ndarray | None, half: tuple[int, int]) -> TemplatePixels:
    """The patches about `xy` (N, 2) with shapes (N, 2, 2), by default upright; those about whole pixels need no look-up."""
    if shape is None and min(image.shape) > 2 * max(half) and np.array_equal(xy, np.rint(xy)):
        f, fx, fy = image.around(xy.astype(np.int64), half)
    else:
        f, fx, fy = _looked_up(image, xy, np.broadcast_to(np.eye(2), (len(xy), 2, 2)) if shape is None else shape, half)
    N, n = f.shape
    contrast, q, mean = np.empty(N, np.float32), np.empty((N, 6), np.float32), np.empty((N, 6), np.float32)
    second, energy = np.empty((3, N, 6), np.float32), np.empty((N, 4), np.float32)
    m = _monomials(half)
    products = np.ascontiguousarray(m[:, UPPER[0]] * m[:, UPPER[1]])  # (n, 6)
    moments = np.concatenate([m[:, 1:], m[:, 1:] ** 2], axis=1)
    for rows in pieces(N, n):
        g, x, y = f[rows], fx[rows], fy[rows]
        _normalise(g, contrast[rows])
        xx, xy_, yy = x * x, x * y, y * y
        for total, a in zip(second, (xx, xy_, yy)):
            np.matmul(a, products, out=total[rows])
        xx += yy
        xx -= np.float32(NOISE_ENERGY)
        np.maximum(xx, np.float32(1e-3), out=xx)
        np.divide(xx @ moments, xx.sum(axis=1, keepdims=True), out=energy[rows])
        _project(x, y, g, m, q[rows], xy_)
        mean[rows, :3], mean[rows, 3:] = x @ m, y @ m
    return TemplatePixels(f=f, fx=fx, fy=fy, contrast=contrast, q=q, mean=mean, second=second, energy=energy)


def compare(
    image: SplineImage, c: np.ndarray, A: np.ndarray, half: tuple[int, int], templates: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Products of the patches about c (m, 2) with shapes A (m, 2, 2) of a search image with the `templates` f̂, fx, fy (m, n) beside them.

    With g̃ free of its mean: g̃·g̃ (m,), at least 1e-6; g̃·f̂ (m,); and Jᵀ g̃ (m, 6).
    """
    f, fx, fy = templates
    m, n = f.shape
    power, along, pulled = np.empty(m, np.float32), np.empty(m, np.float32), np.empty((m, 6), np.float32)
    basis, monomials, mean = patch_basis(*half), _monomials(half), _mean(n)
    for rows in pieces(m, n):
        g = image.sample_patches(c[rows], A[rows], basis)
        g -= (g @ mean)[:, None]
        np.einsum("ij,ij->i", g, g, out=power[rows])
        np.einsum("ij,ij->i", g, f[rows], out=along[rows])
        _project(fx[rows], fy[rows], g, monomials, pulled[rows], None)
    return np.maximum(power, np.float32(1e-6), out=power), along, pulled


def pieces(rows: int, pixels: int) -> Iterator[slice]:
    """Pieces of so many patches with so many pixels each."""
    step = max(1, PIECE // pixels)
    return (slice(i, min(i + step, rows)) for i in range(0, rows, step))


def _normalise(g: np.ndarray, length: np.ndarray) -> None:
    """Take means and lengths out of the rows of g (m, n), in place."""
    g -= (g @ _mean(g.shape[1]))[:, None]
    np.sqrt(np.einsum("ij,ij->i", g, g), out=length)
    g *= (1 / np.maximum(length, np.float32(1e-6)))[:, None]


def _project(fx: np.ndarray, fy: np.ndarray, g: np.ndarray, monomials: np.ndarray, out: np.ndarray, work: np.ndarray | None) -> None:
    """Jᵀ g (m, 6), written to `out`."""
    work = np.multiply(fx, g, out=work)
    np.matmul(work, monomials, out=out[:, :3])
    np.multiply(fy, g, out=work)
    np.matmul(work, monomials, out=out[:, 3:])


@lru_cache(maxsize=64)
def _monomials(half: tuple[int, int]) -> np.ndarray:
    """Columns 1, u, v (n, 3) float32."""
    return np.ascontiguousarray(patch_basis(*half).T)


@lru_cache(maxsize=64)
def _mean(n: int) -> np.ndarray:
    return np.full(n, 1 / n, dtype=np.float32)


def _looked_up(image: SplineImage, xy: np.ndarray, shape: np.ndarray, half: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patches and their gradients by fourth-order central differences, in one look-up with a border of two."""
    w, h = half
    outs = f, fx, fy = [np.empty((len(xy), (2 * h + 1) * (2 * w + 1)), np.float32) for _ in range(3)]
    basis = patch_basis(w + 2, h + 2)
    for rows in pieces(len(xy), basis.shape[1]):
        P = image.sample_patches(xy[rows], shape[rows], basis).reshape(-1, 2 * h + 5, 2 * w + 5)
        for out, a in zip(outs, (P, difference(P, 1), difference(P, 2 * w + 5))):
            out[rows].reshape(len(P), 2 * h + 1, 2 * w + 1)[...] = a.reshape(P.shape)[:, 2:-2, 2:-2]
    return f, fx, fy
