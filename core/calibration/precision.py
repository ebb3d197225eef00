"""Precision in space: covariance of the cameras in the free network, and the error that it causes at points of a volume.

    Q_c = (S + μ G Gᵀ)⁻¹ − G (Gᵀ G)⁻¹ μ⁻¹ … Gᵀ = S⁺                              (1)   minimum trace, cameras
    X(c): ∂X/∂c = −(Σ G_cᵀ G_c)⁻¹ G_cᵀ J_c                                      (2)   a point intersected by the cameras that show it
    ΔX_i − (τ + θ × X_i) → min over τ, θ                                         (3)   errors beyond a rigid motion of the whole

    P = Q_r ⊕ 0 + [K; I] Σ [K; I]ᵀ ,   K = Q_rl Q_ll⁻¹                          (4)   l: unknowns that were left out, r: the others
    Σ = τ Q_gg for each group g of them ,   τ = max(0, F − 1) ,   F = xᵀ Q_gg⁻¹ x / m      (5)
    1 + τ = b γ(a, b) / γ(a + 1, b) ,   a = m / 2 ,   b = m F / 2                   (6)   coefficients of a fisheye lens

(4) is the effect of left-out unknowns of covariance Σ on the others (Schmidt 1966, "consider" parameters); with Σ = Q_ll it is the
covariance of the adjustment in which all are free. As E F = 1 + λ / m, F − 1 in (5) is the unbiased estimate of the size of a group
beyond its noise, and its positive part the empirical Bayes variance (Efron & Morris 1973). The four coefficients of a fisheye lens describe
one curve and replace one another: that one of them is small by itself proves nothing. (6), with incomplete gamma functions, is its mean
size for x ~ N(0, (1 + τ) Q_gg) and 1 / (1 + τ) uniform between 0 and 1 (Strawderman 1971, doi:10.1214/aoms/1177693528), never 0.

Mapping through (3) is an S-transformation to the datum of the points themselves (Baarda 1973), so the figures do not depend on the datum.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.camera import INTERIOR, Camera, exterior_derivatives, image_with_derivatives, interior_of
from ..geometry.rotation import cross_matrix
from .bundle import FIXED_SIGMA, NEAREST_M, Normals, Unknowns, free_network, reduce_to_cameras
from .network import Network


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PredictedError:
    """Errors at points in space caused by the calibration alone (not by measuring the points), as standard deviations [m]."""

    xyz_m: np.ndarray  # (M, 3)
    sigma_m: np.ndarray  # (M,) root of the variance summed over x, y, z
    rms_m: float
    length_rms_m: float  # of pairs (point 2 i, point 2 i + 1)


def camera_covariance(network: Network, normals: Normals, unknowns: Unknowns) -> np.ndarray:
    """Cofactors (C p, C p) of the camera unknowns in the free network, for sigma0 = 1 px.  (1)"""
    S = reduce_to_cameras(normals)[0]
    scale = 1 / np.sqrt(np.maximum(np.diag(normals.V), 1e-12))
    G = np.linalg.qr(free_network(network, unknowns) / scale[:, None])[0]
    scaled = (S * scale * scale[:, None] + (S * scale * scale[:, None]).T) / 2
    values, vectors = np.linalg.eigh(scaled + G @ G.T)
    Q = (vectors / np.maximum(values, 1e-15)) @ vectors.T - G @ G.T
    return Q * scale * scale[:, None]


def group_of(
    off: np.ndarray, unknowns: Unknowns, covariance: np.ndarray, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A group of interior unknowns less the expected values (m,), its covariance (m, m) and its columns (m,), all cameras together.

    `off` (C, 10) are all interior unknowns less their expected values, `covariance` (C p, C p) that of the free ones. What a camera's
    lens does not have is left out: an unknown that is 0 by definition would dilute the others.
    """
    columns = list(unknowns.columns)
    of_group = [INTERIOR.index(name) for name in names]
    index = np.arange(len(off))[:, None] * len(columns) + [columns.index(n) for n in of_group]
    there = unknowns.sigma[:, of_group] > FIXED_SIGMA
    return off[:, of_group][there], covariance[np.ix_(index[there], index[there])], index[there]


