"""The values of a take in the scene, apart from clips and clicks: its views in order, and what take.toml has for the whole recording."""

from typing import Any

import bpy

from ..core.images.interlace import BOTH, INTERLACE
from ..core.take.writing import ASSUMED_FPS
from .scene.clips import frames_per_image
from .session import get_session

MODELS = (  # with the numbers that .blend files hold
    ("auto", "Whole or Upper Body", "Whichever the images show", "NONE", 8),
    ("none", "No Body", "Clouds and trajectories only", "NONE", 0),
    ("full", "Whole Body", "All limbs", "NONE", 1),
    ("upper_body", "Upper Body", "From the pelvis up, both arms", "NONE", 2),
    ("arm.R", "Right Arm", "Shoulder, elbow, wrist", "NONE", 3),
    ("arm.L", "Left Arm", "Shoulder, elbow, wrist", "NONE", 4),
    ("leg.R", "Right Leg", "Hip, knee, ankle", "NONE", 5),
    ("leg.L", "Left Leg", "Hip, knee, ankle", "NONE", 6),
    ("own", "Custom Model", "A .toml model in the project folder", "NONE", 7),
)
FIELDS_USED = {
    "none": ("Progressive", "The footage is not interlaced"),
    "odd": ("Upper Field", "Interlaced footage: use lines 1, 3, 5, … only"),
    "even": ("Lower Field", "Interlaced footage: use lines 2, 4, 6, … only"),
    "both": ("Both Fields", "Interlaced footage: use each field as a frame, which doubles the frame rate"),
}
FIELD_ORDERS = (
    ("odd", "Upper First", "Lines 1, 3, 5, … were exposed first"),
    ("even", "Lower First", "Lines 2, 4, 6, … were exposed first"),
)


def notify_change(_: Any, __: Any) -> None:
    """A value was changed; Blender does not report changes by scripts in another way."""
    for listener in get_session().on_value_change:
        listener()


def _renamed(view: Any, _: bpy.types.Context) -> None:
    if view.clip is not None:
        view.clip["tricap_view"] = view.name
    notify_change(view, _)


def _shifted(view: Any, _: bpy.types.Context) -> None:
    if view.clip is not None:
        rate = view.fps or (view.id_data.tricap.fps if view.id_data else 0.0)
        view.clip.frame_start = frames_per_image(view.clip) * (round(view.start_s * rate) - view.offset_frames)
    notify_change(view, _)


class View(bpy.types.PropertyGroup):
    """One camera's footage: its clip, and its place in the project's folder."""

    name: bpy.props.StringProperty(
        name="View",
        update=_renamed,  # type: ignore[valid-type]
        description="Name of the view and of its camera, such as L, C, R from left to right",
    )
    clip: bpy.props.PointerProperty(type=bpy.types.MovieClip, name="Clip")  # type: ignore[valid-type]
    images: bpy.props.StringProperty(name="Images")  # type: ignore[valid-type]
    movie: bpy.props.StringProperty(name="Movie")  # type: ignore[valid-type]
    person: bpy.props.StringProperty(name="Person", options={"HIDDEN"})  # type: ignore[valid-type]  # a key of [[views]] or ""
    person_files: bpy.props.StringProperty(name="Masks", options={"HIDDEN"})  # type: ignore[valid-type]
    offset_frames: bpy.props.IntProperty(
        name="Offset",
        update=_shifted,  # type: ignore[valid-type]
        description="Frame offset of this camera relative to the others; positive if it started recording earlier",
    )
    fps: bpy.props.FloatProperty(
        name="FPS of View",
        min=0.0,
        max=10_000.0,
        precision=3,
        update=_shifted,  # type: ignore[valid-type]
        description="Images per second of this camera. 0: those of the other cameras",
    )
    start_s: bpy.props.FloatProperty(
        name="Start",
        precision=4,
        soft_min=-600.0,
        soft_max=600.0,
        update=_shifted,  # type: ignore[valid-type]
        description="When this camera took its first image, in seconds after the beginning of the take; Synchronise finds it",
    )
    readout_s: bpy.props.FloatProperty(
        name="Readout",
        precision=4,
        min=-1.0,
        max=1.0,
        update=notify_change,  # type: ignore[valid-type]
        description="Rolling shutter: seconds from the first row of an image to the last, such as 0.016. 0: all rows at once",
    )
    drift_ppm: bpy.props.FloatProperty(name="Drift", options={"HIDDEN"})  # type: ignore[valid-type]
    timestamps: bpy.props.StringProperty(name="Time Stamps", options={"HIDDEN"})  # type: ignore[valid-type]


def annotations() -> dict[str, Any]:
    """The properties, for the group that hangs on the scene."""
    props, watched = bpy.props, dict(update=notify_change)
    return {
        "views": props.CollectionProperty(type=View),
        "view_index": props.IntProperty(name="View"),
        "fps": props.FloatProperty(
            name="FPS", default=ASSUMED_FPS, min=0.1, max=10_000.0, precision=3, description="Frames per second of the footage", **watched
        ),
        "interlaced": props.EnumProperty(
            name="Interlacing",
            items=[(name, *FIELDS_USED[name]) for name in (*INTERLACE, BOTH)],
            description="Which fields of interlaced footage are measured",
            **watched,
        ),
        "first_field": props.EnumProperty(name="Field Order", items=FIELD_ORDERS, description="Which field was exposed first", **watched),
        "reference_view": props.StringProperty(
            name="Reference View", description="The view to which the others are matched. Empty: the middle one", **watched
        ),
        "all_frames": props.BoolProperty(name="All Frames", default=True, description="Measure every frame of the footage", **watched),
        "first_frame": props.IntProperty(name="Frame Start", min=0, description="First frame to measure", **watched),
        "last_frame": props.IntProperty(name="End", min=0, description="Last frame to measure", **watched),
        "model": props.EnumProperty(
            name="Body", items=MODELS, default="auto", description="The part of the body that was recorded and is fitted", **watched
        ),
        "model_file": props.StringProperty(name="Model File", description="Name of the .toml model in the project folder", **watched),
        "seed_frame": props.IntProperty(
            name="Click Frame", min=0, description="The frame in which the joints are clicked; measuring starts there", **watched
        ),
        "check_said": props.StringProperty(name="Check", description="Result of Check Footage, Cameras and Sync"),
        "check_passed": props.BoolProperty(options={"HIDDEN"}),
        "check_key": props.StringProperty(options={"HIDDEN"}),
        "take_digest": props.StringProperty(options={"HIDDEN"}),
    }
