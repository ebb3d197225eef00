"""The project: a take on disk, beside the .blend, that says in take.toml what the scene says, so that the panel's buttons and the `tricap`
command give the same numbers.

    scene (views, clips, clicks, knobs)  ── write ──▶  TAKE/take.toml, footage linked into TAKE
    TAKE/take.toml                       ── open_take ──▶  scene

A scene is bound to a take once it has views of its own. Without views, a take that is merely named is run as its file stands.
Other parts of the add-on that keep something of take.toml in the scene add a function to `Session.take_writers` and `take_readers`.
"""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.foundation import store
from ..core.foundation.errors import InputError
from ..core.geometry.rig import Rig, read_rig
from ..core.images.interlace import BOTH, FieldLayout, field_layout
from ..core.take.sources import PERSON_SOURCES
from ..core.take.take import NO_BODY, Take
from ..core.take.take import body_model as take_body_model
from ..core.take.writing import Table, new_table, read_table, renumbered, take_of_table, write_table
from . import clicks, folders, properties
from .scene import clips
from .session import get_session

ENDING, RESULTS, VIEW_KEY = "_tricap", "results", "tricap_view"
OTHER_LINES = "The footage is shown in other frames than Lines now asks for; press Reload Footage to show it so."


def bound(scene: bpy.types.Scene) -> bool:
    """Whether the scene has footage of its own, so that its take.toml is written from it."""
    return len(scene.tricap.views) > 0


def folder_of(scene: bpy.types.Scene) -> Path:
    """The project's folder; it need not exist yet.

    Raises:
        InputError: none was chosen, and the .blend was never saved.
    """
    if scene.tricap.take:
        return folders.absolute(scene.tricap.take)
    if not bpy.data.filepath:
        raise InputError("Save the Blender file first (the project's folder is made beside it), or choose a folder for the project.")
    blend = Path(bpy.data.filepath)
    return blend.with_name(blend.stem + ENDING).resolve()


