"""What the frames on one side say of the next two, handed over from one stretch of a recording to the next.

Frames i on that side are eliminated from their normal equations (Schur complement); accelerations and tracked points reach two frames far:

    Λ = A_bb − A_bi A_ii⁻¹ A_ib ,   g = g_b − A_bi A_ii⁻¹ g_i        (x − x₀)ᵀ Λ (x − x₀) − 2 gᵀ (x − x₀)                          (1)

of the postures x of two frames, with x₀ where it was linearised. Nothing is lost of what is linear: a twist that only tracked points tell
is known over any number of stretches.
"""

from dataclasses import dataclass, replace

import numpy as np

from .acceleration import Acceleration
from .block_band import NormalEquations, eliminated, reversed_in_time
from .observations import MaterialSteps, Observation
from .problem import Problem, Scales, linearise
from .solver import Solution
from .state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class HandedOver:
    """(1) of the first two frames of a stretch, or of the last two."""

    equations: NormalEquations  # of two frames, in the order of time
    motion: np.ndarray  # (2, D) x₀
    first: bool

    def _rows(self, frames: int) -> slice:
        return slice(0, 2) if self.first else slice(frames - 2, frames)

    def cost(self, motion: np.ndarray) -> float:
        """(1) at a motion (T, D), with the least that it can be added: it is not negative."""
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
        e = self.equations
        return np.block([[e.diagonal[0], e.next1[0].T], [e.next1[0], e.diagonal[1]]]), e.g.ravel()


@dataclass(frozen=True, eq=False, kw_only=True)
class Tied:
    """Accelerations within a stretch, and what the frames beside it say."""

    acceleration: Acceleration
    beside: HandedOver | None

    def cost(self, motion: np.ndarray) -> float:
        """Sum of squares at a motion (T, D)."""
        return self.acceleration.cost(motion) + (self.beside.cost(motion) if self.beside is not None else 0.0)

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations."""
        self.acceleration.add_to(equations, motion)
        if self.beside is not None:
            self.beside.add_to(equations, motion)


def hand_over(
    problem: Problem,
    solution: Solution,
    own: range,
    beside: HandedOver | None,
    time_s: np.ndarray,
    sigma: np.ndarray,
    *,
    ahead: bool,
    understated: Scales | None = None,
) -> HandedOver:
    """What the `own` frames of an adjusted stretch, and those `beside` it, say of the two frames ahead of them or before them.

    `time_s` (T,) are the times of the stretch's frames, `sigma` (D,) those of accelerations, `understated` as in `linearise`.
    """
    frames = slice(own.start, own.stop + 2) if ahead else slice(own.start - 2, own.stop)
    first, observe_step = frames.start, problem.observe_step

    def observe(t: int, state: BodyState) -> list[Observation]:
        return problem.observe(t + first, state) if t + first in own else []

    def step(t: int, a: BodyState, b: BodyState) -> MaterialSteps | None:
        return observe_step(t + first, a, b) if observe_step and (t + first in own or t + first + 1 in own) else None

    tied = Tied(acceleration=Acceleration(time_s=time_s[frames], sigma=sigma), beside=beside)
    part = replace(problem, smoothness=tied, of_shape=(), observe=observe, observe_step=step)
    e = linearise(part, solution.motion[frames], solution.vector, solution.scales, understated).equations
    left = eliminated(e, len(own)) if ahead else reversed_in_time(eliminated(reversed_in_time(e), len(own)))
    return HandedOver(equations=_definite(left), motion=solution.motion[frames][-2:] if ahead else solution.motion[frames][:2], first=ahead)


def _definite(e: NormalEquations) -> NormalEquations:
    """Equations of two frames without the negative eigenvalues that rounding leaves of directions of which nothing is known."""
    D = e.g.shape[1]
    A = np.block([[e.diagonal[0], e.next1[0].T], [e.next1[0], e.diagonal[1]]])
    scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-12))
    values, vectors = np.linalg.eigh((A + A.T) / 2 * scale * scale[:, None])
    A = (vectors * np.maximum(values, 0.0)) @ vectors.T / scale / scale[:, None]
    return replace(e, diagonal=np.stack([A[:D, :D], A[D:, D:]]), next1=A[None, D:, :D])
