"""One Blender window: a display of its own, an empty profile with the extension installed, one script that drives it, its pictures."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chroot import SHARE, Unavailable

DRIVER = Path(__file__).with_name("drive.py")
MODULE = Path(__file__).with_name("module_window.py")
TIMED_OUT, OTHER_BUILD = 124, 4  # exit codes; OTHER_BUILD is that of MODULE


def run_script(
    root: Path, package: Path, script: Path, out: Path, limit_s: float, data: Path | None, size: tuple[int, int], *, module: bool = False
) -> int:
    """Install `package` into an empty profile, open Blender's window in the chroot `root`, and let `script` drive it (see drive.py).

    What the script writes to its folder `drive.OUT` is in `out` afterwards, with log.txt; `data`, a file or folder, is copied to
    `drive.DATA`. Returns the script's exit code, 0 when all that it checked is so; TIMED_OUT after limit_s, longer on a busy machine.
    With `module`, the window is that of this Python's module bpy instead; the chroot has the display.

    Raises:
        Unavailable: no display can be opened, or the extension cannot be installed.
    """
    with _shared_folder(root) as folder:
        inside = Path("/") / folder.relative_to(root)
        for source in (*DRIVER.parent.glob("[a-z]*.py"), script, *script.parent.glob("[a-z]*.py")):
            shutil.copy(source, folder)
        if data is not None:
            (shutil.copytree if data.is_dir() else shutil.copy)(data, folder / "data" / data.name)
        shutil.copyfile(package, folder / "tricap.zip")
        (folder / "out").mkdir()
        with _display(root, inside, size) as display:
            # Each has a cache of its own: two versions of the renderer Mesa that share one end each other (SIGBUS).
            home, cache = (folder, root / SHARE / "module_cache") if module else (inside, Path("/") / SHARE / "cache")
            environment = _environment(home, cache, display)
            _install([sys.executable, MODULE, "--install", home / "tricap.zip"] if module else _installing(root, home), environment)
            blender = [sys.executable, MODULE] if module else ["chroot", root, "blender"]
            code = _drive(blender, home, script.stem, size, environment, limit_s, folder / "out" / "log.txt")
        if module and code == OTHER_BUILD:
            raise Unavailable((folder / "out" / "log.txt").read_text(errors="replace").strip().rstrip("."))
        out.mkdir(parents=True, exist_ok=True)
        shutil.copytree(folder / "out", out, dirs_exist_ok=True, symlinks=True)  # those into the data lead nowhere outside
        return code


@contextmanager
def _shared_folder(root: Path) -> Iterator[Path]:
    (root / SHARE).mkdir(exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="run-", dir=root / SHARE))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _display(root: Path, inside: Path, size: tuple[int, int]) -> Iterator[str]:
    """A virtual display of the chroot; its picture lies in the file that drive.py reads."""
    (root / inside.relative_to("/") / "screen").mkdir()
    command = [
        "chroot",
        root,
        "Xvfb",
        "-displayfd",
        "1",
        "-screen",
        "0",
        f"{size[0]}x{size[1]}x24",
        "-nolisten",
        "tcp",
        "+extension",
        "GLX",
        "-fbdir",
        inside / "screen",
    ]
    server = subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert server.stdout is not None
    try:
        number = server.stdout.readline().strip()
        if not number.isdigit():
            raise Unavailable("Xvfb opened no display")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


def _environment(home: Path, cache: Path, display: str) -> dict[str, str]:
    keep = {name: value for name, value in os.environ.items() if name in ("LANG", "PATH", "TERM")}
    return {
        **keep,
        "DISPLAY": display,
        "HOME": str(home),
        "XDG_CACHE_HOME": str(cache),
        "LIBGL_ALWAYS_SOFTWARE": "1",
        "BLENDER_USER_RESOURCES": str(home / "profile"),
        "PYTHONUNBUFFERED": "1",
        "PYTHONFAULTHANDLER": "1",  # the module's Python says where it crashed
        "OPENBLAS_NUM_THREADS": "1",
        "LC_ALL": "C.UTF-8",
    }


def _installing(root: Path, inside: Path) -> list[object]:
    return ["chroot", root, "blender", "--command", "extension", "install-file", "-r", "user_default", "-e", inside / "tricap.zip"]


def _install(command: list[object], environment: dict[str, str]) -> None:
    done = subprocess.run([str(part) for part in command], env=environment, capture_output=True, text=True, timeout=180)
    if done.returncode:
        raise Unavailable(f"the extension could not be installed: {(done.stdout + done.stderr).strip()}")


def _drive(
    blender: list[object], home: Path, script: str, size: tuple[int, int], environment: dict[str, str], limit_s: float, log: Path
) -> int:
    start = f"import sys; sys.path.insert(0, {str(home)!r}); import drive; drive.run({script!r})"
    options = ["--enable-event-simulate", "--no-window-focus", "--gpu-backend", "opengl", "--window-geometry", 0, 0, *size]
    command = [*blender, *options, "--python-exit-code", "3", "--python-expr", start]
    with log.open("w") as lines:
        window = subprocess.Popen([str(part) for part in command], env=environment, stdin=subprocess.DEVNULL, stdout=lines, stderr=lines)
        try:
            return _ended(window, limit_s)
        finally:
            window.kill()  # chroot became Blender, so this is Blender
            window.wait()


def _ended(blender: "subprocess.Popen[bytes]", limit_s: float) -> int:
    """The exit code; TIMED_OUT after as many seconds of a machine that does nothing else."""
    spent, before = 0.0, time.monotonic()
    while spent < limit_s:
        try:
            return blender.wait(1.0)
        except subprocess.TimeoutExpired:
            now = time.monotonic()
            spent += (now - before) / max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
            before = now
    return TIMED_OUT
