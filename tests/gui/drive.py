"""Runs inside Blender: drives its window by simulated mouse and keys, looks at its picture, and keeps what it saw.

A script is a module with a generator `steps()`; it uses the generators below with `yield from`, and `check` for what must be so:

    import drive

    def steps():
        area = yield from drive.sidebar("VIEW_3D", "Tricap")
        yield from drive.press(area, "tricap.run")
        yield from drive.wait_for(lambda: not bpy.context.window_manager.tricap.running, 60, "the run ends")
        drive.check("Body" in bpy.data.objects, "there is a body")
        yield from drive.shot("after_the_run")

Coordinates are window pixels, origin at the bottom left. Every event is a step of a timer, as a person's would be.
"""

import importlib
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import bpy
from display import pixels, slowness, write_png

HERE = Path(__file__).resolve().parent
OUT = HERE / "out"
DATA = HERE / "data"
STEP_S = 0.02
ESC_S = 1.0
Steps = Iterator[None]

failures: list[str] = []
_began = time.monotonic()


# ---- what a script says ----------------------------------------------------------------------------------------------


def say(*words: object) -> None:
    """A line of the log, with the time."""
    print(f"[{time.monotonic() - _began:7.2f}]", *words, flush=True)


def check(so: object, what: str) -> None:
    """Note whether something that must be so is so."""
    say("ok    " if so else "FAILED", what)
    if not so:
        failures.append(what)


class GaveUp(Exception):
    """The script cannot go on; the failure is noted."""


def need(so: object, what: str) -> None:
    """`check`, where nothing after it makes sense otherwise."""
    check(so, what)
    if not so:
        raise GaveUp(what)


# ---- time ------------------------------------------------------------------------------------------------------------


