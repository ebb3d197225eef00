"""The mesh of a skin: closed, of quadrilaterals, of the same topology in every pose.

Cubic B-spline patches over the contours of a skin (Thalmann, Shen & Chauvineau 1996), and their polygons in any fineness.

The contours of a part are a net D of points, closed around the bone (u, N points) and closed along it, too: the curve of ray j runs over
the pole into ray j + N/2 and comes back over the other pole. Both directions are uniform cubic B-splines,

    S(u) = Σ_i P_i B(u − i) ,   S(i) = (P_{i−1} + 4 P_i + P_{i+1})/6                                        (1)

Interpolating: the cyclic system (1) is solved for P, so the surface passes through every sample and is twice differentiable everywhere,
over joints and poles as well; each bone's piece is the patch between its two rings, which neighbours share with tangent and curvature.
(A patch clamped at its ends, cut out of this surface by repeating knots, is the same surface.)
Approximating, the literal paper: P = D. A ring of N points on a circle then shrinks by

    1 − (2 + cos(2π/N))/3 :   2.5 % for N = 16, 1.1 % for 24, 0.6 % for 32                                  (2)
"""

from dataclasses import dataclass

import numpy as np

from ...foundation.arrays import frozen
from ...foundation.settings import knob

INTERPOLATING, APPROXIMATING = "interpolating", "approximating"
DETAIL = 2  # of a scene: at 32 rays the quads are 0.15 to 0.25 mm RMS from the surface, with 1 they are 0.7, being flat


