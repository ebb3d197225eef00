"""Where the bones of a body are, whatever they hang on."""

import numpy as np

from .mapping import RigMap
from .rig import Motion, Rig
from .roles import SIDES, above, sided


def loose_parts(target: Rig, target_map: RigMap) -> dict[int, int]:
    """Bones that do not hang on what they belong to in a body (as in control rigs), by index, and what that is: they must be carried."""
    loose = {}
    for role, chain in target_map.bones.items():
        part = above(role, target_map.bones)
        line = [*(target_map.bones[part][-1:] if part else ()), *chain]
        for a, b in zip((target.index[name] for name in line), (target.index[name] for name in line[1:])):
            if a not in target.ancestors(b) and not target.connected[b]:
                loose[b] = a
    return loose


def outwards(rig: Rig, rig_map: RigMap) -> list[tuple[int, int]]:
    """Every bone and what it hangs on (−1: nothing), loose parts on what they belong to, each after what it hangs on."""
    loose, seen, order = loose_parts(rig, rig_map), set[int](), list[tuple[int, int]]()

    def visit(b: int) -> None:
        if b in seen:
            return
        seen.add(b)
        a = loose.get(b, int(rig.parents[b]))
        if a >= 0:
            visit(a)
        order.append((b, a))

    for b in range(len(rig.names)):
        visit(b)
    return order


def heads_of(target: Rig, R: np.ndarray, carrier: int, shift: np.ndarray, target_map: RigMap) -> np.ndarray:
    """Heads (T, B, 3) of all bones, loose parts where the body has them."""
    head = np.empty(R.shape[:3])
    for b, a in outwards(target, target_map):
        if a >= 0:
            head[:, b] = head[:, a] + R[:, a] @ (target.R_rest[a].T @ (target.head_m[b] - target.head_m[a]))
        else:
            head[:, b] = target.head_m[b]
        if b == carrier:
            head[:, b] += shift
    return head


def hip_centre(motion: Motion, rig_map: RigMap) -> np.ndarray:
    """Between the heads of the thighs (T, 3), or the head of the hips."""
    names = [rig_map.first(sided("thigh", side)) for side in SIDES]
    known = [motion.head_m[:, motion.rig.index[name]] for name in names if name]
    return np.mean(known, axis=0) if len(known) == 2 else motion.head_m[:, motion.rig.index[rig_map.bones["hips"][0]]]
