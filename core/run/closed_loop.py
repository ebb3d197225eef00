"""The loop of tracking and fitting, closed once (D'Apuzzo et al. 1999, §5; D'Apuzzo & Plänkers 2000, §3):

    fit → tracking guided by the body → outlines predicted by trajectories and body → fit to the points, trajectories and outlines

The body predicts where and when lost points reappear (`fitting/inputs/track_guide.py`). Those that are found again keep their identity, so
that the second fit has longer trajectories. An outline is predicted by the trajectories inside it and compared with that of the body in the
same frame (`outlines.py`). Outlines that the user tracked (contours/VIEW.csv) are used as they are.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from ..body.motion import BodyFit
from ..body.skeleton import Skeleton
from ..body.skin.extremities import shape_with_ends
from ..body.skin.posed import skins_in
from ..fitting.inputs.fit_input import Outlines
from ..fitting.inputs.take_inputs import read_contours
from ..fitting.settings import FitSettings
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from ..geometry.raster import rasterize
from ..report.loop_pictures import OUTLINES
from ..report.silhouettes import is_whole_body
from .outlines import Start, write_contour
from .take_run import Run

OFF, TRACKS = "off", "tracks"  # values of `fitting.closed_loop`, besides OUTLINES
FOR_WHOLE_BODIES = OFF  # what auto is for them: see docs/decisions.md
FOLDER = OUTLINES  # in OUT: the tables of the outlines, laid out as contours/


def loop_of(settings: FitSettings, skeleton: Skeleton) -> str:
    """What the loop uses: `OFF`, `TRACKS` or `OUTLINES`."""
    if settings.closed_loop != "auto":
        return settings.closed_loop
    return FOR_WHOLE_BODIES if is_whole_body(skeleton) else OFF


def predicted_outlines(run: Run, body: BodyFit, monitor: Monitor) -> Sequence[Outlines]:
    """Track the outline in every view without one from `tricap contour`, write outlines/VIEW.csv, and read all of them for the fit.

    Raises:
        InputError: an image cannot be read, or a table of contours is damaged.
        Cancelled: the user asked to stop.
    """
    views = [view.name for view in run.footage.take.views]
    own = read_contours(run.results, views)
    try:
        start = Start(outlines=_outlines_of(run, body))
    except InputError as no_skin:
        run.warn(f"No outlines were predicted: {no_skin}")
        return own
    others = [view for view in views if view not in {outlines.view for outlines in own}]
    for view in others:
        write_contour(run, view, monitor, start, FOLDER)
    return [*own, *read_contours(run.results, others, FOLDER)]


def _outlines_of(run: Run, body: BodyFit) -> Callable[[int, Camera], list[np.ndarray]]:
    """The outlines of the body as a function of frame and camera. Raises InputError for a body without a skin."""
    settings, motion = run.settings["skin"], body.motion
    skin_at = skins_in(shape_with_ends(body.shape, settings), motion.values, settings)
    row = {int(frame): i for i, frame in enumerate(motion.frames)}

    def outlines(frame: int, camera: Camera) -> list[np.ndarray]:
        if frame not in row:
            return []
        skin = skin_at(motion.values[row[frame]])
        raster = rasterize(camera, skin.vertices_m, skin.triangles, back_faces=True)
        mask = (raster.image(np.ones(len(raster.sample)), 0.0) > 0).astype(np.uint8)
        return [c[:, 0].astype(np.float64) for c in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]]

    return outlines
