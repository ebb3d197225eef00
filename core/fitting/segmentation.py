"""Which limb does a measured point belong to? (D'Apuzzo et al. 1999, §3.3: the closest limb in the pose so far.)

    d = |X − bone's segment| − radius of the limb in the direction of X                                           (1)
    α_ij = π_ij N(d_ij; σ) max(0, n_i·n_j) / (Σ_k π_ik N(d_ik; σ) max(0, n_i·n_k) + π_0 / (2 gate))               (2)
    π_j = mean of α_ij over i ,   π_0 = 1 − Σ_j π_j ,   σ² = Σ α d² / Σ α , within 3 and 30 mm                    (3)

Hard segmentation: the closest limb has the smallest distance (1) from its surface (`body.parts`), not from its axis: a fat trunk
must not swallow the points of a thin arm. A point belongs to no limb when it is further from that surface than a gate, when it lies along
the bone where the surface is another part's or bends with the joint (the shoulder belongs to the trunk, what is beyond the wrist to the
hand), or when its normal points into the limb.

Soft segmentation: points may belong to several limbs, to each in part (Horaud, Niskanen, Dewaele & Boyer 2009, IEEE TPAMI 31(1), §4). d_ij
is the distance of point i from the surface of limb j, n are their normals, and the last term of (2) is the class of outliers, even within
the gate. Few of a body's limbs are near a point: π_ij is π_j among those that are, together 1 − π_0. A few rounds of (2) and (3) begin at σ
= 30 mm; as the body approaches its points σ falls with their distances, so a far start remains undecided, and a good fit decides as sharply
as the hard segmentation. The share of a limb where the surface is another part's is dropped.
"""

from collections.abc import Callable, Hashable
from typing import Any, Protocol, Self, TypeVar, cast

import numpy as np

from .inputs.cloud_points import CloudPoints
from .state import CROSS, BodyState

HYSTERESIS_M = 0.004  # motion of the body within which points keep their limbs
FACING = 0.6  # least cosine between a point's normal and the limb's
WIDEST_M, NARROWEST_M = 0.030, 0.003  # of σ in (3)
ROUNDS = 6  # of (2) and (3)
OUTLIERS = (0.05, 0.5)  # π_0 at the start, and at most
ALONG, AROUND = 9, 10  # points on the surface of a limb
LEAST_SHARE = 0.05  # of a point for a limb; a smaller one is not worth its equation


