"""Files from outside: only regular files of a size, and texts that take neither long nor much to parse."""

import json
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.rig_files import read_any
from tricap.core.foundation import bounded
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rig import read_rig
from tricap.core.images.picture import read_image
from tricap.core.motion.formats.bvh import read_bvh
from tricap.core.motion.retarget.mapping import read_preset
from tricap.core.results.folder import Results
from tricap.core.take.take import read_take
from tricap.core.take.writing import read_table

HEAD = 'format = "tricap-take"\nversion = 1\nfps = 25.0\n'
VIEWS = '[[views]]\nname = "L"\nmovie = "l.mp4"\n[[views]]\nname = "R"\nmovie = "r.mp4"\n'
YAML = "%YAML:1.0\n---\n"
SECONDS = 1.0  # each took 7 to 22 s
SLOW = {  # name of the file: its content
    "a key of 20,000 parts": ("take.toml", ".".join("a" * 20_000) + " = 1\n"),
    "quoted parts": ("take.toml", ".".join(['"a"'] * 20_000) + " = 1\n"),
    "a table of 20,000 parts": ("rig.toml", "[" + " . ".join("a" * 20_000) + "]\n"),
    "spaces": ("rig.yml", YAML + "a" + " " * 100_000 + "b\n"),
    "many openings": ("rig.yml", YAML + "a: !!opencv-matrix\n   rows: 3\n" + "   data: [ " * 20_000),
    "many rows": ("rig.yml", YAML + "a: !!opencv-matrix\n" + "   rows: rows:" * 20_000),
    "names": ("rig.yml", YAML + 'names: [ "' * 50_000),
    "one long word": ("take.toml", "a" * 1_000_000),
    "words": ("take.toml", "a.b " * 250_000),
    "quotes": ("take.toml", '"' * 1_000_000),
    "an array": ("take.toml", HEAD + "frames = [" + "1.5, " * 150_000),
}
TOO_MUCH = {
    "400 digits": HEAD + VIEWS + f"[settings.matching]\npatch_px = {'9' * 400}\n",
    "400 digits as fps": HEAD.replace("25.0", "9" * 400) + VIEWS,
    "400 digits in a click": HEAD + VIEWS + f"[seeds.joints]\n'wrist.R' = {{ L = [{'9' * 400}, 1.0] }}\n",
    "400 digits of a limit": HEAD + VIEWS + f"[body.limits]\n'knee.R flexion' = [0, {'9' * 400}]\n",
    "10,000 hexadecimal digits": HEAD + VIEWS + f"[settings.matching]\npatch_px = 0x{'f' * 10_000}\n",
    "a frame": HEAD + f"frames = [0, 0x{'f' * 10_000}]\n" + VIEWS,
    "tables of 3,000 levels": HEAD + VIEWS + "[settings]\na = " + "{a=" * 3000 + "1" + "}" * 3000 + "\n",
    "lists of 200 levels": HEAD + VIEWS + "[settings.matching]\npatch_px = " + "[" * 200 + "]" * 200 + "\n",
    "keys of 3,000 levels": HEAD + VIEWS + "[settings]\n" + ".".join("a" * 3000) + " = 1\n",
}


@pytest.mark.parametrize("case", SLOW)
def test_what_took_a_quarter_of_a_minute_takes_a_moment(tmp_path: Path, case: str) -> None:
    name, text = SLOW[case]
    (tmp_path / name).write_text(text)
    began = time.process_time()
    with pytest.raises(InputError):
        read_take(tmp_path) if name == "take.toml" else read_any(tmp_path / name)
    assert time.process_time() - began < SECONDS


