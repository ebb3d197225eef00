"""A take of three views at 24, 30 and 60 images a second, started up to ten minutes apart, against the same take in step.

    .venv/py3.13/bin/python tests/bench/loose_cameras.py FOLDER [--width 480] [--frames 14] [--silent]

FOLDER/step is a swinging arm at 30 images per second. FOLDER/loose shows the same: C is the same view; L began 587 s before it, at 24
images per second with a clock that is slow by 50 ppm; R at 60, fast by 25 ppm. L and R have rolling shutters, of which six bands are
filmed. All have sound. The beginnings are found and written by `tricap synchronise`; then clouds, trajectories and joints of both takes
are compared with the truth. Some minutes of CPU; what is in FOLDER is not made again. With `--silent` the sound is deleted.
"""

import argparse
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.core.synchronising.test_synchronise import write_wav
from tricap.core.cli.main import main as tricap
from tricap.core.foundation.progress import Monitor
from tricap.core.synchronising.sound import RATE
from tricap.core.synchronising.synchronise import synchronise, write_starts
from tricap.core.synthetic.arm import SENSORS, ArmTakeSettings, _Studio, _studio, _write_png, make_arm_take
from tricap.core.synthetic.film import digitize, expose, paint
from tricap.core.synthetic.score import score_run
from tricap.core.take.take import read_take

FRAMES, RATE_30, BANDS, UP = 24, 30.0, 6, 4
BEYOND_S = 0.1  # of the motion that is filmed before the first frame and after the last; elsewhere pictures stand still
SOUND_S = 8.0  # of C and R


@dataclass(frozen=True, kw_only=True, slots=True)
class Loose:
    """A view with its own clock: image n is exposed at start + (1 + drift) n / fps."""

    name: str
    start_s: float
    drift: float
    fps: float
    readout_s: float

    def time_s(self, n: float) -> float:
        """When image n was exposed."""
        return self.start_s + (1 + self.drift) * n / self.fps

    def number(self, time_s: float) -> int:
        """The image exposed at a time."""
        return int((time_s - self.start_s) / (1 + self.drift) * self.fps)


VIEWS = (
    Loose(name="L", start_s=-587.3141, drift=50e-6, fps=24.0, readout_s=0.016),
    Loose(name="R", start_s=-0.41173, drift=-25e-6, fps=60.0, readout_s=0.009),
)


def film(folder: Path, view: Loose, studio: _Studio) -> None:
    """The pictures of a view; links to the first and last moving ones where nothing moves."""
    i = [c.name for c in studio.rig.cameras].index(view.name)
    camera, sensor = studio.rig.cameras[i], SENSORS[view.name]
    edges = np.linspace(0, camera.size_px[1], BANDS + 1).round().astype(int)
    first, last = view.number(-BEYOND_S), view.number(FRAMES / RATE_30 + BEYOND_S)
    for n in range(first, last + 1):
        picture = np.zeros(camera.size_px[::-1], np.float32)
        for low, high in zip(edges[:-1], edges[1:]):
            moment = view.time_s(n) + view.readout_s * ((low + high) / 2 / edges[-1] - 0.5)
            picture[low:high] = expose(paint(camera, studio.subject.parts(moment), studio.noise, studio.backdrops[i]), sensor)[low:high]
        _write_png(folder / f"{n:05d}.png", digitize(picture, sensor, 1.0, np.random.default_rng([7, n, i])))
    for n in range(first):
        (folder / f"{n:05d}.png").symlink_to(folder / f"{first:05d}.png")


def make(folder: Path, width_px: int) -> None:
    """Both takes."""
    settings = ArmTakeSettings(width_px=width_px, frames=FRAMES, fps=RATE_30, interlaced="none", swing_s=0.9, click_error_px=2.0)
    make_arm_take(folder / "step", settings)
    loose = folder / "loose"
    shutil.copytree(folder / "step", loose, ignore=shutil.ignore_patterns("L", "R"))
    text = (loose / "take.toml").read_text(encoding="utf-8")
    for view in VIEWS:
        film(loose / view.name, view, _studio(settings))
        images = f'images = "{view.name}/*.png"'
        text = text.replace(images, f"{images}\nfps = {view.fps}\nreadout = {view.readout_s}")
    (loose / "take.toml").write_text(text, encoding="utf-8")
    begin = VIEWS[0].start_s - 1
    t = np.arange(round((SOUND_S + 1 - begin) * RATE * UP)) / (RATE * UP)
    room = lfilter([1.0], [1.0, -0.7], np.random.default_rng(1).standard_normal(len(t)))
    room *= 0.02 + 0.2 * (np.sin(1.3 * t) * np.sin(0.37 * t) > 0.6)
    centre = Loose(name="C", start_s=0.0, drift=0.0, fps=RATE_30, readout_s=0.0)
    for seed, view in enumerate((*VIEWS, centre)):
        n = np.arange(round((SOUND_S - min(view.start_s, 0.0)) * RATE))
        own = lfilter([1.0], [1.0, -0.7], np.random.default_rng([9, seed]).standard_normal(len(n)))
        heard = np.interp(view.start_s + (1 + view.drift) * n / RATE - begin, t, room)
        write_wav(loose / f"{view.name}.wav", 0.7 * (heard + 0.02 * own))


def started(folder: Path) -> None:
    """Find the beginnings by sound, then with the rays; print their errors in the middle of what all views show, and write them."""
    take = read_take(folder)
    heard = any(folder.glob("*.wav"))
    by_sound = [("sound", replace(take, rig_path=folder / "none.toml"))] if heard else []
    for method, shown in (*by_sound, ("sound and rays" if heard else "rays", take)):
        timings = synchronise(shown, Monitor())
        for timing in timings:
            for view in (v for v in VIEWS if v.name == timing.view):
                n = (FRAMES / RATE_30 / 2 - view.start_s) / (1 + view.drift) * view.fps
                off_s = timing.start_s + (1 + 1e-6 * timing.drift_ppm) * n / view.fps - view.time_s(n)
                print(
                    f"{method}: {view.name} wrong by {1e3 * off_s:.3f} ms, sigma {1e3 * timing.sigma_s:.3f}; {timing.problem}", flush=True
                )
    write_starts(folder, timings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--frames", type=int, default=14, help=f"that are measured, of {FRAMES}")
    parser.add_argument("--silent", action="store_true")
    args = parser.parse_args()
    folder = args.folder.resolve()
    if not (folder / "loose" / "take.toml").is_file():
        make(folder, args.width)
    for sound in (folder / "loose").glob("*.wav") if args.silent else ():
        sound.unlink()
    started(folder / "loose")
    for name in ("step", "loose"):
        for stage in ("measure", "track", "fit"):
            tricap([stage, str(folder / name), "--out", str(folder / f"out_{name}"), "--frames", f"0:{args.frames}", "--quiet"])
        score = score_run(folder / name, folder / f"out_{name}")
        print(f"{name}: clouds {score.clouds}\n{name}: trajectories {score.trajectories}\n{name}: joints {score.joints}", flush=True)


if __name__ == "__main__":
    main()
