"""Control of drift: a point's temporal result adjusted with a match of its key template (equation (1) of templates.py)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry.small_matrices import invert_spd
from ..images.sampling import SplineImage
from ..matching.least_squares import Matches
from .templates import Templates

SIGMAS, JUMP_PX = 5.0, 1.0  # a key template's match further off than both is another place


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Held:
    """N points after the control. Rows' pixels."""

    shift: np.ndarray  # (N, 2) to add to the temporal result
    key_shape: np.ndarray  # (N, 2, 2)
    drift: np.ndarray  # (N, 2, 2) covariance against the key template
    renewed: np.ndarray  # (N,) whose template is unlike by now: the present patch is to be the template


def hold(
    temporal: Matches,
    good: np.ndarray,
    key_shape: np.ndarray,
    drift: np.ndarray,
    templates: Templates,
    identity: np.ndarray,
    image: SplineImage,
    min_correlation: float,
    corrected: Callable[[Matches], Matches] | None = None,
) -> Held:
    """Match the key templates of the `good` points about their temporal results, and adjust; `corrected` mends their matches first."""
    grown = np.where(good[:, None, None], drift + temporal.covariance, drift)
    shape = np.where(good[:, None, None], temporal.shape @ key_shape, key_shape)
    start = np.where(good[:, None], temporal.xy, np.nan)
    key = templates.match(identity, image, start, shape)
    if corrected is not None:
        key = corrected(key)
    away = np.linalg.norm(key.xy - temporal.xy, axis=1)
    sigma = np.sqrt(np.maximum(np.trace(grown + key.covariance, axis1=1, axis2=2), 0.0))
    held = good & key.ok & (key.correlation >= min_correlation) & (away <= np.maximum(JUMP_PX, SIGMAS * sigma))
    shift, left = np.zeros((len(good), 2)), grown.copy()
    gain = grown[held] @ invert_spd(grown[held] + key.covariance[held] + np.eye(2) * 1e-8)
    shift[held] = np.einsum("nij,nj->ni", gain, key.xy[held] - temporal.xy[held])
    left[held] = not_below((np.eye(2) - gain) @ grown[held], temporal.covariance[held], key.covariance[held])
    shape[held] = key.shape[held]
    renewed = good & ~held
    return Held(shift=shift, key_shape=np.where(renewed[:, None, None], np.eye(2), shape), drift=left, renewed=renewed)


def not_below(covariance: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A covariance (N, 2, 2) after adjustment, not less than the better of the two matches.

    Both matches look at the same new image, whose noise is not averaged away; nor is that of a template that is the same in every frame.
    """
    own, first, second = (np.maximum(np.trace(K, axis1=1, axis2=2), 1e-12) for K in (covariance, a, b))
    return covariance * np.maximum(1.0, np.minimum(first, second) / own)[:, None, None]
