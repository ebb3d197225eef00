"""Proposals for the other views from one click: the epipolar curve, and the matching point on it.

A pixel's ray X(w) = C + d / w (w: inverse depth) is a straight line in another camera's undistorted image,

    (a, b)(w) = (p_x w + q_x, p_y w + q_y) / (p_z w + q_z) ,   p = R' C + t' ,  q = R' d                                (1)

which the lens bends into a curve (camera.py, (3)–(5)). Along it the click's patch is searched by the plane sweep of the seeds (Collins
1996), and the best match is refined by least squares matching (Gruen 1985). Where texture is too poor or repeats, nothing is proposed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.camera import Camera
from ..geometry.intersection import MOST_MISS_SIGMAS, Intersection, intersect_clicks, most_miss_px
from .least_squares import MatchingSettings, SearchImage, TemplatePoints, match_patches
from .seeds import approximations_at_depth, sweep_ray
from .views import Views

CURVE_STEP_PX = 6.0  # px between corners of the polyline
NEAREST_M = 0.05  # m, nearest depth of a ray without a depth range
FIELD_MARGIN = 1.05  # of the frame corner's radius: the lens is not calibrated further out
LARGEST_PATCH_PX = 51  # side of a patch, the limit of its knob
PIXEL_SIGMA_PX = 0.1  # of the clicked pixel itself in an intersection with matches of it: it defines the point
LARGER_PX = (0, 8, 16)  # px by which patches are larger, tried one after the other
DEPTH_SHARE = 0.4  # of a joint's depth below the skin, its sigma: bodies differ
UNMATCHED_SIGMA_PX = 0.5  # px, sigma of a point below the surface in views without a match
MAX_MISS_PX = 2.5  # px, largest distance of a match from its epipolar curve


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Proposal:
    """Where a point clicked in one view was found in another. Full-frame pixels."""

    xy_px: np.ndarray  # (2,)
    sigma_px: float  # along the worse axis
    correlation: float  # of the patches; the smallest of those that define the place


def epipolar_curve(camera: Camera, xy_px: np.ndarray, other: Camera, depth_range_m: tuple[float, float] | None = None) -> np.ndarray:
    """The ray of pixel `xy_px` (2,) of `camera` as a polyline (M, 2) in the frame of `other`; M = 0 where it is not in sight.

    `depth_range_m`: nearest and farthest depth in `camera`; without it from 5 cm to infinity. The polyline's corners lie on the curve, and
    its edges within a thousandth of a pixel for any usual lens.
    """
    near, far = depth_range_m or (NEAREST_M, np.inf)
    p = other.to_camera(camera.centre_m)
    q = other.R_cam_world @ camera.rays(np.asarray(xy_px, dtype=np.float64))
    ends = _ahead(p, q, 1 / far, 1 / near)
    if ends is None:
        return np.zeros((0, 2))
    inside = _in_disc(*ends, FIELD_MARGIN * other.field_radius)
    if inside is None:
        return np.zeros((0, 2))
    start, end = inside
    count = 2 + int(np.linalg.norm(end - start) * other.focal_px / CURVE_STEP_PX)
    ab = start + (end - start) * np.linspace(0, 1, count)[:, None]
    rays = np.concatenate([ab, np.ones((count, 1))], axis=1)
    curve = other.project((rays - other.t_cam_world_m) @ other.R_cam_world)
    return curve[other.sees(curve, -CURVE_STEP_PX)]


def _ahead(p: np.ndarray, q: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Both ends (2,) of (1) for inverse depths low … high, as far as they lie before the camera."""
    least = 1e-3 * float(np.linalg.norm(q))
    at = [p * w + q for w in (low, high)]
    if at[0][2] < least and at[1][2] < least:
        return None
    for i in (0, 1):
        if at[i][2] < least:
            share = (least - at[1 - i][2]) / (at[i][2] - at[1 - i][2])
            at[i] = at[1 - i] + share * (at[i] - at[1 - i])
    return at[0][:2] / at[0][2], at[1][:2] / at[1][2]


