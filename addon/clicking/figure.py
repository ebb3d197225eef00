"""A small drawn figure that shows where a joint is: the whole body at rest, seen from the front. No Blender in here."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ...core.body.model_file import read_model
from ...core.body.skeleton import joint_positions

CORNERS = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class Figure:
    """The figure in a unit of its height; x to the right as one who faces the person sees it, y up, the origin at its lower left."""

    triangles: np.ndarray  # (N, 3, 2) of its body
    joints: dict[str, np.ndarray]  # (2,) by name
    width: float


@cache
def figure() -> Figure:
    """The whole body's model at rest. The person faces −y of the world and is seen from there: its right is on the left."""
    model = read_model("full")
    skeleton = model.skeleton
    lengths = np.array([bone.nominal_length_m for bone in skeleton.bones])
    places = {name: X[[0, 2]] for name, X in joint_positions(skeleton, lengths, np.zeros(len(skeleton.dof_names))).items()}
    limbs = [(places[b.head_joint], places[b.tail_joint], radii[:, 0]) for b, radii in zip(skeleton.bones, model.visible_radii_m)]
    outline = np.concatenate([_limb(a, b, r) for a, b, r in limbs if np.isfinite(r).all()])
    low, high = outline.reshape(-1, 2).min(axis=0), outline.reshape(-1, 2).max(axis=0)
    size = high[1] - low[1]
    return Figure(
        triangles=(outline - low) / size,
        joints={name: (p - low) / size for name, p in places.items()},
        width=float((high[0] - low[0]) / size),
    )


def _limb(a: np.ndarray, b: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """A bone's silhouette: discs at 1/6, 1/2 and 5/6 of it, and what lies between them, as triangles (N, 3, 2)."""
    centres = [a + share * (b - a) for share in (0.0, 1 / 6, 0.5, 5 / 6, 1.0)]
    widths = [0.8 * radii[0], *radii, 0.8 * radii[2]]
    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    across = np.array([-along[1], along[0]])
    parts = [_disc(c, w) for c, w in zip(centres, widths)]
    for (c, w), (d, v) in zip(zip(centres, widths), zip(centres[1:], widths[1:])):
        p, q, r, s = c - w * across, c + w * across, d + v * across, d - v * across
        parts.append(np.array([[p, q, r], [p, r, s]]))
    return np.concatenate(parts)


def _disc(centre: np.ndarray, radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, CORNERS + 1)
    rim = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([np.broadcast_to(centre, rim[1:].shape), rim[:-1], rim[1:]], axis=1)
