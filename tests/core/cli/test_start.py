"""The command answers without loading scipy or the stages. Which modules are loaded is tested, because times depend on the machine."""

import subprocess
import sys
from pathlib import Path

import pytest

from tricap.addon.retarget import command as retargeting
from tricap.addon.retarget.programs import PROGRAMS
from tricap.core.calibration.boards.board import BoardKind
from tricap.core.calibration.rig_files import FORMATS
from tricap.core.cli import parser
from tricap.core.motion.formats.markers import UNITS_M
from tricap.core.run.engine import RETRIES

HEAVY = ("scipy", "bpy", "tricap.core.surface", "tricap.core.tracking.track", "tricap.core.fitting.stages", "tricap.core.run")
LISTING = "import sys, tricap.__main__ as m; "
CODE = f"""{LISTING}
try:
    m.main(sys.argv[1:])
except SystemExit:
    print()
print(*sys.modules)"""


def loaded(*arguments: str) -> set[str]:
    """The modules that a command loads, by name and by package."""
    done = subprocess.run([sys.executable, "-c", CODE, *arguments], capture_output=True, text=True, check=True)
    names = done.stdout.splitlines()[-1].split()
    return {".".join(name.split(".")[:n]) for name in names for n in range(1, 5)}


@pytest.mark.parametrize("arguments", [("--help",), ("run", "--help"), ("run", "--nonsense")], ids=" ".join)
def test_help_and_invalid_arguments_load_no_stage(arguments: tuple[str, ...]) -> None:
    modules = loaded(*arguments)
    assert "tricap.core.cli.parser" in modules
    assert not modules & {*HEAVY, "tricap.core.matching", "tricap.core.checking"}


@pytest.mark.parametrize("name", ["rig.toml", "take.toml"])
def test_check_of_a_damaged_file_loads_no_stage(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("fps = [", encoding="utf-8")
    modules = loaded("check", str(tmp_path / name))
    assert "tricap.core.checking.findings" in modules
    assert not modules & {*HEAVY}


def test_a_command_that_computes_is_found_out() -> None:
    """The guard sees what a command loads."""
    assert {"tricap.core.fitting.stages", "tricap.core.run"} <= loaded("run", "no take", "--out", "nowhere")


def test_the_parser_knows_what_it_does_not_import() -> None:
    assert parser.RIG_FORMATS == tuple(sorted(FORMATS))
    assert parser.RETRIES == RETRIES
    assert parser.BOARDS == tuple(BoardKind)
    assert retargeting.UNITS == tuple(UNITS_M)
    assert retargeting.PROGRAM_NAMES == tuple(PROGRAMS)