def pause(seconds: float) -> Steps:
    """Let Blender live for a while."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield


def wait_for(condition: Callable[[], object], seconds: float, what: str) -> Steps:
    """Until the condition holds; the script ends if that takes longer than `seconds` on a free machine."""
    began = time.monotonic()
    while not condition():
        waited = time.monotonic() - began
        if waited > seconds and waited > seconds * slowness():
            need(False, f"{what} (waited {waited:.0f} s)")
        yield
    say("ok    ", f"{what} ({time.monotonic() - began:.2f} s)")


def quiet(seconds: float = 4.0) -> Steps:
    """Until nothing has run for some seconds: a check may begin by itself (every two it is looked for one), and moves the buttons."""
    since = time.monotonic()
    while time.monotonic() - since < seconds:
        if bpy.context.window_manager.tricap.running:
            since = time.monotonic()
        yield
    yield from settle()


def settle(pauses: int = 4) -> Steps:
    """Let everything be laid out and drawn."""
    for area in window().screen.areas:
        area.tag_redraw()
    for _ in range(pauses):
        yield
    with override(window=window()):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
    yield


def override(**members: object) -> AbstractContextManager[None]:
    """`temp_override` for operators, as the add-on uses it: in Blender 4.5 no thread may run meanwhile."""
    return importlib.import_module("bl_ext.user_default.tricap.addon.alone").override(**members)


# ---- mouse and keys --------------------------------------------------------------------------------------------------


def window() -> bpy.types.Window:
    """The first window."""
    return bpy.context.window_manager.windows[0]


_mouse = [0, 0]


def move(x: float, y: float) -> Steps:
    """The pointer goes there."""
    _mouse[:] = [round(x), round(y)]
    window().event_simulate(type="MOUSEMOVE", value="NOTHING", x=_mouse[0], y=_mouse[1])
    yield


def click(x: float, y: float, button: str = "LEFTMOUSE", **held: bool) -> Steps:
    """Move, press, release. `held`: shift, ctrl, alt."""
    yield from move(x - 2, y)
    yield from move(x, y)
    yield
    for value in ("PRESS", "RELEASE"):
        window().event_simulate(type=button, value=value, x=_mouse[0], y=_mouse[1], **held)
        yield
    yield


def drag(start: tuple[float, float], end: tuple[float, float], pieces: int = 6, button: str = "LEFTMOUSE", **held: bool) -> Steps:
    """Press at `start`, move, release at `end`."""
    yield from move(*start)
    yield
    window().event_simulate(type=button, value="PRESS", x=_mouse[0], y=_mouse[1], **held)
    yield
    for i in range(1, pieces + 1):
        yield from move(*(a + (b - a) * i / pieces for a, b in zip(start, end)))
        yield
    window().event_simulate(type=button, value="RELEASE", x=_mouse[0], y=_mouse[1], **held)
    yield
    yield


def key(name: str, **held: bool) -> Steps:
    """Press and release a key where the pointer is: key("ESC"), key("Z", ctrl=True)."""
    for value in ("PRESS", "RELEASE"):
        window().event_simulate(type=name, value=value, x=_mouse[0], y=_mouse[1], **held)
        yield
    yield


def stopped_by_esc(what: str) -> Steps:
    """Esc ends the running job within a second more than this window needs for a key that does nothing: it is drawn between two events.
    A check that then begins by itself is another job."""
    began = time.monotonic()
    yield from key("F19")
    pressed = time.monotonic()
    yield from key("ESC")
    yield from wait_for(lambda: not bpy.context.window_manager.tricap.blocks, 30, what)
    any_key, esc = pressed - began, time.monotonic() - pressed
    check(esc - any_key < ESC_S * slowness(), f"Esc took {esc:.2f} s, a key that does nothing {any_key:.2f} s")


def enter_text(x: float, y: float, text: str) -> Steps:
    """Into the field at (x, y): click, paste over what it holds, Enter."""
    yield from click(x, y)
    yield from key("A", ctrl=True)
    bpy.context.window_manager.clipboard = text
    yield from key("V", ctrl=True)
    yield from key("NUMPAD_ENTER")
    yield


# ---- places ----------------------------------------------------------------------------------------------------------


def area_of(kind: str) -> bpy.types.Area:
    """The largest area of this ui_type, e.g. "VIEW_3D"."""
    found = [area for area in window().screen.areas if area.ui_type == kind]
    if not found:
        need(False, f"an area {kind} is open")
    return max(found, key=lambda area: area.width * area.height)


def region_of(area: bpy.types.Area, kind: str = "WINDOW") -> bpy.types.Region:
    """Its region of that kind."""
    found = [region for region in area.regions if region.type == kind]
    if not found:
        need(False, f"{area.ui_type} has a region {kind}")
    return found[0]


def middle(area: bpy.types.Area) -> tuple[float, float]:
    """The middle of its main region."""
    region = region_of(area)
    return region.x + region.width / 2, region.y + region.height / 2


def sidebar(kind: str, tab: str) -> Iterator[None]:
    """Open the sidebar of the largest area of that ui_type and its tab; returns the area."""
    area = area_of(kind)
    area.spaces.active.show_region_ui = True
    yield from settle()
    region_of(area, "UI").active_panel_category = tab
    yield from settle()
    if kind == "CLIP_EDITOR" and bpy.app.version < (5, 0):  # it leaves the footage where the sidebar is now
        yield from move(area.x + 40, middle(area)[1])
        yield from key("HOME")
        yield from settle()
    yield from move(region_of(area, "UI").x + 60, middle(area)[1])
    yield from settle()
    return area


@dataclass(frozen=True)
class Button:
    """What lies under the pointer at one place of a region."""

    x: float
    y: float
    what: str  # "bpy.ops.tricap.run()" or "bpy.data.scenes["Scene"].tricap.take"


def buttons(area: bpy.types.Area, kind: str = "UI", until: str | None = None) -> Iterator[None]:
    """What can be pressed in the visible part of a region, found as a person would: by moving over it. Returns a list of Buttons.

    With `until`, it ends at the first one whose command or data path contains that.
    """
    region, found = region_of(area, kind), {}
    for part in (0.5, 0.25, 0.72, 0.12):
        for y in range(region.y + region.height - 6, region.y + 4, -9):
            x = region.x + region.width * part
            yield from move(x, y)
            what = under_pointer(area, region)
            if what and what not in found:
                yield from move(x, y - 5)  # rather its middle than its edge
                found[what] = Button(x, _mouse[1] if under_pointer(area, region) == what else y, what)
                if until is not None and until in what:
                    return list(found.values())
    return list(found.values())


def under_pointer(area: bpy.types.Area, region: bpy.types.Region) -> str:
    """What Blender's own “Copy Python Command” or “Copy Full Data Path” says of the button that the pointer is over; "" without one."""
    wm = bpy.context.window_manager
    with override(window=window(), area=area, region=region):
        for copy in (bpy.ops.ui.copy_python_command_button, bpy.ops.ui.copy_data_path_button):
            if copy.poll():
                wm.clipboard = ""
                more = {"full_path": True} if copy is bpy.ops.ui.copy_data_path_button else {}
                if copy(**more) == {"FINISHED"} and wm.clipboard:
                    return wm.clipboard
    return ""


