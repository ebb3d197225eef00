"""Weights where legs leave the trunk, and of the neck.

The share of a leg rises across an oblique plane through the joint, whatever part a vertex was cast with.

The seam of the meshes (welding) is where the surface of the limb leaves that of the trunk: for a leg, a hand's breadth below the joint.
With weights that change there, a bent hip dents the front of the thigh. Flesh moves with the thigh from the groin's crease on, which runs
from the pubis outwards and upwards in front and lower behind:

    T = smooth(½ + s/2h) · side ,   s = n·(X − X_joint) − s_0 ,   n ∝ y + a out + b ahead                    (1)

with y along the limb's first own bone, `out` away from the middle, h, s_0 in lengths of that bone. w' = (1 − T) w_trunk + T w_limb.

A neck bends from the collar bones to the jaw, and not within the 3 cm between the ends of the chest's bone and of the head, where the
throat would fold. There u is harmonic on the mesh, 0 below the collar and 1 at the jaw, and chest, neck and head have the shares

    chest ½(|1 − 2u| + 1 − 2u) ,   neck 1 − |1 − 2u| ,   head ½(|1 − 2u| − 1 + 2u) ,   |·| rounded             (2)
"""

from dataclasses import dataclass

import numpy as np

from ..parts import body_parts
from ..shape import BodyShape
from ..skeleton import bone_frames
from .ends import HEAD
from .extremities import NECK
from .rays import smooth
from .surface_operators import factorised, laplacian


@dataclass(frozen=True, slots=True)
class _Border:
    """(1): `half` h and `beyond` s_0 over the bone's length, `outward` a, `ahead` b; `reach`: distances from the joint, over the bone's
    length, between which the limb's share of trunk vertices fades, and the web between the limbs ends."""

    half: float
    beyond: float
    outward: float
    ahead: float
    reach: tuple[float, float]


BORDERS = {  # by the bone that turns at the joint
    "thigh": _Border(half=0.21, beyond=0.045, outward=0.5, ahead=0.4, reach=(0.55, 0.8)),
}
MIDDLE = 0.09  # over the bone's length: half of the width of the web between the legs, which follows both and the trunk
NONE = 1e-6  # a share that does not matter


def with_limb_borders(shape: BodyShape, vertices: np.ndarray, part: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The weights (V, B) of vertices (V, 3) of the rest pose that belong to the parts (V,), with those of limbs as in (1)."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    parts, found = body_parts(shape), weights
    ahead = R[parts[0].bones[0]][:, 2]
    for p, limb in enumerate(parts):
        own = [b for b in limb.bones if shape.skeleton.bones[b].name[:-2] in BORDERS]
        if limb.parent is None or limb.attachment is None or not own:
            continue
        b, border = own[0], BORDERS[shape.skeleton.bones[own[0]].name[:-2]]
        out = np.array([np.sign(head[b, 0]), 0.0, 0.0])
        n = R[b][:, 1] + border.outward * (out - (out @ R[b][:, 1]) * R[b][:, 1]) + border.ahead * ahead
        offset, length = vertices - head[b], shape.lengths_m[b]
        s = offset @ n / np.linalg.norm(n) / length - border.beyond
        side = smooth(0.5 + vertices @ out / (2 * MIDDLE * length))
        near = 1 - smooth((np.linalg.norm(offset, axis=1) / length - border.reach[0]) / (border.reach[1] - border.reach[0]))
        share = smooth(0.5 + s / (2 * border.half)) * np.where(part == p, 1 - near * (1 - side), side * near * (part == limb.parent))
        found = _with_share(found, _from(shape, b), share, np.isin(part, (p, limb.parent)), (limb.attachment, b))
    return found


CHEST = "chest"
COLLAR = 0.2  # how far below the neck's joint the collar is in the middle of the body, in lengths of the chest's bone …
FALL = 0.35  # … and how much lower it is farther ahead
JAWS = 0.97  # weight of the head in vertices that are entirely the head's
ROUNDED = 0.3  # of |·| in (2)


def with_neck(shape: BodyShape, vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The weights (V, B) of vertices (V, 3) of the rest pose, with those of chest, neck and head as in (2)."""
    from scipy import sparse

    names = [bone.name for bone in shape.skeleton.bones]
    if not {CHEST, NECK, HEAD} <= set(names):
        return weights
    chest, neck, head = three = np.array([names.index(name) for name in (CHEST, NECK, HEAD)])
    R, joint = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    local = (vertices - joint[neck]) @ R[chest] / shape.lengths_m[chest]
    below, jaw = local[:, 1] + FALL * local[:, 2] < -COLLAR, weights[:, head] > JAWS
    C, _ = laplacian(vertices, faces)
    free = ~below & ~jaw & (weights[:, three].sum(axis=1) > NONE)
    if not (free.any() and jaw.any()):
        return weights
    rows = np.flatnonzero(free)
    u = jaw.astype(np.float64)
    u[rows] = factorised(sparse.csc_matrix(-C[rows][:, rows])).solve(C[rows] @ u)
    bend = np.hypot(1 - 2 * u, ROUNDED) - (np.hypot(1, ROUNDED) - 1)
    share = np.clip(np.stack([(bend + 1 - 2 * u) / 2, 1 - bend, (bend - 1 + 2 * u) / 2], axis=1), 0, None)
    found = weights.copy()
    total = weights[np.ix_(rows, three)].sum(axis=1, keepdims=True)
    found[np.ix_(rows, three)] = total * share[rows] / share[rows].sum(axis=1, keepdims=True)
    return found


def _from(shape: BodyShape, bone: int) -> np.ndarray:
    """(B,) bool: the bone and all that hang on it."""
    found = np.zeros(len(shape.skeleton.bones), dtype=bool)
    for b, parent in enumerate(shape.skeleton.parents):
        found[b] = b == bone or (parent >= 0 and found[parent])
    return found


def _with_share(weights: np.ndarray, own: np.ndarray, share: np.ndarray, which: np.ndarray, otherwise: tuple[int, int]) -> np.ndarray:
    """Weights (V, B) of which the bones `own` (B,) have the sum `share` (V,) in the vertices `which` (V,). `otherwise`: the bones that
    have it all where none of either kind had any."""
    both = []
    for bones, only in zip((~own, own), otherwise):
        part = np.where(bones, weights, 0.0)
        total = part.sum(axis=1, keepdims=True)
        both.append(np.where(total > NONE, part / np.maximum(total, NONE), np.eye(len(own))[only]))
    mixed = (1 - share)[:, None] * both[0] + share[:, None] * both[1]
    return np.where(which[:, None], mixed, weights)
