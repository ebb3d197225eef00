"""The trajectories of all tracked points as ONE mesh of edges; geometry nodes show the trail up to the current frame.

A point that is visible in two successive frames gives an edge. Named attributes on the points: frame, track and segment (int, see
prepare.py), sigma [m] and speed [m/s] (float), velocity [m/s] (vector).
"""

from collections.abc import Mapping

import bpy
import numpy as np

from ...core.tracking.reasons import REASON_COLOURS
from ...core.tracking.settings import TrackStatus
from . import nodes
from .cloud import write

NAME, ARROWS_NAME, BENDS_NAME, REMOVED_NAME = "Trajectories", "Velocities", "Accelerations", "Removed trajectories"
ARROW_S = 0.1  # an arrow has the length of the path in this time
BEND_S2 = 0.02  # an arrow of an acceleration is it times this
BARB = 0.25  # length of an arrow's barbs, as a fraction of it
TRAIL_FRAMES = 10
TRAIL_RADIUS_M, TRAIL_RADIUS_PX = 0.0006, 0.6  # the larger of both, as of the cloud's points
REDDEST_SPEED_M_S = 2.0  # painted red
REDDEST_M_S2 = 20.0  # painted red


def add_trajectories(
    collection: bpy.types.Collection, arrays: Mapping[str, np.ndarray], trail: int = TRAIL_FRAMES, radius_m: float = TRAIL_RADIUS_M
) -> bpy.types.Object:
    """One object, whose trails are `trail` frames long and `radius_m` thick, from the arrays of trajectories.npz and the bones of their
    points: frames (T,), xyz_m (T, N, 3) with NaN = not visible, velocity_m_s, sigma_m (T, N), segment (T, N)."""
    xyz, frames = arrays["xyz_m"], arrays["frames"]
    visible = np.isfinite(xyz).all(axis=-1)  # (T, N)
    row, track = np.nonzero(visible)
    index = np.full(visible.shape, -1)
    index[row, track] = np.arange(len(row))
    joined = visible[:-1] & visible[1:] & (np.diff(frames) == 1)[:, None]
    edges = np.stack([index[:-1][joined], index[1:][joined]], axis=-1)
    mesh = bpy.data.meshes.new(NAME)
    mesh.vertices.add(len(row))
    mesh.edges.add(len(edges))
    mesh.edges.foreach_set("vertices", np.ascontiguousarray(edges, dtype=np.int32).ravel())
    write(mesh, "position", "FLOAT_VECTOR", xyz[visible])
    write(mesh, "frame", "INT", frames[row])
    write(mesh, "track", "INT", track)
    write(mesh, "sigma", "FLOAT", np.nan_to_num(arrays["sigma_m"][visible]))
    velocity = np.nan_to_num(arrays["velocity_m_s"][visible])
    write(mesh, "speed", "FLOAT", np.linalg.norm(velocity, axis=-1))
    write(mesh, "velocity", "FLOAT_VECTOR", velocity)
    write(mesh, "segment", "INT", arrays["segment"][visible])
    mesh.update()
    material = nodes.heat_material(NAME, "speed", REDDEST_SPEED_M_S)
    mesh.materials.append(material)
    trail_object = bpy.data.objects.new(NAME, mesh)
    collection.objects.link(trail_object)
    trail_object.modifiers.new("Trail", "NODES").node_group = trail_group(material, trail, radius_m)
    return trail_object


