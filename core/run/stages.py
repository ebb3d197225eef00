"""The inputs of each stage, defined once: a run removes, and the panel marks as stale, exactly the results that a change affects.

The key of a stage is a digest of everything that its result depends on, including the earlier stages. run.json stores the key with which
each stage ran; a stage is stale when its current key differs. Footage enters a key by file names, sizes and modification times (an
export of the same size is another file). Because a copy of a project has other times, run.json also stores each key with the content of
the files in place of their times: where only these differ, the stage is done (`known_keys`). Checkpoints compare the content, too.
"""

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..body.model_file import model_files
from ..fitting.settings import ALGORITHM
from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..foundation.settings import to_table
from ..results.films import FILMS
from ..surface import starts
from ..take.footage import Footage
from ..take.surface_clicks import surface_clicks
from ..take.take import NO_BODY, FrameClicks, Take, View
from ..tracking import track
from .file_digests import reads_content

STAGES = ("measure", "track", "fit")


Stamp = Callable[[Path], tuple[str, int, int | str]]  # name, size, and time of modification or digest of a file
CONTENT = "content"  # of a stage in run.json: its key, with the content of files
STAMPED = "stamped"  # the key, with times, of a copy of these files that was found to be the same


@dataclass(frozen=True, kw_only=True)
class StageInput:
    """The inputs and files of a stage that no earlier stage has."""

    settings: tuple[str, ...]  # groups of knobs
    take: Callable[[Footage, Mapping[str, Any], Stamp], Any]  # the parts of take, rig and footage as values with a `repr`
    files: tuple[str, ...]  # results in OUT, which a run removes once they are stale


def _measure_input(footage: Footage, settings: Mapping[str, Any], stamp: Stamp) -> Any:
    """The images, the cameras, the person's masks, and the clicks that the surface follows."""
    take = footage.take
    clicks = followed_clicks(take, settings)
    regions = [c for c in _corrections(take) if c[0] == "region"]
    views = [(v.name, v.offset_frames, *v.clock, *_timestamps(take, v, stamp)) for v in take.views]
    files = [[stamp(path) for path in s.files()] for s in footage.sequences]
    rig = store.digest(take.rig_path)
    rows = take.interlaced, take.first_field
    person = [(v.name, v.mask, v.masks, v.background, _person_files(take, v, stamp)) for v in take.views]
    swept: tuple[float | str, ...] = (footage.click_sigma_px,) if clicks.surface else ()  # how far about the clicked surface
    swept += footage.unlike_views
    return views, files, rig, rows, take.reference_view, footage.frames, _clicked(clicks), regions, person, starts.ALGORITHM, *swept


def followed_clicks(take: Take, settings: Mapping[str, Any]) -> FrameClicks:
    """The clicks that the surface follows, with the settings of a run; see `surface_clicks`."""
    return surface_clicks(take, automatic_seeds=settings["growing"].seed_spacing_px > 0)


def _timestamps(take: Take, view: View, stamp: Stamp) -> tuple[Any, ...]:
    return () if view.timestamps is None else (stamp(take.folder / view.timestamps),)


def _person_files(take: Take, view: View, stamp: Stamp) -> Any:
    pattern = view.mask or view.masks or view.background
    return [stamp(path) for path in sorted(bounded.matching(take.folder, pattern))] if pattern else []


def _track_input(footage: Footage, settings: Mapping[str, Any], stamp: Stamp) -> Any:
    return footage.take.fps, [c for c in _corrections(footage.take) if c[0] == "trajectory"], track.ALGORITHM


def _fit_input(footage: Footage, settings: Mapping[str, Any], stamp: Stamp) -> Any:
    take = footage.take
    model = take.body_model or NO_BODY
    own = store.digest(*model_files(model)) if model.endswith(".toml") else ""
    named = Path(model).name if own else model
    others = [] if followed_clicks(take, settings) is take.clicks else [_clicked(take.clicks)]  # the key of the surface lacks them
    return (
        named,
        own,
        tuple(sorted(take.locked)),
        sorted(take.limits.items()),
        others + [_clicked(k) for k in take.keyframes],
        _keypoints(take, stamp),
        ALGORITHM,
    )


STAGE_INPUTS: dict[str, StageInput] = {
    "measure": StageInput(settings=("timing", "enhance", "matching", "growing", "surface"), take=_measure_input, files=()),
    "track": StageInput(settings=("tracking",), take=_track_input, files=("trajectories.npz", "trajectories_raw.npz", "tracked")),
    "fit": StageInput(
        settings=("fitting", "skin"),
        take=_fit_input,
        files=("frames.csv", "joints.csv", "motion.csv", "body.toml", "skin", "outlines", "report", *FILMS, "body.blend"),
    ),
}
# Groups in no stage's key: a preset enters by its settings, the outlines of `tricap contour` by their content, chosen points do not.
WITHOUT_STAGE = ("method", "contour", "key_points")
STAGE_FILES = tuple(name for own in STAGE_INPUTS.values() for name in own.files)


