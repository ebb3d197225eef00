"""The extension as a user gets it: the zip installed into a real Blender with an empty profile, used, disabled, uninstalled."""

import importlib.util
import json
import os
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

PROBE = Path(__file__).with_name("extension_probe.py")
ROOT = PROBE.parents[2]
PATIENCE_S = 600
PROMISED = {"run.json", "clouds/0000.ply", "trajectories.npz", "joints.csv", "motion.csv", "body.toml", "skin/0000.ply"}
LEAKY = """
import threading
import bpy

class TRICAP_OT_leak(bpy.types.Operator):
    bl_idname = "tricap.leak"
    bl_label = "Leak"

class LeakyGroup(bpy.types.PropertyGroup):
    pass

def ticking():
    return 1000.0

def drawing(self, context):
    return None

def loading(*_):
    return None

def register():
    if hasattr(bpy.types.Scene, "leak"):
        return
    bpy.utils.register_class(TRICAP_OT_leak)
    bpy.utils.register_class(LeakyGroup)
    bpy.types.Scene.leak = bpy.props.PointerProperty(type=LeakyGroup)
    bpy.app.timers.register(ticking)
    bpy.app.handlers.load_post.append(loading)
    bpy.types.VIEW3D_MT_object.append(drawing)
    threading.Thread(target=threading.Event().wait, daemon=True, name="leaky").start()

def unregister():
    pass
"""

pytestmark = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed for this Python")


def probe(package: Path, folder: Path, *, packages: Path | None = None, run_the_path: bool = False) -> dict[str, Any]:
    """Install `package` into Blender in a process of its own, with the empty profile folder/profile; what it found.

    With `packages`, that folder takes the place of Python's own site-packages.
    """
    (folder / "profile").mkdir()
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "profile"), "PYTHONDONTWRITEBYTECODE": "1"}
    if packages:
        environment["PYTHONPATH"] = str(packages)
    python = [sys.executable, "-S"] if packages else [sys.executable]
    arguments = [PROBE, package, folder / "found.json", *([folder] if run_the_path else [])]
    done = subprocess.run([*python, *map(str, arguments)], env=environment, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S)
    output = done.stdout + done.stderr
    assert done.returncode == 0 and "Traceback" not in output, output
    return json.loads((folder / "found.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def found(extension_zip: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The zip without wheels (quick)."""
    return probe(extension_zip, tmp_path_factory.mktemp("extension"))


def blender_alone(folder: Path) -> Path:
    """A folder of packages with bpy and what comes with Blender, without scipy and OpenCV: as in Blender itself."""
    folder.mkdir()
    for source in Path(sysconfig.get_path("purelib")).iterdir():
        if not source.name.startswith(("scipy", "cv2", "opencv")) and source.suffix != ".pth":
            (folder / source.name).symlink_to(source, target_is_directory=source.is_dir())
    return folder


def assert_nothing_left(found: dict[str, Any]) -> None:
    """Disabled: Blender is as before. Uninstalled: no module and no file is left either."""
    assert found["left after disabling"] == {}
    assert found["classes left"] == []
    assert found["timers left"] == []
    assert found["enabled again"]
    assert found["left after uninstalling"] == {}
    assert found["modules left"] == []
    assert found["files left"] == []


def test_it_installs_and_registers(found: dict[str, Any]) -> None:
    assert found["installed"] == ["FINISHED"]
    assert "bl_ext.user_default.tricap" in found["added"]["add-ons"]
    assert [name for name in found["added"]["operators"] if name.startswith("tricap.")]
    assert [name for name in found["added"]["types"] if name.startswith("TRICAP_PT_")]


def test_it_runs_from_its_own_folder_under_its_own_name(found: dict[str, Any]) -> None:
    assert "extensions/user_default/tricap/core" in Path(found["used"]["core"]).as_posix()
    assert found["absolute"] == []


def test_it_leaves_nothing_behind(found: dict[str, Any]) -> None:
    assert_nothing_left(found)


@pytest.mark.parametrize("way", ["reload", "import", "install"])
def test_loaded_anew_it_is_there_once(found: dict[str, Any], way: str) -> None:
    now = next(each for each in found["reloaded"] if each["way"] == way)
    without_addresses = {kind: [name.split(" at 0x")[0] for name in names] for kind, names in found["added"].items()}
    assert now["added"] == without_addresses and now["footage"] == "empty" and now["listeners"] == 1
    assert now["classes"] == found["classes"]


def test_an_extension_that_leaves_things_behind_is_found_out(dev: ModuleType, tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "core").mkdir(parents=True)
    (source / "core" / "__init__.py").write_text("")
    (source / "__init__.py").write_text(LEAKY)
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    table = {key: value for key, value in manifest.items() if key not in ("build", "wheels", "platforms")}
    (source / "blender_manifest.toml").write_text(dev.toml_text(table))
    dev.blender_extension("build", "--source-dir", source, "--output-filepath", tmp_path / "leaky.zip")
    found = probe(tmp_path / "leaky.zip", tmp_path)
    left = found["left after disabling"]
    assert left["types"] == ["TRICAP_OT_leak"] and left["operators"] == ["tricap.leak"]
    assert "Scene.leak" in left["properties"]
    assert any("load_post" in handler for handler in left["handlers"])
    assert any("VIEW3D_MT_object" in drawn for drawn in left["drawn"])
    assert left["threads"] == ["leaky"]
    assert found["classes left"] == ["LeakyGroup", "TRICAP_OT_leak"]
    assert found["timers left"] == ["ticking"]


@pytest.mark.slow
def test_the_whole_path_runs_from_the_zip_with_its_own_wheels(full_extension_zip: Path, tmp_path: Path) -> None:
    found = probe(full_extension_zip, tmp_path, packages=blender_alone(tmp_path / "packages"), run_the_path=True)
    own = (tmp_path / "profile" / "extensions" / ".local").as_posix()
    assert found["used"]["scipy"].startswith(own) and found["used"]["cv2"].startswith(own)
    assert not found["used"]["numpy"].startswith(own), "numpy is Blender's"
    path = found["path"]
    assert path["ended"] == ["FINISHED"]
    assert PROMISED <= set(path["files"])
    assert path["moving armatures"] and {"ARMATURE", "CAMERA", "META"} <= set(path["kinds"])
    assert_nothing_left(found)
