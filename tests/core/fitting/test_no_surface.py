"""Recordings whose surface cannot be measured: a blank scene with an arm that has only keypoints or outlines."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.body.skin.contour_skin import limb_skin
from tricap.core.fitting.inputs.no_surface import background_outside_outlines, filled, outline_polygons
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.raster import rasterize
from tricap.core.geometry.rig import Rig
from tricap.core.geometry.rotation import axis_rotation
from tricap.core.motion.formats.markers import Markers
from tricap.core.motion.formats.trc import write_trc
from tricap.core.run import pipeline, take_run
from tricap.core.run.record import read_frame_table
from tricap.core.synthetic import arm
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take
from tricap.core.tracking.contour import contour_of_mask, outward_normals

from ..conftest import three_cameras, write_take

SHAPE = default_shape(read_model("arm.R"))
MOTION = np.zeros((3, len(SHAPE.skeleton.dofs)))
MOTION[:, :3] = 0.15, 0.0, 2.6
MOTION[:, SHAPE.skeleton.layout["elbow.R flexion"]] = np.radians([40.0, 45.0, 50.0])
MODEL = '[body]\nmodel = "arm.R"\n'


def _joints() -> np.ndarray:
    return np.stack(list(joint_positions(SHAPE.skeleton, SHAPE.lengths_m, MOTION).values()), axis=1)


def _with_keypoints(folder: Path) -> Path:
    take = write_take(folder, three_cameras(), [[]] * 3, more=MODEL + '[[keypoints]]\nfiles = "kp.trc"\naxes = "Z up"\n')
    names, X = SHAPE.skeleton.joint_names, _joints()
    write_trc(folder / "kp.trc", Markers(names=names, fps=25.0, frames=np.arange(3), xyz_m=X, sigma_m=np.full(X.shape[:2], np.nan)),
              axes="Z up")  # fmt: skip
    return take


def _outlines(out: Path) -> None:
    (out / "contours").mkdir(parents=True)
    for camera in three_cameras().cameras:
        rows = []
        for frame, motion in enumerate(MOTION):
            skin = limb_skin(SHAPE, motion)
            raster = rasterize(camera, skin.vertices_m, skin.triangles)
            xy = contour_of_mask(raster.image(np.ones(len(raster.sample)), 0.0) > 0, 4.0)
            rows += [f"{frame},{i},{x},{y},{u},{v},0.5,1" for i, ((x, y), (u, v)) in enumerate(zip(xy, outward_normals(xy)))]
        text = "frame,vertex,x,y,normal_x,normal_y,sigma,on_edge\n" + "\n".join(rows) + "\n"
        (out / "contours" / f"{camera.name}.csv").write_text(text)


def _run(out: Path) -> dict[str, Any]:
    return json.loads((out / "run.json").read_text())  # type: ignore[no-any-return]


@pytest.mark.slow
def test_keypoints_stand_for_a_surface_that_cannot_be_measured(tmp_path: Path) -> None:
    take, out = _with_keypoints(tmp_path / "take"), tmp_path / "out"
    job = pipeline.run(take, out)
    assert job.body is not None and np.linalg.norm(job.body.motion.joints_m - _joints(), axis=2).max() < 0.02
    run = _run(out)
    assert run["stages"]["measure"]["not_done"] == run["stages"]["track"]["not_done"] == "nothing could be measured"
    assert any("rests on outlines and keypoints" in w for w in run["warnings"]) and not (out / "clouds").exists()
    assert read_frame_table(out / "frames.csv").frames.tolist() == [0, 1, 2] and "body fitted" in str(job)
    assert (out / "report" / "report.html").exists() and pipeline.is_complete(job)


@pytest.mark.slow
def test_outlines_alone_and_nothing_is_measured_where_it_is_not_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take, out, joints = tmp_path / "take", tmp_path / "out", _joints()[0]
    clicks = {name: {c.name: c.project(X).round(1).tolist() for c in three_cameras().cameras}
              for name, X in zip(SHAPE.skeleton.joint_names, joints)}  # fmt: skip
    said = "".join(f'"{n}" = {{ ' + ", ".join(f"{v} = {xy}" for v, xy in at.items()) + " }\n" for n, at in clicks.items())
    write_take(take, three_cameras(), [[]] * 3, more=MODEL + "[seeds.joints]\n" + said)
    with pytest.raises(InputError, match="No surface could be measured|nowhere|texture|alike"):
        pipeline.run(take, out)
    _outlines(out)
    monkeypatch.setattr(pipeline, "measure_frames", lambda *args: pytest.fail("measured"))
    job = pipeline.run(take, out, {"fitting": {"use_surface": False}})
    assert job.body is not None and np.linalg.norm(job.body.motion.joints_m - _joints(), axis=2).max() < 0.02
    assert _run(out)["stages"]["measure"]["not_done"] == "fitting.use_surface is false"


def test_between_cameras_all_around_nothing_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless no body is wanted: then the surface is all there is, and is tried."""

    def tried(*args: Any) -> None:
        raise InputError("tried")

    monkeypatch.setattr(pipeline, "measure_frames", tried)
    takes = {
        model: write_take(tmp_path / model, three_cameras(base_m=6.0), [[]], more=f'[body]\nmodel = "{model}"\n')
        for model in ("arm.R", "none")
    }
    with take_run.open_run(takes["arm.R"], tmp_path / "out") as job:
        pipeline.measure(job, Monitor())
        assert job.surfaceless and any("no surface is measured" in w for w in job.record["warnings"])
    assert _run(tmp_path / "out")["stages"]["measure"]["not_done"] == "the views look from too far apart"
    with take_run.open_run(takes["none"], tmp_path / "surface") as job, pytest.raises(InputError, match="tried"):
        pipeline.measure(job, Monitor())


