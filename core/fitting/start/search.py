"""Poses all around in one frame: every known pose in every heading, where the outline and the measured points place it.

A pose is scaled to the height of the person's region in the middle view, centred on it, and moved in depth until the surface that it turns
to the camera has the median depth of the points. Where the image cuts the person below, poses of several statures hang from the region's
top, and only what is inside the image counts. What a pose then explains is `explained.body_gains`; the stature's prior and clicks count as
penalties in the same unit, voxels of the cloud.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ...body.skeleton import bone_frames
from ...geometry.camera import Camera
from ...geometry.rotation import axis_rotation
from ..context import FitContext
from ..explained import Evidence, body_gains
from ..observations import ClickedJoints
from ..state import BodyState, ShapeParameters

HEADINGS = 20  # 18° apart: the adjustment converges from half of that
WIDTH_M = 0.06  # of the weights of what a pose explains
COARSER = 2  # times the evidence is thinned
ALONG = np.array([0.1, 0.5, 0.9])  # of a bone, where its flesh is sampled
FACING = 0.7  # of a radius: the mean distance from the axis of the surface that a camera sees
SHORTEST, TALLEST, STATURE_STEP = 0.85, 1.15, 0.05  # over the model's
STATURE_PENALTY = 3000.0  # voxels, by (ln stature)²
ENDS = 0.002  # of the cells: the quantile that is the region's top, and its bottom
CLICK_M, CLICK_PENALTY, MOST_MISSES = 0.12, 60.0, 9.0  # distance from a click that costs so many voxels, and the most such squares
BATCH = 512  # poses at a time: memory
BORDER = 1.5  # cells from the image's border
BORDER_PX, CUT = 16.0, 0.8  # where there are no cells: two patches; and the density of points there over the mean, more than that of feet
STATURES_CUT = (0.9, 1.0, 1.1)  # over the model's, of a person who is cut below
LOWEST_M = 0.4  # what is seen of a person is at least so high


class Framing(Enum):
    """How much of the person the middle view shows."""

    WHOLE = "the whole person"
    UPPER = "the upper part: the image's lower border cuts the person"
    CUT = "a part: another border cuts the person, or it is no person"


@dataclass(frozen=True, eq=False, kw_only=True)
class Hypotheses:
    """N poses of one frame."""

    poses: np.ndarray  # (N, D)
    stature: np.ndarray  # (N,)
    score: np.ndarray  # (N,) voxels

    def best(self, count: int) -> "Hypotheses":
        """The best ones, in that order."""
        order = np.argsort(-self.score, kind="stable")[:count]
        return Hypotheses(poses=self.poses[order], stature=self.stature[order], score=self.score[order])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Region:
    """What one view shows of the person, in metres at the person's depth: across, downwards, and the points' depth."""

    camera: Camera
    middle_m: float
    top_m: float
    bottom_m: float
    depth_m: float
    framing: Framing


def scaled_vector(parameters: ShapeParameters, stature: float) -> np.ndarray:
    """The shape vector (S,) of the template, taller by a factor."""
    vector = parameters.vector()
    for group in ("lengths", "radii"):
        vector[parameters.layout.group(group)] += np.log(stature)
    return vector


def hypotheses(fit: FitContext, t: int, evidence: Evidence, known: np.ndarray) -> Hypotheses:
    """The known poses (K, D) in all headings in frame index `t`, which shows the whole person, or the upper part."""
    parameters, skeleton = fit.parameters, fit.model.skeleton
    middle = fit.cameras[len(fit.cameras) // 2]
    region = _region(evidence, middle)
    rest = parameters.state(np.zeros(len(skeleton.dofs)), parameters.vector())
    at_origin = bone_frames(skeleton, rest.lengths_m, known)
    poses, stature = [], []
    for k in range(HEADINGS):
        angle = 2 * np.pi * k / HEADINGS
        flesh = _flesh(rest, at_origin, angle)
        for base, size in [_places(region, *flesh)] if region.framing is Framing.WHOLE else _hanging(region, *flesh):
            turned = known.copy()
            turned[:, skeleton.layout[f"{skeleton.joint_names[0]} rotation"]] += angle
            turned[:, skeleton.layout.group("base")] = base
            poses.append(turned)
            stature.append(size)
    all_poses, sizes = np.concatenate(poses), np.concatenate(stature)
    for _ in range(COARSER):
        evidence = evidence.thinned()
    score = -STATURE_PENALTY * np.log(sizes) ** 2
    rounded = STATURE_STEP * np.round(sizes / STATURE_STEP)
    for size in np.unique(rounded).tolist():
        rows, vector = np.flatnonzero(rounded == size), scaled_vector(parameters, size)
        for part in np.split(rows, range(BATCH, len(rows), BATCH)):
            fit.monitor.check()
            score[part] += body_gains(evidence, parameters, all_poses[part], vector, WIDTH_M)
    return Hypotheses(poses=all_poses, stature=sizes, score=score - _misses(fit, t, all_poses, sizes))


def framing(evidence: Evidence, camera: Camera) -> Framing:
    """Which borders of an image cut the person: those that the person's cells touch, or where the background is not known, many points."""
    views = [view for view in evidence.cells if view.camera.name == camera.name]
    size, X = np.array(camera.size_px), evidence.points.xyz_m
    if views:
        near, few, xy = BORDER * views[0].distance.step_px, np.zeros(2), views[0].xy_px
    else:
        near, xy = BORDER_PX, camera.project(X)
        few = CUT * len(X) * near / np.maximum(np.ptp(xy, axis=0), near) if len(X) else np.zeros(2)
    if not len(X) or not len(xy) or np.ptp(xy[:, 1]) * float(np.median(camera.to_camera(X)[:, 2])) / camera.focal_px < LOWEST_M:
        return Framing.CUT
    (left, top), (right, below) = (xy < near).sum(axis=0) > few, (xy > size - 1 - near).sum(axis=0) > few
    if left or right or top:
        return Framing.CUT
    return Framing.UPPER if below else Framing.WHOLE


