"""A recording in stretches: what is adjusted at once, so that the memory of a fit does not grow with the length of the clip.

Points are read when their stretch is adjusted and let go after it. The stretches follow each other from the click frame outwards. What is
known of all frames behind is handed over (`handed_over`); of the frames ahead, `MARGIN` take part.

What is finished of a fit in stretches, as arrays that are kept, so that a killed fit goes on with the next stretch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..inputs.material_tracks import MaterialTracks
from ..inputs.standing_feet import StandingFeet
from ..segmentation import crop
from ..solve.block_band import NormalEquations
from ..solve.solver import Solution
from ..solve.time_priors import MarginalPrior
from ..state import BodyState
from .pose_tracking import Checkpoints

AT_ONCE = 300  # frames: a whole body with 4,000 points a frame takes 2 MB each while it is adjusted
BLOCKS = 3  # of those from which the shape is found
MARGIN = 50
REACH_M = 0.10  # of the points that are kept for the adjustment of the sequence


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """What the adjustment over T frames is made from, all of a recording or a stretch of it."""

    fit: FitContext
    frames: Sequence[int]  # T, the take's numbers
    points: Sequence[CloudPoints]  # T
    time_s: np.ndarray  # (T,)
    sigma: np.ndarray  # (D,) of accelerations
    tracks: MaterialTracks | None
    lengths: tuple[np.ndarray, np.ndarray]  # see FitContext.shape_observations
    feet: StandingFeet | None

    def stretch(self, frames: Sequence[int], motion: np.ndarray, vector: np.ndarray) -> "Recording":
        """Some frames, with the points near a motion (T, D) of all frames with the shape vector (S,)."""
        states = self.fit.parameters.states(motion[frames], vector)
        points = [near(self.points[t], state) for t, state in zip(frames, states)]
        if len(frames) == len(self.frames):
            return replace(self, points=points)
        return replace(
            self,
            fit=self.fit.stretch(frames),
            frames=[self.frames[t] for t in frames],
            time_s=self.time_s[frames],
            points=points,
            tracks=self.tracks and self.tracks.stretch(frames),
            feet=self.feet and self.feet.stretch(frames),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameResults:
    """What is told of n adjusted frames."""

    values: np.ndarray  # (n, D)
    covariance: np.ndarray  # (n, D, D)
    joints_m: np.ndarray  # (n, J, 3)
    joint_sigma_m: np.ndarray  # (n, J)
    sigma0: np.ndarray  # (n,)
    points: np.ndarray  # (n, B)
    evidence: np.ndarray  # (n, B)
    outline_m: np.ndarray  # (K,)


def joined(parts: list[FrameResults]) -> FrameResults:
    """One after the other. The list is emptied, so that little is held twice."""
    ends = {name: np.cumsum([0, *(len(getattr(p, name)) for p in parts)]) for name in FrameResults.__dataclass_fields__}
    whole = {name: np.empty((end[-1], *getattr(parts[0], name).shape[1:]), getattr(parts[0], name).dtype) for name, end in ends.items()}
    for i in range(len(parts)):
        part = parts.pop(0)
        for name, end in ends.items():
            whole[name][end[i] : end[i + 1]] = getattr(part, name)
    return FrameResults(**whole)


def near(points: CloudPoints, state: BodyState) -> CloudPoints:
    """The points that the adjustment of a body near this state can ever need."""
    return crop(points, state, REACH_M)


def sample(frames: int, click: int) -> list[int]:
    """Not more than `AT_ONCE` frames: blocks of successive ones, evenly over the recording, one of them around the click frame."""
    long = AT_ONCE // BLOCKS
    starts = np.linspace(0, frames - long, BLOCKS).round().astype(int)
    starts[np.argmin(np.abs(starts + long // 2 - click))] = np.clip(click - long // 2, 0, frames - long)
    return sorted({t for start in starts.tolist() for t in range(start, start + long)})


def spans(frames: int) -> list[range]:
    """All frames in stretches of about the same length, none longer than `AT_ONCE`."""
    ends = np.linspace(0, frames, -(-frames // AT_ONCE) + 1).round().astype(int).tolist()
    return [range(a, b) for a, b in zip(ends, ends[1:])]


def outwards(frames: int, click: int) -> list[tuple[range, range, int]]:
    """The stretches in the order in which they are adjusted: own frames, those with the margin, and the direction from the click frame.

    The first has the click frame, margins on both sides, and direction 0.
    """
    every = spans(frames)
    first = next(k for k, span in enumerate(every) if click in span)

    def wide(span: range, before: int, after: int) -> range:
        return range(max(0, span.start - before), min(frames, span.stop + after))

    return [
        (every[first], wide(every[first], MARGIN, MARGIN), 0),
        *((span, wide(span, 0, MARGIN), 1) for span in every[first + 1 :]),
        *((span, wide(span, MARGIN, 0), -1) for span in every[:first][::-1]),
    ]


A = TypeVar("A")
WAYS = {1: "ahead", -1: "back"}


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """How an adjustment ended."""

    iterations: int
    converged: bool

    def arrays(self) -> dict[str, np.ndarray]:
        """As an array to be kept."""
        return {"ended": np.array([self.iterations, self.converged], dtype=np.int64)}

    @staticmethod
    def of(solution: Solution) -> "Convergence":
        """That of a solution."""
        return Convergence(iterations=solution.iterations, converged=solution.converged)

    @staticmethod
    def loaded(kept: Mapping[str, np.ndarray]) -> "Convergence":
        """What was kept."""
        return Convergence(iterations=int(kept["ended"][0]), converged=bool(kept["ended"][1]))


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeResult:
    """The shape of a recording in stretches."""

    simplified: np.ndarray  # (S',) of the simplified body, from which the complete model is made
    vector: np.ndarray  # (S,)
    covariance: np.ndarray  # (S, S)
    ended: Convergence

    def save(self, kept: Checkpoints | None) -> None:
        """Keep it."""
        if kept is not None:
            kept.save("shape", {"simplified": self.simplified, "vector": self.vector, "covariance": self.covariance, **self.ended.arrays()})

    @staticmethod
    def loaded(kept: Checkpoints | None) -> "ShapeResult | None":
        """What was kept, if anything was."""
        found = kept.load("shape") if kept is not None else None
        if found is None:
            return None
        return ShapeResult(
            simplified=found["simplified"], vector=found["vector"], covariance=found["covariance"], ended=Convergence.loaded(found)
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class MarginalPriors:
    """What the frames behind hand over: to the adjustment, and to covariances, where understated variances are made honest."""

    known: MarginalPrior | None
    honest: MarginalPrior | None


NOTHING_BEHIND = MarginalPriors(known=None, honest=None)


@dataclass(frozen=True, eq=False, kw_only=True)
class StretchResult:
    """An adjusted stretch: what is told of its own frames, and what it hands over ahead (1) and back (−1)."""

    looked: FrameResults
    ended: Convergence
    behind: Mapping[int, MarginalPriors]

    def save(self, kept: Checkpoints | None, own: range, around: range) -> None:
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
    def loaded(kept: Checkpoints | None, own: range, around: range) -> "StretchResult | None":
        """What was kept of these frames with the same margins, if anything was."""
        found = kept.load(_name(own)) if kept is not None else None
        if found is None or found["around"].tolist() != [around.start, around.stop]:
            return None
        behind = {
            way: MarginalPriors(known=_handed_over(found, f"{word}.known", way), honest=_handed_over(found, f"{word}.honest", way))
            for way, word in WAYS.items()
            if f"{word}.known.motion" in found
        }
        return StretchResult(looked=_value(FrameResults, "looked", found), ended=Convergence.loaded(found), behind=behind)


def _name(own: range) -> str:
    return f"frames_{own.start}_{own.stop - 1}"


def _handed_over(kept: Mapping[str, np.ndarray], name: str, way: int) -> MarginalPrior:
    return MarginalPrior(equations=_value(NormalEquations, name, kept), motion=kept[f"{name}.motion"], first=way > 0)


def _table(name: str, value: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass that has nothing else."""
    return {f"{name}.{field.name}": getattr(value, field.name) for field in fields(value)}


def _value(kind: type[A], name: str, kept: Mapping[str, np.ndarray]) -> A:
    return kind(**{field.name: kept[f"{name}.{field.name}"] for field in fields(kind)})  # type: ignore[arg-type]
