"""What is known of a lens before it is calibrated: pseudo-observations that keep unknowns which the data do not determine where lenses are.

The sigmas are generous (a tenth of them would be no surprise), in units that mean the same for every lens: displacement at the image's
corner as a part of its distance from the middle. They matter only where the data say little (SCIENCE §3: "pseudo-observations on each
additional parameter").
"""

import numpy as np

from ..geometry.camera_derivatives import INTERIOR
from .bundle import Unknowns

RADIAL_SIGMA = (0.5, 0.3, 0.15)  # k1 ρ², k2 ρ⁴, k3 ρ⁶ at the corner, ρ in units of f
DECENTRING_SIGMA = 0.01  # p ρ
AFFINITY_SIGMA = 0.01
MIDDLE_SIGMA = 0.08  # of the image width
FOCAL_SIGMA = 1.5  # of f


def lens_knowledge(size_px: np.ndarray, focal_px: np.ndarray) -> Unknowns:
    """Expected values and sigmas of the interior unknowns of C cameras; all ten free."""
    C = len(size_px)
    expected, sigma = np.zeros((C, len(INTERIOR))), np.ones((C, len(INTERIOR)))
    rho = np.linalg.norm(size_px, axis=1) / 2 / focal_px
    expected[:, 0], sigma[:, 0] = focal_px, FOCAL_SIGMA * focal_px
    expected[:, 1:3], sigma[:, 1:3] = (size_px - 1) / 2, MIDDLE_SIGMA * size_px[:, :1]
    for n, part in enumerate(RADIAL_SIGMA):
        sigma[:, 3 + n] = part / rho ** (2 * n + 2)
    sigma[:, 6:8] = DECENTRING_SIGMA / rho[:, None]
    sigma[:, 8:10] = AFFINITY_SIGMA
    return Unknowns(free=np.ones(len(INTERIOR), dtype=bool), expected=expected, sigma=sigma)
