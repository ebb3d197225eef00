"""Clicking joints or surface seeds, without events and drawing: the current joint, its clicks, and the proposals for them.

The clicks themselves are native tracking tracks and are read from there each time, so that this session, Blender's undo and moving a
marker with G never contradict each other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.geometry.intersection import intersect_clicks
from ...core.matching.foreground import around_clicks
from ...core.matching.proposals import Proposal, below_surface, epipolar_curve, where_rays_meet
from .. import clicks
from .finder import Answer, Finder, Question

ARMS = tuple(f"{joint}.{side}" for side in "RL" for joint in ("shoulder", "elbow", "wrist"))
LEGS = tuple(f"{joint}.{side}" for side in "RL" for joint in ("hip", "knee", "ankle", "toe"))
ORDER = ("head", "neck", *ARMS, "pelvis", *LEGS)
TRUNK = ("shoulder.R", "shoulder.L", "hip.R", "hip.L")
HIDDEN = ("chest", "spine", "clavicle.R", "clavicle.L")  # inside the trunk: hard to locate from outside


@dataclass
class _Action:
    """What undo needs: the current joint before an action, and the clicks (frame, name, view, pixel) that it replaced."""

    index: int
    before: list[tuple[int, str, str, list[float] | None]] = field(default_factory=list)
    skipped: str = ""  # the joint that it skipped


class ClickSession:
    """Clicks of `names`, one after the other, in the clips of all views (in the order of the cameras).

    `depths_m`: depths of the joints below the skin; names without one are on the surface.
    """

    def __init__(
        self,
        clips: Mapping[str, bpy.types.MovieClip],
        names: Sequence[str],
        frame: int,
        finder: Finder | None,
        depths_m: Mapping[str, float] | None = None,
    ) -> None:
        if not names:
            raise InputError("There is nothing to click. Choose a body in step 3 first.")
        self._clip_names = {view: clip.name for view, clip in clips.items()}  # undo replaces the objects
        self.names, self.frame, self.finder, self.depths_m = list(names), frame, finder, dict(depths_m or {})
        self.views = list(clips)
        self.index = 0
        self.proposals: dict[str, Proposal] = {}
        self.asking, self.problem = False, ""
        self._history: list[_Action] = []
        self._skipped: set[str] = set()
        self._proposed_for: dict[str, np.ndarray] = {}
        self.go_to_next(from_index=0)

    @property
    def clips(self) -> dict[str, bpy.types.MovieClip]:
        """The clip of every view.

        Raises:
            InputError: one was deleted or renamed meanwhile.
        """
        found = {view: bpy.data.movieclips.get(name) for view, name in self._clip_names.items()}
        for view, clip in found.items():
            if clip is None:
                raise InputError(f"The movie clip of view {view} was deleted or renamed while clicking. Earlier clicks are kept.")
        return found

    @property
    def endless(self) -> bool:
        """Whether surface seeds or single points are clicked, whose number is unlimited."""
        return any(kind.fullmatch(self.names[0]) for kind in (clicks.SURFACE_SEED, clicks.POINT))

    @property
    def has_all_clips(self) -> bool:
        """Whether all clips still exist under their names."""
        return all(name in bpy.data.movieclips for name in self._clip_names.values())

    def view_of(self, clip: bpy.types.MovieClip | None) -> str | None:
        """The view that a clip shows, None for other clips."""
        return next((view for view, name in self._clip_names.items() if clip is not None and clip.name == name), None)

    @property
    def name(self) -> str:
        """The current joint or seed; "" when all are done."""
        return self.names[self.index] if self.index < len(self.names) else ""

    @property
    def changed(self) -> bool:
        """Whether the session has changed a click."""
        return any(action.before for action in self._history)

    def clicks(self, name: str | None = None) -> dict[str, np.ndarray]:
        """The clicks of a joint (by default the current one) in this frame: view → pixel (2,)."""
        name = self.name if name is None else name
        found = {view: clicks.get_click(clip, name, self.frame) for view, clip in self.clips.items()} if name else {}
        return {view: np.array(xy) for view, xy in found.items() if xy is not None}

    def click(self, view: str, xy_px: np.ndarray, snap_px: float = 0.0) -> None:
        """Click the current joint; within `snap_px` of its proposal, the proposal is used."""
        if not self.name:
            return
        offer = self.proposals.get(view)
        if offer is not None and np.linalg.norm(offer.xy_px - xy_px) <= snap_px:
            xy_px = offer.xy_px
        self._put({view: xy_px})

    def accept(self) -> None:
        """Accept all proposals and go to the next joint; views that do not show the joint have no proposal."""
        if self.name and self.proposals:
            name = self.name
            self._put({view: offer.xy_px for view, offer in self.proposals.items()})
            if self.name == name:
                self.go_to_next(self.index + 1)
        elif self.name:
            self._leave(on_purpose=False)

    def skip(self) -> None:
        """Leave the current joint as it is and go to the next; it is not asked for again."""
        if self.name:
            self._leave(on_purpose=True)

    def _leave(self, *, on_purpose: bool) -> None:
        new = self.name if on_purpose and self.name not in self._skipped else ""
        self._history.append(_Action(index=self.index, skipped=new))
        if new:
            self._skipped.add(new)
        self.go_to_next(self.index + 1)

    def back(self) -> bool:
        """Undo the last action, or without one go to the previous joint. False if there is none."""
        if self._history:
            action = self._history.pop()
            self.index = action.index
            self._skipped.discard(action.skipped)
            for frame, name, view, xy in reversed(action.before):
                if xy is None:
                    clicks.remove_click(self.clips[view], name, frame)
                else:
                    clicks.set_click(self.clips[view], name, frame, (xy[0], xy[1]))
        elif self.index > 0:
            self.index -= 1
        else:
            return False
        self.propose()
        return True

    def go_to(self, name: str) -> None:
        """Make a joint the current one."""
        self.index = self.names.index(name)
        self.propose()

    def go_to_next(self, from_index: int) -> None:
        """Make the first joint from this index on that is neither clicked in two views nor skipped the current one; after the last, the
        first that is missing. All are done when each is clicked in two views or was skipped."""
        self.index = from_index
        while self.name and (self._is_complete(self.name) or self.name in self._skipped):
            self.index += 1
        if not self.name and not self.endless:
            self.index = next((i for i, name in enumerate(self.names) if name in self.missing()), len(self.names))
        self.propose()

    def _is_complete(self, name: str) -> bool:
        return len(self.clicks(name)) >= min(2, len(self.views))

    def missing(self, *, skipped: bool = False) -> dict[str, int]:
        """The joints that are not clicked in two views, with the number of views in which they are; with `skipped` also those skipped."""
        left = [name for name in self.names if not self._is_complete(name) and (skipped or name not in self._skipped)]
        return {name: len(self.clicks(name)) for name in left}

    def show_frame(self, frame: int) -> None:
        """Click in another frame from now on."""
        if frame != self.frame:
            self.frame = frame
            self._skipped.clear()
            self.go_to_next(0)

    def propose(self) -> None:
        """Ask for proposals that agree with the current clicks."""
        self.proposals, self.problem, self.asking = {}, "", False
        clicked = self._proposed_for = self.clicks()
        if self.finder is None or not clicked or len(clicked) == len(self.views):
            return
        if len(clicked) > 1:
            number = {self.views.index(view): xy for view, xy in clicked.items()}
            self._offer(where_rays_meet(self.finder.cameras, number, self.finder.click_sigma_px))
            return
        ((view, xy),) = clicked.items()
        at = self.views.index(view)
        self.asking = True
        self.finder.ask(Question(name=self.name, frame=self.frame, view=at, xy_px=xy, depth_range_m=self._depth_range(at)))

    def poll(self) -> bool:
        """Use the finder's answer once it has one, and notice markers that were moved; True when something changed."""
        now, before = self.clicks(), self._proposed_for
        if now.keys() != before.keys() or any(not np.array_equal(xy, before[view]) for view, xy in now.items()):
            self.propose()
            return True
        answer = self.finder.poll() if self.finder is not None else None
        return answer is not None and self.take_answer(answer)

    def take_answer(self, answer: Answer) -> bool:
        """Use an answer, if it belongs to the current click; True if it does."""
        asked, clicked = answer.question, self.clicks()
        here = clicked.get(self.views[asked.view])
        if (asked.name, asked.frame, len(clicked)) != (self.name, self.frame, 1) or here is None or not np.array_equal(here, asked.xy_px):
            return False
        self.asking, self.problem = False, answer.problem
        found = answer.proposals
        if self.finder is not None and self.name in self.depths_m:
            found = below_surface(self.finder.cameras, asked.view, asked.xy_px, found, self.depths_m[self.name])
        self._offer(found)
        return True

    def curves(self, view: str) -> dict[str, np.ndarray]:
        """The epipolar curves (M, 2) of the current joint's clicks in other views, by the view of the click."""
        if self.finder is None:
            return {}
        camera = dict(zip(self.views, self.finder.cameras))
        found = {other: epipolar_curve(camera[other], xy, camera[view]) for other, xy in self.clicks().items() if other != view}
        return {other: curve for other, curve in found.items() if len(curve) > 1}

    def next_view(self) -> str | None:
        """The first view in which the current joint is not clicked yet."""
        clicked = self.clicks()
        return next((view for view in self.views if view not in clicked), None) if self.name else None

    def _put(self, at: Mapping[str, np.ndarray]) -> None:
        action = _Action(index=self.index)
        for view, xy in at.items():
            clip = self.clips[view]
            inside = np.clip(xy, -0.5, np.array(clip.size) - 0.5)
            action.before.append((self.frame, self.name, view, clicks.get_click(clip, self.name, self.frame)))
            _select(clip, clicks.set_click(clip, self.name, self.frame, (float(inside[0]), float(inside[1]))))
        self._history.append(action)
        if len(self.clicks()) == len(self.views):
            self.go_to_next(self.index + 1)
        else:
            self.propose()

    def _offer(self, proposals: Sequence[Proposal | None]) -> None:
        clicked = self.clicks()
        self.proposals = {view: p for view, p in zip(self.views, proposals) if p is not None and view not in clicked}

    def _depth_range(self, view: int) -> tuple[float, float] | None:
        """The range of depths of the body in one camera, from the other joints that are clicked in this frame."""
        assert self.finder is not None
        cameras, depths = self.finder.cameras, []
        for name in self.names:
            at = self.clicks(name) if name != self.name else {}
            if len(at) > 1:
                clicked = [cameras[self.views.index(v)] for v in at]
                depths.append(float(cameras[view].to_camera(intersect_clicks(clicked, np.array([list(at.values())])).xyz_m)[0, 2]))
        valid = [depth for depth in depths if np.isfinite(depth) and depth > 0]
        return around_clicks(np.array(valid)).depth_range_m if valid else None


def _select(clip: bpy.types.MovieClip, track: bpy.types.MovieTrackingTrack) -> None:
    """Select only this track, so that G moves it."""
    for other in clip.tracking.tracks:
        other.select = other == track
    clip.tracking.tracks.active = track


def joints_of(model_joints: Sequence[str], *, hidden: bool = False) -> list[str]:
    """The joints of a model in the order in which they are clicked; those inside the trunk come last, if at all."""
    return [name for name in (*ORDER, *(HIDDEN if hidden else ())) if name in model_joints]


def needed_first(names: Sequence[str], needed: str) -> list[str]:
    """The joint that a fit asks for, then those of the trunk, which spare further questions, then all others."""
    return list(dict.fromkeys([needed, *(name for name in TRUNK if name in names), *names]))


def free_seed_names(clips: Mapping[str, bpy.types.MovieClip], frame: int, count: int = 200) -> list[str]:
    """Names for surface seeds: those clicked in one view only, then new ones."""
    taken = {
        name
        for name in (f"seed {i}" for i in range(1, count))
        if sum(clicks.get_click(clip, name, frame) is not None for clip in clips.values()) > 1
    }
    return [name for name in (f"seed {i}" for i in range(1, count)) if name not in taken]
