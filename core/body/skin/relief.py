"""The person's own relief: the displacement of the skin along its normals that the measured points of all frames show.

Every measured point X with normal m is compared with the nearest vertex of the posed skin, p with normal n, in the tangential plane of the
point, so that p need not be opposite to it:

    d = m·(X − p) / (m·n) ,   σ_d² = σ_m² / (m·n)²                                                           (1)

The points of a vertex in one frame are averaged. Over the frames, whose poses have errors of their own, each is an observation of the
displacement δ of the vertex, which has a Gaussian Markov prior of the Matérn family (Lindgren, Rue & Lindström 2011, J. R. Stat. Soc. B
73(4)): standard deviation s, range 2.8/κ, so that it is smooth, and returns to zero where nothing was measured:

    Σ ρ( (δ_v − d)/σ ) + δᵀ Q δ → min ,   Q = (κ²M − C) M⁻¹ (κ²M − C) / τ² ,   τ² = 4π κ² s²                (2)
    σ² = σ_d² + c² σ_f² ,   σ_f: mean absolute deviation of the frames' d from δ nearby, √(π/2) times        (3)

At head, hands and feet, whose shapes are anatomical, s is smaller and n is the normal of the surface without nose, ears and toes: along
their own normals a coarse measurement would fold them. A patch shows a surface that is smoother than a nose, and there points are compared
with the skin smoothed alike, so that a nose is not flattened by its own measurement.

c > 1, because the errors of a frame are alike in all points of a region, so that many points of few frames prove little. Thus the skin is
detailed where the frames agree (a face), and smooth where they do not (a bending hip).

M, C are the operators of the mesh (surface_operators), ρ is Tukey's biweight. The inverse of the normal matrix is the covariance of δ;
its diagonal is estimated from samples A⁻¹(Bᵀε) of it (Papandreou & Yuille 2010, NIPS), seed fixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ...foundation.arrays import frozen
from ...foundation.progress import Monitor
from ...foundation.threads import in_threads
from ...geometry.robust import TUKEY, mad_sigma
from ..shape import BodyShape
from .closed_skin import OneSkin
from .ends import HEAD
from .fairing import anatomical
from .fingers import FINGER_BONE
from .posed import Poser
from .surface_operators import factorised, laplacian, vertex_normals

if TYPE_CHECKING:
    from scipy import sparse

PRIOR_M = 0.010  # s of (2): how far a body of metaballs lies from a person …
HEAD_PRIOR_M = 0.005  # … its head, which has a face of its own
THIN_PRIOR_M = 0.003  # … and its hands and feet, whose own pose is hardly measured
FINGERS_REACH = 4.0  # vertices that follow fingers by a quarter count as theirs
KAPPA = 40.0  # κ of (2) [1/m]: a range of 7 cm
GATE = 4.0  # s; points farther from the skin belong to something else
LEAST_COSINE = 0.4  # … and so do those whose normals differ more
CANDIDATES = 6  # nearest vertices of a point
LEAST_SIGMA_M = 0.0005  # of an observation: the surface's texture
START_SIGMA_M = 0.004  # σ_f at first
CORRELATED = 3.0  # c of (3)
NEARBY_M = 0.03  # over which σ_f is averaged
BLUR = 0.14  # of a patch's side: the length over which it smooths the surface
MOST_FRAMES = 80  # evenly over the take
ROUNDS = (12, MOST_FRAMES)  # frames, evenly, of each round of finding the points' vertices
TOGETHER = 8  # frames between two reports of progress
REWEIGHTINGS = (0, 2)  # in each round
SAMPLES = 32  # of the covariance: each sigma to 12 %
UNMEASURED = 0.7  # of s: the sigma above which a vertex was hardly measured
MIRRORED_M = 0.006  # by which the sides of a person differ
HEADS = 0.5  # weight of the head in vertices that are the head's


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfacePoints:
    """N measured points of one frame [m], with unit normals towards the cameras and standard deviations along them."""

    motion: np.ndarray  # (D,) the pose of the body in this frame
    xyz_m: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3)
    sigma_m: np.ndarray  # (N,)
    patch_m: float = 0.0  # side of the patches that were matched


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Relief:
    """Displacements of V vertices along `directions` [m], outwards positive, and the standard deviations of where the skin is."""

    displacement_m: np.ndarray  # (V,)
    sigma_m: np.ndarray  # (V,) the prior's, where nothing was measured
    along: np.ndarray  # (V, 3) the directions

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement_m", frozen(self.displacement_m, (None,), name="displacement_m"))
        object.__setattr__(self, "sigma_m", frozen(self.sigma_m, self.displacement_m.shape, name="sigma_m"))
        object.__setattr__(self, "along", frozen(self.along, (len(self.displacement_m), 3), name="along"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Observed:
    vertex: np.ndarray  # (M,)
    d: np.ndarray  # (M,)
    variance: np.ndarray  # (M,)


def measured_relief(
    skin: OneSkin, shape: BodyShape, frames: Sequence[SurfacePoints], mirror: bool, monitor: Monitor, straight: OneSkin | None = None
) -> Relief:
    """The relief of a skin made in the rest pose of `shape`. 0.1 s a frame for a whole body, and 6 s.  (1)–(3)

    Where a vertex was hardly measured it follows the mirror image of the other side, with its sigma and `MIRRORED_M`: at the head always,
    elsewhere with `mirror`. `straight` is the skin when it was symmetric, before its head was put in place.

    Raises:
        Cancelled: the monitor was cancelled.
    """
    poser, nearby = Poser(shape, skin.weights), Nearby(skin.vertices_m, skin.faces)
    normals, as_measured = directions(skin, shape, nearby), _blurred(skin, shape, BLUR * float(np.median([f.patch_m for f in frames])))
    size, fingers = _prior_sigma(shape, skin), _fingers(shape, skin)
    gate = np.where(fingers < 0.5, GATE * np.maximum(size, PRIOR_M * _share(shape, skin, (HEAD,))), 0.0)
    prior, delta, factor, weight = _prior(skin.vertices_m, skin.faces, size), np.zeros(len(normals)), None, np.zeros(0)
    smoothed = anatomical(shape, skin.weights)
    for done, (most, reweightings) in enumerate(zip(ROUNDS, REWEIGHTINGS)):
        moved, found = as_measured + delta[:, None] * normals, list[_Observed]()
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))
        observed = partial(_observed, poser, moved, skin.faces, delta, gate, normals, smoothed)
        for i in range(0, len(chosen), TOGETHER):
            monitor.step("relief", done * len(chosen) + i, len(ROUNDS) * len(chosen) + 1)
            found += in_threads(observed, [frames[row] for row in chosen[i : i + TOGETHER]])
        seen = _Observed(**{name: np.concatenate([getattr(f, name) for f in found]) for name in _Observed.__slots__})
        delta, factor, weight = _adjusted(prior, nearby, seen, reweightings)
    sigma = _sigmas(factor, prior, seen, weight)
    symmetric, may = straight or skin, mirror | (_share(shape, skin, (HEAD,)) > HEADS)
    before, count = (symmetric.vertices_m, normals if symmetric is skin else directions(symmetric, shape)), len(seen.d)
    seen, weight = _mirrored(*before, may, delta, sigma, size, seen, weight)
    if len(seen.d) > count:
        total, right = (np.bincount(seen.vertex, w, len(delta)) for w in (weight, weight * seen.d))
        factor = factorised(prior.T @ prior, total)
        delta, sigma = factor.solve(right), _sigmas(factor, prior, seen, weight)
    return Relief(displacement_m=(1 - fingers) * delta, sigma_m=np.hypot((1 - fingers) * sigma, fingers * size), along=normals)


class Nearby:
    """Means over the neighbourhood of every vertex, by diffusion over a length [m]."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, length_m: float = NEARBY_M) -> None:
        from scipy import sparse

        C, area = laplacian(vertices, faces)
        self._factor, self._count, self._area = factorised(sparse.diags(area) - length_m**2 * C), len(area), area

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Smooth values (V, K)."""
        return np.asarray(self._factor.solve(self._area[:, None] * values))

    def scatter(self, vertex: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """σ_f (V,) of (3) from residuals (M,) at vertices (M,), none of which counts more than GATE times their standard deviation."""
        size = np.minimum(np.abs(residual), GATE * float(mad_sigma(residual)) if len(residual) else 0.0)
        total, count = (np.bincount(vertex, w, self._count) for w in (size, np.ones(len(size))))
        mean = self._factor.solve(total) / np.maximum(self._factor.solve(count), 1e-12)
        return np.asarray(np.maximum(np.sqrt(np.pi / 2) * mean, LEAST_SIGMA_M))


def directions(skin: OneSkin, shape: BodyShape, nearby: Nearby | None = None) -> np.ndarray:
    """(V, 3) along which a skin is displaced: its normals, at head, hands and feet those of the surface without nose, ears and toes."""
    normals = vertex_normals(skin.vertices_m, skin.faces)
    smooth = (nearby or Nearby(skin.vertices_m, skin.faces)).mean(normals)
    return _mixed(normals, smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12), anatomical(shape, skin.weights))


def _blurred(skin: OneSkin, shape: BodyShape, length_m: float) -> np.ndarray:
    """Vertices (V, 3) of a skin whose anatomical parts are smoothed over a length."""
    if length_m == 0:
        return skin.vertices_m
    smooth = Nearby(skin.vertices_m, skin.faces, length_m).mean(skin.vertices_m)
    return np.asarray(skin.vertices_m + anatomical(shape, skin.weights)[:, None] * (smooth - skin.vertices_m))


def _mixed(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit vectors (V, 3) between a and b."""
    found = a + share[:, None] * (b - a)
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12))


