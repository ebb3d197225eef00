"""A person-like rest pose, for sources whose zero pose is not one.

In some files the zero pose is arbitrary: every bone lies along its own axis. Rotations since that pose do not show how a part lies in the
body. Any frame of the motion can serve as the rest pose instead; the best is one in which the person stands upright with straight limbs.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .mapping import MappedMotion
from .roles import SIDES, sided
from .turns import unit

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
