"""Where the person is: the range of depths to measure, and the planes of the background to leave out.

The depth range comes from the clicks in that frame; without clicks, or where they are in another frame, from the nearest surface with many
seeds, of those that moved if these are enough; later from the frame before. Where the take has masks or images of the empty background,
only points inside these silhouettes are measured. Floor and walls are planes of seeds that do not change over time and have nothing behind
them; they are found once per take, and points on them are not measured. `method` records which of these was used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..images.interlace import RowGrid

REACH_M = 0.55  # m, a body's extent in depth beyond clicked joints
NEAREST_M = 0.05  # m, smallest depth of all
NEARER = 0.5  # of the smallest depth of the person: no nearer is looked for in the next frame
SPEED_M_S = 2.0  # m/s in depth, of a walking person
MARGIN_M = 0.30  # m that a person may move in depth between frames, and by which a limb may exceed the cloud of the frame before
FURTHEST_LIMB_M = 1.2  # m in front of the middle of a person's depths
CLOUD_PERCENT = (1, 99)  # percentiles of a cloud's depths that are taken as its limits
CUBE_M, CUBES_APART = 0.2, 2  # points belong together whose cubes are at most two apart
FEWEST_IN_GROUP = 6  # points; smaller groups do not show where the person is
MIN_CLOUD = 20  # points of a cloud; fewer do not change the depths
CLUSTER_WIDTH = 0.12  # of log depth
CLUSTER_SHARE = 0.3  # of the seeds in the richest cluster
PLANE_TOLERANCE_M = 0.015  # m
PLANE_SIGMAS = 3.0  # of a point's own sigma across a plane, up to the tolerance once more
NEAR_PLANE_M = 0.10  # m from a plane: seeds so near to it do not show where the person is
PLANE_SHARE = 0.3  # of the static seeds that are left, which a plane must contain
PLANE_MIN = 20  # seeds of a plane
PLANE_EXTENT_M = 1.2  # m; longer than the flat front of a person who stands still
EXTENT_PERCENT = (5, 95)  # percentiles along the longest axis that are taken as a plane's extent
BEHIND_SHARE = 0.03  # of all seeds, which may lie behind a plane
BEHIND_TOLERANCES = 4  # tolerances behind the plane, from which a seed lies behind it
REMOVED_TOLERANCES = 2  # tolerances before the plane, up to which seeds belong to it and do not support another one
PLANE_TRIALS = 400  # triples of seeds
MAX_PLANES = 3
RANDOM_SEED = 1999
STATIC_NOISE = 2.0  # times the images' usual difference, up to which a place is unchanged
STATIC_WINDOW = (9, 9)  # px over which differences are averaged


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Silhouette:
    """Where one view shows the person: a mask (h', w) over the rows of its image."""

    camera: Camera
    rows: RowGrid
    mask: np.ndarray

    def misses(self, xyz_m: np.ndarray) -> np.ndarray:
        """(N,) points (N, 3) whose projection lies outside the person; points outside the image do not count."""
        xy = self.rows.from_frame(self.camera.project(xyz_m))
        h, w = self.mask.shape
        with np.errstate(invalid="ignore"):
            inside = (xy > -0.5).all(axis=1) & (xy < (w - 0.5, h - 0.5)).all(axis=1)
        at = np.rint(np.where(inside[:, None], xy, 0.0)).astype(int)
        return np.asarray(inside & ~self.mask[at[:, 1], at[:, 0]])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Foreground:
    """Where the person may be: depths in the reference camera, planes n·X = d to leave out, n towards the cameras, and silhouettes."""

    depth_range_m: tuple[float, float]
    method: str
    planes: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))  # (P, 4) nx ny nz d
    silhouettes: tuple[Silhouette, ...] = ()  # of this frame

    def excludes(self, xyz_m: np.ndarray, covariance_m2: np.ndarray) -> np.ndarray:
        """(N,) points (N, 3) on one of the planes, within tolerances from their covariances (N, 3, 3), or behind it, or outside a
        silhouette."""
        outside = np.zeros(len(xyz_m), dtype=bool)
        for silhouette in self.silhouettes:
            outside |= silhouette.misses(xyz_m)
        if not len(self.planes):
            return outside
        n = self.planes[:, :3]
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.einsum("pi,nij,pj->np", n, covariance_m2, n))
            tolerance = PLANE_TOLERANCE_M + np.minimum(PLANE_SIGMAS * sigma, PLANE_TOLERANCE_M)
            return np.asarray(outside | (xyz_m @ n.T - self.planes[:, 3] < tolerance).any(axis=1))

    def off_planes(self, xyz_m: np.ndarray) -> np.ndarray:
        """The points (N, 3) that are not so near to a plane that they may lie on it, as inaccurate as seeds are."""
        return xyz_m[(xyz_m @ self.planes[:, :3].T - self.planes[:, 3] > NEAR_PLANE_M).all(axis=1)]