def _prior_sigma(shape: BodyShape, skin: OneSkin) -> np.ndarray:
    """s (V,) of (2)."""
    thin = np.minimum(1.0, _share(shape, skin, ("hand", "foot")) + _fingers(shape, skin))
    head = _share(shape, skin, (HEAD,))
    return np.asarray(PRIOR_M * (THIN_PRIOR_M / PRIOR_M) ** thin * (HEAD_PRIOR_M / PRIOR_M) ** head)


def _share(shape: BodyShape, skin: OneSkin, names: tuple[str, ...]) -> np.ndarray:
    """(V,) to what degree vertices belong to the bones of these names."""
    chosen = [bone.name.split(".")[0] in names for bone in shape.skeleton.bones]
    return np.asarray(skin.weights[:, chosen].sum(axis=1))


def _fingers(shape: BodyShape, skin: OneSkin) -> np.ndarray:
    """(V,) 0 to 1: to what degree a vertex is a finger's: these keep their shape, because the bends of fingers are not measured."""
    own = [FINGER_BONE.fullmatch(bone.name) is not None for bone in shape.skeleton.bones]
    return np.minimum(1.0, FINGERS_REACH * skin.weights[:, own].sum(axis=1))


def _prior(vertices: np.ndarray, faces: np.ndarray, size: np.ndarray) -> "sparse.csc_matrix":
    """The square root (V, V) of Q of (2): Q = Hᵀ H, for s (V,)."""
    from scipy import sparse

    C, area = laplacian(vertices, faces)
    scale = area**-0.5 / (np.sqrt(4 * np.pi) * KAPPA * size)
    return sparse.csc_matrix(sparse.diags(scale) @ (KAPPA**2 * sparse.diags(area) - C))


