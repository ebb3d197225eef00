"""The polygonal skin: core's skin of the rest pose as a mesh with the bones' vertex groups and an armature modifier.

The armature deforms it by blending bones; the exact skin of a posture is core.body.skin.limb_skin of that posture.
"""

import bpy
import numpy as np

from ...core.body.shape import BodyShape
from ...core.body.skin import Skin, limb_skin
from . import paint

NAME = "Skin"
SKIN_COLOUR = (0.80, 0.52, 0.41)


def add_skin(collection: bpy.types.Collection, armature_object: bpy.types.Object, shape: BodyShape) -> bpy.types.Object:
    """The skin of the rest pose, bound to the armature.

    Raises:
        InputError: the body is of a kind that core makes no skin for.
    """
    skin = limb_skin(shape, np.zeros(len(shape.skeleton.dof_names)))
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata(skin.vertices_m.tolist(), [], skin.faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    mesh.materials.append(paint.plain_material(NAME, SKIN_COLOUR))
    mesh.update()
    skin_object = bpy.data.objects.new(NAME, mesh)
    skin_object.parent = armature_object
    _bind(skin_object, skin)
    skin_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    collection.objects.link(skin_object)
    return skin_object


def _bind(skin_object: bpy.types.Object, skin: Skin) -> None:
    for bone, weights in zip(skin.bone_names, skin.weights.T):
        group = skin_object.vertex_groups.new(name=bone)
        for weight in np.unique(weights[weights > 0]):  # all vertices of a contour have the same weight
            group.add(np.flatnonzero(weights == weight).tolist(), float(weight), "REPLACE")
