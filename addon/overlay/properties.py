"""What is drawn over the footage: switches in the scene, all off by default."""

import bpy

from ...core.surface.cloud import FILTERS
from ...core.tracking.settings import TrackStatus
from .canvas import redraw_clips
from .layers import ALL


def _changed(_: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    redraw_clips(context)


STAGES_SHOWN = [
    ("before", "Before", "Everything, as it was before filtering"),
    ("kept", "After", "What is left after the filters and your corrections"),
    ("removed", "Removed", "Only what was removed; Inspect Points shows why"),
    ("both", "Both", "What is left, and in red what was removed"),
]
SURFACE_FILTERS = [(ALL, "All Filters", ""), *((str(n), words.capitalize(), "") for n, words in enumerate(FILTERS, 1))]
TRACK_FILTERS = [(ALL, "All Filters", ""), *((s.name, s.words.capitalize(), "") for s in TrackStatus if s > TrackStatus.MEASURED)]


def _switch(name: str, about: str) -> bpy.types.BoolProperty:
    return bpy.props.BoolProperty(name=name, description=about, update=_changed)


class TricapOverlay(bpy.types.PropertyGroup):
    """The switches."""

    points: _switch("Matched Points", "The measured points of this frame, coloured by sigma")  # type: ignore[valid-type]
    most_sigma_mm: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Red from [mm]",
        description="The sigma that is painted red; 0: the 95th percentile of the frame",
        min=0.0,
        soft_max=20.0,
        update=_changed,
    )
    which_points: bpy.props.EnumProperty(name="Which Points", default="kept", update=_changed, items=STAGES_SHOWN)  # type: ignore[valid-type]
    point_filter: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Filter", items=SURFACE_FILTERS, update=_changed, description="Show the effect of this surface filter alone, or of all"
    )
    tracks: _switch("Trajectories", "The paths of the tracked points in the last frames")  # type: ignore[valid-type]
    which: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Which", default="both", update=_changed, items=STAGES_SHOWN
    )
    track_filter: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Filter", items=TRACK_FILTERS, update=_changed, description="Show the effect of this track filter alone, or of all"
    )
    tail: bpy.props.IntProperty(name="Tail", description="Length of the paths in frames", default=8, min=1, max=200, update=_changed)  # type: ignore[valid-type]
    contour: _switch("Outline", "The tracked outline of the person")  # type: ignore[valid-type]
    body: _switch("Fitted Body", "The outline of the fitted body's skin")  # type: ignore[valid-type]
    chosen: _switch("Followed Points", "The paths of the points that were clicked and followed")  # type: ignore[valid-type]
    graph: _switch("Quality Graph", "Residuals and sigmas of all frames; doubtful frames are red")  # type: ignore[valid-type]


CLASSES = (TricapOverlay,)