def _region(evidence: Evidence, camera: Camera) -> _Region:
    points = camera.to_camera(evidence.points.xyz_m)
    depth = float(np.median(points[:, 2]))
    views = [view for view in evidence.cells if view.camera.name == camera.name]
    rays = camera.rays(views[0].xy_px) @ camera.R_cam_world.T if views else points
    across, down = (rays[:, :2] / rays[:, 2:] * depth).T
    top, bottom = np.quantile(down, [ENDS, 1 - ENDS])
    half = 0.5 * views[0].distance.step_px * depth / camera.focal_px if views else 0.0
    return _Region(
        camera=camera,
        middle_m=float(across.mean()),
        top_m=float(top) - half,
        bottom_m=float(bottom) + half,
        depth_m=depth,
        framing=framing(evidence, camera),
    )


def _flesh(rest: BodyState, at_origin: tuple[np.ndarray, np.ndarray], angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (N, S, 3) along the bones of poses at the origin that are turned by an angle, the flesh's radius there (S,) and its area."""
    R, head = at_origin
    turn, bones = axis_rotation("z", angle), np.array(sorted(rest.profiles))
    lengths = rest.lengths_m[bones]
    radii = np.array([rest.profiles[b].radii_m[[0, -1]].mean() for b in bones.tolist()])
    X = head[:, bones][:, :, None] + (lengths[:, None] * ALONG)[..., None] * R[:, bones][:, :, None, :, 1]
    return X.reshape(len(head), -1, 3) @ turn.T, np.repeat(radii, len(ALONG)), np.repeat(lengths * radii, len(ALONG))


def _places(region: _Region, X: np.ndarray, radius: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the base (N, 3) of poses with flesh at X (N, S, 3) belongs, and their stature (N,)."""
    across, down, depth = np.moveaxis(X @ region.camera.R_cam_world.T, -1, 0)
    top, bottom = (down - radius).min(axis=1), (down + radius).max(axis=1)
    size = np.clip((region.bottom_m - region.top_m) / (bottom - top), SHORTEST, TALLEST)
    at = np.stack(
        [
            region.middle_m - size * (across * area).sum(axis=1) / area.sum(),
            (region.top_m + region.bottom_m - size * (top + bottom)) / 2,
            region.depth_m - size * np.median(depth - FACING * radius, axis=1),
        ],
        axis=1,
    )
    return region.camera.centre_m + at @ region.camera.R_cam_world, size


def _hanging(region: _Region, X: np.ndarray, radius: np.ndarray, area: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """As `_places`, of a person who is cut below, for one stature after the other."""
    across, down, depth = np.moveaxis(X @ region.camera.R_cam_world.T, -1, 0)
    top = (down - radius).min(axis=1)
    for size in STATURES_CUT:
        seen = size * (down - top[:, None]) < region.bottom_m - region.top_m
        share = np.where(seen, area, 0.0)
        at = np.stack(
            [
                region.middle_m - size * (across * share).sum(axis=1) / share.sum(axis=1),
                region.top_m - size * top,
                region.depth_m - size * np.nanmedian(np.where(seen, depth - FACING * radius, np.nan), axis=1),
            ],
            axis=1,
        )
        yield region.camera.centre_m + at @ region.camera.R_cam_world, np.full(len(X), size)


def _misses(fit: FitContext, t: int, poses: np.ndarray, stature: np.ndarray) -> np.ndarray:
    """The penalty (N,) of poses whose joints miss the clicks of frame index `t`."""
    if t not in fit.clicked:
        return np.zeros(len(poses))
    found, skeleton = fit.clicked[t], fit.model.skeleton
    R, head = bone_frames(skeleton, fit.parameters.template.lengths_m, poses)
    base = poses[:, None, skeleton.layout.group("base")]
    penalty = np.zeros(len(poses))
    for joint in np.unique(found.joint).tolist():
        bone, at_tail = skeleton.joint_bones[joint]
        X = head[:, bone] + (fit.parameters.template.lengths_m[bone] * R[:, bone, :, 1] if at_tail else 0.0)
        X = base[:, 0] + stature[:, None] * (X - base[:, 0])
        penalty += click_penalty(found, joint, X)
    return penalty


def click_penalty(clicks: ClickedJoints, joint: int, X: np.ndarray) -> np.ndarray:
    """The penalty (N,) of places (N, 3) of a joint for the distance from its clicks."""
    rows = np.flatnonzero(clicks.joint == joint)
    total = np.zeros(len(X))
    for row in rows.tolist():
        camera = clicks.cameras[row]
        metres = camera.to_camera(X)[:, 2] / camera.focal_px
        off = np.linalg.norm(camera.project(X) - clicks.xy_px[row], axis=1) * metres / CLICK_M
        total += CLICK_PENALTY * np.minimum(np.nan_to_num(off, nan=MOST_MISSES) ** 2, MOST_MISSES)
    return total
