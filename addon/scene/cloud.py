"""The point clouds of all frames as ONE mesh object; geometry nodes show the points of the current frame.

Named attributes on the points: frame and segment (int, see prepare.py), sigma [m], intensity and speed [m/s] (float), normal and velocity
[m/s] (vector).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.geometry.camera import Camera
from . import nodes

NAME = "Cloud"
POINT_RADIUS_M, POINT_RADIUS_PX = 0.0015, 1.2  # the larger of both, in the image of the camera that the scene is seen through
COLOURS = ("intensity", "sigma", "speed")
REDDEST_PERCENTILE = 98.0  # of the values: painted red


@dataclass(frozen=True, kw_only=True)
class CloudPoints:
    """The points of one frame: xyz_m and normals (N, 3), sigma_m, intensity and segment (N,), velocity_m_s (N, 3), 0 = unknown."""

    frame: int
    xyz_m: np.ndarray
    sigma_m: np.ndarray
    normals: np.ndarray
    intensity: np.ndarray
    velocity_m_s: np.ndarray
    segment: np.ndarray

    @property
    def speed_m_s(self) -> np.ndarray:
        """(N,)"""
        return np.asarray(np.linalg.norm(self.velocity_m_s, axis=1))


def pixel_size_m(camera: Camera, xyz_m: np.ndarray) -> float:
    """How large the pixels of a camera are where the points (N, 3) are, in their median depth; 0 without points before the camera."""
    depth_m = float(np.median(camera.to_camera(xyz_m)[:, 2])) if len(xyz_m) else 0.0
    return max(0.0, depth_m) / float(camera.matrix[0, 0])


def add_cloud(
    collection: bpy.types.Collection, clouds: Sequence[CloudPoints], colour: str = "intensity", pixel_m: float = 0.0
) -> bpy.types.Object:
    """One object with the points of all `clouds`; the viewport shows those of the current frame. `colour` is one of COLOURS; `pixel_m`
    is the size of the camera's pixels there."""
    mesh = bpy.data.meshes.new(NAME)
    mesh.vertices.add(sum(len(cloud.xyz_m) for cloud in clouds))
    write(mesh, "position", "FLOAT_VECTOR", np.concatenate([cloud.xyz_m for cloud in clouds]))
    write(mesh, "normal", "FLOAT_VECTOR", np.concatenate([cloud.normals for cloud in clouds]))
    write(mesh, "sigma", "FLOAT", np.concatenate([cloud.sigma_m for cloud in clouds]))
    write(mesh, "intensity", "FLOAT", np.concatenate([cloud.intensity for cloud in clouds]))
    write(mesh, "speed", "FLOAT", np.concatenate([cloud.speed_m_s for cloud in clouds]))
    write(mesh, "velocity", "FLOAT_VECTOR", np.concatenate([cloud.velocity_m_s for cloud in clouds]))
    write(mesh, "segment", "INT", np.concatenate([cloud.segment for cloud in clouds]))
    write(mesh, "frame", "INT", np.concatenate([np.full(len(cloud.xyz_m), cloud.frame) for cloud in clouds]))
    material = _material(clouds, colour)
    mesh.materials.append(material)
    cloud_object = bpy.data.objects.new(NAME, mesh)
    collection.objects.link(cloud_object)
    modifier = cloud_object.modifiers.new("Current frame", "NODES")
    modifier.node_group = current_frame_group(material, max(POINT_RADIUS_M, POINT_RADIUS_PX * pixel_m))
    return cloud_object


def write(mesh: bpy.types.Mesh, name: str, data_type: str, values: np.ndarray, domain: str = "POINT") -> None:
    """Write a named attribute; `values` has one row per point (or edge, by `domain`)."""
    attribute = mesh.attributes.get(name) or mesh.attributes.new(name, data_type, domain)
    key = "vector" if data_type == "FLOAT_VECTOR" else "value"
    attribute.data.foreach_set(key, np.ascontiguousarray(values, dtype=np.int32 if data_type == "INT" else np.float32).ravel())


def current_frame_group(material: bpy.types.Material, radius_m: float = POINT_RADIUS_M) -> bpy.types.NodeTree:
    """Geometry nodes: keep the points whose attribute `frame` is the current frame, as small spheres of the input `Radius`."""
    group, group_input, group_output = nodes.new_group("Tricap current frame")
    nodes.length_input(group, "Radius", radius_m)
    time = nodes.add(group, "GeometryNodeInputSceneTime")
    selection = nodes.compare(group, "EQUAL", nodes.attribute(group, "frame", "INT"), time.outputs["Frame"])
    points = nodes.add(group, "GeometryNodeMeshToPoints")
    paint_node = nodes.add(group, "GeometryNodeSetMaterial")
    paint_node.inputs["Material"].default_value = material
    group.links.new(group_input.outputs[0], points.inputs["Mesh"])
    group.links.new(group_input.outputs["Radius"], points.inputs["Radius"])
    group.links.new(selection, points.inputs["Selection"])
    group.links.new(points.outputs["Points"], paint_node.inputs["Geometry"])
    group.links.new(paint_node.outputs["Geometry"], group_output.inputs[0])
    nodes.arrange(group)
    return group


def _material(clouds: Sequence[CloudPoints], colour: str) -> bpy.types.Material:
    if colour == "intensity":
        return nodes.attribute_material(NAME, colour, 1.0 / _white(clouds))
    values = np.concatenate([cloud.sigma_m if colour == "sigma" else cloud.speed_m_s for cloud in clouds])
    values = values[np.isfinite(values)]
    reddest = (float(np.percentile(values, REDDEST_PERCENTILE)) if len(values) else 0.0) or 1.0
    return nodes.heat_material(NAME, colour, reddest, nodes.AZURE)


def _white(clouds: Sequence[CloudPoints]) -> float:
    brightest = max((float(cloud.intensity.max(initial=0.0)) for cloud in clouds), default=0.0)
    return brightest or 1.0
