"""`tricap check OUT`: is a result complete, does it belong to the present take, and where is it unreliable?

A fitted body that is implausible: limbs of odd proportions (a joint was clicked in place of another), joints far from their clicks, and
angles beyond the limits of their joints.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..body.limb_words import counts, limb_words, sentence
from ..body.model_file import read_model, with_limits
from ..body.motion import BodyFit, BodyMotion
from ..body.shape import BodyShape, read_body
from ..fitting.inputs.fit_input import FitInput
from ..foundation import bounded, lock, store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..motion.formats.ply import read_ply
from ..motion.tables import JointTable, MotionTable, read_joints, read_motion
from ..results import blend_file
from ..results.folder import lost
from ..results.own_files import files_of
from ..results.run_json import ASKS, UNTIL, read_run
from .findings import Cause, Checked, Finding, doubtful, wrong

MOST_CLOUDS = 40  # that are read, spread over the run
THIN = 0.4  # of the usual number of points
LARGE_SIGMA_MM = 5.0  # of a point
LARGE_SIGMA_DEG = 15.0  # of a joint angle
RAYS_PX = 1.0  # distance between the rays of matched points
NEAR_M = 0.03  # beyond the largest ball of a bone: points so near belong to it
FEWEST_ON_LIMB = 30  # points
MOST_LISTED = 8  # frames
AGAIN = "Run the same command again; it resumes there."
NEEDED = {"measure": ("clouds",), "track": ("trajectories.npz",), "fit": ("body.toml", "joints.csv", "motion.csv"), "report": ("report",)}


def check_run(folder: Path, monitor: Monitor) -> Checked:
    """All checks of the folder of a run."""
    findings: list[Finding] = []
    figures: dict[str, Any] = {}
    notes: list[str] = []
    try:
        run = read_run(folder / "run.json")
        _refuse_parts(run, folder)
        inputs = _same_inputs(run, folder) if "measure" in run["stages"] else []  # an earlier body is of earlier ones
        findings += [*_warnings(run), *_complete(run, folder), *inputs, *_rays(run)]
        if any(files_of(folder / "clouds", "clouds")):
            findings += _clouds(run, folder, figures, monitor)
        if (folder / "motion.csv").exists():
            findings += _body(folder, figures)
            notes = _limbs(read_joints(folder / "joints.csv"), figures)
    except InputError as error:
        findings.append(wrong(Cause.INPUT, str(error)))
    return Checked(subject=str(folder), kind="result", findings=tuple(findings), figures=figures, notes=tuple(notes))


def _limbs(joints: JointTable, figures: dict[str, Any]) -> list[str]:
    """A line for each limb: in which frames it was seen, inferred or guessed; none for a file of an earlier version."""
    if not joints.known or any("" in row for row in joints.known.values()):
        return []
    frames, words = joints.frames.tolist(), limb_words(tuple(joints.known), list(zip(*joints.known.values())))
    figures["limbs"] = counts(words)
    return [sentence(limb, frames, row) for limb, row in words.items()]


def _refuse_parts(run: Mapping[str, Any], folder: Path) -> None:
    lacking = [name for name in ("stages", "inputs", "warnings", "frames") if name not in run]
    if lacking:
        raise InputError(f"{folder / 'run.json'} is damaged; run again.")


def _warnings(run: Mapping[str, Any]) -> list[Finding]:
    return [doubtful(Cause.WARNING, str(w)) for w in run["warnings"]]


def not_measured(folder: Path) -> Finding:
    """That a run was stopped early, maybe before it had a run.json."""
    return wrong(Cause.NOT_FINISHED, f"The run in {folder} was stopped before its surface was measured.", AGAIN)


def _complete(run: Mapping[str, Any], folder: Path) -> list[Finding]:
    """Stages that were never finished, and missing files of finished ones."""
    findings: list[Finding] = []
    if (folder / lock.NAME).is_file():
        findings.append(
            wrong(Cause.NOT_FINISHED, f"A run in {folder} was killed before its end, or is still at work ({lock.NAME}).", AGAIN)
        )
    if not {"measure", "fit"} & set(run["stages"]):
        return [*findings, not_measured(folder)]
    if ASKS in run and "fit" not in run["stages"]:
        findings.append(wrong(Cause.NOT_FINISHED, f"The run in {folder} ended with a question.", run[ASKS]))
    elif (last := run.get(UNTIL, "measure")) not in run["stages"]:
        findings.append(wrong(Cause.NOT_FINISHED, f"The run in {folder} ended before its stage “{last}” was done.", AGAIN))
    incomplete = lost(folder, run)
    for stage, files in NEEDED.items():
        done = "not_done" not in run["stages"].get(stage, {"not_done": True})
        gone = [name for name in files if done and not (folder / name).exists()]
        less = [name for name in incomplete.get(stage, []) if name not in gone]
        if gone:
            findings.append(wrong(Cause.FILES_MISSING, f"{', '.join(gone)} of the stage “{stage}” is missing in {folder}.", AGAIN))
        if less:
            sentence = f"{', '.join(less)} of the stage “{stage}” in {folder} is missing, cut, damaged, or lacks files."
            findings.append(wrong(Cause.FILES_MISSING, sentence, AGAIN))
    if fault := blend_file.lacking(folder, run):
        findings.append(wrong(Cause.FILES_MISSING, f"{blend_file.BLEND} in {folder} {fault}.", AGAIN))
    return findings


def _same_inputs(run: Mapping[str, Any], folder: Path) -> list[Finding]:
    """Input files that have changed since the run. A take that no longer exists is not an error."""
    take = Path(str(run.get("take", "")))
    try:
        files = [take / Path(name).name for name in run["inputs"]]
        present = {p.name: store.digest(p, largest=bounded.TOML_BYTES) for p in files if p.is_file()}
    except (OSError, ValueError):  # an impossible path: from another system, or damaged
        return []
    changed = [name for name, digest in run["inputs"].items() if present.get(name, digest) != digest]
    if not changed:
        return []
    sentence = f"{', '.join(changed)} of {take} has changed since this run."
    return [wrong(Cause.STALE_RESULT, sentence, "Run again; results that do not depend on it are reused.")]


def _rays(run: Mapping[str, Any]) -> list[Finding]:
    findings, measured = [], run["stages"].get("measure", {})
    residual = measured.get("residual_px")
    if isinstance(residual, float) and residual > RAYS_PX and not run["warnings"]:
        findings.append(
            wrong(
                Cause.RAYS_MISS,
                f"The rays of matched points miss each other by {residual:.1f} px: the calibration does not fit, or the views are not "
                "synchronised.",
                "Run `tricap check` on the take: it tells which.",
                residual_px=residual,
            )
        )
    return findings


def _clouds(run: Mapping[str, Any], folder: Path, figures: dict[str, Any], monitor: Monitor) -> list[Finding]:
    """Frames without a cloud or with few points, and sigmas that are too large."""
    findings = []
    frames = range(*run["frames"])
    measured = {path.name for path in (folder / "clouds").glob("*.ply")}
    missing = [f for f in frames if f"{f:04d}.ply" not in measured]
    if missing:
        findings.append(
            wrong(
                Cause.FRAMES_MISSING,
                f"{len(missing)} of {len(frames)} frames have no cloud, the first is {missing[0]}.",
                "Run the same command again.",
                frames=len(missing),
            )
        )
    there = sorted(set(frames) - set(missing))
    chosen = [there[i] for i in np.unique(np.linspace(0, len(there) - 1, min(MOST_CLOUDS, len(there))).astype(int))] if there else []
    counts, sigmas = [], []
    for i, frame in enumerate(chosen):
        monitor.step("reading the clouds", i, len(chosen))
        vertex = read_ply(folder / "clouds" / f"{frame:04d}.ply").vertex
        counts.append(len(vertex["x"]))
        sigmas.append(finite_median(vertex["sigma"]) if "sigma" in vertex else np.nan)
    usual = finite_median(counts, 0.0)
    thin = [f for f, n in zip(chosen, counts) if n < THIN * usual]
    if thin:
        findings.append(
            doubtful(
                Cause.COVERAGE,
                f"Frames {_list(thin)} have less than {100 * THIN:.0f} % of the usual {usual:.0f} points.",
                "Look at the images of these frames: does the person leave the views, or turn a side without texture towards them?",
                usual_points=usual,
            )
        )
    sigma_mm = 1e3 * finite_median(sigmas, 0.0)
    figures |= {"points_per_frame": usual, "sigma_mm": sigma_mm}
    if sigma_mm > LARGE_SIGMA_MM:
        findings.append(
            doubtful(
                Cause.LARGE_SIGMA,
                f"The points have a sigma of {sigma_mm:.1f} mm (median): too large for the shape of a body.",
                "Move the cameras closer to the person or further apart, or wear clothes with more texture.",
                sigma_mm=sigma_mm,
            )
        )
    return findings


def _body(folder: Path, figures: dict[str, Any]) -> list[Finding]:
    """Joint angles with large sigmas, and limbs without points."""
    shape, joints = read_body(folder / "body.toml"), read_joints(folder / "joints.csv")
    motion = read_motion(folder / "motion.csv", shape.skeleton)
    findings = _angles(motion, set(shape.skeleton.layout.group("base").tolist()), figures)
    frame = int(joints.frames[len(joints.frames) // 2]) if len(joints.frames) else -1
    path = folder / "clouds" / f"{frame:04d}.ply"
    if not path.is_file():
        return findings
    xyz, t = read_ply(path).xyz_m, int(np.flatnonzero(joints.frames == frame)[0])
    bare, balls = [], shape.metaballs
    for b, bone in enumerate(shape.skeleton.bones):
        own = balls.radii_m[balls.bone_index == b][:, [0, 2]]  # across the bone
        if len(own) and bone.head_joint in joints.joints_m and bone.tail_joint in joints.joints_m:
            away_m = _distance(xyz, joints.joints_m[bone.head_joint][t], joints.joints_m[bone.tail_joint][t])
            if (away_m < own.max() + NEAR_M).sum() < FEWEST_ON_LIMB:
                bare.append(bone.name)
    if bare:
        findings.append(
            doubtful(
                Cause.COVERAGE,
                f"In frame {frame} there are hardly any measured points on {', '.join(bare)}.",
                "Its motion follows from its neighbours and from the clicks; film it from more sides, or with more texture.",
            )
        )
    return findings


def _angles(motion: MotionTable, base: set[int], figures: dict[str, Any]) -> list[Finding]:
    sigma = np.degrees(np.median(motion.sigma, axis=0)) if len(motion.sigma) else np.zeros(len(motion.dof_names))
    angles = {name: float(s) for d, (name, s) in enumerate(zip(motion.dof_names, sigma)) if d not in base}
    figures["angle_sigma_deg"] = angles
    large = {name: s for name, s in angles.items() if s > LARGE_SIGMA_DEG}
    return (
        [
            doubtful(
                Cause.LARGE_SIGMA,
                "Poorly determined: " + ", ".join(f"{n} ± {s:.0f}°" for n, s in large.items()) + " (median).",
                "Do not rely on these angles; round limbs seen from one side do not show their twist.",
                **large,
            )
        ]
        if large
        else []
    )


def _distance(xyz_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances (N,) of points (N, 3) from the segment a–b."""
    along = b - a
    t = np.clip((xyz_m - a) @ along / max(float(along @ along), 1e-12), 0, 1)
    return np.asarray(np.linalg.norm(xyz_m - a - t[:, None] * along, axis=1))


