"""Poses in which people are found: typical ones of recorded motion, as angles of the `full` model.

poses.csv was made by tests/bench/_pose_dictionary.py from free recordings: walking, running, jumping, dancing, kicking, punching, bending,
waving. Each row is one pose; its mirror image counts too. The first column is the recording, the second how many of the sampled frames are
nearest to that pose, the others are angles in whole degrees, without the heading.

The recordings come from the CMU Graphics Lab Motion Capture Database (mocap.cs.cmu.edu; free for all uses), AnimatedDrawings (Meta
Platforms; MIT licence) and PyMO (O. Alemi; MIT licence).
"""

import csv
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...body.skeleton import Skeleton
from ...foundation import bounded

FILE = Path(__file__).with_name("poses.csv")
LARGEST_BYTES = 1 << 20
OTHER_SIDE = {".R": ".L", ".L": ".R"}


@lru_cache(maxsize=1)
def _rows() -> tuple[dict[str, str], ...]:
    return tuple(csv.DictReader(bounded.text_of(FILE, LARGEST_BYTES).splitlines()))


def known_poses(skeleton: Skeleton, without: tuple[str, ...] = ()) -> np.ndarray:
    """Poses (N, D) of a model's skeleton at the origin, mirror images included; DOFs that the dictionary lacks are at rest.

    `without`: recordings that are left out, for tests on the same recordings.
    """
    dofs = skeleton.dofs[len(skeleton.base_dofs) :]
    poses = np.zeros((0, len(skeleton.dofs)))
    for row in _rows():
        if row["source"] in without:
            continue
        both = np.zeros((2, len(skeleton.dofs)))
        for i, dof in enumerate(dofs, len(skeleton.base_dofs)):
            name, end = dof.name, dof.name.partition(" ")[0][-2:]
            other = name.replace(end, OTHER_SIDE[end]) if end in OTHER_SIDE else name
            sign = 1.0 if dof.axis == "x" else -1.0  # bending forwards stays, turning and leaning change sides
            both[:, i] = np.radians(float(row.get(name, 0.0))), sign * np.radians(float(row.get(other, 0.0)))
        poses = np.concatenate([poses, both])
    return poses
