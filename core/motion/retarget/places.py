"""Where the bones of a body are, whatever their parents in the rig: control rigs have parts that descend from nothing in the body."""

from dataclasses import dataclass, replace

import numpy as np

from .mapping import MappedRig, RigMap
from .rig import Motion, Rig, following
from .roles import SIDES, above, sided


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TargetPose:
    """The target in every frame, while its motion is made: rotations of its bones, and how far the body has been moved."""

    target: MappedRig
    R: np.ndarray  # (T, B, 3, 3) in the world
    driven: np.ndarray  # (B,) bones that follow the source; the others keep their rest pose relative to their parents
    carrier: int  # the bone whose location channels carry the body; −1 for none
    shift_m: np.ndarray  # (T, 3) of the carrier's head

    def turned(self, R: np.ndarray) -> "TargetPose":
        """The pose with other rotations of driven bones; the others follow their parents."""
        return replace(self, R=following(self.target.rig, R, self.driven))

    def moved(self, shift_m: np.ndarray) -> "TargetPose":
        """The pose with another shift of the carrier."""
        return replace(self, shift_m=shift_m)

    @property
    def head_m(self) -> np.ndarray:
        """Heads (T, B, 3) of all bones, loose parts where the body has them."""
        rig, head = self.target.rig, np.empty(self.R.shape[:3])
        for b, a in outwards(rig, self.target.map):
            if a >= 0:
                head[:, b] = head[:, a] + self.R[:, a] @ (rig.R_rest[a].T @ (rig.head_m[b] - rig.head_m[a]))
            else:
                head[:, b] = rig.head_m[b]
            if b == self.carrier:
                head[:, b] += self.shift_m
        return head

    @property
    def hips_m(self) -> np.ndarray:
        """The middle between the hip joints (T, 3)."""
        return hip_centre(
            Motion(rig=self.target.rig, fps=1.0, frames=np.arange(len(self.R)), R=self.R, head_m=self.head_m), self.target.map
        )


def loose_parts(target: Rig, target_map: RigMap) -> dict[int, int]:
    """Bones that do not descend from the part they belong to in a body (as in control rigs), by index, and that part's last bone: they
    must be carried along."""
    loose = {}
    for role, chain in target_map.bones.items():
        part = above(role, target_map.bones)
        line = [*(target_map.bones[part][-1:] if part else ()), *chain]
        for a, b in zip((target.index[name] for name in line), (target.index[name] for name in line[1:])):
            if a not in target.ancestors(b) and not target.connected[b]:
                loose[b] = a
    return loose


def outwards(rig: Rig, rig_map: RigMap) -> list[tuple[int, int]]:
    """Every bone with its parent in the body (−1: none), loose parts under the part they belong to, parents first."""
    loose, visited, order = loose_parts(rig, rig_map), set[int](), list[tuple[int, int]]()

    def visit(b: int) -> None:
        if b in visited:
            return
        visited.add(b)
        a = loose.get(b, int(rig.parents[b]))
        if a >= 0:
            visit(a)
        order.append((b, a))

    for b in range(len(rig.names)):
        visit(b)
    return order


def hip_centre(motion: Motion, rig_map: RigMap) -> np.ndarray:
    """The middle between the heads of the thighs (T, 3), or the head of the hips."""
    names = [rig_map.first(sided("thigh", side)) for side in SIDES]
    known = [motion.head_m[:, motion.rig.index[name]] for name in names if name]
    return np.mean(known, axis=0) if len(known) == 2 else motion.head_m[:, motion.rig.index[rig_map.bones["hips"][0]]]
