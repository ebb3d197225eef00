"""The skin of a body: contours across the bones, each point cast from the axis to the implicit surface (Thalmann, Shen & Chauvineau
1996; D'Apuzzo et al. 1999). The deformation needs no weights: the metaballs move with the bones, and the surface is computed in each pose.

    shape, pose ── chains of bones (parts) ── rays of their contours (rays) ── outermost roots (roots)
      ──▶ Skin, with B-spline patches between the contours (mesh)

A chain is one closed mesh over all its joints, so elbow, knee, waist and neck have no seam. Chains that grow out of others (arms and legs
out of the trunk) overlap with them on one common surface.

Weights of the bones in the vertices of the skin, with which joints bend over their whole range without self-intersection of the skin.

An armature that preserves volume turns a vertex near a joint, bent by β, by w β about the joint. On the inner side of the bend a vertex at
the distance d along its bone and h off the axis is at the angle 90° + φ from the joint, φ = atan(d/h), and must not be carried past the
bisecting plane of the bend: φ + w β ≥ β/2, increasing with d. So, for all β < 2 atan(D/h),

    w = ½ (1 − atan(d/q)/atan(D/q)) ,   q = max(h, q_0) ,   D = 5 q                                         (1)

which allows 157° for a cylinder. Joints that bend to one side only, such as elbows and knees, have a wide zone there and a narrow one on
the outer side, so that the point of the elbow moves with its bones; the joint's limits define to what degree it is such a hinge.
"""

from collections.abc import Sequence

import numpy as np

from ...foundation.errors import InputError
from ..parts import Part, body_parts
from ..shape import BodyShape
from ..skeleton import Bone, bone_frames
from .mesh import INTERPOLATING, Skin, SkinSettings, chain_faces, refined
from .rays import Rays, Segment, cast, segments_of, swing
from .roots import limb_normals, limb_root, part_root

ZONE = 5.0  # D/q of (1): atan 5 = 79°, with room for limbs that are no cylinders
LEAST_Q = 0.5  # q_0, in limb radii
ROUNDED = 0.4  # the maximum of (1) is rounded over this many limb radii
MOST_BONES = 4  # per vertex, the limit of game engines and glTF
LARGEST_ZONE = 0.95  # of the bone's length: with less, a knee of usual thickness bends only by 130°


def chain_weights(shape: BodyShape, segments: Sequence[Segment], rays: Rays, local_m: np.ndarray) -> np.ndarray:
    """The weights (V, B) of all bones in the vertices of one chain, given in their bones' axes (V, 3); rows sum to 1.  (1)"""
    weights = np.zeros((len(local_m), len(shape.skeleton.bones)))
    for here, segment in enumerate(segments):
        own = np.flatnonzero(rays.bone == segment.bone)
        along = rays.station[own]
        for other, joint, distance in ((here - 1, here, along), (here + 1, here + 1, segment.length - along)):
            if not 0 <= other < len(segments):
                continue
            inner = _inner_side(shape, segments[joint - 1].bone, segments[joint].bone, segment.bone)
            radius = min(segments[joint - 1].radius, segments[joint].radius)
            weights[own, segments[other].bone] = _share(distance, local_m[own] @ inner, radius, segment.length)
        weights[own, segment.bone] = 1 - weights[own].sum(axis=1)
    return weights


def strongest(weights: np.ndarray) -> np.ndarray:
    """The `MOST_BONES` largest weights (V, B) of every vertex, less the next largest, normalised: no bone's weight jumps to 0 or from 0."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, : MOST_BONES + 1]
    largest = np.take_along_axis(weights, order, axis=1)
    less = largest[:, MOST_BONES:] if largest.shape[1] > MOST_BONES else np.zeros((len(weights), 1))
    found = np.zeros(weights.shape)
    np.put_along_axis(found, order[:, :MOST_BONES], largest[:, :MOST_BONES] - (1 - 1e-9) * less, axis=1)  # not all zero if five are equal
    return np.asarray(found / found.sum(axis=1, keepdims=True))


def _share(distance: np.ndarray, inwards: np.ndarray, radius: float, length: float) -> np.ndarray:
    """w of (1) of the bone beyond the joint."""
    least, over = LEAST_Q * radius, inwards - LEAST_Q * radius
    q = least + 0.5 * (over + np.hypot(over, ROUNDED * radius))
    zone = np.minimum(ZONE * q, LARGEST_ZONE * length)
    return np.asarray(0.5 * np.maximum(0.0, 1 - np.arctan2(np.maximum(distance, 0.0), q) / np.arctan2(zone, q)))


def _inner_side(shape: BodyShape, parent: int, child: int, bone: int) -> np.ndarray:
    """`hinge` of the joint of parent and child, in the axes of `bone`, one of both."""
    bones = shape.skeleton.bones
    inner = hinge(bones[child])
    if bone == child:
        return inner
    y_parent, y_child = bones[parent].R_rest[:, 1], bones[child].R_rest[:, 1]
    return np.asarray(bones[parent].R_rest.T @ swing(y_child, y_parent) @ bones[child].R_rest @ inner)


def hinge(bone: Bone) -> np.ndarray:
    """(3,) in the bone's axes: the side to which its joint bends; of length 1 if to that side only, 0 if to all sides equally."""
    middle, reach = np.zeros(3), 0.0
    for dof in bone.dofs:
        if dof.axis == "y":
            continue
        low, high = dof.limits
        if not np.isfinite([low, high]).all():
            return np.zeros(3)
        axis = np.eye(3)["xyz".index(dof.axis)]
        middle += (low + high) / 2 * np.cross(axis, [0.0, 1.0, 0.0])
        reach = max(reach, (high - low) / 2)
    size = float(np.linalg.norm(middle))
    return middle * max(0.0, 2 * size / reach - 1) / size if reach and size else np.zeros(3)


