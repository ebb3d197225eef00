"""Clicked joints: their observations, their places in space, and whether the views agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...foundation.errors import InputError
from ...geometry.camera import Camera
from ...geometry.rig import Rig
from ..observations import ClickedJoints, Observation
from .fit_input import ClickedAt

CONTRADICTION = 6.0  # sigmas between a click and the projection of the joint that the views agree on
STEPS = 10


@dataclass(frozen=True, eq=False, kw_only=True)
class Clicks:
    """The observations of the joints where the fit begins, and their places in space."""

    observations: tuple[Observation, ...]
    xyz_m: np.ndarray  # (J, 3) NaN: not in two views

    @property
    def located(self) -> np.ndarray:
        """Which joints (J,) are located in space."""
        return np.isfinite(self.xyz_m).all(axis=1)


def read_clicks(rig: Rig, joint_names: Sequence[str], joints: ClickedAt, sigma_px: float) -> tuple[ClickedJoints, np.ndarray]:
    """Clicks of the model's joints in one frame, and the joints' places (J, 3) by forward intersection, NaN without two views.

    `joints[name][view] = (x, y)` in full-frame pixels. Joints that the model does not have are ignored.

    Raises:
        InputError: the views contradict each other, or the rig has no such view.
    """
    cameras: list[Camera] = []
    index: list[int] = []
    xy: list[np.ndarray] = []
    places = np.full((len(joint_names), 3), np.nan)
    for j, name in enumerate(joint_names):
        views = {view: np.asarray(p, dtype=np.float64) for view, p in joints.get(name, {}).items() if np.isfinite(p).all()}
        seen = [rig[view] for view in views]
        if len(seen) >= 2:
            places[j] = intersection(seen, np.array(list(views.values())))
            _check_agreement(name, seen, np.array(list(views.values())), places[j], sigma_px)
        cameras += seen
        index += [j] * len(seen)
        xy += list(views.values())
    found = ClickedJoints(
        cameras=tuple(cameras), joint=np.array(index, dtype=np.intp), xy_px=np.array(xy).reshape(-1, 2), sigma_px=sigma_px
    )
    return found, places


def initial_clicks(xyz_m: np.ndarray, joint_names: Sequence[str], observations: Sequence[Observation]) -> Clicks:
    """The joints of the frame in which the fit begins; at least two (J, 3) must be located.

    Raises:
        InputError: fewer are.
    """
    located = [name for name, place in zip(joint_names, xyz_m) if np.isfinite(place).all()]
    if len(located) < 2:
        raise InputError(
            f"The body needs at least two of the joints {', '.join(joint_names)} clicked in two views each, "
            f"but has {', '.join(located) or 'none'}; click more of them under [seeds.joints], or choose the model under "
            "[body] that has those that you clicked."
        )
    return Clicks(observations=tuple(observations), xyz_m=xyz_m)


def intersection(cameras: Sequence[Camera], xy_px: np.ndarray) -> np.ndarray:
    """The point (3,) whose projections are closest to K image points (K, 2): rays first, then Gauss-Newton in the images."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, xy in zip(cameras, xy_px):
        ray = camera.rays(xy)
        P = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        A, b = A + P, b + P @ camera.centre_m
    X = np.linalg.lstsq(A, b, rcond=None)[0]
    for _ in range(STEPS):
        pairs = [camera.project_with_jacobian(X) for camera in cameras]
        r = np.concatenate([p - xy for (p, _), xy in zip(pairs, xy_px)])
        if not np.isfinite(r).all():
            break
        step = np.linalg.lstsq(np.concatenate([J for _, J in pairs]), -r, rcond=None)[0]
        X = X + step
        if np.linalg.norm(step) < 1e-9:
            break
    return X


def _check_agreement(name: str, cameras: Sequence[Camera], xy_px: np.ndarray, X: np.ndarray, sigma_px: float) -> None:
    error = np.array([np.linalg.norm(camera.project(X) - xy) for camera, xy in zip(cameras, xy_px)])
    if np.isfinite(error).all() and error.max() < CONTRADICTION * sigma_px:
        return
    worst = _odd_one_out(cameras, xy_px) if len(cameras) > 2 else int(np.argmax(np.nan_to_num(error, nan=np.inf)))
    raise InputError(
        f"The clicks on “{name}” contradict each other by up to {np.nan_to_num(error, nan=np.inf).max():.0f} px; "
        f"check view {cameras[worst].name} first and click the joint again."
    )


def _odd_one_out(cameras: Sequence[Camera], xy_px: np.ndarray) -> int:
    left = []
    for k in range(len(cameras)):
        others = [i for i in range(len(cameras)) if i != k]
        X = intersection([cameras[i] for i in others], xy_px[others])
        error = [np.linalg.norm(cameras[i].project(X) - xy_px[i]) for i in others]
        left.append(float(np.nan_to_num(np.max(error), nan=np.inf)))
    return int(np.argmin(left))