def around_clicks(depth_m: np.ndarray) -> Foreground:
    """The depths of a body some of whose joints or surface points were clicked."""
    return Foreground(depth_range_m=(max(NEAREST_M, float(depth_m.min()) - REACH_M), float(depth_m.max()) + REACH_M), method="clicks")


def since_clicks(depth_m: np.ndarray, seconds: float, person_m: np.ndarray) -> Foreground:
    """The depths `seconds` before or after the frame of the clicks: those of the nearest cluster of the seeds' depths `person_m` (N,)
    that a body can reach in this time; without such seeds, all that it can reach."""
    near, far = around_clicks(depth_m).depth_range_m
    near, far = max(NEAREST_M, near - SPEED_M_S * seconds), far + SPEED_M_S * seconds
    reached = person_m[(person_m >= near) & (person_m <= far)]
    if not len(reached):
        return Foreground(depth_range_m=(near, far), method="clicks")
    found = nearest_surface(reached)
    return Foreground(
        depth_range_m=(max(near, found.depth_range_m[0]), min(far, found.depth_range_m[1])), method="clicks and nearest surface"
    )


def nearest_surface(depth_m: np.ndarray) -> Foreground:
    """The nearest cluster of seeds' depths with at least CLUSTER_SHARE of the richest cluster's seeds."""
    position = np.log(np.sort(depth_m))
    density = _neighbours(position)
    nearest = position[np.argmax(density >= CLUSTER_SHARE * density.max())]
    members = depth_m[(np.log(depth_m) > nearest - CLUSTER_WIDTH) & (np.log(depth_m) < nearest + 2 * CLUSTER_WIDTH)]
    return Foreground(
        depth_range_m=(float(members.min()) * (1 - CLUSTER_WIDTH), float(members.max()) * (1 + CLUSTER_WIDTH)), method="nearest surface"
    )


def after(
    depth_m: np.ndarray, before: Foreground, fewest: int = MIN_CLOUD, *, near_m: np.ndarray | None = None, confirmed: bool = True
) -> Foreground:
    """The depths in the next frame, from those of the person in this one; fewer than `fewest` points change nothing.

    `near_m`: the depths by which the near end is judged, by default all. The far end follows it: it is no further away than at first.
    Where matches are not `confirmed` by a third view, as many seeds may be false as true, everywhere before the person: then the depths
    keep the richest cluster.
    """
    if len(depth_m) < fewest:
        return before
    high = float(np.percentile(depth_m, CLOUD_PERCENT[1]))
    low = float(np.percentile(depth_m if near_m is None else near_m, CLOUD_PERCENT[0]))
    width = max(before.depth_range_m[1] - before.depth_range_m[0], 2 * MARGIN_M)
    near, latest = max(NEAREST_M, NEARER * low, low - MARGIN_M), -np.inf
    if not confirmed:
        middle = float(depth_m[np.argmax(_neighbours(np.log(np.maximum(depth_m, NEAREST_M))))])
        near, latest = max(near, middle - FURTHEST_LIMB_M), middle + 2 * MARGIN_M
    far = min(high + MARGIN_M, max(near + width, latest))
    return Foreground(depth_range_m=(near, far), method="frame before", planes=before.planes)


