"""The person, not the wall: in which depths to measure, and which planes of the room to leave out.

The depth range comes from what the user clicked in that frame; without clicks, or where they are of another frame, from the nearest
surface that carries many seeds, of those that moved if these are enough; later from the frame before. Where the user gave masks or images
of the empty background, only what lies inside these silhouettes is measured. Floor and walls are planes of seeds
that do not change over time and have nothing behind them; they are found once per take, and points on them are not measured. Which of
these was used is said in `method`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..images.interlace import RowGrid

REACH_M = 0.55  # a body's extent in depth beyond clicked joints
SPEED_M_S = 2.0  # of someone who walks, in depth
MARGIN_M = 0.30  # what a person may move in depth between frames, and a limb beyond the cloud of the frame before
CLUSTER_WIDTH, CLUSTER_SHARE = 0.12, 0.3  # of log depth; of the seeds in the richest cluster
PLANE_TOLERANCE_M, PLANE_SHARE, PLANE_MIN, BEHIND_SHARE = 0.015, 0.3, 20, 0.03
PLANE_TRIALS, MAX_PLANES = 400, 3
STATIC_NOISE = 2.0
PLANE_SIGMAS = 3.0
PLANE_EXTENT_M = 1.2  # longer than the flat front of a person who stands still


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Silhouette:
    """Where one view shows the person: a mask (h', w) over the rows of its image."""

    camera: Camera
    rows: RowGrid
    mask: np.ndarray

    def misses(self, xyz_m: np.ndarray) -> np.ndarray:
        """(N,) points (N, 3) that this view would show beside the person; those out of its sight may be there."""
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
        """(N,) points (N, 3) that lie on one of the planes as far as their covariances (N, 3, 3) can tell, or behind it, or beside a
        silhouette."""
        beside = np.zeros(len(xyz_m), dtype=bool)
        for silhouette in self.silhouettes:
            beside |= silhouette.misses(xyz_m)
        if not len(self.planes):
            return beside
        n = self.planes[:, :3]
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.einsum("pi,nij,pj->np", n, covariance_m2, n))
            tolerance = PLANE_TOLERANCE_M + np.minimum(PLANE_SIGMAS * sigma, PLANE_TOLERANCE_M)
            return np.asarray(beside | (xyz_m @ n.T - self.planes[:, 3] < tolerance).any(axis=1))


def around_clicks(depth_m: np.ndarray) -> Foreground:
    """The depths of a body some of whose joints or surface points were clicked."""
    return Foreground(depth_range_m=(max(0.05, float(depth_m.min()) - REACH_M), float(depth_m.max()) + REACH_M), method="clicks")


def since_clicks(depth_m: np.ndarray, seconds: float, person_m: np.ndarray) -> Foreground:
    """The depths `seconds` before or after joints were clicked: of what is nearest among the seeds' depths `person_m` (N,) that a body
    can have reached since; where there is none, all that it can have reached."""
    near, far = around_clicks(depth_m).depth_range_m
    near, far = max(0.05, near - SPEED_M_S * seconds), far + SPEED_M_S * seconds
    reached = person_m[(person_m >= near) & (person_m <= far)]
    if not len(reached):
        return Foreground(depth_range_m=(near, far), method="clicks")
    found = nearest_surface(reached)
    return Foreground(
        depth_range_m=(max(near, found.depth_range_m[0]), min(far, found.depth_range_m[1])), method="clicks and nearest surface"
    )


def nearest_surface(depth_m: np.ndarray) -> Foreground:
    """The nearest cluster of seeds' depths that holds at least CLUSTER_SHARE of the richest cluster's seeds."""
    position = np.log(np.sort(depth_m))
    density = (np.abs(position[:, None] - position[None, :]) < CLUSTER_WIDTH).sum(axis=1)
    nearest = position[np.argmax(density >= CLUSTER_SHARE * density.max())]
    members = depth_m[(np.log(depth_m) > nearest - CLUSTER_WIDTH) & (np.log(depth_m) < nearest + 2 * CLUSTER_WIDTH)]
    return Foreground(
        depth_range_m=(float(members.min()) * (1 - CLUSTER_WIDTH), float(members.max()) * (1 + CLUSTER_WIDTH)), method="nearest surface"
    )


