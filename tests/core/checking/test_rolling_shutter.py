"""A view whose rows are exposed one after the other: by how much is found from the motion, and told by `tricap check`."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.checking.take_check import rolling_finding
from tricap.core.checking.timing import _readout, estimate_offsets
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import write_rig
from tricap.core.surface.starts import measured_rows
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

from ..conftest import Body, three_cameras, write_take_toml

FRAMES = 9


def place_m(t: np.ndarray) -> np.ndarray:
    """Where (N, 3) the plane is at times (N,) in frames: up and down, 6 px a frame at most."""
    return np.stack([np.zeros_like(t), 0.044 * np.sin(0.3 * t), np.full_like(t, 2.16)], axis=-1)


def picture(camera: Camera, body: Body, t: float, readout: float) -> np.ndarray:
    """Frame t of a camera whose row y is exposed at t + readout (y/h − ½)."""
    w, h = camera.size_px
    y, x = np.mgrid[0:h, 0:w].astype(float)
    rays = camera.rays(np.stack([x, y], axis=-1).reshape(-1, 2))
    at = place_m(t + readout * (y.ravel() / h - 0.5))
    along = (at[:, 2] - camera.centre_m[2]) / rays[:, 2]
    own = camera.centre_m + along[:, None] * rays - at
    noise = np.random.default_rng([int(10 * t), *map(ord, camera.name)]).standard_normal((h, w))
    return np.clip(np.rint(body.texture(own).reshape(h, w) + noise), 0, 255).astype(np.uint8)


def rolling_take(folder: Path, readout: dict[str, float], late: dict[str, float]) -> Path:
    rig, body = three_cameras(width=240, height=180, focal=960.0), Body(contrast=40.0)
    for camera in rig.cameras:
        (folder / camera.name).mkdir(parents=True)
        for t in range(FRAMES):
            image = picture(camera, body, t + 1 + late.get(camera.name, 0.0), readout.get(camera.name, 0.0))
            (folder / camera.name / f"{t:04d}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    write_rig(folder / "rig.toml", rig)
    write_take_toml(folder, [c.name for c in rig.cameras])
    return folder


@pytest.mark.slow
def test_the_readout_is_found_with_its_sigma_beside_an_offset(tmp_path: Path) -> None:
    """Measured: 0.012 frames at worst; (2) bends too little where the motion turns within few frames."""
    take = rolling_take(tmp_path, {"L": -0.3, "R": 0.5}, {"R": -0.4})
    found = {o.view: o for o in estimate_offsets(open_take(read_take(take)), Monitor())}
    for view, readout, late in (("L", -0.3, 0.0), ("R", 0.5, -0.4)):
        offset = found[view]
        assert abs(offset.readout_frames - readout) < 0.03 and 0 < offset.readout_sigma < 0.02 and offset.rolls, offset
        assert abs(offset.delay_frames - late) < 0.03, offset
    assert found["C"].readout_frames == 0.0 and not found["C"].rolls
    said = rolling_finding(found["R"])
    assert "view R takes 0.5" in said.sentence and "longer from first to last row" in said.sentence and not said.certain
    assert "shorter" in rolling_finding(found["L"]).sentence


@pytest.mark.slow
def test_a_known_readout_is_taken_out_of_the_images_and_of_the_check(tmp_path: Path) -> None:
    """Measured: 0.17 of the difference between the images remains."""
    take = read_take(rolling_take(tmp_path, {"R": 0.5}, {}))
    known = replace(take, views=tuple(replace(v, readout_s=0.5 / take.fps if v.name == "R" else 0.0) for v in take.views))
    offset = estimate_offsets(open_take(known), Monitor())[2]
    assert abs(offset.readout_frames) < 0.03 and not offset.rolls
    camera, frame = three_cameras(width=240, height=180, focal=960.0).cameras[2], 1
    at_once = picture(camera, Body(contrast=40.0), frame + 1.0, 0.0)
    edge = np.s_[12:-12, 12:-12]
    before, after = (rms(measured_rows(open_take(t), frame)[2][edge] - at_once[edge]) for t in (take, known))
    assert after < 0.35 * before
    assert len(open_take(known).files(frame)) == 5, "the images before and after count"


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(difference**2)))


@pytest.mark.parametrize("readout", ["true", "2.0", "nan", '"x"'])
def test_an_impossible_readout_is_refused(tmp_path: Path, readout: str) -> None:
    write_take_toml(tmp_path, ["L", "R"], more=f"readout = {readout}")
    with pytest.raises(InputError, match='`readout` of view "R" .* write the seconds from its first row to the last'):
        read_take(tmp_path)


@pytest.mark.slow
def test_a_global_shutter_is_none(tmp_path: Path) -> None:
    for offset in estimate_offsets(open_take(read_take(rolling_take(tmp_path, {}, {}))), Monitor()):
        assert abs(offset.readout_frames) < 0.02 and not offset.rolls, offset


def test_rows_that_all_move_alike_say_nothing() -> None:
    e = np.column_stack([np.full(40, -2.0), np.zeros(40), np.full(40, 2.0), np.zeros(40), np.zeros(40)])
    assert _readout(e, 0.0, 0.0, np.zeros(40)) == (pytest.approx(np.nan, nan_ok=True), np.inf)
