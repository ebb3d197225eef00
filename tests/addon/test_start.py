"""Enabling the add-on loads neither stages nor builders nor scipy, and takes less time than Blender itself needs to be loaded."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed for this Python")
CODE = """
import os, sys, time
began = time.process_time()
import bpy
blender_s = time.process_time() - began
import tricap
before, began = set(sys.modules), time.process_time()
tricap.register()
if "work" in sys.argv:
    from tricap.core.run import pipeline
print(time.process_time() - began, blender_s, *(set(sys.modules) - before), flush=True)
os._exit(0)  # Blender 4.5 as a module crashes as it ends with the add-on registered"""
HEAVY = {
    "scipy",
    "tricap.addon.scene.build",
    "tricap.addon.scene.contents",
    "tricap.core.calibration.calibrate",
    "tricap.core.checking.take_check",
    "tricap.core.cli.main",
    "tricap.core.fitting.stages.sequence",
    "tricap.core.report.pages",
    "tricap.core.run.pipeline",
    "tricap.core.run.record",
    "tricap.core.run.take_run",
    "tricap.core.surface.measure",
    "tricap.core.synchronising.synchronise",
    "tricap.core.tracking.track",
}
STARTS = 3  # of which the quickest counts; the bytecode was written by an earlier one


def start(bytecode: Path, *arguments: str) -> tuple[float, float, set[str]]:
    """The CPU times [s] of registering in a new process and of importing bpy there, and the modules that registering loads."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    variables["PYTHONPYCACHEPREFIX"] = str(bytecode)
    done = subprocess.run([sys.executable, "-c", CODE, *arguments], capture_output=True, text=True, check=True, env=variables)
    seconds, blender_s, *modules = done.stdout.splitlines()[-1].split()
    return float(seconds), float(blender_s), set(modules)


@pytest.mark.slow
def test_enabling_loads_no_stage_and_is_quick(tmp_path: Path) -> None:
    modules = start(tmp_path)[-1]
    assert "tricap.core.run.settings" in modules
    assert not modules & HEAVY
    seconds, blender_s, _ = zip(*(start(tmp_path) for _ in range(STARTS)), strict=True)
    assert min(seconds) < min(blender_s)  # measured a third to 0.6 of it, idle and busy


@pytest.mark.slow
def test_a_loaded_stage_is_found_out(tmp_path: Path) -> None:
    assert {"tricap.core.run.pipeline", "tricap.core.run.record", "tricap.core.tracking.track"} <= start(tmp_path, "work")[-1]
