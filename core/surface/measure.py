"""Surface measurement of a whole take: frame after frame from the frame of the clicks, each frame's depths from the one before.

Every frame leaves a checkpoint whose key covers the images, the rig, the settings and the frame before, so that a killed run resumes where
it stopped and gives the same numbers.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.threads import in_threads
from ..images.enhance import EnhanceSettings, enhanced
from ..images.interlace import frame_time_s
from ..images.retime import retimed
from ..images.sampling import SplineImage
from ..images.sequence import IMAGE_ENDINGS
from ..matching import foreground as fg
from ..matching.constraints import constrain
from ..matching.least_squares import MatchingSettings
from ..matching.occlusion_check import fails_occlusion_check
from ..matching.region_growing import GrowingSettings, MatchedField, grow_regions
from ..matching.seeds import Approximations, sweep_seeds
from ..matching.views import TemplateGrid, Views, template_grid
from ..matching.voronoi_scan import voronoi_scan
from ..results.folder import Results
from ..take.clicked_points import clicked_depth, clicked_seeds, seeds_before_joints, settled_seeds
from ..take.footage import Footage, footage_frames
from ..take.person_masks import silhouette_file, silhouette_sources, silhouettes
from .cloud import OCCLUDED, PointCloud, SurfaceSettings, point_cloud, why_removed

ALGORITHM = "surface 20"  # part of every key: raise it when the same input gives other numbers
MIN_MOVED = 20  # seeds; with fewer that moved, the person is searched for among all of them
SEED_SPACING_PX = 24  # without automatic seeds: of those by which the background is found, and of those from the frame before
SEED_SPEED_M_S = 1.0  # sigma of the speed in depth at which seeds come from the frame before
ANY_DEPTH_M = (fg.NEAREST_M, 1e3)
FIELD_SINGLE = ("shape", "covariance", "correlation", "covariance_m2", "residual_px", "sigma0")  # stored in single precision


class NothingMeasured(InputError):
    """The first frame of a take gave no surface. `why` is the cause that a check of the footage found, if it did."""

    def __init__(self, frame: int, why: str = "") -> None:
        self.frame, self.why = frame, why
        guess = "no matches were found in all views. Check that rig.toml belongs to this footage and that the views are not swapped, "
        super().__init__(f"No surface could be measured in frame {frame}: {why or guess + 'or click surface seeds.'}")

    def __reduce__(self) -> tuple[type, tuple[int, str]]:
        return type(self), (self.frame, self.why)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameImages:
    """The rows of one frame that are measured, of all views, ready for matching."""

    grey: list[np.ndarray]
    spline: list[SplineImage]


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


def measured_rows(footage: Footage, frame: int) -> list[np.ndarray]:
    """The rows (h', w) float32 of all views at one frame; views with a time offset are interpolated to the moment of the others.

    The interpolation uses the same rows of the images before and after.

    Raises:
        InputError: see `Footage.read`.
    """
    grid, step = footage.take.rows_at(frame), footage.take.field_layout.per_image

    def neighbour(k: int, at: int) -> np.ndarray | None:
        number, sequence = footage.number(k, at), footage.sequences[k]
        return grid.rows(footage.reduced_image(k, sequence.read(number))) if 0 <= number < sequence.count else None

    rows = [grid.rows(image) for image in footage.read(frame)]
    for k, late in enumerate(footage.delay_images):
        if late:
            rows[k] = retimed(rows[k], neighbour(k, frame - step), neighbour(k, frame + step), late)
    return rows


def load_images(footage: Footage, frame: int, enhance: EnhanceSettings | None = None) -> FrameImages:
    """Read a frame and prepare it. The images for matching may be enhanced, the grey values are those of the files.

    Raises:
        InputError: see `Footage.read`.
    """
    grey = measured_rows(footage, frame)
    matched = enhanced(grey, enhance, row_step=footage.take.rows_at(frame).step) if enhance is not None else grey
    return FrameImages(grey=grey, spline=in_threads(SplineImage, matched))


@dataclass(frozen=True, kw_only=True, slots=True)
class MeasureSettings:
    """All knobs on which the surface of a frame depends."""

    matching: MatchingSettings
    growing: GrowingSettings
    surface: SurfaceSettings
    enhance: EnhanceSettings | None = None

    @staticmethod
    def of(settings: Mapping[str, Any]) -> "MeasureSettings":
        """Those of a run's settings, by the names of their tables."""
        return MeasureSettings(**{f.name: settings[f.name] for f in fields(MeasureSettings)})


def measure_frames(footage: Footage, settings: MeasureSettings, results: Results, monitor: Monitor) -> Iterator[MeasuredFrame]:
    """Measure all frames: from the frame of the clicks to the end, then from it to the beginning.

    Raises:
        InputError: the images cannot be read.
        NothingMeasured: nothing of a person can be measured in the first frame.
    """
    take = footage.take
    first = take.clicks.frame if take.clicks.frame in footage.frames else footage.frames.start
    order = [*range(first, footage.frames.stop), *range(first - 1, footage.frames.start - 1, -1)]
    base = store.digest(
        ALGORITHM,
        repr((settings.matching, settings.growing, settings.surface.of_measuring, settings.enhance)),
        take.rig_path,
        repr((take.interlaced, take.first_field, take.reference_view, take.clicks.table())),
        repr([(v.name, v.offset_frames) for v in take.views]),
        repr(footage.delay_images) if any(footage.delay_images) else "",
        repr(footage.click_sigma_px) if take.clicks.surface else "",
        repr(footage.reduction.tolist()) if footage.full_size_px else "",
    )
    start = before = None
    for done, frame in enumerate(order):
        part = monitor.part("surface", done, len(order))
        part.step("surface", 0, 1)
        if frame == first - 1:
            before = start
        needed = [before.key] if before else _image_digests(footage, _furthest_frame(footage, frame))  # the background is found with it
        key = store.digest(base, *needed, str(frame), *_image_digests(footage, frame), *_silhouette_digests(footage, frame))
        measured = read_checkpoint(footage, results, frame, key)
        if measured is None:
            measured = _measure(_frame_views(footage, frame, settings, first=before is None), settings, before, key, part)
            _checkpoint(results, measured, footage)
        start = start or measured
        before = measured
        yield measured


def _image_digests(footage: Footage, frame: int) -> list[str]:
    """The identity of a frame's images: the content of image files; the size and date of a movie. With interpolated views it includes the
    frames before and after."""
    step = footage.take.field_layout.per_image
    near = (frame - step, frame, frame + step) if any(footage.delay_images) else (frame,)
    parts = []
    for path in (path for f in near if f in footage.frames or f == frame for path in footage.files(f)):
        try:
            state = path.stat()
            parts.append(store.digest(path) if path.suffix.lower() in IMAGE_ENDINGS else f"{state.st_size} {state.st_mtime_ns}")
        except OSError as error:
            raise InputError(f"Cannot read the image {path}: {error.strerror or error}.") from error
    return parts


def _silhouette_digests(footage: Footage, frame: int) -> list[str]:
    """The content of the masks and backgrounds of a frame."""
    paths = (silhouette_file(footage, k, frame) for k in range(len(footage.take.views)))
    return [store.digest(path) for path in paths if path is not None and path.is_file()]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _FrameViews:
    """One frame, ready to be measured."""

    footage: Footage
    frame: int
    grey: list[np.ndarray]  # (h', w) of every view, as they were taken
    views: Views
    grid: TemplateGrid
    silhouettes: tuple[fg.Silhouette, ...]


def _frame_views(footage: Footage, frame: int, settings: MeasureSettings, *, first: bool) -> _FrameViews:
    """Read a frame. Raises InputError; see `Footage.read`, and `silhouettes` for what is checked in the `first` frame alone."""
    images = load_images(footage, frame, settings.enhance)
    rows = footage.take.rows_at(frame)
    views = Views(images=images.spline, cameras=footage.rig.cameras, reference=footage.take.reference, rows=rows)
    return _FrameViews(
        footage=footage,
        frame=frame,
        grey=images.grey,
        views=views,
        grid=template_grid(views.template.shape, rows, settings.growing.spacing_px),
        silhouettes=silhouettes(footage, images.grey, frame, first=first),
    )


def _measure(now: _FrameViews, settings: MeasureSettings, before: MeasuredFrame | None, key: str, monitor: Monitor) -> MeasuredFrame:
    """The surface of a frame, in the depths where the frame before was, or else where the person is."""
    views, ref = now.views, now.views.reference
    if before is None:
        where, seeds = _first_foreground(now, settings, monitor)
    else:
        where = fg.after(views.base.to_camera(before.cloud.xyz_m)[:, 2], before.foreground)
        automatic = settings.growing.seed_spacing_px > 0
        box = _box_of_person(now, before.cloud.xyz_m)
        seeds = _swept(now, settings, where.depth_range_m, monitor, box) if automatic else _seeds_of_before(now, settings, before)
    sources = silhouette_sources(now.footage)
    where = replace(where, silhouettes=now.silhouettes, method=f"{where.method}, {sources}" if sources else where.method)
    field = _matched(now, seeds, settings, where, monitor)
    why = why_removed(field, views.base, ref, settings.surface)
    clean = np.flatnonzero(why == 0)
    why[clean[fails_occlusion_check(field.select(clean), views, settings.matching)]] = OCCLUDED
    cloud = point_cloud(field.select(why == 0), now.grey[ref], views.base, ref, now.frame, settings.surface)
    if before is None and not len(cloud.xyz_m):
        raise NothingMeasured(now.frame)
    return MeasuredFrame(
        frame=now.frame,
        field=field.select(why == 0),
        cloud=in_full_pixels(cloud, now.footage),
        foreground=replace(where, silhouettes=()),
        key=key,
        removed_px=now.footage.to_full(views.rows.to_frame(field.xy[why > 0])).astype(np.float32),
        removed_why=why[why > 0],
    )


def _matched(now: _FrameViews, seeds: Approximations, settings: MeasureSettings, where: fg.Foreground, monitor: Monitor) -> MatchedField:
    """The matched field of a frame, under the constraint that was chosen, before the filters."""
    matching, growing = settings.matching, settings.growing
    cover = voronoi_scan if growing.method == "published" else grow_regions
    field = cover(now.views, now.grid, seeds, matching, growing, foreground=where, monitor=monitor)
    return _single(constrain(field, now.views, matching, foreground=where, monitor=monitor, pairs=growing.pairs))


def _box_of_person(now: _FrameViews, before_m: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Where in the reference image (rows' pixels) a person can be whose cloud (N, 3) in the frame before is known; None: anywhere."""
    if len(before_m) < fg.MIN_CLOUD:
        return None
    views = now.views
    at = views.rows.from_frame(views.base.project(before_m))
    reach = fg.REACH_M * views.base.focal_px / float(np.median(views.base.to_camera(before_m)[:, 2])) / np.array([1.0, views.rows.step])
    return at.min(axis=0) - reach, at.max(axis=0) + reach


def _swept(
    now: _FrameViews,
    settings: MeasureSettings,
    depth_range_m: tuple[float, float] | None,
    monitor: Monitor,
    within_px: tuple[np.ndarray, np.ndarray] | None = None,
) -> Approximations:
    """The automatic seeds of a frame within a range of depths."""
    growing = settings.growing
    return sweep_seeds(
        now.views,
        now.grid,
        settings.matching,
        spacing_px=growing.seed_spacing_px or SEED_SPACING_PX,
        depth_range_m=depth_range_m,
        within_px=within_px,
        monitor=monitor,
        pairs=growing.pairs,
    )


def first_seeds(footage: Footage, settings: MeasureSettings, frame: int, monitor: Monitor) -> tuple[fg.Foreground, Approximations]:
    """Where the person is in one frame, and the surface seeds there."""
    return _first_foreground(_frame_views(footage, frame, settings, first=True), settings, monitor)


def _first_foreground(now: _FrameViews, settings: MeasureSettings, monitor: Monitor) -> tuple[fg.Foreground, Approximations]:
    """Where the person is in the first frame, inside silhouettes if there are any, and the seeds there."""
    footage, take = now.footage, now.footage.take

    def sweep(depth_range_m: tuple[float, float] | None) -> Approximations:
        found = _swept(now, settings, depth_range_m, monitor)
        xyz = _seed_points(now, found)
        outside = fg.Foreground(depth_range_m=(0.0, np.inf), method="", silhouettes=now.silhouettes).excludes(
            xyz, np.zeros((len(xyz), 3, 3))
        )
        return Approximations(**{f.name: getattr(found, f.name)[~outside] for f in fields(Approximations)})

    planes, moving = _background_and_person(now, sweep(None))
    depth = np.array([clicked_depth(footage, name, at) for name, at in take.clicks.named])
    if len(depth) and now.frame == take.clicks.frame:
        where = fg.around_clicks(depth)
    elif len(depth):
        where = fg.since_clicks(depth, frame_time_s(abs(now.frame - take.clicks.frame), take.fps), moving)
    elif len(moving):
        where = fg.nearest_surface(moving)
    else:
        where = fg.Foreground(depth_range_m=ANY_DEPTH_M, method="everything")
    where = replace(where, planes=planes)
    if not settings.growing.seed_spacing_px:
        return where, _seeds_from_clicks(now, settings)
    seeds = sweep(where.depth_range_m)
    if take.clicks.surface and now.frame == take.clicks.frame:
        clicked = clicked_seeds(footage, now.views, settings.matching)
        seeds = Approximations(**{f.name: np.concatenate([getattr(s, f.name) for s in (seeds, clicked)]) for f in fields(Approximations)})
    return where, seeds


def _seeds_from_clicks(now: _FrameViews, settings: MeasureSettings) -> Approximations:
    """The clicked surface seeds of the first frame, or else the surface in front of the clicked joints.

    Raises:
        InputError: nothing is clicked, or in another frame.
    """
    clicks = now.footage.take.clicks
    if clicks.named and now.frame != clicks.frame:
        raise InputError(f"Without automatic seeds the surface starts from the clicks in frame {clicks.frame}: measure that frame, too.")
    seeds = clicked_seeds if clicks.surface else seeds_before_joints
    return seeds(now.footage, now.views, settings.matching)


def _seeds_of_before(now: _FrameViews, settings: MeasureSettings, before: MeasuredFrame) -> Approximations:
    """Seeds where the frame before was matched, one in about every `SEED_SPACING_PX`, moved in depth to where the views correlate."""
    grid = before.field.grid
    every = max(1, round(SEED_SPACING_PX / grid.spacing_px))
    row, column = np.divmod(before.field.cell, grid.shape[1])
    chosen = (row % every == 0) & (column % every == 0)
    moved_m = SEED_SPEED_M_S * abs(now.frame - before.frame) / now.footage.take.fps
    return settled_seeds(now.views, before.field.xyz_m[chosen], np.full(int(chosen.sum()), moved_m), settings.matching)


def _seed_points(now: _FrameViews, seeds: Approximations) -> np.ndarray:
    """The seeds in space (N, 3)."""
    views = now.views
    return views.base.points_at_depth(views.rows.to_frame(seeds.xy[:, views.reference]), seeds.depth_m)


def _furthest_frame(footage: Footage, frame: int) -> int:
    """The frame of the take, on the same rows, that differs most in time, whether it is to be measured or not."""
    step = footage.take.field_layout.per_image
    return max((f for f in footage_frames(footage.take, footage.sequences) if (f - frame) % step == 0), key=lambda f: abs(f - frame))


def _background_and_person(now: _FrameViews, seeds: Approximations) -> tuple[np.ndarray, np.ndarray]:
    """Planes (P, 4) of floor and walls, and the depths of the seeds off them: of those that moved, unless these are too few.

    A seed moved if the frame furthest in time shows something else at its place.
    """
    ref, other = now.views.reference, _furthest_frame(now.footage, now.frame)
    if other == now.frame or not len(seeds.depth_m):
        return np.zeros((0, 4)), seeds.depth_m
    later = load_images(now.footage, other).grey[ref]
    xyz = _seed_points(now, seeds)
    still = fg.unchanged(now.grey[ref], later, seeds.xy[:, ref])
    planes = fg.background_planes(xyz[still], xyz, [c.centre_m for c in now.views.cameras])
    off_planes = ~fg.Foreground(depth_range_m=(0.0, np.inf), method="", planes=planes).excludes(xyz, np.zeros((len(xyz), 3, 3)))
    moved = off_planes & ~still
    return planes, seeds.depth_m[moved if moved.sum() >= MIN_MOVED else off_planes]


def in_full_pixels(cloud: PointCloud, footage: Footage) -> PointCloud:
    """The cloud with coordinates and residuals in pixels of the files' images, where these were reduced."""
    if not footage.full_size_px:
        return cloud
    return replace(cloud, xy_px=footage.to_full(cloud.xy_px), residual_px=cloud.residual_px * float(footage.reduction.mean()))


def _single(field: MatchedField) -> MatchedField:
    """The field with its covariances in single precision, as a checkpoint stores it: a resumed run continues with the same numbers."""
    return replace(field, **{name: getattr(field, name).astype(np.float32).astype(np.float64) for name in FIELD_SINGLE})


def _checkpoint(results: Results, m: MeasuredFrame, footage: Footage) -> None:
    arrays = {f"field_{f.name}": getattr(m.field, f.name) for f in fields(MatchedField) if f.name not in ("grid", "tried", "limit_px")}
    arrays = {k: v.astype(np.float32) if k.removeprefix("field_") in FIELD_SINGLE else v for k, v in arrays.items()}
    arrays |= {f"cloud_{f.name}": getattr(m.cloud, f.name) for f in fields(PointCloud) if f.name not in ("frame", "xy_px", "residual_px")}
    arrays |= {
        "where": np.array(m.foreground.depth_range_m),
        "planes": m.foreground.planes,
        "method": np.array(m.foreground.method),
        "grid": np.array([m.field.grid.spacing_px, *m.field.grid.shape, m.field.tried]),
        "limit_px": np.array(m.field.limit_px),
        "reduction": footage.reduction,
        "removed_px": m.removed_px,
        "removed_why": m.removed_why,
    }
    results.save_checkpoint("surface", f"{m.frame:04d}", m.key, arrays)


def read_checkpoint(footage: Footage, results: Results, frame: int, key: str) -> MeasuredFrame | None:
    """A frame that was measured before, from the same input; None where there is none, or it is damaged."""
    a = results.load_checkpoint("surface", f"{frame:04d}", key)
    if a is None:
        return None
    spacing, gh, gw, tried = (int(v) for v in a["grid"])
    rows = footage.take.rows_at(frame)
    values = {
        k.removeprefix("field_"): v.astype(np.float64) if v.dtype == np.float32 else v for k, v in a.items() if k.startswith("field_")
    }
    field = MatchedField(
        grid=TemplateGrid(spacing_px=spacing, rows=rows, shape=(gh, gw)), tried=tried, limit_px=float(a["limit_px"]), **values
    )
    cloud = PointCloud(
        frame=frame,
        xy_px=rows.to_frame(field.xy),
        residual_px=field.residual_px,
        **{k.removeprefix("cloud_"): v for k, v in a.items() if k.startswith("cloud_")},
    )
    where = fg.Foreground(depth_range_m=(float(a["where"][0]), float(a["where"][1])), method=str(a["method"]), planes=a["planes"])
    why = a.get("removed_why", np.zeros(0, dtype=np.uint8))  # earlier versions did not store it
    removed = a.get("removed_px", np.zeros((0, field.xy.shape[1], 2), dtype=np.float32))
    cloud = in_full_pixels(cloud, footage)
    return MeasuredFrame(frame=frame, field=field, cloud=cloud, foreground=where, key=key, removed_px=removed, removed_why=why)
