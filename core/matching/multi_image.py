"""Multi-image matching with collinearity observations (Gruen & Baltsavias 1988; Gruen 1985).

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

from dataclasses import dataclass

import numpy as np

from ..foundation.progress import Monitor
from ..foundation.threads import equal_pieces, in_threads
from .least_squares import INSIDE_SHARE, SIGMA0_CONTRAST, MatchingSettings, MatchStatus
from .object_space import MIN_NOISE, MOST_CONVERGED_PX, SHARED_FROM, inverse_normals, solve_normals, without_noise
from .patches import TemplatePatches
from .views import Views

LARGEST = 512  # points of a piece
NEIGHBOUR_SHIFT_PX = 1.0  # rows' px, sigma of the neighbours' prediction of c_k in (4)
NEIGHBOUR_SHAPE = 0.1  # sigma of their prediction of A_k in (4)
CONVERGED_SIGMAS = 0.05  # a step below this part of a point's sigma is the last
MAX_STEP_PX = 1.5  # px, longer steps are shortened
MAX_SHAPE_STEP = 0.3  # change of A in one step


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MultiImageMatches:
    """N points matched in S search images at once. Rows' pixels, metres."""

    centre: np.ndarray  # (N, S, 2) c_k, of the patches
    shape: np.ndarray  # (N, S, 2, 2) A_k
    xy: np.ndarray  # (N, S, 2) x_k, of the texture's centre of gravity
    covariance: np.ndarray  # (N, S, 2, 2) of xy
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    residual_px: np.ndarray  # (N, S + 1, 2) image point − projection, the template first, full-frame pixels; 0 in views without part
    visible: np.ndarray  # (N, S) which search views took part
    correlation: np.ndarray  # (N, S), 1 in views without part
    offset: np.ndarray  # (N, 2) o
    spread: np.ndarray  # (N, 2) variance of the texture's energy about o
    iterations: np.ndarray  # (N,)
    status: np.ndarray  # (N,) MatchStatus

    @property
    def ok(self) -> np.ndarray:
        """(N,) which points passed all limits."""
        return self.status == MatchStatus.OK


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MultiImageStarts:
    """N points of the reference view to be matched in its S search views, and approximate values of their unknowns."""

    xy: np.ndarray  # (N, 2) rows' pixels of the reference view
    centre: np.ndarray  # (N, S, 2) c_k, of the patches
    shape: np.ndarray  # (N, S, 2, 2) A_k
    xyz_m: np.ndarray  # (N, 3)
    visible: np.ndarray | None = None  # (N, S) which search views take part; None: all

    def select(self, rows: np.ndarray | slice) -> "MultiImageStarts":
        """Only these points."""
        return MultiImageStarts(
            xy=self.xy[rows],
            centre=self.centre[rows],
            shape=self.shape[rows],
            xyz_m=self.xyz_m[rows],
            visible=None if self.visible is None else self.visible[rows],
        )


