"""The first screen of a report: a verdict in plain words, and the body over the footage coloured by the sigmas of its joints."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..body.limb_words import FEW_FRAMES, MOST_SPANS, SIDES, frame_list, guessed_frames, limb_words
from ..body.motion import BRIDGED, GUESSED, SEEN, SUSPECT, BodyFit
from ..body.sigma_colours import sigma_colours
from ..geometry.camera import Camera
from ..geometry.raster import rasterize, vertex_normals
from . import pictures
from .person import Mesh

NOT_WANTED = 'model = "none" under [body]'  # why there is no body, if the take says so
PREDICTED = {
    BRIDGED: "the whole pose is predicted",
    SUSPECT: "residuals are large or observations few",
}
WHY = {  # the reasons of run.json's doubtful frames, in a sentence
    "few points": "few points were measured",
    "points uncertain": "the measured points are uncertain",
    "large residuals": "the rays of matched points miss each other",
    "few tracks": "few points were tracked",
    "tracks uncertain": "the tracked points are uncertain",
    "body off the points": "the body lies off the measured points",
    "joints uncertain": "the joints are uncertain",
    "fit bridged": "nothing was measured of the body: its pose is predicted",
    "fit suspect": "residuals are large or observations few",
    "fit partial": "some limbs have too few points",
}
FLESH_M = 0.12  # from a joint
OPACITY = 0.6


def headline(record: Mapping[str, Any], body: BodyFit | None, doubtful: int) -> str:
    """Whether the result can be used, in a sentence. `doubtful`: the number of doubtful frames."""
    if body is None:
        why = record["stages"].get("fit", {}).get("not_done", NOT_WANTED)
        return "Surface and trajectories, as the take asks for no body." if why == NOT_WANTED else f"No body was fitted: {why}."
    contradicted = sorted({frame for frames in body.contradicted.values() for frame in frames})
    if contradicted:
        return f"The images contradict the body in {_frames(len(contradicted))}: look at these before you use them."
    if not body.converged:
        return "The adjustment has not converged: all figures are preliminary."
    frames, limbs = body.motion.frames.tolist(), limb_words(body.motion.joint_names, body.motion.known)
    guessed = [limb for limb, row in limbs.items() if row.count(GUESSED) > FEW_FRAMES]
    if guessed:
        which = "; ".join(f"the {limb} in frames {frame_list(guessed_frames(frames, limbs[limb]), MOST_SPANS)}" for limb in guessed)
        return f"Usable, but some of it is guessed: {which}."
    if doubtful:
        return f"Usable, but look at {_frames(doubtful)}: the worst {'is' if doubtful == 1 else 'are'} below, with the reason."
    return "No frame stands out as doubtful."


def verdict(record: Mapping[str, Any], body: BodyFit | None) -> str:
    """What came out, and how well it is known, in a few sentences."""
    if body is None:
        return _of_surface(record["stages"])
    motion = body.motion
    sigma, own = (1e3 * np.median(s, axis=0) for s in (motion.joint_sigma_m, motion.joint_frame_sigma_m))
    worst, frames = int(sigma.argmax()), len(motion.frames)
    limbs = limb_words(motion.joint_names, motion.known)
    predicted = {words: motion.status.count(status) for status, words in PREDICTED.items() if status in motion.status}
    if unseen := sum(any(word != SEEN for word in row) for row in zip(*limbs.values())):
        predicted["the images do not show a limb well, and its place is inferred or guessed"] = unseen
    less = "".join(f" In {'all' if n == frames else n} of them {words}." for words, n in predicted.items())
    return (
        f"The body was fitted in {_frames(frames)}.{less} Its joints are known to {np.median(sigma):.1f} mm (one sigma, median). Most of "
        f"that is the same in all frames: their motion is known to {np.median(own):.1f} mm. Least certain is the "
        f"{joint_words(motion.joint_names[worst])}, with {sigma[worst]:.0f} mm."
    )


def joint_words(joint: str) -> str:
    """A joint as people call it: "wrist.R" -> "right wrist"."""
    name, _, side = joint.partition(".")
    return f"{SIDES[side]} {name}" if side in SIDES else {"crown": "top of the head"}.get(name, name)


def _frames(count: int) -> str:
    return f"{count} frame" if count == 1 else f"{count} frames"


def _of_surface(stages: Mapping[str, Any]) -> str:
    measured, tracked = stages.get("measure", {}), stages.get("track", {})
    if "points_per_frame" not in measured:
        return f"No surface was measured: {measured.get('not_done', 'it was not asked for')}."
    text = f"The surface was measured in {_frames(measured['frames'])}, with {measured['points_per_frame']:,.0f} points a frame (sigma "
    points = f"{text}{measured['sigma_mm']:.2f} mm, median)"
    return f"{points} and {tracked['trajectories']:,} trajectories." if "trajectories" in tracked else f"{points}."


def bone_sigma_mm(body: BodyFit, index: int) -> np.ndarray:
    """The larger sigma (B,) of the two joints at a bone's ends, in one frame, without what is common to all frames."""
    names, sigma = body.motion.joint_names, 1e3 * body.motion.joint_frame_sigma_m[index]
    ends = [[names.index(joint) for joint in (bone.head_joint, bone.tail_joint)] for bone in body.shape.skeleton.bones]
    return np.asarray(sigma[np.array(ends)].max(axis=1))


def body_by_sigma(grey: np.ndarray, camera: Camera, skin: Mesh, sigma_mm: np.ndarray) -> np.ndarray:
    """The skin over one view, coloured by the sigmas (B,) of its bones: uint8 (h, w, 3)."""
    image = pictures.colour(grey).astype(np.float64)
    raster = rasterize(camera, skin.vertices_m, skin.triangles)
    normal = raster.interpolate(vertex_normals(skin.vertices_m, skin.triangles), skin.triangles) @ camera.R_cam_world.T
    light = 0.45 + 0.55 * np.clip(-normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12), 0, 1)
    tint = raster.interpolate(sigma_colours(skin.weights @ sigma_mm)[:, ::-1], skin.triangles)
    flat = image.reshape(-1, 3)
    flat[raster.sample] = (1 - OPACITY) * flat[raster.sample] + OPACITY * light[:, None] * tint
    return image.clip(0, 255).astype(np.uint8)


def about_joints(camera: Camera, joints_m: np.ndarray) -> np.ndarray:
    """Points (4 J, 3) about joints (J, 3), as far across the view as flesh may reach."""
    steps = FLESH_M * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]) @ camera.R_cam_world
    return np.asarray((joints_m[:, None] + steps).reshape(-1, 3))
