"""The layers of the fitted body one after the other, as a picture (D'Apuzzo et al. 1999, Fig. 10): skeleton, metaballs by kind, polygons of
the skin, and the skin shaded; in the rest pose, from the front."""

import cv2
import numpy as np

from ..body.anatomy import BONE, FAT, FLESH, KINDS, MUSCLE
from ..body.ellipsoids import ellipsoids
from ..body.shape import BodyShape
from ..body.skeleton import joint_positions
from ..body.skin.mesh import Skin
from ..geometry.camera import Camera
from ..geometry.raster import rasterize, shade, vertex_normals
from .drawing import add_axes, add_scale, small_text
from .person import Coloured, Mesh

PANEL_PX = (330, 520)  # width, height
GROUND, EDGE = (28, 28, 28), (125, 125, 125)
BONE_LINE, JOINT_DOT = (200, 215, 225), (60, 190, 250)
SKIN_COLOUR = np.array([120.0, 190.0, 255.0])  # BGR
KIND_COLOURS = {BONE: (205, 225, 235), MUSCLE: (85, 85, 215), FAT: (90, 205, 240), FLESH: (120, 140, 220)}  # BGR
DISTANCE_M, MARGIN_M = 30.0, 0.16  # far away, so that the picture is nearly to one scale
TITLES = ("a  skeleton", "b  metaballs", "c  blended surface", "d  finished skin", "e  with its texture")
LETTERS = 1.7  # their size: the page shows five panels in the width of one
FACTOR, DARKEST = 2, 0.55  # samples across a pixel of the last panel, and its least light: the texture has shades of its own


def layers_picture(shape: BodyShape, skin: Skin, finished: Mesh, coloured: Coloured | None = None) -> np.ndarray:
    """The layers side by side, in the rest pose: `skin` is that of the metaballs, `finished` that of the person, and `coloured` the same
    with its texture."""
    rest = np.zeros(len(shape.skeleton.dofs))
    camera, px_per_m = _in_front(shape, rest)
    panels = [_skeleton(shape, rest, camera), _balls(shape, rest, camera), _polygons(skin, camera), _shaded(finished, camera)]
    panels += [_textured(coloured, camera)] if coloured is not None else []
    for panel, title in zip(panels, TITLES):
        small_text(panel, title, (10, 24), size=LETTERS)
        add_scale(panel, px_per_m, size=LETTERS)
        add_axes(panel, ("x", "z"), up=True, size=LETTERS)
    return np.hstack(panels)


def kinds_shown(shape: BodyShape) -> str:
    """The colours of the kinds that a body has, as words for the caption."""
    words = {BONE: "white: bone", MUSCLE: "red: muscle", FAT: "yellow: fat", FLESH: "rose: flesh (bone, muscle and fat together)"}
    there = {KINDS[k] for k in np.unique(ellipsoids(shape, np.zeros(len(shape.skeleton.dofs))).kind)}
    return ", ".join(words[kind] for kind in KINDS if kind in there)


def _in_front(shape: BodyShape, rest: np.ndarray) -> tuple[Camera, float]:
    """A camera in front of the body that shows all of it, and the pixels of a metre."""
    joints = np.array([*joint_positions(shape.skeleton, shape.lengths_m, rest).values()])
    ahead, down = -shape.skeleton.bones[0].R_rest[:, 2], np.array([0.0, 0.0, -1.0])
    ahead = np.array([*ahead[:2], 0.0]) / np.linalg.norm(ahead[:2]) if np.linalg.norm(ahead[:2]) > 0.1 else np.array([0.0, 1.0, 0.0])
    R = np.stack([np.cross(down, ahead), down, ahead])
    across = joints @ R.T
    low, high = across.min(axis=0) - MARGIN_M, across.max(axis=0) + MARGIN_M
    middle, (width, height) = R.T @ (0.5 * (low + high)), PANEL_PX
    px_per_m = float(min(width / (high - low)[0], (height - 60) / (high - low)[1]))
    focal = px_per_m * DISTANCE_M
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    t = -R @ (middle - DISTANCE_M * ahead)
    return Camera(name="front", size_px=PANEL_PX, matrix=matrix, distortions=np.zeros(5), R_cam_world=R, t_cam_world_m=t), px_per_m


def _empty() -> np.ndarray:
    return np.full((PANEL_PX[1], PANEL_PX[0], 3), GROUND, np.uint8)


def _skeleton(shape: BodyShape, rest: np.ndarray, camera: Camera) -> np.ndarray:
    picture, joints = _empty(), joint_positions(shape.skeleton, shape.lengths_m, rest)
    pixel = {name: tuple(np.rint(camera.project(xyz)).astype(int).tolist()) for name, xyz in joints.items()}
    for bone in shape.skeleton.bones:
        cv2.line(picture, pixel[bone.head_joint], pixel[bone.tail_joint], BONE_LINE, 3, cv2.LINE_AA)
    for xy in pixel.values():
        cv2.circle(picture, xy, 4, JOINT_DOT, -1, cv2.LINE_AA)
    return picture


def _balls(shape: BodyShape, rest: np.ndarray, camera: Camera) -> np.ndarray:
    mesh, picture = ellipsoids(shape, rest), _empty()
    raster = rasterize(camera, mesh.vertices_m, mesh.triangles)
    normal = raster.interpolate(vertex_normals(mesh.vertices_m, mesh.triangles), mesh.triangles) @ camera.R_cam_world.T
    light = 0.35 + 0.65 * np.clip(-normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12), 0, 1)
    tints = np.array([KIND_COLOURS[kind] for kind in KINDS], dtype=np.float64)[mesh.kind[mesh.triangles[raster.triangle, 0]]]
    picture.reshape(-1, 3)[raster.sample] = (light[:, None] * tints).astype(np.uint8)
    return picture


def _polygons(skin: Skin, camera: Camera) -> np.ndarray:
    """The faces from behind to the front, filled, so that only those in front are seen."""
    picture, xy, depth = _empty(), camera.project(skin.vertices_m), camera.to_camera(skin.vertices_m)[:, 2]
    corners = np.rint(8 * xy).astype(np.int32)
    for face in skin.faces[np.argsort(-depth[skin.faces].mean(axis=1))]:
        cv2.fillPoly(picture, [corners[face]], GROUND, cv2.LINE_8, 3)
        cv2.polylines(picture, [corners[face]], True, EDGE, 1, cv2.LINE_AA, 3)
    return picture


def _shaded(skin: Mesh, camera: Camera) -> np.ndarray:
    light, covered = shade(camera, skin.vertices_m, skin.triangles)
    alpha = covered[..., None]
    return ((1 - alpha) * _empty() + alpha * light[..., None] * SKIN_COLOUR).clip(0, 255).astype(np.uint8)


def _textured(skin: Coloured, camera: Camera) -> np.ndarray:
    raster = rasterize(camera, skin.vertices_m, skin.triangles, factor=FACTOR)
    normal = raster.interpolate(vertex_normals(skin.vertices_m, skin.triangles), skin.triangles) @ camera.R_cam_world.T
    facing = np.clip(-normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12), 0, 1)
    samples = np.tile(np.array(GROUND, np.uint8), (*raster.shape, 1))
    samples.reshape(-1, 3)[raster.sample] = (DARKEST + (1 - DARKEST) * facing)[:, None] * skin.colours(raster)
    return np.asarray(cv2.resize(samples, camera.size_px, interpolation=cv2.INTER_AREA))
