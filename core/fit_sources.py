"""Where the fit's input comes from: the take's clicks and limits, the run's clouds and trajectories, contours/*.csv in OUT, keypoints."""

import csv
import io
from collections.abc import Sequence
from math import radians

import numpy as np

from .errors import InputError
from .fitting.fit_input import ClickedAt, FitInput, ViewContours
from .results import Results
from .surface.cloud import PointCloud
from .take import Footage, Seeds
from .tracking.trajectories import Trajectories

COLUMNS = ("frame", "x", "y", "normal_x", "normal_y", "sigma", "on_edge")


def fit_input(footage: Footage, clouds: Sequence[PointCloud], trajectories: Trajectories | None, results: Results) -> FitInput:
    """All that the fit can use of a run.

    Raises:
        InputError: a table of contours or keypoints cannot be read, or the clicks are in frames that were not measured.
    """
    take = footage.take
    return FitInput(
        rig=footage.rig,
        model=str(take.body_model),
        clouds=clouds,  # type: ignore[arg-type]
        time_s=np.array([c.frame for c in clouds]) / take.fps,
        clicks={s.frame: _clicked(s) for s in (*take.keyframes, take.seeds) if s.joints},
        click_frame=take.seeds.frame,
        trajectories=trajectories,  # type: ignore[arg-type]
        contours=read_contours(results, [v.name for v in take.views]),
        locked=take.locked,
        limits={name: (radians(low), radians(high)) for name, (low, high) in take.limits.items()},
    )


def read_contours(results: Results, views: Sequence[str]) -> list[ViewContours]:
    """The outlines that `tricap contour` wrote, the vertices on an edge only.

    Raises:
        InputError: a table cannot be read.
    """
    found = []
    for view in views:
        path = results.path("contours", f"{view}.csv")
        if not path.exists():
            continue
        try:
            rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
            table = np.array([[float(row[name]) for name in COLUMNS] for row in rows]).reshape(-1, len(COLUMNS))
        except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
            raise InputError(f"{path} is no table of contours ({error}); run `tricap contour` for view {view} again.") from error
        table = table[(table[:, 6] > 0) & np.isfinite(table).all(axis=1)]
        found.append(ViewContours(view=view, frame=table[:, 0], xy_px=table[:, 1:3], normal=table[:, 3:5], sigma_px=table[:, 5]))
    return found


def _clicked(seeds: Seeds) -> ClickedAt:
    return {name: {view: xy.tolist() for view, xy in at.items()} for name, at in seeds.joints.items()}