def sparser(arrays: Mapping[str, np.ndarray], most: int) -> tuple[Mapping[str, np.ndarray], int]:
    """Every k-th trajectory, so that at most about `most` positions are left, and k."""
    k = -(-int(np.isfinite(arrays["xyz_m"][..., 0]).sum()) // most) or 1
    return (arrays if k == 1 else {name: a[:, ::k] if a.ndim > 1 else a for name, a in arrays.items()}), k


def trail_radius_m(pixel_m: float) -> float:
    """The radius of trails where the camera's pixels have this size."""
    return max(TRAIL_RADIUS_M, TRAIL_RADIUS_PX * pixel_m)


def add_removed(
    collection: bpy.types.Collection, raw: Mapping[str, np.ndarray], most: int, radius_m: float = TRAIL_RADIUS_M
) -> bpy.types.Object:
    """One object with what the filters removed, from the arrays of trajectories_raw.npz (frames, xyz_m, status), coloured by reason as in
    the report; of more than `most` positions every n-th trajectory. Attributes of the points: frame, track, reason (TrackStatus)."""
    gone = np.isfinite(raw["xyz_m"]).all(axis=-1) & (raw["status"] != TrackStatus.MEASURED)
    every = -(-int(gone.sum()) // most) or 1
    xyz, status, gone = raw["xyz_m"][:, ::every], raw["status"][:, ::every], gone[:, ::every]
    ends = gone.copy()
    ends[:-1] |= gone[1:] & np.isfinite(xyz[:-1]).all(axis=-1)  # a line goes on from the last position that was kept
    row, track = np.nonzero(ends)
    index = np.full(ends.shape, -1)
    index[row, track] = np.arange(len(row))
    joined = ends[:-1] & gone[1:] & (np.diff(raw["frames"]) == 1)[:, None]
    edges = np.stack([index[:-1][joined], index[1:][joined]], axis=-1)
    mesh = bpy.data.meshes.new(REMOVED_NAME)
    mesh.vertices.add(len(row))
    mesh.edges.add(len(edges))
    mesh.edges.foreach_set("vertices", np.ascontiguousarray(edges, dtype=np.int32).ravel())
    write(mesh, "position", "FLOAT_VECTOR", xyz[ends])
    write(mesh, "frame", "INT", raw["frames"][row])
    write(mesh, "track", "INT", every * track)
    write(mesh, "reason", "INT", status[ends])
    table = np.tile(np.array([0.3, 0.3, 0.3]), (max(TrackStatus) + 1, 1))
    for reason, bgr in REASON_COLOURS.items():
        table[reason] = (np.array(bgr[::-1]) / 255) ** 2.2
    write(mesh, "colour", "FLOAT_VECTOR", table[status[ends]])
    mesh.update()
    material = nodes.coloured_material(REMOVED_NAME, "colour")
    mesh.materials.append(material)
    removed = bpy.data.objects.new(REMOVED_NAME, mesh)
    collection.objects.link(removed)
    removed.modifiers.new("Trail", "NODES").node_group = trail_group(material, radius_m=radius_m)
    return removed


def add_bends(collection: bpy.types.Collection, arrays: Mapping[str, np.ndarray], radius_m: float = TRAIL_RADIUS_M) -> bpy.types.Object:
    """The accelerations as arrows; see `add_arrows`."""
    return _arrows(collection, arrays, BENDS_NAME, arrays["acceleration_m_s2"], BEND_S2, REDDEST_M_S2, radius_m)


def add_arrows(collection: bpy.types.Collection, arrays: Mapping[str, np.ndarray], radius_m: float = TRAIL_RADIUS_M) -> bpy.types.Object:
    """One object with an arrow for the velocity of every point in every frame; the viewport shows those of the current frame."""
    return _arrows(collection, arrays, ARROWS_NAME, arrays["velocity_m_s"], ARROW_S, REDDEST_SPEED_M_S, radius_m)


def _arrows(
    collection: bpy.types.Collection,
    arrays: Mapping[str, np.ndarray],
    name: str,
    vectors: np.ndarray,
    scale: float,
    reddest: float,
    radius_m: float,
) -> bpy.types.Object:
    """Arrows of `vectors` (T, N, 3) times `scale` at the points, with their size as the attribute speed."""
    known = np.isfinite(arrays["xyz_m"]).all(axis=-1) & np.isfinite(vectors).all(axis=-1)
    row, _ = np.nonzero(known)
    at, velocity = arrays["xyz_m"][known], vectors[known]
    arrow = scale * velocity
    aside = np.cross(arrow, [0.0, 1.0, 0.0])
    aside *= 0.5 * BARB * np.linalg.norm(arrow, axis=1, keepdims=True) / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
    corners = np.stack([at, at + arrow, at + (1 - BARB) * arrow + aside, at + (1 - BARB) * arrow - aside], axis=1)
    edges = 4 * np.arange(len(at))[:, None, None] + np.array([[0, 1], [1, 2], [1, 3]])
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(4 * len(at))
    mesh.edges.add(3 * len(at))
    mesh.edges.foreach_set("vertices", np.ascontiguousarray(edges, dtype=np.int32).ravel())
    write(mesh, "position", "FLOAT_VECTOR", corners.reshape(-1, 3))
    write(mesh, "frame", "INT", np.repeat(arrays["frames"][row], 4))
    write(mesh, "speed", "FLOAT", np.repeat(np.linalg.norm(velocity, axis=1), 4))
    mesh.update()
    material = nodes.heat_material(name, "speed", reddest)
    mesh.materials.append(material)
    arrows_object = bpy.data.objects.new(name, mesh)
    collection.objects.link(arrows_object)
    arrows_object.modifiers.new("Current frame", "NODES").node_group = trail_group(material, 0, radius_m)
    return arrows_object


def trail_group(material: bpy.types.Material, frames: int = TRAIL_FRAMES, radius_m: float = TRAIL_RADIUS_M) -> bpy.types.NodeTree:
    """Geometry nodes: the edges of the last `Trail` frames before the current one, as thin tubes of the input `Radius`."""
    group, group_input, group_output = nodes.new_group("Tricap trail")
    trail = group.interface.new_socket("Trail", in_out="INPUT", socket_type="NodeSocketInt")
    trail.default_value, trail.min_value = frames, 0
    nodes.length_input(group, "Radius", radius_m)
    now = nodes.add(group, "GeometryNodeInputSceneTime").outputs["Frame"]
    frame = nodes.attribute(group, "frame", "INT")
    begin = nodes.math(group, "SUBTRACT", now, group_input.outputs["Trail"])
    both = nodes.add(group, "FunctionNodeBooleanMath", operation="AND")
    group.links.new(nodes.compare(group, "LESS_EQUAL", frame, now), both.inputs[0])
    group.links.new(nodes.compare(group, "GREATER_EQUAL", frame, begin), both.inputs[1])
    keep = nodes.add(group, "GeometryNodeSeparateGeometry", domain="POINT")
    curve = nodes.add(group, "GeometryNodeMeshToCurve")
    profile = nodes.add(group, "GeometryNodeCurvePrimitiveCircle")
    profile.inputs["Resolution"].default_value = 3
    group.links.new(group_input.outputs["Radius"], nodes.active(profile.inputs, "Radius"))
    tube = nodes.add(group, "GeometryNodeCurveToMesh")
    paint_node = nodes.add(group, "GeometryNodeSetMaterial")
    paint_node.inputs["Material"].default_value = material
    chain = (
        (group_input.outputs[0], keep.inputs["Geometry"]),
        (both.outputs[0], keep.inputs["Selection"]),
        (keep.outputs["Selection"], curve.inputs["Mesh"]),
        (curve.outputs["Curve"], tube.inputs["Curve"]),
        (profile.outputs["Curve"], tube.inputs["Profile Curve"]),
        (tube.outputs["Mesh"], paint_node.inputs["Geometry"]),
        (paint_node.outputs["Geometry"], group_output.inputs[0]),
    )
    for source, target in chain:
        group.links.new(source, target)
    nodes.arrange(group)
    return group
