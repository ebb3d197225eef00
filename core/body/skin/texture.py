"""The person's own texture: what the footage of all views and frames shows of the skin, on its texture coordinates.

A texel is a place of the skin. In each frame it is projected into every view in which it is visible: it faces the camera, and nothing of
the posed skin is nearer, with a margin at edges. Its colour there has the weight

    w = (cos ϑ · f/z)² / (1 + (σ/σ_0)²) ,                                                                   (1)

ϑ: angle between normal and ray, f/z: pixels per metre, σ: standard deviation of the skin's place there (relief). The `KEPT` colours of
the largest weights are kept, divided by the exposure of their view, and averaged with weights that decrease with their distance from the
average, so that a hand before the hip, or background beside a misplaced limb, counts little. The exposures g_v follow from the median
ratios of vertices that two views show at the same time,

    ln g_a − ln g_b = median ln(I_a / I_b) ,   Σ ln g_v = 0                                                 (2)

Texels that no view showed, or whose place was not measured, get colours from elsewhere on the body (`texture_fill`). The mask
distinguishes both.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...foundation import store
from ...foundation.arrays import frozen
from ...foundation.progress import Monitor
from ...foundation.threads import equal_pieces, in_threads
from ...geometry.camera import Camera
from ..shape import BodyShape
from .closed_skin import OneSkin
from .person_skin import cage
from .posed import Poser
from .surface_operators import vertex_normals
from .texture_fill import Texels, filled

TEXTURE, MASK = "texture.png", "texture_mask.png"  # in the folder skin/
LEAST_COSINE = 0.3  # between normal and ray
KEPT = 24  # colours of a texel, …
LEAST_KEPT, LARGE_PX = 8, 2048  # … fewer in a texture that is wider than this, whose table would be too large
ROBUST_GREY = 40.0  # distance from the average at which a colour's weight is halved
REWEIGHTINGS = 4
TOGETHER = 30_000  # texels: fewer pieces wait less for each other
SIGMA_M = 0.004  # σ_0 of (1)
LEAST_TRUST = 0.2  # 1/(1 + (σ/σ_0)²): where less is known of the skin's place, σ > 8 mm, its colour may be the background's
NEARER_M = 0.025  # by which another surface must be nearer to hide a texel
EDGE_PX = 2  # margin at the edges of nearer surfaces
DARKEST = 4.0  # grey values that count for the exposures
FEWEST = 30  # common vertices of two views
LEAST_HOLE_PX = 7  # texels; smaller holes have no rim
RIM_PX = 3  # texels at the rim of what was seen, with the background in them, and as many over which it fades into what is filled
PADDING_PX = 6  # around the islands
MOST_FRAMES = 16  # evenly over the take


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class View:
    """The image of one view in one frame."""

    camera: Camera
    rgb: np.ndarray  # (h, w, 3) float32, 0…255


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Texture:
    """A picture on the skin's texture coordinates; row 0 is at the top, v = 1."""

    rgb: np.ndarray  # (S, S, 3) uint8
    seen: np.ndarray  # (S, S) bool: from footage; elsewhere filled from around, or no part of the skin
    covered: np.ndarray  # (S, S) bool: part of the skin
    exposures: np.ndarray  # (K,) of the views, by which their colours were divided

    def __post_init__(self) -> None:
        side = self.rgb.shape[:2]
        object.__setattr__(self, "rgb", frozen(self.rgb, (*side, 3), np.uint8, "rgb"))
        object.__setattr__(self, "seen", frozen(self.seen, side, np.bool_, "seen"))
        object.__setattr__(self, "covered", frozen(self.covered, side, np.bool_, "covered"))
        object.__setattr__(self, "exposures", frozen(self.exposures, (None,), name="exposures"))


