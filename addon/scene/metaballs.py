"""The metaball skin: groups of Blender metaballs that follow the bones, with the surface of the fitted field.

Our field is  F = Σ w exp(−2 d)  with d the squared distance in units of the radii l, surface F = ½. Blender's is
Σ s max(0, 1 − ρ²)³ with compact support. The exponential is a sum of three of Blender's kernels at the same place,

    exp(−2 d) ≈ Σ_j s_j max(0, 1 − d / a_j²)³                                                            (1)

so every fitted ball becomes four ellipsoids of sizes a_j · l and stiffness w · s_j, threshold ½. The coefficients are a least
squares fit to limbs of three balls: a limb of 40 mm is off by 0.04 mm RMS (with three kernels 0.09, at
most 0.33 mm). Blender adds the fields of all
objects whose names differ only in the number; Blender calls these a family and polygonises it in the object without a number.

core.body.metaball_groups decides which balls form a family, so that hips and shoulders are as thick as fitted and arms do not fuse with
the flanks.

Blender polygonises visible and hidden metaballs alike in every frame, which for a whole body takes some 30 times as long as everything
else in the scene. They are therefore in a collection of their own, which the view layers exclude as long as nobody looks at them.
"""

import bpy
import numpy as np

from ...core.body.metaballs import THRESHOLD, Metaballs
from ...core.body.shape import BodyShape
from . import nodes

NAME = "Flesh"
COLLECTION = "Metaballs"
COLLECTION_KEY = "tricap_metaballs"  # custom property by which the collection is found again, whatever its name
KERNELS = ((0.1174, 0.8021), (0.3608, 1.1586), (0.3972, 1.5345), (0.1227, 2.0242))  # stiffness s_j, size a_j  (1)
STIFFNESS_MAX = 10.0  # Blender's own limit
SIZE_MAX = 16.0  # largest half axis / radius (Blender's limit: 20): the circles that the viewport draws at the radius lie in the flesh
RESOLUTION_M, RENDER_RESOLUTION_M = 0.008, 0.005
SKIN_COLOUR = (0.80, 0.52, 0.41)


def add_collection(parent: bpy.types.Collection) -> bpy.types.Collection:
    """An empty collection for metaballs, in `parent`."""
    collection = bpy.data.collections.new(COLLECTION)
    collection[COLLECTION_KEY] = True
    parent.children.link(collection)
    return collection


def add_metaballs(collection: bpy.types.Collection, armature_object: bpy.types.Object, shape: BodyShape) -> list[bpy.types.Object]:
    """For each family a metaball object per bone, child of that bone; a family is polygonised in its first object."""
    from ...core.body.metaball_groups import metaball_groups

    objects = []
    found = metaball_groups(shape)
    for balls in found:
        bones = list(dict.fromkeys(balls.bone_index.tolist()))
        words = NAME if len(found) == 1 else f"{NAME} {shape.skeleton.bones[bones[0]].name}"
        family = free_family_name(words)
        material = nodes.plain_material(family, SKIN_COLOUR)
        for i, b in enumerate(bones):
            bone = shape.skeleton.bones[b].name
            data = _data(family, balls, np.flatnonzero(balls.bone_index == b), shape.lengths_m, material)
            member = bpy.data.objects.new(f"{family}.{i:03d}" if i else family, data)
            member.parent, member.parent_type, member.parent_bone = armature_object, "BONE", bone
            member.location = (0.0, -armature_object.data.bones[bone].length, 0.0)  # children of a bone sit at its tail
            collection.objects.link(member)
            objects.append(member)
    return objects


def free_family_name(name: str) -> str:
    """`name`, with a letter appended if another metaball family of the file has that name."""
    taken = {_stem(other.name) for other in bpy.data.objects}
    for letter in ("", *(f" {chr(code)}" for code in range(ord("B"), ord("Z") + 1))):
        if name + letter not in taken:
            return name + letter
    raise RuntimeError(f"The file has 26 families of metaballs called {name}")


def _stem(name: str) -> str:
    head, dot, number = name.rpartition(".")
    return head if dot and number.isdigit() else name


def _data(name: str, balls: Metaballs, own: np.ndarray, lengths_m: np.ndarray, material: bpy.types.Material) -> bpy.types.MetaBall:
    data = bpy.data.metaballs.new(name)
    data.threshold = THRESHOLD
    data.resolution, data.render_resolution = RESOLUTION_M, RENDER_RESOLUTION_M
    data.materials.append(material)
    centres_m = balls.centres_m(lengths_m)
    for m in own:
        for stiffness, size in KERNELS:
            element = data.elements.new(type="ELLIPSOID")
            half_axes = size * balls.radii_m[m]
            element.co, element.radius = centres_m[m], half_axes.max() / SIZE_MAX
            element.size_x, element.size_y, element.size_z = SIZE_MAX * half_axes / half_axes.max()
            element.stiffness = min(stiffness * float(balls.weight[m]), STIFFNESS_MAX)
    return data
