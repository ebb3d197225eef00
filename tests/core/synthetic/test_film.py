"""The sensor model and what a camera sees."""

import numpy as np
import pytest

from tricap.core.geometry.camera import Camera
from tricap.core.geometry.raster import vertex_normals
from tricap.core.synthetic.figure import BARE_SKIN, CLOTH, Material, Part, superellipsoid, wall
from tricap.core.synthetic.film import AMBIENT, LIGHT, Sensor, digitize, expose, paint, solid_noise, visible_vertices

CAMERA = Camera(
    name="C",
    size_px=(160, 120),
    matrix=np.array([[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]]),
    R_cam_world=np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
)  # looks along +y, z up
NOISE = solid_noise(1, cells=48)


def ball(y: float, radius: float, material: object = CLOTH) -> Part:
    vertices, triangles = superellipsoid(np.array([0.0, y, 0.0]), np.full(3, radius), 2.0, 30, 40)
    return Part(vertices_m=vertices, triangles=triangles, rest_m=vertices, material=material)  # type: ignore[arg-type]


@pytest.mark.parametrize("grey", [20.0, 90.0, 200.0])
def test_noise_follows_the_sensor_s_model(grey: float) -> None:
    sensor = Sensor(dark_sigma=0.8, noise_per_grey=0.022)
    stored = digitize(np.full((400, 400), grey, np.float32), sensor, 1.0, np.random.default_rng(2)).astype(float)
    expected = 0.8**2 + 0.022 * grey + 1 / 12
    assert abs(stored.mean() - grey) < 0.02 and abs(stored.var() / expected - 1) < 0.03  # 160,000 samples: sigma of a variance 0.4 %
    assert np.array_equal(digitize(np.full((4, 4), grey), sensor, 0.0, np.random.default_rng(2)), np.full((4, 4), grey))


def test_a_layer_covers_what_lies_behind_and_keeps_what_lies_before() -> None:
    behind = paint(CAMERA, [wall(2.0, 20, 1.5, (0.0, 0.0)), ball(1.0, 0.1)], NOISE)
    assert np.isfinite(behind.depth_m).all() and abs(behind.depth_m[120, 160] - 0.9) < 1e-3
    both = paint(CAMERA, [ball(1.5, 0.3, BARE_SKIN)], NOISE, behind)
    assert abs(both.depth_m[120, 160] - 0.9) < 1e-3 and both.light[60, 80] == behind.light[60, 80]
    assert abs(both.depth_m[120, 240] - 1.2504) < 5e-3 and both.light[60, 120] != behind.light[60, 120]
    assert both.light[5, 5] == behind.light[5, 5]


def test_outlines_are_covered_in_part_and_inner_pixels_are_shaded_at_their_centres() -> None:
    bright = ball(1.0, 0.1, Material(mean=100.0, contrast=0.0))
    light = paint(CAMERA, [bright], NOISE).light
    hit = paint(CAMERA, [bright], NOISE).depth_m < np.inf
    share = hit.reshape(120, 2, 160, 2).mean(axis=(1, 3))
    assert set(np.unique(share)) == {0.0, 0.25, 0.5, 0.75, 1.0}
    assert (light[share == 0] == 0).all() and (light[share > 0] > 0).all() and (light <= 100.001 * share).all()
    x, y = 88, 52  # the normal of the ball there, from the ray through the pixel's centre
    ray = CAMERA.rays(np.array([x, y])) / np.linalg.norm(CAMERA.rays(np.array([x, y])))
    depth = ray[1] - np.sqrt(ray[1] ** 2 - 1 + 0.01)
    normal = (ray * depth - [0, 1, 0]) / 0.1
    assert light[y, x] == pytest.approx(100 * (AMBIENT + (1 - AMBIENT) * normal @ LIGHT / np.linalg.norm(LIGHT)), rel=2e-3)


def test_exposure_is_blurred_and_has_the_camera_s_gain() -> None:
    layer = paint(CAMERA, [ball(1.0, 0.1)], NOISE)
    plain, louder = expose(layer, Sensor()), expose(layer, Sensor(gain=1.1, offset=-5.0))
    assert plain.shape == (120, 160) and np.allclose(louder, 1.1 * plain - 5, atol=1e-3)
    edge = plain[60, 40:60]
    assert ((edge > 5) & (edge < 0.9 * edge.max())).sum() >= 2  # the outline is spread over some pixels


def test_seen_vertices_face_the_camera_and_are_not_hidden() -> None:
    near, far = ball(1.0, 0.05), ball(2.0, 0.2)
    layer = paint(CAMERA, [near, far], NOISE)
    seen = visible_vertices(CAMERA, near.vertices_m, vertex_normals(near.vertices_m, near.triangles), layer)
    assert 0.3 < seen.mean() < 0.5 and near.vertices_m[seen, 1].max() < 1.0  # a bit less than half of a ball
    seen = visible_vertices(CAMERA, far.vertices_m, vertex_normals(far.vertices_m, far.triangles), layer)
    across = np.linalg.norm(far.vertices_m[:, [0, 2]] / far.vertices_m[:, 1:2], axis=1)  # tangent of the angle from the axis
    assert seen.any() and across[seen].min() > 0.05 * 0.98 and not seen[far.vertices_m[:, 1] > 2].any()


def test_vertices_outside_the_frame_are_not_seen() -> None:
    beside = superellipsoid(np.array([2.0, 1.0, 0.0]), np.full(3, 0.05), 2.0, 10, 10)
    layer = paint(CAMERA, [ball(1.0, 0.05)], NOISE)
    assert not visible_vertices(CAMERA, beside[0], vertex_normals(*beside), layer).any()


@pytest.mark.parametrize("power", [2.0, 3.0])
def test_parts_are_closed_and_face_outwards(power: float) -> None:
    vertices, triangles = superellipsoid(np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.2, 0.1]), power, 20, 24)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = set(map(tuple, edges.tolist()))
    assert len(there) == len(edges) and there == set(map(tuple, edges[:, ::-1].tolist()))
    p = vertices[triangles]
    volume = np.einsum("ni,ni->", p[:, 0] - 1, np.cross(p[:, 1] - 1, p[:, 2] - 1)) / 6
    assert volume > 0.9 * 4 / 3 * np.pi * 0.006
    assert np.allclose((np.abs((vertices - [1, 2, 3]) / [0.3, 0.2, 0.1]) ** power).sum(axis=1), 1)