@pytest.mark.parametrize("case", TOO_MUCH)
def test_numbers_and_tables_without_end_are_one_sentence(tmp_path: Path, case: str) -> None:
    for name in ("take.toml", "rig.toml"):
        (tmp_path / name).write_text(TOO_MUCH[case])
    for read in (lambda: read_take(tmp_path), lambda: read_table(tmp_path), lambda: read_rig(tmp_path / "rig.toml")):
        with pytest.raises(InputError) as refused:
            read()
        assert len(str(refused.value)) < 500


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_pattern_through_links_in_circles_is_matched_in_a_moment(tmp_path: Path) -> None:
    """Two links to their own folder give it 2²⁵ names of 25 parts."""
    (tmp_path / "L").mkdir()
    (tmp_path / "L" / "0.png").write_bytes(b"")
    for name in ("a", "b"):
        (tmp_path / name).symlink_to(".")
    began = time.process_time()
    for stars in ("*/" * 25, "[ab]/" * 39, "L/../" * 20 + "*/L/../*/"):
        assert [path.name for path in bounded.matching(tmp_path, stars + "L/*.png")] == ["0.png"]
    assert bounded.matching(tmp_path, "*/" * 100 + "L/*.png") == []  # more links than a path may have
    assert time.process_time() - began < SECONDS


@pytest.mark.parametrize("wildcard", ["*a", "[a-b]*", "?*"])
def test_a_pattern_of_many_wildcards_is_matched_in_a_moment(tmp_path: Path, wildcard: str) -> None:
    (tmp_path / ("a" * 240 + ".png")).write_bytes(b"")
    began = time.process_time()
    for folder in ("", f"{wildcard * 40}c/"):
        assert bounded.matching(tmp_path, f"{folder}{wildcard * 60}c.png") == []
    assert time.process_time() - began < SECONDS


def test_patterns_are_matched_as_people_write_them(tmp_path: Path) -> None:
    for name in ("L/a/0.png", "L/b/1.png", "R/2.png", "3.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    expected = {"*.png": ["3.png"], "L/*/*.png": ["L/a/0.png", "L/b/1.png"], "[LR]/2.png": ["R/2.png"], "L/a/0.png": ["L/a/0.png"],
                "./R/*": ["R/2.png"], "**/*.png": ["3.png", "L/a/0.png", "L/b/1.png", "R/2.png"], "L/**/?.png": ["L/a/0.png", "L/b/1.png"],
                "": [], "a**b": [], "[" * 50_000: [], "*a" * 400: [], "no/*": []}  # fmt: skip
    for pattern, names in expected.items():
        found = [path.relative_to(tmp_path).as_posix() for path in bounded.matching(tmp_path, pattern)]
        assert sorted(found) == names, pattern[:50]


@pytest.mark.parametrize(
    "name, mark",
    [("run.json", '{\n "format": "tricap-run",\n'), (".tricap-lock", '{"pid": 1, "host": "a"}\n'), (".tricap-files", '[\n "1.png"\n]\n')],
)
def test_a_wildcard_does_not_enter_a_folder_of_results(tmp_path: Path, name: str, mark: str) -> None:
    """Pictures of a run in the take became footage, or masks, of the next run."""
    for path in ("films/L/0.png", "results/fields/L/1.png", "results/report/2_L.png", "theirs/L/3.png"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(b"")
    (tmp_path / "results" / name).write_text(mark)
    (tmp_path / "theirs" / name).write_text('{"format": "another"}')
    expected = {"**/L/*.png": ["films/L/0.png", "theirs/L/3.png"], "**/*_L.png": [], "*/*/L/*.png": [],
                "res*/fields/L/*.png": [], "results/fields/*/*.png": ["results/fields/L/1.png"]}  # fmt: skip
    for pattern, names in expected.items():
        assert sorted(path.relative_to(tmp_path).as_posix() for path in bounded.matching(tmp_path, pattern)) == names, pattern


def test_dotted_keys_and_values_that_people_write_are_read() -> None:
    text = 'a.b."c.d".e = "1.2.3.4"\nf = [1.5, 2.5, [3.5]]\n[settings.matching]\npatch_px = 9223372036854775807\n'
    assert bounded.toml_of(text)["a"]["b"]["c.d"]["e"] == "1.2.3.4"
    with pytest.raises(ValueError, match="more than 32 parts .at line 3"):
        bounded.toml_of("a = 1\nb = 2\n" + ".".join("c" * 40) + " = 3")


def test_json_and_xml_are_bounded() -> None:
    assert bounded.json_of('{"a": [1, 2.5, "x"]}') == {"a": [1, 2.5, "x"]}
    for text in ("[" * 100 + "]" * 100, "[" * 100_000, "1" * 400, '{"a": [' + "9" * 30 + "]}"):
        with pytest.raises(ValueError, match="more than 64|beyond"):
            bounded.json_of(text)
    assert bounded.xml_of("<a><b>1</b></a>").findtext("b") == "1"
    for text in ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "<a>", "\ud800"):
        with pytest.raises(ValueError):
            bounded.xml_of(text)


