"""Scoring a run against the truth of its recording: accuracy, counts and completeness. Distances in millimetres, angles in degrees.

Gross errors (10 mm and more) are counted, and excluded from the clouds' median and percentile. The truth of a trajectory is the path of the
point of the true surface nearest to its beginning. "Motion" figures are without the mean over time: a joint inside the body has no exact
position, but must not drift.
"""

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..body.shape import read_body
from ..foundation import bounded, store
from ..foundation.errors import InputError, damage_of
from ..foundation.progress import Monitor
from ..motion.formats.ply import Ply, read_ply
from .truth import Truth, motion_capture_name, read_truth

STAGE = "score"
GROSS_MM = 10.0  # errors from here on are gross
COVERED_M = 0.012  # a surface point with a measured point within this distance is covered
HINGES = {"elbow": ("shoulder", "wrist"), "knee": ("hip", "ankle")}


@dataclass(frozen=True, kw_only=True, slots=True)
class CloudScore:
    """Clouds against the true surface."""

    frames: int
    points_per_frame: float
    median_mm: float
    p95_mm: float
    gross_fraction: float  # mean over the frames
    coverage: float  # fraction of the textured surface visible in all cameras that has a point within 12 mm

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of {self.points_per_frame:,.0f} points: median {self.median_mm:.2f} mm, 95 % {self.p95_mm:.2f} mm, "
            f"≥ 10 mm {self.gross_fraction:.1%}, coverage {self.coverage:.0%}"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class TrajectoryScore:
    """Trajectories against the true surface's motion."""

    trajectories: int
    mean_length_frames: float
    median_mm: float
    p95_mm: float
    false_fraction: float  # fraction of the positions after the first with an error of 10 mm or more

    def __str__(self) -> str:
        return (
            f"{self.trajectories:,} of {self.mean_length_frames:.1f} frames: median {self.median_mm:.2f} mm, 95 % {self.p95_mm:.2f} "
            f"mm, ≥ 10 mm {self.false_fraction:.1%}"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class JointScore:
    """Joints against the true ones."""

    mpjpe_mm: float  # mean per joint position error
    motion_rms_mm: float  # mean over the joints of the rms without the mean offset
    joints_mm: dict[str, float]

    def __str__(self) -> str:
        return (
            f"mean error {self.mpjpe_mm:.1f} mm, motion {self.motion_rms_mm:.1f} mm rms ("
            + ", ".join(f"{name} {value:.1f}" for name, value in self.joints_mm.items())
            + ")"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class AngleScore:
    """One angle over time."""

    rms_deg: float
    motion_rms_deg: float

    def __str__(self) -> str:
        return f"{self.rms_deg:.1f}° rms, motion {self.motion_rms_deg:.1f}°"


@dataclass(frozen=True, kw_only=True, slots=True)
class ShapeScore:
    """The fitted person against the true one."""

    lengths_mm: dict[str, float]  # error of each bone's length
    radius_bias: float  # mean and rms of l_fit/l_true − 1 of the metaballs' cross radii; NaN: the bodies have other balls
    radius_rms: float

    def __str__(self) -> str:
        lengths = ", ".join(f"{name} {value:+.1f} mm" for name, value in self.lengths_mm.items())
        radii = f"; cross radii {self.radius_bias:+.1%}, {self.radius_rms:.1%} rms" if self.radius_rms == self.radius_rms else ""
        return f"lengths {lengths}{radii}"


@dataclass(frozen=True, kw_only=True, slots=True)
class SkinScore:
    """Vertices of the skin next to surface visible in all cameras, against the true surface."""

    frames: int
    median_mm: float
    rms_mm: float
    p95_mm: float

    def __str__(self) -> str:
        return f"{self.frames} frames: median {self.median_mm:.2f} mm, rms {self.rms_mm:.2f} mm, 95 % {self.p95_mm:.2f} mm"


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """The scores of a run. None: the run, or the truth, lacks this result."""

    clouds: CloudScore | None
    trajectories: TrajectoryScore | None
    joints: JointScore | None
    hinges: dict[str, AngleScore]  # angles between bones at elbows and knees, from the joints' positions
    angles: dict[str, AngleScore]  # the body model's degrees of freedom
    shape: ShapeScore | None
    skin: SkinScore | None

    def __str__(self) -> str:
        """One line for each score."""
        rows = [("clouds", self.clouds), ("trajectories", self.trajectories), ("joints", self.joints)]
        rows += [(f"{name} bend", score) for name, score in self.hinges.items()] + list(self.angles.items())  # type: ignore[arg-type]
        rows += [("body shape", self.shape), ("skin", self.skin)]  # type: ignore[list-item]
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {'missing' if score is None else score}" for name, score in rows)


def score_run(take: Path, out: Path, monitor: Monitor | None = None) -> Score:
    """Score the results in `out` against `take`/truth.npz.

    Raises:
        InputError: the truth is missing, or a result cannot be read or belongs to other frames.
    """
    truth, out, monitor = read_truth(Path(take)), Path(out), monitor or Monitor()
    joints = _read_joints(out / "joints.csv", truth)
    return Score(
        clouds=_score_clouds(truth, out, monitor),
        trajectories=_score_trajectories(truth, out / "trajectories.npz", monitor),
        joints=_score_joints(truth, joints),
        hinges=_score_hinges(truth, joints),
        angles=_score_angles(truth, out / "motion.csv"),
        shape=_score_shape(truth, out / "body.toml"),
        skin=_score_skin(truth, out, monitor),
    )


def _meshes(folder: Path, truth: Truth, monitor: Monitor) -> list[tuple[int, Ply]]:
    """The PLY files of a folder with their frames, without empty ones."""
    found = []
    paths = sorted(folder.glob("*.ply"))
    for i, path in enumerate(paths):
        monitor.step(STAGE, i, len(paths))
        if not path.stem.isdecimal() or int(path.stem) >= len(truth.vertices_m):
            raise InputError(f"{path} is not a frame of the recording, which has {len(truth.vertices_m)}; score the run with its own take.")
        ply = read_ply(path)
        if len(ply.xyz_m):
            found.append((int(path.stem), ply))
    return found


def _score_clouds(truth: Truth, out: Path, monitor: Monitor) -> CloudScore | None:
    from scipy.spatial import cKDTree

    distances, coverage = [], []
    for frame, ply in _meshes(out / "clouds", truth, monitor):
        distances.append(truth.closest(frame, ply.xyz_m)[0] * 1e3)
        wanted = truth.vertices_m[frame][truth.visible[frame] & truth.textured]
        coverage.append(np.mean(cKDTree(ply.xyz_m).query(wanted)[0] < COVERED_M))
    if not distances:
        return None
    fine = np.concatenate([d[d < GROSS_MM] for d in distances] + [np.zeros(0)])
    median, p95 = np.percentile(fine, [50, 95]) if len(fine) else (np.nan, np.nan)
    return CloudScore(
        frames=len(distances),
        points_per_frame=float(np.mean([len(d) for d in distances])),
        median_mm=float(median),
        p95_mm=float(p95),
        gross_fraction=float(np.mean([np.mean(d >= GROSS_MM) for d in distances])),
        coverage=float(np.mean(coverage)),
    )


def _score_trajectories(truth: Truth, path: Path, monitor: Monitor) -> TrajectoryScore | None:
    if not path.exists():
        return None
    try:
        file = store.load_arrays(path)
        frames, xyz, shared = file["frames"].astype(np.intp), file["xyz_m"].astype(np.float64), "track" in file
    except store.DAMAGED as error:
        raise InputError(f"{path} has no trajectories or is damaged; run the tracking again.") from error
    if shared:
        raise InputError(f"{path} has several trajectories in a column, which cannot be scored; run fewer frames of the take (--frames).")
    if len(frames) and frames.max() >= len(truth.vertices_m):
        raise InputError(f"{path} has frame {frames.max()}, the recording only {len(truth.vertices_m)}; score the run with its own take.")
    seen = np.isfinite(xyz).all(axis=2)
    xyz, seen = xyz[:, seen.any(axis=0)], seen[:, seen.any(axis=0)]
    if not seen.size:
        return None
    expected = _true_paths(truth, frames, xyz, seen.argmax(axis=0), monitor)
    later = seen & (np.arange(len(frames))[:, None] > seen.argmax(axis=0))
    off = np.linalg.norm((xyz - expected)[later], axis=1) * 1e3
    median, p95 = np.percentile(off, [50, 95]) if len(off) else (np.nan, np.nan)
    return TrajectoryScore(
        trajectories=seen.shape[1],
        mean_length_frames=float(seen.sum(axis=0).mean()),
        median_mm=float(median),
        p95_mm=float(p95),
        false_fraction=float(np.mean(off > GROSS_MM)) if len(off) else 0.0,
    )


def _true_paths(truth: Truth, frames: np.ndarray, xyz: np.ndarray, first: np.ndarray, monitor: Monitor) -> np.ndarray:
    """The paths (T, N, 3) of the surface points nearest to the trajectories in their `first` (N,) steps."""
    paths = np.empty_like(xyz)
    for step in range(len(frames)):
        monitor.step(STAGE, step, len(frames))
        born = np.flatnonzero(first == step)
        if len(born):
            _, triangle, weights = truth.closest(frames[step], xyz[step, born])
            corners = truth.triangles[triangle]
            paths[:, born] = sum(weights[:, c, None] * truth.vertices_m[frames][:, corners[:, c]] for c in range(3))
    return paths


def _table(path: Path, needed: tuple[str, ...]) -> dict[str, list[str]]:
    """The columns of a CSV file by name."""
    try:
        rows = list(csv.reader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))))
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"Cannot read {path}: {damage_of(error)}; run the fit again.") from error
    missing = [name for name in needed if not rows or name not in rows[0]]
    if missing or any(len(row) != len(rows[0]) for row in rows):
        raise InputError(f"{path} is no complete table with the columns {', '.join(needed)}; run the fit again.")
    return {name: [row[i] for row in rows[1:]] for i, name in enumerate(rows[0])}


