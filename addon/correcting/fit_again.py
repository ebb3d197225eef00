"""bpy.ops.tricap.fit_again(): the frames around the joints that were pulled or clicked since the fit are fitted again, in seconds."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.foundation.progress import Monitor
from .. import project
from ..editing import uncertainty
from ..editing.curves import replace_keys, sigma_curves
from ..operators.stages import Fit, StageOperator, run_and_read
from ..overlay import canvas, results
from ..retarget import base_layer
from ..scene import built, stored
from ..scene.action import place_sigmas
from ..scene.action_curves import curves_of
from ..scene.rest_pose import REST_POSE_KEY, with_rest_pose
from ..scene.standing import LIFT_KEY, MEASURED_KEY, Standing, all_bodies, controls_of_body

if TYPE_CHECKING:
    from ...core.run.around_clicks import FittedAgain


class FitAgain(StageOperator, bpy.types.Operator):
    """Fit the frames around the joints that you pulled or clicked since the fit. If more than that has changed, fit all frames"""

    bl_idname = "tricap.fit_again"
    bl_label = "Fit Again"
    bl_options = {"UNDO"}
    step, stages = Fit.step, Fit.stages
    take = out = ""  # those of the panel

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Any]:
        """Folders and settings as they are now; writes the project's take.toml.

        Raises:
            InputError: the new frames could not be put into what a control rig plays; nothing was computed.
        """
        for body, rig in _controlled(context.scene):
            base_layer.check_bakes(rig, body)
        take, out, overrides = project.chosen(context.scene, "", "")

        def compute(monitor: Monitor) -> Any:
            from ...core.run.around_clicks import fit_around_clicks

            found = fit_around_clicks(take, out, overrides, monitor)
            return found if found is not None else run_and_read(take, out, overrides, self.stages, False, monitor)

        return compute

    def finish(self, context: bpy.types.Context, result: Any) -> set[str]:
        """Move the keys of the body in the scene, and those of its control rig, and report."""
        if isinstance(result, tuple):
            return super().finish(context, result)
        for body in all_bodies(context.scene):
            move_keys(body, result)
            renew_sigmas(body, result)
        for body, rig in _controlled(context.scene):
            base_layer.bake_again(rig, body, result.frames)
        results.clear()
        uncertainty.forget()
        _mark_again(context.scene)
        canvas.redraw_clips(context)
        context.scene.frame_set(context.scene.frame_current)
        self.report({"INFO"}, f"{result} Fit Body also adjusts the shape.")
        for _, rig in _controlled(context.scene):
            self.report({"INFO"}, f"The base layer of “{rig.name}” plays these frames as they are now; its corrections are as before.")
        return {"FINISHED"}


def _mark_again(scene: bpy.types.Scene) -> None:
    """Let the markers in the timeline be those of the new results."""
    from ..scene.build import mark_doubtful
    from ..scene.contents import doubtful_in

    if (run := results.current(scene)) is not None:
        mark_doubtful(scene, doubtful_in(run.out, []))


def _controlled(scene: bpy.types.Scene) -> list[tuple[bpy.types.Object, bpy.types.Object]]:
    """The bodies that a control rig drives, each with it."""
    return [(body, rig) for body in all_bodies(scene) if (rig := controls_of_body(body)) is not None]


def move_keys(body: bpy.types.Object, again: "FittedAgain") -> None:
    """Add what the new fit changed to the actions of a body: the measured one, and the edited one with its edits."""
    from ..scene.armature import channel_of

    before, after = (with_rest_pose(again.shape, values, again.sigma, _pose_of(body))[1] for values in (again.before, again.after))
    change = {name: column for name, column in zip(again.dof_names, (after - before).T) if np.abs(column).max() > 0}
    lift_m = stored.number(body.data, LIFT_KEY)
    stand = Standing(lift_m=lift_m, floor_m=body.location.z) if lift_m is not None else None
    channels = channel_of(again.shape, stand)
    moved = {(f'pose.bones["{c.bone}"].{c.path}', c.index): c.sign * change[name] for name, c in channels.items() if name in change}
    measured = stored.data_block(body, MEASURED_KEY, bpy.types.Action)
    actions = {action for action in (body.animation_data and body.animation_data.action, measured) if action is not None}
    with built.no_edit(actions):
        for curve in (curve for action in actions for curve in curves_of(action)):
            if (curve.data_path, curve.array_index) in moved:
                before = np.array([curve.evaluate(frame) for frame in again.frames])
                replace_keys(curve, again.frames, before + moved[curve.data_path, curve.array_index])


def renew_sigmas(body: bpy.types.Object, again: "FittedAgain") -> None:
    """Give the sigmas of a body, those of its angles and of the places of its bones, the values of the new fit in its frames."""
    shape, _, sigma = with_rest_pose(again.shape, again.after, again.sigma, _pose_of(body))
    new = dict(zip(again.dof_names, sigma.T)) | place_sigmas(shape, again.joints, again.frames)
    curves = sigma_curves(body)
    with built.no_edit({curve.id_data for curve in curves.values()}):
        for name, curve in curves.items():
            values = new.get(name.removeprefix("sigma "))
            if values is not None:
                replace_keys(curve, again.frames, values)


def _pose_of(body: bpy.types.Object) -> str:
    """The rest pose with which a body was built."""
    return "T" if body.data.get(REST_POSE_KEY) == "T" else "A"


CLASSES = (FitAgain,)
