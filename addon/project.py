"""The project: a take on disk, next to the .blend, whose take.toml has the same values as the scene, so that the panel's buttons and the
`tricap` command give the same numbers.

    scene (views, clips, clicks, settings)  ── write ──▶  TAKE/take.toml, footage linked into TAKE
    TAKE/take.toml                       ── open_take ──▶  scene

A scene is bound to a take once it has views. Without views, the take that the panel names is run as its file is.
Other parts of the add-on that have values of take.toml in the scene add a function to `Session.take_writers` and `take_readers`.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.foundation import store
from ..core.foundation.bounded import real_path
from ..core.foundation.errors import InputError
from ..core.geometry.rig import Rig, read_rig
from ..core.images.interlace import BOTH, FieldLayout, field_layout
from ..core.take.sources import PERSON_SOURCES
from ..core.take.take import AUTO_BODY, NO_BODY, TOP_LEVEL, Take, model_of_joints
from ..core.take.take import body_model as take_body_model
from ..core.take.writing import Table, new_table, read_table, renumbered, take_of_table, write_table
from . import clicks, folders, properties
from .scene import clips
from .session import get_session

ENDING, RESULTS, VIEW_KEY = "_tricap", "results", "tricap_view"
SAMPLE_NAME = "tricap_sample"  # the folder that Load Sample makes
SAME_RATE = 1e-3  # relative difference of the images per second that does not show
OTHER_FIELDS = "The footage does not show the chosen fields. Press Reload Footage."
CHANGED_OUTSIDE = "take.toml was changed outside Blender. Reload Take uses these changes, Overwrite Take discards them."


def bound(scene: bpy.types.Scene) -> bool:
    """Whether the scene has footage, so that take.toml is written from the scene."""
    return len(scene.tricap.views) > 0


def is_sample(scene: bpy.types.Scene) -> bool:
    """Whether the scene's footage is that of the sample."""
    return bool(scene.tricap.take) and folders.absolute(scene.tricap.take).name == SAMPLE_NAME


def folder_of(scene: bpy.types.Scene) -> Path:
    """The project's folder; it need not exist yet.

    Raises:
        InputError: none was chosen, and the .blend was never saved.
    """
    if scene.tricap.take:
        return folders.absolute(scene.tricap.take)
    if not bpy.data.filepath:
        raise InputError("Save the Blender file first: the project folder is created next to it. Or choose a folder for the project.")
    blend = Path(bpy.data.filepath)
    return real_path(blend.with_name(blend.stem + ENDING))


