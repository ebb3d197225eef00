"""Points matched between two views without the rig; their distances from the rig's epipolar lines show whether it belongs to the footage.

SIFT keypoints (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94) with his ratio test, mutual nearest neighbours only. On cloth at 3.6 mm
a pixel, cameras 10° apart, a pair of images gives one to four hundred matches, 95 to 99 % of them correct.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.fundamental import fundamental_matrix
from ..geometry.robust import finite_median
from ..geometry.rotation import cross_matrix
from ..images.interlace import RowGrid

MOST_FEATURES = 3000  # of an image
LONGEST_SIDE_PX = 1600  # larger images are reduced
RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor (Lowe 2004, §7.1)
INLIER_PX = 2.0  # distance from a fundamental matrix
MINIMAL_MATCHES = 7  # that a fundamental matrix always fits
INLIER_SHARE = 0.6  # of the other matches
NEIGHBOURS = 6  # views ahead with which a view is matched: in time linear in the views
FEWEST_MATCHES = 24  # distinct ones, of a pair
DEEPER = 1.01  # factor of a depth, to find in which direction its point moves in another view


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Features:
    """Keypoints of one image: `xy` (N, 2) in the measured rows, and their descriptors (N, 128)."""

    xy: np.ndarray
    descriptors: np.ndarray


def eight_bits(grey: np.ndarray) -> np.ndarray:
    """An image (h, w) as uint8, its range stretched so that dark footage has features, too."""
    low, high = np.percentile(grey, [0.5, 99.5])
    scale = 235.0 / max(float(high - low), 8.0)
    return np.clip((grey - low) * scale + 10, 0, 255).astype(np.uint8)


def find_features(grey: np.ndarray) -> Features:
    """Keypoints of the measured rows (h, w) of an image; a large image is reduced first."""
    step = max(1.0, max(grey.shape) / LONGEST_SIDE_PX)
    reduced = eight_bits(grey)
    if step > 1:
        reduced = cv2.resize(reduced, (round(grey.shape[1] / step), round(grey.shape[0] / step)), interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT_create(nfeatures=MOST_FEATURES).detectAndCompute(reduced, None)
    if not keypoints:
        return Features(xy=np.zeros((0, 2)), descriptors=np.zeros((0, 128), np.float32))
    scale = np.array(grey.shape[::-1]) / np.array(reduced.shape[::-1])
    return Features(xy=(np.array([k.pt for k in keypoints]) + 0.5) * scale - 0.5, descriptors=descriptors)


def match_pair(a: Features, b: Features) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m,) of `a` and (m,) of `b` whose descriptors match unambiguously, in both directions."""
    if len(a.xy) < 2 or len(b.xy) < 2:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forward = matcher.knnMatch(a.descriptors, b.descriptors, 2)
    matched = [(m.queryIdx, m.trainIdx) for m, n in forward if m.distance < RATIO * n.distance]
    pairs = np.array(matched, dtype=int).reshape(-1, 2)
    if len(pairs):
        back = matcher.match(b.descriptors[pairs[:, 1]], a.descriptors)  # one for each, in the same order
        pairs = pairs[[m.trainIdx for m in back] == pairs[:, 0]]
    return pairs[:, 0], pairs[:, 1]


def epipolar_distance_px(a: Camera, b: Camera, xa_px: np.ndarray, xb_px: np.ndarray) -> np.ndarray:
    """Signed distance (m,) [px] of full-frame points (m, 2) of cameras a and b from each other's epipolar lines, the mean of both images.

    With y_b ~ R y_a + t and E = [t]× R:  e = y_bᵀ E y_a / √(½ |E y_a|² / f_b² + ½ |Eᵀ y_b|² / f_a²), the lengths without the third
    component: √2 times Sampson's distance.
    """
    R = b.R_cam_world @ a.R_cam_world.T
    E = cross_matrix(b.t_cam_world_m - R @ a.t_cam_world_m) @ R
    ya, yb = a.directions(xa_px), b.directions(xb_px)
    la, lb = ya @ E.T, yb @ E
    if a.fisheye or b.fisheye:  # on the unit sphere, as f is pixels per radian
        na, nb = np.linalg.norm(ya, axis=1), np.linalg.norm(yb, axis=1)
        la, lb, yb = la / na[:, None], lb / nb[:, None], yb / nb[:, None]
        length = np.sqrt((la**2).sum(axis=1) / b.focal_px**2 + (lb**2).sum(axis=1) / a.focal_px**2) / np.sqrt(2.0)
        return np.asarray((yb * la).sum(axis=1) / np.maximum(length, 1e-30))
    length = np.sqrt((la[:, :2] ** 2).sum(axis=1) / b.focal_px**2 + (lb[:, :2] ** 2).sum(axis=1) / a.focal_px**2) / np.sqrt(2.0)
    return np.asarray((yb * la).sum(axis=1) / np.maximum(length, 1e-30))


def in_front(a: Camera, b: Camera, xa_px: np.ndarray, xb_px: np.ndarray) -> np.ndarray:
    """(m,) whether the rays come closest to each other in front of both cameras."""
    return np.asarray((_depth(a, b, xa_px, xb_px) > 0) & (_depth(b, a, xb_px, xa_px) > 0))


