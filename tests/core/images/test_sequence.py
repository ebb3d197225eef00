"""Reading footage: every kind of image, movies, natural order, gaps, and files that are not what they say."""

import re
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.images import picture, sequence
from tricap.core.images.headers import has_several_images
from tricap.core.images.picture import decoded, grey, read_image
from tricap.core.images.sequence import ImageFiles, Movie, open_sequence

RAMP = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) * 21


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return path


def numbered(folder: Path, *numbers: object, pattern: str = "{}.png") -> Path:
    for i, n in enumerate(numbers):
        write(folder / pattern.format(n), np.full((8, 8), i, np.uint8))
    return folder


@pytest.mark.parametrize("ending", [".png", ".tif", ".bmp", ".pgm"])
def test_8_bits(tmp_path: Path, ending: str) -> None:
    image = (RAMP // 257).astype(np.uint8)
    got = read_image(write(tmp_path / f"a{ending}", image))
    assert got.dtype == np.float32 and np.array_equal(got, image)


@pytest.mark.parametrize("ending", [".png", ".tif", ".pgm"])
def test_16_bits_span_the_same_range(tmp_path: Path, ending: str) -> None:
    got = read_image(write(tmp_path / f"a{ending}", RAMP))
    assert got.dtype == np.float32 and np.abs(got - RAMP / 257).max() < 1e-4
    assert read_image(write(tmp_path / "white.png", np.full((8, 8), 65535, np.uint16))).max() == 255


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [3, 4])
def test_colour_becomes_luma(tmp_path: Path, dtype: type, channels: int) -> None:
    top = np.iinfo(dtype).max
    image = np.zeros((8, 9, channels), dtype)
    image[:, :3, 0], image[:, 3:6, 1], image[:, 6:, 2] = top, top, top  # blue, green, red
    got = read_image(write(tmp_path / "a.png", image))
    assert got.shape == (8, 9)
    assert np.allclose(got[0, [0, 3, 6]], [0.114 * 255, 0.587 * 255, 0.299 * 255], atol=0.6)  # Rec. 601; 8 bits are rounded


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 3), (np.uint16, 4)])
def test_colours_stay_colours(tmp_path: Path, dtype: type, channels: int) -> None:
    top = np.iinfo(dtype).max
    image = np.zeros((8, 9, channels), dtype)
    image[:, :3, 0], image[:, 3:6, 1], image[:, 6:, 2] = top, top, top  # blue, green, red
    got = ImageFiles((write(tmp_path / "a.png", image),), "*.png").read_colour(0)
    assert got.dtype == np.float32 and got[0, [0, 3, 6]].tolist() == [[0, 0, 255], [0, 255, 0], [255, 0, 0]]
    plain = ImageFiles((write(tmp_path / "b.png", image[:, :, 0]),), "*.png").read_colour(0)
    assert plain.shape == (8, 9, 3) and (plain[:, :, 0] == plain[:, :, 2]).all()


def test_floats_of_one_are_white() -> None:
    for dtype in (np.float32, np.float64):
        for shape in ((4, 5), (4, 5, 3)):
            assert np.allclose(grey(np.full(shape, 0.5, dtype)), 127.5, atol=0.01)
    assert grey(np.full((4, 5), np.nan, np.float32)).max() == 0


def test_paths_with_spaces_and_accents(tmp_path: Path) -> None:
    folder = numbered(tmp_path / "Prise numéro 1 äöß 日本" / "vue gauche", *range(3))
    footage = open_sequence(folder.parent, images="vue gauche/*.png", movie=None, view="L")
    assert footage.count == 3 and [int(footage.read(i)[0, 0]) for i in range(3)] == [0, 1, 2]
    movie = write_movie(folder.parent / "vue é.avi", 3)
    assert open_sequence(folder.parent, images=None, movie=movie.name, view="L").count == 3


def test_natural_order(tmp_path: Path) -> None:
    numbered(tmp_path / "L", 8, 9, 10, 11, pattern="take2_{}_c.png")
    (tmp_path / "L" / "notes.txt").write_text("")
    footage = open_sequence(tmp_path, images="L/*", movie=None, view="L")
    assert [p.name for p in footage.files()] == [f"take2_{n}_c.png" for n in (8, 9, 10, 11)]
    names = ["a²1.png", "1²2.png", "B2.png", "b10.png"]
    for name in names:
        write(tmp_path / "odd" / name, np.zeros((8, 8), np.uint8))
    assert [p.name for p in open_sequence(tmp_path, images="odd/*", movie=None, view="L").files()][-2:] == ["B2.png", "b10.png"]


