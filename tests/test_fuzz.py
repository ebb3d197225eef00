"""Damaged files: whatever stands in a file of at most a megabyte, a reader gives its content or one sentence, within 2 s and 500 MB.

`python tests/mutations.py FOLDER 10000` does the same at length. All readers share a child process: a decoder that crashes kills only it.
"""

import json
import os
import re
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation import store
from tricap.core.foundation.errors import LONGEST, InputError
from tricap.core.images.headers import claimed_size
from tricap.core.images.picture import read_image
from tricap.core.motion.formats.keypoints_json import natural_order, read_keypoints
from tricap.core.motion.tables import read_joints
from tricap.core.results.folder import PARENTS, WRITTEN, Results
from tricap.core.run.batch import out_folders
from tricap.core.tracking.point_tables import read_planar, read_points

HERE = Path(__file__).resolve().parent
COUNT = 40


def fuzz(folder: Path, count: int, *names: str) -> tuple[list[dict], str]:
    """What the child process says of each reader, and the reader at which it died, if it did."""
    environment = {**os.environ, "OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_LOG_LEVEL": "SILENT", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, str(HERE / "mutations.py"), str(folder), str(count), *names]
    done = subprocess.run(command, capture_output=True, env=environment, timeout=600)
    began = [line[1:] for line in done.stderr.decode(errors="replace").splitlines() if line.startswith("@")]
    return [json.loads(line) for line in done.stdout.splitlines()], began[-1] if done.returncode and began else ""


@pytest.mark.slow
def test_only_input_errors_come_out_of_damaged_files(tmp_path: Path) -> None:
    said, died = fuzz(tmp_path, COUNT)
    assert not died, f"the process died in “{died}”"
    faults = [(row["reader"], fault) for row in said for fault in row["faults"]]
    assert not faults, "\n".join(f"{name}, number {f['number']}: {f['fault']}" for name, f in faults)
    assert len(said) > 35 and all(
        row["read"] + row["refused"] == COUNT and row["special"] and (row["names"] or sys.platform != "linux") for row in said
    )
    assert sum(row["refused"] for row in said) > 0.4 * COUNT * len(said)  # the damage is real


@pytest.mark.slow
def test_a_faulty_reader_is_found(tmp_path: Path) -> None:
    """The engine itself: readers that raise something else, that are slow, that take memory, and that crash."""
    said, died = fuzz(tmp_path, 2, "test raises", "test sleeps", "test swells", "test dies")
    assert [bool(row["faults"]) for row in said] == [True, True, True] and died == "test dies"


