"""The skin of a body in many poses: the skin of the middle pose, cast once, follows the bones.

Casting a skin onto the implicit surface costs 0.3 s, moving its vertices 2 ms. Every bone b moves from the middle pose by a rotation and a
shift, as a unit dual quaternion; those of a vertex's bones are blended by its weights (Kavan et al. 2008, doi:10.1145/1409625.1409627),

    q̂ = Σ_b w_b q̂_b / |Σ_b w_b q̂_b|                                                                        (1)

which keeps the volume at bent joints as Blender's armature does. On a walker in 40 frames, half of the vertices are within 0.2 mm of the
skin that is cast in the frame itself, and 95 % within 5 mm; the others are near armpits and crotch, or inside the body.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...geometry.rotation import cross, quaternion_from_matrix
from ..shape import BodyShape
from ..skeleton import bone_frames
from .contour_skin import Skin, SkinSettings, body_skin


class PosedSkin:
    """The skin of a body in any pose, of the same topology as `body_skin`."""

    def __init__(self, shape: BodyShape, motion: np.ndarray, settings: SkinSettings | None = None) -> None:
        """`motion` (T, D): the poses whose median is the middle one.

        Raises:
            InputError: see `body_skin`.
        """
        middle = np.median(motion, axis=0)
        self._shape, self._skin = shape, body_skin(shape, middle, settings)
        self._R, self._head = bone_frames(shape.skeleton, shape.lengths_m, middle)

    def at(self, pose: np.ndarray) -> Skin:
        """The skin in one pose (D,), rad and metres."""
        R, head = bone_frames(self._shape.skeleton, self._shape.lengths_m, pose)
        turn = R @ self._R.transpose(0, 2, 1)
        shift = head - np.einsum("bij,bj->bi", turn, self._head)
        real, dual = self._dual_quaternions(turn, shift)
        real, dual = self._skin.weights @ real, self._skin.weights @ dual  # (1)
        size = np.linalg.norm(real, axis=1, keepdims=True)
        w, v, dual = real[:, :1] / size, real[:, 1:] / size, dual / size
        moved = 2 * (w * dual[:, 1:] - dual[:, :1] * v + cross(v, dual[:, 1:]))
        vertices, normals = (x + 2 * cross(v, cross(v, x) + w * x) for x in (self._skin.vertices_m, self._skin.normals))
        return replace(self._skin, vertices_m=vertices + moved, normals=normals)

    def _dual_quaternions(self, turn: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Real and dual parts (B, 4) of rotations (B, 3, 3) and shifts (B, 3); a bone's sign is that of its parent."""
        real = quaternion_from_matrix(turn)
        for b, parent in enumerate(self._shape.skeleton.parents):
            if parent >= 0 and real[b] @ real[parent] < 0:
                real[b] = -real[b]
        w, v = real[:, :1], real[:, 1:]
        along = np.einsum("bi,bi->b", shift, v)[:, None]
        return real, 0.5 * np.concatenate([-along, w * shift + cross(shift, v)], axis=1)


def skins_in(shape: BodyShape, motion: np.ndarray, settings: SkinSettings) -> Callable[[np.ndarray], Skin]:
    """The skin as a function of the pose (D,), as the settings ask for it: posed, or cast anew in every frame. `motion` (T, D).

    Raises:
        InputError: see `body_skin`.
    """
    return (lambda pose: body_skin(shape, pose, settings)) if settings.exact else PosedSkin(shape, motion, settings).at
