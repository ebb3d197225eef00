"""The skin of a body: contours across the bones, each point cast from the axis to the implicit surface (Thalmann, Shen & Chauvineau
1996; D'Apuzzo et al. 1999). The deformation needs no weights: the metaballs move with the bones and the surface is found anew.

    shape, posture ── chains of bones (skin_parts) ── rays of their contours (skin_rays) ── outermost roots (skin_roots)
      ──▶ Skin, with B-spline patches between the contours (skin_patches)

A chain is one closed mesh over all its joints, so elbow, knee, waist and neck have no seam. Chains that grow out of others (arms and legs
out of the trunk) overlap with them on one common surface.
"""

import numpy as np

from ..errors import InputError
from .shape import BodyShape
from .skeleton import bone_frames
from .skin_mesh import INTERPOLATING, Skin, SkinSettings, chain_faces
from .skin_parts import Part, body_parts
from .skin_patches import refined
from .skin_rays import Rays, cast, segments_of
from .skin_roots import limb_normals, limb_root, part_root
from .skin_weights import chain_weights

__all__ = ["Skin", "SkinSettings", "body_skin", "limb_skin"]


def limb_skin(shape: BodyShape, motion: np.ndarray, settings: SkinSettings | None = None) -> Skin:
    """The skin of a limb in one posture. `motion` (D,) rad and metres, in the order of the skeleton's DOFs.

    A vertex lies on F = T, with the field of its bone and of the bones that meet it. Two exceptions: where two segments are pressed
    together the vertex stops at the plane between them, and where the metaballs do not reach around the axis it stays 1 mm from it.
    About 10 ms for two bones at the default settings.

    Raises:
        InputError: the bones with metaballs are no single chain, or the number of rays is odd.
    """
    if len(body_parts(shape)) != 1:
        raise InputError(f"The skin of “{shape.model}” cannot be made: its bones are no single chain; use a model of one limb.")
    return body_skin(shape, motion, settings)


def body_skin(shape: BodyShape, motion: np.ndarray, settings: SkinSettings | None = None) -> Skin:
    """The skin of any body in one posture: one closed mesh per chain of bones, of the same topology in every posture.

    `motion` (D,) rad and metres, in the order of the skeleton's DOFs. Vertices lie as in `limb_skin`, or, where a chain meets the one it
    grows out of, on the joint surface of both or inside the other (skin_roots). A body of one chain has the skin of `limb_skin`.
    With `detail` above 1, B-spline patches through these vertices are cut finer (skin_patches). A whole body: 0.2 s.

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
