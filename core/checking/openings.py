"""What a run refuses although its footage and rig are in order: settings, the body and its keypoints, the silhouettes of the views."""

from collections.abc import Callable

import numpy as np

from ..fitting.inputs.take_inputs import check_body, read_source
from ..fitting.settings import FitSettings
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..take.footage import Footage
from ..take.person_masks import check_mask, silhouette_files, silhouettes
from ..take.sources import KeypointSource, read_picture
from .findings import Cause, Finding, doubtful, wrong
from .places import place_findings
from .survey import LONGEST

LAST_IMAGES = 50  # of a view; with a clock, not every one of them is that of a frame
MORE_FRAMES = 1.5  # times those of the footage: keypoints of so many are of another recording or rate


def opening_findings(footage: Footage, fitting: FitSettings, monitor: Monitor) -> list[Finding]:
    """Every file and value that the stages of a run read besides the images: one finding for each of the first faults of a kind."""
    checks: list[Callable[[], object]] = [lambda: check_body(footage, fitting)]
    checks += [lambda k=k: _check_silhouettes(footage, k, monitor) for k in range(len(footage.take.views))]  # type: ignore[misc]
    checks.append(lambda: _silhouettes_of_first(footage))
    findings = list[Finding]()
    checks += [lambda source=source: findings.extend(_keypoint_doubts(footage, source)) for source in footage.take.keypoints]  # type: ignore[misc]
    for check in checks:
        monitor.check()
        try:
            check()
        except InputError as error:
            if str(error) not in [finding.sentence for finding in findings]:
                findings.append(wrong(Cause.INPUT, str(error)))
    return findings or place_findings(footage, fitting, monitor)


def _keypoint_doubts(footage: Footage, source: KeypointSource) -> list[Finding]:
    """A doubt where the keypoints of a view go on far beyond its last image.

    Raises:
        InputError: they cannot be used.
    """
    last = int(read_source(footage, source).frame.max())
    if not source.view:
        return []
    view = [view.name for view in footage.take.views].index(source.view)
    images = np.arange(footage.sequences[view].count)
    end = int(footage.frames_of_images(view, images[-LAST_IMAGES:]).max())
    if last <= MORE_FRAMES * max(end, 1):
        return []
    sentence = f"The keypoints “{source.files}” go on to frame {last}, and the footage ends with frame {end}."
    return [doubtful(Cause.FRAME_RATE, sentence, "Are they of the same recording, at the same number of images per second?")]


def _silhouettes_of_first(footage: Footage) -> None:
    frame = footage.frames.start
    rows = footage.take.rows_at(frame)
    silhouettes(footage, [rows.rows(image) for image in footage.read(frame)], frame, first=True)


def _check_silhouettes(footage: Footage, view: int, monitor: Monitor) -> None:
    """Find the silhouette's file of a view for every frame, and read those of at most LONGEST frames over the whole take.

    Raises:
        InputError: one is missing or unusable.
    """
    given, paths = footage.take.views[view], silhouette_files(footage, view, footage.frames)
    chosen = paths[:: max(1, -(-len(paths) // LONGEST))]
    somebody = not chosen
    for n, path in enumerate(chosen):
        monitor.step(f"checking the masks of {given.name}", n, len(chosen))
        picture = read_picture(path, given.name, footage.sizes_px[view])
        if given.background is None:
            check_mask(picture, path, of_all=given.masks is None)
        somebody = somebody or bool(picture.any())
    if not somebody and given.masks is not None:
        raise InputError(f"All masks of view {given.name} are black; paint the person white, or remove `masks` from take.toml.")
