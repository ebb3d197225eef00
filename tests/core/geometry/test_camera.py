"""The camera against its equations: derivatives, inverse, and OpenCV's own projection."""

import cv2
import numpy as np
import pytest

from tricap.core.geometry.camera import INTERIOR, Camera, camera_of, image_of, image_with_derivatives, interior_of, project_all
from tricap.core.geometry.rotation import rotation_from_vector

STRONG = [-0.30, 0.12, 1.2e-3, -0.8e-3, -0.02]


def camera(distortions: object = STRONG, affinity: object = (8e-4, -5e-4), skew: float = 0.0) -> Camera:
    R = rotation_from_vector(np.array([0.2, -0.4, 0.1]))
    return Camera(name="C", size_px=(768, 576), matrix=np.array([[1500.0, skew, 380.3], [0, 1490.0, 290.8], [0, 0, 1]]),
                  distortions=np.array(distortions), affinity=np.array(affinity), R_cam_world=R,
                  t_cam_world_m=np.array([0.1, -0.2, 1.5]))  # fmt: skip


def points(c: Camera, n: int = 200, seed: int = 0) -> np.ndarray:
    """World points all over the frame and a little beyond, 0.5 to 6 m before the camera."""
    random = np.random.default_rng(seed)
    xy = random.uniform([-30, -30], [798, 606], (n, 2))
    depth = random.uniform(0.5, 6, n)
    ab = (xy - c.matrix[:2, 2]) / np.diag(c.matrix)[:2]
    return (np.concatenate([ab, np.ones((n, 1))], axis=1) * depth[:, None] - c.t_cam_world_m) @ c.R_cam_world


def test_projection_agrees_with_opencv() -> None:
    c = camera(affinity=(0, 0))
    X = points(c)
    theirs, _ = cv2.projectPoints(X, cv2.Rodrigues(c.R_cam_world)[0], c.t_cam_world_m, c.matrix, c.distortions)
    assert np.abs(c.project(X) - theirs[:, 0]).max() < 1e-9


@pytest.mark.parametrize("affinity", [(0.0, 0.0), (8e-4, -5e-4), (0.02, 0.03)])
def test_affinity_scales_and_shears_what_the_lens_made(affinity: tuple[float, float]) -> None:
    plain, c = camera(affinity=(0, 0)), camera(affinity=affinity)
    X = points(c)
    a, b = np.moveaxis((plain.project(X) - plain.matrix[:2, 2]) / [1500.0, 1490.0], -1, 0)
    expected = np.stack([1500.0 * ((1 + affinity[0]) * a + affinity[1] * b), 1490.0 * b], axis=1) + plain.matrix[:2, 2]
    assert np.abs(c.project(X) - expected).max() < 1e-9


@pytest.mark.parametrize("skew", [0.0, 1.7])
def test_the_jacobian_agrees_with_differences(skew: float) -> None:
    c = camera(skew=skew)
    X, h = points(c), 1e-6
    xy, J = c.project_with_jacobian(X)
    assert np.array_equal(xy, c.project(X))
    for j in range(3):
        step = h * np.eye(3)[j]
        difference = (c.project(X + step) - c.project(X - step)) / (2 * h)
        scale = np.linalg.norm(J, axis=(1, 2))
        worst = np.abs(J[:, :, j] - difference).max(axis=1) / scale
        assert worst.max() < 2e-8, f"∂/∂{'XYZ'[j]}"  # measured 3e-9: rounding of 600 px / h


@pytest.mark.parametrize("lens", ["Brown", "fisheye"])
def test_all_cameras_at_once_are_each_by_itself(lens: str) -> None:
    cameras = [camera(), camera(skew=1.7, affinity=(0.02, 0.03)), camera([0.1, 0, 0, 0, 0])] + ([fisheye()] if lens == "fisheye" else [])
    X = np.concatenate([points(cameras[0]), [[np.nan] * 3, [0.0, 0.0, -50.0]]])
    for camera_, xy, J in zip(cameras, *project_all(cameras, X), strict=True):
        alone, derivatives = camera_.project_with_jacobian(X)
        assert np.allclose(xy, alone, rtol=0, atol=1e-9, equal_nan=True) and np.allclose(J, derivatives, rtol=1e-12, equal_nan=True)


