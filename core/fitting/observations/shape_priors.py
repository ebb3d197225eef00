"""What is believed of the bone lengths together, as a person's proportions: ln L ~ N(mean, covariance).  (`bone_lengths`)

Limbs are nearly round, trunks as flat as the model's: ln l_x − ln l_z = ln of the model's ratio + ε for every ball, σ about 10 %.

Points seen from one side cannot tell depth from thickness.

Both sides of a body are alike: the logarithms of a length or radius on the left and on the right differ by 0 ± sigma.

People's bones do by 1 to 2 % at most (Auerbach & Ruff 2006, J. Hum. Evol. 50: 203-218), their flesh by more.

What is believed of the bone lengths before anything but clicks is looked at.

    ln L_b = ln L_b,model + g + c_k + d_b + j_b ,   g ~ N(0, σ_g²) ,   c_k ~ N(0, σ_k²) ,   d_b ~ N(0, σ_d²)                (1)
    σ_k² = σ_c⁴ / (σ_c² + (e / L_k)²)                                                                                  (2)

g is the person's size: all bones share it. d_b is what one bone is longer or shorter than in other people of that size, a few per cent.
c_k belongs to a chain k of bones whose two ends were clicked: there the length is what was clicked (a joint is where the operator, or a
detector, sees it, not where the anatomist does), so it is free by σ_c, as far as two clicks that are off by e tell a length L_k (2); a
neck is too short for them. Inside a chain (collarbones; pelvis, spine and chest), and where nobody clicked at all (head, hands), bones
keep the model's proportions: clouds and outlines show no joints there, and what a body differs from its balls (a cap, fingers, loose
clothes) it differs in all frames alike. However many they are, frames do not outvote σ_d nor σ_g, which count as often as they do: else
what nobody clicked grows together with all the rest, for chains that were clicked follow by c_k.

j_b ~ N(0, model.length_sigma²) is for a joint that has no place of its own that people agree on, clicked or not. A neck's base is taken
anywhere between the breastbone and the vertebrae in the middle of the neck, 25 mm up or down. A neck that keeps its proportions above such
a click lifts the skull off the head that was measured; one with j_b is as long as the head's surface says.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...body.model_file import BodyModel
from ...body.skeleton import Skeleton
from ..state import BodyState, shape_vector


@dataclass(frozen=True, eq=False, kw_only=True)
class Proportions:
    """Mean (B,) and covariance (B, B) of the logarithms of the bone lengths [m]."""

    mean: np.ndarray
    covariance: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(B,) W (ln L − mean), with WᵀW the inverse of the covariance."""
        return np.asarray(self._root @ (np.log(state.lengths_m) - self.mean))

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(B, D + S); zeros (B, D) without shape"""
        b = len(self.mean)
        J = np.zeros((b, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            J[:, state.n_motion : state.n_motion + b] = self._root
        return J

    @cached_property
    def _root(self) -> np.ndarray:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))


@dataclass(frozen=True, eq=False, kw_only=True)
class EqualRadii:
    """One observation for each of the M balls."""

    sigma: float
    log_ratio: np.ndarray | float = 0.0  # (M,) the model's ln l_x − ln l_z
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(M,)"""
        return (np.log(state.balls.radii_m[:, 0] / state.balls.radii_m[:, 2]) - self.log_ratio) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(M, D + S); zeros (M, D) without shape"""
        m = len(state.balls.weight)
        J = np.zeros((m, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            rows, first = np.arange(m), state.n_motion + len(state.lengths_m) + 2 * np.arange(m)
            J[rows, first], J[rows, first + 1] = 1 / self.sigma, -1 / self.sigma
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class Symmetry:
    """K pairs of shape parameters."""

    left: np.ndarray  # (K,) indices in the shape vector
    right: np.ndarray  # (K,)
    sigma: np.ndarray  # (K,)
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(K,)"""
        value = shape_vector(state)
        return (value[self.left] - value[self.right]) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(K, D + S); zeros (K, D) without shape"""
        J = np.zeros((len(self.left), state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            rows = np.arange(len(self.left))
            J[rows, state.n_motion + self.left], J[rows, state.n_motion + self.right] = 1 / self.sigma, -1 / self.sigma
        return J


STATURE_SIGMA = 0.07  # relative, of a person about the model
CLICKS_OFF_M = 0.02  # of both ends of a length together


def proportions(
    model: BodyModel,
    lengths_m: np.ndarray,
    located: np.ndarray,
    clicked_sigma: float,
    own_sigma: float,
    stature_sigma: float = STATURE_SIGMA,
) -> Proportions:
    """(1) about the lengths (B,) of a model, when some joints (J,) have places: σ_c, σ_d and σ_g. Lengths that are known fix the size."""
    stature = min(stature_sigma, clicked_sigma)
    of_joints = np.minimum(model.length_sigma, 2 * clicked_sigma)
    covariance = np.full((len(lengths_m), len(lengths_m)), stature**2) + np.diag(own_sigma**2 + of_joints**2)
    for chain in clicked_chains(model.skeleton, located):
        of_clicks = (CLICKS_OFF_M / lengths_m[chain].sum()) ** 2
        covariance[np.ix_(chain, chain)] += clicked_sigma**4 / (clicked_sigma**2 + of_clicks)  # (2)
    return Proportions(mean=np.log(lengths_m), covariance=covariance)


def clicked_chains(skeleton: Skeleton, located: np.ndarray) -> list[list[int]]:
    """The bones that have joints with places (J,) on both sides, those together that follow each other without such a joint or a fork."""
    joint = {name: i for i, name in enumerate(skeleton.joint_names)}
    ends = [(joint[bone.head_joint], joint[bone.tail_joint]) for bone in skeleton.bones]
    chains = [[b] for b in range(len(ends)) if _clicked_on_both_sides(ends, b, located)]
    meeting = np.bincount(np.array(ends).ravel(), minlength=len(joint))
    for between in np.flatnonzero((meeting == 2) & ~located).tolist():
        here = [chain for chain in chains if any(between in ends[b] for b in chain)]
        if len(here) == 2:
            chains = [*(chain for chain in chains if chain not in here), here[0] + here[1]]
    return chains


def _clicked_on_both_sides(ends: Sequence[tuple[int, int]], bone: int, located: np.ndarray) -> bool:
    beyond = {ends[bone][1]}
    for b, (head, tail) in enumerate(ends):  # parents come first
        if b != bone and head in beyond:
            beyond.add(tail)
    far = np.isin(np.arange(len(located)), list(beyond))
    return bool((located & far).any() and (located & ~far).any())
