"""How far following the body frame after frame has come: all that the next frame depends on, to be kept so that a killed fit goes on."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

KEEP_EVERY = 25  # frames: some seconds of work


class Kept(Protocol):
    """Where a fit keeps its work, each part by its name, under a key of all that it depends on."""

    def load(self, name: str) -> Mapping[str, np.ndarray] | None:
        """What was kept under a name, if anything was."""

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep this under a name, instead of what was."""


@dataclass(kw_only=True)
class Way:
    """What is known of T frames with D degrees of freedom and B bones, when `done` of them are done."""

    motion: np.ndarray  # (T, D)
    known: np.ndarray  # (T, D) where each DOF was seen
    unseen: np.ndarray  # (B,) for how many frames each bone was not
    seen: list[int]  # frames of this direction that were found
    support: float | None = None  # of the last of them
    done: int = 1

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays to be kept; unknown support is NaN."""
        support = np.nan if self.support is None else self.support
        return {
            "motion": self.motion,
            "known": self.known,
            "unseen": self.unseen,
            "seen": np.array(self.seen, dtype=np.int64),
            "support": np.array([support]),
            "done": np.array([self.done]),
        }

    def goes_on(self, kept: Mapping[str, np.ndarray] | None) -> "Way":
        """What was kept, if it is of these frames, else this."""
        mine, other = ({n: a.shape for n, a in table.items() if n != "seen"} for table in (self.arrays(), kept or {}))
        if kept is None or mine != other:
            return self
        support = float(kept["support"][0])
        return Way(
            motion=kept["motion"].copy(),
            known=kept["known"].copy(),
            unseen=kept["unseen"].copy(),
            seen=kept["seen"].tolist(),
            support=None if np.isnan(support) else support,
            done=int(kept["done"][0]),
        )
