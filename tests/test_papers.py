"""The tables of docs/method.md that go through the two papers: every sentence and figure is there, and names what exists."""

import argparse
import ast
import re
from functools import cache
from pathlib import Path

import pytest

from tricap.addon import command
from tricap.addon.retarget import command as retargeting
from tricap.core.cli.parser import build_parser
from tricap.core.report.pages import KINDS
from tricap.core.run.settings import SETTINGS

ROOT = Path(__file__).resolve().parent.parent
NUMBERS = [*(str(n) for n in range(1, 86)), *(f"B{n}" for n in range(1, 19))]
SPAN = re.compile(r"`([^`]+)`")


def rows(text: str) -> dict[str, tuple[str, str]]:
    """What stands in the columns “here” and “test”, by number."""
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines() if re.match(r"\| B?\d+ \|", line)]
    assert all(len(row) == 4 for row in cells)
    return {row[0].strip("| "): (row[2], row[3]) for row in cells}


TEXT = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
TABLE = rows(TEXT)


@cache
def commands() -> dict[str, set[str]]:
    """The options of every command."""
    parser = build_parser((command.add_commands, retargeting.add_commands))
    (chosen,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return {name: {o for action in part._actions for o in action.option_strings} for name, part in chosen.choices.items()}


@cache
def words_of_the_panel() -> set[str]:
    """Every text constant of the add-on."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "addon").rglob("*.py"))
    return {node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


@cache
def functions_of(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)}


def faults(here: str, test: str) -> list[str]:
    """What a row names that does not exist."""
    found = []
    for span in SPAN.findall(here):
        if span.startswith("tricap "):
            name, *options = span.split()[1:]
            found += [span] if name not in commands() or not set(options) <= commands()[name] else []
        else:
            group, _, name = span.partition(".")
            found += [span] if group not in SETTINGS or name not in SETTINGS[group].__dataclass_fields__ else []
    found += [word for word in re.findall(r"\*([^*]+)\*", here) if word not in words_of_the_panel()]
    tests = [(ROOT / "tests" / file, function) for file, _, function in (span.partition("::") for span in SPAN.findall(test))]
    return found + [test for path, function in tests or [(ROOT, "")] if not path.is_file() or function not in functions_of(path)]


def test_every_sentence_of_the_papers_has_a_row() -> None:
    assert list(TABLE) == NUMBERS
    assert all(SPAN.search(here) or "*" in here for here, _ in TABLE.values())


@pytest.mark.parametrize("number", NUMBERS)
def test_a_row_names_what_exists(number: str) -> None:
    assert not faults(*TABLE[number])


def test_every_figure_of_the_papers_has_a_place() -> None:
    """Each figure once (the text of B has none with the number 15); commands, settings, buttons and sections of the report exist."""
    lines = [line.strip("| ").split(" | ") for line in TEXT.splitlines() if re.match(r"\| [AB] \d", line)]
    figures = [figure for numbers, _, _ in lines for figure in numbers.split(", ")]
    assert sorted(figures) == sorted([*(f"A {n}" for n in range(1, 15)), *(f"B {n}" for n in range(1, 18) if n != 15)])
    sections = {*KINDS, "Cameras and person"}
    for _, _, here in lines:
        named = re.findall(r"\*\*([^*]+)\*\*", here)
        assert set(named) <= sections, here
        chapters = re.findall(r"\*([^*]+)\*", here) if here.endswith(" above") else []
        assert all(f"## {chapter}" in TEXT for chapter in chapters)
        assert chapters or not [fault for fault in faults(re.sub(r"\*\*[^*]+\*\*", "", here), "") if fault]


def test_what_does_not_exist_is_found() -> None:
    test = "`test_papers.py::test_what_does_not_exist_is_found`"
    here = "`tricap run --film`, `skin.relief`, *Fit Body*"
    assert not faults(here, test)
    for wrong in ("`tricap dance`", "`tricap run --dance`", "`skin.dance`", "`dance.relief`", "*Dance*"):
        assert faults(wrong, test)
    assert (
        faults(here, "`test_papers.py::test_dance`")
        and faults(here, "`test_dance.py::test_dance`")
        and faults(here, f"{test}, `test_papers.py::test_dance`")
    )
