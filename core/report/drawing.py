"""What every picture of a report has: a scale, its axes, and words.

Bars of colours, scales and axes are in a strip under a picture, names of panels above it: nothing lies on the person or on the points.
"""

from collections.abc import Sequence

import cv2
import numpy as np

WHITE, SHADOW = (255, 255, 255), (20, 20, 20)  # BGR
FONT = cv2.FONT_HERSHEY_SIMPLEX
MARGIN_PX, ARM_PX = 12, 26
NARROW_PX = 400
OF_PANELS = 1.7  # size of letters in pictures of two panels, which are shown smaller
STRIP_PX, TITLE_PX, ROW_PX = 54, 20, 18  # heights of the strip under a picture, of a title and of a row of a legend, by the size of letters
ROOM_PX = 300  # width that the strip's content needs, by the size of letters
GROUND = (28, 28, 28)
FRONT, SIDE = "from the reference camera", "from its right side"  # names of panels
LONGEST = 0.3  # of the picture's width, that a scale takes at most
RAMP = cv2.applyColorMap(np.linspace(25, 245, 256).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0]  # blue to red, BGR


def size_of(picture: np.ndarray) -> float:
    """How much larger letters, lines and margins are than in a picture of `NARROW_PX`: a page shows all pictures about as large."""
    return max(1.0, max(picture.shape[:2]) / NARROW_PX)


def small_text(picture: np.ndarray, words: str, at: tuple[int, int], colour: tuple[int, int, int] = WHITE, size: float = 0) -> None:
    """Words with a dark outline, from a pixel on their base line; `size` of the letters, by default that of the picture."""
    k = size or size_of(picture)
    thick, step = max(1, round(k)), max(1, round(k))
    for dx, dy in ((-step, 0), (step, 0), (0, -step), (0, step)):  # a thicker line would be wider: letters would not lie on their outline
        cv2.putText(picture, words, (at[0] + dx, at[1] + dy), FONT, 0.42 * k, SHADOW, thick, cv2.LINE_AA)
    cv2.putText(picture, words, at, FONT, 0.42 * k, colour, thick, cv2.LINE_AA)


def with_strip(
    picture: np.ndarray,
    px_per_m: float = float("nan"),
    axes: tuple[str, str] | None = ("x", "y"),
    *,
    note: str = "",
    left: bool = False,
    bar: tuple[float, str] | None = None,
    size: float = 0,
) -> np.ndarray:
    """The picture above a strip with a bar of colours (its upper end and words), a scale and axes; see the functions that draw them."""
    width = picture.shape[1]
    k = size or min(size_of(picture), width / ROOM_PX)
    strip = np.full((round(STRIP_PX * k), width, 3), GROUND, np.uint8)
    start = 0 if bar is None else add_colour_bar(strip, *bar, size=k)
    add_scale(strip, px_per_m, note, size=k, start=start)
    if axes is not None:
        add_axes(strip, axes, left=left, size=k)
    return np.vstack([picture, strip])


def with_title(picture: np.ndarray, words: str, size: float = 0) -> np.ndarray:
    """The picture below its name."""
    k = size or size_of(picture)
    strip = np.full((round(TITLE_PX * k), picture.shape[1], 3), GROUND, np.uint8)
    small_text(strip, words, (round(MARGIN_PX * k), round(14 * k)), size=k)
    return np.vstack([strip, picture])


def with_legend(picture: np.ndarray, meanings: Sequence[tuple[tuple[int, int, int], str]], size: float = 0) -> np.ndarray:
    """The picture above swatches of its colours (BGR) with what they mean, in as many rows as they need."""
    k, rows, x = size or size_of(picture), list[np.ndarray](), picture.shape[1]
    gap, side = round(MARGIN_PX * k), round(9 * k)
    for colour, words in meanings:
        wide = side + round(5 * k) + text_width(words, k) + gap
        if x + wide > picture.shape[1]:
            rows.append(np.full((round(ROW_PX * k), picture.shape[1], 3), GROUND, np.uint8))
            x = gap
        top = round(4 * k)
        cv2.rectangle(rows[-1], (x, top), (x + side, top + side), colour, -1)
        small_text(rows[-1], words, (x + side + round(5 * k), top + side), size=k)
        x += wide
    return np.vstack([picture, *rows])


