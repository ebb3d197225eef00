"""bpy.ops.tricap.add_footage(directory="…", files=[…]), .open_take(directory="…"), .reload_take(), .keep_mine(), .move_view(up=True),
.remove_view(), .reload_footage(), .find_footage(directory="…"), .common_frames()"""

from pathlib import Path
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.images.interlace import BOTH
from ...core.images.sequence import open_sequence
from ...core.take.footage_files import copy_take, find_footage, find_moved, name_views, take_files
from ...core.take.writing import footage_entry, link_footage, read_table, relink_footage, unlink_footage
from .. import folders, project
from ..panels import sentence
from ..scene.looking import show_all_frames
from . import watch
from .cameras import use_calibration_in
from .simple_operator import SimpleOperator
from .states import is_rate_assumed

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


class AddFootage(SimpleOperator, bpy.types.Operator):
    """Choose the movies of all cameras at once, the folder that contains a folder of images for each camera, or a take. A calibration
    in the same folder is used"""

    bl_idname = "tricap.add_footage"
    bl_label = "Add Footage"
    bl_options = {"UNDO"}

    directory: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", options=RELATIVE)  # type: ignore[valid-type]
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]
    filename: bpy.props.StringProperty(subtype="FILE_NAME", options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]
    fps: bpy.props.FloatProperty(
        name="FPS",
        default=0.0,
        min=0.0,
        max=10000.0,
        options={"SKIP_SAVE"},  # type: ignore[valid-type]
        description="Frame rate of image files; movies and takes have their own. 0: as in step 1",
    )
    offered_fps: bpy.props.FloatProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]  # the value with which the file browser opened
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_movie: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the files, unless the project's folder cannot be created."""
        try:
            folders.check_writable(project.folder_of(context.scene))
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.filename = ""  # not the name of the file that was saved last
        self.fps = self.offered_fps = context.scene.tricap.fps
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context: bpy.types.Context) -> None:
        """In the file browser's sidebar: what to choose."""
        sentence(self.layout, context, "Movies: open their folder. Select some with Shift or Ctrl, or nothing for all.", "FILE_MOVIE")
        sentence(self.layout, context, "Images: open the folder that contains a folder for each camera, and select nothing.", "FILE_IMAGE")
        if not project.bound(context.scene):
            self.layout.prop(self, "fps", text="FPS of Images")

    def do(self, context: bpy.types.Context) -> str:
        """Link the footage into the project and show it as clips; from a take also its values."""
        scene, place, names = context.scene, folders.absolute(self.directory), [f.name for f in self.files if f.name]
        fps = self.fps if self.fps != self.offered_fps else 0.0
        if not project.bound(scene) and take_files(place, names):
            return self._add_take(scene, place, fps)
        said = self._add_files(scene, place, names, fps)
        cameras = use_calibration_in(self, context, place)
        order = ", ".join(view.name for view in scene.tricap.views)
        return f"{said}, from left to right: {order}. If that is wrong, correct it in step 1.{cameras}"

    def _add_take(self, scene: bpy.types.Scene, place: Path, fps: float) -> str:
        """Link the footage of a take; copy its take.toml and cameras."""
        folder = project.make_folder(scene)
        copy_take(place, folder)
        project.open_take(scene, folder)
        show_frames(scene)
        if fps:
            scene.tricap.fps = fps
        project.write(scene)
        return f"{len(scene.tricap.views)} views, with the settings of {place / 'take.toml'}. Check them in step 1."

    def _add_files(self, scene: bpy.types.Scene, place: Path, names: list[str], fps: float) -> str:
        """Link movies and folders of images; `fps`: of images, 0 where the user entered none."""
        sources = find_footage(place, names)
        folder, first = project.make_folder(scene), not project.bound(scene)
        old = [project.view_entry(view) for view in scene.tricap.views]
        made = [footage_entry(folder, name, path) for name, path in name_views(sources, [entry["name"] for entry in old])]
        linked = link_footage(folder, [link for _, link in made])
        entries = [*old, *(entry for entry, _ in made)]
        try:
            files = project.files_of(folder, entries, project.fields_of(scene))
            project.show_views(scene, entries, files)
        except InputError:
            unlink_footage(linked)
            raise
        if first:
            use_rate_of(scene, fps)
            show_frames(scene)
        if lengths_differ(scene, folder):
            use_common_frames(scene, folder)
        if len(entries) > 1:
            project.write(scene)
        rate = f"{round(scene.tricap.fps, 3):g} fps{' (assumed: images state none)' if is_rate_assumed(scene) else ''}"
        return f"{len(made)} views added, {rate}"


class OpenTake(SimpleOperator, bpy.types.Operator):
    """Open a folder that contains take.toml: its footage, cameras, clicks and settings"""

    bl_idname = "tricap.open_take"
    bl_label = "Open Take"
    bl_options = {"UNDO"}

    directory: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml. Empty: the one in the panel",
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the folder, unless the panel has one that is not open yet."""
        if context.scene.tricap.take and not project.bound(context.scene):
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Show it."""
        scene = context.scene
        folder = folders.take_folder(self.directory, scene)
        if self.directory and scene.tricap.take and folder != folders.absolute(scene.tricap.take):
            scene.tricap.out = ""  # the results of another take
        first = not project.bound(scene)
        project.open_take(scene, folder)
        if first:
            show_frames(scene)
        return f"{folder.name}: {len(scene.tricap.views)} views."


