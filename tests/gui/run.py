"""`dev.py gui-test`: Tricap's workflow in a true Blender window, by mouse and keys. One script after the other, pictures kept."""

import argparse
import re
import signal
import sys
import time
from pathlib import Path

import chroot
import window

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SCRIPTS = ("sample", "workflow", "control_rig", "over_footage", "review", "smooth", "points", "points_2d")
LIMIT_S = 480.0
SIZE = (1600, 1000)


def main() -> int:
    """Set up, run the scripts, say how each went; exit code 0 if all passed or nothing could be set up."""
    options = _parser().parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that Blender and its display end too
    began = time.monotonic()
    try:
        root = chroot.set_up(options.root, install=options.install)
        program = "the module's Blender" if options.module else chroot.version(root)
        say(f"{program} is ready in {root} ({time.monotonic() - began:.0f} s)")
        failed = [path.stem for path in options.scripts if not _passed(root, path.resolve(), options)]
    except chroot.Unavailable as why:
        say(f"gui-test: skipped, for {why}.")
        return 0
    say(f"gui-test: {'failed: ' + ', '.join(failed) if failed else 'passed'} ({time.monotonic() - began:.0f} s); pictures: {options.out}")
    return 1 if failed else 0


def _passed(root: Path, script: Path, options: argparse.Namespace) -> bool:
    began, out = time.monotonic(), options.out / script.stem
    code = window.run_script(root, options.package, script, out, options.limit, options.data, _size(script), module=options.module)
    how = {0: "passed", window.TIMED_OUT: "stopped"}.get(code, f"failed (exit code {code})")
    say(f"== {script.stem}: {how} after {time.monotonic() - began:.0f} s")
    if code:
        say((out / "log.txt").read_text(errors="replace").rstrip())
    return code == 0


def _size(script: Path) -> tuple[int, int]:
    """The size of the window: the script's SIZE = (width, height), if it has one. A small window is drawn sooner."""
    found = re.search(r"^SIZE = \((\d+), (\d+)\)", script.read_text(encoding="utf-8"), re.MULTILINE)
    return (int(found[1]), int(found[2])) if found else SIZE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--package", type=Path, required=True, help="the extension's zip")
    parser.add_argument("--root", type=Path, default=ROOT / ".gui" / "blender", help="folder of the chroot")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "gui", help="folder for pictures and logs")
    parser.add_argument("--data", type=Path, help="a file or folder for the scripts")
    parser.add_argument("--install", action="store_true", help="install debootstrap where it is missing, by the system's package manager")
    parser.add_argument("--module", action="store_true", help="the window of this Python's module bpy, not that of Debian's Blender")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds for one script, on a machine that does nothing else")
    parser.add_argument("scripts", nargs="*", type=Path, default=[HERE / f"{name}.py" for name in SCRIPTS])
    return parser


def say(line: str) -> None:
    """Tell the user at once."""
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
