"""The settings of the calibration, in the scene: `scene.tricap_calibrate`."""

import bpy

from ...core.calibration.boards.board import DICTIONARIES, MOST_SQUARES
from ..take_properties import FIELD_ORDERS, FIELDS_USED

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}
TARGETS = [
    ("WAND", "Wand", "A bar with two bright targets at its ends, waved through the volume"),
    ("charuco", "ChArUco", "A checkerboard with a marker in every white square; a part of it is enough"),
    ("chessboard", "Checkerboard", "A plain checkerboard, which must be visible as a whole"),
]


class TricapCalibrate(bpy.types.PropertyGroup):
    """The settings and the result of the calibration."""

    target: bpy.props.EnumProperty(
        name="Target",
        default="WAND",  # type: ignore[valid-type]
        items=TARGETS,
        description="What the footage shows",
    )
    squares: bpy.props.IntVectorProperty(
        name="Squares",
        size=2,
        default=(9, 6),
        min=3,
        max=MOST_SQUARES,  # type: ignore[valid-type]
        description="Across and down: the squares of a ChArUco board, the inner corners of a checkerboard",
    )
    square_m: bpy.props.FloatProperty(
        name="Square Size",
        default=0.03,
        min=0.0,
        soft_max=0.5,
        unit="LENGTH",  # type: ignore[valid-type]
        precision=4,
        description="Side of a square, as measured on the print",
    )
    marker_m: bpy.props.FloatProperty(
        name="Marker Size",
        default=0.0,
        min=0.0,
        soft_max=0.5,
        unit="LENGTH",  # type: ignore[valid-type]
        precision=4,
        description="Side of a marker. 0: three quarters of a square",
    )
    dictionary: bpy.props.EnumProperty(
        name="Dictionary",
        default="DICT_4X4_50",  # type: ignore[valid-type]
        items=[(name, name.removeprefix("DICT_"), "") for name in DICTIONARIES],
        description="The set of markers with which the board was made",
    )
    bar: bpy.props.StringProperty(
        name="Target Footage",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder that contains a folder of images, or a movie, of the wand or board for each camera",
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
    board_footage: bpy.props.StringProperty(
        name="Board Too",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder like that of the wand, in which the same cameras show a board: both go into one adjustment. Empty: no board",
    )
    board_kind: bpy.props.EnumProperty(
        name="Board",
        items=TARGETS[1:],  # type: ignore[valid-type]
        description="The board that was filmed besides the wand",
    )
    lenses_only: bpy.props.BoolProperty(
        name="Board for Lenses Only",
        default=False,  # type: ignore[valid-type]
        description="The cameras were moved between the films of the wand and of the board, or filmed the board one after another",
    )
    started_fps: bpy.props.FloatProperty(
        name="Started Separately [FPS]",
        default=0.0,
        min=0.0,
        max=1000.0,  # type: ignore[valid-type]
        description="Images per second of cameras that were started one by one: when each of them began is found by its sound, by light or "
        "by time codes. 0: all films begin at the same instant",
    )
    rates: bpy.props.StringProperty(
        name="FPS of Views",
        description="Images per second of each camera where they differ, such as L=24, C=30, R=60. Empty: the same for all",
    )
    interlaced: bpy.props.EnumProperty(
        name="Interlacing",
        default="none",  # type: ignore[valid-type]
        items=[(name, *texts) for name, texts in FIELDS_USED.items()],
        description="Which fields of interlaced footage are measured",
    )
    first_field: bpy.props.EnumProperty(name="Field Order", items=FIELD_ORDERS, description="Which field was exposed first")  # type: ignore[valid-type]
    lens: bpy.props.EnumProperty(
        name="Lens",
        items=[  # type: ignore[valid-type]
            ("auto", "Automatic", "Of each camera the model that fits its images"),
            ("brown", "Brown", "Radial and tangential distortion"),
            ("fisheye", "Fisheye", "OpenCV's fisheye lens"),
        ],
        description="Model of the lenses",
    )
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
        name="Target on Floor",
        description="Frames in which the wand or board lies on the floor, such as 0, 40, 80; "  # type: ignore[valid-type]
        "the floor becomes z = 0. Empty: up is the mean up direction of the cameras",
    )
    level: bpy.props.StringProperty(name="Target Level", description="Frames in which the wand or board is horizontal, such as 12, 57")  # type: ignore[valid-type]
    like_scene: bpy.props.BoolProperty(
        name="Align to Scene Cameras",
        default=False,  # type: ignore[valid-type]
        description="Align the new cameras to the scene's cameras of the same names, so that a new calibration does not move the world",
    )
    light: bpy.props.StringProperty(name="Light")  # type: ignore[valid-type]
    verdict: bpy.props.StringProperty(name="Verdict")  # type: ignore[valid-type]
    advice: bpy.props.StringProperty(name="Advice")  # type: ignore[valid-type]
    rig: bpy.props.StringProperty(name="Rig", subtype="FILE_PATH")  # type: ignore[valid-type]
