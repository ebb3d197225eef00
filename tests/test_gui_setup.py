"""The window's test says in one line why it cannot be set up, and does not fail for it."""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

GUI = Path(__file__).with_name("gui")
Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def gui(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module run, as `dev.py gui-test` starts it, by a root who has debootstrap and room."""
    monkeypatch.syspath_prepend(str(GUI))
    monkeypatch.setattr(os, "geteuid", lambda: 0, raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/sbin/{name}")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**12, 0, 10**12))
    yield importlib.import_module("run")
    for name in ("run", "chroot", "window"):
        sys.modules.pop(name, None)


def said(gui: ModuleType, root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *more: str) -> str:
    """What is printed, with exit code 0."""
    monkeypatch.setattr(gui.signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["run.py", "--package", "none.zip", "--root", str(root), *more])
    assert gui.main() == 0 and not root.exists()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 and lines[0].startswith("gui-test: skipped, for ")
    return lines[0]


@pytest.mark.skipif(os.name == "nt", reason="there are no chroots on Windows")
@pytest.mark.parametrize(
    ("lacking", "why"),
    [
        ("root", "rights of root"),
        ("debootstrap", "debootstrap is not installed"),
        ("room", "GB free"),
        ("network", "could not fetch Debian sid (E: no network)"),
    ],
)
def test_why_not(
    gui: ModuleType, lacking: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if lacking == "root":
        monkeypatch.setattr(os, "geteuid", lambda: 1000, raising=False)
    elif lacking == "debootstrap":
        monkeypatch.setattr(shutil, "which", lambda _: None)
    elif lacking == "room":
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**9, 0, 10**9))
    else:
        told = subprocess.CompletedProcess([], 1, "", "I: x\nE: no network\n")
        monkeypatch.setattr(gui.chroot.subprocess, "run", lambda *_, **__: told)
    assert why in said(gui, tmp_path / "gui" / "blender", capsys, monkeypatch)


@pytest.mark.skipif(os.name == "nt", reason="there are no chroots on Windows")
@pytest.mark.parametrize("asked", [False, True])
def test_debootstrap_is_installed_only_when_asked(
    gui: ModuleType, asked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[list[str]] = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        ran.append(command)
        return subprocess.CompletedProcess(command, 100, "", "E: no such package\n")

    monkeypatch.setattr(shutil, "which", lambda name: None if name == "debootstrap" else f"/usr/bin/{name}")
    monkeypatch.setattr(gui.chroot.subprocess, "run", run)
    line = said(gui, tmp_path / "gui" / "blender", capsys, monkeypatch, *(["--install"] if asked else []))
    if asked:
        assert [command[-2:] for command in ran] == [["DPkg::Lock::Timeout=60", "update"], ["--no-install-recommends", "debootstrap"]]
        assert "debootstrap could not be installed (E: no such package)" in line
    else:
        assert not ran and "--install does it" in line


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the module's window is opened on Linux alone")
def test_the_module_has_what_its_window_needs_and_another_library_is_refused() -> None:
    """The symbols are looked up in the library of Blender 4.5; one without them ends with a sentence, before anything is changed."""
    found = importlib.util.find_spec("bpy")
    places = [Path(place) for place in (found.submodule_search_locations or ())] if found is not None else []
    cases = [(file, 0, "main_python_enter") for place in places if (place / "4.5").is_dir() for file in place.glob("__init__*.so")]
    for file, code, words in (*cases, (Path(np.linalg._umath_linalg.__file__), 4, "has no symbol")):
        script = f"import pathlib, sys; sys.path.insert(0, {str(GUI)!r}); import module_window as window; "
        script += f"print(window._values(pathlib.Path({str(file)!r})))"
        done = subprocess.run([sys.executable, "-c", script], cwd=GUI, capture_output=True, text=True, timeout=60)
        assert done.returncode == code and words in done.stdout, done.stderr