def find(area: bpy.types.Area, what: str, kind: str = "UI") -> Iterator[None]:
    """The button whose command or data path contains `what`; scrolls down to it. Returns a Button; the script ends without one."""
    region = region_of(area, kind)
    yield from move(region.x + 40, region.y + region.height / 2)
    yield from key("HOME")
    for _ in range(8):
        there = yield from buttons(area, kind, what)
        for button in there:
            if what in button.what:
                return button
        yield from move(region.x + 40, region.y + region.height / 2)
        for _ in range(6):
            yield from key("WHEELDOWNMOUSE")
        yield from settle()
    need(False, f"there is a button for {what} in {area.ui_type}")


def press(area: bpy.types.Area, what: str, kind: str = "UI") -> Steps:
    """Click the button whose command or data path contains `what`."""
    button = yield from find(area, what, kind)
    yield from click(button.x, button.y)
    yield from settle()


def fill(area: bpy.types.Area, what: str, text: str, kind: str = "UI") -> Steps:
    """Type into the field whose data path contains `what`."""
    button = yield from find(area, what, kind)
    yield from enter_text(button.x, button.y, text)
    yield from settle()


def choose(operator_label: str, folder: Path, name: str = "") -> Steps:
    """Answer the file browser that an operator has opened: folder, perhaps a file's name, and its button."""
    yield from wait_for(lambda: any(a.type == "FILE_BROWSER" for a in window().screen.areas), 10, f"a file browser opens: {operator_label}")
    yield from settle(10)
    area = next(a for a in window().screen.areas if a.type == "FILE_BROWSER")
    yield from fill(area, "directory", f"{folder}/", kind="UI")
    yield from click(*middle(area))  # one Enter shows the folder, and the field is still open
    yield from settle()
    foot = region_of(area, "EXECUTE")
    if name:
        yield from enter_text(foot.x + 0.4 * foot.width, foot.y + 0.5 * foot.height, name)
        yield from settle()
    yield from shot(f"file_browser_{operator_label}")
    yield from settle()
    yield from click(foot.x + 0.95 * foot.width, foot.y + 0.5 * foot.height)
    yield from wait_for(lambda: all(a.type != "FILE_BROWSER" for a in window().screen.areas), 10, "the file browser closes")
    yield from settle(10)


def pick(area: bpy.types.Area, what: str, owner: bpy.types.bpy_struct, name: str, value: str) -> Steps:
    """Open a drop-down menu, go down to an item by the arrow keys, take it."""
    button = yield from find(area, what)
    yield from click(button.x, button.y)
    yield from settle()
    for _ in range(owner.bl_rna.properties[name].enum_items.keys().index(value) + 1):
        yield from key("DOWN_ARROW")
    yield from shot(f"menu_{name}")
    yield from key("RET")
    yield from settle()
    need(getattr(owner, name) == value, f"{value} is chosen for {name} (it is {getattr(owner, name)})")


