"""B-spline patches: through the samples, on the implicit surface, without a fold; and by how much the approximating ones shrink."""

import numpy as np
import pytest

from tricap.core.body.metaballs import field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.contour_skin import SkinSettings, limb_skin
from tricap.core.body.skin.mesh import APPROXIMATING, control_net, corner_uv, refined, shrinkage

from .test_skin import crossing_edges

RMS_M = 0.1e-3  # measured 0.024 (straight) … 0.058 mm (140°) at 32 points a ring; 0.3 mm wanted
NORMAL_DEG = 6.0  # 99 % of the vertices; measured 1.3° straight, 4.6° at 140°


def posture(shape: BodyShape, bend_deg: float) -> np.ndarray:
    motion = np.zeros(len(shape.skeleton.dof_names))
    motion[6:8] = np.radians(bend_deg), 0.5
    return motion


@pytest.mark.parametrize("model", ["arm.R", "leg.R"])
@pytest.mark.parametrize("bend", [0.0, 70.0, 120.0, 140.0])
def test_on_the_surface_without_fold_or_crossing(model: str, bend: float) -> None:
    shape = default_shape(read_model(model))
    motion = posture(shape, bend)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    fine = refined(limb_skin(shape, motion), 3)
    F, gradient, _, _ = field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, fine.vertices_m)
    steepness = np.linalg.norm(gradient, axis=1)
    assert np.sqrt((((F - 0.5) / steepness) ** 2).mean()) < RMS_M
    outward = -gradient / steepness[:, None]
    angle = np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", outward, fine.normals), -1, 1)))
    assert np.percentile(angle, 99) < NORMAL_DEG
    p = fine.vertices_m[fine.faces]
    across = np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    assert (np.einsum("fk,fk->f", across, outward[fine.faces].mean(axis=1)) > 0).all()  # no face is flipped


@pytest.mark.slow
@pytest.mark.parametrize("bend", [140.0, 110.0, 0.0])
def test_the_patches_do_not_cut_themselves(bend: float) -> None:
    shape = default_shape(read_model("arm.R"))
    fine = refined(limb_skin(shape, posture(shape, bend), SkinSettings(contours=10, rays=24, cap_contours=3)), 2)
    assert crossing_edges(fine.vertices_m, fine.triangles) == 0


def test_no_jump_of_the_normal_at_the_joints_ring() -> None:
    """The ring of the elbow belongs to both bones' patches: faces on both sides of it differ by their curvature alone."""
    shape = default_shape(read_model("arm.R"))
    for bend in (0.0, 70.0, 120.0):
        skin, detail = limb_skin(shape, posture(shape, bend)), 8
        fine = refined(skin, detail)
        ring = (5 + 1 + 14) * detail  # cap, the bone's first contour, its 14 others
        grid = fine.normals[1:-1].reshape(-1, fine.rays, 3)
        steps = np.degrees(np.arccos(np.clip(np.einsum("rnk,rnk->rn", grid[:-1], grid[1:]), -1, 1)))
        jump, nearby = steps[ring - 2 : ring], steps[ring - 12 : ring + 10]
        assert jump.max() <= nearby.max()  # measured 3.0° at 0°: no more than the surface turns in any such step
        assert bend > 100 or jump.max() < 5.0


def test_interpolating_passes_through_the_samples_and_keeps_the_topology() -> None:
    shape = default_shape(read_model("arm.R"))
    skin = limb_skin(shape, posture(shape, 50.0))
    same = refined(skin, 1)
    assert np.abs(same.vertices_m - skin.vertices_m).max() < 1e-12 and np.array_equal(same.faces, skin.faces)
    fine = refined(skin, 2)
    assert np.abs(fine.vertices_m[1:-1].reshape(-1, 64, 3)[1::2, ::2] - skin.vertices_m[1:-1].reshape(-1, 32, 3)).max() < 1e-12
    assert len(fine.vertices_m) - len(fine.triangles) // 2 == 2 and np.allclose(fine.weights.sum(axis=1), 1)
    asked = limb_skin(shape, posture(shape, 50.0), SkinSettings(detail=2))
    assert np.array_equal(asked.vertices_m, fine.vertices_m)


@pytest.mark.parametrize(("rays", "stated"), [(16, 0.0254), (24, 0.0114), (32, 0.0064)])
def test_shrinkage_of_the_approximating_variant(rays: int, stated: float) -> None:
    assert shrinkage(rays) == pytest.approx(stated, abs=5e-5)
    circle = np.exp(2j * np.pi * np.arange(rays) / rays)
    ring = np.stack([circle.real, circle.imag, 0 * circle.real], axis=-1)
    net = np.broadcast_to(ring, (8, rays, 3))  # a cylinder
    shape = default_shape(read_model("arm.R"))
    literal = limb_skin(shape, posture(shape, 0.0), SkinSettings(rays=rays, patches=APPROXIMATING))
    exact = limb_skin(shape, posture(shape, 0.0), SkinSettings(rays=rays))
    R, head = bone_frames(shape.skeleton, shape.lengths_m, posture(shape, 0.0))
    radius = [np.linalg.norm(np.cross(s.vertices_m - head[0], R[0, :, 1]), axis=1)[1 + rays * 12 : 1 + rays * 13] for s in (literal, exact)]
    assert 1 - (radius[0] / radius[1]).mean() == pytest.approx(shrinkage(rays), rel=0.35)  # along the bone it smooths a little, too
    np.testing.assert_allclose(np.linalg.norm(control_net(net), axis=-1), 1 / (1 - shrinkage(rays)), rtol=1e-12)


def test_texture_coordinates_unroll_every_part() -> None:
    shape = default_shape(read_model("arm.R"))
    skin = limb_skin(shape, posture(shape, 0.0))
    uv = corner_uv(skin)
    assert uv.shape == (len(skin.faces), 4, 2) and uv.min() >= 0 and uv.max() <= 1
    area = 0.5 * np.cross(np.pad(uv[:, 2] - uv[:, 0], ((0, 0), (0, 1))), np.pad(uv[:, 3] - uv[:, 1], ((0, 0), (0, 1))))[:, 2]
    assert (area > 0).all()  # one way up, none folded
    assert np.ptp(uv[..., 0], axis=1).max() < 3 / skin.rays


def test_wrong_arguments() -> None:
    shape = default_shape(read_model("arm.R"))
    skin = limb_skin(shape, posture(shape, 0.0))
    with pytest.raises(ValueError, match="detail 0"):
        refined(skin, 0)
