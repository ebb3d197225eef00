"""Make core/fitting/start/poses.csv from free recordings of motion: python _pose_dictionary.py OUT.csv COUNT FILE.bvh …

Eight frames a second are taken as directions of trunk and limbs, without the heading. The poses of the dictionary are those furthest from
each other (Gonzalez 1985), where a pose stands for its mirror image, too. Each is then posed on the `full` model by its joints.
"""

import sys
from pathlib import Path

import numpy as np

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.inputs.clicks import Clicks
from tricap.core.fitting.observations import Keypoints
from tricap.core.fitting.solve.problem import Estimate, Problem
from tricap.core.fitting.solve.solver import solve
from tricap.core.fitting.stages.inverse_kinematics import coarse_pose, dof_priors
from tricap.core.fitting.state import ShapeParameters
from tricap.core.geometry.rotation import axis_rotation, unit
from tricap.core.motion.formats.bvh import read_bvh
from tricap.core.motion.retarget.rig import Motion

PER_SECOND = 8
SHAPE = default_shape(read_model("full"))
SKELETON, PARAMETERS = SHAPE.skeleton, ShapeParameters(SHAPE)
LENGTH = dict(zip((bone.name for bone in SKELETON.bones), SHAPE.lengths_m))
REST = {name: X[0] for name, X in joint_positions(SKELETON, SHAPE.lengths_m, np.zeros((1, len(SKELETON.dofs)))).items()}
NAMES = {  # of the bones that begin at a joint: most files, those with “LeftKnee”, and CMU's own
    "hip": ("UpLeg", "Hip", "femur"),
    "knee": ("Leg", "Knee", "tibia"),
    "ankle": ("Foot", "Ankle", "foot"),
    "toe": ("ToeBase", "Toe", "toes"),
    "shoulder": ("Arm", "Shoulder", "humerus"),
    "elbow": ("ForeArm", "Elbow", "radius"),
    "wrist": ("Hand", "Wrist", "wrist"),
}
CHAIN = (("shoulder", "elbow", "upper_arm", 0.8), ("elbow", "wrist", "forearm", 0.7), ("hip", "knee", "thigh", 1.2),
         ("knee", "ankle", "shin", 1.0), ("ankle", "toe", "foot", 0.2))  # fmt: skip
# directions by which poses are compared, with their weights: across the hips and shoulders, the trunk, then the limbs of either side
COMPARED = [("hip.R", "hip.L", 0.5), ("shoulder.R", "shoulder.L", 0.7), ("pelvis", "neck", 1.5)]
COMPARED += [(f"{a}.{side}", f"{b}.{side}", weight) for side in "LR" for a, b, _, weight in CHAIN]
MIRRORED = [0, 1, 2, *range(3 + len(CHAIN), 3 + 2 * len(CHAIN)), *range(3, 3 + len(CHAIN))]
SIGMA_M, TOE_SIGMA_M = 0.02, 0.06


def heads(motion: Motion) -> dict[str, np.ndarray]:
    """The joints (T, 3) of a recording."""
    names = list(motion.rig.names)
    kind = 2 if "lfemur" in names else 1 if "LeftKnee" in names else 0
    found = {
        f"{joint}.{side[0]}": motion.head_m[:, names.index((side[0].lower() if kind == 2 else side) + words[kind])]
        for joint, words in NAMES.items()
        for side in ("Left", "Right")
    }
    return found | {"head": motion.head_m[:, names.index("head" if kind == 2 else "Head")]}


