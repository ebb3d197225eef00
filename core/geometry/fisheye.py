"""OpenCV's fisheye lens (Kannala & Brandt 2006, doi:10.1109/TPAMI.2006.153), in place of Brown's distortion.

    r² = a² + b² ,  θ = arctan r ,  θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)                  (1)
    S = θ_d / r ,  a' = a S ,  b' = b S                                                          (2)
    Q = (dS/dr) / r :  ∂a'/∂a = S + a² Q ,  ∂a'/∂b = a b Q ,  ∂b'/∂b = S + b² Q                  (3)

a, b are those of the central projection, so that the lens reaches to less than 90° from its axis.
"""

import numpy as np

NEAR_AXIS = 1e-8  # r² below which (3) is its limit
STEPS = 20  # of Newton's method
TOLERANCE = 1e-10
WIDEST = np.radians(89.5)  # from the axis
FARTHEST = float(np.tan(WIDEST))  # r

Terms = tuple[np.ndarray, np.ndarray, np.ndarray]  # S, Q and θ / r


def scale(k: np.ndarray, a: np.ndarray, b: np.ndarray) -> Terms:
    """S, Q and θ / r (…,) at a, b (…,) for coefficients (4, …).  (2), (3)"""
    r2 = a * a + b * b
    near = r2 < NEAR_AXIS
    r = np.sqrt(np.where(near, 1.0, r2))
    theta = np.arctan(r)
    t = theta * theta
    per_r = np.where(near, 1 - r2 / 3, theta / r)
    t = np.where(near, r2, t)
    S = per_r * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))
    slope = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3])))  # dθ_d / dθ
    Q = np.where(near, 2 * (k[0] - 1 / 3), (slope / (1 + r * r) - S) / (r * r))
    return S, Q, per_r


def angle_of(k: np.ndarray, distorted: np.ndarray) -> np.ndarray:
    """θ (…,) of θ_d (…,), by Newton's method; NaN where there is none below WIDEST.  (1)"""
    theta = np.minimum(distorted, WIDEST)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            t = theta * theta
            off = theta * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) - distorted
            theta = theta - off / (1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3]))))
            if np.nanmax(np.abs(off), initial=0.0) < TOLERANCE:
                break
        good = (np.abs(off) < 1e3 * TOLERANCE) & (theta >= 0) & (theta <= WIDEST)
    return np.where(good, theta, np.nan)
