"""Key templates: the patch of each point's birth, kept so that a track cannot drift away from what it began with.

From frame to frame small errors add up to a random walk over the body, σ √n after n frames. Each frame's result is therefore adjusted with
a match of the key template itself, with P the point's covariance against the template, K_t and K_b those of the two matches:

    P⁻¹ ← (P + K_t)⁻¹ + K_b⁻¹                                                  (1)

but P is never less than the better of K_t and K_b: both matches look at the same new image, and the template's noise is always the same.

Where the template has become too unlike (its correlation is below a limit), the point's present patch becomes the template, and P is
added to the drift of the template itself.

Only tiles are kept, not images: memory grows with the points, not with the frames. Their gradients and normal matrices are made once,
when they are cut, from the new tiles laid out as one image.
"""

from dataclasses import dataclass

import numpy as np

from ..images.sampling import SplineImage
from ..matching.least_squares import Matches, MatchingSettings, PatchTemplates, match_prepared, prepare_templates
from ..matching.patch_pixels import patch_offsets
from .tracked import rows_of

BORDER = 5  # pixels about a patch: gradients, and where the spline still feels the tile's border
MAX_WIDTH_PX = 8000  # of an atlas, a limit of the look-up
REACQUIRE_CORRELATION = 0.9  # of a lost point with its key template: more than in tracking, for nothing else supports the match


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Tiles:
    """Cut-outs of the reference view by ascending identity."""

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
        """These templates and new ones, which replace those of the same identity."""
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
        """The templates of these points; a point without one is left out."""
        rows = rows_of(self.tiles.identity, np.unique(identities))
        rows = rows[rows >= 0]
        return Templates(tiles=self.tiles.select(rows), patches=self.patches.select(rows))

    def match(self, identity: np.ndarray, image: SplineImage, start: np.ndarray, shape: np.ndarray) -> Matches:
        """The templates of these points (each has one) matched in an image, from positions (N, 2) and shapes (N, 2, 2)."""
        return match_prepared(self.patches, rows_of(self.tiles.identity, identity), image, start, shape)


def no_templates(settings: MatchingSettings, row_step: int) -> Templates:
    """None yet."""
    w, h = _half_tile(settings, row_step)
    none = Tiles(identity=np.zeros(0, np.int64), tile=np.zeros((0, 2 * h + 1, 2 * w + 1), np.float16), offset=np.zeros((0, 2)))
    return Templates(tiles=none, patches=_prepared(none, settings, row_step))


def cut_tiles(image: SplineImage, identity: np.ndarray, xy: np.ndarray, settings: MatchingSettings, row_step: int) -> Tiles:
    """The tiles about points (N, 2) of an image; beyond its border the image is mirrored."""
    w, h = _half_tile(settings, row_step)
    middle = np.rint(xy)
    v, u = np.mgrid[-h : h + 1, -w : w + 1]
    x, y = (middle[:, i, None] + d.ravel() for i, d in ((0, u), (1, v)))
    tile = image.sample(x.astype(np.float32), y.astype(np.float32)).reshape(len(xy), *u.shape)
    return Tiles(identity=identity, tile=tile.astype(np.float16), offset=xy - middle)


def atlas(tiles: Tiles) -> tuple[np.ndarray, np.ndarray]:
    """One image (H, W) float32 of the tiles, and where their points lie in it (N, 2)."""
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
    patches = prepare_templates(SplineImage(grey), np.zeros((1, 2)) if none else xy, settings, row_step)
    return patches.select(np.zeros(0, np.int64)) if none else patches


def _half_tile(settings: MatchingSettings, row_step: int) -> tuple[int, int]:
    w, h = patch_offsets(settings.patch_px, row_step)[2]
    return w + BORDER, h + BORDER
