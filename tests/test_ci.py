"""The command of continuous integration: what counts as a failure. Pythons and dev.py are stand-ins here."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

RUN = Path(__file__).parents[1] / ".ci" / "run"
pytestmark = pytest.mark.skipif(os.name == "nt" or not RUN.is_file() or shutil.which("bash") is None, reason="a script for bash")

PROGRAM = """#!/usr/bin/env bash
case "$1 $2 $3" in
    -c*) exit 0 ;;
    "dev.py test -m") {slow} ;;
    "dev.py test ") {quick} ;;
    "dev.py gui-test --install") {window} ;;
esac
"""


def ci(folder: Path, *, slow: str = "exit 0", quick: str = "exit 0", window: str = "exit 0", seconds: tuple[int, int, int] = (60, 20, 30)):
    """Exit code and lines of .ci/run with programs that do as said; seconds for everything, the window, one Python's tests."""
    (folder / ".ci").mkdir()
    shutil.copy(RUN, folder / ".ci" / "run")
    (folder / "programs").mkdir()
    for version in ("3.11", "3.13"):
        program = folder / "programs" / f"python{version}"
        program.write_text(PROGRAM.format(slow=slow, quick=quick, window=window))
        program.chmod(0o755)
    limits = dict(zip(("TRICAP_CI_ALL_S", "TRICAP_CI_WINDOW_S", "TRICAP_CI_TESTS_S"), map(str, seconds)))
    environment = {**os.environ, **limits, "PATH": f"{folder / 'programs'}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", folder / ".ci" / "run"], env=environment, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout


def test_all_passes(tmp_path: Path) -> None:
    code, said = ci(tmp_path)
    assert code == 0 and said.count("dev.py test") == 4 and said.count("dev.py test -m slow") == 2 and "Window: exit code 0" in said


@pytest.mark.parametrize("part", ["slow", "window"])
def test_a_failure_is_one(tmp_path: Path, part: str) -> None:
    code, said = ci(tmp_path, **{part: "exit 3"})  # type: ignore[arg-type]
    assert code == 1 and "exit code 3" in said


def test_a_window_that_hangs_once_it_is_open_is_a_failure(tmp_path: Path) -> None:
    code, said = ci(tmp_path, window="echo 'Blender 5.2 is ready in x'; exec sleep 30", seconds=(2, 1, 1))
    assert code == 1 and "was set up and running, and did not end" in said


def test_a_window_that_cannot_be_set_up_in_time_is_a_sentence(tmp_path: Path) -> None:
    code, said = ci(tmp_path, window="exec sleep 30", seconds=(2, 1, 1))
    assert code == 0 and "could not be set up in the" in said


@pytest.mark.slow
def test_slow_tests_without_room_run_under_one_python(tmp_path: Path) -> None:
    code, said = ci(tmp_path, slow="sleep 6", seconds=(31, 20, 11))
    assert code == 0 and said.count("dev.py test -m slow") == 1 and "the slow tests are left to the other Python" in said


@pytest.mark.slow
def test_tests_that_hang_are_stopped(tmp_path: Path) -> None:
    code, said = ci(tmp_path, slow="exec sleep 30", quick="exec sleep 30", seconds=(3, 1, 1))
    assert code == 1 and "stopped after 1 s" in said and "Window: exit code 0" in said


def test_the_words_by_which_an_open_window_is_known() -> None:
    ready = next(line.split('"')[1] for line in RUN.read_text(encoding="utf-8").splitlines() if line.startswith("READY="))
    assert ready in (RUN.parents[1] / "tests" / "gui" / "run.py").read_text(encoding="utf-8")
