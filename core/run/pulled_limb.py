"""A fitted body, read back to show the limb whose joint is dragged over the footage: its pose, and its outline in every view."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..body.shape import read_body
from ..body.skin.fingers import shape_for_skin
from ..body.skin.mesh import SkinSettings
from ..body.skin.person_skin import REST, OneSkin, cage, read_skin
from ..body.skin.posed import Poser
from ..fitting.stages.pulled import moved_by_pull, pulled_pose
from ..fitting.state import ShapeParameters
from ..foundation.errors import InputError
from ..foundation.settings import from_table
from ..geometry.camera import Camera
from ..motion.tables import MotionTable, read_motion
from ..results.run_json import read_run

MINE = 0.5  # a vertex belongs to the bones that have at least this part of its weights


@dataclass(frozen=True, eq=False)
class FittedLimbs:
    """A fitted body with its motion and, if there is one, its skin."""

    parameters: ShapeParameters
    motion: MotionTable
    skin: OneSkin | None

    @staticmethod
    def read(out: Path) -> "FittedLimbs":
        """From a folder of results.

        Raises:
            InputError: there is no fitted body, or a file is damaged.
        """
        out = Path(out)
        for name in ("body.toml", "motion.csv", "run.json"):
            if not (out / name).is_file():
                raise InputError(f"There is no fitted body yet: {name} is not in {out}; run step 6 first.")
        settings = from_table(SkinSettings, read_run(out / "run.json").get("settings", {}).get("skin", {}), "[skin] of run.json")
        person, rest = shape_for_skin(read_body(out / "body.toml"), settings), out / "skin" / REST
        skin = read_skin(rest, person) if rest.is_file() else None
        return FittedLimbs(ShapeParameters(person), read_motion(out / "motion.csv", person.skeleton), skin)

    def limb(self, frame: int, joint: str) -> "PulledLimb":
        """What moves when a joint is dragged in a frame.

        Raises:
            InputError: no body was fitted in this frame, or it has no such joint.
        """
        if joint not in self.parameters.skeleton.joint_names:
            raise InputError(f"The fitted body has no joint “{joint}”.")
        rows = np.flatnonzero(self.motion.frames == frame)
        if not len(rows):
            raise InputError(f"No body was fitted in frame {frame}; go to another frame, or click the joints there.")
        bones = moved_by_pull(self.parameters, joint)[1]
        skin = None if self.skin is None else _Skin.of(self.skin, self.parameters, bones)
        return PulledLimb(self.parameters, self.motion.values[rows[0]], joint, bones, skin)


@dataclass(frozen=True, eq=False)
class PulledLimb:
    """A joint that is dragged, the pose (D,) in which it was fitted, the bones (K,) that move with it, and their skin."""

    parameters: ShapeParameters
    fitted: np.ndarray
    joint: str
    bones: np.ndarray
    skin: "_Skin | None"

    def pose(self, xyz_m: np.ndarray) -> np.ndarray:
        """The pose (D,) with the joint at a place (3,) [m], or as near as its limb reaches."""
        return pulled_pose(self.parameters, self.fitted, self.joint, xyz_m)

    def joint_m(self, pose: np.ndarray) -> np.ndarray:
        """The joint (3,) [m] in a pose (D,)."""
        row = self.parameters.skeleton.joint_names.index(self.joint)
        return np.asarray(self.parameters.state(pose, self.parameters.vector()).joints_m[row])

    def bones_m(self, pose: np.ndarray) -> np.ndarray:
        """Heads and tails (K, 2, 3) [m] of the bones in a pose (D,)."""
        state = self.parameters.state(pose, self.parameters.vector())
        tails = state.head_m + state.lengths_m[:, None] * state.R[:, :, 1]
        return np.stack([state.head_m, tails], axis=1)[self.bones]

    def outlines_m(self, pose: np.ndarray, *cameras: Camera) -> list[np.ndarray]:
        """The outline of the skin as each camera sees it in a pose (D,): segments (N, 2, 3) [m]; none without a skin."""
        if self.skin is None:
            return [np.zeros((0, 2, 3)) for _ in cameras]
        vertices_m = self.skin.poser.posed(self.skin.vertices_m, pose)
        return [vertices_m[self.skin.outline(vertices_m, camera.centre_m)] for camera in cameras]


@dataclass(frozen=True, eq=False)
class _Skin:
    """The skin of some bones, of the cage's quads (F, 4): a few thousand are enough to draw by. Inner edges: their ends (E, 2), and the two
    quads (E, 2) at each."""

    poser: Poser
    vertices_m: np.ndarray  # (V, 3)
    faces: np.ndarray
    edges: np.ndarray
    sides: np.ndarray

    @staticmethod
    def of(skin: OneSkin, parameters: ShapeParameters, bones: np.ndarray) -> "_Skin":
        """The quads all of whose vertices belong to the bones (K,)."""
        rows, faces = cage(skin)
        mine = skin.weights[rows][:, bones].sum(axis=1) >= MINE
        used, faces = np.unique(faces[mine[faces].all(axis=1)], return_inverse=True)
        faces = faces.reshape(-1, 4)
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        quad = np.repeat(np.arange(len(faces)), 4)
        order = np.lexsort(ends.T)
        ends, quad = ends[order], quad[order]
        pair = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))  # an edge at the border has one quad
        sides = np.stack([quad[pair], quad[pair + 1]], axis=1)
        return _Skin(Poser(parameters.template, skin.weights[rows[used]]), skin.vertices_m[rows[used]], faces, ends[pair], sides)

    def outline(self, vertices_m: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
        """Ends (N, 2) of the edges between a quad that faces a camera's centre (3,) and one that does not."""
        a, b, c, d = (vertices_m[self.faces[:, k]] for k in range(4))
        facing = np.einsum("fi,fi->f", np.cross(c - a, d - b), centre_m - a) > 0
        return self.edges[facing[self.sides[:, 0]] != facing[self.sides[:, 1]]]
