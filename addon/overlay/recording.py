"""The run whose results are shown: its folder, cameras and what was read from it, kept until the files change. No drawing in here."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.contour_table import ContourTable
from ...core.errors import InputError
from ...core.frame_table import FrameTable, read_frame_table
from ...core.geometry.camera import Camera
from ...core.images.fields import RowGrid
from ...core.inspection import FramePoints, TrackHistory, body_outline, read_points, read_removed, read_tracks
from ...core.matching.least_squares import MatchingSettings
from ...core.run_json import read_run
from ...core.settings import from_table
from ...core.take import open_take, read_take
from ...core.tracking.contour import Contour
from .. import folders, project

KEPT = 48  # things of single frames


@dataclass(eq=False, kw_only=True)
class Recording:
    """An OUT folder and the cameras of its views. Each thing is read once; a problem is kept as its sentence."""

    out: Path
    cameras: dict[str, Camera]
    reference: int
    rows_at: Callable[[int], RowGrid]
    patch_px: int
    problem: str = ""
    _read: OrderedDict[Any, Any] = field(default_factory=OrderedDict)

    def points(self, frame: int) -> FramePoints | None:
        """The points of a frame, if it has any."""
        return self.kept(("points", frame), lambda: read_points(self.out, frame, list(self.cameras.values()), self.rows_at(frame)))

    def removed(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """What the surface's filters took out of a frame."""
        found: tuple[np.ndarray, np.ndarray] = self.kept(("removed", frame), lambda: read_removed(self.out, frame))
        return found

    def tracks(self) -> TrackHistory | None:
        """All trajectories, if there are any."""
        return self.kept("tracks", lambda: read_tracks(self.out))

    def outline(self, view: str, frame: int) -> list[Any]:
        """The fitted body's outline."""
        return self.kept(("outline", view, frame), lambda: body_outline(self.out, frame, self.cameras[view])) or []

    def contours(self, view: str) -> Mapping[int, Contour]:
        """The tracked contours of a view, by frame."""
        return self.kept(f"contours of {view}", lambda: ContourTable(self.out / "contours" / f"{view}.csv")) or {}

    def contour(self, view: str, frame: int) -> Contour | None:
        """The tracked contour in a frame, if there is one."""
        return self.kept(("contour", view, frame), lambda: self.contours(view).get(frame))  # type: ignore[no-any-return]

    def table(self) -> FrameTable | None:
        """How good the frames are, if a run wrote that."""
        path = self.out / "frames.csv"
        return self.kept("table", lambda: read_frame_table(path) if path.is_file() else None)

    def has(self, key: Any) -> bool:
        """Whether something was read or made already."""
        return key in self._read

    def kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """What `make` gives, made once; None, and its sentence in `problem`, where the files are damaged."""
        if key not in self._read:
            try:
                self._read[key] = make()
            except InputError as error:
                self.problem, self._read[key] = str(error), None
            singles = [k for k in self._read if isinstance(k, tuple)]
            if len(singles) > KEPT:
                del self._read[singles[0]]
        elif isinstance(key, tuple):
            self._read.move_to_end(key)
        return self._read[key]


_current: dict[str, Any] = {"key": None, "recording": None, "problem": ""}


def current(scene: bpy.types.Scene) -> Recording | None:
    """The recording of a scene; None where nothing was run yet (`problem` says why)."""
    try:
        key = _key(scene)
    except InputError as error:
        _current.update(key=None, recording=None, problem=str(error))
        return None
    if key != _current["key"]:
        _current.update(key=key, recording=None, problem="")
        try:
            _current["recording"] = _open(scene)
        except InputError as error:
            _current["problem"] = str(error)
    found: Recording | None = _current["recording"]
    return found


def problem() -> str:
    """Why there is nothing to show, or what could not be read."""
    found = _current["recording"]
    return str(_current["problem"] or (found.problem if found is not None else ""))


def forget() -> None:
    """Read everything anew when it is asked for."""
    _current.update(key=None, recording=None, problem="")


def view_of(clip: bpy.types.MovieClip) -> str:
    """The name of the view that a clip shows, "" for other clips."""
    return str(clip.get(project.VIEW_KEY, ""))


def _key(scene: bpy.types.Scene) -> tuple[Any, ...]:
    folder, out = project.folder_of(scene), folders.output_folder("", scene)
    watched = [folder / "take.toml", folder / "rig.toml", *(out / name for name in ("run.json", "frames.csv", "contours"))]
    return folder, out, *(path.stat().st_mtime_ns if path.exists() else 0 for path in watched)


def _open(scene: bpy.types.Scene) -> Recording:
    folder, out = project.folder_of(scene), folders.output_folder("", scene)
    if not (out / "run.json").is_file():
        raise InputError("Nothing was measured yet.")
    footage, run = open_take(read_take(folder)), read_run(out / "run.json")
    matching = run.get("settings", {}).get("matching", {})
    patch = from_table(MatchingSettings, {name: v for name, v in matching.items() if name == "patch_px"}, "[matching] of run.json")
    cameras = {view.name: camera for view, camera in zip(footage.take.views, footage.rig.cameras)}
    return Recording(out=out, cameras=cameras, reference=footage.take.reference, rows_at=footage.take.rows_at, patch_px=patch.patch_px)
