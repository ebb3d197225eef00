"""Rectangles in a square as small as can be found: islands of a texture.

Each rectangle, in a given order, is put as low as it fits on those before it, and there as far to the left as it fits (skyline, bottom
left; Jylänki 2010, A thousand ways to pack the bin, sec. 5). The best of several orders and widths is kept, always the same for the same
sizes.
"""

import numpy as np

WIDTHS = np.linspace(1.0, 1.4, 81)  # tried, over the side of a square of the same area
SAME = 1e-9  # lengths that differ by less are equal


def packed(sizes: np.ndarray) -> tuple[np.ndarray, float]:
    """The lower left corners (N, 2) of rectangles (N, 2), width and height, that do not overlap, and the side of the square around them."""
    side = float(np.sqrt(sizes.prod(axis=1).sum()))
    orders = [np.argsort(-np.round(key, 9), kind="stable") for key in (sizes[:, 1], sizes[:, 0], sizes.prod(axis=1), sizes.max(axis=1))]
    wide = [max(side * ratio, sizes[:, 0].max()) for ratio in WIDTHS]
    found = [_on_skyline(sizes, order, width) for order in orders for width in wide]
    return min(found, key=lambda placed: placed[1])


def _on_skyline(sizes: np.ndarray, order: np.ndarray, width: float) -> tuple[np.ndarray, float]:
    """Corners (N, 2) in a strip of this width, and the side of the square around all."""
    begin, height = np.array([0.0]), np.array([0.0])  # of each step of the skyline, from the left
    corners = np.zeros((len(sizes), 2))
    for i in order:
        wide, tall = sizes[i]
        end = np.append(begin[1:], width)
        fits = begin[begin + wide <= width + SAME]
        below = [height[(begin < x + wide - SAME) & (end > x + SAME)].max() for x in fits]
        corners[i] = x, y = fits[int(np.argmin(np.round(below, 9)))], min(below)
        left, right = begin < x - SAME, end > x + wide + SAME
        begin = np.concatenate([begin[left], [x], np.maximum(begin[right], x + wide)])
        height = np.concatenate([height[left], [y + tall], height[right]])
    return corners, float((corners + sizes).max())
