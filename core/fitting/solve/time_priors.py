"""Observations that couple the poses of successive frames: weak accelerations, and the marginal prior from frames that were adjusted
before.

    2/(h1 + h2) · ((θ_{t+1} − θ_t)/h2 − (θ_t − θ_{t−1})/h1) = 0 ± σ ,   h1, h2: the times between the three frames               (1)
    (x − x₀)ᵀ Λ (x − x₀) − 2 gᵀ (x − x₀)  →  min                                                                                 (2)
    Λ = A_bb − A_bi A_ii⁻¹ A_ib ,   g = g_b − A_bi A_ii⁻¹ g_i                                                                    (3)

(1), smoothness: every DOF's acceleration is zero within a sigma.

(2), marginal prior: what all frames i on one side of a stretch contribute to its first two, or last two, frames b with the poses x. The
frames i are eliminated from their normal equations (3) (Schur complement); accelerations and tracked points couple frames that are at most
two apart, so only two are left. x₀ is where the equations were linearised. Nothing linear is lost: a twist that only tracked points
constrain stays determined over any number of stretches.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..observations import Observation, Steps
from ..state import BodyState
from .block_band import NormalEquations, eliminated, reversed_in_time
from .problem import Estimate, Problem, Scales, linearise

LEAST = 0.1  # of the loosest sigma: however steady the observed motion
SPAN_S = 0.1  # accelerations of a first motion are taken over this time, which averages its noise
SMALLEST_DIAGONAL = 1e-12  # of Λ, before its rows are scaled
ENOUGH = 3  # second differences of a DOF, for a sigma of its own


@dataclass(frozen=True, eq=False, kw_only=True)
class Acceleration:
    """Observations of T−2 accelerations for each of D DOFs."""

    time_s: np.ndarray  # (T,)
    sigma: np.ndarray  # (D,) rad/s², m/s²

    def coefficients(self) -> np.ndarray:
        """(T−2, 3) of θ_{t−1}, θ_t, θ_{t+1} in (1)."""
        h = np.diff(self.time_s)
        h1, h2 = h[:-1], h[1:]
        return (2 / (h1 + h2))[:, None] * np.stack([1 / h1, -1 / h1 - 1 / h2, 1 / h2], axis=1)

    def cost(self, motion: np.ndarray) -> float:
        """Sum of squares at a motion (T, D)."""
        if len(motion) < 3:
            return 0.0
        c = self.coefficients()
        values = c[:, 0, None] * motion[:-2] + c[:, 1, None] * motion[1:-1] + c[:, 2, None] * motion[2:]
        return float(np.sum((values / self.sigma) ** 2))

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations of these observations."""
        weight = 1 / self.sigma**2
        for t, c in enumerate(self.coefficients() if len(motion) > 2 else ()):
            value = weight * (c @ motion[t : t + 3])
            for i in range(3):
                equations.diagonal[t + i] += np.diag(c[i] ** 2 * weight)
                equations.g[t + i] -= c[i] * value
            equations.next1[t] += np.diag(c[1] * c[0] * weight)
            equations.next1[t + 1] += np.diag(c[2] * c[1] * weight)
            equations.next2[t] += np.diag(c[2] * c[0] * weight)


def typical_acceleration(
    motion: np.ndarray, observed: np.ndarray, time_s: np.ndarray, loosest: np.ndarray, least: np.ndarray | float = LEAST
) -> np.ndarray:
    """Sigma (D,) of the accelerations of a motion (T, D) where it is `observed` (T, D), between `least` (D,) times the `loosest` and that.

    An occluded limb is taken to move as that limb does where it is visible. The root mean square of second differences over `SPAN_S`.
    """
    step = max(1, round(SPAN_S / float(np.median(np.diff(time_s))))) if len(time_s) > 1 else 1
    if len(motion) < 2 * step + 3:
        return loosest
    h = (time_s[2 * step :] - time_s[: -2 * step]) / 2
    a = (motion[2 * step :] - 2 * motion[step:-step] + motion[: -2 * step]) / h[:, None] ** 2
    good = observed[2 * step :] & observed[step:-step] & observed[: -2 * step]
    count = good.sum(axis=0)
    rms = np.sqrt((np.where(good, a, 0.0) ** 2).sum(axis=0) / np.maximum(count, 1))
    return np.where(count >= ENOUGH, np.clip(rms, least * loosest, loosest), loosest)


