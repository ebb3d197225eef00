"""Multi-image matching with collinearity observations (Gruen & Baltsavias 1988; Gruen 1985; SCIENCE §5).

All search images k = 1 … S of a point are matched in one adjustment with its position X in space: 6 S geometric unknowns and the 2 S
radiometric ones, which are eliminated, and 3 of X: 8 S + 3.

    grey values:   f − r0_k − r1_k g_k = J_k d_k + v ,                              weight P_k = 1/σ_k²          (1)
    collinearity:  x_k + A_k E d_k − F_k(X) = F'_k dX + v ,   E = [1 o] ⊗ I ,       weight 1/σ_c²                (2)
    template:      x_0 − F_0(X) = F'_0 dX + v ,                                     weight 1/σ_c²                (3)
    neighbours:    c_k = c_k⁰ ± 1 px ,   A_k = A_k⁰ ± 0.1                           (optional)                   (4)

x_k = c_k + A_k o is the image of the texture's centre of gravity o (see `least_squares`), x_0 that point in the template, which is fixed,
so that X moves along its ray. d_k is composed with the warp: c ← c + A d, A ← A (I + B). J belongs to the template alone.

Covariance as in `object_space` (5): half of a residual's variance is the template's noise and common to all search images.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..foundation.progress import Monitor
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..images.interlace import RowGrid
from ..images.sampling import SplineImage
from .least_squares import MatchingSettings, MatchStatus
from .object_space import MIN_NOISE, SHARED_FROM, inverse_normals, solve_normals, without_noise
from .patches import TemplatePatches

LARGEST = 512  # points of a piece
NEIGHBOUR_SHIFT_PX, NEIGHBOUR_SHAPE = 1.0, 0.1
CONVERGED_SIGMAS, MAX_STEP_PX, MAX_SHAPE_STEP = 0.05, 1.5, 0.3


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MultiImageMatches:
    """N points matched in S search images at once. Rows' pixels, metres."""

    middle: np.ndarray  # (N, S, 2) c_k, of the patches
    shape: np.ndarray  # (N, S, 2, 2) A_k
    xy: np.ndarray  # (N, S, 2) x_k, of the texture's centre of gravity
    covariance: np.ndarray  # (N, S, 2, 2) of xy
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    residual_px: np.ndarray  # (N, S + 1, 2) image point − projection, the template first, full-frame pixels; 0 in views without part
    seen: np.ndarray  # (N, S) which views took part
    correlation: np.ndarray  # (N, S), 1 in views that did not
    offset: np.ndarray  # (N, 2) o
    spread: np.ndarray  # (N, 2) variance of the texture's energy about o
    iterations: np.ndarray  # (N,)
    status: np.ndarray  # (N,) MatchStatus

    @property
    def ok(self) -> np.ndarray:
        """(N,) which points passed all limits."""
        return self.status == MatchStatus.OK


