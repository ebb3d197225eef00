"""A head of quads with brow, closed eyes, nose, mouth, jaw and ears, cast onto solids that have the proportions of anthropometry.

Coordinates in mm of a head whose bone, from the atlas to the crown, is UNIT_MM long: x to the side, y along the bone, z to the face. The
proportions are those of adults (Gordon et al., ANSUR 1989), between women and men: about 195 mm long, 152 wide, 225 high from the chin;
136 wide at the cheekbones; the nose's root 115 above the chin, the nose 35 wide and 22 beyond the face; pupils 63 apart; the mouth 50
wide; ears 62 mm high, their fronts 130 below the crown.

Rings of COLUMNS rays, close together where the face and the ears are; the crown is closed by a square block of quads. The lowest ring is
at the neck.
"""

from functools import lru_cache

import numpy as np

from .rays import smooth
from .sculpture import Solid, cast_inwards
from .template import OWN, Template, grid_cap, run_of, tube

UNIT_MM = 158.0
COLUMNS = 56
AXIS_Z = 5.0  # of the rays' origins
FARTHEST_MM = 150.0
TOP_MM, LOW_MM = 84.0, -30.0  # between these the rays are level
HALF_COLUMNS = ((48.0, 12), (78.0, 4), (118.0, 7), (180.0, 5))  # degrees from the middle of the face: end of a range, and its columns
ROW_MM = 5.7
ABOVE_DEG = (5.0, 11.0, 18.0, 26.0, 35.0, 44.0, 53.0)  # elevations of the rays above the brow
BELOW_DEG = ((-60.0, -26.0), (-48.0, -21.0), (-38.0, -16.5), (-28.0, -12.0), (-18.5, -8.0), (-9.0, -4.0))  # at chin and nape
FOLLOWS_MM = (-95.0, -20.0)  # height (tilted to the chin) over which vertices pass from the neck to the head
TILT = 0.55
GIRTH, BORDER, MARGIN = 3.6, 0.15, 0.05  # of the texture's island: width of the rings', the strip below them, and what is between islands

SOLIDS = (
    Solid((0, 92, -8), (75, 80, 94), 1),  # cranium
    Solid((0, 90, 38), (61, 54, 52), 22),  # forehead
    Solid((0, 18, 36), (57, 74, 46), 25),  # face
    Solid((0, -62, -24), (52, 52), 22, end=(0, -140, -34)),  # neck
    Solid((0, 8, -24), (56, 46, 56), 26),  # nape
    Solid((47, 33, 40), (19, 15, 26), 16, pair=True),  # cheekbones
    Solid((43, -12, 8), (12, 22, 24), 18, pair=True),  # angles of the jaw
    Solid((44, -24, 12), (10, 11), 14, end=(14, -43, 64), pair=True),  # its lower edges
    Solid((0, -41, 70), (17, 13, 14), 12),  # chin
    Solid((9, 69, 83), (8.0, 8.0), 10, end=(46, 67, 62), pair=True),  # brow ridges
    Solid((31, 54, 91), (20, 12, 16), 10, pair=True, hollow=True),  # orbits
    Solid((31, 54.5, 67), (15.0, 12.5, 14.5), 3, pair=True),  # eyes, closed
    Solid((0, 62, 81), (6.5, 8.5), 9, end=(0, 24, 103)),  # bridge of the nose
    Solid((0, 21.5, 104), (9.5, 8.5, 9.5), 6),  # its tip
    Solid((11.5, 16.5, 95), (7.5, 7.5, 10), 4, pair=True),  # its wings
    Solid((0, -4, 76), (30, 18, 14), 14),  # mouth
    Solid((0, -3.0, 91.5), (4.2, 3.0), 4, end=(23, -8, 80), pair=True),  # upper lip
    Solid((0, -14.5, 89.5), (5.2, 3.4), 4, end=(20, -11.5, 80), pair=True),  # lower lip
    Solid((0, -8.6, 99), (2.2, 1.6), 2, end=(25, -9.4, 85), pair=True, hollow=True),  # between them
    Solid((75, 43, -14), (9, 30, 19), 10, pair=True, turn_deg=(12, 20, 0)),  # ears
    Solid((88, 42, -9), (8, 16, 9), 6, pair=True, hollow=True, turn_deg=(12, 20, 0)),  # their hollows
)


