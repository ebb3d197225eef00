"""Image sequences of a camera: image files or a movie, with grey values as float32 in the range 0…255.

Files are read on demand, so a long sequence needs no more memory than a short one.
"""

import os
import re
import shlex
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from ..foundation import bounded
from ..foundation.errors import InputError
from .packets import Packets
from .picture import OTHER_SIZE, WHITES, colour, decoded, grey, refuse_open_exr, refuse_size
from .sample_tables import claimed_samples

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".exr")
MOVIE_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".mpg", ".mpeg", ".webm", ".m4v")
SIGNATURES = (
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8\xff",
    b"II*\0",
    b"MM\0*",
    b"II+\0",
    b"BM",
    b"RIFF",
    b"P2",
    b"P3",
    b"P5",
    b"P6",
)
MOVIE_SIGNATURES = (b"RIFF", b"\x1a\x45\xdf\xa3", b"\0\0\1\xba", b"\0\0\1\xb3", b"\x47")  # AVI, Matroska, MPEG: program, video, transport
GIF = b"GIF8"  # begins like a transport stream
MOVIE_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")  # one of them begins an MP4 or QuickTime file
MARKED = (
    "{path} is marked as interlaced, and such movies cannot be decoded here; take the mark away, which keeps its fields as they are: "
    "ffmpeg -i {name} -vf setfield=prog -c:v ffv1 new.mkv"
)
AVI = ".avi"  # whose header has the number of images, written at the end of a recording
SOON = 1000  # images in an AVI file's header, up to which it is compared with the file before anything is computed
CUT = (
    "The header of {path} has {count} images, but more follow, as after a recording that did not end properly; "
    "write it anew: ffmpeg -i {name} -c copy new.mkv"
)
TOO_MANY = "{path} is not a movie that can be decoded ({reason}); write it anew: ffmpeg -i {name} -c copy new.mkv"
NO_MOVIE = "{path} is not a movie that can be decoded; convert it to H.264 in .mp4, or to PNG files."


class ImageSequence(Protocol):
    """Frames of one camera, counted from 0."""

    @property
    def count(self) -> int:
        """Number of frames."""

    @property
    def source(self) -> str:
        """Where the frames come from, for messages."""

    def read(self, index: int) -> np.ndarray:
        """Grey values (h, w) float32 of frame `index`."""

    def read_colour(self, index: int) -> np.ndarray:
        """RGB values (h, w, 3) float32 of frame `index`; equal ones in footage without colours."""

    def files(self) -> tuple[Path, ...]:
        """The files behind the frames."""


