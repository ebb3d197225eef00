"""An animator's work on a body that is built again: its place, its path, its foot lock, its control rig and its edits."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import bpy
from mathutils import Euler, Vector

from ...core.foundation.errors import InputError
from ..retarget.control_rig import LOCKED_KEY
from ..retarget.controls_again import Controls, make_again, remember
from ..scene import built, standing
from ..scene.earlier import built_collections
from . import foot_lock


@dataclass(frozen=True, eq=False, kw_only=True)
class Work:
    """What was done with a body."""

    path: standing.Path
    location: Vector  # its height is that of the floor
    rotation: Euler
    scale: Vector
    locked: bool  # the feet
    controls: Controls | None

    @staticmethod
    def of(scene: bpy.types.Scene) -> "Work | None":
        """That with the body of an earlier build; None without one."""
        body = _built_body(scene)
        if body is None:
            return None
        path = standing.path_of(scene)
        return Work(
            path=path,
            location=(body.delta_location if path == standing.Path.OBJECT else body.location).copy(),
            rotation=body.rotation_euler.copy(),
            scale=body.scale.copy(),
            locked=bool(body.get(LOCKED_KEY)) or foot_lock.is_active(body),
            controls=remember(body),
        )

    def again(self, scene: bpy.types.Scene, edited: Sequence[bpy.types.Action]) -> Iterator[tuple[str, str]]:
        """Do it again with the body that was built in its place; gives sentences, each with its kind. `edited`: actions that are kept."""
        body, played = _built_body(scene), set[bpy.types.Action]()
        if body is not None:
            body.location.xy, body.rotation_euler, body.scale = self.location.xy, self.rotation, self.scale
            if self.path != standing.Path.BONE:
                standing.carry_path(scene, self.path)
            yield from self._locked(body)
        if self.controls is not None:
            yield self._controls(body, played)
        if left := [f"“{action.name}”" for action in edited if action not in played]:
            one = len(left) == 1
            yield (
                "WARNING",
                f"What you edited in the earlier motion is kept as the action{'' if one else 's'} {', '.join(left)}; in the Action Editor "
                f"{'it' if one else 'one'} can be played instead of the new motion.",
            )

    def _locked(self, body: bpy.types.Object) -> Iterator[tuple[str, str]]:
        if self.locked:
            try:
                yield "INFO", f"The feet are locked in the new motion, too. {foot_lock.lock_feet(body)}"
            except InputError as error:
                yield "WARNING", f"The feet are no longer locked: {error}"

    def _controls(self, body: bpy.types.Object | None, played: set[bpy.types.Action]) -> tuple[str, str]:
        assert self.controls is not None
        name = self.controls.name
        if body is None:
            return "WARNING", f"The control rig “{name}” went with the earlier body."
        try:
            rig = make_again(body, self.controls)
        except InputError as error:
            return "WARNING", f"The control rig “{name}” went with the earlier body, and could not be made again: {error}"
        base = built.actions_of(rig)
        played |= base
        layers = any(built.is_edited(action) for action in base)
        return "INFO", f"The control rig “{rig.name}” plays the new motion{', with your corrections over it' if layers else ''}."


def _built_body(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The body of a build, not a copy of it; None without one."""
    inside = {thing for collection in built_collections(scene) for thing in collection.all_objects}
    bodies = [body for body in standing.all_bodies(scene) if body in inside]
    return next((body for body in bodies if built.is_own(body)), bodies[0] if bodies else None)
