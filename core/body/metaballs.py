"""Metaballs: ellipsoidal primitives with an exponential field, fixed to bones (D'Apuzzo et al. 1999, Eqs. 4–8).

    d_i(X) = (x/l_x)² + (y/l_y)² + (z/l_z)²      in the axes of the ball's bone, from the ball's centre      (7)
    F(X) = Σ_i w_i exp(−2 d_i) ,   surface F = T = ½                                                        (8)

l is a field scale, not the visible half axis: an isolated ball with w = 1 has the visible radius r = l √(½ ln(w/T)) = 0.58871 l. The radius
R of a limb follows from the SUM: three balls at 1/6, 1/2, 5/6 of a bone with l = 0.30 of its length along it need l = 1.534 R across.
The fields of bones that meet at a joint are summed ("consistent mode"); balls further away do not count.
`fields` has other potentials than exp(−2 d) for display; the fit uses this one only.
"""

from dataclasses import dataclass

import numpy as np

from ..foundation.arrays import frozen
from .fields import EXPONENTIAL, THRESHOLD, VISIBLE, Potential

__all__ = [
    "ALONG",
    "STATIONS",
    "THRESHOLD",
    "VISIBLE",
    "Metaballs",
    "active_balls",
    "field",
    "field_and_derivatives",
    "local_points",
    "three_balls",
]

STATIONS = (1 / 6, 1 / 2, 5 / 6)  # centres of a segment's three balls, as fractions of the bone
ALONG = 0.30  # l along the bone, as a fraction of its length
PER_STOUTNESS = 0.85  # l along the bone by its mean radius, for bones that are thick for their length …
FURTHEST_ALONG = 0.42  # … as a fraction of its length at most
ACROSS = 1.534  # l across the bone by its visible radius, with three balls (simulated)
STEPS = 50  # of the fixed-point iteration
LEAST_ROOM = 0.05  # of the threshold, that the other balls leave to a ball
LEAST_RATIO = 1.01  # of a ball's weight to that room


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Metaballs:
    """M balls. Centres are fractions of the bone's length in its axes (0, f, 0 lies on the bone); radii are l [m] in the bone's axes."""

    bone_index: np.ndarray  # (M,) int
    centre: np.ndarray  # (M, 3) in bone lengths; y along the bone from its head
    radii_m: np.ndarray  # (M, 3) l_x, l_y (along the bone), l_z
    weight: np.ndarray  # (M,)

    def __post_init__(self) -> None:
        m = len(self.bone_index)
        object.__setattr__(self, "bone_index", frozen(self.bone_index, (m,), np.intp, "bone_index"))
        for name, shape in dict(centre=(m, 3), radii_m=(m, 3), weight=(m,)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))

    def centres_m(self, lengths_m: np.ndarray) -> np.ndarray:
        """Centres (M, 3) [m] in the bones' axes, from the bones' heads, for bone lengths (B,)."""
        return self.centre * np.asarray(lengths_m)[self.bone_index, None]