def match_multi_image(
    images: Sequence[SplineImage],
    cameras: Sequence[Camera],
    reference: int,
    rows: RowGrid,
    xy: np.ndarray,
    middle: np.ndarray,
    shape: np.ndarray,
    xyz_m: np.ndarray,
    settings: MatchingSettings,
    *,
    sigma_c_px: float,
    neighbours: bool = False,
    seen: np.ndarray | None = None,
    monitor: Monitor | None = None,
) -> MultiImageMatches:
    """Match the reference view's points `xy` (N, 2) (rows' pixels) in all other views, under collinearity.

    Starts: `middle` (N, S, 2) and `shape` (N, S, 2, 2) in the search views, in the order of the cameras, and `xyz_m` (N, 3). With
    `neighbours` these starts are what the neighbours predict and enter as pseudo-observations (4). `sigma_c_px` is in
    full-frame pixels: 0.001 makes (2) a condition. `seen` (N, S) says which search views take part in each point, by default all; one
    that does but does not hold the point makes it OUT_OF_IMAGE.
    Cost: about 40 µs per point of 13×13 and search image.
    """
    n = len(xy)
    order = [reference, *(k for k in range(len(cameras)) if k != reference)]
    taking_part = np.ones((n, len(cameras) - 1), dtype=bool) if seen is None else seen

    def work(span: slice) -> MultiImageMatches:
        if monitor is not None and monitor.cancelled:
            monitor.step("surface", span.start, n)
        patches = TemplatePatches(images[reference], xy[span], settings.patch_px, rows.step)
        views, rig = [images[k] for k in order], [cameras[k] for k in order]
        adjustment = _Adjustment(patches, views, rig, rows, settings, sigma_c_px, neighbours, taking_part[span])
        return adjustment.solve(xy[span], middle[span], shape[span], xyz_m[span])

    parts = in_threads(work, equal_pieces(n, LARGEST, SHARED_FROM))
    names = MultiImageMatches.__dataclass_fields__
    return MultiImageMatches(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


class _Adjustment:
    """The adjustment (1)–(4) of a chunk of points. Views: the template first."""

    def __init__(
        self,
        patches: TemplatePatches,
        images: Sequence[SplineImage],
        cameras: Sequence[Camera],
        rows: RowGrid,
        settings: MatchingSettings,
        sigma_c_px: float,
        neighbours: bool,
        seen: np.ndarray,
    ) -> None:
        self._patches, self._images, self._cameras, self._rows = patches, images, cameras, rows
        self._settings, self._neighbours, self._seen = settings, neighbours, seen
        self._weight = np.array([1.0, rows.step**2]) / sigma_c_px**2  # of (2), (3) in rows' pixels
        self._S = len(images) - 1
        n = len(patches.offset)
        E = np.zeros((n, 2, 6))
        E[:, 0, 0] = E[:, 1, 3] = 1.0
        E[:, 0, 1:3] = E[:, 1, 4:] = patches.offset
        self._E = E
        x, y = np.tile([1.0, 0.0], (n, 1)), np.tile([0.0, 1.0], (n, 1))
        H = np.zeros((n, 6, 6))
        H[:, :3, :3], H[:, 3:, 3:], H[:, :3, 3:] = patches.normal(x, x), patches.normal(y, y), patches.normal(x, y)
        H[:, 3:, :3] = H[:, :3, 3:].transpose(0, 2, 1)
        self._H = H
        self._noise = np.zeros((n, 6, 6))
        self._noise[:, :3, :3] = self._noise[:, 3:, 3:] = patches.noise_moment

    def solve(self, xy: np.ndarray, middle: np.ndarray, shape: np.ndarray, xyz_m: np.ndarray) -> MultiImageMatches:
        s, n, S = self._settings, len(xy), self._S
        middle = np.where(self._seen[..., None], middle, 0.0)
        shape = np.where(self._seen[..., None, None], shape, np.eye(2))
        c, A, X = (np.array(a, dtype=np.float64) for a in (middle, shape, xyz_m))
        status = np.full(n, MatchStatus.NOT_CONVERGED, dtype=np.int8)
        status[~self._patches.textured] = MatchStatus.NO_TEXTURE
        finite = np.isfinite(X).all(axis=1) & np.isfinite(c).all(axis=(1, 2))
        status[~(self._patches.inside & finite)] = MatchStatus.OUT_OF_IMAGE
        P, rho, iterations = np.ones((n, S)), np.zeros((n, S)), np.zeros(n, dtype=np.int16)
        active = np.flatnonzero(status == MatchStatus.NOT_CONVERGED)
        for iteration in range(1, s.max_iterations + 1):
            if not len(active):
                break
            grey, rho[active], held = self._grey_values(c[active], A[active], active)
            P[active] = 1 / np.maximum([self._patches.residual_variance(r, 8, active) for r in rho[active].T], MIN_NOISE**2).T
            P[active] *= self._seen[active]
            N, rhs = self._normal(P[active], grey, xy[active], c[active], A[active], X[active], (middle[active], shape[active]), active)
            step = solve_normals(N, rhs)
            d, moved = step[:, : 6 * S].reshape(-1, S, 2, 3), np.full(len(active), np.nan)
            c[active], A[active], moved = _composed(c[active], A[active], d)
            X[active] += step[:, 6 * S :]
            iterations[active] = iteration
            away = (np.abs(c[active] - middle[active]).max(axis=(1, 2)) > 2 * s.max_shift_px) | ~np.isfinite(moved)
            sigma = np.sqrt(1 / np.maximum(P[active].max(axis=1) * self._H[active][:, [0, 3], [0, 3]].min(axis=1), 1e-12))
            done = moved < np.maximum(min(s.converged_px, 0.01), CONVERGED_SIGMAS * sigma)
            status[active[done]] = MatchStatus.OK
            status[active[away]] = MatchStatus.SHIFT_TOO_LARGE
            status[active[~held]] = MatchStatus.OUT_OF_IMAGE
            active = active[~(done | away | ~held)]
        return self._judge(xy, middle, shape, c, A, X, P, rho, iterations, status)

    def _grey_values(self, c: np.ndarray, A: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Right sides of (1) (m, S, 6), correlations (m, S), and whether all search images that take part hold the patches."""
        p, taking_part = self._patches, self._seen[rows]
        rhs, rho, held = np.zeros((len(rows), self._S, 6)), np.zeros((len(rows), self._S)), np.ones(len(rows), dtype=bool)
        for k, image in enumerate(self._images[1:]):
            visible = image.inside(c[:, k], np.array(p.half) * 0.5)
            c32, A32 = np.where(visible[:, None], c[:, k], 0.0).astype(np.float32), A[:, k].astype(np.float32)
            x, y = (c32[:, i, None] + A32[:, i, :1] * p.u + A32[:, i, 1:] * p.v for i in range(2))
            rho[:, k], (gx, gy) = p.compare(image.sample(x, y), rows)
            rhs[:, k] = -np.concatenate([gx, gy], axis=1)
            held &= visible | ~taking_part[:, k]
        return rhs, np.where(taking_part, rho, 1.0), held

    def _normal(
        self,
        P: np.ndarray,
        grey: np.ndarray,
        xy: np.ndarray,
        c: np.ndarray,
        A: np.ndarray,
        X: np.ndarray,
        expected: tuple[np.ndarray, np.ndarray],
        rows: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (m, 6 S + 3, 6 S + 3) and right side of (1)–(4)."""
        S, W = self._S, self._weight
        N, rhs = self._geometry(c, A, X, rows)
        v, F = self._collinearity(xy, c, A, X, rows)
        rhs[:, 6 * S :] = np.einsum("nkiv,i,nki->nv", F, W, v)
        for k in range(S):
            at = slice(6 * k, 6 * k + 6)
            AE = A[:, k] @ self._E[rows] * self._seen[rows, k, None, None]
            N[:, at, at] += P[:, k, None, None] * self._H[rows]
            rhs[:, at] = P[:, k, None] * grey[:, k] - np.einsum("nia,i,ni->na", AE, W, v[:, k + 1])
            if self._neighbours:
                _add_neighbours(N[:, at, at], rhs[:, at], c[:, k], A[:, k], expected[0][:, k], expected[1][:, k])
        return N, rhs

    def _collinearity(
        self, xy: np.ndarray, c: np.ndarray, A: np.ndarray, X: np.ndarray, rows: np.ndarray | slice
    ) -> tuple[np.ndarray, np.ndarray]:
        """Image point − projection (m, S + 1, 2) and F' (m, S + 1, 2, 3), rows' pixels."""
        o = self._patches.offset[rows]
        at = np.concatenate([(xy + o)[:, None], c + np.einsum("nkij,nj->nki", A, o)], axis=1)
        projected = [camera.project_with_jacobian(X) for camera in self._cameras]
        v = at - self._rows.from_frame(np.stack([x for x, _ in projected], axis=1))
        F = np.stack([J for _, J in projected], axis=1) / np.array([1.0, self._rows.step])[:, None]
        there = np.insert(self._seen[rows], 0, True, axis=1)[..., None]  # the template always is
        return np.where(there, v, 0.0), np.where(there[..., None], F, 0.0)

    def _geometry(self, c: np.ndarray, A: np.ndarray, X: np.ndarray, rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """What (2) and (3) give to the normal matrix; and an empty right side."""
        S, W = self._S, self._weight
        N, at_x = np.zeros((len(c), 6 * S + 3, 6 * S + 3)), slice(6 * S, 6 * S + 3)
        _, F = self._collinearity(np.zeros((len(c), 2)), c, A, X, rows)
        N[:, at_x, at_x] = np.einsum("nkia,i,nkib->nab", F, W, F)
        for k in range(S):
            seen = self._seen[rows, k, None, None]
            at, AE = slice(6 * k, 6 * k + 6), A[:, k] @ self._E[rows] * seen
            N[:, at, at] = np.einsum("nia,i,nib->nab", AE, W, AE) + ~seen * np.eye(6)
            N[:, at, at_x] = -np.einsum("nia,i,nib->nab", AE, W, F[:, k + 1])
            N[:, at_x, at] = N[:, at, at_x].transpose(0, 2, 1)
        return N, np.zeros((len(c), 6 * S + 3))

    def _covariance(self, P: np.ndarray, c: np.ndarray, A: np.ndarray, X: np.ndarray) -> np.ndarray:
        """(n, 6 S + 3, 6 S + 3); half of the variance of a residual is the template's noise and common to all images."""
        S, every = self._S, slice(None)
        texture, _ = self._geometry(c, A, X, every)
        middle = texture.copy()
        for k in range(S):
            at = slice(6 * k, 6 * k + 6)
            if self._neighbours:
                for N in (texture, middle):
                    _add_neighbours(N[:, at, at], np.zeros((len(c), 6)), c[:, k], A[:, k], c[:, k], A[:, k])
            noise = 0.5 * (self._patches.gradient_noise / np.maximum(P[:, k], 1e-12))[:, None, None] * self._noise
            texture[:, at, at] += P[:, k, None, None] * without_noise(self._H, noise)
            for j in range(S):
                share = (1.0 if j == k else 0.5) * np.sqrt(P[:, k] * P[:, j])
                middle[:, at, 6 * j : 6 * j + 6] += share[:, None, None] * self._H
        half = inverse_normals(texture)
        return half @ middle @ half

    def _judge(
        self,
        xy: np.ndarray,
        start: np.ndarray,
        start_shape: np.ndarray,
        c: np.ndarray,
        A: np.ndarray,
        X: np.ndarray,
        P: np.ndarray,
        rho: np.ndarray,
        iterations: np.ndarray,
        status: np.ndarray,
    ) -> MultiImageMatches:
        s, S, patches = self._settings, self._S, self._patches
        failed = status == MatchStatus.OUT_OF_IMAGE
        Xs = np.where(failed[:, None], np.nan, X)
        K = self._covariance(P, c, A, Xs)
        AE = A @ self._E[:, None]
        at = [slice(6 * k, 6 * k + 6) for k in range(S)]
        Kx = np.stack([AE[:, k] @ K[:, at[k], at[k]] @ AE[:, k].transpose(0, 2, 1) for k in range(S)], axis=1)
        variance = np.nan_to_num(Kx[:, :, [0, 1], [0, 1]], nan=1e6) * self._seen[..., None]
        sigma = np.sqrt(np.maximum(variance, 0)).max(axis=(1, 2))
        pixels = np.maximum(patches.pixels, 9.0)
        sigma0 = 50 * np.sqrt(np.clip(1 - rho.min(axis=1) ** 2, 0, 1) * pixels / (pixels - 8))
        for bad, why in (
            (np.abs(c - start).max(axis=(1, 2)) > s.max_shift_px, MatchStatus.SHIFT_TOO_LARGE),
            (np.abs(A - start_shape).max(axis=(1, 2, 3)) > s.max_shear, MatchStatus.SHAPE_TOO_LARGE),
            (rho.min(axis=1) < s.min_correlation, MatchStatus.LOW_CORRELATION),
            (sigma > s.max_sigma_px, MatchStatus.SIGMA_TOO_LARGE),
            (sigma0 > s.max_sigma0, MatchStatus.SIGMA0_TOO_LARGE),
        ):
            status[(status == MatchStatus.OK) & bad] = why
        v, _ = self._collinearity(xy, c, A, Xs, slice(None))
        return MultiImageMatches(
            middle=c,
            shape=A,
            xy=c + np.einsum("nkij,nj->nki", A, patches.offset),
            covariance=Kx,
            xyz_m=Xs,
            covariance_m2=K[:, 6 * S :, 6 * S :],
            residual_px=v * (1.0, self._rows.step),
            seen=self._seen,
            correlation=rho,
            offset=patches.offset,
            spread=patches.spread,
            iterations=iterations,
            status=status,
        )


def _add_neighbours(N: np.ndarray, rhs: np.ndarray, c: np.ndarray, A: np.ndarray, c0: np.ndarray, A0: np.ndarray) -> None:
    """Add the pseudo-observations (4) of one search image to its part of the normal equations, in place."""
    AA = A.transpose(0, 2, 1) @ A
    for column, wish, sigma in (
        (0, c0 - c, NEIGHBOUR_SHIFT_PX),
        (1, A0[:, :, 0] - A[:, :, 0], NEIGHBOUR_SHAPE),
        (2, A0[:, :, 1] - A[:, :, 1], NEIGHBOUR_SHAPE),
    ):
        for i in range(2):
            for j in range(2):
                N[:, column + 3 * i, column + 3 * j] += AA[:, i, j] / sigma**2
            rhs[:, column + 3 * i] += np.einsum("nj,nj->n", A[:, :, i], wish) / sigma**2


def _composed(c: np.ndarray, A: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Warps (m, S) after steps d (m, S, 2, 3) = [shift B], and the largest move (m,) of a patch [px]."""
    length = np.abs(d[..., 0]).max(axis=(1, 2))
    bend = np.abs(d[..., 1:]).max(axis=(1, 2, 3))
    shrink = np.minimum(1.0, np.minimum(MAX_STEP_PX / np.maximum(length, 1e-9), MAX_SHAPE_STEP / np.maximum(bend, 1e-9)))
    d = d * shrink[:, None, None, None]
    move = np.einsum("nkij,nkj->nki", A, d[..., 0])
    return c + move, A + A @ d[..., 1:], np.abs(move).max(axis=(1, 2))
