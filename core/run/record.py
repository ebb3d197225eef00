"""The content of run.json: the take, settings and inputs of a run, the command that repeats it, and figures of its results.

Also frames.csv: the quality of every frame in one row, for the panel's graph and for finding doubtful frames.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..body.limb_words import FEW_FRAMES, counts, frame_list, guessed_frames, limb_words, to_click
from ..body.motion import FITTED, GUESSED, INFERRED, PARTIAL, SEEN, BodyFit, BodyMotion
from ..fitting.inputs.start_joints import StartJoints
from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..foundation.settings import to_table
from ..geometry.robust import finite_median
from ..matching.foreground import Foreground
from ..surface.frames import FrameSummary
from ..take.footage import Footage
from ..tracking.corrections import odd_regions
from ..tracking.settings import TrackStatus
from ..tracking.trajectories import Trajectories
from .stages import command_of


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
        "reference_note": footage.reference_note,
        "model": take.body_model,
        "settings": {name: to_table(value) for name, value in settings.items()},
        "inputs": {"take.toml": store.digest(take.folder / "take.toml"), take.rig_path.name: store.digest(take.rig_path)},
        "rig": {k: v for k, v in footage.rig.metadata.items() if isinstance(v, (str, int, float))},
        "repeat": command_of(footage, settings),
        "stages": {},
        "warnings": [*footage.rig.remarks, *odd_regions(take.corrections, footage.rig)],
    }


def surface_figures(
    summaries: Sequence[FrameSummary], foreground: Foreground | None, reduction: float, distance_m: float | None
) -> dict[str, Any]:
    """Figures of the measured frames: number, points, residuals, sigma, how the person was separated from the background, by which factor
    the images were reduced, and for a person at which distance [m]; None: at any."""
    return {
        "frames": len(summaries),
        "points_per_frame": float(np.mean([f.points for f in summaries])),
        "residual_px": finite_median([f.residual_px for f in summaries], 0.0),
        "sigma_mm": 1e3 * finite_median([f.sigma_m for f in summaries], 0.0),
        "foreground": foreground.method if foreground else "",
        "background_planes": len(foreground.planes) if foreground else 0,
        "reduction": round(reduction, 3),
        "distance_m": distance_m,
    }


def track_figures(kept: Trajectories, reasons: Mapping[int, int]) -> tuple[dict[str, Any], list[str]]:
    """Figures of the kept trajectories: number, length, sigma, counts of the reasons for removals; and warnings."""
    seen, started = kept.visible, sum(reasons.values())
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
        "sigma_mm": 1e3 * finite_median(kept.sigma_m[seen], 0.0),
        "reasons": why,
    }
    return figures, warnings


def fit_figures(body: BodyFit, silhouettes: Mapping[str, Any], tracked_again: Mapping[str, Any]) -> dict[str, Any]:
    """Figures of the fitted body; those of outlines, silhouettes and the second tracking only where there are any."""
    figures = {
        "frames": frame_states(body),
        "iterations": body.iterations,
        "converged": body.converged,
        "sigma0": finite_median(body.motion.sigma0, 0.0),
        "joint_sigma_mm": 1e3 * finite_median(body.motion.joint_sigma_m, 0.0),
        "joint_frame_sigma_mm": 1e3 * finite_median(body.motion.joint_frame_sigma_m, 0.0),
        "limbs": counts(limb_words(body.motion.joint_names, body.motion.known)),
    }
    if len(body.outline_m):
        figures["outline_mm"] = 1e3 * finite_median(body.outline_m, 0.0)
    return figures | ({"silhouettes": silhouettes} if silhouettes else {}) | ({"tracked_again": tracked_again} if tracked_again else {})


LEAST_SEEN = 0.5  # of the frames
LIMBS = {"upper_arm": "arm", "forearm": "forearm", "thigh": "leg", "shin": "lower leg"}


def start_figures(start: StartJoints) -> dict[str, Any]:
    """The start that was found without clicks, for run.json."""
    return {
        "frame": start.frame,
        "model": start.model,
        "probability": round(start.probability, 4),
        "rivals": {name: round(p, 4) for name, p in start.rivals.items()},
        "stature": round(start.stature, 4),
        "unsure": list(start.unsure),
        "joints_m": {name: np.round(xyz, 4).tolist() for name, xyz in start.xyz_m.items()},
    }


def frame_states(body: BodyFit) -> dict[str, int]:
    """How many frames are in each state."""
    return {word: body.motion.status.count(word) for word in sorted(set(body.motion.status))}


def fit_warnings(body: BodyFit) -> list[str]:
    """What is doubtful about the fit as a whole: frames that rest on prediction, limbs that are guessed, contradicted or seldom seen, an
    adjustment that did not converge."""
    motion = body.motion
    predicted = ", ".join(f"{n} {word}" for word, n in frame_states(body).items() if word not in (FITTED, PARTIAL))
    warnings = [f"Frames in which the body rests on prediction: {predicted}."] if predicted else []
    for limb, row in limb_words(motion.joint_names, motion.known).items():
        frames, seen = guessed_frames(motion.frames.tolist(), row), row.count(SEEN)
        if len(frames) > FEW_FRAMES:
            warnings.append(
                f"The place of the {limb} is guessed in {len(frames)} frames ({frame_list(frames)}), for the images do not show where it "
                f"is: look at it there, and click {_joints(motion, limb, GUESSED)} in a frame in which a view shows it."
            )
        elif seen < LEAST_SEEN * len(row) and len(row) - seen > FEW_FRAMES:
            warnings.append(
                f"The {limb} is seen well in {seen} of {len(row)} frames only, and inferred or guessed in the others: look at it, and "
                f"where it is wrong click {_joints(motion, limb, INFERRED)}."
            )
    for bone, frames in body.contradicted.items():
        if len(frames) > FEW_FRAMES:
            warnings.append(
                f"The images contradict the {limb_name(bone)} in {len(frames)} frames ({frame_list(frames)}): look at it there, and click "
                "its joints in one of these frames."
            )
    if not body.converged:
        warnings.append(f"The fit has not converged after {body.iterations} steps: look at the pictures, and raise fitting.sequence_steps.")
    return warnings


def _joints(motion: BodyMotion, limb: str, word: str) -> str:
    return " and ".join(to_click(motion.joint_names, motion.known, limb, word))


def limb_name(bone: str) -> str:
    """A limb in words, by its first bone: "upper_arm.R" -> "right arm"."""
    part, _, side = bone.partition(".")
    return " ".join([{"L": "left", "R": "right"}.get(side, ""), LIMBS.get(part, part.replace("_", " "))]).strip()


COLUMNS = ("points", "sigma_mm", "residual_px", "tracks", "track_sigma_mm", "fit_sigma0", "joint_sigma_mm")
FEWER_IS_WORSE = ("points", "tracks")
REASONS = {
    "points": "few points",
    "sigma_mm": "points uncertain",
    "residual_px": "large residuals",
    "tracks": "few tracks",
    "track_sigma_mm": "tracks uncertain",
    "fit_sigma0": "body off the points",
    "joint_sigma_mm": "joints uncertain",
}
DOUBTFUL = 1.5  # times worse than the median frame
MIN_RATIO = 0.01  # of a value to the median, where fewer is worse


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameTable:
    """The quality of T frames: medians over a frame's points, NaN where a stage did not run or has nothing in a frame."""

    frames: np.ndarray  # (T,)
    values: dict[str, np.ndarray]  # (T,) by COLUMNS
    fit: tuple[str, ...]  # (T,) "" where no body was fitted, else a status of the fit

    def badness(self) -> tuple[np.ndarray, tuple[str, ...]]:
        """How many times worse than the median frame each frame is (T,), in its worst value; and the reasons, "" unless doubtful."""
        ratio = np.ones((len(COLUMNS), len(self.frames)))
        for i, name in enumerate(COLUMNS):
            value = self.values[name]
            known = np.isfinite(value) & (value > 0)
            if known.any():
                middle = float(np.median(value[known]))
                worse = middle / np.maximum(value, MIN_RATIO * middle) if name in FEWER_IS_WORSE else value / middle
                ratio[i] = np.where(np.isfinite(value), worse, 1.0)
        worst = ratio.argmax(axis=0) if len(self.frames) else np.zeros(0, dtype=int)
        badness = ratio.max(axis=0)
        reasons = [REASONS[COLUMNS[k]] if r >= DOUBTFUL else "" for k, r in zip(worst, badness)]
        for t, state in enumerate(self.fit):
            if state not in ("", FITTED):
                badness[t], reasons[t] = max(badness[t], 2 * DOUBTFUL), f"fit {state}"
        return badness, tuple(reasons)


