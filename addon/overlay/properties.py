"""What is shown over the footage: switches in the scene, all off at first."""

import bpy

from ...core.surface.cloud import FILTERS
from ...core.tracking.settings import TrackStatus
from .canvas import redraw_clips
from .layers import ALL


def _changed(_: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    redraw_clips(context)


WHICH = [
    ("before", "Before", "All, as they were before the filters"),
    ("kept", "After", "What the filters and your corrections left"),
    ("removed", "Gone", "Only what was taken out; Look Closer tells why"),
    ("both", "Both", "What was kept, and in red what went"),
]
SURFACE_FILTERS = [(ALL, "All Filters", ""), *((str(n), words.capitalize(), "") for n, words in enumerate(FILTERS, 1))]
TRACK_FILTERS = [(ALL, "All Filters", ""), *((s.name, s.words.capitalize(), "") for s in TrackStatus if s > TrackStatus.MEASURED)]


def _switch(name: str, about: str) -> bpy.types.BoolProperty:
    return bpy.props.BoolProperty(name=name, description=about, update=_changed)


class TricapOverlay(bpy.types.PropertyGroup):
    """The switches."""

    points: _switch("Matched Points", "The measured points of this frame; the colour is their sigma")  # type: ignore[valid-type]
    most_sigma_mm: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Red from [mm]",
        description="The sigma that is painted red; 0: what 95 % of the frame's points stay below",
        min=0.0,
        soft_max=20.0,
        update=_changed,
    )
    which_points: bpy.props.EnumProperty(name="Which Points", default="kept", update=_changed, items=WHICH)  # type: ignore[valid-type]
    point_filter: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Filter", items=SURFACE_FILTERS, update=_changed, description="Before and after this filter of the surface alone, or all"
    )
    tracks: _switch("Trajectories", "Where the tracked points were in the last frames")  # type: ignore[valid-type]
    which: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Which", default="both", update=_changed, items=WHICH
    )
    track_filter: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Filter", items=TRACK_FILTERS, update=_changed, description="Before and after this filter of the tracks alone, or all"
    )
    tail: bpy.props.IntProperty(name="Tail", description="Frames", default=8, min=1, max=200, update=_changed)  # type: ignore[valid-type]
    contour: _switch("Contour", "The tracked outline of the person")  # type: ignore[valid-type]
    body: _switch("Fitted Body", "The outline of the fitted body's skin")  # type: ignore[valid-type]
    graph: _switch("Graph of Frames", "Residual and sigma of every frame; bad frames are red")  # type: ignore[valid-type]


CLASSES = (TricapOverlay,)
