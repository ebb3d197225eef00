"""`tricap synchronise`: when each view began, by the sound of its recording, else by changes of the light, else by time codes, then by the
rays of points that move.

Sound gives the beginning to some tenths of a millisecond, the drift of the clock, and finds recordings that were started minutes apart. It
needs time to travel: between cameras at a distance b of each other a noise arrives up to b / 343 m/s earlier in one, which the sigma
contains (uniformly distributed directions: b / √3 / 343 m/s). Light needs none (`light`): a lamp that is switched, or a flash, gives the
beginning to a part of an image. Time codes (`time_code`) give it to an image or so, if the clocks of the cameras were set together: each
camera counts whole images, so the sigma is that of a uniform distribution. The rays (`checking.timing`) have no such error; with a rig they
measure what is left, or everything where there is nothing else and the views began within the reach of `tricap check`. Views that began
further apart, without sound, light and time codes, are brought together where the same motion is seen in both (`motion`), if the rays
confirm that.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..checking.timing import TimeOffset, estimate_offsets
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.rig import read_rig
from ..images.sequence import ImageSequence, open_sequence
from ..take.clock import Clock, clocks_of
from ..take.footage import Footage, open_take
from ..take.take import Take, View
from ..take.writing import read_table, write_table
from .light import LightChange, brightness_of, light_changes, offset_by_light
from .motion import energy_of, offsets_by_motion
from .sound import Sound, offset_between, read_wav
from .time_code import TimeCode, read_time_code, started_after

SPEED_OF_SOUND_M_S = 343.0
USUAL_DISTANCE_M = 2.0  # between two cameras without a rig
MOST_RAYS_SIGMA = 0.06  # frames: a less exact estimate from rays is not used
TRACKING = 2.0  # times the sigma of the rays, and …
LEAST_IMAGES = 0.005  # … images: by how much tracked points are wrong in the same way in all frames (measured, synthetic footage)
CONTRADICTION = 5.0  # sigmas by which rays and sound may differ, and more than …
IMAGE_LATENESS_S = 0.1  # … by which the images in a file are later than its sound
MOTION_SIGMA_S = 0.1  # of a beginning by the motion alone, which is none
MovieSound = Callable[[Path], Sound | None]  # the sound of a movie's own track, None without one


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewTiming:
    """When a view began. `start_s` and `drift_ppm` are its keys in take.toml; NaN where it was not found."""

    view: str
    start_s: float
    sigma_s: float
    drift_ppm: float
    method: str  # "reference", "sound", "light", "time code", "rays", one of them or "motion" “and rays”, or "" where it was not found
    problem: str = ""  # why it was not found, and what to do

    @property
    def found(self) -> bool:
        """Whether its beginning is known."""
        return bool(self.method)

    def to_table(self) -> dict[str, object]:
        """The figures, for JSON; None where the view was not found."""
        figures = {
            "start_s": round(float(self.start_s), 6),
            "sigma_s": round(float(self.sigma_s), 6),
            "drift_ppm": round(float(self.drift_ppm), 3),
        }
        return {**(figures if self.found else dict.fromkeys(figures)), "by": self.method, "problem": self.problem}

    def __str__(self) -> str:
        if not self.found:
            return f"View {self.view}: {self.problem}"
        if self.method == "reference":
            return f"View {self.view}: starts at {self.start_s:.4f} s (the reference view)."
        drift = f", its clock is slow by {self.drift_ppm:.1f} ppm" if self.drift_ppm else ""
        return f"View {self.view}: starts at {self.start_s:.4f} s ± {1e3 * self.sigma_s:.2f} ms, by {self.method}{drift}."


def synchronise(take: Take, monitor: Monitor, movie_sound: MovieSound | None = None) -> tuple[ViewTiming, ...]:
    """The beginning of every view on the clock of the reference view, in the order of the views.

    The sound of view NAME is NAME.wav in the take's folder, or its movie's own as `movie_sound` reads it.

    Raises:
        InputError: a sound or an image cannot be read.
        Cancelled: the monitor was cancelled.
    """
    take = replace(take, reference_chosen=True)  # the same view in all steps, also in those that open the footage
    sounds = {v.name: _sound(take, v, movie_sound) for v in take.views}
    reference = take.views[take.reference]
    timings = {reference.name: _timing(reference, reference.start_s, 0.0, reference.drift_ppm, "reference")}
    others = [v for v in take.views if v is not reference]
    lights = _Lights(take)
    for n, view in enumerate(others):
        a, b, part = sounds[reference.name], sounds[view.name], monitor.part("finding the start", n, len(others))
        heard = offset_between(a, b, part) if a and b else None
        if heard is not None:
            sigma_s = float(np.hypot(heard.sigma_s, _distance_m(take, view) / np.sqrt(3) / SPEED_OF_SOUND_M_S))
            timings[view.name] = _placed(take, view, heard.offset_s, heard.drift, sigma_s, "sound")
        else:
            seen = lights.timing(view, part) or _by_time_code(take, view)
            timings[view.name] = seen or _lost(take, view, a, b, sounded=movie_sound is not None)
    found = tuple(timings[v.name] for v in take.views)
    if not take.rig_path.is_file():
        return found
    found = _with_rays(take, found, monitor)
    audible = {name for name, sound in sounds.items() if sound is not None and not sound.silent}
    lost = [timing for timing in found if not timing.found and not {reference.name, timing.view} <= audible]
    motions = _Motions(take)
    by_motion = {
        t.view: motions.timing(t, timings[reference.name], monitor.part("finding the motion", n, len(lost))) for n, t in enumerate(lost)
    }
    found = tuple(by_motion.get(timing.view, timing) for timing in found)
    moved = any(timing.method.startswith("motion") for timing in found)
    return _with_rays(take, found, monitor) if moved else found  # again, in the frames that all views show


def write_starts(folder: Path, timings: tuple[ViewTiming, ...]) -> bool:
    """Write the beginnings into FOLDER/take.toml; returns whether something changed.

    Raises:
        InputError: a view was not found, or the file cannot be written; it is unchanged then.
    """
    lost = [timing for timing in timings if not timing.found]
    if lost:
        raise InputError(f"Nothing was written. {lost[0]}")
    table, of_view = read_table(folder), {timing.view: timing for timing in timings}
    views = []
    for entry in table["views"]:
        timing = of_view[entry["name"]]
        keys = {"start": round(float(timing.start_s), 6), "drift_ppm": round(float(timing.drift_ppm), 3)}
        offset = {} if timing.method != "reference" else {k: entry[k] for k in ("offset_frames",) if k in entry}
        rest = {k: v for k, v in entry.items() if k not in ("start", "drift_ppm", "offset_frames")}
        views.append(rest | offset | {key: value for key, value in keys.items() if value})
    return write_table(folder, table | {"views": views})


def _sound(take: Take, view: View, movie_sound: MovieSound | None) -> Sound | None:
    wav = take.folder / f"{view.name}.wav"
    if wav.is_file():
        return read_wav(wav)
    return movie_sound(take.folder / view.movie) if view.movie is not None and movie_sound is not None else None


def _timing(view: View, start_s: float, sigma_s: float, drift_ppm: float, method: str) -> ViewTiming:
    return ViewTiming(view=view.name, start_s=start_s, sigma_s=sigma_s, drift_ppm=drift_ppm, method=method)


def _placed(take: Take, view: View, offset_s: float, drift: float, sigma_s: float, method: str) -> ViewTiming:
    """A view that began `offset_s` after the reference view by its clock, on the take's clock: T = T₀ + (1 + k₀) t."""
    reference = take.views[take.reference]
    slow = 1 + 1e-6 * reference.drift_ppm
    start_s = _zero(reference, _rate(take)) + slow * offset_s
    return _timing(view, start_s, sigma_s, 1e6 * (slow * (1 + drift) - 1), method)


