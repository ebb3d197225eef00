"""Head, hands and feet of a skin: templates in the place of the parts' ends, for every person of one topology.

    a part's rings up to the neck, wrist or ankle ── rows in which three edges become one, or one three, until the template's are left
      ──▶ the template's cage, placed and scaled as the fitted head, hand or foot (1 in extremities)                         (1)

A row that takes n edges to n − 2k has k groups of four quads about two new vertices, evenly around the ring. Where quads of an end are
cut, their vertices are those of a Catmull–Clark subdivision: the cut is followed by

    x' = x + 4/n (x̄ − x) ,   x̄: the mean of the centres of the n quads at x                                                 (2)

(Warren & Weimer 2002, Subdivision Methods for Geometric Design, sec. 7.2; Stam 2001, CAGD 18(5)).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..shape import BodyShape
from ..skeleton import bone_frames
from .extremities import has_end, placement
from .fingers import HAND, has_digits
from .foot_template import foot_template
from .hand_template import PALM, RING, hand_template
from .head_template import head_template
from .rays import smooth
from .template import Template
from .welding import Net, Welded, face_uv, net_faces

HEAD = "head"
WRIST = 0.15  # the last ring of the limb is before this fraction of the hand's bone
WRIST_HALF = (0.315, 0.20)  # half width and half thickness of the limb's last ring for which the template is made …
NEAR_RING = (0.7, 1.5)  # … bounds of what others have in its place
FADING = 0.6  # and the length over which they pass into the palm's
NECK = -0.58  # the trunk's last ring is below this height over the head's bone
ANKLE = -0.62  # the leg's last ring is above this depth over the foot's bone


@dataclass(frozen=True, eq=False, slots=True)
class _Kind:
    """How a template is joined: the part's last ring has its middle before `before` along `along`; the border runs from the axis `start` to
    `quarter`. `fitted`: the template's vertices for a ring (N, 3), in the template's coordinates."""

    template: Callable[[], Template]
    along: np.ndarray
    before: float
    start: np.ndarray
    quarter: np.ndarray
    fitted: Callable[[np.ndarray, Template], np.ndarray]


def _kind_of(shape: BodyShape, b: int) -> _Kind | None:
    """Of bone b; None: the surface of its balls is its end."""
    x, y, z = np.eye(3)
    name = shape.skeleton.bones[b].name
    if name == HEAD and has_end(shape, b):
        return _Kind(head_template, y, NECK, -z, -x, _border_fitted)
    if not has_digits(shape, b):
        return None
    if name[:-2] != HAND:
        return _Kind(foot_template, z, ANKLE, x, y, _border_fitted)
    return _Kind(partial(hand_template, shape.finger_bend(name)), y, WRIST, x, -z, _palm_fitted)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cage:
    """The quads of a whole body before they are cut. Arrays as in `OneSkin`."""

    vertices_m: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    weights: np.ndarray
    part: np.ndarray
    sewn: np.ndarray  # (V,) bool, as in `Welded`
    end: np.ndarray  # (V,) bool: of a template


def caged(whole: Welded, shape: BodyShape) -> Cage:
    """The quads of the nets, with templates in place of the ends of parts that have one."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    nets, ends = list(whole.nets), []
    for p, net in enumerate(whole.nets):
        last = int(whole.weights[net.poles[1]].argmax()) if net.poles[1] is not None else -1
        kind = _kind_of(shape, last) if last >= 0 else None
        if kind is not None:
            end = _End(shape, whole, net, p, last, kind, R[last], head[last])
            nets[p] = Net(rings=net.rings[: end.row + 1], poles=(net.poles[0], None), kept=net.kept[: end.row])
            ends.append(end)
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
        end=np.arange(first)[used] >= len(whole.vertices_m),
        faces=numbers.reshape(-1, 4),
        uv=np.concatenate([uv, *(chart[0] + chart[1] * m.uv for chart, m in zip(charts, made))]),
    )
    return joined


def _chart(end: "_End") -> tuple[float, float]:
    """Width and height [m] of the texture's island of an end."""
    unit = float(np.abs(end.placed.scale).mean())
    return unit * end.template.uv_size[0], unit * end.template.uv_size[1]


@dataclass(frozen=True, eq=False, slots=True)
class _Made:
    vertices_m: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    uv: np.ndarray  # (F, 4, 2) 0…1


