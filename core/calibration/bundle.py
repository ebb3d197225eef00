"""Self-calibrating bundle adjustment of a reference bar (Maas 1998; D'Apuzzo et al. 2000, §2.2) or a board, by Schur's complement.

    x_ick + v = F_c(X_ik) ,   Σ w v² + Σ ((p − p0) / σ_p)² s² → min            (1)   6 + up to 11 unknowns per camera; X_ik: `network`
    [V  W ] [Δc]   [g_c]
    [Wᵀ U ] [Δb] = [g_b] ,   U_i = L_i L_iᵀ ,   Y_i = L_i⁻¹ W_iᵀ                (2)   U: q×q blocks, q unknowns of a position
    S = V − Σ Y_iᵀ Y_i ,   S Δc = g_c − Σ Y_iᵀ L_i⁻¹ g_i                       (3)
    (S + μ G Gᵀ) Δc = …                                                        (4)   G: turning and shifting the whole (free network)

The eleventh is how late the camera is, on which its image points x_ick then depend (`delays`).

Another object that the same cameras filmed takes part by its own S and right side (3) at cameras c₀ (Helmert's method of partial networks):

    S Δc = … ,   S ← S + (s / s')² S' ,   g_c ← g_c + (s / s')² (r' − S' (c − c₀))       (5)   s': sigma of its image points

The second sum of (1) is the prior of the interior unknowns, as pseudo-observations (`reference_bar.lens_prior`); s is the sigma of the
image points. The scale comes from the object, so G has six columns. All normal equations are float64; one step costs O(N C² + N C K).
Internally, positions are the last axis of every array and are processed in blocks: the small products of (2) and (3) then run over many
positions at once, which is several times as fast as one position after the other.
"""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from ..geometry.camera import INTERIOR, columns_of_derivatives, columns_of_exterior, image_of
from ..geometry.rotation import cross_matrix, rotation_from_vector, vector_from_rotation
from .delays import MovingPoints
from .network import Network

AnyNetwork = TypeVar("AnyNetwork", bound=Network)

BLOCK = 256  # positions
BEHIND_PX = 1e4  # residual of a point behind the camera
NEAREST_M = 1e-3  # in front of the camera; points that are nearer count as behind it
DAMPING = 1e-3  # of the first step, relative to the diagonal of the normal matrix
MIN_DAMPING = 1e-9
MAX_DAMPING = 1e6  # no step lowers the sum of squares any more
DELAY = 16  # index of the delay among the unknowns of a camera
DELAY_SIGMA = 1.0  # images, of all cameras but the first
FIRST_DELAY_SIGMA = 1e-6
FIXED_SIGMA = 1e-6  # of an unknown that its camera does not have, and that is always 0
CONVERGED = 1e-4  # decrease of the sum of squares in units of σ0² per unknown


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Block:
    """The reduced normal equations of another object that the same cameras filmed: all unknowns of a camera but its delay.  (5)"""

    interior: np.ndarray  # (C, 10) of the cameras at which they were formed
    R: np.ndarray  # (C, 3, 3)
    t: np.ndarray  # (C, 3)
    S: np.ndarray  # (16 C, 16 C) for sigma 1 px
    rhs: np.ndarray  # (16 C,)
    sigma_px: float

    def cost(self, network: Network, unit_px: float) -> float:
        """Its part of the sum (1), less that at its own cameras."""
        change = change_of_cameras(network, self)
        return float((unit_px / self.sigma_px) ** 2 * (change @ self.S @ change - 2 * self.rhs @ change))

    def add_to(self, V: np.ndarray, g_c: np.ndarray, network: Network, columns: np.ndarray, unit_px: float) -> None:
        """Add it to normal equations of the camera unknowns `columns`.  (5)"""
        every, own = np.arange(len(network.R))[:, None], np.flatnonzero(columns != DELAY)
        of_block, of_sum = (every * 16 + columns[own]).ravel(), (every * len(columns) + own).ravel()
        weight = (unit_px / self.sigma_px) ** 2
        V[np.ix_(of_sum, of_sum)] += weight * self.S[np.ix_(of_block, of_block)]
        g_c[of_sum] += weight * (self.rhs - self.S @ change_of_cameras(network, self))[of_block]


