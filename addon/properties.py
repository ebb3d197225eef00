"""Properties of the scene: the take, the output folder, and the settings of every stage.

The settings are made from core's dataclasses: name, default, limits, unit and tooltip have one definition. Only those that a user has
changed in Blender override the take's own [settings] and the defaults.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import bpy
import numpy as np

from ..core.foundation import settings as knobs
from ..core.run.settings import SETTINGS, settings_of
from . import take_properties
from .editing import foot_lock, uncertainty
from .scene import excluded, footage_plane, layers, metaballs, standing
from .scene.options import POINTS_KEY
from .session import get_session

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


def property_of(field: "dataclasses.Field[Any]") -> Any:
    """The bpy property of one setting.

    Raises:
        TypeError: Blender has no property for its type.
    """
    meta, default = field.metadata, field.default
    words: dict[str, Any] = dict(name=label(field), description=meta.get("about", "").rstrip("."))
    words["update"] = take_properties.notify_change
    if isinstance(default, bool):
        return bpy.props.BoolProperty(default=default, **words)
    if isinstance(default, str) and meta.get("choices"):
        return bpy.props.EnumProperty(default=default, items=[(choice, choice, "") for choice in meta["choices"]], **words)
    if isinstance(default, str):
        return bpy.props.StringProperty(default=default, **words)
    limits = {key: meta[bound] for key, bound in (("min", "low"), ("max", "high")) if meta.get(bound) is not None}
    if isinstance(default, int):
        return bpy.props.IntProperty(default=default, **limits, **words)
    if isinstance(default, float):
        return bpy.props.FloatProperty(default=default, precision=4, **limits, **words)
    raise TypeError(f"Setting {field.name} is a {type(default).__name__}, for which there is no property")


def label(field: "dataclasses.Field[Any]") -> str:
    """A setting's name in the panel, with its unit: Patch [px]."""
    unit = field.metadata.get("unit", "")
    return title(field.name, unit) + (f" [{unit}]" if unit else "")


def title(name: str, unit: str) -> str:
    """The label of a setting: "patch_px" in px is Patch."""
    short = name.removesuffix("_" + unit.replace("/", "_").replace("²", "2")) if unit else name
    return short.replace("_", " ").title()


def group_class(name: str, settings: type) -> type:
    """A PropertyGroup class with a property for every field of the frozen dataclass `settings`."""
    annotations = {field.name: property_of(field) for field in dataclasses.fields(settings)}
    return type(f"Tricap_{name}", (bpy.types.PropertyGroup,), {"__annotations__": annotations, "__doc__": settings.__doc__ or name})


def touched(group: bpy.types.PropertyGroup, settings: type) -> dict[str, Any]:
    """The settings that were changed in Blender, as a plain table for `from_table`."""
    return {
        field.name: exact(getattr(group, field.name), field.default)
        for field in dataclasses.fields(settings)
        if group.is_property_set(field.name)
    }


def snapshot(group: bpy.types.PropertyGroup, settings: type) -> Any:
    """The frozen settings that the group shows: those that were changed, and defaults."""
    return knobs.from_table(settings, touched(group, settings), f"The panel “{settings.__name__}”")


def overrides(scene: bpy.types.Scene) -> dict[str, dict[str, Any]]:
    """What was changed in every stage: {"matching": {"patch_px": 17}}, the form of take.toml's [settings]."""
    tables = {name: touched(getattr(scene.tricap, name), settings) for name, settings in stages().items()}
    return {name: table for name, table in tables.items() if table}


def check_settings(tables: Mapping[str, Mapping[str, Any]], where: str) -> None:
    """Check a take's [settings].

    Raises:
        InputError: a name is unknown or a value invalid.
    """
    settings_of(tables, {}, where)


def show_settings(scene: bpy.types.Scene, tables: Mapping[str, Mapping[str, Any]]) -> None:
    """Show a take's [settings] as the settings that were changed; reset all others."""
    current = knobs.current_tables(tables, stages(), "")
    for name, settings in stages().items():
        group, table = getattr(scene.tricap, name), current[name]
        for field in dataclasses.fields(settings):
            if field.name in table:
                setattr(group, field.name, type(field.default)(table[field.name]))
            else:
                group.property_unset(field.name)


