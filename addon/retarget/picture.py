"""A picture that compares source and target: lines from joint to joint, the target with points of its skin."""

from collections.abc import Mapping
from pathlib import Path

import bpy
import cv2
import numpy as np

from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.motion.retarget.mapping import RigMap
from ...core.motion.retarget.rig import Motion
from ...core.motion.retarget.roles import ARM, LEG, SIDES, sided
from ...core.motion.retarget.transfer import body_axes
from ..scene import layers

COLUMNS = 8  # frames
CELL_PX = (190, 270)
MOST_POINTS = 15000  # of the skin
HEADROOM = 1.3  # height of a cell by that of the highest joint, for heads and titles
MAX_GAPS = 0.2  # of a chain's length: gaps between its bones; with larger ones, tails are not drawn
VIEW_DEG = 40.0  # from the front
PAPER, INK, LEFT, RIGHT, SKIN, FLOOR = (255, 255, 255), (60, 60, 60), (40, 90, 220), (210, 120, 30), (185, 185, 185), (160, 160, 160)


def draw(path: Path, source: Motion, source_map: RigMap, target: bpy.types.Object, motion: Motion, target_map: RigMap) -> None:
    """Write a PNG: a row of frames of the source, below it the target, obliquely from the front, with frame numbers. Left limbs are red,
    right ones blue.

    Raises:
        InputError: the file cannot be written.
    """
    some = np.unique(np.linspace(0, len(motion.frames) - 1, COLUMNS).round().astype(int))
    rows = []
    for moved, rig_map, skinned, title in ((source, source_map, None, "source"), (motion, target_map, target, "target")):
        size = max(float(moved.head_m[some, :, 2].max() - min(moved.head_m[..., 2].min(), 0.0)) * HEADROOM, 1e-3)
        view = _view(moved, rig_map)
        cells = [_cell(moved, rig_map, int(i), size, view, skinned) for i in some]
        for k, (i, cell) in enumerate(zip(some, cells)):
            _write(cell, (8, 18), f"{title}, frame {moved.frames[i]:g}" if k == 0 else f"{moved.frames[i]:g}")
        rows.append(np.concatenate(cells, axis=1))
    done, data = cv2.imencode(".png", np.concatenate(rows, axis=0))
    if not done:
        raise InputError(f"The picture {path} could not be made; leave out --report.")
    store.write_bytes(path, data.tobytes())


def _write(image: np.ndarray, place: tuple[int, int], words: str) -> None:
    cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1, cv2.LINE_AA)


def _view(motion: Motion, rig_map: RigMap) -> np.ndarray:
    """Right and up (2, 3) of the picture, VIEW_DEG from the front of the body in the first frame."""
    hips = rig_map.first("hips")
    axes = body_axes(motion.rig, rig_map)
    if hips is not None:
        b = motion.rig.index[hips]
        axes = motion.R[0, b] @ motion.rig.R_rest[b].T @ axes
    heading = np.arctan2(-axes[1, 1], -axes[0, 1]) + np.radians(VIEW_DEG)
    right = np.array([-np.sin(heading), np.cos(heading), 0.0])
    return np.stack([right, np.array([0.12 * np.cos(heading), 0.12 * np.sin(heading), -1.0])])


def _cell(motion: Motion, rig_map: RigMap, i: int, size: float, view: np.ndarray, skinned: bpy.types.Object | None) -> np.ndarray:
    image = np.full((CELL_PX[1], CELL_PX[0], 3), PAPER, dtype=np.uint8)
    head = motion.head_m[i]
    hips = rig_map.first("hips")
    middle = head[motion.rig.index[hips]] if hips else head.mean(axis=0)
    low = min(0.0, float(motion.head_m[..., 2].min()))

    def pixel(X: np.ndarray) -> np.ndarray:
        flat = (X - (middle[0], middle[1], low)) @ view.T / size * CELL_PX[1]
        return np.asarray(flat + (CELL_PX[0] / 2, 0.93 * CELL_PX[1]))

    floor = int(pixel(np.array([middle[0], middle[1], 0.0]))[1])
    cv2.line(image, (0, floor), (CELL_PX[0], floor), FLOOR, 1)
    if skinned is not None:
        for x, y in pixel(_skin_points(skinned, float(motion.frames[i]))).round().astype(int):
            if 0 <= x < CELL_PX[0] and 0 <= y < CELL_PX[1]:
                image[y, x] = SKIN
    for line, colour in _lines(rig_map):
        ends = [head[motion.rig.index[name]] for name in line]
        places = pixel(np.array([*ends, *_tip(motion, i, line)])).round().astype(np.int32)
        cv2.polylines(image, [places.reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA)
    return image


def _tip(motion: Motion, i: int, line: list[str]) -> list[np.ndarray]:
    """The tail of the last bone of a chain, in a rig whose bones end where the next ones begin; other tails mean nothing."""
    rig, bones = motion.rig, [motion.rig.index[name] for name in line]
    gaps = np.linalg.norm(rig.tail_m[bones[1:-1]] - rig.head_m[bones[2:]], axis=1)
    steps = np.linalg.norm(rig.head_m[bones[2:]] - rig.head_m[bones[1:-1]], axis=1)
    last = bones[-1]
    if gaps.sum() > MAX_GAPS * steps.sum():
        return []
    return [motion.head_m[i, last] + motion.R[i, last] @ (rig.R_rest[last].T @ (rig.tail_m[last] - rig.head_m[last]))]


def _lines(rig_map: RigMap) -> list[tuple[list[str], tuple[int, int, int]]]:
    trunk = [name for role in ("hips", "spine", "neck", "head") for name in rig_map.bones.get(role, ())]
    lines: list[tuple[list[str], tuple[int, int, int]]] = [(trunk, INK)]
    for side, colour in zip(SIDES, (LEFT, RIGHT)):
        for parts, start in ((ARM, rig_map.bones.get("spine", ())[-1:]), (LEG, rig_map.bones.get("hips", ())[-1:])):
            line = [*start, *_chain(rig_map.bones, [sided(part, side) for part in parts])]
            lines.append((line, colour))
    return [(line, colour) for line, colour in lines if len(line) > 1]


def _chain(bones: Mapping[str, tuple[str, ...]], roles: list[str]) -> list[str]:
    return [name for role in roles for name in bones.get(role, ())]


def _skin_points(armature_object: bpy.types.Object, frame: float) -> np.ndarray:
    """Vertices (N, 3) of the meshes that the armature deforms, in a frame, thinned to about MOST_POINTS."""
    scene = bpy.context.scene
    scene.frame_set(int(np.floor(frame)), subframe=float(frame % 1.0))
    graph, found = bpy.context.evaluated_depsgraph_get(), [np.zeros((0, 3))]
    for skin in [o for o in scene.objects if o.type == "MESH" and not layers.is_ellipsoids(o)]:
        if armature_object not in (m.object for m in skin.modifiers if m.type == "ARMATURE"):
            continue
        mesh = skin.evaluated_get(graph).data
        place = np.empty(3 * len(mesh.vertices))
        mesh.vertices.foreach_get("co", place)
        world = np.array(skin.matrix_world)
        found.append(place.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
    points = np.concatenate(found)
    return points[:: max(1, len(points) // MOST_POINTS)]
