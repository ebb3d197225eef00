"""A foot of quads with heel, malleoli, arch, ball and five toes.

Coordinates in mm of a right foot whose bone, from the ankle to the ball, is UNIT_MM long: x to the other foot, y level ahead, z down. The
proportions are those of adults (Gordon et al., ANSUR 1989), between women and men: about 262 mm long, 90 wide, malleoli 72 apart, the
ankle's axis 82 above the floor.

Rings turn about an axis above the instep from the ankle, where they are level, to the middle of the foot, where they are upright; their
places are cast onto solids. As at a hand's palm they end at the webs in a wall two quads high, of two columns for each toe and one for
each web, and each toe continues the border of its 2 × 2 quads.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .rays import smooth
from .sculpture import Solid, cast_inwards
from .template import OWN, Template, run_of, tube

UNIT_MM = 149.0
TOE = "toe"  # the bone of all toes
JOINT_MM = (3.0, 128.0, 60.0)  # where it begins
TOES_END_MM = (3.0, 205.0, 72.0)
SOLE_MM = 82.0
COLUMNS = 15
RING = 2 * COLUMNS + 2
PIVOT_MM = (75.0, -75.0)  # y, z of the axis about which the rings turn
RINGS_DEG = (0.0, 13.0, 25.0, 36.0, 47.0, 58.0, 68.0, 78.0, 90.0)
CENTRES_MM = (80.0, 84.0, 93.0, 108.0, 122.0, 130.0, 128.0, 125.0, 126.0)  # of the rings, from the pivot
HALF_MM = ((36, 36), (36, 42), (36, 50), (36, 58), (36, 58), (36, 48), (38, 40), (38, 34), (40, 31))  # about the widths and depths there
AHEAD_MM = (91.0, 107.0, 122.0)  # upright rings beyond them
OBLIQUE = 0.30  # by which the inner end of those is ahead, over their width
FARTHEST_MM = 140.0
BETWEEN = (0.36, 0.7)  # of the way from the last upright ring to the webs: two more
FULLER = 1.08
AROUND = np.array([[0.78, -0.78], [0, -1], [-0.78, -0.78], [-1, 0], [-0.78, 0.78], [0, 1], [0.78, 0.78], [1, 0]])  # x, z of a toe's ring
TOE_SHARE = (0.12, 0.5, 0.85)  # of the toes' bone in the last upright ring and the two beyond it
FOLLOWS_MM = (-62.0, 32.0)  # over which vertices pass from the shin to the foot, downwards …
TILT = 0.40  # … and ahead
GIRTH, GAP = 1.6, 0.03  # of the texture: width of the island from ankle to webs, and what is between it, those of the toes and the webs

SOLIDS = (
    Solid((0, -4, -150), (40, 33), 1, end=(0, -4, 0)),  # shin
    Solid((30, 3, -6), (10, 13, 13), 14),  # malleoli
    Solid((-31, -7, 8), (9, 12, 13), 14),
    Solid((0, -30, -90), (17, 14), 16, end=(0, -35, 25)),  # Achilles' tendon
    Solid((-1, -20, 50), (30, 32, 34), 18),  # heel
    Solid((2, 12, 2), (30, 20), 26, end=(9, 100, 50)),  # instep
    Solid((-3, 52, 52), (33, 66, 32), 22),
    Solid((-21, 0, 66), (17, 14), 16, end=(-28, 106, 68)),  # outer edge
    Solid((22, 124, 63), (20, 30, 20), 14),  # ball
    Solid((1, 120, 61), (30, 30, 20), 14),
    Solid((-26, 110, 67), (17, 30, 16), 14),
    Solid((40, 52, 90), (27, 44, 20), 16, hollow=True),  # arch
    Solid((0, 60, SOLE_MM + 4000), (4000, 4000, 4000), 9, hollow=True),  # floor
)


@dataclass(frozen=True, slots=True)
class _Toe:
    """Centres of its rings from the web to the tip, x, y, z [mm], and half breadths and half thicknesses there."""

    places: tuple[tuple[float, float, float], ...]
    half: tuple[tuple[float, float], ...]


def _toe(web: tuple[float, float, float], tip: tuple[float, float], half: tuple[float, float], arched: float) -> _Toe:
    """From its web, x, y, z, to its tip, x, y; half breadth and thickness; `arched`: how far its middle is above the line between."""
    share = np.array([0.0, 0.28, 0.52, 0.76, 0.93])
    end_z = SOLE_MM - 0.98 * half[1]
    x, y, z = (a + share * (b - a) for a, b in zip(web, (*tip, end_z)))
    z = z - arched * np.sin(np.pi * np.minimum(share / 0.8, 1.0))
    size = np.array([[1.0, 1.05], [0.98, 1.0], [1.0, 0.95], [1.0, 1.0], [0.70, 0.72]]) * half
    return _Toe(tuple(zip(x.tolist(), y.tolist(), z.tolist())), tuple(map(tuple, size.tolist())))


TOES = (  # from the great toe
    _toe((26.0, 168.0, 66.0), (22.0, 211.0), (12.2, 11.0), 1.0),
    _toe((4.5, 171.0, 67.0), (2.0, 207.0), (7.0, 8.0), 4.0),
    _toe((-11.2, 164.0, 68.5), (-14.0, 197.0), (6.6, 7.6), 4.0),
    _toe((-26.2, 154.0, 70.0), (-28.5, 184.0), (6.4, 7.2), 3.5),
    _toe((-41.0, 141.0, 71.5), (-43.0, 167.0), (6.4, 7.0), 2.0),
)


def _columns(per_toe: np.ndarray, inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """(RING, C) of the toes' rings (5, 8, C): a row across all toes, from the inner side over the back."""
    row = np.empty((RING, per_toe.shape[2]))
    for i, ring in enumerate(per_toe):
        d = 1 + 3 * i
        row[d : d + 3] = ring[:3]
        row[RING - d - 2 : RING - d + 1] = ring[[4, 5, 6]]
    row[0], row[COLUMNS + 1] = inner, outer
    return row


