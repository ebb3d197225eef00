"""The pixels of many patches: sampling, gradients, and the few products that least squares matching needs of them.

Threads wait for each other between the calls of numpy, and the fewer rows a call has, the larger is the share of waiting. All work on
pixels is therefore done here, in pieces that stay in the cache, and all work on patches (`least_squares`) on many more patches at once.

Constrained matching (`object_space`, `multi_image`) needs the template side only. In all its forms a parameter θ_i with the monomial
m_i(u, v) moves a patch in a search image along a direction, which is the direction s in the template. The design matrix then consists of
the template's gradients alone (the inverse-compositional idea of Baker & Matthews 2004):

    J[:, i] = (fx s_x + fy s_y) m_i ,   m = 1, u, v, ½ u², u v, ½ v²                                            (1)
    Jᵀ W M J = s_x² Mxx + s_x s_y (Mxy + Mxyᵀ) + s_y² Myy ,   M = I − 1 1ᵀ W / ΣW − f̂ f̂ᵀ W                      (2)

with W the pixels' weights, f̂ the patch free of its mean and of unit length, and M the elimination of offset and gain. Mxx, Mxy and Myy
belong to the template, so that normal matrices of any number of search images, in any iteration, cost a few small products.

Weights that decrease towards the rim (a window) are not those of the noise, which is the same in all pixels. The right side of the normal
equations then has the covariance σ² (M J)ᵀ W² M J, which is less than σ² Jᵀ W M J: see `squared`.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..geometry import robust
from ..images.sampling import SplineImage, correlated_noise, difference

PIECE = 1 << 17  # pixels of a piece
NOISE_ENERGY = 4.0  # grey values² / px², energy of a gradient that is taken as noise, not texture
GRADIENT_NOISE = 130 / 144  # variance of the fourth-order central difference, for white noise of variance 1; 1 / 2σ² after smoothing
LEAST_TEXTURE = 0.15  # of the gradients' energy, taken as texture where a centre of gravity is without noise
MOST_OFFSET = 0.75  # of half the patch, between its centre and that centre of gravity
MIN_CONTRAST = 0.5  # grey values, smallest RMS contrast of a patch
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
    contrast: np.ndarray  # (N,) the length before
    q: np.ndarray  # (N, 6) Jᵀ f̂
    mean: np.ndarray  # (N, 6) Jᵀ 1
    second: np.ndarray  # (3, N, 6) sums of fx fx, fx fy, fy fy times 1, u, v, u², u v, v²
    energy: np.ndarray  # (N, 4) means of u, v, u², v², weighted by the gradients' energy above their noise


def template_pixels(image: SplineImage, xy: np.ndarray, shape: np.ndarray | None, half: tuple[int, int]) -> TemplatePixels:
    """The patches about `xy` (N, 2) with shapes (N, 2, 2), by default upright; those about whole pixels need no interpolation."""
    if shape is None and min(image.shape) > 2 * max(half) and np.array_equal(xy, np.rint(xy)):
        f, fx, fy = image.around(xy.astype(np.int64), half)
    else:
        f, fx, fy = _interpolated(image, xy, np.broadcast_to(np.eye(2), (len(xy), 2, 2)) if shape is None else shape, half)
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
    """Products of the patches about c (m, 2) with shapes A (m, 2, 2) of a search image with their `templates` f̂, fx, fy (m, n).

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
    """Slices of `rows` patches of `pixels` pixels each that stay in the cache."""
    step = max(1, PIECE // pixels)
    return (slice(i, min(i + step, rows)) for i in range(0, rows, step))


def _normalise(g: np.ndarray, length: np.ndarray) -> None:
    """Subtract the means of the rows of g (m, n) and divide by their lengths, in place."""
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


def _interpolated(
    image: SplineImage, xy: np.ndarray, shape: np.ndarray, half: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patches and their gradients by fourth-order central differences, interpolated at once with a border of two."""
    w, h = half
    outs = f, fx, fy = [np.empty((len(xy), (2 * h + 1) * (2 * w + 1)), np.float32) for _ in range(3)]
    basis = patch_basis(w + 2, h + 2)
    for rows in pieces(len(xy), basis.shape[1]):
        P = image.sample_patches(xy[rows], shape[rows], basis).reshape(-1, 2 * h + 5, 2 * w + 5)
        for out, a in zip(outs, (P, difference(P, 1), difference(P, 2 * w + 5))):
            out[rows].reshape(len(P), 2 * h + 1, 2 * w + 1)[...] = a.reshape(P.shape)[:, 2:-2, 2:-2]
    return f, fx, fy


class TemplatePatches:
    """N patches of one image about `xy` (N, 2); `weight` (N, n) of their pixels, or None for equal weights.

    `without_noise`: their centres of gravity are those of the gradients' energy beyond that of the image's noise.
    """

    def __init__(
        self,
        image: SplineImage,
        xy: np.ndarray,
        patch_px: int,
        row_step: int,
        *,
        degree: int = 1,
        weight: np.ndarray | None = None,
        without_noise: bool = False,
    ) -> None:
        self.u, self.v, self.half = patch_offsets(patch_px, row_step)
        self.monomials = monomials(self.u, self.v, degree)  # (n, P)
        self.inside = image.inside(xy, np.array(self.half) + 1.0)
        f, fx, fy = _sample(image, np.where(self.inside[:, None], xy, self.half + np.array(3.0)), self.half)
        self._weighted = weight is not None
        self._weight = np.ones_like(f) if weight is None else weight.astype(np.float32)
        self.pixels = self._weight.sum(axis=1).astype(np.float64)  # (N,)
        self.mean_weight = self._weight / np.maximum(self.pixels, 1e-6)[:, None].astype(np.float32)
        f = f - np.einsum("ij,ij->i", f, self.mean_weight)[:, None]
        self.contrast = np.sqrt(np.einsum("ij,ij,ij->i", f, f, self._weight)).astype(np.float64)  # |f̃|
        self.f = f / np.maximum(self.contrast, 1e-6)[:, None].astype(np.float32)
        self.textured = self.inside & (self.contrast > MIN_CONTRAST * np.sqrt(np.maximum(self.pixels, 1.0)))
        self.weighted_f = self.f * self._weight
        self._wfx, self._wfy = fx * self._weight, fy * self._weight
        patch = (-1, 2 * self.half[1] + 1, 2 * self.half[0] + 1)
        self.noise_factor = correlated_noise(self._wfx.reshape(patch), self._wfy.reshape(patch), image.smoothing)  # (N,)
        smooth = image.smoothing[0]
        self.gradient_noise = min(GRADIENT_NOISE, 0.5 / smooth**2 if smooth else GRADIENT_NOISE) / self.noise_factor  # (N,)
        self._centre(fx, fy, 2 * GRADIENT_NOISE * image.noise**2 if without_noise and not smooth else 0.0)
        self._moments(fx, fy)

    def _centre(self, fx: np.ndarray, fy: np.ndarray, noise_energy: float) -> None:
        energy = self._wfx * fx + self._wfy * fy + 1e-3 * self._weight
        total = np.maximum(energy.sum(axis=1, keepdims=True), 1e-9)
        if noise_energy:  # noise lies all over the patch: it draws the centre of weak texture to that of the patch
            energy = energy - np.float32(noise_energy) * self._weight
            total = np.maximum(energy.sum(axis=1, keepdims=True), LEAST_TEXTURE * total)
        moment = (energy @ np.stack([self.u, self.v, self.u**2, self.v**2], axis=1) / total).astype(np.float64)
        if noise_energy:
            out = np.linalg.norm(moment[:, :2] / self.half, axis=1)
            moment[:, :2] *= np.minimum(1.0, MOST_OFFSET / np.maximum(out, 1e-9))[:, None]
        self.offset = moment[:, :2]  # (N, 2) centre of gravity of the gradients' energy
        self.spread = np.maximum(moment[:, 2:] - moment[:, :2] ** 2, 0.0)  # (N, 2)

    def _moments(self, fx: np.ndarray, fy: np.ndarray) -> None:
        self.q = np.stack(self.project(self.f), axis=1)  # (N, 2, P)  Jᵀ W f̂ for s = (1, 0) and (0, 1)
        n = np.sqrt(np.maximum(self.pixels, 1e-6))[:, None, None]
        mean = np.stack([self._sums(self._wfx), self._sums(self._wfy)], axis=1) / n
        C = np.stack([mean, self.q], axis=2)  # (N, 2, 2, P) of Jᵀ W with the two vectors of unit length that M eliminates
        pairs = ((self._wfx * fx, 0, 0), (self._wfx * fy, 0, 1), (self._wfy * fy, 1, 1))
        self.noise_moment = self._products(self._weight)  # of gradients that are noise of variance 1
        self._moment = np.stack([self._products(g) - C[:, i].transpose(0, 2, 1) @ C[:, j] for g, i, j in pairs], axis=1)  # (N, 3, P, P)
        self._squared, self.parameter_pixels = self._moment, np.ones(len(self.pixels))
        if self._weighted:
            self._squared, self.parameter_pixels = self._squared_moments(C)

    def _squared_moments(self, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M J)ᵀ W² M J (N, 3, P, P), and Σ w² / Σ w (N,): the part of the weights' sum by which an unknown reduces the residuals."""
        x, y, w, wf = self._wfx, self._wfy, self._weight, self.weighted_f
        n = np.sqrt(np.maximum(self.pixels, 1e-6))
        share, cross = np.einsum("ij,ij->i", w, w) / n**2, np.einsum("ij,ij->i", w, wf) / n
        E = np.stack([share, cross, cross, np.einsum("ij,ij->i", wf, wf)], axis=1).reshape(-1, 1, 2, 2)
        D = np.stack([np.stack([self._sums(w * g) / n[:, None], self._sums(g * wf)], axis=1) for g in (x, y)], axis=1)
        rest, left = D - E @ C, (C.transpose(0, 1, 3, 2), D.transpose(0, 1, 3, 2))
        pairs = ((x * x, 0, 0), (x * y, 0, 1), (y * y, 1, 1))
        parts = [self._products(g) - left[0][:, i] @ rest[:, j] - left[1][:, i] @ C[:, j] for g, i, j in pairs]
        return np.stack(parts, axis=1), share

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """Products (N, P) of values (N, n) with the monomials."""
        return (values @ self.monomials).astype(np.float64)

    def _products(self, values: np.ndarray) -> np.ndarray:
        """Products (N, P, P) of values (N, n) with the products of two monomials."""
        P = self.monomials.shape[1]
        i, j = np.triu_indices(P)
        place = np.zeros((P, P), dtype=np.int64)
        place[i, j] = place[j, i] = np.arange(len(i))
        return (values @ (self.monomials[:, i] * self.monomials[:, j])).astype(np.float64)[:, place]

    def squared(self) -> "TemplatePatches":
        """The same with normal matrices (M J)ᵀ W² M J: the right side's covariance for noise that is the same in all pixels."""
        same = copy(self)
        same._moment = self._squared
        return same

    def project(self, g: np.ndarray, rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Products (m, P) of g (m, n) with the design matrix (1) for s = (1, 0) and s = (0, 1)."""
        m = self.monomials
        return (self._wfx[rows] * g @ m).astype(np.float64), (self._wfy[rows] * g @ m).astype(np.float64)

    def normal(self, s: np.ndarray, t: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Jᵀ W M J' (m, P, P) of (2) between the directions s and t (m, 2)."""
        M = self._moment[rows]
        cross = M[:, 1]
        return (
            (s[:, 0] * t[:, 0])[:, None, None] * M[:, 0]
            + (s[:, 0] * t[:, 1])[:, None, None] * cross
            + (s[:, 1] * t[:, 0])[:, None, None] * cross.transpose(0, 2, 1)
            + (s[:, 1] * t[:, 1])[:, None, None] * M[:, 2]
        )

    def normal_to_shift(self, s: np.ndarray, t: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """The column of `normal` (m, P) for a shift alone, along t."""
        M = self._moment[rows]
        xx, xy, yx, yy = M[:, 0, :, 0], M[:, 1, :, 0], M[:, 1, 0, :], M[:, 2, :, 0]
        return s[:, :1] * (t[:, :1] * xx + t[:, 1:] * xy) + s[:, 1:] * (t[:, :1] * yx + t[:, 1:] * yy)

    def normal_of_shift(self, s: np.ndarray, t: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """The element of `normal` (m,) for shifts alone, along s and t."""
        M = self._moment[rows, :, 0, 0]
        return s[:, 0] * t[:, 0] * M[:, 0] + (s[:, 0] * t[:, 1] + s[:, 1] * t[:, 0]) * M[:, 1] + s[:, 1] * t[:, 1] * M[:, 2]

    def compare(self, g: np.ndarray, rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Correlation (m,) and the products of M r1 g (m, P), for both directions, of search patches g (m, n)."""
        g = g - np.einsum("ij,ij->i", g, self.mean_weight[rows])[:, None]
        power = np.maximum(np.einsum("ij,ij->i", g, g * self._weight[rows]), 1e-6).astype(np.float64)
        along = np.einsum("ij,ij->i", g, self.weighted_f[rows]).astype(np.float64)
        gain = self.contrast[rows] * along / power
        px, py = self.project(g, rows)
        q, gain = self.q[rows], gain[:, None]
        return along / np.sqrt(power), (gain * (px - q[:, 0] * along[:, None]), gain * (py - q[:, 1] * along[:, None]))

    def residual_variance(self, rho: np.ndarray, parameters: int, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Variance [grey values²] of a pixel after the adjustment, at correlation rho (m,), as white noise of the same effect."""
        lost = self.noise_factor[rows] * self.contrast[rows] ** 2 * np.clip(1 - rho**2, 0, 1)
        return lost / np.maximum(self.pixels[rows] - parameters * self.parameter_pixels[rows], 1.0)


def monomials(u: np.ndarray, v: np.ndarray, degree: int) -> np.ndarray:
    """1, u, v (degree 1) and ½ u², u v, ½ v² (degree 2) as columns (n, 3 or 6) float32."""
    return robust.monomials(u, v, degree).astype(np.float32)


def _sample(image: SplineImage, xy: np.ndarray, half: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patches (N, n) and their gradients by fourth-order central differences, all interpolated at once with a border of two."""
    w, h = half
    v, u = np.mgrid[-h - 2 : h + 3, -w - 2 : w + 3].astype(np.float32)
    x32 = xy.astype(np.float32)
    P = image.sample(x32[:, :1] + u.ravel(), x32[:, 1:] + v.ravel()).reshape(len(xy), 2 * h + 5, 2 * w + 5)
    fx = (8 * (P[:, 2:-2, 3:-1] - P[:, 2:-2, 1:-3]) - (P[:, 2:-2, 4:] - P[:, 2:-2, :-4])) / 12
    fy = (8 * (P[:, 3:-1, 2:-2] - P[:, 1:-3, 2:-2]) - (P[:, 4:, 2:-2] - P[:, :-4, 2:-2])) / 12
    flat = (len(xy), (2 * h + 1) * (2 * w + 1))
    return P[:, 2:-2, 2:-2].reshape(flat), fx.reshape(flat), fy.reshape(flat)
