"""Head and feet of the skin: features where anatomy has them, closed, and the same topology for every person."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.closed_skin import OneSkin, flipped, one_skin
from tricap.core.body.skin.extremities import has_end, placement
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.foot_template import SOLE_MM, TOES, foot_template
from tricap.core.body.skin.foot_template import UNIT_MM as FOOT_MM
from tricap.core.body.skin.head_template import UNIT_MM as HEAD_MM
from tricap.core.body.skin.head_template import head_template
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.sculpture import Solid, cast_inwards
from tricap.core.body.skin.template import Template


@cache
def person() -> BodyShape:
    return shape_for_skin(default_shape(read_model("full")), SkinSettings())


@cache
def skin() -> OneSkin:
    return one_skin(person(), SkinSettings())


def bone(name: str) -> int:
    return [bone.name for bone in person().skeleton.bones].index(name)


def test_rays_stop_at_the_outermost_surface_and_hollows_are_left_out() -> None:
    directions = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    ball = Solid((0, 0, 0), (50, 40, 50), 1)
    found = cast_inwards([ball], np.zeros((2, 3)), directions, 120.0)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 50.0, atol=0.02)
    hollow = Solid((0, 0, 60), (20, 20, 20), 1, hollow=True)
    found = cast_inwards([ball, hollow], np.zeros((2, 3)), directions, 120.0)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), [50.0, 40.0], atol=0.3)
    pair = [ball, Solid((60, 0, 0), (15, 10), 1, end=(70, 0, 0), pair=True)]
    for side in (1.0, -1.0):
        assert cast_inwards(pair, np.zeros((1, 3)), directions[:1] * side, 120.0)[0, 0] == pytest.approx(80.0 * side, abs=0.02)


@pytest.mark.parametrize("template", [head_template(), foot_template()])
def test_templates_are_open_at_their_border_only(template: Template) -> None:
    edges = np.concatenate([template.faces[:, [i, (i + 1) % 4]] for i in range(4)]).tolist()
    assert sorted(a for a, b in edges if [b, a] not in edges) == list(range(template.ring))
    np.testing.assert_allclose(template.weights.sum(axis=1), 1.0)
    assert not template.own[: template.ring].any() and template.own.max() == 1.0
    assert template.uv.min() >= 0 and (template.uv.max(axis=(0, 1)) <= np.array(template.uv_size) + 1e-9).all()


def test_no_seam_is_left_where_a_template_begins() -> None:
    """Around the neck, the quads below the head's ended at other places of the texture than the head's began: a line of false colours."""
    edges = dict[tuple[int, int], list[np.ndarray]]()
    for quad, uv in zip(skin().faces.tolist(), skin().uv):
        for i, j in zip(range(4), (1, 2, 3, 0)):
            edges.setdefault((min(quad[i], quad[j]), max(quad[i], quad[j])), []).append(uv[[i, j]] if quad[i] < quad[j] else uv[[j, i]])
    neck = skin().weights[:, [skin().bone_names.index(name) for name in ("neck", "head")]].sum(axis=1) > 0.3
    apart = [found for edge, found in edges.items() if neck[list(edge)].all() and np.abs(found[0] - found[1]).max() > 1e-9]
    assert len(apart) > 50 and not [a for a, b in apart if np.ptp(np.concatenate([a, b])[:, 1]) < 1e-9 and np.abs(a - b).max() < 0.1]


def test_a_head_has_the_proportions_of_heads_and_two_equal_sides() -> None:
    v = HEAD_MM * head_template().vertices
    head = v[v[:, 1] > -55]
    assert 145 < np.ptp(head[np.abs(head[:, 1] - 95) < 20, 0]) < 158
    nose = head[np.argmax(head[:, 2])]
    assert abs(nose[0]) < 1 and 10 < nose[1] < 35  # between mouth and eyes
    brow, eyes = (head[(np.abs(head[:, 0]) < 42) & (np.abs(head[:, 0]) > 20) & (np.abs(head[:, 1] - y) < 4), 2].max() for y in (70, 54))
    assert brow - eyes > 3
    ears = head[np.abs(head[:, 0]) > 80]
    assert len(ears) > 8 and 10 < ears[:, 1].min() and ears[:, 1].max() < 80 and ears[:, 2].max() < 10
    from scipy.spatial import cKDTree

    assert cKDTree(v).query(v * [-1, 1, 1])[0].max() < 0.1


def test_a_mouth_is_no_muzzle() -> None:
    """Its depth falls evenly to the cheeks, without a step at its corners, and the chin is not far behind the lips."""
    v = HEAD_MM * head_template().vertices
    lips = v[(np.abs(v[:, 1] + 8) < 7) & (v[:, 2] > 20)]
    middle, corner, beside = (lips[np.abs(np.abs(lips[:, 0]) - x) < 4, 2].max() for x in (0, 24, 32))
    assert middle - corner > 5 and corner - beside < 8
    chin = v[(np.abs(v[:, 0]) < 5) & (np.abs(v[:, 1] + 41) < 8), 2].max()
    assert middle - chin < 14


def test_a_foot_has_a_heel_five_toes_on_the_floor_and_an_arch() -> None:
    foot = foot_template()
    v = FOOT_MM * foot.vertices
    assert 250 < np.ptp(v[v[:, 2] > 20, 1]) < 275 and v[:, 2].max() < SOLE_MM + 3
    tips = v[foot.weights[:, 1] == 1.0]
    assert len(TOES) == 5 and tips[:, 1].min() > 130
    under = v[(v[:, 2] > 40) & (np.abs(v[:, 1] - 55) < 25)]
    inner, outer = (under[under[:, 0] * side > 15, 2].max() for side in (1, -1))
    assert outer - inner > 3


@pytest.mark.slow
def test_a_whole_body_has_a_face_and_toes_and_no_flipped_quad() -> None:
    mesh = skin()
    edges = np.concatenate([mesh.faces[:, [i, (i + 1) % 4]] for i in range(4)])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert len(mesh.vertices_m) - len(edges) // 2 + len(mesh.faces) == 2
    assert not flipped(mesh.vertices_m, mesh.faces).any()
    assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    R, head = bone_frames(person().skeleton, person().lengths_m, np.zeros(len(person().skeleton.dofs)))
    for side in ("R", "L"):
        toes = mesh.vertices_m[mesh.weights[:, bone(f"toe.{side}")] > 0.9]
        assert len(toes) > 150
        local = (toes - head[bone(f"toe.{side}")]) @ R[bone(f"toe.{side}")]
        assert local[:, 1].max() < 1.25 * person().lengths_m[bone(f"toe.{side}")] and local[:, 1].min() > 0
    face = mesh.vertices_m[(mesh.weights[:, bone("head")] > 0.99) & (np.abs(mesh.vertices_m[:, 0]) < 0.005)]
    assert head[bone("head")][1] - face[:, 1].min() > 0.10  # the nose; persons face −Y


@pytest.mark.slow
def test_other_persons_have_the_same_topology_and_their_own_size() -> None:
    shape = default_shape(read_model("full"))
    head = [bone.name for bone in shape.skeleton.bones].index("head")
    radii = np.where((shape.metaballs.bone_index == head)[:, None], [1.15, 1.0, 1.0], 1.0) * shape.metaballs.radii_m
    wide = shape_for_skin(replace(shape, metaballs=replace(shape.metaballs, radii_m=radii)), SkinSettings())
    assert has_end(wide, head) and placement(wide, head).scale[0] > 1.05 * placement(person(), head).scale[0]
    other = one_skin(wide, SkinSettings())
    own = np.flatnonzero(skin().weights[:, head] > 0.999)
    theirs = np.flatnonzero(other.weights[:, head] > 0.999)
    assert len(own) == len(theirs)
    assert np.ptp(other.vertices_m[theirs, 0]) > 1.05 * np.ptp(skin().vertices_m[own, 0])
