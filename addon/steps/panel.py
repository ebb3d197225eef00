"""The panel “Tricap” in the sidebar of the 3-D view: eight numbered steps, each with its state, and the next one. draw() only draws."""

import bpy

from ..panels import TricapPanel, sentence
from ..project import is_sample
from . import bodies, check, watch
from .states import STEPS, TITLES, State, Status, is_rate_assumed

ICONS = {
    Status.EMPTY: "RADIOBUT_OFF",
    Status.READY: "PLAY",
    Status.RUNNING: "SORTTIME",
    Status.DONE: "CHECKMARK",
    Status.STALE: "FILE_REFRESH",
    Status.ASKS: "QUESTION",
    Status.FAILED: "ERROR",
}
LABELS = {
    Status.EMPTY: "not ready",
    Status.READY: "ready",
    Status.RUNNING: "running",
    Status.DONE: "done",
    Status.STALE: "out of date",
    Status.ASKS: "click needed",
    Status.FAILED: "failed",
}


class TRICAP_UL_views(bpy.types.UIList):
    """The views, in the order of the cameras from left to right."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Name and offset."""
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False, icon="CAMERA_DATA" if item.clip is not None else "ERROR")
        row.prop(item, "offset_frames", text="Offset")


class TRICAP_PT_main(TricapPanel, bpy.types.Panel):
    """From footage to a rig that moves."""

    bl_label = "Tricap"

    def draw(self, context: bpy.types.Context) -> None:
        """The next or the running step, then all steps."""
        layout, job = self.layout, context.window_manager.tricap
        if job.running:
            draw_job(layout, context)
        if not job.blocks:
            draw_next(layout, context)
        for step in STEPS:
            self.draw_step(context, step)

    def draw_step(self, context: bpy.types.Context, step: str) -> None:
        """One step: its number, name and status; unfolded, its message and its buttons."""
        state, now = watch.state_of(context, step), watch.current(context.scene)
        header, body = self.layout.panel_prop(context.window_manager.tricap_steps, step)
        is_next = step == now.next and state.status in (Status.READY, Status.EMPTY)
        header.label(text=f"{STEPS.index(step) + 1}  {TITLES[STEPS.index(step)]}", icon=ICONS[Status.READY if is_next else state.status])
        right = header.row()
        doubtful = state.doubtful or (step == "cameras" and check.is_doubtful(context.scene))
        right.alignment, right.alert = "RIGHT", doubtful or state.status in (Status.FAILED, Status.STALE)
        right.label(text=f"{'next' if is_next else 'doubtful' if doubtful else LABELS[state.status]} ")
        if body is None:
            return
        column = body.column()
        if state.message and state.status != Status.RUNNING:
            draw_message(column, context, state)
        column.enabled = not context.window_manager.tricap.blocks
        column.use_property_split, column.use_property_decorate = True, False
        bodies.DRAW[step](column, context, step == now.next)
        bodies.advanced(body, context, step)


def draw_message(layout: bpy.types.UILayout, context: bpy.types.Context, state: State) -> None:
    """The message of a state."""
    rows = layout.column()
    rows.alert = state.status == Status.FAILED
    sentence(rows, context, state.message)


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The running job: its stage, progress, time left, and a button to stop it."""
    job = context.window_manager.tricap
    layout.progress(factor=job.progress, text=f"{job.stage.capitalize()}  {job.progress:.0%}  {job.left}", type="BAR")
    layout.operator("tricap.cancel", icon="X", text="Cancel (Esc)")


def draw_next(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The next step; in an empty file also the sample."""
    now, box = watch.current(context.scene), layout.box()
    if now.states["footage"].status == Status.EMPTY:
        sentence(box, context, "Next: 1 Footage. Or try the sample first:", "INFO")
        bodies.offer(box, "tricap.load_sample", icon="PLAY")
    elif now.next is None:
        sentence(box, context, "All steps are done. Press Space to play the animation.", "CHECKMARK")
    else:
        number = STEPS.index(now.next)
        plays = ". Press Space to play the motion." if now.next == STEPS[-1] else ""
        sentence(box, context, f"Next: {number + 1} {TITLES[number]}{plays}", "FORWARD")
    if doubtful := [f"{n} {title}" for n, (step, title) in enumerate(zip(STEPS, TITLES), 1) if now.states[step].doubtful]:
        rows = box.column()
        rows.alert = True
        sentence(
            rows, context, f"Doubtful: {', '.join(doubtful)}. Unfold {'it' if len(doubtful) == 1 else 'them'} for the reason.", "ERROR"
        )
    if now.next == "surface":  # seen before the run: steps 1 and 3 may be done and folded
        if is_rate_assumed(context.scene):
            row = box.row()
            row.alert = True
            row.prop(context.scene.tricap, "fps", text="FPS of the Images")
        box.prop(context.scene.tricap, "model", text="Body")
    if now.can_run:
        bodies.primary(box, "tricap.run", True, icon="FF", text="Run Remaining Steps")
    if is_sample(context.scene):
        box.operator("tricap.compute_sample", icon="FILE_REFRESH")


CLASSES = (TRICAP_UL_views, TRICAP_PT_main)
