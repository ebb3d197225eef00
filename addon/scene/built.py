"""Marks by which a later build tells its own things from the user's: objects by their names, actions by their keys."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy

from . import stored
from .action_curves import curves_of, keys_digest

NAME_KEY = "tricap_built"  # custom property of a build's collection and its objects: the name that they got; copies have another one
CURVES_KEY = "tricap_built_curves"  # custom property of its actions: a digest of their keys


def mark(collection: bpy.types.Collection) -> None:
    """Mark a build's collection and all that is in it."""
    for thing in (collection, *collection.all_objects):
        mark_name(thing)
    mark_actions(action for thing in collection.all_objects for action in actions_of(thing))


def mark_name(thing: bpy.types.Object | bpy.types.Collection) -> None:
    """Mark one thing as made by Tricap."""
    thing[NAME_KEY] = thing.name


def is_own(thing: bpy.types.Object) -> bool:
    """Whether Tricap made it, under this name or another; a copy of what Tricap made is the user's."""
    name = stored.text(thing, NAME_KEY)
    if not name or name == thing.name:
        return bool(name)
    others = [other for other in bpy.data.objects if stored.text(other, NAME_KEY) == name]
    renamed = [other for other in others if not re.fullmatch(re.escape(name) + r"\.\d+", other.name)]
    return renamed == [thing]  # the first one would be among them, if it still had its name


def actions_of(thing: bpy.types.Object) -> set[bpy.types.Action]:
    """The actions that an object plays, and those that its custom properties keep."""
    data = thing.animation_data
    played = [data.action, *(strip.action for track in data.nla_tracks for strip in track.strips)] if data is not None else []
    kept = [value for value in thing.values() if isinstance(value, bpy.types.Action)]
    return {action for action in (*played, *kept) if action is not None}


def mark_actions(actions: Iterable[bpy.types.Action]) -> None:
    """Mark the curves of actions as Tricap made them."""
    for action in actions:
        action[CURVES_KEY] = keys_digest(action)


def is_edited(action: bpy.types.Action) -> bool:
    """Whether an action has curves that Tricap did not make, or not so."""
    curves = curves_of(action)
    return bool(curves) and (any(c.modifiers for c in curves) or stored.text(action, CURVES_KEY) != keys_digest(action))


@contextmanager
def no_edit(actions: Iterable[bpy.types.Action]) -> Iterator[None]:
    """What changes actions here is Tricap's own work: those that nobody has edited stay so."""
    unedited = [action for action in actions if not is_edited(action)]
    yield
    mark_actions(unedited)
