"""Runs that are killed anywhere end, run again, as if nothing had happened. A few moments here; `dev.py bench resume` tries 200."""

import importlib.util
import os
import sys
from collections.abc import Iterator
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


@pytest.fixture(scope="module")
def take(killing: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(killing.tiny_take(tmp_path_factory.mktemp("tiny") / "take"))


@pytest.fixture
def profile(killing: ModuleType, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[None]:
    """The children's Blender profile, not that of this process; where it has imported bpy already, it is that of this process."""
    if "bpy" in sys.modules:
        request.getfixturevalue("blender")
    before = os.environ.get("BLENDER_USER_RESOURCES")
    killing.prepare_profile(tmp_path / "profile")
    yield
    os.environ.pop("BLENDER_USER_RESOURCES") if before is None else os.environ.update(BLENDER_USER_RESOURCES=before)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "count"),
    [("tricap run", 9), ("operator", 6), ("tricap run, in stretches", 6), ("operator, in stretches", 4),
     ("tricap contour", 4), ("contour operator", 2)],
)  # fmt: skip
def test_a_killed_run_goes_on_to_the_same_bytes(
    killing: ModuleType, take: Path, tmp_path: Path, profile: None, driver: str, count: int
) -> None:
    if "operator" in driver and importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed for this Python")
    tally = killing.kill_runs(driver, take, tmp_path, count, seed=7)
    assert sum(tally.moments.values()) == count and not tally.faults, "\n".join(tally.faults)


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