def _wide_rig(width_px: int) -> Rig:
    """The cameras of the synthetic arm, the outer ones turned about it to 55° from the middle one."""
    rig, cameras = arm.arm_rig(width_px), []
    for camera, degrees in zip(rig.cameras, (-45.0, 0.0, 45.0)):
        turn = axis_rotation("z", np.radians(degrees))
        centre = arm.TARGET_M + turn @ (camera.centre_m - arm.TARGET_M)
        R = camera.R_cam_world @ turn.T
        cameras.append(replace(camera, R_cam_world=R, t_cam_world_m=-R @ centre))
    return replace(rig, cameras=tuple(cameras))


@pytest.mark.slow
def test_between_cameras_all_around_a_body_is_held_by_points_of_single_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arm, "rig_for", lambda subject, width_px: _wide_rig(width_px))
    take, errors = tmp_path / "take", dict[bool, np.ndarray]()
    arm.make_arm_take(take, arm.ArmTakeSettings(frames=12, width_px=480, interlaced="none", click_error_px=1.0), Monitor())
    truth = np.load(take / "truth.npz")["joints_m"]
    for tracks in (True, False):
        job = pipeline.run(take, tmp_path / str(tracks), {"fitting": {"use_trajectories": tracks}})
        assert job.body is not None and job.surfaceless and _run(job.results.folder)["stages"]["fit"]["iterations"] > 0
        errors[tracks] = np.linalg.norm(job.body.motion.joints_m - truth, axis=2)
        assert not (job.results.folder / "cache" / "fit_rough").exists()
    assert errors[True].mean() < 0.8 * errors[False].mean() and errors[True].max() < 0.03, {k: e.mean(axis=0) for k, e in errors.items()}


def test_what_lies_outside_an_outline_is_empty(tmp_path: Path) -> None:
    footage = open_take(read_take(_with_keypoints(tmp_path / "take")))
    _outlines(tmp_path / "out")
    job = take_run.Results(tmp_path / "out")
    polygons = outline_polygons(footage, job)
    assert set(polygons) == {"L", "C", "R"} and set(polygons["C"]) == {0, 1, 2}
    empty = next(e for e in background_outside_outlines(footage, polygons) if e.view == "C")
    inside = filled(polygons["C"][1], footage.rig["C"].size_px)
    skin = limb_skin(SHAPE, MOTION[1])
    raster = rasterize(footage.rig["C"], skin.vertices_m, skin.triangles)
    true = raster.image(np.ones(len(raster.sample)), 0.0) > 0
    assert (inside & true).sum() / (inside | true).sum() > 0.93
    far = cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, 5)
    distance = empty.of_frame(1)
    assert distance is not None and abs(distance[2, 3] * empty.unit_px - min(far[10, 14], 127)) < 3.0
    assert distance[far[2::4, 2::4][: distance.shape[0], : distance.shape[1]] == 0].mean() < 2.0
