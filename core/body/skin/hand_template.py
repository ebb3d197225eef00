"""A hand of quads in a relaxed pose: a palm and five fingers, whose rings lie at and beside their joints.

Coordinates in lengths of the hand's bone, from the wrist to the middle finger's knuckle, of a right hand: x to the thumb, y along the hand,
z to the palm. Lengths of metacarpals and phalanges, and of the flesh at the tips: Buryanov & Kotiuk 2010, Int. J. Morphol. 28(3), Tables 1
and 2; breadths of hand and fingers: Greiner 1991, Hand anthropometry of U.S. Army personnel, TR-92/011.

The palm is a tube of RING vertices. It ends at the fingers' webs in a wall two quads high, of two columns for each finger and one for each
web; a finger continues the border of its 2 × 2 quads, the thumb that of 2 × 2 quads of the tube's side. Positions are those of a cage:
a Catmull–Clark subdivision (hands) takes it inwards by 1 − (2 + cos 45°)/3 = 7 … 10 % of a finger's radius, and FULLER offsets that.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .template import OWN, Template

COLUMNS = 12  # vertices across the back of the hand, and across the palm
RING = 2 * COLUMNS + 2
AROUND = np.array([[0.78, -0.78], [0, -1], [-0.78, -0.78], [-1, 0], [-0.78, 0.78], [0, 1], [0.78, 0.78], [1, 0]])  # x, z of a finger's ring
FULLER = 1.08
UNIT_MM = 96.0  # the hand's bone of a person of 1.75 m
BESIDE = 0.085  # distance of the rings beside a joint
WEB = 0.46  # of the first phalanx: where the webs are
THUMB_ROWS = (0, 1, 2)  # rows of the palm between which the thumb leaves it
PALM = np.array(  # y, half width, half thickness, and the middle's x and z of the palm's rows before the knuckles
    [
        [0.29, 0.315, 0.185, -0.01, 0.01],
        [0.45, 0.355, 0.18, -0.02, 0.015],
        [0.64, 0.40, 0.17, -0.035, 0.015],
        [0.80, 0.425, 0.16, -0.045, 0.01],
    ]
)
KNUCKLE = (0.135, 0.150)  # half thickness at the knuckles: back, palm …
BEYOND = (0.112, 0.122)  # … and between knuckles and webs
FOLLOWING = (0.12, 0.5, 0.8, 0.97)  # to what degree the palm's last row, knuckles, the row beyond and webs follow the fingers
NEAR_JOINT = 0.2  # weight of the bone beyond a joint in the rings beside it


@dataclass(frozen=True, slots=True)
class Finger:
    """`base`: its first joint. `lengths_mm`: of its three bones. `radii_mm`: half breadths at its first bone, two joints and tip."""

    name: str
    base: tuple[float, float, float]
    lengths_mm: tuple[float, float, float]
    radii_mm: tuple[float, float, float, float]
    spread_deg: float
    bends_deg: tuple[float, float, float]


FINGERS = (  # from the thumb's side; the last bone with the flesh at its tip
    Finger("f_index", (0.265, 0.985, 0.0), (39.8, 22.4, 19.5), (10.0, 9.8, 8.6, 7.4), 5.0, (9.0, 15.0, 8.0)),
    Finger("f_middle", (0.045, 1.0, -0.012), (44.6, 26.3, 21.2), (10.1, 9.9, 8.7, 7.5), 0.5, (12.0, 18.0, 9.0)),
    Finger("f_ring", (-0.175, 0.945, -0.005), (41.4, 25.7, 21.3), (9.5, 9.3, 8.1, 7.0), -4.0, (15.0, 21.0, 10.0)),
    Finger("f_pinky", (-0.375, 0.855, 0.012), (32.7, 18.1, 19.7), (8.4, 8.1, 7.2, 6.2), -10.0, (18.0, 23.0, 11.0)),
)
THUMB = Finger("thumb", (0.22, 0.21, 0.06), (46.2, 31.6, 25.3), (12.5, 11.0, 10.8, 8.0), 0.0, (0.0, 14.0, 14.0))
THUMB_ALONG, THUMB_FLEXES_TO = (0.54, 0.80, 0.21), (-0.78, 0.25, 0.60)
THENAR = np.array(
    [  # by row of the palm: shifts in x and z of the columns about the thumb's side: back, side, palm and the next two of the palm
        ((0.02, 0.01), (0.07, 0.07), (0.09, 0.13), (0.04, 0.12), (0.01, 0.06)),
        ((0.05, 0.03), (0.00, 0.00), (0.11, 0.20), (0.05, 0.16), (0.01, 0.08)),
        ((0.03, 0.03), (0.06, 0.08), (0.07, 0.13), (0.03, 0.10), (0.00, 0.04)),
        ((0.00, 0.01), (0.01, 0.02), (0.01, 0.03), (0.00, 0.02), (0.00, 0.00)),
    ]
)
DEPTH = 0.90  # of a finger over its breadth
RELAXED = 1.0  # the bend of the fingers of a relaxed hand; 0: straight, 2: half closed
BENDS = (-0.25, 8.0)  # between fingers that are bent back and a fist


@dataclass(frozen=True, eq=False, slots=True)
class FingerFrames:
    """A pose of a finger: joints (4, 3), the tip last, and its bones' axes (3, 3, 3), columns, y along and z where it flexes to."""

    joints: np.ndarray
    axes: np.ndarray


