"""Key templates: the patch of each point in its first frame, to which every frame is compared so that the track does not drift.

Small errors from frame to frame accumulate to a random walk over the body, σ √n after n frames. Each frame's result is therefore adjusted
with a match of the key template itself, with P the point's covariance against the template, K_t and K_b those of the temporal match and of
the key template's:

    P⁻¹ ← (P + K_t)⁻¹ + K_b⁻¹                                                  (1)

but P is never less than the smaller of K_t and K_b: both matches use the same new image, and the template's noise is always the same.

Where the correlation with the template falls below a limit, the point's present patch replaces it, and P is added to the drift of the
template itself.

Only tiles are stored, not images: memory grows with the points, not with the frames. Their gradients and normal matrices are computed once,
when they are cut, from the new tiles laid out as one image.

The module has the templates, the control of drift by (1), and the box search (equation (2) of step.py), which precedes a match where the
position is uncertain.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.small_matrices import invert_spd
from ..images.sampling import SplineImage
from ..matching.least_squares import (
    Matches,
    MatchingSettings,
    PatchTemplates,
    SearchImage,
    TemplatePoints,
    match_prepared,
    prepare_templates,
)
from ..matching.patches import patch_offsets
from .tracked import rows_of

BORDER = 5  # pixels around a patch, for gradients and for the effect of the tile's border on the spline
MAX_WIDTH_PX = 8000  # of an atlas; OpenCV looks up at most 32,766 px
REACQUIRE_CORRELATION = 0.9  # of a lost point with its key template: more than in tracking, as nothing else supports it


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Tiles:
    """Cut-outs of the reference view, in ascending order of identity."""

    identity: np.ndarray  # (N,)
    tile: np.ndarray  # (N, h, w) float16: whole grey values of 8 bits are exact in it
    offset: np.ndarray  # (N, 2) of the point from the tile's middle [px]

    def select(self, rows: np.ndarray) -> "Tiles":
        """Only these rows (indices)."""
        return Tiles(identity=self.identity[rows], tile=self.tile[rows], offset=self.offset[rows])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Templates:
    """The key templates of N points, ready to be matched."""

    tiles: Tiles
    patches: PatchTemplates

    def with_tiles(self, new: Tiles, settings: MatchingSettings, row_step: int) -> "Templates":
        """These templates and new ones, which replace those of the same identities."""
        if not len(new.identity):
            return self
        old = ~np.isin(self.tiles.identity, new.identity)
        identity = np.concatenate([self.tiles.identity[old], new.identity])
        order = np.argsort(identity, kind="stable")
        both = Tiles(
            identity=identity,
            tile=np.concatenate([self.tiles.tile[old], new.tile]),
            offset=np.concatenate([self.tiles.offset[old], new.offset]),
        )
        patches = PatchTemplates.joined([self.patches.select(old), _prepared(new, settings, row_step)])
        return Templates(tiles=both.select(order), patches=patches.select(order))

    def only(self, identities: np.ndarray) -> "Templates":
        """The templates of these points, without those that have none."""
        rows = rows_of(self.tiles.identity, np.unique(identities))
        rows = rows[rows >= 0]
        return Templates(tiles=self.tiles.select(rows), patches=self.patches.select(rows))

    def match(self, identity: np.ndarray, image: SplineImage, start: np.ndarray, shape: np.ndarray) -> Matches:
        """The templates of these points, each of which has one, matched in an image from positions (N, 2) and shapes (N, 2, 2)."""
        return match_prepared(self.patches, rows_of(self.tiles.identity, identity), SearchImage(image=image, start=start, shape=shape))


def no_templates(settings: MatchingSettings, row_step: int) -> Templates:
    """An empty set of templates."""
    w, h = _half_tile(settings, row_step)
    none = Tiles(identity=np.zeros(0, np.int64), tile=np.zeros((0, 2 * h + 1, 2 * w + 1), np.float16), offset=np.zeros((0, 2)))
    return Templates(tiles=none, patches=_prepared(none, settings, row_step))


def cut_tiles(image: SplineImage, identity: np.ndarray, xy: np.ndarray, settings: MatchingSettings, row_step: int) -> Tiles:
    """The tiles around points (N, 2) of an image, which is mirrored at its border."""
    w, h = _half_tile(settings, row_step)
    middle = np.rint(xy)
    v, u = np.mgrid[-h : h + 1, -w : w + 1]
    x, y = (middle[:, i, None] + d.ravel() for i, d in ((0, u), (1, v)))
    tile = image.sample(x.astype(np.float32), y.astype(np.float32)).reshape(len(xy), *u.shape)
    return Tiles(identity=identity, tile=tile.astype(np.float16), offset=xy - middle)


def atlas(tiles: Tiles) -> tuple[np.ndarray, np.ndarray]:
    """One image (H, W) float32 of all tiles, and the positions of their points in it (N, 2)."""
    n, (h, w) = max(1, len(tiles.identity)), tiles.tile.shape[1:]
    across = min(MAX_WIDTH_PX // w, int(np.ceil(np.sqrt(n * h / w))))
    down = -(-n // across)
    grey = np.zeros((down * across, h, w), dtype=np.float32)
    grey[: len(tiles.tile)] = tiles.tile
    place = np.arange(len(tiles.identity))
    middle = np.stack([place % across * w + w // 2, place // across * h + h // 2], axis=1)
    whole = grey.reshape(down, across, h, w).transpose(0, 2, 1, 3).reshape(down * h, across * w)
    return np.ascontiguousarray(whole), middle + tiles.offset


def _prepared(tiles: Tiles, settings: MatchingSettings, row_step: int) -> PatchTemplates:
    grey, xy = atlas(tiles)
    none = not len(xy)
    points = TemplatePoints(image=SplineImage(grey), xy=np.zeros((1, 2)) if none else xy, row_step=row_step, texture_centre=False)
    patches = prepare_templates(points, settings)
    return patches.select(np.zeros(0, np.int64)) if none else patches


def _half_tile(settings: MatchingSettings, row_step: int) -> tuple[int, int]:
    w, h = patch_offsets(settings.patch_px, row_step)[2]
    return w + BORDER, h + BORDER


MAX_JUMP_PX = 1.0  # a key template's match further than this, and than MAX_JUMP_SIGMAS, from the temporal one is another place
MAX_JUMP_SIGMAS = 5.0  # of the difference between the two matches
REGULARISATION_PX2 = 1e-8  # keeps the sum of two covariances invertible


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TemplateState:
    """How N points relate to their key templates, and how far both may have strayed over the body. Rows' pixels."""

    shape: np.ndarray  # (N, 2, 2) from the key template to the image
    drift: np.ndarray  # (N, 2, 2) covariance of the point against its key template
    key_drift: np.ndarray  # (N, 2, 2) covariance of the template's own place on the body

    def renewed(self, rows: np.ndarray) -> "TemplateState":
        """The state after the present patches of `rows` (a mask) became their key templates, which takes over their drift."""
        own = rows[:, None, None]
        return TemplateState(
            shape=np.where(own, np.eye(2), self.shape),
            drift=np.where(own, 0.0, self.drift),
            key_drift=self.key_drift + np.where(own, self.drift, 0.0),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Controlled:
    """N points after the control of drift. Rows' pixels."""

    shift: np.ndarray  # (N, 2) to add to the temporal result
    state: TemplateState
    renewed: np.ndarray  # (N,) points that no longer match their template: the present patch is to replace it


def control_drift(
    temporal: Matches,
    good: np.ndarray,
    state: TemplateState,
    match_templates: Callable[[np.ndarray, np.ndarray], Matches],
    min_correlation: float,
) -> Controlled:
    """Match the key templates of the `good` points about their temporal results, and adjust both.

    `match_templates(start, shape)` matches the templates of all N points from positions (N, 2), NaN to skip one, and shapes (N, 2, 2).
    """
    grown = np.where(good[:, None, None], state.drift + temporal.covariance, state.drift)
    shape = np.where(good[:, None, None], temporal.shape @ state.shape, state.shape)
    key = match_templates(np.where(good[:, None], temporal.xy, np.nan), shape)
    jump = np.linalg.norm(key.xy - temporal.xy, axis=1)
    sigma = np.sqrt(np.maximum(np.trace(grown + key.covariance, axis1=1, axis2=2), 0.0))
    matched = good & key.ok & (key.correlation >= min_correlation) & (jump <= np.maximum(MAX_JUMP_PX, MAX_JUMP_SIGMAS * sigma))
    shift, drift = np.zeros((len(good), 2)), grown.copy()
    gain = grown[matched] @ invert_spd(grown[matched] + key.covariance[matched] + np.eye(2) * REGULARISATION_PX2)
    shift[matched] = np.einsum("nij,nj->ni", gain, key.xy[matched] - temporal.xy[matched])
    drift[matched] = at_least_best((np.eye(2) - gain) @ grown[matched], temporal.covariance[matched], key.covariance[matched])
    shape[matched] = key.shape[matched]
    renewed = good & ~matched
    adjusted = TemplateState(shape=shape, drift=drift, key_drift=state.key_drift)
    return Controlled(shift=shift, state=adjusted.renewed(renewed), renewed=renewed)


def at_least_best(covariance: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """An adjusted covariance (N, 2, 2), enlarged to that of the better of the two matches `a` and `b` where it is smaller.

    Both matches use the same new image, whose noise does not average out; neither does that of a template that is the same in every frame.
    """
    own, first, second = (np.maximum(np.trace(K, axis1=1, axis2=2), 1e-12) for K in (covariance, a, b))
    return covariance * np.maximum(1.0, np.minimum(first, second) / own)[:, None, None]


def search_box(
    grey: np.ndarray, next_grey: np.ndarray, xy: np.ndarray, centre: np.ndarray, box: np.ndarray, patch_px: int, row_step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) within `box` (N,) of `centre` (N, 2) where the patches about `xy` (N, 2) of `grey` correlate best in `next_grey`.

    Returns the correlations (N,) as well, −1 where a patch or its box leaves an image. Box sizes are full-frame pixels; with a box of 0 the
    result is the centre itself. Cost: one call of OpenCV per point, 10 µs for a box of 5 px, 35 µs for 12 px.
    """
    _, _, (w, h) = patch_offsets(patch_px, row_step)
    best, start = np.full(len(xy), -1.0), np.array(centre)
    p, q = (np.rint(np.nan_to_num(a, nan=-1e6)).astype(np.int64) for a in (xy, centre))
    rx, ry = np.ceil(box).astype(np.int64), np.maximum(1, np.ceil(box / row_step)).astype(np.int64)
    usable = _inside(p, grey.shape, w, h) & _inside(q, next_grey.shape, w, h)
    H, W = next_grey.shape
    x0, x1 = np.maximum(0, q[:, 0] - w - rx), np.minimum(W, q[:, 0] + w + rx + 1)
    y0, y1 = np.maximum(0, q[:, 1] - h - ry), np.minimum(H, q[:, 1] + h + ry + 1)
    best[usable & (box == 0)] = 1.0  # no search: the result is the centre
    rows = np.flatnonzero(usable & (box > 0))
    spans = np.stack([p[:, 1] - h, p[:, 1] + h + 1, p[:, 0] - w, p[:, 0] + w + 1, y0, y1, x0, x1], axis=1)[rows].tolist()
    found = np.zeros((len(rows), 3))
    for i, (a, b, c, d, e, f, g, k) in enumerate(spans):
        _, largest, _, at = cv2.minMaxLoc(cv2.matchTemplate(next_grey[e:f, g:k], grey[a:b, c:d], cv2.TM_CCOEFF_NORMED))
        found[i] = largest, *at
    best[rows] = found[:, 0]
    corner = np.stack([x0 + w, y0 + h], axis=1)[rows]
    start[rows] = xy[rows] + found[:, 1:] + corner - p[rows]
    return start, best


def _inside(p: np.ndarray, shape: tuple[int, ...], w: int, h: int) -> np.ndarray:
    return (p[:, 0] >= w) & (p[:, 1] >= h) & (p[:, 0] < shape[1] - w) & (p[:, 1] < shape[0] - h)
