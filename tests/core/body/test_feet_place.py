"""The feet of a skin lie where points measured them: turned, smaller, beside the other."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.closed_skin import OneSkin
from tricap.core.body.skin.feet_place import with_feet_in_place
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import rest_skin
from tricap.core.body.skin.posed import Poser
from tricap.core.body.skin.relief import SurfacePoints
from tricap.core.body.skin.surface_operators import vertex_normals
from tricap.core.geometry.rotation import rotation_from_vector

OUT, SMALLER = np.radians(8.0), 0.95
FRAMES = 8


@lru_cache
def person() -> tuple[BodyShape, OneSkin]:
    shape = shape_for_skin(default_shape(read_model("full")), SkinSettings())
    return shape, rest_skin(shape, SkinSettings())


def foot_of(side: str) -> np.ndarray:
    """(V,) to what degree a vertex is a foot's."""
    shape, skin = person()
    names = [bone.name for bone in shape.skeleton.bones]
    return np.asarray(skin.weights[:, [names.index(f"{part}.{side}") for part in ("foot", "toe")]].sum(axis=1))


def true_vertices(sides: str = "RL") -> np.ndarray:
    """Those of a person whose feet are turned outwards about the ankle, and smaller."""
    shape, skin = person()
    names = [bone.name for bone in shape.skeleton.bones]
    heads, found = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))[1], skin.vertices_m
    for side in sides:
        about = heads[names.index(f"foot.{side}")]
        turn = rotation_from_vector(np.array([0.0, 0.0, OUT if side == "L" else -OUT]))
        found = found + foot_of(side)[:, None] * ((found - about) @ turn.T * SMALLER + about - found)
    return found


def measured(vertices: np.ndarray, sides: str = "RL") -> list[SurfacePoints]:
    """Points of the outer sides and the tops of feet, in some poses."""
    shape, skin = person()
    poser, rng, frames = Poser(shape, skin.weights), np.random.default_rng(3), []
    own = np.max([foot_of(side) for side in sides], axis=0) > 0.5
    for k in range(FRAMES):
        motion = np.zeros(len(shape.skeleton.dofs))
        for side in "RL":
            motion[shape.skeleton.layout[f"knee.{side} flexion"]] = 0.1 * k
            motion[shape.skeleton.layout[f"ankle.{side} flexion"]] = 0.05 * k
        posed = poser.posed(vertices, motion)
        normals = vertex_normals(posed, skin.faces)
        seen = np.flatnonzero(own & (normals @ np.array([0.5, -0.7, 0.5]) > 0.2))
        noise = rng.normal(0, 0.0005, len(seen))
        points = posed[seen] + noise[:, None] * normals[seen]
        frames.append(SurfacePoints(motion=motion, xyz_m=points, normals=normals[seen], sigma_m=np.full(len(seen), 0.0005)))
    return frames


def off_mm(skin: OneSkin, wanted: np.ndarray, side: str) -> float:
    """How far a foot's vertices are from the surface on which they lie, in the mean, also where nothing was measured."""
    from scipy.spatial import cKDTree

    own = foot_of(side) > 0.9
    normals = vertex_normals(wanted, skin.faces)
    near = cKDTree(wanted).query(skin.vertices_m[own])[1]
    return float(1e3 * np.abs(np.einsum("nk,nk->n", skin.vertices_m[own] - wanted[near], normals[near])).mean())


@pytest.mark.slow
def test_feet_are_turned_and_scaled_as_measured() -> None:
    shape, skin = person()
    wanted = true_vertices()
    placed = with_feet_in_place(skin, shape, measured(wanted))
    for side in "RL":
        before, now = off_mm(skin, wanted, side), off_mm(placed, wanted, side)
        assert before > 5 and now < 3
    rest = (foot_of("R") + foot_of("L")) == 0
    far = rest & (np.abs(skin.vertices_m[:, 2] - skin.vertices_m[:, 2].min()) > 0.35)
    np.testing.assert_allclose(placed.vertices_m[far], skin.vertices_m[far], atol=1e-4, err_msg="nothing else moves")


def test_a_foot_that_was_not_measured_follows_the_other_one() -> None:
    shape, skin = person()
    wanted = true_vertices()
    placed = with_feet_in_place(skin, shape, measured(wanted, "R"))
    right, left = off_mm(placed, wanted, "R"), off_mm(placed, wanted, "L")
    assert right < 3 and left < 3


@pytest.mark.parametrize("left", [0, 20])
def test_without_points_the_feet_stay(left: int) -> None:
    shape, skin = person()
    frames = [
        replace(frame, xyz_m=frame.xyz_m[:left], normals=frame.normals[:left], sigma_m=frame.sigma_m[:left])
        for frame in measured(true_vertices())
    ]
    assert with_feet_in_place(skin, shape, frames) is skin
    assert with_feet_in_place(skin, shape, []) is skin
