"""Hands of a skin: from the wrist on, the template's palm and fingers in the place of the limb's end, for every person of one topology.

    a limb's rings up to WRIST of the hand's bone ── rows in which three edges become one, or one three, until RING are left
      ──▶ the template's cage, scaled as the fitted hand (1 in extremities)                                                    (1)

A row that takes n edges to n − 2k has k groups of four quads about two new vertices, evenly around the wrist. Where quads of a hand are
cut, their vertices are those of a Catmull–Clark subdivision: the cut is followed by

    x' = x + 4/n (x̄ − x) ,   x̄: the mean of the centres of the n quads at x                                                 (2)

(Warren & Weimer 2002, Subdivision Methods for Geometric Design, sec. 7.2; Stam 2001, CAGD 18(5)).
"""

from dataclasses import dataclass, replace

import numpy as np

from ..shape import BodyShape
from ..skeleton import bone_frames
from .fingers import hand_scale, has_fingers
from .hand_template import PALM, RING, Template, hand_template
from .rays import smooth
from .welding import Net, Welded, face_uv, net_faces

WRIST = 0.15  # the last ring of the limb is before this fraction of the hand's bone
WRIST_HALF = (0.315, 0.20)  # half width and half thickness of the limb's last ring for which the template is made …
NEAR_WRIST = (0.7, 1.5)  # … bounds of what others have in its place
FADING = 0.6  # and the length over which they pass into the palm's


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cage:
    """The quads of a whole body before they are cut. Arrays as in `OneSkin`."""

    vertices_m: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    weights: np.ndarray
    part: np.ndarray
    sewn: np.ndarray  # (V,) bool, as in `Welded`
    hand: np.ndarray  # (V,) bool: beyond the wrist


def caged(whole: Welded, shape: BodyShape) -> Cage:
    """The quads of the nets, the hands in place of the ends of limbs that have one."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    nets, ends = list(whole.nets), []
    for p, net in enumerate(whole.nets):
        last = int(whole.weights[net.poles[1]].argmax()) if net.poles[1] is not None else -1
        if last >= 0 and has_fingers(shape, last):
            along = (whole.vertices_m[net.rings].mean(axis=1) - head[last]) @ R[last, :, 1] / shape.lengths_m[last]
            row = int(np.flatnonzero(along <= WRIST)[-1])
            nets[p] = Net(rings=net.rings[: row + 1], poles=(net.poles[0], None), kept=net.kept[:row])
            ends.append(_Hand(shape, whole, net.rings[row], p, last, R[last], head[last]))
    first, made = len(whole.vertices_m), []
    for end in ends:
        made.append(end.made(first))
        first += len(made[-1].vertices_m)
    uv, charts = face_uv(replace(whole, nets=tuple(nets)), [_chart(end) for end in ends])
    faces = np.concatenate([*(net_faces(net) for net in nets), *(m.faces for m in made)])
    used, numbers = np.unique(faces, return_inverse=True)
    joined = Cage(
        vertices_m=np.concatenate([whole.vertices_m, *(m.vertices_m for m in made)])[used],
        weights=np.concatenate([whole.weights, *(m.weights for m in made)])[used],
        part=np.concatenate([whole.part, *(np.full(len(m.vertices_m), end.part) for end, m in zip(ends, made))])[used],
        sewn=np.concatenate([whole.sewn, np.zeros(first - len(whole.vertices_m), dtype=bool)])[used],
        hand=np.arange(first)[used] >= len(whole.vertices_m),
        faces=numbers.reshape(-1, 4),
        uv=np.concatenate([uv, *(chart[0] + chart[1] * m.uv for chart, m in zip(charts, made))]),
    )
    return joined


def _chart(end: "_Hand") -> tuple[float, float]:
    """Width and height [m] of the texture's island of a hand."""
    unit = float(np.abs(end.scale).mean())
    return unit * end.template.uv_size[0], unit * end.template.uv_size[1]


