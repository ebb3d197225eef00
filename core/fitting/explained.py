"""How much of what is seen in a frame a pose explains: measured points, and the person's cells in front of the still background.

    w(g) = 1 / (1 + (g / width)²)²                                                                        (1)
    e = Σ_i a_i max(0, max_b w(g_ib) − taken_i)                                                           (2)
    gain = e_points + max(0, e_cells − UNSEEN · A) − Σ_s a_s (min(1, d_s / r_s) + through_s)               (3)

i are points and cells, b the bones of a limb as tapered capsules, g the distance from a capsule's surface (cells: beyond its image), and
`taken` what the rest of the body explains. A is the limb's own area: the body's outline differs from the model's all around, and a hidden
limb must not be drawn to these rims. s are places along the limb: d_s is how far a place lies in the background, averaged over the views,
r_s the limb's radius there; `through` is 1 where points were measured far behind it, or where it lies inside another part. Areas a are in
voxels of the cloud, so that (3) counts like points. Many poses of one limb are evaluated at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..body.skeleton import bone_frames, frames_of_bones
from ..geometry.camera import Camera
from .hands import PALM, hand_capsules, is_hand
from .inputs.background import PersonCells
from .inputs.cloud_points import CloudPoints
from .inputs.silhouettes import near_rays
from .limb import Limb
from .segmentation import facing_bone, gap_to_bone, near_pairs
from .state import BodyState, ShapeParameters, free_bones

MOST_POINTS, MOST_NEAR = 1000, 400  # of a frame, and near a limb
COARSE = 3  # points and cells as one, for a first choice among many poses
CELL_WEIGHT = 0.5  # of the person's area in all views together, against that of measured points
UNSEEN = 0.2  # of a limb's area: rims of the rest of the body are no larger
TAKEN_M, TAKEN_CELLS_M = 0.04, 0.02  # widths: a body differs from its metaballs by a centimetre or two, and what it explains is no other's
BEYOND_M = 0.05  # what is so far beyond a limb's reach is not the limb's
LARGEST = 40_000  # distances from one bone in all poses that are evaluated at once; several threads gain nothing here
FAR = 4.0  # widths, from where on nothing is explained
EXPLAINED = 0.95  # of a point or cell: no limb is looked for there
FACING = 0.3  # least cosine between a point's normal and the limb's
PLACES = np.array([0.15, 0.4, 0.65, 0.9])  # along a bone, where it must not lie in the background
CLEAR_OF_JOINT = 0.5  # of a limb's first bone, from where on it is in no other part
BEHIND_M = 0.06  # a limb so far before measured points would hide them
CELL_OF_DEPTH_M = 0.03
_ZERO, _ONE = np.float32(0), np.float32(1)  # numpy is slower with numbers of another type
FINGERS = np.s_[len(PALM) :]  # of a hand's capsules
FAR_AWAY_M = 1e6  # instead of an infinite distance, which products of matrices do not bear
LARGEST_PX = 1e6  # of an end of a bone in an image: in the plane of a camera a projection has no limit


@dataclass(frozen=True, eq=False, kw_only=True)
class _NearestDepths:
    """The depth [m] of the nearest measured point in square cells of one view, infinite without one; `low` is the index of the first."""

    camera: Camera
    cells_per_tangent: float
    low: np.ndarray  # (2,)
    depth_m: np.ndarray  # (w, h)

    @staticmethod
    def of(camera: Camera, xyz_m: np.ndarray) -> "_NearestDepths":
        """Those of points (N, 3), at least one."""
        p = camera.to_camera(xyz_m)
        scale = float(np.median(p[:, 2])) / CELL_OF_DEPTH_M
        at = np.floor(p[:, :2] / p[:, 2:] * scale).astype(int)
        low = at.min(axis=0)
        depth = np.full(at.max(axis=0) - low + 1, np.inf)
        np.minimum.at(depth, tuple((at - low).T), p[:, 2])
        return _NearestDepths(camera=camera, cells_per_tangent=scale, low=low, depth_m=depth)

    def far_behind(self, xyz_m: np.ndarray) -> np.ndarray:
        """Whether (N,) the nearest point is far behind places (N, 3)."""
        q = self.camera.to_camera(xyz_m)
        where = np.floor(q[:, :2] / np.maximum(q[:, 2:], 1e-6) * self.cells_per_tangent).astype(int) - self.low
        inside = (where >= 0).all(axis=1) & (where < self.depth_m.shape).all(axis=1)
        i, j = np.where(inside[:, None], where, 0).T
        return np.asarray(inside & np.isfinite(self.depth_m[i, j]) & (self.depth_m[i, j] > q[:, 2] + BEHIND_M))


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """What is seen in one frame, or what of it is near a limb, and how much of that other parts explain. Areas in voxels of the cloud."""

    points: CloudPoints
    taken: np.ndarray  # (P,) the share of each point that is explained
    point_area: float  # of one point
    cells: Sequence[PersonCells]  # of each view
    taken_cells: Sequence[np.ndarray]  # (M,) of each view
    voxel_m: float
    depths: _NearestDepths | None  # of all points, in the middle view

    @staticmethod
    def of(points: CloudPoints, cells: Sequence[PersonCells], voxel_m: float) -> "Evidence":
        """The points, thinned, and the cells of all views."""
        every = 1 + (len(points.xyz_m) - 1) // MOST_POINTS if len(points.xyz_m) else 1
        thin = points.take(np.arange(0, len(points.xyz_m), every))
        return Evidence(
            points=thin,
            taken=np.zeros(len(thin.xyz_m)),
            point_area=float(every),
            cells=cells,
            taken_cells=[np.zeros(len(view.xy_px)) for view in cells],
            voxel_m=voxel_m,
            depths=_NearestDepths.of(cells[len(cells) // 2].camera, thin.xyz_m) if cells and len(thin.xyz_m) else None,
        )

    def near(self, limb: Limb, state: BodyState) -> "Evidence":
        """What is within reach of a limb, and not wholly explained by the rest of a body."""
        rest, at = np.setdiff1d(sorted(state.profiles), limb.outer), state.head_m[limb.bones[0]]
        reach = limb.reach_m(state.lengths_m) + BEYOND_M
        close = np.flatnonzero(np.linalg.norm(self.points.xyz_m - at, axis=1) < reach)
        taken, fingers = _points_explained(self.points.take(close), state, rest, TAKEN_M), _fingers(state, rest)
        if fingers is not None:
            taken = np.maximum(taken, _weight(_gaps_of_points(self.points.take(close), fingers)[0], TAKEN_M))
        left = np.flatnonzero(taken < EXPLAINED)
        every = 1 + (len(left) - 1) // MOST_NEAR if len(left) else 1
        left = left[::every]
        views, shares = [], []
        for view in self.cells:
            pixel, depth = view.camera.project(at[None])[0], float(view.camera.to_camera(at[None])[0, 2])
            around = view.take(np.linalg.norm(view.xy_px - pixel, axis=1) < reach * view.camera.focal_px / depth)
            share = _cells_explained(around, state, rest, TAKEN_CELLS_M)
            if fingers is not None:
                share = np.maximum(share, _weight(_gaps_of_cells(around, fingers)[0], TAKEN_CELLS_M))
            views.append(around.take(share < EXPLAINED))
            shares.append(share[share < EXPLAINED])
        points, area = self.points.take(close[left]), self.point_area * every
        return replace(self, points=points, taken=taken[left], point_area=area, cells=views, taken_cells=shares)

    def thinned(self) -> "Evidence":
        """Every `COARSE`th point and cell, each for so many."""
        return replace(
            self,
            points=self.points.take(np.arange(0, len(self.taken), COARSE)),
            taken=self.taken[::COARSE],
            point_area=self.point_area * COARSE,
            cells=[replace(view.take(np.s_[::COARSE]), area_px=view.area_px * COARSE) for view in self.cells],
            taken_cells=[share[::COARSE] for share in self.taken_cells],
        )

    def unexplained(self, about_m: np.ndarray) -> float:
        """The area of points and cells that nothing explains; cells at the depth of a place (3,)."""
        total = self.point_area * float((1 - self.taken).sum())
        return total + sum(self.cell_area(view, about_m) * float((1 - share).sum()) for view, share in zip(self.cells, self.taken_cells))

    def cell_area(self, view: PersonCells, at_m: np.ndarray) -> float:
        """The area of one of a view's cells at a place (3,), with its weight."""
        size = view.area_px**0.5 * float(view.camera.to_camera(at_m[None])[0, 2]) / view.camera.focal_px
        return CELL_WEIGHT / len(self.cells) * (size / self.voxel_m) ** 2


