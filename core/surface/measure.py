"""Surface measurement of a whole take, each frame from its own start (`starts`).

Every frame leaves a checkpoint whose key covers the images, the rig, the settings and the starts before, so that a killed run resumes where
it stopped and gives the same numbers, whoever measures the frames and in whichever order.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..matching import foreground as fg
from ..matching.constraints import constrain
from ..matching.extension import extend
from ..matching.occlusion_check import fails_occlusion_check
from ..matching.region_growing import OF_FIELD, MatchedField, grow_regions, matched_seeds
from ..matching.seeds import Approximations
from ..matching.views import TemplateGrid
from ..matching.voronoi_scan import voronoi_scan
from ..results.folder import Results
from ..take.footage import Footage
from .cloud import OCCLUDED, PointCloud, point_cloud, why_removed
from .starts import FrameStart, FrameStarts, FrameViews, MeasureSettings, frame_views, read_start

OF_CLOUDS_FIELD = ("xy_px", "residual_px", "extended")  # of a cloud, which a checkpoint stores with its field
FIELD_SINGLE = ("shape", "covariance", "correlation", "covariance_m2", "residual_px", "sigma0")  # stored in single precision


FEW = 300  # points of the first frame; with fewer, whose rays miss each other, a third view may refuse what two would match
NOISE_PX = 1.0  # sigma of the Gaussian that takes noise away
CLEARLY_MORE, FEWEST_MORE = 1.25, 5  # seeds that match in smoothed images: as many times, and by at least so many
MISFIT = 0.5  # of the largest misfit of rays that a point may have


class NothingMeasured(InputError):
    """The first frame of a take gave no surface, or no more than `points`. `why` is the cause that a check of the footage found, if it
    did."""

    def __init__(self, frame: int, why: str = "", points: int = 0) -> None:
        self.frame, self.why, self.points = frame, why, points
        guess = "no matches were found in all views. Check that rig.toml belongs to this footage and that the views are not swapped, "
        super().__init__(f"No surface could be measured in frame {frame}: {why or guess + 'or click surface seeds.'}")

    def __reduce__(self) -> tuple[type, tuple[int, str, int]]:
        return type(self), (self.frame, self.why, self.points)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MeasuredFrame:
    """The surface of one frame: the matched field, which tracking needs, and the cloud."""

    frame: int
    field: MatchedField
    cloud: PointCloud
    foreground: fg.Foreground
    key: str
    removed_px: np.ndarray  # (M, K, 2) full-frame pixels of the points that the filters removed
    removed_why: np.ndarray  # (M,) see `why_removed`
    smoothed_px: float  # sigma of the Gaussian that took noise away, 0 without one

    @property
    def of_patches(self) -> "MeasuredFrame":
        """The frame without the points that were measured from their neighbours' surface: too weak a texture to be tracked."""
        own = ~self.field.extended
        return self if own.all() else replace(self, field=self.field.select(own), cloud=self.cloud.select(own))


def measure_frames(
    footage: Footage, settings: MeasureSettings, results: Results, monitor: Monitor, first: int | None = None
) -> Iterator[MeasuredFrame]:
    """Measure all frames: from the first one (by default that of the clicks) to the end, then from it to the beginning.

    Raises:
        InputError: the images cannot be read.
        NothingMeasured: nothing of a person can be measured in the first frame; or hardly anything, with rays that miss each other, if
            nobody has said that this frame is the `first`.
    """
    starts = FrameStarts(footage, settings, results, first)
    for done, frame in enumerate(starts.order):
        part = monitor.part("surface", done, len(starts.order))
        part.step("surface", 0, 1)
        start, now = starts.at(frame, part)
        measured = read_checkpoint(footage, results, frame, start.key)
        if measured is None:
            now = now or frame_views(footage, frame, settings, first=not done)
            measured = _measure(now, settings, start, part)
            points = len(measured.cloud.xyz_m)
            if not done and (not points or (first is None and _refused_by_a_view(measured, settings))):
                raise NothingMeasured(frame, points=points)
            _checkpoint(results, measured, footage)
        starts.measured(measured.field, measured.cloud.xyz_m)
        yield measured