def bomb_png(w: int, h: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = w.to_bytes(4, "big") + h.to_bytes(4, "big") + b"\x08\x00\x00\x00\x00"
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")


@pytest.mark.slow
def test_bombs_are_refused_before_they_unpack(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(bomb_png(30_000, 30_000))
    (tmp_path / "a.pgm").write_bytes(b"P5 30000 30000 255\n" + b"\0" * 100)
    for name in ("a.png", "a.pgm"):
        with pytest.raises(InputError, match="30000×30000 pixels, more than can be measured"):
            read_image(tmp_path / name)
    scan, picture = b"\xff\xda\x00\x08\x01\x01\x00\x01\x3f\x00", cv2.imencode(".jpg", np.zeros((9, 9), np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(picture[:-2] + 1000 * scan + picture[-2:])  # of a progressive one each passes over the whole image
    with pytest.raises(InputError, match="is not a readable image"):
        read_image(tmp_path / "a.jpg")
    store.save(tmp_path / "a.npz", {"zeros": np.zeros(500_000_000, np.int8)}, {})
    assert (tmp_path / "a.npz").stat().st_size < 1_000_000
    with pytest.raises(InputError, match="would unpack to 0.5 GB"):
        store.load(tmp_path / "a.npz")


def test_a_row_for_every_frame_and_name_of_its_own_makes_no_square_table(tmp_path: Path) -> None:
    """As many columns as rows: a megabyte of them asked for gigabytes."""
    rows = "".join(f"{i},{i},p{i},1,2,3,0.1\n" for i in range(3_000))
    (tmp_path / "joints.csv").write_text("frame,time_s,joint,x,y,z,sigma\n" + rows)
    (tmp_path / "planar.csv").write_text("frame,time,point,x,y,z,sigma\n" + rows)
    names = [f"n{i}" for i in range(3_000)]
    people = [{"image_id": i, "keypoints": []} for i in range(3_000)]
    table = {"categories": [{"keypoints": names}], "annotations": [*people, {"image_id": 0, "keypoints": [1, 2, 1]}]}
    (tmp_path / "coco.json").write_text(json.dumps(table))
    for read in (lambda: read_joints(tmp_path / "joints.csv"), lambda: read_planar(tmp_path / "planar.csv"),
                 lambda: read_keypoints([tmp_path / "coco.json"])):  # fmt: skip
        with pytest.raises(InputError, match="nearly all is missing"):
            read()


def test_many_points_that_are_joined_are_read_in_a_moment(tmp_path: Path) -> None:
    rows = "".join(f"p{i},1,2,p{i - 1}\n" for i in range(10_000))
    (tmp_path / "a.csv").write_text("point,x,y,joined_to\n" + rows.replace("p-1", ""))
    began = time.process_time()
    assert len(read_points(tmp_path / "a.csv").joined) == 9_999
    (tmp_path / "a.csv").write_text("point,x,y,joined_to\n" + rows)
    with pytest.raises(InputError, match="which is no point"):
        read_points(tmp_path / "a.csv")
    assert time.process_time() - began < 2.0  # seconds a file, when every name was looked for among all


def test_names_of_images_are_numbers_or_words(tmp_path: Path) -> None:
    path, points = tmp_path / "a.json", [1.0, 2.0, 1.0] * 17
    for name in ([1], {"a": 1}):
        path.write_text(json.dumps([{"image_id": name, "keypoints": points}]))
        with pytest.raises(InputError, match="has an image named"):
            read_keypoints([path])
    for name in ("9" * 5000, "b\u00b2", None, 1.5, True):
        path.write_text(json.dumps([{"image_id": name, "keypoints": points}]))
        assert len(read_keypoints([path]).names) == 17
    assert sorted(["a10", "a\u00b2", "a9", "a" + "1" * 5000], key=natural_order) == ["a9", "a10", "a" + "1" * 5000, "a\u00b2"]


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif", ".bmp", ".webp", "portable"])
@pytest.mark.parametrize("shape", [(24, 41), (33, 20, 3)])
def test_the_claimed_size_is_the_size(ending: str, shape: tuple[int, ...]) -> None:
    ending = {2: ".pgm", 3: ".ppm"}[len(shape)] if ending == "portable" else ending
    data = cv2.imencode(ending, np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8))[1].tobytes()
    assert claimed_size(data) == (shape[1], shape[0])
    assert claimed_size(data[:5]) is None and claimed_size(b"GIF89a") is None


def test_sentences_are_fit_for_a_terminal() -> None:
    assert str(InputError("a\x1b[2Jb\nc\0")) == "a\N{REPLACEMENT CHARACTER}[2Jb c\N{REPLACEMENT CHARACTER}"
    assert len(str(InputError("x" * 100_000))) < LONGEST + 10


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_results_are_not_written_through_links_out_of_their_folder(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "letter.txt").write_text("mine")
    for name in (*WRITTEN, *(f"{parent}/a" for parent in PARENTS)):
        for target in ("letter.txt", "", "not there"):
            out = tmp_path / f"out {name.replace('/', ' ')} {target}"
            (out / name).parent.mkdir(parents=True)
            (out / name).symlink_to(tmp_path / "elsewhere" / target)
            with pytest.raises(InputError, match="is a link to a place outside"):
                Results(out)
    (tmp_path / "batch").mkdir()
    (tmp_path / "batch" / "take").symlink_to(tmp_path / "elsewhere")
    _, refused = out_folders([tmp_path / "takes" / name for name in ("take", "good")], tmp_path / "batch")
    assert list(refused) == [0] and "is a link to a place outside" in refused[0]
    assert (tmp_path / "elsewhere" / "letter.txt").read_text() == "mine" and len(list((tmp_path / "elsewhere").iterdir())) == 1


def test_every_name_that_is_written_to_is_checked_for_links() -> None:
    """Each first name in a call of `Results.path`, and of what lies beside it."""
    sources = [path.read_text(encoding="utf-8") for part in ("core", "addon") for path in (HERE.parent / part).rglob("*.py")]
    named = {name for source in sources for name in re.findall(r'results\.path\("([^"]+)"', source)}
    named |= {name for source in sources for name in re.findall(r'self\.path\("([^"]+)"', source)}
    assert {"clouds", "cache", "run.json", "points3d.csv"} <= named <= {*WRITTEN}, named - {*WRITTEN}
    fields = (HERE.parent / "addon" / "scene" / "clips.py").read_text(encoding="utf-8")
    assert "import FIELDS" in fields