def _list(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:MOST_LISTED])) + (" …" if len(frames) > MOST_LISTED else "")


LIMBS = (("upper_arm", "forearm"), ("thigh", "shin"))
ODD_RATIO = 1.4  # times the model's proportion; fitted limbs come within 1.3, an elbow clicked at the wrist makes 1.6
FAR_SIGMAS = 6.0  # of a click, in the median view
BEYOND_LIMIT_DEG = 15.0
MOST_NAMED = 3  # joints of one kind


def check_fit(given: FitInput, body: BodyFit, click_sigma_px: float) -> list[str]:
    """All warnings about a fitted body; `click_sigma_px` is the sigma of a click."""
    return [*odd_limbs(body.shape), *far_from_clicks(given, body.motion, click_sigma_px), *beyond_limits(given, body.motion)]


def odd_limbs(shape: BodyShape) -> list[str]:
    """A warning for each limb with one part far too long for the other."""
    usual = np.array([bone.nominal_length_m for bone in shape.skeleton.bones])
    names = [bone.name for bone in shape.skeleton.bones]
    relative = {name: float(ratio) for name, ratio in zip(names, shape.lengths_m / usual)}
    warnings = []
    for upper, lower in ((f"{a}.{s}", f"{b}.{s}") for a, b in LIMBS for s in "LR"):
        if upper not in relative or lower not in relative:
            continue
        ratio = relative[upper] / relative[lower]
        if not 1 / ODD_RATIO < ratio < ODD_RATIO:
            long, short = (upper, lower) if ratio > 1 else (lower, upper)
            joint = shape.skeleton.bones[names.index(upper)].tail_joint
            warnings.append(
                f"{long} is {max(ratio, 1 / ratio):.1f} times too long for {short}: is {joint}, or a joint next to it, clicked in the "
                "wrong place or under another name? Look at the pictures of the body."
            )
    return warnings