@pytest.mark.parametrize(
    ("name", "double"),
    [("{}.png", "01.png"), ("{}.png", "1 (1).png"), ("{}.png", "1 - Copy.png"), ("{}.png", "1.jpg"), ("c2_{}_L.png", "C2_001_L.png"),
     ("c2_{}_L.png", "c2_1_L (2).png"), ("{}.png", "1_L.png")],
)  # fmt: skip
def test_two_images_of_one_number(tmp_path: Path, name: str, double: str) -> None:
    """The view was late from the second one on, without a word."""
    numbered(tmp_path / "L", 0, 1, 2, 3, pattern=name)
    assert open_sequence(tmp_path, images="L/*", movie=None, view="L").count == 4
    numbered(tmp_path / "M", 0, 1, 2, 3, pattern=name)
    write(tmp_path / "M" / double, np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match=f"View M has two images of number [12]: .*{re.escape(double)}.*; remove one") as error:
        open_sequence(tmp_path, images="M/*", movie=None, view="M")
    assert name.format(1) in str(error.value)


def test_parts_of_a_recording_that_begin_again_have_no_doubles(tmp_path: Path) -> None:
    for name in ("p1/0.png", "p1/1.png", "p2/0.png", "p2/1.png", "q/A1.png", "q/B1.png", "q/B2.png"):
        write(tmp_path / name, np.zeros((8, 8), np.uint8))
    assert open_sequence(tmp_path, images="p*/*.png", movie=None, view="L").count == 4
    assert open_sequence(tmp_path, images="q/*.png", movie=None, view="L").count == 3


@pytest.mark.parametrize(
    ("numbers", "between"),
    [
        ((0, 1, 3), "1.png and 3.png"),
        ((0, 2, 3), "0.png and 2.png"),
        ((0, 1, 2, 3, 4, 7, 8), "4.png and 7.png"),
        ((0, 1, 3, 4, 6, 7), "1.png and 3.png"),  # two gaps in a short sequence
        ((10, 20, 40, 50), "20.png and 40.png"),
        (tuple(n for n in range(60) if n not in (7, 8, 20, 33, 50)), "6.png and 9.png"),
    ],
)
def test_a_missing_image_in_a_numbered_sequence(tmp_path: Path, numbers: tuple[int, ...], between: str) -> None:
    for pattern in ("{}.png", "frame_{}_cam2.png"):
        folder = numbered(tmp_path / pattern[:5], *numbers, pattern=pattern)
        with pytest.raises(InputError, match="View L lacks the image") as error:
            open_sequence(tmp_path, images=f"{folder.name}/*.png", movie=None, view="L")
        first, last = between.split(" and ")
        assert pattern.format(first[:-4]) in str(error.value) and pattern.format(last[:-4]) in str(error.value)


@pytest.mark.parametrize("numbers", [(5,), (3, 9), (1000, 1040, 1079, 1121, 1160), ("a", "b", "c", "d"), (2, 4, 6, 8), ("a1", "b1", "c1")])
def test_sequences_without_a_gap(tmp_path: Path, numbers: tuple[object, ...]) -> None:
    numbered(tmp_path / "L", *numbers)
    assert open_sequence(tmp_path, images="L/*.png", movie=None, view="L").count == len(numbers)


@pytest.mark.parametrize("pattern", ["", ".", "***", "a**/x.png", "L/*.jpg", "L/[.png", "\0", "~/*.png", "R/*.png", "*/"])
def test_patterns_that_find_nothing(tmp_path: Path, pattern: str) -> None:
    numbered(tmp_path / "L", 0, 1)
    try:
        found = open_sequence(tmp_path, images=pattern, movie=None, view="L")
    except InputError as error:
        assert "View L has no images" in str(error)
    else:
        assert pattern in ("***", "a**/x.png") and found.count  # patterns of newer Pythons


@pytest.mark.parametrize("path", ["../L/*.png", "/etc/*.png", "L/../../x.png"])
def test_paths_outside_the_take(tmp_path: Path, path: str) -> None:
    for how in (dict(images=path, movie=None), dict(images=None, movie=path)):
        with pytest.raises(InputError, match="lies outside the take"):
            open_sequence(tmp_path, view="L", **how)  # type: ignore[arg-type]


def test_files_that_are_no_images(tmp_path: Path) -> None:
    whole = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8))[1].tobytes()
    jpeg = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8))[1].tobytes()
    contents = dict(text=b"not an image\n", empty=b"", cut=whole[: len(whole) // 2], zeros=b"\0" * 1000, cut_jpeg=jpeg[: len(jpeg) // 2])
    for name, content in contents.items():
        path = tmp_path / f"{name}.png"
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"{name}.png is not a readable image; replace it"):
            read_image(path)
    with pytest.raises(InputError, match="Cannot read the image .*gone.png"):
        ImageFiles((tmp_path / "gone.png",), "*.png").read(0)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match="Cannot read the image"):
        read_image(tmp_path / "folder.png")


