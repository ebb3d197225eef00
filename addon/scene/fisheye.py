"""A fisheye lens for Blender's clips, which have Brown's lens only: the Brown polynomial nearest to it over the picture of its camera.

A Blender camera shows the ideal image (w, h), whose corner is R from the principal point, in focal lengths. There

    r (1 + k₁ r² + k₂ r⁴ + k₃ r⁶ + k₄ r⁸) ≈ d(r) ,   0 < r ≤ R                                     (1)

with the distorted radius d of the fisheye lens; the largest difference is made as small as possible (Lawson 1961: least squares with
weights that grow where the difference is large). For a lens of 150° it is 0.1 pixels.
"""

import numpy as np

from ...core.geometry.camera import Camera, image_of, interior_of

SAMPLES = 400
ROUNDS = 60
LEAST_GROWTH = 1e-3


def nearest_brown(camera: Camera) -> tuple[np.ndarray, float]:
    """k1, k2, k3, k4 (4,) of (1), and the largest difference [px]."""
    interior = interior_of(camera)
    corner = np.maximum(interior[1:3] + 0.5, np.array(camera.size_px) - 0.5 - interior[1:3])
    r = np.linspace(0.0, float(np.linalg.norm(corner)) / interior[0], SAMPLES + 1)[1:]
    plain = np.zeros(10)
    plain[[0, 3, 4, 5, 6]] = 1.0, *interior[3:7]
    wanted = image_of(plain, np.stack([r, np.zeros_like(r), np.ones_like(r)], axis=-1), fisheye=True)[:, 0] - r
    A, weight = r[:, None] ** [3, 5, 7, 9], np.ones(SAMPLES)
    best, least = np.zeros(4), np.inf
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        k = np.linalg.lstsq(A * root[:, None], wanted * root, rcond=None)[0]
        off = np.abs(A @ k - wanted)
        if off.max() < least:
            best, least = k, float(off.max())
        weight = weight * (off / max(off.max(), 1e-12) + LEAST_GROWTH)
        weight /= weight.mean()
    return best, least * float(interior[0])