def after(cloud_depth_m: np.ndarray, before: Foreground) -> Foreground:
    """The depths in the next frame, from the cloud of this one; a frame without points changes nothing."""
    if len(cloud_depth_m) < 20:
        return before
    low, high = np.percentile(cloud_depth_m, [1, 99])
    width = max(before.depth_range_m[1] - before.depth_range_m[0], 2 * MARGIN_M)
    near = max(0.05, float(low) - MARGIN_M)
    return Foreground(depth_range_m=(near, min(float(high) + MARGIN_M, near + width)), method="frame before", planes=before.planes)


def background_planes(static_xyz_m: np.ndarray, all_xyz_m: np.ndarray, cameras_m: Sequence[np.ndarray]) -> np.ndarray:
    """Planes (P, 4) of floor and walls among seeds (N, 3) that do not change over time.

    A plane must hold PLANE_SHARE of the static seeds that are left, be longer than a body's flat parts, and have almost none of all seeds
    behind it. The trials are seeded.
    """
    planes: list[np.ndarray] = []
    rest = static_xyz_m
    random = np.random.default_rng(1999)
    eye = np.mean(np.stack(list(cameras_m)), axis=0)
    while len(rest) >= PLANE_MIN and len(planes) < MAX_PLANES:
        plane = _best_plane(rest, eye, random)
        distance = rest @ plane[:3] - plane[3]
        inlier = np.abs(distance) < PLANE_TOLERANCE_M
        behind = float(np.mean(all_xyz_m @ plane[:3] - plane[3] < -4 * PLANE_TOLERANCE_M))
        if inlier.sum() < max(PLANE_MIN, PLANE_SHARE * len(rest)) or behind > BEHIND_SHARE or _extent(rest[inlier]) < PLANE_EXTENT_M:
            break
        planes.append(plane)
        all_xyz_m = all_xyz_m[all_xyz_m @ plane[:3] - plane[3] > -4 * PLANE_TOLERANCE_M]
        rest = rest[distance > 2 * PLANE_TOLERANCE_M]
    return np.array(planes).reshape(-1, 4)


def _extent(points: np.ndarray) -> float:
    """Length of a group of points along its longest axis, without its outermost twentieths."""
    along = (points - points.mean(axis=0)) @ np.linalg.svd(points - points.mean(axis=0))[2][0]
    return float(np.diff(np.percentile(along, [5, 95]))[0])


def _best_plane(points: np.ndarray, eye: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The plane through three points that holds most points, refitted to them."""
    triples = points[random.integers(0, len(points), (PLANE_TRIALS, 3))]
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal, triples = normal[length > 1e-6] / length[length > 1e-6, None], triples[length > 1e-6]
    if not len(normal):
        return np.array([0.0, 0.0, 1.0, -np.inf])
    distance = np.abs(points @ normal.T - np.einsum("ni,ni->n", normal, triples[:, 0]))
    inlier = distance[:, (distance < PLANE_TOLERANCE_M).sum(axis=0).argmax()] < PLANE_TOLERANCE_M
    centre = points[inlier].mean(axis=0)
    n = np.linalg.svd(points[inlier] - centre)[2][2]
    n = n if n @ (eye - centre) > 0 else -n
    return np.array([*n, n @ centre])


def unchanged(grey: np.ndarray, later: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(N,) points (N, 2) of the reference image whose surroundings have the same grey values in a frame far away in time.

    The images may differ in brightness as a whole; what counts is the difference beside the images' usual difference, which is noise.
    """
    difference = np.abs((grey - np.median(grey)) - (later - np.median(later)))
    noise = max(1.0, float(np.median(difference)))
    blurred = cv2.blur(difference, (9, 9))
    pixel = np.rint(xy).astype(int)
    return blurred[pixel[:, 1], pixel[:, 0]] < STATIC_NOISE * noise