def match_multi_image(
    views: Views,
    starts: MultiImageStarts,
    settings: MatchingSettings,
    *,
    sigma_c_px: float,
    neighbours: bool = False,
    monitor: Monitor | None = None,
) -> MultiImageMatches:
    """Match points of the reference view in all search views at once, under collinearity.

    With `neighbours` the starts are the neighbours' predictions and enter as pseudo-observations (4). `sigma_c_px` is in full-frame
    pixels: 0.001 turns (2) into a condition. A point that lies outside a view that takes part is OUT_OF_IMAGE.
    Cost: about 40 µs per point of 13×13 and search image.
    """
    n = len(starts.xy)
    ordered = views.select([views.reference, *views.search])

    def work(span: slice) -> MultiImageMatches:
        if monitor is not None and monitor.cancelled:
            monitor.step("surface", span.start, n)
        return _Adjustment(ordered, starts.select(span), settings, sigma_c_px, neighbours).solve()

    parts = in_threads(work, equal_pieces(n, LARGEST, SHARED_FROM))
    names = MultiImageMatches.__dataclass_fields__
    return MultiImageMatches(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


@dataclass(eq=False, kw_only=True, slots=True)
class _Unknowns:
    """The unknowns of m points: those of the patches in the search views, and the points in space."""

    c: np.ndarray  # (m, S, 2)
    A: np.ndarray  # (m, S, 2, 2)
    X: np.ndarray  # (m, 3)

    def select(self, rows: np.ndarray) -> "_Unknowns":
        return _Unknowns(c=self.c[rows], A=self.A[rows], X=self.X[rows])


class _Adjustment:
    """The adjustment (1)–(4) of a chunk of points. The reference view comes first."""

    def __init__(self, views: Views, starts: MultiImageStarts, settings: MatchingSettings, sigma_c_px: float, neighbours: bool) -> None:
        self._patches = patches = TemplatePatches(views.template, starts.xy, settings.patch_px, views.rows.step)
        self._images, self._cameras, self._rows = views.images, views.cameras, views.rows
        self._settings, self._neighbours = settings, neighbours
        self._weight = np.array([1.0, views.rows.step**2]) / sigma_c_px**2  # of (2), (3) in rows' pixels
        self._S = len(views.search)
        n = len(starts.xy)
        self._visible = visible = np.ones((n, self._S), dtype=bool) if starts.visible is None else starts.visible
        self._xy, self._X = starts.xy, starts.xyz_m
        self._c = np.where(visible[..., None], starts.centre, 0.0)
        self._A = np.where(visible[..., None, None], starts.shape, np.eye(2))
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

    def solve(self) -> MultiImageMatches:
        s, n, S = self._settings, len(self._xy), self._S
        c, A, X = (np.array(a, dtype=np.float64) for a in (self._c, self._A, self._X))
        unknowns = _Unknowns(c=c, A=A, X=X)
        status = np.full(n, MatchStatus.NOT_CONVERGED, dtype=np.int8)
        status[~self._patches.textured] = MatchStatus.NO_TEXTURE
        finite = np.isfinite(X).all(axis=1) & np.isfinite(c).all(axis=(1, 2))
        status[~(self._patches.inside & finite)] = MatchStatus.OUT_OF_IMAGE
        P, rho, iterations = np.ones((n, S)), np.zeros((n, S)), np.zeros(n, dtype=np.int16)
        active = np.flatnonzero(status == MatchStatus.NOT_CONVERGED)
        for iteration in range(1, s.max_iterations + 1):
            if not len(active):
                break
            now = unknowns.select(active)
            grey, rho[active], inside = self._grey_values(now, active)
            P[active] = 1 / np.maximum([self._patches.residual_variance(r, 8, active) for r in rho[active].T], MIN_NOISE**2).T
            P[active] *= self._visible[active]
            N, rhs = self._normal(P[active], grey, now, active)
            step = solve_normals(N, rhs)
            c[active], A[active], moved = _composed(now.c, now.A, step[:, : 6 * S].reshape(-1, S, 2, 3))
            X[active] += step[:, 6 * S :]
            iterations[active] = iteration
            away = (np.abs(c[active] - self._c[active]).max(axis=(1, 2)) > 2 * s.max_shift_px) | ~np.isfinite(moved)
            sigma = np.sqrt(1 / np.maximum(P[active].max(axis=1) * self._H[active][:, [0, 3], [0, 3]].min(axis=1), 1e-12))
            done = moved < np.maximum(min(s.converged_px, MOST_CONVERGED_PX), CONVERGED_SIGMAS * sigma)
            status[active[done]] = MatchStatus.OK
            status[active[away]] = MatchStatus.SHIFT_TOO_LARGE
            status[active[~inside]] = MatchStatus.OUT_OF_IMAGE
            active = active[~(done | away | ~inside)]
        return self._judge(unknowns, P, rho, iterations, status)

    def _grey_values(self, now: _Unknowns, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Right sides of (1) (m, S, 6), correlations (m, S), and whether the patches lie inside all search images that take part."""
        p, taking_part, c, A = self._patches, self._visible[rows], now.c, now.A
        rhs, rho, all_inside = np.zeros((len(rows), self._S, 6)), np.zeros((len(rows), self._S)), np.ones(len(rows), dtype=bool)
        for k, image in enumerate(self._images[1:]):
            inside = image.inside(c[:, k], np.array(p.half) * INSIDE_SHARE)
            c32, A32 = np.where(inside[:, None], c[:, k], 0.0).astype(np.float32), A[:, k].astype(np.float32)
            x, y = (c32[:, i, None] + A32[:, i, :1] * p.u + A32[:, i, 1:] * p.v for i in range(2))
            rho[:, k], (gx, gy) = p.compare(image.sample(x, y), rows)
            rhs[:, k] = -np.concatenate([gx, gy], axis=1)
            all_inside &= inside | ~taking_part[:, k]
        return rhs, np.where(taking_part, rho, 1.0), all_inside

    def _normal(self, P: np.ndarray, grey: np.ndarray, now: _Unknowns, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (m, 6 S + 3, 6 S + 3) and right side of (1)–(4)."""
        S, W = self._S, self._weight
        N, rhs = self._geometry(now, rows)
        v, F = self._collinearity(self._xy[rows], now, rows)
        rhs[:, 6 * S :] = np.einsum("nkiv,i,nki->nv", F, W, v)
        for k in range(S):
            at = slice(6 * k, 6 * k + 6)
            AE = now.A[:, k] @ self._E[rows] * self._visible[rows, k, None, None]
            N[:, at, at] += P[:, k, None, None] * self._H[rows]
            rhs[:, at] = P[:, k, None] * grey[:, k] - np.einsum("nia,i,ni->na", AE, W, v[:, k + 1])
            if self._neighbours:
                _add_neighbours(N[:, at, at], rhs[:, at], now.c[:, k], now.A[:, k], self._c[rows][:, k], self._A[rows][:, k])
        return N, rhs

    def _collinearity(self, xy: np.ndarray, now: _Unknowns, rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """Image point − projection (m, S + 1, 2) and F' (m, S + 1, 2, 3), rows' pixels."""
        o = self._patches.offset[rows]
        at = np.concatenate([(xy + o)[:, None], now.c + np.einsum("nkij,nj->nki", now.A, o)], axis=1)
        projected = [camera.project_with_jacobian(now.X) for camera in self._cameras]
        v = at - self._rows.from_frame(np.stack([x for x, _ in projected], axis=1))
        F = np.stack([J for _, J in projected], axis=1) / np.array([1.0, self._rows.step])[:, None]
        there = np.insert(self._visible[rows], 0, True, axis=1)[..., None]  # the template always is
        return np.where(there, v, 0.0), np.where(there[..., None], F, 0.0)

    def _geometry(self, now: _Unknowns, rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """The part of (2) and (3) in the normal matrix, and an empty right side."""
        S, W, m = self._S, self._weight, len(now.c)
        N, at_x = np.zeros((m, 6 * S + 3, 6 * S + 3)), slice(6 * S, 6 * S + 3)
        _, F = self._collinearity(np.zeros((m, 2)), now, rows)
        N[:, at_x, at_x] = np.einsum("nkia,i,nkib->nab", F, W, F)
        for k in range(S):
            visible = self._visible[rows, k, None, None]
            at, AE = slice(6 * k, 6 * k + 6), now.A[:, k] @ self._E[rows] * visible
            N[:, at, at] = np.einsum("nia,i,nib->nab", AE, W, AE) + ~visible * np.eye(6)
            N[:, at, at_x] = -np.einsum("nia,i,nib->nab", AE, W, F[:, k + 1])
            N[:, at_x, at] = N[:, at, at_x].transpose(0, 2, 1)
        return N, np.zeros((m, 6 * S + 3))

    def _covariance(self, P: np.ndarray, final: _Unknowns) -> np.ndarray:
        """(n, 6 S + 3, 6 S + 3); half of the variance of a residual is the template's noise and common to all images."""
        S, c, A = self._S, final.c, final.A
        texture, _ = self._geometry(final, slice(None))
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
        return half @ middle @ half  # as `object_space` (5)

    def _judge(self, unknowns: _Unknowns, P: np.ndarray, rho: np.ndarray, iterations: np.ndarray, status: np.ndarray) -> MultiImageMatches:
        """The result with its covariance, and the first limit that each point exceeds as its status."""
        s, S, patches, c, A = self._settings, self._S, self._patches, unknowns.c, unknowns.A
        failed = status == MatchStatus.OUT_OF_IMAGE
        final = _Unknowns(c=c, A=A, X=np.where(failed[:, None], np.nan, unknowns.X))
        K = self._covariance(P, final)
        AE = A @ self._E[:, None]
        at = [slice(6 * k, 6 * k + 6) for k in range(S)]
        Kx = np.stack([AE[:, k] @ K[:, at[k], at[k]] @ AE[:, k].transpose(0, 2, 1) for k in range(S)], axis=1)
        variance = np.nan_to_num(Kx[:, :, [0, 1], [0, 1]], nan=1e6) * self._visible[..., None]
        sigma = np.sqrt(np.maximum(variance, 0)).max(axis=(1, 2))
        pixels = np.maximum(patches.pixels, 9.0)
        sigma0 = SIGMA0_CONTRAST * np.sqrt(np.clip(1 - rho.min(axis=1) ** 2, 0, 1) * pixels / (pixels - 8))
        for bad, why in (
            (np.abs(c - self._c).max(axis=(1, 2)) > s.max_shift_px, MatchStatus.SHIFT_TOO_LARGE),
            (np.abs(A - self._A).max(axis=(1, 2, 3)) > s.max_shear, MatchStatus.SHAPE_TOO_LARGE),
            (rho.min(axis=1) < s.min_correlation, MatchStatus.LOW_CORRELATION),
            (sigma > s.max_sigma_px, MatchStatus.SIGMA_TOO_LARGE),
            (sigma0 > s.max_sigma0, MatchStatus.SIGMA0_TOO_LARGE),
        ):
            status[(status == MatchStatus.OK) & bad] = why
        v, _ = self._collinearity(self._xy, final, slice(None))
        return MultiImageMatches(
            centre=c,
            shape=A,
            xy=c + np.einsum("nkij,nj->nki", A, patches.offset),
            covariance=Kx,
            xyz_m=final.X,
            covariance_m2=K[:, 6 * S :, 6 * S :],
            residual_px=v * (1.0, self._rows.step),
            visible=self._visible,
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