def change_of_cameras(network: Network, before: Network | Block) -> np.ndarray:
    """The step (16 C,) of all unknowns of the cameras, but their delays, that leads to those of a network."""
    turn = network.R @ before.R.transpose(0, 2, 1)
    shift = network.t - (turn @ before.t[..., None])[..., 0]
    return np.concatenate([network.interior - before.interior, vector_from_rotation(turn), shift], axis=1).ravel()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Unknowns:
    """Which interior unknowns are free in all cameras, their prior, and whether the delays of the cameras are free."""

    free: np.ndarray  # (10,)
    expected: np.ndarray  # (C, 10)
    sigma: np.ndarray  # (C, 10) of the expected values
    expected_delay_images: np.ndarray | None = None  # (C,); None: no delays
    block: Block | None = None  # of another object

    @property
    def columns(self) -> np.ndarray:
        """Indices of the free unknowns among the 17 of a camera: interior, delay, and the exterior orientation, indices 10 to 15, last."""
        delay = np.arange(DELAY, DELAY + int(self.with_delays))
        return np.concatenate([np.flatnonzero(self.free), delay, np.arange(10, 16)])

    @property
    def with_delays(self) -> bool:
        """Whether the delays are free."""
        return self.expected_delay_images is not None

    @property
    def in_step(self) -> "Unknowns":
        """The same without delays."""
        return replace(self, expected_delay_images=None)

    @property
    def alone(self) -> "Unknowns":
        """The same without another object."""
        return replace(self, block=None)

    def only(self, *names: str) -> "Unknowns":
        """The same prior with only these unknowns free."""
        return replace(self, free=np.array([name in names for name in INTERIOR]))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Normals:
    """The normal equations at one state, reduced to the cameras: (2), (3)."""

    V: np.ndarray  # (C p, C p)
    g_c: np.ndarray  # (C p,)
    U: np.ndarray  # (q, q, N)
    g_b: np.ndarray  # (q, N)
    W: np.ndarray  # (q, C p, N), transposed: its rows are the positions' unknowns


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Adjusted(Generic[AnyNetwork]):
    """An adjusted network. `residual_px` (N, C, K, 2) observed − computed; `weight` (N, C, K), 0: not used."""

    network: AnyNetwork
    residual_px: np.ndarray
    weight: np.ndarray
    cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class LevenbergMarquardt:
    """When the iteration of `adjust` stops, and the damping with which it starts."""

    max_iterations: int = 15
    tolerance: float = CONVERGED
    damping: float = DAMPING


def residuals(network: Network, xy_px: np.ndarray) -> np.ndarray:
    """Observed − computed (N, C, K, 2); NaN where there is no observation, huge where a point lies behind its camera."""
    p = _in_cameras(network)
    ahead = p[:, 2:] > NEAREST_M
    image = image_of(network.interior, np.moveaxis(np.where(ahead, p, 1.0), 1, 2), network.fisheye)  # (C, K N, 2)
    image = np.where(ahead[:, 0, :, None], image, BEHIND_PX).reshape(len(p), xy_px.shape[2], -1, 2)
    with np.errstate(invalid="ignore"):
        return np.clip(xy_px - image.transpose(2, 0, 1, 3), -BEHIND_PX, BEHIND_PX)


def residuals_of(network: Network, points: np.ndarray | MovingPoints) -> tuple[np.ndarray, np.ndarray | None]:
    """Observed − computed (N, C, K, 2), and the velocity of the observed points [px / image] where they are moving."""
    if isinstance(points, MovingPoints):
        xy_px, velocity = points.at(np.zeros(len(network.R)) if network.delay_images is None else network.delay_images)
        return residuals(network, xy_px), velocity
    return residuals(network, points), None


