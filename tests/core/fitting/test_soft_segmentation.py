"""Points that belong to several limbs in parts: near a joint undecided, elsewhere as sharp as the hard segmentation; outliers to nobody."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.fitting.inputs.cloud_points import CloudPoints
from tricap.core.fitting.segmentation import OUTLIERS, responsibilities, segment, soft_segment
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.sequence import FitInput, fit_sequence
from tricap.core.fitting.state import ShapeParameters

EVERYWHERE = np.tile([0.0, 1.0], (2, 1))
KNOWN = FitSettings(model_sigma_m=0.0, length_sigma=0.001, proportion_sigma=0.001, radius_sigma=0.001, voxel_m=0.002)


def test_shares_follow_distances_normals_and_the_spread() -> None:
    gap = np.array([[0.0, 0.02], [0.01, 0.01], [0.02, 0.0], [0.034, 0.034]])
    share = responsibilities(gap, np.ones_like(gap), 0.035)
    assert (share.sum(axis=1) < 1).all() and share[0, 0] > 1.5 * share[0, 1] and np.allclose(share[0], share[2, ::-1])
    assert np.allclose(share[1, 0], share[1, 1]) and share[3].sum() < 0.7 * share[1].sum()
    turned = responsibilities(gap, np.array([[1.0, 1.0], [1.0, 0.2], [1.0, 1.0], [1.0, 1.0]]), 0.035)
    assert turned[1, 0] > 4 * turned[1, 1]
    sharp = responsibilities(np.array([[0.001, 0.012]] * 50), np.ones((50, 2)), 0.035)
    assert sharp[0, 0] > 0.95 > 0.05 > sharp[0, 1]  # σ has fallen to 3 mm
    assert responsibilities(gap, np.zeros_like(gap), 0.035).sum() == 0
    lost = responsibilities(np.full((50, 2), 0.034), np.ones((50, 2)), 0.035)
    assert (1 - lost.sum(axis=1) > OUTLIERS[0]).all()


def test_a_good_pose_decides_as_the_hard_segmentation(make_scene) -> None:
    scene = make_scene(noise=0.001, points=400)
    parameters, cloud = ShapeParameters(scene.shape), scene.clouds[0]
    points = CloudPoints(frame=0, xyz_m=cloud.xyz_m, normals=cloud.normals, sigma_m=np.full(len(cloud.xyz_m), 0.001))
    state = parameters.state(scene.motion[0], parameters.vector())
    hard_rows, hard_bone = segment(points, state, EVERYWHERE, 0.035)
    rows, bone, share = soft_segment(points, state, EVERYWHERE, 0.035)
    assert len(rows) > len(hard_rows) and (share <= 1).all()
    best = {int(r): int(bone[rows == r][np.argmax(share[rows == r])]) for r in set(rows.tolist())}
    agree = np.mean([best.get(int(r)) == b for r, b in zip(hard_rows, hard_bone)])
    assert agree > 0.9
    elbow = np.linalg.norm(points.xyz_m[rows] - state.head_m[1], axis=1)
    several = np.isin(rows, [r for r in set(rows.tolist()) if (rows == r).sum() > 1])
    assert np.median(elbow[several]) < 0.06 < np.median(elbow[~several])
    away = replace_points(points, points.xyz_m + [0.0, 0.5, 0.0])
    assert not len(soft_segment(away, state, EVERYWHERE, 0.035)[0])


def replace_points(points: CloudPoints, xyz_m: np.ndarray) -> CloudPoints:
    """The same points elsewhere."""
    return CloudPoints(frame=points.frame, xyz_m=xyz_m, normals=points.normals, sigma_m=points.sigma_m)


@pytest.mark.parametrize("gross", [0.0, 0.1])
def test_the_fit_is_as_good_with_it(make_scene, gross: float) -> None:
    errors = {"hard": [], "soft": []}
    for seed in range(3):
        scene = make_scene(seed=seed, gross=gross)
        given = FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={0: scene.clicks}, time_s=scene.time_s)
        for how, found in errors.items():
            fit = fit_sequence(given, replace(KNOWN, segmentation=how))
            found.append(np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2).mean())
    assert np.mean(errors["soft"]) < 1.25 * np.mean(errors["hard"]), errors
