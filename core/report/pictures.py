"""Pictures of a run: the fitted body over the footage, trajectories over the footage, the cloud from the reference camera and its side."""

import cv2
import numpy as np

from ..body.shape import BodyShape
from ..body.skeleton import joint_positions
from ..geometry.camera import Camera
from ..geometry.raster import shade
from ..geometry.robust import finite_median
from ..surface.cloud import PointCloud
from ..tracking.trajectories import Trajectories
from .drawing import FRONT, GROUND, OF_PANELS, SIDE, value_colours, with_strip, with_title
from .person import Mesh
from .silhouettes import outlines_of

SKIN_COLOUR = np.array([120.0, 190.0, 255.0])  # BGR
BONE_COLOUR, JOINT_COLOUR = (60, 60, 230), (40, 220, 255)
BODY_OUTLINE, PERSON_OUTLINE = (60, 220, 60), (40, 40, 240)
OPACITY = 0.55
PANEL_PX = 480  # height of a cloud's picture, and width of each of its two panels …
NARROW_PX = 300  # … or this, for somebody who stands
LIGHT = np.array([-0.45, -0.55, -0.70])  # towards the light of a cloud from the front: upper left
SIDE_LIGHT = np.array([0.82, -0.40, -0.40])  # from the side: from where the cameras are, at the right
TAIL_FRAMES = 10
SLOW_M_S = 0.2  # the speed of red points is at least this


def body_over_footage(
    grey: np.ndarray, camera: Camera, shape: BodyShape, values: np.ndarray, skin: Mesh, person_px: np.ndarray | None = None
) -> np.ndarray:
    """The `skin` of one pose, shaded, with its bones and outline, over one view (h, w, 3) uint8. `values` (D,) are the pose's DOFs.

    `person_px` (V, 2): the outline of the person in the footage, drawn as well.
    """
    picture = colour(grey).astype(np.float32)
    light, covered = shade(camera, skin.vertices_m, skin.triangles)
    alpha = (OPACITY * covered)[..., None]
    picture = (1 - alpha) * picture + alpha * light[..., None] * SKIN_COLOUR
    drawn = _draw_bones(picture.clip(0, 255).astype(np.uint8), camera, shape, values)
    cv2.polylines(drawn, outlines_of(covered > 0.5), True, BODY_OUTLINE, 1, cv2.LINE_AA)
    if person_px is not None:
        cv2.polylines(drawn, [np.rint(person_px * 8).astype(np.int32)], True, PERSON_OUTLINE, 1, cv2.LINE_AA, 3)
    return drawn


def _draw_bones(picture: np.ndarray, camera: Camera, shape: BodyShape, values: np.ndarray) -> np.ndarray:
    joints = joint_positions(shape.skeleton, shape.lengths_m, values)
    pixel = {name: camera.project(xyz) for name, xyz in joints.items()}
    for bone in shape.skeleton.bones:
        ends = np.array([pixel[bone.head_joint], pixel[bone.tail_joint]])
        if np.isfinite(ends).all():
            cv2.line(picture, _point(ends[0]), _point(ends[1]), BONE_COLOUR, 2, cv2.LINE_AA)
    for xy in pixel.values():
        if np.isfinite(xy).all():
            cv2.circle(picture, _point(xy), 4, JOINT_COLOUR, -1, cv2.LINE_AA)
    return picture


def high_speed(trajectories: Trajectories, index: int) -> float:
    """The speed [m/s] that nearly no point of a frame exceeds; NaN if none is visible."""
    speed = np.nan_to_num(np.linalg.norm(trajectories.velocity_m_s[index, trajectories.visible[index]], axis=1))
    return max(SLOW_M_S, float(np.percentile(speed, 98))) if len(speed) else float("nan")


def tracks_over_footage(grey: np.ndarray, camera: Camera, trajectories: Trajectories, index: int, high: float) -> np.ndarray:
    """The points visible in one frame with their paths up to it, coloured by speed (blue 0, red `high` [m/s]), over one view."""
    picture = colour(grey)
    first = max(0, index - TAIL_FRAMES)
    visible = trajectories.visible[index]
    paths = camera.project(trajectories.xyz_m[first : index + 1, visible])
    speed = np.nan_to_num(np.linalg.norm(trajectories.velocity_m_s[index, visible], axis=1))
    for xy, c in zip(paths.transpose(1, 0, 2), value_colours(speed, 0.0, high).tolist()):
        xy = xy[np.isfinite(xy).all(axis=1)]
        cv2.polylines(picture, [np.rint(xy * 8).astype(np.int32)], False, c, 1, cv2.LINE_AA, 3)
        cv2.circle(picture, _point(xy[-1]), 2, c, -1, cv2.LINE_AA)
    return picture


