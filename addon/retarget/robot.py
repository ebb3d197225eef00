"""bpy.ops.tricap.add_robot(): a character to try retargeting on, and how it follows the sample's body."""

import bpy
import numpy as np

from ...core.foundation.progress import Monitor
from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.retarget import RetargetSettings, begun_at_rest
from ...core.synthetic.robot import Robot, robot
from ..panels import TellingOperator
from . import apply
from .build import armature_of_rig
from .operators import compute
from .read import action_frames, read_motion, read_rig

NAME = "Robot"
LIGHT, DARK = (0.75, 0.36, 0.06), (0.05, 0.06, 0.08)  # its colours


class AddRobot(TellingOperator, bpy.types.Operator):
    """Add a simple character in a T-pose as the target, to try retargeting without one of your own"""

    bl_idname = "tricap.add_robot"
    bl_label = "Add Robot"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Add it, and choose it as the target."""
        added = context.scene.tricap_retarget.target = add_robot(context)
        return f"“{added.name}” is the target. Press Retarget to let it move."


def add_robot(context: bpy.types.Context) -> bpy.types.Object:
    """The armature of a new robot with its mesh, in a collection of its own. The active object and what is selected stay."""
    active, selected, built = context.view_layer.objects.active, list(context.selected_objects), robot()
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    collection = bpy.data.collections.new(NAME)
    context.scene.collection.children.link(collection)
    rig = armature_of_rig(built.rig, NAME, collection)
    rig.show_in_front, rig.data.display_type = True, "STICK"
    _add_mesh(rig, collection, built)
    context.view_layer.objects.active = active
    for thing in context.selected_objects:
        thing.select_set(thing in selected)
    return rig


def _add_mesh(rig: bpy.types.Object, collection: bpy.types.Collection, built: Robot) -> None:
    from ..scene import nodes
    from ..scene.skin import bind

    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata(built.vertices_m.tolist(), [], built.faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(built.faces), dtype=bool))
    for name, colour in (("Robot", LIGHT), ("Robot Joints", DARK)):
        mesh.materials.append(nodes.plain_material(name, colour, 0.35))
    mesh.polygons.foreach_set("material_index", built.dark.astype(np.int32))
    mesh.update()
    body = bpy.data.objects.new(f"{NAME} Mesh", mesh)
    collection.objects.link(body)
    bind(body, rig, built.rig.names, np.eye(len(built.rig.names))[built.bone])


def follow(target: bpy.types.Object, source: bpy.types.Object) -> None:
    """Let a target move like an armature, beside it.

    Raises:
        InputError: one of them cannot be mapped.
    """
    motion, onto = read_motion(source, read_rig(source), action_frames(source)), apply.read_target(target)
    found = compute(lambda: motion, onto, RetargetSettings(), FeetSettings(), Monitor())
    beside = begun_at_rest(found.result, found.source)
    apply.apply(target, found.source, onto, beside, f"{source.name} on {target.name}")


CLASSES = (AddRobot,)
