"""What the panel of retargeting remembers, in the scene: `scene.tricap_retarget`."""

import json
from collections.abc import Iterable
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.motion.formats.markers import UNITS_M
from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.control_rig import ControlRig
from ...core.motion.retarget.mapping import RigMap
from ...core.motion.retarget.retarget import RetargetSettings
from ...core.motion.retarget.roles import ROLES
from ..properties import group_class

USUAL = "USUAL"
RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


def _is_armature(_: bpy.types.PropertyGroup, thing: bpy.types.Object) -> bool:
    return bool(thing.type == "ARMATURE")


def _with_usual(names: Iterable[str]) -> list[tuple[str, str, str]]:
    return [(USUAL, "As Usual", "As the file says, or as is the custom of its kind"), *((name, name, "") for name in names)]


def said(props: Any) -> dict[str, str]:
    """Up axis and unit of the file, for `read_motion_source`."""
    return {name: "" if getattr(props, name) == USUAL else getattr(props, name) for name in ("up", "unit")}


class MapRow(bpy.types.PropertyGroup):
    """One line of the mapping: a part of the body, and the bones of the target that are it, separated by commas."""

    role: bpy.props.EnumProperty(name="Part", items=[(role, role, "") for role in ROLES])  # type: ignore[valid-type]
    bones: bpy.props.StringProperty(name="Bones", description="Bones from the body outwards, separated by commas")  # type: ignore[valid-type]
    twist: bpy.props.StringProperty(name="Twist", description="Bones that share the part's twist")  # type: ignore[valid-type]


Settings: type = group_class("retarget", RetargetSettings)
Feet: type = group_class("retarget_feet", FeetSettings)


class Retargeting(bpy.types.PropertyGroup):
    """Source, target, settings and the mapping that is being edited."""

    source: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Source",
        poll=_is_armature,  # type: ignore[valid-type]
        description="The armature that moves",
    )
    file: bpy.props.StringProperty(
        name="Motion",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Instead of an armature: a run's folder, BVH, TRC, C3D or CSV",
    )
    up: bpy.props.EnumProperty(
        name="Up",
        items=_with_usual(("Y", "Z")),  # type: ignore[valid-type]
        description="The axis that is up in the file, if the body lies down otherwise",
    )
    unit: bpy.props.EnumProperty(
        name="Unit",
        items=_with_usual(UNITS_M),  # type: ignore[valid-type]
        description="The unit of the file, if it is not the one that it says",
    )
    target: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Target",
        poll=_is_armature,  # type: ignore[valid-type]
        description="The armature that shall move",
    )
    tolerance_deg: bpy.props.FloatProperty(
        name="Simplify [°]",
        min=0.0,
        max=10.0,
        default=0.0,  # type: ignore[valid-type]
        description="Leave out keys as long as no rotation is off by more; 0: a key in every frame",
    )
    strip: bpy.props.BoolProperty(name="As NLA Strip", description="Put the action into a strip, to layer corrections over it")  # type: ignore[valid-type]
    settings: bpy.props.PointerProperty(type=Settings)  # type: ignore[valid-type]
    feet: bpy.props.PointerProperty(type=Feet)  # type: ignore[valid-type]
    rows: bpy.props.CollectionProperty(type=MapRow)  # type: ignore[valid-type]
    row: bpy.props.IntProperty()  # type: ignore[valid-type]
    rows_of: bpy.props.PointerProperty(type=bpy.types.Object)  # type: ignore[valid-type]  # the armature whose bones the lines name
    steering: bpy.props.StringProperty()  # type: ignore[valid-type]  # JSON: how the lines' controls steer the rig
    missing: bpy.props.StringProperty()  # type: ignore[valid-type]
    last: bpy.props.StringProperty()  # type: ignore[valid-type]


def fill_rows(props: Any, rig_map: RigMap, target: bpy.types.Object) -> None:
    """Show the mapping of a target in the editor."""
    props.rows.clear()
    for role, chain in rig_map.bones.items():
        row = props.rows.add()
        row.role, row.bones, row.twist = role, ", ".join(chain), ", ".join(rig_map.twist.get(role, ()))
    props.rows_of, props.row = target, 0
    props.steering = json.dumps(rig_map.control_rig.table()) if rig_map.control_rig is not None else ""
    props.missing = "\n".join((*rig_map.missing, *rig_map.notes))


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
    control_rig = ControlRig(**json.loads(props.steering)) if props.steering else None
    return RigMap(bones=bones, twist=twist, origin="the panel", control_rig=control_rig and control_rig.of_controls(bones, twist))


def other_lines(props: Any, target: bpy.types.Object) -> str:
    """A sentence if the editor's lines are another armature's."""
    if not props.rows or props.rows_of == target:
        return ""
    whose = f"“{props.rows_of.name}”" if props.rows_of is not None else "a rig that is gone"
    return f"the mapping's lines are those of {whose} and were not used; recognise “{target.name}” to edit its own"


CLASSES = (MapRow, Settings, Feet, Retargeting)


def register() -> None:
    """Register the groups and hang them onto the scene."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_retarget = bpy.props.PointerProperty(type=Retargeting)


def unregister() -> None:
    """Take them away again."""
    del bpy.types.Scene.tricap_retarget
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
