"""The images of a board: one folder of images, or one movie, per camera; images of the same number belong together."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ...images.sequence import ImageFiles, ImageSequence
from ..clocks import Clocks, corners_at_common_instants
from .board import DICTIONARIES, Board, BoardKind
from .detection import FEWEST_CORNERS, MIRRORED, VARIANTS, Variant, find_corners, find_variant
from .observations import BoardObservations

Note = Callable[[str, int, int], None]  # view, images searched, images with the board
RUN = 8  # images that follow one another
MOST_IMAGES = 600  # of a view that are searched, evenly spread
MOST_STILLS = 60  # of a view: so few images are searched thoroughly
TRIED_IMAGES = 24  # in which the variant is looked for
GUESSED_IMAGES = 6  # in which other markers are looked for
MOST_POSITIONS = 240  # that are adjusted
NEAR_SIZES = ((-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1))  # by which a board is looked for that has another size


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardFootage:
    """The opened sequences, one per camera, and the number of each of their images."""

    folder: Path
    names: tuple[str, ...]
    sequences: tuple[ImageSequence, ...]
    numbers: tuple[np.ndarray, ...]  # (count,) of each
    clocks: Clocks | None = None  # of films at different rates


def numbered(
    folder: Path, names: tuple[str, ...], sequences: tuple[ImageSequence, ...], together: bool = True, clocks: Clocks | None = None
) -> BoardFootage:
    """Images with their numbers: those in the names of the files, or their order where the names have none.

    Raises:
        InputError: movies that were taken `together` have different lengths.
    """
    if not together or clocks is not None:
        own = tuple(np.arange(s.count) for s in sequences)
        return BoardFootage(folder=folder, names=names, sequences=sequences, numbers=own, clocks=clocks)
    numbers = [_numbers(s) for s in sequences]
    if any(n is None for n in numbers):
        counts = {name: s.count for name, s in zip(names, sequences)}
        if len(set(counts.values())) > 1:
            lengths = ", ".join(f"{name} {count}" for name, count in counts.items())
            raise InputError(
                f"The views in {folder} have different numbers of frames ({lengths}); "
                "trim them to the same instants, or let `tricap calibrate --synchronise` find them by their sound."
            )
        numbers = [np.arange(s.count) for s in sequences]
    known = [n for n in numbers if n is not None]
    return BoardFootage(folder=folder, names=names, sequences=sequences, numbers=tuple(known))


def _numbers(sequence: ImageSequence) -> np.ndarray | None:
    """The numbers in the names of image files that differ from file to file; None for a movie, or where there is not exactly one."""
    if not isinstance(sequence, ImageFiles):
        return None
    parts = [re.findall(r"\d+", path.stem) for path in sequence.files()]
    if len({len(p) for p in parts}) != 1 or not parts[0]:
        return None
    counting = [column for column in zip(*parts) if len(set(column)) == len(parts)]
    if len(counting) != 1 or max(map(len, counting[0])) > 15:
        return None
    return np.array([int(n) for n in counting[0]])


def measure_boards(footage: BoardFootage, board: Board, monitor: Monitor, note: Note | None = None) -> BoardObservations:
    """Find the corners of the board in the images; `note` is called with the number of images of a view that show it.

    Raises:
        InputError: images cannot be read, or a camera never shows the board; the message names the board that is visible, if there is one.
    """
    wanted = _wanted(footage)
    variant = _variant(footage, wanted, board, monitor)
    found: list[dict[int, np.ndarray]] = []
    sizes = []
    for c in range(len(footage.names)):
        corners, size = _view(footage, c, wanted, board, variant, monitor, note)
        if not corners:
            _refuse(footage, c, wanted, board)
        found.append(corners)
        sizes.append(size)
    if footage.clocks is not None:
        found = corners_at_common_instants(footage.clocks, found, board.symmetries)
    frames = _chosen(found)
    K = len(board.corners_m)
    xy = np.full((len(frames), len(found), K, 2), np.nan)
    for c, corners in enumerate(found):
        for i, frame in enumerate(frames):
            if frame in corners:
                xy[i, c] = corners[frame]
    return BoardObservations(names=footage.names, size_px=np.array(sizes, dtype=float), xy_px=xy, frames=np.array(frames), board=board)


def _wanted(footage: BoardFootage) -> list[np.ndarray]:
    """The numbers of the images of each view that are searched."""
    clocks = footage.clocks
    every = np.unique(np.concatenate(footage.numbers)) if clocks is None else footage.numbers[clocks.slowest]
    some = every[_even(every, MOST_IMAGES)]
    return [some if clocks is None else clocks.around(c, some) for c in range(len(footage.names))]


def _variant(footage: BoardFootage, wanted: list[np.ndarray], board: Board, monitor: Monitor) -> Variant:
    """How the board looks, from some images of each view; a chessboard looks the same inverted."""
    if board.kind is BoardKind.CHESSBOARD:
        return Variant()
    images: list[np.ndarray] = []
    for c in range(len(footage.names)):
        at = np.flatnonzero(np.isin(footage.numbers[c], wanted[c]))
        for i in at[np.unique(np.linspace(0, len(at) - 1, TRIED_IMAGES).astype(int))]:
            monitor.step("board", len(images), TRIED_IMAGES * len(footage.names))
            images.append(footage.sequences[c].read(int(i)))
    return find_variant(images, board)[0]


def _view(
    footage: BoardFootage, c: int, wanted: list[np.ndarray], board: Board, variant: Variant, monitor: Monitor, note: Note | None
) -> tuple[dict[int, np.ndarray], tuple[int, int]]:
    """The corners by image number of one view, and the size of its images."""
    name, sequence = footage.names[c], footage.sequences[c]
    at = np.flatnonzero(np.isin(footage.numbers[c], wanted[c]))
    thorough = len(at) <= MOST_STILLS
    corners: dict[int, np.ndarray] = {}
    size = (0, 0)
    for done, i in enumerate(at):
        monitor.step(f"board {name}", done, len(at))
        image = sequence.read(int(i))
        if done and image.shape[::-1] != size:
            raise InputError(f"The images of view {name} have different sizes, from frame {i} on; use one sequence of one camera.")
        size = (image.shape[1], image.shape[0])
        xy = find_corners(image, board, variant, thorough)
        if np.isfinite(xy).any():
            corners[int(footage.numbers[c][i])] = xy
        if note is not None:
            note(name, done + 1, len(corners))
    monitor.step(f"board {name}", len(at), len(at))
    return corners, size


def _chosen(found: list[dict[int, np.ndarray]]) -> list[int]:
    """The frames that are adjusted: at most MOST_POSITIONS of those that most cameras show, evenly spread, and single views to fill up."""
    frames = sorted({frame for corners in found for frame in corners})
    cameras = np.array([sum(frame in corners for corners in found) for frame in frames])
    number = np.array(frames)
    several = np.flatnonzero(cameras >= 2)
    single = np.flatnonzero(cameras < 2)
    chosen = several[_even(number[several], MOST_POSITIONS)]
    chosen = np.concatenate([chosen, single[_even(number[single], MOST_POSITIONS - len(chosen))]])
    return [frames[i] for i in np.sort(chosen)]


def _even(numbers: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` image numbers (n,), evenly spread, those that follow one another in runs: only these show motion."""
    if len(numbers) <= count:
        return np.arange(len(numbers))
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    runs = [run[i : i + RUN] for run in np.split(np.arange(len(numbers)), breaks) for i in range(0, len(run), RUN)]
    share = int(count * len(runs) / len(numbers))
    some = np.unique(np.linspace(0, len(runs) - 1, max(share, 0)).astype(int))
    return np.concatenate([np.arange(0), *(runs[i] for i in some)])[: max(count, 0)]


