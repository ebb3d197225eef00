"""bpy.ops.tricap.person_from(kind="mask", view="L", filepath="…"): where a view shows the person, as masks or the empty background say."""

from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.take.sources import person_files, read_picture
from ...core.take.writing import link_footage
from .. import folders, project
from .footage import Told

FOUND = "none"
KINDS = (
    (FOUND, "Found by Itself", "The person is found by clicks, depth and motion"),
    ("mask", "One Mask", "An image of the view's size, white where the person is, for all frames"),
    ("masks", "A Mask for Every Image", "A folder of such images, one for every image of the view; choose one of them"),
    ("background", "The Empty Background", "An image that the same camera took without the person"),
)


class PersonFrom(Told, bpy.types.Operator):
    """Say where the chosen view shows the person: by masks, or by an image of the empty background. What is measured must lie inside"""

    bl_idname = "tricap.person_from"
    bl_label = "Person From"
    bl_options = {"UNDO"}

    kind: bpy.props.EnumProperty(name="From", items=KINDS)  # type: ignore[valid-type]
    view: bpy.props.StringProperty(
        name="View",
        description="Name of the view; empty: the one chosen in the list",  # type: ignore[valid-type]
        options={"SKIP_SAVE"},
    )
    filepath: bpy.props.StringProperty(name="Image", subtype="FILE_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the image where one is needed."""
        if self.kind == FOUND:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Link the images into the project and note them."""
        scene, view = context.scene, chosen_view(context.scene, self.view)
        before = view.person, view.person_files
        if self.kind == FOUND:
            view.person = view.person_files = ""
            project.write(scene)
            return f"{view.name}: the person is found by itself."
        project.clips_of(scene)
        picture = folders.absolute(self.filepath)
        read_picture(picture, view.name, tuple(view.clip.size))
        files, link = person_files(project.existing_folder(scene), view.name, self.kind, picture)
        link_footage(project.existing_folder(scene), [link])
        view.person, view.person_files = self.kind, files
        try:
            project.write(scene)
        except InputError:
            view.person, view.person_files = before
            raise
        return f"{view.name}: the person is told by {files}."


def chosen_view(scene: bpy.types.Scene, name: str) -> Any:
    """The view of that name, or the one chosen in the list.

    Raises:
        InputError: there is none.
    """
    views, index = scene.tricap.views, scene.tricap.view_index
    found = views.get(name) if name else views[index] if 0 <= index < len(views) else None
    if found is None:
        raise InputError(f"There is no view “{name}”." if name else "Add footage first, and choose a view in the list.")
    return found


def draw_person(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """How the person is told from the background in the chosen view."""
    props = context.scene.tricap
    if not 0 <= props.view_index < len(props.views):
        return
    view = props.views[props.view_index]
    split = layout.split(factor=0.4)
    label = split.column()
    label.alignment = "RIGHT"
    label.label(text=f"Person in {view.name}")
    text = view.person_files if view.person else KINDS[0][1]
    split.operator_menu_enum("tricap.person_from", "kind", text=text, icon="OUTLINER_OB_ARMATURE" if not view.person else "MOD_MASK")


CLASSES = (PersonFrom,)
