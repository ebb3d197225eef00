"""The coarse surface of each frame (`matching.semi_global`), about the person whom the measured cloud shows; each frame is a checkpoint."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..foundation import store
from ..foundation.arrays import LazySequence
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.threads import THREADS, in_threads
from ..matching.semi_global import NO_SURFACE, CoarseSurface, coarse_surface
from ..results.folder import Results
from ..take.footage import Footage
from .cloud import PointCloud
from .starts import image_digests, measured_rows

ALGORITHM = "coarse 2"  # part of every key: raise it when the same input gives other points
FEWEST = 50  # points of a cloud that show where the person is; a frame with fewer has no coarse surface
STAGE = "coarse surface"


def coarse_surfaces(footage: Footage, clouds: Sequence[PointCloud], results: Results, monitor: Monitor) -> Sequence[CoarseSurface]:
    """The coarse surfaces of the clouds' frames, each read from its checkpoint on access; a frame that was matched before is not again.

    Raises:
        InputError: the images cannot be read.
        Cancelled: the frames that were matched have their checkpoints.
    """
    keys, todo = dict[int, str](), list[tuple[int, np.ndarray]]()
    for cloud in clouds:
        monitor.check()
        if len(cloud.xyz_m) < FEWEST:
            continue
        keys[cloud.frame] = store.digest(ALGORITHM, *_depends_on(footage, cloud))
        if results.load_checkpoint("coarse", f"{cloud.frame:04d}", keys[cloud.frame]) is None:
            todo.append((cloud.frame, cloud.xyz_m))

    def match(read: _Images) -> CoarseSurface:
        rows = footage.take.rows_at(read.frame)
        return coarse_surface(read.images, footage.rig.cameras, footage.take.reference, read.about_m, rows)

    for i in range(0, len(todo), THREADS):
        monitor.step(STAGE, i, len(todo))
        part = [_Images(frame=frame, about_m=about, images=measured_rows(footage, frame)) for frame, about in todo[i : i + THREADS]]
        for read, found in zip(part, in_threads(match, part)):
            arrays = {name: getattr(found, name).astype(np.float32) for name in ("xyz_m", "normals", "sigma_m")}
            results.save_checkpoint("coarse", f"{read.frame:04d}", keys[read.frame], arrays)

    def of_frame(cloud: PointCloud) -> CoarseSurface:
        if cloud.frame not in keys:
            return NO_SURFACE
        arrays = results.load_checkpoint("coarse", f"{cloud.frame:04d}", keys[cloud.frame])
        if arrays is None:
            raise InputError(f"The checkpoint of frame {cloud.frame} in {results.path('cache', 'coarse')} was deleted. Run again.")
        return CoarseSurface(**arrays)

    return LazySequence(clouds, of_frame)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Images:
    """What a frame is matched from: the rows of all views, and the points that show where the person is."""

    frame: int
    about_m: np.ndarray  # (N, 3)
    images: Sequence[np.ndarray]


def _depends_on(footage: Footage, cloud: PointCloud) -> list[bytes | str | Path]:
    """Everything that a frame's coarse surface depends on."""
    take, frame = footage.take, cloud.frame
    delays = [footage.delay(k, frame) for k in range(len(take.views))]
    place = repr((take.reference, take.rows_at(frame), delays, footage.reduction.tolist()))
    return [take.rig_path, place, cloud.xyz_m.tobytes(), *image_digests(footage, frame)]