def _in_disc(a: np.ndarray, b: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray] | None:
    """The part of the segment from a to b (2,) that lies in a disc about the origin."""
    along = b - a
    A, B, C = float(along @ along), float(a @ along), float(a @ a) - radius**2
    if A == 0.0:
        return (a, b) if C <= 0 else None
    root = B * B - A * C
    if root <= 0:
        return None
    s, t = max((-B - np.sqrt(root)) / A, 0.0), min((-B + np.sqrt(root)) / A, 1.0)
    return (a + s * along, a + t * along) if s <= t else None


def propose(
    views: Views, xy_px: np.ndarray, settings: MatchingSettings, depth_range_m: tuple[float, float] | None = None
) -> tuple[Proposal | None, ...]:
    """The surface point at pixel `xy_px` (2,) of the reference view in every view; None where it was not found, and in the reference.

    All other views are searched together, with larger and larger patches; where only some match, the rest follows from the intersection of
    the rays. If none matches, they are searched one by one, with large patches only: a small patch has repetitions along its curve.
    `depth_range_m` (in the reference camera) narrows the search. Cost: about 10 ms for three views of 768×576.
    """
    cameras, rows, view, others = views.cameras, views.rows, views.reference, views.search
    at = rows.from_frame(np.asarray(xy_px, dtype=np.float64))
    together = [(others, larger) for larger in LARGER_PX]
    alone = [([k], larger) for k in others for larger in LARGER_PX[1:]] if len(others) > 1 else []
    found: dict[int, Proposal] = {}
    for group, larger in together + alone:
        if found and (group == others or group[0] in found):
            continue
        patch = replace(settings, patch_px=min(settings.patch_px + larger, LARGEST_PATCH_PX))
        matched = _find(views.select((view, *group)), at, patch, depth_range_m)
        found |= {group[k - 1]: proposal for k, proposal in matched.items()}
        if found and group == others:
            limit_px = max(MAX_MISS_PX, MOST_MISS_SIGMAS * max(p.sigma_px for p in found.values()))
            clicked = Proposal(xy_px=rows.to_frame(at), sigma_px=PIXEL_SIGMA_PX, correlation=1.0)
            found = _where_rays_meet(cameras, {view: clicked} | found, limit_px)
            break
    return tuple(found.get(k) if k != view else None for k in range(len(cameras)))


def where_rays_meet(cameras: Sequence[Camera], clicks: Mapping[int, np.ndarray], sigma_px: float) -> tuple[Proposal | None, ...]:
    """Where the point clicked in two views or more (view number → pixel (2,)) lies in the others; None where it lies outside the image.

    The clicks' sigma enters the proposals' sigmas.
    """
    given = {k: Proposal(xy_px=np.asarray(xy, dtype=np.float64), sigma_px=sigma_px, correlation=1.0) for k, xy in clicks.items()}
    if len(given) > 1:
        limit_px = float(most_miss_px(cameras, _intersected(cameras, given), sigma_px)[0])
        found = _where_rays_meet(cameras, given, limit_px)
    else:
        found = given
    return tuple(found.get(k) if k not in clicks else None for k in range(len(cameras)))


