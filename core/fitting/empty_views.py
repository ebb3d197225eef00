"""Where the views show the background, frame by frame, as observations of a body: no limb is there.

Only limbs whose posture must be seen; and of a hand, which the model believes to be straight, the middle, less exactly: the tip of one that
is bent would pull its forearm.
"""

from collections.abc import Sequence
from copy import copy

import numpy as np

from .fit_input import FitInput
from .observations import EmptySpace
from .observations.empty_space import Distances
from .settings import FitSettings
from .state import ShapeParameters, free_bones

ALONG = (0.2, 0.5, 0.8, 1.0)  # where on a bone's axis
MIDDLE, BENT = 0.5, 3.0  # where on a hand's, and how many of the outline's sigmas it may be wrong


class EmptyViews:
    """The views' empty parts in all frames."""

    def __init__(self, given: FitInput, parameters: ShapeParameters, settings: FitSettings) -> None:
        skeleton = parameters.skeleton
        names = {joint: i for i, joint in enumerate(skeleton.joint_names)}
        free = free_bones(parameters)
        ends = ~free & free[skeleton.parents] & ~np.isin(np.arange(len(free)), skeleton.parents)
        places = [(bone, along, 1.0) for bone, seen in zip(skeleton.bones, free) if seen for along in ALONG]
        places += [(bone, MIDDLE, BENT) for bone, last in zip(skeleton.bones, ends) if last and bone.dofs]
        self._head = np.array([names[bone.head_joint] for bone, _, _ in places], dtype=np.intp)
        self._tail = np.array([names[bone.tail_joint] for bone, _, _ in places], dtype=np.intp)
        self._fraction = np.array([along for _, along, _ in places])
        self._sigma_px = settings.empty_sigma_px * np.array([wider for _, _, wider in places])
        self._given = given.empty if settings.use_background else ()
        self._rig, self._frames = given.rig, given.frames

    def stretch(self, frames: Sequence[int]) -> "EmptyViews":
        """Those of some of the frames."""
        part = copy(self)
        part._frames = [self._frames[t] for t in frames]
        return part

    def observe(self, t: int) -> list[EmptySpace]:
        """What is empty in frame index `t`; nothing where that is not known."""
        views = [
            Distances(camera=self._rig[v.view], values_px=d * v.unit_px, step_px=v.step_px, first_px=(v.step_px - 1) / 2)
            for v in self._given
            if (d := v.of_frame(self._frames[t])) is not None
        ]
        if not views:
            return []
        return [EmptySpace(views=views, head=self._head, tail=self._tail, fraction=self._fraction, sigma_px=self._sigma_px)]
