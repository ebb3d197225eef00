"""Hands of the skin: five fingers with bones, closed, the same for every person, and nothing of the fitted motion changed."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, FingerBend, default_shape
from tricap.core.body.skeleton import bone_frames, joint_positions
from tricap.core.body.skin.closed_skin import OneSkin, flipped, one_skin
from tricap.core.body.skin.ends import row_counts, row_of_quads
from tricap.core.body.skin.extremities import person_shape, shape_with_ends
from tricap.core.body.skin.fingers import FINGER_BONE, RIGID_BONE, shape_for_skin
from tricap.core.body.skin.hand_template import FINGERS, RING, THUMB, UNIT_MM, hand_template
from tricap.core.body.skin.mesh import DETAIL, SkinSettings
from tricap.core.body.skin.person_skin import REST, read_skin, write_skin
from tricap.core.body.skin.posed import Poser
from tricap.core.body.skin.relief import SurfacePoints, measured_relief
from tricap.core.foundation.progress import Monitor

BENT = np.radians(60.0)


@cache
def person() -> BodyShape:
    return shape_for_skin(default_shape(read_model("upper_body")), SkinSettings())


@cache
def skin() -> OneSkin:
    return one_skin(person(), SkinSettings(), DETAIL)


def names() -> list[str]:
    return [bone.name for bone in person().skeleton.bones]


def of_finger(weights: np.ndarray, start: str) -> np.ndarray:
    return np.asarray(weights[:, [name.startswith(start) for name in names()]].sum(axis=1) > 0.5)


def with_bent(angles: dict[str, float]) -> np.ndarray:
    """The skin's vertices with bones bent about their x axes."""
    shape = person()
    R_rest, head_rest = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    R, head = R_rest.copy(), head_rest.copy()
    for b, parent in enumerate(shape.skeleton.parents):
        if parent >= 0:
            head[b] = head[parent] + R[parent] @ R_rest[parent].T @ (head_rest[b] - head_rest[parent])
            R[b] = R[parent] @ R_rest[parent].T @ R_rest[b]
        cosine, sine = np.cos(angles.get(names()[b], 0.0)), np.sin(angles.get(names()[b], 0.0))
        R[b] = R[b] @ np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return Poser(shape, skin().weights).moved(skin().vertices_m, R, head)[0]


@pytest.mark.parametrize(("low", "high"), [(32, 26), (8, 26), (26, 26), (78, 26), (16, 26)])
def test_rows_join_rings_of_any_even_numbers(low: int, high: int) -> None:
    for n in row_counts(low, high):
        quads, pairs = row_of_quads(low, n)
        edges = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)]).tolist()
        open_edges = [edge for edge in edges if edge[::-1] not in edges]
        assert len({*map(tuple, edges)}) == len(edges) and len(open_edges) == low + n
        assert len(pairs) == abs(low - n) and set(quads.ravel()) == set(range(low + n + len(pairs)))
        low = n
    assert low == high


def test_the_template_is_open_at_the_wrist_only_and_as_large_as_hands_are() -> None:
    hand = hand_template()
    edges = np.concatenate([hand.faces[:, [i, (i + 1) % 4]] for i in range(4)]).tolist()
    assert sorted(a for a, b in edges if [b, a] not in edges) == list(range(RING))
    np.testing.assert_allclose(hand.weights.sum(axis=1), 1.0)
    tips = {f.name: hand.vertices[hand.weights[:, hand.bones.index(f"{f.name}.03")] > 0.5] for f in (THUMB, *FINGERS)}
    assert 175 < UNIT_MM * tips["f_middle"][:, 1].max() < 195  # hand length 189 mm, slightly bent
    reach = [tips[f.name][:, 1].max() for f in FINGERS]
    assert reach[1] == max(reach) and reach[3] == min(reach) and tips["thumb"][:, 1].max() < reach[3]


def test_a_skin_with_fingers_is_closed_and_no_quad_is_flipped() -> None:
    mesh = skin()
    edges = np.concatenate([mesh.faces[:, [i, (i + 1) % 4]] for i in range(4)])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert len(mesh.vertices_m) - len(edges) // 2 + len(mesh.faces) == 2
    assert not flipped(mesh.vertices_m, mesh.faces).any()
    assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    fingers = {name for name in names() if FINGER_BONE.fullmatch(name)}
    assert len(fingers) == 30 and all((mesh.weights[:, names().index(name)] > 0.6).sum() > 20 for name in fingers)


@pytest.mark.parametrize("bend", [pytest.param(-0.2, marks=pytest.mark.slow), pytest.param(0.0, marks=pytest.mark.slow), 3.0])
def test_measured_fingers_are_bent_as_far_in_skin_and_bones(bend: float) -> None:
    """With the same quads, closed, and none flipped; the other hand is relaxed."""
    body = replace(default_shape(read_model("upper_body")), finger_bends={"hand.R": FingerBend(bend, 0.1)})
    shape = shape_for_skin(body, SkinSettings())
    mesh, bones = one_skin(shape, SkinSettings()), [bone.name for bone in shape.skeleton.bones]
    once = one_skin(person(), SkinSettings())
    assert np.array_equal(mesh.faces, once.faces) and not flipped(mesh.vertices_m, mesh.faces).any()
    R = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))[0][:, :, 1]
    for side, times in (("R", bend), ("L", 1.0)):
        for finger in FINGERS:
            along = [R[bones.index(f"{finger.name}.0{k}.{side}")] for k in (1, 2, 3)]
            angles = [np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a, b in zip(along, along[1:])]
            np.testing.assert_allclose(angles, abs(times) * np.array(finger.bends_deg[1:]), atol=0.5)
    moved = np.linalg.norm(mesh.vertices_m - once.vertices_m, axis=1)
    assert moved[of_finger(once.weights, "f_middle.03.R")].min() > 0.003 and moved[of_finger(once.weights, "f_middle.03.L")].max() < 1e-9