@pytest.mark.parametrize("skew", [0.0, 1.7])
@pytest.mark.parametrize("affinity", [(0.0, 0.0), (0.02, 0.03)])
def test_rays_are_the_inverse_of_the_projection(skew: float, affinity: tuple[float, float]) -> None:
    c = camera(affinity=affinity, skew=skew)
    x, y = np.meshgrid(np.linspace(0, 767, 24), np.linspace(0, 575, 18))
    xy = np.stack([x, y], axis=-1)
    for depth in (0.3, 2.0, 50.0):
        X = c.points_at_depth(xy, depth)
        assert np.abs(c.project(X) - xy).max() < 1e-9
        assert np.allclose(c.to_camera(X)[..., 2], depth, rtol=1e-13)
    X = points(c)
    depth = c.to_camera(X)[:, 2]
    assert np.abs(c.points_at_depth(c.project(X), depth) - X).max() < 1e-11
    assert np.allclose(c.centre_m + 2.5 * c.rays(xy), c.points_at_depth(xy, 2.5))


def test_one_pixel_has_the_ray_that_it_has_among_many() -> None:
    c = camera()
    xy = np.array([[100.0, 500.0], [700.0, 20.0]])
    assert c.directions(xy[1]) == pytest.approx(c.directions(xy)[1], abs=1e-14) and c.rays(xy[1]).shape == (3,)
    assert c.rays(xy[None]).shape == (1, 2, 3)


def test_what_lies_behind_or_is_nan_has_no_image() -> None:
    c = camera()
    behind = c.centre_m - c.rays(np.array([380.0, 290.0]))
    for X in (behind, c.centre_m, np.full(3, np.nan)):
        assert np.isnan(c.project(X)).all() and np.isnan(c.project_with_jacobian(X)[1]).all()
    mixed = c.rays(np.array([[np.nan, 3.0], [100.0, 200.0]]))
    assert np.isnan(mixed[0]).all() and np.allclose(mixed[1], c.rays(np.array([100.0, 200.0])))
    assert c.project(np.zeros((0, 3))).shape == (0, 2) and c.rays(np.zeros((0, 2))).shape == (0, 3)


def test_sees_the_centres_of_its_pixels() -> None:
    c = camera()
    xy = np.array([[0, 0], [767, 575], [-0.01, 5], [767.01, 5], [5, 575.01], [np.nan, 5]])
    assert c.sees(xy).tolist() == [True, True, False, False, False, False]
    assert c.sees(np.array([[4.9, 100], [5, 100]]), 5).tolist() == [False, True]


def test_mirrored_scene_gives_the_mirrored_image() -> None:
    mirror = np.diag([-1.0, 1.0, 1.0])
    matrix = np.array([[1500.0, 0, 383.5], [0, 1490.0, 290.8], [0, 0, 1]])
    k1, k2, p1, p2, k3 = STRONG
    R = rotation_from_vector(np.array([0.2, -0.4, 0.1]))
    a = Camera(name="a", size_px=(768, 576), matrix=matrix, distortions=np.array(STRONG),
               R_cam_world=R, t_cam_world_m=np.array([0.1, 0, 1]))  # fmt: skip
    b = Camera(name="b", size_px=(768, 576), matrix=matrix, distortions=np.array([k1, k2, p1, -p2, k3]),
               R_cam_world=mirror @ R @ mirror, t_cam_world_m=np.array([-0.1, 0, 1]))  # fmt: skip
    X = points(a)
    assert np.abs(a.project(X) * [-1, 1] + [767, 0] - b.project(X @ mirror)).max() < 1e-9


