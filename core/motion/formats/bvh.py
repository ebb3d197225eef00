"""BVH: a skeleton and its motion as text (Biovision). Read into a `Motion` in the world's metres, Z up; written for many readers.

A joint's rotation channels apply in the order of the file: "Zrotation Xrotation Yrotation" is R_z · R_x · R_y.
The format has no unit and no up axis: both are estimated from the skeleton's size and pose unless they are given.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...geometry.rotation import about, between, euler_from_matrix, shortest, unit
from ..plausible import check_places, check_span
from ..retarget.rig import Motion, Rig

DEEPEST = 256  # joints in a chain: a tail or a braid has some dozens
MOST_JOINTS = 4096
LEAST_CELLS, MOST_STILL = 500_000, 2  # joints × frames: so many in any case, and so many for every value of the file
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
TALL_M = 1.7  # height of a person, for the unit
TINY = 1e-6  # by the skeleton's size: bones below it have no length
STUB = 0.05  # by the skeleton's size: length of a bone without length
UPRIGHT = 1.5  # by its extent along Y: the extent along Z of a skeleton whose Z is up
MOVED_M = 1e-5  # a head that moves further relative to its parent needs position channels
MOST_FILLED = 10  # frames from the first to the last, for each that is there, in a file without frame numbers
ROUNDING = 1e-6  # of a frame number
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
CHANNELS = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}


@dataclass
class _Joint:
    name: str
    parent: int
    offset: np.ndarray
    channels: tuple[str, ...] = ()
    end: np.ndarray | None = None
    columns: list[int] = field(default_factory=list)


def read_bvh(path: Path, *, unit_m: float | None = None, up: str | None = None) -> Motion:
    """The motion in a BVH file; bones point from joint to joint. `unit_m`: metres per unit; `up`: "Y" or "Z".

    Raises:
        InputError: it cannot be read, is no BVH file, or is shorter than its header says.
    """
    try:
        text = bounded.text_of(path, bounded.TABLE_BYTES, errors="replace")
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    head, found, body = text.partition("MOTION")
    if not found or not head.lstrip("\ufeff \t\r\n").upper().startswith("HIERARCHY"):
        raise InputError(f"{path} is not a BVH file: it needs a HIERARCHY and a MOTION.")
    joints = _joints(head, path)
    count = sum(len(j.channels) for j in joints)
    if not count:
        raise InputError(f"{path} has no CHANNELS, and so no motion; export it again.")
    if any(column >= count for j in joints for column in j.columns):
        raise InputError(f"{path} gives a joint its CHANNELS twice; it is damaged, export it again.")
    values, fps = _values(body, count, path)
    if len(values) * len(joints) > max(LEAST_CELLS, MOST_STILL * values.size):
        raise InputError(
            f"{path} has only {values.size} values for {len(joints)} joints in {len(values)} frames; it is damaged, export it again."
        )
    return _motion(joints, values, fps, unit_m, up)


def _joints(text: str, path: Path) -> list[_Joint]:
    words = iter(text.split())
    joints: list[_Joint] = []
    stack: list[int] = []
    column = 0
    for word in words:
        kind = word.upper()
        if kind in ("ROOT", "JOINT"):
            name = " ".join(_until(words, "{", path))
            joints.append(_Joint(name=name, parent=stack[-1] if stack else -1, offset=np.zeros(3)))
            stack.append(len(joints) - 1)
            if len(stack) > DEEPEST:
                raise InputError(f"{path} has a chain of more than {DEEPEST} joints; that is no skeleton.")
        elif kind == "END":
            _until(words, "{", path)
            stack.append(-1)
        elif kind == "OFFSET":
            offset = np.array([_number(next(words, ""), path) for _ in range(3)])
            check_places(offset, f"{path} is a motion")
            _set_offset(joints, stack, offset, path)
        elif kind == "CHANNELS":
            count = int(_number(next(words, ""), path))
            names = tuple(next(words, "") for _ in range(min(max(count, 0), 7)))
            if not stack or stack[-1] < 0 or not set(names) <= CHANNELS or len(set(names)) < len(names) or count != len(names):
                raise InputError(f"{path} has channels {' '.join(names)[:80]}, which are no BVH channels; export it again.")
            joint = joints[stack[-1]]
            joint.channels, joint.columns = names, list(range(column, column + count))
            column += count
        elif word == "}":
            if not stack:
                raise InputError(f"{path} closes more brackets than it opens; it is damaged, export it again.")
            stack.pop()
        elif kind != "HIERARCHY":
            raise InputError(f"{path} holds “{word[:40]}” in its HIERARCHY, which is not valid there; export it again.")
        if len(joints) > MOST_JOINTS:
            raise InputError(f"{path} has more than {MOST_JOINTS} joints; that is no skeleton.")
    if stack or not joints:
        raise InputError(f"{path} ends within its HIERARCHY; it is damaged, export it again.")
    return joints


def _until(words: Iterator[str], stop: str, path: Path) -> list[str]:
    found: list[str] = []
    for word in words:
        if word == stop:
            return found
        found.append(word)
        if len(found) > 16:
            break
    raise InputError(f"{path} lacks a bracket after “{' '.join(found)[:40]}”; it is damaged, export it again.")


def _set_offset(joints: list[_Joint], stack: list[int], offset: np.ndarray, path: Path) -> None:
    if not stack:
        raise InputError(f"{path} has an OFFSET outside of a joint; it is damaged, export it again.")
    if stack[-1] >= 0:
        joints[stack[-1]].offset = offset
    elif len(stack) > 1:
        joints[stack[-2]].end = offset


def _number(text: str, path: Path) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise InputError(f"{path} holds “{text[:40]}” where a number is needed; it is damaged, export it again.") from error
    if not np.isfinite(value):
        raise InputError(f"{path} holds “{text[:40]}”, which is no finite number; export it again.")
    return value


def _values(body: str, columns: int, path: Path) -> tuple[np.ndarray, float]:
    words = body.split(maxsplit=5)
    names = [word.lower() for word in words]
    if len(words) < 5 or names[0] != "frames:" or names[2:4] != ["frame", "time:"]:
        raise InputError(f"{path} has no “Frames:” and “Frame Time:” after MOTION; it is damaged, export it again.")
    frames, frame_time = int(_number(words[1], path)), _number(words[4], path)
    if frames < 1 or frame_time <= 0:
        raise InputError(f"{path} has {frames} frames of {frame_time:g} s; a motion needs some.")
    try:
        values = np.fromstring(words[5], sep=" ") if len(words) > 5 and _is_plain(words[5]) else np.zeros(0)
    except ValueError:  # numpy 2: something like “1e” or “--1” among the numbers
        values = np.zeros(0)
    if len(values) < frames * columns:
        raise InputError(f"{path} promises {frames} frames of {columns} values but holds {len(values)} good values; export it again.")
    if len(values) > frames * columns:
        raise InputError(f"{path} has values of {len(values) / max(columns, 1):g} frames, and “Frames: {frames}”; correct that number.")
    table = values.reshape(frames, columns)
    if not np.isfinite(table).all():
        raise InputError(f"{path} holds values that are no finite numbers; export it again.")
    check_places(table, f"{path} is a motion")
    return table, 1.0 / frame_time


def _is_plain(text: str) -> bool:
    return not text.strip("0123456789+-.eE \t\r\n") if len(text) < 200 else not set(text) - set("0123456789+-.eE \t\r\n")


def _motion(joints: list[_Joint], values: np.ndarray, fps: float, unit_m: float | None, up: str | None) -> Motion:
    t, n = len(values), len(joints)
    parents = np.array([joint.parent for joint in joints])
    offset = np.array([joint.offset for joint in joints])
    head = np.zeros((n, 3))
    for b, p in enumerate(parents):
        head[b] = offset[b] + (head[p] if p >= 0 else 0.0)
    tail = _tails(joints, head)
    R, place = np.empty((t, n, 3, 3)), np.empty((t, n, 3))
    for b, (joint, p) in enumerate(zip(joints, parents)):
        local, shift = _channels(joint, values)
        R[:, b] = local if p < 0 else R[:, p] @ local
        place[:, b] = shift if p < 0 else place[:, p] + np.einsum("tij,tj->ti", R[:, p], shift)
    turn = np.eye(3) if (up or _up_axis(head, tail)) == "Z" else Z_UP_FROM_Y_UP
    scale = unit_m or _unit(np.concatenate([head, tail]) @ turn.T)
    head, tail, place = scale * head @ turn.T, scale * tail @ turn.T, scale * place @ turn.T
    R_rest = shortest(np.array([0.0, 1.0, 0.0]), tail - head)
    rig = Rig(
        names=_distinct([joint.name for joint in joints]),
        parents=parents,
        R_rest=R_rest,
        head_m=head,
        tail_m=tail,
        connected=np.array([p >= 0 and not _moves(j) for j, p in zip(joints, parents)]),
        inherits_rotation=np.ones(n, dtype=bool),
    )
    return Motion(rig=rig, fps=fps, frames=np.arange(t), R=turn @ R @ turn.T @ R_rest, head_m=place)


def _moves(joint: _Joint) -> bool:
    return any(channel.endswith("position") for channel in joint.channels)


def _channels(joint: _Joint, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (T, 3, 3) and offset (T, 3) of a joint relative to its parent."""
    R = np.broadcast_to(np.eye(3), (len(values), 3, 3))
    shift = np.tile(joint.offset, (len(values), 1))
    for channel, column in zip(joint.channels, joint.columns):
        axis = "XYZ".index(channel[0])
        if channel.endswith("rotation"):
            R = R @ about(np.eye(3)[axis], np.radians(values[:, column]))
        else:
            shift[:, axis] = values[:, column]
    return R, shift


