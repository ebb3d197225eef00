"""Forward intersection: exact on exact rays; its covariance is the scatter that is observed; what cannot be met is NaN."""

from typing import Any

import numpy as np
import pytest

from tricap.core.geometry.intersection import (
    JOINT_PLACE_M,
    clicks_contradict,
    doubtful_view,
    forward_intersection,
    intersect_clicks,
    joint_clicks_contradict,
)


def cloud(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-0.3, -0.2, 1.9], [0.3, 0.2, 2.5], (n, 3))


def images(cameras: Any, X: np.ndarray) -> np.ndarray:
    return np.stack([c.project(X) for c in cameras], axis=1)


def sigmas(n: int, *sigma_px: float) -> np.ndarray:
    return np.broadcast_to(np.array([np.eye(2) * s**2 for s in sigma_px]), (n, len(sigma_px), 2, 2))


def test_exact_rays_meet_in_the_point(scenes: Any) -> None:
    cameras, X = scenes.three_cameras().cameras, cloud(300)
    for k in (2, 3):
        point = forward_intersection(cameras[:k], images(cameras[:k], X), sigmas(300, *[0.1] * k))
        assert np.abs(point.xyz_m - X).max() < 1e-10
        assert np.abs(point.residual_px).max() < 1e-7 and point.sigma0.max() < 1e-6
        assert (point.rays == k).all()


@pytest.mark.parametrize("sigma_px", [0.02, 0.2, 1.0])
def test_bias_scatter_and_covariance(scenes: Any, sigma_px: float) -> None:
    """Views of unlike quality; the covariance counts them right, sigma0 is 1, and the normalised error is a unit sphere."""
    cameras, n = scenes.three_cameras().cameras, 3000
    X, s = cloud(n), np.array([1.0, 0.5, 2.0]) * sigma_px
    noise = np.random.default_rng(7).standard_normal((n, 3, 2)) * s[:, None]
    point = forward_intersection(cameras, images(cameras, X) + noise, sigmas(n, *s))
    error = point.xyz_m - X
    z = np.linalg.solve(np.linalg.cholesky(point.covariance_m2), error[..., None])[..., 0]
    # of 3000 points the mean of z scatters by 0.018 and its rms by 0.013: four of each
    assert np.abs(z.mean(axis=0)).max() < 0.073 and np.abs(np.sqrt((z**2).mean(axis=0)) - 1).max() < 0.052
    assert abs(np.sqrt((point.sigma0**2).mean()) - 1) < 0.03  # three redundant observations a point: 0.0075 × 4
    by_hand = np.sqrt((np.linalg.norm(point.residual_px, axis=2) ** 2).mean(axis=1))
    assert np.allclose(point.rms_residual_px, by_hand)


def test_correlated_and_unlike_axes_are_weighted(scenes: Any) -> None:
    cameras, n = scenes.three_cameras().cameras, 3000
    X = cloud(n)
    K = np.array([[0.09, 0.02], [0.02, 0.01]])
    noise = np.random.default_rng(8).standard_normal((n, 3, 2)) @ np.linalg.cholesky(K).T
    point = forward_intersection(cameras, images(cameras, X) + noise, np.broadcast_to(K, (n, 3, 2, 2)))
    z = np.linalg.solve(np.linalg.cholesky(point.covariance_m2), (point.xyz_m - X)[..., None])[..., 0]
    assert np.abs(np.sqrt((z**2).mean(axis=0)) - 1).max() < 0.052


def test_missing_rays(scenes: Any) -> None:
    cameras, X = scenes.three_cameras().cameras, cloud(4)
    xy = images(cameras, X)
    xy[1, 0], xy[2, :2], xy[3] = np.nan, np.nan, np.nan
    point = forward_intersection(cameras, xy, sigmas(4, 0.1, 0.1, 0.1))
    assert point.rays.tolist() == [3, 2, 1, 0]
    assert np.abs(point.xyz_m[:2] - X[:2]).max() < 1e-10
    for array in (point.xyz_m, point.covariance_m2, point.residual_px, point.rms_residual_px, point.sigma0):
        assert np.isfinite(array[0]).all() and np.isnan(array[2:]).all()
    assert np.isnan(point.residual_px[1, 0]).all() and np.isfinite(point.residual_px[1, 1:]).all()
    assert np.trace(point.covariance_m2[1]) > np.trace(point.covariance_m2[0])


