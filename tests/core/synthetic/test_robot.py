"""The robot: bones, closed solids, and both sides alike."""

import numpy as np

from tricap.core.synthetic.robot import BONES, robot


def test_every_bone_has_flesh_and_a_parent_of_its_side() -> None:
    found = robot()
    names = found.rig.names
    assert set(found.bone.tolist()) == set(range(len(names))) and len(names) == 2 * len(BONES) - 5
    for name, parent in zip(names, found.rig.parents.tolist()):
        assert parent < 0 or names[parent][-2:] not in (".L", ".R") or names[parent][-2:] == name[-2:]


def test_the_solids_are_closed_and_face_outwards() -> None:
    found = robot()
    corners = found.vertices_m[found.faces]
    edges = np.concatenate([found.faces[:, [k, (k + 1) % 4]] for k in range(4)])
    there, back = ({tuple(edge) for edge in e.tolist()} for e in (edges, edges[:, ::-1]))
    assert len(there) == len(edges) and there == back
    for bone in range(len(found.rig.names)):
        own = corners[found.bone[found.faces[:, 0]] == bone]
        across = np.cross(own[:, 2] - own[:, 0], own[:, 3] - own[:, 1])
        assert np.einsum("fi,fi->", own.mean(axis=1), across) > 0, "a positive volume"


def test_left_and_right_mirror_each_other_on_the_floor() -> None:
    found = robot()
    assert abs(found.vertices_m[:, 2].min()) < 1e-9
    left, right = (found.vertices_m[[found.rig.names[b].endswith(side) for b in found.bone]] for side in (".L", ".R"))
    assert (left[:, 0] > -0.03).all() and np.allclose(np.sort(left[:, 0]), np.sort(-right[:, 0]))