class TextureBaker:
    """Collects the colours of a skin, frame by frame."""

    def __init__(self, skin: OneSkin, shape: BodyShape, size_px: int, views: int) -> None:
        self._skin, self._poser, self._size = skin, Poser(shape, skin.weights), size_px
        self._rows, self._cage = cage(skin)
        self.texel, corners, shares = _texels(skin, size_px)
        ahead = self._poser.frames(np.zeros(len(shape.skeleton.dofs)))[0][0][:, 2]
        self._texels = Texels(skin=skin, corners=corners, shares=shares, ahead=ahead)
        n = len(self.texel)
        self._kept = int(np.clip(KEPT * (LARGE_PX / size_px) ** 2, LEAST_KEPT, KEPT))
        self._weight = np.zeros((n, self._kept), dtype=np.float32)  # in any order, 0 where nothing is kept yet
        self._colour = np.zeros((n, self._kept), dtype=np.uint32)  # see `_packed`
        self._slot = np.zeros(n, dtype=np.int64)  # where a further colour is put: the first free place, or that of the smallest weight …
        self._full = np.zeros(n, dtype=bool)  # … if none is free
        self._least = np.zeros(n, dtype=np.float32)  # weight that a further colour must exceed
        sigma = skin.sigma_m if skin.sigma_m is not None else np.zeros(len(skin.vertices_m))
        self._trust = (1 / (1 + (self._texels.at(sigma) / SIGMA_M) ** 2)).astype(np.float32)
        self._ratios: dict[tuple[int, int], list[np.ndarray]] = {(a, b): [] for b in range(views) for a in range(b)}
        self._views = views

    def add(self, motion: np.ndarray, views: list[View]) -> None:
        """The images of all views in one frame, in which the body has the pose `motion` (D,)."""
        posed = self._poser.posed(self._skin.vertices_m, motion)
        normals = vertex_normals(posed, self._skin.faces)
        nearest = [nearest_depth(view.camera, posed[self._rows], self._cage) for view in views]

        pictured = [_pictured(view.camera, posed, normals) for view in views]
        images = [_packed(view.rgb, v) for v, view in enumerate(views)]

        def shown(piece: slice) -> None:
            a, b, c = np.ascontiguousarray(self._texels.corners[piece].T)
            for v, view in enumerate(views):
                facing = pictured[v][:, 3] > LEAST_COSINE
                rows = piece.start + np.flatnonzero(facing[a] | facing[b] | facing[c])
                at = self._texels.at(pictured[v], rows)
                weight = (at[:, 3] * np.float32(view.camera.focal_px) / at[:, 2]) ** 2 * self._trust[rows]  # (1)
                better = np.flatnonzero(_facing(at) & (weight > self._least[rows]))
                free = better[_unhidden(view.camera, at[better], nearest[v])]
                self._keep(rows[free], sampled(images[v], at[free, :2]).view(np.uint32)[:, 0], weight[free])

        in_threads(shown, equal_pieces(len(self.texel), TOGETHER, TOGETHER))
        on_cage = [_grey(view, at[self._rows], depth) for view, at, depth in zip(views, pictured, nearest)]
        for (a, b), found in self._ratios.items():
            both = (on_cage[a] > DARKEST) & (on_cage[b] > DARKEST)
            found.append(np.log(on_cage[a][both] / on_cage[b][both]))

    def finished(self, monitor: Monitor | None = None) -> Texture:
        """The texture of what was added.

        Raises:
            Cancelled: the monitor was cancelled.
        """
        monitor = monitor or Monitor()
        gain = self._exposures()
        seen = self._full | (self._slot > 0)
        placed = seen & (self._trust > LEAST_TRUST)
        seen = placed if placed.any() else seen
        colour = np.zeros((len(self.texel), 3))
        colour[seen] = self._averaged(np.flatnonzero(seen), gain)
        monitor.check()
        inside = np.clip(self._from_unseen(seen) / RIM_PX - 1, 0, 1)
        colour = inside[:, None] * colour + (1 - inside)[:, None] * filled(self._texels, colour, inside == 1, monitor)
        side = (self._size, self._size)
        rgb, mask, covered = np.zeros((*side, 3)), np.zeros(side, dtype=bool), np.zeros(side, dtype=bool)
        rgb.reshape(-1, 3)[self.texel] = colour
        mask.ravel()[self.texel], covered.ravel()[self.texel] = seen, True
        return Texture(rgb=_padded(np.clip(np.rint(rgb), 0, 255).astype(np.uint8), covered), seen=mask, covered=covered, exposures=gain)

    def _keep(self, rows: np.ndarray, colour: np.ndarray, weight: np.ndarray) -> None:
        """Add packed colours where fewer than `KEPT` are kept, and put them in place of the ones with the smallest weights elsewhere."""
        slot = self._slot[rows]
        at = rows * self._kept + slot
        self._weight.ravel()[at], self._colour.ravel()[at] = weight, colour
        self._slot[rows] = slot = slot + 1
        full = np.flatnonzero(self._full[rows] | (slot == self._kept))
        rows = rows[full]
        self._full[rows], kept = True, self._weight[rows]
        self._slot[rows] = smallest = kept.argmin(axis=1)
        self._least[rows] = kept[np.arange(len(rows)), smallest]

    def _exposures(self) -> np.ndarray:
        """(K,) g of (2)."""
        equations, right = [np.ones(self._views)], [0.0]
        for (a, b), found in self._ratios.items():
            ratios = np.concatenate(found) if found else np.zeros(0)
            if len(ratios) >= FEWEST:
                row = np.zeros(self._views)
                row[a], row[b] = 1.0, -1.0
                equations.append(row)
                right.append(float(np.median(ratios)))
        return np.exp(np.linalg.lstsq(np.stack(equations), np.array(right), rcond=None)[0])

    def _from_unseen(self, seen: np.ndarray) -> np.ndarray:
        """Distances (N,) [texels] of texels from the nearest larger region that was not seen."""
        hidden = np.zeros((self._size, self._size), dtype=np.uint8)
        hidden.ravel()[self.texel] = ~seen
        hidden = cv2.morphologyEx(hidden, cv2.MORPH_OPEN, np.ones((LEAST_HOLE_PX, LEAST_HOLE_PX), dtype=np.uint8))
        if not hidden.any():
            return np.where(seen, np.inf, 0.0)
        return np.where(seen, cv2.distanceTransform(1 - hidden, cv2.DIST_L2, 5).ravel()[self.texel], 0.0)

    def _averaged(self, rows: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Colours (N, 3) of texels that were seen."""
        gains = gain.astype(np.float32)

        def average(piece: slice) -> np.ndarray:
            colour, view = _unpacked(self._colour[rows[piece]])
            exposure, own = gains[view], self._weight[rows[piece]]
            channels = [colour[..., c] / exposure for c in range(3)]  # (N, K) each
            robust = weight = own / own.max(axis=1, keepdims=True)
            for _ in range(REWEIGHTINGS):
                away = sum((channel - _mean(channel, robust)[:, None]) ** 2 for channel in channels)
                robust = weight / (1 + away / np.float32(ROBUST_GREY**2))
            return np.stack([_mean(channel, robust) for channel in channels], axis=1)

        return np.concatenate(in_threads(average, equal_pieces(len(rows), TOGETHER, TOGETHER)))


def _mean(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means (N,) of values (N, K) with weights (N, K)."""
    return np.asarray(np.einsum("nk,nk->n", values, weight) / weight.sum(axis=1))


def _packed(rgb: np.ndarray, view: int) -> np.ndarray:
    """The colours (h, w, 3) of an image and the number of its view as four bytes (h, w, 4) uint8: a table of numbers has one column."""
    whole = np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
    return np.dstack([whole, np.full(whole.shape[:2], view, dtype=np.uint8)])


def _unpacked(colour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The colours (N, K, 3) uint8 and views (N, K) of packed ones (N, K)."""
    four = np.ascontiguousarray(colour).view(np.uint8).reshape(*colour.shape, 4)
    return four[..., :3], four[..., 3]


def nearest_depth(camera: Camera, vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Depths (h, w) [m] of the nearest quads (F, 4) of a mesh, infinite where there is none: of each its mean, the farthest drawn first.

    Each quad is larger by `EDGE_PX`.
    """
    width, height = camera.size_px
    z = camera.to_camera(vertices_m)[:, 2]
    with np.errstate(invalid="ignore"):
        xy = camera.project(vertices_m)
    corner = xy[faces]
    a, b = corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1]
    towards = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0) & (z[faces] > 0).all(axis=1) & np.isfinite(corner).all(axis=(1, 2))
    inside = (corner.min(axis=1) < [width, height]).all(axis=1) & (corner.max(axis=1) > 0).all(axis=1)
    drawn = np.flatnonzero(towards & inside)
    far = z[faces[drawn]].mean(axis=1)
    order = np.argsort(-far, kind="stable")
    image = np.full((height, width), np.inf, dtype=np.float32)
    places = np.ascontiguousarray(np.rint(16 * corner[drawn[order]]), dtype=np.int32)
    for place, depth in zip(places, far[order].tolist()):
        cv2.fillConvexPoly(image, place, depth, shift=4)
    return cv2.erode(image, np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), dtype=np.uint8))