def _badness(table: FrameTable) -> tuple[np.ndarray, tuple[str, ...]]:
    """`FrameTable.badness`, where a state of the fit that most frames share does not single out a frame."""
    usual = {state for state in table.fit if 2 * table.fit.count(state) > len(table.fit)}
    return replace(table, fit=tuple("" if state in usual else state for state in table.fit)).badness()


def doubt(table: FrameTable, guessed: Mapping[str, Sequence[int]]) -> tuple[np.ndarray, tuple[str, ...]]:
    """How doubtful each frame of the table is (T,), as `FrameTable.badness`, and why; `guessed`: the frames in which a limb is guessed."""
    badness, reasons = _badness(table)
    limbs: dict[int, list[str]] = {}
    for limb, frames in guessed.items():
        for frame in frames:
            limbs.setdefault(frame, []).append(limb)
    there = [limbs.get(frame, []) for frame in table.frames.tolist()]
    worse = np.where([len(names) > 0 for names in there], 2 * DOUBTFUL, 1.0)
    words = tuple(f"{' and '.join(names)} guessed" if names else reason for names, reason in zip(there, reasons))
    return np.maximum(badness, worse), words


def doubtful_stretches(table: FrameTable | None, guessed: Mapping[str, Sequence[int]]) -> list[tuple[int, int, str]]:
    """First and last frame of every stretch in which a limb is guessed, and of every run of doubtful frames, with the reason of the worst
    one; in the order of the first frames."""
    found = [(first, last, f"{limb} guessed") for limb, frames in guessed.items() for first, last in _successive(frames)]
    if table is not None:
        badness, reasons = _badness(table)
        of = {int(frame): (bad, reason) for frame, bad, reason in zip(table.frames, badness.tolist(), reasons) if reason}
        for first, last in _successive(list(of)):
            found.append((first, last, max((of[frame] for frame in range(first, last + 1)), key=lambda row: row[0])[1]))
    return sorted(found)