def _observed(
    poser: Poser,
    moved: np.ndarray,
    faces: np.ndarray,
    delta: np.ndarray,
    gate: np.ndarray,
    directions: np.ndarray,
    smoothed: np.ndarray,
    points: SurfacePoints,
) -> _Observed:
    """(1) of one frame, averaged for every vertex; `delta` (V,) is the displacement that the skin `moved` has, `gate` (V,) the largest."""
    from scipy.spatial import cKDTree

    posed, along = poser.moved(moved, *poser.frames(points.motion), directions)
    normals = _mixed(vertex_normals(posed, faces), along, smoothed)
    X, m = points.xyz_m, points.normals
    distance, near = cKDTree(posed).query(X, k=CANDIDATES, distance_upper_bound=float(gate.max()))
    near = np.minimum(near, len(posed) - 1)
    cosine = np.einsum("nkc,nc->nk", normals[near], m)
    best = np.argmin(np.where(cosine > LEAST_COSINE, distance * (2 - cosine), np.inf), axis=1)
    rows = np.arange(len(X))
    vertex, cosine, distance = near[rows, best], cosine[rows, best], distance[rows, best]
    d = delta[vertex] + np.einsum("nc,nc->n", m, X - posed[vertex]) / np.maximum(cosine, LEAST_COSINE)
    good = (cosine > LEAST_COSINE) & np.isfinite(distance) & (np.abs(d) < gate[vertex])
    vertex, cosine, d, sigma = vertex[good], cosine[good], d[good], points.sigma_m[good]
    weight = (cosine / np.maximum(sigma, LEAST_SIGMA_M)) ** 2
    hit, at = np.unique(vertex, return_inverse=True)
    total = np.bincount(at, weight)
    return _Observed(vertex=hit, d=np.bincount(at, weight * d) / total, variance=1 / total)


