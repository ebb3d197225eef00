"""The fit: speed of a whole body, and its solver against scipy's on one problem, all in one run.

    python dev.py bench fit [--json FILE]

The scene is the model's own surface seen from the front, with 1 mm noise: 49 DOF, 57 balls, 4,000 points a frame, some 3,300 after
thinning. All of them are in the adjustment of the whole sequence; from frame to frame, which only needs to find a start for it, no more
than `pose_tracking.MOST_POINTS` (1,000) of them are adjusted. Times are CPU times.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "core" / "fitting"))
import limb_scene  # the scenes of the tests

from tricap.core.body.complete import complete_shape
from tricap.core.body.metaballs import field, field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.motion import BodyFit
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames, joint_positions
from tricap.core.fitting.context import FitContext
from tricap.core.fitting.inputs.cloud_points import thinned
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Estimate
from tricap.core.fitting.solve.solver import FURTHEST, solve
from tricap.core.fitting.stages import sequence
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig

POINTS, NOISE_M, FPS = 4000, 0.001, 25.0
POSES = 5  # whose median is compared with scipy's
MOST, EQUAL = 60, 1.01  # steps; the cost that counts as reached, over the worse of what both end with


def rig() -> Rig:
    """Three cameras in a row, 4 m before the person."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    matrix = np.array([[1000, 0, 384], [0, 1000, 288], [0, 0, 1.0]])
    places = zip("LCR", (-0.4, 0.0, 0.4))
    return Rig(
        cameras=tuple(
            Camera(name=name, size_px=(768, 576), matrix=matrix, R_cam_world=R, t_cam_world_m=-R @ np.array([x, -4.0, 0.0]))
            for name, x in places
        )
    )


def walk(shape: BodyShape, frames: int) -> np.ndarray:
    """A motion (T, D): arms and legs swing against each other."""
    motion, layout = np.zeros((frames, len(shape.skeleton.dofs))), shape.skeleton.layout
    phase = 2 * np.pi * np.arange(frames) / FPS
    for side, sign in (("R", 1.0), ("L", -1.0)):
        motion[:, layout[f"hip.{side} flexion"]] = np.radians(25) * sign * np.sin(phase)
        motion[:, layout[f"knee.{side} flexion"]] = np.radians(30 + 20 * sign * np.cos(phase))
        motion[:, layout[f"shoulder.{side} flexion"]] = np.radians(20) * -sign * np.sin(phase)
        motion[:, layout[f"elbow.{side} flexion"]] = np.radians(30)
    motion[:, 1] = -0.04 * np.arange(frames)
    return motion


