"""Fit a finished body again around the joints that were clicked since: results of the frames around them are replaced, in seconds.

Everything else stays as the whole fit left it: shape, relief and texture of the skin, all other frames, the report. The key of the fit in
run.json stays, too, so that the step is out of date: a whole fit of the same clicks also adjusts the shape.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..body.limb_words import frame_list
from ..body.model_file import model_names
from ..body.motion import BodyMotion
from ..body.shape import BodyShape, read_body
from ..body.skin.fingers import shape_for_skin
from ..body.skin.mesh import SkinSettings
from ..body.skin.person_skin import REST, cage, read_skin
from ..body.skin.posed import Poser
from ..fitting.inputs.completed_clouds import clouds_for_fit
from ..fitting.inputs.no_surface import background_regions, empty_clouds, points_in_views
from ..fitting.inputs.take_inputs import check_body, fit_input
from ..fitting.stages.fit_again import EarlierFit, around, fit_again, with_held
from ..fitting.stages.rough_motion import bodies_in
from ..fitting.stages.set_up import of_model
from ..fitting.state import ShapeParameters
from ..foundation import store
from ..foundation.arrays import LazySequence
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..motion.formats.ply import write_mesh
from ..motion.tables import JointTable, MotionTable, read_joints, read_motion, write_joints, write_motion
from ..results import edited_tables
from ..results.folder import Results
from ..surface.cloud import PointCloud
from ..surface.measure import last_cloud
from ..take.footage import Footage, open_take
from ..take.take import AUTO_BODY, FrameClicks, Take, read_take
from ..tracking.corrections import corrected_cloud
from ..tracking.trajectories import read_trajectories
from .file_digests import FileDigests
from .record import FrameTable, read_frame_table, write_frame_table
from .settings import Overrides, settings_of
from .stages import CONTENT, Stamp, followed_clicks, stage_keys
from .take_run import only_frames

FITTED_WITH = "fitted_with"  # entry of the fit in run.json: what the body was fitted with, see `fitted_with`
MOST_CLOUDS = 64  # in memory: those of the background, and of one stretch
MOVED, MOVED_M = 1e-9, 1e-5  # of a degree of freedom and of a joint: smaller differences are those of the tables' digits
AGAIN = "fitted_again"  # entry of the fit in run.json: first and last frames that were fitted again


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedAgain:
    """What a new fit around some clicks changed: n frames, in them D degrees of freedom before and after [rad, m] with their new sigmas,
    and the joints of all frames."""

    shape: BodyShape
    frames: np.ndarray  # (n,)
    dof_names: tuple[str, ...]
    before: np.ndarray  # (n, D)
    after: np.ndarray  # (n, D)
    sigma: np.ndarray  # (n, D)
    joints: JointTable

    def __str__(self) -> str:
        return f"Frames {frame_list(self.frames.tolist())} were fitted again, with the shape as it was."


def fitted_with(footage: Footage, settings: Mapping[str, Any], out: Path) -> dict[str, Any]:
    """The clicked joints of each frame as digests, and the key of everything else that a body depends on."""
    clicks = {
        s.frame: {name: store.digest(repr(FrameClicks(joints={name: at}).table())) for name, at in s.joints.items()}
        for s in _clicked(footage)
    }
    besides = besides_clicks(footage, settings, out)
    return {"besides": besides, "clicks": {str(frame): digests for frame, digests in sorted(clicks.items())}}


def besides_clicks(footage: Footage, settings: Mapping[str, Any], out: Path, stamp: Stamp | None = None) -> str:
    """The key of everything that a body depends on besides clicks; `stamp`: what stands for a file, by default its time."""
    followed = followed_clicks(footage.take, settings)
    take = replace(footage.take, clicks=replace(followed, joints={}), keyframes=())
    return stage_keys(replace(footage, take=take), settings, out, stamp)["fit"]


def frames_again(fit: Mapping[str, Any], footage: Footage, settings: Mapping[str, Any], out: Path) -> str:
    """The frames, in words, that were fitted again to the clicks as they are now, by the entry of the fit in run.json; "" if anything has
    changed since."""
    before = fit.get(FITTED_WITH, {})
    if not fit.get(AGAIN) or {**before, **fitted_with(footage, settings, out)} != before:
        return ""
    return ", ".join(f"{first}–{last}" if first != last else f"{first}" for first, last in fit[AGAIN])


def fit_around_clicks(
    take_folder: Path, out: Path, overrides: Overrides, monitor: Monitor, frames: tuple[int, int] | None = None
) -> FittedAgain | None:
    """Fit the frames around new, moved and removed joint clicks again. None where more than clicks has changed since
    the body was fitted, so that a whole fit is needed. `frames`: those of that fit, half-open, where they were not all.

    Raises:
        InputError: no clicks have changed, they contradict each other, or the results are damaged.
        Cancelled: the user asked to stop; the results stay as they are.
    """
    take = read_take(take_folder)
    settings = settings_of(take.settings, overrides, str(take.folder / "take.toml"))
    footage = open_take(take, click_sigma_px=settings["fitting"].click_sigma_px)
    footage = footage if frames is None else only_frames(footage, frames)
    check_body(footage, settings["fitting"])
    with Results(out).opened() as results:
        record = results.read_run()
        before = record.get("stages", {}).get("fit", {}).get(FITTED_WITH, {})
        now = fitted_with(footage, settings, results.folder)
        same = before.get("besides") == now["besides"] or (
            CONTENT in before and before[CONTENT] == besides_clicks(footage, settings, results.folder, FileDigests().stamp)
        )
        if not same or not results.path("skin", REST).is_file():
            return None
        changed = _changed(before.get("clicks", {}), now["clicks"])
        if not changed:
            raise InputError("No joints were clicked or pulled since the body was fitted; click or pull one first.")
        body = _Body.read(results, _fitted_model(take, record["stages"]["fit"]))
        stretches = around([*changed], body.motion.frames, body.motion.time_s)
        if not stretches:
            return None
        parts = []
        for i, rows in enumerate(stretches):
            joints = {name for frame, names in changed.items() if frame in body.motion.frames[rows] for name in names}
            parts.append(_fitted(footage, results, settings, body, rows, joints, monitor.part("fit", i, len(stretches))))
        edited = edited_tables.edited(results.folder, record["stages"])  # their edits stay in them
        _write(results, settings["skin"], body, parts)
        ends = [[int(part.frames[0]), int(part.frames[-1])] for part in parts]
        record["stages"]["fit"] |= {FITTED_WITH: {**before, **now}, AGAIN: ends}
        if noted := record["stages"]["fit"].get(edited_tables.ENTRY):
            noted |= {name: digest for name, digest in edited_tables.digests(results.folder).items() if name not in edited}
        results.write_run(record)
        written = _Body.read(results, body.model)
    again = np.concatenate([part.frames for part in parts])
    fitted = np.isin(body.motion.frames, again)
    return FittedAgain(
        shape=body.shape,
        frames=again,
        dof_names=body.motion.dof_names,
        before=body.motion.values[fitted],
        after=np.concatenate([part.values for part in parts]),
        sigma=written.motion.sigma[fitted],
        joints=written.joints,
    )


def _fitted_model(take: Take, fit: Mapping[str, Any]) -> str:
    """The model of the fitted body: the take's, or the one that the `fit` of run.json chose.

    Raises:
        InputError: it chose one that is not ours.
    """
    if take.body_model != AUTO_BODY:
        return str(take.body_model)
    if (chosen := fit.get("chosen_model")) not in model_names():
        raise InputError("run.json does not say which body was fitted; run the whole fit again (Fit Body).")
    return str(chosen)


def _clicked(footage: Footage) -> list[FrameClicks]:
    """The clicked joints in the frames that are fitted."""
    return [s for s in (footage.take.clicks, *footage.take.keyframes) if s.joints and s.frame in footage.frames]


Digests = Mapping[str, Mapping[str, str]]  # of clicks, by frame and joint


def _changed(before: Digests, now: Digests) -> dict[int, list[str]]:
    """The joints whose clicks differ, by frame."""
    found = {}
    for frame in sorted({*before, *now}, key=int):
        old, new = before.get(frame, {}), now.get(frame, {})
        if joints := [name for name in {**old, **new} if old.get(name) != new.get(name)]:
            found[int(frame)] = joints
    return found


@dataclass(frozen=True, eq=False, kw_only=True)
class _Body:
    """The results of the earlier fit."""

    model: str
    shape: BodyShape
    motion: MotionTable
    joints: JointTable
    table: FrameTable

    @staticmethod
    def read(results: Results, model: str) -> "_Body":
        """From the folder of results, of a body of this model.

        Raises:
            InputError: a file is missing or damaged, or the tables have other frames.
        """
        shape = read_body(results.path("body.toml"))
        motion = read_motion(results.path("motion.csv"), shape.skeleton)
        joints, table = read_joints(results.path("joints.csv")), read_frame_table(results.path("frames.csv"))
        same = all(np.array_equal(other.frames, motion.frames) for other in (joints, table))
        if not same or set(joints.joints_m) != set(shape.skeleton.joint_names) or not all(map(all, joints.known.values())):
            raise InputError(f"The tables in {results.folder} do not belong together; run the whole fit again.")
        return _Body(model=model, shape=shape, motion=motion, joints=joints, table=table)

    @property
    def earlier(self) -> EarlierFit:
        """What a new fit of some frames begins with."""
        names = self.shape.skeleton.joint_names
        common = [np.median(self.joints.sigma_m[name] ** 2 - self.joints.frame_sigma_m[name] ** 2) for name in names]
        own = self.motion
        return EarlierFit(
            shape=self.shape, frames=own.frames, time_s=own.time_s, values=own.values, common_m=np.sqrt(np.maximum(common, 0.0))
        )

    @property
    def whole(self) -> BodyMotion:
        """The motion of all frames; its covariances are diagonal, and a table has the status of its frames."""
        names, words = self.shape.skeleton.joint_names, self.table.fit
        return BodyMotion(
            frames=self.motion.frames,
            time_s=self.motion.time_s,
            dof_names=self.motion.dof_names,
            values=self.motion.values,
            covariance=self.motion.sigma[:, :, None] ** 2 * np.eye(len(self.motion.dof_names)),
            joint_names=names,
            joints_m=np.stack([self.joints.joints_m[name] for name in names], axis=1),
            joint_sigma_m=np.stack([self.joints.sigma_m[name] for name in names], axis=1),
            joint_frame_sigma_m=np.stack([self.joints.frame_sigma_m[name] for name in names], axis=1),
            known=tuple(zip(*(self.joints.known[name] for name in names))),
            status=words,
            sigma0=self.table.values["fit_sigma0"],
        )


def _fitted(
    footage: Footage, results: Results, settings: Mapping[str, Any], body: _Body, rows: range, joints: set[str], monitor: Monitor
) -> BodyMotion:
    """The new motion of some rows of the earlier one."""
    fitting, wider = settings["fitting"], with_held(rows, len(body.motion.frames))
    clouds: Sequence[PointCloud] = empty_clouds(footage)
    if fitting.use_surface and results.path("cache", "surface").is_dir():
        corrections, rig = footage.take.corrections, footage.rig

        @lru_cache(maxsize=MOST_CLOUDS)
        def cloud_of(frame: int) -> PointCloud:
            return corrected_cloud(last_cloud(footage, results, frame), corrections, rig)

        clouds = LazySequence(footage.frames, cloud_of)
    trajectories = read_trajectories(results.folder) if fitting.use_surface else None
    parameters = ShapeParameters(body.shape, fitting.weights)
    bodies = None if trajectories is not None else bodies_in(parameters, body.earlier.values, parameters.vector())
    background = background_regions(footage, results, clouds, fitting, monitor, wider, bodies)
    part = replace(footage, frames=footage.frames[wider.start : wider.stop])
    chosen = clouds_for_fit(part, [clouds[row] for row in wider], trajectories, background, fitting, results, monitor)
    given = of_model(fit_input(part, chosen, trajectories, results, background), body.model)
    if bodies is not None and fitting.use_trajectories:
        given = replace(given, image_tracks=points_in_views(part, background, monitor, bodies[wider.start : wider.stop]))
    return fit_again(given, body.earlier, rows, joints, fitting, monitor)


def _write(results: Results, settings: SkinSettings, body: _Body, parts: Sequence[BodyMotion]) -> None:
    """Replace the rows of the tables and the skins of the frames."""
    whole, table = body.whole, body.table
    person = shape_for_skin(body.shape, settings)
    skin = read_skin(results.path("skin", REST), person)
    rows_of_cage, faces = cage(skin)
    poser, vertices = Poser(person, skin.weights[rows_of_cage]), skin.vertices_m[rows_of_cage]
    for part in parts:
        rows = np.flatnonzero(np.isin(whole.frames, part.frames))
        whole, table = _replaced(whole, part, rows), _with_rows(table, part, rows)
        for frame, values in zip(part.frames, part.values):
            write_mesh(results.path("skin", f"{frame:04d}.ply"), poser.posed(vertices, values), faces)
    write_joints(results.path("joints.csv"), whole)
    write_motion(results.path("motion.csv"), whole, body.shape.skeleton)
    write_frame_table(results.path("frames.csv"), table)


def _replaced(whole: BodyMotion, part: BodyMotion, rows: np.ndarray) -> BodyMotion:
    """The motion with other results in some rows: of the degrees of freedom and joints that have moved."""
    dofs = np.flatnonzero((np.abs(part.values - whole.values[rows]) > MOVED).any(axis=0))
    joints = np.flatnonzero((np.abs(part.joints_m - whole.joints_m[rows]) > MOVED_M).any(axis=(0, 2)))
    new: dict[str, Any] = {
        name: np.array(getattr(whole, name)) for name in ("values", "covariance", "joints_m", "joint_sigma_m", "joint_frame_sigma_m")
    }
    new["values"][np.ix_(rows, dofs)] = part.values[:, dofs]
    new["covariance"][np.ix_(rows, dofs, dofs)] = part.covariance[:, dofs][:, :, dofs]
    for name in ("joints_m", "joint_sigma_m", "joint_frame_sigma_m"):
        new[name][np.ix_(rows, joints)] = getattr(part, name)[:, joints]
    sigma0, status, known = np.array(whole.sigma0), list(whole.status), [list(words) for words in whole.known]
    for i, row in enumerate(rows.tolist()):
        sigma0[row], status[row] = part.sigma0[i], part.status[i]
        for j in joints:
            known[row][j] = part.known[i][j]
    return replace(whole, **new, sigma0=sigma0, status=tuple(status), known=tuple(map(tuple, known)))


def _with_rows(table: FrameTable, part: BodyMotion, rows: np.ndarray) -> FrameTable:
    values = {name: np.array(column) for name, column in table.values.items()}
    values["fit_sigma0"][rows] = part.sigma0
    values["joint_sigma_mm"][rows] = [1e3 * finite_median(sigma) for sigma in part.joint_sigma_m]
    words = list(table.fit)
    words[rows[0] : rows[-1] + 1] = part.status
    return replace(table, values=values, fit=tuple(words))
