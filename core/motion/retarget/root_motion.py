"""Root motion for game engines: a bone on the ground that carries the body's path and heading; an engine moves its character by it.

root(t) = Rz(heading(t)), at the hips' place over the ground        heading: twist of the hips about the vertical since their rest pose
"""

from dataclasses import replace

import numpy as np

from ...geometry.rotation import about, transposed, twist_about
from .mapping import RigMap
from .rig import Motion, Rig

UP = np.array([0.0, 0.0, 1.0])
LENGTH = 0.1  # of the root bone, by the rig's height


def root_of(rig: Rig, rig_map: RigMap) -> str:
    """The bone that carries the whole body and is no part of it; "" if there is none."""
    hips = rig_map.first("hips")
    top = rig.names[rig.ancestors(rig.index[hips])[-1]] if hips is not None else ""
    return "" if top in {name for chain in rig_map.bones.values() for name in chain} else top


def with_root(motion: Motion, rig_map: RigMap, name: str) -> Motion:
    """The motion with a root bone `name` below the hips; unchanged if it has such a bone, or no hips with legs.

    The ground is where the lowest bone is in all frames. The bone points forward (−Y) in the rest pose.
    """
    hips = rig_map.first("hips")
    if hips is None or root_of(motion.rig, rig_map) or not {"thigh.L", "thigh.R"} <= set(rig_map.bones):
        return motion
    rig, h = motion.rig, motion.rig.index[hips]
    while name in rig.index:
        name = f"{name}_"
    ends_m = motion.head_m + np.linalg.norm(rig.tail_m - rig.head_m, axis=1)[:, None] * motion.R[..., 1]
    ground_m = float(min(motion.head_m[..., 2].min(), ends_m[..., 2].min()))
    rest_m = np.array([*rig.head_m[h, :2], min(rig.head_m[:, 2].min(), rig.tail_m[:, 2].min())])
    R_rest = about(UP, np.pi)
    heading = np.unwrap(twist_about(motion.R[:, h] @ transposed(rig.R_rest[h]), UP))
    path_m = np.concatenate([motion.head_m[:, h, :2], np.full((len(heading), 1), ground_m)], axis=1)
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
    R = np.concatenate([(about(UP, heading) @ R_rest)[:, None], motion.R], axis=1)
    return replace(motion, rig=extended, R=R, head_m=np.concatenate([path_m[:, None], motion.head_m], axis=1))
