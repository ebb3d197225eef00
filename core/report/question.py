"""report/question.png: the pose in which a fit would start, and its likeliest rival, in all views of the frame in question."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from ..body.model_file import read_model
from ..fitting.inputs.start_joints import StartJoints
from ..geometry.camera import Camera
from .close_up import alike, close_up
from .drawing import plain, size_of, with_legend, with_title
from .pictures import colour

FOUND, RIVAL, ASKED = (60, 220, 255), (255, 90, 230), (255, 255, 255)  # BGR
FAR_PX = 1e5  # from the image, beyond which a line may end anywhere
LEFT = 0.55  # brightness of the person's left limbs, of the colour of the others


def question_picture(start: StartJoints, cameras: Sequence[Camera], names: Sequence[str], images: Sequence[np.ndarray]) -> np.ndarray:
    """The picture (h, w, 3) uint8, BGR, of grey images (h, w) of views with these names."""
    poses = [(start.rival_m, RIVAL), (start.xyz_m, FOUND)]
    everywhere = np.array([xyz for pose, _ in poses for xyz in pose.values()])
    bones = [(bone.head_joint, bone.tail_joint) for bone in read_model(start.model).skeleton.bones]
    panels = []
    for name, window, image in zip(names, alike([close_up(camera, [everywhere]) for camera in cameras]), images):
        detail = window.around(everywhere)
        picture = colour(detail.image(image))
        for pose, shade in poses:
            _draw(picture, detail.camera, pose, bones, shade)
            if start.ask in pose and (at := _pixel(detail.camera, pose[start.ask])) is not None:
                cv2.circle(picture, at, round(9 * size_of(picture)), ASKED, 2, cv2.LINE_AA)
        panels.append(with_title(picture, plain(name)))
    height = max(len(panel) for panel in panels)
    row = np.hstack([cv2.copyMakeBorder(panel, 0, height - len(panel), 0, 0, cv2.BORDER_CONSTANT) for panel in panels])
    meanings = [(FOUND, f"found in frame {start.frame} ({100 * start.probability:.0f} %); the left side is dark")]
    meanings += [(RIVAL, "the likeliest other pose")] if start.rival_m else []
    return with_legend(row, [*meanings, (ASKED, f"{start.ask}: click it")], size=size_of(panels[0]))


def _draw(
    picture: np.ndarray, camera: Camera, pose: Mapping[str, np.ndarray], bones: Sequence[tuple[str, str]], shade: tuple[int, int, int]
) -> None:
    """The bones of a pose, joints by name."""
    for ends in bones:
        if not all(name in pose for name in ends):
            continue
        dark = LEFT if any(name.endswith(".L") for name in ends) else 1.0
        a, b = (_pixel(camera, pose[name]) for name in ends)
        if a is not None and b is not None:
            cv2.line(picture, a, b, tuple(round(dark * value) for value in shade), max(2, round(2 * size_of(picture))), cv2.LINE_AA)


def _pixel(camera: Camera, xyz_m: np.ndarray) -> tuple[int, int] | None:
    """The pixel of a place; None behind the camera."""
    at = camera.project(xyz_m[None])[0]
    if not np.isfinite(at).all():
        return None
    x, y = np.clip(at, -FAR_PX, FAR_PX).round().astype(int).tolist()
    return x, y