def _numbers(table: dict[str, list[str]], name: str, path: Path) -> np.ndarray:
    try:
        return np.array([float(text) for text in table[name]])
    except ValueError as error:
        raise InputError(f"Column “{name}” of {path} has an entry that is not a number ({error}); run the fit again.") from error


def _read_joints(path: Path, truth: Truth) -> dict[str, np.ndarray]:
    """Estimated joints by name, each (T, 3), NaN where missing; only those that the truth has."""
    if not path.exists():
        return {}
    table = _table(path, ("frame", "joint", "x", "y", "z"))
    frame = _numbers(table, "frame", path).astype(np.intp)
    if len(frame) and not 0 <= frame.min() <= frame.max() < len(truth.vertices_m):
        raise InputError(f"{path} has frames beyond the recording's {len(truth.vertices_m)}; score the run with its own take.")
    xyz, names = np.stack([_numbers(table, axis, path) for axis in "xyz"], axis=1), np.array(table["joint"])
    joints = {}
    for name in dict.fromkeys(table["joint"]):
        if motion_capture_name(name) in truth.joints_m:
            joints[name] = np.full((len(truth.vertices_m), 3), np.nan)
            joints[name][frame[names == name]] = xyz[names == name]
    return joints


def _score_joints(truth: Truth, joints: dict[str, np.ndarray]) -> JointScore | None:
    errors = {name: (xyz - truth.joints_m[motion_capture_name(name)]) * 1e3 for name, xyz in joints.items()}
    errors = {name: e[np.isfinite(e).all(axis=1)] for name, e in errors.items()}
    if not errors:
        return None
    motion = [np.sqrt(((e - e.mean(axis=0)) ** 2).sum(axis=1).mean()) for e in errors.values()]
    each = {name: float(np.linalg.norm(e, axis=1).mean()) for name, e in errors.items()}
    return JointScore(mpjpe_mm=float(np.mean(list(each.values()))), motion_rms_mm=float(np.mean(motion)), joints_mm=each)