def limb_gains(evidence: Evidence, limb: Limb, poses: np.ndarray, vector: np.ndarray, width_m: float, least: float = -np.inf) -> np.ndarray:
    """(3) of a limb in N poses (N, D), of a body with the shape vector (S,); for poses whose gain is not above `least`, perhaps only an
    upper bound that is not above it, either."""
    state = limb.parameters.state(poses[0], vector)
    others = _others(limb, state)

    def gains(rows: slice) -> np.ndarray:
        capsules, fingers = _limb_capsules(limb, poses[rows], state)
        gain = _explained_by(evidence, capsules, state, width_m, UNSEEN, least, fingers)
        reached = np.flatnonzero(gain > least)
        if len(reached):
            gain[reached] -= _misplaced(evidence, capsules.take(reached), state, others)
        return gain

    together = 1 + LARGEST // max(len(evidence.taken), *(len(share) for share in evidence.taken_cells), 1)
    return np.concatenate([gains(slice(i, i + together)) for i in range(0, max(len(poses), 1), together)])


def body_gains(evidence: Evidence, parameters: ShapeParameters, poses: np.ndarray, vector: np.ndarray, width_m: float) -> np.ndarray:
    """(3) of a whole body with the shape vector (S,) in N poses (N, D), where all cells count."""
    state = parameters.state(poses[0], vector)
    R, head = bone_frames(parameters.skeleton, state.lengths_m, poses)
    bones = np.array(sorted(state.profiles))
    body = _Capsules.of(state, bones, free_bones(parameters), head[:, bones], R[:, bones])
    return _explained_by(evidence, body, state, width_m) - _misplaced(evidence, body, state, np.zeros(0, np.intp))


