"""The results of a run, read back for inspection: matched points with their patches, trajectories with their status, outlines.

Nothing but projections is computed here. Patches and residuals are stored only in the checkpoints, and are missing once these are deleted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..geometry.camera import Camera
from ..geometry.raster import rasterize
from ..images.interlace import RowGrid
from ..matching.patches import patch_offsets
from ..matching.seeds import approximations_at_depth
from ..motion.formats.ply import read_ply
from ..report.patch_picture import MOST_VIEWS, MatchedPatch
from ..take.footage import Footage
from ..tracking.settings import TrackStatus

SAME_M = 2e-6  # largest difference between a point's coordinates in the checkpoint and in the PLY file, of single precision
EXAMPLES, MUCH = 200, 0.9  # points among which one is chosen, and the quantile of what matching changed: those beyond lie at outlines
CHECKPOINT = {  # of a frame's surface: the arrays shown
    "cloud_xyz_m": ("f", "N3"), "grid": ("iu", "4"), "field_xy": ("f", "NK2"), "field_shape": ("f", "NK22"), "field_cell": ("iu", "N"),
    "field_residual_px": ("f", "N"), "field_correlation": ("f", "N"),
}  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FramePoints:
    """The N points of a frame's cloud in K views. Full-frame pixels."""

    xyz_m: np.ndarray  # (N, 3)
    sigma_m: np.ndarray  # (N,)
    xy_px: np.ndarray  # (N, K, 2) as matched; without checkpoint their projections
    middle_px: np.ndarray  # (N, K, 2) of the patches; NaN without checkpoint
    shape: np.ndarray  # (N, K, 2, 2) of the patches, in the measured images' pixels; NaN without checkpoint
    residual_px: np.ndarray  # (N,) NaN without checkpoint
    correlation: np.ndarray  # (N,) NaN without checkpoint
    reduction: np.ndarray  # (K, 2) pixels for one of the measured images; 1 without checkpoint


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackHistory:
    """All trajectories before filters and corrections."""

    frames: np.ndarray  # (T,)
    xyz_m: np.ndarray  # (T, N, 3) NaN where not visible
    status: np.ndarray  # (T, N) TrackStatus; MEASURED where it passed

    @property
    def kept(self) -> np.ndarray:
        """(T, N) positions that neither the filters nor the user removed."""
        return (self.status == TrackStatus.MEASURED) & np.isfinite(self.xyz_m[..., 0])

    @property
    def removed(self) -> np.ndarray:
        """(T, N) positions that the filters or the user removed."""
        return (self.status != TrackStatus.MEASURED) & np.isfinite(self.xyz_m[..., 0])

    def tails(self, camera: Camera, frame: int, length: int, which: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The last `length` frames in a camera: segments (M, 2, 2) between neighbouring frames, their trajectories (M,), and their relative
        ages, 0…1 (M,). Only segments whose newer end is selected by `which` (T, N)."""
        now = int(np.searchsorted(self.frames, frame))
        if now >= len(self.frames) or self.frames[now] != frame:
            return np.zeros((0, 2, 2)), np.zeros(0, dtype=np.int64), np.zeros(0)
        first = max(0, now - length)
        xy = camera.project(self.xyz_m[first : now + 1])
        there = np.isfinite(xy[..., 0])
        near = np.diff(self.frames[first : now + 1]) == 1
        t, n = np.nonzero(there[1:] & there[:-1] & which[first + 1 : now + 1] & near[:, None])
        return np.stack([xy[t, n], xy[t + 1, n]], axis=1), n, 1 - (t + 1) / max(now - first, 1)

    def at(self, camera: Camera, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (N, 2) in a frame, NaN where not visible, and the TrackStatus (N,) there."""
        now = np.flatnonzero(self.frames == frame)
        if not len(now):
            return np.full((self.status.shape[1], 2), np.nan), np.zeros(self.status.shape[1], dtype=np.int8)
        return camera.project(self.xyz_m[now[0]]), self.status[now[0]]


def read_points(out: Path, frame: int, cameras: Sequence[Camera], rows: RowGrid) -> FramePoints | None:
    """The points of a frame; None where it has no cloud.

    Raises:
        InputError: the cloud is damaged.
    """
    path = Path(out) / "clouds" / f"{frame:04d}.ply"
    if not path.is_file():
        return None
    ply = read_ply(path)
    xyz, sigma = ply.xyz_m, ply.vertex.get("sigma", np.zeros(len(ply.xyz_m))).astype(np.float64)
    n, k = len(xyz), len(cameras)
    values = dict(
        xy_px=np.stack([camera.project(xyz) for camera in cameras], axis=1).reshape(n, k, 2), middle_px=np.full((n, k, 2), np.nan),
        shape=np.full((n, k, 2, 2), np.nan), residual_px=np.full(n, np.nan), correlation=np.full(n, np.nan), reduction=np.ones((k, 2)),
    )  # fmt: skip
    _add_matches(values, Path(out) / "cache" / "surface" / f"{frame:04d}.npz", xyz, rows)
    return FramePoints(xyz_m=xyz, sigma_m=sigma, **values)


def read_removed(out: Path, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The pixels (M, K, 2) of points that the surface's filters removed from a frame, and the filter (M,), 1 for the first of `FILTERS`.

    Empty where the checkpoint is deleted, damaged or of another version.
    """
    try:
        path = Path(out) / "cache" / "surface" / f"{frame:04d}.npz"
        saved, _ = store.load(path)
        store.check_layout(path, saved, removed_px=("f", "MK2"), removed_why=("u", "M"))
    except InputError:
        return np.zeros((0, 0, 2)), np.zeros(0, dtype=np.uint8)
    return saved["removed_px"].astype(np.float64), saved["removed_why"]


def _add_matches(values: dict[str, np.ndarray], path: Path, xyz: np.ndarray, rows: RowGrid) -> None:
    """Add the checkpoint's values of the same points; the user's corrections may have removed some of them from the cloud."""
    try:
        saved, _ = store.load(path)
        store.check_layout(path, saved, **CHECKPOINT)
        found = saved["cloud_xyz_m"].astype(np.float32)
        order = np.lexsort(found.T[::-1])
        mine = np.searchsorted(_key(found[order]), _key(xyz.astype(np.float32)))
        row = order[np.minimum(mine, len(order) - 1)] if len(order) else np.zeros(len(xyz), dtype=np.int64)
        spacing, _, width, _ = (int(v) for v in saved["grid"])
    except InputError:  # deleted, damaged or of another version: the cloud alone is shown
        return
    reduction = saved.get("reduction", values["reduction"])  # earlier versions measured images of their full size only
    if not len(order) or saved["field_xy"].shape[1] != len(values["reduction"]) or min(spacing, width) < 1:
        return
    if reduction.shape != values["reduction"].shape or not (np.isfinite(reduction) & (reduction > 0)).all():
        return
    known = np.flatnonzero(np.abs(found[row] - xyz).max(axis=1) < SAME_M)
    row = row[known]
    xy, shape, cell = saved["field_xy"][row], saved["field_shape"][row].astype(np.float64), saved["field_cell"][row]
    step = np.array([spacing, max(1, round(spacing / rows.step))])
    reference = int(np.abs(shape - np.eye(2)).max(axis=(0, 2, 3)).argmin()) if len(row) else 0
    offset = xy[:, reference] - np.stack([cell % width, cell // width], axis=1) * step
    middle = xy - np.einsum("nkij,nj->nki", shape, offset)
    values["xy_px"][known], values["middle_px"][known] = ((rows.to_frame(at) + 0.5) * reduction - 0.5 for at in (xy, middle))
    values["shape"][known], values["reduction"] = shape, reduction
    values["residual_px"][known] = saved["field_residual_px"][row] * reduction.mean()
    values["correlation"][known] = saved["field_correlation"][row]


def _key(xyz: np.ndarray) -> np.ndarray:
    """Rows (N, 3) float32 as one sortable value each."""
    return np.ascontiguousarray(xyz).view([("x", "f4"), ("y", "f4"), ("z", "f4")]).reshape(-1)


def patch_boxes(
    points: FramePoints, row: int, cameras: Sequence[Camera], reference: int, rows: RowGrid, patch_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """A point's patch in every view (K, 4, 2): at the start of matching, with a surface that faces the reference camera; and as matched.

    NaN without checkpoint.
    """
    _, _, (half_w, half_h) = patch_offsets(patch_px, rows.step)
    corners = np.array([[-half_w, -half_h], [half_w, -half_h], [half_w, half_h], [-half_w, half_h]]) * 1.0
    middle = rows.from_frame(points.middle_px[row])
    found = middle[:, None] + np.einsum("kij,cj->kci", points.shape[row], corners) * points.reduction[:, None]
    depth = cameras[reference].to_camera(points.xyz_m[row])[2]
    start = approximations_at_depth(cameras, reference, rows, middle[None, reference], np.array([depth]))
    begun = start.xy[0][:, None] + np.einsum("kij,cj->kci", start.shape[0], corners * points.reduction[reference])
    return rows.to_frame(begun), rows.to_frame(found)


def example_of_matching(out: Path, frame: int, footage: Footage, patch_px: int) -> MatchedPatch | None:
    """Of the points of a frame that are known best, one whose patch matching changed by much, in the reference view and two others.

    None without checkpoint.
    """
    cameras, reference, rows = footage.rig.cameras, footage.take.reference, footage.take.rows_at(frame)
    points = read_points(out, frame, cameras, rows)
    if points is None or not len(points.xyz_m):
        return None
    known = np.flatnonzero(np.isfinite(points.middle_px[:, reference, 0]) & (points.sigma_m <= np.median(points.sigma_m)))
    found = list[tuple[float, MatchedPatch]]()
    for row in known[:: max(1, len(known) // EXAMPLES)].tolist():
        start_px, found_px = patch_boxes(points, row, cameras, reference, rows, patch_px)
        others = [k for k in range(len(cameras)) if k != reference and np.isfinite([start_px[k], found_px[k]]).all()]
        views = [reference, *others[: MOST_VIEWS - 1]]
        if others:
            change = min(float(np.linalg.norm(found_px[k] - start_px[k], axis=1).max()) for k in views[1:])
            px_per_m = np.array([cameras[k].focal_px / cameras[k].to_camera(points.xyz_m[row])[2] for k in views])
            boxes = {"start_px": start_px[views], "found_px": found_px[views]}
            found.append((change, MatchedPatch(frame=frame, views=tuple(views), px_per_m=px_per_m, **boxes)))
    found.sort(key=lambda entry: entry[0])
    return found[int(MUCH * (len(found) - 1))][1] if found else None


def read_tracks(out: Path) -> TrackHistory | None:
    """All trajectories of a run; None if there are none.

    Raises:
        InputError: the file is damaged.
    """
    path = Path(out) / "trajectories_raw.npz"
    if not path.is_file():
        return None
    arrays, _ = store.load(path)
    store.check_layout(path, arrays, frames=("iu", "T"), xyz_m=("f", "TN3"), status=("iu", "TN"))
    if not np.isin(arrays["status"], list(TrackStatus)).all() or (np.diff(arrays["frames"].astype(np.int64)) < 1).any():
        raise InputError(f"{path} is damaged (invalid frames or states); run the tracking again.")
    return TrackHistory(frames=arrays["frames"], xyz_m=arrays["xyz_m"].astype(np.float64), status=arrays["status"])


def body_outline(out: Path, frame: int, camera: Camera) -> list[np.ndarray]:
    """The outline of the fitted body's skin in a camera: closed polylines (M, 2); none if there is no skin.

    Raises:
        InputError: the skin's file is damaged.
    """
    path = Path(out) / "skin" / f"{frame:04d}.ply"
    if not path.is_file():
        return []
    skin = read_ply(path)
    raster = rasterize(camera, skin.xyz_m, skin.triangles, back_faces=True)
    mask = np.zeros(raster.shape, dtype=np.uint8)
    mask.reshape(-1)[raster.sample] = 1
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [_smoothed(c[:, 0].astype(np.float64)) for c in contours if len(c) > 8]


def _smoothed(loop: np.ndarray) -> np.ndarray:
    """A closed chain of pixels (M, 2), smoothed."""
    weights = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    return sum(w * np.roll(loop, k, axis=0) for k, w in zip(range(-2, 3), weights))  # type: ignore[return-value]
