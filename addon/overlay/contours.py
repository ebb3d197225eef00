"""bpy.ops.tricap.follow_contours(view="C"): the outline of the person in one view or in all, for the eye and for the fit."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import bpy

from ...core import pipeline
from ...core.contour_command import Start, write_contours
from ...core.progress import Monitor
from .. import project
from ..jobs import JobOperator
from . import canvas, recording


class FollowContours(JobOperator, bpy.types.Operator):
    """Follow the person's outline through the frames of a view; surface and tracks are made first where that is needed. The fit uses it"""

    bl_idname = "tricap.follow_contours"
    bl_label = "Follow the Outline"
    bl_options = {"UNDO"}
    step = "tracks"

    view: bpy.props.StringProperty(name="View", description="Name of the view; empty: all of them")  # type: ignore[valid-type]
    from_body: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="From the Fitted Body", description="Begin with the outline of the fitted body, not with that of the measured surface"
    )

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], list[str]]:
        """Folders and settings as they are now; the project's take.toml is written."""
        take, out, overrides = project.chosen(context.scene, "", "")
        view, start = self.view, Start(body=self.from_body)
        return lambda monitor: follow(take, out, overrides, view, monitor, start)

    def finish(self, context: bpy.types.Context, result: list[str]) -> set[str]:
        """Show it, and tell what was found."""
        for sentence in result:
            self.report({"INFO"}, sentence)
        recording.forget()
        context.scene.tricap_overlay.contour = True
        canvas.redraw_clips(context)
        return {"FINISHED"}


def follow(take: Path, out: Path, overrides: Mapping[str, Mapping[str, Any]], view: str, monitor: Monitor, start: Start) -> list[str]:
    """The computation, free of bpy: what was found in every view."""
    with pipeline.open_run(take, out, overrides, contours_aside=True) as run:
        names = [view] if view else [v.name for v in run.footage.take.views]
        return write_contours(run, names, monitor, start)


CLASSES = (FollowContours,)
