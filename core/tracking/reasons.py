"""The colours of the reasons for which trajectories are removed, in the report and in Blender."""

from .settings import TrackStatus

REASON_COLOURS = {  # BGR by reason; the others are grey
    TrackStatus.NOT_FOUND: (60, 160, 250),
    TrackStatus.NOT_MATCHED: (60, 160, 250),
    TrackStatus.NOT_VERIFIED: (40, 220, 240),
    TrackStatus.RAYS_MISS: (40, 220, 240),
    TrackStatus.TOO_FAST: (70, 70, 240),
    TrackStatus.ACCELERATES: (70, 70, 240),
    TrackStatus.NOT_UNIFORM: (230, 110, 200),
    TrackStatus.NOT_RIGID: (230, 110, 200),
    TrackStatus.UNSUPPORTED: (230, 110, 200),
    TrackStatus.UNCERTAIN: (230, 160, 70),
}
COLOUR_WORDS = (
    "red too fast or accelerating, violet unlike its neighbours, blue uncertain, yellow not verified, orange not found, grey others"
)
