"""`python -m tricap`: one parser for the commands of the core and those of the add-on, without starting Blender for the former."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

import tricap
from tricap.__main__ import main

PATIENCE_S = 900
PROMISED = (
    "run.json",
    "clouds/0000.ply",
    "trajectories.npz",
    "joints.csv",
    "motion.csv",
    "body.toml",
    "skin/0000.ply",
    "report/report.html",
    "body.blend",
)


def test_the_parser_joins_the_commands_of_core_and_addon(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    text = capsys.readouterr().out
    assert ended.value.code == 0
    assert all(f"\n    {command} " in text for command in ("new", "measure", "track", "fit", "run", "demo", "scene"))


def test_the_commands_of_core_do_not_start_blender(tmp_path: Path) -> None:
    code = f"import sys; from tricap.__main__ import main; main(['measure', {str(tmp_path)!r}, '--out', 'x']); print('bpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.strip() == "False", done.stderr


def test_it_runs_as_a_module_and_faults_of_the_input_end_with_2(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tricap", "run", str(tmp_path / "none"), "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2 and done.stderr.startswith("tricap: ") and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "out").exists()


def test_modules_in_a_stranger_s_folder_are_not_loaded(tmp_path: Path) -> None:
    for name in ("numpy", "click", "cv2", "json"):
        (tmp_path / f"{name}.py").write_text("print('stranger')\nraise SystemExit(7)\n")
    line = [sys.executable, "-m", "tricap", "check", "take", "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and "stranger" not in done.stdout + done.stderr, done.stderr


def test_child_processes_do_not_load_them_either(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("print('stranger')\n")
    child = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import json'], check=True)"
    code = f"from tricap.__main__ import _leave_out_working_folder as leave; leave(); {child}"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0 and "stranger" not in done.stdout, done.stderr


@pytest.mark.slow
def test_the_demo_ends_and_leaves_every_promised_file(tmp_path: Path) -> None:
    pytest.importorskip("bpy")
    out = tmp_path / "demo"
    command = [sys.executable, "-m", "tricap", "demo", "--out", str(out), "--set", "sample.frames=6"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert "truth" in done.stdout and "body.blend" in done.stdout
    missing = [name for name in PROMISED if not (out / name).is_file()]
    assert not missing, done.stdout + done.stderr


def test_a_wrong_command_ends_with_2(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-m", "tricap", "nonsense"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and "nonsense" in done.stderr


def test_importing_the_package_loads_nothing_of_blender() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import sys, tricap; print([m for m in ('bpy', 'tricap.addon') if m in sys.modules])"],
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "[]", done.stderr
    assert callable(tricap.register) and callable(tricap.unregister)


@pytest.mark.skipif(sys.platform != "linux", reason="only its loader searches so")
def test_no_child_process_searches_libraries_in_the_working_folder(tmp_path: Path) -> None:
    code = "import os, tricap.core, cv2; print(os.environ['LD_LIBRARY_PATH'])"
    for given in (None, "", ":", "/a::/b:"):
        environment = {name: value for name, value in os.environ.items() if name != "LD_LIBRARY_PATH"}
        environment |= {} if given is None else {"LD_LIBRARY_PATH": given}
        done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, env=environment, cwd=tmp_path)
        entries = done.stdout.strip().split(":")
        assert all(Path(entry).is_absolute() for entry in entries) and ("/b" in entries) == bool(given and "b" in given), done.stderr


@pytest.mark.skipif(sys.platform != "linux" or not importlib.util.find_spec("bpy"), reason="Blender as a module, and pipes")
def test_blender_loads_no_plugins_of_the_working_folder(tmp_path: Path) -> None:
    (tmp_path / "plugins").mkdir()
    os.mkfifo(tmp_path / "plugins" / "evil.so")  # whoever opens it waits
    line = [sys.executable, "-P", "-m", "tricap", "scene", "none", "--blend", "a.blend", "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path, timeout=PATIENCE_S / 9)
    assert done.returncode == 2 and "none" in done.stderr and done.stderr.count("\n") == 1, done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="a working folder cannot be deleted on Windows")
def test_a_working_folder_that_was_deleted_does_not_matter(tmp_path: Path) -> None:
    code = f"import os; os.mkdir({str(tmp_path / 'g')!r}); os.chdir({str(tmp_path / 'g')!r}); os.rmdir({str(tmp_path / 'g')!r}); "
    code += f"from tricap.__main__ import main; raise SystemExit(main(['check', {str(tmp_path / 'none')!r}]))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr


def test_an_early_interruption_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(argv: list[str] | None) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("tricap.addon.command.main", interrupted)
    assert main(["check", "x"]) == 130
