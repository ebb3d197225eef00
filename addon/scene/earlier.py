"""What becomes of an earlier build when another takes its place: its own things go, the user's stay.

Objects and collections that the user put among those of the build stay, and so do actions with edits. What refers to a thing of the earlier
build (parents, constraints, modifiers, drivers, markers with cameras) refers to that of the new build which has its name.
"""

from dataclasses import dataclass, field

import bpy

from . import built, clips, metaballs, nodes, standing, stored
from .options import OUT_KEY, PART_KEY

AWAY = "earlier "  # before the names of what is about to go, so that the new build gets these names
WIDGETS = "WGTS_"  # how Rigify begins the name of the collection with the shapes of controls


def built_collections(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The collections of earlier builds in a scene."""
    return [child for child in scene.collection.children_recursive if OUT_KEY in child]


@dataclass(eq=False, kw_only=True)
class Earlier:
    """Earlier builds of a scene, which make room for another one."""

    collections: list[bpy.types.Collection] = field(default_factory=list)  # whole builds, and the parts and widgets in them
    objects: list[bpy.types.Object] = field(default_factory=list)
    used: set[bpy.types.ID] = field(default_factory=set)  # what goes with them unless something else uses it
    names: dict[bpy.types.ID, str] = field(default_factory=dict)  # those before AWAY
    edited: list[bpy.types.Action] = field(default_factory=list)  # they stay

    @staticmethod
    def set_aside(scene: bpy.types.Scene) -> "Earlier":
        """Take the earlier builds of a scene out of it, with their control rigs; what the user put among them stays in it."""
        earlier = Earlier()
        for collection in built_collections(scene):
            earlier._add(scene, collection)
        for thing in {*earlier.objects, *earlier.collections, *earlier.used}:
            if thing.library is None:
                earlier.names[thing] = thing.name
                thing.name = AWAY + thing.name
        return earlier

    def remove(self, scene: bpy.types.Scene, by: bpy.types.Collection) -> None:
        """Remove them for good: the objects in the new collection of the same names take their places."""
        new = {stored.text(thing, built.NAME_KEY): thing for thing in by.all_objects}
        for thing in self.objects:
            name = stored.text(thing, built.NAME_KEY) or self.names.get(thing, thing.name)
            if (other := new.get(name)) is not None and other.type == thing.type:
                thing.user_remap(other)
        self.names = {thing: name for thing, name in self.names.items() if thing in self.used}
        bpy.data.batch_remove(self.objects)
        bpy.data.batch_remove(self.collections)
        shown = {clips.clip_behind(camera) for camera in bpy.data.cameras}
        if scene.active_clip in self.used - shown:
            scene.active_clip = None
        for _ in range(3):  # first meshes and node groups, then their materials, then the images of these have no users
            free = {thing for thing in self.used if thing.users == 0}
            self.used -= free
            self.names = {thing: name for thing, name in self.names.items() if thing not in free}
            bpy.data.batch_remove(free)
        for thing, name in self.names.items():
            thing.name = name

    def _add(self, scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
        marked = built.NAME_KEY in collection  # not by earlier versions: all of it is the build's
        inside = [c for c in collection.children_recursive if metaballs.COLLECTION_KEY in c or PART_KEY in c]
        objects = [o for o in collection.all_objects if len(o.users_collection) == 1 and (not marked or built.is_own(o))]
        for rig in filter(None, [stored.data_block(o, standing.RIG_KEY, bpy.types.Object) for o in objects]):
            objects += [rig, *{bone.custom_shape for bone in rig.pose.bones if bone.custom_shape is not None}]
        widgets = [c for c in collection.children_recursive if c.name.startswith(WIDGETS) and not {*c.all_objects} - {*objects}]
        objects = list(dict.fromkeys(objects))
        self.objects += objects
        _keep_of_user(scene, [collection, *inside], {*objects}, {*inside, *widgets})
        for parent in (scene.collection, *scene.collection.children_recursive):
            if collection.name in parent.children:
                parent.children.unlink(collection)
        self.collections += [*inside, *widgets, collection]
        self._add_used(objects)

    def _add_used(self, objects: list[bpy.types.Object]) -> None:
        used: set[bpy.types.ID] = {o.data for o in objects if o.data is not None}
        actions = {action for o in objects for action in built.actions_of(o)}
        for action in sorted(actions, key=lambda action: action.name):
            if built.is_edited(action):
                if action.library is None:
                    action.use_fake_user = True
                self.edited.append(action)
        used |= actions - {*self.edited}
        used |= {clip for o in objects if o.type == "CAMERA" and (clip := clips.clip_behind(o.data)) is not None}
        used |= {modifier.node_group for o in objects for modifier in o.modifiers if modifier.type == "NODES" and modifier.node_group}
        used |= {m for o in objects if hasattr(o.data, "materials") for m in o.data.materials if m}
        self.used |= used | {image for m in used if isinstance(m, bpy.types.Material) for image in nodes.images_of(m)}


def _keep_of_user(
    scene: bpy.types.Scene, going: list[bpy.types.Collection], objects: set[bpy.types.Object], ours: set[bpy.types.Collection]
) -> None:
    """Link what the user put into collections that go to the scene itself."""
    for collection in going:
        for child in [child for child in collection.children if child not in ours]:
            if child.name not in scene.collection.children:
                scene.collection.children.link(child)
        for thing in [thing for thing in collection.objects if thing not in objects and len(thing.users_collection) == 1]:
            scene.collection.objects.link(thing)