@dataclass(frozen=True, eq=False, kw_only=True)
class MarginalPrior:
    """(2) of the first two frames of a stretch, or of the last two."""

    equations: NormalEquations  # of two frames, in the order of time
    motion: np.ndarray  # (2, D) x₀
    first: bool

    def _rows(self, frames: int) -> slice:
        return slice(0, 2) if self.first else slice(frames - 2, frames)

    def cost(self, motion: np.ndarray) -> float:
        """(2) at a motion (T, D), plus the constant that makes its minimum 0."""
        information, g = self._dense()
        step = (motion[self._rows(len(motion))] - self.motion).ravel()
        return float(step @ information @ step - 2 * g @ step + g @ np.linalg.lstsq(information, g, rcond=None)[0])

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations, with the shape's part if the shape is free."""
        rows, information, g = self._rows(len(motion)), *self._dense()
        step = (motion[rows] - self.motion).ravel()
        equations.diagonal[rows] += self.equations.diagonal
        equations.next1[rows.start] += self.equations.next1[0]
        equations.g[rows] += (g - information @ step).reshape(2, -1)
        if equations.border.shape[2]:
            equations.border[rows] += self.equations.border

    def _dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Λ (2D, 2D) and g (2D,)."""
        e = self.equations
        return np.block([[e.diagonal[0], e.next1[0].T], [e.next1[0], e.diagonal[1]]]), e.g.ravel()


@dataclass(frozen=True, eq=False, kw_only=True)
class Coupling:
    """The coupling of the frames of a stretch: accelerations, and the marginal prior from the frames on one side."""

    acceleration: Acceleration
    prior: MarginalPrior | None

    def cost(self, motion: np.ndarray) -> float:
        """Sum of squares at a motion (T, D)."""
        return self.acceleration.cost(motion) + (self.prior.cost(motion) if self.prior is not None else 0.0)

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations."""
        self.acceleration.add_to(equations, motion)
        if self.prior is not None:
            self.prior.add_to(equations, motion)


def marginal_prior(
    problem: Problem, at: Estimate, own: range, coupling: Coupling, *, ahead: bool, factors: Scales | None = None
) -> MarginalPrior:
    """The prior on the two frames after the `own` frames of an adjusted stretch (`ahead`), or on the two before them.

    `coupling` of all frames of the stretch, with the prior that the stretch itself was given; `factors` as in `linearise`.
    """
    frames = slice(own.start, own.stop + 2) if ahead else slice(own.start - 2, own.stop)
    first, observe_step = frames.start, problem.observe_step

    def observe(t: int, state: BodyState) -> list[Observation]:
        return problem.observe(t + first, state) if t + first in own else []

    def step(t: int, a: BodyState, b: BodyState) -> Steps | None:
        return observe_step(t + first, a, b) if observe_step and (t + first in own or t + first + 1 in own) else None

    smoothness = replace(coupling, acceleration=replace(coupling.acceleration, time_s=coupling.acceleration.time_s[frames]))
    part = replace(problem, smoothness=smoothness, shape_observations=(), observe=observe, observe_step=step)
    e = linearise(part, Estimate(motion=at.motion[frames], vector=at.vector, scales=at.scales), factors).equations
    left = eliminated(e, len(own)) if ahead else reversed_in_time(eliminated(reversed_in_time(e), len(own)))  # (3)
    motion = at.motion[frames]
    return MarginalPrior(equations=_semidefinite(left), motion=motion[-2:] if ahead else motion[:2], first=ahead)


def _semidefinite(e: NormalEquations) -> NormalEquations:
    """Equations of two frames without the negative eigenvalues that rounding leaves in directions that nothing constrains."""
    D = e.g.shape[1]
    A = np.block([[e.diagonal[0], e.next1[0].T], [e.next1[0], e.diagonal[1]]])
    scale = 1 / np.sqrt(np.maximum(np.diag(A), SMALLEST_DIAGONAL))
    values, vectors = np.linalg.eigh((A + A.T) / 2 * scale * scale[:, None])
    A = (vectors * np.maximum(values, 0.0)) @ vectors.T / scale / scale[:, None]
    return replace(e, diagonal=np.stack([A[:D, :D], A[D:, D:]]), next1=A[None, D:, :D])
