"""The start of views by lamps that are switched and by flashes, against truth; and light that gives none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.cli import main
from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sequence import open_sequence
from tricap.core.synchronising.light import BANDS, COLUMNS, GAMMA, LightChange, brightness_of, light_changes, offset_by_light
from tricap.core.take.take import read_take

FINE = 40  # rows of the simulated sensor in a band
Events = list[tuple[float, str]]  # time [images] and kind


def filmed(events: Events, *, images: int, exposure: float, readout: float, seed: int, noise: float = 0.004) -> np.ndarray:
    """The light (n, BANDS, COLUMNS) that a camera records: rows are exposed one after another, in the middle of image n at n."""
    rng = np.random.default_rng(seed)
    heights = (np.arange(BANDS * FINE) + 0.5) / (BANDS * FINE) - 0.5
    low = np.arange(images)[:, None] + readout * heights - exposure / 2
    room = np.full((images, BANDS * FINE), 0.15)
    for time, kind in events:
        after = np.clip((low + exposure - time) / exposure, 0, 1)
        room += {"on": 0.12, "off": -0.08}.get(kind, 0.0) * after + (kind == "flash") * 0.4 * ((after > 0) & (after < 1))
    bands = room.reshape(images, BANDS, FINE).mean(axis=-1)[..., None] * rng.uniform(0.6, 1.4, (BANDS, COLUMNS))
    wandering = 1 + 0.02 * np.sin(np.arange(images)[:, None, None] / 9 + rng.uniform(0, 6, (BANDS, COLUMNS)))  # somebody moves
    return np.asarray(bands * wandering + noise * rng.standard_normal(bands.shape))


@pytest.mark.parametrize(
    ("kinds", "reached", "sigmas"),
    [(("on", "off"), 0.30, 2.0), (("flash",), 0.30, 2.0)],
    ids=["lamps", "flashes"],
)
def test_changes_are_found_to_a_part_of_an_image_and_know_it(kinds: tuple[str, ...], reached: float, sigmas: float) -> None:
    """Measured over 60 cameras: 0.06 to 0.2 images RMS; the errors are 0.5 to 1.2 of their sigmas."""
    off, z = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        events = [(n + rng.uniform(), kinds[i % len(kinds)]) for i, n in enumerate((20, 45, 70))]
        light = filmed(events, images=100, exposure=rng.uniform(0.05, 1.0), readout=rng.choice([0.0, 0.4, 0.8]), seed=seed)
        for change in light_changes(light):
            time = min((t for t, kind in events if kind == change.kind), key=lambda t: abs(t - change.image))
            off.append(change.image - time)
            z.append(off[-1] / change.sigma)
    assert len(off) > 0.6 * 16 * 3, "a global shutter does not see every flash"
    assert np.sqrt(np.mean(np.square(off))) < reached and np.sqrt(np.mean(np.square(z))) < sigmas


def test_what_is_no_change_of_the_light_is_left_out() -> None:
    still = filmed([], images=80, exposure=0.5, readout=0.5, seed=1)
    slow = still * (1 + np.clip((np.arange(80) - 30) / 15, 0, 1))[:, None, None]
    near = still.copy()
    near[40:, :8] *= 2.0  # somebody comes into half of the image
    assert light_changes(still) == light_changes(slow) == light_changes(near) == light_changes(still[:3]) == ()


def changes(*at: tuple[float, str]) -> tuple[tuple[LightChange, ...], np.ndarray]:
    found = tuple(LightChange(image=t, sigma=0.01, kind=kind) for t, kind in at)
    return found, np.array([(c.image / 30, 1 / 30) for c in found]).reshape(-1, 2)


def test_the_pattern_of_the_changes_gives_start_and_drift_or_nothing() -> None:
    times = [100.0, 480.0, 1900.0, 3000.0]
    a, a_s = changes(*((t, "on" if n % 2 == 0 else "off") for n, t in enumerate(times)))
    b, b_s = changes(*(((t - 60) / (1 + 5e-5), "on" if n % 2 == 0 else "off") for n, t in enumerate(times)), (500.0, "flash"))
    found = offset_by_light(a, b, a_s, b_s)
    assert found is not None and found.changes == 4 and abs(found.offset_s - 2.0) < 1e-3 and found.sigma_s < 0.003
    blinks, blinks_s = changes(*((60.0 * n, "flash") for n in range(6)))
    later, later_s = changes(*((60.0 * n, "flash") for n in range(3)))
    assert offset_by_light(blinks, later, blinks_s, later_s) is None, "a lamp that blinks regularly fits more than one start"
    assert offset_by_light(a, later, a_s, later_s) is None, "no change of the same kind"


def test_the_command_finds_the_start_by_a_lamp(tmp_path: Path, capsys: pytest.CaptureFixture[str], scenes) -> None:
    """B began 12.3 images of A later, at 30 instead of 25 images per second."""
    rng = np.random.default_rng(5)
    times = np.array([40.2, 61.7]) / 25
    for view, start_s, fps in (("A", 0.0, 25.0), ("B", 12.3 / 25, 30.0)):
        events: Events = [((t - start_s) * fps, kind) for t, kind in zip(times, ("on", "off"))]
        (tmp_path / view).mkdir()
        for n, image in enumerate(filmed(events, images=75, exposure=0.6, readout=0.7, seed=ord(view))):
            grey = 255 * np.clip(image, 0, 1) ** (1 / GAMMA)
            picture = cv2.resize(grey.astype(np.float32), (64, 48), interpolation=cv2.INTER_NEAREST) + rng.normal(0, 1, (48, 64))
            cv2.imwrite(str(tmp_path / view / f"{n:03}.png"), np.clip(np.rint(picture), 0, 255).astype(np.uint8))
    scenes.write_take_toml(tmp_path, ["A", "B"], more="fps = 30.0")  # of the last view
    assert main.main(["synchronise", str(tmp_path), "--write"]) == 0
    assert "ms, by light" in capsys.readouterr().out
    assert abs(read_take(tmp_path).views[0].start_s + 12.3 / 25) < 0.004  # B is the reference view


def test_the_brightness_of_images_is_that_of_their_light(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.full((48, 64), 128, np.uint8))
    sequence = open_sequence(tmp_path, images="*.png", movie=None, view="A")
    assert brightness_of(sequence, RowGrid(), Monitor()) == pytest.approx(np.full((1, BANDS, COLUMNS), (128 / 255) ** GAMMA))
