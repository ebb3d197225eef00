"""Writing take.toml: what TOML reads comes back exactly, nothing is written in vain, and nothing wrong is written."""

import os
import tomllib
from pathlib import Path

import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.take.footage_files import copy_take
from tricap.core.take.take import read_take
from tricap.core.take.writing import has_comments, link_footage, new_table, read_table, renumbered, take_of_table, toml_text, write_table

FULL = {
    "format": "tricap-take", "version": 1, "fps": 29.97, "interlaced": "odd", "rig": "rig.toml", "reference_view": "C", "frames": [2, 40],
    "views": [{"name": "L", "images": "L/*.png", "offset_frames": -3}, {"name": "C", "movie": 'C "ü".mp4'}],
    "body": {"model": "arm.R", "locked": ["elbow.R twist"], "limits": {"elbow.R flexion": [0.0, 140.5]}},
    "seeds": {"frame": 5, "surface": [{"L": [1.5, 2.0], "C": [3.0, 4.25]}],
              "joints": {"elbow.R": {"L": [612.125, 180.5], "C": [0.1, 1e-7]}, "wrist.R": {}}},
    "keyframes": [{"frame": 9, "joints": {"elbow.R": {"L": [6.0, 1.0]}}}],
    "corrections": [{"kind": "region", "view": "L", "frames": [3, 5], "polygon": [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]}],
    "settings": {"matching": {"patch_px": 17, "robust": True}, "surface": {}},
}  # fmt: skip


def test_every_kind_of_value_comes_back_exactly() -> None:
    assert tomllib.loads(toml_text(FULL)) == FULL


def test_people_can_read_it() -> None:
    text = toml_text(FULL)
    assert '[[views]]\nname = "L"\n' in text and '\n[seeds.joints]\n"elbow.R" = { L = [612.125, 180.5]' in text
    assert "\n[settings.matching]\npatch_px = 17\nrobust = true\n" in text and text.endswith("\n")


def test_a_file_that_says_it_already_is_left_alone(tmp_path: Path) -> None:
    assert write_table(tmp_path, FULL)
    path = tmp_path / "take.toml"
    path.write_text("# my own words\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    assert not write_table(tmp_path, FULL) and path.read_text(encoding="utf-8").startswith("# my own words")
    assert write_table(tmp_path, FULL | {"fps": 25.0}) and read_table(tmp_path) == FULL | {"fps": 25.0}


def test_what_is_no_take_is_not_written(tmp_path: Path) -> None:
    write_table(tmp_path, FULL)
    with pytest.raises(InputError, match="fps"):
        write_table(tmp_path, FULL | {"fps": -1.0})
    with pytest.raises(InputError, match="Did you mean “seeds”"):
        write_table(tmp_path, FULL | {"sedes": {}})
    assert read_table(tmp_path) == FULL and len(list(tmp_path.iterdir())) == 1


def test_no_file_is_an_empty_table_and_a_broken_one_is_told(tmp_path: Path) -> None:
    assert read_table(tmp_path) == {}
    (tmp_path / "take.toml").write_text("format = ", encoding="utf-8")
    with pytest.raises(InputError, match="is not a TOML file"):
        read_table(tmp_path)


def test_a_file_with_comments_is_copied_before_it_is_written(tmp_path: Path) -> None:
    """They were dropped without a word."""
    path, table = tmp_path / "take.toml", new_table([{"name": n, "movie": f"{n}#1.mp4"} for n in "LC"])
    write_table(tmp_path, table)
    assert not has_comments(tmp_path), "a # in a text is none"
    for number, name in ((1, "take.toml.bak"), (2, "take.toml.2.bak")):
        commented = path.read_text() + f"# thought {number}\n"
        path.write_text(commented)
        assert has_comments(tmp_path) and write_table(tmp_path, table | {"fps": 30.0 + number})
        assert (tmp_path / name).read_text() == commented and not has_comments(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_link_is_not_replaced_by_a_take(tmp_path: Path) -> None:
    (tmp_path / "take").mkdir()
    table = new_table([{"name": n, "movie": f"{n}.mp4"} for n in "LC"])
    (tmp_path / "shared.toml").write_text(toml_text(table))
    (tmp_path / "take" / "take.toml").symlink_to(tmp_path / "shared.toml")
    assert not write_table(tmp_path / "take", table), "nothing changes"
    with pytest.raises(InputError, match="is a link, which a file would replace"):
        write_table(tmp_path / "take", table | {"fps": 30.0})
    assert (tmp_path / "take" / "take.toml").is_symlink()


def test_a_new_table_is_a_take(tmp_path: Path) -> None:
    take = take_of_table(tmp_path, new_table([{"name": n, "movie": f"{n}.mp4"} for n in "LCR"], fps=50.0, model="arm.R"))
    assert (take.fps, take.reference_view, take.body_model) == (50.0, "C", "arm.R")


def test_frames_are_renumbered_when_an_image_becomes_two() -> None:
    """Whole images to fields and back; where two frames become one, the earlier one's clicks stay."""
    table = {"frames": [2, 40], "seeds": {"frame": 3}, "keyframes": [{"frame": 4, "joints": {}}, {"frame": 9, "joints": {}}],
             "corrections": [{"kind": "trajectory", "frame": 5}, {"kind": "region", "frames": [1, 4]}], "fps": 25.0}  # fmt: skip
    double = renumbered(table, 2, 1)
    assert double == {"frames": [4, 80], "seeds": {"frame": 6}, "keyframes": [{"frame": 8, "joints": {}}, {"frame": 18, "joints": {}}],
                      "corrections": [{"kind": "trajectory", "frame": 10}, {"kind": "region", "frames": [2, 8]}], "fps": 25.0}  # fmt: skip
    assert renumbered(double, 1, 2) == table and renumbered({"fps": 25.0}, 2, 1) == {"fps": 25.0}
    both = {"keyframes": [{"frame": 4, "joints": {"a": 1}}, {"frame": 5, "joints": {"a": 2}}], "frames": [3, 9]}
    assert renumbered(both, 1, 2) == {"keyframes": [{"frame": 2, "joints": {"a": 1}}], "frames": [1, 5]}
    met = {"seeds": {"frame": 4, "joints": {"a": 1}}, "keyframes": [{"frame": 5, "joints": {"a": 2, "b": 3}}]}
    assert renumbered(met, 1, 2) == {"seeds": {"frame": 2, "joints": {"a": 1, "b": 3}}, "keyframes": []}


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_footage_is_not_copied_to_the_end_of_a_link(tmp_path: Path) -> None:
    """A link that exists cannot be made; where links cannot be made at all, footage is copied."""
    (tmp_path / "film.mp4").write_bytes(b"film")
    (tmp_path / "take").mkdir()
    (tmp_path / "take" / "L.mp4").symlink_to(tmp_path / "profile")
    with pytest.raises(InputError, match="is a link to a place that does not exist; remove it"):
        link_footage(tmp_path / "take", [(tmp_path / "take" / "L.mp4", tmp_path / "film.mp4")])
    assert not (tmp_path / "profile").exists() and (tmp_path / "take" / "L.mp4").is_symlink()


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_cameras_are_not_copied_to_the_end_of_a_link(plane_take: Path, tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "rig.toml").symlink_to(tmp_path / "letter.txt")
    (tmp_path / "letter.txt").write_text("mine")
    copy_take(plane_take, tmp_path / "copy")
    assert (tmp_path / "letter.txt").read_text() == "mine" and read_take(tmp_path / "copy").rig_path.is_file()