def with_left_out(
    covariance: np.ndarray,
    unknowns: Unknowns,
    full: np.ndarray,
    off: np.ndarray,
    left_out: Sequence[Sequence[str]],
    fisheye: bool = False,
) -> np.ndarray:
    """Covariance (16 C, 16 C) of all unknowns when groups of interior unknowns are fixed at their expected values.  (4)–(6)

    `covariance` (C p, C p) and `unknowns` are those of the adjustment without the groups, `full` (16 C, 16 C) and `off` (C, 10), values
    less expected values, those of the adjustment with all unknowns free; `fisheye`: of lenses with four coefficients.
    """
    from scipy.linalg import block_diag

    every = replace(unknowns, free=np.ones(len(INTERIOR), dtype=bool))
    free = (np.arange(len(off))[:, None] * 16 + unknowns.columns).ravel()
    P = np.zeros_like(full)
    P[np.ix_(free, free)] = covariance
    if not left_out:
        return P
    groups = [group_of(off, every, full, names) for names in left_out]
    index = np.concatenate([columns for _, _, columns in groups])
    curve = [fisheye and set(names) <= {"k1", "k2", "k3", "p1", "p2"} for names in left_out]
    excess = block_diag(*(_excess(float(x @ np.linalg.solve(Q, x)), len(x), c) * Q for (x, Q, _), c in zip(groups, curve)))
    K = np.linalg.solve(full[np.ix_(index, index)], full[index]).T
    return P + K @ excess @ K.T


def _excess(square: float, count: int, of_curve: bool) -> float:
    """τ of `count` unknowns whose sum of squares is this, in units of their covariance.  (5); of the coefficients of a curve  (6)"""
    from scipy.special import gammainc

    if not of_curve:
        return max(0.0, square / count - 1)
    a, b = count / 2, max(square / 2, 1e-6)
    return float(b * gammainc(a, b) / (a * gammainc(a + 1, b)) - 1)


def point_derivatives(cameras: Sequence[Camera], unknowns: Unknowns, xyz_m: np.ndarray) -> np.ndarray:
    """Derivatives (M, 3, C p) of intersected points (M, 3) to the camera unknowns; NaN where fewer than two cameras show a point.  (2)"""
    M, p = len(xyz_m), len(unknowns.columns)
    A, N, rays = np.zeros((M, 3, len(cameras) * p)), np.zeros((M, 3, 3)), np.zeros(M)
    for c, camera in enumerate(cameras):
        q = camera.to_camera(xyz_m)
        visible = (q[:, 2] > NEAREST_M) & camera.sees(camera.project(xyz_m))
        q = np.where(visible[:, None], q, [0.0, 0.0, 1.0])
        _, J_interior, G = image_with_derivatives(interior_of(camera), q, camera.fisheye)
        J = np.concatenate([J_interior, exterior_derivatives(G, q)], axis=-1)[..., unknowns.columns]
        GR = (G @ camera.R_cam_world) * visible[:, None, None]
        N += GR.transpose(0, 2, 1) @ GR
        A[:, :, c * p : (c + 1) * p] = GR.transpose(0, 2, 1) @ J
        rays += visible
    D = np.full_like(A, np.nan)
    good = rays >= 2
    D[good] = -np.linalg.solve(N[good], A[good])
    return D


def without_rigid_motion(D: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    """Derivatives (M, 3, q) less the best-fitting rigid motion of the whole.  (3)"""
    M = len(xyz_m)
    T = np.concatenate([np.broadcast_to(np.eye(3), (M, 3, 3)), -cross_matrix(xyz_m - xyz_m.mean(axis=0))], axis=-1).reshape(3 * M, 6)
    flat = D.reshape(3 * M, -1)
    return (flat - T @ np.linalg.lstsq(T, flat, rcond=None)[0]).reshape(D.shape)


def displaced(cameras: Sequence[Camera], unknowns: Unknowns, change: np.ndarray, xyz_m: np.ndarray) -> float:
    """RMS distance [m] by which a change (C p,) of the camera unknowns moves points (M, 3), beyond a rigid motion.  (2), (3)"""
    D = point_derivatives(cameras, unknowns, xyz_m)
    keep = np.isfinite(D).all(axis=(1, 2))
    if not keep.any():
        return 0.0
    moved = without_rigid_motion(D[keep], xyz_m[keep]) @ change
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def predicted_error(cameras: Sequence[Camera], unknowns: Unknowns, covariance: np.ndarray, pairs_m: np.ndarray) -> PredictedError:
    """The error at the ends of test bars (K, 2, 3) from the cameras' covariance (C p, C p).

    Bars with an end that fewer than two cameras show are left out.
    """
    points = pairs_m.reshape(-1, 3)
    D = point_derivatives(cameras, unknowns, points)
    both = np.isfinite(D).all(axis=(1, 2)).reshape(-1, 2).all(axis=1)
    keep = np.repeat(both, 2)
    D, points = without_rigid_motion(D[keep], points[keep]), points[keep]
    variance = np.einsum("mij,jk,mik->m", D, covariance, D, optimize=True)
    d = points[0::2] - points[1::2]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    along = np.einsum("mi,mij->mj", d, D[0::2] - D[1::2])
    length = np.einsum("mj,jk,mk->m", along, covariance, along, optimize=True)
    return PredictedError(
        xyz_m=points,
        sigma_m=np.sqrt(np.maximum(variance, 0)),
        rms_m=float(np.sqrt(max(variance.mean(), 0.0))) if len(points) else np.inf,
        length_rms_m=float(np.sqrt(max(length.mean(), 0.0))) if len(points) else np.inf,
    )
