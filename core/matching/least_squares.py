"""Adaptive least squares matching of many patches at once (Gruen 1985), in the inverse-compositional form (Baker & Matthews 2004).

A patch f of the template image about a point is found in a search image g, moved, sheared and scaled, with another brightness:

    f(u) + e = r0 + r1 g(c + A u) ,   u in the patch                                    (1)

Unknowns: the position c (2), the shape A (2×2) and the radiometry r0, r1. With f̃, g̃ free of their means, f̂ = f̃ / |f̃|, and the design matrix
J = [fx, fx u, fx v, fy, fy u, fy v] of the template's gradients, r0 and r1 are eliminated by M = I − 1 1ᵀ/n − f̂ f̂ᵀ:

    H = Jᵀ M J ,   r1 = |f̃| (g̃·f̂) / (g̃·g̃) ,   Δp = H⁻¹ r1 (Jᵀ g̃ − Jᵀf̂ (g̃·f̂))           (2)
    u → A (I + B)⁻¹ (u − d) + c   with Δp = (d1, B11, B12, d2, B21, B22)                 (3)
    σ0² = |f̃|² (1 − ρ²) / (n − 8) ,   ρ = g̃·f̂ / |g̃| ,   K_c = σ0² A H⁻¹[d] Aᵀ             (4)
    o = Σ u |∇f|² / Σ |∇f|² ,   x_o = c + A o ,   K_o = σ0² A E H⁻¹ Eᵀ Aᵀ , E = [1 o] ⊗ I   (5)

Noise of the template's gradients is in H but does not pull the patch, so that a step leaves a part λ of the distance, with σ the point's
sigma, and no less than a tenth because of the texture's curvature. Where this predicts a negligible rest, the next iteration is spared:

    λ = 130/144 σn² n H⁻¹[d] ≈ 0.45 n σ² ,   σ² = 2 σn² H⁻¹[d] of two images of noise σn                           (6)

What is matched is the texture, so that the point which is transferred with least bias is the centre of gravity o of the patch's gradients
(Förstner 1984), not its centre: at the outline of a body it lies on the body, where the patch's centre may lie on the background.

Where the texture does not determine a patch's shape, smaller parameter sets are used (Gruen 1985 excludes parameters that cannot be
determined). An error of a shape parameter moves the rim of the patch by half its width times that error. Where the noise of both images
alone moves it by more than a limit, the shears are left out (6 unknowns: shift, two scales, radiometry), then the scales, too (4: shift,
radiometry); the shape then stays that of the start.

H belongs to the template alone and is built once; all patches of a piece, in all search images, are arrays, which converged patches leave.
Coordinates are pixels of the images given (a field's rows count as rows).
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np

from ..foundation.progress import Monitor
from ..foundation.settings import knob
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.small_matrices import invert_spd, largest, sandwich
from ..images.sampling import SplineImage, correlated_noise
from .parameter_sets import PARAMETERS, reduced_sets
from .patches import compare, patch_offsets, template_pixels

LARGEST = 4096  # patches of a piece
SHARED_FROM = 513  # patches from which on threads share them
MIN_CONDITION = 1e-6  # added to the scaled diagonal of the whole one
MAX_STEP_PX = 2.0  # px, longer steps are shortened
MIN_DETERMINANT = 0.1  # of I + B; a smaller one has no usable inverse
COMPACT_BELOW = 0.75  # of the patches at work: if fewer still move, the others are taken out of the arrays
CONVERGED_SIGMAS = 0.25  # a step below this part of the point's own sigma is the last
REST_SIGMAS = 0.1  # of the point's sigma, rest after the last step that is accepted where (6) predicts it
REST_PX = 0.005  # px, the same, where it is more
GRADIENT_NOISE = 0.45  # of (6)
CURVATURE_RATE = 0.1  # smallest λ of (6)
GIVE_UP = ((5, 0.15), (9, 0.05))  # iterations after which a patch is given up whose correlation is so much below the smallest
LINEAR_PX = 0.25  # px by which any part of the patch may move for (6) to apply
SIGMA0_CONTRAST = 50  # grey values: contrast to which the patches are scaled for the reported sigma0
INSIDE_SHARE = 0.5  # of half the patch: a match must lie this far inside the search image
TEXTURED_RMS = 0.5  # grey values, smallest RMS contrast of a patch
SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # a 3×3 matrix from its upper part
PER_PATCH = ("inside", "contrast", "f", "fx", "fy", "q", "inverse", "parameters", "offset", "spread", "noise_factor", "textured")  # arrays


@dataclass(frozen=True, kw_only=True, slots=True)
class MatchingSettings:
    """Least squares matching and its quality limits (the five indicators of D'Apuzzo et al. 2000, §2.2)."""

    patch_px: int = knob(13, "Side of the square patch that is compared.", unit="px", low=5, high=51)
    max_iterations: int = knob(20, "Iterations after which a patch has failed.", low=2, high=100)
    converged_px: float = knob(
        0.01, "A patch has converged when it moves by less than this, or by a small part of its sigma.", unit="px", low=1e-4, high=0.5
    )
    max_shift_px: float = knob(3.0, "Largest distance of the result from its start.", unit="px", low=0.5, high=20.0)
    max_sigma_px: float = knob(0.25, "Largest standard deviation of a matched position.", unit="px", low=0.01, high=2.0)
    min_correlation: float = knob(0.75, "Smallest correlation of the matched patches.", low=0.0, high=0.999)
    max_sigma0: float = knob(35.0, "Largest sigma0, in grey values of a patch whose contrast is set to 50.", low=1.0, high=100.0)
    constraint: str = knob(
        "object",
        "Geometric constraint: none, collinearity observations (epipolar), or one piece of surface common to all views (object).",
        choices=("none", "epipolar", "object"),
    )
    neighbours: bool = knob(
        True, "The surface through the neighbouring points enters constrained matching as observations, not only as its start."
    )
    max_rim_sigma_px: float = knob(
        0.0, "Where noise would move the rim of a patch by more, its shape is not estimated; 0: always estimated.", unit="px", low=0, high=2
    )
    max_shear: float = knob(0.75, "Largest change of the patch's shape from its start.", low=0.1, high=3.0)


class MatchStatus(IntEnum):
    """Whether a match is good, or the limit that it exceeds; a point that failed keeps its row."""

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

    xy: np.ndarray  # (N, 2) position of the patch's centre
    shape: np.ndarray  # (N, 2, 2) the affine shape A
    covariance: np.ndarray  # (N, 2, 2) of xy [px²]
    offset: np.ndarray  # (N, 2) o of (5), from the patch's centre, in the template
    spread: np.ndarray  # (N, 2) variance of the gradients' energy about o [px²]
    transfer_covariance: np.ndarray  # (N, 2, 2) of transfer_xy [px²]
    sigma0: np.ndarray  # (N,) grey values of a patch whose contrast is 50
    correlation: np.ndarray  # (N,)
    iterations: np.ndarray  # (N,)
    parameters: np.ndarray  # (N,) 8 unknowns, or 6 or 4 where the texture does not determine the shape
    status: np.ndarray  # (N,) MatchStatus

    @property
    def transfer_xy(self) -> np.ndarray:
        """(N, 2) position of the texture's centre of gravity, x_o of (5)."""
        return self.xy + np.einsum("nij,nj->ni", self.shape, self.offset)

    @property
    def ok(self) -> np.ndarray:
        """(N,) which patches passed all limits."""
        return self.status == MatchStatus.OK


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TemplatePoints:
    """N points of a template image whose patches are to be matched."""

    image: SplineImage
    xy: np.ndarray  # (N, 2) pixels of the image
    shape: np.ndarray | None = None  # (N, 2, 2) warps the patches in the template itself (they were matched there); None: upright squares
    row_step: int = 1  # frame rows from one row of the image to the next: 2 in a field
    texture_centre: bool = True  # transfer the texture's centre of gravity (5); False: the patch's centre

    def select(self, rows: slice) -> "TemplatePoints":
        """Only these points."""
        return replace(self, xy=self.xy[rows], shape=None if self.shape is None else self.shape[rows])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SearchImage:
    """An image in which N patches are searched for, and their approximate warps there."""

    image: SplineImage
    start: np.ndarray  # (N, 2) approximate positions; NaN ends as OUT_OF_IMAGE
    shape: np.ndarray  # (N, 2, 2) approximate affine shapes

    def select(self, rows: slice) -> "SearchImage":
        """Only these patches."""
        return SearchImage(image=self.image, start=self.start[rows], shape=self.shape[rows])


def match_patches(
    template: TemplatePoints,
    searches: Sequence[SearchImage],
    settings: MatchingSettings,
    *,
    needed: int = 0,
    monitor: Monitor | None = None,
) -> list[Matches]:
    """Match the patches about the template points in each search image. Cost: 5 µs per patch of 13×13 and image.

    A point that fewer than `needed` images can still match is given up; it is NOT_CONVERGED in the others.
    """
    n = len(template.xy)

    def work(span: slice) -> list[Matches]:
        if monitor is not None and monitor.cancelled:
            monitor.step("matching", span.start, n)
        return PatchTemplates(template.select(span), settings).find([search.select(span) for search in searches], needed)

    parts = in_threads(work, _pieces(n))
    return [join_matches([part[k] for part in parts]) for k in range(len(searches))]


def prepare_templates(template: TemplatePoints, settings: MatchingSettings) -> "PatchTemplates":
    """The template side of the patches about these points, to be matched many times."""
    return PatchTemplates.joined(in_threads(lambda span: PatchTemplates(template.select(span), settings), _pieces(len(template.xy))))


def match_prepared(templates: "PatchTemplates", rows: np.ndarray, search: SearchImage) -> Matches:
    """Match the prepared templates `rows` (N,) in an image."""
    all_in_order = np.array_equal(rows, np.arange(len(templates.inside)))  # most often: slices then, no copies

    def work(span: slice) -> Matches:
        return templates.select(span if all_in_order else rows[span]).find([search.select(span)])[0]

    return join_matches(in_threads(work, _pieces(len(rows))))


def _pieces(n: int) -> list[slice]:
    return equal_pieces(n, LARGEST, SHARED_FROM)


def join_matches(parts: Sequence[Matches]) -> Matches:
    """The matches of all parts, one after the other."""
    names = Matches.__dataclass_fields__
    return Matches(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


class PatchTemplates:
    """The template side of a piece: patches, gradients, and the inverse of the reduced normal matrix."""

    def __init__(self, template: TemplatePoints, settings: MatchingSettings) -> None:
        image, xy = template.image, template.xy
        self._settings, self._texture_centre = settings, template.texture_centre
        u, _, self.half = patch_offsets(settings.patch_px, template.row_step)
        self.n_pixels = len(u)
        self.inside = image.inside(xy, np.array(self.half) + 1.0)
        p = template_pixels(image, np.where(self.inside[:, None], xy, 0.0), template.shape, self.half)
        self.f, self.fx, self.fy, self.contrast, self.q = p.f, p.fx, p.fy, p.contrast, p.q
        H = self._normal_matrix(p.second, p.mean)
        scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", H), 1e-9))
        eye = np.eye(6) * MIN_CONDITION
        self.inverse = invert_spd(H * scale[:, :, None] * scale[:, None, :] + eye) * scale[:, :, None] * scale[:, None, :]
        self.inverse, self.parameters = reduced_sets(H, self.inverse, image.noise, settings.patch_px / 2, settings.max_rim_sigma_px)
        self.offset: np.ndarray = np.zeros((len(xy), 2))
        self.spread = self.offset
        if template.texture_centre:
            energy = p.energy.astype(np.float64)
            self.offset, self.spread = energy[:, :2], energy[:, 2:] - energy[:, :2] ** 2  # (5)
        patch = (-1, 2 * self.half[1] + 1, 2 * self.half[0] + 1)
        self.noise_factor = correlated_noise(p.fx.reshape(patch), p.fy.reshape(patch), image.smoothing)
        self.textured = self.contrast > TEXTURED_RMS * np.sqrt(self.n_pixels)

    def select(self, rows: np.ndarray | slice) -> "PatchTemplates":
        """Only these rows (a mask, indices or a slice)."""
        chosen = copy(self)
        for name in PER_PATCH:
            setattr(chosen, name, getattr(self, name)[rows])
        return chosen

    @staticmethod
    def joined(parts: "Sequence[PatchTemplates]") -> "PatchTemplates":
        """The templates of all parts, one after the other; all of one patch size."""
        whole = copy(parts[0])
        for name in PER_PATCH:
            setattr(whole, name, np.concatenate([getattr(part, name) for part in parts]))
        return whole

    def _normal_matrix(self, second: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """H = Jᵀ M J (m, 6, 6), from products of the gradients with the monomials up to second order.  (2)"""
        xx, xy, yy = second[:, :, SYMMETRIC]
        H = np.concatenate([np.concatenate([xx, xy], 2), np.concatenate([xy, yy], 2)], 1).astype(np.float64)
        mean, q = mean.astype(np.float64), self.q.astype(np.float64)
        return H - mean[:, :, None] * mean[:, None, :] / self.n_pixels - q[:, :, None] * q[:, None, :]

    def find(self, searches: Sequence[SearchImage], needed: int = 0) -> list[Matches]:
        """Iterate (2) and (3) for all patches in every image, then judge them. Rows go image after image."""
        N, transferred = len(self.inside), self._transferred()
        start, shape = (
            np.concatenate([np.asarray(a, dtype=np.float64) for a in of_images])
            for of_images in ([search.start for search in searches], [search.shape for search in searches])
        )
        settled = self._settled([search.image for search in searches], start, shape, self._usable(searches), needed)
        spans = [slice(k * N, (k + 1) * N) for k in range(len(searches))]
        return [
            self._judge(SearchImage(image=search.image, start=start[r], shape=shape[r]), settled.select(r), transferred)
            for search, r in zip(searches, spans)
        ]

    def _settled(
        self, images: Sequence[SplineImage], start: np.ndarray, shape: np.ndarray, status: np.ndarray, needed: int = 0
    ) -> "_Settled":
        """The results of (2) and (3) for the patches that begin as NOT_CONVERGED."""
        s = self._settings
        c, A, correlation, iterations = start.copy(), shape.copy(), np.zeros(len(start)), np.zeros(len(start), dtype=np.int16)
        chances = _Chances(status, len(self.inside), needed)
        alive = (status == MatchStatus.NOT_CONVERGED) & chances.left(np.arange(len(start)))
        harmless = _starts_at_work(start, alive, len(images))  # finished patches still take part in steps, there
        place, at, warp = np.arange(len(c)), np.where(alive[:, None], c, harmless), np.where(alive[:, None, None], A, np.eye(2))
        work = _AtWork(self, images, place)
        for iteration in range(1, s.max_iterations + 1):
            if not alive.any():
                break
            if np.count_nonzero(alive) < COMPACT_BELOW * len(alive):
                place, at, warp, alive = place[alive], at[alive], warp[alive], alive[alive]
                work = _AtWork(self, images, place)
            step, rho, gain = work.step(at, warp)
            at, warp, moved = compose(at, warp, step)
            lost = (largest(at - start[place]) > 2 * s.max_shift_px) | ~np.isfinite(moved)
            lost |= largest((warp - shape[place]).reshape(-1, 4)) > 2 * s.max_shear
            near, spared = self._converged(step, moved, work.sigma(rho))
            found = alive & (near | spared) & ~lost
            low = alive & ~found & (rho < s.min_correlation - _shortfall(iteration))
            rho = np.where(spared, np.sqrt(np.minimum(rho**2 + gain, 1.0)), rho)
            failed = alive & (lost | low | (found & (rho < s.min_correlation)) | ((iteration == s.max_iterations) & ~found))
            chances.lose(place[failed])
            finished = np.flatnonzero(alive & (found | failed | ~chances.left(place)))
            here = place[finished]
            c[here], A[here], correlation[here], iterations[here] = at[finished], warp[finished], rho[finished], iteration
            status[place[found]] = MatchStatus.OK
            status[place[alive & lost]] = MatchStatus.SHIFT_TOO_LARGE
            status[place[low & ~lost]] = MatchStatus.LOW_CORRELATION
            alive[finished] = False
            at[lost], warp[lost] = harmless[place[lost]], np.eye(2)
        return _Settled(c=c, A=A, status=status, correlation=correlation, iterations=iterations)

    def _usable(self, searches: Sequence[SearchImage]) -> np.ndarray:
        """The statuses that patches have before they move; NOT_CONVERGED are those that can be matched."""
        lost = ~np.concatenate([search.image.inside(search.start, 0.0) & self.inside for search in searches])
        status = np.where(np.tile(self.textured, len(searches)), MatchStatus.NOT_CONVERGED, MatchStatus.NO_TEXTURE).astype(np.int8)
        status[lost] = MatchStatus.OUT_OF_IMAGE
        return status

    def _converged(self, step: np.ndarray, moved: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which patches' last step was small; and for which it predicts by (6) that the next would be."""
        rate = np.maximum(CURVATURE_RATE, GRADIENT_NOISE * self.n_pixels * sigma**2)
        linear = moved + self.half[0] * largest(step[:, [1, 2, 4, 5]]) <= LINEAR_PX
        spared = linear & (moved < np.maximum(REST_PX, REST_SIGMAS * sigma) / rate)
        return moved < np.maximum(self._settings.converged_px, CONVERGED_SIGMAS * sigma), spared

    def _transferred(self) -> np.ndarray | None:
        """E H⁻¹ Eᵀ of (5) (N, 2, 2)."""
        if not self._texture_centre:
            return None
        E = np.concatenate([np.ones((len(self.offset), 1)), self.offset], axis=1)
        return np.einsum("nabj,nj->nab", np.einsum("naibj,ni->nabj", self.inverse.reshape(-1, 2, 3, 2, 3), E), E)

    def _judge(self, search: SearchImage, settled: "_Settled", transferred: np.ndarray | None) -> Matches:
        """The matches in one image, with covariances (4) and (5), and the first limit that each exceeds as its status."""
        c, A, status, correlation = settled.c, settled.A, settled.status, settled.correlation
        s = self._settings
        dof = max(1, self.n_pixels - PARAMETERS)
        lost = np.clip(1 - correlation**2, 0, 1)
        variance = self.noise_factor * self.contrast.astype(np.float64) ** 2 * lost / dof  # (4)
        K = K_o = variance[:, None, None] * sandwich(A, self.inverse[:, ::3, ::3])
        if transferred is not None:
            K_o = variance[:, None, None] * sandwich(A, transferred)
        sigma0 = SIGMA0_CONTRAST * np.sqrt(lost * self.n_pixels / dof)
        sigma = np.sqrt(np.maximum(np.maximum(K[:, 0, 0], K[:, 1, 1]), 0))
        for bad, why in (
            (largest(c - search.start) > s.max_shift_px, MatchStatus.SHIFT_TOO_LARGE),
            (~search.image.inside(c, np.array(self.half) * INSIDE_SHARE), MatchStatus.OUT_OF_IMAGE),
            (largest((A - search.shape).reshape(-1, 4)) > s.max_shear, MatchStatus.SHAPE_TOO_LARGE),
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
            iterations=settled.iterations,
            parameters=self.parameters,
            status=status,
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Settled:
    """Where the iterations left M patches, all of one image or image after image."""

    c: np.ndarray  # (M, 2)
    A: np.ndarray  # (M, 2, 2)
    status: np.ndarray  # (M,) MatchStatus
    correlation: np.ndarray  # (M,)
    iterations: np.ndarray  # (M,)

    def select(self, rows: slice) -> "_Settled":
        """Only these patches."""
        return _Settled(**{f.name: getattr(self, f.name)[rows] for f in fields(_Settled)})


class _Chances:
    """In how many images each of N points can still be matched, of rows image after image; below `needed` it is given up."""

    def __init__(self, status: np.ndarray, points: int, needed: int) -> None:
        self._points, self._needed = points, needed
        self._open = (status.reshape(-1, points) == MatchStatus.NOT_CONVERGED).sum(axis=0) if points else np.zeros(0, dtype=np.int64)

    def lose(self, rows: np.ndarray) -> None:
        """These rows failed."""
        if self._needed:
            np.subtract.at(self._open, rows % self._points, 1)

    def left(self, rows: np.ndarray) -> np.ndarray:
        """Whether the points of these rows can still be matched in as many images as are needed."""
        return np.asarray(self._open[rows % max(1, self._points)] >= self._needed)


def _shortfall(iteration: int) -> float:
    """By how much the correlation may be below the smallest one at an iteration."""
    return min((below for since, below in GIVE_UP if iteration >= since), default=np.inf)


def _starts_at_work(start: np.ndarray, alive: np.ndarray, images: int) -> np.ndarray:
    """For each row (N · images, 2) a place among the starts of its image that are `alive`: no other part of it is to be interpolated."""
    by_image, there = start.reshape(images, -1, 2), alive.reshape(images, -1)
    if not there.size:
        return start
    first = np.where(there.any(axis=1)[:, None], by_image[np.arange(images), there.argmax(axis=1)], 0.0)
    return np.repeat(first, there.shape[1], axis=0)


class _AtWork:
    """The patches of a piece that still move: the rows `place` (m,) of all patches in all images, image after image."""

    def __init__(self, templates: PatchTemplates, images: Sequence[SplineImage], place: np.ndarray) -> None:
        t, N = templates, len(templates.inside)
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
        found = [compare(image, c[rows], A[rows], self._half, patches) for image, rows, patches in self._views]
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
