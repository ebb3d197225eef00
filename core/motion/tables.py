"""Motion as tables for people and other programs: joints.csv and motion.csv.

joints.csv  one row per frame and joint: frame, time_s, joint, x, y, z [m, world], sigma [m, mean standard deviation of a coordinate],
            sigma_frame [m, the part of it that is not common to all frames], known (seen, inferred or guessed). Files of earlier versions
            lack the last two.
motion.csv  one row per frame: frame, time_s, one column per DOF (its name; degrees, base positions in metres), then one
            `sigma <name>` column each in the same unit. Angles are those of the bones' pose channels, 0 in the rest pose.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..body.limb_words import limb_joints
from ..body.motion import GUESSED, KNOWN, BodyMotion
from ..body.skeleton import Skeleton
from ..foundation import bounded, store
from ..foundation.arrays import check_sparse, frozen
from ..foundation.errors import InputError, damage_of
from .plausible import LARGEST_FRAME, check_times

SIGMA = "sigma"
JOINT_COLUMNS = ("frame", "time_s", "joint", "x", "y", "z", SIGMA)
LATER_COLUMNS = ("sigma_frame", "known")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MotionTable:
    """The content of motion.csv, in radians, and metres for the base."""

    frames: np.ndarray  # (T,)
    time_s: np.ndarray  # (T,)
    dof_names: tuple[str, ...]  # D
    values: np.ndarray  # (T, D)
    sigma: np.ndarray  # (T, D)

    def __post_init__(self) -> None:
        t, d = len(self.frames), len(self.dof_names)
        object.__setattr__(self, "frames", frozen(self.frames, (t,), np.int64, "frames"))
        for name, shape in dict(time_s=(t,), values=(t, d), sigma=(t, d)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointTable:
    """The content of joints.csv: positions (T, 3) [m], sigmas (T,) and words (T,) of KNOWN by joint; NaN and "" where a frame lacks the
    joint, or the file these columns."""

    frames: np.ndarray  # (T,)
    time_s: np.ndarray  # (T,)
    joints_m: Mapping[str, np.ndarray]
    sigma_m: Mapping[str, np.ndarray]
    frame_sigma_m: Mapping[str, np.ndarray]
    known: Mapping[str, tuple[str, ...]]


def write_joints(path: Path, motion: BodyMotion) -> None:
    """Write joints.csv.

    Raises:
        InputError: the file cannot be written.
    """
    rows = [
        [frame, f"{time:.6f}", joint, *(f"{c:.6f}" for c in X), f"{sigma:.6f}", f"{own:.6f}", word]
        for frame, time, places, sigmas, owns, words in zip(
            motion.frames, motion.time_s, motion.joints_m, motion.joint_sigma_m, motion.joint_frame_sigma_m, motion.known
        )
        for joint, X, sigma, own, word in zip(motion.joint_names, places, sigmas, owns, words)
    ]
    _write(path, (*JOINT_COLUMNS, *LATER_COLUMNS), rows)


def write_motion(path: Path, motion: BodyMotion, skeleton: Skeleton) -> None:
    """Write motion.csv. `skeleton` defines which DOFs are angles.

    Raises:
        InputError: the file cannot be written.
    """
    factor = _to_file(skeleton, motion.dof_names)
    names = ["frame", "time_s", *motion.dof_names, *(f"sigma {name}" for name in motion.dof_names)]
    rows = [
        [frame, f"{time:.6f}", *(f"{v:.6f}" for v in np.concatenate([values * factor, sigma * factor]))]
        for frame, time, values, sigma in zip(motion.frames, motion.time_s, motion.values, motion.sigma)
    ]
    _write(path, names, rows)


def read_motion(path: Path, skeleton: Skeleton) -> MotionTable:
    """Read motion.csv in the order of the skeleton's DOFs, whatever the order of the columns.

    Raises:
        InputError: the file is missing, lacks a column, or holds something that is no number.
    """
    header, rows = _read(path)
    names = skeleton.dof_names
    columns = [_column(header, name, path) for name in ("frame", "time_s", *names, *(f"sigma {name}" for name in names))]
    table = np.array([[_number(row[c], path, line) for c in columns] for line, row in enumerate(rows, 2)]).reshape(-1, len(columns))
    _check_sigmas(table[:, 2 + len(names) :], path)
    check_times(table[:, 0], 1.0, f"{path} has rows")
    d, factor = len(names), _to_file(skeleton, names)
    known = np.isfinite(table[:, 2 : 2 + d])
    if len(some := np.argwhere(~known & known.any(axis=1)[:, None])):
        row, column = some[0]
        raise InputError(
            f"Row {row + 2} of {path} has no number in the column “{names[column]}”, but in others; give it one, or none to any."
        )
    return MotionTable(
        frames=table[:, 0], time_s=table[:, 1], dof_names=names, values=table[:, 2 : 2 + d] / factor, sigma=table[:, 2 + d :] / factor
    )


def read_joints(path: Path, needs_sigma: bool = True) -> JointTable:
    """Read joints.csv, or a table like it, which may lack the sigmas.

    Raises:
        InputError: the file is missing, lacks a column, or holds something that is no number.
    """
    header, rows = _read(path)
    columns = {name: _column(header, name, path) for name in JOINT_COLUMNS if name != SIGMA or needs_sigma}
    frame_sigma, word = (header.index(name) if name in header else None for name in LATER_COLUMNS)
    times: dict[int, float] = {}
    found: dict[str, dict[int, list[float]]] = {}
    words: dict[str, dict[int, str]] = {}
    for line, row in enumerate(rows, 2):
        frame = _whole(row[columns["frame"]], path, line)
        times[frame] = _number(row[columns["time_s"]], path, line)
        joint, own = row[columns["joint"]], np.nan if frame_sigma is None else _number(row[frame_sigma], path, line)
        if frame in found.get(joint, {}):
            raise InputError(f"Row {line} of {path} is the second for “{joint[:40]}” in frame {frame}; remove one of them.")
        numbers = [_number(row[columns[c]], path, line) if c in columns else np.nan for c in ("x", "y", "z", SIGMA)]
        found.setdefault(joint, {})[frame] = [*numbers, own]
        words.setdefault(joint, {})[frame] = "" if word is None else _word(row[word], path, line)
    frames = sorted(times)
    check_sparse(len(rows), len(frames), len(found), path)
    tables = {joint: np.array([places.get(f, [np.nan] * 5) for f in frames]) for joint, places in found.items()}
    _check_sigmas(np.array([*tables.values()]).reshape(-1, 5)[:, 3:], path)
    return JointTable(
        frames=np.array(frames, dtype=np.int64),
        time_s=np.array([times[f] for f in frames]),
        joints_m={joint: t[:, :3] for joint, t in tables.items()},
        sigma_m={joint: t[:, 3] for joint, t in tables.items()},
        frame_sigma_m={joint: t[:, 4] for joint, t in tables.items()},
        known={joint: tuple(row.get(f, "") for f in frames) for joint, row in words.items()},
    )


def read_guessed(path: Path) -> dict[str, tuple[int, ...]]:
    """The frames in which each limb is guessed, by its name in words, from joints.csv; no limbs of a file of an earlier version.

    Raises:
        InputError: the file is missing, or these columns of it are damaged.
    """
    header, rows = _read(path)
    if "known" not in header:
        return {}
    frame, joint, known = (_column(header, name, path) for name in ("frame", "joint", "known"))
    joints = list(dict.fromkeys(row[joint] for row in rows))
    limbs = limb_joints(joints)
    limb_of = {joints[i]: limb for limb, indices in limbs.items() for i in indices}
    found: dict[str, set[int]] = {limb: set() for limb in limbs}
    for line, row in enumerate(rows, 2):
        if _word(row[known], path, line) == GUESSED and row[joint] in limb_of:
            found[limb_of[row[joint]]].add(_whole(row[frame], path, line))
    return {limb: tuple(sorted(frames)) for limb, frames in found.items() if frames}


def _to_file(skeleton: Skeleton, names: Sequence[str]) -> np.ndarray:
    base = {dof.name for dof in skeleton.base_dofs}
    return np.array([1.0 if name in base else np.degrees(1.0) for name in names])


def _write(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    store.write_text(Path(path), text.getvalue())


def _read(path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        lines = list(csv.reader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))))
    except PermissionError as error:
        raise InputError(f"Cannot read the table {path}: {error.strerror}; change its rights.") from error
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"Cannot read the table {path}: {damage_of(error)}; mend it, or run the fit again.") from error
    if not lines:
        raise InputError(f"The table {path} is empty; mend it, or run the fit again.")
    header, rows = lines[0], [row for row in lines[1:] if row]
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise InputError(f"Row {line} of {path} has {len(row)} values, the header {len(header)}; mend it, or run the fit again.")
    return header, rows


def _column(header: Sequence[str], name: str, path: Path) -> int:
    if name not in header:
        raise InputError(f"The table {path} has no column “{name}”; if it belongs to this body, run the fit again.")
    return list(header).index(name)


def _word(text: str, path: Path, line: int) -> str:
    if text not in ("", *KNOWN):
        raise InputError(f"Row {line} of {path} has “{text[:40]}” for “known”, not {', '.join(KNOWN)}; mend it, or run the fit again.")
    return text


def _whole(text: str, path: Path, line: int) -> int:
    value = _number(text, path, line)
    if not abs(value) < LARGEST_FRAME:
        raise InputError(f"Row {line} of {path} has the frame number {text[:40]}; mend it, or run the fit again.")
    return int(value)


def _check_sigmas(sigma: np.ndarray, path: Path) -> None:
    if (sigma < 0).any():
        raise InputError(f"{path} has a negative sigma ({sigma.min():g}), which no run writes; mend it, or run the fit again.")


def _number(text: str, path: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise InputError(f"Row {line} of {path} holds “{text[:40]}” where a number is needed; mend it, or run the fit again.") from error
    return value
