"""Footage as Blender movie clips, with the camera's lens and distortion, so that undistorted footage fits the ideal camera."""

from collections.abc import Sequence
from pathlib import Path

import bpy

from ...core.geometry.camera import Camera
from . import axes


def load_clip(name: str, first_file: Path, camera: Camera) -> bpy.types.MovieClip:
    """The image sequence that begins with `first_file`, or the movie, as a clip that starts at scene frame 0."""
    clip = bpy.data.movieclips.load(str(first_file))
    clip.name = name
    clip.frame_start = 0
    set_lens(clip, camera)
    return clip


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


def clip_faults(clip: bpy.types.MovieClip, camera: Camera, files: Sequence[Path], label: str) -> list[str]:
    """What keeps Blender from showing the footage as Tricap reads it, in sentences."""
    faults = []
    if tuple(clip.size) != camera.size_px:
        faults.append(f"Blender reads the footage of {label} as {clip.size[0]}×{clip.size[1]}, the camera has "
                      f"{camera.size_px[0]}×{camera.size_px[1]}; convert it to PNG to see it behind the camera.")
    if files and clip.frame_duration < len(files):
        faults.append(f"Blender shows only {clip.frame_duration} of the {len(files)} images of {label}: their names are not numbered"
                      " without a gap; rename them to see all of them behind the camera.")
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
