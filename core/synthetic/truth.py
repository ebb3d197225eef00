"""truth.npz, the truth of a recording, and distances from it.

vertices_m (T, V, 3), triangles (F, 3), textured (V,), visible (T, ⌈V/8⌉) packed bits, joints_m (T, J, 3), joint_names, time_s (T,)
and, for recordings of a body model: dof_names, motion_values (T, D), bone_names, lengths_m (B,), radii_m (M, 3)
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..foundation import store
from ..foundation.errors import InputError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

NEEDED = ("vertices_m", "triangles", "textured", "visible", "joints_m", "joint_names", "time_s")
LIMBS = {"shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "hip": "UpLeg", "knee": "Leg", "ankle": "Foot"}
SIDES = {"L": "Left", "R": "Right"}
MIDDLE = {"pelvis": "Hips", "neck": "Neck1", "head": "Head"}
CANDIDATES = 20  # triangles tried per point
BATCH = 20000  # points at a time


def motion_capture_name(joint: str) -> str:
    """The name of a joint in motion capture files, and in truth.npz: “elbow.R” → “RightForeArm”; the name itself if it has none."""
    name, _, side = joint.partition(".")
    return SIDES[side] + LIMBS[name] if name in LIMBS and side in SIDES else MIDDLE.get(joint, joint)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Truth:
    """The true surface, its part visible in all cameras, the true joints, and the values of the body model (or None)."""

    vertices_m: np.ndarray  # (T, V, 3)
    triangles: np.ndarray  # (F, 3)
    textured: np.ndarray  # (V,) bool
    visible: np.ndarray  # (T, V) bool
    joints_m: dict[str, np.ndarray]  # (T, 3) by motion capture name
    motion: dict[str, np.ndarray] | None = None  # (T,) by DOF
    lengths_m: dict[str, float] | None = None  # by bone
    radii_m: np.ndarray | None = None  # (M, 3)
    settings: str = ""  # of the recording, as JSON

    def closest(self, frame: int, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The nearest surface points: distance (N,) [m], triangle (N,), weights of its corners (N, 3)."""
        return closest_on_mesh(self.vertices_m[frame], self.triangles, points_m)


def read_truth(take: Path) -> Truth:
    """Read TAKE/truth.npz.

    Raises:
        InputError: it is missing, damaged or incomplete.
    """
    path = Path(take) / "truth.npz"
    try:
        data = store.load_arrays(path)
    except FileNotFoundError as error:
        raise InputError(f"{path} is missing; only a recording with known truth can be scored.") from error
    except store.DAMAGED as error:
        raise InputError(f"{path} is damaged ({error}); make the recording again.") from error
    missing = [name for name in NEEDED if name not in data]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}; make the recording again.")
    count = data["vertices_m"].shape[1]
    return Truth(
        vertices_m=data["vertices_m"].astype(np.float64),
        triangles=data["triangles"].astype(np.int64),
        textured=data["textured"].astype(bool),
        visible=np.unpackbits(data["visible"], axis=1)[:, :count].astype(bool),
        joints_m={str(name): data["joints_m"][:, i].astype(np.float64) for i, name in enumerate(data["joint_names"])},
        motion=dict(zip(data["dof_names"].tolist(), data["motion_values"].T)) if "dof_names" in data else None,
        lengths_m=dict(zip(data["bone_names"].tolist(), data["lengths_m"].tolist())) if "bone_names" in data else None,
        radii_m=data.get("radii_m"),
        settings=str(data.get("settings", "")),
    )


def closest_on_mesh(vertices_m: np.ndarray, triangles: np.ndarray, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest points of a mesh to points (N, 3): distance (N,), triangle (N,), weights of its corners (N, 3).

    The 20 triangles with the nearest centres are tried, which is exact as long as triangles of very different size do not meet.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(points_m, dtype=np.float64)
    corners = vertices_m[triangles]
    tree = cKDTree(corners.mean(axis=1))
    found = [_closest_of(corners, tree, part) for part in np.array_split(points, max(1, len(points) // BATCH))]
    return tuple(np.concatenate(column) for column in zip(*found))  # type: ignore[return-value]


def _closest_of(corners: np.ndarray, tree: "cKDTree", points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    near = tree.query(points, k=min(CANDIDATES, len(corners)))[1].reshape(len(points), -1)
    weights = _weights(corners[near] - points[:, None, None])
    squared = (np.einsum("nkc,nkcx->nkx", weights, corners[near] - points[:, None, None]) ** 2).sum(axis=2)
    best = squared.argmin(axis=1)
    row = np.arange(len(points))
    return np.sqrt(squared[row, best]), near[row, best], weights[row, best]


def _weights(p: np.ndarray) -> np.ndarray:
    """Barycentric weights (…, 3) of the point nearest to the origin in triangles p (…, 3, 3): inside, else on the nearest edge."""
    options = [_inside_weights(p)]
    for i in range(3):
        a, edge = p[..., i, :], p[..., (i + 1) % 3, :] - p[..., i, :]
        share = np.clip(-(a * edge).sum(-1) / np.maximum((edge * edge).sum(-1), 1e-300), 0, 1)
        on_edge = np.zeros(p.shape[:-1])
        on_edge[..., i], on_edge[..., (i + 1) % 3] = 1 - share, share
        options.append(on_edge)
    every = np.stack(options)
    squared = (np.einsum("o...c,...cx->o...x", every, p) ** 2).sum(axis=-1)
    squared[0] = np.where((options[0] >= 0).all(axis=-1), squared[0], np.inf)
    return np.take_along_axis(every, squared.argmin(axis=0)[None, ..., None], axis=0)[0]


def _inside_weights(p: np.ndarray) -> np.ndarray:
    """Weights of the foot of the perpendicular from the origin on the triangle's plane; −1 for a triangle without area."""
    u, v, a = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :], p[..., 0, :]
    uu, uv, vv, ua, va = ((x * y).sum(-1) for x, y in ((u, u), (u, v), (v, v), (u, a), (v, a)))
    det = uu * vv - uv * uv
    flat = det <= 1e-12 * uu * vv
    det = np.where(flat, 1.0, det)
    s, t = (uv * va - vv * ua) / det, (uv * ua - uu * va) / det
    return np.where(flat[..., None], -1.0, np.stack([1 - s - t, s, t], axis=-1))
