"""Settings of tracking, and what can become of a trajectory."""

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

from ..foundation.settings import knob

SCHEMES = ("space", "published")
UNIFORMITY = ("rigid", "voxels", "off")
AFTERWARDS = ("max_speed", "max_acceleration", "uniformity", "max_sigma_ratio", "min_length", "smooth_frames")  # knobs of the filters alone


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingSettings:
    """How points are followed from frame to frame, and which trajectories are kept."""

    scheme: str = knob(
        "space",
        "The step: predicted and controlled in space, or as published, each image for itself, without control of drift.",
        choices=SCHEMES,
    )
    prediction_acceleration: float = knob(
        30.0,
        "Scheme “published”: acceleration that the box about a predicted position allows for; the second try has twice the box.",
        unit="m/s²",
        low=0.0,
        high=1000.0,
    )
    spacing_px: int = knob(8, "Distance between tracked points in the reference image.", unit="px", low=1, high=64)
    box_px: int = knob(
        12,
        "Half size of the box searched where no motion is known, then twice as much; else two fifths, then all of it (one camera: twice).",
        unit="px",
        low=2,
        high=64,
    )
    min_correlation: float = knob(0.6, "Smallest correlation in the box.", low=0.0, high=0.99)
    max_residual_px: float = knob(
        0.7, "Largest distance by which rays may miss, or what the calibration of the take needs.", unit="px", low=0.05, high=10.0
    )
    drift_correlation: float = knob(
        0.8, "A point is held to the patch of its birth as long as they correlate by this much (1: never).", low=0.3, high=1.0
    )
    min_coverage: float = knob(
        0.6, "Smallest part of a tracked patch that lies on the measured surface; less is the outline of the body.", low=0.0, high=1.0
    )
    regenerate_every: int = knob(
        1, "Every so many frames, new points start where the surface has none (0: never).", unit="frames", low=0, high=1000
    )
    bridge_frames: int = knob(
        3, "So many frames may be missing or black before all trajectories end (0: none).", unit="frames", low=0, high=100
    )
    wait_frames: int = knob(
        5,
        "So many frames a lost point is looked for where its neighbours or its own motion take it (0: none).",
        unit="frames",
        low=0,
        high=100,
    )
    max_speed: float = knob(10.0, "Trajectories faster than this are cut.", unit="m/s", low=0.1, high=100.0)
    max_acceleration: float = knob(150.0, "Trajectories that accelerate more than this are cut.", unit="m/s²", low=1.0, high=10_000.0)
    uniformity: str = knob(
        "rigid",
        "What a trajectory's neighbours are asked: their rigid motion, their mean velocity in voxels as published, or nothing.",
        choices=UNIFORMITY,
    )
    neighbourhood_m: float = knob(0.1, "Radius of a point's neighbourhood, and side of a voxel.", unit="m", low=0.01, high=1.0)
    max_deviation_mm: float = knob(
        2.5, "Deviation from the neighbours' motion that is always allowed in one frame.", unit="mm", low=0.1, high=100.0
    )
    max_sigma_ratio: float = knob(2.5, "Largest sigma of a point, in units of the median over all points.", low=1.0, high=1000.0)
    min_length: int = knob(
        5, "Trajectories of fewer frames are removed, in a shorter recording those that do not last.", unit="frames", low=2, high=1000
    )
    smooth_frames: int = knob(
        7, "Frames over which smoothed velocities and accelerations are taken (odd; 0: as they are).", unit="frames", low=0, high=99
    )

    @property
    def of_the_step(self) -> "TrackingSettings":
        """The same but for the knobs that no step of the surface's points asks, which have their defaults: what a checkpoint depends on."""
        defaults: dict[str, Any] = {f.name: f.default for f in fields(self) if f.name in AFTERWARDS}
        return replace(self, **defaults)


@dataclass(frozen=True, kw_only=True, slots=True)
class KeyPointSettings:
    """How points that the user chose are tracked in space, besides the settings of tracking."""

    markers: bool = knob(
        False, "The chosen points are bright round markers; each click means the middle of the nearest one.", was=("tracking.markers",)
    )


class TrackStatus(IntEnum):
    """What became of a trajectory in a frame."""

    ABSENT = 0  # not born yet, or ended before
    MEASURED = 1
    LEFT_IMAGE = 2
    NOT_FOUND = 3  # no correlation in the box
    NOT_MATCHED = 4  # temporal matching failed its limits
    NOT_VERIFIED = 5  # spatial matching contradicts the temporal one
    RAYS_MISS = 6
    TOO_FAST = 7
    ACCELERATES = 8
    TOO_SHORT = 9
    AT_OUTLINE = 10  # the patch lies partly beyond the outline of the body
    OFF_SURFACE = 11  # the frame's own surface is elsewhere
    NOT_UNIFORM = 12  # its velocity is not that of its voxel
    NOT_RIGID = 13  # it leaves the rigid motion of its neighbours
    OTHER_PIECE = 14  # a frame of a trajectory that was cut; the other pieces stand in columns of their own
    UNSUPPORTED = 15  # it has no neighbours that could confirm it
    UNCERTAIN = 16  # its sigma is much larger than others'
    REMOVED_BY_USER = 17  # a correction of take.toml

    @property
    def words(self) -> str:
        """As a user reads it."""
        return self.name.lower().replace("_", " ")
