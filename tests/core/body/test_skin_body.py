"""The skin of a whole body: closed parts, outside out, on one common surface where they meet."""

import numpy as np
import pytest

from tricap.core.body.metaballs import THRESHOLD, Metaballs, active_balls, field_and_derivatives
from tricap.core.body.model_file import model_names, read_model
from tricap.core.body.parts import body_parts
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.contour_skin import Skin, body_skin, limb_skin
from tricap.core.body.skin.rays import Rays
from tricap.core.body.skin.roots import part_root
from tricap.core.foundation.errors import InputError

from .whole_body import posture, whole_body

SEAM_DEG = 5.0
POSTURES = (
    {},
    dict(upper_arm_R_z=45, upper_arm_L_z=-45, thigh_R_x=60, shin_R_x=90),
    dict(upper_arm_R_x=80, forearm_R_x=100, upper_arm_L_z=40, spine_x=25, chest_z=20, head_x=20, thigh_L_x=40, shin_L_x=60),
)


def parts_of(skin: Skin) -> list[tuple[slice, np.ndarray]]:
    """Vertices and triangles (numbered from the part's first) of every part."""
    begin, found = 0, []
    for size in skin.part_sizes:
        own = ((skin.triangles >= begin) & (skin.triangles < begin + size)).all(axis=1)
        found.append((slice(begin, begin + size), skin.triangles[own] - begin))
        begin += size
    return found


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    p = vertices[triangles]
    return float(np.einsum("ni,ni->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6)


def test_chains_and_what_they_hang_on() -> None:
    shape = whole_body()
    names = [[shape.skeleton.bones[b].name for b in part.bones] for part in body_parts(shape)]
    assert names[0] == ["pelvis", "spine", "chest", "neck", "head"]
    assert names[1] == ["shoulder.R", "upper_arm.R", "forearm.R", "hand.R"] and names[2] == ["thigh.R", "shin.R", "foot.R"]
    assert [part.parent for part in body_parts(shape)] == [None, 0, 0, 0, 0]
    assert [shape.skeleton.bones[part.attachment].name for part in body_parts(shape)[1:3]] == ["chest", "pelvis"]


@pytest.mark.parametrize("angles", POSTURES)
def test_every_part_is_closed_and_faces_outwards(angles: dict[str, float]) -> None:
    shape = whole_body()
    skin = body_skin(shape, posture(shape, **angles))
    assert skin.vertices_m.shape == body_skin(shape, posture(shape)).vertices_m.shape
    for part, triangles in parts_of(skin):
        edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        there, back = set(map(tuple, edges.tolist())), set(map(tuple, edges[:, ::-1].tolist()))
        assert len(there) == len(edges) and there == back
        assert len(skin.vertices_m[part]) - len(triangles) // 2 == 2 and volume(skin.vertices_m[part], triangles) > 5e-4
    assert np.allclose(skin.weights.sum(axis=1), 1) and np.allclose(np.linalg.norm(skin.normals, axis=1), 1)


@pytest.mark.parametrize("angles", POSTURES)
def test_where_parts_meet_they_have_one_surface_without_a_seam(angles: dict[str, float]) -> None:
    """The limb's surface, looked for on the normals of the trunk's vertices: where both parts have one there, it is the same one."""
    shape = whole_body()
    motion = posture(shape, **angles)
    skin, parts = body_skin(shape, motion), body_parts(shape)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    trunk = parts_of(skin)[0][0]
    p, n = skin.vertices_m[trunk], skin.normals[trunk]
    angles_deg: list[float] = []
    for index in range(1, 5):
        for bone in parts[index].junction[:-1] or parts[index].junction:
            towards = Rays(
                origin=p - 0.02 * n, direction=n, reach=np.full(len(p), 0.04), bone=np.full(len(p), bone), station=np.zeros(len(p))
            )
            rho, normals = part_root(shape, parts, index, R, head, towards)
            beside = np.abs((p - head[bone]) @ R[bone, :, 1] - shape.lengths_m[bone] / 2) < 0.6 * shape.lengths_m[bone]
            both = beside & (np.abs(rho - 0.02) < 1e-4)
            angle = np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", n, normals)[both], -1, 1)))
            angles_deg += angle.tolist()
    assert len(angles_deg) > 20
    assert max(angles_deg) < SEAM_DEG  # promised; measured: 1.0°


def test_no_collar_where_the_neck_passes_to_the_head() -> None:
    """The chest's balls reach a short neck's end: where its field gave way to the head's at once, the nape had an edge of 18°."""
    shape = default_shape(read_model("full"))
    rest = np.zeros(len(shape.skeleton.dof_names))
    skin = body_skin(shape, rest)
    joint = bone_frames(shape.skeleton, shape.lengths_m, rest)[1][[bone.name for bone in shape.skeleton.bones].index("head")]
    along = np.diff(skin.vertices_m[1 : skin.part_sizes[0] - 1].reshape(-1, skin.rays, 3), axis=0)
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    turns = np.degrees(np.arccos(np.clip(np.einsum("rnk,rnk->rn", along[1:], along[:-1]), -1, 1)))
    rings = skin.vertices_m[1 : skin.part_sizes[0] - 1].reshape(-1, skin.rays, 3)[1:-1].mean(axis=1)
    beside = np.abs(rings[:, 2] - joint[2]) < 0.03
    assert beside.sum() > 5 and turns[beside].max() < 12  # measured 10.9°


def test_chest_and_pelvis_are_as_thick_as_fitted() -> None:
    """Balls that a trunk and its limbs both count are counted once; when they were counted twice, chest and pelvis were 8 mm too thick."""
    shape = default_shape(read_model("full"))
    rest = np.zeros(len(shape.skeleton.dof_names))
    R, head = bone_frames(shape.skeleton, shape.lengths_m, rest)
    skin, names = body_skin(shape, rest), [bone.name for bone in shape.skeleton.bones]
    trunk = skin.vertices_m[: skin.part_sizes[0]]
    for name, least in (("chest", 60), ("pelvis", 20)):
        b = names.index(name)
        along = (trunk - head[b]) @ R[b, :, 1] / shape.lengths_m[b]
        own = trunk[(np.abs(along - 0.5) < 0.3) & (np.abs(trunk[:, 0]) < 0.06)]
        active = active_balls(shape.metaballs, shape.skeleton.neighbours, b)
        every = np.broadcast_to(active, (len(own), len(active)))
        F, slope, *_ = field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, own, every)
        off = np.abs(F - THRESHOLD) / np.linalg.norm(slope, axis=1)
        assert len(own) > least and np.median(off) < 2e-3, name


@pytest.mark.parametrize("model", [name for name in model_names() if name.startswith(("arm", "leg"))])
def test_a_limb_has_the_limbs_skin(model: str) -> None:
    shape = default_shape(read_model(model))
    motion = np.linspace(-0.3, 0.8, len(shape.skeleton.dof_names))
    a, b = body_skin(shape, motion), limb_skin(shape, motion)
    assert np.array_equal(a.vertices_m, b.vertices_m) and np.array_equal(a.faces, b.faces) and np.array_equal(a.weights, b.weights)


@pytest.mark.parametrize("model", model_names())
def test_every_model_has_a_skin(model: str) -> None:
    shape = default_shape(read_model(model))
    skin = body_skin(shape, np.zeros(len(shape.skeleton.dof_names)))
    assert np.isfinite(skin.vertices_m).all() and sum(volume(skin.vertices_m[p], t) for p, t in parts_of(skin)) > 1e-3


def test_a_rigid_motion_moves_the_skin_rigidly_and_far_parts_do_not_care() -> None:
    shape = whole_body()
    rest, moved = posture(shape), posture(shape)
    moved[:3] += 0.3, -0.1, 0.2
    a = body_skin(shape, rest)
    assert np.abs(body_skin(shape, moved).vertices_m - a.vertices_m - [0.3, -0.1, 0.2]).max() < 1e-9
    kick = body_skin(shape, posture(shape, shin_L_x=80))
    arm = parts_of(a)[1][0]
    assert np.abs(kick.vertices_m[arm] - a.vertices_m[arm]).max() < 1e-12


def test_the_mirrored_body_has_the_mirrored_skin() -> None:
    shape = whole_body()
    motion = posture(shape)
    motion[0] = 0.0
    skin = body_skin(shape, motion)
    parts = [skin.vertices_m[part] for part, _ in parts_of(skin)]
    for right, left in ((1, 3), (2, 4)):
        mirrored = parts[right] * [-1, 1, 1]
        nearest = np.linalg.norm(mirrored[:, None] - parts[left][None], axis=2).min(axis=1)
        assert nearest.max() < 1e-6


def test_a_body_without_flesh_is_told() -> None:
    shape = whole_body()
    none = Metaballs(bone_index=np.zeros(0, dtype=int), centre=np.zeros((0, 3)), radii_m=np.zeros((0, 3)), weight=np.zeros(0))
    bare = BodyShape(
        model="bare",
        skeleton=shape.skeleton,
        lengths_m=shape.lengths_m,
        metaballs=none,
        length_sigma_m=shape.length_sigma_m,
        radius_sigma_m=np.zeros((0, 3)),
    )
    with pytest.raises(InputError, match="no metaballs"):
        body_skin(bare, posture(shape))
    with pytest.raises(InputError, match="no single chain"):
        limb_skin(shape, posture(shape))
