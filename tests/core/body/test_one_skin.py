"""The skin in one piece: closed, of quads, on the fitted surface, with texture coordinates and shares of the bones."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.one_skin import DETAIL, OneSkin, one_skin, turned_over
from tricap.core.body.shape import default_shape
from tricap.core.body.skin import body_skin
from tricap.core.body.skin_mesh import SkinSettings
from tricap.core.body.skin_weights import MOST_BONES, hinge, strongest
from tricap.core.body.whole_surface import WholeSurface


@cache
def skin_of(model: str, detail: int = 1) -> OneSkin:
    return one_skin(default_shape(read_model(model)), SkinSettings(), detail)


def face_normals(skin: OneSkin) -> np.ndarray:
    corner = skin.vertices_m[skin.faces]
    return np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])


@pytest.mark.parametrize(("model", "detail"), [("full", 1), ("upper_body", 2), ("leg.L", 1)])
def test_it_is_closed_and_faces_outwards(model: str, detail: int) -> None:
    skin = skin_of(model, detail)
    edges = np.concatenate([skin.faces[:, [i, (i + 1) % 4]] for i in range(4)])
    there, back = set(map(tuple, edges.tolist())), set(map(tuple, edges[:, ::-1].tolist()))
    assert len(there) == len(edges) and there == back
    assert len(skin.vertices_m) - len(edges) // 2 + len(skin.faces) == 2  # one surface without handles
    surface = WholeSurface(default_shape(read_model(model)), np.zeros(len(default_shape(read_model(model)).skeleton.dof_names)))
    outwards = surface.normals(skin.vertices_m[skin.faces].mean(axis=1), skin.part[skin.faces[:, 0]])
    assert (np.einsum("nk,nk->n", face_normals(skin), outwards) > 0).all()


def test_thighs_that_touch_leave_no_fold_between_them() -> None:
    """Thighs a sixth thicker, which are one at the crotch: no two faces along a common edge turn against each other."""
    shape = default_shape(read_model("full"))
    balls, bones = shape.metaballs, shape.skeleton.bones
    thigh = np.array([bones[b].name.startswith("thigh") for b in balls.bone_index])
    thick = replace(shape, metaballs=replace(balls, radii_m=np.where(thigh[:, None], 1.15, 1.0) * balls.radii_m))
    skin = one_skin(thick, SkinSettings())
    normals = face_normals(skin) / np.linalg.norm(face_normals(skin), axis=1, keepdims=True)
    edges = np.sort(np.concatenate([skin.faces[:, [i, (i + 1) % 4]] for i in range(4)]), axis=1)
    order = np.lexsort(edges.T)
    pairs = np.tile(np.arange(len(skin.faces)), 4)[order].reshape(-1, 2)  # the two faces of each edge
    assert np.einsum("nk,nk->n", normals[pairs[:, 0]], normals[pairs[:, 1]]).min() > -0.5


def test_seams_are_on_the_surface_and_the_parts_skin_is_kept_elsewhere() -> None:
    shape, skin = default_shape(read_model("full")), skin_of("full")
    rest = np.zeros(len(shape.skeleton.dof_names))
    parts = {tuple(v) for v in body_skin(shape, rest, SkinSettings()).vertices_m.round(9).tolist()}
    made = np.array([tuple(v) not in parts for v in skin.vertices_m.round(9).tolist()])
    off = np.abs(WholeSurface(shape, rest).distance_m(skin.vertices_m, skin.part))
    assert 0.1 < made.mean() < 0.6 and np.sqrt((off[made] ** 2).mean()) < 1e-4 and off[made].max() < 1e-3  # measured 0.02 and 0.45 mm


def test_limbs_leave_the_trunk_without_an_edge() -> None:
    """Across an edge between two parts the normal turns by no more than 5° other than across the edges beside; it did by 84° in armpits."""
    skin = skin_of("upper_body", DETAIL)
    edges = np.stack([skin.faces, np.roll(skin.faces, -1, axis=1)], axis=-1)  # (F, 4, 2)
    face_of = {tuple(edge): (f, i) for f, four in enumerate(edges.tolist()) for i, edge in enumerate(four)}
    normals, middle = face_normals(skin), skin.vertices_m[skin.faces].mean(axis=1)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    part = np.array([np.bincount(own).argmax() for own in skin.part[skin.faces]])

    def turn(f: int, i: int) -> float:
        """Of the normal over edge i of face f, in degrees, valleys positive."""
        a, b = edges[f, i].tolist()
        g = face_of[b, a][0]
        angle = np.degrees(np.arccos(np.clip(normals[f] @ normals[g], -1, 1)))
        return float(angle * np.sign((middle[g] - middle[f]) @ normals[f]))

    jumps = []
    for (a, b), (f, i) in face_of.items():
        g, j = face_of[b, a]
        if a < b and part[f] != part[g]:
            jumps.append(abs(turn(f, i) - (turn(f, (i + 2) % 4) + turn(g, (j + 2) % 4)) / 2))
    assert len(jumps) > 100 and max(jumps) < 5.0


def test_quads_that_are_turned_over_are_mended() -> None:
    """Thighs a third thicker cross each other where the legs begin; a quad whose point is drawn over its opposite side is told."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]])
    faces = np.array([[0, 1, 2, 3], [1, 4, 5, 2]])
    assert not turned_over(square, faces).any()
    square[4] = 0.5, 0.6, 0.0
    assert turned_over(square, faces)[1]
    shape = default_shape(read_model("full"))
    thigh = np.array([shape.skeleton.bones[b].name.startswith("thigh") for b in shape.metaballs.bone_index])
    balls = replace(shape.metaballs, radii_m=np.where(thigh[:, None], 1.3, 1.0) * shape.metaballs.radii_m)
    skin = one_skin(replace(shape, metaballs=balls), SkinSettings())
    hands = [i for i, name in enumerate(skin.bone_names) if name.startswith("hand")]  # the tips' fans are as they were
    about = skin.weights[:, hands].sum(axis=1)[skin.faces].max(axis=1) < 0.5
    assert not turned_over(skin.vertices_m, skin.faces)[about].any()


