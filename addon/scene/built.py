"""Marks by which a later build tells its own things from the user's: objects by their names, actions by their keys."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from . import stored
from .action_curves import curves_of

NAME_KEY = "tricap_built"  # custom property of objects and collections of a build: the name that they got; copies have another one
CURVES_KEY = "tricap_built_curves"  # custom property of its actions: a digest of their curves


def mark(collection: bpy.types.Collection) -> None:
    """Mark a build's collection and all that is in it."""
    for thing in (collection, *collection.children_recursive, *collection.all_objects):
        mark_name(thing)
    mark_actions(action for thing in collection.all_objects for action in actions_of(thing))


def mark_name(thing: bpy.types.Object | bpy.types.Collection) -> None:
    """Mark one thing as made by Tricap."""
    thing[NAME_KEY] = thing.name


def is_own(thing: bpy.types.Object | bpy.types.Collection) -> bool:
    """Whether Tricap made it, under this name or another; a copy of what Tricap made is the user's."""
    name = stored.text(thing, NAME_KEY)
    if not name or name == thing.name:
        return bool(name)
    kind = bpy.data.objects if isinstance(thing, bpy.types.Object) else bpy.data.collections
    marked = [other for other in kind if stored.text(other, NAME_KEY) == name]
    copies = re.compile(re.escape(name) + r"\.\d+")
    return name not in [other.name for other in marked] and [other for other in marked if not copies.fullmatch(other.name)] == [thing]


def actions_of(thing: bpy.types.Object) -> set[bpy.types.Action]:
    """The actions that an object plays, and those that its custom properties keep."""
    data = thing.animation_data
    played = [data.action, *(strip.action for track in data.nla_tracks for strip in track.strips)] if data is not None else []
    kept = [value for value in thing.values() if isinstance(value, bpy.types.Action)]
    return {action for action in (*played, *kept) if action is not None}


def mark_actions(actions: Iterable[bpy.types.Action]) -> None:
    """Mark the curves of actions as Tricap made them."""
    for action in actions:
        action[CURVES_KEY] = _digest(action)


def is_edited(action: bpy.types.Action) -> bool:
    """Whether an action has curves that Tricap did not make, or not so."""
    return bool(curves_of(action)) and stored.text(action, CURVES_KEY) != _digest(action)


@contextmanager
def no_edit(actions: Iterable[bpy.types.Action]) -> Iterator[None]:
    """What changes actions here is Tricap's own work: those that nobody has edited stay so."""
    unedited = [action for action in actions if not is_edited(action)]
    yield
    mark_actions(unedited)


def _digest(action: bpy.types.Action) -> str:
    digest = hashlib.sha256()
    for curve in sorted(curves_of(action), key=lambda curve: (curve.data_path, curve.array_index)):
        keys = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
        curve.keyframe_points.foreach_get("co", keys)
        digest.update(f"{curve.data_path} {curve.array_index} {len(keys)} {len(curve.modifiers)} ".encode() + keys.tobytes())
    return digest.hexdigest()[:16]
