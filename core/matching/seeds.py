"""Seeds: the first matched points, found automatically by sweeping along the rays of the reference view (Collins 1996).

On a coarse grid of textured points of the reference image, each ray is sampled in inverse depth, so finely that the search images move by
about a pixel. The patch, warped as a plane facing the reference camera, is correlated with all search views:

    score(w) = Σ_k ρ_k(w) / K ,   w = 1 / depth ,   best w taken if its score is high, unique, and from all K views     (1)

With more than two search views, a point that is not visible in all of them is scored over one view less, the best ones at every depth, and
so on down to two (with `pairs`, to one). Least squares matching then refines the result. For a clicked surface seed only the depths near
the click are swept.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..images.interlace import RowGrid
from ..images.sampling import SplineImage
from .least_squares import MatchingSettings
from .patches import patch_offsets
from .views import TemplateGrid, Views

NEAREST_BASES = 0.8  # nearest depth of the sweep over the longest base of the views that are matched, where nothing else limits it
FARTHEST_BASES = 40.0  # farthest depth
SWEEP_STEP_PX = 1.0  # px of the fastest search image from sample to sample
MIN_SCORE = 0.80  # of (1)
MIN_LEAD = 0.04  # of the best score over the second-best peak
PEAK_SAMPLES = 9  # a peak has the best score of so many samples about it
PEAK_DISTANCE = 8  # samples from the best one within which there is no other peak
MIN_CONTRAST = 0.5  # grey values, smallest standard deviation of a patch
CONTRAST_OVER_NOISE = 1.4  # and smallest ratio of it to the image's noise
PATCH_STRIDE = 2  # px between the pixels that are compared
DENSE_PATCH_PX = 9  # side of the largest patch of which all pixels are compared
SWEEP_SMOOTHING_PX = 1.0  # px, sigma of the Gaussian: finer details would be noise to every other pixel
LARGEST_SHAPE = 30.0  # pixels of a view over those of the reference
MIN_SAMPLES = 8  # of a ray
PROJECTED_EVERY = 8  # samples of a ray
FASTEST_PX = 4.0  # from sample to sample, where a search image is followed smoothly
CUBIC = 4  # values of a cubic
MAX_SAMPLES = 1200
LOOK_UP = 30_000_000  # grey values interpolated per block
CORRELATED = 16_384  # patches correlated at once
CLICK_SIGMAS = 3.0  # sigmas of depth that are swept about a click,
CLICK_SHARE = 0.5  # but not more than this part of the depth


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Approximations:
    """Starts of M points: their positions in every view, and the shapes of a reference patch there. Rows' pixels."""

    xy: np.ndarray  # (M, K, 2)
    shape: np.ndarray  # (M, K, 2, 2)
    depth_m: np.ndarray  # (M,) in the reference camera


def approximations_at_depth(
    cameras: Sequence[Camera], reference: int, rows: RowGrid, xy: np.ndarray, depth_m: np.ndarray
) -> Approximations:
    """The starts of points `xy` (M, 2) (rows' pixels of the reference) at depth (M,), induced by planes that face the reference camera."""
    depth = np.asarray(depth_m, dtype=np.float64)
    corners = _corners(cameras[reference], rows, xy, depth[:, None])[:, 0]
    at = [_image_of(camera, rows, corners) for camera in cameras]
    return Approximations(xy=np.stack([c for c, _ in at], axis=1), shape=np.stack([A for _, A in at], axis=1), depth_m=depth)


def _corners(base: Camera, rows: RowGrid, xy: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """World points (M, D, 3, 3) of the reference's rows' pixels (M, 2), of the next column and of the next row, at depths (M or 1, D)."""
    ray = base.rays(rows.to_frame(xy[:, None, :] + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])))
    return base.centre_m + ray[:, None] * depth_m[..., None, None]


