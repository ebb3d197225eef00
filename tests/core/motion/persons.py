"""People made of sticks, for the tests of retargeting: any names, rolls, proportions, rest poses and headings; and how they move."""

from collections.abc import Mapping

import numpy as np

from tricap.core.geometry.rotation import about, matrix_from_vector, shortest
from tricap.core.motion.retarget.mapping import MappedMotion, MappedRig, RigMap, find_map
from tricap.core.motion.retarget.rig import Motion, Rig, posed
from tricap.core.motion.retarget.roles import SIDES, sided

# role, parent, head, tail of the left side or the middle; faces −Y, metres
PARTS = (
    ("hips", "", (0, 0, 1.0), (0, 0, 1.1)),
    ("spine", "hips", (0, 0, 1.1), (0, 0, 1.45)),
    ("neck", "spine", (0, 0, 1.45), (0, 0, 1.55)),
    ("head", "neck", (0, 0, 1.55), (0, 0, 1.75)),
    ("clavicle", "spine", (0.03, 0, 1.42), (0.18, 0, 1.42)),
    ("upper_arm", "clavicle", (0.18, 0, 1.42), (0.46, 0, 1.42)),
    ("forearm", "upper_arm", (0.46, 0, 1.42), (0.72, 0, 1.42)),
    ("hand", "forearm", (0.72, 0, 1.42), (0.85, 0, 1.42)),
    ("thigh", "hips", (0.1, 0, 0.95), (0.1, 0, 0.52)),
    ("shin", "thigh", (0.1, 0, 0.52), (0.1, 0, 0.09)),
    ("foot", "shin", (0.1, 0, 0.09), (0.1, -0.14, 0.02)),
    ("toe", "foot", (0.1, -0.14, 0.02), (0.1, -0.2, 0.02)),
)
MIRROR = np.array([-1.0, 1.0, 1.0])


def person(
    *,
    names: Mapping[str, str] | None = None,
    size: float = 1.0,
    arms_down_deg: float = 0.0,
    legs_apart_deg: float = 0.0,
    heading_deg: float = 0.0,
    roll_seed: int | None = None,
    thigh_part: float = 0.5,
    without: tuple[str, ...] = (),
) -> Rig:
    """A rig; bones have their roles' names unless `names` says otherwise. `without`: parts whose children hang on their parents."""
    rows = []
    for role, parent, head, tail in PARTS:
        if role in without:
            continue
        while parent in without:
            parent = next(p for r, p, _, _ in PARTS if r == parent)
        central = parent in ("", "hips", "spine", "neck") and role in ("hips", "spine", "neck", "head")
        for side in ("",) if central else SIDES:
            X = np.array([head, tail]) * (MIRROR if side == "R" else 1.0)
            parent_role = parent if parent in ("", "hips", "spine", "neck", "head") else sided(parent, side)
            X = _shaped(role, side, X, arms_down_deg, legs_apart_deg, thigh_part)
            rows.append((sided(role, side) if side else role, parent_role, X))
    order = {role: i for i, (role, _, _) in enumerate(rows)}
    places = np.array([X for _, _, X in rows]) * size @ about(np.array([0.0, 0.0, 1.0]), np.radians(heading_deg)).T
    along = places[:, 1] - places[:, 0]
    R_rest = shortest(np.array([0.0, 1.0, 0.0]), along)
    if roll_seed is not None:
        R_rest = R_rest @ about(np.array([0.0, 1.0, 0.0]), np.random.default_rng(roll_seed).uniform(-np.pi, np.pi, len(rows)))
    return Rig(
        names=tuple((names or {}).get(role, role) for role, _, _ in rows),
        parents=np.array([order[parent] if parent else -1 for _, parent, _ in rows]),
        R_rest=R_rest,
        head_m=places[:, 0],
        tail_m=places[:, 1],
        connected=np.zeros(len(rows), dtype=bool),
        inherits_rotation=np.ones(len(rows), dtype=bool),
    )


def mapped(motion: Motion, rig_map: RigMap | None = None) -> MappedMotion:
    """A motion with a mapping, or with the one that is found."""
    return MappedMotion(motion=motion, map=rig_map or find_map(motion.rig))


def mapped_rig(rig: Rig, rig_map: RigMap | None = None) -> MappedRig:
    """A rig with a mapping, or with the one that is found."""
    return MappedRig(rig=rig, map=rig_map or find_map(rig))


def _shaped(role: str, side: str, X: np.ndarray, arms_down_deg: float, legs_apart_deg: float, thigh_part: float) -> np.ndarray:
    sign = -1.0 if side == "R" else 1.0
    if role in ("thigh", "shin"):
        knee = 0.95 - 0.86 * thigh_part
        X = X.copy()
        X[1 if role == "thigh" else 0, 2] = knee
    if role in ("upper_arm", "forearm", "hand"):
        shoulder = np.array([sign * 0.18, 0, 1.42])
        X = shoulder + (X - shoulder) @ about(np.array([0.0, 1.0, 0.0]), sign * np.radians(arms_down_deg)).T
    if role in ("thigh", "shin", "foot", "toe"):
        hip = np.array([sign * 0.1, 0, 0.95])
        turned = hip + (X - hip) @ about(np.array([0.0, -1.0, 0.0]), sign * np.radians(legs_apart_deg)).T
        X = (
            turned
            if role in ("thigh", "shin")
            else X
            + (
                hip
                + (np.array([sign * 0.1, 0, 0.09]) - hip) @ about(np.array([0.0, -1.0, 0.0]), sign * np.radians(legs_apart_deg)).T
                - np.array([sign * 0.1, 0, 0.09])
            )
        )
    return X


def flail(rig: Rig, frames: int = 60, seed: int = 3, reach: float = 0.8) -> Motion:
    """Every bone turns smoothly about all its axes; the body travels."""
    random = np.random.default_rng(seed)
    n = len(rig.names)
    phase = np.linspace(0, 2 * np.pi, frames)[:, None, None]
    vectors = reach * random.uniform(-1, 1, (n, 3)) * np.sin(phase * random.integers(1, 3, (n, 3)) + random.uniform(0, 6, (n, 3)))
    shift = np.stack([0.3 * phase[:, 0, 0], -0.5 * phase[:, 0, 0], 0.1 * np.sin(phase[:, 0, 0])], axis=1)
    R, head = posed(rig, matrix_from_vector(vectors), {0: shift})
    return Motion(rig=rig, fps=30.0, frames=np.arange(frames), R=R, head_m=head)


def squat(rig: Rig, frames: int = 90, deepest: float = 0.9) -> Motion:
    """Both feet stand while the knees bend and stretch; thigh and shin must be equally long, and the person face −Y."""
    angle = deepest * np.sin(np.linspace(0, 2 * np.pi, frames)) ** 2
    across = np.array([-1.0, 0.0, 0.0])  # about it thighs go forwards
    world = np.broadcast_to(np.eye(3), (frames, len(rig.names), 3, 3)).copy()
    for b, name in enumerate(rig.names):
        if name.startswith("thigh"):
            world[:, b] = about(across, angle)
        elif name.startswith("shin"):
            world[:, b] = about(across, -angle)
    R = world @ rig.R_rest
    leg = 0.43 * rig.height_m / 1.73
    drop = np.stack([np.zeros(frames), np.zeros(frames), 2 * leg * (np.cos(angle) - 1.0)], axis=1)
    from tricap.core.motion.retarget.rig import channels

    R, head = posed(rig, channels(rig, R), {0: drop})
    return Motion(rig=rig, fps=30.0, frames=np.arange(frames), R=R, head_m=head)
