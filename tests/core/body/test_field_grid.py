"""The field on a grid is the field at its points, and reaches as far as the surface does."""

import numpy as np
import pytest

from tricap.core.body.metaballs import THRESHOLD, field
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.contour_skin import limb_skin
from tricap.core.body.skin.whole_surface import field_grid


def test_the_grid_of_a_limb_is_its_field() -> None:
    shape = default_shape(read_model("arm.R"))
    motion = np.zeros(len(shape.skeleton.dof_names))
    motion[shape.skeleton.layout["elbow.R flexion"]] = 0.8
    grid = field_grid(shape, motion, 0.01)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    at = np.stack(np.meshgrid(*map(np.arange, grid.values.shape), indexing="ij"), axis=-1).reshape(-1, 3)[::7]
    exact = field(shape.metaballs, shape.lengths_m, R, head, grid.origin_m + 0.01 * at)
    assert np.abs(grid.values[tuple(at.T)] - exact).max() < 2e-3  # what lies beyond a ball's reach is left out
    rim = np.concatenate([np.take(grid.values, [0, -1], axis=axis).ravel() for axis in range(3)])
    assert rim.max() < 0.1 * THRESHOLD < THRESHOLD < grid.values.max()


@pytest.mark.parametrize("spacing_m", [0.01, 0.006])
def test_the_skin_lies_where_the_grid_says(spacing_m: float) -> None:
    shape = default_shape(read_model("arm.R"))
    motion = np.zeros(len(shape.skeleton.dof_names))
    grid = field_grid(shape, motion, spacing_m)
    from scipy.ndimage import map_coordinates

    skin = limb_skin(shape, motion)
    at = (skin.vertices_m - grid.origin_m) / spacing_m
    assert np.abs(map_coordinates(grid.values, at.T, order=3) - THRESHOLD).max() < 0.02
