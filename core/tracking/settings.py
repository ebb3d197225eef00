"""Settings of tracking, and the status of a trajectory in a frame."""

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

from ..foundation.settings import knob

SCHEMES = ("space", "published")
UNIFORMITY = ("rigid", "voxels", "off")
FILTER_KNOBS = (
    "max_speed",
    "max_acceleration",
    "uniformity",
    "max_sigma_ratio",
    "min_length",
    "smooth_frames",
)  # read only by filters


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingSettings:
    """How points are tracked from frame to frame, and which trajectories pass the filters."""

    scheme: str = knob(
        "space",
        "The tracking step: in space with drift control, or as published, with a prediction in each image and without drift control.",
        choices=SCHEMES,
    )
    prediction_acceleration: float = knob(
        30.0,
        "Scheme “published”: acceleration that the search box allows for; the second attempt has a box twice as large.",
        unit="m/s²",
        low=0.0,
        high=1000.0,
    )
    spacing_px: int = knob(8, "Distance between tracked points in the reference view.", unit="px", low=1, high=64)
    box_px: int = knob(
        12,
        "Half size of the search box of a new point, then doubled; with a predicted motion 0.4 of it, then all of it (2-D mode: twice).",
        unit="px",
        low=2,
        high=64,
    )
    min_correlation: float = knob(0.6, "Smallest correlation in the search box.", low=0.0, high=0.99)
    max_residual_px: float = knob(
        0.7, "Largest RMS residual of a point's rays; raised where the rig's calibration is less precise.", unit="px", low=0.05, high=10.0
    )
    drift_correlation: float = knob(
        0.8, "Smallest correlation with a point's key template, to which its drift is controlled (1: no control).", low=0.3, high=1.0
    )
    min_coverage: float = knob(
        0.6, "Smallest part of a tracked patch on the measured surface; patches with less lie at the body's outline.", low=0.0, high=1.0
    )
    regenerate_every: int = knob(
        1, "Interval at which new points start where the surface has none (0: never).", unit="frames", low=0, high=1000
    )
    bridge_frames: int = knob(
        3, "Longest run of missing or black frames that trajectories bridge (0: none).", unit="frames", low=0, high=100
    )
    wait_frames: int = knob(
        5,
        "Frames in which a lost point is searched for, where its neighbours or its own motion predict it (0: none).",
        unit="frames",
        low=0,
        high=100,
    )
    max_speed: float = knob(10.0, "Trajectories are cut where they are faster than this.", unit="m/s", low=0.1, high=100.0)
    max_acceleration: float = knob(150.0, "Trajectories are cut where they accelerate more than this.", unit="m/s²", low=1.0, high=10_000.0)
    uniformity: str = knob(
        "rigid",
        "Test against neighbours: their rigid motion, their median velocity in voxels as published, or none.",
        choices=UNIFORMITY,
    )
    neighbourhood_m: float = knob(0.1, "Radius of a point's neighbourhood, and edge length of a voxel.", unit="m", low=0.01, high=1.0)
    max_deviation_mm: float = knob(
        2.5, "Deviation from the neighbours' motion that is always accepted in one frame.", unit="mm", low=0.1, high=100.0
    )
    max_sigma_ratio: float = knob(2.5, "Largest sigma of a point, relative to the median of all points.", low=1.0, high=1000.0)
    min_length: int = knob(
        5, "Shorter trajectories are removed; in a shorter recording, those that do not span it.", unit="frames", low=2, high=1000
    )
    smooth_frames: int = knob(
        7, "Frames over which velocities and accelerations are smoothed (odd; 0: not smoothed).", unit="frames", low=0, high=99
    )

    @property
    def of_the_step(self) -> "TrackingSettings":
        """The settings that a checkpoint depends on: these, with the defaults of the knobs that only the filters read."""
        defaults: dict[str, Any] = {f.name: f.default for f in fields(self) if f.name in FILTER_KNOBS}
        return replace(self, **defaults)


@dataclass(frozen=True, kw_only=True, slots=True)
class KeyPointSettings:
    """How chosen points are tracked in space, in addition to the settings of tracking."""

    markers: bool = knob(
        False, "The chosen points are bright round markers; each click means the middle of the nearest one.", was=("tracking.markers",)
    )


class TrackStatus(IntEnum):
    """The status of a trajectory in a frame."""

    ABSENT = 0  # before its first frame or after its last
    MEASURED = 1
    LEFT_IMAGE = 2
    NOT_FOUND = 3  # too little correlation in the search box
    NOT_MATCHED = 4  # temporal matching exceeded its limits
    NOT_VERIFIED = 5  # spatial matching contradicts the temporal one
    RAYS_MISS = 6
    TOO_FAST = 7
    ACCELERATES = 8
    TOO_SHORT = 9
    AT_OUTLINE = 10  # the patch lies partly beyond the outline of the body
    OFF_SURFACE = 11  # the frame's measured surface has another depth
    NOT_UNIFORM = 12  # its velocity differs from that of its voxel
    NOT_RIGID = 13  # it deviates from the rigid motion of its neighbours
    OTHER_PIECE = 14  # a frame of a cut trajectory whose pieces have separate columns
    UNSUPPORTED = 15  # it has no neighbours to confirm it
    UNCERTAIN = 16  # its sigma is much larger than that of others
    REMOVED_BY_USER = 17  # a correction of take.toml

    @property
    def words(self) -> str:
        """The name as users read it."""
        return self.name.lower().replace("_", " ")
