"""The zero of the head's angles: the face looks ahead, and neither up nor down.

The fitted head is an ellipsoid along the line from chin to crown, which shows neither nose nor chin: its angles follow the motion, but from
a zero of their own. Where the face of the skin was registered to the measured points (`head_place`), the rotation F from the bone's axes
to those of the face is known. With it, the bone has the face's axes in all frames,

    E(θ') = E(θ) F ,    x' = Fᵀ x                                                                          (1)

E being the rotation of the bone's three angles, and x what the bone carries: metaballs, and the skin, whose rest pose becomes the one in
which the face looks ahead. Nothing moves in the frames themselves.
"""

from dataclasses import replace

import numpy as np

from ...geometry.rotation import rotation_from_vector
from ..motion import BodyFit
from ..shape import BodyShape
from ..skeleton import Bone, joint_positions
from .closed_skin import OneSkin
from .ends import HEAD
from .posed import Poser

SIGMA = 0.08  # rad, of a registered face about each axis


def facing_ahead(body: BodyFit, skin: OneSkin, shape: BodyShape, turn: np.ndarray) -> tuple[BodyFit, OneSkin, BodyShape]:
    """The same with F, given as its Rodrigues vector (3,), in (1): a fit, its skin in the rest pose, and the shape that carries the skin.

    They stay as they are if the head does not turn about three axes.
    """
    skeleton, F = body.shape.skeleton, rotation_from_vector(turn)
    b = next((i for i, bone in enumerate(skeleton.bones) if bone.name == HEAD), -1)
    columns = [i for i in range(len(skeleton.dofs)) if skeleton.dof_bone[i] == b and i not in skeleton.locked]
    if b < 0 or len(columns) < 3:
        return body, skin, shape
    bone, motion = skeleton.bones[b], body.motion
    columns = sorted(columns, key=lambda i: _order(bone).index(skeleton.dofs[i].axis))
    values, covariance = motion.values.copy(), motion.covariance.copy()
    values[:, columns] = _turned(bone, values[:, columns], F)
    covariance[:, columns, columns] += SIGMA**2
    joints = motion.joints_m.copy()
    joints[:, motion.joint_names.index(bone.tail_joint)] = joint_positions(skeleton, body.shape.lengths_m, values)[bone.tail_joint]
    moved = replace(motion, values=values, covariance=covariance, joints_m=joints)
    ahead = np.zeros(values.shape[1])
    ahead[columns] = _turned(bone, np.zeros((1, 3)), F.T)[0]
    skin = replace(skin, vertices_m=Poser(shape, skin.weights).posed(skin.vertices_m, ahead))
    return replace(body, shape=_with_balls_turned(body.shape, b, F), motion=moved), skin, _with_balls_turned(shape, b, F)


def _order(bone: Bone) -> str:
    """The axes of a bone's rotation, from the outermost on."""
    return bone.rotation_mode[::-1].lower()


def _turned(bone: Bone, angles: np.ndarray, F: np.ndarray) -> np.ndarray:
    """θ' (T, 3) of (1) for θ (T, 3), in the order of the bone's rotation."""
    from scipy.spatial.transform import Rotation

    order = _order(bone).upper()
    return np.asarray((Rotation.from_euler(order, angles) * Rotation.from_matrix(F)).as_euler(order))


def _with_balls_turned(shape: BodyShape, b: int, F: np.ndarray) -> BodyShape:
    """The metaballs of bone b at the same place, and their cross radii about the new axes."""
    balls, centre = shape.metaballs, shape.metaballs.centre.copy()
    own = balls.bone_index == b
    centre[own] = centre[own] @ F
    return replace(shape, metaballs=replace(balls, centre=centre))
