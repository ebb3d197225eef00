"""The z-buffer against closed forms: a plane, a sphere, what hides what, edges without cracks, cuts at the camera."""

import numpy as np
import pytest

from tricap.core.geometry.camera import Camera
from tricap.core.geometry.raster import Raster, rasterize, shade, vertex_normals
from tricap.core.geometry.rotation import rotation_from_vector

MATRIX = np.array([[300.0, 0, 79.3], [0, 300.0, 60.1], [0, 0, 1]])
DISTORTED = dict(distortions=[-0.2, 0.08, 1e-3, -7e-4, 0.0], affinity=[2e-4, -1e-4])


def camera(**more: object) -> Camera:
    return Camera(name="C", size_px=(160, 120), matrix=MATRIX, **more)  # type: ignore[arg-type]


def grid(n: int, half_x: float, half_y: float, z: object) -> tuple[np.ndarray, np.ndarray]:
    """A surface z(x, y) of 2 n² triangles that faces a camera at the origin looking along +z."""
    t = np.linspace(-1, 1, n + 1)
    x, y = np.meshgrid(t * half_x, t * half_y)
    vertices = np.stack([x, y, z(x, y) * np.ones_like(x)], axis=-1).reshape(-1, 3)  # type: ignore[operator]
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    b, c, d = a + 1, a + n + 1, a + n + 2
    return vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def sphere(centre: tuple[float, float, float], radius: float, n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    u = np.arange(2 * n) * np.pi / n
    v = np.linspace(0, np.pi, n + 1)[1:-1]
    ring = np.stack([np.sin(v)[:, None] * np.cos(u), np.sin(v)[:, None] * np.sin(u), np.cos(v)[:, None] * np.ones_like(u)], -1)
    points = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]]) * radius + np.array(centre)
    i, j = np.meshgrid(np.arange(n - 2), np.arange(2 * n), indexing="ij")
    k = (j + 1) % (2 * n)
    a, b, c, d = (r * 2 * n + s for r, s in ((i, j), (i, k), (i + 1, j), (i + 1, k)))
    sides = np.concatenate([np.stack([a, c, d], -1).reshape(-1, 3), np.stack([a, d, b], -1).reshape(-1, 3)])
    s, e, last = np.arange(2 * n), (np.arange(2 * n) + 1) % (2 * n), (n - 2) * 2 * n
    top, bottom = np.stack([0 * s + len(points) - 2, s, e], 1), np.stack([0 * s + len(points) - 1, last + e, last + s], 1)
    return points, np.concatenate([sides, top, bottom])


def test_tilted_plane_depth_is_that_of_the_ray() -> None:
    cam = camera(R_cam_world=rotation_from_vector(np.array([0.1, -0.2, 0.05])), t_cam_world_m=[0.1, 0.2, 0.3])
    vertices, triangles = grid(1, 0.5, 0.4, lambda x, y: 2 + 0.3 * x - 0.2 * y)
    raster = rasterize(cam, vertices, triangles)
    xy = raster.xy_px
    assert len(xy) > 3000
    on_ray = cam.points_at_depth(xy, raster.depth_m)
    assert np.abs(on_ray[:, 2] - (2 + 0.3 * on_ray[:, 0] - 0.2 * on_ray[:, 1])).max() < 1e-9
    assert np.abs(raster.interpolate(vertices, triangles) - on_ray).max() < 1e-9  # the weights are perspective-correct


def test_sphere_depth_through_a_distorting_camera() -> None:
    cam = camera(**DISTORTED)
    centre, radius = (0.12, -0.08, 1.0), 0.2
    vertices, triangles = sphere(centre, radius, 120)
    raster = rasterize(cam, vertices, triangles)
    xy = raster.xy_px
    off = np.linalg.norm(cam.points_at_depth(xy, raster.depth_m) - centre, axis=1) - radius
    # a chord over 2π/240 lies R (1 - cos) ≈ 0.034 mm inside, twice that over a diagonal; grazing rays magnify it along the ray,
    # so the distance from the surface is the measure. Straight edges between distorted corners add < 0.01 mm here.
    assert -1.5e-4 < off.min() and off.max() < 2e-5
    every = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1)
    ray = cam.rays(every) / np.linalg.norm(cam.rays(every), axis=-1, keepdims=True)
    inside = np.linalg.norm(np.cross(ray, centre), axis=-1) < radius  # the ray passes the centre nearer than the radius
    assert np.sum(raster.image(np.ones(len(xy)), 0.0).astype(bool) != inside) < 0.003 * inside.sum()


def test_nearer_surface_hides_the_farther_and_back_faces_are_dropped() -> None:
    far, far_triangles = grid(3, 0.5, 0.4, lambda x, y: 2.0)
    near, near_triangles = sphere((0.0, 0.0, 1.2), 0.1)
    vertices = np.concatenate([far, near])
    for order in (0, 1):
        parts = [far_triangles, near_triangles + len(far)]
        raster = rasterize(camera(), vertices, np.concatenate(parts[::-1] if order else parts))
        depth = raster.image(raster.depth_m)
        assert abs(depth[60, 79] - 1.1) < 1e-3 and depth[20, 20] == pytest.approx(2.0)
    turned = far_triangles[:, ::-1]
    assert len(rasterize(camera(), far, turned).sample) == 0
    assert len(rasterize(camera(), far, turned, back_faces=True).sample) == len(rasterize(camera(), far, far_triangles).sample) > 0