class _Lights:
    """The changes of the light in the views of a take, each found when it is needed."""

    def __init__(self, take: Take) -> None:
        self._take, self._found = take, dict[str, tuple[tuple[LightChange, ...], Clock]]()

    def timing(self, view: View, monitor: Monitor) -> ViewTiming | None:
        """The beginning of a view by the light; None where it does not change alike in it and the reference view."""
        a, a_clock = self._of(self._take.views[self._take.reference], monitor)
        b, b_clock = self._of(_unplaced(view), monitor) if a else ((), a_clock)
        lit = offset_by_light(a, b, _moments(a, a_clock), _moments(b, b_clock)) if b else None
        return None if lit is None else _timing(view, lit.offset_s, lit.sigma_s, 1e6 * lit.drift, "light")

    def _of(self, view: View, monitor: Monitor) -> tuple[tuple[LightChange, ...], Clock]:
        if view.name not in self._found:
            sequence, clock = _timed(self._take, view)
            brightness = brightness_of(sequence, self._take.rows_at(0), monitor)
            known = abs(clock.readout_s / clock.period_s) if clock.readout_s else None
            self._found[view.name] = light_changes(brightness[:, ::-1] if clock.readout_s < 0 else brightness, known), clock
        return self._found[view.name]


class _Motions:
    """The motion in the views of a take, found when it is needed."""

    def __init__(self, take: Take) -> None:
        self._take, self._found = take, dict[str, tuple[np.ndarray, np.ndarray]]()

    def timing(self, lost: ViewTiming, reference: ViewTiming, monitor: Monitor) -> ViewTiming:
        """The beginning of a view that is `lost`, where the same motion is seen in it and the reference view, and the rays confirm it."""
        view = next(v for v in self._take.views if v.name == lost.view)
        a = self._of(self._take.views[self._take.reference], monitor)
        b = self._of(_unplaced(view), monitor)
        pair = replace(self._take, views=(self._take.views[self._take.reference], view), reference_view=reference.view)
        for offset_s in offsets_by_motion(a[0], b[0], a[1], b[1]):
            candidate = _timing(view, offset_s, MOTION_SIGMA_S, 0.0, "motion")
            try:
                found = _with_rays(pair, [reference, candidate], monitor)[1]
            except InputError:  # the views would have no frame in common
                continue
            if found.method == "motion and rays":
                return found
        return lost

    def _of(self, view: View, monitor: Monitor) -> tuple[np.ndarray, np.ndarray]:
        """The energies (n − 1,) of a view, and their times (n − 1,)."""
        if view.name not in self._found:
            sequence, clock = _timed(self._take, view)
            energy = energy_of(sequence, self._take.rows_at(0), monitor)
            self._found[view.name] = energy, np.array([clock.time_s(n + 0.5) for n in range(len(energy))])
        return self._found[view.name]


