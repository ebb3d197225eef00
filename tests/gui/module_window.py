"""Blender's Python module with a window: `python module_window.py --window-geometry 0 0 1600 1000 --python-expr EXPRESSION`.

There is no other Blender 4.5 LTS for this test: Debian has none, and its makers' download is not in any package registry. The module from
PyPI has all of Blender, the window too, but its start, `main_python_enter`, sets the flag for background mode. This program loads the
library, changes the 1 that is stored there into 0, in memory, and imports it then; Blender's own main loop follows. It takes the arguments
of Blender that window.py gives, and `--install FILE.zip` for an extension.

The addresses are those of the library's own symbol table. Where they or the instructions are not as expected, it ends with exit code 4.
"""

import argparse
import ctypes
import importlib.util
import os
import re
import struct
import sys
from pathlib import Path
from typing import NoReturn

import numpy as np

OTHER_BUILD = 4  # exit code
STORES_ONE = re.compile(rb"\xc6\x83(....)\x01", re.DOTALL)  # mov byte [rbx + offset], 1
TESTS_BIT = re.compile(rb"\xf6\x80(....)(.)", re.DOTALL)  # test byte [rax + offset], bit
SYMBOLS = ("PyInit_bpy", "G", "main_python_enter", "rna_Window_event_add_simulate", "WM_init_state_size_set", "WM_init_window_focus_set",
           "BPY_context_get", "WM_main")  # fmt: skip
ENTRY = np.dtype([("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")])
SYMBOL_TABLE, READ_WRITE_RUN, PAGE = 2, 7, 4096
EXTENSION = "bl_ext.user_default.tricap"


def main() -> None:
    """Open the window and run the expression; never returns."""
    options = _parser().parse_known_args()[0]
    if options.install:
        _install(options.install)
    library, places = _library()
    flags, bit = _prepared(places)
    size = (ctypes.c_int(each) for each in options.window_geometry)
    ctypes.CFUNCTYPE(None, *4 * [ctypes.c_int])(places["WM_init_state_size_set"])(*size)
    ctypes.CFUNCTYPE(None, ctypes.c_bool)(places["WM_init_window_focus_set"])(False)
    import bpy

    if bpy.app.background:
        _ended("is in background mode all the same")
    ctypes.c_ubyte.from_address(flags).value |= bit  # --enable-event-simulate
    import addon_utils

    addon_utils.enable(EXTENSION, default_set=True)
    exec(options.python_expr, {"__name__": "__main__"})
    context = ctypes.CFUNCTYPE(ctypes.c_void_p)(places["BPY_context_get"])()
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(places["WM_main"])(context)
    del library


def _install(package: str) -> NoReturn:
    """Install an extension into the profile, in background mode."""
    import bpy

    bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True, overwrite=True)
    sys.stdout.flush()
    os._exit(0 if EXTENSION in bpy.context.preferences.addons else 1)  # 4.5 would hang at the end with classes that are registered


def _library() -> tuple[ctypes.CDLL, dict[str, int]]:
    """The library of the module, not yet started, and the addresses of SYMBOLS in it."""
    found = importlib.util.find_spec("bpy")
    if found is None or not found.submodule_search_locations:
        _ended("is not installed for this Python")
    (file,) = Path(found.submodule_search_locations[0]).glob("__init__*.so")
    values = _values(file)
    library = ctypes.CDLL(str(file))
    start = ctypes.cast(library.PyInit_bpy, ctypes.c_void_p).value or 0
    return library, {name: value + start - values["PyInit_bpy"] for name, value in values.items()}


def _values(file: Path) -> dict[str, int]:
    """The values of SYMBOLS in the symbol table of an ELF library; names of C++ are known by their length."""
    data = np.memmap(file, dtype=np.uint8, mode="r")
    at, size, count = struct.unpack("<Q", data[0x28:0x30])[0], *struct.unpack("<HH", data[0x3A:0x3E])
    sections = [struct.unpack("<IIQQQQIIQQ", data[at + i * size : at + (i + 1) * size]) for i in range(count)]
    table = next((section for section in sections if section[1] == SYMBOL_TABLE), None)
    if table is None:
        _ended("has no symbol table")
    entries = data[table[4] : table[4] + table[5]].view(ENTRY)
    names = sections[table[6]]
    text = data[names[4] : names[4] + names[5]].tobytes()
    values = {}
    for name in SYMBOLS:
        mangled = re.search(rb"\0(%s\0|_ZL?%d%s)" % (name.encode(), len(name), name.encode()), text)
        values[name] = entries["value"][entries["name"] == mangled.start() + 1] if mangled else ()
    missing = [name for name, value in values.items() if not len(value)]
    if missing:
        _ended(f"has no symbol {missing[0]}")
    return {name: int(value[0]) for name, value in values.items()}


def _prepared(places: dict[str, int]) -> tuple[int, int]:
    """Let the start leave background mode off. Returns the address and the bit of the flag that allows simulated events."""
    stores = list(STORES_ONE.finditer(ctypes.string_at(places["main_python_enter"], 1000)))
    tests = TESTS_BIT.search(ctypes.string_at(places["rna_Window_event_add_simulate"], 200))
    if len(stores) != 2 or tests is None:  # factory settings, then background mode
        _ended("starts in another way")
    address = places["main_python_enter"] + stores[1].end() - 1
    page = ctypes.c_void_p(address // PAGE * PAGE)
    if ctypes.CDLL(None).mprotect(page, ctypes.c_size_t(2 * PAGE), READ_WRITE_RUN):
        _ended("cannot be changed in memory")
    ctypes.memmove(address, b"\0", 1)
    return places["G"] + struct.unpack("<i", tests[1])[0], tests[2][0]


def _ended(why: str) -> NoReturn:
    print(f"Blender's module {why}.", flush=True)
    os._exit(OTHER_BUILD)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--install", metavar="FILE", help="install an extension and end")
    parser.add_argument("--window-geometry", nargs=4, type=int, default=(0, 0, 1600, 1000))
    parser.add_argument("--python-expr", default="")
    return parser


if __name__ == "__main__":
    main()
