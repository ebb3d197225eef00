"""Which unknowns of an affine patch its texture can determine: where it cannot, smaller sets of them are adjusted (`least_squares`)."""

import numpy as np

from ..geometry.small_matrices import invert_spd

PARAMETERS = 8  # unknowns: six of the shape and position, two of the radiometry
SETS = ((6, (1, 2, 4, 5), (0, 1, 3, 5)), (4, (1, 5), (0, 3)))  # unknowns; parameters that must be certain before; those that stay
SETS_CONDITION = 1e-6  # added to the scaled diagonal of a smaller set's normal matrix


def reduced_sets(H: np.ndarray, inverse: np.ndarray, noise: float, half_px: float, limit_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverses (N, 6, 6) of normal matrices H (N, 6, 6) with zeros for what is left out, and the numbers of unknowns (N,).

    `inverse` is that of all parameters, `noise` that of an image in grey values, `half_px` half the patch's width; a limit of 0 keeps
    all parameters.
    """
    count = np.full(len(H), PARAMETERS, dtype=np.int8)
    if not limit_px:
        return inverse, count
    inverse = inverse.copy()
    for unknowns, needed, stay in SETS:
        variance = np.max([inverse[:, i, i] for i in needed], axis=0)
        rows = np.flatnonzero(np.sqrt(2 * np.maximum(variance, 0.0)) * noise * half_px > limit_px)
        block = np.ix_(rows, np.array(stay), np.array(stay))
        part = H[block]
        scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", part), 1e-9))
        both = scale[:, :, None] * scale[:, None, :]
        inverse[rows], count[rows] = 0.0, unknowns
        inverse[block] = invert_spd(part * both + SETS_CONDITION * np.eye(len(stay))) * both
    return inverse, count