def _refuse(footage: BoardFootage, c: int, wanted: list[np.ndarray], board: Board) -> None:
    """Say why a view never shows the board."""
    at = np.flatnonzero(np.isin(footage.numbers[c], wanted[c]))
    images = [footage.sequences[c].read(int(i)) for i in at[np.unique(np.linspace(0, len(at) - 1, TRIED_IMAGES).astype(int))]]
    start = f"View {footage.names[c]} in {footage.folder} never shows the {board.kind.value} of {board.label}"
    counted = "inner corners" if board.kind is BoardKind.CHESSBOARD else "squares"
    if board.kind is BoardKind.CHARUCO:
        if find_variant(images, board, MIRRORED)[1]:
            raise InputError(f"{start}, but its images are mirrored; flip them horizontally.")
        images = images[:: max(1, len(images) // GUESSED_IMAGES)]
        for other in DICTIONARIES:
            if other != board.dictionary and (guess := _other_markers(board, other)) and find_variant(images, guess, VARIANTS[:2])[1]:
                raise InputError(f"{start} with {board.dictionary}, but one of {other}; give --dictionary {other}.")
        if (other_size := _other_charuco(images, board)) is not None:
            raise InputError(f"{start} squares, but one of {other_size.label}; give {other_size.label}.")
    elif (other_size := _other_size(images[:: max(1, len(images) // GUESSED_IMAGES)], board)) is not None:
        raise InputError(
            f"{start} {counted}, but one of {other_size.label}: inner corners are where four squares meet; give {other_size.label}."
        )
    raise InputError(
        f"{start} {counted}; check the numbers of {counted} across and down, and hold the whole board in the image, flat, lit and close."
    )


def _other_size(images: list[np.ndarray], board: Board) -> Board | None:
    """The chessboard that the images show instead: the squares were counted, not the inner corners, or a row or column was miscounted."""
    for across, down in NEAR_SIZES:
        try:
            guess = Board(kind=board.kind, squares=(board.squares[0] + across, board.squares[1] + down), square_m=board.square_m)
        except InputError:  # too few corners
            continue
        if any(np.isfinite(find_corners(image, guess)).any() for image in images):
            return guess
    return None


def _other_charuco(images: list[np.ndarray], board: Board) -> Board | None:
    """The ChArUco board of another size that most corners in the images belong to: across and down exchanged, or miscounted."""
    across, down = board.squares
    found: list[tuple[int, Board]] = []
    for size in ((down, across), *((across + a, down + d) for a, d in NEAR_SIZES)):
        try:
            guess = Board(kind=board.kind, squares=size, square_m=board.square_m, dictionary=board.dictionary, marker_m=board.marker_m)
        except InputError:  # too few corners, or markers
            continue
        found.append((find_variant(images, guess, VARIANTS[:2])[1], guess))
    count, best = max(found, key=lambda pair: pair[0], default=(0, board))
    return best if count >= FEWEST_CORNERS else None


def _other_markers(board: Board, dictionary: str) -> Board | None:
    try:
        return Board(kind=board.kind, squares=board.squares, square_m=board.square_m, dictionary=dictionary, marker_m=board.marker_m)
    except InputError:  # too few markers for this board
        return None
