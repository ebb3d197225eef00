"""What a rig could not show of the motion that was put onto it: so that nothing is lost on the way through a simpler rig.

A knight whose feet are too long for its legs must lift its toes; a trunk of one bone cannot bend like one of three; there may be no neck at
all. An action that we write remembers that beside its keys, relative to what its rig does show, and the next retargeting from it puts it
back. These are the values alone; `restore` finds and uses them.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import InputError
from ...values import frozen

FORMAT = "tricap-unshown"
VERSION = 1
STEP = 1e-5  # of what is written: rad, m
STATES = ("ankle", "toe", "flat")


@dataclass(frozen=True, eq=False, kw_only=True)
class UnshownChain:
    """The bones that a part has in the source, of which all, some, or none are there.

    `order`: by bone of the source's part, which of the rig's own bones goes with it, −1 for one that is lacking; `ends` (n,): where each
    ends, as a part (0…1] of the length; `along_m` (3,): from the part's beginning to its end in the rest pose, of a part that is lacking
    altogether. `turn` (E, T, 3) [rad]: how the lacking ones have turned, in the world, against the rig's next one, or the last one of the
    part `beside`, which has `size` bones.
    """

    role: str
    order: tuple[int, ...]
    ends: np.ndarray
    along_m: np.ndarray
    beside: str
    size: int
    turn: np.ndarray

    def __post_init__(self) -> None:
        own = [k for k in self.order if k >= 0]
        if min(self.order, default=-2) < -1 or max(own, default=-1) >= self.size or own and self.order[-1] < 0:
            raise ValueError("the order of a part's bones names some that there are not")
        object.__setattr__(self, "ends", frozen(self.ends, (len(self.order),), float, "ends"))
        object.__setattr__(self, "along_m", frozen(self.along_m, (3,), float, "along_m"))
        object.__setattr__(self, "turn", frozen(self.turn, (self.order.count(-1), *np.shape(self.turn)[1:]), float, "turn"))


@dataclass(frozen=True, eq=False, kw_only=True)
class Unshown:
    """At the frames (T,) of a motion: by role how far its bones were turned so that feet stand, `held` (n, T, 3) [rad, in the world]; how
    far the hips were moved for it, `moved_m` (T, 3); by role the twist that forearms took over; when the feet stand, by STATES and side
    (T,), found with the settings `feet`; the ankles' level; and the bones that the rig lacks."""

    frames: np.ndarray
    held: Mapping[str, np.ndarray]
    twisted: Mapping[str, np.ndarray]
    moved_m: np.ndarray
    stands: Mapping[str, Mapping[str, np.ndarray]]
    feet: Mapping[str, Any]
    level_m: float
    chains: tuple[UnshownChain, ...]

    def at(self, frames: np.ndarray) -> "Unshown":
        """The same at other frames (T',): on straight lines between its own, before and after them as at its ends."""

        def there(values: np.ndarray) -> np.ndarray:
            flat = values.reshape(-1, *values.shape[-2:])
            found = [[np.interp(frames, self.frames, column) for column in part.T] for part in flat]
            return (
                np.array(found, dtype=float)
                .reshape(len(flat), 3, len(frames))
                .transpose(0, 2, 1)
                .reshape(*values.shape[:-2], len(frames), 3)
            )

        near = np.abs(np.asarray(frames)[:, None] - self.frames).argmin(axis=1)
        chains = tuple(
            UnshownChain(role=c.role, order=c.order, ends=c.ends, along_m=c.along_m, beside=c.beside, size=c.size, turn=there(c.turn))
            for c in self.chains
        )
        return Unshown(
            frames=np.asarray(frames, dtype=float),
            held={role: there(v) for role, v in self.held.items()},
            twisted={role: there(v) for role, v in self.twisted.items()},
            moved_m=there(self.moved_m),
            stands={state: {side: on[near] for side, on in sides.items()} for state, sides in self.stands.items()},
            feet=self.feet,
            level_m=self.level_m,
            chains=chains,
        )


def to_text(unshown: Unshown) -> str:
    """As JSON."""

    def whole(values: np.ndarray) -> list[Any]:
        return list(np.round(np.asarray(values) / STEP).astype(int).tolist())

    def marks(on: np.ndarray) -> str:
        return "".join("01"[int(v)] for v in on)

    return json.dumps(
        {
            "format": FORMAT,
            "version": VERSION,
            "frames": unshown.frames.tolist(),
            "feet": dict(unshown.feet),
            "level_m": unshown.level_m,
            "stands": {state: {side: marks(on) for side, on in sides.items()} for state, sides in unshown.stands.items()},
            "held": {role: whole(v) for role, v in unshown.held.items()},
            "twisted": {role: whole(v) for role, v in unshown.twisted.items()},
            "moved": whole(unshown.moved_m),
            "chains": [
                {
                    "role": c.role,
                    "order": list(c.order),
                    "ends": c.ends.tolist(),
                    "along_m": c.along_m.tolist(),
                    "beside": c.beside,
                    "size": c.size,
                    "turn": whole(c.turn),
                }
                for c in unshown.chains
            ],
        },
        separators=(",", ":"),
    )


def from_text(text: str) -> Unshown:
    """From JSON.

    Raises:
        InputError: it is no such text, or damaged.
    """
    try:
        table = json.loads(text)
        if (table["format"], table["version"]) != (FORMAT, VERSION):
            raise ValueError("another format")
        frames = np.array(table["frames"], dtype=float)
        t = len(frames)

        def values(rows: Any, *shape: int) -> np.ndarray:
            found = np.array(rows, dtype=float).reshape(*shape, t, 3) * STEP
            if not np.isfinite(found).all():
                raise ValueError("no numbers")
            return found

        stands = {
            state: {side: frozen([c == "1" for c in on], (t,), bool, state) for side, on in table["stands"][state].items()}
            for state in STATES
        }
        if not t or not np.isfinite(frames).all() or (np.diff(frames) <= 0).any() or len({tuple(sides) for sides in stands.values()}) > 1:
            raise ValueError("frames or sides do not go together")
        chains = tuple(
            UnshownChain(
                role=str(c["role"]),
                order=tuple(int(k) for k in c["order"]),
                ends=np.array(c["ends"], dtype=float),
                along_m=np.array(c["along_m"], dtype=float),
                beside=str(c["beside"]),
                size=int(c["size"]),
                turn=values(c["turn"], -1),
            )
            for c in table["chains"]
        )
        if not all(np.isfinite([*c.ends, *c.along_m]).all() and (np.diff(c.ends) >= 0).all() for c in chains):
            raise ValueError("parts end nowhere")
        return Unshown(
            frames=frames,
            held={str(role): values(rows, -1) for role, rows in table["held"].items()},
            twisted={str(role): values(rows, -1) for role, rows in table["twisted"].items()},
            moved_m=values(table["moved"]),
            stands=stands,
            feet=dict(table["feet"]),
            level_m=float(table["level_m"]),
            chains=chains,
        )
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"What the action remembers of its motion is damaged ({type(error).__name__}); retarget it anew.") from error
