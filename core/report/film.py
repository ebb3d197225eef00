"""film.mp4: the fitted body over every frame of every view, side by side.

It is made from the files of a run (skin/, joints.csv, body.toml), so that it can be made later, too. A joint is coloured by its reported
sigma, as in the report.
"""

import os
from pathlib import Path

import cv2
import numpy as np

from ..body.shape import read_body
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from ..geometry.raster import shade
from ..motion.formats.ply import read_ply
from ..motion.tables import JointTable, read_joints
from ..results.folder import Results
from ..take.footage import Footage
from .overview import sigma_colours
from .pictures import OPACITY, SKIN_COLOUR, colour

WIDTH_PX = 1920  # of the movie, at most
CODEC = "mp4v"
BAR_PX = 26  # height of the line of text


def write_film(footage: Footage, results: Results, monitor: Monitor) -> Path:
    """Write OUT/film.mp4, whole or not at all; about 0.1 s for a frame of a view.

    Raises:
        InputError: there is no fitted body, an image cannot be read, or movies cannot be written here.
        Cancelled: the user asked to stop; no film was written.
    """
    if not results.path("joints.csv").is_file() or not results.path("skin").is_dir():
        raise InputError(f"{results.folder} has no fitted body with a skin, and a film needs one; run the fit first.")
    joints, skeleton = read_joints(results.path("joints.csv")), read_body(results.path("body.toml")).skeleton
    bones = [(bone.head_joint, bone.tail_joint) for bone in skeleton.bones]
    cameras = _smaller(footage.rig.cameras)
    size = sum(c.size_px[0] for c in cameras), max(c.size_px[1] for c in cameras) + BAR_PX
    part = results.path("cache", "film.mp4")
    part.parent.mkdir(parents=True, exist_ok=True)
    part.unlink(missing_ok=True)  # OpenCV would write through a link, or over another name of a file
    movie = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*CODEC), footage.take.fps, (size[0] // 2 * 2, size[1] // 2 * 2))
    try:
        if not movie.isOpened():
            raise InputError(f"This OpenCV cannot write the movie {part}; check that the disk has room.")
        for t, frame in enumerate(joints.frames.tolist()):
            monitor.step("film", t, len(joints.frames))
            mesh = read_ply(results.path("skin", f"{frame:04d}.ply"))
            places = {name: (xyz[t], _sigma(joints, name)[t]) for name, xyz in joints.joints_m.items()}
            panels = [
                _panel(grey, camera, mesh.xyz_m, mesh.triangles, places, bones) for grey, camera in zip(footage.read_whole(frame), cameras)
            ]
            movie.write(_together(panels, size, f"frame {frame}   {joints.time_s[t]:.2f} s   views {', '.join(c.name for c in cameras)}"))
        movie.release()
        if cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT) != len(joints.frames):  # the writer does not report a full disk
            raise InputError(f"The movie {part} could not be written whole; check that the disk has room.")
    except BaseException:
        movie.release()
        part.unlink(missing_ok=True)
        raise
    os.replace(part, results.path("film.mp4"))
    return results.path("film.mp4")


def _smaller(cameras: tuple[Camera, ...]) -> list[Camera]:
    """The cameras of images that fit side by side into the movie."""
    factor = min(1.0, WIDTH_PX / sum(c.size_px[0] for c in cameras))
    return [c.resized((round(c.size_px[0] * factor), round(c.size_px[1] * factor))) for c in cameras]


def _sigma(joints: JointTable, name: str) -> np.ndarray:
    """The sigmas (T,) [m] of a joint, as in the report; files of earlier versions have only the whole ones."""
    own = joints.frame_sigma_m[name]
    return np.where(np.isfinite(own), own, joints.sigma_m[name])


def _panel(
    grey: np.ndarray,
    camera: Camera,
    vertices_m: np.ndarray,
    triangles: np.ndarray,
    joints: dict[str, tuple[np.ndarray, float]],
    bones: list[tuple[str, str]],
) -> np.ndarray:
    """The body over one view, in the size of the camera."""
    picture = colour(cv2.resize(grey.astype(np.float32), camera.size_px, interpolation=cv2.INTER_AREA)).astype(np.float32)
    light, covered = shade(camera, vertices_m, triangles, factor=1)
    alpha = (OPACITY * covered)[..., None]
    drawn = ((1 - alpha) * picture + alpha * light[..., None] * SKIN_COLOUR).clip(0, 255).astype(np.uint8)
    at = {name: camera.project(xyz[None])[0] for name, (xyz, _) in joints.items()}
    tint = {name: tuple(sigma_colours(np.array(1e3 * sigma)).tolist()) for name, (_, sigma) in joints.items()}
    spots = {name: tuple(np.rint(xy).astype(int).tolist()) for name, xy in at.items() if np.isfinite(xy).all() and np.abs(xy).max() < 3e4}
    for head, tail in bones:
        if head in spots and tail in spots:
            cv2.line(drawn, spots[head], spots[tail], (255, 255, 255), 1, cv2.LINE_AA)
    for name, spot in spots.items():
        cv2.circle(drawn, spot, 3, tint[name], -1, cv2.LINE_AA)
    return drawn


def _together(panels: list[np.ndarray], size: tuple[int, int], text: str) -> np.ndarray:
    """The views side by side above a line of text; width and height are even, as movies need."""
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    x = 0
    for panel in panels:
        picture[: panel.shape[0], x : x + panel.shape[1]] = panel
        x += panel.shape[1]
    plain = text.encode("ascii", "replace").decode()  # OpenCV's letters are ASCII
    cv2.putText(picture, plain, (8, size[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture[: size[1] // 2 * 2, : size[0] // 2 * 2]
