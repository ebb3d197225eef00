"""The head of a skin, put where the points of all frames measured it, before the relief.

The anatomical head (ends) has the place and size of the fitted balls, whose face is no better than an ellipsoid's: nose and chin may lie
centimetres beside the person's, and a relief would then give the chin the shape of a mouth. In the axes of the head's bone the vertices x
move by a similarity of six parameters p, a shift up and ahead, a pitch, and three scales, to the degree w to which they are the head's,
smoothed over the neck:

    x' = x + w (S Q(x − c) + c + t − x) ,   Σ ρ( m·(X − x')/σ ) + Σ (p/σ_p)² → min                           (1)

with X, m a point and its normal in the head's axes, x' the vertex nearest to it, renewed in every step. ρ is Tukey's biweight. A head on
which few points were measured stays where it is.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...geometry.robust import TUKEY
from ..shape import BodyShape
from ..skeleton import bone_frames
from .closed_skin import OneSkin
from .ends import HEAD
from .extremities import has_end
from .relief import LEAST_COSINE, Nearby, SurfacePoints
from .surface_operators import vertex_normals

PRIOR = np.array([0.03, 0.015, 0.15, 0.10, 0.10, 0.10])  # σ_p: up and ahead [m], pitch [rad], ln of the scales to the side, up, ahead
FARTHEST_M = 0.03  # of a point from the skin
SIGMA_M = 0.003  # σ: what a face differs from the anatomical one
EACH_FOR = 25.0  # as many points count as one: their errors are alike
FEWEST = 300  # points
MOST_FRAMES = 12  # evenly
STEPS = 12
OWN = 0.5  # weight of the head in vertices that are compared


def with_head_in_place(skin: OneSkin, shape: BodyShape, frames: Sequence[SurfacePoints]) -> OneSkin:
    """The skin of the rest pose with its head registered to the points of all frames.  (1)"""
    names = [bone.name for bone in shape.skeleton.bones]
    b = names.index(HEAD) if HEAD in names else -1
    if b < 0 or not has_end(shape, b) or not frames:
        return skin
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    own = skin.weights[:, b]
    local = (skin.vertices_m - head[b]) @ R[b]
    points, normals = _in_head(shape, b, frames, local[own > OWN])
    if len(points) < FEWEST:
        return skin
    middle, across = local[own > OWN].mean(axis=0), vertex_normals(skin.vertices_m, skin.faces) @ R[b]
    p = _registered(local[own > OWN], across[own > OWN], middle, points, normals)
    share = Nearby(skin.vertices_m, skin.faces).mean(own[:, None])  # wider than the weights, or the throat would fold
    moved = local + share * (_moved(local, middle, p) - local)
    return replace(skin, vertices_m=head[b] + moved @ R[b].T)


def _in_head(shape: BodyShape, b: int, frames: Sequence[SurfacePoints], vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points near the head and their normals (N, 3), in the axes of its bone."""
    low, high = vertices.min(axis=0) - FARTHEST_M, vertices.max(axis=0) + FARTHEST_M
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
    return np.asarray(((x - middle) * np.exp(p[3:])) @ _pitch(p[2]).T + middle + [0.0, p[0], p[1]])


def _derivatives(x: np.ndarray, middle: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Those of `_moved` with respect to p, (V, 3, 6)."""
    scaled, turn, shift = (x - middle) * np.exp(p[3:]), _pitch(p[2]), np.zeros((len(x), 3, 2))
    shift[:, 1, 0] = shift[:, 2, 1] = 1.0
    pitch = (scaled * [0.0, 1.0, 1.0]) @ _pitch(p[2] + np.pi / 2).T * [0.0, 1.0, 1.0]
    return np.concatenate([shift, pitch[:, :, None], turn * scaled[:, None]], axis=2)


def _pitch(angle: float) -> np.ndarray:
    """Q (3, 3)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])


def _registered(x: np.ndarray, across: np.ndarray, middle: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """p (6,) of (1) for vertices with normals (V, 3)."""
    from scipy.spatial import cKDTree

    p = np.zeros(len(PRIOR))
    for _ in range(STEPS):
        at = _moved(x, middle, p)
        distance, near = cKDTree(at).query(points, distance_upper_bound=FARTHEST_M)
        good = np.flatnonzero(np.isfinite(distance))
        good = good[np.einsum("nk,nk->n", across[near[good]], normals[good]) > LEAST_COSINE]
        if len(good) < FEWEST:
            return np.zeros(len(PRIOR))
        n, i = normals[good], near[good]
        r = np.einsum("nk,nk->n", n, points[good] - at[i])
        J = np.einsum("nk,nkp->np", n, _derivatives(x[i], middle, p))
        spread = max(SIGMA_M, 1.4826 * float(np.median(np.abs(r))))
        weight = np.clip(1 - (r / (TUKEY * spread)) ** 2, 0, None) ** 2 / (EACH_FOR * spread**2)
        normal = J.T @ (weight[:, None] * J) + np.diag(PRIOR**-2)
        p = p + np.linalg.solve(normal, J.T @ (weight * r) - p / PRIOR**2)
    return p
