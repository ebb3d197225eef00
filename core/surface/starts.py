"""Where the measurement of a frame starts: the depths in which the person is, and the seeds of the surface there.

The starts follow each other: those of a frame are searched for about the person in the frame before, as its seeds show it. They are cheap,
so that the rest, which depends on a frame's own start alone, can be done for many frames at once. A start is a checkpoint, too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.arrays import concatenated, select_rows
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.threads import in_threads
from ..images.enhance import EnhanceSettings, enhanced
from ..images.interlace import frame_time_s
from ..images.retime import retimed
from ..images.sampling import SplineImage
from ..images.sequence import IMAGE_ENDINGS
from ..matching import foreground as fg
from ..matching.least_squares import MatchingSettings
from ..matching.region_growing import GrowingSettings, MatchedField
from ..matching.seeds import Approximations, at_an_end, longest_base_m, sweep_seeds
from ..matching.views import TemplateGrid, Views, template_grid
from ..results.folder import Results
from ..take.clicked_points import clicked_depth, clicked_seeds, seeds_before_joints, settled_seeds
from ..take.footage import Footage, footage_frames
from ..take.person_masks import silhouette_file, silhouette_sources, silhouettes
from .cloud import SurfaceSettings

ALGORITHM = "surface 29"  # part of every key: raise it when the same input gives other numbers
SEED_PX = 0.3  # precision of a seed in the images
MIN_MOVED = 20  # seeds; with fewer that moved, the person is searched for among all of them
SEED_SPACING_PX = 24  # without automatic seeds: of those by which the background is found, and of those from the frame before
SEED_SPEED_M_S = 1.0  # sigma of the speed in depth at which seeds come from the frame before
ANY_DEPTH_M = (fg.NEAREST_M, 1e3)
SUPPORT_SPACINGS = 2.2  # spacings of the seeds within which others support a seed,
SUPPORT_M = 0.15  # m, if their depths differ by less
SUPPORT = 2  # so many of them
ABOUT_SEED_M = 0.3  # m from a seed in the frame before, as far as a hand moves meanwhile, within which the person is searched for
MIN_SEEDS = 8  # supported ones; fewer do not show where the person is


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameStart:
    """Where the measurement of a frame starts."""

    frame: int
    where: fg.Foreground  # without silhouettes, which are read with the images
    seeds: Approximations
    person_m: np.ndarray  # (N, 3) points that show where the person is
    key: str  # of everything that it depends on
    field: MatchedField | None = None  # of the frame, where the seeds of the next one come from it


def first_frame(footage: Footage) -> int:
    """The frame from which the others are measured: that of the clicks, or else the first of the take."""
    clicked = footage.take.clicks.frame
    return clicked if clicked in footage.frames else footage.frames.start


class FrameStarts:
    """The starts of a take's frames: from the `first` one to the end, then from it to the beginning (`order`)."""

    def __init__(self, footage: Footage, settings: "MeasureSettings", results: Results, first: int | None = None) -> None:
        self._footage, self._settings, self._results = footage, settings, results
        take = footage.take
        self.first = first_frame(footage) if first is None else first
        self.order = [*range(self.first, footage.frames.stop), *range(self.first - 1, footage.frames.start - 1, -1)]
        self._base = store.digest(
            ALGORITHM,
            repr((settings.matching, settings.growing, settings.surface.of_measuring, settings.enhance)),
            take.rig_path,
            repr((take.interlaced, take.first_field, take.reference_view, take.clicks.table())),
            repr([(v.name, v.offset_frames) for v in take.views]),
            (repr(footage.delay_images) if any(footage.delay_images) else "")
            + (repr([clock.digest() for clock in footage.clocks]) if footage.clocks else ""),
            repr(footage.click_sigma_px) if take.clicks.surface else "",
            repr(footage.reduction.tolist()) if footage.full_size_px else "",
            "".join(f" not matched {name}" for name in footage.unlike_views),
        )
        self._of_first: FrameStart | None = None
        self._before: FrameStart | None = None

    @property
    def alone(self) -> bool:
        """Whether the starts do not depend on what is measured, so that the frames can be measured in any order."""
        return self._settings.growing.seed_spacing_px > 0

    def at(self, frame: int, monitor: Monitor) -> tuple[FrameStart, "FrameViews | None"]:
        """The start of the next frame of `order`, and the frame itself if it had to be read.

        Raises:
            InputError: the images cannot be read.
        """
        footage = self._footage
        before = self._of_first if frame == self.first - 1 else self._before
        needed = [before.key] if before else image_digests(footage, _furthest_frame(footage, frame))  # the background is found with it
        key = store.digest(self._base, *needed, str(frame), *image_digests(footage, frame), *_silhouette_digests(footage, frame))
        start, now = read_start(self._results, frame, key) if self.alone else None, None
        if start is None:
            now = frame_views(footage, frame, self._settings, first=before is None)
            start = _frame_start(now, self._settings, before, key, monitor)
            if self.alone:
                _write_start(self._results, start)
        self._of_first, self._before = self._of_first or start, start
        return start, now

    def measured(self, field: MatchedField, cloud_m: np.ndarray) -> None:
        """Let the next start follow what was measured in this frame, where seeds are not searched for automatically."""
        if not self.alone and self._before is not None:
            first = self._of_first is self._before
            self._before = replace(self._before, field=field, person_m=cloud_m)
            self._of_first = self._before if first else self._of_first


