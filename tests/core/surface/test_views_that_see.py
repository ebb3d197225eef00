"""Points are measured in the views that show them: a flat view of four costs nothing but its rays, and pairs reach the cloud's file."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.intersection import chi2_limit
from tricap.core.geometry.rig import Rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.motion.formats.ply import read_ply
from tricap.core.run import pipeline, take_run

COARSE = {"growing": {"spacing_px": 6}}


def four_cameras(scenes: Any) -> Rig:
    """L, C and R, and U half as far above C as these are apart, looking at the same point."""
    three, up = scenes.three_cameras(), 0.25
    ahead = np.array([0.0, up, scenes.depth_m]) / np.hypot(up, scenes.depth_m)
    R = np.stack([[1.0, 0.0, 0.0], np.cross(ahead, [1.0, 0.0, 0.0]), ahead])
    values = {name: getattr(three["C"], name) for name in Camera.__dataclass_fields__}
    above = Camera(**values | dict(name="U", R_cam_world=R, t_cam_world_m=-R @ np.array([0.0, -up, 0.0])))
    return Rig(cameras=(three["L"], three["C"], above, three["R"]))


@pytest.fixture(scope="module")
def plane(scenes: Any) -> Any:
    return scenes.Body(half_m=(0.26, 0.2), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))


@pytest.fixture(scope="module")
def four_views(tmp_path_factory: pytest.TempPathFactory, scenes: Any, plane: Any) -> Path:
    """One frame of the plane, seen by four cameras; do not change it, copy it."""
    take = scenes.write_take(tmp_path_factory.mktemp("four"), four_cameras(scenes), [[plane]])
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace("[[views]]", 'reference_view = "C"\n[[views]]', 1))
    return Path(take)


def painted(take: Path, folder: Path, view: str, part: slice = slice(None)) -> Path:
    """A copy in which columns of a view's pictures are evenly grey."""
    shutil.copytree(take, folder)
    for path in (folder / view).iterdir():
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        picture[:, part] = 90
        path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("how", ["object", "epipolar", "published"])
def test_a_flat_view_of_four_costs_only_its_rays(four_views: Path, tmp_path: Path, scenes: Any, plane: Any, how: str) -> None:
    settings = {
        "growing": COARSE["growing"] | {"method": "published" if how == "published" else "fronts"},
        "matching": {"constraint": "none" if how == "published" else how},
    }
    whole = scenes.measure(four_views, tmp_path / "whole", settings)[0]
    blind = scenes.measure(painted(four_views, tmp_path / "take", "U"), tmp_path / "blind", settings)[0]
    assert (whole.cloud.rays == 4).mean() > 0.9 and (blind.cloud.rays == 3).all()
    assert len(blind.cloud.xyz_m) > 0.9 * len(whole.cloud.xyz_m) > 350
    for m in (whole, blind):
        assert np.median(np.abs(plane.distance_m(m.cloud.xyz_m))) < 0.6e-3 and np.isfinite(m.cloud.covariance_m2).all()
        assert np.isfinite(m.cloud.residual_px).all() and np.median(m.cloud.residual_px) < 0.3


def test_each_point_uses_the_views_that_see_it(four_views: Path, tmp_path: Path, scenes: Any, plane: Any) -> None:
    """U shows only the right half; what would lie in the left half of its picture has three rays, the rest four."""
    rig = four_cameras(scenes)
    m = scenes.measure(painted(four_views, tmp_path / "take", "U", slice(0, 100)), tmp_path / "out", COARSE)[0]
    at = rig["U"].project(m.cloud.xyz_m)[:, 0]
    assert (m.cloud.rays[at < 90] == 3).all() and (m.cloud.rays[at > 110] == 4).mean() > 0.95
    assert min((at < 90).sum(), (at > 110).sum()) > 100 and np.median(np.abs(plane.distance_m(m.cloud.xyz_m[at < 90]))) < 0.6e-3
    shape = m.field.shape[:, 2]  # where U does not see the point the shape is that which is expected there
    assert np.abs(shape - np.median(shape, axis=0)).max() < 0.3


