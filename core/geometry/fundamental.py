"""The fundamental matrix of two views from matched points, of which some are wrong (MAGSAC++: Barath et al. 2020)."""

import cv2
import numpy as np


def fundamental_matrix(
    xi: np.ndarray, xj: np.ndarray, tolerance: float, confidence: float, iterations: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """F (3, 3) with x_jᵀ F x_i = 0 for points (m, 2), and which of them (m,) agree with it; None where the points determine none."""
    try:
        F, agree = cv2.findFundamentalMat(
            np.ascontiguousarray(xi), np.ascontiguousarray(xj), cv2.USAC_MAGSAC, tolerance, confidence, iterations
        )
    except cv2.error:  # OpenCV 5.0 raises where no sample gives a matrix
        return None
    return None if F is None or agree is None or F.shape != (3, 3) else (F, agree.ravel() > 0)
