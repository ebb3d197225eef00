"""Matching under constraints: derivatives, exactness of the warp, covariance against scatter, and what the constraints are for."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.robust import PolynomialFit
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.constraints import OUTLINE_ACROSS_PX, OUTLINE_ALONG_PX, RAY_SIGMA_PX, _model_covariance, constrain, over_outline
from tricap.core.matching.foreground import Foreground
from tricap.core.matching.least_squares import MatchingSettings, MatchStatus
from tricap.core.matching.multi_image import MultiImageStarts, match_multi_image
from tricap.core.matching.object_space import Epipolar, SurfacePrior, SurfaceStarts, match_surface
from tricap.core.matching.occlusion_check import acceptable, depth_uncertainty, fails_occlusion_check
from tricap.core.matching.patches import TemplatePatches, monomials, patch_offsets
from tricap.core.matching.region_growing import GrowingSettings, MatchedField, grow_regions, rounds_of_larger_patches
from tricap.core.matching.seeds import sweep_seeds
from tricap.core.matching.views import Views, template_grid

EVERYWHERE = Foreground(depth_range_m=(1.0, 2.0), method="everything")
SETTINGS = MatchingSettings()


def views(images: list[SplineImage], rig: Any) -> Views:
    return Views(images=images, cameras=rig, reference=1, rows=RowGrid())


class Scene:
    """A rendered surface, and points on it with their true inverse depth and its derivatives."""

    def __init__(self, surfaces: ModuleType, surface: Any, kind: str, seed: int = 0, noise: float = 2.0, spacing: int = 9) -> None:
        self.rig, self.grey = surfaces.render(surface, kind, seed=seed, noise=noise)
        self.surface = surface
        self.images = [SplineImage(g) for g in self.grey]
        y, x = np.mgrid[40:200:spacing, 60:260:spacing].astype(float)
        xy = np.stack([x.ravel(), y.ravel()], axis=1)
        tips = xy[:, None] + [[0, 0], [9, 0], [-9, 0], [0, 9], [0, -9]]
        seen = np.isfinite(self.depth(tips)).all(axis=1)
        self.xy = xy[seen]
        w = 1 / self.depth(tips[seen])
        zero = np.zeros(len(w))
        self.theta = np.stack(
            [w[:, 0], (w[:, 1] - w[:, 2]) / 18, (w[:, 3] - w[:, 4]) / 18, (w[:, 1] + w[:, 2] - 2 * w[:, 0]) / 81, zero, zero], axis=1
        )

    def depth(self, xy: np.ndarray) -> np.ndarray:
        """True depth in the centre camera."""
        return self.surface.hit(self.rig[1].centre_m, self.rig[1].rays(xy))[0]

    def xyz(self, xy: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Points of the centre view's pixels at inverse depth w."""
        return self.rig[1].points_at_depth(xy, 1 / w)

    @property
    def views(self) -> Views:
        """The images with the rig as it is now."""
        return views(self.images, self.rig)

    def grown(self) -> MatchedField:
        """The unconstrained field."""
        grid = template_grid(self.images[1].shape, RowGrid(), 4)
        seeds = sweep_seeds(self.views, grid, SETTINGS, spacing_px=24, depth_range_m=(1.1, 1.8), monitor=Monitor())
        return grow_regions(self.views, grid, seeds, SETTINGS, GrowingSettings(), foreground=EVERYWHERE, monitor=Monitor())


@pytest.fixture(scope="module")
def plane(surfaces: ModuleType) -> Scene:
    return Scene(surfaces, surfaces.plane(), "strong")


@pytest.mark.parametrize("row_step", [1, 2])
def test_warp_is_the_projection_of_the_surface(surfaces: ModuleType, row_step: int) -> None:
    """Every pixel of a patch lands where the camera projects its point of the surface; the rest is the curvature of the distortion."""
    rig, rows = surfaces.cameras(), RowGrid(row_step, row_step - 1)
    xy = np.array([[100.0, 60.0 / row_step], [200.0, 150.0 / row_step]])
    theta = np.array([[0.7, 2e-3, -1e-3, 2e-5, -1e-5, 3e-5], [0.72, -1e-3, 2e-3, 1e-5, 2e-5, 1e-5]])
    v, u = (a.ravel().astype(np.float32) for a in np.mgrid[-6:7, -8:9])
    m = monomials(u, v, 2)
    X = rig[1].points_at_depth(rows.to_frame(xy[:, None] + np.stack([u, v], axis=1)), 1 / (theta @ m.T))
    for k in (0, 2):
        line = Epipolar(rig[1], rig[k], rows, xy)
        c, _, _, L = line.centre(theta)
        x, y = line.warp(theta, m, np.arange(2), c, L)
        assert np.abs(np.stack([x, y], axis=-1) - rows.from_frame(rig[k].project(X))).max() < 0.006


