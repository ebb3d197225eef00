"""A rest pose that looks like a person, for sources whose zero pose does not.

Some files' zero pose is no pose at all: every bone lies along its own axis. What a part has turned since then says nothing about how it
lies in the body. Any frame of the motion serves as the rest pose as well, best one in which the person stands upright with straight limbs.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .mapping import RigMap
from .rig import Motion
from .roles import SIDES, sided
from .turns import unit

LIKE_A_PERSON = 0.5  # mean cosine of legs and trunk with the vertical, less for bent or crossed limbs
GOOD = 0.8


def person_like(place: Callable[[str], np.ndarray | None]) -> np.ndarray:
    """How much a pose (…) looks like a person who stands (1: upright, straight limbs, arms not crossed); `place` gives heads by role."""
    scores = []
    centre = _middle(place("thigh.L"), place("thigh.R"))
    chest = _middle(place("upper_arm.L"), place("upper_arm.R"))
    if centre is not None and chest is not None:
        scores.append(unit(chest - centre)[..., 2])
        left = unit(place("thigh.L") - place("thigh.R"))  # type: ignore[operator]
        scores.append(np.sum(left * unit(place("upper_arm.L") - place("upper_arm.R")), axis=-1))  # type: ignore[operator]
    for side in SIDES:
        a, b, c = (place(sided(part, side)) for part in ("thigh", "shin", "foot"))
        if a is not None and b is not None and c is not None:
            scores += [-unit(b - a)[..., 2], -unit(c - b)[..., 2]]
        a, b, c = (place(sided(part, side)) for part in ("upper_arm", "forearm", "hand"))
        if a is not None and b is not None and c is not None:
            scores.append(np.sum(unit(b - a) * unit(c - b), axis=-1))
    return np.mean(scores, axis=0) if scores else np.ones(1)


def _middle(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
    return None if a is None or b is None else (a + b) / 2


def with_person_like_rest(motion: Motion, rig_map: RigMap) -> tuple[Motion, str]:
    """The motion, with its most person-like frame as the rest pose if its own is not, and a note if so."""
    rig = motion.rig
    if "thigh.L" not in rig_map.bones or "thigh.R" not in rig_map.bones:
        return motion, ""

    def head(places: np.ndarray) -> Callable[[str], np.ndarray | None]:
        def place(role: str) -> np.ndarray | None:
            name = rig_map.first(role)
            return places[..., rig.index[name], :] if name else None

        return place

    if float(person_like(head(rig.head_m))) >= LIKE_A_PERSON:
        return motion, ""
    scores = person_like(head(motion.head_m))
    best = int(np.argmax(scores))
    along = np.einsum("bji,bj->bi", rig.R_rest, rig.tail_m - rig.head_m)
    posed = replace(
        rig, R_rest=motion.R[best], head_m=motion.head_m[best], tail_m=motion.head_m[best] + np.einsum("bij,bj->bi", motion.R[best], along)
    )
    note = f"the source's rest pose is no person's: frame {motion.frames[best]:g} was taken instead"
    return replace(motion, rig=posed), note if scores[best] >= GOOD else f"{note}, in which the limbs are bent; twists may be off"
