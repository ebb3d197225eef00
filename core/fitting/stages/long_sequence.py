"""A long recording in stretches: the frames that are adjusted at once, so that the memory of a fit does not grow with the length of the
clip.

Points are read when their stretch is adjusted, and released after it. The stretches follow each other from the click frame outwards. All
frames of earlier stretches contribute a marginal prior (`solve.time_priors`); of the frames ahead, `MARGIN` take part. The shape and every
adjusted stretch are stored, so that an interrupted fit resumes with the next one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from ..context import FitContext
from ..hands import REACH
from ..inputs.cloud_points import CloudPoints
from ..inputs.material_tracks import PointTracks
from ..limb import Limb, whole_limbs
from ..observations.joints import StandingFeet
from ..segmentation import crop
from ..solve.block_band import NormalEquations
from ..solve.problem import Estimate, robust_scale
from ..solve.solver import Solution
from ..solve.time_priors import MarginalPrior
from ..state import BodyState
from .contradicted import misplaced_limbs, widened
from .joint_places import JointPlaces, has_both_sides, joints_in_place, place_sigmas
from .limb_modes import elsewhere, of_joints
from .pose_tracking import Checkpoints
from .unseen_hands import unseen_hands

A = TypeVar("A")
DIRECTIONS = {1: "ahead", -1: "back"}
AT_ONCE = 300  # frames: a whole body with 4,000 points a frame takes 2 MB each while it is adjusted
BLOCKS = 3  # of frames for the shape
MARGIN = 50
REACH_M = 0.10  # of the points that take part in the adjustment of the sequence
SUSPICIOUS = 3.0  # times the usual sigma0
Covariance = tuple[np.ndarray, np.ndarray, np.ndarray]  # blocks: pose (T, D, D), pose with shape (T, D, S), shape (S, S)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """The input of the adjustment over T frames: a whole recording or a stretch of it."""

    fit: FitContext
    frames: Sequence[int]  # T, the take's numbers
    points: Sequence[CloudPoints]  # T
    time_s: np.ndarray  # (T,)
    sigma: np.ndarray  # (D,) of accelerations
    tracks: PointTracks | None
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

    def places(self, solution: Solution) -> JointPlaces | None:
        """Where the joints lie, if that is asked for."""
        asked, joints = self.fit.settings.place_joints, self.fit.parameters.skeleton.joint_names
        if asked == "off" or (asked == "auto" and not has_both_sides(joints)):
            return None
        return joints_in_place(self.fit, solution.motion, solution.vector, self.time_s)

    def place_sigmas(self, solution: Solution, places: JointPlaces | None) -> np.ndarray:
        """Sigma (J,) [m] of where each joint lies in the body, whether it was moved to its clicks or not."""
        found = places or joints_in_place(self.fit, solution.motion, solution.vector, self.time_s)
        return place_sigmas(self.fit) if found is None else found.sigma_m

    def with_places(self, solution: Solution, places: JointPlaces | None) -> tuple["Recording", Solution]:
        """The recording and its solution with the joints in their places, if there are others."""
        if places is None:
            return self, solution
        fit, solution = places.applied(self.fit, solution)
        return replace(self, fit=fit), solution


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameResults:
    """The results of n adjusted frames."""

    values: np.ndarray  # (n, D)
    covariance: np.ndarray  # (n, D, D)
    joints_m: np.ndarray  # (n, J, 3)
    joint_sigma_m: np.ndarray  # (n, J)
    sigma0: np.ndarray  # (n,)
    points: np.ndarray  # (n, B)
    evidence: np.ndarray  # (n, B)
    outline_m: np.ndarray  # (K,)
    misplaced: np.ndarray  # (n, L) area in voxels by which each limb contradicts what is seen (`contradicted`)
    elsewhere_m2: np.ndarray  # (n, J) variance that the other places of limbs add (`limb_modes`); joint_sigma_m is without it


def frame_results(
    part: Recording, solution: Estimate, covariance: Covariance, frames: range, limbs: Sequence[Limb] | None = None
) -> FrameResults:
    """The results of some of the frames that were adjusted. `limbs`: those that are looked for elsewhere, too; by default all."""
    fit, points, (pose, mixed, shape) = part.fit, part.points, covariance
    skeleton = fit.model.skeleton
    n, J, B = len(frames), len(skeleton.joint_names), len(skeleton.bones)
    joints, joint_sigma = np.empty((n, J, 3)), np.empty((n, J))
    sigma0 = np.array([frame_sigma0(fit, t, points[t], solution) for t in frames])
    counts, outline = np.zeros((2, n, B), dtype=np.int64), [np.zeros(0)]
    limbs = whole_limbs(fit.parameters) if limbs is None else limbs
    given = fit, points, solution, part.time_s, frames, limbs
    wrong, others = [], [*elsewhere(*given), *unseen_hands(*given)]
    for i, t in enumerate(frames):
        fit.monitor.check()
        state = fit.parameters.state(solution.motion[t], solution.vector)
        joints[i], A = state.joint_jacobian
        K = np.block([[pose[t], mixed[t]], [mixed[t].T, shape]])
        joint_sigma[i] = np.sqrt(np.einsum("jia,ab,jib->j", A, K, A, optimize=True) / 3)
        counts[0, i] = np.bincount(fit.surface(points[t], state).bone, minlength=B)
        counts[1, i] = fit.evidence(t, points[t], state)
        wrong.append(misplaced_limbs(fit, t, points[t], state))
        widened(fit.parameters, wrong[-1], pose[t], joint_sigma[i])
        for other in others:
            pose[t][np.ix_(other.limb.columns, other.limb.columns)] += other.covariance[i]
        outline += [np.abs(rays.residual(state)) * rays.sigma_m for rays in fit.silhouettes.observe(t, state)]
    return FrameResults(
        values=solution.motion[frames],
        covariance=pose[frames],
        joints_m=joints,
        joint_sigma_m=joint_sigma,
        sigma0=sigma0,
        points=counts[0],
        evidence=counts[1],
        outline_m=np.concatenate(outline),
        misplaced=np.array(wrong),
        elsewhere_m2=of_joints(others, skeleton, n),
    )


def frame_sigma0(fit: FitContext, t: int, points: CloudPoints, solution: Estimate) -> float:
    """The robust scale of a frame's points, without points that of its outlines; NaN without either."""
    state = fit.parameters.state(solution.motion[t], solution.vector)
    residuals = [r for o in fit.surface_observations(t, points, state) if len(r := o.residual(state))]
    return robust_scale(residuals[0]) if residuals else np.nan


