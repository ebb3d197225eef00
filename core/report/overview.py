"""The first screen of a report: a verdict in a sentence, the body over the footage coloured by its sigmas, and doubtful frames."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from ..body.limb_words import FEW_FRAMES, limb_words
from ..body.motion import BRIDGED, GUESSED, SEEN, SUSPECT, BodyFit
from ..body.skin.mesh import Skin
from ..geometry.camera import Camera
from ..geometry.raster import rasterize, vertex_normals
from . import pictures

PREDICTED = {
    BRIDGED: "the whole pose is predicted",
    SUSPECT: "residuals are large or observations few",
}
SIGMAS_MM = np.array([1.0, 7.0, 50.0])  # of joints; their colours are
COLOURS = np.array([[200, 130, 40], [60, 205, 250], [50, 50, 230]], dtype=np.float64)  # BGR: blue, yellow, red
LEGEND = "Colour: sigma of the joints in this frame, without what is common to all; blue 1 mm or less, yellow 7 mm, red 50 mm or more."
CELL_PX = 300  # height of a picture of the strip
MARGIN = 1.3  # of a picture about the body
OPACITY = 0.6
SURROUND = 40  # grey value around an image that is smaller than its cell


def verdict(record: Mapping[str, Any], body: BodyFit | None, doubtful: int) -> str:
    """One sentence or two on what came out, and whether it is to be trusted. `doubtful`: the number of doubtful frames."""
    stages = record["stages"]
    if body is None:
        return " ".join([_of_surface(stages), f"No body was fitted: {stages.get('fit', {}).get('not_done', 'it was not asked for')}."])
    motion = body.motion
    sigma, own = (1e3 * np.median(s, axis=0) for s in (motion.joint_sigma_m, motion.joint_frame_sigma_m))
    worst, frames = int(sigma.argmax()), len(motion.frames)
    limbs = limb_words(motion.joint_names, motion.known)
    predicted = {words: motion.status.count(status) for status, words in PREDICTED.items() if status in motion.status}
    if unseen := sum(any(word != SEEN for word in row) for row in zip(*limbs.values())):
        predicted["a limb is inferred or guessed"] = unseen
    less = "; ".join(f"in {n if n < frames else 'all'} of them {words}" for words, n in predicted.items())
    text = (
        f"The body was fitted in {frames} frames{f'; {less}' if less else ''}. "
        f"Reported sigma of its joints: {np.median(sigma):.1f} mm (median; {np.median(own):.1f} mm without what is common to all frames), "
        f"largest at {motion.joint_names[worst]} with {sigma[worst]:.0f} mm."
    )
    guessed = {limb: row.count(GUESSED) for limb, row in limbs.items() if row.count(GUESSED) > FEW_FRAMES}
    if guessed:
        named = " and the ".join(f"{limb} in {count}" for limb, count in guessed.items())
        text = f"{text} The {named} frames {'are' if len(guessed) > 1 else 'is'} guessed."
    contradicted = len({frame for frames in body.contradicted.values() for frame in frames})
    if contradicted:
        return f"{text} The images contradict it in {contradicted} frames: do not use these before you have looked at them."
    if not body.converged:
        return f"{text} The adjustment has not converged: the figures are preliminary."
    return f"{text} {f'{doubtful} frames are doubtful; the worst are shown here.' if doubtful else 'No frame stands out as doubtful.'}"


def _of_surface(stages: Mapping[str, Any]) -> str:
    measured, tracked = stages.get("measure", {}), stages.get("track", {})
    if "points_per_frame" not in measured:
        return f"No surface was measured: {measured.get('not_done', 'it was not asked for')}."
    text = f"The surface was measured in {measured['frames']} frames, with {measured['points_per_frame']:,.0f} points a frame (sigma "
    points = f"{text}{measured['sigma_mm']:.2f} mm, median)"
    return f"{points} and {tracked['trajectories']:,} trajectories." if "trajectories" in tracked else f"{points}."


def sigma_colours(sigma_mm: np.ndarray) -> np.ndarray:
    """Colours (…, 3) BGR of sigmas (…) of joints."""
    at = np.log(np.clip(np.nan_to_num(sigma_mm, nan=np.inf), SIGMAS_MM[0], SIGMAS_MM[-1]))
    return np.stack([np.interp(at, np.log(SIGMAS_MM), COLOURS[:, c]) for c in range(3)], axis=-1)


def bone_sigma_mm(body: BodyFit, index: int) -> np.ndarray:
    """The larger sigma (B,) of the two joints at a bone's ends, in one frame, without what is common to all frames."""
    names, sigma = body.motion.joint_names, 1e3 * body.motion.joint_frame_sigma_m[index]
    ends = [[names.index(joint) for joint in (bone.head_joint, bone.tail_joint)] for bone in body.shape.skeleton.bones]
    return np.asarray(sigma[np.array(ends)].max(axis=1))


def window_px(camera: Camera, joints_m: np.ndarray) -> float:
    """Side [px] of a square about the joints (J, 3) in one view, no larger than the image."""
    return min(MARGIN * float(np.nanmax(np.ptp(camera.project(joints_m), axis=0), initial=1.0)), *camera.size_px)


def body_by_sigma(grey: np.ndarray, camera: Camera, skin: Skin, sigma_mm: np.ndarray, centre_px: np.ndarray, side_px: float) -> np.ndarray:
    """The skin over a square of one view, `side_px` wide about `centre_px`, coloured by the sigmas (B,) of its bones: uint8 (h, h, 3)."""
    scale = CELL_PX / side_px
    small = camera.resized((max(1, round(camera.size_px[0] * scale)), max(1, round(camera.size_px[1] * scale))))
    image = pictures.colour(cv2.resize(grey.astype(np.float32), small.size_px, interpolation=cv2.INTER_AREA)).astype(np.float64)
    raster = rasterize(small, skin.vertices_m, skin.triangles)
    normal = raster.interpolate(vertex_normals(skin.vertices_m, skin.triangles), skin.triangles) @ small.R_cam_world.T
    light = 0.45 + 0.55 * np.clip(-normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12), 0, 1)
    tint = raster.interpolate(sigma_colours(skin.weights @ sigma_mm), skin.triangles)
    flat = image.reshape(-1, 3)
    flat[raster.sample] = (1 - OPACITY) * flat[raster.sample] + OPACITY * light[:, None] * tint
    corner = np.rint((centre_px + 0.5) * scale - 0.5 - CELL_PX / 2).astype(int)
    x, y = np.clip(corner, 0, np.maximum(0, np.array(small.size_px) - CELL_PX))  # within the image, where that is large enough
    part = image[y : y + CELL_PX, x : x + CELL_PX].clip(0, 255).astype(np.uint8)
    down, right = CELL_PX - part.shape[0], CELL_PX - part.shape[1]
    around = ((down // 2, down - down // 2), (right // 2, right - right // 2), (0, 0))
    return np.pad(part, around, constant_values=SURROUND)


def strip_frames(count: int, doubtful: Sequence[int], most: int = 6) -> list[int]:
    """Indices of up to `most` frames, evenly over a recording of `count` frames, and those of up to three doubtful frames."""
    even = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()
    return sorted({*even, *doubtful[:3]})
