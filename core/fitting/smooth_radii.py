"""Post-fit smoothing: radius is redistributed among neighbouring, strongly correlated balls, or the surface would have rings.

A person is thicker or thinner than the model over longer stretches than a ball. For x, ln l of the cross radii, with K their covariance
given the lengths, x_0 the model's, and balls that follow each other along a part of the body,

    A (x − x_0) = 0 ± σ ,   A: x_i−1 − 2 x_i + x_i+1 of three such balls                                    (1)
    x' = x − G A (x − x_0) ,   K' = K − G A K ,   G = K Aᵀ (A K Aᵀ + σ²)⁻¹                                  (2)

Precisely measured radii hardly change; poses and lengths do not change at all: as an equation of the fit itself, (1) took the joints of a
turning person 3 mm farther from the truth, since thickness there compensates errors of the joints.
"""

import numpy as np

from ..body.parts import body_parts
from ..body.shape import BodyShape
from ..body.skin.extremities import SIMPLE
from .state import ShapeParameters


def smooth_radii(parameters: ShapeParameters, vector: np.ndarray, covariance: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """The shape vector (S,) and its covariance (S, S) after (2)."""
    radii, lengths = parameters.layout.group("radii"), parameters.layout.group("lengths")
    A = _second_differences(parameters.template)
    mixed = covariance[np.ix_(radii, lengths)]
    K = covariance[np.ix_(radii, radii)] - mixed @ np.linalg.pinv(covariance[np.ix_(lengths, lengths)], hermitian=True) @ mixed.T
    G = K @ A.T @ np.linalg.inv(A @ K @ A.T + sigma**2 * np.eye(len(A)))
    found, spread = vector.copy(), covariance.copy()
    found[radii] -= G @ (A @ (vector - parameters.vector())[radii])  # (2)
    spread[np.ix_(radii, radii)] -= G @ A @ K  # (2)
    return found, spread


def _second_differences(shape: BodyShape) -> np.ndarray:
    """A (2 P, 2 M) of (1): for P triples of the M balls, of l_x and of l_z; none where muscles lie side by side."""
    balls = shape.metaballs
    if not set(np.bincount(balls.bone_index).tolist()) <= {0, SIMPLE}:
        return np.zeros((0, 2 * len(balls.weight)))
    places = [
        (p, part.bones.index(b), balls.centre[m, 1], m)
        for p, part in enumerate(body_parts(shape))
        for m, b in enumerate(balls.bone_index.tolist())
        if b in part.bones
    ]
    line = sorted(places)
    triples = [[m for *_, m in line[i : i + 3]] for i in range(len(line) - 2) if line[i][0] == line[i + 2][0]]
    A = np.zeros((len(triples), 2, len(balls.weight), 2))
    for k, triple in enumerate(triples):
        for axis in (0, 1):
            A[k, axis, triple, axis] = 1.0, -2.0, 1.0
    return A.reshape(2 * len(triples), 2 * len(balls.weight))