def _successive(frames: Sequence[int]) -> list[tuple[int, int]]:
    """First and last of every run of successive frames."""
    found: list[tuple[int, int]] = []
    for frame in frames:
        if found and found[-1][1] == frame - 1:
            found[-1] = (found[-1][0], frame)
        else:
            found.append((frame, frame))
    return found


def frame_table(summaries: Sequence[FrameSummary], trajectories: Trajectories | None, body: BodyFit | None) -> FrameTable:
    """The table of a run, as far as it has come. Points are counted before corrections. Without measured frames, those of the body."""
    frames = np.array([f.frame for f in summaries] if summaries or body is None else body.motion.frames, dtype=np.int64)
    values = {name: np.full(len(frames), np.nan) for name in COLUMNS}
    for i, summary in enumerate(summaries):
        values["points"][i], values["sigma_mm"][i], values["residual_px"][i] = summary.points, 1e3 * summary.sigma_m, summary.residual_px
    if trajectories is not None:
        for t in np.flatnonzero(np.isin(trajectories.frames, frames)):
            at = np.searchsorted(frames, trajectories.frames[t])
            values["tracks"][at] = trajectories.visible[t].sum()
            values["track_sigma_mm"][at] = 1e3 * finite_median(trajectories.sigma_m[t][trajectories.visible[t]])
    fit = [""] * len(frames)
    if body is not None:
        motion = body.motion
        for t in np.flatnonzero(np.isin(motion.frames, frames)):
            at = int(np.searchsorted(frames, motion.frames[t]))
            fit[at] = motion.status[t]
            values["fit_sigma0"][at], values["joint_sigma_mm"][at] = motion.sigma0[t], 1e3 * finite_median(motion.joint_sigma_m[t])
    return FrameTable(frames=frames, values=values, fit=tuple(fit))


def doubtful_frames(table: FrameTable, body: BodyFit | None) -> dict[int, str]:
    """Why frames are doubtful, the worst first: those in which the images contradict a limb or do not show where it is, then those worse
    than the median frame."""
    contradicted: dict[int, list[str]] = {}
    for bone, frames in body.contradicted.items() if body is not None else ():
        for frame in frames:
            contradicted.setdefault(int(frame), []).append(limb_name(bone))
    found = {frame: f"the images contradict the {' and the '.join(limbs)}" for frame, limbs in contradicted.items()}
    for frame, limbs in _guessed(body).items() if body is not None else ():
        found.setdefault(frame, f"the {' and the '.join(limbs)} {'are' if len(limbs) > 1 else 'is'} guessed")
    badness, reasons = _badness(table)
    for t in np.argsort(-badness, kind="stable").tolist():
        if reasons[t]:
            found.setdefault(int(table.frames[t]), reasons[t])
    return found


def _guessed(body: BodyFit) -> dict[int, list[str]]:
    """The limbs that are guessed, by frame."""
    found: dict[int, list[str]] = {}
    for limb, row in limb_words(body.motion.joint_names, body.motion.known).items():
        for frame in guessed_frames(body.motion.frames.tolist(), row):
            found.setdefault(frame, []).append(limb)
    return found


def write_frame_table(path: Path, table: FrameTable) -> None:
    """Write frames.csv; NaN gives an empty cell."""
    lines = [",".join(("frame", *COLUMNS, "fit"))]
    for t, frame in enumerate(table.frames):
        cells = [f"{v:.4g}" if np.isfinite(v) else "" for v in (table.values[name][t] for name in COLUMNS)]
        lines.append(",".join((str(int(frame)), *cells, table.fit[t])))
    store.write_text(path, "\n".join(lines) + "\n")


def read_frame_table(path: Path) -> FrameTable:
    """Read frames.csv.

    Raises:
        InputError: it is missing or damaged.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))))
        return FrameTable(
            frames=np.array([int(r["frame"]) for r in rows], dtype=np.int64),
            values={name: np.array([float(r[name]) if r[name] else np.nan for r in rows]) for name in COLUMNS},
            fit=tuple(r["fit"] or "" for r in rows),
        )
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}; run the take again.") from error
    except (KeyError, TypeError, ValueError, OverflowError, csv.Error) as error:
        raise InputError(f"{path} is damaged; run the take again.") from error
