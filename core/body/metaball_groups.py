"""Which balls add up in a skin of metaballs that knows no places: families, of whose fields the largest counts.

The surface of a body (whole_surface) holds beside its bones; a sum of metaballs holds everywhere, and one family for all would web an arm
to the flank beside it, and a leg to the other. So each family has the balls of

    a part            its own chain of bones
    a trunk           … and the short bones within it on which limbs hang: shoulders
    a limb            … that hangs on the trunk by a long bone, a thigh: and the trunk's bone there
    a trunk's bone    on which such limbs hang: its own, what is next to it of the trunk, and the limbs'
    a shoulder        the trunk's bone on which it hangs, its own, and those of the upper arm

and those beside a joint with one of its bones, with weights a of their own, as near 1 (or 0 of the latter) as the surface lets them be:

    Σ_m a_m f_m(X) = T ± s |∇G| ,   a_m = 1 ± σ ,   0 ≤ a_m ≤ 4                                               (1)

at points X of the surface, s = 1 mm, in rest and with the limbs moved, each for the family whose field is the largest there; and where
another's is above T, for that one, too. At rest and in a step, three bodies: 0.24 to 0.32 mm RMS, hips 0.2 to 0.4, neck 0.4 to 0.6,
shoulders 0.6 to 0.7, where they hang on the chest 0.5 to 0.8 (4 mm at most, in the armpit; 6 between the thighs).
Where limbs touch, as in a squat, the sum is up to 40 mm thicker.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import lsq_linear

from .metaballs import THRESHOLD, Metaballs, local_points, squared_distances
from .shape import BodyShape
from .skeleton import bone_frames
from .skin.contour_skin import body_skin
from .skin.mesh import SkinSettings
from .skin.parts import Part, body_parts
from .skin.whole_surface import WholeSurface

UPPER = 0.6  # balls of a limb up to here along its first long bone count for the trunk's bone
NEXT_TO = 0.34  # and those of the trunk's next bone up to here
MOVED = (0.0, 0.35, -0.35)  # postures of (1): how far each DOF of a limb's first bones goes towards its upper limit, or its lower one
SAMPLED = SkinSettings(contours=6, rays=16)
ON_SURFACE_M = 5e-4  # points of a part's skin that are farther from the surface lie within another part
SIGMA_M, SIGMA, LARGEST = 1e-3, 2.0, 4.0  # s, σ and the bound of (1); σ is of one ball against all points
ROUNDS = 4
LEAST = 0.02  # balls of less weight are left out


def families(shape: BodyShape) -> list[Metaballs]:
    """The balls of each family, with their weights; first those of the parts. A whole body takes 0.7 s, one chain none."""
    parts = body_parts(shape)
    chosen = _chosen(shape, parts)
    wanted = np.zeros((len(chosen), len(shape.metaballs.weight)))
    for k, own in enumerate(chosen):
        wanted[k, own] = 1.0
    if len(parts) == 1:
        return [_family(shape.metaballs, own, a) for own, a in zip(chosen, wanted)]
    balls, weights, (f, slope) = [_with_those_met(shape, own) for own in chosen], wanted.copy(), _samples(shape, parts)
    for _ in range(ROUNDS):
        F = f @ weights.T
        largest = F.argmax(axis=1)
        for k, used in enumerate(balls):
            rows = (largest == k) | (F[:, k] > THRESHOLD)
            weights[k, used] = _solved(f[np.ix_(rows, used)], slope[rows], wanted[k, used])
    return [_family(shape.metaballs, used, a) for used, a in zip(balls, weights)]


def _solved(f: np.ndarray, slope: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(1) for one family, whose balls' fields are f (N, m)."""
    A, firm = f / (SIGMA_M * slope)[:, None], len(f) / SIGMA**2
    N = A.T @ A + firm * np.eye(len(wanted))
    L = np.linalg.cholesky(N)  # the same minimum with m equations: N = L Lᵀ
    y = np.linalg.solve(L, A.T @ (THRESHOLD / (SIGMA_M * slope)) + firm * wanted)
    return np.asarray(lsq_linear(L.T, y, bounds=(0.0, LARGEST)).x)


