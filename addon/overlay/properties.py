"""What is shown over the footage: switches in the scene, all off at first."""

import bpy

from .canvas import redraw_clips


def _changed(_: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    redraw_clips(context)


def _switch(name: str, about: str) -> bpy.types.BoolProperty:
    return bpy.props.BoolProperty(name=name, description=about, update=_changed)


class TricapOverlay(bpy.types.PropertyGroup):
    """The switches."""

    points: _switch("Matched Points", "The measured points of this frame; the colour is their sigma")  # type: ignore[valid-type]
    most_sigma_mm: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Red from [mm]", description="The sigma that is painted red; 0: what 95 % of the frame's points stay below", min=0.0,
        soft_max=20.0, update=_changed)
    tracks: _switch("Trajectories", "Where the tracked points were in the last frames")  # type: ignore[valid-type]
    which: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Which", default="both", update=_changed, items=[
            ("before", "Before", "All trajectories, as they were before the filters"),
            ("kept", "After", "What the filters and your corrections left"),
            ("removed", "Gone", "Only what was taken out; Look Closer tells why"),
            ("both", "Both", "Kept ones in blue, removed ones in red")])
    tail: bpy.props.IntProperty(name="Tail", description="Frames", default=8, min=1, max=200, update=_changed)  # type: ignore[valid-type]
    contour: _switch("Contour", "The tracked outline of the person")  # type: ignore[valid-type]
    body: _switch("Fitted Body", "The outline of the fitted body's skin")  # type: ignore[valid-type]
    graph: _switch("Graph of Frames", "Residual and sigma of every frame; bad frames are red")  # type: ignore[valid-type]


CLASSES = (TricapOverlay,)
