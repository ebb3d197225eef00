"""bpy.ops.tricap.follow_points(): the clicked points in all views and in space; .follow_points2d(clip="face.mp4"): in one clip.

Both write the tables of the commands `tricap track --points` and `tricap track2d` into the output folder, and show them in the scene.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from .. import clicks, folders, project
from ..jobs import JobOperator
from ..overlay import canvas, results
from . import tracks
from .join import clip_named

if TYPE_CHECKING:
    from ...core.images.sequence import ImageSequence
    from ...core.tracking.planar import PlanarTracks
    from ...core.tracking.point_tables import KeyPointTable

PLANAR = "planar"  # folder of the tables of single clips, in OUT


class FollowPoints(JobOperator, bpy.types.Operator):
    """Follow the points that are clicked in this frame through all frames, in all views and in space; shows their paths over the footage,
    and in the 3D view with their velocities"""

    bl_idname = "tricap.follow_points"
    bl_label = "Follow Points"
    bl_options = {"UNDO"}

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], tuple[KeyPointTable, float]]":
        """The clicks of the current frame; writes the project's take.toml."""
        frame = context.scene.frame_current
        points = tracks.points_in_views(project.clips_of(context.scene), frame)
        take, out, overrides = project.chosen(context.scene, "", "")
        return lambda monitor: follow(take, out, overrides, points, frame, monitor)

    def finish(self, context: bpy.types.Context, result: "tuple[KeyPointTable, float]") -> set[str]:
        """Show the points."""
        from ..scene.key_points import add_key_points

        table, fps = result
        add_key_points(context.scene, table, fps)
        results.clear()
        context.scene.tricap_overlay.chosen = True
        canvas.redraw_clips(context)
        whole = int(np.isfinite(table.xyz_m).all(axis=(0, 2)).sum())
        told = f"{len(table.names)} points over {len(table.frames)} frames, {whole} of them visible in every frame."
        self.report({"INFO"}, told)
        return {"FINISHED"}


def follow(
    take: Path, out: Path, overrides: Any, points: dict[str, dict[str, list[float]]], frame: int, monitor: Monitor
) -> "tuple[KeyPointTable, float]":
    """The computation, without bpy: writes points3d.csv and points2d.csv; their content, and the frames a second."""
    from ...core.cli.points import follow_points
    from ...core.results.folder import Results
    from ...core.run.settings import settings_of
    from ...core.take.footage import open_take
    from ...core.take.take import read_take
    from ...core.tracking.point_tables import read_key_points, write_key_points

    opened = read_take(take)
    settings = settings_of(opened.settings, overrides, str(take / "take.toml"))
    footage = open_take(opened, click_sigma_px=settings["fitting"].click_sigma_px)
    if frame not in footage.frames:
        raise InputError(f"Frame {frame} is not among the frames {footage.frames.start} to {footage.frames.stop - 1} of the take.")
    chosen = {name: {view: np.array(xy) for view, xy in at.items()} for name, at in points.items()}
    with Results(out).opened() as folder:
        found = follow_points(footage, chosen, frame, settings, monitor)
        files = folder.path("points3d.csv"), folder.path("points2d.csv")
        write_key_points(*files, tuple(chosen), tuple(c.name for c in footage.rig.cameras), opened.fps, found)
    return read_key_points(*files), opened.fps