def _family(balls: Metaballs, order: np.ndarray, weights: np.ndarray) -> Metaballs:
    used = order[weights[order] > LEAST]
    return replace(
        balls,
        bone_index=balls.bone_index[used],
        centre=balls.centre[used],
        radii_m=balls.radii_m[used],
        weight=balls.weight[used] * weights[used],
    )


def _samples(shape: BodyShape, parts: tuple[Part, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Fields f (N, M) of all balls at points of the surface in the postures of (1), and its slope |∇G| there (N,)."""
    fields, slopes = [], []
    for share in MOVED:
        motion = _moved(shape, parts, share)
        skin, surface = body_skin(shape, motion, SAMPLED), WholeSurface(shape, motion)
        part = np.repeat(np.arange(len(parts)), skin.part_sizes)
        seen = np.abs(surface.distance_m(skin.vertices_m, part)) < ON_SURFACE_M
        points = skin.vertices_m[seen]
        local = local_points(*bone_frames(shape.skeleton, shape.lengths_m, motion), points)
        fields.append(shape.metaballs.weight * np.exp(-2 * squared_distances(shape.metaballs, shape.lengths_m, local)[1]))
        slopes.append(surface.slope(points, part[seen]))
    return np.concatenate(fields), np.concatenate(slopes)


def _moved(shape: BodyShape, parts: tuple[Part, ...], share: float) -> np.ndarray:
    """A posture (D,) in which the bones by which limbs hang are turned this far from rest to their limits."""
    motion = np.zeros(len(shape.skeleton.dof_names))
    for b in (b for part in parts if part.parent is not None for b in part.junction):
        for dof in shape.skeleton.bones[b].dofs:
            limit = dof.limits[int(share > 0)]
            motion[shape.skeleton.layout[dof.name]] = abs(share) * limit if np.isfinite(limit) else 0.0
    return motion


def _chosen(shape: BodyShape, parts: tuple[Part, ...]) -> list[np.ndarray]:
    """The balls (numbers, rising by the bone's place in the family) of which each family is made."""
    found = [_balls(shape, _bones(parts, p)) for p in range(len(parts))]
    for attachment in sorted({part.attachment for part in parts if _is_long(part) and part.attachment is not None}):
        limbs = [part.bones[0] for part in parts if _is_long(part) and part.attachment == attachment]
        trunk = next(part for part in parts if attachment in part.bones)
        beyond = trunk.bones[trunk.bones.index(attachment) + 1 :][:1]
        found.append(np.concatenate([_balls(shape, (attachment,)), _balls(shape, beyond, NEXT_TO), _balls(shape, limbs, UPPER)]))
    for part in parts:
        if part.attachment is not None and not _is_long(part):
            found.append(np.concatenate([_balls(shape, (part.attachment, part.bones[0])), _balls(shape, part.bones[1:2], UPPER)]))
    return found


def _with_those_met(shape: BodyShape, own: np.ndarray) -> np.ndarray:
    """The balls of a family, and those beside a joint with one of its bones: with farther ones, arms would melt into flanks."""
    bones, along, parents = np.unique(shape.metaballs.bone_index[own]), shape.metaballs.centre[:, 1], shape.skeleton.parents
    above = {int(parents[b]) for b in bones if shape.skeleton.starts_at_tail[b]}
    below = [b for b, parent in enumerate(parents) if parent in bones]
    of = shape.metaballs.bone_index
    met = (np.isin(of, list(above)) & (along > 1 - NEXT_TO)) | (np.isin(of, below) & (along < NEXT_TO))
    return np.concatenate([own, np.setdiff1d(np.flatnonzero(met), own)])


def _is_long(limb: Part) -> bool:
    """Whether a limb leaves the trunk by its first bone."""
    return limb.parent is not None and len(limb.junction) == 1


def _bones(parts: tuple[Part, ...], p: int) -> tuple[int, ...]:
    part = parts[p]
    short = tuple(limb.bones[0] for limb in parts if limb.parent == p and not _is_long(limb))
    above = (part.attachment,) if _is_long(part) and part.attachment is not None else ()
    return (*part.bones, *short, *above)


def _balls(shape: BodyShape, bones: Sequence[int], up_to: float = np.inf) -> np.ndarray:
    balls = shape.metaballs
    found = [np.flatnonzero((balls.bone_index == b) & (balls.centre[:, 1] < up_to)) for b in bones]
    return np.concatenate([np.zeros(0, dtype=np.intp), *found])