def _depth(a: Camera, b: Camera, xa_px: np.ndarray, xb_px: np.ndarray) -> np.ndarray:
    """(m,) depths in a where its rays come closest to those of b."""
    da, db = a.rays(xa_px), b.rays(xb_px)
    base = b.centre_m - a.centre_m
    aa, bb, ab = (da * da).sum(axis=1), (db * db).sum(axis=1), (da * db).sum(axis=1)
    determinant = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    return np.asarray((bb * (da @ base) - ab * (db @ base)) / determinant)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PairMatches:
    """Matches of views i and j in some frames: full-frame pixels (m, 2) each."""

    i: int
    j: int
    xi_px: np.ndarray
    xj_px: np.ndarray

    def agreeing(self, cameras: Sequence[Camera], limit_px: float) -> np.ndarray:
        """(m,) whether the rays of cameras[i] and cameras[j] pass within `limit_px` of each other, in front of both."""
        a, b = cameras[self.i], cameras[self.j]
        return (np.abs(self.epipolar_distance_px(cameras)) < limit_px) & in_front(a, b, self.xi_px, self.xj_px)

    def epipolar_distance_px(self, cameras: Sequence[Camera]) -> np.ndarray:
        """(m,) signed distances [px] from the epipolar lines."""
        return epipolar_distance_px(cameras[self.i], cameras[self.j], self.xi_px, self.xj_px)

    def inliers(self) -> np.ndarray | None:
        """Rows (n,) of the matches that agree with one fundamental matrix, whatever the rig; None if most do not, or there are too few.

        MAGSAC++ (Barath 2020, doi:10.1109/CVPR42600.2020.00138). A match at rest, which is found in every frame, counts once.
        """
        rows = np.unique(np.rint(np.hstack([self.xi_px, self.xj_px])), axis=0, return_index=True)[1]
        if len(rows) < FEWEST_MATCHES:
            return None
        found = fundamental_matrix(self.xi_px[rows], self.xj_px[rows], INLIER_PX, 0.999, 4000)
        if found is None or found[1].sum() - MINIMAL_MATCHES < INLIER_SHARE * (len(rows) - MINIMAL_MATCHES):
            return None
        return rows[found[1]]

    def consistent(self) -> "PairMatches | None":
        """The `inliers`."""
        rows = self.inliers()
        return None if rows is None else PairMatches(i=self.i, j=self.j, xi_px=self.xi_px[rows], xj_px=self.xj_px[rows])


@dataclass(frozen=True, kw_only=True, slots=True)
class ThirdView:
    """By how much a third view misses the points of two: the median along its epipolar lines, which no pair of views shows."""

    views: tuple[int, int, int]  # the third one last
    points: int
    along_px: float  # signed
    spread_px: float  # median of the deviations from it


def third_views(pairs: Sequence[PairMatches], cameras: Sequence[Camera]) -> list[ThirdView]:
    """Every three views that show enough of the same points: those of a and b, intersected, in c. `pairs` are consistent."""
    of_pair = {(p.i, p.j): (p.xi_px, p.xj_px) for p in pairs} | {(p.j, p.i): (p.xj_px, p.xi_px) for p in pairs}
    found = []
    for (a, b), (xa, xb) in of_pair.items():
        for c in (c for c in range(len(cameras)) if c > b and (a, c) in of_pair):
            row = {tuple(xy): n for n, xy in enumerate(of_pair[a, c][0].tolist())}
            both = [(m, row[tuple(xy)]) for m, xy in enumerate(xa.tolist()) if tuple(xy) in row]
            if len(both) >= FEWEST_MATCHES:
                m, n = np.array(both).T
                off = _along_px(cameras[a], cameras[b], cameras[c], xa[m], xb[m], of_pair[a, c][1][n])
                middle = finite_median(off, 0.0)
                spread = finite_median(np.abs(off - middle), 0.0)
                found.append(ThirdView(views=(a, b, c), points=len(m), along_px=middle, spread_px=spread))
    return found


def _along_px(a: Camera, b: Camera, c: Camera, xa_px: np.ndarray, xb_px: np.ndarray, xc_px: np.ndarray) -> np.ndarray:
    """How far (m,) [px] points of a and b lie from where c shows them, in the direction in which they move there with their depth in a."""
    depth = _depth(a, b, xa_px, xb_px)
    here, deeper = (c.project(a.points_at_depth(xa_px, factor * depth)) for factor in (1.0, DEEPER))
    direction = (deeper - here) / np.linalg.norm(deeper - here, axis=1, keepdims=True)
    return np.asarray(((xc_px - here) * direction).sum(axis=1))


def match_views(images: Sequence[Sequence[np.ndarray]], rows: RowGrid) -> list[PairMatches]:
    """The matches of pairs of views over some frames; `images[t][k]` are the measured rows of view k."""
    return match_features([[find_features(image) for image in frame] for frame in images], rows)


def match_features(features: Sequence[Sequence[Features]], rows: RowGrid) -> list[PairMatches]:
    """The matches of every pair of views that are near each other in the list, over some frames; `features[t][k]` are those of view k."""
    pairs = []
    for i, j in ((i, j) for i, j in combinations(range(len(features[0])), 2) if j - i <= NEIGHBOURS):
        matched = [match_pair(frame[i], frame[j]) for frame in features]
        xi = np.concatenate([frame[i].xy[m] for frame, (m, _) in zip(features, matched)])
        xj = np.concatenate([frame[j].xy[m] for frame, (_, m) in zip(features, matched)])
        pairs.append(PairMatches(i=i, j=j, xi_px=rows.to_frame(xi), xj_px=rows.to_frame(xj)))
    return pairs