def on_model(at: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The joints of one frame with the model's lengths, the pelvis at the origin, facing −Y."""
    hips, shoulders = ((at[f"{part}.L"] + at[f"{part}.R"]) / 2 for part in ("hip", "shoulder"))
    up, middle = unit(shoulders - hips), (REST["shoulder.L"] + REST["shoulder.R"]) / 2
    chest = up * np.linalg.norm(middle - REST["pelvis"])
    placed = {"pelvis": np.zeros(3), "neck": chest + up * np.linalg.norm(REST["neck"] - middle)}
    for part, origin in (("hip", np.zeros(3)), ("shoulder", chest)):
        half = unit(at[f"{part}.L"] - at[f"{part}.R"]) * np.linalg.norm(REST[f"{part}.L"] - REST[f"{part}.R"]) / 2
        placed |= {f"{part}.L": origin + half, f"{part}.R": origin - half}
    for side in "LR":
        for a, b, bone, _ in CHAIN:
            placed[f"{b}.{side}"] = placed[f"{a}.{side}"] + LENGTH[f"{bone}.{side}"] * unit(at[f"{b}.{side}"] - at[f"{a}.{side}"])
    placed["head"] = placed["neck"] + LENGTH["neck"] * unit(at["head"] - shoulders)
    left = placed["hip.L"] - placed["hip.R"] + placed["shoulder.L"] - placed["shoulder.R"]
    turn = axis_rotation("z", -np.arctan2(left[1], left[0]))
    return {name: turn @ X for name, X in placed.items()}


def furthest(features: np.ndarray, count: int) -> tuple[list[int], np.ndarray]:
    """The rows of features (N, K, 3) furthest from each other, and how many rows are nearest to each."""
    other = features[:, MIRRORED] * [-1, 1, 1]
    other[:, :2] *= -1  # across the body: from right to left again
    flat, mirror = features.reshape(len(features), -1), other.reshape(len(features), -1)

    def away(i: int) -> np.ndarray:
        return np.minimum(np.linalg.norm(flat - flat[i], axis=1), np.linalg.norm(mirror - flat[i], axis=1))

    chosen = [int(np.argmin(np.linalg.norm(flat - np.median(flat, axis=0), axis=1)))]
    distance, owner = away(chosen[0]), np.zeros(len(flat), dtype=int)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        now = away(chosen[-1])
        owner[now < distance] = len(chosen) - 1
        distance = np.minimum(distance, now)
    return chosen, np.bincount(owner, minlength=count)


def angles(at: dict[str, np.ndarray]) -> np.ndarray:
    """The model's angles [°] for joints."""
    names = SKELETON.joint_names
    xyz = np.stack([at.get(name, np.full(3, np.nan)) for name in names])
    rows = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    sigma = np.array([TOE_SIGMA_M if names[j].startswith("toe") else SIGMA_M for j in rows])
    seen, priors = Keypoints(joint=rows, xyz_m=xyz[rows], sigma_m=sigma), dof_priors(SKELETON, np.radians(2.0), np.zeros(3))
    start = coarse_pose(PARAMETERS, Clicks(observations=(seen,), xyz_m=xyz))
    problem = Problem(parameters=PARAMETERS, observe=lambda t, state: [seen, *priors], fixed=SKELETON.locked)
    found = solve(problem, Estimate(motion=start[None], vector=PARAMETERS.vector()), steps=60)
    return np.degrees(found.motion[0, len(SKELETON.base_dofs) :])


def main(out: str, count: str, *files: str) -> None:
    """Write the dictionary."""
    poses, sources = [], []
    for path in map(Path, files):
        motion = read_bvh(path)
        joints = heads(motion)
        for t in range(0, len(motion.frames), max(1, round(motion.fps / PER_SECOND))):
            poses.append(on_model({name: X[t] for name, X in joints.items()}))
            sources.append(path.stem)
    features = np.array([[weight * unit(pose[b] - pose[a]) for a, b, weight in COMPARED] for pose in poses])
    chosen, frames = furthest(features, int(count))
    lines = [",".join(["source", "frames", *SKELETON.dof_names[len(SKELETON.base_dofs) :]])]
    for i, n in zip(chosen, frames):
        lines.append(",".join([sources[i], str(n), *(str(int(a)) for a in np.rint(angles(poses[i])))]))
    Path(out).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
