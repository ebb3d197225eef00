"""Results on disk: round trips, files that appear whole or not at all, and files that are not ours."""

import json
import math
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError

ARRAYS = dict(x=np.random.default_rng(1).standard_normal((20, 3)), empty=np.zeros((0, 2), np.float32), word=np.array("clicks"))


@pytest.mark.parametrize("compress", [True, False])
def test_round_trip(tmp_path: Path, compress: bool) -> None:
    path = tmp_path / "deep" / "Ärm é.npz"
    store.save(path, ARRAYS, {"key": "k", "names": ["a"]}, compress=compress)
    arrays, header = store.load(path)
    assert header.pop(store.CONTENT)
    assert header == {"key": "k", "names": ["a"], "store_version": 1}
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and np.array_equal(arrays[name], array)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.skipif(os.name == "nt", reason="hard links need a right on Windows")
def test_other_names_of_a_file_keep_its_content(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("mine")
    os.link(tmp_path / "letter.txt", tmp_path / "run.json")
    store.write_text(tmp_path / "run.json", "{}")
    assert (tmp_path / "run.json").read_text() == "{}" and (tmp_path / "letter.txt").read_text() == "mine"


@pytest.mark.parametrize("compress", [True, False])
def test_a_file_with_a_wrong_byte_is_refused_or_gives_the_same_arrays(tmp_path: Path, compress: bool) -> None:
    path = tmp_path / "a.npz"
    store.save(path, ARRAYS, {"key": "k"}, compress=compress)
    whole, refused = path.read_bytes(), 0
    for i in range(0, len(whole), 5):
        for byte in (whole[i] ^ 0xFF, whole[i] ^ 1):
            path.write_bytes(whole[:i] + bytes([byte]) + whole[i + 1 :])
            try:
                arrays, header = store.load(path)
            except InputError:
                refused += 1
                continue
            assert header["key"] == "k" and all(np.array_equal(arrays[n], a) for n, a in ARRAYS.items()), i
    assert refused > len(whole) / 5  # zip's dates and the like may change unseen
    for length in range(0, len(whole), 11):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            store.load(path)


def _npy(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _pickled(path: Path) -> None:
    np.savez(path, header_json=np.array(json.dumps({"store_version": 1})), x=np.array([{"a": 1}], dtype=object))


def _newer(path: Path) -> None:
    np.savez(path, header_json=np.array(json.dumps({"store_version": 2})))


FOREIGN: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "text": lambda path: path.write_text("no npz"),
    "empty": lambda path: path.write_bytes(b""),
    "npy": _npy,
    "pickle": lambda path: path.write_bytes(pickle.dumps([1])),
    "pickled objects": _pickled,
    "without header": lambda path: np.savez(path, x=np.zeros(2)),
    "header is a list": lambda path: np.savez(path, header_json=np.array("[1]")),
    "header is no JSON": lambda path: np.savez(path, header_json=np.array("{")),
    "deep JSON": lambda path: np.savez(path, header_json=np.array("[" * 100_000)),
    "newer version": _newer,
    "folder": lambda path: path.mkdir(),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_files_that_are_not_ours(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.npz"
    FOREIGN[kind](path)
    with pytest.raises(InputError) as error:
        store.load(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    store.write_json(path, {"old": 1})

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(store.os, name, full)
            with pytest.raises(InputError, match="No space left on device. Choose another folder"):
                store.write_json(path, {"new": 1})
    assert store.read_json(path) == {"old": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="Cannot write"):
        store.write_text(tmp_path / "file" / "a.txt", "x")


def test_json_has_no_nan(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    store.write_json(path, {"sigma0": math.nan, "list": [1.0, math.inf, (2, -math.inf)], "name": "é", "yes": True, "none": None})
    assert store.read_json(path) == {"sigma0": None, "list": [1.0, None, [2, None]], "name": "é", "yes": True, "none": None}


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\udcff"])
def test_json_that_is_none(tmp_path: Path, text: str) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match="not a JSON file"):
        store.read_json(path)
    with pytest.raises(InputError, match="Cannot read"):
        store.read_json(tmp_path / "missing.json")


def test_digests_tell_parts_apart(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"ab")
    assert store.digest("ab", "c") != store.digest("a", "bc") != store.digest("abc")
    assert store.digest(tmp_path / "f") == store.digest(b"ab") == store.digest("ab")


def test_the_layout_of_what_is_read(tmp_path: Path) -> None:
    layout = {"frames": ("iu", "T"), "xyz_m": ("f", "TN3")}
    sound = {"frames": np.arange(4), "xyz_m": np.zeros((4, 5, 3), np.float32)}
    store.check_layout(tmp_path / "a.npz", sound, **layout)
    wrong_ones = (np.zeros((4, 5, 2)), np.zeros((3, 5, 3)), np.zeros(4), np.zeros((4, 1), int))
    for name, wrong in zip(("xyz_m", "xyz_m", "frames", "frames"), wrong_ones):
        with pytest.raises(InputError, match="a.npz is damaged: .* has the shape"):
            store.check_layout(tmp_path / "a.npz", sound | {name: wrong}, **layout)
    with pytest.raises(InputError, match="a.npz has no frames"):
        store.check_layout(tmp_path / "a.npz", {"xyz_m": sound["xyz_m"]}, **layout)


def test_a_file_written_piece_by_piece_appears_when_it_is_whole(tmp_path: Path) -> None:
    with store.written(tmp_path / "a" / "x.csv") as file:
        file.write(b"1\n")
        assert not (tmp_path / "a" / "x.csv").exists()
        file.write(b"2\n")
    assert (tmp_path / "a" / "x.csv").read_bytes() == b"1\n2\n"
    with pytest.raises(InputError, match="no outline"), store.written(tmp_path / "a" / "x.csv") as file:
        file.write(b"3\n")
        raise InputError("There is no outline.")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["x.csv"] and (tmp_path / "a" / "x.csv").read_bytes() == b"1\n2\n"


def test_the_digest_of_a_file_is_that_of_its_bytes(tmp_path: Path) -> None:
    data = bytes(range(256)) * 9000  # more than one piece
    (tmp_path / "x").write_bytes(data)
    assert store.digest(tmp_path / "x", "y") == store.digest(data, "y") != store.digest(data + b"y")


def test_another_program_writes_under_a_name_that_nobody_knows_before(tmp_path: Path) -> None:
    part = store.part_of(tmp_path / "a" / "x.blend")
    assert part != store.part_of(tmp_path / "a" / "x.blend") and part.match(".x.*.part.blend")
    store.try_writing(part)
    assert list((tmp_path / "a").iterdir()) == []
    part.write_text("") if os.name == "nt" else part.symlink_to(tmp_path / "not there")
    with pytest.raises(FileExistsError):
        store.try_writing(part)
    assert not (tmp_path / "not there").exists(), "nothing is made at the end of a link"


def test_a_file_that_is_too_large_is_not_read_for_its_digest(tmp_path: Path) -> None:
    """A mask that is a sparse file of 20 GB takes no room on the disk, and took minutes."""
    with (tmp_path / "mask.png").open("wb") as file:
        file.truncate(600_000_000)
    with pytest.raises(InputError, match="mask.png: it is larger than 512 MB"):
        store.digest("key", tmp_path / "mask.png")
    (tmp_path / "a.toml").write_bytes(b"# sound")
    with pytest.raises(InputError, match="a.toml: it is larger than 0 MB"):
        store.digest(tmp_path / "a.toml", largest=6)
    assert store.digest(tmp_path / "a.toml", largest=7) == store.digest(b"# sound")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_results_have_the_rights_that_the_user_asked_for(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        for umask, mode in ((0o077, 0o600), (0o002, 0o664), (0o022, 0o644)):
            os.umask(umask)
            store.write_text(tmp_path / "a", "a")
            assert (tmp_path / "a").stat().st_mode & 0o777 == mode
    finally:
        os.umask(before)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_bytes_that_are_no_text_are_read_back_from_json(tmp_path: Path) -> None:
    """Such as those in the name of a folder."""
    value = {"take": b"k\xff\xc3\xa9".decode("utf-8", "surrogateescape")}
    store.write_json(tmp_path / "a.json", value)
    assert store.read_json(tmp_path / "a.json") == value


FULL = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
try:
    store.save(Path(sys.argv[1]), {"a": np.random.default_rng(0).random(10_000)}, {})
except InputError:
    print("full")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of files are those of POSIX")
def test_a_full_disk_is_an_error_and_no_more(tmp_path: Path) -> None:
    """zipfile would end the archive later, in a file that is closed by then, with a traceback of its own."""
    done = subprocess.run([sys.executable, "-P", "-c", FULL, tmp_path / "a.npz"], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "full\n", "") and not list(tmp_path.iterdir())
