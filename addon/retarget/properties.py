"""The settings of retargeting in the scene: `scene.tricap_retarget`."""

import json
import math
from collections.abc import Iterable
from typing import Any

import bpy

from ...core.foundation import bounded
from ...core.foundation.errors import InputError
from ...core.motion.formats.markers import UNITS_M
from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.mapping import RigMap, control_rig_of
from ...core.motion.retarget.retarget import RetargetSettings
from ...core.motion.retarget.roles import ROLES
from ..properties import group_class
from ..scene.armature import SNAPS_KEY
from ..scene.standing import DOFS_KEY

AUTOMATIC = "USUAL"  # the identifier in saved files
RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


EXPORTED = (
    ("PLAYED", "What Plays", "The armature as it plays in the scene: with its edited action, NLA layers and constraints"),
    ("MEASURED", "Measured Motion", "The motion as it was measured, with its sigmas, from the files of the run"),
)


PLACES = (
    ("SIDE", "Side by Side", "The target begins where it stands, or beside the source if it stands in it"),
    ("SOURCE", "In Place", "The target moves where the source does"),
)


def _is_armature(_: bpy.types.PropertyGroup, thing: bpy.types.Object) -> bool:
    return bool(thing.type == "ARMATURE")


def _with_automatic(names: Iterable[str]) -> list[tuple[str, str, str]]:
    return [(AUTOMATIC, "Automatic", "As stated in the file, or as is usual for its format"), *((name, name, "") for name in names)]


def axes_of_file(props: Any) -> dict[str, str]:
    """Up axis and unit of the motion file, for `read_motion_source`."""
    return {name: "" if getattr(props, name) == AUTOMATIC else getattr(props, name) for name in ("up", "unit")}


class MapRow(bpy.types.PropertyGroup):
    """One line of the mapping: a part of the body, its bones in source and target, separated by commas, and a rotation offset."""

    role: bpy.props.EnumProperty(name="Part", items=[(role, role, "") for role in ROLES])  # type: ignore[valid-type]
    bones: bpy.props.StringProperty(name="Bones", description="Bones of this part from the body outwards, separated by commas")  # type: ignore[valid-type]
    source: bpy.props.StringProperty(name="Source", description="Bones of this part in the source, as recognised")  # type: ignore[valid-type]
    offset: bpy.props.FloatVectorProperty(  # type: ignore[valid-type]
        name="Rotation Offset",
        subtype="EULER",
        size=3,
        description="Turns this part of the target about its own axes in the rest pose, in all frames",
    )
    twist: bpy.props.StringProperty(name="Twist", description="Twist bones of this part, separated by commas")  # type: ignore[valid-type]


Settings: type = group_class("retarget", RetargetSettings)
Feet: type = group_class("retarget_feet", FeetSettings)


class Retargeting(bpy.types.PropertyGroup):
    """Source, target, settings, and the mapping in the editor."""

    source: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Source",
        poll=_is_armature,  # type: ignore[valid-type]
        description="The armature with the motion",
    )
    file: bpy.props.StringProperty(
        name="Motion",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="A motion file instead of an armature: a folder with results, BVH, TRC, C3D or CSV",
    )
    up: bpy.props.EnumProperty(
        name="Up",
        items=_with_automatic(("Y", "Z")),  # type: ignore[valid-type]
        description="The up axis of the file; change it if the body lies down",
    )
    unit: bpy.props.EnumProperty(
        name="Unit",
        items=_with_automatic(UNITS_M),  # type: ignore[valid-type]
        description="The unit of the file; change it if the one stated in the file is wrong",
    )
    target: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Target",
        poll=_is_armature,  # type: ignore[valid-type]
        description="The armature that gets the motion",
    )
    tolerance_deg: bpy.props.FloatProperty(
        name="Simplify [°]",
        min=0.0,
        max=10.0,
        default=0.0,  # type: ignore[valid-type]
        description="Remove keys as long as no rotation changes by more than this; 0: a key in every frame",
    )
    place: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Place",
        items=PLACES,
        description="Where the target plays the motion",
    )
    strip: bpy.props.BoolProperty(name="As NLA Strip", description="Push the action down to an NLA strip, to layer corrections over it")  # type: ignore[valid-type]
    settings: bpy.props.PointerProperty(type=Settings)  # type: ignore[valid-type]
    feet: bpy.props.PointerProperty(type=Feet)  # type: ignore[valid-type]
    rows: bpy.props.CollectionProperty(type=MapRow)  # type: ignore[valid-type]
    row: bpy.props.IntProperty()  # type: ignore[valid-type]
    rows_of: bpy.props.PointerProperty(type=bpy.types.Object)  # type: ignore[valid-type]  # the armature of the mapping
    steering: bpy.props.StringProperty()  # type: ignore[valid-type]  # JSON: the control rig of the mapping
    missing: bpy.props.StringProperty()  # type: ignore[valid-type]
    export_source: bpy.props.EnumProperty(name="Motion", items=EXPORTED, description="What Export Motion writes")  # type: ignore[valid-type]
    export: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Armature",
        poll=_is_armature,  # type: ignore[valid-type]
        description="The armature to export; its skin is exported, too. Empty: the only one of the scene",
    )
    last: bpy.props.StringProperty()  # type: ignore[valid-type]  # figures and notes of the last retargeting
    last_export: bpy.props.StringProperty()  # type: ignore[valid-type]  # what was exported since


