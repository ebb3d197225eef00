"""Control of drift: a point's temporal result adjusted with a match of its key template (equation (1) of templates.py)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry.small_matrices import invert_spd
from ..matching.least_squares import Matches

MAX_JUMP_PX = 1.0  # a key template's match further than this, and than MAX_JUMP_SIGMAS, from the temporal one is another place
MAX_JUMP_SIGMAS = 5.0  # of the difference between the two matches
REGULARISATION_PX2 = 1e-8  # keeps the sum of two covariances invertible


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TemplateState:
    """How N points relate to their key templates, and how far both may have strayed over the body. Rows' pixels."""

    shape: np.ndarray  # (N, 2, 2) from the key template to the image
    drift: np.ndarray  # (N, 2, 2) covariance of the point against its key template
    key_drift: np.ndarray  # (N, 2, 2) covariance of the template's own place on the body

    def renewed(self, rows: np.ndarray) -> "TemplateState":
        """The state after the present patches of `rows` (a mask) became their key templates, which takes over their drift."""
        own = rows[:, None, None]
        return TemplateState(
            shape=np.where(own, np.eye(2), self.shape),
            drift=np.where(own, 0.0, self.drift),
            key_drift=self.key_drift + np.where(own, self.drift, 0.0),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Controlled:
    """N points after the control of drift. Rows' pixels."""

    shift: np.ndarray  # (N, 2) to add to the temporal result
    state: TemplateState
    renewed: np.ndarray  # (N,) points that no longer match their template: the present patch is to replace it


def control_drift(
    temporal: Matches,
    good: np.ndarray,
    state: TemplateState,
    match_templates: Callable[[np.ndarray, np.ndarray], Matches],
    min_correlation: float,
) -> Controlled:
    """Match the key templates of the `good` points about their temporal results, and adjust both.

    `match_templates(start, shape)` matches the templates of all N points from positions (N, 2), NaN to skip one, and shapes (N, 2, 2).
    """
    grown = np.where(good[:, None, None], state.drift + temporal.covariance, state.drift)
    shape = np.where(good[:, None, None], temporal.shape @ state.shape, state.shape)
    key = match_templates(np.where(good[:, None], temporal.xy, np.nan), shape)
    jump = np.linalg.norm(key.xy - temporal.xy, axis=1)
    sigma = np.sqrt(np.maximum(np.trace(grown + key.covariance, axis1=1, axis2=2), 0.0))
    matched = good & key.ok & (key.correlation >= min_correlation) & (jump <= np.maximum(MAX_JUMP_PX, MAX_JUMP_SIGMAS * sigma))
    shift, drift = np.zeros((len(good), 2)), grown.copy()
    gain = grown[matched] @ invert_spd(grown[matched] + key.covariance[matched] + np.eye(2) * REGULARISATION_PX2)
    shift[matched] = np.einsum("nij,nj->ni", gain, key.xy[matched] - temporal.xy[matched])
    drift[matched] = at_least_best((np.eye(2) - gain) @ grown[matched], temporal.covariance[matched], key.covariance[matched])
    shape[matched] = key.shape[matched]
    renewed = good & ~matched
    adjusted = TemplateState(shape=shape, drift=drift, key_drift=state.key_drift)
    return Controlled(shift=shift, state=adjusted.renewed(renewed), renewed=renewed)


def at_least_best(covariance: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """An adjusted covariance (N, 2, 2), enlarged to that of the better of the two matches `a` and `b` where it is smaller.

    Both matches use the same new image, whose noise does not average out; neither does that of a template that is the same in every frame.
    """
    own, first, second = (np.maximum(np.trace(K, axis1=1, axis2=2), 1e-12) for K in (covariance, a, b))
    return covariance * np.maximum(1.0, np.minimum(first, second) / own)[:, None, None]
