"""Quads of nets of rings, their texture coordinates, and quads cut finer."""

import numpy as np

from .welding import Net, Welded

MARGIN = 0.01  # between the islands and around them


def net_faces(net: Net) -> np.ndarray:
    """The quads (F, 4) of a net, outside counter-clockwise; at a pole each spans two edges of the ring."""
    i, j = np.nonzero(net.kept)
    on = (j + 1) % net.rings.shape[1]
    sides = np.stack([net.rings[i, j], net.rings[i, on], net.rings[i + 1, on], net.rings[i + 1, j]], axis=-1)
    return np.concatenate([_fan(net.rings[0], net.poles[0])[:, ::-1], sides, _fan(net.rings[-1], net.poles[1])])


def _fan(ring: np.ndarray, pole: int | None) -> np.ndarray:
    k = np.arange(0, len(ring) if pole is not None else 0, 2)
    return np.stack([np.full(len(k), -1 if pole is None else pole), ring[k], ring[k + 1], ring[(k + 2) % len(ring)]], axis=1)


def face_uv(whole: Welded) -> np.ndarray:
    """Texture coordinates (F, 4, 2) in the order of the nets' faces: an island a part, side by side, all to one scale.

    u runs around the bones, v along them; an island is as wide as its part's mean girth and as high as the part is long.
    """
    sizes = [_girth_and_length(whole, net) for net in whole.nets]
    scale = (1 - 2 * MARGIN) / max(sum(width for width, _ in sizes) * (1 + MARGIN * len(sizes)), max(height for _, height in sizes))
    islands, left = [], MARGIN
    for net, (width, height) in zip(whole.nets, sizes):
        uv = _net_uv(net)
        islands.append(uv * [scale * width, scale * height] + [left, MARGIN])
        left += scale * width + MARGIN * scale * width
    return np.concatenate(islands)


def _girth_and_length(whole: Welded, net: Net) -> tuple[float, float]:
    rings = whole.vertices_m[np.maximum(net.rings, 0)]
    there = (net.rings >= 0)[..., None]
    along = np.linalg.norm(np.diff(rings, axis=0), axis=2)
    both = (there[1:] & there[:-1])[..., 0]
    whole_rings = there[..., 0].all(axis=1)
    girth = np.linalg.norm(rings - np.roll(rings, 1, axis=1), axis=2).sum(axis=1)[whole_rings].mean()
    return float(girth), float((along * both).sum(axis=1).sum() / both.sum(axis=1).mean())


def _net_uv(net: Net) -> np.ndarray:
    """(F, 4, 2) in 0…1 over the net."""
    rings, rays = net.rings.shape
    v = (np.arange(rings) + (net.poles[0] is not None)) / (rings - 1 + sum(pole is not None for pole in net.poles))
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
