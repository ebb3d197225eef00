"""Least squares matching in object space: one piece of surface is fitted to all search images at once (Krupnik & Schenk 1997).

The unknowns are not those of patches in images but of the surface on the reference view's rays: its inverse depth w, with slopes and
curvatures. Every search view k shows the same piece through its own camera X_k = R_k X + t_k:

    w(u, v) = θ · m(u, v) ,   m = 1, u, v [, ½ u², u v, ½ v²]                                                (1)
    h_k(u, v) = R_k R_0ᵀ q(u, v) + w b_k ,   b_k = R_k C_0 + t_k ,   x_k(u, v) = π_k(h_k) + δ_k n_k            (2)
    f(u, v) + e = r0_k + r1_k g_k(x_k(u, v))                                                                  (3)

R_0 and C_0 are the rotation and the projection centre of the reference view, q the direction of its ray at unit depth, and b_k that centre
in the frame of camera k; π_k projects with lens distortion, which is taken as linear over a patch. Planes are linear in inverse depth, so
that 1, u, v are an exact plane and move the search patches by its homography. δ_k shifts a patch across its epipolar line
(n_k ⟂ e_k = ∂x_k/∂w) under the pseudo-observation δ_k = 0 ± σ_c, which allows for errors of the calibration. r0, r1 are eliminated. In the
template these directions are s_k = A_k⁻¹ e_k and n'_k = A_k⁻¹ n_k, with A_k = ∂x_k/∂(u, v), and the design matrix is that of the template's
gradients (see `patches`). With P_k = 1/σ_k² from the residuals of each image, 0 in views without part in a point,

    N = Σ_k P_k J_kᵀ M J_k + P_prior ,   N dθ = Σ_k P_k J_kᵀ M (f − r0 − r1 g_k) + P_prior (θ_prior − θ)        (4)

Here θ contains the δ_k, and P_prior their weights 1/σ_c².

Covariance: the template's noise is common to all search images (σ_f² = ½ min σ_k²), and the noise of the gradients makes N too large (on
simulated skin N⁻¹ gives 0.11 px, and the scatter is 0.24 px). With N' free of the gradients' noise

    K = N'⁻¹ [ Σ_k ½ P_k J_kᵀ J_k + σ_f² (Σ_k P_k J_k)ᵀ (Σ_k P_k J_k) + P_prior ] N'⁻¹                           (5)

In its middle, J_kᵀ J_k is weighted by W², not W, where a patch has a window, and P_prior is replaced by P_prior² times the squared errors
of the prior where these are given.
"""

from dataclasses import dataclass

import numpy as np

from ..foundation.progress import Monitor
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..geometry.small_matrices import invert_spd
from ..images.interlace import RowGrid
from .least_squares import INSIDE_SHARE, SIGMA0_CONTRAST, MatchingSettings, MatchStatus
from .patches import TemplatePatches, monomials, pieces
from .views import Views

LARGEST = 2048  # points of a piece
SHARED_FROM = 513  # points from which on threads share them
MIN_NOISE = 0.4  # grey values, of a difference of two images: no image is better than its quantisation
CONVERGED_SIGMAS = 0.2  # a step below this part of N's sigma is the last; noise of the gradients makes that sigma small on weak texture
MOST_CONVERGED_PX = 0.01  # px, upper limit of the knob `converged_px` here: constrained matches are more precise
MAX_STEP_PX = 1.5  # px in the fastest search view, longer steps are shortened
MIN_REMAINING = 0.1  # part of the gradients' energy that is always taken as texture


def px_per_inverse_metre(views: Views) -> float:
    """How fast the fastest search view moves with inverse depth [px m], for cameras of similar focal lengths."""
    base = views.base
    return max(base.focal_px * float(np.linalg.norm(views.cameras[k].centre_m - base.centre_m)) for k in views.search)