@dataclass(frozen=True, eq=False, slots=True)
class _Made:
    vertices_m: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    uv: np.ndarray  # (F, 4, 2) 0…1


class _Hand:
    """One hand, sewn to the ring (N,) of a limb."""

    def __init__(self, shape: BodyShape, whole: Welded, ring: np.ndarray, part: int, b: int, R: np.ndarray, head: np.ndarray) -> None:
        self.template, self.scale, self.part = hand_template(), hand_scale(shape, b), part
        self._R, self._head, self._left = R, head, self.scale[0] < 0
        local = (whole.vertices_m[ring] - head) @ R / self.scale
        order = np.arange(len(ring))[::-1] if self._left else np.arange(len(ring))
        angle = np.arctan2(-(local - local.mean(axis=0))[order, 2], (local - local.mean(axis=0))[order, 0])
        order = np.roll(order, -int(np.abs(angle).argmin()))
        self._ring, self._local, self._places = ring[order], local[order], _fitted_to(local, self.template.vertices)
        names = [bone.name for bone in shape.skeleton.bones]
        side = shape.skeleton.bones[b].name[-2:]
        columns = [names.index(f"{name}{side}") if name else b for name in self.template.bones]
        self._weights = np.zeros((len(self.template.vertices), len(names)))
        self._weights[:, columns] = self.template.weights
        self._of_ring = whole.weights[self._ring]

    def made(self, first: int) -> _Made:
        """Vertices numbered from `first`, and the quads between them and the limb's ring."""
        t = self.template
        places, shares, faces = [self._places], [self._weights], [first + t.faces]
        uv = [t.uv / t.uv_size]
        ring, at, own = self._ring, self._local, self._of_ring
        counts = row_counts(len(ring), RING)
        count = first + len(t.vertices)
        for step, n in enumerate(counts, 1):
            share = step / len(counts)
            if step == len(counts):
                upper, up_at, up_own = first + np.arange(RING), self._places[:RING], self._weights[:RING]
            else:
                up_at = (1 - share) * _around(self._local, n) + share * _around(self._places[:RING], n)
                up_own = (1 - share) * _around(self._of_ring, n) + share * _around(self._weights[:RING], n)
                upper = count + np.arange(n)
                places.append(up_at)
                shares.append(up_own)
                count += n
            quads, pairs = row_of_quads(len(ring), n)
            numbers = np.concatenate([ring, upper, count + np.arange(len(pairs))])
            both = [np.concatenate(pair) for pair in ((at, up_at), (own, up_own))]
            inner = [np.einsum("pk,pkc->pc", np.broadcast_to(INNER, (len(pairs), 3)), values[pairs]) for values in both]
            places.append(inner[0])
            shares.append(inner[1])
            count += len(pairs)
            faces.append(numbers[quads])
            uv.append(_row_uv(quads, len(ring), n, pairs, (step - 1) / len(counts), share, t))
            ring, at, own = upper, up_at, up_own
        quads = np.concatenate(faces)
        found = np.concatenate(uv)
        if self._left:
            quads, found = quads[:, ::-1], found[:, ::-1]
        vertices = self._head + (np.concatenate(places) * self.scale) @ self._R.T
        return _Made(vertices, quads, np.concatenate(shares), found)