def measure_piece(footage: Footage, settings: MeasureSettings, results: Results, keys: Mapping[int, str], monitor: Monitor) -> None:
    """Measure some frames whose starts are known, by frame number with their keys, and leave their checkpoints.

    Raises:
        InputError: the images cannot be read, or a start was deleted.
        Cancelled: the frames measured so far have their checkpoints.
    """
    for done, (frame, key) in enumerate(keys.items()):
        part = monitor.part("surface", done, len(keys))
        part.step("surface", 0, 1)
        start = read_start(results, frame, key)
        if start is None:
            raise InputError(f"The checkpoint of frame {frame} in {results.path('cache', 'starts')} was deleted; run again.")
        if results.load_checkpoint("surface", f"{frame:04d}", key) is None:
            _checkpoint(results, _measure(frame_views(footage, frame, settings, first=False), settings, start, part), footage)
    monitor.step("surface", 1, 1)


def _refused_by_a_view(measured: MeasuredFrame, settings: MeasureSettings) -> bool:
    """Whether a frame has few points, whose rays miss each other nearly as much as they may."""
    few = len(measured.cloud.xyz_m) < FEW
    return few and finite_median(measured.field.residual_px) > MISFIT * settings.growing.max_residual_px


def _measure(now: FrameViews, settings: MeasureSettings, start: FrameStart, monitor: Monitor) -> MeasuredFrame:
    """The surface of a frame from its start."""
    smoothed_px = _smoothing_px(now, start.seeds, settings)
    now = replace(now, views=now.views.smoothed(smoothed_px)) if smoothed_px else now
    views, ref, where = now.views, now.views.reference, replace(start.where, silhouettes=now.silhouettes)
    field = _matched(now, start.seeds, settings, where, monitor)
    why = why_removed(field, views.base, ref, settings.surface)
    removed_xy, removed_why = field.xy[why > 0], why[why > 0]
    field = field.select(why == 0)
    if field.weak_texture:
        field = _single(extend(field, views, settings.matching, foreground=where, monitor=monitor))
        why = why_removed(field, views.base, ref, settings.surface)
        removed_xy, removed_why = np.concatenate([removed_xy, field.xy[why > 0]]), np.concatenate([removed_why, why[why > 0]])
        field = field.select(why == 0)
    occluded = fails_occlusion_check(field, views, settings.matching)
    removed_xy = np.concatenate([removed_xy, field.xy[occluded]])
    removed_why = np.concatenate([removed_why, np.full(np.count_nonzero(occluded), OCCLUDED, dtype=np.uint8)])
    field = field.select(~occluded)
    return MeasuredFrame(
        frame=now.frame,
        field=field,
        cloud=in_full_pixels(point_cloud(field, now.grey[ref], views.base, ref, now.frame, settings.surface), now.footage),
        foreground=start.where,
        key=start.key,
        removed_px=now.footage.to_full(views.rows.to_frame(removed_xy)).astype(np.float32),
        removed_why=removed_why,
        smoothed_px=smoothed_px,
    )


def _smoothing_px(now: FrameViews, seeds: Approximations, settings: MeasureSettings) -> float:
    """The sigma of the Gaussian before the views are matched: 0, unless noise hides the texture and clearly more seeds match with one."""
    if settings.growing.method == "published" or not len(seeds.depth_m):
        return 0.0
    smooth = now.views.smoothed(NOISE_PX)
    usual, smoothed = (matched_seeds(views, now.grid, seeds, settings.matching) for views in (now.views, smooth))
    return NOISE_PX if smoothed > CLEARLY_MORE * usual and smoothed - usual >= FEWEST_MORE else 0.0


def _matched(now: FrameViews, seeds: Approximations, settings: MeasureSettings, where: fg.Foreground, monitor: Monitor) -> MatchedField:
    """The matched field of a frame, under the constraint that was chosen, before the filters."""
    matching, growing = settings.matching, settings.growing
    cover = voronoi_scan if growing.method == "published" else grow_regions
    field = cover(now.views, now.grid, seeds, matching, growing, foreground=where, monitor=monitor)
    return _single(constrain(field, now.views, matching, foreground=where, monitor=monitor, pairs=growing.pairs))


def in_full_pixels(cloud: PointCloud, footage: Footage) -> PointCloud:
    """The cloud with coordinates and residuals in pixels of the files' images, where these were reduced."""
    if not footage.full_size_px:
        return cloud
    return replace(cloud, xy_px=footage.to_full(cloud.xy_px), residual_px=cloud.residual_px * float(footage.reduction.mean()))


