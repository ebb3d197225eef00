"""The joints at which a fit begins that was not clicked, and how sure they are."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ...foundation.errors import InputError

UNTRIED = "whether another pose fits better"  # a rival without a pose
SIGMA_M = 0.05  # of a joint, in a coordinate
SIGMAS_M = {"elbow": 0.06, "wrist": 0.11, "knuckles": 0.11}  # of those that one frame hardly shows where an arm lies on the body


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
    unsure: tuple[str, ...] = ()  # joints of arms that this frame does not show: the others decide where they are
    rival_m: Mapping[str, np.ndarray] = field(default_factory=dict)  # (3,) by joint, of the likeliest other explanation, where there is one

    @staticmethod
    def sigma_m(joint: str) -> float:
        """The standard deviation [m] of a joint's coordinate: measured in 18 frames of nine takes with known truth; knuckles as wrists."""
        return SIGMAS_M.get(joint.partition(".")[0], SIGMA_M)

    @property
    def question(self) -> str:
        """What is uncertain and which click decides, as sentences."""
        doubts = sorted(self.rivals, key=lambda name: (name == UNTRIED, -self.rivals[name]))
        doubt = f": {' or '.join(doubts[:2])}" if doubts else ""
        side = {"L": "left ", "R": "right "}.get(self.ask[-1], "") if "." in self.ask else ""
        return (
            f"It is not certain how the person stands in frame {self.frame} ({self.probability:.0%}){doubt}. "
            f"Click the {side}{self.ask.partition('.')[0]} in two views of frame {self.frame}, or three of neck, shoulders, pelvis and "
            "hips, which always suffice; then run it again. After one click it may ask for another."
        )


class NeedsClick(InputError):
    """It is not certain how the person stands; the sentence asks for the click that decides: of this joint in this frame."""

    def __init__(self, start: StartJoints, note: str = "") -> None:
        super().__init__(f"{start.question} {note}".rstrip())
        self.start, self.frame, self.joint = start, start.frame, start.ask