@pytest.mark.parametrize("factor", [1, 3])
def test_neighbours_leave_no_crack_and_share_no_sample(factor: int) -> None:
    rng = np.random.default_rng(5)
    vertices, triangles = grid(25, 1.0, 1.0, lambda x, y: 2.0)
    inner = np.abs(vertices[:, :2]).max(axis=1) < 0.99
    vertices[inner, :2] += rng.uniform(-0.02, 0.02, (inner.sum(), 2))
    vertices[:, 2] += rng.uniform(-0.05, 0.05, len(vertices))
    raster = rasterize(camera(), vertices, triangles, factor=factor)
    assert len(raster.sample) == 160 * 120 * factor**2  # every sample is covered
    shown = np.zeros(len(triangles), dtype=int)
    for one in range(0, len(triangles), 7):  # a triangle alone covers just the samples that it has in the mesh
        alone = rasterize(camera(), vertices, triangles[one : one + 1], factor=factor)
        shown[one] = len(alone.sample)
    assert np.array_equal(shown[::7], np.bincount(raster.triangle, minlength=len(triangles))[::7])


def test_vertices_and_edges_exactly_on_samples_are_covered_once() -> None:
    z, f = 1.0, 300.0
    at = np.array([[40, 30], [80, 30], [80, 70], [40, 70], [60, 50]])  # pixel centres
    vertices = np.concatenate([(at - MATRIX[:2, 2]) / f * z, np.full((5, 1), z)], axis=1)
    triangles = np.array([[0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0]])
    parts = [set(rasterize(camera(), vertices, t[None]).sample.tolist()) for t in triangles]
    assert sum(map(len, parts)) == len(set().union(*parts))
    assert abs(len(set().union(*parts)) - 40 * 40) <= 80  # the square's own edges may fall on either side by rounding


def test_a_field_is_the_frame_s_rows() -> None:
    vertices, triangles = sphere((0.0, 0.0, 1.0), 0.15, 20)
    whole, field = (
        rasterize(camera(**DISTORTED), vertices, triangles),
        rasterize(camera(**DISTORTED), vertices, triangles, rows=np.arange(1, 120, 2)),
    )
    assert field.shape == (60, 160)
    assert np.array_equal(field.image(field.triangle, -1), whole.image(whole.triangle, -1)[1::2])


def test_floor_that_runs_under_the_camera_is_cut_at_it() -> None:
    cam = camera(**DISTORTED)
    floor = np.array([[-40.0, 0.5, -40], [40, 0.5, -40], [40, 0.5, 40], [-40, 0.5, 40]])  # y points down: half a metre below
    raster = rasterize(cam, floor, np.array([[0, 3, 2], [0, 2, 1]]), back_faces=True)
    below = np.arange(160 * 120) // 160 > 68
    assert set(np.flatnonzero(below)) <= set(raster.sample.tolist())
    rows = np.array([80, 100, 119])
    xy = np.stack([np.full(3, 79.0), rows], axis=1)
    seen = raster.image(raster.depth_m)[rows, 79]
    ray = cam.directions(xy)
    assert np.all(np.abs(seen / (0.5 / ray[:, 1]) - 1) < 0.12)  # edges 80 m long are straight here, curved in a distorting lens
    pinhole = rasterize(camera(), floor, np.array([[0, 3, 2], [0, 2, 1]]), back_faces=True)
    exact = 0.5 / camera().directions(xy)[:, 1]
    assert np.allclose(pinhole.image(pinhole.depth_m)[rows, 79], exact, rtol=1e-9)
    points = pinhole.interpolate(floor, np.array([[0, 3, 2], [0, 2, 1]]))
    assert np.abs(points[:, 2] - pinhole.depth_m).max() < 1e-6  # weights refer to the uncut triangle


def test_nothing_folds_back_from_outside_the_field() -> None:
    cam = camera(distortions=[-0.6, 0.0, 0, 0, 0])  # a pure k1 turns back at r = 0.745
    vertices = np.array([[1.2, -0.2, 1.0], [1.6, -0.2, 1.0], [1.6, 0.2, 1.0]])
    assert len(rasterize(cam, vertices, np.array([[0, 1, 2]]), back_faces=True).sample) == 0


def test_nothing_to_draw() -> None:
    behind = np.array([[0.0, 0, -1], [1, 0, -1], [0, 1, -1]])
    for triangles in (np.array([[0, 1, 2]]), np.zeros((0, 3), dtype=int)):
        raster: Raster = rasterize(camera(), behind, triangles)
        assert len(raster.sample) == 0 and np.isnan(raster.image(raster.depth_m)).all()


def test_normals_and_shading() -> None:
    centre = np.array([0.0, 0.0, 1.0])
    vertices, triangles = sphere((0.0, 0.0, 1.0), 0.2)
    outward = (vertices - centre) / 0.2
    assert np.abs(vertex_normals(vertices, triangles) - outward).max() < 0.02
    grey, coverage = shade(camera(), vertices, triangles)
    assert grey.shape == coverage.shape == (120, 160) and grey.dtype == np.float32
    assert coverage[60, 79] == 1.0 and coverage[0, 0] == 0.0 and ((coverage > 0) & (coverage < 1)).sum() > 50
    assert grey[40, 65] > grey[80, 95] and grey.max() <= 1.0