def target_of(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The target that is chosen; without one the only armature of the scene that can be one."""
    props = scene.tricap_retarget
    if props.target is not None:
        return props.target
    others = [o for o in scene.objects if o.type == "ARMATURE" and o != props.source and DOFS_KEY not in o.data and SNAPS_KEY not in o]
    return others[0] if len(others) == 1 else None


def fill_rows(props: Any, rig_map: RigMap, target: bpy.types.Object, source: RigMap | None = None) -> None:
    """Show the mapping of a target in the editor, next to that of the source."""
    props.rows.clear()
    for role, chain in rig_map.bones.items():
        row = props.rows.add()
        row.role, row.bones, row.twist = role, ", ".join(chain), ", ".join(rig_map.twist.get(role, ()))
        row.source = ", ".join(source.bones.get(role, ())) if source is not None else ""
        row.offset = [math.radians(angle) for angle in rig_map.offsets_deg.get(role, (0.0, 0.0, 0.0))]
    props.rows_of, props.row = target, 0
    props.steering = json.dumps(rig_map.control_rig.table()) if rig_map.control_rig is not None else ""
    props.missing = "\n".join((*rig_map.missing_notes, *rig_map.notes))


def edited_map(props: Any, target: bpy.types.Object | None) -> RigMap | None:
    """The mapping in the editor; None if it is empty or another armature's.

    Raises:
        InputError: a part has two lines.
    """

    def names(text: str) -> tuple[str, ...]:
        return tuple(name.strip() for name in text.split(",") if name.strip())

    if not props.rows or props.rows_of != target:
        return None
    roles = [row.role for row in props.rows]
    for role in roles:
        if roles.count(role) > 1:
            raise InputError(f"The mapping has {roles.count(role)} lines for “{role}”; remove all but one.")
    bones = {row.role: names(row.bones) for row in props.rows if names(row.bones)}
    twist = {row.role: names(row.twist) for row in props.rows if names(row.twist)}
    try:
        table = bounded.json_of(props.steering or "null")
    except ValueError as error:
        raise InputError(f"The mapping in this .blend file is damaged ({error}); press Recognise to make it again.") from error
    control_rig = control_rig_of(table, {"L": "L", "R": "R"}, "The mapping in this .blend file") if table is not None else None
    offsets = {row.role: tuple(math.degrees(angle) for angle in row.offset) for row in props.rows if row.role in bones and any(row.offset)}
    controls = control_rig and control_rig.of_controls(bones, twist)
    return RigMap(bones=bones, twist=twist, origin="the panel", control_rig=controls, offsets_deg=offsets)


def foreign_mapping_note(props: Any, target: bpy.types.Object) -> str:
    """A note if the mapping in the editor belongs to another armature, else ""."""
    if not props.rows or props.rows_of == target:
        return ""
    whose = f"“{props.rows_of.name}”" if props.rows_of is not None else "a deleted armature"
    return f"the mapping is that of {whose} and was not used; press Recognise to edit the one of “{target.name}”"


CLASSES = (MapRow, Settings, Feet, Retargeting)


def register() -> None:
    """Register the property groups and add them to the scene."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_retarget = bpy.props.PointerProperty(type=Retargeting)


def unregister() -> None:
    """Remove them."""
    del bpy.types.Scene.tricap_retarget
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