def _unplaced(view: View) -> View:
    """The view on its own clock: as if it had begun with the take."""
    return replace(view, start_s=0.0, drift_ppm=0.0, offset_frames=0)


def _timed(take: Take, view: View) -> tuple[ImageSequence, Clock]:
    """The images of a view, and its clock."""
    size_px = read_rig(take.rig_path)[view.name].size_px if take.rig_path.is_file() else None
    sequence = open_sequence(take.folder, images=view.images, movie=view.movie, view=view.name, size_px=size_px)
    timed = replace(take, views=(replace(view, fps=view.fps or _rate(take)),))
    return sequence, clocks_of(timed, (sequence,))[0]


def _moments(changes: Sequence[LightChange], clock: Clock) -> np.ndarray:
    """The times (n, 2) of changes by a clock, and the intervals of the images then."""
    times = [(clock.time_s(c.image), clock.time_s(c.image + 0.5) - clock.time_s(c.image - 0.5)) for c in changes]
    return np.array(times).reshape(-1, 2)


def _by_time_code(take: Take, view: View) -> ViewTiming | None:
    """The beginning by the time codes of both movies; None where there are none, or they cannot be compared."""
    a, b = (_time_code(take, v) for v in (take.views[take.reference], view))
    offset_s = started_after(a, b) if a and b else None
    if a is None or b is None or offset_s is None:
        return None
    return _placed(take, view, offset_s, 0.0, float(np.hypot(a.frame_s, b.frame_s) / np.sqrt(12)), "time code")


