"""Opened footage: the images of a take with their cameras, as large as their files or reduced."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ..foundation.errors import InputError
from ..geometry.intersection import CLICK_SIGMA_PX
from ..geometry.rig import Rig, read_rig
from ..images.sequence import ImageSequence, open_sequence
from .take import Clicks, Take


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Footage:
    """An opened take: its cameras in the order of the views, and their sequences."""

    take: Take
    rig: Rig
    sequences: tuple[ImageSequence, ...]
    frames: range
    click_sigma_px: float = CLICK_SIGMA_PX  # of the take's clicks
    delay_images: tuple[float, ...] = ()  # time offset by which the images of each view are interpolated; empty: none
    full_size_px: tuple[tuple[int, int], ...] = ()  # of the views' images, where they are reduced to the cameras' size; else empty

    def number(self, view: int, frame: int) -> int:
        """The number of the image in a view's sequence that shows a frame of the take."""
        return self.take.field_layout.image(frame) + self.take.views[view].offset_frames

    def single(self) -> "Footage":
        """The footage with one frame per image."""
        take, per = self.take.single(), self.take.field_layout.per_image
        return replace(self, take=take, frames=range(self.frames.start // per, -(-self.frames.stop // per)))

    def read(self, frame: int) -> list[np.ndarray]:
        """The grey images (h, w) float32 of all views at one frame of the take.

        Raises:
            InputError: an image is missing, damaged, or of another size than its camera.
        """
        return self._checked(frame, [s.read(self.number(k, frame)) for k, s in enumerate(self.sequences)])

    def read_colour(self, frame: int) -> list[np.ndarray]:
        """The RGB images (h, w, 3) float32 of all views at one frame of the take; the rows of the other field are interpolated.

        Raises:
            InputError: as `read`.
        """
        images = self._checked(frame, [s.read_colour(self.number(k, frame)) for k, s in enumerate(self.sequences)])
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

    def files(self, frame: int) -> list[Path]:
        """The files of one frame; a movie is the file of all of its frames."""
        return [f[self.number(k, frame)] if len(f := s.files()) > 1 or s.count == 1 else f[0] for k, s in enumerate(self.sequences)]


def open_take(take: Take, sequences: tuple[ImageSequence, ...] | None = None, *, click_sigma_px: float = CLICK_SIGMA_PX) -> Footage:
    """Open the footage (unless `sequences` are the opened views) and the rig of a take and check that they belong together.

    `click_sigma_px`: the knob fitting.click_sigma_px, for what depends on the clicks.

    Raises:
        InputError: a view without camera or images, views of unequal length, frames or clicks outside the footage.
    """
    rig = read_rig(take.rig_path)
    rig = Rig(cameras=tuple(rig[v.name] for v in take.views), metadata=rig.metadata)
    sequences = sequences or tuple(open_sequence(take.folder, images=v.images, movie=v.movie, view=v.name) for v in take.views)
    frames = footage_frames(take, sequences)
    footage = Footage(take=take, rig=rig, sequences=sequences, frames=frames, click_sigma_px=click_sigma_px)
    _check_clicks(footage)
    return footage


def footage_frames(take: Take, sequences: tuple[ImageSequence, ...]) -> range:
    """The frames of a take that are measured.

    Raises:
        InputError: the views have no common frames, or not those in the take.
    """
    per = take.field_layout.per_image
    counts = [per * (s.count - v.offset_frames) for s, v in zip(sequences, take.views)]
    first = per * max(0, *(-v.offset_frames for v in take.views))
    if take.frames is None:
        if len(set(counts)) > 1:
            lengths = ", ".join(f"{v.name} has {c}" for v, c in zip(take.views, counts))
            advice = "Trim them, or set `offset_frames` or `frames` in take.toml."
            raise InputError(f"The views of {take.folder.name} are not equally long: {lengths} frames. {advice}")
        if counts[0] <= first:
            raise InputError(f"With these `offset_frames` the views of {take.folder.name} have no common frame; correct them in take.toml.")
        return range(first, counts[0])
    start, stop = take.frames
    if start < first or stop > min(counts):
        has = f"the footage has frames {first} to {min(counts)} (half-open)"
        raise InputError(f"`frames` of {take.folder.name} is [{start}, {stop}], but {has}; correct it in take.toml.")
    return range(start, stop)


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
