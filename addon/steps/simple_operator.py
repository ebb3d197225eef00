"""The base of the buttons that work at once."""

import bpy

from ..panels import TellingOperator
from . import watch


class SimpleOperator(TellingOperator):
    """Mix-in: the steps' states are computed again after the work."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do it."""
        try:
            return super().execute(context)
        finally:
            watch.refresh(context.scene)