def _pictured(camera: Camera, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(N, 4) float32 of places (N, 3): pixel, depth z [m], and cos ϑ of (1); not a number where a place is behind the camera.

    Between the vertices of a skin they are linear, within a hundredth of a pixel.
    """
    ray, z = camera.centre_m - places, camera.to_camera(places)[:, 2]
    cosine = np.einsum("nk,nk->n", ray, normals) / np.maximum(np.sqrt(np.einsum("nk,nk->n", ray, ray)), 1e-9)
    return np.column_stack([camera.project(places), z, cosine]).astype(np.float32)


def _facing(at: np.ndarray) -> np.ndarray:
    """Whether places `_pictured` so (N, 4) are before the camera and face it."""
    return np.asarray((at[:, 3] > LEAST_COSINE) & (at[:, 2] > 0))


def _unhidden(camera: Camera, at: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The rows (M,) of places `_pictured` so (N, 4) that lie inside the image with nothing of the nearest `depth` (h, w) before them."""
    rows = np.flatnonzero(camera.sees(at[:, :2], EDGE_PX + 1))
    pixel, z, cosine = np.rint(at[rows, :2]).astype(np.int64), at[rows, 2], at[rows, 3]
    beside = (EDGE_PX + 1) * z / camera.focal_px * np.sqrt(1 / cosine**2 - 1)  # how much nearer the same surface is at the margin's end
    return rows[z < depth[pixel[:, 1], pixel[:, 0]] + NEARER_M + beside]


def _grey(view: View, at: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The grey values (N,) of places `_pictured` so (N, 4), NaN where a view does not show them."""
    grey, rows = np.full(len(at), np.nan), np.flatnonzero(_facing(at))
    rows = rows[_unhidden(view.camera, at[rows], depth)]
    grey[rows] = sampled(view.rgb, at[rows, :2]).mean(axis=1)
    return grey


def sampled(picture: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """The colours (N, C) of a picture (h, w, C) at its pixels (N, 2), of the same type."""
    at = np.ascontiguousarray(xy, dtype=np.float32)
    found = [
        cv2.remap(picture, part[:, None, 0], part[:, None, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        for part in (at[i : i + 30000] for i in range(0, len(at), 30000))  # of at most 32767 rows
    ]
    return np.concatenate(found) if found else np.zeros((0, picture.shape[2]), dtype=picture.dtype)


def halves(quads: np.ndarray) -> np.ndarray:
    """What quads (F, 4, …) have at their corners as that of their triangles (2 F, 3, …)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def pixels_of(uv: np.ndarray, size_px: int) -> np.ndarray:
    """The pixels (…, 2) of a square picture at texture coordinates (…, 2), v upwards; pixel centres are at whole numbers."""
    return np.asarray(uv * [size_px, -size_px] + [-0.5, size_px - 0.5])


def _texels(skin: OneSkin, size_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The texels (N,) that the skin covers, row · S + column, the vertices (N, 3) around each, and their weights (N, 3)."""
    triangles, xy = halves(skin.faces), pixels_of(halves(skin.uv), size_px)
    owner = np.full((size_px, size_px), -1, dtype=np.int32)
    for t, place in enumerate(np.ascontiguousarray(np.rint(16 * xy), dtype=np.int32)):
        cv2.fillConvexPoly(owner, place, t, shift=4)
    texel = np.flatnonzero(owner.ravel() >= 0)
    triangle = owner.ravel()[texel]
    at = np.stack([texel % size_px, texel // size_px], axis=1) - xy[triangle, 0]
    e1, e2 = xy[triangle, 1] - xy[triangle, 0], xy[triangle, 2] - xy[triangle, 0]
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    area = np.where(np.abs(area) < 1e-9, np.inf, area)
    s = (at[:, 0] * e2[:, 1] - at[:, 1] * e2[:, 0]) / area
    t = (e1[:, 0] * at[:, 1] - e1[:, 1] * at[:, 0]) / area
    shares = np.clip(np.stack([1 - s - t, s, t], axis=1), 0, None)
    return texel, triangles.astype(np.int32)[triangle], (shares / shares.sum(axis=1, keepdims=True)).astype(np.float32)


def _padded(rgb: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """The picture with the islands continued outwards, so that filters of renderers do not mix in what lies between them."""
    found, there = rgb.copy(), covered.astype(np.uint8)
    for _ in range(PADDING_PX):
        count = cv2.boxFilter(there.astype(np.float32), -1, (3, 3), normalize=False)
        total = cv2.boxFilter(found.astype(np.float32) * there[..., None], -1, (3, 3), normalize=False)
        new = (there == 0) & (count > 0)
        found[new] = np.rint(total[new] / count[new][:, None]).astype(np.uint8)
        there[new] = 1
    return found


def write_texture(folder: Path, texture: Texture) -> None:
    """Write texture.png, and texture_mask.png: white where the texture is from footage.

    Raises:
        InputError: a file cannot be written.
    """
    for name, picture in ((TEXTURE, texture.rgb[:, :, ::-1]), (MASK, 255 * texture.seen.astype(np.uint8))):
        store.write_bytes(folder / name, cv2.imencode(".png", picture)[1].tobytes())
