"""Finds the proposals of a click on a thread of its own, so that the window stays responsive while images are matched. Without bpy."""

import logging
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.foundation.errors import InputError
from ...core.geometry.camera import Camera
from ...core.images.sampling import SplineImage
from ...core.matching.least_squares import MatchingSettings
from ...core.matching.proposals import Proposal, propose
from ...core.matching.views import Views
from ...core.take.footage import Footage
from ..session import get_session

log = logging.getLogger(__name__)

CACHED_FRAMES = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """A click for which proposals are wanted."""

    name: str
    frame: int
    view: int
    xy_px: np.ndarray  # (2,)
    depth_range_m: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer:
    """The proposals, one or None per view, or the reason why there are none."""

    question: Question
    proposals: tuple[Proposal | None, ...]
    problem: str = ""


class Finder:
    """Answers one question at a time; a new question replaces one that still waits."""

    def __init__(self, footage: Footage, settings: MatchingSettings) -> None:
        self._footage, self._settings = footage, settings
        self._images: dict[int, list[SplineImage]] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="tricap proposals")
        self._pending: Future[Answer] | None = None
        get_session().finders.append(self)

    @property
    def cameras(self) -> Sequence[Camera]:
        """The cameras in the order of the views."""
        return self._footage.rig.cameras

    @property
    def click_sigma_px(self) -> float:
        """How exactly joints are clicked."""
        return self._footage.click_sigma_px

    def prepare(self, frame: int) -> None:
        """Read and prepare the images of a frame, before the first click."""
        self._pool.submit(self._load, frame)

    def ask(self, question: Question) -> None:
        """Find the proposals of a click; `poll` returns them."""
        if self._pending is not None:
            self._pending.cancel()
        self._pending = self._pool.submit(self._answer, question)

    def poll(self) -> Answer | None:
        """The answer to the latest question, once, as soon as it is known."""
        if self._pending is None or not self._pending.done() or self._pending.cancelled():
            return None
        answer, self._pending = self._pending.result(), None
        return answer

    def wait(self) -> Answer | None:
        """The answer to the latest question, however long it takes."""
        if self._pending is not None and not self._pending.cancelled():
            self._pending.result()
        return self.poll()

    def finish(self, seconds: float) -> None:
        """Wait until nothing is computed, at most for some seconds."""
        wait([self._pool.submit(int)], seconds)

    def close(self) -> None:
        """End the thread after its current computation (well below a second)."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        if self in (open_finders := get_session().finders):
            open_finders.remove(self)

    def _answer(self, question: Question) -> Answer:
        nothing: tuple[Any, ...] = (None,) * len(self.cameras)
        try:
            images = self._load(question.frame)
            rows, asked = self._footage.take.rows_at(question.frame), question
            views = Views(images=images, cameras=self.cameras, reference=asked.view, rows=rows)
            found = propose(views, asked.xy_px, self._settings, asked.depth_range_m)
        except InputError as error:
            return Answer(question=question, proposals=nothing, problem=str(error))
        except Exception as error:  # the edge of the thread: an error in here must not cost a click
            log.exception("No proposals for %s.", question.name)
            return Answer(question=question, proposals=nothing, problem=f"Internal error ({error}); see the system console.")
        return Answer(question=question, proposals=found)

    def _load(self, frame: int) -> list[SplineImage]:
        if frame not in self._images:
            while len(self._images) >= CACHED_FRAMES:
                self._images.pop(next(iter(self._images)))
            rows = self._footage.take.rows_at(frame)
            self._images[frame] = [SplineImage(rows.rows(image)) for image in self._footage.read(frame)]
        return self._images[frame]


def close_all(*_: Any) -> None:
    """End all threads (another file is loaded, Blender quits, the add-on is disabled)."""
    for finder in list(get_session().finders):
        finder.close()
