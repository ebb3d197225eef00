"""One image file: its size in its header, read before it is decoded, and its grey and colour values as float32 in the range 0…255."""

from pathlib import Path

import cv2
import numpy as np

from ..foundation import bounded
from ..foundation.errors import InputError
from .headers import claimed_size, has_several_images, memory_bytes

MAX_PIXELS = 36_000_000  # of 8K video
MOST_BYTES, BYTES_PER_BYTE = 400_000_000, 100  # of memory for an image, and for each byte of a larger file
MAX_SIDE_PX = 8191  # OpenCV looks up four times as many
OPEN_EXR = b"\x76\x2f\x31\x01"
OTHER_SIZE = "{path} has {w}×{h} pixels, but its camera has {size[0]}×{size[1]}; use the footage as it was calibrated."
WHITES = (1023.0, 4095.0, 16383.0, 65535.0)  # of 10, 12, 14 and 16 bits
KINDS = ("uint8", "uint16", "float32", "float64")


def read_image(path: Path) -> np.ndarray:
    """Grey values (h, w) float32 0…255 of one image file of 8 or 16 bits, grey or colour.

    Raises:
        InputError: see `decoded`.
    """
    return grey(decoded(path))


def decoded(path: Path, size_px: tuple[int, int] | None = None) -> np.ndarray:
    """The pixels of an image file (h, w) or (h, w, channels).

    Raises:
        InputError: the file is missing, is not an image, has several, is too large (MAX_PIXELS, MAX_SIDE_PX), has another size (width,
            height) than `size_px`, an unsupported type of pixels, or unpacks to far more than its own size.
    """
    content = _content(path)
    claimed = claimed_size(content)
    refuse_size(claimed, path)
    if claimed is not None and size_px is not None and claimed != size_px:
        raise InputError(OTHER_SIZE.format(path=path, w=claimed[0], h=claimed[1], size=size_px))
    if claimed is not None and (memory := memory_bytes(content, claimed)) > max(MOST_BYTES, BYTES_PER_BYTE * len(content)):
        raise InputError(
            f"{path} would unpack to {memory / 1e9:.1f} GB, more than {BYTES_PER_BYTE} times its size; save it with 8 bits per channel."
        )
    if has_several_images(content):
        raise InputError(f"{path} has several images, of which only one would be measured; write each of them to a file of its own.")
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path} is not a readable image; replace it, or remove it from the sequence.")
    refuse_size(image.shape[1::-1], path)
    if image.dtype.name not in KINDS:
        raise InputError(f"{path} has {image.dtype.name} pixels; save it with 8 or 16 bits per channel.")
    return np.asarray(image)


def header_size(path: Path) -> tuple[int, int] | None:
    """(width, height) in the header of an image file, None if it is damaged; nothing is decoded.

    Raises:
        InputError: the file is missing, or an OpenEXR image.
    """
    return claimed_size(_content(path))


def _content(path: Path) -> bytes:
    try:
        content = bounded.bytes_of(path, bounded.IMAGE_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read the image {path}: {error.strerror or error}.") from error
    refuse_open_exr(content[:8], path)
    return content


def refuse_size(size_px: tuple[int, int] | None, path: Path) -> None:
    """Refuse a size of images that cannot be measured; None: not known."""
    if size_px is None or min(size_px) < 1:
        raise InputError(f"{path} is not a readable image; replace it, or remove it from the sequence.")
    if size_px[0] * size_px[1] > MAX_PIXELS or max(size_px) > MAX_SIDE_PX:
        raise InputError(f"{path} has {size_px[0]}×{size_px[1]} pixels, more than can be measured; scale the footage down.")


def grey(image: np.ndarray, white: float = 0.0) -> np.ndarray:
    """Grey values (h, w) float32 0…255 of an image of 8 or 16 bits (of which `white` is white) or float 0…1, grey, BGR or BGRA."""
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.ndim == 3:
        image = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY) if image.shape[2] >= 3 else image[:, :, 0]
    if image.dtype == np.uint16:
        return (image / np.float32((white or WHITES[-1]) / 255)).astype(np.float32, copy=False)
    if image.dtype.kind == "f":
        return np.ascontiguousarray(np.nan_to_num(image, nan=0.0) * 255.0, dtype=np.float32)
    return image.astype(np.float32)


def colour(image: np.ndarray, white: float = 0.0) -> np.ndarray:
    """RGB values (h, w, 3) float32 0…255 of an image as for `grey`."""
    if image.ndim == 2 or image.shape[2] < 3:
        return np.repeat(grey(image, white)[:, :, None], 3, axis=2)
    return np.ascontiguousarray(np.stack([grey(image[:, :, channel], white) for channel in (2, 1, 0)], axis=2))


def refuse_open_exr(first: bytes, path: Path) -> None:
    """Refuse an OpenEXR image, by its first bytes."""
    if first.startswith(OPEN_EXR):
        raise InputError(f"{path} is an OpenEXR image, which is not supported; save the sequence as PNG or TIFF of 16 bits.")