def far_from_clicks(given: FitInput, motion: BodyMotion, sigma_px: float) -> list[str]:
    """A warning about the joints that lie far from their clicks, the worst first; `sigma_px` is the sigma of a click."""
    far = []
    for frame, joints in given.clicks.items():
        fitted_m = dict(zip(motion.joint_names, motion.joints_m[list(motion.frames).index(frame)]))
        for name, views in joints.items():
            if name not in fitted_m or not views:
                continue
            off = float(np.median([np.linalg.norm(given.rig[view].project(fitted_m[name]) - xy) for view, xy in views.items()]))
            if off > FAR_SIGMAS * sigma_px:
                far.append((off, f"{name} by {off:.0f} px in frame {frame}"))
    if not far:
        return []
    worst = ", ".join(text for _, text in sorted(far, reverse=True)[:MOST_NAMED])
    more = f" and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
    return [
        f"Fitted joints are far from their clicks: {worst}{more}. Check those clicks and the pictures of the body; more clicks in frames "
        "in between help."
    ]


def beyond_limits(given: FitInput, motion: BodyMotion) -> list[str]:
    """A warning about the angles far beyond the limits of their joints, the worst first."""
    skeleton = with_limits(read_model(given.model), given.limits, given.locked).skeleton
    low, high = np.degrees([dof.limits for dof in skeleton.dofs]).T
    values = np.degrees(motion.values)
    beyond = np.maximum(values - high, low - values)
    beyond[:, skeleton.layout.group("base")] = 0.0  # a position, no angle
    worst = np.argsort(-beyond.max(axis=0), kind="stable")
    far = [
        f"{skeleton.dofs[d].name} by up to {beyond[:, d].max():.0f}° (frame {motion.frames[int(beyond[:, d].argmax())]})"
        for d in worst
        if beyond[:, d].max() > BEYOND_LIMIT_DEG
    ]
    if not far:
        return []
    more = f" and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
    return [
        f"Joint angles exceed their limits: {', '.join(far[:MOST_NAMED])}{more}. The limb may be bent the wrong way: click its joints in "
        "such a frame, or widen the limits under [body.limits]."
    ]
