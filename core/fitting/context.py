"""What stays the same throughout one fit: model, settings, clicks and priors, and how points become observations."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from ..body.model_file import BodyModel
from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from .explained import Evidence, explained_area
from .hands import BEND_SIGMA
from .inputs.background import BackgroundRegions
from .inputs.clicks import Clicks
from .inputs.cloud_points import VARIANCE_FLOOR_M2, CloudPoints
from .inputs.image_tracks import ImageTracks
from .inputs.keypoints import JointTracks
from .inputs.silhouettes import Silhouettes
from .observations import (
    ClickedJoints,
    EqualRadii,
    HandPoints,
    JointLimits,
    Observation,
    Proportions,
    ShapePrior,
    SilhouetteRays,
    SurfacePoints,
    Symmetry,
)
from .observations.hand_points import hand_owners
from .observations.self_collision import CollisionPairs
from .observations.shape_priors import proportions
from .segmentation import SegmentationCache, segment, soft_segment
from .settings import FitSettings
from .solve.problem import Problem, Smoothness, robust_weights
from .state import BodyState, ShapeParameters, free_bones

SUPPORT_SIGMA_M, SUPPORT_WIDTH = 0.005, 3.0  # of the weights by which poses are compared
EXPLAINED_WIDTH_M = 0.015  # of a cell beyond a limb
FLESH_ASYMMETRY = 2.0  # the sigma of radii on the left against the right over that of lengths
WEIGHT_SIGMA = 0.3  # of ln w: of an isolated ball only r = l √(½ ln 2w) is observable, not its weight and radius apart
POINTS_OF_RAY = 3  # a limb of 25 cm has some 300 points (one a voxel), and 40 rays a view
LARGEST_RESIDUAL = 3.0  # sigmas of a click, or beyond a limit, that count in a score
FEW = 0.5  # of `min_points`: a bone with fewer has lost its points
LEAST_GAIN = 0.25  # of `min_points`: a pose from another start replaces the first one if it explains so many points more; less is noise
HAND_SIGMA_M, HAND_PATCH_M = 0.005, 0.025  # of a hand from its capsules, and how large the patches are in which this error is the same
HAND_GATE_M = 0.045  # from a hand, from where on a point is not the hand's
_Owners = tuple[np.ndarray, np.ndarray, np.ndarray]  # rows of points, the bone of each, and its share
NO_SHAPE = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, eq=False, kw_only=True)
class _SurfaceAndHands:
    """Points on a body's surface, and those on hands with fingers."""

    surface: SurfacePoints
    hands: HandPoints

    def reweighted(self, reference: BodyState) -> "_SurfaceAndHands":
        """The same points with weights from another reference state."""
        return replace(self, surface=self.surface.reweighted(reference))


