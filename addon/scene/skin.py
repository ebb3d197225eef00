"""The polygonal skin: core's skin as quads with texture coordinates, bound to the armature, and on request exact in every frame.

The armature deforms the skin of the rest pose by blending bones. The exact skin is the run's own, the implicit surface of every frame's
posture found anew, as a mesh cache beside the .blend (PC2, Blender's Mesh Cache modifier): shape keys would put 120 MB into a file of
1,000 frames.
"""

import struct
from pathlib import Path

import bpy
import numpy as np

from ...core import store
from ...core.body.shape import BodyShape
from ...core.body.skin import Skin, SkinSettings, body_skin
from ...core.body.skin_patches import corner_uv, refined
from ...core.errors import InputError
from . import paint
from .contents import FrameSkins

NAME, EXACT_NAME = "Skin", "Exact skin"
CACHE_MODIFIER = "Every frame"
SKIN_COLOUR = (0.80, 0.52, 0.41)
PC2_HEADER = struct.Struct("<12siiffi")  # magic, version, points, first frame, frames per sample, samples


def add_skin(collection: bpy.types.Collection, armature_object: bpy.types.Object, shape: BodyShape, detail: int = 1,
             settings: SkinSettings = SkinSettings(), found: Skin | None = None) -> bpy.types.Object:  # noqa: B008  frozen
    """The skin of the rest pose, bound to the armature, sampled as the run's settings say; `detail` cuts its B-spline patches finer.
    It may have been found before.

    Raises:
        InputError: the body has no metaballs.
    """
    skin = found or body_skin(shape, np.zeros(len(shape.skeleton.dof_names)), settings)
    skin = refined(skin, detail) if detail > 1 else skin
    skin_object = _mesh_object(collection, NAME, skin)
    skin_object.parent = armature_object
    _bind(skin_object, skin)
    skin_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    return skin_object


def add_exact_skin(collection: bpy.types.Collection, shape: BodyShape, skins: FrameSkins, cache: Path) -> bpy.types.Object:
    """The skin as the run found it in every frame. Writes `cache` (.pc2); missing frames hold the skin before them.

    Raises:
        InputError: the skins are not those of this body, or the cache cannot be written.
    """
    rest = body_skin(shape, np.zeros(len(shape.skeleton.dof_names)), skins.settings)
    if rest.vertices_m.shape != skins.vertices_m.shape[1:]:
        raise InputError(f"The run's skins have {skins.vertices_m.shape[1]} points, that of body.toml {len(rest.vertices_m)}; "
                         "run the fit again.")
    first, last = int(skins.frames[0]), int(skins.frames[-1])
    held = np.searchsorted(skins.frames, np.arange(first, last + 1), side="right") - 1
    head = PC2_HEADER.pack(b"POINTCACHE2\0", 1, len(rest.vertices_m), float(first), 1.0, len(held))
    store.write_bytes(cache, head + skins.vertices_m[held].tobytes())
    skin_object = _mesh_object(collection, EXACT_NAME, rest)
    modifier = skin_object.modifiers.new(CACHE_MODIFIER, "MESH_CACHE")
    modifier.cache_format, modifier.filepath = "PC2", str(cache)
    modifier.frame_start = float(first)
    return skin_object


def _mesh_object(collection: bpy.types.Collection, name: str, skin: Skin) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(skin.vertices_m.tolist(), [], skin.faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", corner_uv(skin).astype(np.float32).ravel())
    mesh.materials.append(paint.plain_material(name, SKIN_COLOUR))
    mesh.update()
    if len(skin.part_sizes) > 1:  # where parts overlap, shade by the surface they share
        mesh.normals_split_custom_set_from_vertices(skin.normals.tolist())
    skin_object = bpy.data.objects.new(name, mesh)
    collection.objects.link(skin_object)
    return skin_object


def _bind(skin_object: bpy.types.Object, skin: Skin) -> None:
    for bone, weights in zip(skin.bone_names, skin.weights.T):
        group = skin_object.vertex_groups.new(name=bone)
        for weight in np.unique(weights[weights > 0]):  # all vertices of a contour have the same weight
            group.add(np.flatnonzero(weights == weight).tolist(), float(weight), "REPLACE")
