"""Footage as Blender movie clips, with the camera's lens and distortion, so that undistorted footage fits the ideal camera."""

from collections.abc import Collection
from pathlib import Path

import bpy

from ...core.foundation.bounded import real_path
from ...core.foundation.errors import InputError
from ...core.geometry.camera import Camera
from ...core.images.interlace import FieldLayout, field_pictures
from ...core.images.sequence import ImageSequence, open_sequence
from ...core.results.folder import FIELDS
from .. import folders
from . import axes, stored

FIELDS_KEY = "tricap_fields"  # custom property of a clip that shows single fields: the first field
CLIP_KEY = "tricap_clip"  # custom property of a camera: the clip behind it


def load_clip(name: str, first_file: Path, camera: Camera) -> bpy.types.MovieClip:
    """The image sequence that begins with `first_file`, or the movie, as a clip with the camera's lens."""
    clip = open_clip(name, first_file)
    set_lens(clip, camera)
    return clip


def open_clip(name: str, first_file: Path) -> bpy.types.MovieClip:
    """The image sequence that begins with `first_file`, or the movie, as a clip that starts at scene frame 0.

    Raises:
        InputError: Blender cannot read it.
    """
    try:
        clip = bpy.data.movieclips.load(str(first_file))
    except RuntimeError as error:
        raise InputError(f"Blender cannot read the footage {first_file} ({str(error).strip()}); convert it to H.264 or PNG.") from error
    clip.name = name
    clip.filepath = folders.for_user(first_file)
    clip.frame_start = 0
    return clip


def clip_of_view(scene: bpy.types.Scene, name: str, first_file: Path, camera: Camera) -> bpy.types.MovieClip:
    """The project's clip of a view if it shows this file, else a new one; with the camera's lens."""
    project = getattr(scene, "tricap", None)  # the command `tricap scene` builds without the add-on's properties
    own = next((view.clip for view in project.views if view.name == name and view.clip is not None), None) if project else None
    if own is None or real_path(bpy.path.abspath(own.filepath)) != real_path(first_file):
        return load_clip(f"Footage {name}", first_file, camera)
    set_lens(own, camera)
    return own


def first_file(folder: Path, images: str | None, movie: str | None, view: str, fields: FieldLayout) -> Path:
    """The file that Blender opens for a view of the take in `folder`; with both fields, the picture of the first one.

    Raises:
        InputError: the footage is missing, or the pictures of its fields cannot be written.
    """
    return shown_files(open_sequence(folder, images=images, movie=movie, view=view), fields, folder / FIELDS / view)[0]


def shown_files(sequence: ImageSequence, fields: FieldLayout, folder: Path) -> tuple[Path, ...]:
    """The files that Blender shows of a sequence: its own, or pictures of both fields, written to `folder` if they are not there.

    Raises:
        InputError: the pictures cannot be written.
    """
    return sequence.files() if fields.per_image == 1 else field_pictures(sequence, fields, folder)


def frames_per_image(clip: bpy.types.MovieClip) -> int:
    """Frames of the clip per image of the footage: two where it shows single fields."""
    return 2 if clip.get(FIELDS_KEY) else 1


def set_lens(clip: bpy.types.MovieClip, camera: Camera) -> None:
    """Give the clip's tracking camera the calibrated lens and Brown's distortion."""
    lens = axes.lens(camera)
    tracking = clip.tracking.camera
    tracking.sensor_width = lens.sensor_width_mm
    tracking.pixel_aspect = lens.pixel_aspect_y
    tracking.units = "MILLIMETERS"
    tracking.focal_length = lens.lens_mm
    tracking.principal_point_pixels = axes.principal_point_bottom_up_px(camera)
    tracking.distortion_model = "BROWN"
    for name, value in axes.brown_coefficients(camera).items():
        setattr(tracking, name, value)


def clip_faults(clip: bpy.types.MovieClip, camera: Camera, files: Collection[Path], label: str) -> list[str]:
    """Warnings where Blender does not show the footage as Tricap reads it."""
    faults = []
    if tuple(clip.size) != camera.size_px:
        faults.append(
            f"Blender reads the footage of {label} as {clip.size[0]}×{clip.size[1]}, the camera has "
            f"{camera.size_px[0]}×{camera.size_px[1]}; convert it to PNG to see it behind the camera."
        )
    if files and clip.frame_duration < len(files):
        faults.append(
            f"Blender shows only {clip.frame_duration} of the {len(files)} images of {label}: the numbers in their names have"
            " gaps; rename them to see all of them behind the camera."
        )
    return faults


def show_behind(camera_data: bpy.types.Camera, clip: bpy.types.MovieClip) -> None:
    """The undistorted clip as the background of the camera's view."""
    background = camera_data.background_images.new()
    background.source = "MOVIE_CLIP"
    background.clip = clip
    background.clip_user.use_render_undistorted = True
    background.clip_user.proxy_render_size = "FULL"
    background.frame_method = "STRETCH"
    background.alpha = 1.0
    camera_data.show_background_images = True
    camera_data[CLIP_KEY] = clip


def clip_behind(camera_data: bpy.types.Camera) -> bpy.types.MovieClip | None:
    """The clip that `show_behind` put there; None if it was deleted since.

    Blender (4.5, 5.2) leaves a dangling pointer to a deleted clip in the background image, and crashes when it is read or freed; a
    custom property that points to the clip is cleared instead. So the background image is removed without being read.
    """
    clip = stored.data_block(camera_data, CLIP_KEY, bpy.types.MovieClip)
    if clip is None and CLIP_KEY in camera_data:
        camera_data.background_images.clear()
    return clip
