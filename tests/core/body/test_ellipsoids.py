"""Metaballs as ellipsoids: each alone is the surface of its field."""

import numpy as np

from tricap.core.body.anatomy import FLESH, KINDS
from tricap.core.body.ellipsoids import ellipsoids
from tricap.core.body.metaballs import THRESHOLD, local_points, squared_distances
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames


def test_an_ellipsoid_is_where_its_field_alone_is_the_threshold() -> None:
    shape = default_shape(read_model("full"))
    motion = 0.3 * np.sin(np.arange(len(shape.skeleton.dofs)))
    found = ellipsoids(shape, motion)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    d = squared_distances(shape.metaballs, shape.lengths_m, local_points(R, head, found.vertices_m))[1]
    alone = shape.metaballs.weight[found.ball] * np.exp(-2 * d[np.arange(len(d)), found.ball])
    assert np.allclose(alone, THRESHOLD, atol=1e-9)
    assert [KINDS[k] for k in np.unique(found.kind)] == [FLESH]
    a, b, c = (found.vertices_m[found.triangles[:, k]] for k in range(3))
    middle = np.array([found.vertices_m[found.ball == m].mean(axis=0) for m in range(len(shape.metaballs.weight))])
    assert (np.einsum("ni,ni->n", np.cross(b - a, c - a), (a + b + c) / 3 - middle[found.ball[found.triangles[:, 0]]]) > 0).all(), "outward"