def local_points(R: np.ndarray, head_m: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    """World points (N, 3) in the axes of every bone (N, B, 3), from frames R (B, 3, 3), heads (B, 3)."""
    return np.einsum("nbi,bij->nbj", np.asarray(xyz_m)[:, None, :] - head_m, R, optimize=True)


def squared_distances(balls: Metaballs, lengths_m: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """q = (x/l_x, y/l_y, z/l_z) (N, M, 3) and d = q·q (N, M) of points given in every bone's axes (N, B, 3).  (7)"""
    q = (local[:, balls.bone_index] - balls.centres_m(lengths_m)) / balls.radii_m
    return q, np.einsum("nmi,nmi->nm", q, q)


def field(
    balls: Metaballs,
    lengths_m: np.ndarray,
    R: np.ndarray,
    head_m: np.ndarray,
    xyz_m: np.ndarray,
    active: np.ndarray | None = None,
    potential: Potential = EXPONENTIAL,
) -> np.ndarray:
    """F (N,) at world points (N, 3). `active`: bool (M,) or (N, M), the balls that count; default all.  (8)

    Arguments: bone lengths (B,), frames R (B, 3, 3) and heads (B, 3) of ONE pose (`skeleton.bone_frames`).
    """
    terms = balls.weight * potential.value(squared_distances(balls, lengths_m, local_points(R, head_m, xyz_m))[1])
    return np.asarray((terms if active is None else np.where(active, terms, 0.0)).sum(axis=1))


def field_and_derivatives(
    balls: Metaballs,
    lengths_m: np.ndarray,
    R: np.ndarray,
    head_m: np.ndarray,
    xyz_m: np.ndarray,
    active: np.ndarray | None = None,
    potential: Potential = EXPONENTIAL,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F (N,), its gradient in space (N, 3), and its derivatives to ln l (N, M, 3) and to the weights w (N, M).

    Arguments as in `field`. ∇F = 2 Σ w f'(d) q/l in the world's axes; ∂F/∂ln l = −2 q² w f'(d); ∂F/∂w = f(d).
    """
    q, d = squared_distances(balls, lengths_m, local_points(R, head_m, xyz_m))
    value, slope = potential.value(d), balls.weight * potential.slope(d)
    if active is not None:
        value, slope = np.where(active, value, 0.0), np.where(active, slope, 0.0)
    gradient = 2 * np.einsum("nm,nmi,mji->nj", slope, q / balls.radii_m, R[balls.bone_index], optimize=True)
    return value @ balls.weight, gradient, -2 * slope[..., None] * q**2, value


def active_balls(balls: Metaballs, neighbours: np.ndarray, bone: int) -> np.ndarray:
    """The balls (M,) that count for the surface of `bone`: its own, its parent's and its children's (`Skeleton.neighbours`)."""
    return neighbours[bone, balls.bone_index]


def three_balls(
    bone_index: np.ndarray, lengths_m: np.ndarray, visible_radii_m: np.ndarray, stations: np.ndarray | None = None
) -> Metaballs:
    """Three balls for each of the bones (K,) whose surface has the wanted cross radii (K, 3 stations, 2) [m] in x and z at the stations.

    `stations` (K, 3) are fractions of the bones, as a rule `STATIONS`. Balls of bones that are short for their thickness reach further
    along the bone and are weaker (`_reach`): else each shows as a band. Fixed point of l_k = R_k / √(½ ln(w/(T − Σ_{j≠k} F_j))) at the
    stations. Simulated ripple between 20 and 80 % of the bone: 1.8 mm for R = 40 mm and L = 260 mm.
    """
    bone_index, wanted = np.asarray(bone_index), np.asarray(visible_radii_m, dtype=np.float64)
    k = len(bone_index)
    own = np.asarray(lengths_m, dtype=np.float64)[bone_index]
    at = np.broadcast_to(STATIONS, (k, 3)) if stations is None else np.asarray(stations, dtype=np.float64)
    reach, spread = _reach(wanted.mean(axis=(1, 2)) / own), (at[:, 2] - at[:, 0]) / (STATIONS[2] - STATIONS[0])
    weight = _at_middle(ALONG) / _at_middle(reach)
    reach = reach * spread
    along = weight[:, None, None] * np.exp(-2 * ((at[:, :, None] - at[:, None]) / reach[:, None, None]) ** 2)
    cross = ACROSS * wanted
    for _ in range(STEPS):
        others = along[:, None] * np.exp(-2 * (wanted[:, :, None, :] / cross[:, None, :, :]) ** 2).transpose(0, 3, 1, 2)
        rest = others.sum(-1) - np.diagonal(others, axis1=-2, axis2=-1)
        room = np.maximum(THRESHOLD - rest.transpose(0, 2, 1), LEAST_ROOM)
        cross = wanted / np.sqrt(0.5 * np.log(np.maximum(weight[:, None, None] / room, LEAST_RATIO)))
    radii = np.stack([cross[..., 0].ravel(), np.repeat(reach * own, 3), cross[..., 1].ravel()], axis=-1)
    centre = np.zeros((3 * k, 3))
    centre[:, 1] = at.ravel()
    return Metaballs(bone_index=np.repeat(bone_index, 3), centre=centre, radii_m=radii, weight=np.repeat(weight, 3))


def _reach(stoutness: np.ndarray) -> np.ndarray:
    """l along the bone as a fraction of its length, for bones of a mean radius of so many lengths."""
    return np.clip(PER_STOUTNESS * stoutness, ALONG, FURTHEST_ALONG)


def _at_middle(reach: np.ndarray | float) -> np.ndarray:
    """Σ exp(−2 d) of three balls at the middle of their bone's axis."""
    return np.asarray(np.exp(-2 * np.subtract.outer(0.5, np.array(STATIONS)) ** 2 / np.asarray(reach)[..., None] ** 2).sum(axis=-1))
