"""The sample of the extension: a recording of a person who walks, with its finished results, in one small archive.

`python3 dev.py sample` makes it: `make_recording`, a run, `pack`. `unpack` lays it out as a take with the folder `results`. Footage enters
the keys of the stages by its modification times, so all files get the same one, and the results are valid wherever they are unpacked.
"""

import io
import os
import re
import shlex
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2

from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..images.picture import decoded
from ..results.run_json import read_run
from .arm import PERSON, VIEWS, ArmTakeSettings, clear_recording, make_arm_take

RECORDING = ArmTakeSettings(subject=PERSON, frames=12, fps=12.5, width_px=512, interlaced="none", swing_s=0.96)
RESULTS = "results"
TEXTURE_PX = 640  # the person is 380 pixels high
JPEG_QUALITY = 85
MODIFIED_S = 1_600_000_000  # of all files
PLACE = "SAMPLE"  # in run.json, where a run names the folder of its take
KEPT = re.compile(
    rf"(take|rig)\.toml|[{''.join(VIEWS)}]/\d{{4}}\.jpg|{RESULTS}/"
    r"(run\.json|body\.toml|(joints|motion|frames)\.csv|trajectories\.npz|clouds/\d{4}\.ply|skin/(rest\.npz|texture(_mask)?\.png))"
)
LARGEST_BYTES = 16 << 20


def pack(archive: Path, folder: Path) -> None:
    """Pack a recording and its results, from which the report is removed."""
    record = _placed(read_run(folder / RESULTS / "run.json"), str(bounded.real_path(folder)), PLACE)
    record["stages"].pop("report")  # it is as large as all else
    record.pop("files")  # some of them are left out
    store.write_json(folder / RESULTS / "run.json", record)
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed:
        for name in filter(KEPT.fullmatch, files):
            data = bounded.bytes_of(folder / name, LARGEST_BYTES)
            packed.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    store.write_bytes(archive, content.getvalue())


def make_recording(folder: Path, monitor: Monitor | None = None) -> None:
    """The recording in an empty or new folder, with JPEG images as cameras write them, and without its truth."""
    make_arm_take(folder, RECORDING, monitor)
    for path in sorted(folder.glob("*/*.png")):
        picture = decoded(path)
        store.write_bytes(path.with_suffix(".jpg"), cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
        path.unlink()
    (folder / "truth.npz").unlink()
    take = bounded.text_of(folder / "take.toml", bounded.TOML_BYTES).replace(".png", ".jpg")
    store.write_text(folder / "take.toml", f"{take}\n[settings.skin]\ntexture_px = {TEXTURE_PX}\n")
    _set_times(folder.rglob("*"))


def unpack(archive: Path, folder: Path) -> None:
    """Lay out the sample in a folder. take.toml is written last: as long as it is missing, the sample is not there.

    Raises:
        InputError: the archive is damaged, or the folder has other content than a sample, or cannot be written.
    """
    content = _read(archive)
    clear_recording(folder)
    for name in sorted(content, key=lambda name: (name == "take.toml", name != "rig.toml", name)):
        path = folder / name
        store.write_bytes(path, content[name])
        if name == f"{RESULTS}/run.json":
            store.write_json(path, _placed(read_run(path), PLACE, str(bounded.real_path(folder))))
        _set_times([path])


def _read(archive: Path) -> dict[str, bytes]:
    """The files of the archive, by name."""
    try:
        with zipfile.ZipFile(io.BytesIO(bounded.bytes_of(archive, LARGEST_BYTES))) as packed:
            entries = [entry for entry in packed.infolist() if KEPT.fullmatch(entry.filename)]
            if sum(entry.file_size for entry in entries) > LARGEST_BYTES:
                raise ValueError("it is too large")
            return {entry.filename: packed.read(entry) for entry in entries}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"The sample {archive} is damaged ({error}); install the extension again.") from error


def _placed(record: dict[str, Any], before: str, now: str) -> dict[str, Any]:
    """run.json with another folder of the take."""
    return {**record, "take": now, "repeat": str(record["repeat"]).replace(shlex.quote(before), shlex.quote(now), 1)}


def _set_times(paths: Iterable[Path]) -> None:
    for path in paths:
        os.utime(path, (MODIFIED_S, MODIFIED_S))
