"""Blender's own tracker (libmv) on the film of `tracking.py`, headless, in the `bpy` module: a peer of the 2-D mode.

Affine, against the keyframe's pattern, the window of ours: its most exact way. It runs from frame to frame within one operator; its time
includes decoding the pictures.
"""

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

PATTERN_PX, SEARCH_PX = 13, 45


def blender_tracks(frames: list[np.ndarray], start: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Paths (T, N, 2) of points (N, 2), NaN where lost, and the CPU seconds; None where there is no Blender."""
    try:
        import bpy
    except ImportError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        for i, frame in enumerate(frames):
            cv2.imwrite(str(Path(folder) / f"{i:04d}.png"), frame.astype(np.uint8))
        clip = bpy.data.movieclips.load(str(Path(folder) / "0000.png"))
        size = np.array(clip.size[:])
        for n, xy in enumerate(start):
            _add_track(clip, str(n), (xy + 0.5) / size * (1, -1) + (0, 1), size)
        seconds = _tracked(bpy, clip)
        path = np.full((len(frames), len(start), 2), np.nan)
        for n in range(len(start)):
            for marker in clip.tracking.tracks[str(n)].markers:
                if not marker.mute and 1 <= marker.frame <= len(frames):
                    path[marker.frame - 1, n] = (np.array(marker.co[:]) * (1, -1) + (0, 1)) * size - 0.5
    return path, seconds


def _add_track(clip: object, name: str, uv: np.ndarray, size: np.ndarray) -> None:
    track = clip.tracking.tracks.new(name=name, frame=1)  # type: ignore[attr-defined]
    track.motion_model, track.pattern_match, track.correlation_min = "Affine", "KEYFRAME", 0.75
    marker = track.markers.find_frame(1)
    marker.co = uv
    w, h = PATTERN_PX / 2 / size
    marker.pattern_corners = ((-w, -h), (w, -h), (w, h), (-w, h))
    marker.search_min, marker.search_max = -SEARCH_PX / 2 / size, SEARCH_PX / 2 / size
    track.select = True


def _tracked(bpy: object, clip: object) -> float:
    """Let Blender track all selected tracks to the clip's end; gives the CPU seconds."""
    context, scene = bpy.context, bpy.context.scene  # type: ignore[attr-defined]
    scene.frame_start, scene.frame_end = 1, clip.frame_duration  # type: ignore[attr-defined]
    scene.frame_set(1)
    window = context.window_manager.windows[0]
    area = max(window.screen.areas, key=lambda a: a.width * a.height)
    area.type = "CLIP_EDITOR"
    space = area.spaces.active
    space.clip, space.mode = clip, "TRACKING"
    region = next(r for r in area.regions if r.type == "WINDOW")
    begin = time.process_time()
    with context.temp_override(window=window, area=area, region=region, space_data=space):
        bpy.ops.clip.track_markers(backwards=False, sequence=True)  # type: ignore[attr-defined]
    return time.process_time() - begin
