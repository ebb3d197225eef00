"""Pictures of single fields, for programs that show footage frame by frame: picture n is field n, its missing rows interpolated.

They are made once: a file beside them says what they were made from.
"""

from pathlib import Path

import cv2
import numpy as np

from . import store
from .errors import InputError
from .images.fields import FieldLayout
from .images.sequence import ImageSequence
from .progress import Monitor

MADE_FROM = "made_from.json"


def field_pictures(sequence: ImageSequence, fields: FieldLayout, folder: Path, monitor: Monitor | None = None) -> tuple[Path, ...]:
    """FOLDER/000000.png …, a picture of every field of a sequence, made where they are not there yet.

    Raises:
        InputError: an image cannot be read, or the folder cannot be written to.
        Cancelled: the monitor was cancelled; the pictures are made anew when they are asked for again.
    """
    paths = tuple(folder / f"{n:06d}.png" for n in range(fields.per_image * sequence.count))
    source, record = _said(sequence, fields), folder / MADE_FROM
    if record.is_file() and store.read_json(record) == source and all(path.is_file() for path in paths):
        return paths
    try:
        folder.mkdir(parents=True, exist_ok=True)
        record.unlink(missing_ok=True)
        for n, path in enumerate(paths):
            if monitor is not None:
                monitor.step("fields", n, len(paths))
            picture = fields.rows(n).whole(sequence.read(fields.image(n)))
            store.write_bytes(path, cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1].tobytes())
        store.write_json(record, source)
    except OSError as error:
        raise InputError(f"Cannot write pictures of the fields into {folder}: {error.strerror or error}. Choose another folder.") from error
    return paths


def _said(sequence: ImageSequence, fields: FieldLayout) -> dict[str, object]:
    """What identifies the pictures: names, sizes and dates of the footage, and which field is first."""
    files = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in sequence.files()]
    return {"files": files, "count": sequence.count, "first_row": fields.first.offset}
