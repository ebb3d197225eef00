"""Chosen points as native tracks: every track that is neither a joint nor a surface seed, whatever its name. Joined pairs are stored in the
clip, a custom property of lines “name<tab>other”."""

import bpy

from ...core.foundation.errors import InputError
from .. import clicks

JOINED = "tricap_joined"  # custom property of a clip


def points_of(clip: bpy.types.MovieClip, frame: int) -> dict[str, list[float]]:
    """The chosen points that are clicked in a frame of the scene: name → pixel [x, y]."""
    names = [track.name for track in clip.tracking.tracks if not clicks.is_click(track.name)]
    found = {name: clicks.get_click(clip, name, frame) for name in names}
    return {name: xy for name, xy in found.items() if xy is not None}


def points_in_views(clips: dict[str, bpy.types.MovieClip], frame: int) -> dict[str, dict[str, list[float]]]:
    """The chosen points that are clicked in two views or more: name → view → pixel.

    Raises:
        InputError: there are none, or one is clicked in a single view.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for view, clip in clips.items():
        for name, xy in points_of(clip, frame).items():
            found.setdefault(name, {})[view] = xy
    single = [name for name, at in found.items() if len(at) < 2]
    if not found:
        others = sorted({f for clip in clips.values() for f in clicked_frames(clip)})
        where = f"They are clicked in frame {others[0]}: go there." if others else "Press Click Points, and click each in two views."
        raise InputError(f"No points are clicked in frame {frame}. {where}")
    if single:
        raise InputError(f"“{single[0]}” is clicked in one view only. Click it in another view, or follow it in that view alone (2-D).")
    return found


def clicked_frames(clip: bpy.types.MovieClip) -> set[int]:
    """The scene's frames in which chosen points are clicked."""
    chosen = [track for track in clip.tracking.tracks if not clicks.is_click(track.name)]
    return {clicks.scene_frame(clip, m.frame) for track in chosen for m in track.markers if m.is_keyed and not m.mute}


def joined(clip: bpy.types.MovieClip) -> list[tuple[str, str]]:
    """The pairs of points of a clip that are joined by lines, without those whose track was deleted or renamed."""
    lines = [line.split("\t") for line in str(clip.get(JOINED, "")).splitlines()]
    names = set(clip.tracking.tracks.keys())
    return [(pair[0], pair[1]) for pair in lines if len(pair) == 2 and names.issuperset(pair)]


def join(clip: bpy.types.MovieClip, names: list[str]) -> bool:
    """Join points one to the next; if all of them are joined already, separate them. Whether they are joined now."""
    now, wanted = joined(clip), list(zip(names, names[1:]))
    there = [pair for pair in wanted if pair in now or pair[::-1] in now]
    apart = len(there) == len(wanted)
    rest = [pair for pair in now if pair not in wanted and pair[::-1] not in wanted]
    clip[JOINED] = "\n".join("\t".join(pair) for pair in (rest if apart else rest + wanted))
    return not apart