def _tails(joints: list[_Joint], head: np.ndarray) -> np.ndarray:
    """A bone ends at the mean of its children, or at its End Site; a bone without length continues its parent for STUB of the size."""
    tails = []
    size = float(np.ptp(head, axis=0).max()) or 1.0
    for b, joint in enumerate(joints):
        children = [c for c, other in enumerate(joints) if other.parent == b and np.linalg.norm(head[c] - head[b]) > TINY * size]
        tail = head[children].mean(axis=0) if children else head[b] + (joint.end if joint.end is not None else 0.0)
        if np.linalg.norm(tail - head[b]) < TINY * size:
            p = joint.parent
            tail = head[b] + STUB * size * (unit(head[b] - head[p]) if p >= 0 and unit(head[b] - head[p]).any() else np.array([0, 1.0, 0]))
        tails.append(tail)
    return np.array(tails)


def _up_axis(head: np.ndarray, tail: np.ndarray) -> str:
    extent = np.ptp(np.concatenate([head, tail]), axis=0)
    return "Z" if extent[2] > UPRIGHT * extent[1] else "Y"


def _unit(places: np.ndarray) -> float:
    """Metres per unit: the unit for which the skeleton is nearest to a person's height."""
    height = float(np.ptp(places[:, 2]))
    return min(UNITS_M.values(), key=lambda factor: abs(np.log(max(height, 1e-9) * factor / TALL_M)))


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name}.{seen[name] - 1:03d}")
    return tuple(result)


