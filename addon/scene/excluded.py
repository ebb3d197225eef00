"""Collections that the view layers exclude as long as nobody looks at them; each is found again by a custom property, whatever its name."""

from collections.abc import Iterator

import bpy


def exist(scene: bpy.types.Scene, key: str) -> bool:
    """Whether the scene has a collection with the custom property `key`."""
    return next(_layers(scene, key), None) is not None


def shown(scene: bpy.types.Scene, key: str) -> bool:
    """Whether a view layer of the scene includes one of them, so that Blender evaluates it."""
    return any(not layer.exclude for layer in _layers(scene, key))


def show(scene: bpy.types.Scene, key: str, included: bool) -> None:
    """Include them in every view layer of the scene, or exclude them."""
    for layer in list(_layers(scene, key)):
        layer.exclude = not included
    for view_layer in scene.view_layers:
        view_layer.update()  # until then Blender 4.5 crashes when a script goes through its objects


def _layers(scene: bpy.types.Scene, key: str) -> Iterator[bpy.types.LayerCollection]:
    waiting = [layer.layer_collection for layer in scene.view_layers]
    while waiting:
        layer = waiting.pop()
        if key in layer.collection:
            yield layer
        waiting.extend(layer.children)
