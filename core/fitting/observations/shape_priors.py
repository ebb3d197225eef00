"""Priors of the shape: radii, proportions of the bones, roundness and symmetry.

    (x − mean) / σ = ε                                                                                                 (1)
    W (ln L − mean) = ε ,   WᵀW = covariance⁻¹ of                                                                      (2)
    ln L_b = ln L_b,model + g + c_k + d_b + j_b ,   g ~ N(0, σ_g²) ,   c_k ~ N(0, σ_k²) ,   d_b ~ N(0, σ_d²)           (3)
    σ_k² = σ_c⁴ / (σ_c² + (e / L_k)²)                                                                                  (4)
    (ln l_x − ln l_z − ln (l_x⁰ / l_z⁰)) / σ = ε ,    σ about 10 %                                                     (5)
    (ln p_L − ln p_R) / σ = ε                                                                                          (6)

(1): x are the logarithms of lengths, cross radii and weights, so that σ is relative.

(2)–(4), proportions: g is the person's size, common to all bones. d_b is the deviation of one bone from those of other people of that size,
a few per cent. c_k belongs to a chain k of bones whose two ends were clicked: there the length is the clicked one (an operator or a
detector places a joint elsewhere than an anatomist), so it is free by σ_c, as far as two clicks with an error e determine a length L_k (4);
a neck is too short for that. Inside a chain (collarbones; pelvis, spine and chest), and where nothing was clicked (head, hands), bones have
the model's proportions: clouds and outlines show no joints there, and the model's error (a cap, fingers, loose clothes) is the same in all
frames. However many they are, frames must not outvote σ_d and σ_g, which count once for each of them: otherwise unclicked bones grow with
the others, while clicked chains adapt by c_k. j_b ~ N(0, model.length_sigma²) is for a joint without an agreed place, clicked or not. A
neck's base is placed anywhere between the breastbone and the vertebrae in the middle of the neck, 25 mm up or down. A neck of fixed
proportions above such a click lifts the skull off the measured head; with j_b its length follows from the head's surface.

A person who was found without clicks has limbs of his own, too: bones between found joints differ by l + f_b, l ~ N(0, σ_l²) common to arms
and legs, and f_b ~ N(0, σ_f²). Legs show their lengths; arms that are hidden in the first frame follow them, and not a wrong pose.

(5), roundness: limbs are nearly round, trunks as flat as the model's, with its cross radii l_x⁰ and l_z⁰. Points from one side of a limb
determine its depth and its thickness only together.

(6), symmetry of a length or radius p on the left and on the right: people's bones differ by 1 to 2 % at most (Auerbach & Ruff 2006, J. Hum.
Evol. 50: 203-218), their flesh by more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...body.model_file import BodyModel
from ...body.skeleton import Skeleton
from ..state import BodyState, shape_vector

STATURE_SIGMA = 0.07  # σ_g, relative, of a person about the model
CLICK_ERROR_M = 0.02  # e of (4), of both ends of a length together
LIMBS_SIGMA, FOUND_SIGMA = 0.10, 0.05  # σ_l and σ_f: of a person's limbs against the trunk, and of one of their bones


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrior:
    """Mean and sigma of the shape vector (S,), logarithms of lengths and cross radii; with an infinite sigma there is no prior.  (1)"""

    mean: np.ndarray
    sigma: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(S,)"""
        return (shape_vector(state) - self.mean) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(S, D + S); zeros (S, D) without shape"""
        J = state.layout.empty_jacobian(state.layout.n_shape, shape)
        if shape:
            J[:, state.layout.columns("shape")] = np.diag(1 / self.sigma)
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class Proportions:
    """Mean (B,) and covariance (B, B) of the logarithms of the bone lengths [m].  (2)"""

    mean: np.ndarray
    covariance: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(B,)"""
        return np.asarray(self._root @ (np.log(state.lengths_m) - self.mean))

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(B, D + S); zeros (B, D) without shape"""
        J = state.layout.empty_jacobian(len(self.mean), shape)
        if shape:
            J[:, state.layout.columns("lengths")] = self._root
        return J

    @cached_property
    def _root(self) -> np.ndarray:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))


@dataclass(frozen=True, eq=False, kw_only=True)
class EqualRadii:
    """One observation for each of the M balls.  (5)"""

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
        J = state.layout.empty_jacobian(m, shape)
        if shape:
            rows, (x, z) = np.arange(m), state.layout.radii(np.arange(m)).T
            J[rows, x], J[rows, z] = 1 / self.sigma, -1 / self.sigma
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class Symmetry:
    """K pairs of shape parameters.  (6)"""

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
        J = state.layout.empty_jacobian(len(self.left), shape)
        if shape:
            rows, at = np.arange(len(self.left)), state.layout
            J[rows, at.shape_columns(self.left)], J[rows, at.shape_columns(self.right)] = 1 / self.sigma, -1 / self.sigma
        return J


def proportions(
    model: BodyModel,
    lengths_m: np.ndarray,
    located: np.ndarray,
    clicked_sigma: float,
    own_sigma: float,
    stature_sigma: float = STATURE_SIGMA,
    found: Sequence[str] = (),
) -> Proportions:
    """(3) about the lengths (B,) of a model, with joints (J,) that were located: σ_c, σ_d and σ_g. Given lengths fix the size.

    `found`: joints that were found without clicks.
    """
    stature = min(stature_sigma, clicked_sigma)
    of_joints = np.minimum(model.length_sigma, 2 * clicked_sigma)
    covariance = np.full((len(lengths_m), len(lengths_m)), stature**2) + np.diag(own_sigma**2 + of_joints**2)  # (3)
    for chain in clicked_chains(model.skeleton, located):
        of_clicks = (CLICK_ERROR_M / lengths_m[chain].sum()) ** 2
        covariance[np.ix_(chain, chain)] += clicked_sigma**4 / (clicked_sigma**2 + of_clicks)  # (4)
    limbs = [b for b, bone in enumerate(model.skeleton.bones) if bone.head_joint in found and bone.tail_joint in found]
    of_limbs: np.ndarray = LIMBS_SIGMA**2 + FOUND_SIGMA**2 * np.eye(len(limbs))
    covariance[np.ix_(limbs, limbs)] += of_limbs
    return Proportions(mean=np.log(lengths_m), covariance=covariance)


def clicked_chains(skeleton: Skeleton, located: np.ndarray) -> list[list[int]]:
    """The bones with `located` joints (J,) on both sides; those in a row without such a joint or a fork between them are one chain."""
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
