"""The settings of the wand calibration, in the scene: `scene.tricap_calibrate`."""

import bpy

from ..take_properties import FIELD_ORDERS, FIELDS_USED

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


class TricapCalibrate(bpy.types.PropertyGroup):
    """The settings and the result of the wand calibration."""

    bar: bpy.props.StringProperty(
        name="Wand Footage",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder that contains a folder of images, or a movie, of the waved wand for each camera",
    )
    length_m: bpy.props.FloatProperty(
        name="Wand Length",
        default=0.5,
        min=0.0,
        soft_max=5.0,
        unit="LENGTH",  # type: ignore[valid-type]
        precision=4,
        description="Distance between the centres of the two targets of the wand",
    )
    interlaced: bpy.props.EnumProperty(
        name="Interlacing",
        default="none",  # type: ignore[valid-type]
        items=[(name, *texts) for name, texts in FIELDS_USED.items()],
        description="Which fields of interlaced footage are measured",
    )
    first_field: bpy.props.EnumProperty(name="Field Order", items=FIELD_ORDERS, description="Which field was exposed first")  # type: ignore[valid-type]
    focal_px: bpy.props.FloatProperty(
        name="Approximate Focal Length [px]",
        default=0.0,
        min=0.0,  # type: ignore[valid-type]
        description="In pixels, if known. 0: estimated",
    )
    diameter_m: bpy.props.FloatProperty(
        name="Target Diameter",
        default=0.0,
        min=0.0,
        soft_max=0.2,
        unit="LENGTH",  # type: ignore[valid-type]
        precision=4,
        description="Diameter of the targets, if known. 0: unknown",
    )
    mask: bpy.props.StringProperty(
        name="Mask",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Image that is black where targets cannot be, for example over lamps, or a folder of such "
        "images named like the cameras. Empty: none",
    )
    floor: bpy.props.StringProperty(
        name="Wand on Floor",
        description="Frames in which the wand lies on the floor, such as 0, 40, 80; "  # type: ignore[valid-type]
        "the floor becomes z = 0. Empty: up is the mean up direction of the cameras",
    )
    level: bpy.props.StringProperty(name="Wand Level", description="Frames in which the wand is horizontal, such as 12, 57")  # type: ignore[valid-type]
    like_scene: bpy.props.BoolProperty(
        name="Align to Scene Cameras",
        default=False,  # type: ignore[valid-type]
        description="Align the new cameras to the scene's cameras of the same names, so that a new calibration does not move the world",
    )
    light: bpy.props.StringProperty(name="Light")  # type: ignore[valid-type]
    verdict: bpy.props.StringProperty(name="Verdict")  # type: ignore[valid-type]
    advice: bpy.props.StringProperty(name="Advice")  # type: ignore[valid-type]
    rig: bpy.props.StringProperty(name="Rig", subtype="FILE_PATH")  # type: ignore[valid-type]
