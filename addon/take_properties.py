"""What the scene keeps of a take besides its clips and clicks: the views in their order, and what take.toml says of the whole recording."""

from typing import Any

import bpy

from ..core.images.interlace import BOTH, INTERLACE
from .scene.clips import frames_per_image
from .session import get_session

MODELS = (
    ("none", "No Body", "Clouds and trajectories only"),
    ("full", "Whole Body", "All limbs"),
    ("upper_body", "Upper Body", "From the pelvis up, both arms"),
    ("arm.R", "Right Arm", "Shoulder, elbow, wrist"),
    ("arm.L", "Left Arm", "Shoulder, elbow, wrist"),
    ("leg.R", "Right Leg", "Hip, knee, ankle"),
    ("leg.L", "Left Leg", "Hip, knee, ankle"),
    ("own", "Own Model", "A .toml model in the project's folder"),
)
LINES = {
    "none": ("Progressive", "Every image is whole"),
    "odd": ("Odd Lines", "Interlaced video: keep lines 1, 3, 5 …"),
    "even": ("Even Lines", "Interlaced video: keep lines 2, 4, 6 …"),
    "both": ("Both Fields", "Interlaced video: odd and even lines are two instants, twice as many frames a second"),
}
FIELDS = (
    ("odd", "Odd Lines First", "Lines 1, 3, 5 … were exposed first"),
    ("even", "Even Lines First", "Lines 2, 4, 6 … were exposed first"),
)


def tell_touched(_: Any, __: Any) -> None:
    """Somebody changed a value; Blender does not tell of changes by scripts otherwise."""
    for listener in get_session().on_value_change:
        listener()


def _renamed(view: Any, _: bpy.types.Context) -> None:
    if view.clip is not None:
        view.clip["tricap_view"] = view.name
    tell_touched(view, _)


def _shifted(view: Any, _: bpy.types.Context) -> None:
    if view.clip is not None:
        view.clip.frame_start = -frames_per_image(view.clip) * view.offset_frames
    tell_touched(view, _)


class View(bpy.types.PropertyGroup):
    """One camera's footage: its clip, and where it lies in the project's folder."""

    name: bpy.props.StringProperty(
        name="View",
        update=_renamed,  # type: ignore[valid-type]
        description="Name of the view; its camera has the same name, such as L, C, R from left to right",
    )
    clip: bpy.props.PointerProperty(type=bpy.types.MovieClip, name="Clip")  # type: ignore[valid-type]
    images: bpy.props.StringProperty(name="Images")  # type: ignore[valid-type]
    movie: bpy.props.StringProperty(name="Movie")  # type: ignore[valid-type]
    person: bpy.props.StringProperty(name="Person", options={"HIDDEN"})  # type: ignore[valid-type]  # a key of [[views]] or ""
    person_files: bpy.props.StringProperty(name="Masks", options={"HIDDEN"})  # type: ignore[valid-type]
    offset_frames: bpy.props.IntProperty(
        name="Offset",
        update=_shifted,  # type: ignore[valid-type]
        description="Images by which this recorder was switched on earlier than the others",
    )


def annotations() -> dict[str, Any]:
    """The properties, for the group that hangs on the scene."""
    props, told = bpy.props, dict(update=tell_touched)
    return {
        "views": props.CollectionProperty(type=View),
        "view_index": props.IntProperty(name="View"),
        "fps": props.FloatProperty(
            name="Frame Rate", default=25.0, min=0.1, max=10_000.0, precision=3, description="Images per second of the footage", **told
        ),
        "interlaced": props.EnumProperty(
            name="Lines",
            items=[(name, *LINES[name]) for name in (*INTERLACE, BOTH)],
            description="Which lines of interlaced video are measured",
            **told,
        ),
        "first_field": props.EnumProperty(name="First Field", items=FIELDS, description="Which field is the earlier one", **told),
        "reference_view": props.StringProperty(
            name="Reference View", description="The view that the others are compared with; empty: the middle one", **told
        ),
        "all_frames": props.BoolProperty(name="All Frames", default=True, description="Measure all that the footage has", **told),
        "first_frame": props.IntProperty(name="First", min=0, description="First frame to measure", **told),
        "last_frame": props.IntProperty(name="Last", min=0, description="Last frame to measure", **told),
        "model": props.EnumProperty(
            name="Body", items=MODELS, default="full", description="Which part of the body is filmed and fitted", **told
        ),
        "model_file": props.StringProperty(name="Model File", description="Name of the .toml model in the project's folder", **told),
        "seed_frame": props.IntProperty(
            name="Seed Frame", min=0, description="The frame in which the joints are clicked; measuring starts from it", **told
        ),
        "check_said": props.StringProperty(name="Check", description="What the check of footage and cameras found"),
        "check_key": props.StringProperty(options={"HIDDEN"}),
        "take_digest": props.StringProperty(options={"HIDDEN"}),
    }
