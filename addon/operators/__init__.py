"""Operators that run the stages and build the scene; each can be called from a script with all its arguments."""

import bpy

from .. import jobs
from . import build_scene, control_rig, import_tracks, run, stages

CLASSES = (
    run.LoadSample,
    run.ComputeSample,
    stages.Measure,
    stages.Track,
    stages.Fit,
    run.Run,
    build_scene.BuildScene,
    *control_rig.CLASSES,
    import_tracks.ImportTracks2d,
    run.Cancel,
)


def register() -> None:
    """Register the operators."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(import_tracks.menu)


def unregister() -> None:
    """Stop a running job and unregister the operators."""
    jobs.stop_current()
    jobs.stop_watching()
    bpy.types.TOPBAR_MT_file_import.remove(import_tracks.menu)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
