"""How well the joints are known, as colours: the same in report, film and Blender."""

import numpy as np

SIGMAS_MM = np.array([1.0, 7.0, 50.0])  # of joints; their colours are
COLOURS = np.array([[40, 130, 200], [250, 205, 60], [230, 50, 50]], dtype=np.float64)  # RGB: blue, yellow, red


def sigma_colours(sigma_mm: np.ndarray) -> np.ndarray:
    """Colours (…, 3) RGB, 0 to 255, of sigmas (…) of joints; red where there is none."""
    at = np.log(np.clip(np.nan_to_num(sigma_mm, nan=np.inf), SIGMAS_MM[0], SIGMAS_MM[-1]))
    return np.stack([np.interp(at, np.log(SIGMAS_MM), COLOURS[:, c]) for c in range(3)], axis=-1)
