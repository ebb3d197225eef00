"""The zero of the head's angles and its joint: nothing moves in the frames, and the bone has the face's axes and begins at the joint."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.motion import FITTED, SEEN, BodyFit, BodyMotion
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames, joint_positions
from tricap.core.body.skin.closed_skin import OneSkin
from tricap.core.body.skin.facing import SIGMA, Facing, facing_ahead
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.head_place import LEVEL, MOST_TURN, registered_head
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import rest_skin
from tricap.core.body.skin.posed import Poser
from tricap.core.body.skin.relief import Nearby, SurfacePoints, measured_relief
from tricap.core.body.skin.surface_operators import vertex_normals
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import rotation_from_vector, vector_from_rotation

TURN = np.radians([-15.0, 9.0, 4.0])
FACING = Facing(turn=TURN, joint_m=np.array([0.01, -0.04, 0.015]), crown_m=np.array([0.0, 0.14, 0.0]))


def _fit(model: str, frames: int = 3) -> BodyFit:
    shape, rng = default_shape(read_model(model)), np.random.default_rng(0)
    skeleton, names = shape.skeleton, shape.skeleton.joint_names
    values = rng.normal(0, 0.3, (frames, len(skeleton.dofs)))
    joints = joint_positions(skeleton, shape.lengths_m, values)
    known = np.zeros((frames, len(names)))
    motion = BodyMotion(
        frames=np.arange(frames),
        time_s=np.arange(frames) / 25,
        dof_names=skeleton.dof_names,
        values=values,
        covariance=np.zeros((frames, values.shape[1], values.shape[1])),
        joint_names=names,
        joints_m=np.stack([joints[name] for name in names], axis=1),
        joint_sigma_m=known,
        joint_frame_sigma_m=known,
        known=((SEEN,) * len(names),) * frames,
        status=(FITTED,) * frames,
        sigma0=np.ones(frames),
    )
    return BodyFit(shape=shape, motion=motion, iterations=1, converged=True, points=known, outline_m=np.zeros(0))


def _skin_of_one_quad(shape: BodyShape, bone: str) -> OneSkin:
    names = tuple(b.name for b in shape.skeleton.bones)
    weights = np.tile(np.array(names) == bone, (4, 1)).astype(float)
    at = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))[1][names.index(bone)]
    corners = at + 0.1 * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    return OneSkin(
        vertices_m=corners, faces=np.arange(4)[None], uv=np.zeros((1, 4, 2)), weights=weights, part=np.zeros(4), bone_names=names
    )


def _balls_m(shape: BodyShape, values: np.ndarray) -> np.ndarray:
    R, head = bone_frames(shape.skeleton, shape.lengths_m, values)
    b = shape.metaballs.bone_index
    return np.einsum("tmij,mj->tmi", R[:, b], shape.metaballs.centres_m(shape.lengths_m)) + head[:, b]


def test_the_bone_turns_and_nothing_moves() -> None:
    body = _fit("full")
    shape = body.shape
    skin = _skin_of_one_quad(shape, "head")
    moved, ahead, carrying = facing_ahead(body, skin, shape, FACING, {"head"})  # a clicked joint stays
    head = [bone.name for bone in shape.skeleton.bones].index("head")
    before, after = (bone_frames(shape.skeleton, shape.lengths_m, m.motion.values)[0] for m in (body, moved))
    np.testing.assert_allclose(after[:, head], before[:, head] @ rotation_from_vector(TURN), atol=1e-12)
    np.testing.assert_array_equal(np.delete(after, head, axis=1), np.delete(before, head, axis=1))
    np.testing.assert_allclose(_balls_m(moved.shape, moved.motion.values), _balls_m(shape, body.motion.values), atol=1e-12)
    assert np.abs(ahead.vertices_m - skin.vertices_m).max() > 0.01  # the rest pose looks elsewhere
    for old, new in zip(body.motion.values, moved.motion.values):
        np.testing.assert_allclose(
            Poser(carrying, ahead.weights).posed(ahead.vertices_m, new), Poser(shape, skin.weights).posed(skin.vertices_m, old), atol=1e-12
        )
    others = [name != "crown" for name in body.motion.joint_names]
    np.testing.assert_array_equal(moved.motion.joints_m[:, others], body.motion.joints_m[:, others])
    crown = joint_positions(shape.skeleton, shape.lengths_m, moved.motion.values)["crown"]
    np.testing.assert_allclose(moved.motion.joints_m[:, body.motion.joint_names.index("crown")], crown, atol=1e-12)
    assert np.isclose(moved.motion.sigma, SIGMA).any(axis=0).sum() == 3


@pytest.mark.parametrize(("stiff", "within_m"), [(True, 1e-9), (False, 0.02)])
def test_the_joint_moves_and_nothing_else_does(stiff: bool, within_m: float) -> None:
    """The neck has another length, the same in all frames: where the head nods, its place is a compromise along the neck."""
    body = _fit("full", 5)
    shape, values = body.shape, body.motion.values.copy()
    names = [bone.name for bone in shape.skeleton.bones]
    head, neck = names.index("head"), names.index("neck")
    if stiff:
        for b in (head, neck):
            values[:, shape.skeleton.dof_bone == b] = 0.1
    body = replace(body, motion=replace(body.motion, values=values))
    skin = _skin_of_one_quad(shape, "head")
    moved, rest, carrying = facing_ahead(body, skin, shape, FACING)
    (R, at), (R_now, now) = (bone_frames(m.shape.skeleton, m.shape.lengths_m, m.motion.values) for m in (body, moved))
    np.testing.assert_allclose(now[:, head], at[:, head] + R[:, head] @ FACING.joint_m, atol=within_m)
    np.testing.assert_allclose(R_now[:, head], R[:, head] @ rotation_from_vector(TURN), atol=1e-9)
    np.testing.assert_allclose(np.delete(now, head, axis=1), np.delete(at, head, axis=1), atol=1e-12)
    np.testing.assert_allclose(_balls_m(moved.shape, moved.motion.values), _balls_m(shape, values), atol=max(within_m, 0.003))
    for old, new in zip(values, moved.motion.values):
        before = Poser(shape, skin.weights).posed(skin.vertices_m, old)
        np.testing.assert_allclose(Poser(carrying, rest.weights).posed(rest.vertices_m, new), before, atol=within_m)
    places = joint_positions(moved.shape.skeleton, moved.shape.lengths_m, moved.motion.values)
    for joint in ("head", "crown"):
        np.testing.assert_allclose(moved.motion.joints_m[:, moved.motion.joint_names.index(joint)], places[joint], atol=1e-12)
    crown = at[:, head] + R[:, head] @ FACING.crown_m
    beyond = np.einsum("ti,ti->t", places["crown"] - crown, R_now[:, head, :, 1])
    np.testing.assert_allclose(beyond, 0.0, atol=within_m)  # as far as the crown, in the face's axes


def test_a_body_without_a_head_stays() -> None:
    body = _fit("arm.R")
    skin = _skin_of_one_quad(body.shape, "forearm.R")
    assert facing_ahead(body, skin, body.shape, FACING) == (body, skin, body.shape)


@pytest.fixture(scope="module")
def person() -> tuple[BodyShape, OneSkin]:
    settings = SkinSettings()
    shape = shape_for_skin(default_shape(read_model("full")), settings)
    return shape, rest_skin(shape, settings)


def _points(shape: BodyShape, skin: OneSkin, turn: np.ndarray) -> list[SurfacePoints]:
    """The front of the head's vertices, turned about their middle."""
    b, Q = skin.bone_names.index("head"), rotation_from_vector(turn)
    R = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))[0][b]
    own = skin.weights[:, b] > 0.9
    x, n = skin.vertices_m[own] @ R, vertex_normals(skin.vertices_m, skin.faces)[own] @ R
    middle = x.mean(axis=0)
    x, n = (x - middle) @ Q.T + middle, n @ Q.T
    seen = n[:, 2] > -0.3
    one = SurfacePoints(
        motion=np.zeros(len(shape.skeleton.dofs)), xyz_m=x[seen] @ R.T, normals=n[seen] @ R.T, sigma_m=np.full(seen.sum(), 1e-3)
    )
    return [one] * 24


