"""The feet of a skin, put where the points of all frames measured them, before the relief.

The anatomical feet (ends) have mean proportions for the length of their bones, and lie to the shins as in a rest pose. A person's are
smaller or larger, and stand more on their outer edges, or turned outwards, by an angle that a hinge with a weak prior takes for none. Both
feet together have a similarity (`similarity`, 1) about the ankles, one the mirror image of the other; then each has its own, which differs
little from it. Feet on which few points were measured stay where they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..shape import BodyShape
from ..skeleton import bone_frames
from .closed_skin import OneSkin
from .extremities import has_end
from .foot_template import TOE
from .relief import Nearby, SurfacePoints
from .similarity import Movable, Prior, points_about, registered
from .surface_operators import vertex_normals

BOTH = Prior(
    mean=np.zeros(9),
    sigma=np.array([0.006, 0.006, 0.006, 0.1, 0.2, 0.15, 0.05, 0.03, 0.06]),  # to the other foot, along the bone to the ball, across it
    size=0.045,
)
EACH, EACH_SIZE = 0.5, 0.02  # of these σ, and size of a foot about that of both
FEET = ("foot.R", "foot.L")
OWN = 0.5  # weight of a foot in vertices that are compared
HEM = 0.45  # of the bone's length, from the ankle: trousers may hang as far, and vertices there only take their points
MARGIN_M = 0.1  # about a foot: other vertices take no points from it
MIRRORED = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Foot:
    """A foot in the axes of its bone, mirrored if it is the left one."""

    movable: Movable
    points: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3)
    flip: np.ndarray  # (3,)
    R: np.ndarray  # (3, 3) axes of its bone in the rest pose


def with_feet_in_place(skin: OneSkin, shape: BodyShape, frames: Sequence[SurfacePoints]) -> OneSkin:
    """The skin of the rest pose with its feet registered to the points of all frames."""
    bones = [b for b, bone in enumerate(shape.skeleton.bones) if bone.name in FEET and has_end(shape, b)]
    if not bones or not frames:
        return skin
    feet = [_foot(skin, shape, b, [_nearest(shape, b, bones, frame) for frame in frames]) for b in bones]
    both = registered(_near(feet[0]), np.concatenate([f.points for f in feet]), np.concatenate([f.normals for f in feet]), BOTH)
    if both is None:
        return skin
    vertices = skin.vertices_m
    for foot in feet:
        own = registered(_near(foot), foot.points, foot.normals, Prior(mean=both, sigma=EACH * BOTH.sigma, size=EACH_SIZE))
        placed = foot.movable.at(both if own is None else own) - foot.movable.x
        vertices = vertices + (placed * foot.flip) @ foot.R.T
    return replace(skin, vertices_m=vertices)


def _nearest(shape: BodyShape, b: int, feet: list[int], frame: SurfacePoints) -> SurfacePoints:
    """The points of a frame that are nearer to bone b than to the other foot, which may stand beside it."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, frame.motion)
    distance = {}
    for foot in feet:
        X = (frame.xyz_m - head[foot]) @ R[foot]
        X[:, 1] -= np.clip(X[:, 1], 0.0, shape.lengths_m[foot])
        distance[foot] = np.linalg.norm(X, axis=1)
    own = np.all([distance[b] <= distance[foot] for foot in feet], axis=0)
    return replace(frame, xyz_m=frame.xyz_m[own], normals=frame.normals[own], sigma_m=frame.sigma_m[own])


def _foot(skin: OneSkin, shape: BodyShape, b: int, frames: Sequence[SurfacePoints]) -> _Foot:
    axes, heads = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    names, R, ankle = [bone.name for bone in shape.skeleton.bones], axes[b], heads[b]
    side = names[b][-2:]
    flip = MIRRORED if side == ".L" else np.ones(3)
    own = skin.weights[:, b] + skin.weights[:, [name == TOE + side for name in names]].sum(axis=1)
    local = (skin.vertices_m - ankle) @ R
    points, normals = points_about(shape, b, frames, local[own > OWN])
    share = Nearby(skin.vertices_m, skin.faces).mean(own[:, None])
    across = vertex_normals(skin.vertices_m, skin.faces) @ R
    compared = (own > OWN) & (np.linalg.norm(local, axis=1) > HEM * shape.lengths_m[b])
    movable = Movable(x=local * flip, across=across * flip, share=share, own=compared, middle=np.zeros(3))
    return _Foot(movable=movable, points=points * flip, normals=normals * flip, flip=flip, R=R)


def _near(foot: _Foot) -> Movable:
    own = foot.movable.x[foot.movable.own]
    return foot.movable.within(own.min(axis=0) - MARGIN_M, own.max(axis=0) + MARGIN_M)