def _single(field: MatchedField) -> MatchedField:
    """The field with its covariances in single precision, as a checkpoint stores it: a resumed run continues with the same numbers."""
    return replace(field, **{name: getattr(field, name).astype(np.float32).astype(np.float64) for name in FIELD_SINGLE})


def _checkpoint(results: Results, m: MeasuredFrame, footage: Footage) -> None:
    arrays = {f"field_{f.name}": getattr(m.field, f.name) for f in fields(MatchedField) if f.name not in OF_FIELD}
    arrays = {k: v.astype(np.float32) if k.removeprefix("field_") in FIELD_SINGLE else v for k, v in arrays.items()}
    arrays |= {f"cloud_{f.name}": getattr(m.cloud, f.name) for f in fields(PointCloud) if f.name not in ("frame", *OF_CLOUDS_FIELD)}
    arrays |= {
        "where": np.array(m.foreground.depth_range_m),
        "planes": m.foreground.planes,
        "method": np.array(m.foreground.method),
        "grid": np.array([m.field.grid.spacing_px, *m.field.grid.shape, m.field.tried]),
        "limit_px": np.array(m.field.limit_px),
        "texture": np.array([m.field.rig_sigma_px, m.field.weak_texture]),
        "reduction": footage.reduction,
        "removed_px": m.removed_px,
        "removed_why": m.removed_why,
        "smoothed_px": np.array(m.smoothed_px),
    }
    results.save_checkpoint("surface", f"{m.frame:04d}", m.key, arrays)


def last_cloud(footage: Footage, results: Results, frame: int) -> PointCloud:
    """The cloud of a frame as it was measured last, from whatever input.

    Raises:
        InputError: its checkpoint is missing or damaged.
    """
    path = results.path("cache", "surface", f"{frame:04d}.npz")
    found = read_checkpoint(footage, results, frame, str(store.header_of(path).get("key")))
    if found is None:
        raise InputError(f"The checkpoint {path} is missing or damaged: run the whole fit again.")
    return found.cloud


def read_checkpoint(footage: Footage, results: Results, frame: int, key: str) -> MeasuredFrame | None:
    """A frame that was measured before, from the same input; None where there is none, or it is damaged."""
    arrays = results.load_checkpoint("surface", f"{frame:04d}", key)
    return None if arrays is None else _measured(footage, frame, key, arrays)


def _measured(footage: Footage, frame: int, key: str, a: dict[str, np.ndarray]) -> MeasuredFrame:
    spacing, gh, gw, tried = (int(v) for v in a["grid"])
    rows = footage.take.rows_at(frame)
    values = {
        k.removeprefix("field_"): v.astype(np.float64) if v.dtype == np.float32 else v for k, v in a.items() if k.startswith("field_")
    }
    rig_sigma_px, weak = a.get("texture", np.zeros(2))  # earlier versions did not store this,
    values.setdefault("extended", np.zeros(len(values["cell"]), dtype=bool))  # nor this
    field = MatchedField(
        grid=TemplateGrid(spacing_px=spacing, rows=rows, shape=(gh, gw)),
        tried=tried,
        limit_px=float(a["limit_px"]),
        rig_sigma_px=float(rig_sigma_px),
        weak_texture=bool(weak),
        **values,
    )
    cloud = PointCloud(
        frame=frame,
        xy_px=rows.to_frame(field.xy),
        residual_px=field.residual_px,
        extended=field.extended,
        **{k.removeprefix("cloud_"): v for k, v in a.items() if k.startswith("cloud_")},
    )
    where = fg.Foreground(depth_range_m=(float(a["where"][0]), float(a["where"][1])), method=str(a["method"]), planes=a["planes"])
    why = a.get("removed_why", np.zeros(0, dtype=np.uint8))  # earlier versions did not store it
    removed = a.get("removed_px", np.zeros((0, field.xy.shape[1], 2), dtype=np.float32))
    cloud = in_full_pixels(cloud, footage)
    return MeasuredFrame(
        frame=frame,
        field=field,
        cloud=cloud,
        foreground=where,
        key=key,
        removed_px=removed,
        removed_why=why,
        smoothed_px=float(a["smoothed_px"]),
    )
