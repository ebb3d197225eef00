"""The `tricap` command with any kind of standard output and error: its exit code and its work do not depend on them."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tricap.core.cli.main import _progress_line, main
from tricap.core.cli.streams import write_line
from tricap.core.foundation.errors import InputError, sentence_of
from tricap.core.foundation.progress import Monitor

pytestmark = pytest.mark.skipif(os.name == "nt", reason="redirects by a shell of Unix")
VIEWS = '[[views]]\nname = "L"\nimages = "L/*.png"\n[[views]]\nname = "R"\nimages = "R/*.png"\n'
RIG = "[cam_0]\nname = 'é“\U0001f600'\n"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig.toml in which `tricap check` finds something, with a name beyond every old encoding."""
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text(RIG, encoding="utf-8")
    return path


def shell(line: str, rig: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """`tricap ARGUMENTS` in the line is the command."""
    script = line.replace("tricap", f"{shlex.quote(sys.executable)} -P -m tricap").replace("RIG", str(rig))
    return subprocess.run(["bash", "-c", script], capture_output=True, env={**os.environ, **environment}, timeout=120)


def test_every_line_ends_with_the_code_of_what_was_found(rig: Path) -> None:
    lines = (
        "tricap check RIG | head -c 0; exit ${PIPESTATUS[0]}",
        "tricap check RIG >&-",
        "tricap check RIG 2>&-",
        "tricap check RIG <&- >&- 2>&-",
        "tricap check RIG 2> /dev/full",
        "tricap check RIG --json > /dev/null",
    )
    script = "; ".join(f"({line}); echo $?" for line in lines)
    done = shell(script, rig)
    codes = [line for line in done.stdout.decode().split() if line.isdecimal()]
    assert codes == ["1"] * len(lines), done
    assert b"Traceback" not in done.stderr and b"Exception ignored" not in done.stderr, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["check RIG", "check RIG --json", "--help", "run --help"])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_an_output_that_cannot_be_written_is_one_sentence(rig: Path, arguments: str, unbuffered: str) -> None:
    done = shell(f"tricap {arguments} > /dev/full; exit $?", rig, PYTHONUNBUFFERED=unbuffered)
    assert done.returncode == 2 and done.stderr.decode().startswith("tricap: Cannot write the output of this command: No space"), done
    assert done.stderr.count(b"\n") == 1
    assert b"required: COMMAND" in shell("tricap > /dev/full", rig).stderr.splitlines()[-1]  # nothing was to be written there
    assert shell("tricap --help | head -c 0; exit ${PIPESTATUS[0]}", rig).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_every_encoding_takes_every_character(rig: Path, encoding: str) -> None:
    plain = shell("tricap check RIG; tricap check RIG --json", rig, PYTHONIOENCODING=encoding)
    text = plain.stdout.decode(encoding)
    assert plain.returncode == 1 and b"Traceback" not in plain.stderr, plain
    found = json.loads(text[text.index("{") :])
    assert "é“\U0001f600" in str(found), text


def test_what_names_would_do_to_a_terminal_is_shown_instead(capfd: pytest.CaptureFixture[str]) -> None:
    """Escape sequences, and marks that turn the direction of writing; JSON stays what it was."""
    evil = "a\x1b]0;pwn\x07\x9b31m\u202eé\u200d\U0001f600\ttab\x7f"
    for line in (f"{evil}\nsecond", json.dumps({"a": evil}, ensure_ascii=False)):
        write_line(line, sys.stdout)
    shown = capfd.readouterr().out
    assert shown.startswith("a\\u001b]0;pwn\\u0007\\u009b31m\\u202eé\u200d\U0001f600\ttab\\u007f\nsecond\n{")
    assert json.loads(shown.splitlines()[-1]) == {"a": evil}


def test_arguments_that_are_unknown_do_not_steer_the_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["check", "a", "b\x1b[31m\u202e"])
    assert "unrecognized arguments: b\\u001b[31m\\u202e" in capfd.readouterr().err


def test_a_progress_bar_that_nobody_reads_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        _progress_line(Monitor())("surface", 1, 2)


def test_faults_of_the_system_are_sentences() -> None:
    assert sentence_of(InputError("a")) == "a"
    assert sentence_of(KeyError("a")) is None and sentence_of(OSError("no number")) is None
    said = sentence_of(OSError(36, "File name too long", "a" * 5000))
    assert said and "File name too long" in said and len(said) < 1600
    assert "memory" in str(sentence_of(MemoryError()))
    assert "memory" in str(sentence_of(ImportError("/usr/lib/x.so: failed to map segment from shared object")))
    assert "thread" in str(sentence_of(RuntimeError("can't start new thread"))) and sentence_of(RuntimeError("a")) is None
    assert sentence_of(ImportError("No module named 'x'")) is None


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps such limits")
def test_a_limit_of_memory_is_one_sentence(rig: Path) -> None:
    for megabytes in (150, 560):
        done = shell(f"ulimit -v {megabytes << 10}; tricap check RIG", rig)
        said = f"tricap: Tricap needs 800 MB of memory, and the limit is {megabytes} MB. Raise the limit (ulimit -v, -d).\n"
        assert done.returncode == 2 and done.stderr.decode() == said, done
    assert shell("ulimit -d 100000; tricap check RIG >&- 2>&-", rig).returncode == 2
    assert shell("ulimit -v 1000000; tricap check RIG", rig).returncode == 1


@pytest.mark.slow
def test_a_name_that_is_too_long_is_one_sentence(rig: Path) -> None:
    long = "a" * 500
    for line in (
        f"measure {rig.parent} --out {rig.parent / 'out'} --frames 0:{'9' * 5000}",
        f"check {long}",
        f"run {long} --out {rig.parent / 'out'}",
        f"calibrate {long} --out {rig.parent / 'b.toml'} --bar 1",
    ):
        done = shell(f"tricap {line}", rig)
        assert done.returncode == 2 and done.stderr.count(b"\n") == 1 and b"tricap: " in done.stderr, done