def explained(evidence: Evidence, limb: Limb, state: BodyState, width_m: float) -> float:
    """The area that a body's limb explains: (3) without its last sum."""
    capsules, fingers = _limb_capsules(limb, state.motion[None], state)
    return float(_explained_by(evidence, capsules, state, width_m, UNSEEN, fingers=fingers)[0])


def misplaced(evidence: Evidence, limb: Limb, state: BodyState) -> float:
    """The area of a body's limb that contradicts what is seen: the last sum of (3)."""
    return float(_misplaced(evidence, _limb_capsules(limb, state.motion[None], state)[0], state, _others(limb, state))[0])


def explained_area(evidence: Evidence, state: BodyState, posed: np.ndarray, width_m: float) -> float:
    """The area of the person's cells that a body explains, less that of its `posed` (B,) bones in the background."""
    bones = np.array(sorted(state.profiles))
    middle = state.head_m[bones].mean(axis=0)
    shares = [_cells_explained(view, state, bones, width_m) for view in evidence.cells]
    area = sum(evidence.cell_area(view, middle) * float(share.sum()) for view, share in zip(evidence.cells, shares))
    body = _Capsules.of(state, bones, posed, state.head_m[None, bones], state.R[None, bones])
    return area - float(_misplaced(evidence, body, state, np.zeros(0, np.intp))[0])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Capsules:
    """K bones in N poses as tapered capsules."""

    bones: np.ndarray  # (K,)
    first_m: np.ndarray  # (N, K, 3)
    axis: np.ndarray  # (N, K, 3) unit
    length_m: np.ndarray  # (K,)
    radii_m: np.ndarray  # (K, 2) at both ends
    posed: np.ndarray  # (K,) whether its place counts: not that of bones with a firm prior

    @staticmethod
    def of(state: BodyState, bones: np.ndarray, posed: np.ndarray, head: np.ndarray, R: np.ndarray) -> "_Capsules":
        """Bones (K,) of a body, their frames `head` (N, K, 3) and R (N, K, 3, 3) in N poses; `posed` (B,)."""
        return _Capsules(
            bones=bones,
            first_m=head,
            axis=R[..., 1],
            length_m=state.lengths_m[bones],
            radii_m=np.array([[state.profiles[b].radii_m[i].mean() for i in (0, -1)] for b in bones.tolist()], np.float32),
            posed=posed[bones],
        )

    def take(self, poses: np.ndarray) -> "_Capsules":
        """Those in some of the poses."""
        return replace(self, first_m=self.first_m[poses], axis=self.axis[poses])

    def image(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Both ends (N, 2, K, 2) [px] in a view, and the metres of a pixel (N, K) float32 at the middles."""
        ends = np.stack([self.first_m, self.first_m + self.length_m[:, None] * self.axis], axis=1)
        depth = camera.to_camera(ends.mean(axis=1).reshape(-1, 3))[:, 2].reshape(ends.shape[0], -1)
        metres = np.maximum(depth, 1e-6) / camera.focal_px
        return camera.project(ends.reshape(-1, 3)).reshape(*ends.shape[:-1], 2), metres.astype(np.float32)

    @property
    def area_m2(self) -> float:
        """Of their images, side by side."""
        return 2 * float((self.radii_m.mean(axis=1) * self.length_m).sum())

    def radius(self, k: int | np.ndarray, fraction: np.ndarray) -> np.ndarray:
        """The radius of capsule k, or of several (K, 1), at fractions of its length."""
        return np.asarray(self.radii_m[k, 0] + (self.radii_m[k, 1] - self.radii_m[k, 0]) * fraction)


def _limb_capsules(limb: Limb, poses: np.ndarray, state: BodyState) -> tuple[_Capsules, _Capsules | None]:
    """A limb in N poses, and the fingers of a hand that it carries: the fitted hand ends at its knuckles. A hand alone has its fingers."""
    bones = np.array([b for b in limb.outer.tolist() if b in state.profiles])
    R, head = frames_of_bones(limb.parameters.skeleton, state.lengths_m, poses, bones)
    fingers = _hands(state, bones, head, R, of_hand=np.s_[:] if limb.hand is not None else FINGERS)
    if limb.hand is not None and fingers is not None:
        return fingers, None
    return _Capsules.of(state, bones, free_bones(limb.parameters), head, R), fingers


def _fingers(state: BodyState, bones: np.ndarray) -> _Capsules | None:
    """The fingers of hands among some of a body's bones."""
    return _hands(state, bones, state.head_m[None, bones], state.R[None, bones], of_hand=FINGERS)


def _hands(state: BodyState, bones: np.ndarray, head: np.ndarray, R: np.ndarray, of_hand: slice) -> _Capsules | None:
    """Some of the capsules of the hands among bones (K,), whose frames in N poses are `head` (N, K, 3) and R (N, K, 3, 3); None if there
    are no hands."""
    names = [state.skeleton.bones[b].name for b in bones.tolist()]
    hands = [k for k, name in enumerate(names) if is_hand(name)]
    if not hands:
        return None
    found = []
    for k in hands:
        length = float(state.lengths_m[bones[k]])
        bend = state.finger_bends[int(bones[k])]
        ends, radii = (part[of_hand] * length for part in hand_capsules(names[k].endswith(".L"), bend))
        along = ends[:, 1] - ends[:, 0]
        lengths = np.linalg.norm(along, axis=1)
        axes = R[:, k].transpose(0, 2, 1)
        found.append((head[:, k, None] + ends[:, 0] @ axes, along / lengths[:, None] @ axes, lengths, radii))
    first, axis, length_m, radii_m = zip(*found)
    lengths = np.concatenate(length_m)
    return _Capsules(
        bones=np.repeat(bones[hands], [len(part) for part in length_m]),
        first_m=np.concatenate(first, axis=1),
        axis=np.concatenate(axis, axis=1),
        length_m=lengths,
        radii_m=np.concatenate(radii_m).astype(np.float32),
        posed=np.ones(len(lengths), dtype=bool),
    )


def _others(limb: Limb, state: BodyState) -> np.ndarray:
    """The bones in whose flesh a limb cannot lie."""
    return np.array([b for b in sorted(state.profiles) if b != limb.parent and b not in limb.outer], dtype=np.intp)


def _explained_by(
    evidence: Evidence,
    capsules: _Capsules,
    state: BodyState,
    width_m: float,
    unseen: float = 0.0,
    least: float = -np.inf,
    fingers: _Capsules | None = None,
) -> np.ndarray:
    """The first terms of (3) in N poses (N,), with a share `unseen`; with or without the `fingers`, which may be bent to a fist, whichever
    explains more. A cell's area is that at the first capsule in one `state`. An upper bound for poses that do not get above `least`."""
    areas = [evidence.cell_area(view, state.head_m[capsules.bones[0]]) for view in evidence.cells]
    parts = [capsules] if fingers is None else [capsules, fingers]
    rims = unseen * CELL_WEIGHT * np.cumsum([part.area_m2 for part in parts]) / evidence.voxel_m**2
    of_points = evidence.point_area * _gains(_gaps_of_points, evidence.points, parts, evidence.taken, width_m)
    most = max(sum(area * float((1 - share).sum()) for area, share in zip(areas, evidence.taken_cells)) - rims[0], 0.0)
    gain = of_points.max(axis=0) + most
    above = gain > least
    some, cells = [part.take(above) for part in parts], np.zeros((len(parts), int(above.sum())))
    for view, share, area in zip(evidence.cells, evidence.taken_cells, areas):
        cells += area * _gains(_gaps_of_cells, view, some, share, width_m)
    gain[above] = (of_points[:, above] + np.maximum(cells - rims[:, None], 0.0)).max(axis=0)
    return gain


def _points_explained(points: CloudPoints, state: BodyState, bones: np.ndarray, width_m: float) -> np.ndarray:
    """The share (P,) of each point that some bones of a body explain."""
    rows, bone = near_pairs(points.xyz_m, state, np.full(len(state.lengths_m), FAR * width_m), bones)
    gap, _, facing = facing_bone(points.xyz_m[rows], points.normals[rows], state, bone)
    return _largest(rows, facing * _weight(gap, width_m), len(points.xyz_m))


def _cells_explained(view: PersonCells, state: BodyState, bones: np.ndarray, width_m: float) -> np.ndarray:
    """The share (M,) of each of a view's cells that some bones of a body explain."""
    origin = np.broadcast_to(view.camera.centre_m, view.directions.shape)
    rows, bone, X = near_rays(origin, view.directions, state, FAR * width_m, bones)
    return _largest(rows, _weight(np.maximum(gap_to_bone(X, state, bone), 0.0), width_m), len(view.xy_px))


def _largest(rows: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Of values (K,) ordered by rows (K,) the largest of each of n rows, at least 0."""
    found, first = np.zeros(n), np.flatnonzero(np.diff(rows, prepend=-1))
    if len(first):
        found[rows[first]] = np.maximum(np.maximum.reduceat(values, first), 0.0)
    return found


def _weight(gap: np.ndarray, width_m: float) -> np.ndarray:
    return np.asarray(1 / (1 + (gap / width_m) ** 2) ** 2)  # (1)


def _gaps_of_points(points: CloudPoints, capsules: _Capsules) -> np.ndarray:
    """How far points (P,) are from capsules in N poses (N, P), in single precision: products of matrices give what is linear in 1, X and X²
    of all pairs."""
    origin = capsules.first_m[0, 0]  # numbers are small from here
    X, normals = (v.astype(np.float32) for v in (points.xyz_m - origin, points.normals))
    along_normal = np.where(normals.any(axis=1), np.einsum("pi,pi->p", X, normals), FAR_AWAY_M)  # an unknown normal points outwards
    places = np.column_stack([X, np.ones(len(X)), np.einsum("pi,pi->p", X, X), normals, along_normal]).astype(np.float32).T
    gap = np.full((len(capsules.first_m), len(X)), np.inf, np.float32)
    for k, length in enumerate(capsules.length_m.astype(np.float32)):
        first, axis = (v.astype(np.float32) for v in (capsules.first_m[:, k] - origin, capsules.axis[:, k]))
        squares = np.einsum("nd,nd->n", first, first)[:, None]
        along = np.hstack([axis, -np.einsum("nd,nd->n", axis, first)[:, None]]) / length @ places[:4]
        distance = np.hstack([-2 * first, squares, np.ones_like(squares)]) @ places[:5]  # squared, from the capsule's first end
        nearest = np.clip(along, _ZERO, _ONE)
        along += along
        along -= nearest
        along *= nearest
        along *= length * length
        distance -= along
        np.sqrt(np.maximum(distance, _ZERO, out=distance), out=distance)
        outwards = np.hstack([-first, np.ones_like(squares)]) @ places[5:]
        outwards -= nearest * (length * axis @ places[5:8])
        facing = outwards > np.float32(FACING) * distance
        distance -= capsules.radius(k, nearest)
        np.minimum(gap, np.abs(distance, out=distance), out=gap, where=facing)
    return gap


def _gaps_of_cells(view: PersonCells, capsules: _Capsules) -> np.ndarray:
    """How far cells (P,) are beyond capsules in N poses (N, P): places along and across the image of a capsule, the first as fractions, the
    others in metres."""
    gap = np.full((len(capsules.first_m), len(view.xy_px)), np.inf, np.float32)
    if not gap.size:
        return gap
    centre = view.xy_px.mean(axis=0)
    ends_px, metres = capsules.image(view.camera)
    visible = (np.abs(ends_px) < LARGEST_PX).all(axis=(1, 3))
    a, ab = (np.where(visible[..., None], v, 1.0) for v in (ends_px[:, 0] - centre, ends_px[:, 1] - ends_px[:, 0]))
    size = np.maximum(np.linalg.norm(ab, axis=-1), 1e-6)[..., None]
    normal = np.stack([-ab[..., 1], ab[..., 0]], axis=-1) * metres[..., None] / size
    along, across = (
        np.concatenate([v, -np.einsum("nkd,nkd->nk", v, a)[..., None]], axis=-1).astype(np.float32) for v in (ab / size**2, normal)
    )
    across[~visible] = 0.0, 0.0, FAR_AWAY_M
    length = (size * metres[..., None]).astype(np.float32)
    xy = np.column_stack([view.xy_px - centre, np.ones(len(view.xy_px))]).astype(np.float32).T
    for k in range(len(capsules.length_m)):
        beyond, distance = along[:, k] @ xy, across[:, k] @ xy
        nearest = np.clip(beyond, _ZERO, _ONE)
        beyond -= nearest
        beyond *= length[:, k]
        beyond *= beyond
        distance *= distance
        distance += beyond
        np.sqrt(distance, out=distance)
        distance -= capsules.radius(k, nearest)
        np.minimum(gap, distance, out=gap)
    return np.maximum(gap, _ZERO, out=gap)


def _gains(
    gaps_of: Callable[[Any, _Capsules], np.ndarray], seen: Any, parts: Sequence[_Capsules], taken: np.ndarray, width_m: float
) -> np.ndarray:
    """The sums (K, N) of (2) of what is seen, of the first of K parts, of the first two, …"""
    gap, found = np.array(np.inf, np.float32), []
    for part in parts:
        gap = np.minimum(gap, gaps_of(seen, part))
        gain = _weight(gap, width_m)
        gain -= taken.astype(np.float32)
        found.append(np.maximum(gain, _ZERO, out=gain).sum(axis=1))
    return np.asarray(found, dtype=np.float64)


def _misplaced(evidence: Evidence, capsules: _Capsules, state: BodyState, others: np.ndarray) -> np.ndarray:
    """The area (N,) of capsules that lies in the background, in `others` of a body's bones, or before points that it would hide."""
    k = np.flatnonzero(capsules.posed)
    length = capsules.length_m[k]
    radius = capsules.radius(k[:, None], PLACES)  # (K, S)
    area = (length / len(PLACES))[:, None] * 2 * radius / evidence.voxel_m**2
    X = capsules.first_m[:, k, None] + (length[:, None] * PLACES)[..., None] * capsules.axis[:, k, None]  # (N, K, S, 3)
    flat, shape = X.reshape(-1, 3), X.shape[:-1]
    wrong = np.zeros(shape)
    for view in evidence.cells:
        pixels, depth = view.camera.project_with_depth(flat)
        d = view.distance.values(np.nan_to_num(pixels, nan=-1.0))
        wrong += np.minimum((d * depth / view.camera.focal_px).reshape(shape) / radius, 1.0) / len(evidence.cells)
    if evidence.depths is not None:
        wrong += evidence.depths.far_behind(flat).reshape(shape)
    if len(others):
        rows, bone = near_pairs(flat, state, np.zeros(len(state.lengths_m)), others)
        inside = _largest(rows, -gap_to_bone(flat[rows], state, bone), len(flat)).reshape(shape) / radius
        clear = (capsules.bones[k] != capsules.bones[0])[:, None] | (PLACES > CLEAR_OF_JOINT)
        wrong += np.minimum(inside, 1.0) * clear
    return np.asarray((wrong * area).sum(axis=(1, 2)))