def test_pairs_reach_the_file(plane_take: Path, tmp_path: Path, scenes: Any, plane: Any) -> None:
    """R sees the right half only: without `pairs` nothing is measured in the other half, with it the file says which points are pairs."""
    take, counts = painted(plane_take, tmp_path / "take", "R", slice(0, 100)), []
    for pairs in (False, True):
        settings = {"growing": COARSE["growing"] | {"pairs": pairs}}
        with take_run.open_run(take, tmp_path / f"{pairs}", settings, (0, 1)) as run:
            pipeline.measure(run, Monitor())
        ply = read_ply(tmp_path / f"{pairs}" / "clouds" / "0000.ply")
        rays, near = ply.vertex["rays"], np.abs(plane.distance_m(ply.xyz_m))
        counts.append(((rays == 2).sum(), (rays == 3).sum()))
        assert rays.dtype == np.uint8 and np.median(near) < 0.6e-3
    assert counts[0][0] == 0 < 150 < counts[1][0] and counts[1][1] >= 0.95 * counts[0][1] > 100
    assert np.median(near[rays == 2]) < 1e-3


def test_with_pairs_two_of_three_views_are_enough(plane_take: Path, tmp_path: Path, scenes: Any, plane: Any) -> None:
    """One view is flat altogether: seeds and points come from the other two."""
    take = painted(plane_take, tmp_path / "take", "L")
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace("[[views]]", "frames = [0, 1]\n[[views]]", 1))
    m = scenes.measure(take, tmp_path / "out", {"growing": COARSE["growing"] | {"pairs": True}})[0]
    assert len(m.cloud.xyz_m) > 350 and (m.cloud.rays == 2).all() and np.median(np.abs(plane.distance_m(m.cloud.xyz_m))) < 1e-3


def test_the_test_of_rays_knows_their_number(four_views: Path, tmp_path: Path, scenes: Any) -> None:
    """χ² of 99.9 % over 2 K − 3: 3.29 for two rays, 2.33 for three (tables of the distribution). As a setting it is stricter."""
    assert np.allclose(chi2_limit(np.array([2, 3, 4])) ** 2 * (1, 3, 5), (10.828, 16.266, 20.515), atol=1e-3)
    sizes = [
        len(scenes.measure(four_views, tmp_path / str(limit), {"growing": COARSE["growing"] | {"max_ray_sigma0": limit}})[0].cloud.xyz_m)
        for limit in (0.0, 3.0)
    ]
    assert 0.85 * sizes[1] < sizes[0] < sizes[1]


def fan(scenes: Any, count: int) -> Rig:
    """So many cameras in a row, 0.8 m from the first to the last, that look at the same point."""
    template, cameras = scenes.three_cameras()["C"], []
    values = {name: getattr(template, name) for name in Camera.__dataclass_fields__}
    for i, x in enumerate(np.linspace(-0.4, 0.4, count)):
        ahead = np.array([-x, 0.0, scenes.depth_m]) / np.hypot(x, scenes.depth_m)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        R = np.stack([right, np.cross(ahead, right), ahead])
        cameras.append(Camera(**values | dict(name=f"V{i}", R_cam_world=R, t_cam_world_m=-R @ np.array([x, 0.0, 0.0]))))
    return Rig(cameras=tuple(cameras))


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 8])
def test_from_two_to_eight_cameras(tmp_path: Path, scenes: Any, plane: Any, count: int) -> None:
    """Measured, tracked and reported; eight views see more precisely than two."""
    frames = [[plane.moved(np.eye(3), [0.004 * i, 0.0, 0.0])] for i in range(2)]
    take = scenes.write_take(tmp_path / "take", fan(scenes, count), frames)
    made = pipeline.run(take, tmp_path / "out", {"growing": {"spacing_px": 9}})
    for cloud, (body,) in zip(made.clouds, frames):
        assert len(cloud.xyz_m) > 150 and cloud.rays.max() == count and np.median(cloud.rays) > count / 2
        assert np.median(np.abs(body.distance_m(cloud.xyz_m))) < (1.0e-3 if count == 2 else 0.4e-3)
    assert made.trajectories is not None and made.trajectories.visible.all(axis=0).sum() > 60
    steps = np.diff(made.trajectories.xyz_m, axis=0)[0]
    assert np.median(np.linalg.norm(steps - [0.004, 0, 0], axis=1)) < 1.5e-3
    assert (tmp_path / "out" / "report" / "report.html").is_file()