class ReloadTake(SimpleOperator, bpy.types.Operator):
    """Read take.toml again; its values replace those in this file"""

    bl_idname = "tricap.reload_take"
    bl_label = "Reload Take"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Read it."""
        project.open_take(context.scene, project.existing_folder(context.scene))
        return "The take was reloaded."


class OverwriteTake(SimpleOperator, bpy.types.Operator):
    """Write the values of this file to take.toml; changes that were made outside Blender are lost"""

    bl_idname = "tricap.keep_mine"
    bl_label = "Overwrite Take"

    def do(self, context: bpy.types.Context) -> str:
        """Write it."""
        project.write(context.scene, overwrite=True)
        return "take.toml was overwritten."


class MoveView(bpy.types.Operator):
    """Move the view in the list; the cameras are listed from left to right"""

    bl_idname = "tricap.move_view"
    bl_label = "Move View"
    bl_options = {"UNDO"}

    up: bpy.props.BoolProperty(name="Up", default=True)  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Move it."""
        props = context.scene.tricap
        to = props.view_index + (-1 if self.up else 1)
        if not (0 <= to < len(props.views) and 0 <= props.view_index < len(props.views)):
            return {"CANCELLED"}
        props.views.move(props.view_index, to)
        props.view_index = to
        watch.refresh(context.scene)
        return {"FINISHED"}


class RemoveView(bpy.types.Operator):
    """Remove the view from the project; its files stay where they are"""

    bl_idname = "tricap.remove_view"
    bl_label = "Remove View"
    bl_options = {"UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it."""
        props = context.scene.tricap
        if not 0 <= props.view_index < len(props.views):
            return {"CANCELLED"}
        props.views.remove(props.view_index)
        props.view_index = max(0, props.view_index - 1)
        watch.refresh(context.scene)
        return {"FINISHED"}


class ReloadFootage(SimpleOperator, bpy.types.Operator):
    """Create deleted movie clips again, with their clicks from take.toml, or show the chosen fields of the footage"""

    bl_idname = "tricap.reload_footage"
    bl_label = "Reload Footage"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Create them again, or convert them."""
        scene, folder = context.scene, project.existing_folder(context.scene)
        if project.shows_other_fields(scene):
            project.show_fields(scene)
            return "Every field is a frame now." if scene.tricap.interlaced == BOTH else "Every image is a frame now."
        lost = [view.name for view in scene.tricap.views if view.clip is None]
        entries = [project.view_entry(view) for view in scene.tricap.views]
        files = project.files_of(folder, entries, project.fields_of(scene))
        project.show_views(scene, entries, files)
        project.show_clicks(scene, read_table(folder), lost)
        return f"{len(lost)} clips were created again."


class FindFootage(SimpleOperator, bpy.types.Operator):
    """Choose the folder to which the footage was moved: that with the movies, or with a folder of images for each camera"""

    bl_idname = "tricap.find_footage"
    bl_label = "Find Footage"

    directory: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", options=RELATIVE)  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_movie: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Link the project to that footage; clicks, offsets and results stay."""
        folder, views = project.existing_folder(context.scene), context.scene.tricap.views
        links = {v.name: folder / v.movie if v.movie else (folder / v.images).parent for v in views}
        relink_footage(find_moved(links, folders.absolute(self.directory)))
        for view in views:
            if view.clip is not None:
                view.clip.filepath = view.clip.filepath  # Blender reads it again
        return "The footage was found."


class CommonFrames(SimpleOperator, bpy.types.Operator):
    """Measure only the frames that all views have"""

    bl_idname = "tricap.common_frames"
    bl_label = "Use Common Frames"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Set the first and the last frame."""
        use_common_frames(context.scene, project.existing_folder(context.scene))
        return ""


def use_rate_of(scene: bpy.types.Scene, of_images: float) -> None:
    """Set the frame rate of the first movie, or that of the images (0: no change)."""
    rate = next((view.clip.fps for view in scene.tricap.views if view.clip.source == "MOVIE" and view.clip.fps > 0), of_images)
    if rate:
        scene.tricap.fps = rate


def show_frames(scene: bpy.types.Scene) -> None:
    """Set the scene's frame range to that of the footage, and show the click frame."""
    scene.frame_start, scene.frame_end = 0, max(0, min(view.clip.frame_duration for view in scene.tricap.views) - 1)
    scene.frame_current = min(scene.tricap.seed_frame, scene.frame_end)  # Clip Editors follow, which `frame_set` leaves where they are
    show_all_frames(bpy.context)


def lengths_differ(scene: bpy.types.Scene, folder: Path) -> bool:
    """Whether the views begin or end with different frames."""
    return len({span for span in _spans(scene, folder)}) > 1


def use_common_frames(scene: bpy.types.Scene, folder: Path) -> None:
    """Measure only the frames that all views have.

    Raises:
        InputError: there are none.
    """
    if any(view.has_clock for view in project.take(scene).views):
        scene.tricap.all_frames = True  # which are those that all views show
        return
    spans = _spans(scene, folder)
    first, stop = max(0, *(a for a, _ in spans)), min(b for _, b in spans)
    if stop <= first:
        raise InputError("With these offsets the views have no frame in common. Correct the offsets in step 1.")
    props = scene.tricap
    props.all_frames, props.first_frame, props.last_frame = False, first, stop - 1


def _spans(scene: bpy.types.Scene, folder: Path) -> list[tuple[int, int]]:
    def count(view: Any) -> int:
        return open_sequence(folder, images=view.images or None, movie=view.movie or None, view=view.name).count

    per = project.fields_of(scene).per_image
    return [(-per * view.offset_frames, per * (count(view) - view.offset_frames)) for view in scene.tricap.views]


CLASSES = (AddFootage, OpenTake, ReloadTake, OverwriteTake, MoveView, RemoveView, ReloadFootage, FindFootage, CommonFrames)
