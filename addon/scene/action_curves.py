"""The curves of actions."""

import bpy


def bags_of(action: bpy.types.Action) -> list[bpy.types.ActionChannelbag]:
    """The bags with the curves of an action, one for each slot."""
    return [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]


def curves_of(action: bpy.types.Action) -> list[bpy.types.FCurve]:
    """All curves of an action."""
    return [curve for bag in bags_of(action) for curve in bag.fcurves]
