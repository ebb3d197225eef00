"""The steps of the workflow as operators, one file each; every one can be called from a script with all its arguments."""

import bpy

from .. import jobs
from . import build_scene, cancel, load_sample, run, stages

CLASSES = (load_sample.LoadSample, stages.Measure, stages.Track, stages.Fit, run.Run, build_scene.BuildScene, cancel.Cancel)


def register() -> None:
    """Register the operators."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Stop a running job and unregister the operators."""
    jobs.stop_current()
    jobs.stop_watching()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
