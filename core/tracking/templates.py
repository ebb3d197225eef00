"""Key templates: the patch of each point's birth, kept so that a track cannot drift away from what it began with.

From frame to frame small errors add up to a random walk over the body, σ √n after n frames. Each frame's result is therefore adjusted with
a match of the key template itself, with P the point's covariance against the template, K_t and K_b those of the two matches:

    P⁻¹ ← (P + K_t)⁻¹ + K_b⁻¹                                                  (1)

Where the template has become too unlike (its correlation is below a limit), the point's present patch becomes the template, and P is
added to the drift of the template itself.

Only tiles are kept, not images: memory grows with the points, not with the frames. The tiles in use are laid out as one image, an atlas.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..images.sampling import SplineImage
from .tracked import rows_of

BORDER = 5  # pixels about a patch: gradients, and where the spline still feels the tile's border
MAX_WIDTH_PX = 8000  # of an atlas, a limit of the look-up


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Templates:
    """Tiles of the reference view by ascending identity."""

    identity: np.ndarray  # (N,)
    tile: np.ndarray  # (N, h, w) float16: whole grey values of 8 bits are exact in it
    offset: np.ndarray  # (N, 2) of the point from the tile's middle [px]

    def with_tiles(self, new: "Templates") -> "Templates":
        """These templates and new ones, which replace those of the same identity."""
        old = ~np.isin(self.identity, new.identity)
        identity = np.concatenate([self.identity[old], new.identity])
        order = np.argsort(identity, kind="stable")
        tile, offset = np.concatenate([self.tile[old], new.tile]), np.concatenate([self.offset[old], new.offset])
        return Templates(identity=identity[order], tile=tile[order], offset=offset[order])

    def only(self, identities: np.ndarray) -> "Templates":
        """The templates of these points; a point without one is left out."""
        rows = rows_of(self.identity, np.unique(identities))
        rows = rows[rows >= 0]
        return replace(self, identity=self.identity[rows], tile=self.tile[rows], offset=self.offset[rows])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Atlas:
    """The tiles of N points as one image."""

    grey: np.ndarray  # (H, W) float32
    spline: SplineImage
    xy: np.ndarray  # (N, 2) where the points lie in it; NaN without a template


def no_templates(half: tuple[int, int]) -> Templates:
    """None yet, for patches of the half size (columns, rows)."""
    h, w = (2 * (half[1] + BORDER) + 1, 2 * (half[0] + BORDER) + 1)
    return Templates(identity=np.zeros(0, np.int64), tile=np.zeros((0, h, w), np.float16), offset=np.zeros((0, 2)))


def cut_templates(image: SplineImage, identity: np.ndarray, xy: np.ndarray, half: tuple[int, int]) -> Templates:
    """The tiles about points (N, 2) of an image; beyond its border the image is mirrored."""
    w, h = half[0] + BORDER, half[1] + BORDER
    middle = np.rint(xy)
    v, u = np.mgrid[-h : h + 1, -w : w + 1]
    x, y = (middle[:, i, None] + d.ravel() for i, d in ((0, u), (1, v)))
    tile = image.sample(x.astype(np.float32), y.astype(np.float32)).reshape(len(xy), *u.shape)
    return Templates(identity=identity, tile=tile.astype(np.float16), offset=xy - middle)


def atlas(templates: Templates, identity: np.ndarray) -> Atlas:
    """One image of the tiles of these points."""
    at = rows_of(templates.identity, identity)
    used = np.unique(at[at >= 0])
    n, (h, w) = max(1, len(used)), templates.tile.shape[1:]
    across = min(MAX_WIDTH_PX // w, int(np.ceil(np.sqrt(n * h / w))))
    down = -(-n // across)
    tiles = np.zeros((down * across, h, w), dtype=np.float32)
    tiles[: len(used)] = templates.tile[used]
    grey = np.ascontiguousarray(tiles.reshape(down, across, h, w).transpose(0, 2, 1, 3).reshape(down * h, across * w))
    place = np.searchsorted(used, at)
    middle = np.stack([place % across * w + w // 2, place // across * h + h // 2], axis=1)
    xy = middle + templates.offset[at] if len(templates.identity) else np.zeros((len(at), 2))
    return Atlas(grey=grey, spline=SplineImage(grey), xy=np.where((at >= 0)[:, None], xy, np.nan))
