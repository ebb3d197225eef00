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

from ..foundation.arrays import concatenated, select_rows
from ..foundation.progress import Monitor
from ..foundation.settings import knob
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.small_matrices import invert_spd, largest, sandwich
from ..images.sampling import SplineImage, correlated_noise
from .parameter_sets import PARAMETERS, reduced_sets
from .patch_steps import PatchSteps, compose
from .patches import patch_offsets, template_pixels

LARGEST = 4096  # patches of a piece
SHARED_FROM = 513  # patches from which on threads share them
MIN_CONDITION = 1e-6  # added to the scaled diagonal of the whole one
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
OF_PIXELS = ("f", "fx", "fy")  # arrays of each patch's pixels, and
JUDGED = ("q", "inside", "contrast", "inverse", "parameters", "offset", "spread", "noise_factor", "textured")  # of each patch
PER_PATCH = (*OF_PIXELS, *JUDGED)


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
    return [concatenated([part[k] for part in parts]) for k in range(len(searches))]


def prepare_templates(template: TemplatePoints, settings: MatchingSettings) -> "PatchTemplates":
    """The template side of the patches about these points, to be matched many times."""
    return PatchTemplates.joined(in_threads(lambda span: PatchTemplates(template.select(span), settings), _pieces(len(template.xy))))


def match_prepared(templates: "PatchTemplates", rows: np.ndarray, search: SearchImage) -> Matches:
    """Match the prepared templates `rows` (N,) in an image."""
    all_in_order = np.array_equal(rows, np.arange(len(templates.inside)))  # most often: slices then, no copies

    def work(span: slice) -> Matches:
        return templates.select(span if all_in_order else rows[span]).find([search.select(span)])[0]

    return concatenated(in_threads(work, _pieces(len(rows))))