def test_arrays_are_checked_and_cannot_be_changed() -> None:
    c = camera()
    with pytest.raises(ValueError):
        c.matrix[0, 0] = 1
    for wrong in (dict(matrix=np.eye(4)), dict(distortions=np.zeros(4)), dict(t_cam_world_m=np.zeros((3, 1)))):
        values = dict(name="C", size_px=(8, 8), matrix=np.eye(3)) | wrong
        with pytest.raises(ValueError, match="has shape"):
            Camera(**values)  # type: ignore[arg-type]


WIDE = [0.08, -0.03, 0.012, -0.002, 0.0]


def fisheye(affinity: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """150° across."""
    matrix = np.array([[300.0, 0, 381.0], [0, 300.0, 290.0], [0, 0, 1]])
    R = rotation_from_vector(np.array([0.1, -0.2, 0.3]))
    return Camera(name="a", size_px=(768, 576), matrix=matrix, distortions=np.array(WIDE), affinity=np.array(affinity),
                  R_cam_world=R, t_cam_world_m=np.array([0.1, 0.2, 0.3]), fisheye=True)  # fmt: skip


def in_view(c: Camera, widest_deg: float = 84.0) -> np.ndarray:
    """Points (300, 3) in the world up to an angle from the axis, one of them on it."""
    rng = np.random.default_rng(1)
    angle, turn, far = np.radians(rng.uniform(0, widest_deg, 300)), rng.uniform(0, 2 * np.pi, 300), rng.uniform(0.5, 5, (300, 1))
    angle[0] = 0.0
    p = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1) * far
    return np.asarray((p - c.t_cam_world_m) @ c.R_cam_world)


def test_a_fisheye_lens_is_that_of_opencv() -> None:
    c = fisheye()
    X = in_view(c)
    theirs, _ = cv2.fisheye.projectPoints(X[:, None], cv2.Rodrigues(c.R_cam_world)[0], c.t_cam_world_m, c.matrix, c.distortions[:4])
    assert np.abs(c.project(X) - theirs[:, 0]).max() < 1e-9


def test_a_fisheye_lens_has_its_inverse_and_derivatives() -> None:
    c = fisheye((0.01, -0.005))
    X = in_view(c)
    image, jacobian = c.project_with_jacobian(X)
    again = c.project(c.points_at_depth(image, c.to_camera(X)[:, 2]))
    assert np.abs(again - image).max() < 1e-8
    steps = [(c.project(X + h) - c.project(X - h)) / 2e-6 for h in 1e-6 * np.eye(3)]
    assert np.abs(np.stack(steps, axis=-1) - jacobian).max() < 1e-4 * np.abs(jacobian).max()
    interior, p = interior_of(c), c.to_camera(X)
    image, J, G = image_with_derivatives(interior, p, True)
    assert np.abs(image - c.project(X)).max() < 1e-9 and np.abs(G @ c.R_cam_world - jacobian).max() < 1e-8
    for n, step in enumerate(1e-6 * np.diag([300, 300, 300, 1, 1, 1, 1, 1, 1, 1])):
        difference = (image_of(interior + step, p, True) - image_of(interior - step, p, True)) / (2 * step[n])
        assert np.abs(difference - J[..., n]).max() < 1e-5 * max(1.0, np.abs(J[..., n]).max()), INTERIOR[n]
    both = np.stack([interior, interior])
    mixed = image_of(both, np.stack([p, p]), np.array([True, False]))
    assert np.array_equal(mixed[0], image_of(interior, p, True)) and np.array_equal(mixed[1], image_of(interior, p))
    rebuilt = camera_of("a", c.size_px, interior, c.R_cam_world, c.t_cam_world_m, fisheye=True)
    assert np.abs(rebuilt.project(X) - c.project(X)).max() < 1e-9


def test_a_fisheye_lens_ends_before_ninety_degrees() -> None:
    c = fisheye()
    assert np.isnan(c.directions(np.array([[3000.0, 290.0]]))[0, 0]) and np.isfinite(c.directions(np.array([[381.0, 290.0]]))).all()
    assert np.isfinite(c.resized((384, 288)).field_radius) and c.field_radius > 3