def plain(words: str) -> str:
    """Words in OpenCV's letters, which are ASCII."""
    return words.encode("ascii", "replace").decode()


def text_width(words: str, size: float) -> int:
    """The width [px] of words of `small_text`."""
    return int(cv2.getTextSize(words, FONT, 0.42 * size, max(1, round(size)))[0][0])


def add_scale(picture: np.ndarray, px_per_m: float, note: str = "", size: float = 0, start: int = 0) -> None:
    """A bar of a round length in the lower left corner (right of column `start`), with the length and a note; none where a metre has no
    size."""
    if not np.isfinite(px_per_m) or px_per_m <= 0:
        return
    (height, width), k = picture.shape[:2], size or size_of(picture)
    bar_m = round_length(LONGEST * width / px_per_m)
    left, y = start + round(MARGIN_PX * k), height - round(14 * k)
    for colour, thick in ((SHADOW, 4), (WHITE, 2)):
        cv2.line(picture, (left, y), (left + round(bar_m * px_per_m), y), colour, round(thick * k))
    small_text(picture, length_words(bar_m) + (f" {note}" if note else ""), (left, y - round(7 * k)), size=k)


def round_length(most_m: float) -> float:
    """The largest length that is 1, 2 or 5 times a power of ten [m] and no longer than another."""
    power = 10.0 ** np.floor(np.log10(most_m))
    return float(next(m * power for m in (5.0, 2.0, 1.0) if m * power <= most_m * (1 + 1e-9)))


def length_words(metres: float) -> str:
    """A round length in the unit that needs no decimals."""
    if metres >= 1:
        return f"{metres:g} m"
    return f"{100 * metres:g} cm" if metres >= 0.01 else f"{1000 * metres:g} mm"


def add_axes(picture: np.ndarray, names: tuple[str, str], *, left: bool = False, up: bool = False, size: float = 0) -> None:
    """Arrows with names in the lower right corner: the first to the right (to the left with `left`), the second down (or `up`)."""
    k = size or size_of(picture)
    corner = np.array([picture.shape[1] - 48 * k, picture.shape[0] - (18 if up else 44) * k])
    first, second = (-ARM_PX if left else ARM_PX, 0), (0, -ARM_PX if up else ARM_PX)
    for name, arm, shift in ((names[0], first, (-11, 4) if left else (3, 4)), (names[1], second, (4, 0) if up else (4, 8))):
        tip = corner + k * np.array(arm)
        for colour, thick in ((SHADOW, 3), (WHITE, 1)):
            cv2.arrowedLine(picture, _pixel(corner), _pixel(tip), colour, round(thick * k), cv2.LINE_AA, tipLength=0.25)
        small_text(picture, name, _pixel(tip + k * np.array(shift)), size=k)


def _pixel(xy: np.ndarray) -> tuple[int, int]:
    return round(float(xy[0])), round(float(xy[1]))


def value_colours(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Colours (…, 3) BGR uint8 of values (…) from blue (low) over green and yellow to red (high)."""
    return np.asarray(RAMP[np.clip(255 * (values - low) / max(high - low, 1e-12), 0, 255).astype(np.uint8)])


def add_colour_bar(picture: np.ndarray, high: float, words: str, size: float = 0) -> int:
    """The colours from 0 to `high` in the upper left corner, with what they mean (ASCII), such as "speed, m/s"; gives the column where
    they end."""
    k, width = size or size_of(picture), picture.shape[1]
    left, top, length, thick = round(MARGIN_PX * k), round(22 * k), round(LONGEST * width), max(4, round(6 * k))
    cv2.rectangle(picture, (left - 1, top - 1), (left + length, top + thick), SHADOW, -1)
    picture[top : top + thick, left : left + length] = RAMP[np.linspace(0, 255, length).astype(int)]
    small_text(picture, words, (left, top - round(7 * k)), size=k)
    base, end = top + thick + round(13 * k), f"{high:.2g}"
    small_text(picture, "0", (left, base), size=k)
    small_text(picture, end, (left + length - text_width(end, k), base), size=k)
    return left + max(length, text_width(words, k)) + round(MARGIN_PX * k / 2)
