"""The head of a skin, put where the points of all frames measured it, before the relief.

The anatomical head (ends) has the place and size of the fitted balls, whose face is no better than an ellipsoid's: nose and chin may lie
centimetres beside the person's, the face may look aside, and a relief would then give the chin the shape of a mouth and flatten a cheek. In
the axes of the head's bone the vertices x move by a similarity of nine parameters p, a shift t, a rotation Q and three scales S, to the
degree w to which they are the head's, smoothed over the neck:

    x' = x + w (Q S (x − c) + c + t − x) ,   Σ ρ( m·(X − x')/σ ) + pᵀ Σ⁻¹ p → min                              (1)

with Σ = diag(σ_p²), and more for a common scale; X, m a point and its normal in the head's axes, x' the nearest of those vertices whose
normals are alike, renewed in every step. ρ is Tukey's biweight. A head on which few points were measured stays where it is.

A bowed or turned head may be fitted in another direction, and its chin taken for the neck. So other places of the face are tried
(OTHERS), and one of them is taken if it agrees clearly better with all points about the head, also those below it: if (1) with ρ of a
fixed width and wider σ_p, a point without a vertex counting as an outlier, is less than CLEARLY of what it is where the fit has the face,
and so is the median misfit of the points that have one (a head pushed down over the neck leaves none without a vertex, and fits nothing).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...geometry.robust import TUKEY
from ...geometry.rotation import cross_matrix, rotation_from_vector, vector_from_rotation
from ..shape import BodyShape
from ..skeleton import bone_frames
from .closed_skin import OneSkin
from .ends import HEAD
from .extremities import NECK, has_end
from .facing import Facing
from .relief import LEAST_COSINE, Nearby, SurfacePoints
from .surface_operators import vertex_normals

MEAN = np.array([0.0, 0.0, 0.0, -0.38, 0.0, 0.0, 0.0, 0.0, 0.0])  # of p: the fitted head is an ellipsoid along the line from chin to crown
PRIOR = np.array([0.01, 0.03, 0.015, 0.1, 0.25, 0.1, 0.04, 0.04, 0.04])  # σ_p of t [m], Rodrigues vector of Q, ln S: to the side, up, ahead
SIZE = 0.1  # … and what the three ln S have in common
LEVEL = np.array([0.165, 0.0, 0.0])  # the anatomical head looks up by so much [rad], where a level one is registered to it
JOINT_M = np.array([0.0, 0.020, -0.008])  # where the anatomical head turns on the neck, in the axes of the bone, before it is registered
MOST_TURN = 0.45  # rad, of Q to the side …
MOST_FOUND = 1.2  # … where another place was clearly better
OTHERS = [(up, aside) for up in (-0.1, 0.2, 0.5) for aside in (-0.9, -0.45, 0.0, 0.45, 0.9)]  # rad, of Q: places of the face that are tried
NEAR = np.array([0.02, 0.05, 0.03, 0.15, 0.25, 0.1, 0.04, 0.04, 0.04])  # σ_p about each of them
WIDE = np.array([0.02, 0.05, 0.03, 0.35, 0.4, 0.15, 0.04, 0.04, 0.04])  # σ_p by which they are judged
MARGIN_M = 0.1  # about the points: other vertices are none of theirs
BELOW_M = 0.08  # the chin of a bowed head lies so far below the fitted one
CLEARLY = 0.85  # what another place may cost, and misfit, of what the fit's does
JUDGED_M = 0.004  # σ by which they are judged
MOST_TRIED, MOST_JUDGED = 2000, 6000  # points by which they are tried and judged: these stand for all
FEW_STEPS = 8  # while they are tried
REFINED = 3  # of them
FARTHEST_M = 0.03  # of a point from the skin
SIGMA_M = 0.003  # σ: what a face differs from the anatomical one
EACH_FOR = 100.0  # as many points count as one: their errors are alike
FEWEST = 300  # points
MOST_FRAMES = 24  # evenly
CANDIDATES = 4  # nearest vertices of a point
STEPS = 15
OWN = 0.5  # weight of the head in vertices that are compared
NECKS = 0.2  # of the neck's weight with which it goes along


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeadPlace:
    """Where the head of a skin was registered."""

    head: "_Movable"
    p: np.ndarray  # (9,) of (1)
    R: np.ndarray  # (3, 3) axes of its bone in the rest pose
    head_m: np.ndarray  # (3,) where its bone begins there
    length_m: float  # of the bone
    found: bool  # whether it was found where the fit has no face

    def moved(self, skin: OneSkin) -> OneSkin:
        """The skin of the rest pose with its head there."""
        return replace(skin, vertices_m=self.head_m + self.head.at(self.p) @ self.R.T)

    @property
    def facing(self) -> Facing | None:
        """Where the face looks, and where the head begins and ends, in the axes of its bone.

        None if the head would be turned by more than a fit is wrong: then the points do not show the face.
        """
        if abs(self.p[4]) > (MOST_FOUND if self.found else MOST_TURN):
            return None
        joint, crown = _moved(np.stack([JOINT_M, [0.0, self.length_m, 0.0]]), self.head.middle, self.p)
        turn = vector_from_rotation(rotation_from_vector(self.p[3:6]) @ rotation_from_vector(LEVEL))
        return Facing(turn=turn, joint_m=joint, crown_m=crown)


def registered_head(skin: OneSkin, shape: BodyShape, frames: Sequence[SurfacePoints]) -> HeadPlace | None:
    """Register the head of a skin in the rest pose to the points of all frames (1); None without a head, or with too few points."""
    names = [bone.name for bone in shape.skeleton.bones]
    b = names.index(HEAD) if HEAD in names else -1
    if b < 0 or not has_end(shape, b) or not frames:
        return None
    axes, heads = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    R, head = axes[b], heads[b]
    own = skin.weights[:, b]
    local = (skin.vertices_m - head) @ R
    points, normals = _in_head(shape, b, frames, local[own > OWN])
    if len(points) < FEWEST:
        return None
    necks = skin.weights[:, [name == NECK for name in names]].sum(axis=1)
    weight = own + NECKS * necks
    share = Nearby(skin.vertices_m, skin.faces).mean(weight[:, None])  # wider than the weights, or throat and nape would fold
    movable = _Movable(x=local, across=vertex_normals(skin.vertices_m, skin.faces) @ R, share=share, own=own > OWN)
    p = _registered(movable, points, normals)
    if p is None:
        return None
    other = _elsewhere(movable, *_in_head(shape, b, frames, local[own > OWN], BELOW_M), p)
    place = p if other is None else other
    return HeadPlace(head=movable, p=place, R=R, head_m=head, length_m=float(shape.lengths_m[b]), found=other is not None)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Movable:
    """The vertices of a skin in the axes of the head's bone."""

    x: np.ndarray  # (V, 3)
    across: np.ndarray  # (V, 3) normals
    share: np.ndarray  # (V, 1) w of (1)
    own: np.ndarray  # (V,) bool: the head's; the others only take their points from the jaw and the nape

    @property
    def middle(self) -> np.ndarray:
        """c of (1)."""
        return np.asarray(self.x[self.own].mean(axis=0))

    def at(self, p: np.ndarray) -> np.ndarray:
        """x' (V, 3) of (1)."""
        return np.asarray(self.x + self.share * (_moved(self.x, self.middle, p) - self.x))


