"""bpy.ops.tricap.synchronise()"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.take.take import read_take
from .. import project
from ..jobs import JobOperator

if TYPE_CHECKING:
    from ...core.synchronising.synchronise import ViewTiming


class Synchronise(JobOperator, bpy.types.Operator):
    """Find when each camera began: by the sound of its movie or NAME.wav, a switched lamp, a flash or time codes; then by moving points"""

    bl_idname = "tricap.synchronise"
    bl_label = "Synchronise"
    bl_options = {"UNDO"}
    step = "footage"
    if_stopped = "Nothing was changed."

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], tuple[ViewTiming, ...]]":
        """The project with the scene's current values."""
        from ...core.synchronising.synchronise import synchronise
        from ..movie_sound import movie_sound

        folder: Path = project.chosen(context.scene, "", "")[0]

        def found(monitor: Monitor) -> "tuple[ViewTiming, ...]":
            timings = synchronise(read_take(folder), monitor, movie_sound)
            if lost := [str(timing) for timing in timings if not timing.found]:
                raise InputError(" ".join(lost))
            return timings

        return found

    def finish(self, context: bpy.types.Context, result: "tuple[ViewTiming, ...]") -> set[str]:
        """Set the starts of the views."""
        of_view = {timing.view: timing for timing in result}
        for view in context.scene.tricap.views:
            timing = of_view[view.name]
            if timing.method != "reference":
                view.start_s, view.drift_ppm, view.offset_frames = timing.start_s, timing.drift_ppm, 0
            self.report({"INFO"}, str(timing))
        return {"FINISHED"}


CLASSES = (Synchronise,)