def test_images_of_a_kind_or_size_that_cannot_be_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="has int32 pixels"):
        read_image(write(tmp_path / "a.tif", np.zeros((8, 8), np.int32)))
    with pytest.raises(InputError, match="has 8192×8 pixels, more than can be measured"):
        read_image(write(tmp_path / "wide.png", np.zeros((8, 8192), np.uint8)))
    monkeypatch.setattr(picture, "MAX_PIXELS", 63)
    with pytest.raises(InputError, match="has 8×8 pixels"):
        read_image(write(tmp_path / "b.png", np.zeros((8, 8), np.uint8)))


def write_movie(path: Path, frames: int) -> Path:
    """Frames of the grey values 20, 40, …, with one bright square that wanders; JPEG-compressed."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
    assert writer.isOpened()
    for shown in movie_pictures(frames):
        writer.write(np.repeat(shown[:, :, None], 3, axis=2))
    writer.release()
    return path


def movie_pictures(frames: int) -> list[np.ndarray]:
    pictures = []
    for i in range(frames):
        picture = np.full((48, 64), 20 + 20 * i, np.uint8)
        picture[8:16, 8 * (i % 8) : 8 * (i % 8) + 8] = 240
        pictures.append(picture)
    return pictures


def test_a_movie_whose_header_has_too_few_images_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a recorder that crashed; of sixteen images thirteen were left out in silence."""
    path = write_movie(tmp_path / "m.avi", 12)
    whole = bytearray(path.read_bytes())
    for chunk, at in ((b"avih", 8 + 16), (b"strh", 8 + 32)):  # dwTotalFrames and dwLength
        place = whole.index(chunk) + at
        assert int.from_bytes(whole[place : place + 4], "little") == 12
        whole[place : place + 4] = (3).to_bytes(4, "little")
    path.write_bytes(whole)
    said = "has 3 images, but more follow.*ffmpeg -i m.avi -c copy new.mkv"
    with pytest.raises(InputError, match=said):
        Movie(path)
    monkeypatch.setattr(sequence, "SOON", 0)  # as of a long film, which would take long to read
    movie = Movie(path)
    assert movie.count == 3 and movie.read(1).shape == (48, 64)
    with pytest.raises(InputError, match=said):
        movie.read(2)
    assert len(Movie(write_movie(tmp_path / "whole.avi", 12)).read(11)) == 48


def test_a_movie_gives_the_frames_that_were_written_in_any_order(tmp_path: Path) -> None:
    path, pictures = write_movie(tmp_path / "m.avi", 7), movie_pictures(7)
    movie = open_sequence(tmp_path, images=None, movie="m.avi", view="L")
    assert movie.count == 7 and movie.files() == (path,)
    for i in (0, 1, 2, 6, 3, 3, 0, 5):
        assert np.abs(movie.read(i) - pictures[i]).mean() < 2.0, i  # neighbours differ by 20
    assert np.abs(movie.read_colour(3).mean(axis=2) - pictures[3]).mean() < 2.0
    files = ImageFiles(tuple(write(tmp_path / f"{i}.png", p) for i, p in enumerate(pictures)), "*.png")
    assert max(float(np.abs(movie.read(i) - files.read(i)).mean()) for i in range(7)) < 2.0


def test_a_movie_that_ends_early(tmp_path: Path) -> None:
    movie = Movie(write_movie(tmp_path / "m.avi", 4))
    with pytest.raises(InputError, match="Frame 4 of .*m.avi cannot be decoded, although its header has 4 frames"):
        movie.read(4)
    assert movie.read(1)[0, 0] == pytest.approx(40, abs=2)


def test_movies_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no movie")
    with pytest.raises(InputError, match="text.mp4 is not a movie that can be decoded"):
        open_sequence(tmp_path, images=None, movie="text.mp4", view="L")
    for name in ("missing.mp4", "", "\0"):
        with pytest.raises(InputError, match="of view L is missing"):
            open_sequence(tmp_path, images=None, movie=name, view="L")


def test_a_movie_with_a_name_that_is_no_text(tmp_path: Path) -> None:
    """OpenCV crashes on such a name."""
    for path in (tmp_path / "k\udcff" / "c.avi", tmp_path / "k\udcff.mp4"):
        with pytest.raises(InputError, match="is not UTF-8; rename it"):
            Movie(path)


