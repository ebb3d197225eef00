"""The results that are shown: a run's folder, its cameras, and what was read from it, cached until the files change."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.foundation.settings import from_table
from ...core.geometry.camera import Camera
from ...core.images.interlace import RowGrid
from ...core.matching.least_squares import MatchingSettings
from ...core.results.run_json import read_run
from ...core.take.footage import open_take
from ...core.take.take import read_take
from ...core.tracking.contour import Contour, ContourTable
from .. import folders, project
from ..session import OpenResults, get_session

if TYPE_CHECKING:
    from ...core.run.inspection import FramePoints, TrackHistory
    from ...core.run.record import FrameTable
    from ...core.tracking.point_tables import KeyPointTable

POINTS = ("points3d.csv", "points2d.csv")  # tables of single points
CACHED_FRAMES = 48  # things of single frames that are cached at most


@dataclass(eq=False, kw_only=True)
class RunResults:
    """The results in OUT and the cameras of its views. Each file is read once; `problem` is why one could not be read."""

    out: Path
    cameras: dict[str, Camera]
    reference: int
    rows_at: Callable[[int], RowGrid]
    patch_px: int
    problem: str = ""
    _read: OrderedDict[Any, Any] = field(default_factory=OrderedDict)

    def points(self, frame: int) -> "FramePoints | None":
        """The points of a frame, if it has any."""
        from ...core.run.inspection import read_points

        return self.cached(("points", frame), lambda: read_points(self.out, frame, list(self.cameras.values()), self.rows_at(frame)))

    def removed(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (M, K, 2) of the points that the surface's filters removed from a frame, and which filter did (M,)."""
        from ...core.run.inspection import read_removed

        found: tuple[np.ndarray, np.ndarray] = self.cached(("removed", frame), lambda: read_removed(self.out, frame))
        return found

    def tracks(self) -> "TrackHistory | None":
        """All trajectories, if there are any."""
        from ...core.run.inspection import read_tracks

        return self.cached("tracks", lambda: read_tracks(self.out))

    def chosen(self) -> "KeyPointTable | None":
        """The single points that were followed, if there are any."""
        from ...core.tracking.point_tables import read_key_points

        space, images = (self.out / name for name in POINTS)
        return self.cached("chosen", lambda: read_key_points(space, images) if space.is_file() and images.is_file() else None)  # type: ignore[no-any-return]

    def outline(self, view: str, frame: int) -> list[Any]:
        """The fitted body's outline."""
        from ...core.run.inspection import body_outline

        return self.cached(("outline", view, frame), lambda: body_outline(self.out, frame, self.cameras[view])) or []

    def contours(self, view: str) -> Mapping[int, Contour]:
        """The tracked contours of a view, by frame."""
        tables = [self.out / folder / f"{view}.csv" for folder in ("contours", "outlines")]  # of the user, and of the fit's loop
        path = next((table for table in tables if table.is_file()), tables[0])
        return self.cached(f"contours of {view}", lambda: ContourTable(path)) or {}

    def contour(self, view: str, frame: int) -> Contour | None:
        """The tracked contour in a frame, if there is one."""
        return self.cached(("contour", view, frame), lambda: self.contours(view).get(frame))  # type: ignore[no-any-return]

    def table(self) -> "FrameTable | None":
        """The quality of the frames, if a run wrote it."""
        from ...core.run.record import read_frame_table

        path = self.out / "frames.csv"
        return self.cached("table", lambda: read_frame_table(path) if path.is_file() else None)

    def doubt(self) -> tuple[np.ndarray, tuple[str, ...]]:
        """How doubtful the frames of the table are (T,), and why, "" unless they are; empty without a table."""
        from ...core.motion.tables import read_guessed
        from ...core.run.record import doubt

        table, joints = self.table(), self.out / "joints.csv"
        guessed = self.cached("guessed", lambda: read_guessed(joints) if joints.is_file() else {})
        if table is None:
            return np.zeros(0), ()
        return self.cached("doubt", lambda: doubt(table, guessed or {}))  # type: ignore[no-any-return]

    def has(self, key: Any) -> bool:
        """Whether something is cached."""
        return key in self._read

    def cached(self, key: Any, make: Callable[[], Any]) -> Any:
        """The result of `make`, made once; None where the files are damaged, with the reason in `problem`."""
        if key not in self._read:
            try:
                self._read[key] = make()
            except InputError as error:
                self.problem, self._read[key] = str(error), None
            singles = [k for k in self._read if isinstance(k, tuple)]
            if len(singles) > CACHED_FRAMES:
                del self._read[singles[0]]
        elif isinstance(key, tuple):
            self._read.move_to_end(key)
        return self._read[key]


def current(scene: bpy.types.Scene) -> RunResults | None:
    """The results of a scene's project; None where there are none (`problem` has the reason)."""
    file = get_session().file
    try:
        key = _key(scene)
    except InputError as error:
        file.open_results = OpenResults(problem=str(error))
        return None
    if key != file.open_results.key:
        file.open_results = OpenResults(key=key)
        try:
            file.open_results.results = _open(scene)
        except InputError as error:
            file.open_results.problem = str(error)
    return file.open_results.results


def problem() -> str:
    """Why there is nothing to show, or which file could not be read."""
    now = get_session().file.open_results
    return now.problem or (now.results.problem if now.results is not None else "")


def clear() -> None:
    """Empty the cache: everything is read again when it is needed."""
    get_session().file.open_results = OpenResults()


def view_of(clip: bpy.types.MovieClip) -> str:
    """The name of the view that a clip shows, "" for other clips."""
    return str(clip.get(project.VIEW_KEY, ""))


def _key(scene: bpy.types.Scene) -> tuple[Any, ...]:
    folder, out = project.folder_of(scene), folders.output_folder("", scene)
    watched = [
        folder / "take.toml",
        folder / "rig.toml",
        *(out / name for name in ("run.json", "frames.csv", "joints.csv", "contours", "outlines", "points2d.csv")),
    ]
    return folder, out, *(path.stat().st_mtime_ns if path.exists() else 0 for path in watched)


def _open(scene: bpy.types.Scene) -> RunResults:
    folder, out = project.folder_of(scene), folders.output_folder("", scene)
    if not (out / "run.json").is_file() and not (out / POINTS[0]).is_file():
        raise InputError("Nothing was measured yet.")
    footage = open_take(read_take(folder))
    run = read_run(out / "run.json") if (out / "run.json").is_file() else {}  # single points are followed without a run
    matching = run.get("settings", {}).get("matching", {})
    patch = from_table(MatchingSettings, {name: v for name, v in matching.items() if name == "patch_px"}, "[matching] of run.json")
    cameras = {view.name: camera for view, camera in zip(footage.take.views, footage.rig.cameras)}
    return RunResults(out=out, cameras=cameras, reference=footage.take.reference, rows_at=footage.take.rows_at, patch_px=patch.patch_px)
