"""The skin lies on the implicit surface, is closed, faces outwards and does not cut itself, in straight and in bent postures."""

import numpy as np
import pytest

from tricap.core.body.metaballs import Metaballs, field
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames, joint_positions
from tricap.core.body.skin.contour_skin import SkinSettings, limb_skin
from tricap.core.foundation.errors import InputError


def posture(shape: BodyShape, bend_deg: float, twist_deg: float = 0.0) -> np.ndarray:
    motion = np.zeros(len(shape.skeleton.dof_names))
    motion[:3] = 0.1, -0.2, 1.4
    motion[3:6] = np.radians([25.0, -10.0, 30.0])
    motion[6:8] = np.radians([bend_deg, twist_deg])
    return motion


@pytest.fixture(params=["arm.R", "arm.L", "leg.R", "leg.L"])
def limb(request: pytest.FixtureRequest) -> BodyShape:
    return default_shape(read_model(request.param))


@pytest.mark.parametrize(("bend", "twist"), [(0.0, 0.0), (1e-7, 0.0), (70.0, 40.0), (120.0, -40.0)])
def test_vertices_lie_on_the_surface(limb: BodyShape, bend: float, twist: float) -> None:
    motion = posture(limb, bend, twist)
    R, head = bone_frames(limb.skeleton, limb.lengths_m, motion)
    F = field(limb.metaballs, limb.lengths_m, R, head, limb_skin(limb, motion).vertices_m)
    assert np.abs(F - 0.5).max() < 1e-9


