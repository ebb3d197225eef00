"""The skin without the rings and ledges of a body made of few metaballs: its mean curvature is smoothed, not its position.

The curvature of a sum of balls rises and falls with the balls, and jumps where limbs leave the trunk. The smooth surface x nearest to the
skin x⁰ with the smoothed mean curvature h̃ (after Eigensatz, Sumner & Pauly 2008, Computer Graphics Forum 27(2), curvature-domain shape
processing; M, C and the normals n of surface_operators):

    (M + ℓ² K) h̃ = M h ,   h = n·M⁻¹C x⁰ ,   K = −C                                                        (1)
    ‖M^(−½) (C x − M h̃ n)‖² + ‖w⁻² M^½ (x − x⁰)‖² → min                                                    (2)

A cylinder or a sphere stays as it is, at any radius, where smoothing of positions would shrink it. Heads, hands and feet, made of
anatomical balls, keep their shape (w → 0, and Δx⁰ in place of h̃ n), with a smooth transition. Applied again, with smaller widths, to the
skin with relief, whose points are 1 cm apart: a finer wave is noise, and an edge is left over from a fold of the skin at a joint.
"""

from dataclasses import dataclass

import numpy as np

from ..shape import BodyShape
from .extremities import TABLES
from .fingers import FINGER_BONE
from .surface_operators import factorised, laplacian, vertex_normals


@dataclass(frozen=True, slots=True)
class Widths:
    """ℓ of (1), w of (2), and w at heads, hands and feet [m]; waves shorter than some 2π w vanish if the smoothed curvature has none."""

    curvature: float
    tie: float
    anatomical: float


OF_BALLS = Widths(0.05, 0.09, 0.006)
OF_RELIEF = Widths(0.015, 0.008, 0.003)
STEPS = 2  # the second with the normals of the first


def anatomical(shape: BodyShape, weights: np.ndarray) -> np.ndarray:
    """(V,) 0 to 1: to what degree vertices with these weights (V, B) belong to bones with anatomical shapes."""
    own = [
        bone.name.removesuffix(".R").removesuffix(".L") in TABLES or bool(FINGER_BONE.fullmatch(bone.name)) for bone in shape.skeleton.bones
    ]
    return np.asarray(weights[:, own].sum(axis=1))


def faired(vertices: np.ndarray, faces: np.ndarray, kept: np.ndarray, widths: Widths = OF_BALLS) -> np.ndarray:
    """Vertices (V, 3) of the fair surface; `kept` (V,) 0 to 1: to what degree each keeps its place.  (1), (2)"""
    from scipy import sparse

    found = vertices
    tie = np.exp((1 - kept) * np.log(widths.tie) + kept * np.log(widths.anatomical)) ** -4
    for _ in range(STEPS):
        C, area = laplacian(found, faces)
        M, normals = sparse.diags(area), vertex_normals(found, faces)
        h = np.einsum("vk,vk->v", normals, C @ found) / area
        smooth = factorised(M - widths.curvature**2 * C).solve(area * h)
        wanted = kept[:, None] * (C @ found) / area[:, None] + ((1 - kept) * smooth)[:, None] * normals
        normal = C.T @ sparse.diags(1 / area) @ C
        right = C.T @ wanted + (tie * area)[:, None] * vertices
        found = factorised(normal, tie * area).solve(right)
    return np.asarray(found)
