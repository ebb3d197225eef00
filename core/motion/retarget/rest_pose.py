"""Poses: a person-like rest pose of the source, and the target's pose while its motion is computed.

In some files the zero pose is arbitrary: every bone lies along its own axis. Rotations since that pose do not show how a part lies in the
body. Any frame of the motion can serve as the rest pose instead; the best is one in which the person stands upright with straight limbs.

A target's bones are where the body has them, whatever their parents in the rig: control rigs have parts that descend from none of the body.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...geometry.rotation import unit
from .mapping import MappedMotion, MappedRig, RigMap
from .rig import Motion, Rig, following
from .roles import SIDES, above, sided

LIKE_A_PERSON = 0.5  # mean cosine of legs and trunk with the vertical; bent or crossed limbs lower it
GOOD = 0.8  # the same; below it the limbs of the chosen frame are bent


def person_like(head: Callable[[str], np.ndarray | None]) -> np.ndarray:
    """How much a pose (…) looks like a person who stands (1: upright, straight limbs, arms not crossed); `head` gives heads by role."""
    scores = []
    centre = _middle(head("thigh.L"), head("thigh.R"))
    chest = _middle(head("upper_arm.L"), head("upper_arm.R"))
    if centre is not None and chest is not None:
        scores.append(unit(chest - centre)[..., 2])
        left = unit(head("thigh.L") - head("thigh.R"))  # type: ignore[operator]
        scores.append(np.sum(left * unit(head("upper_arm.L") - head("upper_arm.R")), axis=-1))  # type: ignore[operator]
    for side in SIDES:
        a, b, c = (head(sided(part, side)) for part in ("thigh", "shin", "foot"))
        if a is not None and b is not None and c is not None:
            scores += [-unit(b - a)[..., 2], -unit(c - b)[..., 2]]
        a, b, c = (head(sided(part, side)) for part in ("upper_arm", "forearm", "hand"))
        if a is not None and b is not None and c is not None:
            scores.append(np.sum(unit(b - a) * unit(c - b), axis=-1))
    return np.mean(scores, axis=0) if scores else np.ones(1)


def _middle(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
    return None if a is None or b is None else (a + b) / 2


def with_person_like_rest(source: MappedMotion) -> tuple[MappedMotion, str]:
    """The motion with its most person-like frame as the rest pose if its own is not person-like, and a note if so."""
    motion, rig = source.motion, source.rig
    if "thigh.L" not in source.map.bones or "thigh.R" not in source.map.bones:
        return source, ""

    def heads(head_m: np.ndarray) -> Callable[[str], np.ndarray | None]:
        def of_role(role: str) -> np.ndarray | None:
            name = source.map.first(role)
            return head_m[..., rig.index[name], :] if name else None

        return of_role

    if float(person_like(heads(rig.head_m))) >= LIKE_A_PERSON:
        return source, ""
    scores = person_like(heads(motion.head_m))
    best = int(np.argmax(scores))
    along = np.einsum("bji,bj->bi", rig.R_rest, rig.tail_m - rig.head_m)
    posed = replace(
        rig, R_rest=motion.R[best], head_m=motion.head_m[best], tail_m=motion.head_m[best] + np.einsum("bij,bj->bi", motion.R[best], along)
    )
    note = f"the source's rest pose is not a person's: frame {motion.frames[best]:g} was used instead"
    changed = MappedMotion(motion=replace(motion, rig=posed), map=source.map)
    return changed, note if scores[best] >= GOOD else f"{note}, in which the limbs are bent; twists may be off"


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
