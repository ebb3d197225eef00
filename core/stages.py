"""What each stage depends on, said once: the run removes and the panel calls stale exactly what a change concerns.

The key of a stage is a digest of all that its result depends on, the stages before it included. run.json carries the key with which each
stage was done; a stage is stale when its key now is another. Footage counts by names, sizes and when its files
were written (an export of the same size is another one); checkpoints look at its content.
"""

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import following, measuring, store
from .body.model_file import model_files
from .errors import InputError
from .fitting.settings import ALGORITHM
from .settings import to_table
from .take import Footage, Seeds, Take, View

STAGES = ("measure", "track", "fit")


@dataclass(frozen=True, kw_only=True)
class StageInput:
    """What concerns a stage and no stage before it."""

    settings: tuple[str, ...]  # groups of knobs
    take: Callable[[Footage], Any]  # what take.toml, rig.toml and the footage say, as values with a `repr`
    files: tuple[str, ...]  # what the stage leaves in OUT and no run may leave standing once it is stale


def _seen(footage: Footage) -> Any:
    """The images, the cameras, and where the person is."""
    take = footage.take
    regions = [c for c in _corrections(take) if c[0] == "region"]
    views = [(v.name, v.offset_frames) for v in take.views]
    files = [[_stamp(path) for path in s.files()] for s in footage.sequences]
    rig = store.digest(take.rig_path)
    rows = take.interlaced, take.first_field
    person = [(v.name, v.mask, v.masks, v.background, _person_files(take, v)) for v in take.views]
    return views, files, rig, rows, take.reference_view, footage.frames, _clicked(take.seeds), regions, person, measuring.ALGORITHM


def _person_files(take: Take, view: View) -> Any:
    pattern = view.mask or view.masks or view.background
    return [_stamp(path) for path in sorted(take.folder.glob(pattern))] if pattern else []


def _followed(footage: Footage) -> Any:
    return footage.take.fps, [c for c in _corrections(footage.take) if c[0] == "trajectory"], following.ALGORITHM


def _fitted(footage: Footage) -> Any:
    take = footage.take
    model = take.body_model
    own = store.digest(*model_files(model)) if model and Path(model).is_file() else ""
    return model, own, take.locked, sorted(take.limits.items()), [_clicked(k) for k in take.keyframes], _keypoints(take), ALGORITHM


STAGE_INPUTS: dict[str, StageInput] = {
    "measure": StageInput(settings=("timing", "enhance", "matching", "growing", "surface"), take=_seen, files=()),
    "track": StageInput(settings=("tracking",), take=_followed, files=("trajectories.npz", "trajectories_raw.npz")),
    "fit": StageInput(
        settings=("fitting", "skin"),
        take=_fitted,
        files=("frames.csv", "joints.csv", "motion.csv", "body.toml", "skin", "report", "body.blend"),
    ),
}
# Groups of knobs that concern no stage: what `tricap contour` writes concerns the fit by its content, the tracks of chosen points nothing.
WITHOUT_STAGE = ("contour", "key_points")
STAGE_FILES = tuple(name for concern in STAGE_INPUTS.values() for name in concern.files)


def stage_keys(footage: Footage, settings: Mapping[str, Any], out: Path) -> dict[str, str]:
    """The key of every stage, for opened footage, the settings of a run, and the contours that were put into its folder OUT, which are the
    second word of the fit's key.

    Raises:
        InputError: footage, rig or model have gone.
    """
    keys, before = {}, ""
    try:
        for stage, concern in STAGE_INPUTS.items():
            said = [settings[name] for name in concern.settings], concern.take(footage)
            before = keys[stage] = store.digest(before, repr(said))
        contours = sorted((out / "contours").glob("*.csv"))
        keys["fit"] += f" {store.digest(*contours)}" if contours else ""
    except OSError as error:
        raise InputError(f"Cannot read {error.filename}: {error.strerror or error}.") from error
    return keys


def command_of(footage: Footage, settings: Mapping[str, Any]) -> str:
    """The command that runs this again; what take.toml says of settings need not be repeated, but does no harm."""
    said = [
        f"--set {group}.{name}={shlex.quote(json.dumps(value) if isinstance(value, bool) else str(value))}"
        for group, chosen in settings.items()
        for name, value in to_table(chosen).items()
        if value != to_table(type(chosen)())[name]
    ]
    frames = f"--frames {footage.frames.start}:{footage.frames.stop}"
    return " ".join(["tricap run", shlex.quote(str(footage.take.folder)), "--out OUT", frames, *said])


def stage_of(group: str) -> str:
    """The stage that a group of knobs concerns first."""
    return next(stage for stage, concern in STAGE_INPUTS.items() if group in concern.settings)


def valid_stages(run: Mapping[str, Any], keys: Mapping[str, str], *, ignore_contours: bool = False) -> dict[str, Any]:
    """The stages in a run.json that were done with these keys; the report is as good as the fit, and so are tracks that the body guided.

    `ignore_contours`: a body that was fitted with other contours, or none, is good enough.
    """
    stages: dict[str, Any] = run.get("stages", {})
    keys = {**keys, "report": keys["fit"]}

    def done_so(name: str, entry: Mapping[str, Any]) -> bool:
        key, now = str(entry.get("key", "")), keys.get(name, "")
        return bool(key) and (key == now or (ignore_contours and key.partition(" ")[0] == now.partition(" ")[0]))

    good = {name: entry for name, entry in stages.items() if done_so(name, entry)}
    if "fit" not in good and "tracked_again" in stages.get("fit", {}):
        good.pop("track", None)
    return good


def _stamp(path: Path) -> tuple[str, int, int]:
    """Name, size, and when it was written, in whole seconds: some file systems keep no less."""
    state = path.stat()
    return path.name, state.st_size, state.st_mtime_ns // 1_000_000_000


def _keypoints(take: Take) -> Any:
    return [(repr(s), [_stamp(path) for path in sorted(take.folder.glob(s.files))]) for s in take.keypoints]


def _clicked(seeds: Seeds) -> Any:
    clicks = [*seeds.joints.items(), *((f"surface {i}", at) for i, at in enumerate(seeds.surface))]
    return seeds.frame, [(name, sorted((view, xy.tolist()) for view, xy in at.items())) for name, at in clicks]


def _corrections(take: Take) -> list[Any]:
    return [(c.kind, c.view, c.frames, c.xy_px.tolist()) for c in take.corrections]
