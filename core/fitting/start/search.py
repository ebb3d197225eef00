"""Poses all around in one frame: every known pose in every heading, where the outline and the measured points place it.

A pose is scaled to the height of the person's region in the middle view, centred on it, and moved in depth until the surface that it turns
to the camera has the median depth of the points. What it then explains is `explained.body_gains`; the stature's prior and clicks count as
penalties in the same unit, voxels of the cloud.
"""

from dataclasses import dataclass

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


def scaled_vector(parameters: ShapeParameters, stature: float) -> np.ndarray:
    """The shape vector (S,) of the template, taller by a factor."""
    vector = parameters.vector()
    for group in ("lengths", "radii"):
        vector[parameters.layout.group(group)] += np.log(stature)
    return vector


def hypotheses(fit: FitContext, t: int, evidence: Evidence, known: np.ndarray) -> Hypotheses:
    """The known poses (K, D) in all headings in frame index `t`, in which the person is wholly visible."""
    parameters, skeleton = fit.parameters, fit.model.skeleton
    middle = fit.cameras[len(fit.cameras) // 2]
    region = _region(evidence, middle)
    rest = parameters.state(np.zeros(len(skeleton.dofs)), parameters.vector())
    at_origin = bone_frames(skeleton, rest.lengths_m, known)
    poses, stature = [], []
    for k in range(HEADINGS):
        angle = 2 * np.pi * k / HEADINGS
        turned = known.copy()
        turned[:, skeleton.layout[f"{skeleton.joint_names[0]} rotation"]] += angle
        turned[:, skeleton.layout.group("base")], size = _places(region, *_flesh(rest, at_origin, angle))
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


def is_inside(evidence: Evidence) -> bool:
    """Whether no border of the image cuts the person in the middle view."""
    if not evidence.cells:
        return True
    view = evidence.cells[len(evidence.cells) // 2]
    near, size = BORDER * view.distance.step_px, np.array(view.camera.size_px)
    return bool((view.xy_px.min(axis=0) >= near).all() and (view.xy_px.max(axis=0) <= size - 1 - near).all())


def _region(evidence: Evidence, camera: Camera) -> _Region:
    points = camera.to_camera(evidence.points.xyz_m)
    depth = float(np.median(points[:, 2]))
    views = [view for view in evidence.cells if view.camera.name == camera.name]
    rays = camera.rays(views[0].xy_px) @ camera.R_cam_world.T if views else points
    across, down = (rays[:, :2] / rays[:, 2:] * depth).T
    top, bottom = np.quantile(down, [ENDS, 1 - ENDS])
    half = 0.5 * views[0].distance.step_px * depth / camera.focal_px if views else 0.0
    return _Region(camera=camera, middle_m=float(across.mean()), top_m=float(top) - half, bottom_m=float(bottom) + half, depth_m=depth)


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