def finger_frames(finger: Finger, bend: float = RELAXED) -> FingerFrames:
    """Where the bones of a finger are when its joints are bent `bend` times as far as in the relaxed pose."""
    if finger is THUMB:
        y = np.array(THUMB_ALONG) / np.linalg.norm(THUMB_ALONG)
        z = np.array(THUMB_FLEXES_TO) - (np.array(THUMB_FLEXES_TO) @ y) * y
        z /= np.linalg.norm(z)
        R = np.stack([np.cross(y, z), y, z], axis=1)
    else:
        a = np.radians(-finger.spread_deg)
        R = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    joints, axes = [np.array(finger.base)], []
    for length, angle in zip(finger.lengths_mm, bend * np.radians(finger.bends_deg)):
        R = R @ np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
        axes.append(R)
        joints.append(joints[-1] + length / UNIT_MM * R[:, 1])
    return FingerFrames(np.stack(joints), np.stack(axes))


class _Cage:
    """The growing cage."""

    def __init__(self) -> None:
        self.bones = (OWN, *(f"{finger.name}.0{k}" for finger in (THUMB, *FINGERS) for k in (1, 2, 3)))
        self.places: list[np.ndarray] = []
        self.shares: list[np.ndarray] = []
        self.faces: list[np.ndarray] = []
        self.uv: list[np.ndarray] = []
        self.count = 0

    def added(self, places: np.ndarray, shares: np.ndarray) -> np.ndarray:
        self.places.append(places)
        self.shares.append(np.broadcast_to(shares, (len(places), len(self.bones))))
        self.count += len(places)
        return np.arange(self.count - len(places), self.count)

    def share(self, **of: float) -> np.ndarray:
        """Weights by bone, "_" for "."; what is left is the hand's."""
        row = np.zeros(len(self.bones))
        for name, value in of.items():
            row[self.bones.index(name)] = value
        row[0] = 1 - row.sum()
        return row

    def quads(self, faces: np.ndarray, uv: np.ndarray) -> None:
        self.faces.append(faces.reshape(-1, 4))
        self.uv.append(uv.reshape(-1, 4, 2))

    def tube(self, rings: np.ndarray, u: np.ndarray, v: np.ndarray, left_out: np.ndarray | None = None) -> None:
        """Quads between rings (R, n), with texture coordinates u (n + 1) around and v (R) along; `left_out` (R − 1, n)."""
        on = np.roll(rings, -1, axis=1)
        faces = np.stack([rings[:-1], on[:-1], on[1:], rings[1:]], axis=-1)
        i, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(rings.shape[1]), indexing="ij")
        uv = np.stack([np.stack([u[j], u[j + 1], u[j + 1], u[j]], axis=-1), np.stack([v[i], v[i], v[i + 1], v[i + 1]], axis=-1)], axis=-1)
        kept = np.ones(faces.shape[:2], dtype=bool) if left_out is None else ~left_out
        self.quads(faces[kept], uv[kept])