def _in_head(
    shape: BodyShape, b: int, frames: Sequence[SurfacePoints], vertices: np.ndarray, below_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Points near the head and their normals (N, 3), in the axes of its bone; also those so far `below_m` it."""
    low, high = vertices.min(axis=0) - FARTHEST_M, vertices.max(axis=0) + FARTHEST_M
    low[1] -= below_m
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int))
    points, normals = [], []
    for frame in (frames[i] for i in chosen):
        R, head = bone_frames(shape.skeleton, shape.lengths_m, frame.motion)
        X = (frame.xyz_m - head[b]) @ R[b]
        near = ((X > low) & (X < high)).all(axis=1)
        points.append(X[near])
        normals.append(frame.normals[near] @ R[b])
    return np.concatenate(points), np.concatenate(normals)


def _moved(x: np.ndarray, middle: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) moved entirely."""
    return np.asarray(((x - middle) * np.exp(p[6:])) @ rotation_from_vector(p[3:6]).T + middle + p[:3])


def _changed(p: np.ndarray, step: np.ndarray) -> np.ndarray:
    """p (9,) after a step (9,), of which the rotation follows the one that is there."""
    turned = vector_from_rotation(rotation_from_vector(step[3:6]) @ rotation_from_vector(p[3:6]))
    return np.concatenate([p[:3] + step[:3], turned, p[6:] + step[6:]])


def _derivatives(x: np.ndarray, middle: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Those of `_moved` with respect to a step, (V, 3, 9)."""
    Q, scaled = rotation_from_vector(p[3:6]), (x - middle) * np.exp(p[6:])
    shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
    return np.concatenate([shift, -cross_matrix(scaled @ Q.T), Q * scaled[:, None]], axis=2)


def _registered(
    skin: _Movable,
    points: np.ndarray,
    normals: np.ndarray,
    stand_for: int = 1,
    *,
    mean: np.ndarray = MEAN,
    sigma: np.ndarray = PRIOR,
    steps: int = STEPS,
    start: np.ndarray | None = None,
) -> np.ndarray | None:
    """p (9,) of (1), with this mean and these σ_p; None if too few points find a vertex. Each of the points `stand_for` several."""
    p, information = mean if start is None else start, _information(sigma)
    for _ in range(steps):
        at = skin.at(p)
        found, r = _residuals(skin, at, p, points, normals)
        good = np.flatnonzero(np.isfinite(r) & skin.own[found])
        if len(good) * stand_for < FEWEST:
            return None
        n, i, r = normals[good], found[good], r[good]
        J = skin.share[i] * np.einsum("nk,nkp->np", n, _derivatives(skin.x[i], skin.middle, p))
        spread = max(SIGMA_M, 1.4826 * float(np.median(np.abs(r))))
        weight = np.clip(1 - (r / (TUKEY * spread)) ** 2, 0, None) ** 2 * stand_for / (EACH_FOR * spread**2)
        normal = J.T @ (weight[:, None] * J) + information
        p = _changed(p, np.linalg.solve(normal, J.T @ (weight * r) - information @ (p - mean)))
    return p


def _information(sigma: np.ndarray) -> np.ndarray:
    """Σ⁻¹ of (1)."""
    common = np.repeat([0.0, SIZE], (6, 3))
    return np.linalg.inv(np.diag(sigma**2) + np.outer(common, common))


def _residuals(skin: _Movable, at: np.ndarray, p: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertex (N,) to which each point belongs, of those that are `at`, and its distance (N,) along the normal; inf without one."""
    from scipy.spatial import cKDTree

    rows = np.arange(len(points))
    distance, near = cKDTree(at).query(points, k=CANDIDATES, distance_upper_bound=FARTHEST_M)
    near = np.minimum(near, len(at) - 1)
    cosine = np.einsum("nkc,nc->nk", skin.across[near] @ rotation_from_vector(p[3:6]).T, normals)
    best = np.argmin(np.where(cosine > LEAST_COSINE, distance * (2 - cosine), np.inf), axis=1)
    found = near[rows, best]
    good = np.isfinite(distance[rows, best]) & (cosine[rows, best] > LEAST_COSINE)
    return found, np.where(good, np.einsum("nk,nk->n", normals, points - at[found]), np.inf)


def _elsewhere(skin: _Movable, points: np.ndarray, normals: np.ndarray, p: np.ndarray) -> np.ndarray | None:
    """Another place of the head that agrees clearly better with the points about it than p (9,) does; None if there is none."""
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    near = skin.own | ((skin.x > low) & (skin.x < high)).all(axis=1)
    skin = _Movable(x=skin.x[near], across=skin.across[near], share=skin.share[near], own=skin.own[near])
    every, some = -(-len(points) // MOST_JUDGED), -(-len(points) // MOST_TRIED)
    few, judged = (points[::some], normals[::some], some), (points[::every], normals[::every], every)

    def residuals(p: np.ndarray) -> np.ndarray:
        return _residuals(skin, skin.at(p), p, *judged[:2])[1]

    def cost(p: np.ndarray) -> float:
        """(1), as places are judged."""
        agrees = np.clip(1 - (residuals(p) / (TUKEY * JUDGED_M)) ** 2, 0, None) ** 3
        return float(TUKEY**2 / 3 / EACH_FOR * every * (1 - agrees).sum() + (p - MEAN) @ _information(WIDE) @ (p - MEAN))

    def misfit_m(p: np.ndarray) -> float:
        """Of the points that belong to a vertex, the median."""
        r = np.abs(residuals(p))
        return float(np.median(r[np.isfinite(r)])) if np.isfinite(r).any() else np.inf

    tried = []
    for up, aside in OTHERS:
        mean = np.array([0.0, 0.0, 0.0, up, aside, 0.0, 0.0, 0.0, 0.0])
        if (other := _registered(skin, *few, mean=mean, sigma=NEAR, steps=FEW_STEPS)) is not None:
            tried.append(other)
    tried = sorted(tried, key=cost)[:REFINED]
    further = [_registered(skin, *judged, sigma=WIDE, start=start) for start in tried]
    places = [*tried, *(place for place in further if place is not None)]
    if not places:
        return None
    best = min(places, key=cost)
    return best if cost(best) < CLEARLY * cost(p) and misfit_m(best) < CLEARLY * misfit_m(p) else None