def write_bvh(path: Path, motion: Motion, *, unit_m: float = 1.0, order: str = "ZXY", names: dict[str, str] | None = None) -> None:
    """Write a motion, Y up, with a row for each of its evenly timed frames. `order`: of the rotation channels; `names`: other names for
    bones.

    Raises:
        InputError: the file cannot be written, or most frames between its first and its last are missing.
    """
    motion = evenly_timed(motion)
    rig, to_file = motion.rig, Z_UP_FROM_Y_UP.T
    since_rest = to_file @ (motion.R @ np.swapaxes(rig.R_rest, -1, -2)) @ to_file.T
    head_rest, tail_rest, place = (x @ to_file.T / unit_m for x in (rig.head_m, rig.tail_m, motion.head_m))
    free = _free_heads(motion)
    lines, columns, order_of_joints = ["HIERARCHY"], [], []

    def add(b: int, depth: int) -> None:
        pad, p = "\t" * depth, rig.parents[b]
        offset = head_rest[b] - (head_rest[p] if p >= 0 else 0.0)
        moves = p < 0 or free[b]
        channels = ["Xposition Yposition Zposition"] if moves else []
        lines.extend(
            [
                f"{pad}{'JOINT' if depth else 'ROOT'} {_name((names or {}).get(rig.names[b], rig.names[b]))}",
                f"{pad}{{",
                f"{pad}\tOFFSET {_text(offset)}",
                f"{pad}\tCHANNELS {6 if moves else 3} {' '.join([*channels, *(f'{axis}rotation' for axis in order)])}",
            ]
        )
        local = since_rest[:, b] if p < 0 else np.swapaxes(since_rest[:, p], 1, 2) @ since_rest[:, b]
        if moves:
            parent = place[:, b] if p < 0 else np.einsum("tji,tj->ti", since_rest[:, p], place[:, b] - place[:, p])
            columns.append(parent)
        angles = np.degrees(euler_from_matrix(local, order[::-1]))  # the last to be written turns first
        columns.append(angles[:, ["XYZ".index(axis) for axis in order]])
        order_of_joints.append(b)
        for child in rig.children[b]:
            add(child, depth + 1)
        if not rig.children[b]:
            lines.extend([f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {_text(tail_rest[b] - head_rest[b])}", f"{pad}\t}}"])
        lines.append(f"{pad}}}")

    for root in np.flatnonzero(rig.parents < 0):
        add(int(root), 0)
    lines += ["MOTION", f"Frames: {len(motion.frames)}", f"Frame Time: {1.0 / motion.fps:.9g}"]
    table = np.concatenate(columns, axis=1)
    lines += [" ".join(f"{value:.6f}" for value in row) for row in table]
    store.write_text(Path(path), "\n".join(lines) + "\n")


