"""Residual motion: what a rig could not show of the motion that was retargeted to it, so that nothing is lost through a simpler rig.

Feet that are too long for their legs must lift their toes in a walk; a trunk of one bone cannot bend like one of three; a rig may have no
neck. An action that Tricap writes stores this next to its keys, relative to what its rig does show, and the next retargeting from it
restores it. This module has the values and their text; `restore` finds and uses them.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...foundation import bounded
from ...foundation.arrays import frozen
from ...foundation.errors import InputError

FORMAT = "tricap-unshown"  # of actions in users' files
VERSION = 1
STEP = 1e-5  # [rad, m] resolution of the stored numbers
STATES = ("ankle", "toe", "flat")


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualChain:
    """The bones of a part of the source, of which the rig has all, some, or none.

    `order`: by bone of the source's part, the index of the rig's own bone paired with it, −1 if lacking. `ends` (n,): each bone's end as a
    fraction (0…1] of the part's length. `along_m` (3,): from the part's beginning to its end in the rest pose, for a part that is lacking
    entirely. `turn` (E, T, 3) [rad]: rotations of the lacking bones in the world, relative to the rig's next bone, or to the last bone of
    the part `parent`, which has `size` bones.
    """

    role: str
    order: tuple[int, ...]
    ends: np.ndarray
    along_m: np.ndarray
    parent: str
    size: int
    turn: np.ndarray

    def __post_init__(self) -> None:
        own = [k for k in self.order if k >= 0]
        if min(self.order, default=-2) < -1 or max(own, default=-1) >= self.size or own and self.order[-1] < 0:
            raise ValueError("the order of a part's bones has invalid indices")
        object.__setattr__(self, "ends", frozen(self.ends, (len(self.order),), float, "ends"))
        object.__setattr__(self, "along_m", frozen(self.along_m, (3,), float, "along_m"))
        object.__setattr__(self, "turn", frozen(self.turn, (self.order.count(-1), *np.shape(self.turn)[1:]), float, "turn"))


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualMotion:
    """At the frames (T,) of a motion, by role where a mapping is named so."""

    frames: np.ndarray
    planting_turns: Mapping[str, np.ndarray]  # by role (n, T, 3) [rad, world]: rotations that planted the feet
    planting_shift_m: np.ndarray  # (T, 3) of the hips, for the same
    forearm_twists: Mapping[str, np.ndarray]  # by role (1, T, 3) [rad, world]: twist that forearms took from their hands
    contacts: Mapping[str, Mapping[str, np.ndarray]]  # by STATES and side (T,): frames in which the feet stand
    contact_settings: Mapping[str, Any]  # the settings with which they were found
    ankle_level_m: float
    chains: tuple[ResidualChain, ...]  # the bones that the rig lacks

    def at(self, frames: np.ndarray) -> "ResidualMotion":
        """The same at other frames (T',), linearly interpolated, constant before the first and after the last."""

        def interpolated(values: np.ndarray) -> np.ndarray:
            flat = values.reshape(-1, *values.shape[-2:])
            found = [[np.interp(frames, self.frames, column) for column in part.T] for part in flat]
            return (
                np.array(found, dtype=float)
                .reshape(len(flat), 3, len(frames))
                .transpose(0, 2, 1)
                .reshape(*values.shape[:-2], len(frames), 3)
            )

        nearest = np.abs(np.asarray(frames)[:, None] - self.frames).argmin(axis=1)
        return ResidualMotion(
            frames=np.asarray(frames, dtype=float),
            planting_turns={role: interpolated(v) for role, v in self.planting_turns.items()},
            planting_shift_m=interpolated(self.planting_shift_m),
            forearm_twists={role: interpolated(v) for role, v in self.forearm_twists.items()},
            contacts={state: {side: on[nearest] for side, on in sides.items()} for state, sides in self.contacts.items()},
            contact_settings=self.contact_settings,
            ankle_level_m=self.ankle_level_m,
            chains=tuple(replace(c, turn=interpolated(c.turn)) for c in self.chains),
        )


def to_text(residual: ResidualMotion) -> str:
    """As JSON."""

    def whole(values: np.ndarray) -> list[Any]:
        return list(np.round(np.asarray(values) / STEP).astype(int).tolist())

    def marks(on: np.ndarray) -> str:
        return "".join("01"[int(v)] for v in on)

    return json.dumps(
        {
            "format": FORMAT,
            "version": VERSION,
            "frames": residual.frames.tolist(),
            "feet": dict(residual.contact_settings),
            "level_m": residual.ankle_level_m,
            "stands": {state: {side: marks(on) for side, on in sides.items()} for state, sides in residual.contacts.items()},
            "held": {role: whole(v) for role, v in residual.planting_turns.items()},
            "twisted": {role: whole(v) for role, v in residual.forearm_twists.items()},
            "moved": whole(residual.planting_shift_m),
            "chains": [
                {
                    "role": c.role,
                    "order": list(c.order),
                    "ends": c.ends.tolist(),
                    "along_m": c.along_m.tolist(),
                    "beside": c.parent,
                    "size": c.size,
                    "turn": whole(c.turn),
                }
                for c in residual.chains
            ],
        },
        separators=(",", ":"),
    )


def from_text(text: str) -> ResidualMotion:
    """From JSON.

    Raises:
        InputError: the text is of another format, or damaged.
    """
    try:
        table = bounded.json_of(text)
        if (table["format"], table["version"]) != (FORMAT, VERSION):
            raise ValueError("another format")
        frames = np.array(table["frames"], dtype=float)
        t = len(frames)

        def values(rows: Any, *shape: int) -> np.ndarray:
            found = np.array(rows, dtype=float).reshape(*shape, t, 3) * STEP
            if not np.isfinite(found).all():
                raise ValueError("not finite")
            return found

        contacts = {
            state: {side: frozen([c == "1" for c in on], (t,), bool, state) for side, on in table["stands"][state].items()}
            for state in STATES
        }
        if not t or not np.isfinite(frames).all() or (np.diff(frames) <= 0).any() or len({tuple(sides) for sides in contacts.values()}) > 1:
            raise ValueError("inconsistent frames or sides")
        chains = tuple(
            ResidualChain(
                role=str(c["role"]),
                order=tuple(int(k) for k in c["order"]),
                ends=np.array(c["ends"], dtype=float),
                along_m=np.array(c["along_m"], dtype=float),
                parent=str(c["beside"]),
                size=int(c["size"]),
                turn=values(c["turn"], -1),
            )
            for c in table["chains"]
        )
        if not all(np.isfinite([*c.ends, *c.along_m]).all() and (np.diff(c.ends) >= 0).all() for c in chains):
            raise ValueError("invalid ends of parts")
        return ResidualMotion(
            frames=frames,
            planting_turns={str(role): values(rows, -1) for role, rows in table["held"].items()},
            forearm_twists={str(role): values(rows, -1) for role, rows in table["twisted"].items()},
            planting_shift_m=values(table["moved"]),
            contacts=contacts,
            contact_settings=dict(table["feet"]),
            ankle_level_m=float(table["level_m"]),
            chains=chains,
        )
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"The residual motion stored with the action is damaged ({type(error).__name__}); retarget it again.") from error
