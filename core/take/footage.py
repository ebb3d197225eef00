"""Opened footage: the images of a take with their cameras, as large as their files or reduced."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ..foundation.errors import InputError
from ..foundation.threads import in_threads
from ..geometry.intersection import CLICK_SIGMA_PX
from ..geometry.rig import Rig, read_rig
from ..geometry.view_angles import default_reference, second_neighbour_deg, views_alike
from ..images.retime import Recent
from ..images.sequence import ImageSequence, open_sequence
from .clock import Clock, clocks_of
from .take import Clicks, Take

STRAY_FRAMES = 200  # looked at


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Footage:
    """An opened take: its cameras in the order of the views, and their sequences."""

    take: Take
    rig: Rig
    sequences: tuple[ImageSequence, ...]
    frames: range
    click_sigma_px: float = CLICK_SIGMA_PX  # of the take's clicks
    clocks: tuple[Clock, ...] = ()  # of the views; empty where they are shifted by whole frames at most
    delay_images: tuple[float, ...] = ()  # time offset by which the images of each view are interpolated; empty: none
    full_size_px: tuple[tuple[int, int], ...] = ()  # of the views' images, where they are reduced to the cameras' size; else empty

    @property
    def reference_note(self) -> str:
        """Which view is the reference view and why, where the cameras decided that and not take.toml; else empty."""
        take, middle = self.take, len(self.take.views) // 2
        if take.reference_chosen or take.reference == middle:
            return ""
        own, other = (second_neighbour_deg(self.rig.cameras, k) for k in (take.reference, middle))
        return (
            f"The reference view is {take.reference_view}, not {take.views[middle].name} in the middle of the list: two other views look "
            f"from within {own:.0f}° of it, and of {take.views[middle].name} from within {other:.0f}°. `reference_view` in take.toml names "
            "another one."
        )

    @property
    def unlike_views(self) -> tuple[str, ...]:
        """The names of the views that are not matched, as they look from too far apart from the reference view."""
        reference = self.take.reference
        matched = (reference, *views_alike(self.rig.cameras, reference))
        return tuple(view.name for k, view in enumerate(self.take.views) if k not in matched)

    def number(self, view: int, frame: int) -> int:
        """The number of the image in a view's sequence that shows a frame of the take."""
        if self.clocks:
            return self.clocks[view].nearest(self.take.instant_s(frame))
        return self.take.field_layout.image(frame) + self.take.views[view].offset_frames

    def frames_of_images(self, view: int, numbers: np.ndarray) -> np.ndarray:
        """The frames (n,) of the take that images (n,) of a view show, of both fields the first; −1 for images between those of frames."""
        per = self.take.field_layout.per_image
        if not self.clocks:
            return np.asarray(per * (numbers - self.take.views[view].offset_frames))
        frames = [per * round(self.clocks[view].time_s(int(n)) * self.take.fps / per) for n in numbers]
        return np.array([f if self.number(view, f) == n else -1 for f, n in zip(frames, numbers)], dtype=int)

    def delay(self, view: int, frame: int) -> float:
        """By how many image intervals the image of a view is later than the instant of a frame, as far as it is known."""
        known = self.clocks[view].delay_images(self.number(view, frame), self.take.instant_s(frame)) if self.clocks else 0.0
        return known + (self.delay_images[view] if self.delay_images else 0.0)

    def row_delays(self, view: int, frame: int, rows: int) -> np.ndarray:
        """The same for each of the rows (rows,) of the image, which a rolling shutter exposes one after another."""
        rolling = self.clocks[view].row_delays(rows) if self.clocks else np.zeros(rows)
        return rolling + self.delay(view, frame)

    def single(self) -> "Footage":
        """The footage with one frame per image."""
        take, per = self.take.single(), self.take.field_layout.per_image
        return replace(self, take=take, frames=range(self.frames.start // per, -(-self.frames.stop // per)))

    def read(self, frame: int) -> list[np.ndarray]:
        """The grey images (h, w) float32 of all views at one frame of the take.

        Raises:
            InputError: an image is missing, damaged, or of another size than its camera.
        """
        return self._checked(frame, in_threads(lambda k: self.sequences[k].read(self.number(k, frame)), range(len(self.sequences))))

    def read_whole(self, frame: int) -> list[np.ndarray]:
        """The same for the eye: the rows of the other field are interpolated.

        Raises:
            InputError: as `read`.
        """
        rows = self.take.rows_at(frame)
        return [rows.whole(image) for image in self.read(frame)]

    def read_colour(self, frame: int) -> list[np.ndarray]:
        """The RGB images (h, w, 3) float32 of all views at one frame of the take; the rows of the other field are interpolated.

        Raises:
            InputError: as `read`.
        """
        views = range(len(self.sequences))
        images = self._checked(frame, in_threads(lambda k: self.sequences[k].read_colour(self.number(k, frame)), views))
        return [self.take.rows_at(frame).whole(image) for image in images]

    def _checked(self, frame: int, images: list[np.ndarray]) -> list[np.ndarray]:
        for image, size, view in zip(images, self.sizes_px, self.take.views):
            if image.shape[1::-1] != size:
                raise InputError(
                    f"Frame {frame} of view {view.name} has {image.shape[1]}×{image.shape[0]} pixels, but its camera in "
                    f"{self.take.rig_path.name} has {size[0]}×{size[1]}; use the footage as it was calibrated."
                )
        return [self.reduced_image(k, image) for k, image in enumerate(images)]

    @property
    def sizes_px(self) -> list[tuple[int, int]]:
        """(width, height) of the files' images of each view."""
        return list(self.full_size_px) or [camera.size_px for camera in self.rig.cameras]

    @property
    def reduction(self) -> np.ndarray:
        """(K, 2) pixels of the files' images, in x and y, for one of the cameras of the views."""
        return np.array(self.sizes_px, dtype=np.float64) / [camera.size_px for camera in self.rig.cameras]

    def reduced_image(self, view: int, image: np.ndarray) -> np.ndarray:
        """An image (h, w) of a view's files at the size of its camera."""
        return cv2.resize(image, self.rig.cameras[view].size_px, interpolation=cv2.INTER_AREA) if self.full_size_px else image

    def to_full(self, xy_px: np.ndarray) -> np.ndarray:
        """Pixels (…, K, 2) of the files' images of pixels (…, K, 2) of the cameras of K views."""
        return np.asarray((xy_px + 0.5) * self.reduction - 0.5) if self.full_size_px else xy_px

    def reduced(self, factor: float) -> "Footage":
        """The same footage with images smaller by a factor, and with the cameras and clicks that belong to them."""
        cameras = self.rig.cameras
        smaller = [camera.resized((round(camera.size_px[0] / factor), round(camera.size_px[1] / factor))) for camera in cameras]
        scale = {c.name: np.array(small.size_px) / c.size_px for c, small in zip(cameras, smaller)}

        def moved(at: Clicks) -> Clicks:
            return {view: (xy + 0.5) * scale[view] - 0.5 for view, xy in at.items()}

        clicks = self.take.clicks
        joints = {name: moved(at) for name, at in clicks.joints.items()}
        clicks = replace(clicks, surface=tuple(moved(at) for at in clicks.surface), joints=joints)
        return replace(
            self,
            take=replace(self.take, clicks=clicks),
            rig=replace(self.rig, cameras=tuple(smaller)),
            click_sigma_px=self.click_sigma_px / factor,
            full_size_px=tuple(camera.size_px for camera in cameras),
        )

    def interval_frames(self, view: int) -> float:
        """The time between two images of a view, in frames of the take."""
        return self.clocks[view].period_s * self.take.fps if self.clocks else float(self.take.field_layout.per_image)

    def strays_frames(self, view: int, first_frame: int) -> float:
        """By how many frames a view is shown at another moment, at most, where its images are played one after another at the take's rate.

        Its image 0 is then shown in the scene's `first_frame`.
        """
        per = self.take.field_layout.per_image
        some = self.frames[:: max(1, len(self.frames) // STRAY_FRAMES)]
        return max((abs(per * self.number(view, frame) + first_frame - frame) for frame in some), default=0.0)

    def files(self, frame: int) -> list[Path]:
        """The files of one frame, and where a view is interpolated also of its images before and after; a movie is the file of all."""
        files = list[Path]()
        for k, sequence in enumerate(self.sequences):
            own, number = sequence.files(), self.number(k, frame)
            if len(own) < 2 and sequence.count > 1:
                files.append(own[0])
            else:
                around = 1 if self.row_delays(k, frame, 2).any() else 0
                files += own[max(number - around, 0) : number + around + 1]
        return files


def open_take(take: Take, sequences: tuple[ImageSequence, ...] | None = None, *, click_sigma_px: float = CLICK_SIGMA_PX) -> Footage:
    """Open the footage (unless `sequences` are the opened views) and the rig of a take and check that they belong together.

    `click_sigma_px`: the knob fitting.click_sigma_px, for what depends on the clicks.

    Raises:
        InputError: a view without camera or images, views of unequal length, frames or clicks outside the footage.
    """
    rig = read_rig(take.rig_path)
    rig = Rig(cameras=tuple(rig[v.name] for v in take.views), metadata=rig.metadata, remarks=rig.remarks)
    take = take if take.reference_chosen else replace(take, reference_view=default_reference([v.name for v in take.views], rig))
    sequences = sequences or tuple(
        open_sequence(take.folder, images=v.images, movie=v.movie, view=v.name, size_px=rig[v.name].size_px) for v in take.views
    )
    frames, clocks = footage_frames(take, sequences), clocks_of(take, sequences)
    if clocks:
        sequences = tuple(s if isinstance(s, Recent) else Recent(s) for s in sequences)  # read with their neighbours in time
    footage = Footage(take=take, rig=rig, sequences=sequences, frames=frames, clocks=clocks, click_sigma_px=click_sigma_px)
    _check_clicks(footage)
    _check_corrections(footage)
    return footage


def footage_frames(take: Take, sequences: tuple[ImageSequence, ...]) -> range:
    """The frames of a take that are measured: those of `frames`; else all, and where the views have clocks, those that all of them show.

    Raises:
        InputError: the views have no common frames, or not those in the take.
    """
    per, clocks = take.field_layout.per_image, clocks_of(take, sequences)
    if clocks:
        return _common_frames(take, per, clocks, [s.count for s in sequences])
    counts = [per * (s.count - v.offset_frames) for s, v in zip(sequences, take.views)]
    first = per * max(0, *(-v.offset_frames for v in take.views))
    if take.frames is None:
        if len(set(counts)) > 1:
            ends = ", ".join(f"{v.name} ends with frame {c - 1}" for v, c in zip(take.views, counts))
            common = f"write `frames = [{first}, {min(counts)}]` in take.toml, which all views show, or " if first < min(counts) else ""
            advice = f"{common}correct `offset_frames`."
            raise InputError(f"The views of {take.folder.name} end differently: {ends}; {advice}")
        if counts[0] <= first:
            raise InputError(f"With these `offset_frames` the views of {take.folder.name} have no common frame; correct them in take.toml.")
        return range(first, counts[0])
    start, stop = take.frames
    if start < first or stop > min(counts):
        has = f"the footage has frames {first} to {min(counts)} (half-open)"
        raise InputError(f"`frames` of {take.folder.name} is [{start}, {stop}], but {has}; correct it in take.toml.")
    return range(start, stop)


def _common_frames(take: Take, per: int, clocks: tuple[Clock, ...], counts: list[int]) -> range:
    """The frames, from 0 on, for which every view has an image within half an interval."""
    rate = take.fps / per
    first = max(0, max(math.ceil((c.time_s(0) - c.period_s / 2) * rate) for c in clocks))
    stop = min(math.floor((c.time_s(n - 1) + c.period_s / 2) * rate) for c, n in zip(clocks, counts)) + 1
    while first < stop and any(c.nearest(first / rate) < 0 for c in clocks):
        first += 1
    while first < stop and any(c.nearest((stop - 1) / rate) >= n for c, n in zip(clocks, counts)):
        stop -= 1
    if stop <= first:
        spans = ", ".join(f"{v.name} from {c.time_s(0):.2f} to {c.time_s(n - 1):.2f} s" for v, c, n in zip(take.views, clocks, counts))
        raise InputError(f"The views of {take.folder.name} have no frame in common ({spans}); correct `start` in take.toml.")
    if take.frames is None:
        return range(per * first, per * stop)
    if take.frames[0] < per * first or take.frames[1] > per * stop:
        has = f"the views have frames {per * first} to {per * stop} (half-open) in common"
        raise InputError(f"`frames` of {take.folder.name} is [{take.frames[0]}, {take.frames[1]}], but {has}; correct it in take.toml.")
    return range(*take.frames)


def _check_corrections(footage: Footage) -> None:
    for c in footage.take.corrections:
        if c.frames.stop <= footage.frames.start or c.frames.start >= footage.frames.stop:
            where = f"frames {c.frames.start} to {c.frames.stop - 1}" if len(c.frames) > 1 else f"frame {c.frames.start}"
            raise InputError(
                f"A correction of {footage.take.folder.name} in view {c.view} is for {where}, and the take has the frames "
                f"{footage.frames.start} to {footage.frames.stop - 1}; correct it under [[corrections]], or remove it."
            )


def _check_clicks(footage: Footage) -> None:
    for clicked in (footage.take.clicks, *footage.take.keyframes):
        clicks = [(f"joint “{name}”", at) for name, at in clicked.joints.items()]
        clicks += [(f"surface seed {i + 1}", at) for i, at in enumerate(clicked.surface)]
        for label, at in clicks:
            _check_inside(footage, label, at)
        if clicks and clicked.frame not in footage.frames:
            raise InputError(
                f"The clicks of {footage.take.folder.name} in frame {clicked.frame} are not among the frames "
                f"{footage.frames.start} to {footage.frames.stop - 1}; change `frame` in take.toml."
            )


def _check_inside(footage: Footage, label: str, at: Clicks) -> None:
    for view, xy in at.items():
        if not footage.rig[view].sees(xy):
            w, h = footage.rig[view].size_px
            where = f"at ({xy[0]:g}, {xy[1]:g}), outside the image of {w}×{h} pixels"
            raise InputError(f"The {label} in view {view} lies {where}; click it again.")
