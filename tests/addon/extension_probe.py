"""Run by test_extension.py in a process of its own: install a zip, enable, use, disable, uninstall; the findings as JSON.

    python extension_probe.py ZIP JSON [FOLDER]      with BLENDER_USER_RESOURCES set to an empty folder

With FOLDER it also makes a short sample recording there and runs the whole path on it, by the operator.
"""

import gc
import importlib.util
import json
import os
import sys
import threading
import types
from pathlib import Path

import bpy

EXTENSION = "bl_ext.user_default.tricap"
FRAMES = 6


def drawn_by(cls: type) -> list[str]:
    """Who added to a menu, header or panel of Blender's; its own draw() is kept in the same list."""
    drawn = getattr(getattr(cls, "draw", None), "_draw_funcs", ())
    return [f"{function.__module__}.{function.__qualname__}" for function in drawn if function.__qualname__ != f"{cls.__name__}.draw"]


def traces() -> dict[str, list[str]]:
    """All that an add-on can add to Blender, by name."""
    kinds = {name: getattr(bpy.types, name) for name in dir(bpy.types)}
    rna = {name: kind.bl_rna for name, kind in kinds.items() if hasattr(kind, "bl_rna")}
    keyconfig = bpy.context.window_manager.keyconfigs.addon
    keymaps = keyconfig.keymaps if keyconfig else ()
    handlers = {name: getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)}
    return {
        "types": sorted(kinds),
        "properties": sorted(f"{name}.{key}" for name, kind in rna.items() for key in kind.properties.keys()),
        "operators": sorted(f"{space}.{name}" for space in dir(bpy.ops) for name in dir(getattr(bpy.ops, space))),
        "drawn": sorted(f"{name}: {who}" for name, kind in kinds.items() for who in drawn_by(kind)),
        "handlers": sorted(f"{name}: {each!r}" for name, all_of in handlers.items() if isinstance(all_of, list) for each in all_of),
        "keys": sorted(f"{keymap.name}: {item.idname}" for keymap in keymaps for item in keymap.keymap_items),
        "add-ons": sorted(bpy.context.preferences.addons.keys()),
        "threads": sorted(thread.name for thread in threading.enumerate()),
    }


def own_modules() -> dict[str, types.ModuleType]:
    """The extension's modules that are loaded now."""
    return {name: module for name, module in sys.modules.items() if name == EXTENSION or name.startswith(EXTENSION + ".")}


def registered_classes() -> list[str]:
    """The extension's classes that are registered now (a property group is in none of Blender's lists)."""
    classes = [each for each in gc.get_objects() if isinstance(each, type) and str(each.__module__).startswith(EXTENSION)]
    return sorted(cls.__name__ for cls in classes if getattr(cls, "is_registered", False))


def difference(now: dict[str, list[str]], before: dict[str, list[str]]) -> dict[str, list[str]]:
    """What was added, by kind."""
    return {kind: sorted(set(names) - set(before[kind])) for kind, names in now.items() if set(names) - set(before[kind])}


def use(core: types.ModuleType) -> dict[str, object]:
    """A little work done by the installed core."""
    import cv2
    import numpy
    import scipy

    return {"core": core.__file__, "scipy": scipy.__file__, "cv2": cv2.__file__, "numpy": numpy.__file__}


def run_the_path(folder: Path) -> dict[str, object]:
    """A sample recording made by the installed core, measured by the operator, and what the scene then holds."""
    arm = importlib.import_module(f"{EXTENSION}.core.synthetic.arm")
    arm.make_arm_take(folder / "take", arm.ArmTakeSettings(frames=FRAMES))
    ended = bpy.ops.tricap.run(take=str(folder / "take"), out=str(folder / "out"), build=True)
    rigs = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    return {
        "ended": sorted(ended),
        "files": sorted(path.relative_to(folder / "out").as_posix() for path in (folder / "out").rglob("*") if path.is_file()),
        "moving armatures": [item.name for item in rigs if item.animation_data and item.animation_data.action],
        "kinds": sorted({item.type for item in bpy.data.objects}),
    }


def counts(added: dict[str, list[str]]) -> dict[str, list[str]]:
    """What was added, without the addresses of functions, which are others after each import."""
    return {kind: [name.split(" at 0x")[0] for name in names] for kind, names in added.items()}


def reloaded(before: dict[str, list[str]], package: str) -> list[dict[str, object]]:
    """What is there after each way to load the code anew: every module reloaded in place, all imported again, installed over itself."""
    found = []
    for way in ("reload", "import", "install"):
        bpy.ops.preferences.addon_disable(module=EXTENSION)
        if way == "reload":
            for module in own_modules().values():
                importlib.reload(module)
        elif way == "import":
            for name in own_modules():
                del sys.modules[name]
        bpy.ops.preferences.addon_enable(module=EXTENSION)
        if way == "install":
            bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True, overwrite=True)
        session, watch = (importlib.import_module(f"{EXTENSION}.addon.{name}") for name in ("session", "steps.watch"))
        states = watch.refresh(bpy.context.scene).states
        found.append(
            {
                "way": way,
                "added": counts(difference(traces(), before)),
                "classes": registered_classes(),
                "listeners": len(session.get_session().on_job_end),
                "footage": states["footage"].status,
            }
        )
    return found


def main(package: str, report: str, folder: str | None = None) -> None:
    before = traces()
    found: dict[str, object] = {}
    installed = bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True, overwrite=True)
    found["installed"] = sorted(installed)
    found["added"] = difference(traces(), before)
    found["classes"] = registered_classes()
    found["used"] = use(importlib.import_module(f"{EXTENSION}.core"))
    if folder:
        found["path"] = run_the_path(Path(folder))
    modules = own_modules()
    found["absolute"] = sorted(name for name in sys.modules if name.split(".")[0] in ("tricap", "core", "addon"))
    functions = [value for module in modules.values() for value in vars(module).values() if isinstance(value, types.FunctionType)]
    bpy.ops.preferences.addon_disable(module=EXTENSION)
    found["left after disabling"] = difference(traces(), before)
    found["classes left"] = registered_classes()
    found["timers left"] = [function.__qualname__ for function in functions if bpy.app.timers.is_registered(function)]
    repositories = [repository.module for repository in bpy.context.preferences.extensions.repos]
    bpy.ops.preferences.addon_enable(module=EXTENSION)
    found["enabled again"] = EXTENSION in bpy.context.preferences.addons
    found["reloaded"] = reloaded(before, package) if importlib.util.find_spec(f"{EXTENSION}.addon") else []
    bpy.ops.extensions.package_uninstall(repo_index=repositories.index("user_default"), pkg_id="tricap")
    found["left after uninstalling"] = difference(traces(), before)
    found["modules left"] = sorted(own_modules())
    profile = Path(os.environ["BLENDER_USER_RESOURCES"])
    found["files left"] = sorted(str(path.relative_to(profile)) for path in profile.rglob("*tricap*"))
    Path(report).write_text(json.dumps(found, indent=1, default=str), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
    sys.stdout.flush()
    os._exit(0)  # Blender 4.5 as a module can hang in its own atexit