def test_cut_finer_it_is_the_same_surface() -> None:
    shape, skin = default_shape(read_model("upper_body")), skin_of("upper_body", 2)
    assert len(skin.faces) == 4 * len(skin_of("upper_body").faces)
    off = WholeSurface(shape, np.zeros(len(shape.skeleton.dof_names))).distance_m(skin.vertices_m, skin.part)
    assert np.sqrt((off**2).mean()) < 0.3e-3


def test_a_scenes_quads_are_near_the_surface() -> None:
    """At 32 points a ring and a scene's own detail; 0.17 mm RMS, with half as many 0.7."""
    shape, skin = default_shape(read_model("upper_body")), skin_of("upper_body", DETAIL)
    corner = skin.vertices_m[skin.faces]
    area = np.linalg.norm(face_normals(skin), axis=1)
    off = WholeSurface(shape, np.zeros(len(shape.skeleton.dof_names))).distance_m(corner.mean(axis=1), skin.part[skin.faces[:, 0]])
    assert np.sqrt((area * off**2).sum() / area.sum()) < 0.3e-3


def test_both_sides_are_mirror_images() -> None:
    points = skin_of("full").vertices_m
    mirrored = points * [-1, 1, 1]
    nearest = np.array([np.abs(points - p).max(axis=1).min() for p in mirrored[:: len(points) // 200]])
    assert nearest.max() < 1e-4


def test_islands_lie_side_by_side_and_no_face_is_turned_over() -> None:
    skin = skin_of("full")
    assert skin.uv.min() >= 0 and skin.uv.max() <= 1
    a, b = skin.uv[:, 2] - skin.uv[:, 0], skin.uv[:, 3] - skin.uv[:, 1]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert (area > 0).all() and area.sum() < 1


def test_shares_of_the_bones_do_not_jump() -> None:
    skin = skin_of("full")
    assert np.allclose(skin.weights.sum(axis=1), 1) and skin.weights.min() >= 0
    assert (skin.weights > 0).sum(axis=1).max() <= MOST_BONES and (skin_of("upper_body", 2).weights > 0).sum(axis=1).max() <= MOST_BONES
    ends = np.concatenate([skin.faces[:, [i, (i + 1) % 4]] for i in range(4)])
    assert np.abs(skin.weights[ends[:, 0]] - skin.weights[ends[:, 1]]).max() < 0.45


def test_of_many_bones_none_leaves_at_once() -> None:
    """Five bones at a shoulder: as the fourth and the fifth change places, no share jumps; it did by a tenth, and left dents."""
    weights = np.array([[0.4, 0.25, 0.15, 0.1 + d, 0.1 - d, 0.0] for d in (-1e-6, 0.0, 1e-6)])
    found = strongest(weights)
    assert np.abs(np.diff(found, axis=0)).max() < 1e-5 and (found > 0).sum(axis=1).max() <= MOST_BONES
    np.testing.assert_allclose(found.sum(axis=1), 1)
    few = np.array([[0.6, 0.0, 0.4, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(strongest(few), few)
    assert np.isfinite(strongest(np.full((1, 6), 1 / 6))).all()


def test_hinges_are_read_from_the_limits() -> None:
    bones = {bone.name: bone for bone in default_shape(read_model("full")).skeleton.bones}
    np.testing.assert_allclose(hinge(bones["forearm.R"]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(hinge(bones["shin.L"]), [0, 0, 1], atol=1e-12)
    assert not hinge(bones["hand.R"]).any() and not hinge(bones["pelvis"]).any()
