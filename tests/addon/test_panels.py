"""Sentences in the sidebar: wrapped by the width of their words."""

from types import ModuleType


def test_a_sentence_is_wrapped_by_its_width(empty: ModuleType) -> None:
    import blf

    from tricap.addon.panels import FONT, wrapped

    def measure(part: str) -> float:
        return blf.dimensions(FONT, part)[0]

    blf.size(FONT, 11.0)
    text = "Save the Blender file first: the project folder is created next to it. Then add the footage of your cameras."
    lines = wrapped(text, 200.0, measure)
    assert " ".join(lines) == text and max(map(measure, lines)) <= 200.0
    assert all(measure(f"{line} {after.split()[0]}") > 200.0 for line, after in zip(lines, lines[1:])), "a line is too short"
    assert wrapped("One.\n\nTwo.", 200.0, measure) == ["One.", "Two."]
    assert wrapped("a_very_long_name_of_a_file.toml is missing", 60.0, measure)[0] == "a_very_long_name_of_a_file.toml"
    assert wrapped("", 60.0, measure) == []
