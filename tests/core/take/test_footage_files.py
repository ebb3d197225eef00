"""Footage found in folders, and views named after what file names tell."""

from pathlib import Path

import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.images.sequence import open_sequence
from tricap.core.take.footage_files import find_footage, find_moved, name_views


def made(folder: Path, *names: str) -> list[Path]:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    return [folder / name for name in names]


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["right.mp4", "left.mp4", "centre.mp4"], ["L", "C", "R"]),
        (["shot1_R.avi", "shot1_L.avi"], ["L", "R"]),
        (["kickLeft.mov", "kickRight.mov", "kickMiddle.mov"], ["L", "C", "R"]),
        (["links.mp4", "mitte.mp4", "rechts.mp4"], ["L", "C", "R"]),
        (["walk cam10.mp4", "walk cam2.mp4"], ["cam2", "cam10"]),
        (["GX010031.MP4", "GX010044.MP4"], ["GX010031", "GX010044"]),
        (["left_1.mp4", "left_2.mp4"], ["1", "2"]),
    ],
)
def test_names_and_order(tmp_path: Path, files: list[str], names: list[str]) -> None:
    named = name_views(made(tmp_path, *files))
    assert [name for name, _ in named] == names and {path.name for _, path in named} == set(files)


def test_a_name_that_is_taken_is_not_given_again(tmp_path: Path) -> None:
    assert [name for name, _ in name_views(made(tmp_path, "left.mp4"), taken=["L"])] == ["left"]
    assert [name for name, _ in name_views(made(tmp_path, "a.mp4"), taken=["a"])] == ["a 2"]


def test_an_image_stands_for_its_folder_and_a_folder_for_all_in_it(tmp_path: Path) -> None:
    made(tmp_path, "L/0001.png", "L/0002.png", "R/0001.png", "notes/a.txt", "extra.mp4", ".hidden.mp4")
    assert find_footage(tmp_path / "L", ["0001.png", "0002.png"]) == [tmp_path / "L"]
    assert [p.name for p in find_footage(tmp_path, [])] == ["extra.mp4", "L", "R"]
    assert find_footage(tmp_path / "L", []) == [tmp_path / "L"]
    assert find_footage(tmp_path, ["extra.mp4", ""]) == [tmp_path / "extra.mp4"]


def test_what_is_no_footage_is_told(tmp_path: Path) -> None:
    made(tmp_path, "notes/a.txt")
    notes = tmp_path / "notes"
    for folder, names, words in ((notes, [], "holds no footage"), (notes, ["a.txt"], "neither a movie nor an image"),
                                 (tmp_path, ["gone.mp4"], "is missing"), (tmp_path / "gone", [], "Cannot read the folder")):  # fmt: skip
        with pytest.raises(InputError, match=words):
            find_footage(folder, names)


def test_moved_footage_is_found_by_the_names_that_it_had(tmp_path: Path) -> None:
    made(tmp_path / "new" / "shot 1", "left.mp4", "C/0.png", "C/1.png")
    take = tmp_path / "take"
    take.mkdir()
    links = {"L": take / "L.mp4", "C": take / "centre", "R": take / "right"}
    links["L"].symlink_to(tmp_path / "old" / "left.mp4")
    links["C"].symlink_to(tmp_path / "old" / "C")
    made(take, "right/0.png")
    found = {links["L"]: tmp_path / "new" / "shot 1" / "left.mp4", links["C"]: tmp_path / "new" / "shot 1" / "C"}
    for place in ("new", "new/shot 1", "new/shot 1/C"):
        assert {link: path.resolve() for link, path in find_moved(links, tmp_path / place).items()} == found
    with pytest.raises(InputError, match=r"take does not contain left.mp4, C \(the footage of L, C\)"):
        find_moved(links, take)
    with pytest.raises(InputError, match="view L is not at .*old/left.mp4 any more"):
        open_sequence(take, images=None, movie="L.mp4", view="L")
