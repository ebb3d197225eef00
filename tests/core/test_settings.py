"""Settings: defaults, limits, and every kind of value that is refused, with the sentence that helps."""

import dataclasses
import json

import pytest

from tricap.core import pipeline
from tricap.core.errors import InputError
from tricap.core.settings import from_table, knob, nearest_name, to_table


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


@pytest.mark.parametrize("group", sorted(pipeline.SETTINGS))
def test_every_knob_says_what_it_is_and_lies_within_its_limits(group: str) -> None:
    cls = pipeline.SETTINGS[group]
    for field in dataclasses.fields(cls):
        about = field.metadata["about"]
        assert about.endswith(".") and about[0].isupper(), field.name
        low, high = field.metadata["low"], field.metadata["high"]
        assert (low is None or field.default >= low) and (high is None or field.default <= high), field.name
        assert not field.metadata["choices"] or field.default in field.metadata["choices"]
    assert from_table(cls, json.loads(json.dumps(to_table(cls()))), group) == cls()


def test_the_commands_settings_overrule_the_takes() -> None:
    made = pipeline.settings_of({"matching": {"patch_px": 15, "max_shift_px": 2.0}}, {"matching": {"patch_px": 17}}, "take.toml")
    assert (made["matching"].patch_px, made["matching"].max_shift_px) == (17, 2.0)
    with pytest.raises(InputError, match="Did you mean “matching”"):
        pipeline.settings_of({}, {"matchin": {"patch_px": 17}}, "take.toml")


def test_the_nearest_name() -> None:
    assert nearest_name("elbow.r", ("elbow.R", "wrist.R")) == " Did you mean “elbow.R”?"
    assert nearest_name("q", ("elbow.R", "wrist.R")) == " Known are: elbow.R, wrist.R."
