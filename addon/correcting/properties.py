"""The user's corrections, stored in the scene and written to take.toml: [[corrections]], `locked` and `limits` of [body]."""

import bpy


class TricapCorner(bpy.types.PropertyGroup):
    """A pixel: full-frame coordinates, (0, 0) is the centre of the top-left pixel."""

    x: bpy.props.FloatProperty(name="X", precision=2)  # type: ignore[valid-type]
    y: bpy.props.FloatProperty(name="Y", precision=2)  # type: ignore[valid-type]


class TricapCorrection(bpy.types.PropertyGroup):
    """A trajectory to remove (one corner, in frame `first`), or a region to exclude (three corners or more, frames `first` to `last`)."""

    kind: bpy.props.EnumProperty(
        name="Kind",
        items=[  # type: ignore[valid-type]
            ("trajectory", "Trajectory", "The trajectory nearest to a pixel is removed"),
            ("region", "Region", "Everything measured inside a polygon is excluded"),
        ],
    )
    view: bpy.props.StringProperty(name="View")  # type: ignore[valid-type]
    first: bpy.props.IntProperty(name="From", min=0, description="First frame")  # type: ignore[valid-type]
    last: bpy.props.IntProperty(name="To", min=0, description="Last frame")  # type: ignore[valid-type]
    corners: bpy.props.CollectionProperty(type=TricapCorner)  # type: ignore[valid-type]


class TricapDof(bpy.types.PropertyGroup):
    """A degree of freedom of the body model: whether it is locked at rest, and its limits in degrees."""

    name: bpy.props.StringProperty(name="Name")  # type: ignore[valid-type]
    locked: bpy.props.BoolProperty(name="Locked", description="Lock it at its rest value")  # type: ignore[valid-type]
    low: bpy.props.FloatProperty(name="Lower", description="Lower limit in degrees", min=-360.0, max=360.0, precision=1)  # type: ignore[valid-type]
    high: bpy.props.FloatProperty(name="Upper", description="Upper limit in degrees", min=-360.0, max=360.0, precision=1)  # type: ignore[valid-type]


class TricapCorrecting(bpy.types.PropertyGroup):
    """All corrections of a scene."""

    corrections: bpy.props.CollectionProperty(type=TricapCorrection)  # type: ignore[valid-type]
    active: bpy.props.IntProperty(name="Correction")  # type: ignore[valid-type]
    dofs: bpy.props.CollectionProperty(type=TricapDof)  # type: ignore[valid-type]
    active_dof: bpy.props.IntProperty(name="Degree of Freedom")  # type: ignore[valid-type]
    dofs_model: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    region_frames: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="In",
        default="all",
        items=[
            ("all", "All Frames", "Exclude the region in all frames"),
            ("one", "This Frame", "Exclude the region in the current frame only; change that in the list"),
        ],
    )


CLASSES = (TricapCorner, TricapCorrection, TricapDof, TricapCorrecting)
