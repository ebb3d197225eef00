"""A rig and its motion from named points: joints measured or digitised, without rotations.

Each part points from joint to joint. Its twist is that of its parent, carried along by the smallest rotation, so that nothing flips; the
twist of hips and chest follows from the line between the hip joints or shoulders.
"""

from collections.abc import Mapping

import numpy as np

from ...foundation.errors import InputError
from ...geometry.rotation import shortest, transposed, unit
from ..formats.markers import Markers, filled
from .rig import Motion, Rig
from .roles import SIDES, WORD, read_name, side_of_words, sided

WORDS = {
    "hip": "thigh",
    "knee": "shin",
    "ankle": "foot",
    "toe": "toe",
    "bigtoe": "toe",
    "toes": "toe",
    "ball": "toe",
    "shoulder": "upper_arm",
    "elbow": "forearm",
    "wrist": "hand",
    "clavicle": "clavicle",
    "hand": "fingers",
    "finger": "fingers",
}
CENTRAL = {
    "pelvis": "hips",
    "hips": "hips",
    "midhip": "hips",
    "hip": "hips",
    "root": "hips",
    "neck": "neck",
    "head": "head",
    "nose": "nose",
    "chest": "chest",
    "spine": "spine",
    "thorax": "chest",
}
# part, joint at its head, joint at its tail, parent part, direction of the left one in the rest pose
LIMBS = (
    ("upper_arm", "upper_arm", "forearm", "spine", (1.0, 0.0, 0.0)),
    ("forearm", "forearm", "hand", "upper_arm", (1.0, 0.0, 0.0)),
    ("hand", "hand", "fingers", "forearm", (1.0, 0.0, 0.0)),
    ("thigh", "thigh", "shin", "hips", (0.0, 0.0, -1.0)),
    ("shin", "shin", "foot", "thigh", (0.0, 0.0, -1.0)),
    ("foot", "foot", "toe", "shin", (0.0, -1.0, 0.0)),
)


def joint_of(name: str) -> str:
    """ "RKnee", "knee.R", "right_knee" -> "shin.R"; "" for points that are not joints of the body."""
    words = [word.lower() for word in WORD.findall(name)]
    side, words = side_of_words(words)
    core = "".join(word for word in words if not word.isdigit() and word not in ("joint", "center", "centre", "jc"))
    if side:
        return sided(WORDS[core], side) if core in WORDS else ""
    if core[:1] in ("r", "l") and core[1:] in WORDS:
        return sided(WORDS[core[1:]], core[0].upper())
    return CENTRAL.get(core, "")


def joint_of_bone(name: str) -> str:
    """The joint at the head of a bone, for points named like bones: "lfemur" -> "thigh.L"."""
    reading = read_name(name)
    return sided(reading.part, reading.side) if reading.part and reading.side else reading.part if reading.part in ("hips", "head") else ""


def motion_from_points(markers: Markers) -> Motion:
    """A motion with the roles as bones' names.

    Raises:
        InputError: too few of the points are joints.
    """
    points = filled(markers)
    places: dict[str, np.ndarray] = {}
    for i, name in enumerate(points.names):
        places.setdefault(joint_of(name) or joint_of_bone(name), points.xyz_m[:, i])
    places.pop("", None)
    rows = _torso(places)
    for side in SIDES:
        mirror = np.array([1.0 if side == "L" else -1.0, 1.0, 1.0])
        for part, begin, end, above, rest in LIMBS:
            a, b = places.get(sided(begin, side)), places.get(sided(end, side))
            parent = above if above in ("hips", "spine") else sided(above, side)
            if a is None or (b is None and parent not in rows):
                continue
            rows[sided(part, side)] = (a, b, parent if parent in rows else "", np.array(rest) * mirror)
    limbs = [role for role in rows if role not in ("hips", "spine", "head")]
    if not any(rows[role][1] is not None for role in limbs):
        raise InputError("No two of the points are joints of one limb (such as shoulder.R and elbow.R); rename the points.")
    return _motion(rows, points)