@pytest.mark.slow
def test_a_face_tells_where_the_head_looks(person) -> None:
    shape, skin = person
    turn = np.radians([-24.0, 12.0, 3.0])
    expected = vector_from_rotation(rotation_from_vector(turn) @ rotation_from_vector(LEVEL))
    np.testing.assert_allclose(
        np.degrees(registered_head(skin, shape, _points(shape, skin, turn)).facing.turn), np.degrees(expected), atol=2.0
    )


def _few_points(shape: BodyShape, skin: OneSkin, turn_deg: tuple[float, float, float]) -> list[SurfacePoints]:
    """As many as a take shows: some thousands, of all frames together."""
    frames = _points(shape, skin, np.radians(turn_deg))
    return [replace(p, xyz_m=p.xyz_m[i::24], normals=p.normals[i::24], sigma_m=p.sigma_m[i::24]) for i, p in enumerate(frames)]


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", [(25.0, 0.0, 0.0), (20.0, -35.0, 5.0)])
def test_a_bowed_and_turned_face_is_found_where_the_fit_has_none(person, turn_deg: tuple[float, float, float]) -> None:
    """The search began at one place alone: the head of somebody who looked down became a third too large, its face on the forehead."""
    shape, skin = person
    place = registered_head(skin, shape, _few_points(shape, skin, turn_deg))
    assert place.found
    np.testing.assert_allclose(np.degrees(place.p[3:6]), turn_deg, atol=3.0)
    assert np.abs(place.p[6:]).max() < 0.03 and place.facing is not None


