"""How large the images are that are measured: a body's motion needs some points all over it, not every pixel of a large image.

    p = √(A / N) / s                                                                                                    (1)

A is the area of the body that a camera sees, N the points that a fit needs, s their spacing in pixels: where a pixel is p metres wide at
the person, there are N points. Images with smaller pixels are reduced before anything is matched: patches then cover as much of the body as
they do in the images of a smaller camera, and the cost no longer depends on the camera. Skin and plain cloth in compressed footage may have
texture of fine grain alone: where reduced images show next to nothing, they are measured as they are.
"""

import numpy as np

from ..body.model_file import read_model
from ..body.parts import bone_profiles, chain_neighbours
from ..body.shape import default_shape
from ..foundation.progress import Monitor
from ..results.folder import Results
from ..take.clicked_points import clicked_depth
from ..take.footage import Footage
from .measure import NothingMeasured, measure_frames
from .starts import MeasureSettings

POINTS = 2000.0  # N
LEAST_FACTOR = 1.5  # a reduction by less is not worth the loss
LEAST_SHARE = 0.25  # of N, in the reduced images of a frame; with fewer points these lack the texture


def measured_footage(footage: Footage, quality: str, spacing_px: int) -> Footage:
    """The footage as it is measured with a quality (`SurfaceSettings`): smaller where a body is to be fitted and the images are large.

    The clicks tell how far away the person is; without clicks, and with interlaced video, the images stay as they are.

    Raises:
        InputError: the clicks contradict each other, or the model is unknown.
    """
    take = footage.take
    if quality != "motion" or take.joints_model is None or not take.clicks.joints or take.interlaced != "none":
        return footage
    depth = float(np.median([clicked_depth(footage, name, at) for name, at in take.clicks.joints.items()]))
    factor = np.sqrt(seen_area_m2(take.joints_model) / POINTS) / spacing_px * footage.rig.cameras[take.reference].focal_px / depth  # (1)
    return footage.reduced(float(factor)) if factor >= LEAST_FACTOR else footage


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
