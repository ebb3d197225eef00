"""The height of the floor under a measured person, found from the feet while they stand. World: Z up; the floor is level."""

import numpy as np

from ..body.shape import BodyShape
from .retarget.contacts import FeetSettings, find_contacts, leg_length
from .retarget.mapping import find_map
from .retarget.rig import Motion
from .sources import body_motion


def floor_height(shape: BodyShape, values: np.ndarray, frames: np.ndarray, fps: float, sole_m: float) -> float | None:
    """The floor's z [m] of a body whose DOFs are `values` (T, D) [rad, m] at `frames` (T,); NaN rows have no pose.

    `sole_m`: how far the sole lies below the ankles while the body stands in its rest pose. The ankles' level is that of their contacts
    with the floor. None if the body has no legs, or no frame has a pose.
    """
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return None
    motion = body_motion(shape, values[known], frames[known], fps)
    legs = [side for side in "LR" if {f"thigh.{side}", f"shin.{side}", f"foot.{side}"} <= set(motion.rig.names)]
    if not legs:
        return None
    contacts = find_contacts(motion, find_map(motion.rig), FeetSettings(), _leg_m(motion, legs[0]))
    return None if contacts is None else contacts.ankle_level_m - sole_m


def _leg_m(motion: Motion, side: str) -> float:
    rig = motion.rig
    return leg_length({part: rig.head_m[rig.index[f"{part}.{side}"]] for part in ("thigh", "shin", "foot")})