def make_folder(scene: bpy.types.Scene) -> Path:
    """The project's folder, made where it was not there; the scene remembers it and the folder for results in it.

    Raises:
        InputError: see `folder_of`; it cannot be written to, or holds the take of another file.
    """
    folder = folder_of(scene)
    if not bound(scene) and (folder / "take.toml").exists():
        raise InputError(f"{folder} holds a take already; press Open Take to go on with it, or choose another folder for the project.")
    folders.check_writable(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the folder {folder}: {error.strerror or error}. Choose another place for the project.") from error
    scene.tricap.take = folders.for_user(folder)
    if not scene.tricap.out:
        scene.tricap.out = folders.for_user(folder / RESULTS)
    return folder


def clips_of(scene: bpy.types.Scene) -> dict[str, bpy.types.MovieClip]:
    """The clip of every view, in the order of the views.

    Raises:
        InputError: a clip was deleted.
    """
    for view in scene.tricap.views:
        if view.clip is None:
            raise InputError(f"The movie clip of view {view.name} was deleted; press Reload Footage.")
    return {view.name: view.clip for view in scene.tricap.views}


def view_of(scene: bpy.types.Scene, clip: bpy.types.MovieClip | None) -> Any:
    """The view (name, clip, images or movie, offset_frames) that a clip shows, or None."""
    return next((view for view in scene.tricap.views if clip is not None and view.clip == clip), None)


def rig_of(scene: bpy.types.Scene) -> Rig | None:
    """The project's cameras, None where there are none yet.

    Raises:
        InputError: rig.toml is damaged.
    """
    path = take(scene).rig_path
    return read_rig(path) if path.exists() else None


def take(scene: bpy.types.Scene) -> Take:
    """The take as the scene says it now; nothing is written.

    Raises:
        InputError: something is missing or cannot be.
    """
    folder = folder_of(scene)
    return take_of_table(folder, table(scene))


def write(scene: bpy.types.Scene, *, overwrite: bool = False) -> Path:
    """Write take.toml as the scene says it, if it differs; gives the project's folder.

    Raises:
        InputError: the folder is gone or read-only, the scene's values cannot be, or somebody else changed the file (unless `overwrite`).
    """
    folder = existing_folder(scene)
    if shows_other_lines(scene):
        raise InputError(OTHER_LINES)
    if not overwrite and changed_outside(scene):
        raise InputError(f"{folder / 'take.toml'} was changed outside this file; press Reload Take to take that over, or Keep Mine.")
    write_table(folder, table(scene))
    remember(scene, folder)
    return folder


def fields_of(scene: bpy.types.Scene) -> FieldLayout:
    """Where in the footage's images the scene's frames are."""
    return field_layout(scene.tricap.interlaced, scene.tricap.first_field)


def shows_other_lines(scene: bpy.types.Scene) -> bool:
    """Whether the clips show whole images where fields are wanted, or the other way about: frames have other numbers then."""
    wanted = _first_field(scene)
    return any(view.clip is not None and view.clip.get(clips.FIELDS_KEY, "") != wanted for view in scene.tricap.views)


def show_lines(scene: bpy.types.Scene) -> None:
    """Show the footage as `interlaced` wants it, with every frame's number in take.toml, clicks and corrections changed to suit.

    Raises:
        InputError: take.toml cannot be written, or the fields' pictures cannot be made.
    """
    folder = existing_folder(scene)
    shown = max(clips.frames_per_image(clip) for clip in clips_of(scene).values())
    per_image = fields_of(scene).per_image
    write_table(folder, renumbered(table(scene), per_image, shown))
    open_take(scene, folder)
    scene.frame_end = (scene.frame_end + 1) * per_image // shown - 1


def _first_field(scene: bpy.types.Scene) -> str:
    """The field that is first where both are measured, else ""."""
    return str(scene.tricap.first_field) if scene.tricap.interlaced == BOTH else ""


def files_of(folder: Path, entries: Sequence[Table], fields: FieldLayout) -> dict[str, Path]:
    """By view, the file by which Blender opens the footage of every entry of [[views]].

    Raises:
        InputError: footage is missing.
    """
    return {e["name"]: clips.first_file(folder, e.get("images"), e.get("movie"), e["name"], fields) for e in entries}


def edit(scene: bpy.types.Scene, change: Callable[[Table], None]) -> None:
    """Write take.toml with a change of something that the scene does not keep itself.

    Raises:
        InputError: see `write`; the changed table is no take.
    """
    folder = write(scene)
    edited = read_table(folder)
    change(edited)
    write_table(folder, edited)
    remember(scene, folder)


def existing_folder(scene: bpy.types.Scene) -> Path:
    """The project's folder.

    Raises:
        InputError: it is not there any more.
    """
    folder = folder_of(scene)
    if not folder.is_dir():
        raise InputError(f"The project's folder {folder} is not there; move it back, or choose where it is now.")
    return folder


def changed_outside(scene: bpy.types.Scene) -> bool:
    """Whether take.toml says something that this scene neither read nor wrote."""
    path = folder_of(scene) / "take.toml"
    return path.exists() and store.digest(path) not in {scene.tricap.take_digest, *get_session().take_digests}


def remember(scene: bpy.types.Scene, folder: Path) -> None:
    """The file is now what the scene says."""
    digest = store.digest(folder / "take.toml")
    get_session().take_digests.add(digest)
    scene.tricap.take_digest = digest


def table(scene: bpy.types.Scene) -> Table:
    """What take.toml is to say: what the file says, with what the scene keeps put in its place.

    Raises:
        InputError: a clip was deleted, or the file that is there is no take.
    """
    props, old = scene.tricap, read_table(folder_of(scene))
    made = dict(old) or new_table([])
    views = [view_entry(view) for view in props.views]
    made |= {"fps": properties.exact(props.fps), "interlaced": props.interlaced, "views": views}
    said = props.first_field != "odd" or "first_field" in old  # odd need not be said
    _put(made, "first_field", _first_field(scene) if said else "")
    _put(made, "reference_view", props.reference_view if props.reference_view in [view.name for view in props.views] else "")
    _put(made, "frames", None if props.all_frames else [props.first_frame, props.last_frame + 1])
    _put(made, "body", _body(scene, old))
    _put_clicks(scene, made)
    _put(made, "settings", properties.overrides(scene))
    for writer in get_session().take_writers:
        writer(scene, made)
    return _kept_alike(made, old)


def open_take(scene: bpy.types.Scene, folder: Path) -> None:
    """Show a take in the scene: its footage as clips, its clicks as tracks, its values and settings in the panel.

    Raises:
        InputError: it is no take, or its footage cannot be opened; the scene is as it was.
    """
    said = read_table(folder)
    if not said:
        raise InputError(f"{folder} is not a take: there is no take.toml in it. Add footage to make one.")
    opened = take_of_table(folder, said)
    properties.check_settings(opened.settings, str(folder / "take.toml"))
    files = files_of(folder, said["views"], opened.field_layout)
    props = scene.tricap
    props.take = folders.for_user(folder)
    props.fps, props.interlaced, props.first_field = said["fps"], opened.interlaced, opened.first_field
    show_views(scene, said["views"], files)
    props.reference_view = said.get("reference_view", "")
    props.all_frames = opened.frames is None
    if opened.frames:
        props.first_frame, props.last_frame = opened.frames[0], opened.frames[1] - 1
    _show_model(scene, said.get("body", {}).get("model", ""))
    props.seed_frame = opened.seeds.frame
    show_clicks(scene, said, [view.name for view in opened.views])
    properties.show_settings(scene, opened.settings)
    for reader in get_session().take_readers:
        reader(scene, said)
    remember(scene, folder)


def show_views(scene: bpy.types.Scene, entries: list[Table], files: dict[str, Path]) -> None:
    """Make the scene's views those of `entries` ([[views]]), with a clip each; a clip that shows the file already is kept.

    Raises:
        InputError: Blender cannot read a file; the views are as they were.
    """
    props = scene.tricap
    kept = {view.name: view.clip for view in props.views if view.clip is not None}
    shown = {name: _clip_of(kept.get(name), name, path) for name, path in files.items()}
    props.views.clear()
    for entry in entries:
        view = props.views.add()
        view.clip = shown[entry["name"]]
        view.clip[clips.FIELDS_KEY] = _first_field(scene)
        view.name = entry["name"]
        view.images, view.movie = entry.get("images", ""), entry.get("movie", "")
        view.offset_frames = entry.get("offset_frames", 0)
        view.person = next((key for key in PERSON_SOURCES if key in entry), "")
        view.person_files = entry.get(view.person, "")


def _clip_of(known: bpy.types.MovieClip | None, name: str, path: Path) -> bpy.types.MovieClip:
    """The clip that is there, if it shows the file, else a new one."""
    if known is not None and Path(bpy.path.abspath(known.filepath)).resolve() == path.resolve():
        return known
    return clips.open_clip(f"Footage {name}", path)


def _body(scene: bpy.types.Scene, old: Table) -> Table | None:
    """[body]; a file that has none stays without while no body is chosen."""
    if model_of(scene):
        return {**old.get("body", {}), "model": model_of(scene)}
    return {"model": NO_BODY} if "body" in old or not old else None


def model_of(scene: bpy.types.Scene) -> str:
    """The body model as take.toml names it, "" for none."""
    props = scene.tricap
    return {NO_BODY: "", "own": props.model_file}.get(props.model, props.model)


def body_model(scene: bpy.types.Scene) -> str | None:
    """The body model as `read_model` takes it, a file of the project with its path; None for none.

    Raises:
        InputError: the file does not lie in the project's folder.
    """
    return take_body_model(folder_of(scene), model_of(scene) or None, "the panel")


def _show_model(scene: bpy.types.Scene, name: str) -> None:
    props = scene.tricap
    known = {item.identifier for item in props.bl_rna.properties["model"].enum_items}
    props.model = name if name in known else "own" if name else NO_BODY
    props.model_file = name if props.model == "own" else ""


def view_entry(view: Any) -> Table:
    """What [[views]] says of a view."""
    entry = {"name": view.name, "images": view.images, "movie": view.movie, "offset_frames": view.offset_frames}
    if view.person:
        entry[view.person] = view.person_files
    return {key: value for key, value in entry.items() if value or key == "name"}


def _put(made: Table, key: str, value: Any) -> None:
    """A key with its value, or no such key where there is nothing to say."""
    if value:
        made[key] = value
    else:
        made.pop(key, None)


def _put_clicks(scene: bpy.types.Scene, made: Table) -> None:
    """[seeds] and [[keyframes]] from the clips; a pixel that the file has in more decimals than Blender is left as it is."""
    shown, frame = clips_of(scene), scene.tricap.seed_frame
    sizes = {view: tuple(clip.size) for view, clip in shown.items()}
    joints, surface = clicks.clicks_of_frame(shown, frame)
    old, old_keys = made.get("seeds", {}), {k.get("frame", 0): k for k in made.get("keyframes", [])}
    joints = _same_pixels(joints, old.get("joints", {}), sizes)
    before = dict(enumerate(old.get("surface", [])))
    surface = [*_same_pixels(dict(enumerate(surface)), before, sizes).values()]
    said = {"frame": frame, "surface": surface, "joints": joints}
    _put(made, "seeds", {k: v for k, v in said.items() if v or k == "frame"} if frame or joints or surface else None)
    others = sorted({f for clip in shown.values() for f in clicks.clicked_frames(clip)} - {frame})
    keyframes = [(f, _same_pixels(clicks.clicks_of_frame(shown, f)[0], old_keys.get(f, {}).get("joints", {}), sizes)) for f in others]
    _put(made, "keyframes", [{"frame": f, "joints": clicked} for f, clicked in keyframes if clicked])


def _same_pixels(new: dict[Any, Any], old: dict[Any, Any], sizes: dict[str, tuple[int, int]]) -> dict[Any, Any]:
    def same(name: Any, view: str, xy: list[float]) -> list[float]:
        before = old.get(name, {}).get(view)
        return before if before is not None and clicks.is_same_pixel(before, xy, sizes[view]) else xy

    return {name: {view: same(name, view, xy) for view, xy in at.items()} for name, at in new.items()}


def show_clicks(scene: bpy.types.Scene, said: Table, views: Collection[str]) -> None:
    """Show the clicks of a take.toml's table in the clips of these views, in the place of those that are there."""
    shown = {view: clip for view, clip in clips_of(scene).items() if view in views}
    for clip in shown.values():
        clicks.clear(clip)
    for group in (said.get("seeds", {}), *said.get("keyframes", [])):
        numbered = {f"seed {i + 1}": at for i, at in enumerate(group.get("surface", []))}
        for name, at in {**group.get("joints", {}), **numbered}.items():
            for view in at.keys() & shown.keys():
                clicks.set_click(shown[view], name, group.get("frame", 0), at[view])


def _kept_alike(new: Any, old: Any) -> Any:
    """`new`, where a number that single precision cannot tell from the old one is the old one."""
    if isinstance(new, dict) and isinstance(old, dict):
        return {key: _kept_alike(value, old.get(key)) for key, value in new.items()}
    numbers = isinstance(new, float) and isinstance(old, (int, float)) and not isinstance(old, bool)
    return old if numbers and np.float32(new) == np.float32(old) else new


def chosen(scene: bpy.types.Scene, take: str, out: str) -> tuple[Path, Path, dict[str, dict[str, Any]]]:
    """What an operator is to run: the take's folder, that for the results, and the knobs to put over the take's own.

    The scene's project is written to take.toml first, its knobs with it; another take is run as its file stands, with the panel's knobs.

    Raises:
        InputError: no take is chosen, it cannot be, or a folder cannot be written to.
    """
    ours = bound(scene) and (not take or folders.absolute(take) == folder_of(scene))
    folder = write(scene) if ours else folders.take_folder(take, scene)
    results = folders.output_folder(out, scene, str(folder))
    folders.check_writable(results)
    return folder, results, {} if ours else properties.overrides(scene)
