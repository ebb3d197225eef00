"""bpy.ops.tricap.export(filepath="…", kind="bvh", preset="plain", out="")"""

from collections.abc import Callable
from pathlib import Path

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.retarget.rig import Motion
from ...core.motion.sources import read_motion_source
from .. import folders
from ..jobs import JobOperator
from ..retarget.by_blender import export_motion
from ..retarget.export import BY_BLENDER, export_file, named_for
from ..retarget.programs import PROGRAMS

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}
KINDS = (
    ("bvh", "BVH", "The motion of the skeleton, for nearly all animation software"),
    ("trc", "TRC", "The joints as points, for OpenSim"),
    ("c3d", "C3D", "The joints as points, for biomechanics"),
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
    if_stopped = "No file was written."

    kind: bpy.props.EnumProperty(name="Format", items=KINDS, default="bvh")  # type: ignore[valid-type]
    preset: bpy.props.EnumProperty(
        name="For",
        items=[(name, name.capitalize(), "") for name in PROGRAMS],  # type: ignore[valid-type]
        description="Use the names, units and axes of this software",
    )
    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH")  # type: ignore[valid-type]
    out: bpy.props.StringProperty(
        name="Results",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder of a run. Empty: the project's",
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file; the export itself is quick."""
        name = "skin" if self.kind == "ply" else f"motion.{self.kind}"
        self.filepath = self.filepath or str(Path(bpy.data.filepath).parent / name if bpy.data.filepath else name)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], str | Motion]:
        """The results and the file."""
        if not self.filepath:
            raise InputError("Choose the file to export to.")
        out, kind, preset = folders.output_folder(self.out, context.scene), self.kind, self.preset
        file = named_for(kind, folders.absolute(self.filepath), out)
        self._out, self._file = out, file
        if kind in BY_BLENDER:
            return lambda monitor: read_motion_source(out)
        return lambda monitor: export_file(out, kind, file, preset, monitor)

    def finish(self, context: bpy.types.Context, result: str | Motion) -> set[str]:
        """Write what Blender's exporters write, and report it."""
        if isinstance(result, Motion):
            result = export_motion(self.kind, self._out, self._file, PROGRAMS[self.preset], result)
        context.scene.tricap_retarget.last_export = f"Exported {self._file.name}: {result}."
        self.report({"INFO"}, f"{self._file}: {result}")
        return {"FINISHED"}


CLASSES = (Export,)