def evenly_timed(motion: Motion) -> Motion:
    """The motion with frames at equal distances, numbered one by one at their own rate: BVH has no frame numbers. Frames that are missing
    in between are interpolated.

    Raises:
        InputError: very many are missing.
    """
    steps = np.diff(motion.frames)
    if (steps == 1).all():
        return motion
    whole = (motion.frames % 1 == 0).all()
    step = float(np.gcd.reduce(steps.astype(np.int64))) if whole else float(steps[0]) if np.allclose(steps, steps[0]) else 1.0
    frames = motion.frames[0] + step * np.arange(1 + int((motion.frames[-1] - motion.frames[0]) / step + ROUNDING))
    R, head_m = motion.R, motion.head_m
    if len(frames) != len(motion.frames) or not np.allclose(frames, motion.frames):
        check_span(0, len(frames), len(motion.frames), "BVH has a row for every frame; there is a motion", MOST_FILLED)
        row = np.clip(np.searchsorted(motion.frames, frames, side="right") - 1, 0, len(steps) - 1)
        part = ((frames - motion.frames[row]) / steps[row])[:, None]
        R, head_m = between(R[row], R[row + 1], part), head_m[row] + part[..., None] * (head_m[row + 1] - head_m[row])
    return replace(motion, fps=motion.fps / step, frames=np.arange(len(frames)), R=R, head_m=head_m, residual=None)


def _free_heads(motion: Motion) -> np.ndarray:
    """Bones (B,) whose heads move relative to their parents: they need position channels."""
    rig = motion.rig
    free = np.zeros(len(rig.names), dtype=bool)
    for b, p in enumerate(rig.parents):
        if p >= 0:
            rigid = motion.head_m[:, p] + motion.R[:, p] @ (rig.R_rest[p].T @ (rig.head_m[b] - rig.head_m[p]))
            free[b] = np.abs(motion.head_m[:, b] - rigid).max() > MOVED_M
    return free


def _name(name: str) -> str:
    """A name as one word of the file: blanks, braces and what cannot be printed become “_”."""
    return "".join("_" if c in " {}" or not c.isprintable() else c for c in name)


def _text(vector: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in vector)
