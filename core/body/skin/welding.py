"""One net of quads from the closed parts of a skin: limbs are sewn into the trunk, ring to ring.

    an arm   a block of a × b quads of the trunk is removed, with 2 (a + b) = N the points of a limb's ring; its border becomes the arm's
             first ring, and rings between it and the first ring outside the trunk bridge the gap                        (1)
    legs     two limbs at the trunk's first bone: the trunk ends in a ring of N; a line of N/2 − 1 points under the crotch
             halves it, so that each leg's first ring is half of that ring and the line                                  (2)

Modellers join limbs like this: only quads, and only the corners of the blocks, the ends of the crotch's line and the poles have other than
four neighbours. The parts' fields in the pose of the parts' skin decide to which part a vertex belongs.

Quads of nets of rings, their texture coordinates, and their subdivision.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..parts import Part
from .mesh import Skin
from .packing import packed
from .whole_surface import WholeSurface

OUTSIDE = 0.5  # a ring is outside the parent part where the parent's field is below this fraction of the limb's
LEAST_SIDE = 2  # quads along a side of a block
PROJECTION_STEPS = 20  # Newton's, of 5 mm at most


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Net:
    """The rings of one part, by indices of the vertices of the whole net."""

    rings: np.ndarray  # (C, N)
    poles: tuple[int | None, int | None]  # before the first ring and after the last; None: open
    kept: np.ndarray  # (C − 1, N) bool: whether the quad from ring i to i + 1 and from column j to j + 1 exists


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Welded:
    """The parts as one net."""

    vertices_m: np.ndarray  # (V, 3)
    weights: np.ndarray  # (V, B)
    nets: tuple[Net, ...]  # one a part
    part: np.ndarray  # (V,) the part to which a vertex belongs; those of a limb's first ring belong to the trunk
    sewn: np.ndarray  # (V,) bool: new vertices, and those of the rings that they join


class _Sewing:
    """The growing lists of vertices; the parts' own vertices keep their indices."""

    def __init__(self, skin: Skin) -> None:
        self.places, self.weights = [skin.vertices_m], [skin.weights]
        self.count = len(skin.vertices_m)

    def added(self, places: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """The indices of new vertices (n, 3) with weights (n, B)."""
        self.places.append(places)
        self.weights.append(weights)
        self.count += len(places)
        return np.arange(self.count - len(places), self.count)

    def project(self, surface: WholeSurface, numbers: np.ndarray, part: int) -> None:
        """Move new vertices onto the surface, as points of a part."""
        places = np.concatenate(self.places)
        places[numbers] = surface.projected(places[numbers], np.full(len(numbers), part), PROJECTION_STEPS)
        self.places = [places]

    def at(self, numbers: np.ndarray) -> np.ndarray:
        """Positions (…, 3)."""
        return np.asarray(np.concatenate(self.places)[numbers])

    def shares(self, numbers: np.ndarray) -> np.ndarray:
        """Weights (…, B)."""
        return np.asarray(np.concatenate(self.weights)[numbers])


def welded(skin: Skin, parts: tuple[Part, ...], surface: WholeSurface) -> Welded:
    """The parts of `skin` (`body_skin`, detail 1) sewn together; new vertices are on the surface, but unevenly spaced."""
    sewing, nets = _Sewing(skin), _own_nets(skin)
    parent_ratio = surface.parent_ratio(skin.vertices_m).T
    joined: list[np.ndarray] = []
    for trunk, part in enumerate(parts):
        limbs = [i for i, other in enumerate(parts) if other.parent == trunk]
        forked = [i for i in limbs if parts[i].attachment == part.bones[0]]
        loops: dict[int, np.ndarray] = {}
        if len(forked) == 2:
            inside = parent_ratio[forked].min(axis=0)[nets[trunk].rings] < 1
            nets[trunk], halves, line = _forked(sewing, nets[trunk], nets[forked[0]], inside)
            sewing.project(surface, line, trunk)
            loops |= dict(zip(forked, halves))
        for i in limbs:
            if i not in loops:
                nets[trunk], loops[i] = _block_out(sewing, nets[trunk], nets[i], parent_ratio[i, nets[trunk].rings] < 1)
        for i, loop in loops.items():
            nets[i], ring = _sewn_on(sewing, nets[i], loop, parent_ratio[i])
            sewing.project(surface, ring[len(loop) : -len(loop)], i)
            joined.append(ring)
    return _compact(sewing, parts, nets, np.concatenate([np.zeros(0, dtype=np.int64), *joined]), len(skin.vertices_m))


def _own_nets(skin: Skin) -> list[Net]:
    nets, begin = [], 0
    for size in skin.part_sizes:
        rings = begin + 1 + np.arange(size - 2).reshape(-1, skin.rays)
        nets.append(Net(rings=rings, poles=(begin, begin + size - 1), kept=np.ones((len(rings) - 1, skin.rays), dtype=bool)))
        begin += size
    return nets


def _first_outside(net: Net, parent_ratio: np.ndarray) -> int:
    """The first ring from which on all are outside the parent part; at least one ring is left after it."""
    mixed = (parent_ratio[net.rings] > OUTSIDE).any(axis=1)
    return min(int(np.flatnonzero(mixed)[-1]) + 1 if mixed.any() else 0, len(net.rings) - 2)


def _column(sewing: _Sewing, ring: np.ndarray, place: np.ndarray) -> float:
    """The column (fractional) of a ring in whose direction a point lies."""
    points = sewing.at(ring)
    centre = points.mean(axis=0)
    axis = np.cross(points - centre, np.roll(points, -1, axis=0) - centre).sum(axis=0)  # whatever its points' own tilt
    spokes = np.stack([points[0], points[len(ring) // 4], place]) - centre
    first, quarter, towards = spokes - np.outer(spokes @ axis / (axis @ axis), axis)
    a, b = np.linalg.lstsq(np.stack([first, quarter], axis=1), towards, rcond=None)[0]
    angle = np.arctan2(b, a)
    return float(angle / (2 * np.pi) * len(ring))


def _forked(sewing: _Sewing, net: Net, limb: Net, inside: np.ndarray) -> tuple[Net, list[np.ndarray], np.ndarray]:
    """(2): the trunk above its fork, the first ring of both limbs, `limb` first, and the crotch's line.

    `inside` (C, N): the trunk's points inside one of the limbs.
    """
    rays = net.rings.shape[1]
    mixed = inside.any(axis=1) & (np.arange(len(net.rings)) < len(net.rings) // 2)
    level = min(int(np.flatnonzero(mixed)[-1]) + 1 if mixed.any() else 0, len(net.rings) - 3)
    ring = net.rings[level]
    column = round(_column(sewing, ring, sewing.at(limb.rings[len(limb.rings) // 3]).mean(axis=0)) + rays / 4)
    ends = column % rays, (column + rays // 2) % rays
    line = _crotch(sewing, net, level, ends)
    back = (ends[0] - np.arange(rays // 2 + 1)) % rays, (ends[1] - np.arange(rays // 2 + 1)) % rays
    loops = [np.concatenate([ring[back[0]], line[::-1]]), np.concatenate([ring[back[1]], line])]
    return Net(rings=net.rings[level:], poles=(None, net.poles[1]), kept=net.kept[level:]), loops, line


def _crotch(sewing: _Sewing, net: Net, level: int, ends: tuple[int, int]) -> np.ndarray:
    """N/2 − 1 new vertices on the trunk's surface from column to column over the pole, evenly spaced."""
    down, up = net.rings[level::-1, ends[0]], net.rings[: level + 1, ends[1]]
    path = np.concatenate([down, [net.poles[0]], up]).astype(np.int64)
    places = sewing.at(path)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    half = net.rings.shape[1] // 2
    at = np.linspace(0, run[-1], half + 1)[1:-1]
    shares = sewing.shares(path)
    return sewing.added(
        np.stack([np.interp(at, run, places[:, k]) for k in range(3)], axis=1),
        np.stack([np.interp(at, run, shares[:, b]) for b in range(shares.shape[1])], axis=1),
    )


def _block_out(sewing: _Sewing, net: Net, limb: Net, inside: np.ndarray) -> tuple[Net, np.ndarray]:
    """(1): the trunk without the block where the limb leaves it, and the block's border. `inside` (C, N): trunk's points in the limb."""
    n_rings, rays = net.rings.shape
    rows = np.flatnonzero(inside.any(axis=1))
    outward = sewing.at(limb.rings[len(limb.rings) // 2]).mean(axis=0)
    if not len(rows):
        rows = np.array([np.linalg.norm(sewing.at(net.rings) - outward, axis=2).min(axis=1).argmin()])
    wide, tall = int(inside.sum(axis=1).max()) + 1, int(np.ptp(rows)) + 2
    a = int(np.clip(2 * round(rays / 4 * wide / (wide + tall)), LEAST_SIDE, rays // 2 - LEAST_SIDE))  # even: the limb in its middle
    b = rays // 2 - a
    row = int(np.clip(round(float(rows.min() + rows.max() - b) / 2), 1, n_rings - 2 - b))
    column = round(_column(sewing, net.rings[row + b // 2], outward) - a / 2)
    across, along = (column + np.arange(a + 1)) % rays, row + np.arange(b + 1)
    kept = net.kept.copy()
    kept[np.ix_(along[:-1], across[:-1])] = False
    border = [
        net.rings[row, across[:-1]],
        net.rings[along[:-1], across[-1]],
        net.rings[row + b, across[:0:-1]],
        net.rings[along[:0:-1], across[0]],
    ]
    return Net(rings=net.rings, poles=net.poles, kept=kept), np.concatenate(border)


def _sewn_on(sewing: _Sewing, net: Net, loop: np.ndarray, parent_ratio: np.ndarray) -> tuple[Net, np.ndarray]:
    """The limb from its new first ring `loop` on, and the vertices of the joined and the new rings."""
    rays = len(loop)
    first = _first_outside(net, parent_ratio)
    ring = sewing.at(net.rings[first])
    shift = int(np.argmin([((sewing.at(np.roll(loop, s)) - ring) ** 2).sum() for s in range(rays)]))
    loop = np.roll(loop, shift)
    start, shares, end_shares = sewing.at(loop), sewing.shares(loop), sewing.shares(net.rings[first])
    edge = float(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).mean())
    gap = float(np.linalg.norm(ring - start, axis=1).mean())
    between = []
    for t in np.linspace(0, 1, max(1, round(gap / edge)) + 1)[1:-1]:
        between.append(sewing.added((1 - t) * start + t * ring, (1 - t) * shares + t * end_shares))
    rings = np.concatenate([[loop], *([np.stack(between)] if between else []), net.rings[first:]])
    sewn = np.concatenate([loop, *between, net.rings[first]])
    return Net(rings=rings, poles=(None, net.poles[1]), kept=np.ones((len(rings) - 1, rays), dtype=bool)), sewn


def _compact(sewing: _Sewing, parts: tuple[Part, ...], nets: list[Net], sewn: np.ndarray, before: int) -> Welded:
    """The nets without the vertices that no quad uses any more."""
    used = np.zeros(sewing.count, dtype=bool)
    for net in nets:
        i, j = np.nonzero(net.kept)
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
            used[net.rings[i + di, (j + dj) % net.rings.shape[1]]] = True
        used[[pole for pole in net.poles if pole is not None]] = True
    number = np.cumsum(used) - 1
    made = np.zeros(sewing.count, dtype=bool)
    made[sewn] = made[before:] = True
    renumbered = tuple(
        Net(
            rings=np.where(used[net.rings], number[net.rings], -1),
            kept=net.kept,
            poles=(_of(number, net.poles[0]), _of(number, net.poles[1])),
        )
        for net in nets
    )
    part = np.zeros(sewing.count, dtype=np.int64)
    for p in reversed(range(len(nets))):  # trunks last: a limb's first ring is theirs
        part[nets[p].rings] = p
        trunk = parts[p].parent
        part[nets[p].rings[0]] = p if trunk is None else trunk
        part[[pole for pole in nets[p].poles if pole is not None]] = p
    return Welded(
        vertices_m=np.concatenate(sewing.places)[used],
        weights=np.concatenate(sewing.weights)[used],
        nets=renumbered,
        part=part[used],
        sewn=made[used],
    )


def _of(number: np.ndarray, pole: int | None) -> int | None:
    return None if pole is None else int(number[pole])


MARGIN = 0.01  # between the islands and around them, over the side of a square of their area


def net_faces(net: Net) -> np.ndarray:
    """The quads (F, 4) of a net, outside counter-clockwise; at a pole each spans two edges of the ring."""
    i, j = np.nonzero(net.kept)
    on = (j + 1) % net.rings.shape[1]
    sides = np.stack([net.rings[i, j], net.rings[i, on], net.rings[i + 1, on], net.rings[i + 1, j]], axis=-1)
    return np.concatenate([_fan(net.rings[0], net.poles[0])[:, ::-1], sides, _fan(net.rings[-1], net.poles[1])])


def _fan(ring: np.ndarray, pole: int | None) -> np.ndarray:
    k = np.arange(0, len(ring) if pole is not None else 0, 2)
    return np.stack([np.full(len(k), -1 if pole is None else pole), ring[k], ring[k + 1], ring[(k + 2) % len(ring)]], axis=1)


def face_uv(whole: Welded, ends: Sequence[tuple[float, float]] = ()) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Texture coordinates (F, 4, 2) in the order of the nets' faces, and corner (2,) and size (2,) of islands for `ends`, sizes in metres.

    One island per part and end, packed into the square at one scale. u runs around the bones, v along them, as the rings' mean distances;
    an island is as wide as its part's mean girth and as high as the part is long.
    """
    sizes = np.array([*(_girth_and_length(whole, net) for net in whole.nets), *ends])
    gap = MARGIN * np.sqrt(sizes.prod(axis=1).sum())
    corners, side = packed(sizes + gap)
    scale = 1 / (side + gap)
    corners, sizes = (corners + gap) * scale, sizes * scale
    islands = [_net_uv(whole, net) * size + corner for net, size, corner in zip(whole.nets, sizes, corners)]
    return np.concatenate(islands), list(zip(corners, sizes))[len(islands) :]


def _girth_and_length(whole: Welded, net: Net) -> tuple[float, float]:
    rings, there = whole.vertices_m[np.maximum(net.rings, 0)], (net.rings >= 0).all(axis=1)
    girth = np.linalg.norm(rings - np.roll(rings, 1, axis=1), axis=2).sum(axis=1)[there].mean()
    return float(girth), float(_steps_m(whole, net).sum())


def _steps_m(whole: Welded, net: Net) -> np.ndarray:
    """(C + 1,) mean distances from pole to ring, from ring to ring, and from ring to pole; 0 without a pole."""
    steps = np.zeros(len(net.rings) + 1)
    for i, (a, b) in enumerate(zip(net.rings, net.rings[1:]), 1):
        both = (a >= 0) & (b >= 0)
        steps[i] = np.linalg.norm(whole.vertices_m[a[both]] - whole.vertices_m[b[both]], axis=1).mean()
    for end, pole in zip((0, -1), net.poles):
        if pole is not None:
            ring = net.rings[end][net.rings[end] >= 0]
            steps[end] = np.linalg.norm(whole.vertices_m[ring] - whole.vertices_m[pole], axis=1).mean()
    return steps


def _net_uv(whole: Welded, net: Net) -> np.ndarray:
    """(F, 4, 2) in 0…1 over the net."""
    rays, along = net.rings.shape[1], np.cumsum(_steps_m(whole, net))
    v = along[:-1] / along[-1]
    i, j = np.nonzero(net.kept)
    sides = np.stack([np.stack([j, j + 1, j + 1, j], axis=1) / rays, v[np.stack([i, i, i + 1, i + 1], axis=1)]], axis=-1)
    k = np.arange(0, rays, 2)
    fan = np.stack([k + 1, k, k + 1, k + 2], axis=1) / rays
    first, last = (np.stack([fan, np.broadcast_to([pole, at, at, at], fan.shape)], axis=-1) for pole, at in ((0.0, v[0]), (1.0, v[-1])))
    ends = [fan_uv if pole is not None else fan_uv[:0] for fan_uv, pole in zip((first[:, ::-1], last), net.poles)]
    return np.concatenate([ends[0], sides, ends[1]])


def cut(
    vertices: np.ndarray, weights: np.ndarray, part: np.ndarray, faces: np.ndarray, uv: np.ndarray, detail: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Every quad in detail × detail: values linear between its corners, part (V,) of the nearest.

    Vertices (V, 3), weights (V, B), faces (F, 4), uv (F, 4, 2).
    """
    s = np.arange(detail + 1) / detail
    shares = np.stack([np.outer(1 - s, 1 - s), np.outer(1 - s, s), np.outer(s, s), np.outer(s, 0 * s + 1 - s)], axis=-1)
    a, b = np.meshgrid(np.arange(detail), np.arange(detail), indexing="ij")
    small = np.stack([np.stack(pair, axis=-1) for pair in ((a, b), (a, b + 1), (a + 1, b + 1), (a + 1, b))], axis=-2).reshape(-1, 4, 2)
    number, count = _shared_numbers(faces, len(vertices), detail)
    values = np.concatenate([vertices, weights], axis=1)
    fine = np.empty((count, values.shape[1]))
    fine[number.ravel()] = np.einsum("abk,fkc->fabc", shares, values[faces]).reshape(-1, values.shape[1])
    fine_part = np.empty(count, dtype=part.dtype)
    fine_part[number.ravel()] = part[faces][:, shares.argmax(axis=-1)].ravel()
    fine_uv = np.einsum("abk,fkc->fabc", shares, uv)
    at = small[..., 0], small[..., 1]
    return fine[:, :3], fine[:, 3:], fine_part, number[:, *at].reshape(-1, 4), fine_uv[:, *at].reshape(-1, 4, 2)


def _shared_numbers(faces: np.ndarray, count: int, detail: int) -> tuple[np.ndarray, int]:
    """Numbers (F, detail + 1, detail + 1) of the vertices of the cut quads, where neighbours share them, and how many there are."""
    number = np.empty((len(faces), detail + 1, detail + 1), dtype=np.int64)
    last, inner = detail, slice(1, detail)
    for corner, (a, b) in enumerate(((0, 0), (0, last), (last, last), (last, 0))):
        number[:, a, b] = faces[:, corner]
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    first = count + edge[:, None] * (detail - 1)
    step = np.arange(detail - 1)
    along = np.where((edges[:, 0] < edges[:, 1])[:, None], first + step, first + step[::-1]).reshape(len(faces), 4, detail - 1)
    number[:, 0, inner], number[:, inner, last] = along[:, 0], along[:, 1]
    number[:, last, inner], number[:, inner, 0] = along[:, 2, ::-1], along[:, 3, ::-1]
    count += (int(edge.max()) + 1) * (detail - 1)
    number[:, inner, inner] = count + np.arange(len(faces) * (detail - 1) ** 2).reshape(len(faces), detail - 1, detail - 1)
    return number, count + len(faces) * (detail - 1) ** 2
