"""A hand with its fingers, for searches: the hand of a fitted body is flat, ends at the knuckles, and does not show where its thumb is.

Capsules in the axes of the hand's bone, as in `body.skin.hand_template`: three along the palm, one for each finger and one for the thumb.
"""

from functools import lru_cache

import numpy as np

from ..body.skin.hand_template import FINGERS, THUMB, UNIT_MM, finger_frames

HAND = "hand"
PALM = ((0.20, 0.265, 0.155), (0.0, -0.06, 0.165), (-0.18, -0.375, 0.150))  # x at the wrist, x at the knuckles, half thickness
REACH = 2.2  # lengths of the bone, from the wrist to beyond the fingers


def is_hand(name: str) -> bool:
    """Whether a bone of this name is a left or right hand."""
    return name in (f"{HAND}.L", f"{HAND}.R")


@lru_cache(maxsize=2)
def hand_capsules(left: bool) -> tuple[np.ndarray, np.ndarray]:
    """The ends (K, 2, 3) and the radii (K, 2) of a hand's capsules, in lengths of its bone."""
    ends, radii = [], []
    for at_wrist, at_knuckles, half in PALM:
        ends.append([(at_wrist, 0.15, 0.0), (at_knuckles, 0.95, 0.0)])
        radii.append((half, 0.9 * half))
    for finger in (*FINGERS, THUMB):
        joints = finger_frames(finger).joints
        ends.append([tuple(joints[0]), tuple(joints[-1])])
        radii.append((finger.radii_mm[0] / UNIT_MM, finger.radii_mm[-1] / UNIT_MM))
    side = np.array([-1.0 if left else 1.0, 1.0, 1.0])
    return np.array(ends) * side, np.array(radii)


def thumb_side(left: bool) -> np.ndarray:
    """A place (3,) beside the palm, where the thumb's joint is, in lengths of the bone: it shows how a hand is turned about itself."""
    return np.array([-0.6 if left else 0.6, 0.6, 0.0])