def time_stamp(path: Path) -> tuple[str, int, int]:
    """Name, size, and modification time in nanoseconds."""
    state = path.stat()
    return path.name, state.st_size, state.st_mtime_ns


def coarse_time_stamp(path: Path) -> tuple[str, int, int]:
    """Name, size, and modification time in whole seconds, the resolution of some file systems."""
    name, size, time_ns = time_stamp(path)
    return name, size, time_ns // 1_000_000_000


def stamp_for(footage: Footage) -> Stamp:
    """What stands for a file of a take: where other times alone do not matter, because its content is read, times are exact. Otherwise a
    copy to another file system would be another take."""
    return time_stamp if reads_content(footage) else coarse_time_stamp


def stage_keys(footage: Footage, settings: Mapping[str, Any], out: Path, stamp: Stamp | None = None) -> dict[str, str]:
    """The key of every stage, for opened footage, the settings of a run, and the contours in its folder OUT, whose digest is the
    second word of the fit's key. `stamp`: what stands for a file, by default its time.

    Raises:
        InputError: footage, rig or model are missing.
    """
    keys, before = {}, ""
    try:
        stamp = stamp or stamp_for(footage)
        for stage, own in STAGE_INPUTS.items():
            inputs = [settings[name] for name in own.settings], own.take(footage, settings, stamp)
            before = keys[stage] = store.digest(before, repr(inputs))
        contours = sorted((out / "contours").glob("*.csv"))
        keys["fit"] += f" {store.digest(*contours, largest=bounded.TABLE_BYTES)}" if contours else ""
    except OSError as error:
        raise InputError(f"Cannot read {error.filename}: {error.strerror or error}.") from error
    return keys


def known_keys(keys: Mapping[str, str], run: Mapping[str, Any], content: Callable[[], Mapping[str, str]]) -> dict[str, str]:
    """The keys, where only the times of files differ from those in a run.json with the key there. `content`: the keys by the content of
    files, of none or all stages; it is called only where the answer depends on it. Results of earlier versions have no such keys."""
    known, by_content = dict(keys), None
    for stage, entry in run.get("stages", {}).items():
        (now, contours), then = _words(keys.get(stage, "")), _words(entry.get("key", ""))[0]
        if stage not in keys or now == then or not entry.get(CONTENT):
            continue
        same = now == _words(entry.get(STAMPED, ""))[0]
        if not same:
            by_content = content() if by_content is None else by_content
            same = _words(by_content.get(stage, ""))[0] == _words(entry[CONTENT])[0]
        if same:
            known[stage] = f"{then} {contours}".rstrip()
    return known


def _words(key: str) -> tuple[str, str]:
    """A key without the digest of the contours, and this digest."""
    own, _, contours = key.partition(" ")
    return own, contours


def command_of(footage: Footage, settings: Mapping[str, Any]) -> str:
    """The command that repeats the run; it also repeats the settings of take.toml, which is harmless."""
    options = [
        f"--set {group}.{name}={shlex.quote(json.dumps(value) if isinstance(value, bool) else str(value))}"
        for group, chosen in settings.items()
        for name, value in to_table(chosen).items()
        if value != to_table(type(chosen)())[name]
    ]
    frames = f"--frames {footage.frames.start}:{footage.frames.stop}"
    return " ".join(["tricap run", shlex.quote(str(footage.take.folder)), "--out OUT", frames, *options])


def stage_of(group: str) -> str:
    """The first stage that a group of settings affects."""
    return next(stage for stage, own in STAGE_INPUTS.items() if group in own.settings)


def valid_stages(run: Mapping[str, Any], keys: Mapping[str, str], *, ignore_contours: bool = False) -> dict[str, Any]:
    """The stages in a run.json that ran with these keys; the report is valid if the fit is, and so are tracks that were guided by the body.

    `ignore_contours`: also accept a body that was fitted with other contours, or none.
    """
    stages: dict[str, Any] = run.get("stages", {})
    keys = {**keys, "report": keys["fit"]}

    def is_valid(name: str, entry: Mapping[str, Any]) -> bool:
        key, now = str(entry.get("key", "")), keys.get(name, "")
        return bool(key) and (key == now or (ignore_contours and _words(key)[0] == _words(now)[0]))

    valid = {name: entry for name, entry in stages.items() if is_valid(name, entry)}
    if "fit" not in valid and "tracked_again" in stages.get("fit", {}):
        valid.pop("track", None)
    return valid


def _keypoints(take: Take, stamp: Stamp) -> Any:
    return [(repr(s), [stamp(path) for path in sorted(bounded.matching(take.folder, s.files))]) for s in take.keypoints]


def _clicked(clicks: FrameClicks) -> Any:
    return clicks.frame, clicks.table()


def _corrections(take: Take) -> list[Any]:
    return [(c.kind, c.view, c.frames, c.xy_px.tolist()) for c in take.corrections]