Row = tuple[np.ndarray, np.ndarray | None, str, np.ndarray]  # from, to (T, 3), parent part, direction in the rest pose


def _torso(places: dict[str, np.ndarray]) -> dict[str, Row]:
    def middle(part: str) -> np.ndarray | None:
        pair = [places.get(sided(part, side)) for side in SIDES]
        return None if pair[0] is None or pair[1] is None else (pair[0] + pair[1]) / 2

    up, rows = np.array([0.0, 0.0, 1.0]), dict[str, Row]()
    hips, shoulders = places.get("hips"), middle("upper_arm")
    hips = middle("thigh") if hips is None else hips
    neck = places.get("neck", shoulders)
    if hips is not None and neck is not None:
        waist = hips + 0.3 * (neck - hips)
        rows["hips"] = (hips, waist, "", up)
        rows["spine"] = (waist, neck, "hips", up)
        if "head" in places or "nose" in places:
            rows["head"] = (neck, places.get("head", places.get("nose")), "spine", up)
    return rows


def _motion(rows: Mapping[str, Row], points: Markers) -> Motion:
    t, names = len(points.frames), tuple(rows)
    lengths = {name: _length(row) for name, row in rows.items()}
    turned: dict[str, np.ndarray] = {}
    head_rest: dict[str, np.ndarray] = {}
    for name, (a, b, above, rest) in rows.items():
        before = turned[above] if above else np.broadcast_to(np.eye(3), (t, 3, 3))
        along = unit(b - a) if b is not None else before @ rest
        if name in ("hips", "spine"):
            before = _facing(rows, name, along, before)
        turned[name] = shortest(before @ rest, along) @ before
        head_rest[name] = _rest_head(rows, name, above, head_rest, a, turned)
    order = {name: i for i, name in enumerate(names)}
    head = np.stack([head_rest[name] for name in names])
    direction = np.stack([rows[name][3] for name in names])
    R_rest = shortest(np.array([0.0, 1.0, 0.0]), direction)
    low = min(0.0, float(head[:, 2].min()))
    head = head - (0.0, 0.0, low)
    tail = head + direction * np.array([lengths[name] for name in names])[:, None]
    rig = Rig(
        names=names,
        parents=np.array([order[rows[name][2]] if rows[name][2] else -1 for name in names]),
        R_rest=R_rest,
        head_m=head,
        tail_m=tail,
        connected=np.zeros(len(names), dtype=bool),
        inherits_rotation=np.ones(len(names), dtype=bool),
        roles={name: name for name in names},
    )
    R = np.stack([turned[name] @ R_rest[order[name]] for name in names], axis=1)
    return Motion(rig=rig, fps=points.fps, frames=points.frames, R=R, head_m=np.stack([rows[name][0] for name in names], axis=1))


def _length(row: Row) -> float:
    a, b = row[0], row[1]
    return float(np.median(np.linalg.norm(b - a, axis=1))) if b is not None else 0.1


def _facing(rows: Mapping[str, Row], name: str, along: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Frames (T, 3, 3) with z along the trunk and x to the left, from the hip joints or the shoulders."""
    part = "thigh" if name == "hips" else "upper_arm"
    pair = [rows.get(sided(part, side)) for side in SIDES]
    if pair[0] is None or pair[1] is None:
        return before
    left = pair[0][0] - pair[1][0]
    x = unit(left - along * np.sum(left * along, axis=1, keepdims=True))
    return np.stack([x, np.cross(along, x), along], axis=2)


def _rest_head(
    rows: Mapping[str, Row], name: str, above: str, heads: Mapping[str, np.ndarray], a: np.ndarray, turned: Mapping[str, np.ndarray]
) -> np.ndarray:
    """The head of a part in the rest pose: its median position in its parent's axes."""
    if not above:
        return np.array([0.0, 0.0, 1.0]) if name == "hips" else np.median(a, axis=0)
    start = rows[above][0]
    return heads[above] + np.median(np.einsum("tij,tj->ti", transposed(turned[above]), a - start), axis=0)
