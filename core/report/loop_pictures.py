"""What the closed loop of fit and tracking did, and the outlines that it predicted and corrected (D'Apuzzo & Plänkers 2000, Figs. 16, 17):
in every view the outline of one frame, carried there from the frame before by the trajectories inside it, and as the image's edges put it.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.robust import finite_median
from ..results.folder import Results
from ..take.footage import Footage
from ..tracking.contour import Contour, ContourTable, predict_contour
from ..tracking.trajectories import Trajectories
from . import pictures
from .close_up import Detail, close_up
from .drawing import with_legend

OUTLINES = "outlines"  # value of `fitting.closed_loop`, and the folder in OUT
PREDICTED, TRACKED = (250, 200, 60), (40, 40, 240)  # BGR
FINEST_PX = 1 / 8  # of a vertex in a picture


def loop_words(stages: Mapping[str, Any]) -> str:
    """That the loop was closed and what it gained, from the stages in run.json; "" where it was not."""
    fit, first = stages.get("fit", {}), stages.get("track", {})
    loop, again = fit.get("closed_loop", ""), fit.get("tracked_again", {})
    if not loop or "mean_length_frames" not in again or "mean_length_frames" not in first:
        return ""
    both = " and to the outlines that trajectories and body predict in every view" if loop == OUTLINES else ""
    lengths = [f"{one['trajectories']:,} trajectories of {one['mean_length_frames']:.1f} frames on average" for one in (first, again)]
    return (
        f"The loop of fit and tracking was closed once (fitting.closed_loop = {loop}): points were tracked again with the fitted body, "
        f"which predicts where lost points reappear, and the body was fitted again to these trajectories{both}. Before, there were "
        f"{lengths[0]}; after, {lengths[1]}."
    )


def outline_pictures(results: Results, footage: Footage, tracks: Trajectories | None, near: bool) -> dict[str, tuple[str, np.ndarray]]:
    """File name → (caption, picture) of each view with a table in OUT/outlines, in a frame near the middle; close-ups with `near`.

    Raises:
        InputError: a table is damaged, or an image cannot be read.
    """
    found = dict[str, tuple[str, np.ndarray]]()
    if tracks is None:
        return found
    for k, camera in enumerate(footage.rig.cameras):
        table = ContourTable(results.path(OUTLINES, f"{camera.name}.csv"))
        index = _shown(table, tracks)
        if index is None:
            continue
        before, frame = (int(tracks.frames[i]) for i in (index - 1, index))
        predicted = predict_contour(table[before].xy_px, *(camera.project(tracks.xyz_m[i]) for i in (index - 1, index)))
        there = tracks.xyz_m[index]
        there = there[np.isfinite(there).all(axis=1)]
        part = close_up(camera, [there] if near else []).around(there)
        grey = part.image(footage.read_whole(frame)[k])
        found[f"outlines_{frame:04d}_{camera.name}.png"] = (
            _caption(frame, before, camera, predicted, table[frame]),
            _picture(grey, part, there, predicted, table[frame], before),
        )
    return found


def _shown(table: ContourTable, tracks: Trajectories) -> int | None:
    """The index of the frame nearest to the middle that has an outline, as the one before it has."""
    there = np.isin(tracks.frames, list(table))
    both = 1 + np.flatnonzero(there[1:] & there[:-1])
    return int(both[np.abs(both - len(tracks.frames) // 2).argmin()]) if len(both) else None


def _caption(frame: int, before: int, camera: Camera, predicted: np.ndarray, tracked: Contour) -> str:
    from scipy.spatial import cKDTree

    apart = finite_median(cKDTree(predicted).query(tracked.xy_px)[0])
    return (
        f"Frame {frame}, view {camera.name}: the outline that the trajectories predict from that of frame {before} (blue), and the tracked "
        f"outline, which the fit used (red); {apart:.1f} px apart (median), {100 * float(tracked.on_edge.mean()):.0f} % of it on an edge"
    )


def _picture(grey: np.ndarray, part: Detail, xyz_m: np.ndarray, predicted: np.ndarray, tracked: Contour, before: int) -> np.ndarray:
    picture = pictures.colour(grey)
    for xy, tint in ((predicted, PREDICTED), (tracked.xy_px, TRACKED)):
        cv2.polylines(picture, [np.rint(part.pixels(xy) / FINEST_PX).astype(np.int32)], True, tint, 1, cv2.LINE_AA, 3)
    shown = pictures.with_scale(picture, part.camera, xyz_m)
    return with_legend(shown, [(PREDICTED, f"predicted from frame {before}"), (TRACKED, "tracked")])
