"""The colours of the reasons for which trajectories are removed, in the report and in Blender."""

from .settings import TrackStatus

Colour = tuple[int, int, int]  # BGR
REASONS: tuple[tuple[str, Colour, str, tuple[TrackStatus, ...]], ...] = (  # name of the colour, colour, meaning, reasons
    ("red", (70, 70, 240), "too fast or accelerating", (TrackStatus.TOO_FAST, TrackStatus.ACCELERATES)),
    (
        "violet",
        (230, 110, 200),
        "unlike its neighbours",
        (TrackStatus.NOT_UNIFORM, TrackStatus.NOT_RIGID, TrackStatus.UNSUPPORTED),
    ),
    ("blue", (230, 160, 70), "uncertain", (TrackStatus.UNCERTAIN,)),
    ("yellow", (40, 220, 240), "not verified", (TrackStatus.NOT_VERIFIED, TrackStatus.RAYS_MISS)),
    ("orange", (60, 160, 250), "not found", (TrackStatus.NOT_FOUND, TrackStatus.NOT_MATCHED)),
)
OTHERS: Colour = (150, 150, 150)
REASON_COLOURS = {reason: colour for _, colour, _, reasons in REASONS for reason in reasons}  # the others are grey
COLOUR_WORDS = ", ".join([*(f"{name} {meaning}" for name, _, meaning, _ in REASONS), "grey others"])
MEANINGS = [*((colour, meaning) for _, colour, meaning, _ in REASONS), (OTHERS, "others")]