class ImageFiles:
    """Numbered image files in natural order (2 before 10)."""

    def __init__(self, paths: tuple[Path, ...], source: str, size_px: tuple[int, int] | None = None) -> None:
        """`size_px`: (width, height) of its camera's images; those of another size are not decoded."""
        self._paths, self._source, self._size_px = paths, source, size_px
        self._top: float | None = None

    @property
    def count(self) -> int:
        """Number of files."""
        return len(self._paths)

    @property
    def source(self) -> str:
        """The pattern of the files."""
        return self._source

    def files(self) -> tuple[Path, ...]:
        """The image files in order."""
        return self._paths

    def read(self, index: int) -> np.ndarray:
        """Grey values (h, w) float32 of file `index`.

        Raises:
            InputError: the file is gone or is not an image.
        """
        return grey(decoded(self._paths[index], self._size_px), self._white())

    def read_colour(self, index: int) -> np.ndarray:
        """RGB values (h, w, 3) float32 of file `index`; see `read`."""
        return colour(decoded(self._paths[index], self._size_px), self._white())

    def _white(self) -> float:
        """The grey value of white: cameras of 10 or 12 bits often write files of 16 bits."""
        if self._top is None:
            samples = sorted({0, len(self._paths) // 2, len(self._paths) - 1})
            if decoded(self._paths[0], self._size_px).dtype != np.uint16:
                self._top = 0.0
            else:
                brightest = max(int(decoded(self._paths[i], self._size_px).max()) for i in samples)
                self._top = float(next(white for white in WHITES if brightest <= white))
        return self._top


class LaterPart:
    """A sequence without its first images."""

    def __init__(self, whole: ImageSequence, first: int, count: int) -> None:
        self._whole, self._first, self._count = whole, first, count

    @property
    def first(self) -> int:
        """The number of its frame 0 in the whole sequence."""
        return self._first

    @property
    def count(self) -> int:
        """Number of frames that are left."""
        return self._count

    @property
    def source(self) -> str:
        """Where the frames come from."""
        return self._whole.source

    def read(self, index: int) -> np.ndarray:
        """Grey values (h, w) float32 of frame `index` of the part."""
        return self._whole.read(self._first + index)

    def read_colour(self, index: int) -> np.ndarray:
        """RGB values (h, w, 3) float32 of frame `index` of the part."""
        return self._whole.read_colour(self._first + index)

    def files(self) -> tuple[Path, ...]:
        """The files behind the whole sequence."""
        return self._whole.files()


class Movie:
    """A movie file, decoded frame by frame; reading in order is fast, reading backwards starts again."""

    def __init__(self, path: Path, size_px: tuple[int, int] | None = None) -> None:
        """`size_px`: (width, height) of its camera's images; a movie of another size is not decoded.

        Raises:
            InputError: it is no movie that can be decoded, too large, or of another size.
        """
        _check_movie(path)
        self._path = path
        self._capture = _capture(path)
        self._next, self._last = 0, np.zeros(0)
        self._shown_ms: dict[int, float] = {}
        self._packets = Packets(path)
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) if self._capture.isOpened() else 0
        if count < 1:
            raise InputError(NO_MOVIE.format(path=path))
        w, h = (int(self._capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        refuse_size((w, h), path)
        if size_px is not None and (w, h) not in (size_px, size_px[::-1]):  # some decoders tell the size before it is turned
            raise InputError(OTHER_SIZE.format(path=path, w=w, h=h, size=size_px))
        self._count = count
        self._packets.at(0)
        if self._count <= SOON:
            self._refuse_more()
        if self._packets.may_be_interlaced and count > 1:
            self.read(0), self.read(1)

    @property
    def count(self) -> int:
        """Number of frames in the movie's header."""
        return self._count

    @property
    def source(self) -> str:
        """The movie's path."""
        return str(self._path)

    def files(self) -> tuple[Path, ...]:
        """The movie file."""
        return (self._path,)

    def read(self, index: int) -> np.ndarray:
        """Grey values (h, w) float32 of frame `index`; the last frame is cached.

        Raises:
            InputError: the movie ends before that frame, its pictures have another size there, or are marked as interlaced.
        """
        if index == self._next - 1 and len(self._last):
            return grey(self._last)
        if index < self._next:
            self._capture.release()
            self._capture, self._next = _capture(self._path), 0
        before, image = self._last, np.zeros(0)
        self._last = image
        while self._next <= index:
            ok = self._capture.grab() if self._next < index else None
            if ok is None:
                ok, image = self._capture.read()
            if not ok:
                raise InputError(
                    f"Frame {index} of {self._path} cannot be decoded, although its header has {self._count} frames. "
                    "Leave out the end with `frames` in take.toml, or convert the movie again."
                )
            self._shown_ms[self._next] = float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
            self._next += 1
        self._refuse_change(index)
        if index == self._count - 1:
            self._refuse_more()
        if self._packets.may_be_interlaced and np.array_equal(before, image):  # each frame has the noise of a camera
            raise InputError(MARKED.format(path=self._path, name=shlex.quote(self._path.name)))
        self._last = image
        return grey(image)

    def _refuse_more(self) -> None:
        """The images beyond those of the header would be left out in silence."""
        if self._path.suffix.lower() == AVI and self._packets.exceed(self._count):
            raise InputError(CUT.format(path=self._path, count=self._count, name=shlex.quote(self._path.name)))

    def _refuse_change(self, index: int) -> None:
        """The decoder would scale such pictures, so that they fit no calibration."""
        first, now = self._packets.at(0), self._packets.at(index)
        if first is not None and now is not None and now[1] != first[1]:
            raise InputError(
                f"From frame {now[0]} on, the pictures of {self._path} have {now[1][0]}×{now[1][1]} pixels instead of "
                f"{first[1][0]}×{first[1][1]}. Leave out those frames with `frames` in take.toml, or cut the movie there."
            )

    def read_colour(self, index: int) -> np.ndarray:
        """RGB values (h, w, 3) float32 of frame `index`; see `read`."""
        self.read(index)
        return colour(self._last)

    @property
    def shown(self) -> int:
        """Number of frames decoded so far, whose time stamps are known."""
        return len(self._shown_ms)

    def stamps_ms(self, count: int) -> np.ndarray:
        """When the first frames (at most `count`) are shown, increasing: of those decoded so far, or of more that are not decoded."""
        decoded = np.array([self._shown_ms[n] for n in range(count) if n in self._shown_ms])
        if len(decoded) < min(count, self._count):  # which shows also pictures that the decoder skips, for they are damaged
            return self._packets.stamps_ms(count)
        return decoded if (np.diff(decoded) > 0).all() else np.zeros(0)

    @property
    def unevenness(self) -> float:
        """Largest deviation, in frames, of the time stamps decoded so far from an even rate; 0 if not known."""
        frames = np.array(sorted(self._shown_ms), dtype=np.float64)
        shown = np.array([self._shown_ms[int(f)] for f in frames])
        if len(frames) < 4 or not np.ptp(shown) > 0:
            return 0.0
        step, first = np.polyfit(frames, shown, 1)
        return float(np.abs(shown - (first + step * frames)).max() / step) if step > 0 else 0.0


def movie_rate(path: Path) -> float:
    """The images per second that a movie file states; 0 if it states none.

    Raises:
        InputError: it is no movie that can be read.
    """
    _check_movie(path)
    return max(float(_capture(path).get(cv2.CAP_PROP_FPS)), 0.0)


def _capture(path: Path) -> Any:
    """A decoder that applies the orientation in the movie's header, which OpenCV 4 does on request only."""
    capture = cv2.VideoCapture(str(path))
    if capture.isOpened():
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return capture


def open_sequence(
    folder: Path, *, images: str | None, movie: str | None, view: str, gaps: bool = False, size_px: tuple[int, int] | None = None
) -> ImageSequence:
    """The sequence of one view of the take in `folder`. `gaps`: numbers may be missing among its images; `size_px` of its camera.

    Raises:
        InputError: there is no such footage, it is a movie of another size, or a path leads out of the folder.
    """
    pattern = images if images is not None else movie or ""
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise InputError(f"View {view} reads “{pattern}”, which lies outside the take {folder}; move or link the footage into the take.")
    link = folder / movie if movie is not None else (folder / pattern).parent
    if link.is_symlink() and not link.exists():
        raise InputError(
            f"The footage of view {view} is not at {bounded.real_path(link)} any more; move it back, or correct the link {link}."
        )
    if movie is not None:
        path = folder / movie
        if not path.is_file():
            raise InputError(f"The movie {path} of view {view} is missing; correct `movie` in take.toml.")
        return Movie(path, size_px)
    found = bounded.matching(folder, pattern)
    paths = tuple(sorted((p for p in found if p.suffix.lower() in IMAGE_ENDINGS and p.name[0] != "."), key=natural))
    if not paths:
        inside = pattern and (folder / pattern).is_dir()
        hint = f"“{pattern}” is a folder; write “{pattern.rstrip('/')}/*.png” for its PNG files." if inside else "Correct `images` there."
        raise InputError(f"View {view} has no images: nothing in {folder} matches “{pattern}” of take.toml. {hint}")
    if not gaps:
        _check_doubles(paths, view)
        _check_numbering(paths, view)
    for path in paths:
        _check_signature(path)
    return ImageFiles(paths, pattern, size_px)


def _check_movie(path: Path) -> None:
    """Only files with their own images are decoded: playlists and scripts would make the decoder open other files, even URLs."""
    if path.suffix.lower() not in MOVIE_ENDINGS:
        raise InputError(f"The movie {path} is of an unsupported kind ({', '.join(MOVIE_ENDINGS)}); convert it to H.264 in .mp4.")
    bounded.check_name(path)
    first = _first_bytes(path, "movie")
    if not (first.startswith(MOVIE_SIGNATURES) or first[4:8] in MOVIE_BOXES) or first.startswith(GIF):
        raise InputError(NO_MOVIE.format(path=path))
    if first[4:8] in MOVIE_BOXES:
        _check_samples(path)


def _check_samples(path: Path) -> None:
    """FFmpeg makes an entry for every sample that a table claims, and each has a byte at least."""
    try:
        with bounded.opened(path, bounded.MOVIE_BYTES) as file:
            size = os.fstat(file.fileno()).st_size
            count = claimed_samples(file, size)
            if count > size:
                raise ValueError(f"its tables claim {count} images or sounds, more than its {size} bytes can be")
    except OSError as error:
        raise InputError(f"Cannot read the movie {path}: {error.strerror or error}.") from error
    except ValueError as error:
        raise InputError(TOO_MANY.format(path=path, reason=error, name=shlex.quote(path.name))) from error


def _first_bytes(path: Path, what: str) -> bytes:
    try:
        with bounded.opened(path, bounded.IMAGE_BYTES if what == "image" else bounded.MOVIE_BYTES) as file:
            return file.read(8)
    except FileNotFoundError as error:
        if path.is_symlink():
            where = f"leads to {path.readlink()}, which is not there; is its drive connected?"
            raise InputError(f"The {what} {path} is a link that {where}") from error
        raise InputError(f"The {what} {path} is gone; put it back.") from error
    except OSError as error:
        raise InputError(f"Cannot read the {what} {path}: {error.strerror or error}.") from error


def _check_signature(path: Path) -> None:
    """Refuse files that are no images by their first bytes, before anything is computed."""
    first = _first_bytes(path, "image")
    refuse_open_exr(first, path)
    if first.startswith(b"version "):
        raise InputError(f"{path} is a Git LFS placeholder of the image; fetch the images with `git lfs pull`.")
    if not first.startswith(SIGNATURES):
        raise InputError(f"{path} is not a readable image; replace it, or remove it from the sequence.")


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A key to sort paths by, 2 before 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d+)", str(path)) if part]


def _check_doubles(paths: tuple[Path, ...], view: str) -> None:
    """Refuse two images of one number, such as 7.png and 07.png, or 7.png and its copy “7 (1).png”: all later images would be late."""
    for path, other in zip(paths, paths[1:]):
        number = _to_number(min(path, other, key=lambda p: len(natural(Path(p.stem)))))
        if number and path.parent == other.parent and all(natural(Path(p.stem))[: len(number)] == number for p in (path, other)):
            raise InputError(f"View {view} has two images of number {number[-1][1]}: {path.name} and {other.name}; remove one of them.")


def _to_number(path: Path) -> list[tuple[int, int, str]]:
    """The key of a file's name up to its last number; empty without a number."""
    key = natural(Path(path.stem))
    return key[: max((n for n, part in enumerate(key, 1) if not part[0]), default=0)]


def _check_numbering(paths: tuple[Path, ...], view: str) -> None:
    """Refuse a gap in the numbers, a missing image, if most of the numbers have the same step."""
    numbers = [[int(n) for n in re.findall(r"\d+", p.stem)] for p in paths]
    if len(paths) < 3 or not numbers[0] or len({len(n) for n in numbers}) > 1:
        return
    table = np.array(numbers, dtype=object)
    counting = [column for column in table.T if len(set(column)) > 1]
    steps = [int(b - a) for a, b in zip(counting[-1], counting[-1][1:])] if counting else [0]
    usual = min(set(steps), key=lambda step: (-steps.count(step), step))
    if usual < 1 or 2 * steps.count(usual) < len(steps):
        return
    for i, step in enumerate(steps):
        if step > usual and step % usual == 0:
            raise InputError(
                f"View {view} lacks the image(s) between {paths[i].name} and {paths[i + 1].name}; "
                "restore them, or renumber the files of all views in the same way."
            )