def _time_code(take: Take, view: View) -> TimeCode | None:
    return None if view.movie is None else read_time_code(take.folder / view.movie)


def _rate(take: Take) -> float:
    """Images per second of a view without a rate of its own."""
    return take.fps / take.field_layout.per_image


def _distance_m(take: Take, view: View) -> float:
    if not take.rig_path.is_file():
        return USUAL_DISTANCE_M
    rig = read_rig(take.rig_path)
    return float(np.linalg.norm(rig[view.name].centre_m - rig[take.reference_view].centre_m))


def _lost(take: Take, view: View, a: Sound | None, b: Sound | None, *, sounded: bool) -> ViewTiming:
    if a is None or b is None:
        name = take.reference_view if b is not None else view.name
        track = ", and no track in its movie" if sounded and view.movie is not None else ""
        why = f"there is no sound of {name} (no {name}.wav{track})"
    elif a.silent or b.silent:
        why = f"the sound of {view.name if b.silent else 'the reference view'} is silent"
    else:
        why = "its sound has nothing in common with that of the reference view"
    why += "; nor does the light change alike in both, nor have both movies a time code"
    advice = "Clap once, or switch a lamp, at the beginning of a recording, or give its `start` in take.toml."
    return ViewTiming(view=view.name, start_s=np.nan, sigma_s=np.inf, drift_ppm=0.0, method="", problem=f"{why}. {advice}")


def with_starts(take: Take, timings: Mapping[str, ViewTiming]) -> Take:
    """The take with the beginnings that were found."""
    found = {name: t for name, t in timings.items() if t.found and t.method != "reference"}
    views = tuple(
        replace(v, start_s=found[v.name].start_s, drift_ppm=found[v.name].drift_ppm, offset_frames=0) if v.name in found else v
        for v in take.views
    )
    return replace(take, views=views)


def _with_rays(take: Take, timings: Sequence[ViewTiming], monitor: Monitor) -> tuple[ViewTiming, ...]:
    """The beginnings improved by the rays of moving points, where these are exact enough."""
    started = with_starts(take, {t.view: t for t in timings})
    views = tuple(replace(v, fps=v.fps or _rate(take)) for v in started.views)  # with clocks, views may differ in length
    clicks = replace(started.clicks, joints={}, surface=())
    started = replace(started, views=views, clicks=clicks, keyframes=(), frames=None)  # frames may be those of wrong starts
    footage = open_take(started)
    offsets = estimate_offsets(footage.single(), monitor)
    return tuple(_improved(started, footage, t, o) for t, o in zip(timings, offsets))


def _improved(take: Take, footage: Footage, timing: ViewTiming, offset: TimeOffset) -> ViewTiming:
    rate = footage.single().take.fps
    late_s, sigma_s = offset.delay_frames / rate, float(np.hypot(TRACKING * offset.sigma_frames, LEAST_IMAGES)) / rate
    if timing.method == "reference" or offset.method != "rays" or sigma_s * rate > MOST_RAYS_SIGMA:
        return timing if timing.found else replace(timing, problem=f"too few moving points can be matched, and {timing.problem}")
    if timing.found and abs(late_s) > max(CONTRADICTION * np.hypot(sigma_s, timing.sigma_s), IMAGE_LATENESS_S):
        why = f"its {timing.method} and the rays of moving points contradict each other by {1e3 * late_s:+.0f} ms"
        advice = f"Is its {timing.method} that of this recording, and the rig that of these cameras?"
        return replace(timing, method="", problem=f"{why}. {advice}")
    view = next(v for v in take.views if v.name == timing.view)
    before_s = timing.start_s if timing.found else _zero(view, rate)
    method = " and ".join(dict.fromkeys([*timing.method.split(" and "), "rays"])) if timing.found else "rays"
    return replace(timing, start_s=before_s + late_s, sigma_s=sigma_s, method=method, problem="")


def _zero(view: View, rate: float) -> float:
    """The moment of image 0 as take.toml has it."""
    return view.start_s - view.offset_frames / (view.fps or rate)