def _adjusted(prior: "sparse.csc_matrix", nearby: "Nearby", seen: _Observed, reweightings: int) -> tuple[np.ndarray, Any, np.ndarray]:
    """δ (V,) of (2), the factorised normal matrix, and the observations' weights (M,)."""
    count, robust = prior.shape[0], np.ones(len(seen.d))
    spread = np.full(len(seen.d), START_SIGMA_M)
    delta, factor, weight = np.zeros(count), None, robust
    for _ in range(1 + reweightings):
        weight = robust / (seen.variance + (CORRELATED * spread) ** 2)
        factor = factorised(prior.T @ prior, np.bincount(seen.vertex, weight, count))
        delta = factor.solve(np.bincount(seen.vertex, weight * seen.d, count))
        residual = seen.d - delta[seen.vertex]
        spread = nearby.scatter(seen.vertex, residual)[seen.vertex]  # (3)
        robust = np.clip(1 - (residual / (TUKEY * np.sqrt(seen.variance + spread**2))) ** 2, 0, None) ** 2
    return delta, factor, weight


def _mirrored(
    vertices: np.ndarray,
    normals: np.ndarray,
    may: np.ndarray,
    delta: np.ndarray,
    sigma: np.ndarray,
    size: np.ndarray,
    seen: _Observed,
    weight: np.ndarray,
) -> tuple[_Observed, np.ndarray]:
    """The observations and those of measured vertices' mirror images (in the plane x = 0) at vertices that were hardly measured and `may`
    (V,) follow them."""
    from scipy.spatial import cKDTree

    flip = np.array([-1.0, 1.0, 1.0])
    distance, other = cKDTree(vertices).query(vertices * flip, distance_upper_bound=GATE * PRIOR_M)
    there = np.flatnonzero(np.isfinite(distance) & may)
    other = other[there]
    there, other = (rows[(sigma[there] > UNMEASURED * size[there]) & (sigma[other] < UNMEASURED * size[other])] for rows in (there, other))
    places = (vertices + delta[:, None] * normals)[other] * flip
    cosine = np.einsum("nk,nk->n", normals[there], normals[other] * flip)
    d = np.einsum("nk,nk->n", normals[other] * flip, places - vertices[there]) / np.maximum(cosine, LEAST_COSINE)
    good = (cosine > LEAST_COSINE) & (np.abs(d) < GATE * size[there])
    both = _Observed(
        vertex=np.concatenate([seen.vertex, there[good]]),
        d=np.concatenate([seen.d, d[good]]),
        variance=np.concatenate([seen.variance, sigma[other[good]] ** 2 + MIRRORED_M**2]),
    )
    return both, np.concatenate([weight, 1 / both.variance[len(weight) :]])


def _sigmas(factor: Any, prior: "sparse.csc_matrix", seen: _Observed, weight: np.ndarray) -> np.ndarray:
    """Standard deviations (V,) of δ, from samples of its distribution."""
    of_prior, of_seen = np.random.default_rng(0).standard_normal((SAMPLES, 2, prior.shape[0])).transpose(1, 2, 0)
    root = np.sqrt(np.bincount(seen.vertex, weight, prior.shape[0]))
    draws = factor.solve(np.asfortranarray(prior.T @ of_prior + root[:, None] * of_seen))  # all at once: a third of the time
    return np.asarray(np.sqrt(np.einsum("vs,vs->v", draws, draws) / SAMPLES))
