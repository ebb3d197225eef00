"""bpy.ops.tricap.export(filepath="…", kind="bvh", preset="plain", source="PLAYED", armature="", out="")"""

from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.retarget.rig import Motion
from ...core.motion.sources import read_motion_source
from .. import folders
from ..jobs import JobOperator
from ..retarget.export import BY_BLENDER, export_file, exporting_played, named_for
from ..retarget.operators import armature_of
from ..retarget.programs import PROGRAMS
from ..retarget.properties import EXPORTED
from ..scene.armature import SNAPS_KEY

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}
KINDS = (
    ("bvh", "BVH", "The motion of the skeleton, for nearly all animation software"),
    ("trc", "TRC", "The joints as points, for OpenSim"),
    ("c3d", "C3D", "The joints as points, and the poses of all segments, for biomechanics"),
    ("mot", "OpenSim", "A scaled model (.osim) and its coordinates (.mot)"),
    ("csv", "CSV", "The joints as a table with their sigmas"),
    ("fbx", "FBX", "Skeleton and skin, for game engines and animation software"),
    ("glb", "glTF", "Skeleton and skin, for game engines and the web"),
    ("usd", "USD", "Skeleton and skin, for film pipelines"),
    ("abc", "Alembic", "The animated skin alone"),
    ("ply", "PLY", "The skin of every frame, into a folder"),
)


class Export(JobOperator, bpy.types.Operator):
    """Export the motion for other software"""

    bl_idname = "tricap.export"
    bl_label = "Export"
    step = "retarget"
    if_stopped = "The file is as it was before; of PLY files, those written so far stay."

    kind: bpy.props.EnumProperty(name="Format", items=KINDS, default="bvh")  # type: ignore[valid-type]
    preset: bpy.props.EnumProperty(
        name="For",
        items=[(name, name.capitalize(), "") for name in PROGRAMS],  # type: ignore[valid-type]
        description="Use the names, units and axes of this software",
    )
    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH")  # type: ignore[valid-type]
    source: bpy.props.EnumProperty(name="Motion", items=EXPORTED, description="What is exported")  # type: ignore[valid-type]
    armature: bpy.props.StringProperty(name="Armature", description="What Plays: of this armature; empty: the one in the panel")  # type: ignore[valid-type]
    out: bpy.props.StringProperty(
        name="Results",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Measured Motion: of the run in this folder; empty: the project's. A folder selects Measured Motion",
    )

    chosen: bpy.props.BoolProperty(name="File Chosen", default=False, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file; with a file, export with progress and Esc."""
        if self.chosen:
            return super().invoke(context, event)
        self._asked = True
        name = "skin" if self.kind == "ply" else f"motion.{self.kind}"
        self.filepath = self.filepath or str(Path(bpy.data.filepath).parent / name if bpy.data.filepath else name)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Export at once; after the file browser, which ends with this call, as a job of its own, which Esc stops."""
        if not getattr(self, "_asked", False):
            return super().execute(context)
        given = {name: getattr(self, name) for name in ("kind", "preset", "filepath", "source", "armature", "out")}
        bpy.ops.tricap.export("INVOKE_DEFAULT", chosen=True, **given)
        return {"FINISHED"}

    def draw(self, context: bpy.types.Context) -> None:
        """The options in the file browser."""
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in ("kind", "preset", "source"):
            layout.prop(self, name)
        if self.source == "PLAYED":
            layout.prop_search(self, "armature", bpy.data, "objects")
        else:
            layout.prop(self, "out")

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], str | Motion]:
        """What is exported, and the file."""
        kind, preset, chosen = self.kind, self.preset, folders.to_write(self.filepath)
        if self.source == "PLAYED" and not self.out:
            self._armature, self._file = self._playing(context), named_for(kind, chosen, _results(context.scene))
            return lambda monitor: ""
        out = folders.output_folder(self.out, context.scene)
        self._armature, self._out, self._file = None, out, named_for(kind, chosen, out)
        if kind in BY_BLENDER:
            return lambda monitor: read_motion_source(out)
        return lambda monitor: export_file(out, kind, self._file, preset, monitor)

    def _playing(self, context: bpy.types.Context) -> bpy.types.Object:
        """The armature to export: the given one, that of the panel, or the only one of the scene.

        Raises:
            InputError: there is none.
        """
        chosen = context.scene.tricap_retarget.export
        if self.armature or chosen is not None:
            return armature_of(self.armature, chosen, "armature to export")
        armatures = [o for o in context.scene.objects if o.type == "ARMATURE" and SNAPS_KEY not in o]
        if not armatures:
            raise InputError("The scene has no armature to export. Build the rig first (step 7), or choose Measured Motion.")
        if len(armatures) > 1:
            raise InputError(f"The scene has {len(armatures)} armatures. Choose the one to export.")
        return armatures[0]

    def in_steps(self, context: bpy.types.Context, result: Any, monitor: Monitor) -> Generator[None, None, Any]:
        """Read what plays, frame by frame, and write it."""
        if self._armature is None:
            return result
        return (yield from exporting_played(self._armature, self.kind, self._file, self.preset, monitor))

    def finish(self, context: bpy.types.Context, result: str | Motion) -> set[str]:
        """Write what needs the open file, and report it."""
        if isinstance(result, Motion):
            from ..retarget.by_blender import export_motion

            result = export_motion(self.kind, self._out, self._file, PROGRAMS[self.preset], result)
        context.scene.tricap_retarget.last_export = f"Exported {self._file.name}: {result}."
        self.report({"INFO"}, f"{self._file}: {result}")
        return {"FINISHED"}


def _results(scene: bpy.types.Scene) -> Path | None:
    """The folder of the project's results, which no export overwrites; None where no project is chosen."""
    try:
        return folders.output_folder("", scene)
    except InputError:
        return None


CLASSES = (Export,)
