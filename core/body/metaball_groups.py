"""Groups of metaballs whose fields are summed: the body's surface is the union of the groups' surfaces (in Blender a metaball family each).

The fitted surface (whole_surface) sums only the balls of adjacent bones. Metaballs of one group are summed everywhere, and a single group
would web an arm to the flank next to it, and one leg to the other. So each group has the balls of

    a part            its own chain of bones
    a trunk           … and the short bones within it that carry limbs: shoulders
    a limb            … attached to the trunk by a long bone, a thigh: and the trunk's bone there
    a trunk's bone    that carries such limbs: its own, the adjacent ones of the trunk, and the limbs'
    a shoulder        the trunk's bone that carries it, its own, and those of the upper arm

and the balls near a joint with one of its bones. The balls' weights a in a group are adjusted, as near 1 (0 for the latter) as the surface
allows:

    Σ_m a_m f_m(X) = T ± s |∇G| ,   a_m = 1 ± σ ,   0 ≤ a_m ≤ 4                                               (1)

at points X of the surface, s = 1 mm, in the rest pose and with the limbs moved, each for the group with the largest field there; and for
any other group whose field is above T. In the rest pose and in a step, three bodies: 0.24 to 0.32 mm RMS, hips 0.2 to 0.4, neck 0.4 to
0.6, shoulders 0.6 to 0.7, at the chest 0.5 to 0.8 (4 mm at most, in the armpit; 6 between the thighs).
Where limbs touch, as in a squat, the sum is up to 40 mm thicker.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .metaballs import THRESHOLD, Metaballs, local_points, squared_distances
from .parts import Part, body_parts
from .shape import BodyShape
from .skeleton import bone_frames
from .skin.contour_skin import body_skin
from .skin.mesh import SkinSettings
from .skin.whole_surface import WholeSurface

UPPER = 0.6  # fraction of a limb's first long bone: balls up to here count for the trunk's bone
NEXT_TO = 0.34  # fraction of a bone: balls up to here are near its joint
MOVED = (0.0, 0.35, -0.35)  # poses of (1): fraction to which each DOF of a limb's first bones goes to its upper, or lower (−), limit
SAMPLED = SkinSettings(contours=6, rays=16)
ON_SURFACE_M = 5e-4  # points of a part's skin that are farther from the surface lie within another part
SIGMA_M = 1e-3  # s of (1)
SIGMA = 2.0  # σ of (1), of one ball against all points
LARGEST = 4.0  # bound of (1)
ROUNDS = 4  # of assigning points to groups and solving (1)
LEAST = 0.02  # balls of less weight are left out


def metaball_groups(shape: BodyShape) -> list[Metaballs]:
    """The balls of each group, with their weights; the parts' groups come first. A whole body takes 0.7 s, one chain no time."""
    parts = body_parts(shape)
    chosen = _chosen(shape, parts)
    wanted = np.zeros((len(chosen), len(shape.metaballs.weight)))
    for k, own in enumerate(chosen):
        wanted[k, own] = 1.0
    if len(parts) == 1:
        return [_group(shape.metaballs, own, a) for own, a in zip(chosen, wanted)]
    balls, weights, (f, slope) = [_with_adjacent(shape, own) for own in chosen], wanted.copy(), _samples(shape, parts)
    for _ in range(ROUNDS):
        F = f @ weights.T
        largest = F.argmax(axis=1)
        for k, used in enumerate(balls):
            rows = (largest == k) | (F[:, k] > THRESHOLD)
            weights[k, used] = _solved(f[np.ix_(rows, used)], slope[rows], wanted[k, used])
    return [_group(shape.metaballs, used, a) for used, a in zip(balls, weights)]


def _solved(f: np.ndarray, slope: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(1) for one group, whose balls' fields are f (N, m)."""
    from scipy.optimize import lsq_linear

    A, prior = f / (SIGMA_M * slope)[:, None], len(f) / SIGMA**2
    N = A.T @ A + prior * np.eye(len(wanted))
    L = np.linalg.cholesky(N)  # the same minimum with m equations: N = L Lᵀ
    y = np.linalg.solve(L, A.T @ (THRESHOLD / (SIGMA_M * slope)) + prior * wanted)
    return np.asarray(lsq_linear(L.T, y, bounds=(0.0, LARGEST)).x)


def _group(balls: Metaballs, order: np.ndarray, weights: np.ndarray) -> Metaballs:
    used = order[weights[order] > LEAST]
    return replace(
        balls,
        bone_index=balls.bone_index[used],
        centre=balls.centre[used],
        radii_m=balls.radii_m[used],
        weight=balls.weight[used] * weights[used],
    )


def _samples(shape: BodyShape, parts: tuple[Part, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Fields f (N, M) of all balls at points of the surface in the poses of (1), and its slope |∇G| there (N,)."""
    fields, slopes = [], []
    for share in MOVED:
        motion = _moved(shape, parts, share)
        skin, surface = body_skin(shape, motion, SAMPLED), WholeSurface(shape, motion)
        part = np.repeat(np.arange(len(parts)), skin.part_sizes)
        on_surface = np.abs(surface.distance_m(skin.vertices_m, part)) < ON_SURFACE_M
        points = skin.vertices_m[on_surface]
        local = local_points(*bone_frames(shape.skeleton, shape.lengths_m, motion), points)
        fields.append(shape.metaballs.weight * np.exp(-2 * squared_distances(shape.metaballs, shape.lengths_m, local)[1]))
        slopes.append(surface.slope(points, part[on_surface]))
    return np.concatenate(fields), np.concatenate(slopes)


def _moved(shape: BodyShape, parts: tuple[Part, ...], share: float) -> np.ndarray:
    """A pose (D,) in which the bones that attach limbs are turned by this fraction from rest to their limits."""
    motion = np.zeros(len(shape.skeleton.dof_names))
    for b in (b for part in parts if part.parent is not None for b in part.junction):
        for dof in shape.skeleton.bones[b].dofs:
            limit = dof.limits[int(share > 0)]
            motion[shape.skeleton.layout[dof.name]] = abs(share) * limit if np.isfinite(limit) else 0.0
    return motion


def _chosen(shape: BodyShape, parts: tuple[Part, ...]) -> list[np.ndarray]:
    """Indices of the balls of each group, in the order of its bones."""
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


def _with_adjacent(shape: BodyShape, own: np.ndarray) -> np.ndarray:
    """The balls of a group, and those near a joint with one of its bones: with farther ones, arms would melt into flanks."""
    bones, along, parents = np.unique(shape.metaballs.bone_index[own]), shape.metaballs.centre[:, 1], shape.skeleton.parents
    above = {int(parents[b]) for b in bones if shape.skeleton.starts_at_tail[b]}
    below = [b for b, parent in enumerate(parents) if parent in bones]
    of = shape.metaballs.bone_index
    near = (np.isin(of, list(above)) & (along > 1 - NEXT_TO)) | (np.isin(of, below) & (along < NEXT_TO))
    return np.concatenate([own, np.setdiff1d(np.flatnonzero(near), own)])


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