def _toe_rings(toe: _Toe) -> np.ndarray:
    """(R, 8, 3)."""
    centres = np.array(toe.places)
    rings = []
    for k, (half, depth) in enumerate(toe.half):
        y = centres[min(k + 1, len(centres) - 1)] - centres[max(k - 1, 0)]
        y = y / np.linalg.norm(y)
        x = np.cross(y, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        z = np.cross(x, y)
        rings.append(centres[k] + FULLER * (half * AROUND[:, :1] * x + depth * AROUND[:, 1:] * z))
    return np.stack(rings)


def _body() -> np.ndarray:
    """(R, RING, 3) rings from the ankle to the ball, cast onto the solids."""
    webs = _columns(np.stack([_toe_rings(toe)[0] for toe in TOES]), _toe_rings(TOES[0])[0, 7], _toe_rings(TOES[-1])[0, 3])
    width, middle = np.ptp(webs[:, 0]) / 2, (webs[:, 0].max() + webs[:, 0].min()) / 2
    at_toes = np.stack([(webs[:, 0] - middle) / width, np.where(np.arange(RING) <= COLUMNS + 1, -1.0, 1.0)], axis=1)
    at_toes[[0, COLUMNS + 1], 1] = 0.0
    even = 2 * np.pi * np.arange(RING) / RING
    origins, directions = [], []
    turning = len(RINGS_DEG)
    for k in range(turning + len(AHEAD_MM)):
        angle = np.radians(RINGS_DEG[min(k, turning - 1)])
        down = np.array([0.0, -np.cos(angle), np.sin(angle)])  # from the pivot
        half: tuple[float, float] = HALF_MM[min(k, turning - 1)]
        centre = np.array([0.0, *PIVOT_MM]) + CENTRES_MM[min(k, turning - 1)] * down
        across, deep = np.cos(even), -np.sin(even)
        if k >= turning:
            t = (k - turning + 1) / (len(AHEAD_MM) + 1)
            across, deep = (1 - t) * across + t * at_toes[:, 0], (1 - t) * deep + t * at_toes[:, 1]
            centre = np.array([-3.0 * t, AHEAD_MM[k - turning], centre[2] + 12 * t])
            half = (44, 24 - 6 * t)
        direction = across[:, None] * [half[0], 0.0, 0.0] + deep[:, None] * half[1] * down
        direction[:, 1] += (k >= turning) * OBLIQUE * direction[:, 0] * (k - turning + 1) / len(AHEAD_MM)
        directions.append(direction / np.linalg.norm(direction, axis=1, keepdims=True))
        origins.append(np.broadcast_to(centre, (RING, 3)))
    body = cast_inwards(SOLIDS, np.concatenate(origins), np.concatenate(directions), FARTHEST_MM).reshape(-1, RING, 3)
    between = [(1 - s) * body[-1] + s * webs for s in BETWEEN]
    return np.concatenate([body, np.stack([*between, webs])])


@lru_cache(maxsize=1)
def foot_template() -> Template:
    """The cage of the right foot."""
    body = _body()
    places, count = [body.reshape(-1, 3)], body.shape[0] * RING
    rings = np.arange(count).reshape(-1, RING)
    u, v = GIRTH * np.arange(RING + 1) / RING, 0.15 + run_of(body) / UNIT_MM
    faces, uv = ([part] for part in tube(rings, u, v))
    webs, inner = rings[-1], {0: rings[-1][0], COLUMNS - 1: rings[-1][COLUMNS + 1]}
    for i, toe in enumerate(TOES):
        for column, corner in ((3 * i, 7), (3 * i + 2, 3)):
            if column not in inner:
                inner[column] = count
                places.append(_toe_rings(toe)[0, [corner]])
                count += 1
    left, bottom = 0.0, float(v[-1]) + GAP
    for i, toe in enumerate(TOES):
        d, own = 1 + 3 * i, _toe_rings(toe)
        root = [*webs[d : d + 3], inner[3 * i + 2], *webs[[RING - d - 2, RING - d - 1, RING - d]], inner[3 * i]]
        beyond = count + np.arange(own[1:].size // 3).reshape(-1, 8)
        tip = (own[-1].mean(axis=0) + 0.25 * (own[-1] - own[-2]).mean(axis=0))[None]
        places += [own[1:].reshape(-1, 3), tip]
        pole, count = count + beyond.size, count + beyond.size + 1
        width, along = 8 * 2 * FULLER * toe.half[0][0] / UNIT_MM * 0.4, bottom + run_of(own) / UNIT_MM
        for values, part in zip((faces, uv), tube(np.concatenate([[root], beyond]), left + width * np.arange(9) / 8, along)):
            values.append(part)
        faces.append(np.append(beyond[-1], pole)[[[0, 1, 8, 7], [1, 2, 3, 8], [8, 3, 4, 5], [7, 8, 5, 6]]])
        square = np.array([[1, -1], [0, -1], [-1, -1], [-1, 0], [-1, 1], [0, 1], [1, 1], [1, 0], [0, 0]]) * width / 8
        uv.append((square + [left + width / 8, along[-1] + width / 8])[[[0, 1, 8, 7], [1, 2, 3, 8], [8, 3, 4, 5], [7, 8, 5, 6]]])
        if i < len(TOES) - 1:
            c, box = d + 2, np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * 0.05
            a, b = inner[3 * i + 2], inner[3 * i + 3]
            faces.append(np.array([[webs[c], webs[c + 1], b, a], [a, b, webs[RING - c - 1], webs[RING - c]]]))
            uv.append(np.stack([box + [GIRTH + GAP, 0.12 * i], box + [GIRTH + GAP, 0.12 * i + 0.05]]))
        left += width + GAP
    vertices, islands = np.concatenate(places), np.concatenate(uv)
    return Template(
        vertices=vertices / UNIT_MM,
        faces=np.concatenate(faces),
        weights=_weights(vertices, rings),
        bones=(OWN, TOE),
        uv=islands,
        uv_size=(float(islands[..., 0].max()), float(islands[..., 1].max())),
        girth=GIRTH,
        ring=RING,
        border_u=np.arange(RING) / RING,
        own=_own(vertices, rings),
        column=np.arange(len(vertices)) % RING,
    )


def _weights(vertices: np.ndarray, rings: np.ndarray) -> np.ndarray:
    """(V, 2) of the foot and its toes."""
    toe = np.zeros(len(vertices))
    toe[rings[-1].min() :] = 1.0
    for ring, share in zip(rings[-4:-1], TOE_SHARE):
        toe[ring] = share
    return np.stack([1 - toe, toe], axis=1)


def _own(vertices: np.ndarray, rings: np.ndarray) -> np.ndarray:
    """(V,) `Template.own`: 0 at the border."""
    own = smooth((vertices[:, 2] + TILT * vertices[:, 1] - FOLLOWS_MM[0]) / (FOLLOWS_MM[1] - FOLLOWS_MM[0]))
    own[rings[0]] = 0.0
    return np.asarray(own)
