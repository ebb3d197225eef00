"""The panel “Tricap” in the sidebar of the 3-D view: eight numbered steps, each with its state, and what is next. draw() only draws."""

import bpy

from ..panels import TricapPanel, sentence
from . import bodies, watch
from .states import STAGE, STEPS, TITLES, State

ICONS = {"empty": "RADIOBUT_OFF", "ready": "PLAY", "running": "SORTTIME", "done": "CHECKMARK", "stale": "FILE_REFRESH", "failed": "ERROR"}


class TRICAP_UL_views(bpy.types.UIList):
    """The views in the order in which the cameras stand."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Name and offset."""
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False, icon="CAMERA_DATA" if item.clip is not None else "ERROR")
        row.prop(item, "offset_frames", text="Offset")


class TRICAP_PT_main(TricapPanel, bpy.types.Panel):
    """From footage to a rig that moves."""

    bl_label = "Tricap"

    def draw(self, context: bpy.types.Context) -> None:
        """What is next or running, then the steps."""
        layout, job = self.layout, context.window_manager.tricap
        if job.running:
            draw_job(layout, context)
        else:
            draw_next(layout, context)
        for step in STEPS:
            self.draw_step(context, step)

    def draw_step(self, context: bpy.types.Context, step: str) -> None:
        """One step: its number, name and state; unfolded, why it is so and what can be done."""
        state, now = watch.state_of(context, step), watch.look(context.scene)
        header, body = self.layout.panel_prop(context.window_manager.tricap_steps, step)
        is_next = step == now.next and state.word in ("ready", "empty")
        header.label(text=f"{STEPS.index(step) + 1}  {TITLES[STEPS.index(step)]}", icon=ICONS["ready" if is_next else state.word])
        word = header.row()
        word.alignment, word.alert = "RIGHT", state.word in ("failed", "stale")
        word.label(text=("next" if is_next else state.word) + " ")
        if body is None:
            return
        column = body.column()
        if state.why and state.word != "running":
            tell(column, context, state)
        column.enabled = not context.window_manager.tricap.running
        column.use_property_split, column.use_property_decorate = True, False
        bodies.DRAW[step](column, context, step == now.next)
        bodies.advanced(body, context, step)


def tell(layout: bpy.types.UILayout, context: bpy.types.Context, state: State) -> None:
    """The state's sentence."""
    rows = layout.column()
    rows.alert = state.word == "failed"
    sentence(rows, context, state.why)


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What runs, how far it is, how long it still takes, and how to stop it."""
    job = context.window_manager.tricap
    layout.progress(factor=job.progress, text=f"{job.stage.capitalize()}  {job.progress:.0%}  {job.left}", type="BAR")
    layout.operator("tricap.cancel", icon="X", text="Cancel (Esc)")


def draw_next(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The next thing to do, in words; before anything is there, the sample."""
    now, box = watch.look(context.scene), layout.box()
    if now.states["footage"].word == "empty":
        sentence(box, context, "Next: 1 Footage. Or see how it works first:", "INFO")
        bodies.offer(box, "tricap.load_sample", icon="PLAY")
    elif now.next is None:
        sentence(box, context, "Everything is done. Play the animation with the space bar.", "CHECKMARK")
    else:
        number = STEPS.index(now.next)
        plays = ". The space bar plays the motion." if now.next == STEPS[-1] else ""
        sentence(box, context, f"Next: {number + 1} {TITLES[number]}{plays}", "FORWARD")
    if now.next in STAGE:
        box.operator("tricap.run", icon="FF", text="Do Everything That Is Missing")


CLASSES = (TRICAP_UL_views, TRICAP_PT_main)