def test_left_and_right_hands_are_mirror_images() -> None:
    from scipy.spatial import cKDTree

    sides = [skin().vertices_m[of_finger(skin().weights, "f_") & (skin().vertices_m[:, 0] * sign > 0)] for sign in (1, -1)]
    assert len(sides[0]) == len(sides[1]) > 1000
    assert cKDTree(sides[0] * [-1, 1, 1]).query(sides[1])[0].max() < 1e-4


@pytest.mark.slow
def test_wider_hands_have_the_same_topology_and_wider_fingers() -> None:
    shape = default_shape(read_model("upper_body"))
    hands = [name.startswith("hand") for name in (bone.name for bone in shape.skeleton.bones)]
    mine = np.isin(shape.metaballs.bone_index, np.flatnonzero(hands))
    radii = np.where(mine[:, None], [1.2, 1.0, 1.0], 1.0) * shape.metaballs.radii_m
    wide = shape_for_skin(replace(shape, metaballs=replace(shape.metaballs, radii_m=radii)), SkinSettings())
    other = one_skin(wide, SkinSettings())
    once = one_skin(person(), SkinSettings())
    np.testing.assert_array_equal(other.faces[-1000:] - len(other.vertices_m), once.faces[-1000:] - len(once.vertices_m))
    index = of_finger(once.weights, "f_index.02.R")
    assert np.ptp(other.vertices_m[-len(once.vertices_m) :][index], axis=0).max() > np.ptp(once.vertices_m[index], axis=0).max()


def test_joints_and_motion_are_those_of_the_fitted_body() -> None:
    shape = default_shape(read_model("upper_body"))
    motion = np.random.default_rng(0).normal(0, 0.3, (3, len(shape.skeleton.dofs)))
    assert person().skeleton.dof_names == shape.skeleton.dof_names
    fitted = joint_positions(shape.skeleton, shape.lengths_m, motion)
    shown = joint_positions(person().skeleton, person().lengths_m, motion)
    for joint, places in fitted.items():
        np.testing.assert_array_equal(places, shown[joint])


def test_a_finger_bends_by_60_degrees_at_its_joints() -> None:
    for bone in ("f_index.02.R", "f_pinky.02.L", "thumb.03.R"):
        moved = with_bent({bone: BENT})
        assert not flipped(moved, skin().faces).any()
        still = skin().weights[:, [name.startswith(bone[:-5]) and name.endswith(bone[-2:]) for name in names()]].sum(axis=1) == 0
        np.testing.assert_allclose(moved[still], skin().vertices_m[still], atol=1e-12)
        tip = skin().weights[:, names().index(f"{bone[:-4]}03{bone[-2:]}")] > 0.99
        assert np.linalg.norm(moved[tip] - skin().vertices_m[tip], axis=1).min() > 0.004


@pytest.mark.slow
def test_relief_leaves_fingers_as_they_are() -> None:
    mesh, shape = skin(), person()
    normals = np.zeros(mesh.vertices_m.shape)
    normals[:, 1] = -1.0
    points = SurfacePoints(
        motion=np.zeros(len(shape.skeleton.dofs)),
        xyz_m=mesh.vertices_m + 0.003 * normals,
        normals=normals,
        sigma_m=np.full(len(normals), 0.001),
    )
    relief = measured_relief(mesh, shape, [points], False, Monitor())
    fingers = of_finger(mesh.weights, "f_") & (mesh.weights[:, [n.startswith("hand") for n in names()]].sum(axis=1) == 0)
    assert np.abs(relief.displacement_m[fingers]).max() < 1e-9 and relief.sigma_m[fingers].min() > 0.001
    assert np.abs(relief.displacement_m).max() > 0.001


def test_files_with_and_without_fingers_are_read(tmp_path: Path) -> None:
    write_skin(tmp_path / REST, skin())
    np.testing.assert_allclose(read_skin(tmp_path / REST, person()).weights, skin().weights, atol=1e-6)
    mittens_shape = person_shape(default_shape(read_model("upper_body")))
    mittens = one_skin(mittens_shape, SkinSettings(contours=6, rays=16))
    write_skin(tmp_path / "old.npz", mittens)  # as written before there were fingers
    read = read_skin(tmp_path / "old.npz", person())
    assert read.bone_names == tuple(names())
    assert not read.weights[:, [bool(RIGID_BONE.fullmatch(name)) for name in names()]].any()


def test_the_contours_of_the_report_have_the_bones_of_the_fit() -> None:
    shape = default_shape(read_model("full"))
    cast = shape_with_ends(shape, SkinSettings())
    assert [bone.name for bone in cast.skeleton.bones] == [bone.name for bone in shape.skeleton.bones]
    assert len(shape_for_skin(shape, SkinSettings()).skeleton.bones) > len(cast.skeleton.bones)