def _finger_stations(frames: FingerFrames, first: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[int, float]]]:
    """Rings of a finger beyond `first`: centres (R, 3), axes (R, 3, 3), distances along it (R,), and bone and share of the bone before."""
    joints, axes = frames.joints, frames.axes
    lengths = np.linalg.norm(np.diff(joints, axis=0), axis=1)
    beside = np.minimum(BESIDE, 0.3 * lengths)
    places: list[tuple[int, float, float]] = []
    if lengths[0] - beside[0] - first > 1.5 * BESIDE:
        places.append((0, 0.5 * (first + lengths[0] - beside[0]), 0.0))
    for k in (1, 2):
        places += [(k - 1, lengths[k - 1] - beside[k - 1], -NEAR_JOINT), (k, 0.0, 0.5), (k, beside[k], NEAR_JOINT)]
        if k == 1:
            places.append((1, 0.5 * lengths[1], 0.0))
    places += [(2, 0.55 * lengths[2], 0.0), (2, 0.82 * lengths[2], 0.0), (2, 0.985 * lengths[2], 0.0)]
    before = np.concatenate([[0.0], np.cumsum(lengths)])
    centres, turned = [], []
    for k, s, shared in places:
        centres.append(joints[k] + s * axes[k][:, 1])
        turned.append(axes[k] if shared != 0.5 else _between(axes[k - 1], axes[k]))
    return np.stack(centres), np.stack(turned), np.array([before[k] + s for k, s, _ in places]), [(k, shared) for k, _, shared in places]


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(a + b)
    return np.asarray(u @ vt)


def _radius(finger: Finger, along: np.ndarray) -> np.ndarray:
    """Half breadths of a finger's cage at distances along it."""
    ends = np.concatenate([[0.0], np.cumsum(finger.lengths_mm)]) / UNIT_MM
    at = [0.4 * ends[1], ends[1], ends[2], ends[2] + 0.55 * (ends[3] - ends[2]), ends[2] + 0.84 * (ends[3] - ends[2]), ends[3]]
    base, first, second, tip = np.array(finger.radii_mm) / UNIT_MM
    return np.asarray(FULLER * np.interp(along, at, [base, first, second, 0.98 * second, tip, 0.55 * tip]))


def _ring(centre: np.ndarray, axes: np.ndarray, radius: float, around: np.ndarray) -> np.ndarray:
    return np.asarray(centre + radius * (around[:, :1] * axes[:, 0] + DEPTH * around[:, 1:] * axes[:, 2]))


def _grow(cage: _Cage, finger: Finger, bend: float, root: np.ndarray, first: float, left: float, bottom: float) -> tuple[float, float]:
    """The finger beyond its first ring `root` (8,), which is at `first` along it; returns width and height of its texture."""
    frames = finger_frames(finger, bend)
    centres, axes, along, owners = _finger_stations(frames, first)
    rings = [root]
    for centre, turn, radius, (k, shared) in zip(centres, axes, _radius(finger, along), owners):
        own = cage.share(**{f"{finger.name}.0{k + 1}": 1.0})
        if shared:
            other = cage.share(**{f"{finger.name}.0{k + (0 if shared > 0 else 2)}": 1.0})
            own = (1 - abs(shared)) * own + abs(shared) * other
        rings.append(cage.added(_ring(centre, turn, radius, AROUND), own))
    width = 2 * np.pi * 0.95 * float(_radius(finger, along[:1])[0])
    u = left + width * np.arange(9) / 8
    v = bottom + np.concatenate([[first], along])
    cage.tube(np.stack(rings), u, v - first)
    last = rings[-1]
    pole = cage.added((frames.joints[3] + 0.012 * frames.axes[2][:, 1])[None], cage.share(**{f"{finger.name}.03": 1.0}))[0]
    high = float(v[-1] - first + 0.02)
    half = 0.5 * width / 4
    square = np.array([[1, -1], [0, -1], [-1, -1], [-1, 0], [-1, 1], [0, 1], [1, 1], [1, 0], [0, 0]])  # the last ring and the tip
    grid = np.array([left + half, high + half]) + half * square
    corners = np.array([[0, 1, 8, 7], [1, 2, 3, 8], [8, 3, 4, 5], [7, 8, 5, 6]])
    cage.quads(np.append(last, pole)[corners], grid[corners])
    return width, high + 2 * half - bottom