def _frame_start(now: "FrameViews", settings: "MeasureSettings", before: FrameStart | None, key: str, monitor: Monitor) -> FrameStart:
    """The start of a frame, in the depths where the person was in the frame before, or else where the person is."""
    if before is None:
        where, seeds = _first_foreground(now, settings, monitor)
    else:
        confirmed = now.views.required_matches(settings.growing.pairs) > 1
        fewest = MIN_SEEDS if before.field is None else fg.MIN_CLOUD
        if confirmed:
            depth, near = (now.views.base.to_camera(xyz)[:, 2] for xyz in (before.person_m, fg.without_small_groups(before.person_m)))
            where = fg.after(depth, before.where, fewest, near_m=near)
        else:
            where = fg.after(_sure_depths(now.views, before), before.where, fewest, confirmed=False)
        if before.field is None:
            seeds = _swept(now, settings, where.depth_range_m, monitor, _about_person(now, before.person_m))
        else:
            seeds = _seeds_of_before(now, settings, before.field, before.frame)
    sources = silhouette_sources(now.footage)
    if sources and not where.method.endswith(sources):
        where = replace(where, method=f"{where.method}, {sources}")
    return FrameStart(frame=now.frame, where=where, seeds=seeds, person_m=_person_points(now, settings, seeds, where), key=key)


def _sure_depths(views: Views, before: FrameStart) -> np.ndarray:
    """The depths (M,) of the person in the frame before, of seeds that are neither near a plane nor at an end of the range."""
    depth = views.base.to_camera(before.where.off_planes(before.person_m))[:, 2]
    searched = before.field is None and before.where.depth_range_m != ANY_DEPTH_M
    return depth[~at_an_end(views, depth, before.where.depth_range_m)] if searched else depth


def _person_points(now: "FrameViews", settings: "MeasureSettings", seeds: Approximations, where: fg.Foreground) -> np.ndarray:
    """The seeds (N, 3) that belong to the person: in the foreground, and next to others in the image and in depth."""
    ref, reach = now.views.reference, SUPPORT_SPACINGS * (settings.growing.seed_spacing_px or SEED_SPACING_PX)
    xyz = _seed_points(now, seeds)
    outside = replace(where, silhouettes=now.silhouettes).excludes(xyz, np.zeros((len(xyz), 3, 3)))
    xyz, depth, at = xyz[~outside], seeds.depth_m[~outside], seeds.xy[~outside, ref] * (1.0, now.views.rows.step)
    near = (np.abs(at[:, None] - at).max(axis=2) <= reach) & (np.abs(depth[:, None] - depth) <= SUPPORT_M)
    return np.asarray(xyz[near.sum(axis=1) > SUPPORT])


def read_start(results: Results, frame: int, key: str) -> FrameStart | None:
    """A start from its checkpoint; None where there is none, or it is damaged."""
    a = results.load_checkpoint("starts", f"{frame:04d}", key)
    if a is None:
        return None
    where = fg.Foreground(depth_range_m=(float(a["where"][0]), float(a["where"][1])), method=str(a["method"]), planes=a["planes"])
    seeds = Approximations(**{f.name: a[f.name] for f in fields(Approximations)})
    return FrameStart(frame=frame, where=where, seeds=seeds, person_m=a["person_m"], key=key)


def _write_start(results: Results, start: FrameStart) -> None:
    arrays = {f.name: getattr(start.seeds, f.name) for f in fields(Approximations)}
    where = {"where": np.array(start.where.depth_range_m), "planes": start.where.planes, "method": np.array(start.where.method)}
    results.save_checkpoint("starts", f"{start.frame:04d}", start.key, {**arrays, **where, "person_m": start.person_m})


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameImages:
    """The rows of one frame that are measured, of all views, ready for matching."""

    grey: list[np.ndarray]
    spline: list[SplineImage]


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


