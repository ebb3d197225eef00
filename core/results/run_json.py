"""Reads run.json and validates it once, so that its users can rely on its layout. The file may come from an untrusted source."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..foundation import bounded, store
from ..foundation.errors import InputError

FORMAT, VERSION = "tricap-run", 1
UNTIL = "until"  # the last stage that a command was to do
ASKS = "asks"  # what the user is asked before the run can go on
FIELD_TYPES: dict[str, type | tuple[type, ...]] = {
    "take": str, "frames": list, "fps": (int, float), "views": list, "settings": dict, "inputs": dict, "stages": dict, "warnings": list,
    "reference_note": str, "files": dict, "blend": list, "outlines": dict, "films": dict, UNTIL: str, ASKS: str,
}  # fmt: skip
STAGE_FIGURES = {  # figures that a finished stage must have
    "measure": ("frames", "points_per_frame", "residual_px", "sigma_mm"),
    "track": ("trajectories", "mean_length_frames"),
    "fit": ("joint_sigma_mm",),
}
SEEN = {"full": "the whole person is seen", "upper_body": "the images cut the person below"}  # why a model was chosen
JOINTS = "it has the joints that are located"
STAGE_WORDS = ("key", "content", "stamped", "not_done", "chosen_model", "surface")
LARGEST_FIGURE = 1e12  # far above every figure of a run
MOST_FRAMES = 10_000_000  # of a run


def read_run(path: Path) -> dict[str, Any]:
    """The table in a run.json, with fields of the types in `FIELD_TYPES` and the figures of each finished stage.

    Raises:
        InputError: it is missing, damaged, or of another version.
    """
    run = store.read_json(path)
    if not isinstance(run, dict) or run.get("format") != FORMAT:
        raise InputError(f"{path} was not written by Tricap; choose another folder for the results.")
    if run.get("version") != VERSION:
        raise InputError(f"{path} was not written by this version of Tricap; choose another folder, or --restart.")
    invalid = next((name for name, kind in FIELD_TYPES.items() if name in run and not isinstance(run[name], kind)), None)
    invalid = invalid or _invalid_table(run) or _invalid_stage(run.get("stages", {}))
    if invalid is not None:
        raise InputError(f"{path} is damaged: “{invalid}” is invalid; remove the file and run again.")
    return run


def notes_of(run: Mapping[str, Any]) -> list[str]:
    """What a run decided by itself: the reference view and the body model, a sentence each."""
    fit = run.get("stages", {}).get("fit", {})
    notes = [run.get("reference_note", "")]
    if "chosen_model" in fit:
        chosen = fit["chosen_model"]
        why = SEEN.get(chosen, JOINTS) if "start" in fit else JOINTS
        notes.append(f"The body is “{chosen}”: {why}. For another one, write `model` under [body] of take.toml, or choose it in step 3.")
    return [note for note in notes if note]


def _invalid_table(run: Mapping[str, Any]) -> str | None:
    if any(not isinstance(table, dict) for table in run.get("settings", {}).values()):
        return "settings"
    if not bounded.is_path(run.get("take", "")):
        return "take"
    if not _is_span(run.get("frames", [0, 0])):
        return "frames"
    sizes = run.get("files", {}).values()
    if any(not isinstance(size, list) or len(size) != 2 or any(type(n) is not int for n in size) for size in sizes):
        return "files"
    drawn = run.get("outlines", {}).values()
    if any(not isinstance(entry, dict) or any(not isinstance(text, str) for text in entry.values()) for entry in drawn):
        return "outlines"
    texts = {name: run.get(name, {}).values() for name in ("inputs", "films")}
    texts |= {name: run.get(name, []) for name in ("warnings", "views", "blend")}
    return next((name for name, values in texts.items() if any(not isinstance(v, str) for v in values)), None)


def _invalid_stage(stages: Mapping[str, Any]) -> str | None:
    """The first stage with an invalid entry."""
    for stage, entry in stages.items():
        if not isinstance(entry, dict) or any(not isinstance(entry.get(name, ""), str) for name in STAGE_WORDS):
            return stage
        if "not_done" not in entry and any(not is_figure(entry.get(name)) for name in STAGE_FIGURES.get(stage, ())):
            return stage
        counts = entry.get("frames", {}) if stage == "fit" else {}
        if not isinstance(counts, dict) or any(not is_figure(n) for n in counts.values()):
            return stage
        limbs = entry.get("limbs", {}) if stage == "fit" else {}
        if not isinstance(limbs, dict) or any(
            not isinstance(words, dict) or any(not is_figure(n) for n in words.values()) for words in limbs.values()
        ):
            return stage
        again = entry.get("fitted_again", []) if stage == "fit" else []
        if not isinstance(again, list) or not all(map(_is_span, again)):
            return stage
        if not isinstance(entry.get("fitted_with", {}), dict):
            return stage
    return None


def _is_span(value: Any) -> bool:
    """Whether a value is a first and a last frame, or the one after it, not too far apart for a run."""
    if not isinstance(value, list) or [type(frame) for frame in value] != [int, int]:
        return False
    return 0 <= value[1] - value[0] <= MOST_FRAMES and abs(value[0]) < LARGEST_FIGURE


def is_figure(value: Any) -> bool:
    """Whether a value is a finite number of plausible size."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < LARGEST_FIGURE
