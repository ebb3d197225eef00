"""`tricap check OUT`: is a result complete, does it belong to the take as it is now, and where is it not to be trusted?"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..body.shape import read_body
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.robust import finite_median
from ..motion.formats.ply import read_ply
from ..motion.tables import MotionTable, read_joints, read_motion
from ..results.run_json import read_run
from .findings import Checked, Finding, doubtful, wrong

MOST_FRAMES = 10_000_000
LOOKED_AT = 40  # clouds, spread over the run
THIN = 0.4  # of the usual number of points
UNSURE_MM, UNSURE_DEG = 5.0, 15.0  # sigmas: a point's, a joint angle's
RAYS_PX = 1.0
NEAR_M, ON_A_LIMB = 0.12, 30  # points within this distance of a bone
MADE_BY = {"measure": ("clouds",), "track": ("trajectories.npz",), "fit": ("body.toml", "joints.csv", "motion.csv"), "report": ("report",)}


def check_run(folder: Path, monitor: Monitor) -> Checked:
    """Everything that can be said of the folder of a run from what lies in it."""
    findings: list[Finding] = []
    figures: dict[str, Any] = {}
    try:
        run = read_run(folder / "run.json")
        _refuse_parts(run, folder)
        findings += [*_warnings(run), *_complete(run, folder), *_same_inputs(run, folder), *_rays(run)]
        if (folder / "clouds").is_dir():
            findings += _clouds(run, folder, figures, monitor)
        if (folder / "motion.csv").exists():
            findings += _body(folder, figures)
    except InputError as error:
        findings.append(wrong("input", str(error)))
    return Checked(subject=str(folder), kind="result", findings=tuple(findings), figures=figures)


def _refuse_parts(run: Mapping[str, Any], folder: Path) -> None:
    lacking = [name for name in ("stages", "inputs", "warnings", "frames") if name not in run]
    if lacking or run["frames"][1] - run["frames"][0] > MOST_FRAMES:
        raise InputError(f"{folder / 'run.json'} is damaged; run again.")


def _warnings(run: Mapping[str, Any]) -> list[Finding]:
    return [doubtful("warning", str(w)) for w in run["warnings"]]


def _complete(run: Mapping[str, Any], folder: Path) -> list[Finding]:
    """Stages that were never finished, and files of finished ones that are gone."""
    found, again = [], "Run the same command again; it goes on from there."
    if "measure" not in run["stages"]:
        return [wrong("not finished", f"The run in {folder} was stopped before its surface was measured.", again)]
    for stage, files in MADE_BY.items():
        if "not_done" in run["stages"].get(stage, {}) or stage not in run["stages"]:
            continue
        gone = [name for name in files if not (folder / name).exists()]
        if gone:
            found.append(wrong("files missing", f"{', '.join(gone)} of the stage “{stage}” is missing in {folder}.", again))
    return found


def _same_inputs(run: Mapping[str, Any], folder: Path) -> list[Finding]:
    """Input files that have changed since the run; a take that is not there any more is not held against its result."""
    take = Path(str(run.get("take", "")))
    try:
        known = {p.name: store.digest(p) for p in (take / Path(name).name for name in run["inputs"]) if p.is_file()}
    except (OSError, ValueError):  # a folder that cannot be: from another system, or damaged
        return []
    changed = [name for name, digest in run["inputs"].items() if known.get(name, digest) != digest]
    if not changed:
        return []
    said = f"{', '.join(changed)} of {take} has changed since this run."
    return [wrong("stale result", said, "Run again; what does not depend on it is kept.")]


def _rays(run: Mapping[str, Any]) -> list[Finding]:
    found, measured = [], run["stages"].get("measure", {})
    residual = measured.get("residual_px")
    if isinstance(residual, float) and residual > RAYS_PX and not run["warnings"]:
        found.append(
            wrong(
                "rays miss",
                f"The rays of matched points miss each other by {residual:.1f} px: a calibration that does not fit, or views out of step.",
                "Run `tricap check` on the take: it tells them apart.",
                residual_px=residual,
            )
        )
    return found


def _clouds(run: Mapping[str, Any], folder: Path, figures: dict[str, Any], monitor: Monitor) -> list[Finding]:
    """Frames without a cloud or with a thin one, and sigmas too large."""
    found = []
    frames = range(*run["frames"])
    measured = {path.name for path in (folder / "clouds").glob("*.ply")}
    missing = [f for f in frames if f"{f:04d}.ply" not in measured]
    if missing:
        found.append(
            wrong(
                "frames missing",
                f"{len(missing)} of {len(frames)} frames have no cloud, the first is {missing[0]}.",
                "Run the same command again.",
                frames=len(missing),
            )
        )
    there = sorted(set(frames) - set(missing))
    chosen = [there[i] for i in np.unique(np.linspace(0, len(there) - 1, min(LOOKED_AT, len(there))).astype(int))] if there else []
    counts, sigmas = [], []
    for i, frame in enumerate(chosen):
        monitor.step("reading the clouds", i, len(chosen))
        vertex = read_ply(folder / "clouds" / f"{frame:04d}.ply").vertex
        counts.append(len(vertex["x"]))
        sigmas.append(finite_median(vertex["sigma"]) if "sigma" in vertex else np.nan)
    usual = finite_median(counts, 0.0)
    thin = [f for f, n in zip(chosen, counts) if n < THIN * usual]
    if thin:
        found.append(
            doubtful(
                "coverage",
                f"Frames {_list(thin)} have less than {100 * THIN:.0f} % of the usual {usual:.0f} points.",
                "Look at these frames' pictures: does the person leave the views, or turn a side without texture to them?",
                usual_points=usual,
            )
        )
    sigma_mm = 1e3 * finite_median(sigmas, 0.0)
    figures |= {"points_per_frame": usual, "sigma_mm": sigma_mm}
    if sigma_mm > UNSURE_MM:
        found.append(
            doubtful(
                "large sigma",
                f"The points have a sigma of {sigma_mm:.1f} mm (median): too coarse for a body's shape.",
                "Bring the cameras nearer or further apart, or give the clothes more texture.",
                sigma_mm=sigma_mm,
            )
        )
    return found


def _body(folder: Path, figures: dict[str, Any]) -> list[Finding]:
    """Joint angles that are not known well enough, and limbs without points."""
    shape, joints = read_body(folder / "body.toml"), read_joints(folder / "joints.csv")
    motion = read_motion(folder / "motion.csv", shape.skeleton)
    found = _angles(motion, set(shape.skeleton.layout.group("base").tolist()), figures)
    frame = int(joints.frames[len(joints.frames) // 2]) if len(joints.frames) else -1
    path = folder / "clouds" / f"{frame:04d}.ply"
    if not path.is_file():
        return found
    xyz, t = read_ply(path).xyz_m, int(np.flatnonzero(joints.frames == frame)[0])
    bare = []
    for bone in shape.skeleton.bones:
        if bone.head_joint in joints.joints_m and bone.tail_joint in joints.joints_m:
            near = _distance(xyz, joints.joints_m[bone.head_joint][t], joints.joints_m[bone.tail_joint][t]) < NEAR_M
            if near.sum() < ON_A_LIMB:
                bare.append(bone.name)
    if bare:
        found.append(
            doubtful(
                "coverage",
                f"In frame {frame} there are hardly any measured points on {', '.join(bare)}.",
                "Its motion rests on its neighbours and on the clicks; see it from more sides, or give it texture.",
            )
        )
    return found


def _angles(motion: MotionTable, base: set[int], figures: dict[str, Any]) -> list[Finding]:
    sigma = np.degrees(np.median(motion.sigma, axis=0)) if len(motion.sigma) else np.zeros(len(motion.dof_names))
    angles = {name: float(s) for d, (name, s) in enumerate(zip(motion.dof_names, sigma)) if d not in base}
    figures["angle_sigma_deg"] = angles
    unsure = {name: s for name, s in angles.items() if s > UNSURE_DEG}
    return (
        [
            doubtful(
                "large sigma",
                "Hardly determined: " + ", ".join(f"{n} ± {s:.0f}°" for n, s in unsure.items()) + " (median).",
                "Do not quote these angles; round limbs seen from one side do not show their twist.",
                **unsure,
            )
        ]
        if unsure
        else []
    )


def _distance(xyz_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances (N,) of points (N, 3) from the segment a–b."""
    along = b - a
    t = np.clip((xyz_m - a) @ along / max(float(along @ along), 1e-12), 0, 1)
    return np.asarray(np.linalg.norm(xyz_m - a - t[:, None] * along, axis=1))


def _list(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:8])) + (" …" if len(frames) > 8 else "")
