"""What is finished of a fit in stretches, as arrays that are kept, so that a killed fit goes on with the next stretch."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from .block_band import NormalEquations
from .handed_over import HandedOver
from .solver import Solution
from .stretches import Looked
from .way import Kept

A = TypeVar("A")
WAYS = {1: "ahead", -1: "back"}


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How an adjustment ended."""

    iterations: int
    converged: bool

    def arrays(self) -> dict[str, np.ndarray]:
        """As an array to be kept."""
        return {"ended": np.array([self.iterations, self.converged], dtype=np.int64)}

    @staticmethod
    def of(solution: Solution) -> "Ended":
        """That of a solution."""
        return Ended(iterations=solution.iterations, converged=solution.converged)

    @staticmethod
    def loaded(kept: Mapping[str, np.ndarray]) -> "Ended":
        """What was kept."""
        return Ended(iterations=int(kept["ended"][0]), converged=bool(kept["ended"][1]))


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundShape:
    """The shape of a recording in stretches."""

    simplified: np.ndarray  # (S',) of the simplified body, from which the complete model is made
    vector: np.ndarray  # (S,)
    covariance: np.ndarray  # (S, S)
    ended: Ended

    def save(self, kept: Kept | None) -> None:
        """Keep it."""
        if kept is not None:
            kept.save("shape", {"simplified": self.simplified, "vector": self.vector, "covariance": self.covariance, **self.ended.arrays()})

    @staticmethod
    def loaded(kept: Kept | None) -> "FoundShape | None":
        """What was kept, if anything was."""
        found = kept.load("shape") if kept is not None else None
        if found is None:
            return None
        return FoundShape(simplified=found["simplified"], vector=found["vector"], covariance=found["covariance"], ended=Ended.loaded(found))


@dataclass(frozen=True, eq=False, kw_only=True)
class Behind:
    """What the frames behind hand over: to the adjustment, and to covariances, where understated variances are made honest."""

    known: HandedOver | None
    honest: HandedOver | None


NOTHING_BEHIND = Behind(known=None, honest=None)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stretch:
    """An adjusted stretch: what is told of its own frames, and what it hands over ahead (1) and back (−1)."""

    looked: Looked
    ended: Ended
    behind: Mapping[int, Behind]

    def save(self, kept: Kept | None, own: range, around: range) -> None:
        """Keep it under its own frames, with those that took part."""
        if kept is None:
            return
        arrays = {"around": np.array([around.start, around.stop]), **self.ended.arrays(), **_table("looked", self.looked)}
        for way, behind in self.behind.items():
            for name, handed in (("known", behind.known), ("honest", behind.honest)):
                assert handed is not None
                arrays |= {f"{WAYS[way]}.{name}.motion": handed.motion, **_table(f"{WAYS[way]}.{name}", handed.equations)}
        kept.save(_name(own), arrays)

    @staticmethod
    def loaded(kept: Kept | None, own: range, around: range) -> "Stretch | None":
        """What was kept of these frames with the same margins, if anything was."""
        found = kept.load(_name(own)) if kept is not None else None
        if found is None or found["around"].tolist() != [around.start, around.stop]:
            return None
        behind = {
            way: Behind(known=_handed_over(found, f"{word}.known", way), honest=_handed_over(found, f"{word}.honest", way))
            for way, word in WAYS.items()
            if f"{word}.known.motion" in found
        }
        return Stretch(looked=_value(Looked, "looked", found), ended=Ended.loaded(found), behind=behind)


def _name(own: range) -> str:
    return f"frames_{own.start}_{own.stop - 1}"


def _handed_over(kept: Mapping[str, np.ndarray], name: str, way: int) -> HandedOver:
    return HandedOver(equations=_value(NormalEquations, name, kept), motion=kept[f"{name}.motion"], first=way > 0)


def _table(name: str, value: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass that has nothing else."""
    return {f"{name}.{field.name}": getattr(value, field.name) for field in fields(value)}


def _value(kind: type[A], name: str, kept: Mapping[str, np.ndarray]) -> A:
    return kind(**{field.name: kept[f"{name}.{field.name}"] for field in fields(kind)})  # type: ignore[arg-type]
