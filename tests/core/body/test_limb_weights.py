"""Where a limb's weights begin on the skin, and the place of the head."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.core.body.whole_body import whole_body
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.closed_skin import OneSkin, one_skin
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.head_place import FEWEST, registered_head
from tricap.core.body.skin.limb_weights import with_limb_borders
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.relief import SurfacePoints
from tricap.core.body.skin.surface_operators import vertex_normals

FEW = SkinSettings(contours=8, rays=16, cap_contours=3)
HIGHER_M, AHEAD_M = 0.012, 0.010


@cache
def body() -> tuple[BodyShape, OneSkin]:
    shape = whole_body()
    return shape, one_skin(shape, FEW)


def test_a_thigh_begins_at_its_joint_and_not_at_the_seam() -> None:
    shape, skin = body()
    names = list(skin.bone_names)
    _, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    hip, thigh = head[names.index("thigh.R")], skin.weights[:, names.index("thigh.R")]
    across, _, height = (skin.vertices_m - hip).T
    front = (np.abs(across) < 0.03) & (skin.vertices_m[:, 1] < -0.03)
    assert thigh[front & (height < -0.07) & (height > -0.15)].min() > 0.8
    assert thigh[front & (height > 0.15)].max() < 0.1
    assert np.allclose(skin.weights.sum(axis=1), 1)


def test_both_sides_have_the_same_weights() -> None:
    shape, skin = body()
    names = list(skin.bone_names)
    places, part = np.array([[-0.05, -0.1, -0.02], [0.05, -0.1, -0.02], [-0.12, 0.09, -0.05], [0.12, 0.09, -0.05]]), np.zeros(4, dtype=int)
    weights = np.tile(np.eye(len(names))[names.index("pelvis")], (4, 1))
    found = with_limb_borders(shape, places, part, weights)
    left, right = found[:, names.index("thigh.L")], found[:, names.index("thigh.R")]
    assert np.allclose(left[[1, 0, 3, 2]], right) and right[0] > 0.1 and np.allclose(found.sum(axis=1), 1)


def test_a_chest_keeps_its_weights() -> None:
    shape, skin = body()
    above = skin.vertices_m[:, 2] > 0.35
    found = with_limb_borders(shape, skin.vertices_m, skin.part, skin.weights)
    assert above.any() and np.allclose(found[above], skin.weights[above])


@cache
def person() -> tuple[BodyShape, OneSkin]:
    shape = shape_for_skin(default_shape(read_model("upper_body")), SkinSettings())
    return shape, one_skin(shape, SkinSettings())


def seen_head(higher_m: float, ahead_m: float) -> tuple[SurfacePoints, np.ndarray]:
    """Points on the front of a head that is somewhere else than the skin's, and the head's vertices (bool)."""
    shape, skin = person()
    names = list(skin.bone_names)
    b = names.index("head")
    R, _ = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    head, normals = skin.weights[:, b] > 0.9, vertex_normals(skin.vertices_m, skin.faces)
    front = head & (normals @ R[b][:, 2] > 0.2)
    moved = skin.vertices_m[front] + higher_m * R[b][:, 1] + ahead_m * R[b][:, 2]
    pose = np.zeros(len(shape.skeleton.dofs))
    return SurfacePoints(motion=pose, xyz_m=moved, normals=normals[front], sigma_m=np.full(len(moved), 0.001)), head


@pytest.mark.slow
def test_the_head_moves_to_the_measured_face() -> None:
    shape, skin = person()
    seen, head = seen_head(HIGHER_M, AHEAD_M)
    found = registered_head(skin, shape, [seen] * 3).moved(skin)
    R, _ = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    b = list(skin.bone_names).index("head")
    moved = np.median((found.vertices_m - skin.vertices_m)[head] @ R[b], axis=0)
    assert np.abs(moved - [0, HIGHER_M, AHEAD_M]).max() < 0.005
    hands = skin.weights[:, [name.startswith("hand") for name in skin.bone_names]].sum(axis=1) > 0.5
    assert np.abs(found.vertices_m - skin.vertices_m)[hands].max() < 1e-5


def test_a_head_with_few_points_stays() -> None:
    shape, skin = person()
    seen, _ = seen_head(HIGHER_M, AHEAD_M)
    few = replace(seen, **{name: getattr(seen, name)[: FEWEST - 1] for name in ("xyz_m", "normals", "sigma_m")})
    assert registered_head(skin, shape, [few]) is None
    assert registered_head(skin, shape, []) is None
