"""The skin as one watertight mesh: the implicit surface of the rest pose, in quads of about a centimetre, bound to the armature."""

import bpy
import numpy as np

from ...core.body.one_skin import onto_surface, shared_weights
from ...core.body.shape import BodyShape
from ...core.body.skin import body_skin
from ...core.progress import Monitor
from . import paint
from .implicit import implicit_surface
from .skin import SKIN_COLOUR

NAME = "Skin in one piece"
SPACING_M = 0.01
STEPS = 100  # a weight is written in hundredths
LEAST = 0.5 / STEPS


def add_one_skin(collection: bpy.types.Collection, armature_object: bpy.types.Object, shape: BodyShape, monitor: Monitor | None = None
                 ) -> bpy.types.Object:
    """The whole body's skin without borders, hidden like the skin of parts; the armature deforms it, keeping volumes.

    A whole body has 23,000 quads and takes 2 s. It has no texture coordinates: those of the skin of parts are by parts.

    Raises:
        InputError: this Blender was built without OpenVDB, or the body has no metaballs.
        Cancelled: the monitor was cancelled.
    """
    rest = np.zeros(len(shape.skeleton.dof_names))
    parts = body_skin(shape, rest)
    points, quads = implicit_surface(shape, rest, monitor, spacing_m=SPACING_M)
    points = onto_surface(shape, rest, points)
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata(points.tolist(), [], quads.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    mesh.materials.append(paint.plain_material(NAME, SKIN_COLOUR))
    mesh.update()
    skin_object = bpy.data.objects.new(NAME, mesh)
    collection.objects.link(skin_object)
    skin_object.parent = armature_object
    for bone, weights in zip(parts.bone_names, shared_weights(points, quads, parts).T):
        if weights.max() < LEAST:
            continue
        group = skin_object.vertex_groups.new(name=bone)
        level = np.round(STEPS * weights).astype(int)
        for step in np.unique(level[level > 0]):
            group.add(np.flatnonzero(level == step).tolist(), step / STEPS, "REPLACE")
    modifier = skin_object.modifiers.new("Armature", "ARMATURE")
    modifier.object, modifier.use_deform_preserve_volume = armature_object, True
    return skin_object