def _score_hinges(truth: Truth, joints: dict[str, np.ndarray]) -> dict[str, AngleScore]:
    scores = {}
    for hinge, ends in HINGES.items():
        for side in "LR":
            names = [f"{joint}.{side}" for joint in (ends[0], hinge, ends[1])]
            if set(names) <= set(joints):
                true = _angle_deg(*(truth.joints_m[motion_capture_name(name)] for name in names))
                scores[names[1]] = _angle_score(_angle_deg(*(joints[name] for name in names)) - true)
    return scores


def _angle_deg(a: np.ndarray, corner: np.ndarray, b: np.ndarray) -> np.ndarray:
    u, v = a - corner, b - corner
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("ni,ni->n", u, v)))


def _angle_score(error_deg: np.ndarray) -> AngleScore:
    error = error_deg[np.isfinite(error_deg)]
    return AngleScore(rms_deg=float(np.sqrt(np.mean(error**2))), motion_rms_deg=float(error.std()))


def _score_angles(truth: Truth, path: Path) -> dict[str, AngleScore]:
    if truth.motion is None or not path.exists():
        return {}
    names = tuple(name for name in truth.motion if name.rpartition(" ")[2] not in ("x", "y", "z"))  # without the base
    table = _table(path, ("frame", *names))
    frame = _numbers(table, "frame", path).astype(np.intp)
    if len(frame) and not 0 <= frame.min() <= frame.max() < len(truth.vertices_m):
        raise InputError(f"{path} has frames beyond the recording's {len(truth.vertices_m)}; score the run with its own take.")
    errors = {name: _numbers(table, name, path) - np.degrees(truth.motion[name][frame]) for name in names}
    return {name: _angle_score((error + 180) % 360 - 180) for name, error in errors.items()}