@dataclass(frozen=True, eq=False, kw_only=True)
class FitContext:
    """Model, settings and clicks of one fit."""

    cameras: tuple[Camera, ...]
    model: BodyModel
    parameters: ShapeParameters
    settings: FitSettings
    clicks: Clicks
    click: int  # index of the frame where the fit begins
    located: np.ndarray  # (J,) whether a joint was located in space, in any frame
    stature_sigma: float  # relative, of a person about the parameters' template
    frames: int  # the prior of bone lengths counts as often
    priors: list[Observation]  # of every frame's motion
    clicked: Mapping[int, ClickedJoints]  # by frame index
    places: Mapping[int, np.ndarray]  # (J, 3) of joints clicked in two views, NaN of others, by frame index
    tracks: JointTracks
    silhouettes: Silhouettes
    background: BackgroundRegions
    collisions: CollisionPairs
    found: tuple[str, ...] = ()  # joints that were found without clicks where the fit begins: bones between them have their own lengths
    unsure: tuple[str, ...] = ()  # of these, joints of limbs that are not certain
    in_views: ImageTracks | None = None  # points followed in single views, where none are measured in space
    turned: np.ndarray | None = None  # (T, D) angles of hands as they were looked for, in place of their priors; NaN of other DOFs
    monitor: Monitor = field(default_factory=Monitor)  # checked for cancellation within the steps

    def stretch(self, frames: Sequence[int]) -> "FitContext":
        """The same for some of the frames, whose indices then begin at 0; only `click` stays the index in the recording."""
        names = ("tracks", "silhouettes", "background", *(() if self.in_views is None else ("in_views",)))
        parts = {name: getattr(self, name).stretch(frames) for name in names}
        clicked = {i: self.clicked[t] for i, t in enumerate(frames) if t in self.clicked}
        turned = None if self.turned is None else self.turned[np.asarray(frames)]
        return replace(self, clicked=clicked, places={i: self.places[frames[i]] for i in clicked}, turned=turned, **parts)

    def pose_observations(self, state: BodyState) -> list[Observation]:
        """Observations of any pose: limits, priors, and no self-collision."""
        return [*self.priors, *self.collisions.observe(state)]

    def joints(self, t: int) -> list[Observation]:
        """Observations of the joints in frame index `t`: clicks and keypoints."""
        return [*([self.clicked[t]] if t in self.clicked else []), *self.tracks.observe(t)]

    def surface(
        self,
        points: CloudPoints,
        state: BodyState,
        gate_scale: np.ndarray | float = 1.0,
        cache: SegmentationCache | None = None,
    ) -> SurfacePoints:
        """The points near a body's surface, as observations of it; `gate_scale` (B,) or for all multiplies the gate.

        Points within one patch share the model's error: the weight of their common part is divided among them (`variance_inflation`).
        """
        find = self._find(points, state, gate_scale)
        if cache is None:
            return self._observed(points, state, *find())
        return cache.observed(points.frame, state, find, partial(self._observed, points, state))

    def _find(self, points: CloudPoints, state: BodyState, gate_scale: np.ndarray | float = 1.0) -> Callable[[], _Owners]:
        """The segmentation of points, still to be made."""
        s = self.settings
        return partial(_hard if s.segmentation == "hard" else soft_segment, points, state, self.model.surface, s.gate_m * gate_scale)

    def _observed(self, points: CloudPoints, state: BodyState, rows: np.ndarray, bone: np.ndarray, share: np.ndarray) -> SurfacePoints:
        """Some points (rows), each with its bone and the share of it that is this bone's."""
        s = self.settings
        own, model = points.sigma_m[rows] ** 2 + VARIANCE_FLOOR_M2, s.model_sigma_m**2
        in_patch = max(1.0, (s.model_patch_m / s.voxel_m) ** 2)  # points that share the model's error
        return SurfacePoints.about(
            state,
            xyz_m=points.xyz_m[rows],
            bone=bone,
            sigma_m=np.sqrt(own + model),
            variance_inflation=(own + in_patch * model) / (own + model) / share,
            form=s.residual,
        )

    def surface_observations(
        self,
        t: int,
        points: CloudPoints,
        state: BodyState,
        gate_scale: np.ndarray | float = 1.0,
        cache: SegmentationCache | None = None,
    ) -> list[Observation]:
        """Observations of the body's surface in frame index `t`: measured points and outlines."""
        return [self.surface(points, state, gate_scale, cache), *self.silhouettes.observe(t, state, cache, gate_scale)]

    def with_fingers(self, t: int, points: CloudPoints, state: BodyState, cache: SegmentationCache | None = None) -> list[Observation]:
        """As `surface_observations`; where hands were looked for and have enough points, these are on their fingers, not on metaballs."""
        if self.turned is None:
            return self.surface_observations(t, points, state, cache=cache)
        find, observe = partial(self._find_with_hands, points, state), partial(self._observe_with_hands, points, state)
        found = observe(*find()) if cache is None else cache.observed(points.frame, state, find, observe)
        return [found.surface, found.hands, *self.silhouettes.observe(t, state, cache)]

    def _find_with_hands(self, points: CloudPoints, state: BodyState) -> tuple[_Owners, tuple[np.ndarray, np.ndarray]]:
        """The segmentation of points without those of hands, and of these: rows and bones.

        A hand has its own if they are at least `min_points`, and its forearm has points: an arm that nobody sees may lie beside anything.
        """
        (rows, bone, share), (of_hands, hand) = self._find(points, state)(), hand_owners(points.xyz_m, points.normals, state, HAND_GATE_M)
        count, others = (np.bincount(of, minlength=len(state.lengths_m)) for of in (hand, bone))
        enough = (count[hand] >= self.settings.min_points) & (others[state.skeleton.parents[hand]] >= self.few_points)
        of_hands, hand = of_hands[enough], hand[enough]
        kept = ~np.isin(bone, hand) & ~np.isin(rows, of_hands)
        return (rows[kept], bone[kept], share[kept]), (of_hands, hand)

    def _observe_with_hands(
        self, points: CloudPoints, state: BodyState, others: _Owners, hands: tuple[np.ndarray, np.ndarray]
    ) -> _SurfaceAndHands:
        """The observations of what `_find_with_hands` found."""
        rows, bone = hands
        own, in_patch = points.sigma_m[rows] ** 2 + VARIANCE_FLOOR_M2, max(1.0, (HAND_PATCH_M / self.settings.voxel_m) ** 2)
        variance = own + HAND_SIGMA_M**2
        found = HandPoints(
            xyz_m=points.xyz_m[rows],
            bone=bone,
            sigma_m=np.sqrt(variance),
            variance_inflation=(own + in_patch * HAND_SIGMA_M**2) / variance,
        )
        return _SurfaceAndHands(surface=self._observed(points, state, *others), hands=found)

    def evidence(self, t: int, points: CloudPoints, state: BodyState) -> np.ndarray:
        """The points of each bone (B,), rays of outlines and points followed in single views counted as several; a keypoint at its end
        counts as enough."""
        b, ends = len(state.lengths_m), [self.model.skeleton.joint_names.index(bone.tail_joint) for bone in self.model.skeleton.bones]
        counts = np.bincount(segment(points, state, self.model.surface, self.settings.gate_m)[1], minlength=b)
        for rays in self.silhouettes.observe(t, state):
            counts += POINTS_OF_RAY * np.bincount(rays.bone, minlength=b)
        if self.in_views is not None:
            counts += POINTS_OF_RAY * self.in_views.counts(t, state)
        return np.asarray(counts + np.where(np.isin(ends, self.tracks.joints(t)), self.settings.min_points, 0))

    @property
    def few_points(self) -> float:
        """A bone with fewer points has lost them."""
        return FEW * self.settings.min_points

    @property
    def least_gain(self) -> float:
        """By how many points a pose must be better supported to replace another."""
        return LEAST_GAIN * self.settings.min_points

    @cached_property
    def proportions(self) -> Proportions:
        """The prior of the bone lengths. It counts once for every frame: the model's error is the same in all of them."""
        s, root = self.settings, np.sqrt(self.frames)
        return proportions(
            self.model,
            self.parameters.template.lengths_m,
            self.located,
            s.length_sigma,
            s.proportion_sigma / root,
            self.stature_sigma / root,
            self.found,
        )

    def shape_observations(self, lengths: tuple[np.ndarray, np.ndarray] | None = None, weight: float = 1.0) -> list[Observation]:
        """The priors of the shape; `lengths`: ln of the bone lengths (B,) and their sigmas, where there is more than the proportions
        (else infinite). `weight`: how often they will count; that of bends counts once."""
        mean, s = self.parameters.vector(), self.settings
        sigma, own = np.full(len(mean), s.radius_sigma), self.model.radius_sigma[self.parameters.template.metaballs.bone_index]
        sigma[self.parameters.layout.group("radii")] = np.repeat(np.where(own > 0, own, s.radius_sigma), 2)
        sigma[self.parameters.layout.group("weights")] = WEIGHT_SIGMA
        sigma[self.parameters.layout.group("bends")] = BEND_SIGMA * np.sqrt(weight)
        of_lengths = self.parameters.layout.group("lengths")
        mean[of_lengths], sigma[of_lengths] = lengths if lengths is not None else (mean[of_lengths], np.inf)
        radii = self.parameters.template.metaballs.radii_m
        found: list[Observation] = [
            ShapePrior(mean=mean, sigma=sigma),
            self.proportions,
            EqualRadii(sigma=s.roundness_sigma, log_ratio=np.log(radii[:, 0] / radii[:, 2])),
        ]
        left, right = self.parameters.pairs()
        asymmetry = np.where(np.isin(left, of_lengths), 1.0 / np.sqrt(self.frames), FLESH_ASYMMETRY)
        return [*found, Symmetry(left=left, right=right, sigma=s.symmetry_sigma * asymmetry)] if len(left) else found

    def problem(
        self,
        observe: Callable[[int, BodyState], list[Observation]],
        free: str | None = None,
        smoothness: Smoothness | None = None,
        *,
        fix_pose: bool = False,
    ) -> Problem:
        """An adjustment of the shape parameters in the group `free`, and of the pose unless it is fixed."""
        shape = self.parameters.layout.group(free) if free else NO_SHAPE
        fixed = np.arange(len(self.model.skeleton.dofs)) if fix_pose else self.model.skeleton.locked
        return Problem(
            parameters=self.parameters,
            observe=observe,
            shape_observations=self.shape_observations(),
            free_shape=shape,
            smoothness=smoothness,
            fixed=fixed,
            robust=self.settings.robust,
            robust_width=self.settings.robust_width,
            monitor=self.monitor,
        )

    def with_exact_outlines(self, points: Iterable[CloudPoints]) -> "FitContext":
        """Without the outlines against the background, which are less exact than measured points, if any of the frames has `points`."""
        return replace(self, silhouettes=self.silhouettes.drawn_only()) if any(len(cloud.xyz_m) for cloud in points) else self

    def support(self, t: int, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> float:
        """How many points and rays of frame index `t` a body explains: the sum of their robust weights for a width of `SUPPORT_SIGMA_M`."""
        state = self.parameters.state(motion, vector)
        found: list[SurfacePoints | SilhouetteRays] = [self.surface(points, state), *self.silhouettes.observe(t, state)]
        return sum(
            float(robust_weights(o.residual(state) * o.sigma_m / SUPPORT_SIGMA_M, "geman-mcclure", SUPPORT_WIDTH).sum()) for o in found
        )

    def seen(self, t: int, points: CloudPoints) -> Evidence:
        """What is seen in frame index `t`, for a search."""
        return Evidence.of(points, self.background.cells(t), self.settings.voxel_m)

    def score(self, t: int, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, support: float | None = None) -> float:
        """The `support` (computed unless it is given) and the area of the person's cells that the body explains, less that of limbs in the
        background and half the squared residuals of joints in frame index t and of the DOFs' limits (capped)."""
        state = self.parameters.state(motion, vector)
        limits = [prior for prior in self.priors if isinstance(prior, JointLimits)]
        residuals = np.concatenate([o.residual(state) for o in (*self.joints(t), *limits)])
        seen = self.seen(t, points)
        area = explained_area(seen, state, free_bones(self.parameters), EXPLAINED_WIDTH_M) if seen.cells else 0.0
        support = self.support(t, points, motion, vector) if support is None else support
        return support + area - 0.5 * float(np.minimum(residuals**2, LARGEST_RESIDUAL**2).sum())


def _hard(
    points: CloudPoints,
    state: BodyState,
    surface: np.ndarray,
    gate_m: np.ndarray | float,
) -> _Owners:
    """As `soft_segment`, with every point wholly one limb's."""
    rows, bone = segment(points, state, surface, gate_m)
    return rows, bone, np.ones(len(rows))