def _pieces(n: int) -> list[slice]:
    return equal_pieces(n, LARGEST, SHARED_FROM)


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

    def select(self, rows: np.ndarray | slice, names: Sequence[str] = PER_PATCH) -> "PatchTemplates":
        """Only these rows (a mask, indices or a slice), of the arrays of these names."""
        chosen = copy(self)
        for name in names:
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
        """The matches in every image."""
        matching = Matching([search.image for search in searches], self._settings, needed)
        start, shape = (np.stack(a).astype(np.float64) for a in ([s.start for s in searches], [s.shape for s in searches]))
        matching.add(self, start, shape)
        matching.advance()
        return matching.take()[1]

    def converged(self, step: np.ndarray, moved: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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

    def judged(self, search: SearchImage, found: "_Found") -> Matches:
        """The matches in one image, with covariances (4) and (5), and the first limit that each exceeds as its status."""
        c, A, status, correlation = found.c, found.A, found.status, found.correlation
        s, transferred = self._settings, self._transferred()
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
            iterations=found.iterations,
            parameters=self.parameters,
            status=status,
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Found:
    """Where the iterations are with N patches in S images: the first two axes of every array; of one image without the first."""

    c: np.ndarray  # (S, N, 2)
    A: np.ndarray  # (S, N, 2, 2)
    status: np.ndarray  # (S, N) MatchStatus
    correlation: np.ndarray  # (S, N)
    iterations: np.ndarray  # (S, N)


class Matching:
    """Patches that are searched for in S images, a few iterations at a time, while others are added.

    A point that fewer than `needed` images can still match is given up.
    """

    def __init__(self, images: Sequence[SplineImage], settings: MatchingSettings, needed: int = 0) -> None:
        self._images, self._settings, self._needed = images, settings, needed
        self._templates: PatchTemplates | None = None

    def add(self, templates: PatchTemplates, start: np.ndarray, shape: np.ndarray) -> None:
        """More patches, from positions (S, n, 2) and shapes (S, n, 2, 2)."""
        S, n = start.shape[:2]
        status = np.where(templates.textured, MatchStatus.NOT_CONVERGED, MatchStatus.NO_TEXTURE).astype(np.int8)[None].repeat(S, axis=0)
        for k, image in enumerate(self._images):
            status[k, ~(image.inside(start[k], 0.0) & templates.inside)] = MatchStatus.OUT_OF_IMAGE
        alive = status == MatchStatus.NOT_CONVERGED
        alive &= alive.sum(axis=0) >= self._needed
        found = _Found(
            c=start.copy(), A=shape.copy(), status=status, correlation=np.zeros((S, n)), iterations=np.zeros((S, n), dtype=np.int16)
        )
        new = {"_start": start, "_shape": shape, "_alive": alive}
        if self._templates is None:
            self._templates, self._found = templates, found
        else:
            new = {name: np.concatenate([getattr(self, name), a], axis=1) for name, a in new.items()}
            self._templates = PatchTemplates.joined([self._templates, templates])
            self._found = concatenated([self._found, found], axis=1)
        self._start, self._shape, self._alive = (new[name] for name in ("_start", "_shape", "_alive"))

    def advance(self, share: float = 0.0) -> None:
        """Iterate (2) and (3) until no more than a share of the patches that move now still do."""
        t, s, (S, N) = self._templates, self._settings, self._alive.shape
        c, A, status, correlation, iterations = (getattr(self._found, f.name) for f in fields(_Found))
        c, A, start, shape = (a.reshape(S * N, *a.shape[2:]) for a in (c, A, self._start, self._shape))
        status, correlation, iterations, moving = (a.reshape(S * N) for a in (status, correlation, iterations, self._alive))
        place = np.flatnonzero(moving)
        if t is None or not len(place):
            return
        open_, few = self._alive.sum(axis=0) + (self._found.status == MatchStatus.OK).sum(axis=0), share * len(place)
        at, warp, alive, work = c[place], A[place], np.ones(len(place), dtype=bool), PatchSteps(t, self._images, place)
        _, first = np.unique(place // N, return_index=True)
        harmless = dict(zip((place[first] // N).tolist(), start[place[first]]))  # no other part of an image is to be interpolated
        while np.count_nonzero(alive) > few:
            if np.count_nonzero(alive) < COMPACT_BELOW * len(alive):
                place, at, warp, alive = place[alive], at[alive], warp[alive], alive[alive]
                work = PatchSteps(t, self._images, place)
            step, rho, gain = work.step(at, warp)
            at, warp, moved = compose(at, warp, step)
            iterations[place] += alive
            iteration = iterations[place]
            lost = (largest(at - start[place]) > 2 * s.max_shift_px) | ~np.isfinite(moved)
            lost |= largest((warp - shape[place]).reshape(-1, 4)) > 2 * s.max_shear
            near, spared = t.converged(step, moved, work.sigma(rho))
            good = alive & (near | spared) & ~lost
            low = alive & ~good & (rho < s.min_correlation - _shortfall(iteration))
            rho = np.where(spared, np.sqrt(np.minimum(rho**2 + gain, 1.0)), rho)
            failed = alive & (lost | low | (good & (rho < s.min_correlation)) | ((iteration >= s.max_iterations) & ~good))
            np.subtract.at(open_, place[failed] % N, 1)
            finished = np.flatnonzero(alive & (good | failed | (open_[place % N] < self._needed)))
            here = place[finished]
            c[here], A[here], correlation[here] = at[finished], warp[finished], rho[finished]
            status[place[good]] = MatchStatus.OK
            status[place[alive & lost]] = MatchStatus.SHIFT_TOO_LARGE
            status[place[low & ~lost]] = MatchStatus.LOW_CORRELATION
            alive[finished] = moving[here] = False
            for row in np.flatnonzero(lost).tolist():
                at[row], warp[row] = harmless[int(place[row] // N)], np.eye(2)
        c[place[alive]], A[place[alive]] = at[alive], warp[alive]

    def take(self) -> tuple[np.ndarray, list[Matches]]:
        """Which of the patches (N,) no longer move in any image, and their matches in every image; they are removed."""
        assert self._templates is not None
        done = ~self._alive.any(axis=0)
        own = self._templates if done.all() else self._templates.select(done, JUDGED)
        searches = [
            SearchImage(image=image, start=self._start[k, done], shape=self._shape[k, done]) for k, image in enumerate(self._images)
        ]
        matches = [own.judged(search, select_rows(self._found, (k, done))) for k, search in enumerate(searches)]
        self._templates = None if done.all() else self._templates.select(~done)
        self._found, self._alive = select_rows(self._found, np.s_[:, ~done]), np.ascontiguousarray(self._alive[:, ~done])
        self._start, self._shape = self._start[:, ~done], self._shape[:, ~done]
        return done, matches


def _shortfall(iteration: np.ndarray) -> np.ndarray:
    """By how much the correlations (m,) may be below the smallest one at these iterations."""
    allowed = np.full(len(iteration), np.inf)
    for since, below in GIVE_UP:
        allowed[iteration >= since] = below
    return allowed
