"""A take: one recording of a person, described by take.toml in the folder of the footage.

Joint and view names, and every key, are checked when the file is read; the images are not read.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import bounded
from ..foundation.arrays import frozen
from ..foundation.errors import InputError, shown
from ..foundation.settings import nearest_name
from ..geometry.rig import MOST_CAMERAS
from ..geometry.view_angles import default_reference
from ..images.interlace import BOTH, INTERLACE, FieldLayout, RowGrid, field_layout, frame_time_s
from .clock import KEYS as CLOCK_KEYS
from .clock import view_clock
from .sources import (
    PERSON_SOURCES,
    KeypointSource,
    check_keys,
    check_pattern,
    frame_pair,
    inside,
    is_number,
    is_pixel,
    keypoint_sources,
    person_source,
    table_of,
    tables_of,
)

FORMAT, VERSION = "tricap-take", 1
MOST_FRAMES = 100_000_000
MOST_SEEDS = 1000  # clicked surface points, and corners of a polygon: what people click
MOST_CORRECTIONS = 5000
SIDED = ("clavicle", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe", "knuckles")
JOINTS = ("pelvis", "spine", "chest", "neck", "head", *(f"{j}.{s}" for j in SIDED for s in "LR"))
KEYS = (
    "format",
    "version",
    "fps",
    "interlaced",
    "first_field",
    "rig",
    "reference_view",
    "frames",
    "views",
    "body",
    "seeds",
    "keyframes",
    "corrections",
    "keypoints",
    "settings",
    "preset",
    "quality",
)
LONGEST_NAME = 120  # bytes of a view's name: a file's may have 255, and other words stand before and behind it
TOP_LEVEL = {"preset": "method", "quality": "surface"}  # settings that are keys of take.toml itself, and their groups

CORRECTIONS = {"trajectory": ("frame", "xy"), "region": ("frames", "polygon")}  # the keys of each kind
NO_BODY, AUTO_BODY = "none", "auto"  # `model` under [body]; the latter where nothing is said
WHOLE_BODY = "full"  # the model that has all joints
START_ALONE = (AUTO_BODY, WHOLE_BODY, "upper_body")  # models whose joints need no clicks; a limb starts alone where its person is visible
Clicks = Mapping[str, np.ndarray]  # view name -> (2,) full-frame pixels


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """One camera's footage: image files (a pattern) or a movie. Image 0 of the take is its number `offset_frames`, unless it has a clock
    (`clock.clocks_of`): its own images per second, the second at which it starts, a drift, or a file of time stamps.

    One of `mask`, `masks` (a pattern, an image for every image) and `background` may give the silhouette of the person.
    """

    name: str
    images: str | None = None
    movie: str | None = None
    offset_frames: int = 0
    fps: float | None = None
    start_s: float = 0.0
    drift_ppm: float = 0.0
    readout_s: float = 0.0  # of a rolling shutter
    timestamps: str | None = None
    mask: str | None = None
    masks: str | None = None
    background: str | None = None

    @property
    def has_clock(self) -> bool:
        """Whether its images are not simply those of the take's frames, shifted by a number of frames."""
        return self.fps is not None or self.timestamps is not None or bool(self.start_s or self.drift_ppm or self.readout_s)

    @property
    def clock(self) -> tuple[float | str | None, ...]:
        """What sets its clock, for digests; empty without one."""
        rolls = (self.readout_s,) if self.readout_s else ()
        return (self.fps, self.start_s, self.drift_ppm, self.timestamps, *rolls) if self.has_clock else ()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameClicks:
    """The clicks of one frame, in full-frame pixels: surface seeds and joints."""

    frame: int = 0
    surface: tuple[Clicks, ...] = ()
    joints: Mapping[str, Clicks] = field(default_factory=dict)

    @property
    def named(self) -> list[tuple[str, Clicks]]:
        """All clicks and their names in messages: joints, then surface seeds from 1."""
        return [*self.joints.items(), *((f"surface seed {i + 1}", at) for i, at in enumerate(self.surface))]

    def table(self) -> list[tuple[str, list[tuple[str, list[float]]]]]:
        """All clicks as plain values, for digests."""
        clicks = [*self.joints.items(), *((f"surface {i}", at) for i, at in enumerate(self.surface))]
        return [(name, sorted((view, xy.tolist()) for view, xy in at.items())) for name, at in clicks]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Correction:
    """An error that the user marked in one view, in full-frame pixels.

    "trajectory": the trajectory nearest to `xy_px` (1, 2) in frame `frames.start` is removed.
    "region": measurements inside the polygon `xy_px` (n, 2) are left out in `frames`.
    """

    kind: str
    view: str
    frames: range
    xy_px: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (None, 2)))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Take:
    """A recording. `folder` has take.toml and the footage; `frames` is half-open, None means all.

    A frame of the take is an image, or one of its two fields where `interlaced` is "both".
    """

    folder: Path
    fps: float  # frames per second
    views: tuple[View, ...]
    rig_path: Path
    interlaced: str = "none"
    first_field: str = "odd"  # of "both"
    reference_view: str = ""
    reference_chosen: bool = True  # by take.toml; otherwise it is the middle one, and `open_take` may take another
    frames: tuple[int, int] | None = None
    body_model: str | None = AUTO_BODY  # the name of one of ours, or the absolute path of the take's own; None: surface and tracks only
    locked: tuple[str, ...] = ()  # degrees of freedom fixed at their rest value
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # by degree of freedom, in degrees
    clicks: FrameClicks = field(default_factory=FrameClicks)
    keyframes: tuple[FrameClicks, ...] = ()  # clicked joints of further frames, one entry per frame
    corrections: tuple[Correction, ...] = ()
    keypoints: tuple[KeypointSource, ...] = ()
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def field_layout(self) -> FieldLayout:
        """Which rows of which images are the frames of the take."""
        return field_layout(self.interlaced, self.first_field)

    def time_s(self, frames: np.ndarray) -> np.ndarray:
        """When frames (T,) of the take were taken, in seconds after frame 0."""
        return frame_time_s(frames, self.fps)

    def instant_s(self, frame: int) -> float:
        """When the image of a frame was taken, in seconds after frame 0: for both fields of an image, the instant of the first."""
        per = self.field_layout.per_image
        return frame // per * per / self.fps

    def rows_at(self, frame: int) -> RowGrid:
        """The rows of the image that show a frame of the take."""
        return self.field_layout.rows(frame)

    def single(self) -> "Take":
        """This take with one frame per image: of both fields the first, with the clicks of both."""
        if self.interlaced != BOTH:
            return self
        clicks, *keys = (replace(s, frame=self.field_layout.image(s.frame)) for s in (self.clicks, *self.keyframes))
        frames = None if self.frames is None else (self.frames[0] // 2, (self.frames[1] + 1) // 2)
        return replace(self, fps=self.fps / 2, interlaced=self.first_field, frames=frames, clicks=clicks, keyframes=tuple(keys))

    @property
    def clicked_joints(self) -> frozenset[str]:
        """The names of the joints that are clicked in any frame."""
        return frozenset(name for frame in (self.clicks, *self.keyframes) for name in frame.joints)

    @property
    def joints_model(self) -> str | None:
        """See `model_of_joints`."""
        return model_of_joints(self.body_model)

    @property
    def reference(self) -> int:
        """Index of the reference view."""
        return [v.name for v in self.views].index(self.reference_view)


def read_take(folder: Path) -> Take:
    """Read FOLDER/take.toml.

    Raises:
        InputError: the file is missing or damaged, or has an unknown key or an impossible value.
    """
    folder = Path(folder)
    path = folder / "take.toml" if folder.name != "take.toml" else folder
    bounded.check_name(bounded.real_path(path.parent))
    try:
        return take_of_text(bounded.text_of(path, bounded.TOML_BYTES), path)
    except OSError as error:
        message = f"{folder} is not a take: cannot read {path.name} in it ({error.strerror or error}). Make one with `tricap new`."
        raise InputError(message) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text in UTF-8 ({error}); save it as UTF-8 (in Notepad under “Encoding”).") from error


def take_of_text(text: str, path: Path) -> Take:
    """The take described by this text of a take.toml at `path`.

    Raises:
        InputError: the text is no TOML, or has an unknown key or an impossible value.
    """
    try:
        table = bounded.toml_of(text)
    except ValueError as error:
        raise InputError(f"{path} is not a TOML file: {error}; correct that place.") from error
    return _take(table, bounded.real_path(path.parent), str(path))


def _take(table: Mapping[str, Any], folder: Path, where: str) -> Take:
    check_keys(table, KEYS, where)
    if table.get("format") != FORMAT or table.get("version") != VERSION:
        present = f"it has {shown(table['format'])} and {shown(table['version'])}" if {"format", "version"} <= {*table} else "it lacks them"
        raise InputError(f'{where} must have format = "{FORMAT}" and version = {VERSION}; {present}.')
    views = _views(table.get("views"), where)
    names = tuple(v.name for v in views)
    reference = table.get("reference_view", default_reference(names))
    if reference not in names:
        raise InputError(f"`reference_view` of {where} is {shown(reference)}.{nearest_name(str(reference), names)}")
    interlaced = table.get("interlaced", "none")
    if interlaced not in (*INTERLACE, BOTH):
        raise InputError(f"`interlaced` of {where} is {shown(interlaced)}; write one of: {', '.join((*INTERLACE, BOTH))}.")
    first_field = table.get("first_field", "odd")
    if first_field not in ("odd", "even") or ("first_field" in table and interlaced != BOTH):
        raise InputError(f'`first_field` of {where} is {shown(first_field)}; write "odd" or "even", and only with interlaced = "both".')
    fps = table.get("fps")
    if not is_number(fps) or not 0.1 <= float(fps) <= 10_000:
        raise InputError(f"`fps` of {where} is {shown(fps)}; write the frames per second, such as 25.0.")
    body = table_of(table, "body", where)
    check_keys(body, ("model", "locked", "limits"), f"[body] of {where}")
    if not isinstance(body.get("model", ""), str):
        raise InputError(
            f'`model` under [body] of {where} is {shown(body["model"])}; write the name of a body model, such as "arm.R", or "none".'
        )
    return Take(
        folder=folder,
        fps=float(fps) * field_layout(interlaced).per_image,
        views=views,
        rig_path=inside(folder, table.get("rig", "rig.toml"), where),
        interlaced=interlaced,
        first_field=first_field,
        reference_view=reference,
        reference_chosen="reference_view" in table,
        frames=frame_pair(table.get("frames"), where),
        body_model=body_model(folder, body.get("model"), where),
        locked=_locked(body.get("locked", []), where),
        limits=_limits(body.get("limits", {}), where),
        clicks=(clicks := _frame_clicks(table_of(table, "seeds", where), names, where)),
        keyframes=_keyframes(tables_of(table, "keyframes", where), clicks, names, where),
        corrections=_corrections(tables_of(table, "corrections", where), names, where),
        keypoints=keypoint_sources(tables_of(table, "keypoints", where), names, JOINTS, where),
        settings=_settings(table, where),
    )


def _views(entries: Any, where: str) -> tuple[View, ...]:
    if not isinstance(entries, list) or len(entries) < 2 or not all(isinstance(e, dict) for e in entries):
        raise InputError(f"{where} needs at least two [[views]], in the order in which the cameras stand.")
    views = []
    for entry in entries:
        label = f"view {shown(entry.get('name'))} of {where}"
        check_keys(entry, ("name", "images", "movie", "offset_frames", *CLOCK_KEYS, *PERSON_SOURCES), label)
        offset = entry.get("offset_frames", 0)
        if not isinstance(entry.get("name"), str) or not entry["name"]:
            raise InputError(f'A {label} needs a name (text), such as "L".')
        if isinstance(offset, bool) or not isinstance(offset, int) or abs(offset) > MOST_FRAMES:
            raise InputError(f"`offset_frames` of {label} is {shown(offset)}; write a whole number of frames, such as -2.")
        if not bounded.fits_file_names(entry["name"]):  # it is used in file names
            raise InputError(f'The {label} has a name, or a character in its name, that no file may have; choose a plain name such as "L".')
        if len(entry["name"].encode()) > LONGEST_NAME:
            raise InputError(f"The {label} has a name that is too long for the files that are named after it; choose a shorter one.")
        if sorted(map(type, (entry.get("images"), entry.get("movie"))), key=str) != [type(None), str]:
            raise InputError(f'The {label} needs either `images` (a pattern such as "{entry["name"]}/*.png") or `movie` (a file).')
        check_pattern(entry.get("images"), label)
        files = {key: entry.get(key) for key in ("images", "movie")} | person_source(entry, label)
        views.append(View(name=entry["name"], offset_frames=offset, **files, **view_clock(entry, label)))
    if len(views) > MOST_CAMERAS:
        raise InputError(f"{where} has {len(views)} views; a take has at most {MOST_CAMERAS}.")
    if len({v.name.casefold() for v in views}) < len(views):
        raise InputError(f"Two views of {where} have the same name, or names that differ only in capitals; give each its own.")
    footage = {(v.images, v.movie): v.name for v in reversed(views)}
    if same := next((v.name for v in views if footage[v.images, v.movie] != v.name), None):
        raise InputError(f"View {same} of {where} has the footage of another view; give it that of its own camera.")
    return tuple(views)


def _locked(names: Any, where: str) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise InputError(f'`locked` under [body] of {where} is {shown(names)}; write a list of names, such as ["elbow.R twist"].')
    return tuple(names)


def _limits(table: Any, where: str) -> Mapping[str, tuple[float, float]]:
    if not isinstance(table, dict):
        raise InputError(f'[body.limits] of {where} must be a table, such as "knee.R flexion" = [0, 140].')
    for name, pair in table.items():
        if not isinstance(pair, list) or len(pair) != 2 or not all(is_number(v) for v in pair) or not pair[0] < pair[1]:
            raise InputError(f"The limits of “{name}” in {where} are {shown(pair)}; write [lowest, highest] in degrees.")
    return {name: (float(low), float(high)) for name, (low, high) in table.items()}


def _keyframes(tables: list[Mapping[str, Any]], seeds: FrameClicks, views: tuple[str, ...], where: str) -> tuple[FrameClicks, ...]:
    for table in tables:
        check_keys(table, ("frame", "joints"), f"a [[keyframes]] of {where}")
    keyframes = tuple(_frame_clicks(table, views, where, "keyframes") for table in tables)
    if len({k.frame for k in keyframes}) < len(keyframes):
        raise InputError(f"Two [[keyframes]] of {where} are for the same frame; write their joints into one.")
    if seeds.joints and any(k.joints and k.frame == seeds.frame for k in keyframes):
        raise InputError(f"A [[keyframes]] of {where} is for frame {seeds.frame}, as [seeds.joints] is; write its joints there.")
    return tuple(sorted(keyframes, key=lambda k: k.frame))


def _corrections(tables: list[Mapping[str, Any]], views: tuple[str, ...], where: str) -> tuple[Correction, ...]:
    if len(tables) > MOST_CORRECTIONS:
        raise InputError(f"{where} has {len(tables)} [[corrections]]; {MOST_CORRECTIONS} is the most.")
    return tuple(_correction(table, views, where) for table in tables)


def _correction(table: Mapping[str, Any], views: tuple[str, ...], where: str) -> Correction:
    kind, view, label = table.get("kind"), table.get("view"), f"a [[corrections]] of {where}"
    if not isinstance(kind, str) or kind not in CORRECTIONS:
        raise InputError(f"`kind` of {label} is {shown(kind)}; write one of: {', '.join(CORRECTIONS)}.")
    check_keys(table, ("kind", "view", *CORRECTIONS[kind]), label)
    if view not in views:
        raise InputError(f"`view` of {label} is {shown(view)}.{nearest_name(str(view), views)}")
    frame = table.get("frame")
    if kind == "region" and isinstance(table.get("polygon"), list) and len(table["polygon"]) > MOST_SEEDS:
        raise InputError(f"The polygon of {label} has {len(table['polygon'])} corners; {MOST_SEEDS} is the most.")
    if kind == "region":
        frames, corners = frame_pair(table.get("frames"), label), table.get("polygon")
    else:
        frames, corners = (frame, frame + 1) if isinstance(frame, int) else None, [table.get("xy")]
    wanted = 3 if kind == "region" else 1
    if not isinstance(corners, list) or len(corners) < wanted or not all(is_pixel(xy) for xy in corners) or frames is None:
        need = "frames = [first, one after the last] and a polygon of three or more" if kind == "region" else "a frame and xy, one"
        raise InputError(f"The correction “{kind}” of {where} needs {need} pixel coordinates [x, y].")
    return Correction(kind=kind, view=view, frames=range(*frames), xy_px=np.array(corners, dtype=np.float64))


def _frame_clicks(table: Mapping[str, Any], views: tuple[str, ...], where: str, name: str = "seeds") -> FrameClicks:
    check_keys(table, ("frame", "surface", "joints"), f"[{name}] of {where}")
    frame, surface, joints = table.get("frame", 0), table.get("surface", []), table.get("joints", {})
    if not isinstance(frame, int) or not isinstance(surface, list) or not isinstance(joints, dict):
        raise InputError(f"[{name}] of {where} needs frame (a whole number), surface (a list) and joints (a table).")
    if len(surface) > MOST_SEEDS:
        raise InputError(f"[{name}] of {where} has {len(surface)} surface seeds; {MOST_SEEDS} is the most. Without any, they are found.")
    check_keys(joints, JOINTS, f"[{name}.joints] of {where}")
    return FrameClicks(
        frame=frame,
        surface=tuple(_clicks(s, views, f"surface seed {i + 1} of {where}") for i, s in enumerate(surface)),
        joints={name: _clicks(joints[name], views, f"joint “{name}” of {where}") for name in JOINTS if name in joints},
    )


def _clicks(at: Any, views: tuple[str, ...], label: str) -> Clicks:
    if not isinstance(at, dict):
        raise InputError(f"The {label} must name views and pixels, such as {{ {views[0]} = [312.0, 180.5] }}.")
    check_keys(at, views, label)
    for view, xy in at.items():
        if not is_pixel(xy):
            raise InputError(f"The {label} in view {view} is {shown(xy)}; write two pixel coordinates [x, y].")
    return {view: np.array(xy, dtype=np.float64) for view, xy in at.items()}


def _settings(take: Mapping[str, Any], where: str) -> Mapping[str, Mapping[str, Any]]:
    """[settings], with the `TOP_LEVEL` keys among them."""
    table = dict(table_of(take, "settings", where))
    for name, group in table.items():
        if not isinstance(group, dict):
            raise InputError(f"[settings] of {where} must contain tables such as [settings.matching]; “{name}” is not a table.")
    for key in (key for key in TOP_LEVEL if key in take):
        values = table.get(group := TOP_LEVEL[key], {})
        if key in values:
            raise InputError(f"{where} sets `{key}` twice, also under [settings.{group}]; remove one of them.")
        table[group] = {**values, key: take[key]}
    return table


def model_of_joints(model: str | None) -> str | None:
    """The model whose joints can be clicked: that of the whole person until one is chosen."""
    return WHOLE_BODY if model == AUTO_BODY else model


def body_model(folder: Path, name: str | None, where: str) -> str | None:
    """`model` of [body]: the name of one of ours, or the path of the take's own .toml file, as `read_model` takes it; `AUTO_BODY` where
    nothing is said, None for no body.

    Raises:
        InputError: the file does not lie in the take's folder.
    """
    if name is None:
        return AUTO_BODY
    if name == NO_BODY:
        return None
    return str(inside(folder, name, where, "model")) if name.endswith(".toml") else name