def take_item(area: bpy.types.Area, below: str, up_px: float, number: int) -> Steps:
    """Open the menu that lies up_px above the button whose data path contains `below` (a menu itself does not tell its name), go down to
    its item of that number by the arrow keys, take it."""
    button = yield from find(area, below)
    yield from click(button.x, button.y + up_px * bpy.context.preferences.system.ui_scale)
    yield from settle()
    for _ in range(number):
        yield from key("DOWN_ARROW")
    yield from shot("menu_items")
    yield from key("RET")
    yield from settle()


def look_up(area: bpy.types.Area, what: str, name: str) -> Steps:
    """Choose a thing by its name in the field whose data path contains `what`."""
    button = yield from find(area, what)
    yield from click(button.x, button.y)
    yield from settle()
    bpy.context.window_manager.clipboard = name
    yield from key("V", ctrl=True)
    yield from settle()
    yield from shot(f"looked_up_{name}")
    yield from key("RET")
    yield from settle()


def reports() -> list[str]:
    """All messages that Blender has shown, oldest first, read from its Info editor."""
    area = min(window().screen.areas, key=lambda a: a.width * a.height)
    before, wm = area.type, bpy.context.window_manager
    area.type = "INFO"
    try:
        for kind in ("info", "error", "warning", "operator", "debug"):
            if hasattr(area.spaces.active, f"show_report_{kind}"):
                setattr(area.spaces.active, f"show_report_{kind}", kind in ("info", "error", "warning"))
        wm.clipboard = ""
        with override(window=window(), area=area, region=region_of(area)):
            bpy.ops.info.select_all(action="SELECT")
            bpy.ops.info.report_copy()
        return [line for line in wm.clipboard.splitlines() if line and not line.startswith("bpy.")]
    finally:
        area.type = before


def command(*words: str) -> list[str]:
    """The `tricap` command of this Blender; of the module, which has no program, that of its Python."""
    return [bpy.app.binary_path, "--command", "tricap", *words] if bpy.app.binary_path else [sys.executable, "-m", "tricap", *words]


# ---- pictures --------------------------------------------------------------------------------------------------------


def shot(name: str, area: bpy.types.Area | None = None) -> Steps:
    """Keep a picture of the window, or of one area, as OUT/name.png."""
    yield from settle()
    yield from pause(0.1)
    picture = pixels()
    if area is not None:
        top = window().height - area.y - area.height
        picture = picture[top : top + area.height, area.x : area.x + area.width]
    write_png(OUT / f"{name}.png", picture)
    say("shot  ", name)


# ---- the run ---------------------------------------------------------------------------------------------------------


def run(script: str) -> None:
    """Step through `script`.steps(), then end Blender: exit code 0 if all is so, 1 if not, 3 after an exception."""
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"  # in this window, where events can be simulated
    going: list[Steps] = []

    def step() -> float:
        try:
            if not going:
                say(bpy.app.version_string, "window", window().width, window().height)
                going.append(_with_picture(importlib.import_module(script).steps()))
            next(going[0])
            return STEP_S
        except StopIteration:
            say(f"{len(failures)} failed", *failures)
            code = 1 if failures else 0
        except BaseException:
            traceback.print_exc()
            code = 3
        sys.stdout.flush()
        os._exit(code)

    bpy.app.timers.register(step, first_interval=1.0, persistent=True)  # a script may open another file


def _with_picture(steps: Steps) -> Steps:
    """The steps, and a picture of the window if they fail."""
    yield from settle()
    try:
        yield from steps
    except GaveUp:
        yield from shot("failed_here")
    except Exception:
        yield from shot("failed_here")
        raise