class _End:
    """One end, sewn to a ring (N,) of a part."""

    def __init__(self, shape: BodyShape, whole: Welded, net: Net, part: int, b: int, kind: _Kind, R: np.ndarray, head: np.ndarray) -> None:
        self.template, self.part, self.placed = kind.template(), part, placement(shape, b)
        self._R, self._head, self._left = R, head, self.placed.scale[0] < 0
        rings = self.placed.from_bone((whole.vertices_m[net.rings] - head) @ R)
        self.row = _row_before(rings.mean(axis=1) @ kind.along, kind.before, _beyond_holes(net))
        ring, local = net.rings[self.row], rings[self.row]
        order = np.arange(len(ring))[::-1] if self._left else np.arange(len(ring))
        spokes = (local - local.mean(axis=0))[order]
        angle = np.arctan2(spokes @ kind.quarter, spokes @ kind.start)
        order = np.roll(order, -int(np.abs(angle).argmin()))
        self._ring, self._local, self._places = ring[order], local[order], kind.fitted(local, self.template)
        names = [bone.name for bone in shape.skeleton.bones]
        side = shape.skeleton.bones[b].name[-2:]
        columns = [names.index(f"{name}{side}") if name else b for name in self.template.bones]
        self._of_ring = whole.weights[self._ring]
        own = np.zeros((len(self.template.vertices), len(names)))
        own[:, columns] = self.template.weights
        of_ring = _around(self._of_ring, self.template.ring)[self.template.column]
        self._weights = of_ring + self.template.own[:, None] * (own - of_ring)

    def made(self, first: int) -> _Made:
        """Vertices numbered from `first`, and the quads between them and the part's ring."""
        t = self.template
        places, shares, faces = [self._places], [self._weights], [first + t.faces]
        uv = [t.uv / t.uv_size]
        ring, at, own, u = self._ring, self._local, self._of_ring, np.arange(len(self._ring)) / len(self._ring)
        counts = row_counts(len(ring), t.ring)
        count = first + len(t.vertices)
        for step, n in enumerate(counts, 1):
            share = step / len(counts)
            if step == len(counts):
                upper, up_at, up_own = first + np.arange(t.ring), self._places[: t.ring], self._weights[: t.ring]
            else:
                up_at = (1 - share) * _around(self._local, n) + share * _around(self._places[: t.ring], n)
                up_own = (1 - share) * _around(self._of_ring, n) + share * _around(self._weights[: t.ring], n)
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
            up_u = t.border_u if step == len(counts) else np.arange(n) / n
            uv.append(_row_uv(quads, u, up_u, pairs, (step - 1) / len(counts), share, t))
            ring, at, own, u = upper, up_at, up_own, up_u
        quads = np.concatenate(faces)
        found = np.concatenate(uv)
        if self._left:
            quads, found = quads[:, ::-1], found[:, ::-1]
        vertices = self._head + self.placed.in_bone(np.concatenate(places)) @ self._R.T
        return _Made(vertices, quads, np.concatenate(shares), found)


def _row_before(along: np.ndarray, before: float, beyond_holes: np.ndarray) -> int:
    """The last ring that is `before` a place along the bone and beyond the holes; where an arm is sewn on above that place, the first ring
    beyond the holes."""
    usable = np.flatnonzero(beyond_holes)
    reached = usable[along[usable] <= before]
    return int(reached[-1] if len(reached) else usable[0])


def _beyond_holes(net: Net) -> np.ndarray:
    """The rings (C,) between which and the end of the part no quad is missing."""
    whole = net.kept.all(axis=1)
    return np.append(np.logical_and.accumulate(whole[::-1])[::-1], True)


def _middle_and_half(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (points.max(axis=0) + points.min(axis=0)) / 2, np.ptp(points, axis=0) / 2


def _border_fitted(ring: np.ndarray, template: Template) -> np.ndarray:
    """The template's vertices, those near its border as wide and as deep as the part's last ring (N, 3) is, and in its middle."""
    (to, wide), (at, own) = _middle_and_half(ring), _middle_and_half(template.vertices[: template.ring])
    ratio, shift = np.clip(wide / np.maximum(own, 1e-9), *NEAR_RING), to - at
    along = own.argmin()
    ratio[along], shift[along] = 1.0, max(0.0, shift[along])  # no further back than the ring, where the part ends late
    return np.asarray(template.vertices + (1 - template.own[:, None]) * ((template.vertices - at) * (ratio - 1) + shift))


def _palm_fitted(ring: np.ndarray, template: Template) -> np.ndarray:
    """The template's vertices, those of the palm as wide and as thick near the wrist as the limb's ring (N, 3) is."""
    vertices = template.vertices
    middle, half = _middle_and_half(ring)
    ratio = np.clip(half[[0, 2]] / WRIST_HALF, *NEAR_RING)
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


def _row_uv(
    quads: np.ndarray, low: np.ndarray, high: np.ndarray, pairs: np.ndarray, bottom: float, top: float, template: Template
) -> np.ndarray:
    """Texture coordinates (F, 4, 2) of a row, in the strip below the palm's, from u (N,) to u (M,), 0…1."""
    u = np.concatenate([low, high])
    v = np.concatenate([np.full(len(low), bottom), np.full(len(high), top)])
    rolled = u[pairs]
    rolled = np.where(np.ptp(rolled, axis=1, keepdims=True) > 0.5, rolled + (rolled < 0.5), rolled)
    u, v = np.concatenate([u, rolled @ INNER]), np.concatenate([v, v[pairs] @ INNER])
    around = u[quads]
    around = np.where(np.ptp(around, axis=1, keepdims=True) > 0.5, around + (around < 0.5), around)
    return np.stack([template.girth * around / template.uv_size[0], 0.15 * v[quads] / template.uv_size[1]], axis=-1)


def rounded(vertices: np.ndarray, faces: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) of quads that were cut in halves, `which` (V,) of them moved to those of a Catmull–Clark subdivision.  (2)"""
    near = np.flatnonzero(which[faces].any(axis=1))
    ends, centres = faces[near].ravel(), np.repeat(vertices[faces[near]].mean(axis=1), 4, axis=0)
    count = np.bincount(ends, minlength=len(vertices))
    mean = np.stack([np.bincount(ends, centres[:, k], len(vertices)) for k in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    return np.where(which[:, None], vertices + (4 / np.maximum(count, 1))[:, None] * (mean - vertices), vertices)
