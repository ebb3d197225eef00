"""bpy.ops.tricap.cancel()"""

import bpy

from ..session import get_session


class Cancel(bpy.types.Operator):
    """Stop the running job; what was finished is kept"""

    bl_idname = "tricap.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only while a job runs."""
        return get_session().job is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask the job to stop; the operator that watches it ends it."""
        job = get_session().job
        if job is not None:
            job.monitor.cancel()
        return {"FINISHED"}
