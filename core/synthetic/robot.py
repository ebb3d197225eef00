"""A character of plain shapes with an armature, to try retargeting on: a robot with long arms, short legs and a large head."""

from dataclasses import dataclass

import numpy as np

from ..geometry.rotation import shortest
from ..motion.retarget.rig import Rig

# Bones, parents first, in a T-pose that faces −Y, with the left side at +X: name, parent, head and tail [m]. Those with `.L` stand for
# both sides.
BONES = (
    ("hips", "", (0.0, 0.0, 0.72), (0.0, 0.0, 0.82)),
    ("spine", "hips", (0.0, 0.0, 0.82), (0.0, 0.0, 0.97)),
    ("chest", "spine", (0.0, 0.0, 0.97), (0.0, 0.0, 1.19)),
    ("neck", "chest", (0.0, 0.0, 1.19), (0.0, 0.0, 1.25)),
    ("head", "neck", (0.0, 0.0, 1.25), (0.0, 0.0, 1.53)),
    ("shoulder.L", "chest", (0.03, 0.0, 1.13), (0.18, 0.0, 1.13)),
    ("upper_arm.L", "shoulder.L", (0.18, 0.0, 1.13), (0.44, 0.005, 1.13)),
    ("forearm.L", "upper_arm.L", (0.44, 0.005, 1.13), (0.70, 0.0, 1.13)),
    ("hand.L", "forearm.L", (0.70, 0.0, 1.13), (0.84, 0.0, 1.13)),
    ("thigh.L", "hips", (0.10, 0.0, 0.70), (0.10, -0.005, 0.40)),
    ("shin.L", "thigh.L", (0.10, -0.005, 0.40), (0.10, 0.0, 0.10)),
    ("foot.L", "shin.L", (0.10, 0.0, 0.10), (0.10, -0.12, 0.03)),
    ("toe.L", "foot.L", (0.10, -0.12, 0.03), (0.10, -0.20, 0.03)),
)
# Solids: bone, middle and half sizes along x, y, z [m], and whether it is dark. Those of bones with `.L` stand for both sides.
SOLIDS = (
    ("hips", (0.0, 0.0, 0.76), (0.125, 0.085, 0.07), False),
    ("spine", (0.0, 0.0, 0.88), (0.07, 0.06, 0.09), True),
    ("chest", (0.0, 0.0, 1.06), (0.165, 0.10, 0.125), False),
    ("chest", (0.0, -0.095, 1.08), (0.05, 0.015, 0.05), True),
    ("neck", (0.0, 0.0, 1.21), (0.045, 0.045, 0.06), True),
    ("head", (0.0, 0.0, 1.39), (0.135, 0.125, 0.135), False),
    ("head", (0.0, -0.105, 1.40), (0.095, 0.03, 0.05), True),
    ("head", (0.0, 0.0, 1.555), (0.02, 0.02, 0.035), True),
    ("shoulder.L", (0.185, 0.0, 1.13), (0.06, 0.06, 0.06), True),
    ("upper_arm.L", (0.315, 0.0, 1.13), (0.115, 0.045, 0.045), False),
    ("upper_arm.L", (0.44, 0.0, 1.13), (0.042, 0.042, 0.042), True),
    ("forearm.L", (0.575, 0.0, 1.13), (0.115, 0.05, 0.05), False),
    ("forearm.L", (0.70, 0.0, 1.13), (0.032, 0.032, 0.032), True),
    ("hand.L", (0.785, 0.0, 1.13), (0.065, 0.042, 0.024), False),
    ("hand.L", (0.755, -0.052, 1.13), (0.035, 0.016, 0.016), True),
    ("thigh.L", (0.10, 0.0, 0.70), (0.058, 0.058, 0.058), True),
    ("thigh.L", (0.10, 0.0, 0.55), (0.06, 0.062, 0.13), False),
    ("shin.L", (0.10, 0.0, 0.40), (0.048, 0.048, 0.048), True),
    ("shin.L", (0.10, 0.0, 0.25), (0.052, 0.055, 0.13), False),
    ("foot.L", (0.10, 0.0, 0.10), (0.038, 0.038, 0.038), True),
    ("foot.L", (0.10, -0.035, 0.045), (0.055, 0.10, 0.045), False),
    ("toe.L", (0.10, -0.155, 0.032), (0.053, 0.052, 0.032), True),
)
ACROSS = 6  # quads along an edge of a solid
ROUND = 0.35  # exponent of the solids: 1 is an ellipsoid, 0 a box


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot:
    """B bones, and V vertices of quads, each of which moves with one bone."""

    rig: Rig
    vertices_m: np.ndarray  # (V, 3)
    bone: np.ndarray  # (V,)
    faces: np.ndarray  # (F, 4)
    dark: np.ndarray  # (F,) bool


def robot() -> Robot:
    """The robot, standing on the floor in a T-pose."""
    bones = [
        (_on(side, name), _on(side, parent), np.array(head) * (side, 1, 1), np.array(tail) * (side, 1, 1))
        for name, parent, head, tail in BONES
        for side in _sides(name)
    ]
    names = tuple(name for name, *_ in bones)
    heads, tails = np.array([head for *_, head, _ in bones]), np.array([tail for *_, tail in bones])
    cube, quads = _rounded_cube()
    vertices, owners, faces, dark = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for name, middle, half, is_dark in SOLIDS:
        for side in _sides(name):
            faces.append((quads if side > 0 else quads[:, ::-1]) + len(vertices) * len(cube))
            vertices.append((np.array(middle) + cube * half) * (side, 1, 1))
            owners.append(np.full(len(cube), names.index(_on(side, name))))
            dark.append(np.full(len(quads), is_dark))
    return Robot(
        rig=Rig(
            names=names,
            parents=np.array([names.index(parent) if parent else -1 for _, parent, *_ in bones]),
            R_rest=shortest(np.array([0.0, 1.0, 0.0]), tails - heads),
            head_m=heads,
            tail_m=tails,
            connected=np.zeros(len(names), dtype=bool),
            inherits_rotation=np.ones(len(names), dtype=bool),
        ),
        vertices_m=np.concatenate(vertices),
        bone=np.concatenate(owners),
        faces=np.concatenate(faces),
        dark=np.concatenate(dark),
    )


def _sides(name: str) -> tuple[float, ...]:
    """The factors of x for the sides that have a bone: 1 the left one or the middle, −1 the right one."""
    return (1.0, -1.0) if name.endswith(".L") else (1.0,)


def _on(side: float, name: str) -> str:
    return name if side > 0 else name.replace(".L", ".R")


def _rounded_cube() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) within −1…1 and outward quads (F, 4) of a superellipsoid, |x|^(2/e) + |y|^(2/e) + |z|^(2/e) = 1."""
    n, along = ACROSS + 1, np.linspace(-1.0, 1.0, ACROSS + 1)
    index: dict[tuple[float, ...], int] = {}
    quads = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            place = np.empty((n, n, 3))
            place[..., axis], place[..., u], place[..., v] = sign, along[:, None], along[None]
            ids = np.array([[index.setdefault(tuple(p.round(6).tolist()), len(index)) for p in row] for row in place])
            around = np.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], axis=-1).reshape(-1, 4)
            quads.append(around if sign > 0 else around[:, ::-1])
    direction = np.array(list(index))
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    radius = (np.abs(direction) ** (2 / ROUND)).sum(axis=1) ** (-ROUND / 2)
    return direction * radius[:, None], np.concatenate(quads)
