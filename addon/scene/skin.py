"""The polygonal skin: one closed mesh of quads with texture coordinates, bound to the armature, and on request exact in every frame.

The armature deforms the skin of the rest pose by blending bones, keeping volumes. The exact skin is cast onto the implicit surface
of each frame's pose, as a mesh cache next to the .blend (PC2, Blender's Mesh Cache modifier): shape keys would
add 120 MB to a file of 1,000 frames.

The implicit surface of the fitted field itself, for checking metaballs and skin, is meshed by OpenVDB, which comes with Blender.
"""

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

from ...core.body.fields import EXPONENTIAL, Potential
from ...core.body.metaballs import THRESHOLD
from ...core.body.shape import BodyShape, read_body
from ...core.body.skeleton import bone_frames
from ...core.body.skin.closed_skin import OneSkin
from ...core.body.skin.contour_skin import body_skin
from ...core.body.skin.fingers import shape_for_skin
from ...core.body.skin.mesh import DETAIL, SkinSettings, corner_uv
from ...core.body.skin.person_skin import REST, read_skin, resampled, rest_skin
from ...core.body.skin.posed import Poser
from ...core.body.skin.whole_surface import field_grid
from ...core.foundation import store
from ...core.foundation.bounded import real_place
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.foundation.settings import from_table
from ...core.results.run_json import read_run
from . import nodes
from .contents import FrameSkins

ATTRIBUTES = ("relief_m", "sigma_m")  # of the vertices: measured displacement, and standard deviation of where the surface is
NAME, EXACT_NAME = "Skin", "Exact skin"
CACHE_MODIFIER = "Every frame"
SKIN_COLOUR = (0.80, 0.52, 0.41)
WEIGHT_STEPS = 2000  # quantisation of the weights; coarser ones fold the inside of a sharply bent elbow
IMPLICIT_SPACING_M = 0.005  # of the grid in which the implicit surface is sampled; the surface is then exact to 0.4 mm
PC2_START = "POINTCACHE2"
PC2_HEADER = struct.Struct("<12siiffi")  # magic, version, points, first frame, frames per sample, samples


def add_skin(
    collection: bpy.types.Collection,
    armature_object: bpy.types.Object,
    shape: BodyShape,
    detail: int = DETAIL,
    settings: SkinSettings = SkinSettings(),  # noqa: B008  frozen
    prepared: OneSkin | None = None,
    texture: Path | None = None,
) -> bpy.types.Object:
    """The skin of the rest pose as one closed mesh, bound to the armature, with `detail` pieces for each edge of its cage.

    `prepared`: the run's skin, in the rest pose of `shape`; without it one is made, without relief. `texture`: its picture.

    Raises:
        InputError: the body has no metaballs, or the picture cannot be read.
    """
    skin = resampled(prepared or rest_skin(shape, settings), detail)
    painted = nodes.image_material(NAME, texture) if texture is not None and texture.is_file() else None
    skin_object = _mesh_object(collection, NAME, skin.vertices_m, skin.faces, skin.uv, painted)
    for name in ATTRIBUTES:
        if (values := getattr(skin, name)) is not None:
            skin_object.data.attributes.new(name, "FLOAT", "POINT").data.foreach_set("value", values.astype(np.float32))
    bind(skin_object, armature_object, skin.bone_names, skin.weights)
    return skin_object


def skin_of_run(out: Path) -> tuple[BodyShape, OneSkin | None]:
    """The body of the results in OUT as its skin shows it, and that skin, if the run wrote one.

    Raises:
        InputError: a file is missing or damaged.
    """
    run = read_run(out / "run.json") if (out / "run.json").is_file() else {}
    settings = from_table(SkinSettings, run.get("settings", {}).get("skin", {}), "[skin] of run.json")
    shape = shape_for_skin(read_body(out / "body.toml"), settings)
    file = out / "skin" / REST
    return shape, read_skin(file, shape) if file.is_file() else None


def in_rest_pose(skin: OneSkin, made: BodyShape, shape: BodyShape) -> OneSkin:
    """The skin that was made in the rest pose of one body, in that of another with the same bones: `shape`."""
    if shape is made:
        return skin
    rest = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    return replace(skin, vertices_m=Poser(made, skin.weights).moved(skin.vertices_m, *rest)[0])


def cache_of(blend: Path) -> Path:
    """The file of the exact skin of a .blend file."""
    return real_place(blend).with_suffix(".pc2")


