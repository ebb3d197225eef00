"""The skin of a person: fair, with the relief that was measured, the same in files, poses and scenes."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.closed_skin import OneSkin, flipped, mean_of_neighbours
from tricap.core.body.skin.contour_skin import body_skin
from tricap.core.body.skin.fairing import faired
from tricap.core.body.skin.head_place import registered_head
from tricap.core.body.skin.mesh import DETAIL, SkinSettings, corner_uv
from tricap.core.body.skin.person_skin import REST, cage, read_skin, resampled, rest_skin, with_relief, write_skin
from tricap.core.body.skin.posed import Poser
from tricap.core.body.skin.relief import PRIOR_M, SurfacePoints
from tricap.core.body.skin.surface_operators import LEAST_COTANGENT, factorised, laplacian, vertex_normals
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor

FEW = SkinSettings(contours=8, rays=16, cap_contours=3)


@lru_cache
def arm() -> tuple[BodyShape, OneSkin]:
    shape = default_shape(read_model("arm.R"))
    return shape, rest_skin(shape, FEW)


def poses(shape: BodyShape, count: int) -> np.ndarray:
    motion = np.zeros((count, len(shape.skeleton.dofs)))
    motion[:, shape.skeleton.layout["elbow.R flexion"]] = np.linspace(0.1, 1.2, count)
    motion[:, 0] = np.linspace(0, 0.3, count)
    return motion


def sphere(radius: float, n: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """The six sides of a cube, blown up: vertices and quads."""
    t = np.tan(np.linspace(-1, 1, n + 1) * np.pi / 4)
    a, b = np.meshgrid(t, t, indexing="ij")
    sides = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.stack([np.full(a.shape, sign), a, sign * b], axis=-1)
            sides.append(np.roll(side, axis, axis=-1))
    points = np.stack(sides)
    points = radius * points / np.linalg.norm(points, axis=-1, keepdims=True)
    at = np.arange(points[..., 0].size).reshape(6, n + 1, n + 1)
    faces = np.stack([at[:, :-1, :-1], at[:, 1:, :-1], at[:, 1:, 1:], at[:, :-1, 1:]], axis=-1).reshape(-1, 4)
    _, first, number = np.unique(points.reshape(-1, 3).round(9), axis=0, return_index=True, return_inverse=True)
    return points.reshape(-1, 3)[first], number.reshape(-1)[faces]


def test_the_operators_of_a_sphere() -> None:
    vertices, faces = sphere(0.1)
    normals = vertex_normals(vertices, faces)
    C, area = laplacian(vertices, faces)
    assert np.einsum("nk,nk->n", normals, vertices / 0.1).min() > 0.999
    assert area.sum() == pytest.approx(4 * np.pi * 0.01, rel=0.005)
    curvature = np.einsum("nk,nk->n", normals, C @ vertices) / area
    assert (curvature * area).sum() / area.sum() == pytest.approx(-20, rel=0.1) and curvature.max() < -19  # −2/r on the whole


def test_laplacian_is_the_sum_over_both_triangulations() -> None:
    vertices, faces = sphere(0.1, 3)
    vertices = vertices + np.random.default_rng(0).normal(scale=0.004, size=vertices.shape)
    wanted, area = np.zeros((len(vertices), len(vertices))), np.zeros(len(vertices))
    for triangle in np.concatenate([faces[:, c] for c in ([0, 1, 2], [0, 2, 3], [1, 2, 3], [1, 3, 0])]):
        for a, b, c in (np.roll(triangle, i) for i in range(3)):
            u, v = vertices[b] - vertices[a], vertices[c] - vertices[a]
            across = np.linalg.norm(np.cross(u, v))
            weight = max(u @ v / across, LEAST_COTANGENT) / 4
            wanted[[b, c], [c, b]] += weight
            wanted[[b, c], [b, c]] -= weight
            area[a] += across / 12
    C, found = laplacian(vertices, faces)
    assert np.abs(C.toarray() - wanted).max() < 1e-12 and np.allclose(found, area, rtol=1e-12)


def test_equations_of_a_mesh_are_solved() -> None:
    C, area = laplacian(*sphere(0.1))
    weight = area / 0.05**2
    wanted = np.random.default_rng(0).normal(size=len(area))
    right = weight * wanted - C @ wanted
    assert np.allclose(factorised(-C, weight).solve(right), wanted, rtol=1e-8)


def test_fairing_keeps_a_sphere_and_removes_ledges() -> None:
    vertices, faces = sphere(0.1)
    assert np.abs(np.linalg.norm(faired(vertices, faces, np.zeros(len(vertices))), axis=1) - 0.1).max() < 1e-3
    high = vertices * (1 + 0.1 * (vertices[:, 2:] > 0.03))
    found = faired(high, faces, np.zeros(len(vertices)))

    def sharpest(v: np.ndarray) -> float:
        C, area = laplacian(v, faces)
        return float(np.abs(np.einsum("nk,nk->n", vertex_normals(v, faces), C @ v) / area).max())

    assert sharpest(found) < 0.15 * sharpest(high) and not flipped(found, faces).any()
    assert np.abs(faired(high, faces, np.ones(len(vertices))) - high).max() < 0.006  # anatomical shapes stay


def test_a_posed_skin_moves_with_its_bones() -> None:
    shape, skin = arm()
    poser, motion = Poser(shape, skin.weights), poses(shape, 3)
    np.testing.assert_allclose(poser.posed(skin.vertices_m, np.zeros(motion.shape[1])), skin.vertices_m, atol=1e-12)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion[2])
    R0, head0 = bone_frames(shape.skeleton, shape.lengths_m, 0 * motion[2])
    posed = poser.posed(skin.vertices_m, motion[2])
    for b in range(len(R)):
        rigid = skin.weights[:, b] > 1 - 1e-9
        expected = (skin.vertices_m[rigid] - head0[b]) @ (R[b] @ R0[b].T).T + head[b]
        np.testing.assert_allclose(posed[rigid], expected, atol=1e-9)
    assert not flipped(posed, skin.faces).any()


def measured(shape: BodyShape, skin: OneSkin, true_m: np.ndarray, noise_m: float, side: np.ndarray) -> list[SurfacePoints]:
    """Points at the vertices `side` of a skin displaced by `true_m`, in five poses."""
    random, frames = np.random.default_rng(1), []
    poser = Poser(shape, skin.weights)
    vertices = skin.vertices_m + true_m[:, None] * vertex_normals(skin.vertices_m, skin.faces)
    for motion in poses(shape, 5):
        posed = poser.posed(vertices, motion)
        normals = vertex_normals(posed, skin.faces)[side]
        xyz = posed[side] + noise_m * random.standard_normal((side.sum(), 1)) * normals
        xyz[::20] += 0.03 * normals[::20]  # outliers
        frames.append(SurfacePoints(motion=motion, xyz_m=xyz, normals=normals, sigma_m=np.full(len(xyz), noise_m)))
    return frames


def test_relief_is_found_where_it_was_measured_with_its_sigma() -> None:
    shape, skin = arm()
    names = list(skin.bone_names)
    forearm = skin.weights[:, names.index("forearm.R")] > 0.5
    front = vertex_normals(skin.vertices_m, skin.faces)[:, 1] < 0
    true = np.where(forearm, 0.004, 0.0)
    true = resmoothed(true, skin)
    found = with_relief(skin, shape, measured(shape, skin, true, 0.0005, front), None, False, Monitor())
    assert found.relief_m is not None and found.sigma_m is not None
    error, seen = found.relief_m - true, front & (found.sigma_m < 0.002) & (np.abs(true - 0.002) < 0.003)
    assert seen.sum() > 50 and np.median(np.abs(error[seen])) < 0.0004 and np.abs(error[seen]).max() < 0.003
    assert (np.abs(error[seen]) < 3 * found.sigma_m[seen]).mean() > 0.95
    hidden = ~front & (vertex_normals(skin.vertices_m, skin.faces)[:, 1] > 0.9)
    assert np.median(found.sigma_m[hidden]) > 2 * np.median(found.sigma_m[seen]) and found.sigma_m.max() < 1.5 * PRIOR_M
    assert not flipped(found.vertices_m, found.faces).any()


def resmoothed(values: np.ndarray, skin: OneSkin) -> np.ndarray:
    near = mean_of_neighbours(skin.faces, len(values))
    for _ in range(3):
        values = 0.5 * (values + near @ values)
    return values


def test_nothing_measured_is_no_relief() -> None:
    shape, skin = arm()
    far = SurfacePoints(motion=poses(shape, 1)[0], xyz_m=np.full((4, 3), 9.0), normals=np.tile([0.0, -1, 0], (4, 1)), sigma_m=np.ones(4))
    found = with_relief(skin, shape, [far], None, False, Monitor())
    assert found.relief_m is not None and np.abs(found.relief_m).max() < 2e-5  # what the fairing moves


def test_the_file_of_a_skin(tmp_path: Path) -> None:
    shape, skin = arm()
    v = len(skin.vertices_m)
    skin = replace(skin, relief_m=np.linspace(0, 0.01, v), sigma_m=np.full(v, 0.002))
    write_skin(tmp_path / REST, skin)
    back = read_skin(tmp_path / REST, shape)
    assert np.abs(back.vertices_m - skin.vertices_m).max() < 1e-6 and np.abs(back.weights - skin.weights).max() < 1e-6
    assert np.array_equal(back.faces, skin.faces) and back.pieces == skin.pieces and np.allclose(back.relief_m, skin.relief_m, atol=1e-8)
    arrays, header = store.load(tmp_path / REST)
    for name, value, match in (
        ("faces", arrays["faces"] + 10**6, "damaged"),
        ("weights", 0 * arrays["weights"], "damaged"),
        ("bones", arrays["bones"] + 99, "damaged"),
        ("uv", np.where(arrays["uv"] > 0.5, np.nan, arrays["uv"]), "damaged"),
        ("vertices_m", arrays["vertices_m"][:5], "shape"),
    ):
        store.save(tmp_path / REST, arrays | {name: value}, {k: v for k, v in header.items() if k != "store_version"})
        with pytest.raises(InputError, match=match):
            read_skin(tmp_path / REST, shape)
    with pytest.raises(InputError, match="other bones"):
        write_skin(tmp_path / REST, skin)
        read_skin(tmp_path / REST, default_shape(read_model("leg.R")))


def test_the_cage_of_a_limb_is_its_contours() -> None:
    shape, skin = arm()
    rows, faces = cage(skin)
    contours = body_skin(shape, np.zeros(len(shape.skeleton.dofs)), FEW)
    assert np.array_equal(faces, contours.faces)
    assert np.median(np.linalg.norm(skin.vertices_m[rows] - contours.vertices_m, axis=1)) < 0.003  # faired
    coarse, fine = resampled(skin, 1), resampled(skin, 4)
    assert np.allclose(coarse.uv, corner_uv(contours)) and len(fine.faces) == 4 * len(skin.faces)


@pytest.mark.slow
def test_a_whole_body_has_no_ledges_and_comes_in_any_detail() -> None:
    shape = default_shape(read_model("full"))
    skin = rest_skin(shape, FEW)
    assert not flipped(skin.vertices_m, skin.faces).any()
    rows, faces = cage(skin)
    assert skin.pieces == DETAIL and len(faces) * skin.pieces**2 == len(skin.faces)
    coarse, fine = resampled(skin, 1), resampled(skin, 4)
    np.testing.assert_array_equal(coarse.vertices_m, skin.vertices_m[rows])
    assert len(fine.faces) == 4 * len(skin.faces) and np.allclose(fine.weights.sum(axis=1), 1)


@pytest.mark.slow
def test_the_other_side_is_used_on_request() -> None:
    shape = default_shape(read_model("full"))
    skin, rest = rest_skin(shape, FEW), np.zeros(len(shape.skeleton.dofs))
    left = skin.vertices_m[:, 0] > 0.02
    normals = vertex_normals(skin.vertices_m, skin.faces)[left]
    points = SurfacePoints(motion=rest, xyz_m=skin.vertices_m[left] + 0.008 * normals, normals=normals, sigma_m=np.full(left.sum(), 5e-4))
    thigh = skin.weights[:, list(skin.bone_names).index("thigh.R")] > 0.9
    plain, mirrored = (
        with_relief(skin, shape, [points] * 4, registered_head(skin, shape, [points] * 4), mirror, Monitor()) for mirror in (False, True)
    )
    assert plain.relief_m is not None and mirrored.relief_m is not None and mirrored.sigma_m is not None
    assert abs(np.median(plain.relief_m[thigh])) < 0.002 and np.median(mirrored.relief_m[thigh]) == pytest.approx(0.008, abs=0.001)
    assert np.median(mirrored.sigma_m[thigh]) > 0.001
