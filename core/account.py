"""The content of run.json: the take, settings and inputs of a run, the command that repeats it, and figures of its results."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import store
from .settings import to_table
from .stages import command_of
from .take import Footage
from .tracking.settings import TrackStatus
from .tracking.trajectories import Trajectories


def new_record(footage: Footage, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The record of a run, without stages and warnings yet."""
    take = footage.take
    return {
        "take": str(take.folder),
        "frames": [footage.frames.start, footage.frames.stop],
        "fps": take.fps,
        "interlaced": take.interlaced,
        "views": [v.name for v in take.views],
        "reference_view": take.reference_view,
        "model": take.body_model,
        "settings": {name: to_table(value) for name, value in settings.items()},
        "inputs": {"take.toml": store.digest(take.folder / "take.toml"), take.rig_path.name: store.digest(take.rig_path)},
        "rig": {k: v for k, v in footage.rig.metadata.items() if isinstance(v, (str, int, float))},
        "repeat": command_of(footage, settings),
        "stages": {},
        "warnings": [],
    }


def track_figures(kept: Trajectories, reasons: Mapping[int, int]) -> tuple[dict[str, Any], list[str]]:
    """Figures of the kept trajectories: number, length, sigma, counts of the reasons for removals; and warnings."""
    seen, started = kept.seen, sum(reasons.values())
    count = int(seen.shape[1] if kept.track is None else len(np.unique(kept.track[seen])))
    why = {TrackStatus(r).words: n for r, n in sorted(reasons.items(), key=lambda found: -found[1])}
    warnings = []
    if kept.omitted:
        warnings.append(
            f"The {kept.omitted} shortest of {count + kept.omitted} trajectories are left out: the table of so many frames would be too "
            "large; run the take in pieces (--frames) to get all."
        )
    if not count and started:
        warnings.append(f"All {started} trajectories were removed, most of them as “{next(iter(why))}”.")
    figures = {
        "started": started,
        "trajectories": count,
        "points_per_frame": float(seen.sum(axis=1).mean()),
        "mean_length_frames": float(seen.sum() / count) if count else 0.0,
        "sigma_mm": 1e3 * median(kept.sigma_m[seen]),
        "reasons": why,
    }
    return figures, warnings


def median(values: Sequence[float] | np.ndarray) -> float:
    """The median of the finite values, 0 if there are none."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    return float(np.median(finite)) if len(finite) else 0.0
