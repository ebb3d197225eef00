"""bpy.ops.tricap.pull_joint(name="wrist.R", view="C", x=402, y=251): a fitted joint that is dragged over the footage becomes a keyframe.

The joint keeps its depth in the view in which it is dragged. Its new place is clicked in this view, and in the others where it is not
clicked yet, so that the fit has it in two views. While it is dragged, all views show its limb as inverse kinematics leads it there.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.geometry.camera import Camera
from ...core.motion.tables import JointTable, read_joints
from .. import clicks, folders, project
from ..overlay import canvas, draw
from ..overlay.layers import Pulled
from ..overlay.operators import pointed
from .operators import CorrectAtPixel

if TYPE_CHECKING:
    from ...core.run.pulled_limb import PulledLimb

REACHES = 2.0  # of an inspection's reach: how far from the pointer a joint is picked


def fitted_joints(scene: bpy.types.Scene) -> JointTable:
    """The joints of the project's results.

    Raises:
        InputError: there is no fitted body, or its table is damaged.
    """
    path = folders.output_folder("", scene) / "joints.csv"
    if not path.is_file():
        raise InputError("There is no fitted body yet; run step 6 first.")
    return read_joints(path)


def cameras_of(scene: bpy.types.Scene) -> Mapping[str, Camera]:
    """The camera of every view.

    Raises:
        InputError: there are no cameras, or a view has none.
    """
    rig = project.rig_of(scene)
    if rig is None:
        raise InputError("The project has no cameras yet (step 2).")
    return {view.name: rig[view.name] for view in scene.tricap.views}


def places_at(table: JointTable, frame: int) -> dict[str, np.ndarray]:
    """The fitted joints (3,) [m] of a frame, by name.

    Raises:
        InputError: no body was fitted in it.
    """
    rows = np.flatnonzero(table.frames == frame)
    found = {name: xyz[rows[0]] for name, xyz in table.joints_m.items() if len(rows) and np.isfinite(xyz[rows[0]]).all()}
    if not found:
        raise InputError(f"No body was fitted in frame {frame}; go to another frame, or click the joints there.")
    return found


def nearest(places: Mapping[str, np.ndarray], camera: Camera, xy_px: np.ndarray, reach_px: float) -> str:
    """The joint that a view shows nearest to a pixel, "" if none is within reach."""
    away = {name: float(np.linalg.norm(camera.project(xyz) - xy_px)) for name, xyz in places.items()}
    found = min(away, key=lambda name: away[name])
    return found if away[found] <= reach_px else ""


def pulled(
    places: Mapping[str, np.ndarray], cameras: Mapping[str, Camera], name: str, view: str, xy_px: np.ndarray
) -> dict[str, np.ndarray]:
    """The pixels (2,) of a joint in all views that see it, when one view shows it at `xy_px` and its depth there stays."""
    xyz = at_its_depth(places[name], cameras[view], xy_px)
    seen = {other: camera.project(xyz) for other, camera in cameras.items() if other != view}
    return {view: xy_px} | {other: xy for other, xy in seen.items() if cameras[other].sees(xy)}


def at_its_depth(xyz_m: np.ndarray, camera: Camera, xy_px: np.ndarray) -> np.ndarray:
    """The place (3,) [m] that a view shows at a pixel, as deep in this view as the place `xyz_m`."""
    return camera.points_at_depth(xy_px, float(camera.to_camera(xyz_m)[2]))


def as_pulled(limb: "PulledLimb", cameras: Mapping[str, Camera], frame: int, xyz_m: np.ndarray) -> Pulled:
    """How all views show a limb whose joint is dragged to a place (3,) [m]."""
    pose = limb.pose(xyz_m)
    bones = limb.bones_m(pose)
    outlines = dict(zip(cameras, limb.outlines_m(pose, *cameras.values())))
    ends = np.stack([limb.joint_m(limb.fitted), limb.joint_m(pose)])
    return Pulled(
        name=limb.joint,
        frame=frame,
        bones_px={view: camera.project(bones) for view, camera in cameras.items()},
        outline_px={view: camera.project(outlines[view]) for view, camera in cameras.items()},
        joint_px={view: camera.project(ends) for view, camera in cameras.items()},
    )


class PullJoint(CorrectAtPixel, bpy.types.Operator):
    """Drag a joint of the fitted body over the footage to where it should be. It becomes a keyframe; Fit Again then fits the body to it"""

    bl_idname = "tricap.pull_joint"
    bl_label = "Pull Joint"
    bl_options = {"REGISTER", "UNDO"}
    hint = "Drag a joint to where it should be    Esc: take it back while dragging, else finish"

    name: bpy.props.StringProperty(name="Joint", description="Such as wrist.R")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Move one joint."""
        done = self._pull(context, self.name, self.view, self.frame_of(context), np.array([self.x, self.y]))
        return {"FINISHED"} if done else {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start dragging."""
        from ...core.run.pulled_limb import FittedLimbs

        self.held, self.done = "", 0
        try:
            self.table, self.cameras = fitted_joints(context.scene), cameras_of(context.scene)
            self.limbs = FittedLimbs.read(folders.output_folder("", context.scene))
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.scene.tricap_overlay.body = True
        return self.begin(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Pick, drag and release joints."""
        if event.type == "ESC" and event.value == "PRESS" and self.held:
            return self._let_go(context)
        if event.type in ("ESC", "RET", "NUMPAD_ENTER") and event.value == "PRESS":
            return self.end(context, {"FINISHED"} if self.done else {"CANCELLED"})
        place = pointed(context, event)
        if place is None:
            outside = self.held and event.type == "LEFTMOUSE" and event.value == "RELEASE"
            return self._let_go(context) if outside else {"PASS_THROUGH"}
        view, xy, reach = place
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            self._pick(view, context.scene.frame_current, xy, REACHES * reach)
            return {"RUNNING_MODAL"}
        if event.type == "MOUSEMOVE" and self.held:
            draw.show_pulled(as_pulled(self.limb, self.cameras, self.held_frame, at_its_depth(self.at, self.cameras[view], xy)))
            canvas.redraw_clips(context, pictures_only=True)
            return {"RUNNING_MODAL"}
        if event.type == "LEFTMOUSE" and event.value == "RELEASE" and self.held:
            self.done += self._pull(context, self.held, view, self.held_frame, xy)
            return self._let_go(context)
        return {"PASS_THROUGH"}

    def end(self, context: bpy.types.Context, how: set[str]) -> set[str]:
        """Leave the modal state."""
        draw.show_pulled(None)
        return super().end(context, how)

    def _let_go(self, context: bpy.types.Context) -> set[str]:
        self.held = ""
        draw.show_pulled(None)
        canvas.redraw_clips(context)
        return {"RUNNING_MODAL"}

    def _pick(self, view: str, frame: int, xy: np.ndarray, reach_px: float) -> None:
        try:
            places = places_at(self.table, frame)
            name = nearest(places, self.cameras[view], xy, reach_px)
            if not name:
                raise InputError("There is no joint near the pointer; zoom in and drag one.")
            self.limb = self.limbs.limb(frame, name)
        except InputError as error:
            self.report({"WARNING"}, str(error))
            return
        self.held, self.at, self.held_frame = name, places[name], frame

    def _pull(self, context: bpy.types.Context, name: str, view: str, frame: int, xy: np.ndarray) -> bool:
        """Click a joint where it was dragged to; whether that was possible."""
        try:
            shown, cameras = project.clips_of(context.scene), cameras_of(context.scene)
            places = places_at(fitted_joints(context.scene), frame)
            if view not in shown or name not in places:
                raise InputError(f"There is no view “{view}”." if view not in shown else f"The fitted body has no joint “{name}”.")
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return False
        for other, at in pulled(places, cameras, name, view, xy).items():
            if other == view or clicks.get_click(shown[other], name, frame) is None:
                clicks.set_click(shown[other], name, frame, (float(at[0]), float(at[1])))
        self.report({"INFO"}, f"{name} is a keyframe in frame {frame} now. Press Fit Again when you are done.")
        return True


CLASSES = (PullJoint,)
