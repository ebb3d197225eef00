"""bpy.ops.tricap.open_report(): the report of the project's results, in the web browser."""

import bpy

from ...core.foundation.errors import InputError
from .. import folders
from ..panels import TellingOperator


class OpenReport(TellingOperator, bpy.types.Operator):
    """Show the report in the web browser: whether the motion can be used, the body over the footage, doubtful frames, all figures"""

    bl_idname = "tricap.open_report"
    bl_label = "Open Report"

    def do(self, context: bpy.types.Context) -> str:
        """Open the page of the last fit."""
        page = folders.output_folder("", context.scene) / "report" / "report.html"
        if not page.is_file():
            raise InputError("There is no report yet: it is written at the end of Fit Body and of Run Remaining Steps.")
        bpy.ops.wm.url_open(url=page.as_uri())
        return str(page)


CLASSES = (OpenReport,)