def below_surface(
    cameras: Sequence[Camera], view: int, xy_px: np.ndarray, surface: Sequence[Proposal | None], depth_m: float
) -> tuple[Proposal | None, ...]:
    """Where a point lies that was clicked at `xy_px` (2,) in view number `view`, `depth_m` behind the surface that was matched there.

    A joint is clicked on the visible surface, but lies inside the limb; from another side it is not where the surface's texture is. The
    proposals' sigmas contain DEPTH_SHARE of that depth, of which there is no better estimate.
    """
    given = {k: place for k, place in enumerate(surface) if place is not None}
    if not given:
        return tuple(surface)
    point = _intersected(cameras, {view: Proposal(xy_px=xy_px, sigma_px=PIXEL_SIGMA_PX, correlation=1.0), **given})
    depth = float(cameras[view].to_camera(point.xyz_m)[0, 2])
    ray = cameras[view].rays(np.asarray(xy_px, dtype=np.float64))
    X = cameras[view].centre_m + ray * (depth + depth_m)
    sure, found = min(p.correlation for p in given.values()), []
    for k, camera in enumerate(cameras):
        at, J = camera.project_with_jacobian(X)
        sigma = np.hypot(np.linalg.norm(J @ ray) * DEPTH_SHARE * depth_m, given[k].sigma_px if k in given else UNMATCHED_SIGMA_PX)
        visible = k != view and bool(camera.sees(at))
        found.append(Proposal(xy_px=at, sigma_px=float(sigma), correlation=sure) if visible else None)
    return tuple(found)


def _where_rays_meet(cameras: Sequence[Camera], given: Mapping[int, Proposal], limit_px: float) -> dict[int, Proposal]:
    """The given places, and those of their forward intersection in the other views if their rays miss each other by no more."""
    point, found = _intersected(cameras, given), dict(given)
    if not point.rms_residual_px[0] <= limit_px:
        return found
    for k in set(range(len(cameras))) - set(given):
        at, J = cameras[k].project_with_jacobian(point.xyz_m[0])
        if cameras[k].sees(at):
            sigma = np.sqrt(np.diag(J @ point.covariance_m2[0] @ J.T).max())
            found[k] = Proposal(xy_px=at, sigma_px=float(sigma), correlation=min(p.correlation for p in given.values()))
    return found


def _intersected(cameras: Sequence[Camera], given: Mapping[int, Proposal]) -> Intersection:
    """The point (one) that the given places (view number → place) agree on."""
    xy, sigma = np.full((1, len(cameras), 2), np.nan), np.ones((1, len(cameras)))
    for k, place in given.items():
        xy[0, k], sigma[0, k] = place.xy_px, place.sigma_px
    return intersect_clicks(cameras, xy, sigma)


def _find(views: Views, at: np.ndarray, settings: MatchingSettings, depth_range_m: tuple[float, float] | None) -> dict[int, Proposal]:
    """Sweep and matching of the reference view's patch about `at` (rows' pixels): the proposals by the number of the search view."""
    base, rows = views.base, views.rows
    depth = sweep_ray(views, at, settings, depth_range_m)
    if depth is None:
        return {}
    start = approximations_at_depth(views.cameras, views.reference, rows, at[None], np.array([depth]))
    template = TemplatePoints(image=views.template, xy=at[None], row_step=rows.step)
    searches = [SearchImage(image=views.images[k], start=start.xy[:, k], shape=start.shape[:, k]) for k in views.search]
    found = {}
    for k, match in zip(views.search, match_patches(template, searches, settings)):
        xy = rows.to_frame(match.xy[0])
        if match.ok[0] and views.cameras[k].sees(xy) and _miss(base, rows.to_frame(at), views.cameras[k], xy) <= MAX_MISS_PX:
            sigma = np.sqrt(np.diag(rows.covariance_to_frame(match.covariance[0])))
            found[k] = Proposal(xy_px=xy, sigma_px=float(sigma.max()), correlation=float(match.correlation[0]))
    return found


def _miss(camera: Camera, xy_px: np.ndarray, other: Camera, at_px: np.ndarray) -> float:
    """Distance [px] of a pixel of `other` from the epipolar curve of a pixel of `camera`."""
    curve = epipolar_curve(camera, xy_px, other)
    if len(curve) < 2:
        return np.inf
    a, along = curve[:-1], np.diff(curve, axis=0)
    share = np.clip(np.einsum("ij,ij->i", at_px - a, along) / np.maximum(np.einsum("ij,ij->i", along, along), 1e-12), 0, 1)
    return float(np.linalg.norm(a + share[:, None] * along - at_px, axis=1).min())
