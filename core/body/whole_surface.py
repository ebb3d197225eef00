"""The fitted surface of a whole body as a field of places, near the seams of its parts: what skin_roots finds along rays.

    G = (M_trunk^n + M_limb^n)^(1/n) = T ,   M_part = Σ_b u_b F_b   over the part's bones b ,   n = 4          (1)

F_b is the sum of the balls of bone b and of the bones that it meets, as in the fit; u_b is 1 at the bone's middle and passes to the next
bone's about the joint (1b in skin_roots). A place on a limb sees the trunk the less the farther out it lies; a place on the trunk sees its
limbs,

    M_limbs = (Σ M_limb^m)^(1/m) ,   m = 12                                                               (2)

which is the largest, but smooth between two legs. M_trunk is at most 1/τ times what its own balls give (τ = 0.4, skin_roots): two thighs
that nearly touch are no trunk.
"""

from collections.abc import Sequence

import numpy as np

from .metaballs import THRESHOLD, active_balls, local_points, squared_distances
from .shape import BodyShape
from .skeleton import bone_frames
from .skin_parts import body_parts
from .skin_rays import smooth
from .skin_roots import BLEND_POWER, OWN_SHARE, Chain

TAKING_OVER = 12.0  # m of (2)
NEWTON_STEPS = 4
LONGEST_STEP_M = 0.005
CHUNK = 4000
NOTHING = 1e-20


class WholeSurface:
    """The surface (1) of a body in one posture. `part`: (N,) the part that each of the points (N, 3) is a place of."""

    def __init__(self, shape: BodyShape, motion: np.ndarray) -> None:
        self._shape, self._parts = shape, body_parts(shape)
        self._R, self._head = bone_frames(shape.skeleton, shape.lengths_m, np.asarray(motion, dtype=np.float64))
        balls, neighbours = shape.metaballs, shape.skeleton.neighbours
        self._own = np.stack([np.isin(balls.bone_index, part.bones) for part in self._parts], axis=1).astype(np.float64)
        self._part_of = {b: p for p, part in enumerate(self._parts) for b in part.bones}
        self._of_bone = {b: active_balls(balls, neighbours, b).astype(np.float64) for part in self._parts for b in part.bones}

    def of_others(self, points: np.ndarray) -> np.ndarray:
        """At points (N, 3), for each part (N, P): the field there of what it grows out of, without its own balls, over that of its own."""
        return np.concatenate([self._of_others(points[i:i + CHUNK]) for i in range(0, len(points), CHUNK)])

    def _of_others(self, points: np.ndarray) -> np.ndarray:
        terms = self._terms(points)[1]
        found = np.zeros((len(points), len(self._parts)))
        for p, part in enumerate(self._parts):
            if part.parent is not None:
                without = self._of_bones(self._parts[part.parent].bones, points, terms * (1 - self._own[:, p]))[0]
                found[:, p] = without / np.maximum(terms @ self._own[:, p], NOTHING)
        return found

    def reached(self, points: np.ndarray, part: np.ndarray, steps: int = NEWTON_STEPS) -> np.ndarray:
        """Points near the surface, moved onto it."""
        found = np.array(points, dtype=np.float64)
        for first in range(0, len(found), CHUNK):
            rows = slice(first, first + CHUNK)
            for _ in range(steps):
                G, gradient = self._joined(found[rows], part[rows])
                size = np.maximum(np.einsum("nk,nk->n", gradient, gradient), 1e-12)
                step = ((THRESHOLD - G) / size)[:, None] * gradient
                found[rows] += step * np.minimum(1.0, LONGEST_STEP_M / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
        return found

    def distance_m(self, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """How far (N,) points near the surface are off it, outwards positive, to first order."""
        G, gradient = self._joined(points, part)
        return np.asarray((THRESHOLD - G) / np.maximum(np.linalg.norm(gradient, axis=1), 1e-12))

    def slope(self, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """|∇G| (N,) per metre."""
        return np.asarray(np.linalg.norm(self._joined(points, part)[1], axis=1))

    def normals(self, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Outward unit normals (N, 3)."""
        gradient = self._joined(points, part)[1]
        return np.asarray(-gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12))

    def _terms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, d = squared_distances(self._shape.metaballs, self._shape.lengths_m, local_points(self._R, self._head, points))
        return q, self._shape.metaballs.weight * np.exp(-2 * d)

    def _joined(self, points: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """G (N,) and ∇G (N, 3), the slopes of the weights left out.  (1)"""
        q, terms = self._terms(points)
        G, of_ball = np.empty(len(points)), np.empty(terms.shape)
        for p in np.unique(part):
            rows = np.flatnonzero(part == p)
            own, own_balls = self._of_bones(self._parts[p].bones, points[rows], terms[rows])
            other, other_balls = self._others(int(p), points[rows], terms[rows])
            fade = self._fade(int(p), points[rows])
            G[rows] = (own**BLEND_POWER + (fade * other) ** BLEND_POWER) ** (1 / BLEND_POWER)
            share = (own / G[rows]) ** (BLEND_POWER - 1), fade * (fade * other / G[rows]) ** (BLEND_POWER - 1)
            of_ball[rows] = terms[rows] * (share[0][:, None] * own_balls + share[1][:, None] * other_balls)
        balls = self._shape.metaballs
        return G, -4 * np.einsum("nm,nmi,mji->nj", of_ball, q / balls.radii_m, self._R[balls.bone_index], optimize=True)

    def _others(self, p: int, points: np.ndarray, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M (N,) of the parts that may join part p, and the balls that make it (N, M), as factors; smooth where one takes over.  (2)"""
        parent = self._parts[p].parent
        seen = [other.junction for other in self._parts if other.parent == p] + ([self._parts[parent].bones] if parent is not None else [])
        if not seen:
            return np.full(len(points), NOTHING), np.zeros(terms.shape)
        found = [self._of_bones(bones, points, terms) for bones in seen]
        each = np.stack([value for value, _ in found])
        M = (each**TAKING_OVER).sum(axis=0) ** (1 / TAKING_OVER)
        share = (each / M) ** (TAKING_OVER - 1)
        return M, sum((k[:, None] * balls for k, (_, balls) in zip(share, found)), np.zeros(terms.shape))

    def _of_bones(self, bones: Sequence[int], points: np.ndarray, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M (N,) of bones of one part, and the balls that make it (N, M), as factors.  (1)"""
        balls = np.stack([self._of_bone[b] for b in bones])
        factors = Chain.of(bones, self._shape.lengths_m, self._R, self._head).shares(points) @ balls
        M = np.einsum("nm,nm->n", terms, factors)
        p = self._part_of[bones[0]]
        if self._parts[p].parent is not None:
            return np.maximum(M, NOTHING), factors
        own_balls = self._own[:, p] / OWN_SHARE
        own = terms @ own_balls
        return np.maximum(np.minimum(M, own), NOTHING), np.where((own < M)[:, None], own_balls, factors)

    def _station(self, b: int, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self._head[b]) @ self._R[b, :, 1] / self._shape.lengths_m[b])

    def _fade(self, p: int, points: np.ndarray) -> np.ndarray:
        part = self._parts[p]
        if part.parent is None or part.junction[-1] == part.bones[-1]:
            return np.ones(len(points))
        return np.asarray(1 - smooth((self._station(part.junction[-1], points) - 0.5) / 0.5))
