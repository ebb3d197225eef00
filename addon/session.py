"""What the add-on remembers while Blender runs: one `Session`, made when the add-on is registered and dropped when it is unregistered.

What belongs to the open file is in `Session.file`, which begins anew when another file is loaded. No other module of the add-on has
state of its own. Every other module imports this one, so it imports none of them: their types are named in comments.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Event
from typing import TYPE_CHECKING, Any

import bpy

if TYPE_CHECKING:
    from ..core.images.sequence import ImageSequence
    from ..core.take.writing import Table

TakePart = Callable[[bpy.types.Scene, "Table"], None]


@dataclass(eq=False, kw_only=True)
class OpenResults:
    """The results that the overlays show, with the key of the files that they were read from; or why there are none."""

    key: tuple[Any, ...] | None = None
    results: Any = None  # overlay.results.RunResults
    problem: str = ""


@dataclass(eq=False, kw_only=True)
class FileState:
    """What belongs to the open file."""

    changed: bool = True  # something changed in a scene since the states of its steps were computed
    step_states: dict[str, Any] = field(default_factory=dict)  # by scene: steps.states.StepStates
    stamps: dict[str, Any] = field(default_factory=dict)  # by scene: times and sizes of the files on which these states depend
    step_ends: dict[tuple[str, str], Any] = field(default_factory=dict)  # by scene and step: how it failed or was stopped (StepEnd)
    take_problem: str = ""  # why the take of a scene built by the command is not shown
    sequences: "dict[tuple[Any, ...], ImageSequence]" = field(default_factory=dict)  # the opened footage, by file
    digests: Any = None  # core.run.file_digests.FileDigests of the footage, once they were needed
    joints: dict[str, tuple[str, ...]] = field(default_factory=dict)  # those to click, by body model
    click_problems: dict[tuple[Any, ...], str] = field(default_factory=dict)  # by joint, clicks and cameras; "" where there is none
    mends: dict[str, Any] = field(default_factory=dict)  # by checked input: what its check found that a press mends (steps.check.Mends)
    checked_keys: set[str] = field(default_factory=set)  # inputs for which a check began by itself
    # by view and target: images searched, and images that show it:
    bar_counts: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)
    open_results: OpenResults = field(default_factory=OpenResults)
    inspection: tuple[int, Any] = (-1, None)  # the frame, and what is under the pointer in it (overlay.layers.Inspection)
    inspecting: bool = False  # the modal operator of the inspection runs
    uncertainty: tuple[Any, Any] = ((), None)  # what is shown of the body's motion: its key, and the sigmas by bone
    correcting: bool = False  # a modal operator of the corrections runs
    region_corners: tuple[str, list[tuple[float, float]]] = ("", [])  # the view, and the corners clicked so far
    pulled: Any = None  # the limb whose joint is being dragged (overlay.layers.Pulled)


def _set() -> Event:
    event = Event()
    event.set()
    return event


@dataclass(eq=False, kw_only=True)
class Session:
    """What the add-on remembers."""

    file: FileState = field(default_factory=FileState)
    job: Any = None  # the jobs.Job that computes on the worker thread
    may_run: Event = field(default_factory=_set)  # not set while an operator has to be alone (alone.py)
    job_waits: Event = field(default_factory=Event)  # … and the job has noticed it
    job_operator: Any = None  # the modal operator that watches it (jobs.JobOperator)
    click_operator: Any = None  # the modal operator of the clicks (clicking.operators)
    click_drawing: Any = None  # clicking.draw.Drawing
    finders: list[Any] = field(default_factory=list)  # the clicking.finder.Finder whose threads run
    overlay_handle: Any = None  # Blender's handle of what draws the overlays
    uncertainty_handles: list[Any] = field(default_factory=list)  # Blender's handles of what draws the uncertainty, with their spaces
    cli_command: Any = None  # Blender's handle of `blender --command tricap`
    status_workspaces: set[str] = field(default_factory=set)  # those whose status bar shows our text
    take_digests: set[str] = field(default_factory=set)  # of every take.toml that was read or written
    property_groups: list[type] = field(default_factory=list)  # of the scene, in order of registration
    on_job_end: list[Callable[..., None]] = field(default_factory=list)  # jobs.JobEnded
    on_value_change: list[Callable[[], None]] = field(default_factory=list)  # a value of the panel was changed
    take_writers: list[TakePart] = field(default_factory=list)  # the scene's values into the table of take.toml
    take_readers: list[TakePart] = field(default_factory=list)  # and back


_session: Session | None = None


def get_session() -> Session:
    """The session; without a registered add-on (in scripts) it begins when it is first asked for."""
    global _session
    if _session is None:
        _session = Session()
    return _session


@bpy.app.handlers.persistent
def _begin_file(*_: Any) -> None:
    get_session().file = FileState()


def register() -> None:
    """Begin a session."""
    global _session
    _session = Session()
    bpy.app.handlers.load_post.append(_begin_file)


def unregister() -> None:
    """Drop the session."""
    global _session
    bpy.app.handlers.load_post.remove(_begin_file)
    _session = None
