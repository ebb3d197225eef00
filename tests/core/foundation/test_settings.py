"""Settings: defaults, limits, and every kind of value that is refused, with the sentence that helps."""

import ast
import dataclasses
import json
import re
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

from tricap.core.cli import contour, points
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.settings import from_table, knob, nearest_name, to_table
from tricap.core.run import pipeline, take_run
from tricap.core.run import settings as run_settings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sample:
    patch_px: int = knob(13, "Side.", unit="px", low=5, high=51)
    sigma: float = knob(0.25, "Limit.", low=0.0)
    free: float = knob(1.0, "No limits.")
    correct: bool = knob(True, "Yes or no.")
    way: str = knob("odd", "Lines.", choices=("none", "odd"))
    text: str = knob("x", "Any text.", was=("words", "label"))


def test_a_table_becomes_settings_and_comes_back() -> None:
    settings = from_table(Sample, dict(patch_px=17, sigma=1, correct=False, way="none", text="y"), "t")
    assert (settings.patch_px, settings.sigma, settings.free, settings.correct, settings.way) == (17, 1.0, 1.0, False, "none")
    assert isinstance(settings.sigma, float)
    assert from_table(Sample, to_table(settings), "t") == settings
    assert from_table(Sample, dict(patch_px=17.0), "t").patch_px == 17


def test_a_knob_is_found_under_its_earlier_names() -> None:
    assert from_table(Sample, dict(words="y"), "t") == from_table(Sample, dict(label="y"), "t") == Sample(text="y")
    assert "words" not in to_table(Sample())


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (dict(words="y", text="y"), "sets “text” twice"),
        (dict(label="y", words="y"), "sets “text” twice"),
        (dict(patch=13), "Did you mean “patch_px”?"),
        (dict(zzz=13), "Known are: patch_px, sigma"),
        (dict(patch_px=4), "between 5 and 51"),
        (dict(patch_px=52), "between 5 and 51"),
        (dict(patch_px=12.5), "whole number"),
        (dict(patch_px=True), "a number in px is needed"),
        (dict(patch_px="13"), "a number in px is needed"),
        (dict(patch_px=None), "a number"),
        (dict(patch_px=[13]), "a number"),
        (dict(patch_px=float("nan")), "a number"),
        (dict(patch_px=float("inf")), "a number"),
        (dict(patch_px=10**400), "a number"),
        (dict(free=float("inf")), "a number"),
        (dict(free=float("-inf")), "a number"),
        (dict(sigma=-1e-9), "between 0.0 and None"),
        (dict(correct=1), "write true or false"),
        (dict(correct="true"), "write true or false"),
        (dict(way="even"), "choose one of: none, odd"),
        (dict(way=1), "choose one of: none, odd"),
        (dict(text=1), "a text"),
    ],
)
def test_what_is_refused(table: dict, said: str) -> None:
    with pytest.raises(InputError) as error:
        from_table(Sample, table, "[sample]")
    assert said in str(error.value)
    assert "[sample]" in str(error.value) or "sample" in str(error.value)
    assert "\n" not in str(error.value) and len(str(error.value)) < 250


@pytest.mark.parametrize("group", sorted(run_settings.SETTINGS))
def test_every_knob_says_what_it_is_and_lies_within_its_limits(group: str) -> None:
    cls = run_settings.SETTINGS[group]
    for field in dataclasses.fields(cls):
        about = field.metadata["about"]
        assert about.endswith(".") and about[0].isupper(), field.name
        low, high = field.metadata["low"], field.metadata["high"]
        assert (low is None or field.default >= low) and (high is None or field.default <= high), field.name
        assert not field.metadata["choices"] or field.default in field.metadata["choices"]
    assert from_table(cls, json.loads(json.dumps(to_table(cls()))), group) == cls()


def test_the_commands_settings_overrule_the_takes() -> None:
    made = take_run.settings_of({"matching": {"patch_px": 15, "max_shift_px": 2.0}}, {"matching": {"patch_px": 17}}, "take.toml")
    assert (made["matching"].patch_px, made["matching"].max_shift_px) == (17, 2.0)
    with pytest.raises(InputError, match="Did you mean “matching”"):
        take_run.settings_of({}, {"matchin": {"patch_px": 17}}, "take.toml")


def test_the_nearest_name() -> None:
    assert nearest_name("elbow.r", ("elbow.R", "wrist.R")) == " Did you mean “elbow.R”?"
    assert nearest_name("q", ("elbow.R", "wrist.R")) == " Known are: elbow.R, wrist.R."


def test_a_knob_that_moved_to_another_group() -> None:
    """`tracking.markers` of earlier versions is `key_points.markers`."""
    old, new = {"tracking": {"markers": True, "box_px": 9}}, {"key_points": {"markers": True}}
    for tables in ((old, {}), ({}, old), ({}, new)):
        assert take_run.settings_of(*tables, "take.toml")["key_points"].markers
    with pytest.raises(InputError, match=r"\[key_points\] sets “markers” twice, also under its earlier name"):
        take_run.settings_of({}, {"tracking": {"markers": True}, "key_points": {"markers": False}}, "take.toml")


Reads = set[tuple[str, str]]  # an expression, and an attribute of it that is read


@cache
def reads_of(module: ModuleType) -> Reads:
    """What is read in a module and in all that it imports from core, directly or not."""
    seen, rest, reads = set[Path](), [Path(str(module.__file__))], Reads()
    while rest:
        path = rest.pop()
        if path in seen or not path.is_file():
            continue
        seen.add(path)
        source = path.read_text(encoding="utf-8")
        reads |= reads_in(source)
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.level:
                base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
                for imported in (base, *(base / alias.name for alias in node.names)):
                    rest += [imported.with_suffix(".py"), imported / "__init__.py"]
    return reads


def reads_in(source: str) -> Reads:
    nodes = ast.walk(ast.parse(source))
    return {(ast.unparse(n.value), n.attr) for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Load)}


def unread_knobs(group: str, cls: type, reads: Reads) -> list[str]:
    """The knobs of a group that are not read as attributes of a value named for settings or for the group."""
    owner = re.compile(rf"(^|[._])(settings|s|{group})$|\[.{group}.\]$")
    read = {attribute for value, attribute in reads if owner.search(value)}
    return [f.name for f in dataclasses.fields(cls) if f.name not in read]


READ_BY = {"contour": contour, "key_points": points}  # the others by the run


@pytest.mark.parametrize("group", sorted(run_settings.SETTINGS))
def test_every_knob_is_read_by_what_it_belongs_to(group: str) -> None:
    assert not unread_knobs(group, run_settings.SETTINGS[group], reads_of(READ_BY.get(group, pipeline)))


def test_a_knob_that_nothing_reads_is_reported() -> None:
    """One that is only defined, set, or read from something else; and one that the run does not read, though a command does."""
    source = "def f(settings, sample, link):\n    settings.sigma = link.text = 1\n    return settings.patch_px, sample.way, link.correct"
    assert unread_knobs("sample", Sample, reads_in(source)) == ["sigma", "free", "correct", "text"]
    assert unread_knobs("key_points", run_settings.SETTINGS["key_points"], reads_of(pipeline)) == ["markers"]