@dataclass(frozen=True, kw_only=True, slots=True)
class SkinSettings:
    """The sampling of the skin."""

    contours: int = knob(14, "Contours along each bone.", low=4, high=200)
    rays: int = knob(32, "Points on each contour (an even number).", low=8, high=400)
    cap_contours: int = knob(5, "Contours that close each end of the limb.", low=2, high=100)
    detail: int = knob(
        1, "Subdivisions of each edge between contours and points, by B-spline patches; 1: the points alone.", low=1, high=16
    )
    patches: str = knob(
        INTERPOLATING,
        "B-spline patches go through the points, or approximate them and shrink a little.",
        choices=(INTERPOLATING, APPROXIMATING),
    )
    exact: bool = knob(
        False,
        "Cast the skin of every frame onto the fitted surface (0.3 s a frame), instead of moving that of the rest pose with the bones.",
    )
    anatomy: bool = knob(
        True, "Anatomical heads, hands and feet, with jaw, fingers, heel and toes, instead of the three fitted balls of a bone."
    )
    fair: bool = knob(True, "Smooth the rings and ledges that come from the metaballs.")
    relief: bool = knob(True, "Displace the skin to the measured surface of all frames.")
    texture_px: int = knob(1024, "Width and height of the texture from the footage; 0: none.", unit="px", low=0, high=8192)
    mirror: bool = knob(False, "Where only the other side of the body was measured, use its relief, mirrored.")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Skin:
    """A closed mesh, outside counter-clockwise, of the same topology in every pose."""

    vertices_m: np.ndarray  # (V, 3) world: the pole at the base, contour after contour, the pole at the end
    faces: np.ndarray  # (F, 4)
    weights: np.ndarray  # (V, B) of each bone of the skeleton in a vertex; rows sum to 1
    bone_names: tuple[str, ...]
    normals: np.ndarray  # (V, 3) outward, of the implicit surface
    part_sizes: tuple[int, ...]  # vertices of each part, in order; every part is closed
    rays: int  # points on each contour

    def __post_init__(self) -> None:
        v = len(self.vertices_m)
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "faces", frozen(self.faces, (None, 4), np.int64, "faces"))
        object.__setattr__(self, "normals", frozen(self.normals, (v, 3), name="normals"))
        object.__setattr__(self, "weights", frozen(self.weights, (v, len(self.bone_names)), name="weights"))

    @property
    def triangles(self) -> np.ndarray:
        """The faces as triangles (2 F, 3)."""
        return np.stack([self.faces[:, [0, 1, 2]], self.faces[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


def chain_faces(n_vertices: int, rays: int) -> np.ndarray:
    """Faces (F, 4) of contours of `rays` points, closed by poles: quadrilaterals; at the poles each spans two edges of the contour."""
    contours = (n_vertices - 2) // rays
    i, j = np.meshgrid(np.arange(contours - 1), np.arange(rays), indexing="ij")
    here, on = 1 + i * rays + j, 1 + i * rays + (j + 1) % rays
    sides = np.stack([here, on, on + rays, here + rays], axis=-1).reshape(-1, 4)
    k = np.arange(0, rays, 2)
    first, last = 1 + np.stack([k, k + 1, (k + 2) % rays], axis=1), n_vertices - 1 - rays + np.stack([k, k + 1, (k + 2) % rays], axis=1)
    start = np.column_stack([np.zeros(len(k), dtype=np.int64), first[:, ::-1]])
    end = np.column_stack([np.full(len(k), n_vertices - 1), last])
    return np.concatenate([start, sides, end])


def refined(skin: Skin, detail: int, mode: str = INTERPOLATING) -> Skin:
    """The skin's B-spline patches as polygons: every edge of the contours' net in `detail` pieces (1: the net's own points).

    Interpolating, the vertices of `skin` are among those of the result. Normals are those of the B-spline surface. About 40 ms for a
    whole body at detail 2.

    Raises:
        ValueError: `detail` is below 1 or the mode is unknown.
    """
    if detail < 1 or mode not in (INTERPOLATING, APPROXIMATING):
        raise ValueError(f"detail {detail}, mode {mode!r}")
    vertices, normals, weights, faces, sizes, begin, first = [], [], [], [], [], 0, 0
    for size in skin.part_sizes:
        part = slice(begin, begin + size)
        points, across = _surface(skin.vertices_m[part], skin.rays, detail, mode)
        vertices.append(points)
        normals.append(across)
        weights.append(_between(skin.weights[part], skin.rays, detail))
        faces.append(first + chain_faces(len(points), skin.rays * detail))
        sizes.append(len(points))
        begin, first = begin + size, first + len(points)
    return Skin(
        vertices_m=np.concatenate(vertices),
        normals=np.concatenate(normals),
        weights=np.concatenate(weights),
        faces=np.concatenate(faces),
        bone_names=skin.bone_names,
        part_sizes=tuple(sizes),
        rays=skin.rays * detail,
    )


def control_net(net: np.ndarray, mode: str = INTERPOLATING) -> np.ndarray:
    """P (I, J, 3) of (1) for samples (I, J, 3), closed in both directions."""
    return _solved(_solved(net, 0), 1) if mode == INTERPOLATING else net


def shrinkage(rays: int) -> float:
    """By how much the approximating variant shrinks a circle of `rays` points, as a fraction of its radius.  (2)"""
    return float(1 - (2 + np.cos(2 * np.pi / rays)) / 3)


def corner_uv(skin: Skin) -> np.ndarray:
    """Texture coordinates (F, 4, 2) of the faces' corners: u around the bone, v along the part; parts side by side in u."""
    return chains_uv(skin.part_sizes, skin.rays, skin.faces)


def chains_uv(sizes: tuple[int, ...], rays: int, faces: np.ndarray) -> np.ndarray:
    """The same for parts of so many vertices each, on contours of `rays`, with faces (F, 4)."""
    count, strip = sum(sizes), 1.0 / len(sizes)
    uv, around, first = np.empty((count, 2)), np.empty(count), 0
    for i, size in enumerate(sizes):
        rings = (size - 2) // rays
        ring = np.repeat(np.arange(1, rings + 1), rays)
        uv[first : first + size, 1] = np.concatenate([[0], ring, [rings + 1]]) / (rings + 1)
        uv[first : first + size, 0] = i * strip
        around[first : first + size] = np.concatenate([[np.nan], np.tile(np.arange(rays), rings) / rays, [np.nan]])
        first += size
    u = around[faces]
    u = np.where((np.nanmax(u, axis=1) > 0.75)[:, None] & (u < 0.25), u + 1.0, u)  # over the seam
    u = np.where(np.isnan(u), np.nanmean(u, axis=1, keepdims=True), u)
    return np.stack([uv[faces, 0] + 0.98 * strip * u, uv[faces, 1]], axis=-1)


def _surface(points: np.ndarray, rays: int, detail: int, mode: str) -> tuple[np.ndarray, np.ndarray]:
    net = control_net(_closed_net(points, rays), mode)
    value, along = _evaluated(net, 0, detail)
    S, S_around = _evaluated(value, 1, detail)
    S_along = _evaluated(along, 1, detail)[0]
    normals = np.cross(S_around, S_along)
    half = (len(points) - 2) // rays * detail + detail
    rings = slice(1, half)
    return _listed(S, rings, half), _unit(_listed(_with_poles(normals, S_along, half), rings, half))


def _closed_net(points: np.ndarray, rays: int) -> np.ndarray:
    """The samples (2 C + 2, rays, 3): pole, the C contours, pole, and the contours of the opposite rays back."""
    rings = points[1:-1].reshape(-1, rays, points.shape[1])
    pole = [np.broadcast_to(points[i], (1, *rings.shape[1:])) for i in (0, -1)]
    return np.concatenate([pole[0], rings, pole[1], np.roll(rings, -(rays // 2), axis=1)[::-1]])


def _listed(grid: np.ndarray, rings: slice, half: int) -> np.ndarray:
    return np.concatenate([grid[:1, 0], grid[rings].reshape(-1, grid.shape[2]), grid[half : half + 1, 0]])


def _with_poles(normals: np.ndarray, along: np.ndarray, half: int) -> np.ndarray:
    """At a pole all around is one point; there two curves that cross give the normal."""
    quarter = normals.shape[1] // 4
    for row, sign in ((0, -1), (half, 1)):
        normals[row] = sign * np.cross(along[row, 0], along[row, quarter])
    return normals


def _solved(net: np.ndarray, axis: int) -> np.ndarray:
    """The cyclic system (1): circulant, so a division of spectra; its eigenvalues (2 + cos)/3 lie between 1/3 and 1."""
    n = net.shape[axis]
    eigenvalues = (2 + np.cos(2 * np.pi * np.arange(n // 2 + 1) / n)) / 3
    shape = [1] * net.ndim
    shape[axis] = -1
    return np.asarray(np.fft.irfft(np.fft.rfft(net, axis=axis) / eigenvalues.reshape(shape), n, axis=axis))


def _evaluated(net: np.ndarray, axis: int, detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Values and derivatives of (1) at `detail` places in every interval along `axis`."""
    t = np.arange(detail) / detail
    basis = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
    slope = np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2]) / 2
    points = np.stack([np.roll(np.moveaxis(net, axis, 0), 1 - k, axis=0) for k in range(4)])  # i − 1, i, i + 1, i + 2
    found = []
    for b in (basis, slope):
        values = np.einsum("kt,kijc->itjc", b, points)
        found.append(np.moveaxis(values.reshape(-1, *values.shape[2:]), 0, axis))
    return found[0], found[1]


def _between(weights: np.ndarray, rays: int, detail: int) -> np.ndarray:
    """The bones' shares (V', B), linear between the contours and around them."""
    rings = weights[1:-1].reshape(-1, rays, weights.shape[1])
    poles = (np.broadcast_to(weights[i], (1, *rings.shape[1:])) for i in (0, -1))
    net = np.concatenate([next(poles), rings, next(poles)])
    part = (np.arange(detail) / detail)[:, None, None]
    along = np.concatenate([((1 - part) * net[:-1, None] + part * net[1:, None]).reshape(-1, *net.shape[1:]), net[-1:]])
    ahead = np.roll(along, -1, axis=1)
    fine = ((1 - part[:, 0]) * along[:, :, None] + part[:, 0] * ahead[:, :, None]).reshape(len(along), -1, net.shape[2])
    return np.concatenate([weights[:1], fine[1:-1].reshape(-1, net.shape[2]), weights[-1:]])


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300))