@pytest.mark.slow
def test_a_face_that_is_where_the_fit_has_it_is_not_looked_for(person) -> None:
    shape, skin = person
    assert not registered_head(skin, shape, _few_points(shape, skin, (-24.0, 12.0, 3.0))).found


def _egg_on_a_neck(shape: BodyShape, skin: OneSkin, rng: np.random.Generator) -> SurfacePoints:
    """Points of a head without a face, and of what is below it."""
    b = skin.bone_names.index("head")
    R, head = (a[b] for a in bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs))))
    own = ((skin.vertices_m - head) @ R)[skin.weights[:, b] > 0.5]
    half, chin_m = np.ptp(own, axis=0) / 2 * [0.95, 0.95, 0.85], own[:, 1].min()
    out = rng.normal(size=(400, 3))
    out /= np.linalg.norm(out, axis=1)[:, None]
    out = out[(out[:, 2] > -0.2) & (out[:, 1] > -0.8)]
    normals = out / half / np.linalg.norm(out / half, axis=1)[:, None]
    angle, y = rng.uniform(-1.8, 1.8, 160), rng.uniform(chin_m - 0.11, chin_m + 0.02, 160)
    around = np.stack([np.sin(angle), np.zeros(160), np.cos(angle)], axis=1)
    neck = 0.06 * around + np.stack([np.zeros(160), y, np.full(160, -0.01)], axis=1)
    xyz, normals = np.concatenate([own.mean(axis=0) + out * half, neck]), np.concatenate([normals, around])
    rest = np.zeros(len(shape.skeleton.dofs))
    return SurfacePoints(motion=rest, xyz_m=xyz @ R.T + head, normals=normals @ R.T, sigma_m=np.full(len(xyz), 1e-3))


@pytest.mark.slow
def test_a_head_is_not_pushed_over_the_neck_where_no_face_shows(person) -> None:
    """No point was left without a vertex then, but the others fitted worse: the head of the demo's person looked aside by 42°."""
    shape, skin = person
    rng = np.random.default_rng(0)
    place = registered_head(skin, shape, [_egg_on_a_neck(shape, skin, rng) for _ in range(12)])
    assert not place.found and abs(place.p[1]) < 0.02


@pytest.mark.slow
def test_points_that_do_not_show_the_face_tell_nothing(person) -> None:
    shape, skin = person
    assert registered_head(skin, shape, []) is None
    few = [replace(p, xyz_m=p.xyz_m[:5], normals=p.normals[:5], sigma_m=p.sigma_m[:5]) for p in _points(shape, skin, TURN)]
    assert registered_head(skin, shape, few) is None
    aside = np.array([-0.4, 1.3 * MOST_TURN, 0.0])  # further than a fit is wrong
    assert registered_head(skin, shape, _points(shape, skin, aside)).facing is None


@pytest.mark.slow
def test_a_face_is_not_flattened_by_patches_that_smooth_it(person) -> None:
    shape, skin = person
    smooth = replace(skin, vertices_m=Nearby(skin.vertices_m, skin.faces, 0.007).mean(skin.vertices_m))
    seen = _points(shape, smooth, np.zeros(3))[:4]
    exact, as_patches = (
        np.abs(measured_relief(skin, shape, [replace(p, patch_m=side) for p in seen], False, Monitor()).displacement_m)
        for side in (0.0, 0.05)
    )
    face = exact > np.quantile(exact, 0.99)  # nose, mouth and ears
    assert exact[face].min() > 0.003 and np.median(as_patches[face]) < 0.0005