__all__ = ["Skin", "SkinSettings", "body_skin", "limb_skin"]


def limb_skin(shape: BodyShape, motion: np.ndarray, settings: SkinSettings | None = None) -> Skin:
    """The skin of a limb in one pose. `motion` (D,) rad and metres, in the order of the skeleton's DOFs.

    A vertex lies on F = T, with the field of its bone and of the adjacent bones. Two exceptions: where two segments are pressed together
    the vertex stops at the plane between them, and where the metaballs do not surround the axis it is 1 mm from it.
    About 10 ms for two bones at the default settings.

    Raises:
        InputError: the bones with metaballs are no single chain, or the number of rays is odd.
    """
    if len(body_parts(shape)) != 1:
        raise InputError(f"The skin of “{shape.model}” cannot be made: its bones are no single chain; use a model of one limb.")
    return body_skin(shape, motion, settings)


def body_skin(shape: BodyShape, motion: np.ndarray, settings: SkinSettings | None = None) -> Skin:
    """The skin of any body in one pose: one closed mesh per chain of bones, of the same topology in every pose.

    `motion` (D,) rad and metres, in the order of the skeleton's DOFs. Vertices lie as in `limb_skin`, or, where a chain meets the one it
    grows out of, on the joint surface of both or inside the other (roots). A body of one chain has the skin of `limb_skin`.
    With `detail` above 1, B-spline patches through these vertices are cut finer (mesh). A whole body: 0.2 s.

    Raises:
        InputError: there are no metaballs, or the number of rays is odd.
    """
    settings = settings or SkinSettings()
    if settings.rays % 2:
        raise InputError(f"The skin needs an even number of rays, not {settings.rays}; set skin.rays to {settings.rays + 1}.")
    parts = body_parts(shape)
    if not parts:
        raise InputError(f"The skin of “{shape.model}” cannot be made: it has no metaballs; give its bones radii in the model.")
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.asarray(motion, dtype=np.float64))
    vertices, normals, faces, weights, first = [], [], [], [], 0
    for index, part in enumerate(parts):
        segments = segments_of(shape, part.bones, R, head)
        rays = cast(segments, settings)
        found, across = _surface(shape, parts, index, R, head, rays)
        vertices.append(found)
        normals.append(across)
        faces.append(first + chain_faces(len(rays.bone), settings.rays))
        local = np.einsum("vi,vij->vj", found - head[rays.bone], R[rays.bone])
        weights.append(chain_weights(shape, segments, rays, local))
        first += len(rays.bone)
    skin = Skin(
        vertices_m=np.concatenate(vertices),
        faces=np.concatenate(faces),
        weights=np.concatenate(weights),
        bone_names=tuple(bone.name for bone in shape.skeleton.bones),
        part_sizes=tuple(map(len, vertices)),
        normals=np.concatenate(normals),
        rays=settings.rays,
    )
    return skin if settings.detail == 1 and settings.patches == INTERPOLATING else refined(skin, settings.detail, settings.patches)


def _surface(
    shape: BodyShape, parts: tuple[Part, ...], index: int, R: np.ndarray, head: np.ndarray, rays: Rays
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and normals (V, 3) of one part."""
    if len(parts) > 1:
        rho, normals = part_root(shape, parts, index, R, head, rays)
        return rays.origin + rho[:, None] * rays.direction, normals
    vertices = rays.origin + limb_root(shape, R, head, rays)[:, None] * rays.direction
    return vertices, limb_normals(shape, R, head, rays, vertices)