def test_one_bad_point_does_not_harm_the_others(scenes: Any) -> None:
    """Rays that diverge meet behind the cameras; rays that are parallel meet nowhere; neither is a point, the rest stay exact."""
    cameras, X = scenes.three_cameras(distorted=False).cameras, cloud(4)
    xy = images(cameras, X)
    xy[1, 0, 0] -= 250  # L looks further left …
    xy[1, 2, 0] += 250  # … and R further right
    direction = np.array([0.02, 0.01, 1.0]) * 1e9  # a point at infinity
    xy[2] = [c.project(direction) for c in cameras]
    point = forward_intersection(cameras, xy, sigmas(4, 0.1, 0.1, 0.1))
    assert np.abs(point.xyz_m[[0, 3]] - X[[0, 3]]).max() < 1e-10
    assert not (np.isfinite(point.xyz_m[1]).all() and point.rms_residual_px[1] < 20)
    assert np.isnan(point.xyz_m[2]).all() or np.sqrt(point.covariance_m2[2, 2, 2]) > 1e3


def test_none_at_all(scenes: Any) -> None:
    cameras = scenes.three_cameras().cameras
    point = forward_intersection(cameras, np.zeros((0, 3, 2)), np.zeros((0, 3, 2, 2)))
    assert point.xyz_m.shape == (0, 3) and point.rms_residual_px.shape == (0,)


def test_clicks_that_contradict_each_other_by_their_own_sigma(scenes: Any) -> None:
    """A tenth of a percent of clicks as good as their sigma is refused at most; of clicks three times as bad many are."""
    cameras, rng, n = scenes.three_cameras().cameras, np.random.default_rng(7), 4000
    X = cloud(n)
    for count in (2, 3):
        for worse, low, high in ((1.0, 0.0, 0.001), (3.0, 0.1, 1.0)):
            xy = images(cameras[:count], X) + rng.normal(0, 5.0 * worse, (n, count, 2))
            share = clicks_contradict(intersect_clicks(cameras[:count], xy, 5.0), 5.0).mean()
            assert low <= share <= high
    point = intersect_clicks(cameras[:2], np.full((1, 2, 2), np.nan))
    assert clicks_contradict(point).tolist() == [True], "no rays, no point"


@pytest.mark.parametrize(("base_m", "low", "high"), [(0.2, 0.1, 1.0), (6.0, 0.0, 0.005)])
def test_a_joint_may_be_believed_elsewhere_from_another_side_but_not_from_beside(
    scenes: Any, base_m: float, low: float, high: float
) -> None:
    cameras, rng, n = (
        scenes.three_cameras(base_m=base_m, focal=2000.0 * max(1.0, base_m), distorted=False).cameras,
        np.random.default_rng(5),
        3000,
    )
    X = cloud(n)
    believed = X[:, None] + rng.normal(0, JOINT_PLACE_M, (n, 3, 3))
    xy = np.stack([camera.project(believed[:, k]) for k, camera in enumerate(cameras)], axis=1)
    share = joint_clicks_contradict(cameras, intersect_clicks(cameras, xy, 5.0), 5.0).mean()
    assert low <= share <= high
    if base_m > 1:
        assert clicks_contradict(intersect_clicks(cameras, xy, 5.0), 5.0).mean() > 0.5, "a spot on the surface may not"
    nothing = intersect_clicks(cameras[:2], np.full((1, 2, 2), np.nan))
    assert joint_clicks_contradict(cameras[:2], nothing).tolist() == [True], "no rays, no point"


def test_the_view_to_look_at_first(scenes: Any) -> None:
    cameras, X = scenes.three_cameras().cameras, cloud(1)
    for k in range(3):
        xy = images(cameras, X)[0]
        xy[k] += (30.0, 40.0)
        assert doubtful_view(cameras, xy) == k