def test_a_playlist_is_no_movie(tmp_path: Path) -> None:
    """A decoder would follow it out of the take, even into the network; whatever its name, it is not given to the decoder."""
    write_movie(tmp_path / "elsewhere.avi", 4)
    playlist = f"#EXTM3U\n#EXTINF:1,\n{tmp_path / 'elsewhere.avi'}\n"
    for name, text in (("m.m3u8", playlist), ("m.txt", "ffconcat version 1.0\nfile elsewhere.avi\n")):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=f"{name} is of an unsupported kind .*; convert it"):
            open_sequence(tmp_path, images=None, movie=name, view="L")
        for ending in sequence.MOVIE_ENDINGS:
            path = (tmp_path / name).rename(tmp_path / f"m{ending}")
            with pytest.raises(InputError, match="is not a movie that can be decoded"):
                open_sequence(tmp_path, images=None, movie=path.name, view="L")
            path.rename(tmp_path / name)


def test_open_exr_is_told_by_name(tmp_path: Path) -> None:
    (tmp_path / "0.exr").write_bytes(picture.OPEN_EXR + b"\2\0\0\0" + b"\0" * 100)
    for read in (lambda: open_sequence(tmp_path, images="*.exr", movie=None, view="L"), lambda: read_image(tmp_path / "0.exr")):
        with pytest.raises(InputError, match="is an OpenEXR image, which is not supported; save the sequence as PNG"):
            read()