def without_small_groups(xyz_m: np.ndarray) -> np.ndarray:
    """Points (N, 3) without small groups apart from the others: a place of the background can be matched falsely in every frame."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(xyz_m):
        return xyz_m
    cubes, cube, count = np.unique(np.floor(xyz_m / CUBE_M), axis=0, return_inverse=True, return_counts=True)
    a, b = cKDTree(cubes).query_pairs(CUBES_APART, p=np.inf, output_type="ndarray").T
    group = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(len(cubes), len(cubes))), directed=False)[1]
    large = np.bincount(group, count) >= FEWEST_IN_GROUP
    return xyz_m[large[group][cube.ravel()]] if large.any() else xyz_m


def _neighbours(position: np.ndarray) -> np.ndarray:
    """(N,) of how many log depths (N,) each one's cluster consists."""
    ordered = np.sort(position)
    return np.searchsorted(ordered, position + CLUSTER_WIDTH) - np.searchsorted(ordered, position - CLUSTER_WIDTH)


def background_planes(
    static_xyz_m: np.ndarray, all_xyz_m: np.ndarray, cameras_m: Sequence[np.ndarray], tolerance_m: float = PLANE_TOLERANCE_M
) -> np.ndarray:
    """Planes (P, 4) of floor and walls among seeds (N, 3) that do not change over time.

    A plane must contain PLANE_SHARE of the static seeds that are left, within a tolerance, be longer than a body's flat parts, and have
    hardly any of all seeds behind it. The trials are seeded.
    """
    planes: list[np.ndarray] = []
    rest = static_xyz_m
    random = np.random.default_rng(RANDOM_SEED)
    eye = np.mean(np.stack(list(cameras_m)), axis=0)
    while len(rest) >= PLANE_MIN and len(planes) < MAX_PLANES:
        plane = _best_plane(rest, eye, random, tolerance_m)
        distance = rest @ plane[:3] - plane[3]
        inlier = np.abs(distance) < tolerance_m
        behind = float(np.mean(all_xyz_m @ plane[:3] - plane[3] < -BEHIND_TOLERANCES * tolerance_m))
        if inlier.sum() < max(PLANE_MIN, PLANE_SHARE * len(rest)) or behind > BEHIND_SHARE or _extent(rest[inlier]) < PLANE_EXTENT_M:
            break
        planes.append(plane)
        all_xyz_m = all_xyz_m[all_xyz_m @ plane[:3] - plane[3] > -BEHIND_TOLERANCES * tolerance_m]
        rest = rest[distance > REMOVED_TOLERANCES * tolerance_m]
    return np.array(planes).reshape(-1, 4)


def _extent(points: np.ndarray) -> float:
    """Length of a group of points along its longest axis, without its outermost twentieths."""
    along = (points - points.mean(axis=0)) @ np.linalg.svd(points - points.mean(axis=0))[2][0]
    return float(np.diff(np.percentile(along, EXTENT_PERCENT))[0])


def _best_plane(points: np.ndarray, eye: np.ndarray, random: np.random.Generator, tolerance_m: float) -> np.ndarray:
    """The plane through three points that contains most points, refitted to them."""
    triples = points[random.integers(0, len(points), (PLANE_TRIALS, 3))]
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal, triples = normal[length > 1e-6] / length[length > 1e-6, None], triples[length > 1e-6]
    if not len(normal):
        return np.array([0.0, 0.0, 1.0, -np.inf])
    distance = np.abs(points @ normal.T - np.einsum("ni,ni->n", normal, triples[:, 0]))
    inlier = distance[:, (distance < tolerance_m).sum(axis=0).argmax()] < tolerance_m
    centre = points[inlier].mean(axis=0)
    n = np.linalg.svd(points[inlier] - centre)[2][2]
    n = n if n @ (eye - centre) > 0 else -n
    return np.array([*n, n @ centre])


def unchanged(grey: np.ndarray, later: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(N,) points (N, 2) of the reference image whose surroundings have the same grey values in a frame far away in time.

    The images may differ in brightness as a whole; differences are compared with the images' median difference, which is noise.
    """
    difference = np.abs((grey - np.median(grey)) - (later - np.median(later)))
    noise = max(1.0, float(np.median(difference)))
    blurred = cv2.blur(difference, STATIC_WINDOW)
    pixel = np.rint(xy).astype(int)
    return blurred[pixel[:, 1], pixel[:, 0]] < STATIC_NOISE * noise
