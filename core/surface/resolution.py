"""How large the images are that are measured: a body's motion needs some points all over it, not every pixel of a large image.

    p = √(A / N) / s                                                                                                    (1)

A is the area of the body that a camera sees, N the points that a fit needs, s their spacing in pixels: where a pixel is p metres wide at
the person, there are N points. Images with smaller pixels are reduced before anything is matched: patches then cover as much of the body as
they do in the images of a smaller camera, and the cost no longer depends on the camera. Skin and plain cloth in compressed footage may have
texture of fine grain alone: where reduced images show next to nothing, they are measured as they are.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..body.model_file import read_model
from ..body.parts import bone_profiles, chain_neighbours
from ..body.shape import default_shape
from ..foundation.progress import Monitor
from ..results.folder import Results
from ..take.clicked_points import clicked_depth
from ..take.footage import Footage
from ..take.surface_clicks import surface_clicks
from .measure import NothingMeasured, measure_frames
from .starts import MIN_SEEDS, MeasureSettings, first_frame, person_depths

POINTS = 2000.0  # N
LEAST_FACTOR = 1.5  # a reduction by less is not worth the loss
LEAST_SHARE = 0.25  # of N, in the reduced images of a frame; with fewer points these lack the texture
LOOKED_PX = 640.0  # width of the images in which the person is looked for; wide enough for seeds
TALL_M = 1.75  # of a person who fills the image; where even then it is not large, nobody is looked for


@dataclass(frozen=True, kw_only=True, slots=True)
class PersonSeen:
    """How far the person is from the reference camera, and a frame that shows the person."""

    distance_m: float
    frame: int


def measured_footage(footage: Footage, settings: MeasureSettings, distance_m: float | None) -> Footage:
    """The footage as it is measured: with the clicks that the surface follows, and smaller where a person at this distance is to be
    fitted and the images are large.

    Raises:
        InputError: the model is unknown.
    """
    take = footage.take
    clicks = surface_clicks(take, automatic_seeds=settings.growing.seed_spacing_px > 0)
    measured = footage if clicks is take.clicks else replace(footage, take=replace(take, clicks=clicks))
    if distance_m is None or take.joints_model is None:
        return measured
    factor = _factor(footage, settings.growing.spacing_px, distance_m, take.joints_model)
    return measured.reduced(factor) if factor >= LEAST_FACTOR else measured


def _factor(footage: Footage, spacing_px: int, distance_m: float, model: str) -> float:
    """By how much smaller images show the N points of a body at a distance.  (1)"""
    focal_px = footage.rig.cameras[footage.take.reference].focal_px
    return float(np.sqrt(seen_area_m2(model) / POINTS) / spacing_px * focal_px / distance_m)


def person_seen(footage: Footage, settings: MeasureSettings, monitor: Monitor) -> PersonSeen | None:
    """Where the person is for whose motion the images may be reduced: where the clicks show it, or else the seeds of a few frames.

    None: nobody is seen, or the images stay as they are: interlaced ones, and all where the quality is "surface" or no body is wanted.

    Raises:
        InputError: the images cannot be read, or clicks contradict each other.
    """
    take, distances = footage.take, dict[int, float]()
    if settings.surface.quality != "motion" or take.joints_model is None or take.interlaced != "none":
        return None
    usual = measured_footage(footage, settings, None)
    first = first_frame(usual)
    if (clicked_m := clicked_distance_m(usual)) is not None:
        return PersonSeen(distance_m=clicked_m, frame=first)
    camera = footage.rig.cameras[take.reference]
    filled_m = camera.focal_px * TALL_M / camera.size_px[1]
    if not settings.growing.seed_spacing_px or _factor(footage, settings.growing.spacing_px, filled_m, take.joints_model) < LEAST_FACTOR:
        return None
    factor = max(camera.size_px[0] for camera in usual.rig.cameras) / LOOKED_PX
    small = usual.reduced(factor) if factor > 1 else usual
    frames = dict.fromkeys((first, footage.frames[len(footage.frames) // 2], footage.frames[-1]))
    for i, frame in enumerate(frames):
        depth = person_depths(small, settings, frame, monitor.part("seeds", i, len(frames)))
        if len(depth) >= MIN_SEEDS:
            distances[frame] = float(np.median(depth))
    if not distances:
        return None
    middle = sorted(distances, key=lambda frame: distances[frame])[len(distances) // 2]  # in an empty frame false seeds lie anywhere
    return PersonSeen(distance_m=distances[middle], frame=middle)


def clicked_distance_m(footage: Footage) -> float | None:
    """How far the clicked joints are from the reference camera; None without clicks.

    Raises:
        InputError: the clicks contradict each other.
    """
    depths = [clicked_depth(footage, name, at) for name, at in footage.take.clicks.joints.items()]
    return float(np.median(depths)) if depths else None


def shows_enough(reduced: Footage, settings: MeasureSettings, results: Results, first: int | None, monitor: Monitor) -> bool:
    """Whether reduced images show a body in the frame that is measured first (see `measure_frames`), which gets its checkpoint.

    Raises:
        InputError: the images cannot be read.
    """
    try:
        return len(next(measure_frames(reduced, settings, results, monitor, first)).cloud.xyz_m) >= LEAST_SHARE * POINTS
    except NothingMeasured:
        return False


def seen_area_m2(model: str) -> float:
    """A of a body model's person, from in front.  (1)

    Raises:
        InputError: the model is unknown or damaged.
    """
    shape = default_shape(read_model(model))
    profiles = bone_profiles(shape.skeleton, shape.lengths_m, shape.metaballs, chain_neighbours(shape))
    return float(sum(2 * shape.lengths_m[b] * profile.radii_m.mean() for b, profile in profiles.items()))
