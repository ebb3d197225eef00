"""Self-calibrating bundle adjustment of a reference bar (Maas 1998; D'Apuzzo et al. 2000, §2.2), points eliminated by Schur's complement.

A bar position i is a middle M_i and a unit vector d_i; its length L holds exactly, and no weight mixes millimetres with pixels:

    X_i± = M_i ± (L / 2) d_i                                                   (1)   5 unknowns
    x_ick + v = F_c(X_ik) ,   Σ w v² + Σ ((p − p0) / σ_p)² s² → min            (2)   6 + up to 10 unknowns per camera
    [V  W ] [Δc]   [g_c]
    [Wᵀ U ] [Δb] = [g_b] ,   U_i = L_i L_iᵀ ,   Y_i = L_i⁻¹ W_iᵀ                (3)   U: 5×5 blocks
    S = V − Σ Y_iᵀ Y_i ,   S Δc = g_c − Σ Y_iᵀ L_i⁻¹ g_i                       (4)
    (S + μ G Gᵀ) Δc = …                                                        (5)   G: turning and shifting the whole (free network)

The second sum of (2) are pseudo-observations of the interior unknowns: what a lens can be (see `Pseudo`); s is the image points' sigma.
The scale comes from L, so G has six columns. All normal equations are float64; one step costs O(N C²).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.camera import Camera
from ..geometry.camera_derivatives import INTERIOR, camera_of, exterior_derivatives, image_of, image_with_derivatives, interior_of
from ..geometry.rotation import cross_matrix, rotation_from_vector

BEHIND_PX = 1e4  # residual of a point behind the camera
DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e6
CONVERGED = 1e-4  # a step that lowers the sum of squares by less than this part of σ0² per unknown changes nothing


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Network:
    """Cameras and bar positions: the unknowns of the adjustment."""

    interior: np.ndarray  # (C, 10), see INTERIOR
    R: np.ndarray  # (C, 3, 3) world → camera
    t: np.ndarray  # (C, 3) m
    middle: np.ndarray  # (N, 3) m
    direction: np.ndarray  # (N, 3) unit vectors from end 1 to end 0
    length_m: float

    @property
    def ends_m(self) -> np.ndarray:
        """(N, 2, 3) the bar's ends.  (1)"""
        half = self.direction * (self.length_m / 2)
        return np.stack([self.middle + half, self.middle - half], axis=1)

    def cameras(self, names: Sequence[str], size_px: np.ndarray) -> tuple[Camera, ...]:
        """The cameras as values of the geometry package."""
        return tuple(
            camera_of(name, (int(size[0]), int(size[1])), p, R, t)
            for name, size, p, R, t in zip(names, size_px, self.interior, self.R, self.t)
        )

    def with_cameras(self, cameras: Sequence[Camera]) -> "Network":
        """The same positions before other cameras."""
        return replace(
            self,
            interior=np.stack([interior_of(c) for c in cameras]),
            R=np.stack([c.R_cam_world for c in cameras]),
            t=np.stack([c.t_cam_world_m for c in cameras]),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Unknowns:
    """Which interior unknowns are free (10,) in all cameras, and what is known of them beforehand (C, 10): value and sigma."""

    free: np.ndarray
    expected: np.ndarray
    sigma: np.ndarray

    @property
    def columns(self) -> np.ndarray:
        """Indices of the free unknowns among the 16 of a camera, exterior orientation last."""
        return np.concatenate([np.flatnonzero(self.free), np.arange(10, 16)])

    def only(self, *names: str) -> "Unknowns":
        """The same with other unknowns free."""
        return replace(self, free=np.array([name in names for name in INTERIOR]))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Normals:
    """The normal equations at one state, reduced to the cameras: (3), (4)."""

    V: np.ndarray  # (C p, C p)
    g_c: np.ndarray  # (C p,)
    U: np.ndarray  # (N, 5, 5)
    g_b: np.ndarray  # (N, 5)
    W: np.ndarray  # (N, 5, C p)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Adjusted:
    """A network after adjustment. `residual_px` (N, C, 2, 2) observed − computed; `weight` (N, C, 2), 0: not used."""

    network: Network
    residual_px: np.ndarray
    weight: np.ndarray
    cost: float
    iterations: int
    converged: bool


def residuals(network: Network, xy_px: np.ndarray) -> np.ndarray:
    """Observed − computed (N, C, 2, 2); NaN where nothing was observed, huge where a point lies behind its camera."""
    v = xy_px - np.moveaxis(_images(network), 0, 1)
    with np.errstate(invalid="ignore"):
        return np.clip(v, -BEHIND_PX, BEHIND_PX)


def _in_cameras(network: Network) -> np.ndarray:
    """The ends in each camera's frame (C, 2 N, 3)."""
    return network.ends_m.reshape(-1, 3) @ network.R.transpose(0, 2, 1) + network.t[:, None]


def _images(network: Network) -> np.ndarray:
    """Image points (C, N, 2, 2)."""
    p = _in_cameras(network)
    ahead = p[..., 2:] > 1e-3
    image = np.where(ahead, image_of(network.interior, np.where(ahead, p, 1.0)), BEHIND_PX)
    return image.reshape(len(p), -1, 2, 2)


def weights_of(residual_px: np.ndarray, cauchy_px: float | None, used: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights (N, C, 2) of the image points and their part of the sum (2), Cauchy's if a width is given (Huber 1981)."""
    square = np.where(used, np.sum(np.nan_to_num(residual_px) ** 2, axis=-1), 0.0)
    if cauchy_px is None:
        return used.astype(np.float64), float(square.sum())
    u = square / cauchy_px**2
    return used / (1 + u), float(cauchy_px**2 * np.log1p(u).sum())


def tangents(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (N, 3, 2) across each direction (N, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=-1)


def design(network: Network, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image points (C, N, 2, 2) and their derivatives to the free camera unknowns (C, N, 4, p) and to the bar's (C, N, 4, 5)."""
    p = _in_cameras(network)
    C, N = len(p), len(network.middle)
    p = np.where(p[..., 2:] > 1e-3, p, [0.0, 0.0, 1e3])
    image, J_interior, G = image_with_derivatives(network.interior, p)
    J = np.concatenate([J_interior[..., np.flatnonzero(unknowns.free)], exterior_derivatives(G, p)], axis=-1)
    GR = (G.reshape(C, -1, 3) @ network.R).reshape(C, N, 2, 2, 3)
    B = np.empty((C, N, 2, 2, 5))
    B[..., :3] = GR
    B[..., 3:] = (GR.reshape(C, N, 4, 3) @ (tangents(network.direction) * (network.length_m / 2))).reshape(C, N, 2, 2, 2)
    B[:, :, 1, :, 3:] *= -1
    return image.reshape(C, N, 2, 2), J.reshape(C, N, 4, -1), B.reshape(C, N, 4, 5)


def normal_equations(network: Network, residual_px: np.ndarray, weight: np.ndarray, unknowns: Unknowns, unit_px: float) -> Normals:
    """The normal equations (3) with pseudo-observations; `unit_px` is the sigma s of an image coordinate."""
    _, J, B = design(network, unknowns)
    C, N, _, p = J.shape
    root = np.repeat(np.sqrt(np.moveaxis(weight, 1, 0)), 2, axis=2)[..., None]  # (C, N, 4, 1)
    v = np.moveaxis(np.where(weight[..., None] > 0, residual_px, 0.0), 1, 0).reshape(C, N, 4, 1) * root
    J *= root
    B *= root
    V, g_c, W = np.zeros((C * p, C * p)), np.zeros(C * p), np.empty((N, 5, C * p))
    for c in range(C):
        at = slice(c * p, (c + 1) * p)
        flat = J[c].reshape(-1, p)
        V[at, at], g_c[at] = flat.T @ flat, flat.T @ v[c].ravel()
        W[:, :, at] = B[c].transpose(0, 2, 1) @ J[c]
    stacked = np.moveaxis(B, 0, 1).reshape(N, C * 4, 5)
    transposed = stacked.transpose(0, 2, 1)
    U = transposed @ stacked + np.eye(5) * 1e-3
    g_b = (transposed @ np.moveaxis(v, 0, 1).reshape(N, C * 4, 1))[..., 0]
    _add_pseudo_observations(V, g_c, network, unknowns, unit_px)
    return Normals(V=V, g_c=g_c, U=U, g_b=g_b, W=W)


def _add_pseudo_observations(V: np.ndarray, g_c: np.ndarray, network: Network, unknowns: Unknowns, unit_px: float) -> None:
    free = np.flatnonzero(unknowns.free)
    p = len(free) + 6
    for c in range(len(network.interior)):
        at = c * p + np.arange(len(free))
        P = (unit_px / unknowns.sigma[c, free]) ** 2
        V[at, at] += P
        g_c[at] += P * (unknowns.expected[c, free] - network.interior[c, free])


def pseudo_cost(network: Network, unknowns: Unknowns, unit_px: float) -> float:
    """The second sum of (2)."""
    off = ((network.interior - unknowns.expected) / unknowns.sigma)[:, unknowns.free]
    return float(unit_px**2 * np.sum(off**2))


def free_network(network: Network, unknowns: Unknowns) -> np.ndarray:
    """The changes (C p, 6) of the camera unknowns when everything is turned and shifted as a whole, which no image shows."""
    free = int(unknowns.free.sum())
    C = len(network.R)
    G = np.zeros((C, free + 6, 6))
    G[:, free : free + 3, :3] = G[:, free + 3 :, 3:] = -network.R
    G[:, free + 3 :, :3] = -cross_matrix(network.t) @ network.R
    return G.reshape(C * (free + 6), 6)


def reduce_to_cameras(normals: Normals, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """S and its right side (4), and what the bars' own steps need: L⁻¹ (N, 5, 5), Y (N, 5, C p), L⁻¹ g (N, 5)."""
    U = normals.U
    if damping:
        U = U + damping * U * np.eye(5)
    inverse = inverse_factors(U)
    Y = inverse @ normals.W
    z = (inverse @ normals.g_b[..., None])[..., 0]
    flat = Y.reshape(-1, Y.shape[2])
    return normals.V - flat.T @ flat, normals.g_c - flat.T @ z.ravel(), inverse, Y, z


def inverse_factors(U: np.ndarray) -> np.ndarray:
    """L⁻¹ (N, n, n) of U = L Lᵀ (N, n, n), all N at once: for many small blocks much faster than one after the other."""
    n = U.shape[1]
    A = np.ascontiguousarray(np.moveaxis(U, 0, -1))  # (n, n, N); becomes L column by column, B becomes L⁻¹ row by row
    B = np.zeros_like(A)
    for j in range(n):
        A[j:, j] /= np.sqrt(A[j, j])
        for k in range(j + 1, n):
            A[k:, k] -= A[k:, j] * A[k, j]
        B[j, j] = 1 / A[j, j]
        if j:
            B[j, :j] = -np.einsum("kN,kmN->mN", A[j, :j], B[:j, :j]) * B[j, j]
    return np.ascontiguousarray(np.moveaxis(B, -1, 0))


def solve_step(network: Network, normals: Normals, unknowns: Unknowns, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The step of the cameras (C p,) and of the bars (N, 5).  (5)"""
    S, rhs, inverse, Y, z = reduce_to_cameras(normals, damping)
    S = S + damping * np.diag(np.diag(normals.V))
    scale = 1 / np.sqrt(np.maximum(np.diag(normals.V), 1e-12))
    G = np.linalg.qr(free_network(network, unknowns) / scale[:, None])[0]
    scaled = S * scale * scale[:, None] + G @ G.T
    step = scale * np.linalg.lstsq(scaled, scale * rhs, rcond=1e-15)[0]
    bars = (inverse.transpose(0, 2, 1) @ (z - Y @ step)[..., None])[..., 0]
    return step, bars


def moved(network: Network, unknowns: Unknowns, step: np.ndarray, bars: np.ndarray) -> Network:
    """The network after a step."""
    C = len(network.R)
    step = step.reshape(C, -1)
    interior = network.interior.copy()
    interior[:, unknowns.free] += step[:, :-6]
    turn = rotation_from_vector(step[:, -6:-3])
    direction = network.direction + (tangents(network.direction) @ bars[:, 3:, None])[..., 0]
    return replace(
        network,
        interior=interior,
        R=turn @ network.R,
        t=(turn @ network.t[..., None])[..., 0] + step[:, -3:],
        middle=network.middle + bars[:, :3],
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
    )


def adjust(
    network: Network,
    xy_px: np.ndarray,
    used: np.ndarray,
    unknowns: Unknowns,
    *,
    cauchy_px: float | None = None,
    unit_px: float = 0.1,
    max_iterations: int = 15,
    tolerance: float = CONVERGED,
    damping: float = DAMPING,
) -> Adjusted:
    """Levenberg–Marquardt on (2) from a start; `used` (N, C, 2) says which image points take part."""
    iterations, converged = 0, False
    v = residuals(network, xy_px)
    weight, cost = weights_of(v, cauchy_px, used)
    cost += pseudo_cost(network, unknowns, unit_px)
    while iterations < max_iterations and not converged and damping < MAX_DAMPING:
        iterations += 1
        normals = normal_equations(network, v, weight, unknowns, unit_px)
        while damping < MAX_DAMPING:
            trial = moved(network, unknowns, *solve_step(network, normals, unknowns, damping))
            v_trial = residuals(trial, xy_px)
            weight_trial, cost_trial = weights_of(v_trial, cauchy_px, used)
            cost_trial += pseudo_cost(trial, unknowns, unit_px) if _possible(trial) else np.inf
            if cost_trial <= cost:
                break
            damping *= 10
        else:
            break
        converged = cost - cost_trial < tolerance * unit_px**2 * len(normals.g_c)
        network, v, weight, cost = trial, v_trial, weight_trial, cost_trial
        damping = max(damping / 10, MIN_DAMPING)
    return Adjusted(network=network, residual_px=v, weight=weight, cost=cost, iterations=iterations, converged=converged)


def _possible(network: Network) -> bool:
    return bool(np.isfinite(network.interior).all() and (network.interior[:, 0] > 1.0).all() and np.isfinite(network.t).all())