def outlying(sigma0: np.ndarray) -> np.ndarray:
    """Which frames (T,) have suspiciously large residuals."""
    usual = np.nanmedian(sigma0) if np.isfinite(sigma0).any() else 1.0
    return np.asarray(np.nan_to_num(sigma0) > SUSPICIOUS * usual)


def joined(parts: list[FrameResults]) -> FrameResults:
    """One after the other. The list is emptied meanwhile, so that little is in memory twice."""
    ends = {name: np.cumsum([0, *(len(getattr(p, name)) for p in parts)]) for name in FrameResults.__dataclass_fields__}
    whole = {name: np.empty((end[-1], *getattr(parts[0], name).shape[1:]), getattr(parts[0], name).dtype) for name, end in ends.items()}
    for i in range(len(parts)):
        part = parts.pop(0)
        for name, end in ends.items():
            whole[name][end[i] : end[i + 1]] = getattr(part, name)
    return FrameResults(**whole)


def near(points: CloudPoints, state: BodyState) -> CloudPoints:
    """The points that the adjustment of a body near this state can ever need."""
    reach = np.full(len(state.lengths_m), REACH_M)
    hands = list(state.layout.hands)
    reach[hands] += (REACH - 1) * state.lengths_m[hands]  # with their fingers
    return crop(points, state, reach)


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
    """The stretches in the order of their adjustment: own frames, those with the margin, and the direction from the click frame.

    The first contains the click frame; it has margins on both sides, and direction 0.
    """
    every = spans(frames)
    first = next(k for k, span in enumerate(every) if click in span)

    def extended(span: range, before: int, after: int) -> range:
        return range(max(0, span.start - before), min(frames, span.stop + after))

    return [
        (every[first], extended(every[first], MARGIN, MARGIN), 0),
        *((span, extended(span, 0, MARGIN), 1) for span in every[first + 1 :]),
        *((span, extended(span, MARGIN, 0), -1) for span in every[:first][::-1]),
    ]


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Iterations of an adjustment, and whether it converged."""

    iterations: int
    converged: bool

    def arrays(self) -> dict[str, np.ndarray]:
        """As an array, for a checkpoint."""
        return {"convergence": np.array([self.iterations, self.converged], dtype=np.int64)}

    @staticmethod
    def of(solution: Solution) -> "Convergence":
        """That of a solution."""
        return Convergence(iterations=solution.iterations, converged=solution.converged)

    @staticmethod
    def loaded(checkpoint: Mapping[str, np.ndarray]) -> "Convergence":
        """From a checkpoint."""
        return Convergence(iterations=int(checkpoint["convergence"][0]), converged=bool(checkpoint["convergence"][1]))


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeResult:
    """The shape of a recording in stretches."""

    simplified: np.ndarray  # (S',) of the simplified body, from which the complete model is made
    vector: np.ndarray  # (S,)
    covariance: np.ndarray  # (S, S)
    places: JointPlaces | None  # of the joints in the body
    place_m: np.ndarray  # (J,) sigma of these places
    convergence: Convergence

    def save(self, checkpoints: Checkpoints | None) -> None:
        """Store it."""
        if checkpoints is not None:
            arrays = {"simplified": self.simplified, "vector": self.vector, "covariance": self.covariance, "place_m": self.place_m}
            arrays |= _table("places", self.places) if self.places is not None else {}
            checkpoints.save("shape_of_blocks", {**arrays, **self.convergence.arrays()})

    @staticmethod
    def loaded(checkpoints: Checkpoints | None) -> "ShapeResult | None":
        """From its checkpoint, if there is one."""
        found = checkpoints.load("shape_of_blocks") if checkpoints is not None else None
        if found is None:
            return None
        return ShapeResult(
            simplified=found["simplified"],
            vector=found["vector"],
            covariance=found["covariance"],
            places=_value(JointPlaces, "places", found) if "places.vector" in found else None,
            place_m=found["place_m"],
            convergence=Convergence.loaded(found),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class MarginalPriors:
    """The marginal prior of a stretch, once for its adjustment, once with calibrated variances (`variance_factors`) for its covariances."""

    adjustment: MarginalPrior | None
    covariance: MarginalPrior | None


NO_PRIORS = MarginalPriors(adjustment=None, covariance=None)


@dataclass(frozen=True, eq=False, kw_only=True)
class StretchResult:
    """An adjusted stretch: the results of its own frames, and the priors for the stretch ahead (1) and for the one before (−1)."""

    results: FrameResults
    convergence: Convergence
    priors: Mapping[int, MarginalPriors]

    def save(self, checkpoints: Checkpoints | None, own: range, around: range) -> None:
        """Store it under its own frames, with those that took part."""
        if checkpoints is None:
            return
        arrays = {"around": np.array([around.start, around.stop]), **self.convergence.arrays(), **_table("results", self.results)}
        for direction, priors in self.priors.items():
            for use, prior in (("adjustment", priors.adjustment), ("covariance", priors.covariance)):
                assert prior is not None
                name = f"{DIRECTIONS[direction]}.{use}"
                arrays |= {f"{name}.motion": prior.motion, **_table(name, prior.equations)}
        checkpoints.save(_name(own), arrays)

    @staticmethod
    def loaded(checkpoints: Checkpoints | None, own: range, around: range) -> "StretchResult | None":
        """From its checkpoint, if there is one of these frames with the same margins."""
        found = checkpoints.load(_name(own)) if checkpoints is not None else None
        if found is None or found["around"].tolist() != [around.start, around.stop]:
            return None
        priors = {
            direction: MarginalPriors(
                adjustment=_prior(found, f"{word}.adjustment", direction), covariance=_prior(found, f"{word}.covariance", direction)
            )
            for direction, word in DIRECTIONS.items()
            if f"{word}.adjustment.motion" in found
        }
        return StretchResult(results=_value(FrameResults, "results", found), convergence=Convergence.loaded(found), priors=priors)


def _name(own: range) -> str:
    return f"stretch_{own.start}_{own.stop - 1}"


def _prior(checkpoint: Mapping[str, np.ndarray], name: str, direction: int) -> MarginalPrior:
    return MarginalPrior(equations=_value(NormalEquations, name, checkpoint), motion=checkpoint[f"{name}.motion"], first=direction > 0)


def _table(name: str, value: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass that has nothing else."""
    return {f"{name}.{field.name}": getattr(value, field.name) for field in fields(value)}


def _value(kind: type[A], name: str, checkpoint: Mapping[str, np.ndarray]) -> A:
    return kind(**{field.name: checkpoint[f"{name}.{field.name}"] for field in fields(kind)})  # type: ignore[arg-type]