class FollowPoints2d(JobOperator, bpy.types.Operator):
    """Follow the points that are clicked in this frame through the images of this clip alone (2-D): no cameras are needed. Shows them over
    the footage as a picture in the 3D view, joined by lines"""

    bl_idname = "tricap.follow_points2d"
    bl_label = "Follow in This View (2-D)"
    bl_options = {"UNDO"}

    clip: bpy.props.StringProperty(name="Clip", description="Name of the clip. Empty: the one of the editor")  # type: ignore[valid-type]

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], Planar]":
        """The clicks of the current frame and the files of the clip."""
        clip, frame = clip_named(context, self.clip), context.scene.frame_current
        points = tracks.points_of(clip, frame)
        if not points:
            raise InputError(f"No points are clicked in frame {frame} of {clip.name}. Press Click Points (2-D), and click some.")
        name = re.sub(r"\W+", "_", clip.name, flags=re.ASCII).strip("_") or "clip"
        out, path = results_folder(context.scene), folders.absolute(clip.filepath)
        folders.check_writable(out)
        own, shift = clicks.clip_frame(clip, frame) + clip.frame_offset, clip.frame_start - 1 - clip.frame_offset
        pairs = [pair for pair in tracks.joined(clip) if points.keys() >= set(pair)]
        mine = project.view_of(context.scene, clip) is not None and context.scene.tricap.interlaced in ("odd", "even")
        interlaced = context.scene.tricap.interlaced if mine else "none"
        return lambda monitor: follow_planar(path, out / PLANAR / f"{name}.csv", points, pairs, (own, shift), interlaced, monitor)

    def finish(self, context: bpy.types.Context, result: "Planar") -> set[str]:
        """Build the picture with its points and lines."""
        from ...core.tracking.point_tables import read_planar
        from ..operators.build_scene import frame_in_views
        from ..scene.planar import add_planar

        made = add_planar(context.scene, read_planar(result.path), result.joined, result.sequence, first=result.shift)
        frame_in_views(self, context, made.objects[0], front=True)
        told = f"{made.name}: {len(result.names)} points over {len(result.tracks.frames)} frames, {len(result.joined)} lines; {result.path}"
        self.report({"INFO"}, told)
        return {"FINISHED"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Planar:
    """Points followed in one clip, and their table. Image n of the sequence is frame n + `shift` of the scene."""

    path: Path
    names: tuple[str, ...]
    joined: tuple[tuple[str, str], ...]
    tracks: "PlanarTracks"
    sequence: "ImageSequence"
    shift: int


def results_folder(scene: bpy.types.Scene) -> Path:
    """Where the tables of single clips are written: with the results of the take, or without one in the folder next to the Blender file.

    Raises:
        InputError: there is no take, and the Blender file was never saved.
    """
    if scene.tricap.take or scene.tricap.out:
        return folders.output_folder("", scene)
    return project.folder_of(scene) / project.RESULTS


def follow_planar(
    footage: Path,
    table: Path,
    points: dict[str, list[float]],
    pairs: list[tuple[str, str]],
    place: tuple[int, int],
    interlaced: str,
    monitor: Monitor,
) -> Planar:
    """The computation, without bpy: from the clicked image to both ends of the clip. `place`: the number (from 1) of the clicked image
    after the clip's first file, and what must be added to such a number for the frame of the scene."""
    from dataclasses import replace

    from ...core.cli.track2d import open_footage, settings_of_2d, track_both_ways
    from ...core.tracking.point_tables import write_planar

    sequence = open_footage(footage if not _is_image(footage) else footage.parent)
    files = sequence.files()
    first = files.index(footage) if footage in files else 0  # the clip may begin with a later image
    clicked = place[0] - 1 + first
    if not 0 <= clicked < sequence.count:
        raise InputError(f"{footage} has no image for this frame; go to a frame that shows the clip.")
    names, matching_and_tracking = tuple(points), settings_of_2d({})
    found = track_both_ways(sequence, np.array([*points.values()]), clicked, *matching_and_tracking, monitor, interlaced)
    shift = place[1] + 1 - first
    write_planar(table, names, replace(found, frames=found.frames + shift))
    return Planar(path=table, names=names, joined=tuple(pairs), tracks=found, sequence=sequence, shift=shift)


def _is_image(path: Path) -> bool:
    from ...core.images.sequence import IMAGE_ENDINGS

    return path.suffix.lower() in IMAGE_ENDINGS


CLASSES = (FollowPoints, FollowPoints2d)
