"""The bones of fingers and toes in a measured motion, which has none: for the skin, which bends with them."""

from dataclasses import replace

import numpy as np

from ..body.shape import BodyShape
from ..body.skeleton import bone_frames
from ..body.skin.fingers import FINGER_BONE
from .retarget.rig import Motion


def with_digits(motion: Motion, shape: BodyShape) -> Motion:
    """The motion of a body's bones, with those of the fingers and toes that its `shape` for the skin has, each fixed to its parent."""
    skeleton, rig = shape.skeleton, motion.rig
    row = {bone.name: b for b, bone in enumerate(skeleton.bones)}
    R_rest, head = bone_frames(skeleton, shape.lengths_m, np.zeros(len(skeleton.dof_names)))
    index = dict(rig.index)
    added = [b for b, bone in enumerate(skeleton.bones) if FINGER_BONE.fullmatch(bone.name) and bone.name not in index]
    parents, R, heads = rig.parents.tolist(), list(np.moveaxis(motion.R, 1, 0)), list(np.moveaxis(motion.head_m, 1, 0))
    for b in added:
        parent = str(skeleton.bones[b].parent)
        while parent not in index:  # a connection without flesh
            parent = str(skeleton.bones[row[parent]].parent)
        p, own = index[parent], row[parent]
        turned = R[p] @ R_rest[own].T
        index[skeleton.bones[b].name] = len(R)
        parents.append(p)
        R.append(turned @ R_rest[b])
        heads.append(heads[p] + turned @ (head[b] - head[own]))
    n = len(added)
    wider = replace(
        rig,
        names=tuple(index),
        parents=np.array(parents),
        R_rest=np.concatenate([rig.R_rest, R_rest[added]]),
        head_m=np.concatenate([rig.head_m, head[added]]),
        tail_m=np.concatenate([rig.tail_m, head[added] + shape.lengths_m[added, None] * R_rest[added][..., 1]]),
        connected=np.concatenate([rig.connected, skeleton.starts_at_tail[added]]),
        inherits_rotation=np.concatenate([rig.inherits_rotation, np.ones(n, dtype=bool)]),
    )
    return replace(motion, rig=wider, R=np.stack(R, axis=1), head_m=np.stack(heads, axis=1))
