"""The layers of the body, shown one after the other (D'Apuzzo et al. 1999, Fig. 10): skeleton, metaballs, polygons of the skin, skin.

The balls are one mesh of ellipsoids, each as large as it would be alone, bound to the bones like the skin. Its materials are their kinds
(bone, muscle, fat); each ball is a vertex group with its bone and name, such as “upper_arm.L: biceps, long head”. It is hidden until its
layer is shown, and then costs as much as a second skin; Blender's own metaballs, which blend, are another switch (metaballs.py).
"""

import bpy
import numpy as np

from ...core.body.anatomy import BONE, FAT, FLESH, KINDS, MUSCLE, ball_names
from ...core.body.ellipsoids import ellipsoids
from ...core.body.shape import BodyShape
from . import nodes

NAME = "Ellipsoids"
LAYER_KEY = "tricap_layer"  # custom property of what belongs to a layer: one of `LAYERS`
SKELETON, BALLS, POLYGONS, SKIN = "SKELETON", "BALLS", "POLYGONS", "SKIN"
LAYERS = (
    (SKELETON, "Skeleton", "The armature alone"),
    (BALLS, "Metaballs", "The fitted metaballs as ellipsoids: bone, muscle and fat"),
    (POLYGONS, "Polygons", "The skin as polygons"),
    (SKIN, "Skin", "The skin, shaded"),
)
COLOURS = {BONE: (0.80, 0.76, 0.68), MUSCLE: (0.62, 0.09, 0.09), FAT: (0.85, 0.62, 0.15), FLESH: (0.70, 0.28, 0.22)}


def add_ellipsoids(
    collection: bpy.types.Collection, armature_object: bpy.types.Object, shape: BodyShape, lift_m: float
) -> bpy.types.Object:
    """The balls as a hidden mesh bound to the armature, whose rest pose is `lift_m` above that of the shape."""
    from .skin import bind

    found = ellipsoids(shape, np.zeros(len(shape.skeleton.dofs)))
    bones = [bone.name for bone in shape.skeleton.bones]
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata((found.vertices_m + [0.0, 0.0, lift_m]).tolist(), [], found.triangles.tolist())
    mesh.polygons.foreach_set("material_index", found.kind[found.triangles[:, 0]].astype(np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(found.triangles), dtype=bool))
    for kind in KINDS:
        mesh.materials.append(nodes.plain_material(f"Tricap {kind}", COLOURS[kind]))
    balls = bpy.data.objects.new(NAME, mesh)
    balls[LAYER_KEY] = BALLS
    collection.objects.link(balls)
    bone_of = shape.metaballs.bone_index[found.ball]
    bind(balls, armature_object, bones, np.eye(len(bones))[bone_of])
    for m, name in enumerate(ball_names(bones, shape.metaballs.bone_index)):
        group = balls.vertex_groups.new(name=f"{bones[shape.metaballs.bone_index[m]]}: {name.name}")
        group.add(np.flatnonzero(found.ball == m).tolist(), 1.0, "REPLACE")
    balls.hide_viewport = balls.hide_render = True
    return balls


def is_ellipsoids(thing: bpy.types.Object) -> bool:
    """Whether an object is a body's ellipsoids: no skin, though the armature deforms it."""
    return bool(thing.get(LAYER_KEY) == BALLS)


def parts(scene: bpy.types.Scene) -> dict[str, bpy.types.Object]:
    """The ellipsoids (BALLS) and the skin (SKIN) of the scene's body; only those that there are."""
    return {str(thing[LAYER_KEY]): thing for thing in scene.objects if LAYER_KEY in thing}


def shown(scene: bpy.types.Scene) -> str:
    """The layer that the scene shows."""
    there = parts(scene)
    balls, skin = there.get(BALLS), there.get(SKIN)
    if balls is not None and not balls.hide_viewport:
        return BALLS
    if skin is None or skin.hide_viewport:
        return SKELETON
    return POLYGONS if skin.display_type == "WIRE" else SKIN


def show(scene: bpy.types.Scene, layer: str) -> None:
    """Show one layer of the body."""
    there = parts(scene)
    if BALLS in there:
        there[BALLS].hide_viewport = there[BALLS].hide_render = layer != BALLS
    if SKIN in there:
        there[SKIN].hide_viewport = there[SKIN].hide_render = layer not in (SKIN, POLYGONS)
        there[SKIN].display_type = "WIRE" if layer == POLYGONS else "TEXTURED"
