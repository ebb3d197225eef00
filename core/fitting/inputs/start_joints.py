"""The joints at which a fit begins that was not clicked, and how sure they are."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False, kw_only=True)
class StartJoints:
    """The joints of the person in one frame. `rivals`: other explanations of what is seen there, with their probabilities."""

    frame: int  # the take's number
    xyz_m: Mapping[str, np.ndarray]  # (3,) by joint
    stature: float  # over the model's
    model: str  # of the body that was looked for
    probability: float
    rivals: Mapping[str, float]
    ask: str  # the joint whose click would decide
    sigma_m: float = 0.03  # of a joint, if the explanation is right

    @property
    def question(self) -> str:
        """What is uncertain and which click decides, as sentences."""
        doubts = [name for name, _ in sorted(self.rivals.items(), key=lambda rival: -rival[1])]
        side = {"L": "left ", "R": "right "}.get(self.ask[-1], "") if "." in self.ask else ""
        return (
            f"It is not certain how the person stands in frame {self.frame} ({self.probability:.0%}): {' or '.join(doubts[:2])}. "
            f"Click the {side}{self.ask.partition('.')[0]} in two views of frame {self.frame}, and run it again."
        )
