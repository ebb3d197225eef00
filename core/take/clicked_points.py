"""The points in space that clicks define, and the surface seeds from clicks.

A click is precise to a few pixels; the depth at which its rays meet may be wrong by more than the range of convergence of matching. The ray
of the reference view is therefore swept about that depth, within the clicks' own sigma, and the seed starts where the views correlate best.
"""

from dataclasses import fields

import numpy as np

from ..foundation.errors import InputError
from ..geometry.intersection import Intersection, clicks_contradict, intersect_clicks
from ..matching.least_squares import MatchingSettings
from ..matching.seeds import Approximations, approximations_at_depth, settled_depths
from ..matching.views import Views
from .footage import Footage
from .take import Clicks


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
    if clicks_contradict(point, footage.click_sigma_px)[0]:
        raise InputError(
            f"The clicks of “{name}” miss each other by {point.rms_residual_px[0]:.0f} px. Click the same spot in every view, "
            "and check that rig.toml belongs to this footage."
        )
    return point


def with_clicked(footage: Footage, views: Views, seeds: Approximations, matching: MatchingSettings) -> Approximations:
    """The swept seeds and those of the clicked surface points, which need not be clicked in the reference view.

    Raises:
        InputError: see `clicked_point`.
    """
    surface, base = footage.take.clicks.surface, views.base
    points = [clicked_point(footage, f"surface seed {i + 1}", at) for i, at in enumerate(surface)]
    xyz = np.concatenate([p.xyz_m for p in points])
    K = np.concatenate([p.covariance_m2 for p in points])
    axis, depth = base.R_cam_world[2], base.to_camera(xyz)[:, 2]
    xy = views.rows.from_frame(base.project(xyz))
    sigma = np.sqrt(np.einsum("i,nij,j->n", axis, K, axis))
    inside = views.template.inside(xy, 0.0)
    depth = settled_depths(views, xy[inside], depth[inside], sigma[inside], matching)
    clicked = approximations_at_depth(views.cameras, views.reference, views.rows, xy[inside], depth)
    return Approximations(**{f.name: np.concatenate([getattr(seeds, f.name), getattr(clicked, f.name)]) for f in fields(Approximations)})