def _start_ring() -> tuple[np.ndarray, np.ndarray]:
    """Directions u, v (RING,) around the palm's tube at the wrist: evenly, from the thumb's side over the back."""
    angle = 2 * np.pi * np.arange(RING) / RING
    return np.cos(angle), -np.sin(angle)


def _row_at_fingers(along: float, thick: tuple[float, float] | None, bend: float) -> np.ndarray:
    """(RING, 3): a row of the palm at a fraction of the fingers' first bones; `thick`: half thicknesses, by default the fingers' own."""
    ring = np.empty((RING, 3))
    for i, finger in enumerate(FINGERS):
        frames = finger_frames(finger, bend)
        s = along * finger.lengths_mm[0] / UNIT_MM
        turn = _between(np.eye(3), frames.axes[0]) if along == 0 else frames.axes[0]
        centre, breadth = frames.joints[0] + s * frames.axes[0][:, 1], FULLER * finger.radii_mm[0] / UNIT_MM
        if thick is None:
            points = _ring(centre, turn, breadth, AROUND)
        else:
            flatter = np.where(np.abs(AROUND[:, 1]) < 1, 1.15, 1.0) * np.where(AROUND[:, 1] < 0, *thick) * FULLER
            points = centre + np.outer(1.06 * breadth * AROUND[:, 0], turn[:, 0]) + np.outer(flatter * AROUND[:, 1], turn[:, 2])
        d = 1 + 3 * i
        ring[d : d + 3] = points[:3]
        ring[RING - d - 2 : RING - d + 1] = points[[4, 5, 6]]
        if i == 0:
            ring[0] = points[7]
        if i == len(FINGERS) - 1:
            ring[COLUMNS + 1] = points[3]
    return ring


def _palm(cage: _Cage, bend: float) -> list[np.ndarray]:
    """Rows (RING,) of the palm's tube from the wrist to the webs, without its quads."""
    u, v = _start_ring()
    knuckles = _row_at_fingers(0.0, KNUCKLE, bend)
    middle, width = (knuckles[:, 0].max() + knuckles[:, 0].min()) / 2, np.ptp(knuckles[:, 0]) / 2
    u_end, v_end = (knuckles[:, 0] - middle) / width, knuckles[:, 2] / np.where(knuckles[:, 2] < 0, *KNUCKLE) / FULLER
    y_end = knuckles[:, 1] - knuckles[:, 1].mean()
    rows: list[np.ndarray] = []
    for y, half, thick, x0, z0 in PALM:
        t = ((y - PALM[0, 0]) / (1.0 - PALM[0, 0])) ** 0.8
        x, z = (1 - t) * u + t * u_end, (1 - t) * v + t * v_end
        places = np.stack([x0 + 1.03 * half * x, y + t**1.5 * y_end, z0 + 1.03 * thick * z], axis=1)
        places[[1, 0, RING - 1, RING - 2, RING - 3]] += THENAR[len(rows)] @ [[1.0, 0, 0], [0, 0, 1.0]]
        rows.append(cage.added(places, _of_fingers(cage, FOLLOWING[0]) if y == PALM[-1, 0] else cage.share()))
    for along, thick, own in zip((0.0, 0.5 * WEB, WEB), (KNUCKLE, BEYOND, None), FOLLOWING[1:]):
        rows.append(cage.added(_row_at_fingers(along, thick, bend), _of_fingers(cage, own)))
    return rows


def _of_fingers(cage: _Cage, own: float) -> np.ndarray:
    """Weights (RING, 16) of a row of the palm that follows each finger's first bone to the degree `own`."""
    shares = np.empty((RING, len(cage.bones)))
    for i, finger in enumerate(FINGERS):
        d = 1 + 3 * i
        mine = [*range(d, d + 3), *range(RING - d - 2, RING - d + 1), *([0] if i == 0 else []), *([COLUMNS + 1] if i == 3 else [])]
        shares[mine] = cage.share(**{f"{finger.name}.01": own})
    return shares