def _image_of(camera: Camera, rows: RowGrid, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (…, 2) and shape (…, 2, 2) in one view of the patches with corners (…, 3, 3); NaN for patches of an absurd shape, whose
    pixels lie far outside of the image."""
    image = rows.from_frame(camera.project(corners))
    shape = np.stack([image[..., 1, :] - image[..., 0, :], image[..., 2, :] - image[..., 0, :]], axis=-1)
    plausible = (np.abs(shape) <= LARGEST_SHAPE).all(axis=(-2, -1))
    return np.where(plausible[..., None], image[..., 0, :], np.nan), shape


def _along_rays(views: Views, k: int, xy: np.ndarray, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`_image_of` in view k of the patches about points (m, 2) at inverse depths (D,): positions (m, D, 2) and shapes (m, D, 2, 2).

    Along a ray both are smooth: they are computed at every `PROJECTED_EVERY`th sample and interpolated by cubics; of rays where they are
    not, near the plane of the camera, at every sample.
    """
    m, D = len(xy), len(inverse)

    def exactly(points: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _image_of(views.cameras[k], views.rows, _corners(views.base, views.rows, points, 1 / w[None]))

    knots = np.linspace(inverse[0], inverse[-1], max(CUBIC, 1 + -(-(D - 1) // PROJECTED_EVERY)))
    if len(knots) >= D:
        return exactly(xy, inverse)
    c, A = exactly(xy, knots)
    smooth = np.abs(np.diff(c, axis=1)).max(axis=(1, 2)) < PROJECTED_EVERY * FASTEST_PX  # False for NaN
    weights = _cubic_weights((inverse - knots[0]) / (knots[1] - knots[0]), len(knots))
    both = np.concatenate([c, A.reshape(m, len(knots), 4)], axis=2)
    found = np.einsum("dn,mnc->mdc", weights, np.where(smooth[:, None, None], both, 0.0), optimize=True)
    at, shape = found[..., :2], found[..., 2:].reshape(m, D, 2, 2)
    if not smooth.all():
        at[~smooth], shape[~smooth] = exactly(xy[~smooth], inverse)
    return at, shape


def _cubic_weights(x: np.ndarray, n: int) -> np.ndarray:
    """Weights (D, n) of n values at 0, 1, … for the cubics through four neighbours each, at places x (D,) (Lagrange)."""
    first = np.clip(np.floor(x).astype(int) - 1, 0, n - CUBIC)
    rows, weights = np.arange(len(x)), np.zeros((len(x), n))
    for i in range(CUBIC):
        others = [j for j in range(CUBIC) if j != i]
        weights[rows, first + i] = np.prod([(x - first - j) / (i - j) for j in others], axis=0)
    return weights


def sweep_seeds(
    views: Views,
    grid: TemplateGrid,
    settings: MatchingSettings,
    *,
    spacing_px: int,
    depth_range_m: tuple[float, float] | None,
    near_px: tuple[np.ndarray, np.ndarray] | None = None,
    monitor: Monitor,
    pairs: bool = False,
) -> Approximations:
    """Automatic seeds on every so many cells of the template grid (about `spacing_px` apart), where the reference image has texture.

    `depth_range_m` narrows the search (clicked joints, or the frame before); without it the range comes from the base of the rig. With
    `near_px`, places (N, 2) and a distance (2,) in rows' pixels, only cells about these places are searched. With `pairs`, one search view
    is enough.

    Raises:
        InputError: the cameras are at the same position.
        Cancelled: the user asked to stop.
    """
    xy = grid.every(max(1, round(spacing_px / grid.spacing_px)))
    if near_px is not None:
        xy = xy[_near(xy, *near_px)]
    xy = _textured(views, settings, xy)
    smooth = views.smoothed(SWEEP_SMOOTHING_PX)
    near, far = depth_range_m or _default_range(views)
    inverse = _inverse_depths(views, near, far)

    def work(part: slice) -> tuple[np.ndarray, np.ndarray]:
        if monitor.cancelled:
            monitor.step("seeds", part.start, len(xy))
        rho = _sweep_correlations(smooth, settings, xy[part], inverse)
        return _best_depths(rho, inverse, views.required_matches(pairs))

    monitor.step("seeds", 0, len(xy))
    block = max(1, LOOK_UP // max(1, len(inverse) * settings.patch_px**2 * len(views.cameras)))
    parts = in_threads(work, equal_pieces(len(xy), block, 2))
    depth, good = (np.concatenate(a) for a in zip(*parts))
    return approximations_at_depth(views.cameras, views.reference, views.rows, xy[good], depth[good])


def _near(xy: np.ndarray, places: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(N,) which points (N, 2) lie within a distance (2,) of any of the places (M, 2), in both directions."""
    from scipy.spatial import cKDTree

    nearest, _ = cKDTree(places / distance).query(xy / distance, p=np.inf, distance_upper_bound=1.0)
    return np.isfinite(nearest)


def sweep_ray(views: Views, xy: np.ndarray, settings: MatchingSettings, depth_range_m: tuple[float, float] | None = None) -> float | None:
    """Depth [m] at which the reference view's patch about `xy` (2,) (rows' pixels) matches in all search views; None where ambiguous."""
    at = _textured(views, settings, np.asarray(xy, dtype=np.float64)[None])
    if not len(at):
        return None
    inverse = _inverse_depths(views, *(depth_range_m or _default_range(views)))
    depth, good = _best_depths(_sweep_correlations(views, settings, at, inverse), inverse, len(views.search))
    return float(depth[0]) if good[0] else None


def settled_depths(views: Views, xy: np.ndarray, depth_m: np.ndarray, sigma_m: np.ndarray, settings: MatchingSettings) -> np.ndarray:
    """Depths (M,) near `depth_m` ± `sigma_m` at which the reference view's patches about `xy` (M, 2) (rows' pixels) correlate best in as
    many views as show them; the given depth where that is ambiguous."""
    smooth = views.smoothed(SWEEP_SMOOTHING_PX)
    settled = np.array(depth_m, dtype=np.float64)
    for i, (depth, sigma) in enumerate(zip(depth_m, sigma_m)):
        at = _textured(views, settings, xy[i : i + 1])
        if len(at):
            reach = min(CLICK_SIGMAS * sigma, CLICK_SHARE * depth)
            inverse = _inverse_depths(views, depth - reach, depth + reach)
            best, clear = _best_depths(_sweep_correlations(smooth, settings, at, inverse), inverse, 1)
            settled[i] = best[0] if clear[0] else depth
    return settled


def _textured(views: Views, settings: MatchingSettings, xy: np.ndarray) -> np.ndarray:
    """The points (m, 2) of `xy` (N, 2) about which the reference image has more texture than noise."""
    image = views.template
    u, v, half = patch_offsets(settings.patch_px, views.rows.step)
    xy = xy[image.inside(xy, np.array(half) + 3.0)]
    patch = image.look_up((xy[:, :1] + u).astype(np.float32), (xy[:, 1:] + v).astype(np.float32))
    return xy[patch.std(axis=1) > max(MIN_CONTRAST, CONTRAST_OVER_NOISE * image.noise)]


def at_an_end(views: Views, depth_m: np.ndarray, depth_range_m: tuple[float, float]) -> np.ndarray:
    """(M,) which seeds in depths (M,) were found at an end of the range in which they were searched for: that is no peak, they lie beyond.

    They may grow to the surface all the same, but do not show where it is.
    """
    inverse = _inverse_depths(views, *depth_range_m)
    step = inverse[1] - inverse[0]
    return np.asarray((depth_m <= 1 / (inverse[-1] - step)) | (depth_m >= 1 / (inverse[0] + step)))


def longest_base_m(views: Views) -> float:
    """The largest distance between two of the cameras that are matched."""
    centres = np.stack([views.cameras[k].centre_m for k in (views.reference, *views.search)])
    return max(float(np.linalg.norm(a - b)) for a in centres for b in centres)


def _default_range(views: Views) -> tuple[float, float]:
    base = longest_base_m(views)
    if base == 0:
        raise InputError("The cameras are at the same position; depth needs a distance between them. Calibrate again.")
    return NEAREST_BASES * base, FARTHEST_BASES * base


def _inverse_depths(views: Views, near: float, far: float) -> np.ndarray:
    """Inverse depths from far to near, so that the fastest search image moves by about SWEEP_STEP_PX."""
    centres = np.stack([views.cameras[k].centre_m for k in views.search])
    speed = np.linalg.norm(centres - views.base.centre_m, axis=1).max() * views.base.focal_px
    count = int(np.clip(speed * (1 / near - 1 / far) / SWEEP_STEP_PX, MIN_SAMPLES, MAX_SAMPLES))
    return np.linspace(1 / far, 1 / near, count)


def _sweep_correlations(views: Views, settings: MatchingSettings, xy: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Correlations (S, m, D) of the patches in the S search views, NaN where a view does not contain them."""
    m, D = len(xy), len(inverse)
    u, v, half = patch_offsets(settings.patch_px, views.rows.step)
    sampled = (np.round(u).astype(int) % PATCH_STRIDE == 0) if settings.patch_px > DENSE_PATCH_PX else np.ones(len(u), dtype=bool)
    u, v = u[sampled], v[sampled]
    f = _normalised(views.template.look_up((xy[:, :1] + u).astype(np.float32), (xy[:, 1:] + v).astype(np.float32)))
    found = []
    for k in views.search:
        c, A = (a.reshape(m * D, *a.shape[2:]) for a in _along_rays(views, k, xy, inverse))
        inside = views.images[k].inside(c, np.array(half))
        rho = np.full(m * D, np.nan)
        rho[inside] = _correlations(views.images[k], c[inside], A[inside], f, np.repeat(np.arange(m), D)[inside], u, v)
        found.append(rho.reshape(m, D))
    return np.stack(found)


def _best_depths(rho: np.ndarray, inverse: np.ndarray, fewest: int) -> tuple[np.ndarray, np.ndarray]:
    """The depths (m,) at which most of the views (S, m, D) agree, but not fewer than `fewest`, and whether these are unambiguous."""
    ordered = -np.sort(-np.where(np.isnan(rho), -np.inf, rho), axis=0)  # the best view first
    depth, good = np.zeros(rho.shape[1]), np.zeros(rho.shape[1], dtype=bool)
    for views in range(len(rho), min(fewest, len(rho)) - 1, -1):
        score = np.where(np.isfinite(ordered[views - 1]), ordered[:views].sum(axis=0) / views, -1.0)  # (1)
        found, clear = _peaks(score, inverse)
        depth, good = np.where(good, depth, found), good | clear
    return depth, good


def _correlations(
    image: SplineImage, c: np.ndarray, A: np.ndarray, f: np.ndarray, owner: np.ndarray, u: np.ndarray, v: np.ndarray
) -> np.ndarray:
    rho = np.empty(len(c))
    for i in range(0, len(c), CORRELATED):
        s = slice(i, i + CORRELATED)
        c32, A32 = c[s].astype(np.float32), A[s].astype(np.float32)
        g = _normalised(
            image.look_up(c32[:, :1] + A32[:, 0, :1] * u + A32[:, 0, 1:] * v, c32[:, 1:] + A32[:, 1, :1] * u + A32[:, 1, 1:] * v)
        )
        rho[s] = np.einsum("ij,ij->i", g, f[owner[s]])
    return rho


def _normalised(patch: np.ndarray) -> np.ndarray:
    patch = patch - patch.mean(axis=1, keepdims=True)
    return patch / np.maximum(np.linalg.norm(patch, axis=1, keepdims=True), 1e-3)


def _peaks(score: np.ndarray, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the best sample of each row, refined by a parabola, and whether its score is high enough and leads the second-best peak."""
    from scipy.ndimage import maximum_filter1d

    rows, best = np.arange(len(score)), score.argmax(axis=1)
    top = score[rows, best]
    peaks = (score == maximum_filter1d(score, size=PEAK_SAMPLES, axis=1)) & (
        np.abs(np.arange(score.shape[1]) - best[:, None]) > PEAK_DISTANCE
    )
    second = np.where(peaks, score, -1.0).max(axis=1)
    i = np.clip(best, 1, score.shape[1] - 2)
    a, b, c = score[rows, i - 1], score[rows, i], score[rows, i + 1]
    bend = a - 2 * b + c
    offset = np.clip(np.where(bend < -1e-9, 0.5 * (a - c) / np.where(bend < -1e-9, bend, -1.0), 0.0), -0.5, 0.5)
    w = inverse[i] + offset * (inverse[1] - inverse[0])
    return 1 / w, (top >= MIN_SCORE) & (top - second >= MIN_LEAD)