def make_folder(scene: bpy.types.Scene) -> Path:
    """The project's folder, created if needed; the scene stores it and the folder for the results in it.

    Raises:
        InputError: see `folder_of`; it cannot be written to, or contains the take of another file.
    """
    folder = folder_of(scene)
    if not bound(scene) and (folder / "take.toml").exists():
        raise InputError(f"{folder} already contains a take. Press Open Take to use it, or choose another folder for the project.")
    folders.check_writable(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot create the folder {folder}: {error.strerror or error}. Choose another place for the project.") from error
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
            raise InputError(f"The movie clip of view {view.name} was deleted. Press Reload Footage.")
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
    """The take with the scene's current values; nothing is written.

    Raises:
        InputError: something is missing or invalid.
    """
    folder = folder_of(scene)
    return take_of_table(folder, table(scene))


def write(scene: bpy.types.Scene, *, overwrite: bool = False) -> Path:
    """Write take.toml from the scene, if it differs; returns the project's folder.

    Raises:
        InputError: the folder is missing or read-only, a value is invalid, or the file was changed outside (unless `overwrite`).
    """
    folder = existing_folder(scene)
    if shows_other_fields(scene):
        raise InputError(OTHER_FIELDS)
    if not overwrite and changed_outside(scene):
        raise InputError(CHANGED_OUTSIDE)
    write_table(folder, table(scene))
    remember(scene, folder)
    return folder


def fields_of(scene: bpy.types.Scene) -> FieldLayout:
    """Which images and fields of the footage are the scene's frames."""
    return field_layout(scene.tricap.interlaced, scene.tricap.first_field)


def shows_other_fields(scene: bpy.types.Scene) -> bool:
    """Whether the clips show whole images where fields are chosen, or the reverse: their frame numbers differ."""
    wanted = _first_field(scene)
    return any(view.clip is not None and view.clip.get(clips.FIELDS_KEY, "") != wanted for view in scene.tricap.views)


def check_rates(scene: bpy.types.Scene) -> None:
    """Refuse clicks in views of which Blender cannot show the image of every frame.

    Raises:
        InputError: a view has its own images per second, or time stamps.
    """
    rate = scene.tricap.fps
    for view in scene.tricap.views:
        if view.timestamps or (view.fps and abs(view.fps / rate - 1) > SAME_RATE):
            raise InputError(
                f"View {view.name} does not have {rate:g} images per second like the take, and Blender would show it at other moments "
                "than the other views. Start without clicks, or write them into take.toml."
            )


def show_fields(scene: bpy.types.Scene) -> None:
    """Show the chosen fields of the footage; the frame numbers in take.toml, of clicks and corrections are converted.

    Raises:
        InputError: take.toml cannot be written, or the images of the fields cannot be made.
    """
    folder = existing_folder(scene)
    shown = max(clips.frames_per_image(clip) for clip in clips_of(scene).values())
    per_image = fields_of(scene).per_image
    write_table(folder, renumbered(table(scene), per_image, shown))
    open_take(scene, folder)
    scene.frame_end = (scene.frame_end + 1) * per_image // shown - 1


def _first_field(scene: bpy.types.Scene) -> str:
    """The field that comes first if both are measured, else ""."""
    return str(scene.tricap.first_field) if scene.tricap.interlaced == BOTH else ""


def files_of(folder: Path, entries: Sequence[Table], fields: FieldLayout) -> dict[str, Path]:
    """By view, the file with which Blender opens the footage of every entry of [[views]].

    Raises:
        InputError: footage is missing.
    """
    return {e["name"]: clips.first_file(folder, e.get("images"), e.get("movie"), e["name"], fields) for e in entries}


def edit(scene: bpy.types.Scene, change: Callable[[Table], None]) -> None:
    """Change something in take.toml that the scene has no value for.

    Raises:
        InputError: see `write`; the changed table is not a valid take.
    """
    folder = write(scene)
    edited = read_table(folder)
    change(edited)
    write_table(folder, edited)
    remember(scene, folder)


def existing_folder(scene: bpy.types.Scene) -> Path:
    """The project's folder.

    Raises:
        InputError: it no longer exists.
    """
    folder = folder_of(scene)
    if not folder.is_dir():
        raise InputError(f"The project folder {folder} does not exist. Move it back, or choose where it is now in step 1.")
    return folder


def changed_outside(scene: bpy.types.Scene) -> bool:
    """Whether take.toml is in a version that this scene neither read nor wrote."""
    path = folder_of(scene) / "take.toml"
    return path.exists() and store.digest(path) not in {scene.tricap.take_digest, *get_session().take_digests}


def remember(scene: bpy.types.Scene, folder: Path) -> None:
    """The file and the scene now agree."""
    digest = store.digest(folder / "take.toml")
    get_session().take_digests.add(digest)
    scene.tricap.take_digest = digest


def table(scene: bpy.types.Scene) -> Table:
    """The table for take.toml: that of the file, with the scene's values.

    Raises:
        InputError: a clip was deleted, or the existing file is not a valid take.
    """
    props, old = scene.tricap, read_table(folder_of(scene))
    made = dict(old) or new_table([])
    views = [view_entry(view) for view in props.views]
    made |= {"fps": properties.exact(props.fps), "interlaced": props.interlaced, "views": views}
    needed = props.first_field != "odd" or "first_field" in old  # odd is the default
    _put(made, "first_field", _first_field(scene) if needed else "")
    _put(made, "reference_view", props.reference_view if props.reference_view in [view.name for view in props.views] else "")
    _put(made, "frames", None if props.all_frames else [props.first_frame, props.last_frame + 1])
    _put(made, "body", _body(scene, old))
    _put_clicks(scene, made)
    settings = properties.overrides(scene)
    for key, group in TOP_LEVEL.items():
        _put(made, key, settings.get(group, {}).pop(key, None))
    _put(made, "settings", {group: values for group, values in settings.items() if values})
    for writer in get_session().take_writers:
        writer(scene, made)
    return _same_numbers(made, old)


def open_take(scene: bpy.types.Scene, folder: Path, shown: Mapping[str, bpy.types.MovieClip] | None = None) -> None:
    """Show a take in the scene: its footage as clips, its clicks as tracks, its values and settings in the panel.

    `shown`: by view, clips of the file that are used where they show its footage.

    Raises:
        InputError: it is not a take, or its footage cannot be opened; the scene is unchanged.
    """
    saved = read_table(folder)
    if not saved:
        raise InputError(f"{folder} is not a take: it has no take.toml. Press Add Footage to make a new one.")
    opened = take_of_table(folder, saved)
    properties.check_settings(opened.settings, str(folder / "take.toml"))
    files = files_of(folder, saved["views"], opened.field_layout)
    props = scene.tricap
    props.take = folders.for_user(folder)
    props.fps, props.interlaced, props.first_field = saved["fps"], opened.interlaced, opened.first_field
    show_views(scene, saved["views"], files, shown)
    props.reference_view = saved.get("reference_view", "")
    props.all_frames = opened.frames is None
    if opened.frames:
        props.first_frame, props.last_frame = opened.frames[0], opened.frames[1] - 1
    _show_model(scene, saved.get("body", {}).get("model", ""))
    props.seed_frame = opened.clicks.frame
    show_clicks(scene, saved, [view.name for view in opened.views])
    properties.show_settings(scene, opened.settings)
    for reader in get_session().take_readers:
        reader(scene, saved)
    remember(scene, folder)


def show_views(
    scene: bpy.types.Scene, entries: list[Table], files: dict[str, Path], shown: Mapping[str, bpy.types.MovieClip] | None = None
) -> None:
    """Make the scene's views those of `entries` ([[views]]), with a clip each; a clip of the views, or of `shown`, that already shows the
    file is reused.

    Raises:
        InputError: Blender cannot read a file; the views are unchanged.
    """
    props = scene.tricap
    before = dict(shown or {}) | {view.name: view.clip for view in props.views if view.clip is not None}
    clip_of = {name: _clip_of(before.get(name), name, path) for name, path in files.items()}
    props.views.clear()
    for entry in entries:
        view = props.views.add()
        view.clip = clip_of[entry["name"]]
        view.clip[clips.FIELDS_KEY] = _first_field(scene)
        view.name = entry["name"]
        view.images, view.movie = entry.get("images", ""), entry.get("movie", "")
        view.fps, view.drift_ppm, view.timestamps = entry.get("fps", 0.0), entry.get("drift_ppm", 0.0), entry.get("timestamps", "")
        view.readout_s = entry.get("readout", 0.0)
        view.start_s, view.offset_frames = entry.get("start", 0.0), entry.get("offset_frames", 0)
        view.person = next((key for key in PERSON_SOURCES if key in entry), "")
        view.person_files = entry.get(view.person, "")


def _clip_of(clip: bpy.types.MovieClip | None, name: str, path: Path) -> bpy.types.MovieClip:
    """This clip, if it shows the file, else a new one."""
    if clip is not None and real_path(bpy.path.abspath(clip.filepath)) == real_path(path):
        return clip
    return clips.open_clip(f"Footage {name}", path)


def _body(scene: bpy.types.Scene, old: Table) -> Table | None:
    """[body]; without a model if that is chosen by what is seen, and left out if it is empty."""
    model, said = model_of(scene), {key: value for key, value in old.get("body", {}).items() if key != "model"}
    if model == NO_BODY:
        return {"model": NO_BODY}
    return {**said, **({} if model == AUTO_BODY else {"model": model})} or None


def model_of(scene: bpy.types.Scene) -> str:
    """The body model as take.toml names it, `AUTO_BODY` where it is left out."""
    props = scene.tricap
    return str(props.model_file or NO_BODY) if props.model == "own" else str(props.model)


def joints_model(scene: bpy.types.Scene) -> str | None:
    """The model whose joints are clicked as `read_model` takes it, a file of the project with its path; None for none.

    Raises:
        InputError: the file is not in the project's folder.
    """
    return model_of_joints(take_body_model(folder_of(scene), model_of(scene), "the panel"))


def _show_model(scene: bpy.types.Scene, name: str) -> None:
    props = scene.tricap
    known = {item.identifier for item in props.bl_rna.properties["model"].enum_items}
    props.model = name if name in known else "own" if name else AUTO_BODY
    props.model_file = name if props.model == "own" else ""


def view_entry(view: Any) -> Table:
    """The entry of a view in [[views]]."""
    entry = {"name": view.name, "images": view.images, "movie": view.movie, "offset_frames": view.offset_frames}
    entry |= {"fps": properties.exact(view.fps), "start": properties.exact(view.start_s)}
    entry |= {"drift_ppm": properties.exact(view.drift_ppm), "timestamps": view.timestamps}
    entry |= {"readout": properties.exact(view.readout_s)}
    if view.person:
        entry[view.person] = view.person_files
    return {key: value for key, value in entry.items() if value or key == "name"}


def _put(made: Table, key: str, value: Any) -> None:
    """Set a key to its value, or remove it if the value is empty."""
    if value:
        made[key] = value
    else:
        made.pop(key, None)


def _put_clicks(scene: bpy.types.Scene, made: Table) -> None:
    """[seeds] and [[keyframes]] from the clips; a pixel that has more decimals in the file than Blender can store stays as it is."""
    shown, frame = clips_of(scene), scene.tricap.seed_frame
    sizes = {view: tuple(clip.size) for view, clip in shown.items()}
    joints, surface = clicks.clicks_of_frame(shown, frame)
    old, old_keys = made.get("seeds", {}), {k.get("frame", 0): k for k in made.get("keyframes", [])}
    joints = _same_pixels(joints, old.get("joints", {}), sizes)
    before = dict(enumerate(old.get("surface", [])))
    surface = [*_same_pixels(dict(enumerate(surface)), before, sizes).values()]
    clicked = {"frame": frame, "surface": surface, "joints": joints}
    _put(made, "seeds", {k: v for k, v in clicked.items() if v or k == "frame"} if frame or joints or surface else None)
    others = sorted({f for clip in shown.values() for f in clicks.clicked_frames(clip)} - {frame})
    keyframes = [(f, _same_pixels(clicks.clicks_of_frame(shown, f)[0], old_keys.get(f, {}).get("joints", {}), sizes)) for f in others]
    _put(made, "keyframes", [{"frame": f, "joints": in_frame} for f, in_frame in keyframes if in_frame])


def _same_pixels(new: dict[Any, Any], old: dict[Any, Any], sizes: dict[str, tuple[int, int]]) -> dict[Any, Any]:
    def same(name: Any, view: str, xy: list[float]) -> list[float]:
        before = old.get(name, {}).get(view)
        return before if before is not None and clicks.is_same_pixel(before, xy, sizes[view]) else xy

    return {name: {view: same(name, view, xy) for view, xy in at.items()} for name, at in new.items()}


def show_clicks(scene: bpy.types.Scene, saved: Table, views: Collection[str]) -> None:
    """Replace the clicks in the clips of these views by those of a take.toml's table."""
    shown = {view: clip for view, clip in clips_of(scene).items() if view in views}
    for clip in shown.values():
        clicks.clear(clip)
    for group in (saved.get("seeds", {}), *saved.get("keyframes", [])):
        numbered = {f"seed {i + 1}": at for i, at in enumerate(group.get("surface", []))}
        for name, at in {**group.get("joints", {}), **numbered}.items():
            for view in at.keys() & shown.keys():
                clicks.set_click(shown[view], name, group.get("frame", 0), at[view])


def _same_numbers(new: Any, old: Any) -> Any:
    """`new`, with the old numbers where they are equal in single precision."""
    if isinstance(new, dict) and isinstance(old, dict):
        return {key: _same_numbers(value, old.get(key)) for key, value in new.items()}
    numbers = isinstance(new, float) and isinstance(old, (int, float)) and not isinstance(old, bool)
    return old if numbers and np.float32(new) == np.float32(old) else new


def chosen(scene: bpy.types.Scene, take: str, out: str) -> tuple[Path, Path, dict[str, dict[str, Any]]]:
    """What an operator runs: the take's folder, the folder for the results, and the settings that override the take's own.

    The scene's project is first written to take.toml, settings included; another take is run as its file is, with the panel's settings.

    Raises:
        InputError: no take is chosen, it is invalid, or a folder cannot be written to.
    """
    ours = bound(scene) and (not take or folders.absolute(take) == folder_of(scene))
    folder = write(scene) if ours else folders.take_folder(take, scene)
    results = folders.output_folder(out, scene, str(folder))
    folders.check_writable(results)
    return folder, results, {} if ours else properties.overrides(scene)