@pytest.mark.parametrize("bend", [0.0, 120.0, 150.0])
def test_closed_and_outward(limb: BodyShape, bend: float) -> None:
    skin = limb_skin(limb, posture(limb, bend, 30.0))
    for polygons in (skin.faces, skin.triangles):
        edges = np.concatenate([polygons[:, [i, (i + 1) % polygons.shape[1]]] for i in range(polygons.shape[1])])
        there, back = set(map(tuple, edges.tolist())), set(map(tuple, edges[:, ::-1].tolist()))
        assert len(there) == len(edges) and there == back  # every edge once in each direction
    assert len(skin.vertices_m) - len(skin.triangles) // 2 == 2  # Euler: a sphere
    p = skin.vertices_m[skin.triangles]
    volume = np.einsum("ni,ni->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6
    assert volume > 1e-3 and np.array_equal(np.unique(skin.faces), np.arange(len(skin.vertices_m)))
    assert np.allclose(skin.weights.sum(axis=1), 1) and skin.weights.min() >= 0


@pytest.mark.slow
@pytest.mark.parametrize(("bend", "twist"), [(0.0, 90.0), (90.0, -60.0), (120.0, 0.0), (120.0, 80.0)])
def test_does_not_cut_itself(bend: float, twist: float) -> None:
    shape = default_shape(read_model("arm.R"))
    skin = limb_skin(shape, posture(shape, bend, twist))
    assert crossing_edges(skin.vertices_m, skin.triangles) == 0


def test_a_crossing_would_be_found() -> None:
    shape = default_shape(read_model("arm.R"))
    skin = limb_skin(shape, posture(shape, 0.0))
    bent = skin.vertices_m.copy()
    bent[400] += 3 * (skin.vertices_m[400 + 16] - bent[400])  # drawn through the other side
    assert crossing_edges(bent, skin.triangles) > 0


def crossing_edges(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """How many pairs of an edge and a triangle without a common vertex cross (Möller & Trumbore 1997)."""
    edges = np.unique(np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1), axis=0)
    count = 0
    a, ab, ac = vertices[triangles[:, 0]], *(vertices[triangles[:, i]] - vertices[triangles[:, 0]] for i in (1, 2))
    low, high = vertices[triangles].min(axis=1), vertices[triangles].max(axis=1)
    for part in np.array_split(edges, 20):
        p, q = vertices[part[:, 0]], vertices[part[:, 1]]
        near = ((np.minimum(p, q)[:, None] <= high) & (np.maximum(p, q)[:, None] >= low)).all(axis=2)
        near &= ~(triangles[None, :, :, None] == part[:, None, None, :]).any(axis=(2, 3))
        e, t = np.nonzero(near)
        d = q[e] - p[e]
        h = np.cross(d, ac[t])
        det = np.einsum("ni,ni->n", ab[t], h)
        s, det = p[e] - a[t], np.where(det == 0, np.inf, det)
        u = np.einsum("ni,ni->n", s, h) / det
        cross = np.cross(s, ab[t])
        v, w = np.einsum("ni,ni->n", d, cross) / det, np.einsum("ni,ni->n", ac[t], cross) / det
        count += int(np.sum((u > 0) & (v > 0) & (u + v < 1) & (w > 0) & (w < 1)))
    return count


def test_caps_reach_a_little_beyond_the_joints() -> None:
    shape = default_shape(read_model("arm.R"))
    motion = posture(shape, 40.0)
    skin, joints = limb_skin(shape, motion), joint_positions(shape.skeleton, shape.lengths_m, motion)
    for pole, joint, inner in ((0, "shoulder.R", "elbow.R"), (-1, "wrist.R", "elbow.R")):
        outward = (joints[joint] - joints[inner]) / np.linalg.norm(joints[joint] - joints[inner])
        beyond = (skin.vertices_m[pole] - joints[joint]) @ outward
        assert 0 < beyond < 0.03 and np.linalg.norm(skin.vertices_m[pole] - joints[joint] - beyond * outward) < 1e-9


def test_skin_follows_smoothly_and_the_limb_keeps_its_volume() -> None:
    shape = default_shape(read_model("arm.R"))
    skins = [limb_skin(shape, posture(shape, bend)).vertices_m for bend in np.arange(0.0, 120.0, 2.0)]
    steps = np.linalg.norm(np.diff(skins, axis=0), axis=2)
    assert steps.max() < 1.5 * np.radians(2.0) * (shape.lengths_m[1] + 0.05)  # nobody jumps: the farthest from the elbow turns about it
    rigid = np.linalg.norm(skins[0][:150] - skins[-1][:150], axis=1)
    assert rigid.max() < 2e-3  # the end at the shoulder does not care about the elbow


def test_a_rigid_motion_of_the_limb_moves_the_skin_rigidly() -> None:
    shape = default_shape(read_model("arm.R"))
    a, b = posture(shape, 50.0, 20.0), posture(shape, 50.0, 20.0)
    b[:6] += [0.3, 0.1, -0.2, 0.4, 0.5, -0.6]
    Ra, ha = bone_frames(shape.skeleton, shape.lengths_m, a)
    Rb, hb = bone_frames(shape.skeleton, shape.lengths_m, b)
    moved = (limb_skin(shape, a).vertices_m - ha[0]) @ (Rb[0] @ Ra[0].T).T + hb[0]
    assert np.abs(moved - limb_skin(shape, b).vertices_m).max() < 1e-9


def test_weak_metaballs_still_give_a_closed_skin_around_the_axis() -> None:
    shape = default_shape(read_model("arm.R"))
    balls = shape.metaballs
    thin = Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=balls.radii_m, weight=balls.weight * 0.4)
    weak = BodyShape(
        model=shape.model,
        skeleton=shape.skeleton,
        lengths_m=shape.lengths_m,
        metaballs=thin,
        length_sigma_m=shape.length_sigma_m,
        radius_sigma_m=shape.radius_sigma_m,
    )
    assert np.isfinite(limb_skin(weak, posture(shape, 30.0)).vertices_m).all()


def test_settings_and_wrong_bodies() -> None:
    shape = default_shape(read_model("arm.R"))
    skin = limb_skin(shape, posture(shape, 10.0), SkinSettings(contours=8, rays=12, cap_contours=3))
    assert len(skin.vertices_m) == 2 + 12 * (9 + 8 + 2 * 3) and skin.faces.shape[1] == 4
    assert skin.bone_names == ("upper_arm.R", "forearm.R")
    with pytest.raises(InputError, match="even number"):
        limb_skin(shape, posture(shape, 10.0), SkinSettings(rays=13))