def _in_cameras(network: Network) -> np.ndarray:
    """The object's points in each camera's frame (C, 3, K N): point 0 of all positions, then point 1 …"""
    return network.R @ network.columns_m.reshape(3, -1) + network.t[..., None]


def weights_of(residual_px: np.ndarray, cauchy_px: float | None, used: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights (N, C, K) of the image points and their part of the sum (1); Cauchy's weights if a width is given (Huber 1981)."""
    used = used & np.isfinite(residual_px).all(axis=-1)
    square = np.where(used, np.sum(np.nan_to_num(residual_px) ** 2, axis=-1), 0.0)
    if cauchy_px is None:
        return used.astype(np.float64), float(square.sum())
    u = square / cauchy_px**2
    return used / (1 + u), float(cauchy_px**2 * np.log1p(u).sum())


def design(network: Network, unknowns: Unknowns, velocity_px: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image points (C, 2, K, N) (x and y, points, positions) and their derivatives to the free camera unknowns (C, p, 2, K, N) and to
    those of the position (C, q, 2, K, N). `velocity_px` (N, C, K, 2) per image is that of the observed points, if delays are free."""
    p = _in_cameras(network)
    C, N = len(p), network.count
    p = np.where(p[:, 2:] > NEAREST_M, p, [[0.0], [0.0], [1e3]])
    image, J_interior, G = columns_of_derivatives(network.interior, p, network.fisheye)
    J = [J_interior[:, np.flatnonzero(unknowns.free)], columns_of_exterior(G, p)]
    if unknowns.with_delays:
        moving = np.zeros(image.shape) if velocity_px is None else velocity_px.transpose(1, 3, 2, 0).reshape(image.shape)
        J.insert(1, moving[:, None])
    K = p.shape[-1] // max(N, 1)
    GR = (network.R.transpose(0, 2, 1)[:, None] @ G).reshape(C, 2, 3, K, N).swapaxes(1, 2)
    return image.reshape(C, 2, K, N), np.concatenate(J, axis=1).reshape(C, -1, 2, K, N), network.derivatives(GR)


def normal_equations(
    network: Network,
    residual_px: np.ndarray,
    weight: np.ndarray,
    unknowns: Unknowns,
    unit_px: float,
    velocity_px: np.ndarray | None = None,
) -> Normals:
    """The normal equations (2) with pseudo-observations; `unit_px` is the sigma s of an image coordinate."""
    from scipy.linalg import block_diag

    C, N, p, q = len(network.R), network.count, len(unknowns.columns), network.unknowns
    V, g_c = np.zeros((C, p, p)), np.zeros((C, p))
    U, g_b, W = np.empty((q, q, N)), np.empty((q, N)), np.empty((q, C, p, N))
    for at, part in network.blocks():
        J, B, v = _weighted(part, residual_px[at], weight[at], unknowns, None if velocity_px is None else velocity_px[at])
        flat = J.reshape(C, p, -1)
        V += flat @ flat.swapaxes(1, 2)
        g_c += (flat @ v.reshape(C, -1, 1))[..., 0]
        U[..., at] = np.einsum("ckrn,clrn->kln", B, B)
        g_b[:, at] = np.einsum("ckrn,crn->kn", B, v)
        W[..., at] = np.einsum("ckrn,cprn->kcpn", B, J)
    normals = Normals(V=block_diag(*V), g_c=g_c.ravel(), U=U + 1e-3 * np.eye(q)[..., None], g_b=g_b, W=W.reshape(q, C * p, N))
    _add_pseudo_observations(normals.V, normals.g_c, network, unknowns, unit_px)
    return normals


def _weighted(
    network: Network, residual_px: np.ndarray, weight: np.ndarray, unknowns: Unknowns, velocity_px: np.ndarray | None
) -> tuple[np.ndarray, ...]:
    """Derivatives (C, p, 2 K, N), (C, q, 2 K, N) and residuals (C, 2 K, N), times the square roots of the weights."""
    _, J, B = design(network, unknowns, velocity_px)
    root = np.sqrt(weight.transpose(1, 2, 0))[:, None]  # (C, 1, 2, N)
    v = np.where(weight[..., None] > 0, residual_px, 0.0).transpose(1, 3, 2, 0) * root
    J *= root[:, None]
    B *= root[:, None]
    C, p, _, K, N = J.shape
    return J.reshape(C, p, 2 * K, N), B.reshape(C, -1, 2 * K, N), v.reshape(C, 2 * K, N)


def _add_pseudo_observations(V: np.ndarray, g_c: np.ndarray, network: Network, unknowns: Unknowns, unit_px: float) -> None:
    off, sigma = _pseudo_observations(network, unknowns)
    p = len(unknowns.columns)
    for c in range(len(off)):
        at = c * p + np.arange(off.shape[1])
        P = (unit_px / sigma[c]) ** 2
        V[at, at] += P
        g_c[at] += P * off[c]
    if unknowns.block is not None:
        unknowns.block.add_to(V, g_c, network, unknowns.columns, unit_px)


def _pseudo_observations(network: Network, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Expected values less those of the network (C, p − 6), and their sigmas."""
    off, sigma = (unknowns.expected - network.interior)[:, unknowns.free], unknowns.sigma[:, unknowns.free]
    if unknowns.expected_delay_images is None or network.delay_images is None:
        return off, sigma
    late = np.full((len(off), 1), DELAY_SIGMA)
    late[0] = FIRST_DELAY_SIGMA
    return np.hstack([off, (unknowns.expected_delay_images - network.delay_images)[:, None]]), np.hstack([sigma, late])


def pseudo_cost(network: Network, unknowns: Unknowns, unit_px: float) -> float:
    """The second sum of (1), and what another object adds."""
    off, sigma = _pseudo_observations(network, unknowns)
    other = 0.0 if unknowns.block is None else unknowns.block.cost(network, unit_px)
    return float(unit_px**2 * np.sum((off / sigma) ** 2)) + other


def free_network(network: Network, unknowns: Unknowns) -> np.ndarray:
    """The changes (C p, 6) of the camera unknowns when the whole network is rotated and shifted, which leaves all images unchanged."""
    C, p = len(network.R), len(unknowns.columns)
    G = np.zeros((C, p, 6))
    G[:, -6:-3, :3] = G[:, -3:, 3:] = -network.R
    G[:, -3:, :3] = -cross_matrix(network.t) @ network.R
    return G.reshape(C * p, 6)


def reduce_to_cameras(normals: Normals, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """S and its right side (3), and L⁻¹ (q, q, N), from which the steps of the positions follow."""
    inverse = inverse_factors(normals.U * (1 + damping * np.eye(len(normals.U))[..., None]))
    S, rhs = normals.V.copy(), normals.g_c.copy()
    for start in range(0, normals.U.shape[-1], BLOCK):
        at = slice(start, start + BLOCK)
        z = np.einsum("jkn,kn->jn", inverse[..., at], normals.g_b[:, at])
        for Y_j, z_j in zip(eliminated(inverse[..., at], normals.W[..., at]), z):
            S -= Y_j @ Y_j.T
            rhs -= Y_j @ z_j
    return S, rhs, inverse


def eliminated(inverse: np.ndarray, W: np.ndarray) -> np.ndarray:
    """Y = L⁻¹ Wᵀ (q, m, N) of lower triangles L⁻¹ (q, q, N) and W (q, m, N).  (2)"""
    return np.stack([np.einsum("kn,kmn->mn", row[: j + 1], W[: j + 1]) for j, row in enumerate(inverse)])


def inverse_factors(U: np.ndarray) -> np.ndarray:
    """L⁻¹ (n, n, N) of N matrices U = L Lᵀ (n, n, N), all at once, which is much faster than one small matrix after the other."""
    A, n = U.copy(), len(U)  # becomes L column by column
    B = np.zeros_like(A)  # becomes L⁻¹ row by row
    for j in range(n):
        A[j:, j] /= np.sqrt(A[j, j])
        for k in range(j + 1, n):
            A[k:, k] -= A[k:, j] * A[k, j]
        B[j, j] = 1 / A[j, j]
        if j:
            B[j, :j] = -np.einsum("kN,kmN->mN", A[j, :j], B[:j, :j]) * B[j, j]
    return B


def solve_step(network: Network, normals: Normals, unknowns: Unknowns, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The step of the cameras (C p,) and of the positions (q, N).  (4)"""
    S, rhs, inverse = reduce_to_cameras(normals, damping)
    S = S + damping * np.diag(np.diag(normals.V))
    scale = 1 / np.sqrt(np.maximum(np.diag(normals.V), 1e-12))
    G = np.linalg.qr(free_network(network, unknowns) / scale[:, None])[0]
    step = scale * _solved(S * scale * scale[:, None] + G @ G.T, scale * rhs)
    return step, np.einsum("jkn,jn->kn", inverse, np.einsum("jkn,kn->jn", inverse, normals.g_b - step @ normals.W))


def _solved(A: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """x of A x = rhs; of minimum norm where A is singular, as with a camera that has no image points."""
    from scipy.linalg import cho_factor, cho_solve

    try:
        return np.asarray(cho_solve(cho_factor(A), rhs))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(A, rhs, rcond=1e-15)[0])


def moved(network: AnyNetwork, unknowns: Unknowns, step: np.ndarray, positions: np.ndarray) -> AnyNetwork:
    """The network after a step of the cameras (C p,) and of the positions (q, N)."""
    C = len(network.R)
    step = step.reshape(C, -1)
    interior = network.interior.copy()
    free = int(unknowns.free.sum())
    interior[:, unknowns.free] += step[:, :free]
    delay = network.delay_images if network.delay_images is None or not unknowns.with_delays else network.delay_images + step[:, free]
    turn = rotation_from_vector(step[:, -6:-3])
    R, t = turn @ network.R, (turn @ network.t[..., None])[..., 0] + step[:, -3:]
    return replace(network.stepped(positions), interior=interior, R=R, t=t, delay_images=delay)


def adjust(
    network: AnyNetwork,
    points: np.ndarray | MovingPoints,
    used: np.ndarray,
    unknowns: Unknowns,
    *,
    cauchy_px: float | None = None,
    unit_px: float = 0.1,
    iteration: LevenbergMarquardt = LevenbergMarquardt(),  # noqa: B008  frozen
) -> Adjusted[AnyNetwork]:
    """Minimise (1) by Levenberg–Marquardt from `network`, with the image points `used` (N, C, K) of (N, C, K, 2), which may be moving."""
    iterations, converged, damping = 0, False, iteration.damping
    v, velocity = residuals_of(network, points)
    weight, cost = weights_of(v, cauchy_px, used)
    cost += pseudo_cost(network, unknowns, unit_px)
    while iterations < iteration.max_iterations and not converged and damping < MAX_DAMPING:
        iterations += 1
        normals = normal_equations(network, v, weight, unknowns, unit_px, velocity)
        while damping < MAX_DAMPING:
            trial = moved(network, unknowns, *solve_step(network, normals, unknowns, damping))
            v_trial, velocity_trial = residuals_of(trial, points)
            weight_trial, cost_trial = weights_of(v_trial, cauchy_px, used)
            cost_trial += pseudo_cost(trial, unknowns, unit_px) if _possible(trial) else np.inf
            if cost_trial <= cost:
                break
            damping *= 10
        else:
            break
        converged = cost - cost_trial < iteration.tolerance * unit_px**2 * len(normals.g_c)
        network, v, velocity, weight, cost = trial, v_trial, velocity_trial, weight_trial, cost_trial
        damping = max(damping / 10, MIN_DAMPING)
    return Adjusted(network=network, residual_px=v, weight=weight, cost=cost, iterations=iterations, converged=converged)


def _possible(network: Network) -> bool:
    return bool(np.isfinite(network.interior).all() and (network.interior[:, 0] > 1.0).all() and np.isfinite(network.t).all())