def measured_rows(footage: Footage, frame: int) -> list[np.ndarray]:
    """The rows (h', w) float32 of all views at one frame; views with a time offset are interpolated to the moment of the others.

    The interpolation uses the same rows of the images before and after.

    Raises:
        InputError: see `Footage.read`.
    """
    grid = footage.take.rows_at(frame)

    def image(k: int, number: int) -> np.ndarray | None:
        sequence = footage.sequences[k]
        return grid.rows(footage.reduced_image(k, sequence.read(number))) if 0 <= number < sequence.count else None

    rows = [grid.rows(image) for image in footage.read(frame)]
    for k in range(len(rows)):
        late = footage.row_delays(k, frame, len(rows[k]))
        if late.any():
            number = footage.number(k, frame)
            rows[k] = retimed(rows[k], image(k, number - 1), image(k, number + 1), late)
    return rows


def load_images(footage: Footage, frame: int, enhance: EnhanceSettings | None = None) -> FrameImages:
    """Read a frame and prepare it. The images for matching may be enhanced, the grey values are those of the files.

    Raises:
        InputError: see `Footage.read`.
    """
    grey = measured_rows(footage, frame)
    matched = enhanced(grey, enhance, row_step=footage.take.rows_at(frame).step) if enhance is not None else grey
    return FrameImages(grey=grey, spline=in_threads(SplineImage, matched))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameViews:
    """One frame, ready to be measured."""

    footage: Footage
    frame: int
    grey: list[np.ndarray]  # (h', w) of every view, as they were taken
    views: Views
    grid: TemplateGrid
    silhouettes: tuple[fg.Silhouette, ...]


def frame_views(footage: Footage, frame: int, settings: MeasureSettings, *, first: bool) -> FrameViews:
    """Read a frame. Raises InputError; see `Footage.read`, and `silhouettes` for what is checked in the `first` frame alone."""
    images = load_images(footage, frame, settings.enhance)
    rows = footage.take.rows_at(frame)
    views = Views(images=images.spline, cameras=footage.rig.cameras, reference=footage.take.reference, rows=rows)
    return FrameViews(
        footage=footage,
        frame=frame,
        grey=images.grey,
        views=views,
        grid=template_grid(views.template.shape, rows, settings.growing.spacing_px),
        silhouettes=silhouettes(footage, images.grey, frame, first=first),
    )