def test_derivatives_of_the_epipolar_geometry(surfaces: ModuleType) -> None:
    """∂x/∂w and A of the patch's centre against differences."""
    rig, rows, step = surfaces.cameras(), RowGrid(2, 1), 1e-5
    xy, theta = np.array([[120.0, 50.0]]), np.array([[0.71, 3e-3, -2e-3]])

    def image(xy: np.ndarray, w: float) -> np.ndarray:
        return rows.from_frame(rig[2].project(rig[1].points_at_depth(rows.to_frame(xy), 1 / w)))

    _, along, A, _ = Epipolar(rig[1], rig[2], rows, xy).centre(theta)
    assert along[0] == pytest.approx((image(xy[0], 0.71 + step) - image(xy[0], 0.71 - step)) / (2 * step), rel=1e-6)
    for i, name in enumerate("uv"):
        tip = np.eye(2)[i] * 0.01
        numeric = (image(xy[0] + tip, 0.71 + theta[0, 1 + i] * 0.01) - image(xy[0] - tip, 0.71 - theta[0, 1 + i] * 0.01)) / 0.02
        assert A[0, :, i] == pytest.approx(numeric, abs=1e-5), f"derivative to {name}"


@pytest.mark.parametrize("degree", [1, 2])
def test_design_matrix_is_the_derivative_of_the_patch(degree: int) -> None:
    """Products with the design matrix against differences of a smooth template, for every parameter; and N against JᵀMJ."""
    y, x = np.mgrid[:60, :60].astype(float)

    def look(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 100 + 30 * np.sin(0.35 * x + 0.1 * y) + 20 * np.cos(0.12 * x - 0.3 * y)

    patches = TemplatePatches(SplineImage(look(x, y)), np.array([[30.0, 28.0]]), 13, 1, degree=degree)
    m, s = patches.monomials.astype(float), np.array([[0.8, -0.3]])
    J = np.empty((len(m), m.shape[1]))
    for i in range(m.shape[1]):
        ahead, behind = (
            look(30 + patches.u + sign * s[0, 0] * m[:, i], 28 + patches.v + sign * s[0, 1] * m[:, i]) for sign in (1e-4, -1e-4)
        )
        J[:, i] = (ahead - behind) / 2e-4
    test = np.random.default_rng(0).standard_normal((1, len(m))).astype(np.float32)
    px, py = patches.project(test)
    assert (s[0, 0] * px + s[0, 1] * py)[0] == pytest.approx(test[0] @ J, rel=2e-3, abs=0.5)
    f = look(30 + patches.u, 28 + patches.v)
    f = (f - f.mean()) / np.linalg.norm(f - f.mean())
    M = np.eye(len(f)) - 1 / len(f) - np.outer(f, f)
    scale = np.sqrt(np.diag(J.T @ M @ J))
    assert np.abs((patches.normal(s, s)[0] - J.T @ M @ J) / np.outer(scale, scale)).max() < 2e-3
    assert patches.normal_to_shift(s, s)[0] == pytest.approx(patches.normal(s, s)[0, :, 0])
    assert patches.normal_of_shift(s, s)[0] == pytest.approx(patches.normal(s, s)[0, 0, 0])
    weight = np.exp(-(patches.u**2 + patches.v**2) / 40)[None]
    windowed = TemplatePatches(SplineImage(look(x, y)), np.array([[30.0, 28.0]]), 13, 1, degree=degree, weight=weight)
    W = np.diag(weight[0].astype(float))
    f = look(30 + patches.u, 28 + patches.v)
    f = f - np.diag(W) @ f / np.trace(W)
    f /= np.sqrt(f @ W @ f)
    MJ = J - (np.ones((len(f), len(f))) / np.trace(W) + np.outer(f, f)) @ W @ J
    assert np.abs((windowed.normal(s, s)[0] - MJ.T @ W @ MJ) / np.outer(scale, scale)).max() < 2e-3
    assert np.abs((windowed.squared().normal(s, s)[0] - MJ.T @ W**2 @ MJ) / np.outer(scale, scale)).max() < 2e-3


@pytest.mark.parametrize("window", [None, 5.0])
def test_object_space_finds_the_plane_and_knows_its_error(surfaces: ModuleType, window: float | None) -> None:
    """Also through a window, whose weights are not those of the noise."""
    settings = SETTINGS if window is None else replace(SETTINGS, patch_px=17)
    u, v, _ = patch_offsets(settings.patch_px, 1)
    z, bias = [], []
    for seed in range(3):
        scene = Scene(surfaces, surfaces.plane(), "strong", seed)
        start = scene.theta[:, :3] * (1 + 0.002 * np.random.default_rng(seed).standard_normal((len(scene.xy), 1)))  # about 0.3 px
        weight = None if window is None else np.tile(np.exp(-0.5 * (u**2 + v**2) / window**2), (len(start), 1))
        found = match_surface(scene.views, SurfaceStarts(xy=scene.xy, theta=start, window=weight), settings, sigma_across_px=0.03)
        assert found.ok.mean() > 0.98
        o, ok = found.offset, found.ok
        m = monomials(o[:, 0], o[:, 1], 1).astype(float)
        w = np.einsum("ni,ni->n", m, found.theta)
        error = (w - 1 / scene.depth(scene.xy + o))[ok]
        z.append(error / np.sqrt(np.einsum("ni,nij,nj->n", m, found.covariance, m))[ok])
        bias.append(error * 210)  # px in a search view: f · base
        assert np.median(found.across_px[ok] ** 2) < 0.03**2
    assert 0.85 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.2
    assert abs(np.mean(np.concatenate(bias))) < 0.01


def test_priors_whose_errors_are_smaller_than_their_sigmas(plane: Scene) -> None:
    """Curvatures that are exact but have a wide sigma: the sigma of the depth is calibrated."""
    sigma = np.tile([np.inf, 5e-4, 5e-4, 5e-6, 5e-6, 5e-6], (len(plane.xy), 1))
    z = []
    for error in (None, 0.01 * sigma):
        prior = SurfacePrior(value=plane.theta, sigma=sigma, error=error)
        found = match_surface(plane.views, SurfaceStarts(xy=plane.xy, theta=plane.theta, prior=prior), SETTINGS, sigma_across_px=0.03)
        wrong = found.theta[:, 0] - plane.theta[:, 0]
        z.append(np.sqrt(np.mean((wrong**2 / found.covariance[:, 0, 0])[found.ok])))
    assert z[0] < 0.9 < z[1] < 1.2


def test_collinearity_makes_the_rays_meet(plane: Scene) -> None:
    """With σ_c = 10 px the images are free, with 0.001 px their rays meet; well-textured depths agree within their sigma."""
    scene, rows = plane, RowGrid()
    lines = [Epipolar(scene.rig[1], scene.rig[k], rows, scene.xy).centre(scene.theta[:, :3]) for k in (0, 2)]
    middle, shape = (np.stack([line[i] for line in lines], axis=1) for i in (0, 2))
    starts = MultiImageStarts(xy=scene.xy, centre=middle + 0.3, shape=shape, xyz_m=scene.xyz(scene.xy, scene.theta[:, 0]))
    free, held = (match_multi_image(scene.views, starts, SETTINGS, sigma_c_px=s) for s in (10.0, 0.001))
    both = free.ok & held.ok
    assert both.mean() > 0.9
    assert np.abs(held.residual_px[both]).max() < 1e-3 < 0.02 < np.abs(free.residual_px[both]).mean() * 5
    sigma = np.sqrt(np.trace(held.covariance_m2, axis1=1, axis2=2))[both]
    error = scene.surface.distance_m(held.xyz_m[both])
    assert np.median(np.abs(error)) < 1.2 * np.median(np.abs(scene.surface.distance_m(free.xyz_m[both])))
    assert 0.3 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.5


def test_curvature_removes_the_flattening(surfaces: ModuleType) -> None:
    """On a cylinder a plane is measured too deep; with a prior of curvature it is not."""
    scene = Scene(surfaces, surfaces.cylinder(0.06), "strong")
    settings, sigma = replace(SETTINGS, patch_px=17), np.array([np.inf, 4e-4, 4e-4, 4e-5, 4e-5, 4e-5])
    biases = []
    for columns in (3, 6):
        start = scene.theta[:, :columns]
        prior = SurfacePrior(value=start, sigma=np.tile(sigma[:columns], (len(start), 1)))
        found = match_surface(scene.views, SurfaceStarts(xy=scene.xy, theta=start, prior=prior), settings, sigma_across_px=0.03)
        m = monomials(found.offset[:, 0], found.offset[:, 1], 1 if columns == 3 else 2).astype(float)
        w = np.einsum("ni,ni->n", m, found.theta)
        biases.append(np.median(scene.surface.distance_m(scene.xyz(scene.xy + found.offset, w)[found.ok])))
    assert biases[0] < -0.4e-3
    assert abs(biases[1]) < 0.2e-3


@pytest.mark.parametrize("kind", ["strong", "weak"])
def test_constraints_reduce_the_error(surfaces: ModuleType, kind: str) -> None:
    scene = Scene(surfaces, surfaces.cylinder(0.06), kind)
    field = scene.grown()
    rms = {}
    for constraint in ("none", "epipolar", "object"):
        found = constrain(field, scene.views, replace(SETTINGS, constraint=constraint), foreground=EVERYWHERE, monitor=Monitor())
        error = scene.surface.distance_m(found.xyz_m)
        rms[constraint] = np.sqrt(np.mean(error[np.abs(error) < 0.005] ** 2))
        assert len(found.cell) > (0.75 if constraint == "epipolar" else 0.87) * len(field.cell)
        assert np.isfinite(found.covariance_m2).all()
    assert rms["object"] < 0.9 * rms["none"]
    assert rms["epipolar"] < rms["none"]


def test_neighbours_give_a_point_the_curvature_of_its_surface(surfaces: ModuleType) -> None:
    """A limb, measured with the slopes and curvatures of the points around as pseudo-observations and without: 0.29 and 0.97 mm RMS."""
    scene = Scene(surfaces, surfaces.cylinder(0.06), "strong")
    field, rms = scene.grown(), []
    for neighbours in (True, False):
        settings = replace(SETTINGS, neighbours=neighbours)
        error = scene.surface.distance_m(constrain(field, scene.views, settings, foreground=EVERYWHERE, monitor=Monitor()).xyz_m)
        rms.append(np.sqrt(np.mean(error[np.abs(error) < 0.005] ** 2)))
    assert rms[0] < 0.5 * rms[1]


@pytest.mark.slow
def test_a_rig_that_is_half_a_pixel_off_still_helps(surfaces: ModuleType) -> None:
    """The outer views are 0.55 px too high and too low, as after a poor calibration or a movement between exposures. The constraint
    by pieces of surface outweighs this: measured 0.86 mm RMS, 1.27 mm without."""
    scene, rms, residual = Scene(surfaces, surfaces.cylinder(0.15), "weak"), {}, {}
    for k, up in ((0, 1.0), (2, -1.0)):
        camera, turn = scene.rig[k], rotation_from_vector(np.array([up * 0.55 / surfaces.FOCAL_PX, 0.0, 0.0]))
        scene.rig[k] = replace(camera, R_cam_world=turn @ camera.R_cam_world, t_cam_world_m=turn @ camera.t_cam_world_m)
    field = scene.grown()
    for constraint in ("none", "object"):
        settings = replace(SETTINGS, constraint=constraint)
        found = constrain(field, scene.views, settings, foreground=EVERYWHERE, monitor=Monitor())
        error = scene.surface.distance_m(found.xyz_m)
        assert len(found.cell) > 0.85 * len(field.cell)
        rms[constraint], residual[constraint] = np.sqrt(np.mean(error[np.abs(error) < 0.02] ** 2)), np.median(found.residual_px)
    assert rms["object"] < 0.8 * rms["none"]
    assert residual["object"] < 0.8 * residual["none"]


def test_an_outline_moves_points_across_the_ray(surfaces: ModuleType) -> None:
    """Neighbours on one side only: hardly any covariance is added across a surface that faces the camera, and all of it edge-on."""
    base, w, grid = surfaces.cameras()[1], np.array([0.5]), template_grid((80, 100), RowGrid(), 4)
    ray = base.rays(np.array([[40.0, 200.0]]))
    facing = ray[0] / np.linalg.norm(ray[0])
    edge_on = np.cross(facing, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(facing, [0.0, 1.0, 0.0]))
    there = (np.arange(49) % 7 < 4).astype(float)[None]
    half, near, far = (
        over_outline(PolynomialFit(coefficients=np.zeros((1, 6)), scatter=np.zeros(1), weights=a), grid, 13)[0]
        for a in (there, np.where(np.arange(49) % 7 < 6, 1.0, 0.0)[None], np.ones((1, 49)))
    )
    assert 0.3 < half < 0.5 and near < 0.1 * half and far == 0.0  # the window hardly reaches the last column
    K, whole = (_model_covariance(ray, w, 100.0, np.array([share]), 0.0, base)[0] for share in (half, 0.0))
    sigma, least = (np.array([np.sqrt(n @ k @ n) * w[0] * base.focal_px for n in (facing, edge_on)]) for k in (K, whole))
    assert (np.linalg.eigvalsh(K) > 0).all()
    assert least == pytest.approx(RAY_SIGMA_PX, rel=1e-3)
    assert sigma == pytest.approx(np.hypot(RAY_SIGMA_PX, half * np.array([OUTLINE_ALONG_PX, OUTLINE_ACROSS_PX])), rel=1e-3)


def test_points_on_which_two_ways_of_matching_disagree_are_rejected(surfaces: ModuleType) -> None:
    """At an outline the unconstrained patch settles on a mixture of two surfaces; such points are simulated."""
    scene = Scene(surfaces, surfaces.cylinder(0.06), "strong")
    field = scene.grown()
    kept = constrain(field, scene.views, SETTINGS, foreground=EVERYWHERE, monitor=Monitor())
    chosen = np.searchsorted(field.cell, kept.cell[::25])
    mixed = field.xyz_m.copy()
    mixed[chosen] += 0.015 * scene.rig[1].rays(field.xy[chosen, 1])
    found = constrain(replace(field, xyz_m=mixed), scene.views, SETTINGS, foreground=EVERYWHERE, monitor=Monitor())
    assert not np.isin(field.cell[chosen], found.cell).any()
    assert np.isin(np.delete(kept.cell, np.arange(0, len(kept.cell), 25)), found.cell).mean() > 0.97


def edge(surfaces: ModuleType, behind_m: float = 0.03) -> Any:
    """A plane that faces the rig, whose right half lies farther away."""

    def hit(origin: np.ndarray, rays: np.ndarray) -> Any:
        near, far = ((z - origin[2]) / rays[..., 2] for z in (surfaces.DISTANCE_M, surfaces.DISTANCE_M + behind_m))
        x = origin[0] + rays[..., 0] * near
        t = np.where(x < 0, near, far)
        X = origin + rays * t[..., None]
        return np.where(np.abs(X[..., 1]) < 0.2, t, np.nan), X[..., 0], X[..., 1] + 0.13 * (x >= 0)

    def distance_m(X: np.ndarray) -> np.ndarray:
        near = np.where(X[..., 0] < 0.002, X[..., 2] - surfaces.DISTANCE_M, np.inf)
        far = X[..., 2] - surfaces.DISTANCE_M - behind_m
        return np.where(np.abs(near) < np.abs(far), near, far)

    return surfaces.Surface(hit=hit, distance_m=distance_m, normal=lambda X: np.broadcast_to((0.0, 0.0, -1.0), X.shape))


def test_points_between_two_surfaces_are_left_out(surfaces: ModuleType) -> None:
    """Along the edge of something nearer, patches cover both surfaces; their points lie between them, and fail the occlusion check."""
    scene = Scene(surfaces, edge(surfaces), "strong")
    field = scene.grown()

    found = constrain(field, scene.views, SETTINGS, foreground=EVERYWHERE, monitor=Monitor())
    kept = found.select(~fails_occlusion_check(found, scene.views, SETTINGS))
    bad, left = (np.abs(scene.surface.distance_m(f.xyz_m)) > 0.01 for f in (found, kept))
    assert bad.sum() >= 10
    assert left.sum() <= 0.75 * bad.sum()
    assert (~left).sum() > 0.98 * (~bad).sum()
    unconstrained = replace(SETTINGS, constraint="none")
    assert not fails_occlusion_check(found, scene.views, unconstrained).any()


def test_depth_uncertainty(plane: Scene) -> None:
    """Points off the surface are found by their centres; where most points are worse, more is acceptable."""
    sigma = np.full(len(plane.xy), 0.001)

    def uncertainty(shift_px: float) -> np.ndarray:
        planes = plane.theta[:, :3] + np.array([shift_px / 210, 0.0, 0.0])  # f · base = 210 px m
        starts = SurfaceStarts(xy=plane.xy, theta=planes)
        return depth_uncertainty(plane.views, starts, sigma, SETTINGS, px_per_inverse_metre=210.0)

    right, wrong = uncertainty(0.0), uncertainty(2.0)
    assert np.quantile(right, 0.95) < 0.008
    assert np.median(wrong) > 0.9 * 2.0 / 210 * 1.4**2
    assert acceptable(right).mean() > 0.97
    assert not acceptable(np.concatenate([right, wrong]))[len(right) :].mean() > 0.1
    assert acceptable(np.full(5, 0.5)).all()
    flat = [SplineImage(np.full((240, 320), 90.0)) for _ in range(3)]
    starts = SurfaceStarts(xy=plane.xy, theta=plane.theta[:, :3])
    nothing = depth_uncertainty(views(flat, plane.rig), starts, sigma, SETTINGS, px_per_inverse_metre=210.0)
    assert nothing == pytest.approx(np.hypot(0.5 / 210 / plane.theta[:, 0] ** 2, 0.001))


def test_depth_uncertainty_of_no_points(plane: Scene) -> None:
    starts = SurfaceStarts(xy=np.zeros((0, 2)), theta=np.zeros((0, 3)))
    uncertainty = depth_uncertainty(plane.views, starts, np.zeros(0), SETTINGS, px_per_inverse_metre=210.0)
    assert acceptable(uncertainty).shape == (0,)


def test_larger_patches_only_where_pixels_are_small(plane: Scene) -> None:
    growing, depth = GrowingSettings(), np.array([1.4, 1.5, np.nan])
    assert rounds_of_larger_patches(SETTINGS, growing, depth, plane.rig[1]) == 1  # 2 mm per pixel
    assert rounds_of_larger_patches(SETTINGS, growing, depth / 8, plane.rig[1]) == growing.bigger_patches
    assert rounds_of_larger_patches(SETTINGS, replace(growing, bigger_patches=0), depth, plane.rig[1]) == 0


def test_failures_are_statuses(plane: Scene) -> None:
    xy = np.array([[100.0, 100.0], [3.0, 100.0], [100.0, 100.0], [4.0, 4.0]])
    theta = np.array([[np.nan] * 3, [0.7, 0, 0], [5.0, 0, 0], [0.7, 0, 0]])
    found = match_surface(plane.views, SurfaceStarts(xy=xy, theta=theta), SETTINGS, sigma_across_px=0.03)
    assert found.status.tolist()[0] == found.status.tolist()[1] == MatchStatus.OUT_OF_IMAGE
    assert not found.ok.any()
    flat = [SplineImage(np.full((240, 320), 90.0)) for _ in range(3)]
    found = match_surface(views(flat, plane.rig), SurfaceStarts(xy=plane.xy, theta=plane.theta[:, :3]), SETTINGS, sigma_across_px=0.03)
    assert (found.status == MatchStatus.NO_TEXTURE).all()
    nothing = match_surface(plane.views, SurfaceStarts(xy=np.zeros((0, 2)), theta=np.zeros((0, 3))), SETTINGS, sigma_across_px=0.03)
    assert len(nothing.theta) == 0
