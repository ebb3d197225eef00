"""Smaller parameter sets where the texture cannot tell a patch's shape (SCIENCE §4; Gruen 1985: parameters excluded as not determinable).

An error of a shape parameter moves the rim of the patch by half its width times that error. Where the noise of both images alone moves it
by more than a limit, the shears go first (6 unknowns: shift, two scales, radiometry), then the scales too (4: shift, radiometry); the shape
then stays that of the start. The parameters are those of `least_squares` (3): d1, B11, B12, d2, B21, B22.
"""

import numpy as np

from ..geometry.small_matrices import invert_spd

PARAMETERS = 8
SETS = ((6, (1, 2, 4, 5), (0, 1, 3, 5)), (4, (1, 5), (0, 3)))  # unknowns, the shape parameters that must be sure, those that stay


def reduced_sets(H: np.ndarray, inverse: np.ndarray, noise: float, half_px: float, limit_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverses (N, 6, 6) of normal matrices H (N, 6, 6) with zeros for what is left out, and the numbers of unknowns (N,).

    `inverse` is that of all parameters, `noise` that of an image in grey values, `half_px` half the patch's width; a limit of 0 leaves
    all as it is.
    """
    count = np.full(len(H), PARAMETERS, dtype=np.int8)
    if not limit_px:
        return inverse, count
    inverse = inverse.copy()
    for unknowns, needed, kept in SETS:
        variance = np.max([inverse[:, i, i] for i in needed], axis=0)
        rows = np.flatnonzero(np.sqrt(2 * np.maximum(variance, 0.0)) * noise * half_px > limit_px)
        block = np.ix_(rows, np.array(kept), np.array(kept))
        part = H[block]
        scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", part), 1e-9))
        both = scale[:, :, None] * scale[:, None, :]
        inverse[rows], count[rows] = 0.0, unknowns
        inverse[block] = invert_spd(part * both + 1e-6 * np.eye(len(kept))) * both
    return inverse, count
