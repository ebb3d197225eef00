"""A scene that the `tricap` command built, opened in Blender: its take, results and settings become the project of the panel.

The command builds scenes without the add-on's properties. The scene's collection stores where the results were, and where results and
take were relative to the .blend; whichever of these places has them now is used, so that the folders can be moved together.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ..core.foundation.bounded import real_path
from ..core.foundation.errors import InputError, sentence_of
from ..core.images.interlace import BOTH
from ..core.results.run_json import read_run
from ..core.take.footage import open_take as open_footage
from ..core.take.take import read_take
from ..core.take.writing import read_table
from . import folders, project, properties
from .scene import armature, clips, stored
from .scene.options import OUT_KEY, PLACES_KEY
from .session import get_session


def show_built_project(scene: bpy.types.Scene) -> bool:
    """Make the take of a built scene the scene's project, if it has none yet; returns whether it did.

    Raises:
        InputError: the take or its footage was not found, or is damaged.
    """
    built = next((c for c in scene.collection.children_recursive if OUT_KEY in c), None)
    if built is None or project.bound(scene) or scene.tricap.take or not bpy.data.filepath:
        return False
    out = _place(built, "out", Path(stored.text(built, OUT_KEY)), "run.json")
    if out is None:
        return False
    scene.tricap.out = folders.for_user(out)
    _choose_body(scene, built)
    run = read_run(out / "run.json")
    folder = _place(built, "take", Path(run.get("take", "")), "take.toml")
    if folder is None:
        raise InputError(f"The take of this scene is no longer at {run.get('take', '')}. Press Open Take and choose where it is now.")
    scene.tricap.take = folders.for_user(folder)
    take = read_take(folder)
    if take.interlaced == BOTH:  # its clips are made by the user's press: pictures of all fields are written
        return True
    table = read_table(folder)
    project.open_take(scene, folder, _clips_behind_cameras(built, project.files_of(folder, table["views"], take.field_layout)))
    _show_run(scene, folder, run)
    return True


def _place(built: bpy.types.Collection, what: str, absolute: Path, file: str) -> Path | None:
    """The folder of results or take that contains `file`: first relative to the .blend, then where it was."""
    relative = stored.table(built, PLACES_KEY).get(what)
    beside = [Path(bpy.data.filepath).parent / relative] if isinstance(relative, str) else []
    return next((real_path(place) for place in (*beside, absolute) if place.is_absolute() and (place / file).is_file()), None)


def _choose_body(scene: bpy.types.Scene, built: bpy.types.Collection) -> None:
    """The built armature is the source of retargeting, and exported."""
    body, chosen = built.all_objects.get(armature.NAME), scene.tricap_retarget
    if body is not None and body.type == "ARMATURE":
        chosen.source, chosen.export = chosen.source or body, chosen.export or body


def _clips_behind_cameras(built: bpy.types.Collection, files: dict[str, Path]) -> dict[str, bpy.types.MovieClip]:
    """By view, the clip behind its camera, which shows the footage where it is now."""
    found = {}
    for camera in (o for o in built.all_objects if o.type == "CAMERA"):
        clip, view = clips.clip_behind(camera.data), camera.get("tricap_view")
        if clip is not None and view in files:
            if real_path(bpy.path.abspath(clip.filepath)) != real_path(files[view]):
                clip.filepath = folders.for_user(files[view])
            found[view] = clip
    return found


def _show_run(scene: bpy.types.Scene, folder: Path, run: Mapping[str, Any]) -> None:
    """Show the frames and settings with which the run was made, where the command changed those of the take."""
    properties.check_settings(run.get("settings", {}), "run.json")
    properties.show_settings(scene, properties.changed_settings(run.get("settings", {})))
    first, stop = run.get("frames", (0, 0))
    if stop > first and open_footage(read_take(folder)).frames != range(first, stop):
        scene.tricap.all_frames, scene.tricap.first_frame, scene.tricap.last_frame = False, first, stop - 1


@bpy.app.handlers.persistent
def _file_loaded(*_: object) -> None:
    scene = bpy.context.scene
    if scene is not None:
        try:
            show_built_project(scene)
        except Exception as error:  # the edge of the handler: faults of the input and of the system are told, bugs are raised
            reason = sentence_of(error)
            if reason is None:
                raise
            get_session().file.take_problem = reason


def register() -> None:
    """Show the project of every file that is opened."""
    bpy.app.handlers.load_post.append(_file_loaded)


def unregister() -> None:
    """Stop it."""
    bpy.app.handlers.load_post.remove(_file_loaded)
