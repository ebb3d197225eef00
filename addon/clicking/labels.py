"""Where names stand beside their marks, so that none lies over another, nor over a mark. No Blender in here."""

import numpy as np

MARK = 6.0  # half the size of a mark, in pixels of the region as everything here
GAP = 3.0  # to what is beside


def place_labels(marks: np.ndarray, widths: np.ndarray, height: float, region: tuple[float, float]) -> np.ndarray:
    """The lower left corners (N, 2) of names of these widths (N,) beside their marks (N, 2); NaN where there is no room for one.

    Earlier names are given room first. All in pixels of a region of this width and height.
    """
    found, taken = np.full((len(marks), 2), np.nan), np.concatenate([marks - MARK, marks + MARK], axis=1)
    for i, (mark, width) in enumerate(zip(marks, widths)):
        corners = mark + _around(width, height)
        boxes = np.concatenate([corners - GAP / 2, corners + (width + GAP / 2, height + GAP / 2)], axis=1)
        inside = (boxes[:, :2] >= 0).all(axis=1) & (boxes[:, 2:] <= region).all(axis=1)
        apart = (boxes[:, None, 2:] <= taken[:, :2]) | (boxes[:, None, :2] >= taken[:, 2:])
        free = np.flatnonzero(inside & apart.any(axis=2).all(axis=1))
        if len(free):
            found[i], taken = corners[free[0]], np.concatenate([taken, boxes[free[:1]]])
    return found


def _around(width: float, height: float) -> np.ndarray:
    """Corners (K, 2) of a name about a mark: above it first, clear of Blender's own marker and its handle, then beside, then below."""
    near, high = MARK + GAP, 18.0
    return np.array([(-10.0, high), (near, -height / 2), (-near - width, -height / 2), (near - width, high), (-width / 2, -near - height),
                     (near, near), (-near - width, near), (near, -near - height), (-near - width, -near - height)])  # fmt: skip
