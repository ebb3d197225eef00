"""Edges of the skin that turn too much, folds of a displacement, and the weights of the neck."""

from functools import cache

import numpy as np
import pytest

from tests.core.body.whole_body import whole_body
from tricap.core.body.shape import BodyShape
from tricap.core.body.skin.closed_skin import OneSkin, beyond_edges, flipped, mean_of_neighbours, one_skin
from tricap.core.body.skin.edges import LARGEST_TURN, SLIT, _where_better, eased, faired_outside_folds, turns, without_folds, without_slits
from tricap.core.body.skin.limb_weights import with_neck
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.surface_operators import vertex_normals


@cache
def body() -> tuple[BodyShape, OneSkin]:
    shape = whole_body()
    return shape, one_skin(shape, SkinSettings(contours=12, rays=32), detail=2)


def ledge() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A skin with a step of 3 mm across a thigh, its faces, and the thigh's vertices (bool)."""
    _, skin = body()
    thigh = skin.weights[:, list(skin.bone_names).index("thigh.R")] > 0.95
    step = thigh & (skin.vertices_m[:, 2] < np.median(skin.vertices_m[thigh, 2]))
    return skin.vertices_m + 0.003 * step[:, None] * vertex_normals(skin.vertices_m, skin.faces), skin.faces, thigh


def sharp(vertices: np.ndarray, faces: np.ndarray, own: np.ndarray) -> int:
    """How many edges of quads of own vertices turn too much."""
    return int((turns(vertices, faces, beyond_edges(faces)[0])[own[faces].all(axis=1)] > LARGEST_TURN).sum())


@pytest.mark.slow
def test_a_ledge_is_eased_where_it_may_be() -> None:
    vertices, faces, thigh = ledge()
    before = sharp(vertices, faces, thigh)
    found = eased(vertices, faces, thigh)
    assert sharp(found, faces, thigh) < 0.2 * before and before > 10
    assert np.array_equal(found[~thigh], vertices[~thigh])
    assert np.abs(found - vertices).max() < 0.006
    assert np.array_equal(eased(vertices, faces, np.zeros(len(vertices), dtype=bool)), vertices)


@pytest.mark.slow
def test_a_mesh_too_coarse_for_its_surface_does_not_shrink() -> None:
    shape, _ = body()
    coarse = one_skin(shape, SkinSettings(contours=8, rays=16, cap_contours=3))
    may = np.ones(len(coarse.vertices_m), dtype=bool)
    assert sharp(coarse.vertices_m, coarse.faces, may) > 100
    assert np.array_equal(eased(coarse.vertices_m, coarse.faces, may), coarse.vertices_m)


def test_a_displacement_that_folds_the_skin_is_smaller_there_only() -> None:
    _, skin = body()
    along = vertex_normals(skin.vertices_m, skin.faces)
    pit = np.linalg.norm(skin.vertices_m - skin.vertices_m[len(along) // 2], axis=1) < 0.015
    displacement = np.where(pit, -0.2, 0.001)
    assert flipped(skin.vertices_m + displacement[:, None] * along, skin.faces).any()
    found = without_folds(skin.vertices_m, skin.faces, displacement, along)
    assert not flipped(skin.vertices_m + found[:, None] * along, skin.faces).any()
    far = np.linalg.norm(skin.vertices_m - skin.vertices_m[len(along) // 2], axis=1) > 0.4
    assert np.array_equal(found[far], displacement[far])


def test_a_slit_is_closed_and_the_rest_stays() -> None:
    _, skin = body()
    along, beyond = vertex_normals(skin.vertices_m, skin.faces), beyond_edges(skin.faces)[0]
    far = np.linalg.norm(skin.vertices_m - skin.vertices_m[len(along) // 2], axis=1)
    torn = skin.vertices_m + np.where(far < 0.01, -0.03, 0.0)[:, None] * along
    every, before = np.ones(len(along), dtype=bool), turns(skin.vertices_m, skin.faces, beyond)
    found = without_slits(skin.vertices_m, torn, skin.faces, every)
    opened = [(turns(v, skin.faces, beyond) > np.maximum(SLIT, before + np.radians(3.0))).any() for v in (torn, found)]
    assert opened == [True, False]
    assert np.array_equal(found[far > 0.3], torn[far > 0.3])
    assert np.abs(found - skin.vertices_m).max() < 0.001
    assert np.array_equal(without_slits(skin.vertices_m, torn, skin.faces, ~every), torn)
    coarse = skin.vertices_m + 0.002 * np.random.default_rng(0).standard_normal(skin.vertices_m.shape)
    assert np.array_equal(without_slits(skin.vertices_m, coarse, skin.faces, every), coarse)


def test_an_easing_that_turns_edges_more_is_left_out() -> None:
    vertices, faces, thigh = ledge()
    near, rows = mean_of_neighbours(faces, len(vertices)), np.flatnonzero(thigh)
    rough = vertices.copy()
    rough[rows] += 0.01 * np.random.default_rng(0).standard_normal((len(rows), 3))
    assert np.array_equal(_where_better(vertices, rough, faces, near, rows), vertices)
    assert np.array_equal(_where_better(rough, vertices, faces, near, rows), vertices)


def test_a_fairing_that_folds_the_skin_is_left_out_there() -> None:
    _, skin = body()
    at = skin.vertices_m[len(skin.vertices_m) // 2]
    near = np.linalg.norm(skin.vertices_m - at, axis=1) < 0.02
    fair = np.where(near[:, None], 2 * at - skin.vertices_m, skin.vertices_m)
    found = faired_outside_folds(skin.vertices_m, skin.faces, fair)
    assert flipped(fair, skin.faces).any() and not flipped(found, skin.faces).any()


def test_a_neck_bends_between_collar_and_jaw() -> None:
    shape, skin = body()
    names = list(skin.bone_names)
    three = [names.index(name) for name in ("chest", "neck", "head")]
    found = with_neck(shape, skin.vertices_m, skin.faces, skin.weights)
    assert np.allclose(found.sum(axis=1), 1) and found.min() >= 0
    others = np.setdiff1d(np.arange(len(names)), three)
    assert np.allclose(found[:, others], skin.weights[:, others])
    most = found[:, names.index("neck")] > 0.3
    height = skin.vertices_m[most, 2]
    assert np.ptp(height) > 0.05  # more than where the neck's own mesh has no other weight