def cloud(shape: BodyShape, motion: np.ndarray, frame: int, random: np.random.Generator) -> SimpleNamespace:
    """Points on the outside of the whole surface that look at the cameras, by bisection along rays from the bones."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    bones = np.unique(shape.metaballs.bone_index)
    bone = bones[random.choice(len(bones), 4 * POINTS, p=shape.lengths_m[bones] / shape.lengths_m[bones].sum())]
    angle, along = random.uniform(0, 2 * np.pi, len(bone)), random.uniform(0.05, 0.95, len(bone))
    axis = head[bone] + (along * shape.lengths_m[bone])[:, None] * R[bone, :, 1]
    ray = np.cos(angle)[:, None] * R[bone, :, 0] + np.sin(angle)[:, None] * R[bone, :, 2]
    low, high = np.zeros(len(bone)), np.full(len(bone), 0.3)
    for _ in range(14):
        middle = (low + high) / 2
        F = field(shape.metaballs, shape.lengths_m, R, head, axis + middle[:, None] * ray)
        low, high = np.where(F > 0.5, middle, low), np.where(F > 0.5, high, middle)
    gradient = field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, axis + low[:, None] * ray)[1]
    normal = -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    seen = np.flatnonzero(normal[:, 1] < -0.3)[:POINTS]
    X = (axis + low[:, None] * ray)[seen] + NOISE_M * random.normal(size=(len(seen), 1)) * normal[seen]
    covariance = np.broadcast_to(np.eye(3) * NOISE_M**2, (len(X), 3, 3))
    return SimpleNamespace(frame=frame, xyz_m=X, normals=normal[seen], covariance_m2=covariance)


def fit_times(frames: int, settings: FitSettings) -> dict[str, float]:
    """CPU seconds of the stages, and the error of the joints [mm]."""
    shape, random, cameras = default_shape(read_model("full")), np.random.default_rng(0), rig()
    motion = walk(shape, frames)
    clouds = [cloud(shape, m, t, random) for t, m in enumerate(motion)]
    joints = joint_positions(shape.skeleton, shape.lengths_m, motion[0])
    clicks = {name: {c.name: c.project(X) + random.uniform(-3, 3, 2) for c in cameras.cameras} for name, X in joints.items()}
    spent: dict[str, float] = {}
    real = {name: getattr(sequence, name) for name in ("track_poses", "solve", "fit_click_frame", "_covariance")}

    def timed(name: str):
        def call(*args, **kwargs):
            began = time.process_time()
            result = real[name](*args, **kwargs)
            spent[name] = spent.get(name, 0.0) + time.process_time() - began
            return result

        return call

    try:
        for name in real:
            setattr(sequence, name, timed(name))
        given = FitInput(rig=cameras, model="full", clouds=clouds, clicks={0: clicks}, time_s=np.arange(frames) / FPS)
        fit = sequence.fit_sequence(given, settings)
    finally:
        for name, function in real.items():
            setattr(sequence, name, function)
    true = np.stack(list(joint_positions(shape.skeleton, shape.lengths_m, motion).values()), axis=1)
    return {
        "frames": frames,
        "points_a_frame": float(np.mean([len(c.xyz_m) for c in clouds])),
        "click_frame_s": spent["fit_click_frame"],
        "frame_to_frame_ms_a_frame": 1e3 * spent["track_poses"] / max(frames - 1, 1),
        "sequence_ms_a_frame": 1e3 * spent["solve"] / frames,
        "covariance_ms_a_frame": 1e3 * spent["_covariance"] / frames,
        "iterations": fit.iterations,
        "joints_mm": 1e3 * float(np.linalg.norm(fit.motion.joints_m - true, axis=2).mean()),
    }


def against_scipy(settings: FitSettings, seed: int) -> dict[str, float]:
    """One frame's pose from 0.05 rad off: our solver, and scipy's with 2-point differences and with our Jacobian, on the same points.

    `…_s` is until each ends, wherever that is; `…_equal_s` until the cost that both reach, `…_equal_times` that over ours.
    """
    shape, random, cameras = default_shape(read_model("full")), np.random.default_rng(seed), rig()
    motion = walk(shape, 1)
    seen = cloud(shape, motion[0], 0, random)
    points = thinned(seen, settings.voxel_m)
    clicks = {
        name: {c.name: c.project(X) for c in cameras.cameras}
        for name, X in joint_positions(shape.skeleton, shape.lengths_m, motion[0]).items()
    }
    given = FitInput(rig=cameras, model="full", clouds=[seen], clicks={0: clicks}, time_s=np.zeros(1))
    fit: FitContext = sequence.fit_context(given, settings)
    vector = fit.parameters.vector()
    start = motion[0] + random.normal(0, 0.05, motion.shape[1])
    there = fit.parameters.state(motion[0], vector)
    surface = fit.surface(points, there)
    surface = replace(surface, kind="", sigma_m=surface.sigma_m * np.sqrt(surface.variance_inflation), variance_inflation=1.0).reweighted(
        there
    )
    held = [surface, *fit.priors]

    def residual(x: np.ndarray) -> np.ndarray:
        state = fit.parameters.state(x, vector)
        return np.concatenate([o.residual(state) for o in held])

    def jacobian(x: np.ndarray) -> np.ndarray:
        state = fit.parameters.state(x, vector)
        return np.concatenate([o.jacobian(state, shape=False) for o in held])

    def seconds(function, times: int = 3) -> tuple[float, np.ndarray]:
        """The least of some times: what else the machine does only adds."""
        spent = []
        for _ in range(times):
            began = time.process_time()
            found = function()
            spent.append(time.process_time() - began)
        return min(spent), found

    problem = fit.problem(lambda t, state: held)
    ways: dict[str, Callable[[int], np.ndarray]] = {
        "ours": lambda most: solve(problem, Estimate(motion=start[None], vector=vector), steps=most, furthest=FURTHEST).motion[0],
        "scipy_jacobian": lambda most: least_squares(residual, start, jacobian, xtol=1e-4, ftol=1e-4, max_nfev=most).x,
        "scipy_2point": lambda most: least_squares(residual, start, xtol=1e-4, ftol=1e-4, max_nfev=most).x,
    }

    def cost(x: np.ndarray) -> float:
        return float(residual(x) @ residual(x))

    out: dict[str, float] = {"points": len(points.xyz_m)}
    for name, way in ways.items():
        out[f"{name}_s"], x = seconds(lambda way=way: way(MOST), 1 if name == "scipy_2point" else 3)
        out[f"{name}_cost"] = cost(x)
    both = EQUAL * max(out["ours_cost"], out["scipy_jacobian_cost"])  # what each of the two reaches
    steps = {name: next(n for n in range(1, MOST + 1) if cost(ways[name](n)) <= both) for name in ("ours", "scipy_jacobian")}
    steps["scipy_2point"] = steps["scipy_jacobian"]  # the same steps to rounding
    for name, way in ways.items():
        out[f"{name}_equal_s"] = seconds(lambda way=way, n=steps[name]: way(n), 1 if name == "scipy_2point" else 3)[0]
    return out | {f"{name}_equal_times": out[f"{name}_equal_s"] / out["ours_equal_s"] for name in ways if name != "ours"}


def ablation(seeds: int = 4, frames: int = 8) -> list[dict[str, object]]:
    """What each kind of observation and each choice is worth: errors of an arm of unknown shape, 3 mm of noise, seen from the front."""
    base = FitSettings(model_sigma_m=0.001, voxel_m=0.004)
    rows: list[tuple[str, tuple[str, ...], FitSettings]] = [
        ("points", (), base),
        (
            "points, wide priors of the shape",
            (),
            replace(base, length_sigma=1.0, proportion_sigma=1.0, radius_sigma=1.0, roundness_sigma=1.0),
        ),
        ("+ trajectories", ("trajectories",), base),
        ("+ trajectories + outlines", ("trajectories", "contours"), base),
        ("  in turns as published", ("trajectories", "contours"), replace(base, method="alternating")),
        ("  the published residual", ("trajectories", "contours"), replace(base, residual="paper")),
        ("  one ellipsoid a bone", ("trajectories", "contours"), replace(base, balls="one")),
        ("  complete model", ("trajectories", "contours"), replace(base, balls="complete")),
    ]
    scenes = [
        limb_scene.make_scene(frames=frames, seed=s, shape=limb_scene.other_person("arm.R", np.random.default_rng(s))) for s in range(seeds)
    ]
    extra = [{"trajectories": s.trajectories, "contours": limb_scene.outlines(s)} for s in scenes]
    return [{"with": name} | _errors(scenes, [{k: e[k] for k in used} for e in extra], settings) for name, used, settings in rows]


def muscled(shape: BodyShape, random: np.random.Generator) -> BodyShape:
    """A body that no three balls make: the complete model with every muscle 15 % larger or smaller."""
    whole = complete_shape(shape)
    radii = whole.metaballs.radii_m * np.exp(random.normal(0, 0.15, (len(whole.metaballs.weight), 1)))
    return replace(whole, metaballs=replace(whole.metaballs, radii_m=radii))


def of_muscles(seeds: int = 4, frames: int = 8) -> list[dict[str, object]]:
    """What the arrangement of the balls is worth on arms with muscles; 1 mm of noise."""
    settings = FitSettings(model_sigma_m=0.001, voxel_m=0.004)
    scenes = [
        limb_scene.make_scene(
            frames=frames,
            seed=s,
            noise=0.001,
            points=600,
            shape=muscled(limb_scene.other_person("arm.R", np.random.default_rng(s)), np.random.default_rng(s)),
        )
        for s in range(seeds)
    ]
    extra = [{"trajectories": s.trajectories, "contours": limb_scene.outlines(s)} for s in scenes]
    kinds = (
        ("three balls", {}),
        ("one ellipsoid", {"balls": "one"}),
        ("complete", {"balls": "complete"}),
        ("complete, weights free", {"balls": "complete", "weights": True}),
    )
    return [{"with": f"muscles: {name}"} | _errors(scenes, extra, replace(settings, **changes)) for name, changes in kinds]


def _surface_mm(scene: limb_scene.Scene, fit: BodyFit) -> np.ndarray:
    """Distances of true points of the seen surface from the fitted one, in the first frame: the field over its gradient."""
    random, motion = np.random.default_rng(9), scene.motion[0]
    bone = random.integers(0, len(scene.shape.lengths_m), 800)
    X, normal = limb_scene.surface(scene.shape, motion, random.uniform(0.1, 0.9, 800), random.uniform(0, 2 * np.pi, 800), bone)
    X = X[normal @ limb_scene.VIEW < -0.3]
    shape = fit.shape
    R, head = bone_frames(shape.skeleton, shape.lengths_m, fit.motion.values[0])
    F, gradient, *_ = field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, X)
    return np.asarray(1e3 * (F - 0.5) / np.linalg.norm(gradient, axis=1))


def _errors(scenes: list, extra: list[dict], settings: FitSettings) -> dict[str, object]:
    """Errors [mm] of joints across the view and in depth and of the surface, of the radii [%], and of the elbow [deg]; CPU seconds."""
    joints, radii, elbow, seen, began = [], [], [], [], time.process_time()
    for s, more in zip(scenes, extra):
        given = FitInput(rig=s.rig, model=s.model, clouds=s.clouds, clicks={0: s.clicks}, time_s=s.time_s, **more)
        fit = sequence.fit_sequence(given, settings)
        joints.append(fit.motion.joints_m - s.joints_m)
        if len(fit.shape.metaballs.weight) == len(s.shape.metaballs.weight):
            radii.append(np.log(fit.shape.metaballs.radii_m / s.shape.metaballs.radii_m)[:, [0, 2]])
        seen.append(_surface_mm(s, fit))
        at = s.shape.skeleton.layout["elbow.R flexion"]
        elbow.append(np.degrees(fit.motion.values[:, at] - s.motion[:, at]))
    e = 1e3 * np.concatenate(joints)
    return {
        "across_mm": float(np.sqrt((e[..., [0, 2]] ** 2).sum(-1).mean())),
        "depth_mm": float(np.sqrt((e[..., 1] ** 2).mean())),
        "surface_mm": float(np.sqrt((np.concatenate(seen) ** 2).mean())),
        "cpu_s": (time.process_time() - began) / len(scenes),
        "radii_percent": 100 * float(np.sqrt(np.mean(np.concatenate(radii) ** 2))) if radii else float("nan"),
        "elbow_deg": float(np.sqrt(np.mean(np.concatenate(elbow) ** 2))),
    }


def main() -> None:
    """Print a table, and write it as JSON where it is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    settings = FitSettings()
    poses = [against_scipy(settings, seed) for seed in range(1, 1 + POSES)]
    result = {
        "sequence": [fit_times(frames, settings) for frames in (10, 40)],
        "one_frame": {key: float(np.median([row[key] for row in poses])) for key in poses[0]},
        "ablation": [*ablation(), *of_muscles()],
    }
    for row in (*result["sequence"], *poses, result["one_frame"]):
        print("  ".join(f"{key} {value:.4g}" for key, value in row.items()))
    for row in result["ablation"]:
        print("  ".join(f"{value:<34}" if key == "with" else f"{key} {value:6.2f}" for key, value in row.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
