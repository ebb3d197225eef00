"""Adaptive least squares matching of many patches at once (Gruen 1985), in the inverse-compositional form (Baker & Matthews 2004).

A patch f of the template image about a point is found in a search image g, moved, sheared and scaled, with another brightness:

    f(u) + e = r0 + r1 g(c + A u) ,   u in the patch                                    (1)

Unknowns: the position c (2), the shape A (2×2) and the radiometry r0, r1. With f̃, g̃ free of their means, f̂ = f̃ / |f̃|, and the design matrix
J = [fx, fx u, fx v, fy, fy u, fy v] of the template's gradients, r0 and r1 are eliminated by M = I − 1 1ᵀ/n − f̂ f̂ᵀ:

    H = Jᵀ M J ,   r1 = |f̃| (g̃·f̂) / (g̃·g̃) ,   Δp = H⁻¹ r1 (Jᵀ g̃ − Jᵀf̂ (g̃·f̂))           (2)
    u → A (I + B)⁻¹ (u − d) + c   with Δp = (d1, B11, B12, d2, B21, B22)                 (3)
    σ0² = |f̃|² (1 − ρ²) / (n − 8) ,   ρ = g̃·f̂ / |g̃| ,   K_c = σ0² A H⁻¹[d] Aᵀ             (4)
    o = Σ u |∇f|² / Σ |∇f|² ,   x_o = c + A o ,   K_o = σ0² A E H⁻¹ Eᵀ Aᵀ , E = [1 o] ⊗ I   (5)

Noise of the template's gradients is in H but does not pull, so a step leaves a part λ of the way to go, with σ the point's sigma, and
no less than a tenth, for the texture's curvature. Where that foresees too little to matter, the next iteration is spared:

    λ = 130/144 σn² n H⁻¹[d] ≈ 0.45 n σ² ,   σ² = 2 σn² H⁻¹[d] of two images of noise σn                           (6)

What was matched is the texture, so the point that is transferred with least bias is the gradients' centre of gravity o of the patch
(Förstner 1984), not its middle: at the outline of a body it lies on the body, where the middle may lie on the background.

H belongs to the template alone, so it is built once; all patches of a chunk are arrays (N, n), and what has converged leaves the arrays.
Coordinates are pixels of the images given (a field's rows count as rows).
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np

from ..geometry.small_matrices import invert_spd, largest, sandwich
from ..images.sampling import SplineImage, correlated_noise
from ..progress import Monitor
from ..settings import knob
from .affine_steps import compose
from .parameter_sets import PARAMETERS, reduced_sets

CHUNK, LARGEST = 512, 1024  # patches that threads do not share; the most that a piece has when they do
_SHARE = os.environ.get("TRICAP_THREADS", "")  # `tricap batch` gives each worker its own
THREADS = int(_SHARE) if _SHARE.isdecimal() and int(_SHARE) > 0 else 2
CONVERGED_SIGMAS = 0.25  # a step below this part of the point's own sigma changes nothing that can be seen
REMAINS_SIGMAS, REMAINS_PX = 0.1, 0.005  # what may remain after the last step where (6) foresees it
GRADIENT_NOISE, CURVATURE = 0.45, 0.1  # of (6)
LINEAR_PX, MIN_CONDITION = 0.25, 1e-6  # (6) holds while no part of the patch moves by more
PER_PATCH = ("inside", "contrast", "f", "fx", "fy", "q", "inverse", "parameters", "offset", "spread", "textured")  # arrays
UPPER, SYMMETRIC = np.triu_indices(3), np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # of a 3×3 matrix: its upper part, and back
NOISE_ENERGY = 4.0  # of a gradient [grey values² / px²]: less is noise, not texture


@dataclass(frozen=True, kw_only=True, slots=True)
class MatchingSettings:
    """Least squares matching and its quality limits (SCIENCE §4: the five indicators of D'Apuzzo et al. 2000)."""

    patch_px: int = knob(13, "Side of the square patch that is compared.", unit="px", low=5, high=51)
    max_iterations: int = knob(20, "Iterations before a patch is given up.", low=2, high=100)
    converged_px: float = knob(
        0.01, "A patch has converged when it moves by less than this, or by a small part of its sigma.", unit="px", low=1e-4, high=0.5
    )
    max_shift_px: float = knob(3.0, "Largest distance of the result from its start.", unit="px", low=0.5, high=20.0)
    max_sigma_px: float = knob(0.25, "Largest standard deviation of a matched position.", unit="px", low=0.01, high=2.0)
    min_correlation: float = knob(0.75, "Smallest correlation of the matched patches.", low=0.0, high=0.999)
    max_sigma0: float = knob(35.0, "Largest sigma0, in grey values of a patch whose contrast is set to 50.", low=1.0, high=100.0)
    constraint: str = knob(
        "object",
        "Geometry in the matching: none, collinearity observations (epipolar), or one piece of surface seen by all views (object).",
        choices=("none", "epipolar", "object"),
    )
    neighbours: bool = knob(
        True, "What neighbouring points say of the surface enters constrained matching as observations, not as its start alone."
    )
    max_rim_sigma_px: float = knob(
        0.0, "Weak texture is matched without its shape where noise would move the patch's rim by more; 0: never.", unit="px", low=0, high=2
    )
    max_shear: float = knob(0.75, "Largest change of the patch's shape from its start.", low=0.1, high=3.0)


class MatchStatus(IntEnum):
    """Why a match is good or not; a point that failed keeps its row."""

    OK = 0
    OUT_OF_IMAGE = 1
    NO_TEXTURE = 2
    NOT_CONVERGED = 3
    SHIFT_TOO_LARGE = 4
    SHAPE_TOO_LARGE = 5
    LOW_CORRELATION = 6
    SIGMA_TOO_LARGE = 7
    SIGMA0_TOO_LARGE = 8
    NOT_TRIED = 9


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Matches:
    """N patches found (or not) in one search image. Pixels of that image."""

    xy: np.ndarray  # (N, 2) position of the patch's middle
    shape: np.ndarray  # (N, 2, 2) the affine shape A
    covariance: np.ndarray  # (N, 2, 2) of xy [px²]
    offset: np.ndarray  # (N, 2) o of (5), from the patch's middle, in the template
    spread: np.ndarray  # (N, 2) variance of the gradients' energy about o [px²]
    transfer_covariance: np.ndarray  # (N, 2, 2) of transfer_xy [px²]
    sigma0: np.ndarray  # (N,) grey values of a patch whose contrast is 50
    correlation: np.ndarray  # (N,)
    iterations: np.ndarray  # (N,)
    parameters: np.ndarray  # (N,) 8 unknowns, or 6 or 4 where the texture cannot tell the shape
    status: np.ndarray  # (N,) MatchStatus

    @property
    def transfer_xy(self) -> np.ndarray:
        """(N, 2) position of the texture's centre of gravity, x_o of (5)."""
        return self.xy + np.einsum("nij,nj->ni", self.shape, self.offset)

    @property
    def ok(self) -> np.ndarray:
        """(N,) which patches passed all limits."""
        return self.status == MatchStatus.OK


@lru_cache(maxsize=64)
def patch_offsets(patch_px: int, row_step: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Patch coordinates u, v (n,) float32 about the centre, and the half size; `row_step` 2 halves the rows (a field)."""
    half_w, half_h = patch_px // 2, max(2, round((patch_px / row_step - 1) / 2))
    _, u, v = _basis(half_w, half_h)
    return u, v, (half_w, half_h)


def match_patches(
    template: SplineImage,
    xy: np.ndarray,
    searches: Sequence[SplineImage],
    starts: Sequence[np.ndarray],
    shapes: Sequence[np.ndarray],
    settings: MatchingSettings,
    *,
    row_step: int = 1,
    template_shape: np.ndarray | None = None,
    of_texture: bool = True,
    monitor: Monitor | None = None,
) -> list[Matches]:
    """Find the patches about `xy` (N, 2) of the template image in each search image.

    `starts` are the approximate positions (N, 2) and `shapes` the approximate affine shapes (N, 2, 2), one of each per search image.
    `template_shape` (N, 2, 2) warps the patch in the template itself (a patch that was itself matched). NaN starts are OUT_OF_IMAGE.
    Without `of_texture` the patch's middle stands for the texture's centre of gravity (5). Cost: 8 µs per patch of 13×13 and image.
    """
    n = len(xy)
    spans = _spans(n)

    def work(span: slice) -> list[Matches]:
        if monitor is not None and monitor.cancelled:
            monitor.step("matching", span.start, n)
        drawn = None if template_shape is None else template_shape[span]
        patches = PatchTemplates(template, xy[span], settings, row_step, drawn, of_texture=of_texture)
        return [patches.find(g, s[span], A[span]) for g, s, A in zip(searches, starts, shapes)]

    if len(spans) > 1:
        with ThreadPoolExecutor(THREADS) as pool:
            parts = list(pool.map(work, spans))
    else:
        parts = [work(span) for span in spans] or [[_empty() for _ in searches]]
    return [join_matches([part[k] for part in parts]) for k in range(len(searches))]


def prepare_templates(image: SplineImage, xy: np.ndarray, settings: MatchingSettings, row_step: int) -> "PatchTemplates":
    """The template side of the patches about `xy` (N, 2), to be matched many times by their middles."""
    spans = _spans(len(xy)) or [slice(0, 0)]
    return PatchTemplates.joined([PatchTemplates(image, xy[span], settings, row_step, None, of_texture=False) for span in spans])


def match_prepared(templates: "PatchTemplates", rows: np.ndarray, image: SplineImage, start: np.ndarray, shape: np.ndarray) -> Matches:
    """Find the prepared templates `rows` (N,) in an image, from positions `start` (N, 2) and shapes (N, 2, 2)."""
    spans = _spans(len(rows)) or [slice(0, 0)]
    all_in_order = np.array_equal(rows, np.arange(len(templates.inside)))  # most often: slices then, no copies

    def work(span: slice) -> Matches:
        return templates.select(span if all_in_order else rows[span]).find(image, start[span], shape[span])

    if len(spans) == 1:
        return work(spans[0])
    with ThreadPoolExecutor(THREADS) as pool:
        return join_matches(list(pool.map(work, spans)))


def _spans(n: int) -> list[slice]:
    """Equal pieces of n patches: small enough for the cache, large enough for arrays to pay, and two where two threads can share them."""
    count = max(-(-n // LARGEST), THREADS if n > CHUNK else 1)
    cuts = [n * i // count for i in range(count + 1)]
    return [slice(a, b) for a, b in zip(cuts, cuts[1:])] if n else []


def join_matches(parts: Sequence[Matches]) -> Matches:
    """One after the other, rows kept in order."""
    names = Matches.__dataclass_fields__
    return Matches(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


class PatchTemplates:
    """The template side of a chunk: patches, gradients, and the inverse of the reduced normal matrix."""

    def __init__(
        self, image: SplineImage, xy: np.ndarray, settings: MatchingSettings, row_step: int, shape: np.ndarray | None, *, of_texture: bool
    ) -> None:
        self._settings, self._of_texture = settings, of_texture
        self._u, self._v, self._half = patch_offsets(settings.patch_px, row_step)
        self.n_pixels = len(self._u)
        self._pixels = _basis(*self._half)  # (3, n)
        self._monomials = np.ascontiguousarray(self._pixels.T)  # (n, 3)
        self._mean = np.full(self.n_pixels, 1 / self.n_pixels, dtype=np.float32)
        self.inside = image.inside(xy, np.array(self._half) + 1.0)
        f, fx, fy = self._sample(image, np.where(self.inside[:, None], xy, 0.0), shape)
        f -= (f @ self._mean)[:, None]
        self.contrast = np.sqrt(np.einsum("ij,ij->i", f, f))
        f *= (1 / np.maximum(self.contrast, np.float32(1e-6)))[:, None]
        self.f = f
        self.fx, self.fy = fx, fy
        self.q = self._project(self.f)  # Jᵀ f̂
        H = self._normal_matrix()
        scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", H), 1e-9))
        eye = np.eye(6) * MIN_CONDITION
        self.inverse = invert_spd(H * scale[:, :, None] * scale[:, None, :] + eye) * scale[:, :, None] * scale[:, None, :]
        self.inverse, self.parameters = reduced_sets(H, self.inverse, image.noise, settings.patch_px / 2, settings.max_rim_sigma_px)
        self.offset: np.ndarray = np.zeros((len(xy), 2))
        self.spread = self.offset
        if of_texture:
            self.offset, self.spread = self._centre_of_gravity()
        patch = (-1, 2 * self._half[1] + 1, 2 * self._half[0] + 1)
        self.noise_factor = correlated_noise(fx.reshape(patch), fy.reshape(patch), image.smoothing)
        self.textured = self.contrast > 0.5 * np.sqrt(self.n_pixels)

    def select(self, rows: np.ndarray | slice) -> "PatchTemplates":
        """Only these rows (a mask, indices or a slice)."""
        chosen = copy(self)
        for name in PER_PATCH:
            setattr(chosen, name, getattr(self, name)[rows])
        return chosen

    @staticmethod
    def joined(parts: "Sequence[PatchTemplates]") -> "PatchTemplates":
        """One after the other; all of one size of patch."""
        whole = copy(parts[0])
        for name in PER_PATCH:
            setattr(whole, name, np.concatenate([getattr(part, name) for part in parts]))
        return whole

    def _sample(self, image: SplineImage, xy: np.ndarray, shape: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Patch and its gradients by fourth-order central differences, all in one look-up with a border of two."""
        w, h = self._half
        A = np.broadcast_to(np.eye(2), (len(xy), 2, 2)) if shape is None else shape
        P = image.sample_patches(xy, A, _basis(w + 2, h + 2)).reshape(len(xy), 2 * h + 5, 2 * w + 5)
        flat = (len(xy), self.n_pixels)
        f, fx, fy = (a.reshape(P.shape)[:, 2:-2, 2:-2].reshape(flat) for a in (P, _difference(P, 1), _difference(P, 2 * w + 5)))
        return f, fx, fy

    def _centre_of_gravity(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance (m, 2) of the patch coordinates, weighted by the energy of the gradients above their noise.  (5)"""
        energy = self.fx**2 + self.fy**2
        energy = np.maximum(energy - NOISE_ENERGY, 1e-3)
        total = energy.sum(axis=1, keepdims=True)
        uv = np.stack([self._u, self._v, self._u**2, self._v**2], axis=1)
        moment = (energy @ uv / total).astype(np.float64)
        return moment[:, :2], moment[:, 2:] - moment[:, :2] ** 2

    def _project(self, g: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Jᵀ g (m, 6)."""
        return np.concatenate([(self.fx[rows] * g) @ self._monomials, (self.fy[rows] * g) @ self._monomials], axis=1)

    def _normal_matrix(self) -> np.ndarray:
        """H = Jᵀ M J (m, 6, 6), from products of the gradients with the monomials up to second order.  (2)"""
        m = self._monomials
        second = np.ascontiguousarray(m[:, UPPER[0]] * m[:, UPPER[1]])  # (n, 6)
        xx, xy, yy = ((a * b @ second)[:, SYMMETRIC] for a, b in ((self.fx, self.fx), (self.fx, self.fy), (self.fy, self.fy)))
        H = np.concatenate([np.concatenate([xx, xy], 2), np.concatenate([xy, yy], 2)], 1).astype(np.float64)
        mean, q = np.concatenate([self.fx @ m, self.fy @ m], axis=1).astype(np.float64), self.q.astype(np.float64)
        return H - mean[:, :, None] * mean[:, None, :] / self.n_pixels - q[:, :, None] * q[:, None, :]

    def find(self, image: SplineImage, start: np.ndarray, shape: np.ndarray) -> Matches:
        """Iterate (2) and (3) for all patches, then judge them."""
        s, n = self._settings, len(start)
        c, A = np.array(start, dtype=np.float64), np.array(shape, dtype=np.float64)
        status = np.full(n, MatchStatus.NOT_CONVERGED, dtype=np.int8)
        status[~self.textured] = MatchStatus.NO_TEXTURE
        status[~(self.inside & image.inside(c, 0.0))] = MatchStatus.OUT_OF_IMAGE
        correlation, iterations = np.zeros(n), np.zeros(n, dtype=np.int16)
        active = np.flatnonzero(status == MatchStatus.NOT_CONVERGED)
        for iteration in range(1, s.max_iterations + 1):
            if not len(active):
                break
            step, rho, gain = self._step(image, c[active], A[active], slice(None) if len(active) == n else active)  # all: no copies
            c[active], A[active], moved = compose(c[active], A[active], step)
            gone = (largest(c[active] - start[active]) > 2 * s.max_shift_px) | ~np.isfinite(moved)
            near, spared = self._converged(step, moved, self._sigma(rho, active))
            correlation[active], iterations[active] = np.where(spared, np.sqrt(np.minimum(rho**2 + gain, 1.0)), rho), iteration
            done = near | spared
            status[active[done]] = MatchStatus.OK
            status[active[gone]] = MatchStatus.SHIFT_TOO_LARGE
            active = active[~(done | gone)]
        return self._judge(image, start, shape, c, A, status, correlation, iterations)

    def _step(self, image: SplineImage, c: np.ndarray, A: np.ndarray, rows: np.ndarray | slice) -> tuple[np.ndarray, ...]:
        """Δp of (2) (m, 6), the correlation ρ (m,) before it, and what it adds to ρ² where it is small enough to be linear."""
        g = image.sample_patches(c, A, self._pixels)
        g -= (g @ self._mean)[:, None]
        power = np.maximum(np.einsum("ij,ij->i", g, g), 1e-6)
        along = np.einsum("ij,ij->i", g, self.f[rows])
        gain = self.contrast[rows] * along / power  # r1
        rhs = ((self._project(g, rows) - self.q[rows] * along[:, None]) * gain[:, None]).astype(np.float64)
        step = np.einsum("nij,nj->ni", self.inverse[rows], rhs)
        explained = np.einsum("ni,ni->n", step, rhs) / np.maximum(self.contrast[rows], 1e-6) ** 2
        return step, along / np.sqrt(power), explained

    def _converged(self, step: np.ndarray, moved: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which patches' last step was small; and for which it foresees by (6) that the next would be."""
        rate = np.maximum(CURVATURE, GRADIENT_NOISE * self.n_pixels * sigma**2)
        linear = moved + self._half[0] * largest(step[:, [1, 2, 4, 5]]) <= LINEAR_PX
        spared = linear & (moved < np.maximum(REMAINS_PX, REMAINS_SIGMAS * sigma) / rate)
        return moved < np.maximum(self._settings.converged_px, CONVERGED_SIGMAS * sigma), spared

    def _sigma(self, rho: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Standard deviation of the position in the template [px] at correlation rho.  (4)"""
        variance = self.contrast[rows].astype(np.float64) ** 2 * np.clip(1 - rho**2, 0, 1) / max(1, self.n_pixels - PARAMETERS)
        return np.sqrt(variance * np.maximum(self.inverse[rows, 0, 0], self.inverse[rows, 3, 3]))

    def _judge(
        self,
        image: SplineImage,
        start: np.ndarray,
        start_shape: np.ndarray,
        c: np.ndarray,
        A: np.ndarray,
        status: np.ndarray,
        correlation: np.ndarray,
        iterations: np.ndarray,
    ) -> Matches:
        s = self._settings
        dof = max(1, self.n_pixels - PARAMETERS)
        lost = np.clip(1 - correlation**2, 0, 1)
        variance = self.noise_factor * self.contrast.astype(np.float64) ** 2 * lost / dof  # (4)
        K = K_o = variance[:, None, None] * sandwich(A, self.inverse[:, ::3, ::3])
        if self._of_texture:
            E = np.concatenate([np.ones((len(c), 1)), self.offset], axis=1)
            transferred = np.einsum("nabj,nj->nab", np.einsum("naibj,ni->nabj", self.inverse.reshape(-1, 2, 3, 2, 3), E), E)  # (5)
            K_o = variance[:, None, None] * sandwich(A, transferred)
        sigma0 = 50 * np.sqrt(lost * self.n_pixels / dof)
        sigma = np.sqrt(np.maximum(np.maximum(K[:, 0, 0], K[:, 1, 1]), 0))
        for bad, why in (
            (largest(c - start) > s.max_shift_px, MatchStatus.SHIFT_TOO_LARGE),
            (~image.inside(c, np.array(self._half) * 0.5), MatchStatus.OUT_OF_IMAGE),
            (largest((A - start_shape).reshape(-1, 4)) > s.max_shear, MatchStatus.SHAPE_TOO_LARGE),
            (correlation < s.min_correlation, MatchStatus.LOW_CORRELATION),
            (sigma > s.max_sigma_px, MatchStatus.SIGMA_TOO_LARGE),
            (sigma0 > s.max_sigma0, MatchStatus.SIGMA0_TOO_LARGE),
        ):
            status[(status == MatchStatus.OK) & bad] = why
        return Matches(
            xy=c,
            shape=A,
            covariance=K,
            offset=self.offset,
            spread=self.spread,
            transfer_covariance=K_o,
            sigma0=sigma0,
            correlation=correlation,
            iterations=iterations,
            parameters=self.parameters,
            status=status,
        )


@lru_cache(maxsize=64)
def _basis(half_w: int, half_h: int) -> np.ndarray:
    """Rows 1, u, v (3, n) float32 of a patch's pixels."""
    v, u = np.mgrid[-half_h : half_h + 1, -half_w : half_w + 1].astype(np.float32)
    basis = np.stack([np.ones(u.size, np.float32), u.ravel(), v.ravel()])
    basis.setflags(write=False)
    return basis


def _difference(values: np.ndarray, step: int) -> np.ndarray:
    """Central differences of fourth order from the values `step` and 2 `step` away in the flattened array; zero at its ends."""
    p = values.reshape(-1)
    out = np.zeros(p.size, np.float32)
    if p.size > 4 * step:
        near, far = out[2 * step : -2 * step], p[4 * step :] - p[: -4 * step]
        np.subtract(p[3 * step : -step], p[step : -3 * step], out=near)
        near *= np.float32(2 / 3)
        far *= np.float32(1 / 12)
        near -= far
    return out


def _empty() -> Matches:
    pairs, matrices, z = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)
    return Matches(xy=pairs, shape=matrices, covariance=matrices, offset=pairs, spread=pairs, transfer_covariance=matrices, sigma0=z,
                   correlation=z, iterations=z.astype(np.int16), parameters=z.astype(np.int8), status=z.astype(np.int8))  # fmt: skip