@lru_cache(maxsize=4)
def hand_template(bend: float = RELAXED) -> Template:
    """The cage of the right hand, with fingers bent as in `finger_frames`."""
    cage = _Cage()
    rows = _palm(cage, bend)
    lead, mid, end = THUMB_ROWS
    out = np.zeros((len(rows) - 1, RING), dtype=bool)
    out[np.ix_([lead, mid], [0, RING - 1])] = True
    y = np.array([*PALM[:, 0], 1.0, 1.0 + 0.23 * WEB, 1.0 + 0.46 * WEB])
    girth = 2.0
    u = girth * np.arange(RING + 1) / RING
    cage.tube(np.stack(rows), u, y - y[0] + 0.15, out)
    above = float(y[-1] - y[0]) + 0.20
    web, back, palm = rows[-1], 1, RING - 1
    inner = {0: web[0], COLUMNS - 1: web[COLUMNS + 1]}  # the middle row of the wall at the webs, by column
    for i, finger in enumerate(FINGERS):
        frames, s = finger_frames(finger, bend), WEB * finger.lengths_mm[0] / UNIT_MM
        ring = _ring(frames.joints[0] + s * frames.axes[0][:, 1], frames.axes[0], FULLER * finger.radii_mm[0] / UNIT_MM, AROUND)
        for column, corner in ((3 * i, 7), (3 * i + 2, 3)):
            if column not in inner:
                inner[column] = cage.added(ring[corner][None], cage.share(**{f"{finger.name}.01": 1.0}))[0]
    left = 0.0
    heights = []
    for i, finger in enumerate(FINGERS):
        a = 3 * i
        root = np.array([*web[back + a : back + a + 3], inner[a + 2], web[palm - a - 2], web[palm - a - 1], web[palm - a], inner[a]])
        width, height = _grow(cage, finger, bend, root, WEB * finger.lengths_mm[0] / UNIT_MM, left, above)
        heights.append(height)
        if i < len(FINGERS) - 1:
            c = a + 2
            wall = np.array(
                [[web[back + c], web[back + c + 1], inner[c + 1], inner[c]], [inner[c], inner[c + 1], web[palm - c - 1], web[palm - c]]]
            )
            box = np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * 0.05
            cage.quads(wall, np.stack([box + [2.10, 0.15 + 0.12 * i], box + [2.10, 0.20 + 0.12 * i]]))
        left += width + 0.03
    thumb, back_of, palm_of = (np.array([row[column] for row in (rows[lead], rows[mid], rows[end])]) for column in (0, 1, RING - 1))
    root = np.array([thumb[0], *back_of, thumb[2], *palm_of[::-1]])
    width, height = _grow(cage, THUMB, bend, root, 0.28, left, above)
    faces = np.concatenate(cage.faces)
    places = _faired(np.concatenate(cage.places), faces, root)
    weights = np.concatenate(cage.shares).copy()
    _thenar(weights, cage, rows)
    size = max(left + width, 2.2), above + max(*heights, height) + 0.05
    return Template(
        vertices=places,
        faces=faces,
        weights=weights,
        bones=cage.bones,
        uv=np.concatenate(cage.uv),
        uv_size=size,
        girth=girth,
        ring=RING,
        border_u=np.arange(RING) / RING,
        own=np.ones(len(places)),
        column=np.arange(len(places)) % RING,
    )


def _thenar(weights: np.ndarray, cage: _Cage, rows: list[np.ndarray]) -> None:
    """The palm at the thumb's root follows the thumb in part."""
    for row, own in zip(THUMB_ROWS, (0.15, 0.4, 0.3)):
        for column, share in ((0, own), (1, 0.5 * own), (RING - 1, own), (RING - 2, 0.5 * own), (RING - 3, 0.2 * own)):
            weights[rows[row][column]] = cage.share(**{"thumb.01": share})


def _faired(places: np.ndarray, faces: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Vertices (V, 3), of which those of the quads at `root` are a thin plate between the others: Σ |x − mean of its neighbours|² → min."""
    count = len(places)
    joined = np.zeros((count, count))
    for i in range(4):
        joined[faces[:, i], faces[:, i - 1]] = joined[faces[:, i - 1], faces[:, i]] = 1.0
    bending = np.eye(count) - joined / np.maximum(joined.sum(axis=1, keepdims=True), 1.0)
    near = np.unique(faces[np.isin(faces, root).any(axis=1)])
    moved = near[near >= RING]
    rows = np.flatnonzero(joined[moved].any(axis=0) & (np.arange(count) >= RING))
    found = places.copy()
    found[moved] = 0.0
    found[moved] = np.linalg.lstsq(bending[np.ix_(rows, moved)], -bending[rows] @ found, rcond=None)[0]
    return found
