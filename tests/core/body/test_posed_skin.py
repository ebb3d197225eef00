"""The skin that follows the bones, compared with the one that is cast in each pose."""

import numpy as np
import pytest

from tricap.core.body.skin.contour_skin import SkinSettings, body_skin
from tricap.core.body.skin.posed import PosedSkin, skins_in
from tricap.core.synthetic.truth import closest_on_mesh

from .whole_body import posture, whole_body

SHAPE = whole_body()
WALK = np.stack([posture(SHAPE, thigh_L_x=s * 30, thigh_R_x=-s * 30, shin_L_x=20 + 20 * s, forearm_R_x=30 - 20 * s) for s in (-1, 0, 1)])


def test_the_middle_pose_is_the_cast_skin() -> None:
    cast, posed = body_skin(SHAPE, np.median(WALK, axis=0)), PosedSkin(SHAPE, WALK).at(np.median(WALK, axis=0))
    assert np.abs(posed.vertices_m - cast.vertices_m).max() < 1e-12 and np.abs(posed.normals - cast.normals).max() < 1e-12
    assert (posed.faces == cast.faces).all() and posed.part_sizes == cast.part_sizes


def test_a_rigid_motion_moves_the_skin_rigidly() -> None:
    """Also by half a turn and more, where the signs of quaternions change."""
    turned = WALK[1].copy()
    names = list(SHAPE.skeleton.dof_names)
    moves = {name: value for name, value in zip(names[:6], (0.4, -2.0, 0.3, 0.0, 0.0, 3.5))}
    for name, value in moves.items():
        turned[names.index(name)] += value
    posed, cast = PosedSkin(SHAPE, WALK).at(turned), body_skin(SHAPE, turned)
    assert np.abs(posed.vertices_m - cast.vertices_m).max() < 1e-6
    assert np.quantile(np.abs(posed.normals - cast.normals), 0.999) < 1e-6  # in a crease the last digits choose the side


def test_a_walk_stays_close_to_the_cast_skin() -> None:
    """Measured: half within 0.1 mm, 95 % within 4 mm."""
    skin_at = skins_in(SHAPE, WALK, SkinSettings())
    for pose in WALK[[0, 2]]:
        cast = body_skin(SHAPE, pose)
        distance = closest_on_mesh(cast.vertices_m, cast.triangles, skin_at(pose).vertices_m)[0]
        assert np.quantile(distance, 0.5) < 3e-4 and np.quantile(distance, 0.95) < 6e-3


def test_exact_skins_are_cast() -> None:
    settings = SkinSettings(exact=True, rays=16)
    assert (skins_in(SHAPE, WALK, settings)(WALK[0]).vertices_m == body_skin(SHAPE, WALK[0], settings).vertices_m).all()


@pytest.mark.parametrize("pose", WALK)
def test_normals_have_length_one(pose: np.ndarray) -> None:
    assert np.allclose(np.linalg.norm(PosedSkin(SHAPE, WALK).at(pose).normals, axis=1), 1)