def cloud_views(cloud: PointCloud, camera: Camera, spacing_px: int) -> np.ndarray:
    """The cloud as a shaded body from the reference camera and from its right side, in one picture."""
    p = camera.to_camera(cloud.xyz_m)
    n = cloud.normals @ camera.R_cam_world.T
    if not len(p):
        return np.full((PANEL_PX, 2 * PANEL_PX, 3), GROUND, np.uint8)
    centre = np.median(p, axis=0)
    extent = np.percentile(np.abs(p - centre), 99, axis=0).max()
    scale = 0.46 * PANEL_PX / max(float(extent), 1e-3)
    radius = max(1, round(0.9 * spacing_px * float(centre[2]) / camera.focal_px * scale))
    front = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    side = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    lit = ((front, LIGHT), (side, SIDE_LIGHT))
    across = float(np.percentile(np.abs(p - centre)[:, [0, 2]], 99)) * scale
    width = NARROW_PX if across < 0.46 * NARROW_PX else PANEL_PX
    pair = [_points_picture((p - centre) @ R.T, n @ R.T, scale, radius, light, width) for R, light in lit]
    shown = []
    for picture, words, names in zip(pair, (FRONT, SIDE), (("x", "y"), ("z", "y"))):
        shown.append(with_title(with_strip(picture, scale, names, left=names[0] == "z", size=OF_PANELS), words, OF_PANELS))
    return np.hstack(shown)


def _points_picture(p: np.ndarray, n: np.ndarray, scale: float, radius: int, light: np.ndarray, width: int) -> np.ndarray:
    """Points as discs, far ones first, lit along a unit vector (3,)."""
    picture = np.full((PANEL_PX, width, 3), GROUND, np.uint8)
    grey = 60 + 195 * np.clip(n @ light, 0, 1)
    for i in np.argsort(-p[:, 2]):
        at = (round(width / 2 + p[i, 0] * scale), round(PANEL_PX / 2 + p[i, 1] * scale))
        cv2.circle(picture, at, radius, (grey[i] * 0.85, grey[i] * 0.95, float(grey[i])), -1)
    return picture


def points_over_footage(grey: np.ndarray, xy_px: np.ndarray, values: np.ndarray, high: float, radius: int = 1) -> np.ndarray:
    """Matched points over one view, coloured by a value from blue (0) to red (high)."""
    picture = colour(grey)
    for xy, c in zip(xy_px, value_colours(values, 0.0, high).tolist()):
        cv2.circle(picture, _point(xy), radius, c, -1, cv2.LINE_AA)
    return picture


def colour(grey: np.ndarray) -> np.ndarray:
    """A grey image (h, w) as BGR uint8."""
    return cv2.cvtColor(np.clip(grey, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def with_scale(picture: np.ndarray, camera: Camera, xyz_m: np.ndarray, bar: tuple[float, str] | None = None) -> np.ndarray:
    """A picture over footage above the scale at the median depth of points (N, 3), the camera's axes, and a bar of colours: its upper
    end and words (none where that is not finite)."""
    depth = camera.to_camera(xyz_m)[:, 2] if len(xyz_m) else np.zeros(0)
    near = finite_median(np.where(depth > 0, depth, np.nan))
    shown = bar if bar is not None and np.isfinite(bar[0]) else None
    return with_strip(picture, camera.focal_px / near if np.isfinite(near) else float("nan"), note="at the person", bar=shown)


def png(picture: np.ndarray) -> bytes:
    """A picture as PNG."""
    return bytes(cv2.imencode(".png", picture)[1])


def jpeg(picture: np.ndarray) -> bytes:
    """A picture as JPEG, for pages that carry many."""
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1])


def _point(xy: np.ndarray) -> tuple[int, int]:
    return round(float(np.clip(xy[0], -30_000, 30_000))), round(float(np.clip(xy[1], -30_000, 30_000)))