def test_a_file_larger_than_its_kind_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(20_000_000_000)
    with pytest.raises(OSError, match="larger than 4 MB"):
        bounded.bytes_of(path, bounded.TOML_BYTES)
    bounded.check_file(path, bounded.MOVIE_BYTES)
    with pytest.raises(InputError, match=r"take\.toml.*larger than 4 MB"):
        path.rename(tmp_path / "take.toml")
        read_take(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such files")
def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/dev/zero")
    for name in ("pipe", "endless"):
        with pytest.raises(OSError, match="a device, a pipe or a socket"):
            bounded.bytes_of(tmp_path / name, 100)
    if Path("/proc/self/status").exists():
        with pytest.raises(OSError, match="it grows while it is read"):
            bounded.bytes_of(Path("/proc/self/status"), 1 << 20)
    with pytest.raises(IsADirectoryError):
        bounded.bytes_of(tmp_path, 100)


def test_images_are_read_within_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", np.full((9, 9), 7, np.uint8))[1].tobytes())
    assert read_image(tmp_path / "a.png").mean() == 7
    monkeypatch.setattr(bounded, "IMAGE_BYTES", 10)
    with pytest.raises(InputError, match="larger than 0 MB"):
        read_image(tmp_path / "a.png")


def test_texts_lose_their_mark_and_the_ends_of_lines_of_windows(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes("\ufeffé\r\nb\rc\n".encode())
    assert bounded.text_of(tmp_path / "a", 100) == "é\nb\nc\n"
    (tmp_path / "a").write_bytes(b"\xff")
    with pytest.raises(UnicodeDecodeError):
        bounded.text_of(tmp_path / "a", 100)
    assert bounded.text_of(tmp_path / "a", 100, errors="replace") == "\N{REPLACEMENT CHARACTER}"


def test_a_long_line_of_controls_is_read_in_a_moment(tmp_path: Path) -> None:
    follows = {f"a{i}": f"a{i + 1}" for i in range(20_000)}
    path = tmp_path / "map.json"
    path.write_text(json.dumps({"bones": {"hips": "a0"}, "steering": {"follows": follows}}))
    began = time.process_time()
    assert read_preset(path).control_rig is not None
    path.write_text(json.dumps({"bones": {"hips": "a0"}, "steering": {"follows": {**follows, "a20000": "a5"}}}))
    with pytest.raises(InputError, match="follow itself"):
        read_preset(path)
    assert time.process_time() - began < SECONDS  # minutes, when every name was looked for in its whole line


@pytest.mark.skipif(sys.platform != "linux", reason="names are Unicode there")
def test_a_name_that_is_no_unicode_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"k\xff")
    folder.mkdir()
    (folder / "take.toml").write_text(HEAD + VIEWS)
    for read in (read_take, Results):
        with pytest.raises(InputError, match=r"k.udcff is not UTF-8; rename it"):
            read(folder)
    (folder / "below").mkdir()
    with pytest.raises(InputError, match="a folder above it"):
        read_take(folder / "below")


@pytest.mark.parametrize(("joints", "refused"), [(200, False), (3000, True)])
def test_a_chain_of_thousands_of_joints_is_no_skeleton(tmp_path: Path, joints: int, refused: bool) -> None:
    joint = "\n{\nOFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    chain = (
        "ROOT a" + joint + "".join(f"JOINT j{i}{joint}" for i in range(joints)) + "End Site\n{\nOFFSET 0 1 0\n}\n" + "}\n" * (joints + 1)
    )
    values = " ".join(["0"] * 3 * (joints + 1))
    (tmp_path / "a.bvh").write_text(f"HIERARCHY\n{chain}MOTION\nFrames: 1\nFrame Time: 0.04\n{values}\n")
    if refused:
        with pytest.raises(InputError, match="a chain of more than 256 joints"):
            read_bvh(tmp_path / "a.bvh")
    else:
        assert len(read_bvh(tmp_path / "a.bvh").rig.names) == joints + 1
