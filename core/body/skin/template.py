"""A cage of quads of our own for a head, a hand or a foot, which takes the place of a part's end."""

from dataclasses import dataclass

import numpy as np

OWN = ""  # the name of the bone that the template is made for among `Template.bones`


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Template:
    """The cage, in the unit and the axes of its bone (extremities)."""

    vertices: np.ndarray  # (V, 3); the first `ring` are its border, to the left of which, seen from outside, is the cage
    faces: np.ndarray  # (F, 4) outside counter-clockwise
    weights: np.ndarray  # (V, K) of `bones`
    bones: tuple[str, ...]
    uv: np.ndarray  # (F, 4, 2) in units of length, from 0
    uv_size: tuple[float, float]
    girth: float  # width of the island at the border
    ring: int
    border_u: np.ndarray  # (ring,) where the border's vertices are around the island, 0…1
    own: np.ndarray  # (V,) 0 to 1: to what degree the weights are `weights`; for the rest they are those of the part's last ring
    column: np.ndarray  # (V,) the vertex of the border below a vertex


def grid_cap(ring: np.ndarray, first_corner: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (M, C) of the inner vertices of a square block of quads within a ring (4 a, C), and the quads (a², 4) of the ring's vertices
    and these, in this order; a harmonic function. `first_corner`: a vertex of the ring."""
    n = len(ring)
    a = n // 4
    number = np.full((a + 1, a + 1), -1)
    walk = (first_corner + np.arange(n)) % n
    number[0, :a], number[:a, a] = walk[:a], walk[a : 2 * a]
    number[a, a:0:-1], number[a:0:-1, 0] = walk[2 * a : 3 * a], walk[3 * a :]
    inner = number < 0
    number[inner] = n + np.arange(inner.sum())
    count = n + int(inner.sum())
    mean = np.zeros((count - n, count))
    for di, dj in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        mean[np.arange(count - n), np.roll(number, (di, dj), axis=(0, 1))[inner]] = 0.25
    found = np.linalg.solve(np.eye(count - n) - mean[:, n:], mean[:, :n] @ ring)
    faces = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    return found, faces


def tube(rings: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quads (F, 4) between rings (R, n) of vertices, and their texture coordinates (F, 4, 2) for u (n + 1) around and v (R) along."""
    on = np.roll(rings, -1, axis=1)
    faces = np.stack([rings[:-1], on[:-1], on[1:], rings[1:]], axis=-1)
    i, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(rings.shape[1]), indexing="ij")
    uv = np.stack([np.stack([u[j], u[j + 1], u[j + 1], u[j]], axis=-1), np.stack([v[i], v[i], v[i + 1], v[i + 1]], axis=-1)], axis=-1)
    return faces.reshape(-1, 4), uv.reshape(-1, 4, 2)


def run_of(rings: np.ndarray) -> np.ndarray:
    """(R,) mean lengths from the first of rings (R, n, 3) of places to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rings, axis=0), axis=2).mean(axis=1))])
