"""film.mp4: the fitted body over every frame of every view, side by side, in the part of each view through which the person moves.

It is made from the files of a run (skin/, joints.csv, body.toml), so that it can be made later, too. A joint is coloured by its reported
sigma, as in the report.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ..body.shape import read_body
from ..body.sigma_colours import SIGMAS_MM, sigma_colours
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from ..geometry.raster import shade
from ..motion.formats.ply import read_ply
from ..motion.tables import JointTable, read_joints
from ..results.films import FILM, place
from ..results.folder import Results
from ..results.own_files import files_of
from ..take.footage import Footage
from .close_up import Detail, alike, close_up
from .drawing import plain, size_of, small_text, text_width
from .overview import about_joints
from .pictures import OPACITY, SKIN_COLOUR, colour

WIDTH_PX, HEIGHT_PX = 1920, 1080  # of the movie, at most
LARGEST = 2.0  # a pixel of the footage, in pixels of the movie
MOST_PLACES = 300  # of each joint, that show where the person is
CODEC = "mp4v"
BAR_PX = 36  # height of the line of text
LETTERS = 1.6  # largest size of those in it
LEGEND_PX, ROOM_PX = 90, 470  # of the colours in that line, and of all that is in it, by the size of letters


def write_film(footage: Footage, results: Results, monitor: Monitor) -> Path:
    """Write OUT/film.mp4, whole or not at all; about 0.1 s for a frame of a view.

    Raises:
        InputError: there is no fitted body, an image cannot be read, or movies cannot be written here.
        Cancelled: the user asked to stop; no film was written.
    """
    if not results.path("joints.csv").is_file() or not any(files_of(results.path("skin"), "skin")):
        raise InputError(f"{results.folder} has no fitted body with a skin, and a film needs one; run the fit first.")
    joints, skeleton = read_joints(results.path("joints.csv")), read_body(results.path("body.toml")).skeleton
    bones = [(bone.head_joint, bone.tail_joint) for bone in skeleton.bones]
    details = _details(footage.rig.cameras, joints)
    cameras = [detail.camera for detail in details]
    size = sum(c.size_px[0] for c in cameras), max(c.size_px[1] for c in cameras) + BAR_PX
    part = results.path("cache", FILM)
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
            images = [detail.image(grey) for detail, grey in zip(details, footage.read_whole(frame))]
            panels = [_panel(grey, camera, mesh.xyz_m, mesh.triangles, places, bones) for grey, camera in zip(images, cameras)]
            movie.write(_together(panels, size, f"frame {frame}   {joints.time_s[t]:.2f} s"))
        movie.release()
        if cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT) != len(joints.frames):  # the writer does not report a full disk
            raise InputError(f"The movie {part} could not be written whole; check that the disk has room.")
    except BaseException:
        movie.release()
        part.unlink(missing_ok=True)
        raise
    return place(part, results.folder, FILM)


def _details(cameras: Sequence[Camera], joints: JointTable) -> list[Detail]:
    """The part of each view in which the person is in any of the frames; as large as the movie has room for."""
    every = max(1, len(joints.frames) // MOST_PLACES)
    places = np.concatenate([xyz[::every] for xyz in joints.joints_m.values()])
    places = places[np.isfinite(places).all(axis=1)]
    near = [about_joints(camera, places) for camera in cameras]
    views = alike([close_up(camera, [points]) for camera, points in zip(cameras, near)])
    width, height = sum(view.part_px[0] for view in views), max(view.part_px[1] for view in views)
    factor = min(WIDTH_PX / width, HEIGHT_PX / height, LARGEST)
    return [replace(view, side_px=round(factor * max(view.part_px))).around(points) for view, points in zip(views, near)]


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
    """The body over one view (h, w)."""
    picture = colour(grey).astype(np.float32)
    light, covered = shade(camera, vertices_m, triangles, factor=1)
    alpha = (OPACITY * covered)[..., None]
    drawn = ((1 - alpha) * picture + alpha * light[..., None] * SKIN_COLOUR).clip(0, 255).astype(np.uint8)
    at = {name: camera.project(xyz[None])[0] for name, (xyz, _) in joints.items()}
    tint = {name: tuple(sigma_colours(np.array(1e3 * sigma))[::-1].tolist()) for name, (_, sigma) in joints.items()}
    spots = {name: tuple(np.rint(xy).astype(int).tolist()) for name, xy in at.items() if np.isfinite(xy).all() and np.abs(xy).max() < 3e4}
    for head, tail in bones:
        if head in spots and tail in spots:
            cv2.line(drawn, spots[head], spots[tail], (255, 255, 255), 1, cv2.LINE_AA)
    for name, spot in spots.items():
        cv2.circle(drawn, spot, 3, tint[name], -1, cv2.LINE_AA)
    k = size_of(drawn)
    small_text(drawn, f"view {plain(camera.name)}", (8, 8 + round(14 * k)), size=k)
    return drawn


def _together(panels: list[np.ndarray], size: tuple[int, int], text: str) -> np.ndarray:
    """The views side by side above a line of text and the colours of the joints; width and height are even, as movies need."""
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    x = 0
    for panel in panels:
        picture[: panel.shape[0], x : x + panel.shape[1]] = panel
        x += panel.shape[1]
    k = min(LETTERS, size[0] / ROOM_PX)
    base = size[1] - round(BAR_PX / 2 - 4.5 * k)
    small_text(picture, text, (8, base), size=k)
    _add_legend(picture, base, k)
    return picture[: size[1] // 2 * 2, : size[0] // 2 * 2]


def _add_legend(picture: np.ndarray, base: int, k: float) -> None:
    """The colours of the joints' sigmas, on a base line at the right."""
    ends = [f"{SIGMAS_MM[0]:g} mm", f"{SIGMAS_MM[-1]:g} mm"]
    right, gap, length = picture.shape[1] - 8, round(6 * k), round(LEGEND_PX * k)
    colours = sigma_colours(np.geomspace(SIGMAS_MM[0], SIGMAS_MM[-1], length))[:, ::-1]
    at = right - text_width(ends[1], k)
    small_text(picture, ends[1], (at, base), size=k)
    start = at - gap - length
    picture[base - round(9 * k) : base, start : start + length] = colours.astype(np.uint8)
    words = f"sigma of a joint: {ends[0]}"
    small_text(picture, words, (start - gap - text_width(words, k), base), size=k)