def changed_settings(tables: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """The settings in `tables` that differ from the defaults."""
    defaults = {name: dataclasses.asdict(settings()) for name, settings in stages().items()}
    current = knobs.current_tables(tables, stages(), "")
    return {name: {key: value for key, value in table.items() if value != defaults[name][key]} for name, table in current.items()}


def stages() -> Mapping[str, type]:
    """The settings class of every stage, by its name in take.toml."""
    return SETTINGS


def exact(value: Any, default: Any = 0.0) -> Any:
    """What the user typed: the shortest decimal that Blender, in single precision, stores as this value."""
    return float(str(np.float32(value))) if isinstance(default, float) else value


def _of_the_run() -> dict[str, Any]:
    return {
        "take": bpy.props.StringProperty(
            name="Take",
            subtype="DIR_PATH",
            options=RELATIVE,
            update=take_properties.notify_change,
            description="Folder of the take, which contains take.toml",
        ),
        "out": bpy.props.StringProperty(
            name="Output",
            subtype="DIR_PATH",
            options=RELATIVE,
            update=take_properties.notify_change,
            description="Folder for the results. Empty: next to the .blend file, or next to the take",
        ),
        "last": bpy.props.StringProperty(name="Result", description="Summary of the last run"),
    }


def _of_what_is_shown() -> dict[str, Any]:
    """Switches whose state is that of the scene itself."""
    return {
        "show_metaballs": bpy.props.BoolProperty(
            name="Metaballs",
            options=set(),
            get=lambda group: excluded.shown(group.id_data, metaballs.COLLECTION_KEY),
            set=lambda group, value: excluded.show(group.id_data, metaballs.COLLECTION_KEY, value),
            description="Show the metaballs behind the skin. Blender then computes them in every frame, which slows playback",
        ),
        "show_measured": bpy.props.BoolProperty(
            name="Cloud and Trails",
            options=set(),
            get=lambda group: excluded.shown(group.id_data, POINTS_KEY),
            set=lambda group, value: excluded.show(group.id_data, POINTS_KEY, value),
            description="Show the measured points and their trails with the body. They are never rendered",
        ),
        "body_layer": bpy.props.EnumProperty(
            name="Layer",
            items=list(layers.LAYERS),
            options=set(),
            get=lambda group: [name for name, *_ in layers.LAYERS].index(layers.shown(group.id_data)),
            set=lambda group, value: layers.show(group.id_data, layers.LAYERS[value][0]),
            description="Show the layers of the body one after the other: skeleton, metaballs by kind, polygons, skin",
        ),
        "show_uncertainty": bpy.props.BoolProperty(
            name="Show Uncertainty",
            options=set(),
            update=lambda _, context: uncertainty.redraw(context),
            description="Colour the bones in the 3-D view, and strips of trunk and limbs in the timeline, by how well their joints "
            "are known: blue up to 1 mm, red from 50 mm. In Pose Mode the strip is of the selected bones",
        ),
        "foot_lock": bpy.props.BoolProperty(
            name="Foot Lock",
            options=set(),
            get=lambda group: any(foot_lock.is_active(body) for body in standing.all_bodies(group.id_data)),
            set=lambda group, value: foot_lock.activate_all(group.id_data, value),
            description="Let the foot lock act; without it the feet move as measured",
        ),
    }


def _of_the_place() -> dict[str, Any]:
    """Where the body stands and moves, and what stands behind it."""
    return {
        "floor_m": bpy.props.FloatProperty(
            name="Floor",
            options=set(),
            unit="LENGTH",
            precision=3,
            get=lambda group: standing.floor_of(group.id_data),
            set=lambda group, value: standing.stand_on(group.id_data, value),
            description="Height of the floor. It is found from the standing feet. Set Floor, in the sidebar of the Clip Editor, finds "
            "it from a place that you click in two views",
        ),
        "render_footage": bpy.props.BoolProperty(
            name="Footage in Renders",
            options=set(),
            get=lambda group: footage_plane.shown(group.id_data),
            set=lambda group, value: footage_plane.show(group.id_data, value),
            description="Render the body over the footage of the scene's camera; otherwise in a studio, on the floor",
        ),
        "path": bpy.props.EnumProperty(
            name="Path",
            items=[(path.value, title, about) for path, title, about in standing.PATHS],
            options=set(),
            get=lambda group: list(standing.Path).index(standing.path_of(group.id_data)),
            set=lambda group, value: standing.carry_path(group.id_data, list(standing.Path)[value]),
            description="What carries the path of the body over the floor",
        ),
    }


def register() -> None:
    """Make the classes of all stages and register them as `scene.tricap`."""
    groups = {name: group_class(name, settings) for name, settings in stages().items()}
    annotations = _of_the_run() | _of_what_is_shown() | _of_the_place() | take_properties.annotations()
    annotations |= {name: bpy.props.PointerProperty(type=group) for name, group in groups.items()}
    body = {"__annotations__": annotations, "__doc__": "Tricap's part of the scene."}
    scene_group = type("Tricap_scene", (bpy.types.PropertyGroup,), body)
    classes = get_session().property_groups = [take_properties.View, *groups.values(), scene_group]
    for group in classes:
        bpy.utils.register_class(group)
    bpy.types.Scene.tricap = bpy.props.PointerProperty(type=scene_group)


def unregister() -> None:
    """Remove the properties."""
    del bpy.types.Scene.tricap
    for group in reversed(get_session().property_groups):
        bpy.utils.unregister_class(group)
