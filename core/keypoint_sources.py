"""[[keypoints]] of take.toml: files in which another system says where joints are, in the pixels of a view or in space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import InputError
from .settings import nearest_name

KEYS = ("files", "view", "offset_frames", "sigma", "names", "axes")
PIXELS, SPACE = (".json",), (".trc", ".c3d", ".csv")
SIGMA_PX, SIGMA_M = 8.0, 0.02


@dataclass(frozen=True, kw_only=True, slots=True)
class KeypointSource:
    """A file, or a pattern of files in natural order, inside the take's folder."""

    files: str
    view: str = ""  # of keypoints in pixels
    offset_frames: int = 0  # the file's frame of take frame t is t + offset_frames (and the view's own offset)
    sigma: float = SIGMA_PX  # px, or m in space
    names: Mapping[str, str] = field(default_factory=dict)  # the file's name -> our joint
    axes: str | None = None  # of a file in space; None: what such files usually have


def keypoint_sources(
    tables: Sequence[Mapping[str, Any]], views: Sequence[str], joints: Sequence[str], where: str
) -> tuple[KeypointSource, ...]:
    """The sources that a take.toml names.

    Raises:
        InputError: a key, view or joint is unknown, or a value cannot be.
    """
    return tuple(_source(table, views, joints, f"[[keypoints]] of {where}") for table in tables)


def _source(table: Mapping[str, Any], views: Sequence[str], joints: Sequence[str], where: str) -> KeypointSource:
    for key in table:
        if key not in KEYS:
            raise InputError(f"A {where} has an unknown key “{key}”.{nearest_name(key, KEYS)}")
    files, view, names = table.get("files"), table.get("view", ""), table.get("names", {})
    if not isinstance(files, str) or Path(files).is_absolute() or ".." in Path(files).parts:
        raise InputError(f'`files` of a {where} is {files!r}; it must be files inside the take\'s folder, such as "kp/C/*.json".')
    kind = Path(files).suffix.lower()
    if kind not in PIXELS + SPACE:
        raise InputError(f"`files` of a {where} is {files!r}; keypoints are read from {', '.join(PIXELS + SPACE)}.")
    if (kind in PIXELS) != bool(view) or (view and view not in views):
        need = f"must name its view.{nearest_name(str(view), tuple(views))}" if kind in PIXELS else "is in space and has no view."
        raise InputError(f"The {where} with “{files}” {need}")
    if not isinstance(names, dict):
        raise InputError(f'`names` of a {where} must be a table, such as {{ RKnee = "knee.R" }}.')
    for joint in names.values():
        if joint not in joints:
            raise InputError(f"A {where} has the joint {joint!r}, which is none.{nearest_name(str(joint), tuple(joints))}")
    offset, sigma, axes = table.get("offset_frames", 0), table.get("sigma", SIGMA_PX if view else SIGMA_M), table.get("axes")
    if not isinstance(offset, int) or not isinstance(sigma, (int, float)) or not 0 < sigma < 1e4 or not isinstance(axes, str | None):
        raise InputError(f"The {where} with “{files}” needs a whole `offset_frames`, a positive `sigma` and a name as `axes`.")
    return KeypointSource(files=files, view=view, offset_frames=offset, sigma=float(sigma), names=names, axes=axes)
