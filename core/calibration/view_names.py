"""Cameras whose names are not those of the views: which camera is which, by the words in their names, else by their order; and the order
of the cameras from left to right."""

import re
from collections.abc import Callable, Sequence

import numpy as np

from ..foundation.errors import InputError
from ..geometry.rig import Rig
from ..take.footage_files import side_of_name

PARALLEL = 1e-4  # ratio of eigenvalues below which optical axes do not meet
NEAREST, FAR = 0.1, 1e3  # times the extent of the cameras: they meet no nearer, and far ahead is there
MOST_TURNED_DEG = 60.0  # of a camera from the mean direction of all: beyond, there is no left and right


def names_for_views(rig: Rig, views: Sequence[str]) -> dict[str, str]:
    """The view of each camera whose name has to change, by the camera's name; empty if every view has a camera of its name.

    Names that differ in upper and lower case only, words for the same side (left, L), and names with the same number or word besides those
    that all have (cam_2, 2 and cam02), belong together. Where that leaves any open, as many cameras as views are taken in their order.

    Raises:
        InputError: there are fewer cameras than views, or more and their names do not show which are meant.
    """
    names = [camera.name for camera in rig.cameras]
    if set(views) <= set(names):
        return {}
    for keys in (_each(str.casefold), _each(lambda name: side_of_name(name) or name.casefold()), _differing_parts):
        known, wanted = dict(zip(keys(names), names)), keys(views)
        if len(known) == len(names) and len(set(wanted)) == len(views) and set(wanted) <= set(known):
            return {known[key]: view for key, view in zip(wanted, views) if known[key] != view}
    if len(names) != len(views):
        raise InputError(
            f"The calibration has {len(names)} cameras ({', '.join(names)}), the project {len(views)} views ({', '.join(views)}), and the "
            "names do not show which belong together. Give the views the names of their cameras (step 1)."
        )
    return {name: view for name, view in zip(names, views) if name != view}


def from_left_to_right(rig: Rig) -> list[str]:
    """The names of the cameras from left to right around what they look at; as listed where they look in too different directions."""
    turned = np.array([camera.R_cam_world for camera in rig.cameras])  # rows: the axes x (right), y (down), z (forward) in the world
    right, _, forward = turned.mean(axis=0)
    length = float(np.linalg.norm(forward))
    names = [camera.name for camera in rig.cameras]
    if length == 0 or (turned[:, 2] @ forward).min() < np.cos(np.radians(MOST_TURNED_DEG)) * length:
        return names
    centres_m = np.array([camera.centre_m for camera in rig.cameras])
    away_m = _looked_at(centres_m, turned[:, 2], forward / length) - centres_m
    aside = -(away_m @ right) / (away_m @ forward)
    return [names[i] for i in np.argsort(aside, kind="stable")]


def _looked_at(centres_m: np.ndarray, directions: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to all optical axes, by least squares; far ahead where the axes are parallel, or meet behind a camera."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # (N, 3, 3) removes what is along the axis
    point_m = np.linalg.lstsq(across.sum(axis=0), (across @ centres_m[..., None]).sum(axis=0)[:, 0], rcond=PARALLEL)[0]
    ahead_m, spread_m = (point_m - centres_m) @ forward, float(np.ptp(centres_m, axis=0).max())
    return point_m if ahead_m.min() > spread_m * NEAREST else centres_m.mean(axis=0) + FAR * max(spread_m, 1.0) * forward


def _each(key: Callable[[str], str]) -> Callable[[Sequence[str]], list[str]]:
    return lambda names: [key(name) for name in names]


def _differing_parts(names: Sequence[str]) -> list[str]:
    """The words and numbers of each name that not all of them have; the names themselves where that leaves nothing."""
    parts = [[str(int(part)) if part.isdecimal() else part for part in re.findall(r"\d+|[^\W\d_]+", name.casefold())] for name in names]
    common = set(parts[0]).intersection(*parts[1:]) if len(parts) > 1 else set()
    short = [" ".join(part for part in each if part not in common) for each in parts]
    return short if all(short) else list(names)
