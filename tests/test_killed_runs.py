"""Runs that are killed anywhere end, run again, as if nothing had happened. A few moments here; `dev.py bench resume` tries 200."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the children are forked")


@pytest.fixture(scope="module")
def killing() -> ModuleType:
    """killing.py, which lies beside this file."""
    spec = importlib.util.spec_from_file_location("killing", Path(__file__).with_name("killing.py"))
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["killing"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "count"),
    [("tricap run", 4), ("operator", 3), ("tricap run, in stretches", 3), ("operator, in stretches", 2),
     ("tricap contour", 2), ("contour operator", 2)],
)  # fmt: skip
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path: Path, driver: str, count: int) -> None:
    """In a process of its own: what is forked from one that has Blender and threads in it may die by itself."""
    if "operator" in driver and importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed for this Python")
    script, told = Path(__file__).parent / "bench" / "resume.py", tmp_path / "told.json"
    words = ["--moments", str(count), "--seed", "7", "--driver", driver, "--json", str(told)]
    done = subprocess.run([sys.executable, str(script), *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert sum(json.loads(told.read_text())[driver]["moments"].values()) == count


def test_what_differs_is_seen(killing: ModuleType, tmp_path: Path) -> None:
    """The comparison looks at every byte but the seconds."""
    for name, seconds, cloud in (("a", "1.5", b"1"), ("b", "2.75", b"1"), ("c", "2.75", b"2")):
        (tmp_path / name / "clouds").mkdir(parents=True)
        (tmp_path / name / "clouds" / "0000.ply").write_bytes(cloud)
        (tmp_path / name / "run.json").write_text(f'{{"stages": {{"fit": {{"seconds": {seconds}, "sigma0": 1.5}}}}}}')
    a, b, c = (killing.contents(tmp_path / name) for name in "abc")
    assert killing.differences(a, b) == [] and killing.differences(a, c) == ["clouds/0000.ply"]
    (tmp_path / "c" / ".0000.npz.x.part").write_bytes(b"")
    assert killing.differences(a, killing.contents(tmp_path / "c")) == [".0000.npz.x.part", "clouds/0000.ply"]
