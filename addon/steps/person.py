"""bpy.ops.tricap.person_from(kind="mask", view="L", filepath="…"): how the person is separated from the background in a view."""

from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.take.sources import person_files, read_picture
from ...core.take.writing import link_footage
from .. import folders, project
from .simple_operator import SimpleOperator

AUTO = "none"
KINDS = (
    (AUTO, "Auto", "Separate the person by clicks, depth and motion"),
    ("mask", "One Mask", "One image for all frames, of the size of the footage and white where the person is"),
    ("masks", "Mask Sequence", "A folder with a mask for every image of the view; choose one of them"),
    ("background", "Background Plate", "An image of the same camera without the person"),
)


class PersonFrom(SimpleOperator, bpy.types.Operator):
    """Choose how the person is separated from the background in this view. Only the person is measured"""

    bl_idname = "tricap.person_from"
    bl_label = "Separate Person"
    bl_options = {"UNDO"}

    kind: bpy.props.EnumProperty(name="By", items=KINDS)  # type: ignore[valid-type]
    view: bpy.props.StringProperty(
        name="View",
        description="Name of the view. Empty: the one selected in the list",  # type: ignore[valid-type]
        options={"SKIP_SAVE"},
    )
    filepath: bpy.props.StringProperty(name="Image", subtype="FILE_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the image if one is needed."""
        if self.kind == AUTO:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Link the images into the project and enter them in the take."""
        scene, view = context.scene, chosen_view(context.scene, self.view)
        before = view.person, view.person_files
        if self.kind == AUTO:
            view.person = view.person_files = ""
            project.write(scene)
            return f"{view.name}: the person is separated automatically."
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
        return f"{view.name}: the person is separated by {files}."


def chosen_view(scene: bpy.types.Scene, name: str) -> Any:
    """The view of that name, or the one selected in the list.

    Raises:
        InputError: there is none.
    """
    views, index = scene.tricap.views, scene.tricap.view_index
    found = views.get(name) if name else views[index] if 0 <= index < len(views) else None
    if found is None:
        raise InputError(f"There is no view “{name}”." if name else "Add footage first, and select a view in the list.")
    return found


def draw_person(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """How the person is separated from the background in the selected view."""
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
