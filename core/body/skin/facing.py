"""The zero of the head's angles, and the place of its joint: the face looks ahead, and the skull turns on the neck where skulls do.

The fitted head is an ellipsoid along the line from chin to crown, which shows neither nose nor chin: its angles follow the motion, but from
a zero of their own, and where the neck ends under it no surface shows. Where the face of the skin was registered to the measured points
(`head_place`), the rotation F from the bone's axes to those of the face is known, and the place d of the joint in the bone's axes. With
them, the bone has the face's axes and begins there in all frames,

    E(θ') = E(θ) F ,    X_t = h_t + E(θ_t) d ,    x' = Fᵀ (x − d)                                          (1)

E being the rotation of the head, h the joint as it was, and x what the bone carries: metaballs, and the skin, whose rest pose becomes the
one in which the face looks ahead. The neck's two angles point it at X in every frame, its length L' is the median of |X − n|, n being where
it begins, and what it carries turns the other way by G, the mean turn in its own axes. Nothing moves in the frames themselves, but for what
|X − n| differs from L' in them.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from ...geometry.rotation import rotate, rotation_from_vector, shortest, transposed, unit
from ..motion import BodyFit
from ..shape import BodyShape
from ..skeleton import LENGTHS_M, Skeleton, bone_frames, joint_positions
from .closed_skin import OneSkin
from .ends import HEAD
from .posed import Poser

SIGMA = 0.08  # rad, of a registered face about each axis
ALONG = np.array([0.0, 1.0, 0.0])  # a bone, in its axes


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Facing:
    """Where the face looks, and where the head begins and ends, in the axes of the head's bone."""

    turn: np.ndarray  # (3,) F as its Rodrigues vector
    joint_m: np.ndarray  # (3,) d
    crown_m: np.ndarray  # (3,) the end of the bone


def facing_ahead(
    body: BodyFit, skin: OneSkin, shape: BodyShape, facing: Facing, clicked: Collection[str] = ()
) -> tuple[BodyFit, OneSkin, BodyShape]:
    """The same with (1): a fit, its skin in the rest pose, and the shape that carries the skin.

    They stay as they are without a head that another bone carries and that turns about three axes. d is 0 if the head's joint is among the
    `clicked` ones, whose clicks say where it is, or if the neck does not turn about two axes across it.
    """
    skeleton = body.shape.skeleton
    b = next((i for i, bone in enumerate(skeleton.bones) if bone.name == HEAD), -1)
    n, F = int(skeleton.parents[b]) if b >= 0 else -1, rotation_from_vector(facing.turn)
    if n < 0 or len(_free(skeleton, b)) < 3:
        return body, skin, shape
    moves = skeleton.bones[b].head_joint not in clicked and bool(skeleton.starts_at_tail[b]) and _turns_across(skeleton, n)
    d = facing.joint_m if moves else np.zeros(3)
    motion, lengths = body.motion, body.shape.lengths_m.copy()
    values, covariance = motion.values.copy(), motion.covariance.copy()
    R, head = bone_frames(skeleton, lengths, values)
    G = np.eye(3)
    if moves:
        neck = head[:, b] + R[:, b] @ d - head[:, n]
        lengths[n] = np.clip(np.median(np.linalg.norm(neck, axis=1)), *LENGTHS_M)
        lengths[b] = np.clip((facing.crown_m - d) @ F[:, 1], *LENGTHS_M)
        G = shortest(ALONG, unit(rotate(transposed(R[:, n]), neck)).mean(axis=0))
        _point(skeleton, n, values, unit(rotate(transposed(R[:, skeleton.parents[n]] @ skeleton.rest_to_parent[n]), neck)))
    stands = bone_frames(skeleton, lengths, values)[0][:, n] @ skeleton.rest_to_parent[b]
    columns = _free(skeleton, b)
    values[:, columns] = _angles(skeleton, b, transposed(stands) @ R[:, b] @ F)
    covariance[:, columns, columns] += SIGMA**2
    places, joints = joint_positions(skeleton, lengths, values), motion.joints_m.copy()
    for name in (skeleton.bones[b].head_joint, skeleton.bones[b].tail_joint):
        joints[:, motion.joint_names.index(name)] = places[name]
    carried = [(n, G, np.zeros(3)), (b, F, d)]
    moved = replace(motion, values=values, covariance=covariance, joints_m=joints)
    carrying = _with(shape, lengths, carried)
    skin = replace(skin, vertices_m=_at_rest(skin, shape, carrying.lengths_m, carried))
    return replace(body, shape=_with(body.shape, lengths, carried), motion=moved), skin, carrying


def _free(skeleton: Skeleton, b: int) -> list[int]:
    """The columns of a bone's angles, from the outermost on."""
    return [column for column, _ in skeleton.turn_order[b] if column not in skeleton.locked]


def _turns_across(skeleton: Skeleton, n: int) -> bool:
    """Whether a bone is not the first one, and turns about x and z alone."""
    return skeleton.parents[n] >= 0 and {axis for _, axis in skeleton.turn_order[n]} == {0, 2} and len(_free(skeleton, n)) == 2


def _angles(skeleton: Skeleton, b: int, R: np.ndarray) -> np.ndarray:
    """The three angles (T, 3) of rotations (T, 3, 3), in the order of the bone's rotation."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_euler("".join("XYZ"[axis] for _, axis in skeleton.turn_order[b])))


def _point(skeleton: Skeleton, n: int, values: np.ndarray, direction: np.ndarray) -> None:
    """Set a bone's angles about x and z so that it points in directions (T, 3), given in its axes before it turns."""
    (first, axis), (second, _) = skeleton.turn_order[n]
    x, y, z = direction.T
    if axis == 0:  # R_x R_z y = (−sin c, cos c cos a, cos c sin a)
        values[:, first], values[:, second] = np.arctan2(z, y), -np.arcsin(np.clip(x, -1, 1))
    else:  # R_z R_x y = (−sin c cos a, cos c cos a, sin a)
        values[:, first], values[:, second] = np.arctan2(-x, y), np.arcsin(np.clip(z, -1, 1))


Carried = list[tuple[int, np.ndarray, np.ndarray]]  # bones, with the F and d of (1) by which what they carry changes


def _at_rest(skin: OneSkin, shape: BodyShape, lengths_m: np.ndarray, carried: Carried) -> np.ndarray:
    """The vertices (V, 3) of the rest pose, of a body with these lengths."""
    R, head = bone_frames(shape.skeleton, lengths_m, np.zeros(len(shape.skeleton.dofs)))
    for b, F, d in carried:
        R[b] = R[b] @ F.T
        head[b] = head[b] - R[b] @ d
    return Poser(shape, skin.weights).moved(skin.vertices_m, R, head)[0]


def _with(shape: BodyShape, lengths_m: np.ndarray, carried: Carried) -> BodyShape:
    """Other lengths of these bones, and their metaballs at the same places."""
    balls, lengths = shape.metaballs, shape.lengths_m.copy()
    centre = balls.centre.copy()
    for b, F, d in carried:
        own, lengths[b] = balls.bone_index == b, lengths_m[b]
        centre[own] = (centre[own] * shape.lengths_m[b] - d) @ F / lengths[b]
    return replace(shape, lengths_m=lengths, metaballs=replace(balls, centre=centre))
