"""The points in space that clicks define, and the surface seeds from clicks.

A click is precise to a few pixels; the depth at which its rays meet may be wrong by more than the range of convergence of matching. The ray
of the reference view is therefore swept about that depth, within the clicks' own sigma, and the seed starts where the views correlate best.
"""

import numpy as np

from ..foundation.errors import InputError
from ..geometry.intersection import Intersection, doubtful_view, intersect_clicks, joint_clicks_contradict
from ..matching.least_squares import MatchingSettings
from ..matching.seeds import Approximations, approximations_at_depth, settled_depths
from ..matching.views import Views
from .footage import Footage
from .take import Clicks

LIMB_RADIUS_M = 0.05  # by which the surface lies before a joint, and its sigma


def clicked_depth(footage: Footage, name: str, at: Clicks) -> float:
    """Depth [m] in the reference camera of a clicked point.

    Raises:
        InputError: it was clicked in fewer than two views, or its rays miss each other.
    """
    point = clicked_point(footage, name, at)
    return float(footage.rig.cameras[footage.take.reference].to_camera(point.xyz_m)[0, 2])


def clicked_point(footage: Footage, name: str, at: Clicks) -> Intersection:
    """The intersection of the rays of a click in several views (one point), in front of the reference camera.

    Raises:
        InputError: it was clicked in fewer than two views, or its rays miss each other.
    """
    cameras = footage.rig.cameras
    xy = np.array([[at.get(c.name, np.full(2, np.nan)) for c in cameras]])
    point = intersect_clicks(cameras, xy, footage.click_sigma_px)
    if not 0 < cameras[footage.take.reference].to_camera(point.xyz_m)[0, 2] < np.inf:
        raise InputError(f"“{name}” is clicked in {len(at)} view(s) and has no position in space. Click it in two views at least.")
    if joint_clicks_contradict(cameras, point, footage.click_sigma_px)[0]:
        first = f"; look at view {cameras[doubtful_view(cameras, xy[0])].name} first" if point.rays[0] > 2 else ""
        raise InputError(
            f"The clicks of “{name}” miss each other by {point.rms_residual_px[0]:.0f} px. Click the same spot in every view{first}, "
            "and check that rig.toml belongs to this footage."
        )
    return point


def clicked_seeds(footage: Footage, views: Views, matching: MatchingSettings) -> Approximations:
    """The seeds of the clicked surface points, which need not be clicked in the reference view.

    Raises:
        InputError: see `clicked_point`.
    """
    axis = views.base.R_cam_world[2]
    points = [clicked_point(footage, f"surface seed {i + 1}", at) for i, at in enumerate(footage.take.clicks.surface)]
    K = np.concatenate([p.covariance_m2 for p in points])
    return settled_seeds(views, np.concatenate([p.xyz_m for p in points]), np.sqrt(np.einsum("i,nij,j->n", axis, K, axis)), matching)


def seeds_before_joints(footage: Footage, views: Views, matching: MatchingSettings) -> Approximations:
    """The seeds of the surface in front of the clicked joints, for takes without clicked surface points.

    Raises:
        InputError: see `clicked_point`; or no joint is clicked in this take.
    """
    if not footage.take.clicks.joints:
        raise InputError(
            "Without automatic seeds the surface starts from clicks, and this take has none; click joints or points of the surface, or "
            "let seeds be found with growing.seed_spacing_px=24."
        )
    points = np.concatenate([clicked_point(footage, name, at).xyz_m for name, at in footage.take.clicks.joints.items()])
    rays = points - views.base.centre_m
    surface = points - LIMB_RADIUS_M * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return settled_seeds(views, surface, np.full(len(points), LIMB_RADIUS_M), matching)


def settled_seeds(views: Views, xyz_m: np.ndarray, sigma_m: np.ndarray, matching: MatchingSettings) -> Approximations:
    """Seeds near points (M, 3) with these sigmas of depth (M,), where the views correlate best; without those outside the image."""
    base, xy = views.base, views.rows.from_frame(views.base.project(xyz_m))
    inside = views.template.inside(xy, 0.0)
    depth = settled_depths(views, xy[inside], base.to_camera(xyz_m)[inside, 2], sigma_m[inside], matching)
    return approximations_at_depth(views.cameras, views.reference, views.rows, xy[inside], depth)
