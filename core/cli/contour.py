"""`tricap contour`: the outline of the person in one view, tracked frame by frame with the trajectories."""

import argparse

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import nearest_name
from ..geometry.rig import read_rig
from ..images.picture import read_image
from ..results.outputs import check_replaceable
from ..run import pipeline, take_run
from ..run.outlines import MEASURED_SURFACE, Start, write_contour
from ..run.settings import settings_of
from ..surface.measure import NothingMeasured
from ..take.take import Take, read_take
from ..tracking.contour import HEAD
from ..tracking.point_tables import check_polygon, read_polygon
from .arguments import frame_range, overrides


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Track the contour, after measuring and tracking where needed; the lines to show.

    Raises:
        InputError: the arguments or the take have an error.
    """
    start = Start(
        polygon=read_polygon(args.polygon) if args.polygon else None,
        background=read_image(args.background) if args.background else None,
        body=args.from_body,
    )
    take = read_take(args.take)
    _check_views(take, args.view)
    if start.polygon is not None:
        spacing_px = settings_of(take.settings, overrides(args.set), str(args.take))["contour"].spacing_px
        check_polygon(start.polygon, read_rig(take.rig_path)[args.view[0]], spacing_px, args.polygon)
    given = args.take, args.out, overrides(args.set), frame_range(args.frames)
    with take_run.open_run(*given, for_contours=True, needs_body=start.body) as job:
        return [*write_contours(job, args.view, monitor, start), *job.notes]


def _check_views(take: Take, views: list[str]) -> None:
    """Check that a take has views of these names.

    Raises:
        InputError: it lacks one.
    """
    names = [v.name for v in take.views]
    for name in views:
        if name not in names:
            raise InputError(f"{take.folder} has no view “{name}”.{nearest_name(name, names)}")


def write_contours(job: take_run.Run, views: list[str], monitor: Monitor, start: Start = MEASURED_SURFACE) -> list[str]:
    """Track the contour in the views of these names, write contours/NAME.csv of each, and return a sentence for each.

    The take is measured and tracked first where that is needed. It is not needed with a background, which gives the outline in every frame.
    Where there is no surface (or fitting.use_surface is false), a contour that starts from a polygon is tracked in the images.

    A body from which the contours start must belong to the same frames and settings (`open_run` with `needs_body`). The contours make it
    stale, and the next fit replaces it.

    Raises:
        InputError: there is no such view, nothing to start from, or its file is not of an earlier call.
    """
    _check_views(job.footage.take, views)
    if len(views) > 1 and (start.polygon is not None or start.background is not None):
        raise InputError("A polygon or a background belongs to one view; give it with a single --view.")
    for name in views:
        check_replaceable(job.results.path("contours", f"{name}.csv"), HEAD)
    own_start = start.polygon is not None or start.background is not None or start.body
    if job.trajectories is None and start.background is None and (job.settings["fitting"].use_surface or not own_start):
        _track_if_possible(job, monitor, own_start)
    return [write_contour(job, name, monitor, start) for name in views]


def _track_if_possible(job: take_run.Run, monitor: Monitor, own_start: bool) -> None:
    """Measure and track; a take without a measurable surface is an error only if the contour starts from the surface."""
    try:
        pipeline.track(job, monitor)
    except NothingMeasured as error:
        if not own_start:
            raise
        job.warn(f"{error} The outline was tracked in the images.")