def _score_shape(truth: Truth, path: Path) -> ShapeScore | None:
    if truth.radii_m is None or truth.lengths_m is None or not path.exists():
        return None
    shape = read_body(path)
    lengths = {
        bone.name: float(length - truth.lengths_m[bone.name]) * 1e3
        for bone, length in zip(shape.skeleton.bones, shape.lengths_m)
        if bone.name in truth.lengths_m
    }
    if shape.metaballs.radii_m.shape != truth.radii_m.shape:
        return ShapeScore(lengths_mm=lengths, radius_bias=float("nan"), radius_rms=float("nan"))
    ratio = (shape.metaballs.radii_m / truth.radii_m)[:, [0, 2]] - 1
    return ShapeScore(lengths_mm=lengths, radius_bias=float(ratio.mean()), radius_rms=float(np.sqrt((ratio**2).mean())))


def _score_skin(truth: Truth, out: Path, monitor: Monitor) -> SkinScore | None:
    from scipy.spatial import cKDTree

    distances = []
    for frame, ply in _meshes(out / "skin", truth, monitor):
        nearest = cKDTree(truth.vertices_m[frame]).query(ply.xyz_m)[1]
        distances.append(truth.closest(frame, ply.xyz_m[truth.visible[frame][nearest]])[0] * 1e3)
    d = np.concatenate(distances) if distances else np.zeros(0)
    if not len(d):
        return None
    return SkinScore(
        frames=len(distances), median_mm=float(np.median(d)), rms_mm=float(np.sqrt(np.mean(d**2))), p95_mm=float(np.percentile(d, 95))
    )
