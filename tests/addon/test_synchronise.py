"""The button *Synchronise*, and the sound of movies."""

import importlib
import wave
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.synchronising.sound import RATE
from tricap.core.take.writing import read_table

from .conftest import small_rig, write_take

NAME = "bl_ext.user_default.tricap.addon"


def room(seconds: float) -> np.ndarray:
    return 0.2 * np.clip(np.random.default_rng(5).normal(size=round(seconds * RATE)), -4, 4)


def write_wav(path: Path, samples: np.ndarray) -> None:
    with wave.open(str(path), "wb") as wav:
        wav.setnchannels(1), wav.setsampwidth(2), wav.setframerate(RATE)
        wav.writeframes((samples * 32767).astype("<i2").tobytes())


@pytest.fixture
def scene(blender: ModuleType, tmp_path: Path) -> Any:
    """A take without cameras of which R starts 2.5 s late."""
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    folder = tmp_path / "take"
    write_take(folder, small_rig())
    (folder / "rig.toml").unlink()
    sound = room(12.0)
    for view, first in (("L", 0.0), ("C", 0.0), ("R", 2.5)):
        write_wav(folder / f"{view}.wav", sound[round(first * RATE) :])
    importlib.import_module(f"{NAME}.project").open_take(blender.context.scene, folder)
    return blender.context.scene


def test_the_button_sets_the_starts_which_can_be_undone(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    assert blender.ops.tricap.synchronise() == {"FINISHED"}
    assert [round(view.start_s, 3) for view in scene.tricap.views] == [0.0, 0.0, 2.5]
    assert scene.tricap.views[2].clip.frame_start == round(2.5 * scene.tricap.fps)
    project = importlib.import_module(f"{NAME}.project")
    scene.tricap.all_frames = True
    clocked = project.table(scene)["views"][2]
    assert abs(clocked["start"] - 2.5) < 1e-4 and "offset_frames" not in clocked


def test_a_view_without_sound_changes_nothing(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    (tmp_path / "take" / "R.wav").unlink()
    before = read_table(tmp_path / "take")
    with pytest.raises(RuntimeError, match=r"View R: there is no sound of R \(no R.wav"):
        blender.ops.tricap.synchronise()
    assert [view.start_s for view in scene.tricap.views] == [0.0, 0.0, 0.0] and read_table(tmp_path / "take") == before


def test_the_sound_of_a_movie_is_read(blender: ModuleType, tmp_path: Path) -> None:
    aud = importlib.import_module("aud")
    movie_sound = importlib.import_module(f"{NAME}.movie_sound").movie_sound
    sound = aud.Sound.buffer(room(3.0).astype(np.float32)[:, None], RATE)
    path = tmp_path / "a.mkv"
    sound.write(str(path), RATE, aud.CHANNELS_MONO, aud.FORMAT_S16, aud.CONTAINER_MATROSKA, aud.CODEC_PCM, 0, 4096)
    read = movie_sound(path)
    assert read is not None and len(read.samples) >= 3 * RATE
    assert np.corrcoef(read.samples[:RATE], room(3.0)[:RATE])[0, 1] > 0.99
    (tmp_path / "b.mkv").write_bytes(b"no movie")
    assert movie_sound(tmp_path / "b.mkv") is None
