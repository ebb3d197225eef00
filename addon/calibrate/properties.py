"""The settings of the wand calibration, in the scene: `scene.tricap_calibrate`."""

import bpy

from ..take_properties import FIELDS, LINES

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


class TricapCalibrate(bpy.types.PropertyGroup):
    """What the panel “Calibrate” holds."""

    bar: bpy.props.StringProperty(
        name="Bar Footage",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with a folder of images, or a movie, of the waved bar per camera",
    )
    length_m: bpy.props.FloatProperty(
        name="Bar Length",
        default=0.5,
        min=0.0,
        soft_max=5.0,
        unit="LENGTH",  # type: ignore[valid-type]
        precision=4,
        description="Distance between the middles of the bar's two targets",
    )
    interlaced: bpy.props.EnumProperty(
        name="Lines",
        default="none",  # type: ignore[valid-type]
        items=[(name, *told) for name, told in LINES.items()],
        description="Which lines of interlaced video are measured",
    )
    first_field: bpy.props.EnumProperty(name="First Field", items=FIELDS, description="Which field is the earlier one")  # type: ignore[valid-type]
    focal_px: bpy.props.FloatProperty(
        name="Rough Focal Length [px]",
        default=0.0,
        min=0.0,  # type: ignore[valid-type]
        description="In pixels, if it is known; 0: it is found",
    )
    diameter_m: bpy.props.FloatProperty(
        name="Target Diameter",
        default=0.0,
        min=0.0,
        soft_max=0.2,
        unit="LENGTH",  # type: ignore[valid-type]
        precision=4,
        description="Of the bar's targets, if it is known; 0: unknown",
    )
    mask: bpy.props.StringProperty(
        name="Mask",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Image that is black where no target can be, such as lamps, or a folder of such "
        "images named like the cameras. Empty: none",
    )
    floor: bpy.props.StringProperty(
        name="Bar on Floor",
        description="Frames in which the bar lies on the floor, such as 0, 40, 80; "  # type: ignore[valid-type]
        "the floor becomes z = 0. Empty: up is where the cameras' tops are",
    )
    level: bpy.props.StringProperty(name="Bar Level", description="Frames in which the bar is held level, such as 12, 57")  # type: ignore[valid-type]
    like_scene: bpy.props.BoolProperty(
        name="Where the Scene's Cameras Are",
        default=False,  # type: ignore[valid-type]
        description="The new cameras are put where the scene's cameras of the same names stand, "
        "so that a rig calibrated anew does not move the world",
    )
    light: bpy.props.StringProperty(name="Light")  # type: ignore[valid-type]
    verdict: bpy.props.StringProperty(name="Verdict")  # type: ignore[valid-type]
    advice: bpy.props.StringProperty(name="Advice")  # type: ignore[valid-type]
    rig: bpy.props.StringProperty(name="Rig", subtype="FILE_PATH")  # type: ignore[valid-type]
