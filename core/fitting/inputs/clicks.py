"""Clicked joints: their observations, their places in space, and whether the views agree."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ...foundation.errors import InputError
from ...geometry.camera import Camera
from ...geometry.intersection import Intersection, doubtful_view, intersect_clicks, joint_clicks_contradict
from ...geometry.rig import Rig
from ..observations import ClickedJoints, Observation
from .fit_input import ClickedAt

SAME_PX = 0.5  # clicks of two joints are nearer only by mistake


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
            clicked = np.array(list(views.values()))
            point = intersect_clicks(seen, clicked[None], sigma_px)
            _check_agreement(name, seen, clicked, point, sigma_px)
            places[j] = point.xyz_m[0]
        cameras += seen
        index += [j] * len(seen)
        xy += list(views.values())
    found = ClickedJoints(
        cameras=tuple(cameras), joint=np.array(index, dtype=np.intp), xy_px=np.array(xy).reshape(-1, 2), sigma_px=sigma_px
    )
    return found, places


def check_apart(joints: ClickedAt, frame: int) -> None:
    """Check that no two joints of a frame were clicked at the same pixels, in all views of both.

    Raises:
        InputError: two were.
    """
    for (a, of_a), (b, of_b) in combinations(joints.items(), 2):
        both = of_a.keys() & of_b.keys()
        if len(both) > 1 and all(math.dist(of_a[view], of_b[view]) < SAME_PX for view in both):
            raise InputError(f"{a} and {b} are clicked at the same pixels in frame {frame}; click each joint at its own place.")


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


def _check_agreement(name: str, cameras: Sequence[Camera], xy_px: np.ndarray, point: Intersection, sigma_px: float) -> None:
    if not joint_clicks_contradict(cameras, point, sigma_px)[0]:
        return
    miss = np.nan_to_num(np.linalg.norm(point.residual_px[0], axis=1), nan=np.inf)
    worst = doubtful_view(cameras, xy_px) if len(cameras) > 2 else int(np.argmax(miss))
    if not np.isfinite(miss).any():
        raise InputError(f"The rays of the clicks on “{name}” do not meet; click it again, and check where the cameras stand in rig.toml.")
    raise InputError(
        f"The clicks on “{name}” contradict each other by up to {miss.max():.0f} px; "
        f"check view {cameras[worst].name} first and click the joint again."
    )