@pytest.mark.parametrize(("bits", "shape"), [(10, (20, 30)), (12, (20, 30, 3)), (16, (20, 30))])
def test_cameras_of_more_bits_fill_the_range(tmp_path: Path, bits: int, shape: tuple[int, ...]) -> None:
    """10 and 12 bits in files of 16: white is what their bits allow, for the whole sequence alike."""
    for i in range(3):
        image = np.full(shape, (2**bits - 1) * (i + 1) // 3, np.uint16)
        write(tmp_path / f"{i}.png", image)
    found = [open_sequence(tmp_path, images="*.png", movie=None, view="C").read(i).mean() for i in range(3)]
    assert np.allclose(found, [85, 170, 255], atol=0.3)


def test_a_movie_of_more_bits(tmp_path: Path) -> None:
    """A frame of 16 bits fills the range of greys as one of 8 does, in the right order and with no wrap-around."""
    ramp = np.linspace(0, 65535, 48 * 64).reshape(48, 64)
    kind = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(str(tmp_path / "a.mkv"), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 25.0, (64, 48), kind)
    for i in range(3):
        writer.write((ramp * (3 - i) / 3).astype(np.uint16))
    writer.release()
    movie = open_sequence(tmp_path, images=None, movie="a.mkv", view="C")
    for i in range(3):
        assert np.abs(movie.read(i) - ramp * (3 - i) / 3 / 257).max() < 3.0


def turned_movie(path: Path) -> Path:
    """A movie of 64×48, bright at the left, whose header says that it is shown a quarter turn to the right."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (64, 48))
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :20] = 220
    for _ in range(4):
        writer.write(picture)
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 20 + 8 + 8  # version and flags; times, number, length; reserved; layer, group, volume
    matrix = (0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
    data[at : at + 36] = b"".join(v.to_bytes(4, "big", signed=True) for v in matrix)
    path.write_bytes(data)
    return path


def test_a_movie_held_upright_is_read_upright(tmp_path: Path) -> None:
    turned_movie(tmp_path / "phone.mp4")
    image = open_sequence(tmp_path, images=None, movie="phone.mp4", view="C").read(0)
    assert image.shape == (64, 48) and image[:16].mean() > 180 and image[28:].mean() < 40  # the left edge became the upper one


def test_4k_and_portrait(tmp_path: Path) -> None:
    for size in ((3840, 2160), (2160, 3840)):
        write(tmp_path / "a.jpg", np.full(size[::-1], 77, np.uint8))
        assert read_image(tmp_path / "a.jpg").shape == size[::-1]


def with_a_pause(data: bytes) -> bytes:
    """A movie whose first two frames last as long as ever and the others three times: a second row in its table of durations."""
    at = data.index(b"stts")
    count, length = (int.from_bytes(data[at + i : at + i + 4], "big") for i in (12, 16))
    rows = b"".join(v.to_bytes(4, "big") for v in (2, 2, length, count - 2, 3 * length))
    grown = bytearray(data[: at + 8] + rows + data[at + 20 :])
    for box in (b"stts", b"stbl", b"minf", b"mdia", b"trak", b"moov"):
        head = grown.index(box) - 4
        grown[head : head + 4] = (int.from_bytes(grown[head : head + 4], "big") + 8).to_bytes(4, "big")
    if b"elst" in grown:  # how long it is shown
        place = grown.index(b"elst") + 12
        grown[place : place + 4] = (3 * int.from_bytes(grown[place : place + 4], "big")).to_bytes(4, "big")
    return bytes(grown)


def test_a_variable_frame_rate_is_noticed(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "even.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (64, 48))
    for i in range(12):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()
    (tmp_path / "uneven.mp4").write_bytes(with_a_pause((tmp_path / "even.mp4").read_bytes()))
    found = {}
    for name in ("even", "uneven"):
        movie = Movie(tmp_path / f"{name}.mp4")
        for i in range(movie.count):
            assert abs(movie.read(i).mean() - 20 * i) < 4
        found[name] = movie.unevenness
    assert found["even"] < 0.1 and found["uneven"] > 0.6, found


def test_hidden_files_beside_the_images_are_none(tmp_path: Path) -> None:
    numbered(tmp_path / "L", 1, 2, 3)
    (tmp_path / "L" / "._1.png").write_bytes(b"\0\5\26\7")  # what macOS leaves on other file systems
    assert open_sequence(tmp_path, images="L/*.png", movie=None, view="L").count == 3


def test_links_and_placeholders_of_images_that_are_elsewhere(tmp_path: Path) -> None:
    numbered(tmp_path / "L", 1, 2)
    (tmp_path / "L" / "3.png").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n")
    with pytest.raises(InputError, match="git lfs pull"):
        open_sequence(tmp_path, images="L/*.png", movie=None, view="L")
    (tmp_path / "L" / "3.png").unlink()
    (tmp_path / "L" / "3.png").symlink_to(tmp_path / "drive" / "3.png")
    with pytest.raises(InputError, match="a link that leads to .* is its drive connected"):
        open_sequence(tmp_path, images="L/*.png", movie=None, view="L")


def test_a_file_that_is_no_image_is_in_memory_once(tmp_path: Path) -> None:
    """A sparse file of 400 MB, which is a kilobyte in an archive, took 0.9 GB."""
    with (tmp_path / "a.png").open("wb") as file:
        file.truncate(32 << 20)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="not a readable image"):
            decoded(tmp_path / "a.png")
        assert tracemalloc.get_traced_memory()[1] < 1.5 * (32 << 20)
    finally:
        tracemalloc.stop()


def _png_chunk(kind: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")


def test_a_file_with_several_images_is_refused(tmp_path: Path) -> None:
    """Pages of a TIFF, an animated PNG, an animated WebP; one page, and a page with its preview, are images like others."""
    image = np.full((20, 30), 90, np.uint8)
    single = cv2.imencode(".tiff", image)[1].tobytes()
    cv2.imwritemulti(str(tmp_path / "pages.tiff"), [image, image, image])
    pages = (tmp_path / "pages.tiff").read_bytes()
    preview = bytearray(pages)
    second = struct.unpack("<I", pages[4:8])[0]
    (entries,) = struct.unpack("<H", pages[second : second + 2])
    second = struct.unpack("<I", pages[second + 2 + 12 * entries :][:4])[0]
    (entries,) = struct.unpack("<H", pages[second : second + 2])
    kinds = [second + 2 + 12 * i for i in range(entries) if pages[second + 2 + 12 * i :][:2] == struct.pack("<H", 254)]
    preview[kinds[0] + 8 : kinds[0] + 12] = struct.pack("<I", 1)
    preview[second + 2 + 12 * entries : second + 6 + 12 * entries] = bytes(4)  # and no third page
    png = cv2.imencode(".png", image)[1].tobytes()
    animated = png[:33] + _png_chunk(b"acTL", struct.pack(">II", 2, 0)) + png[33:]
    webp = b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<I", 10) + bytes([2, 0, 0, 0, 29, 0, 0, 19, 0, 0])
    for name, content, several in (
        ("single.tiff", single, False), ("pages.tiff", pages, True), ("preview.tiff", bytes(preview), False),
        ("still.png", png, False), ("animated.png", animated, True), ("animated.webp", webp, True),
    ):  # fmt: skip
        path = tmp_path / name
        path.write_bytes(content)
        if several:
            with pytest.raises(InputError, match=f"{name} has several images.*a file of its own"):
                decoded(path)
        else:
            assert (decoded(path) == image).all(), name


def test_a_loop_of_pages_ends() -> None:
    pages = bytearray(struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", 1) + struct.pack("<HHII", 254, 4, 1, 1) + struct.pack("<I", 8))
    assert not has_several_images(bytes(pages))
