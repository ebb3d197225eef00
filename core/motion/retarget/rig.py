"""A rig and a motion as plain values, whatever their origin: an armature, a BVH file, a measured body.

Everything is in the world (metres, Z up); the rest pose is given as rotations and positions:

    R_b = R_parent · R_rest,parentᵀ · R_rest,b · B_b                the rotation of a bone; B_b is its pose channel      (1)
    head_b = head_parent + R_parent · R_rest,parentᵀ · (head_rest,b − head_rest,parent) + shift                         (2)

A bone that does not inherit rotation has R_b = R_rest,b · B_b.

Keyframes: resampling a motion at another frame rate, and key reduction.

Key reduction keeps those keys of a motion keyed in every frame from which linear interpolation gives the others within a tolerance: Ramer
(1972), Douglas and Peucker (1973), with the distance along
the values, of one channel or of all channels of a bone at once.

Control rigs: rigs whose deforming bones follow helpers and constraints, so that keys belong on the controls.

In the state that a preset defines (`properties`, such as FK instead of IK) every control of the body follows another one rigidly, whatever
helpers lie between them in the rig. The controls alone, with these as parents, are a rig like any other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...foundation.arrays import frozen
from ...foundation.errors import InputError
from ...geometry.rotation import between, transposed
from ...images.interlace import frame_time_s
from ..plausible import check_places, check_span, check_times
from .residual_motion import ResidualMotion


@dataclass(frozen=True, eq=False, kw_only=True)
class Rig:
    """Bones, parents first, in their rest pose in the world.

    `roles`: bones by role where the file itself has them (VRM's humanoid). `sole_m`: by bone, points (K, 3) under the foot in the rest
    pose, where the skin touches the floor.
    """

    names: tuple[str, ...]
    parents: np.ndarray  # (B,) index, −1 for none
    R_rest: np.ndarray  # (B, 3, 3) columns are the bone's axes in the world
    head_m: np.ndarray  # (B, 3)
    tail_m: np.ndarray  # (B, 3)
    connected: np.ndarray  # (B,) the head cannot leave the parent's tail
    inherits_rotation: np.ndarray  # (B,)
    roles: Mapping[str, str] = field(default_factory=dict)
    sole_m: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.names)
        for name, shape, dtype in (
            ("parents", (n,), np.intp),
            ("R_rest", (n, 3, 3), float),
            ("head_m", (n, 3), float),
            ("tail_m", (n, 3), float),
            ("connected", (n,), bool),
            ("inherits_rotation", (n,), bool),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, dtype, name))
        if n == 0:
            raise InputError("The rig has no bones; choose an armature with bones.")
        if len(set(self.names)) < n:
            raise InputError("Two bones of the rig have the same name; rename one of them.")
        if not (self.parents < np.arange(n)).all():
            raise InputError("The rig's bones are out of order or form a loop; a parent must come before its children.")
        if not all(np.isfinite(a).all() for a in (self.R_rest, self.head_m, self.tail_m)):
            raise InputError("The rest pose of the rig has positions that are not numbers; repair it.")

    @cached_property
    def index(self) -> dict[str, int]:
        """A bone's index, by its name."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """The children of each bone."""
        lists: list[list[int]] = [[] for _ in self.names]
        for child, parent in enumerate(self.parents):
            if parent >= 0:
                lists[parent].append(child)
        return tuple(map(tuple, lists))

    @cached_property
    def height_m(self) -> float:
        """Height of the rest pose from its lowest to its highest joint."""
        ends = np.concatenate([self.head_m, self.tail_m])
        return float(np.ptp(ends[:, 2]))

    def ancestors(self, bone: int) -> list[int]:
        """The bone itself, its parent, its parent's parent, and so on."""
        line = [bone]
        while self.parents[line[-1]] >= 0:
            line.append(int(self.parents[line[-1]]))
        return line

    def path(self, top: int, bottom: int) -> list[int]:
        """The bones from `top` down to `bottom`, both included; empty if bottom does not descend from top."""
        line = self.ancestors(bottom)
        return line[: line.index(top) + 1][::-1] if top in line else []

    def common(self, a: int, b: int) -> int | None:
        """The lowest common ancestor of both (it may be one of them)."""
        line = set(self.ancestors(b))
        return next((bone for bone in self.ancestors(a) if bone in line), None)


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A rig in motion: R (T, B, 3, 3) and heads (T, B, 3) [m] in the world, at frames (T,) of `fps` frames per second. `residual`: the
    motion that the rig cannot show, at the same frames; `notes`: sentences about its origin."""

    rig: Rig
    fps: float
    frames: np.ndarray  # (T,) frame numbers of the scene
    R: np.ndarray  # (T, B, 3, 3)
    head_m: np.ndarray  # (T, B, 3)
    residual: ResidualMotion | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        t, n = len(self.frames), len(self.rig.names)
        object.__setattr__(self, "frames", frozen(self.frames, (t,), float, "frames"))
        object.__setattr__(self, "R", frozen(self.R, (t, n, 3, 3), float, "R"))
        object.__setattr__(self, "head_m", frozen(self.head_m, (t, n, 3), float, "head_m"))
        if t == 0:
            raise InputError("The motion has no frames; choose one with frames.")
        if not (np.isfinite(self.R).all() and np.isfinite(self.head_m).all()):
            raise InputError("The motion has positions or rotations that are not numbers; fill its gaps first.")
        check_times(self.frames, self.fps, "There is a motion")
        check_places(self.head_m, "There is a motion")
        check_span(self.frames[0], self.frames[-1], t, "There is a motion")


def posed(rig: Rig, basis: np.ndarray, shift_m: Mapping[int, np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Forward kinematics: R (T, B, 3, 3) and heads (T, B, 3) of pose channels `basis` (T, B, 3, 3).  (1), (2)

    `shift_m`: by bone, an offset (T, 3) of its head in the world.
    """
    R, head = np.empty_like(basis), np.empty((*basis.shape[:2], 3))
    for b in range(len(rig.names)):
        R[:, b] = _carried(rig, R, b) @ basis[:, b]
        head[:, b] = head_of(rig, R, head, b)
        if shift_m and b in shift_m:
            head[:, b] += shift_m[b]
    return R, head


def following(rig: Rig, R: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """R (T, B, 3, 3) with the bones that are not `driven` (B,) in their rest pose relative to their parents."""
    R = R.copy()
    for b in np.flatnonzero(~driven):
        p = rig.parents[b]
        R[:, b] = rig.R_rest[b] if p < 0 or not rig.inherits_rotation[b] else R[:, p] @ (rig.R_rest[p].T @ rig.R_rest[b])
    return R


def head_of(rig: Rig, R: np.ndarray, head: np.ndarray, b: int) -> np.ndarray:
    """The head (T, 3) of bone b without a shift of its own, its parent posed as in R (T, B, 3, 3), head (T, B, 3).  (2)"""
    p = rig.parents[b]
    if p < 0:
        return np.broadcast_to(rig.head_m[b], (len(R), 3))
    return head[:, p] + R[:, p] @ (rig.R_rest[p].T @ (rig.head_m[b] - rig.head_m[p]))


def channels(rig: Rig, R: np.ndarray) -> np.ndarray:
    """The pose channels (T, B, 3, 3) that give R (T, B, 3, 3).  (1) solved for B"""
    basis = np.empty_like(R)
    for b in range(len(rig.names)):
        basis[:, b] = transposed(_carried(rig, R, b)) @ R[:, b]
    return basis


def _carried(rig: Rig, R: np.ndarray, b: int) -> np.ndarray:
    """The rotation (T, 3, 3) of bone b with its own channel at rest."""
    p = rig.parents[b]
    if p < 0 or not rig.inherits_rotation[b]:
        return np.broadcast_to(rig.R_rest[b], (len(R), 3, 3))
    return R[:, p] @ (rig.R_rest[p].T @ rig.R_rest[b])


def resampled(motion: Motion, fps: float, first_frame: float) -> Motion:
    """The motion at `fps` frames per second beginning at `first_frame`: rotations by the shortest path, positions linearly."""
    frames = motion.frames
    time = frame_time_s(frames - frames[0], motion.fps)
    count = max(int(np.floor(time[-1] * fps + 1e-6)) + 1, 1)
    wanted = frame_time_s(np.arange(count), fps)
    after = np.clip(np.searchsorted(time, wanted - 1e-9), 1, max(len(time) - 1, 1)) if len(time) > 1 else np.zeros(count, dtype=np.intp)
    before = np.maximum(after - 1, 0)
    span = np.where(time[after] > time[before], time[after] - time[before], 1.0)
    part = np.clip((wanted - time[before]) / span, 0.0, 1.0)
    head = motion.head_m[before] + part[:, None, None] * (motion.head_m[after] - motion.head_m[before])
    R = between(motion.R[before], motion.R[after], np.broadcast_to(part[:, None], head.shape[:2]))
    return replace(motion, fps=fps, frames=first_frame + np.arange(count), R=R, head_m=head, residual=None)


def needed_keys(times: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices (n,) of the keys to keep, of values (T,) or (T, C) at times (T,), in order.

    Linear interpolation between them is nowhere off by more than `tolerance`, all channels together (Euclidean). The first and the last
    are always among them, unless all values lie within the tolerance of the first.
    """
    t = len(times)
    values = np.asarray(values, dtype=np.float64)
    values = values[:, None] if values.ndim == 1 else values
    if t < 2 or tolerance <= 0:
        return np.arange(t)
    if np.linalg.norm(values - values[0], axis=1).max() <= tolerance:
        return np.array([0])
    keep = np.zeros(t, dtype=bool)
    keep[[0, -1]] = True
    stack = [(0, t - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        part = ((times[a : b + 1] - times[a]) / (times[b] - times[a]))[:, None]
        off = np.linalg.norm(values[a : b + 1] - (values[a] + part * (values[b] - values[a])), axis=1)
        worst = a + int(np.argmax(off))
        if off[worst - a] > tolerance:
            keep[worst] = True
            stack += [(a, worst), (worst, b)]
    return np.flatnonzero(keep)


@dataclass(frozen=True, eq=False, kw_only=True)
class ControlRig:
    """The controls of a family of rigs."""

    follows: Mapping[str, str]  # by control, the one that it follows; a control that is not named follows none
    properties: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by bone: custom properties and their values
    skin: Mapping[str, str] = field(default_factory=dict)  # by control, the bone that has the skin's weights instead

    def table(self) -> dict[str, dict[str, Any]]:
        """As plain values, as in a mapping file."""
        return {
            "follows": dict(self.follows),
            "skin": dict(self.skin),
            "properties": {bone: dict(values) for bone, values in self.properties.items()},
        }

    def of_controls(self, *chains: Mapping[str, tuple[str, ...]]) -> "ControlRig | None":
        """This control rig if all bones of `chains` (by role) are its controls, else None."""
        named = {name for table in chains for chain in table.values() for name in chain}
        return self if {*self.follows, *self.follows.values()} >= named else None


def controls_of(rig: Rig, control_rig: ControlRig, chains: Mapping[str, tuple[str, ...]]) -> Rig:
    """The controls in `chains` (bones by role) as a rig of their own."""
    wanted = {name for chain in chains.values() for name in chain}

    def above(name: str) -> str | None:
        parent = control_rig.follows.get(name)
        while parent is not None and parent not in wanted:
            parent = control_rig.follows.get(parent)
        return parent

    def depth(name: str) -> int:
        parent = above(name)
        return 0 if parent is None else 1 + depth(parent)

    names = sorted((name for name in rig.names if name in wanted), key=depth)
    rows = [rig.index[name] for name in names]
    order = {name: i for i, name in enumerate(names)}
    parents = [order[parent] if (parent := above(name)) is not None else -1 for name in names]
    return Rig(
        names=tuple(names),
        parents=np.array(parents),
        R_rest=rig.R_rest[rows],
        head_m=rig.head_m[rows],
        tail_m=rig.tail_m[rows],
        connected=np.zeros(len(names), dtype=bool),
        inherits_rotation=np.ones(len(names), dtype=bool),
    )
