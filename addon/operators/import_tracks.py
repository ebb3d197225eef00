"""bpy.ops.tricap.import_tracks2d(filepath="tracks.csv", points="points.csv", footage="face.mp4")"""

from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.settings import nearest_name
from .. import folders
from ..panels import TellingOperator

if TYPE_CHECKING:
    from ...core.tracking.point_tables import PlanarTable

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


class ImportTracks2d(TellingOperator, bpy.types.Operator):
    """Import points that `tricap track2d` tracked in one camera: an empty for each over the footage, and curves between joined points"""

    bl_idname = "tricap.import_tracks2d"
    bl_label = "Tricap 2-D Tracks (.csv)"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(subtype="FILE_PATH", options=RELATIVE)  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.csv", options={"HIDDEN"})  # type: ignore[valid-type]
    points: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Points",
        options=RELATIVE,
        description="Table of the chosen points, whose column joined_to names the points to join. Empty: none are joined",
    )
    footage: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Footage",
        options=RELATIVE,
        description="The movie or the folder of images in which they were tracked. Empty: no footage is shown",
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Read the files, then build."""
        from ...core.cli.track2d import open_footage
        from ...core.tracking.point_tables import read_planar
        from ..scene.planar import add_planar
        from .build_scene import frame_in_views

        table = read_planar(folders.absolute(self.filepath))
        joined = read_joints(folders.absolute(self.points), table) if self.points else ()
        footage = open_footage(folders.absolute(self.footage)) if self.footage else None
        made = add_planar(context.scene, table, joined, footage)
        frame_in_views(self, context, made.objects[0], front=True)
        return f"{made.name}: {len(table.names)} points over {len(table.frames)} frames, {len(joined)} curves"


def read_joints(path: Path, table: "PlanarTable") -> tuple[tuple[str, str], ...]:
    """The pairs of points to join.

    Raises:
        InputError: the file is not a table of points, or joins a point that was not tracked.
    """
    from ...core.tracking.point_tables import read_points

    joined = read_points(path).joined
    for name in (name for pair in joined for name in pair):
        if name not in table.names:
            raise InputError(f"{path} joins “{name}”, which is not among the tracks.{nearest_name(name, table.names)}")
    return joined


def menu(self: bpy.types.Menu, _: bpy.types.Context) -> None:
    """The entry in File > Import."""
    self.layout.operator(ImportTracks2d.bl_idname)