class Epipolar:
    """The geometry (2) between N points of the reference view and one search view."""

    def __init__(self, base: Camera, camera: Camera, rows: RowGrid, xy: np.ndarray) -> None:
        self._camera, self._rows = camera, rows
        frame = rows.to_frame(xy)
        q = base.directions(frame)
        tip = base.directions(frame[:, None] + [[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        Q = np.stack([tip[:, 0] - tip[:, 1], (tip[:, 2] - tip[:, 3]) * rows.step], axis=2)  # ∂q/∂(u, v) (N, 3, 2)
        rotation = camera.R_cam_world @ base.R_cam_world.T
        self._h0, self._H = q @ rotation.T, rotation @ Q
        self._b = camera.R_cam_world @ base.centre_m + camera.t_cam_world_m  # b_k (3,)

    def centre(self, theta: np.ndarray, rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """At the patch's centre, in rows' pixels: x_k without δ (m, 2), e_k (m, 2), A_k (m, 2, 2) and L = ∂x_k/∂(h_1/h_3, h_2/h_3)."""
        h = self._h0[rows] + theta[:, :1] * self._b  # (2)
        X = (h - self._camera.t_cam_world_m) @ self._camera.R_cam_world
        frame, J = self._camera.project_with_jacobian(X)
        J = (J @ self._camera.R_cam_world.T) / np.array([1.0, self._rows.step])[:, None]  # ∂x/∂h
        A = J @ (self._H[rows] + self._b[:, None] * theta[:, None, 1:3])
        return self._rows.from_frame(frame), J @ self._b, A, J[:, :, :2] * h[:, 2, None, None]

    def warp(
        self, theta: np.ndarray, monomials: np.ndarray, rows: np.ndarray | slice, at: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows (m, n) float32 of x_k(u, v), of patches with centres `at` (m, 2) and L `slope` (m, 2, 2).

        h_k is linear in the monomials, and so is L h_k: one product with the pixels, and a division by the third row.
        """
        h = theta[:, None, :] * self._b[:, None]  # (2) by monomials (m, 3, P)
        h[:, :, 0] += self._h0[rows]
        centre = h[:, :2, 0] / h[:, 2:, 0]
        h[:, :, 1:3] += self._H[rows]
        h[:, :2] = slope @ h[:, :2]
        c = (at - np.einsum("nij,nj->ni", slope, centre)).astype(np.float32)
        x, y, z = np.matmul(h.transpose(1, 0, 2).astype(np.float32), monomials.T)
        x /= z
        x += c[:, :1]
        y /= z
        y += c[:, 1:]
        return x, y


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfacePrior:
    """Pseudo-observations θ = value ± sigma of N points, in the unknowns of (1); an infinite sigma has no weight.

    `error` is the standard deviation of the values, where it differs from the sigma that sets their weight.
    """

    value: np.ndarray  # (N, P)
    sigma: np.ndarray  # (N, P)
    error: np.ndarray | None = None  # (N, P)

    def select(self, rows: np.ndarray | slice) -> "SurfacePrior":
        """Only these points."""
        return SurfacePrior(value=self.value[rows], sigma=self.sigma[rows], error=None if self.error is None else self.error[rows])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfacePatch:
    """N pieces of surface: θ of (1) about the patch's centre, in units of 1/m and rows' pixels, and the quality of the match."""

    theta: np.ndarray  # (N, P)
    covariance: np.ndarray  # (N, P, P)
    across_px: np.ndarray  # (N, S) δ of the S search views, rows' pixels
    across_sigma_px: np.ndarray  # (N, S)
    visible: np.ndarray  # (N, S) which search views took part
    correlation: np.ndarray  # (N, S), 1 in views without part
    sigma_px: np.ndarray  # (N,) of the inverse depth at the texture's centre, as the largest shift in a search view
    offset: np.ndarray  # (N, 2) the texture's centre of gravity, from the patch's centre
    spread: np.ndarray  # (N, 2) variance of the texture's energy about it
    iterations: np.ndarray  # (N,)
    status: np.ndarray  # (N,) MatchStatus

    @property
    def ok(self) -> np.ndarray:
        """(N,) which points passed all limits."""
        return self.status == MatchStatus.OK


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfaceStarts:
    """N pieces of surface to be matched about points of the reference view, with approximate values, priors and windows."""

    xy: np.ndarray  # (N, 2) rows' pixels of the reference view
    theta: np.ndarray  # (N, 3) or (N, 6) approximate θ of (1); the width chooses planes or quadrics
    visible: np.ndarray | None = None  # (N, S) which search views take part; None: all
    prior: SurfacePrior | None = None
    window: np.ndarray | None = None  # (N, n) weights of the patches' pixels; None: equal
    without_noise: bool = False  # the texture's centre of gravity is that of the gradients' energy beyond their noise

    def select(self, rows: np.ndarray | slice) -> "SurfaceStarts":
        """Only these points."""
        return SurfaceStarts(
            xy=self.xy[rows],
            theta=self.theta[rows],
            visible=None if self.visible is None else self.visible[rows],
            prior=None if self.prior is None else self.prior.select(rows),
            window=None if self.window is None else self.window[rows],
            without_noise=self.without_noise,
        )


def match_surface(
    views: Views, starts: SurfaceStarts, settings: MatchingSettings, *, sigma_across_px: float, monitor: Monitor | None = None
) -> SurfacePatch:
    """Fit the surface (1) about points of the reference view to all images at once.

    `sigma_across_px` is σ_c, in rows' pixels: 0.001 forces the patches onto their epipolar lines. A point that lies outside a view that
    takes part is OUT_OF_IMAGE. Cost: about 30 µs per point of 13×13 and search image.
    """
    n = len(starts.xy)

    def work(span: slice) -> SurfacePatch:
        if monitor is not None and monitor.cancelled:
            monitor.step("surface", span.start, n)
        return _Adjustment(views, starts.select(span), settings, sigma_across_px).solve()

    parts = in_threads(work, equal_pieces(n, LARGEST, SHARED_FROM))
    return SurfacePatch(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in SurfacePatch.__dataclass_fields__})


@dataclass(eq=False, kw_only=True, slots=True)
class _Linear:
    """The adjustment of m points, linearised at one θ. S search views."""

    along: np.ndarray  # (m, S, 2) s_k
    across: np.ndarray  # (m, S, 2) n'_k
    weight: np.ndarray  # (m, S) P_k
    correlation: np.ndarray  # (m, S)
    speed: np.ndarray  # (m,) largest |e_k|
    inside: np.ndarray  # (m,) the images of all search views that take part

    @classmethod
    def empty(cls, m: int, S: int) -> "_Linear":
        z = np.zeros
        return cls(
            along=z((m, S, 2)), across=z((m, S, 2)), weight=z((m, S)), correlation=z((m, S)), speed=z(m), inside=np.ones(m, dtype=bool)
        )

    def put(self, rows: np.ndarray, other: "_Linear") -> None:
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(other, name)


class _Adjustment:
    """The adjustment (4) of a chunk of points."""

    def __init__(self, views: Views, starts: SurfaceStarts, settings: MatchingSettings, sigma_across_px: float) -> None:
        xy, S = starts.xy, len(views.search)
        self._patches = TemplatePatches(
            views.template,
            xy,
            settings.patch_px,
            views.rows.step,
            degree=1 if starts.theta.shape[1] == 3 else 2,
            weight=starts.window,
            without_noise=starts.without_noise,
        )
        self._images = [views.images[k] for k in views.search]
        self._lines = [Epipolar(views.base, views.cameras[k], views.rows, xy) for k in views.search]
        self._start, self._prior = starts.theta, starts.prior
        self._visible = np.ones((len(xy), S), dtype=bool) if starts.visible is None else starts.visible
        self._settings, self._across_weight = settings, 1 / sigma_across_px**2
        self._S, self._P = S, self._patches.monomials.shape[1]

    def solve(self) -> SurfacePatch:
        start = self._start
        s, n, P, S = self._settings, len(start), self._P, self._S
        theta, across = np.array(start, dtype=np.float64), np.zeros((n, S))
        status = np.full(n, MatchStatus.NOT_CONVERGED, dtype=np.int8)
        status[~self._patches.textured] = MatchStatus.NO_TEXTURE
        status[~(self._patches.inside & np.isfinite(theta).all(axis=1))] = MatchStatus.OUT_OF_IMAGE
        state, iterations = _Linear.empty(n, S), np.zeros(n, dtype=np.int16)
        active = np.flatnonzero(status == MatchStatus.NOT_CONVERGED)
        for iteration in range(1, s.max_iterations + 1):
            if not len(active):
                break
            rows = slice(None) if len(active) == n else active  # all: no copies
            linear, rhs = self._linearise(theta[active], across[active], rows)
            pseudo, difference = self._pseudo(theta[active], across[active], rows)
            N = self._normal(linear, self._patches, rows) + pseudo[:, :, None] * np.eye(P + S)
            step = solve_normals(N, rhs + pseudo * difference)  # (4)
            length = np.abs(step[:, 0]) * linear.speed
            shrink = np.minimum(1.0, MAX_STEP_PX / np.maximum(length, 1e-12))[:, None]
            theta[active] += step[:, :P] * shrink
            across[active] += step[:, P:] * shrink
            iterations[active] = iteration
            state.put(active, linear)
            away = (np.abs(theta[active, 0] - start[active, 0]) * linear.speed > 2 * s.max_shift_px) | ~np.isfinite(length)
            done = length < np.maximum(
                min(s.converged_px, MOST_CONVERGED_PX), CONVERGED_SIGMAS * linear.speed / np.sqrt(np.maximum(N[:, 0, 0], 1e-30))
            )
            status[active[done]] = MatchStatus.OK
            status[active[away]] = MatchStatus.SHIFT_TOO_LARGE
            status[active[~linear.inside]] = MatchStatus.OUT_OF_IMAGE
            active = active[~(done | away | ~linear.inside)]
        return self._judge(theta, across, state, iterations, status)

    def _linearise(self, theta: np.ndarray, across: np.ndarray, rows: np.ndarray | slice) -> tuple["_Linear", np.ndarray]:
        """The directions, weights and correlations at θ, and the right side (m, P + S) of (4) without pseudo-observations."""
        P, patches = self._P, self._patches
        state, rhs = _Linear.empty(len(theta), self._S), np.zeros((len(theta), P + self._S))
        for k, (image, line) in enumerate(zip(self._images, self._lines)):
            visible = self._visible[rows, k]
            c, e, A, L = line.centre(theta, rows)
            if not visible.all():  # a point may lie behind a camera whose view takes no part
                c, e, A, L = (np.where(visible.reshape(-1, *[1] * (a.ndim - 1)), a, 1.0) for a in (c, e, A, L))
            normal = normal_to(e)
            c = c + across[:, k, None] * normal
            inside = image.inside(c, np.array(patches.half) * INSIDE_SHARE)
            rho, (gx, gy) = self._compare(k, theta, np.where(inside[:, None], c, c[inside.argmax()] if inside.any() else 0.0), L, rows)
            s, t = _apply_inverse(A, e), _apply_inverse(A, normal)
            weight = visible / np.maximum(patches.residual_variance(rho, P + 2, rows), MIN_NOISE**2)
            rhs[:, :P] -= weight[:, None] * (s[:, :1] * gx + s[:, 1:] * gy)
            rhs[:, P + k] -= weight * (t[:, 0] * gx[:, 0] + t[:, 1] * gy[:, 0])
            state.along[:, k], state.across[:, k], state.weight[:, k], state.correlation[:, k] = s, t, weight, np.where(visible, rho, 1.0)
            np.maximum(state.speed, visible * np.linalg.norm(e, axis=1), out=state.speed)
            state.inside &= inside | ~visible
        return state, rhs

    def _compare(
        self, k: int, theta: np.ndarray, at: np.ndarray, slope: np.ndarray, rows: np.ndarray | slice
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Correlation (m,) and the products with the design matrix, of the patches of search view k for the surface θ (m, P)."""
        patches, visible, parts = self._patches, self._visible[rows, k], []
        for piece in pieces(len(theta), len(patches.monomials)):
            own = piece if isinstance(rows, slice) else rows[piece]
            x, y = self._lines[k].warp(theta[piece], patches.monomials, own, at[piece], slope[piece])
            there = visible[piece]
            if not there.all():  # another's place: no other part of the image is to be interpolated
                x[~there], y[~there] = x[there.argmax()], y[there.argmax()]
            parts.append(patches.compare(self._images[k].sample(x, y), own))
        rho, gx, gy = (np.concatenate(a) for a in zip(*((rho, *both) for rho, both in parts)))
        return rho, (gx, gy)

    def _normal(self, a: "_Linear", patches: TemplatePatches, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Σ P_k J_kᵀ M J_k (m, P + S, P + S)."""
        P, N = self._P, np.zeros((len(a.speed), self._P + self._S, self._P + self._S))
        for k in range(self._S):
            s, t, weight = a.along[:, k], a.across[:, k], a.weight[:, k]
            N[:, :P, :P] += weight[:, None, None] * patches.normal(s, s, rows)
            self._cross(N, k, weight[:, None] * patches.normal_to_shift(s, t, rows))
            N[:, P + k, P + k] = weight * patches.normal_of_shift(t, t, rows)
        return N

    def _cross(self, N: np.ndarray, k: int, block: np.ndarray) -> None:
        N[:, : self._P, self._P + k] = N[:, self._P + k, : self._P] = block

    def _covariance(self, a: "_Linear", pseudo: np.ndarray) -> np.ndarray:
        """(5) for all points of the chunk (n, P + S, P + S)."""
        P, patches, squared = self._P, self._patches, self._patches.squared()
        noise, common = np.zeros((2, len(pseudo), P + self._S, P + self._S))
        total = np.einsum("nk,nki->ni", a.weight, a.along)
        common[:, :P, :P] = squared.normal(total, total)
        for k in range(self._S):
            s, t = a.along[:, k] * self._visible[:, [k]], a.across[:, k] * self._visible[:, [k]]
            noise[:, :P, :P] += np.einsum("ni,ni->n", s, s)[:, None, None] * patches.noise_moment
            self._cross(noise, k, np.einsum("ni,ni->n", s, t)[:, None] * patches.noise_moment[:, 0])
            noise[:, P + k, P + k] = np.einsum("ni,ni->n", t, t) * patches.noise_moment[:, 0, 0]
            self._cross(common, k, squared.normal_to_shift(total, a.weight[:, k, None] * t))
            for j in range(self._S):
                common[:, P + k, P + j] = squared.normal_of_shift(a.weight[:, k, None] * t, a.weight[:, j, None] * a.across[:, j])
        middle = 0.5 * self._normal(a, squared) + 0.5 * common / np.maximum(a.weight.max(axis=1), 1e-12)[:, None, None]
        diagonal = np.arange(P + self._S)
        texture = without_noise(self._normal(a, patches), 0.5 * patches.gradient_noise[:, None, None] * noise)
        texture[:, diagonal, diagonal] += pseudo
        middle[:, diagonal, diagonal] += pseudo * self._error_ratio(pseudo)
        half = inverse_normals(texture)
        return half @ middle @ half  # (5)

    def _pseudo(self, theta: np.ndarray, across: np.ndarray, rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """Weights (m, P + S) of the pseudo-observations, and their values less the present unknowns."""
        weight, difference = np.zeros((2, len(theta), self._P + self._S))
        weight[:, self._P :], difference[:, self._P :] = self._across_weight, -across
        if self._prior is not None:
            weight[:, : self._P] = 1 / self._prior.sigma[rows] ** 2
            difference[:, : self._P] = np.where(weight[:, : self._P] > 0, self._prior.value[rows] - theta, 0.0)
        return weight, difference

    def _error_ratio(self, pseudo: np.ndarray) -> np.ndarray:
        """(n, P + S) variance of the pseudo-observations' errors in units of their weights' inverses."""
        ratio = np.ones_like(pseudo)
        if self._prior is not None and self._prior.error is not None:
            taking_part = pseudo[:, : self._P] > 0
            ratio[:, : self._P] = np.where(taking_part, pseudo[:, : self._P] * np.where(taking_part, self._prior.error, 0.0) ** 2, 1.0)
        return ratio

    def _judge(self, theta: np.ndarray, across: np.ndarray, state: "_Linear", iterations: np.ndarray, status: np.ndarray) -> SurfacePatch:
        """The result with its covariance (5), and the first limit that each point exceeds as its status."""
        s, P, patches, speed, correlation = self._settings, self._P, self._patches, state.speed, state.correlation
        start = self._start
        K = self._covariance(state, self._pseudo(theta, across, slice(None))[0])
        at = monomials(patches.offset[:, 0], patches.offset[:, 1], 1 if P == 3 else 2)
        sigma = speed * np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", at, K[:, :P, :P], at), 0.0))
        lost = np.clip(1 - correlation.min(axis=1) ** 2, 0, 1)
        pixels = np.maximum(patches.pixels, P + 3.0)
        for bad, why in (
            (theta[:, 0] <= 0, MatchStatus.SHIFT_TOO_LARGE),
            (np.abs(theta[:, 0] - start[:, 0]) * speed > s.max_shift_px, MatchStatus.SHIFT_TOO_LARGE),
            (np.abs(theta[:, 1:3] - start[:, 1:3]).max(axis=1) * speed > s.max_shear, MatchStatus.SHAPE_TOO_LARGE),
            (correlation.min(axis=1) < s.min_correlation, MatchStatus.LOW_CORRELATION),
            (sigma > s.max_sigma_px, MatchStatus.SIGMA_TOO_LARGE),
            (SIGMA0_CONTRAST * np.sqrt(lost * pixels / (pixels - P - 2)) > s.max_sigma0, MatchStatus.SIGMA0_TOO_LARGE),
        ):
            status[(status == MatchStatus.OK) & bad] = why
        side = np.sqrt(np.maximum(K[:, range(P, P + self._S), range(P, P + self._S)], 0.0))
        return SurfacePatch(
            theta=theta,
            covariance=K[:, :P, :P],
            across_px=across,
            across_sigma_px=side,
            visible=self._visible,
            correlation=correlation,
            sigma_px=sigma,
            offset=patches.offset,
            spread=patches.spread,
            iterations=iterations,
            status=status,
        )


def normal_to(direction: np.ndarray) -> np.ndarray:
    """Unit vectors (…, 2) at right angles to directions (…, 2)."""
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1) / np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 1e-12)


def without_noise(N: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """N without the gradients' noise, but not more than 1 − MIN_REMAINING of any unknown's own."""
    d = np.einsum("nii->ni", N)
    share = np.einsum("nii->ni", noise) / np.maximum(d, 1e-300)
    scale = np.minimum(1.0, (1 - MIN_REMAINING) / np.maximum(share.max(axis=1), 1e-12))
    return N - noise * scale[:, None, None]


def _apply_inverse(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A⁻¹ b of 2×2 matrices (m, 2, 2); zero where A is singular."""
    det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    x = np.stack([A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1], A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]], axis=1)
    return np.where((np.abs(det) > 1e-3)[:, None], x / np.where(np.abs(det) > 1e-3, det, 1.0)[:, None], 0.0)


def _scaled(N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """N with a diagonal of ones (and a trace of damping), and the scale (m, P)."""
    scale = 1 / np.sqrt(np.maximum(np.nan_to_num(np.einsum("nii->ni", N)), 1e-30))
    return np.nan_to_num(N * scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(N.shape[1]), scale


def solve_normals(N: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """x (m, P) of N x = rhs, for normal matrices (m, P, P) whose unknowns have unlike units."""
    M, scale = _scaled(N)
    return scale * np.einsum("nij,nj->ni", invert_spd(M), scale * rhs)


def inverse_normals(N: np.ndarray) -> np.ndarray:
    """N⁻¹ (m, P, P), for normal matrices whose unknowns have unlike units."""
    M, scale = _scaled(N)
    return invert_spd(M) * scale[:, :, None] * scale[:, None, :]
