"""Clicks: native tracking tracks in the clips of the views, one track per joint or surface seed, one marker per clicked frame.

A track has the name of its joint ("elbow.R"); surface seeds are "seed 1", "seed 2", … Frame t of the take is frame t of the scene; a
clip counts its own frames from 1. Disabled markers, and those that a tracker set (not keyed), are not clicks. Blender shows a marker also
in the frames after it, and the first one before it: disabled markers next to each click end this, except for the active track. It cannot
delete the last marker of a track, so a click that is removed there is disabled.
"""

import re
from collections.abc import Iterator

import bpy
import numpy as np

from ..core.take.take import JOINTS
from .scene import axes

SURFACE_SEED = re.compile(r"seed (\d+)")
POINT = re.compile(r"point (\d+)")  # chosen to be followed; no click of the take
Clicks = dict[str, dict[str, list[float]]]  # name -> view -> [x, y] in full-frame pixels


def clip_frame(clip: bpy.types.MovieClip, frame: int) -> int:
    """The clip's own number of a frame of the scene."""
    return frame - clip.frame_start + 1


def scene_frame(clip: bpy.types.MovieClip, own: int) -> int:
    """The scene's number of the clip's frame `own`."""
    return own + clip.frame_start - 1


def is_click(name: str) -> bool:
    """Whether a track of this name is a joint or a surface seed."""
    return name in JOINTS or SURFACE_SEED.fullmatch(name) is not None


def set_click(clip: bpy.types.MovieClip, name: str, frame: int, xy_px: tuple[float, float]) -> bpy.types.MovieTrackingTrack:
    """Set a click (pixels; the centre of the top-left pixel is (0, 0)) in a frame of the scene; returns its track."""
    own = clip_frame(clip, frame)
    track = clip.tracking.tracks.get(name)
    if track is None:
        track = clip.tracking.tracks.new(name=name, frame=own)
    u, v = axes.uv_from_pixel(np.array(xy_px, dtype=np.float64), tuple(clip.size))
    marker = track.markers.insert_frame(own, co=(float(u), float(v)))
    marker.mute = False
    _show_in_its_frames(track)
    return track


def remove_click(clip: bpy.types.MovieClip, name: str, frame: int) -> bool:
    """Remove a click; False if there was none."""
    track = clip.tracking.tracks.get(name)
    own = clip_frame(clip, frame)
    marker = _keyed(track, own) if track is not None else None
    if marker is None:
        return False
    marker.mute = True
    _show_in_its_frames(track)
    return True


def get_click(clip: bpy.types.MovieClip, name: str, frame: int) -> list[float] | None:
    """The pixel [x, y] of a click, None if there is none in that frame."""
    track = clip.tracking.tracks.get(name)
    marker = _keyed(track, clip_frame(clip, frame)) if track is not None else None
    return None if marker is None else pixel_of(marker.co, tuple(clip.size))


def clicked_frames(clip: bpy.types.MovieClip) -> set[int]:
    """The scene's frames in which the clip has clicks."""
    return {scene_frame(clip, m.frame) for track in _tracks(clip) for m in track.markers if m.is_keyed and not m.mute}


def clicks_of_frame(clips: dict[str, bpy.types.MovieClip], frame: int) -> tuple[Clicks, list[dict[str, list[float]]]]:
    """The clicks of one frame in all views: joints by name, in the skeleton's order, and surface seeds in the order of their numbers."""
    found: Clicks = {}
    for view, clip in clips.items():
        for track in _tracks(clip):
            marker = _keyed(track, clip_frame(clip, frame))
            if marker is not None:
                found.setdefault(track.name, {})[view] = pixel_of(marker.co, tuple(clip.size))
    joints = {name: found[name] for name in JOINTS if name in found}
    numbered = sorted((int(n[1]), name) for name in found if (n := SURFACE_SEED.fullmatch(name)))
    return joints, [found[name] for _, name in numbered]


def clear(clip: bpy.types.MovieClip) -> None:
    """Remove every click from the clip."""
    for track in list(_tracks(clip)):
        for own in [m.frame for m in track.markers]:
            remove_click(clip, track.name, scene_frame(clip, own))


def pixel_of(co: tuple[float, float], size_px: tuple[int, int]) -> list[float]:
    """The pixel [x, y] with the fewest decimals that Blender, in single precision, stores as these coordinates."""
    exact = axes.pixel_from_uv(np.array(co, dtype=np.float64), size_px)
    stored = np.float32(co)
    for digits in range(10):
        short = np.round(exact, digits)
        if np.array_equal(np.float32(axes.uv_from_pixel(short, size_px)), stored):
            return [float(v) for v in short]
    return [float(v) for v in exact]


def is_same_pixel(a: list[float], b: list[float], size_px: tuple[int, int]) -> bool:
    """Whether two pixels are the same marker in single precision."""
    uv = [np.float32(axes.uv_from_pixel(np.array(xy, dtype=np.float64), size_px)) for xy in (a, b)]
    return bool(np.array_equal(uv[0], uv[1]))


def _show_in_its_frames(track: bpy.types.MovieTrackingTrack) -> None:
    """Disable the frames next to each marker, as far as they have none, and delete all other disabled markers, but for the last one."""
    places = {marker.frame: tuple(marker.co) for marker in track.markers if not marker.mute}
    ends = {near: co for own, co in places.items() for near in (own - 1, own + 1) if near > 0 and near not in places}
    for own, co in ends.items():
        track.markers.insert_frame(own, co=co).mute = True
    for own in [marker.frame for marker in track.markers if marker.mute and marker.frame not in ends]:
        if len(track.markers) > 1:
            track.markers.delete_frame(own)


def _tracks(clip: bpy.types.MovieClip) -> Iterator[bpy.types.MovieTrackingTrack]:
    return (track for track in clip.tracking.tracks if is_click(track.name))


def _keyed(track: bpy.types.MovieTrackingTrack, own: int) -> bpy.types.MovieTrackingMarker | None:
    marker = track.markers.find_frame(own, exact=True)
    return marker if marker is not None and marker.is_keyed and not marker.mute else None
