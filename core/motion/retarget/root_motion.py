"""Root motion for game engines: a bone on the ground that carries the body's path and heading; an engine moves its character by it.

root(t) = Rz(heading(t)), at the hips' place over the ground        heading: twist of the hips about the vertical since their rest pose

A root bone of the rig's own keeps what was animated: one that travels keeps its path, one that turns its rotation. It gets what it lacks,
as the root of Tricap's own body, which travels but does not turn. The motion of all other bones in the world stays as it is.
"""

from dataclasses import replace

import numpy as np

from ...geometry.rotation import about, transposed, twist_about
from .mapping import RigMap
from .rig import Motion, Rig

UP = np.array([0.0, 0.0, 1.0])
LENGTH = 0.1  # of the root bone, by the rig's height
TURNS_RAD, TRAVELS = 2e-3, 1e-3  # rotation, and path by the rig's height, from which a rig's own root is animated
UPSIDE_DOWN = 0.07  # (1 + cos φ) / 2 with φ = 150°: hips that are tilted by more have no certain heading


def root_of(rig: Rig, rig_map: RigMap) -> str:
    """The bone that carries the whole body and is no part of it; "" if there is none."""
    hips = rig_map.first("hips")
    top = rig.names[rig.ancestors(rig.index[hips])[-1]] if hips is not None else ""
    return "" if top in {name for chain in rig_map.bones.values() for name in chain} else top


def with_root(motion: Motion, rig_map: RigMap, name: str) -> Motion:
    """The motion with a root bone that carries path and heading: the rig's own, else a new one, `name`, below the hips. It is unchanged if
    the rig's own root travels and turns, or if there are no hips with legs.

    The ground is where the lowest bone is in all frames. A new bone points forward (−Y) in the rest pose.
    """
    hips = rig_map.first("hips")
    if hips is None or not {"thigh.L", "thigh.R"} <= set(rig_map.bones):
        return motion
    own = root_of(motion.rig, rig_map)
    return _completed(motion, own, hips) if own else _extended(motion, hips, name)


def heading(motion: Motion, hips: str) -> np.ndarray:
    """The heading (T,) [rad] of the hips without jumps. While they are upside down, it is interpolated."""
    h = motion.rig.index[hips]
    since_rest = motion.R[:, h] @ transposed(motion.rig.R_rest[h])
    angle = twist_about(since_rest, UP)
    certain = np.flatnonzero(0.5 * (1.0 + since_rest[:, 2, 2]) > UPSIDE_DOWN)
    if not len(certain):
        return np.unwrap(angle)
    return np.interp(np.arange(len(angle)), certain, np.unwrap(angle[certain]))


def _completed(motion: Motion, own: str, hips: str) -> Motion:
    """The motion with what the rig's own root lacks of path and heading."""
    rig, root, h = motion.rig, motion.rig.index[own], motion.rig.index[hips]
    turns = np.ptp(motion.R[:, root], axis=0).max() > TURNS_RAD
    travels = np.ptp(motion.head_m[:, root, :2], axis=0).max() > TRAVELS * rig.height_m
    R, head_m = motion.R.copy(), motion.head_m.copy()
    if not turns:
        R[:, root] = about(UP, heading(motion, hips)) @ rig.R_rest[root]
    if not travels:
        from_root = (R[:, root] @ rig.R_rest[root].T) @ (rig.head_m[h] - rig.head_m[root])
        head_m[:, root, :2] = motion.head_m[:, h, :2] - from_root[:, :2]
    return motion if turns and travels else replace(motion, R=R, head_m=head_m)


def _extended(motion: Motion, hips: str, name: str) -> Motion:
    """The motion with a new bone under all others."""
    rig, h = motion.rig, motion.rig.index[hips]
    while name in rig.index:
        name = f"{name}_"
    ends_m = motion.head_m + np.linalg.norm(rig.tail_m - rig.head_m, axis=1)[:, None] * motion.R[..., 1]
    ground_m = float(min(motion.head_m[..., 2].min(), ends_m[..., 2].min()))
    rest_m = np.array([*rig.head_m[h, :2], min(rig.head_m[:, 2].min(), rig.tail_m[:, 2].min())])
    R_rest = about(UP, np.pi)
    path_m = np.concatenate([motion.head_m[:, h, :2], np.full((len(motion.frames), 1), ground_m)], axis=1)
    extended = replace(
        rig,
        names=(name, *rig.names),
        parents=np.concatenate([[-1], np.where(rig.parents < 0, 0, rig.parents + 1)]),
        R_rest=np.concatenate([R_rest[None], rig.R_rest]),
        head_m=np.concatenate([rest_m[None], rig.head_m]),
        tail_m=np.concatenate([rest_m[None] + LENGTH * rig.height_m * R_rest[:, 1], rig.tail_m]),
        connected=np.concatenate([[False], rig.connected & (rig.parents >= 0)]),
        inherits_rotation=np.concatenate([[True], rig.inherits_rotation]),
    )
    R = np.concatenate([(about(UP, heading(motion, hips)) @ R_rest)[:, None], motion.R], axis=1)
    return replace(motion, rig=extended, R=R, head_m=np.concatenate([path_m[:, None], motion.head_m], axis=1))
