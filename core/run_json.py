"""run.json read back: checked once, so that whoever looks into it can rely on what stands where. It may come from a stranger."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import store
from .errors import InputError

FORMAT, VERSION = "tricap-run", 1
KINDS: dict[str, type | tuple[type, ...]] = {
    "take": str, "frames": list, "fps": (int, float), "views": list, "settings": dict, "inputs": dict, "stages": dict, "warnings": list,
}  # fmt: skip
FIGURES = {  # which a finished stage has
    "measure": ("frames", "points_per_frame", "residual_px", "sigma_mm"),
    "track": ("trajectories", "mean_length_frames"),
    "fit": ("joint_sigma_mm",),
}
MOST = 1e12  # no figure of ours comes near


def read_run(path: Path) -> dict[str, Any]:
    """The table in a run.json; what it has of the names in `KINDS` is of that kind, and a finished stage has its figures.

    Raises:
        InputError: it is missing, damaged, or of another version.
    """
    run = store.read_json(path)
    if not isinstance(run, dict) or run.get("format") != FORMAT or run.get("version") != VERSION:
        raise InputError(f"{path} was not written by this version of Tricap; choose another folder, or --restart.")
    odd = next((name for name, kind in KINDS.items() if name in run and not isinstance(run[name], kind)), None)
    odd = odd or _odd_table(run) or _odd_stage(run.get("stages", {}))
    if odd is not None:
        raise InputError(f"{path} is damaged: “{odd}” cannot be what it says; remove the file and run again.")
    return run


def _odd_table(run: Mapping[str, Any]) -> str | None:
    if any(not isinstance(table, dict) for table in run.get("settings", {}).values()):
        return "settings"
    frames = run.get("frames", [0, 0])
    if len(frames) != 2 or any(type(f) is not int for f in frames) or not 0 <= frames[1] - frames[0]:
        return "frames"
    texts = {"inputs": run.get("inputs", {}).values(), "warnings": run.get("warnings", []), "views": run.get("views", [])}
    return next((name for name, values in texts.items() if any(not isinstance(v, str) for v in values)), None)


def _odd_stage(stages: Mapping[str, Any]) -> str | None:
    """The first stage with an entry that no run writes."""
    for stage, entry in stages.items():
        if not isinstance(entry, dict) or not isinstance(entry.get("key", ""), str) or not isinstance(entry.get("not_done", ""), str):
            return stage
        if "not_done" not in entry and any(not is_figure(entry.get(name)) for name in FIGURES.get(stage, ())):
            return stage
        counts = entry.get("frames", {}) if stage == "fit" else {}
        if not isinstance(counts, dict) or any(not is_figure(n) for n in counts.values()):
            return stage
    return None


def is_figure(value: Any) -> bool:
    """Whether a value is a number that can be shown and compared."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < MOST