def segment(points: CloudPoints, state: BodyState, surface: np.ndarray, gate_m: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that belong to a limb (K,) and the limb's bone (K,).

    `surface` (B, 2): the fractions of each bone between which a surface is its own; `gate_m` (B,) or for all: the largest distance from the
    limb's surface.
    """
    gate = np.broadcast_to(gate_m, (len(state.lengths_m),))
    rows, bone = near_pairs(points.xyz_m, state, gate)
    gap, along, facing = facing_bone(points.xyz_m[rows], points.normals[rows], state, bone)
    own = (along >= surface[bone, 0]) & (along <= surface[bone, 1]) & facing & (np.abs(gap) < gate[bone])
    return owners(rows, bone, gap, own)


def owners(rows: np.ndarray, bone: np.ndarray, gap: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the points that belong to the bone with the least gap, and that bone (K,).

    Of pairs of a point and a bone, ordered by points: rows (P,), bones (P,), gaps (P,), and whether the point is that bone's `own` (P,) if
    that is the nearest.
    """
    if not len(rows):
        return rows, bone
    first = np.flatnonzero(np.diff(rows, prepend=-1))
    least = np.repeat(np.minimum.reduceat(gap, first), np.diff(first, append=len(rows)))
    nearest = np.flatnonzero(gap == least)
    nearest = nearest[np.diff(rows[nearest], prepend=-1) > 0]  # one of several that are as near
    found = nearest[own[nearest]]
    return rows[found], bone[found]


class Reweighted(Protocol):
    """Observations whose weights may be renewed."""

    def reweighted(self, reference: BodyState) -> Self:
        """The same with weights from another reference state."""


R = TypeVar("R", bound=Reweighted)


class SegmentationCache:
    """The limb of each point, as long as the body has hardly moved: points do not change limbs for a millimetre."""

    def __init__(self) -> None:
        self._found: dict[Hashable, tuple[np.ndarray, Any]] = {}
        self._observed: dict[Hashable, tuple[Any, Any]] = {}

    def get(self, key: Hashable, state: BodyState, find: Callable[[], Any]) -> Any:
        """The segmentation for `key` of a body within `HYSTERESIS_M` of the present one; without one that of `find`."""
        tails = state.head_m + state.lengths_m[:, None] * state.R[:, :, 1]
        now = np.concatenate([state.head_m.ravel(), tails.ravel(), *(profile.radii_m.ravel() for profile in state.profiles.values())])
        if key not in self._found or np.abs(self._found[key][0] - now).max() > HYSTERESIS_M:
            self._found[key] = (now, find())
        return self._found[key][1]

    def observed(self, key: Hashable, state: BodyState, find: Callable[[], Any], observe: Callable[..., R]) -> R:
        """The observations of the segmentation for `key`: with new weights as long as nothing changes its limb, else `observe`d anew."""
        owners = self.get(key, state, find)
        last = self._observed.get(key)
        found = last[1].reweighted(state) if last is not None and last[0] is owners else observe(*owners)
        self._observed[key] = owners, found
        return cast(R, found)


def crop(points: CloudPoints, state: BodyState, reach_m: np.ndarray | float) -> CloudPoints:
    """The points within `reach_m` (of each bone (B,), or of all) of the bones: all that a fit near this pose can ever need."""
    reach = np.broadcast_to(reach_m, (len(state.lengths_m),))
    rows, bone = near_pairs(points.xyz_m, state, reach)
    return points.take(np.unique(rows[_gap(points.xyz_m[rows], state, bone)[0] < reach[bone]]))


def near_pairs(xyz_m: np.ndarray, state: BodyState, reach_m: np.ndarray, bones: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a point (K,) and a bone (K,), ordered by points, of `bones` or all with balls, in whose enclosing sphere the point is.

    That sphere encloses all places within `reach_m` (B,) of the bone's surface.
    """
    bones = np.unique(state.balls.bone_index) if bones is None else bones
    widest = state.profile_table.radii_m[bones].max(axis=(1, 2))
    half = state.lengths_m[bones] / 2
    middle = state.head_m[bones] + half[:, None] * state.R[bones, :, 1]
    origin = middle.mean(axis=0)
    X, C = xyz_m - origin, middle - origin
    squares = np.einsum("ni,ni->n", X, X)[:, None] - 2 * X @ C.T + np.einsum("bi,bi->b", C, C)
    rows, column = np.nonzero(squares <= (half + widest + reach_m[bones]) ** 2)
    return rows, bones[column]


def facing_bone(xyz_m: np.ndarray, normals: np.ndarray, state: BodyState, bone: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points and one bone each (N,): distance from the limb's surface (N,) [m], fraction along the bone (N,), and whether the normal
    points outwards (N,)."""
    gap, along, cosine = bone_distance(xyz_m, normals, state, bone)
    return gap, along, cosine >= FACING


def bone_distance(xyz_m: np.ndarray, normals: np.ndarray, state: BodyState, bone: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `facing_bone`, with the cosine (N,) between the normal and the limb's; 1 where the normal is unknown."""
    gap, along, outward = _gap(xyz_m, state, bone)
    normal = np.einsum("ni,nij->nj", normals, state.R[bone][:, :, CROSS])
    size = np.sqrt(np.einsum("ni,ni->n", normal, normal) * np.einsum("ni,ni->n", outward, outward))
    cosine = np.where(size > 0, np.einsum("ni,ni->n", normal, outward) / np.maximum(size, 1e-300), 1.0)
    return gap, along, cosine


def gap_to_bone(xyz_m: np.ndarray, state: BodyState, bone: np.ndarray) -> np.ndarray:
    """Distance (N,) [m] of points from the surface of one limb each (N,)."""
    return _gap(xyz_m, state, bone)[0]


def surface_points(state: BodyState) -> np.ndarray:
    """Points (P, 3) evenly all over the surface of all limbs."""
    bones = np.unique(state.balls.bone_index)
    along, angle = (
        grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, ALONG), np.linspace(0, 2 * np.pi, AROUND, endpoint=False), indexing="ij")
    )
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = []
    for b in bones.tolist():
        across = circle * state.profile_table.across(np.full(len(along), b), along, circle)
        local = np.stack([across[:, 0], along * state.lengths_m[b], across[:, 1]], axis=1)
        found.append(state.head_m[b] + local @ state.R[b].T)
    return np.concatenate(found)


def _gap(xyz_m: np.ndarray, state: BodyState, bone: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance (1) from the limb's surface (N,), fraction along the bone (N,), and the direction of its normal across the bone (N, 2)."""
    local = np.einsum("ni,nij->nj", xyz_m - state.head_m[bone], state.R[bone])
    length = state.lengths_m[bone]
    along, across = local[:, 1] / length, local[:, CROSS]
    beyond = local[:, 1] - np.clip(local[:, 1], 0.0, length)
    axes = state.profile_table.across(bone, along, across)
    outward = across / axes
    aside = np.einsum("ni,ni->n", across, across)
    radius = np.sqrt(aside / np.maximum(np.einsum("ni,ni->n", outward, outward), 1e-18))  # of the ellipse in the point's direction
    return np.sqrt(aside + beyond**2) - radius, along, outward / axes


def soft_segment(
    points: CloudPoints, state: BodyState, surface: np.ndarray, gate_m: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the points (K,), a limb's bone (K,), and the limb's share of the point (K,). A row may occur several times.

    Arguments as in `segment`.
    """
    gate = np.broadcast_to(gate_m, (len(state.lengths_m),))
    rows, bone = near_pairs(points.xyz_m, state, gate)
    bones, column = np.unique(bone, return_inverse=True)
    gap, likely, own = (np.zeros((len(points.xyz_m), len(bones))) for _ in range(3))
    d, along, cosine = bone_distance(points.xyz_m[rows], points.normals[rows], state, bone)
    gap[rows, column], likely[rows, column] = d, np.maximum(cosine, 0.0) * (np.abs(d) < gate[bone])
    own[rows, column] = (along >= surface[bone, 0]) & (along <= surface[bone, 1])
    share = responsibilities(gap, likely, float(gate.mean()))
    share = np.where(own > 0, share, 0.0)
    rows, column = np.nonzero(share > LEAST_SHARE)
    return rows, bones[column], share[rows, column]


def responsibilities(gap_m: np.ndarray, likely: np.ndarray, gate_m: float) -> np.ndarray:
    """α (N, J) of distances (N, J) and of factors (N, J) that are 0 where a limb cannot be.  (2), (3)"""
    share, sigma = np.zeros_like(gap_m), WIDEST_M
    mixture, outliers, near = np.ones(gap_m.shape[1]), OUTLIERS[0], likely > 0
    for _ in range(ROUNDS):
        among = (1 - outliers) * mixture / np.maximum((near * mixture).sum(axis=1, keepdims=True), 1e-12)
        density = among * likely * np.exp(-0.5 * (gap_m / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        share = density / (density.sum(axis=1, keepdims=True) + outliers / (2 * gate_m))  # (2)
        total = float(share.sum())
        if total < 1e-9:
            break
        mixture = share.sum(axis=0) / max(int(near.any(axis=1).sum()), 1)  # points beyond every gate do not count as outliers
        outliers = float(np.clip(1 - mixture.sum(), *OUTLIERS))
        sigma = float(np.clip(np.sqrt((share * gap_m**2).sum() / total), NARROWEST_M, WIDEST_M))  # (3)
    return share