def _fitted_to(ring: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The template's vertices, those of the palm as wide and as thick near the wrist as the limb's ring (N, 3) is."""
    middle, half = (ring.max(axis=0) + ring.min(axis=0)) / 2, np.ptp(ring, axis=0) / 2
    ratio = np.clip(half[[0, 2]] / WRIST_HALF, *NEAR_WRIST)
    palm = vertices[: len(PALM) * RING]
    near = 1 - smooth((palm[:, 1] - WRIST) / FADING)[:, None]
    found = vertices.copy()
    found[: len(palm), [0, 2]] = palm[:, [0, 2]] * (1 + near * (ratio - 1)) + near * middle[[0, 2]]
    return found


INNER = np.array([1 / 2, 1 / 3, 1 / 6])  # a new vertex: of that below (or above) it, and of both ends of the single edge


def row_counts(n: int, wanted: int) -> list[int]:
    """How many edges each row's far side has, from n edges to `wanted`; even numbers, at most a third or three times as many each."""
    counts: list[int] = []
    while n != wanted or not counts:
        k = min(abs(n - wanted) // 2, n // 3 if n > wanted else n)
        n += 2 * k if n < wanted else -2 * k
        counts.append(n)
    return counts


def row_of_quads(low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
    """Quads (F, 4) between rings of `low` and `high` vertices and new ones, numbered in this order; what each new one is between (P, 3)."""
    few, k = min(low, high), abs(low - high) // 2
    wide = np.zeros(few, dtype=bool)
    wide[((np.arange(k) + 0.5) * few / max(k, 1)).astype(int)] = True
    quads: list[list[int]] = []
    pairs: list[list[int]] = []
    begin, many = 0, max(low, high)
    for i in range(few):
        span = 3 if wide[i] else 1
        near, ends = [(begin + j) % many for j in range(span + 1)], [i, (i + 1) % few]
        b, t = (near, [low + a for a in ends]) if low >= high else (ends, [low + a for a in near])
        m = [low + high + len(pairs), low + high + len(pairs) + 1]
        if not wide[i]:
            quads.append([b[0], b[1], t[1], t[0]])
        elif low > high:
            quads += [[b[0], b[1], m[0], t[0]], [b[1], b[2], m[1], m[0]], [b[2], b[3], t[1], m[1]], [m[0], m[1], t[1], t[0]]]
            pairs += [[b[1], t[0], t[1]], [b[2], t[1], t[0]]]
        else:
            quads += [[b[0], b[1], m[1], m[0]], [b[0], m[0], t[1], t[0]], [m[0], m[1], t[2], t[1]], [m[1], b[1], t[3], t[2]]]
            pairs += [[t[1], b[0], b[1]], [t[2], b[1], b[0]]]
        begin += span
    return np.array(quads), np.array(pairs, dtype=np.int64).reshape(-1, 3)


def _around(values: np.ndarray, n: int) -> np.ndarray:
    """Values (m, C) around a ring, at n even places."""
    at = np.arange(n) * len(values) / n
    low = at.astype(int)
    return np.asarray(((1 - at + low) * values[low % len(values)].T + (at - low) * values[(low + 1) % len(values)].T).T)


def _row_uv(quads: np.ndarray, low: int, high: int, pairs: np.ndarray, bottom: float, top: float, template: Template) -> np.ndarray:
    """Texture coordinates (F, 4, 2) of a row, in the strip below the palm's."""
    u = np.concatenate([np.arange(low) / low, np.arange(high) / high])
    v = np.concatenate([np.full(low, bottom), np.full(high, top)])
    rolled = u[pairs]
    rolled = np.where(np.ptp(rolled, axis=1, keepdims=True) > 0.5, rolled + (rolled < 0.5), rolled)
    u, v = np.concatenate([u, rolled @ INNER]), np.concatenate([v, v[pairs] @ INNER])
    around = u[quads]
    around = np.where(np.ptp(around, axis=1, keepdims=True) > 0.5, around + (around < 0.5), around)
    return np.stack([2.0 * around / template.uv_size[0], 0.15 * v[quads] / template.uv_size[1]], axis=-1)


def rounded(vertices: np.ndarray, faces: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) of quads that were cut in halves, `which` (V,) of them moved to those of a Catmull–Clark subdivision.  (2)"""
    near = np.flatnonzero(which[faces].any(axis=1))
    ends, centres = faces[near].ravel(), np.repeat(vertices[faces[near]].mean(axis=1), 4, axis=0)
    count = np.bincount(ends, minlength=len(vertices))
    mean = np.stack([np.bincount(ends, centres[:, k], len(vertices)) for k in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    return np.where(which[:, None], vertices + (4 / np.maximum(count, 1))[:, None] * (mean - vertices), vertices)