def _about_person(now: FrameViews, before_m: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Where in the reference image (rows' pixels) a person can be of whom points (N, 3) in the frame before are known: about these places,
    within a distance (2,); None: anywhere."""
    if len(before_m) < MIN_SEEDS:
        return None
    views = now.views
    pixel_m = float(np.median(views.base.to_camera(before_m)[:, 2])) / views.base.focal_px
    return views.rows.from_frame(views.base.project(before_m)), ABOUT_SEED_M / pixel_m / np.array([1.0, views.rows.step])


def _swept(
    now: FrameViews,
    settings: MeasureSettings,
    depth_range_m: tuple[float, float] | None,
    monitor: Monitor,
    near_px: tuple[np.ndarray, np.ndarray] | None = None,
) -> Approximations:
    """The automatic seeds of a frame within a range of depths."""
    growing = settings.growing
    return sweep_seeds(
        now.views,
        now.grid,
        settings.matching,
        spacing_px=growing.seed_spacing_px or SEED_SPACING_PX,
        depth_range_m=depth_range_m,
        near_px=near_px,
        monitor=monitor,
        pairs=growing.pairs,
    )


def first_seeds(footage: Footage, settings: MeasureSettings, frame: int, monitor: Monitor) -> tuple[fg.Foreground, Approximations]:
    """Where the person is in one frame, and the surface seeds there."""
    return _first_foreground(frame_views(footage, frame, settings, first=True), settings, monitor)


def person_depths(footage: Footage, settings: MeasureSettings, frame: int, monitor: Monitor) -> np.ndarray:
    """The depths (N,) [m] in the reference camera of the seeds on the person in a frame.

    Raises:
        InputError: the images cannot be read.
    """
    now = frame_views(footage, frame, settings, first=True)
    where, seeds = _first_foreground(now, settings, monitor)
    return now.views.base.to_camera(_person_points(now, settings, seeds, where))[:, 2]


def _first_foreground(now: FrameViews, settings: MeasureSettings, monitor: Monitor) -> tuple[fg.Foreground, Approximations]:
    """Where the person is in the first frame, inside silhouettes if there are any, and the seeds there."""
    footage, take = now.footage, now.footage.take

    def sweep(depth_range_m: tuple[float, float] | None) -> Approximations:
        found = _swept(now, settings, depth_range_m, monitor)
        xyz = _seed_points(now, found)
        outside = fg.Foreground(depth_range_m=(0.0, np.inf), method="", silhouettes=now.silhouettes).excludes(
            xyz, np.zeros((len(xyz), 3, 3))
        )
        return select_rows(found, ~outside)

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
        seeds = concatenated([seeds, clicked])
    return where, seeds


def _seeds_from_clicks(now: FrameViews, settings: MeasureSettings) -> Approximations:
    """The clicked surface seeds of the first frame, or else the surface in front of the clicked joints.

    Raises:
        InputError: nothing is clicked, or in another frame.
    """
    clicks = now.footage.take.clicks
    if clicks.named and now.frame != clicks.frame:
        raise InputError(f"Without automatic seeds the surface starts from the clicks in frame {clicks.frame}: measure that frame, too.")
    seeds = clicked_seeds if clicks.surface else seeds_before_joints
    return seeds(now.footage, now.views, settings.matching)


def _seeds_of_before(now: FrameViews, settings: MeasureSettings, field: MatchedField, frame: int) -> Approximations:
    """Seeds where the frame before, `frame`, was matched: one in about every `SEED_SPACING_PX`, moved in depth to where the views
    correlate."""
    grid = field.grid
    every = max(1, round(SEED_SPACING_PX / grid.spacing_px))
    row, column = np.divmod(field.cell, grid.shape[1])
    chosen = (row % every == 0) & (column % every == 0)
    moved_m = SEED_SPEED_M_S * abs(now.frame - frame) / now.footage.take.fps
    return settled_seeds(now.views, field.xyz_m[chosen], np.full(int(chosen.sum()), moved_m), settings.matching)


def _seed_points(now: FrameViews, seeds: Approximations) -> np.ndarray:
    """The seeds in space (N, 3)."""
    views = now.views
    return views.base.points_at_depth(views.rows.to_frame(seeds.xy[:, views.reference]), seeds.depth_m)


def _furthest_frame(footage: Footage, frame: int) -> int:
    """The frame of the take, on the same rows, that differs most in time, whether it is to be measured or not."""
    step = footage.take.field_layout.per_image
    return max((f for f in footage_frames(footage.take, footage.sequences) if (f - frame) % step == 0), key=lambda f: abs(f - frame))


def _background_and_person(now: FrameViews, seeds: Approximations) -> tuple[np.ndarray, np.ndarray]:
    """Planes (P, 4) of floor and walls, and the depths of the seeds off them: of those that moved, unless these are too few.

    A seed moved if the frame furthest in time shows something else at its place.
    """
    ref, other = now.views.reference, _furthest_frame(now.footage, now.frame)
    if other == now.frame or not len(seeds.depth_m):
        return np.zeros((0, 4)), seeds.depth_m
    later = load_images(now.footage, other).grey[ref]
    xyz = _seed_points(now, seeds)
    still = fg.unchanged(now.grey[ref], later, seeds.xy[:, ref])
    planes = fg.background_planes(xyz[still], xyz, [c.centre_m for c in now.views.cameras], _depth_tolerance_m(now, seeds.depth_m[still]))
    off_planes = ~fg.Foreground(depth_range_m=(0.0, np.inf), method="", planes=planes).excludes(xyz, np.zeros((len(xyz), 3, 3)))
    moved = off_planes & ~still
    return planes, seeds.depth_m[moved if moved.sum() >= MIN_MOVED else off_planes]


def _depth_tolerance_m(now: FrameViews, depth_m: np.ndarray) -> float:
    """How much seeds in these depths (N,) may be beside a plane on which they lie: cameras near each other see depth less precisely."""
    base_px = now.views.base.focal_px * longest_base_m(now.views)
    return max(fg.PLANE_TOLERANCE_M, SEED_PX * float(np.median(depth_m)) ** 2 / base_px if len(depth_m) else 0.0)


def image_digests(footage: Footage, frame: int) -> list[str]:
    """The identity of a frame's images: the content of image files; the size and date of a movie. With interpolated views it includes the
    frames before and after."""
    parts = []
    for path in footage.files(frame):
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
