"""What stays the same throughout one fit: the model, the clicks, what is believed beforehand, and how points become observations."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import cast

import numpy as np

from ..body.model_file import BodyModel
from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from .inputs.background import BackgroundRegions
from .inputs.clicks import Clicks
from .inputs.cloud_points import CloudPoints
from .inputs.keypoints import JointTracks
from .inputs.silhouettes import Silhouettes
from .observations import (
    ClickedJoints,
    EqualRadii,
    JointLimits,
    Observation,
    Proportions,
    ShapePrior,
    SilhouetteRays,
    SurfacePoints,
    Symmetry,
)
from .observations.self_collision import CollisionPairs
from .observations.shape_priors import proportions
from .robust import robust_weights
from .segmentation import SegmentationCache, segment, soft_segment
from .settings import FitSettings
from .solve.problem import Problem
from .solve.time_priors import Acceleration
from .state import BodyState, ShapeParameters

SUPPORT_SIGMA_M = 0.005  # width of the weight by which postures are compared
FLESH_UNLIKE = 2.0  # the sigma of radii on the left against the right over that of lengths
WEIGHT_SIGMA = 0.3  # of ln w: an isolated ball's weight and radius are seen as one, r = l √(½ ln 2w)
POINTS_OF_RAY = 3  # a limb of 25 cm shows some 300 points (of one voxel each), and 40 rays a view
MOST_OFF = 3.0  # sigmas of a click, or beyond a limit, that count
NO_SHAPE = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, eq=False, kw_only=True)
class FitContext:
    """Model, settings and clicks of one fit."""

    cameras: tuple[Camera, ...]
    model: BodyModel
    parameters: ShapeParameters
    settings: FitSettings
    clicks: Clicks
    click: int  # index of the frame where the fit begins
    located: np.ndarray  # (J,) whether a joint has a place in space of its own, in any frame
    stature_sigma: float  # relative, of a person about the parameters' template
    frames: int  # for how many a belief of bone lengths counts
    priors: list[Observation]  # of every frame's motion
    clicked: Mapping[int, ClickedJoints]  # by frame index
    places: Mapping[int, np.ndarray]  # (J, 3) of joints clicked in two views, NaN of others, by frame index
    tracks: JointTracks
    silhouettes: Silhouettes
    empty: BackgroundRegions
    limbs: CollisionPairs
    monitor: Monitor = field(default_factory=Monitor)  # asked within the steps whether to stop

    def stretch(self, frames: Sequence[int]) -> "FitContext":
        """The same for some of the frames, which count from 0 then; only `click` stays the index in the recording."""
        parts = {name: getattr(self, name).stretch(frames) for name in ("tracks", "silhouettes", "empty")}
        clicked = {i: self.clicked[t] for i, t in enumerate(frames) if t in self.clicked}
        return replace(self, clicked=clicked, places={i: self.places[frames[i]] for i in clicked}, **parts)

    def pose_observations(self, state: BodyState) -> list[Observation]:
        """What is known of any posture: limits, priors, and that limbs are no ghosts."""
        return [*self.priors, *self.limbs.observe(state)]

    def joints(self, t: int) -> list[Observation]:
        """What is known of the joints in frame index `t`: clicks and keypoints."""
        return [*([self.clicked[t]] if t in self.clicked else []), *self.tracks.observe(t)]

    def surface(
        self,
        points: CloudPoints,
        state: BodyState,
        wide: np.ndarray | float = 1.0,
        held: SegmentationCache | None = None,
    ) -> SurfacePoints:
        """The points near a body's surface, as observations of it; `wide` (B,) or for all multiplies the gate.

        Points within one patch share the model's error: the weight of their common part is divided among them (`variance_inflation`).
        """
        s = self.settings
        find = partial(_hard if s.segmentation == "hard" else soft_segment, points, state, self.model.surface, s.gate_m * wide)
        if held is None:
            return self._observed(points, *find()).scaled(state)
        owners = held.get(points.frame, state, find)
        made = (held.made(points.frame, owners) or self._observed(points, *owners)).scaled(state)
        held.keep(points.frame, owners, made)
        return cast(SurfacePoints, made)

    def _observed(self, points: CloudPoints, rows: np.ndarray, bone: np.ndarray, part: np.ndarray) -> SurfacePoints:
        s = self.settings
        own, model = points.sigma_m[rows] ** 2 + 1e-12, s.model_sigma_m**2
        share = max(1.0, (s.model_patch_m / s.voxel_m) ** 2)
        return SurfacePoints(
            xyz_m=points.xyz_m[rows],
            bone=bone,
            sigma_m=np.sqrt(own + model),
            variance_inflation=(own + share * model) / (own + model) / part,
            form=s.residual,
        )

    def surface_observations(
        self, t: int, points: CloudPoints, state: BodyState, wide: np.ndarray | float = 1.0, held: SegmentationCache | None = None
    ) -> list[Observation]:
        """What the views show of the body's surface in frame index `t`: measured points, and outlines."""
        return [self.surface(points, state, wide, held), *self.silhouettes.observe(t, state, held, wide)]

    def evidence(self, t: int, points: CloudPoints, state: BodyState) -> np.ndarray:
        """How many points each bone (B,) has, and what stands for points: rays of outlines, and a keypoint at its end, which is enough."""
        b, ends = len(state.lengths_m), [self.model.skeleton.joint_names.index(bone.tail_joint) for bone in self.model.skeleton.bones]
        counts = np.bincount(segment(points, state, self.model.surface, self.settings.gate_m)[1], minlength=b)
        for rays in self.silhouettes.observe(t, state):
            counts += POINTS_OF_RAY * np.bincount(rays.bone, minlength=b)
        return np.asarray(counts + np.where(np.isin(ends, self.tracks.joints(t)), self.settings.min_points, 0))

    @cached_property
    def proportions(self) -> Proportions:
        """What is believed of the bone lengths, against the error that the model has in all frames alike."""
        s, alike = self.settings, np.sqrt(self.frames)
        return proportions(
            self.model,
            self.parameters.template.lengths_m,
            self.located,
            s.length_sigma,
            s.proportion_sigma / alike,
            self.stature_sigma / alike,
        )

    def shape_observations(self, lengths: tuple[np.ndarray, np.ndarray] | None = None) -> list[Observation]:
        """What is believed about the shape; `lengths`: ln of the bone lengths (B,) and their sigmas, where more than the proportions is
        known (else infinite)."""
        mean, s = self.parameters.vector(), self.settings
        sigma = np.full(len(mean), s.radius_sigma)
        sigma[self.parameters.layout.group("weights")] = WEIGHT_SIGMA
        of_lengths = self.parameters.layout.group("lengths")
        mean[of_lengths], sigma[of_lengths] = lengths if lengths is not None else (mean[of_lengths], np.inf)
        radii = self.parameters.template.metaballs.radii_m
        found: list[Observation] = [
            ShapePrior(mean=mean, sigma=sigma),
            self.proportions,
            EqualRadii(sigma=s.roundness_sigma, log_ratio=np.log(radii[:, 0] / radii[:, 2])),
        ]
        left, right = self.parameters.pairs()
        unlike = np.where(left < self.parameters.n_lengths, 1.0 / np.sqrt(self.frames), FLESH_UNLIKE)
        return [*found, Symmetry(left=left, right=right, sigma=s.symmetry_sigma * unlike)] if len(left) else found

    def problem(
        self,
        observe: Callable[[int, BodyState], list[Observation]],
        free: str | None = None,
        smoothness: Acceleration | None = None,
        *,
        hold_motion: bool = False,
    ) -> Problem:
        """An adjustment in which the shape parameters of the set `free` may change, and the motion unless it is held."""
        shape = self.parameters.layout.group(free) if free else NO_SHAPE
        held = np.arange(len(self.model.skeleton.dofs)) if hold_motion else self.model.skeleton.locked
        return Problem(
            parameters=self.parameters,
            observe=observe,
            shape_observations=self.shape_observations(),
            free_shape=shape,
            smoothness=smoothness,
            held=held,
            robust=self.settings.robust,
            robust_width=self.settings.robust_width,
            monitor=self.monitor,
        )

    def support(self, t: int, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> float:
        """How many points and rays of frame index `t` a body explains: the sum of their weights at a fixed width."""
        state = self.parameters.state(motion, vector)
        found: list[SurfacePoints | SilhouetteRays] = [self.surface(points, state), *self.silhouettes.observe(t, state)]
        return sum(float(robust_weights(o.residual(state) * o.sigma_m / SUPPORT_SIGMA_M, "geman-mcclure", 3.0).sum()) for o in found)

    def score(self, t: int, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> float:
        """The `support`, less what joints known in frame index t and the DOFs' limits are off by: half the squares of it, in sigmas."""
        state = self.parameters.state(motion, vector)
        limits = [prior for prior in self.priors if isinstance(prior, JointLimits)]
        off = np.concatenate([o.residual(state) for o in (*self.joints(t), *limits)])
        return self.support(t, points, motion, vector) - 0.5 * float(np.minimum(off**2, MOST_OFF**2).sum())


def _hard(
    points: CloudPoints,
    state: BodyState,
    surface: np.ndarray,
    gate_m: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `soft_segment`: every point is wholly one limb's."""
    rows, bone = segment(points, state, surface, gate_m)
    return rows, bone, np.ones(len(rows))