def column_angles() -> np.ndarray:
    """(COLUMNS,) [rad] of the rays, 0 at the face, π/2 at the side of x: from the back on, to −x first."""
    half, begin = [0.0], 0.0
    for end, count in HALF_COLUMNS:
        half += np.linspace(begin, end, count + 1)[1:].tolist()
        begin = end
    return np.radians(np.concatenate([-np.array(half[::-1]), half[1:-1]]))


def _rows() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each ring, from the neck: heights of the rays' origins, their elevations at the face and at the back [rad]."""
    level = np.linspace(LOW_MM, TOP_MM, round((TOP_MM - LOW_MM) / ROW_MM) + 1)
    height = np.concatenate([np.full(len(BELOW_DEG), LOW_MM), level, np.full(len(ABOVE_DEG), TOP_MM)])
    elevation = np.radians([*BELOW_DEG, *[(0.0, 0.0)] * len(level), *((a, a) for a in ABOVE_DEG)])
    return height, elevation[:, 0], elevation[:, 1]


@lru_cache(maxsize=1)
def head_template() -> Template:
    """The cage of the head. 0.5 s."""
    angle = column_angles()
    height, at_face, at_back = _rows()
    elevation = at_back[:, None] + (at_face - at_back)[:, None] * (1 + np.cos(angle)) / 2
    level = np.stack([np.sin(angle), np.zeros(COLUMNS), np.cos(angle)], axis=-1)
    direction = np.cos(elevation)[..., None] * level + np.sin(elevation)[..., None] * [0.0, 1.0, 0.0]
    origin = np.zeros((len(height), COLUMNS, 3)) + np.stack([0 * height, height, 0 * height + AXIS_Z], axis=-1)[:, None]
    cap, cap_faces = grid_cap(direction[-1], COLUMNS // 8)
    cap /= np.linalg.norm(cap, axis=1, keepdims=True)
    directions = np.concatenate([direction.reshape(-1, 3), cap])
    origins = np.concatenate([origin.reshape(-1, 3), np.tile(origin[-1, 0], (len(cap), 1))])
    vertices = cast_inwards(SOLIDS, origins, directions, FARTHEST_MM)
    rings = np.arange(len(height) * COLUMNS).reshape(-1, COLUMNS)
    last = np.concatenate([rings[-1], rings.size + np.arange(len(cap))])
    return _finished(vertices / UNIT_MM, rings, last[cap_faces], np.append(angle - angle[0], 2 * np.pi) * GIRTH / (2 * np.pi))


def _finished(vertices: np.ndarray, rings: np.ndarray, cap: np.ndarray, u: np.ndarray) -> Template:
    v = BORDER + run_of(vertices[rings])
    faces, uv = tube(rings, u, v)
    crown = vertices[cap][..., [0, 2]]  # from above
    low, high = crown.min(axis=(0, 1)), crown.max(axis=(0, 1))
    cap_uv = (crown - low) * [-1.0, 1.0] + [GIRTH + MARGIN + high[0] - low[0], 0.0]
    height = (vertices[:, 1] + TILT * vertices[:, 2]) * UNIT_MM
    own = smooth((height - FOLLOWS_MM[0]) / (FOLLOWS_MM[1] - FOLLOWS_MM[0]))
    own[rings[0]] = 0.0
    return Template(
        vertices=vertices,
        faces=np.concatenate([faces, cap]),
        weights=np.ones((len(vertices), 1)),
        bones=(OWN,),
        uv=np.concatenate([uv, cap_uv]),
        uv_size=(GIRTH + MARGIN + high[0] - low[0], float(max(v[-1], high[1] - low[1]))),
        girth=GIRTH,
        ring=COLUMNS,
        border_u=u[:-1] / GIRTH,
        own=own,
        column=np.arange(len(vertices)) % COLUMNS,
    )