def add_exact_skin(collection: bpy.types.Collection, shape: BodyShape, skins: FrameSkins, cache: Path) -> bpy.types.Object:
    """The skin cast in every frame. Writes `cache` (.pc2); missing frames repeat the previous skin.

    Raises:
        InputError: the cache cannot be written.
    """
    rest = body_skin(shape, np.zeros(len(shape.skeleton.dof_names)), skins.settings)
    first, last = int(skins.frames[0]), int(skins.frames[-1])
    row_of_frame = np.searchsorted(skins.frames, np.arange(first, last + 1), side="right") - 1
    head = PC2_HEADER.pack(f"{PC2_START}\0".encode(), 1, len(rest.vertices_m), float(first), 1.0, len(row_of_frame))
    store.write_bytes(cache, head + skins.vertices_m[row_of_frame].tobytes())
    skin_object = _mesh_object(collection, EXACT_NAME, rest.vertices_m, rest.faces, corner_uv(rest))
    if len(rest.part_sizes) > 1:  # where parts overlap, shade by the surface they share
        skin_object.data.normals_split_custom_set_from_vertices(rest.normals.tolist())
    modifier = skin_object.modifiers.new(CACHE_MODIFIER, "MESH_CACHE")
    modifier.cache_format, modifier.filepath = "PC2", str(cache)
    modifier.frame_start = float(first)
    return skin_object


def _mesh_object(
    collection: bpy.types.Collection,
    name: str,
    vertices_m: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    material: bpy.types.Material | None = None,
) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices_m.tolist(), [], faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", uv.astype(np.float32).ravel())
    mesh.materials.append(material or nodes.plain_material(name, SKIN_COLOUR))
    mesh.update()
    skin_object = bpy.data.objects.new(name, mesh)
    collection.objects.link(skin_object)
    return skin_object


def bind(skin_object: bpy.types.Object, armature_object: bpy.types.Object, bone_names: Sequence[str], weights: np.ndarray) -> None:
    """Let the armature deform the object, preserving volume, by the bones' weights (V, B)."""
    skin_object.parent = armature_object
    for bone, share in zip(bone_names, weights.T):
        level = np.round(WEIGHT_STEPS * share).astype(int)
        if not level.any():
            continue
        group = skin_object.vertex_groups.new(name=bone)
        for step in np.unique(level[level > 0]):
            group.add(np.flatnonzero(level == step).tolist(), step / WEIGHT_STEPS, "REPLACE")
    modifier = skin_object.modifiers.new("Armature", "ARMATURE")
    modifier.object, modifier.use_deform_preserve_volume = armature_object, True


def implicit_surface(
    shape: BodyShape, dof_values: np.ndarray, monitor: Monitor | None = None, potential: Potential = EXPONENTIAL
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and quads (K, 4) of the surface F = ½ of the body in one pose, `dof_values` (D,) in radians and metres.

    Raises:
        InputError: this Blender was built without OpenVDB.
        Cancelled: the monitor was cancelled.
    """
    openvdb = _openvdb()
    sampled = field_grid(shape, dof_values, IMPLICIT_SPACING_M, monitor, potential)
    grid = openvdb.FloatGrid()
    grid.copyFromArray(THRESHOLD - sampled.values)  # a level set: negative inside
    points, quads = grid.convertToQuads(0.0)
    return sampled.origin_m + IMPLICIT_SPACING_M * points, quads


def add_implicit(
    collection: bpy.types.Collection, surface: tuple[np.ndarray, np.ndarray], frame: int, potential: Potential = EXPONENTIAL
) -> bpy.types.Object:
    """The surface as an object named after the frame, and after the field where it is not the fitted one."""
    points, quads = surface
    mesh = bpy.data.meshes.new(f"Implicit surface {frame:04d}" + (f" {potential.name}" if potential.name != EXPONENTIAL.name else ""))
    mesh.from_pydata(points.tolist(), [], quads.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    mesh.update()
    checked = bpy.data.objects.new(mesh.name, mesh)
    checked.display_type, checked.hide_render = "WIRE", True
    collection.objects.link(checked)
    return checked


def _openvdb():  # type: ignore[no-untyped-def]
    if hasattr(bpy.utils, "expose_bundled_modules"):
        bpy.utils.expose_bundled_modules()
    try:
        import openvdb
    except ImportError as error:
        raise InputError(
            "This Blender was built without OpenVDB for Python, which the implicit surface is made with; "
            "use the Blender from blender.org, or leave it out."
        ) from error
    return openvdb
