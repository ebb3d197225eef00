"""The state vector of the fit, [S_motion, S_skel] of the papers: who stands where, and the body that a vector means.

One frame's motion (D,) [rad, m] is followed by the shape (S,), which all frames share: ln of the bone lengths (B,), then ln of the cross
radii l_x and l_z of every ball (M, 2), and, where they are free, ln of the balls' weights w (M). Logarithms keep lengths positive and make
their sigmas relative. A ball's centre and its radius along the bone scale with the bone.

Jacobians in blocks: an observation of one body part knows few of the parameters; the zeros are not stored and not multiplied.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from ..body.bone_profile import BoneProfile, bone_profiles, chain_neighbours
from ..body.metaballs import Metaballs
from ..body.shape import BodyShape
from ..body.skeleton import Layout, Skeleton, frames_and_axes
from ..geometry.rotation import cross_matrix
from .part_field import CROSS, Part, cross

__all__ = ["CROSS", "FIRM_PRIOR", "BodyState", "ShapeParameters", "free_bones", "shape_vector"]

FIRM_PRIOR = float(np.radians(20.5))  # a DOF with a prior of a smaller sigma is believed firmly


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyState:
    """A body in one posture."""

    skeleton: Skeleton
    lengths_m: np.ndarray  # (B,)
    balls: Metaballs
    motion: np.ndarray  # (D,)
    parts: tuple[Part, ...]  # B
    weights: bool  # whether they are among the shape's parameters
    R: np.ndarray  # (B, 3, 3) bone frames
    head_m: np.ndarray  # (B, 3) bone heads in the world
    axes: np.ndarray  # (D, 3) axes of the DOFs in the world
    find_profiles: Callable[[], Mapping[int, BoneProfile]]

    @property
    def profiles(self) -> Mapping[int, BoneProfile]:
        """How thick the body is about each bone that has balls, by the bone's index."""
        return self.find_profiles()

    @property
    def n_motion(self) -> int:
        """D."""
        return len(self.motion)

    @property
    def n_shape(self) -> int:
        """S."""
        return len(self.lengths_m) + (3 if self.weights else 2) * len(self.balls.weight)

    @cached_property
    def ball_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """From a world point X to q = (x/l_x, y/l_y, z/l_z) of every ball: X @ (M, 3, 3) − (M, 3)."""
        of, radii = self.balls.bone_index, self.balls.radii_m
        frames = self.R[of] / radii[:, None, :]
        return frames, np.einsum("mi,mij->mj", self.head_m[of], frames) + self.balls.centres_m(self.lengths_m) / radii

    @cached_property
    def screws(self) -> np.ndarray:
        """(D, 4, 3) what a DOF makes of a force g at X: −g · (a × (X − o)) = (1, X) · (screw g); of base DOFs, which shift by a, −g · a."""
        screws, n = np.empty((len(self.axes), 4, 3)), len(self.skeleton.base_dofs)
        screws[:, 0], screws[:, 1:] = cross(self.axes, self.head_m[self.skeleton.dof_bone]), cross_matrix(self.axes)
        screws[:n, 0], screws[:n, 1:] = -self.axes[:n], 0.0
        return screws

    @cached_property
    def log_radii(self) -> np.ndarray:
        """(M,) mean of ln of the balls' cross radii."""
        return np.asarray(np.log(self.balls.radii_m[:, CROSS]).mean(axis=1))

    @cached_property
    def joints_m(self) -> np.ndarray:
        """Joint positions (J, 3)."""
        bones, at_tail = (np.array(column) for column in zip(*self.skeleton.joint_bones))
        return self.head_m[bones] + np.where(at_tail[:, None], self.lengths_m[bones, None] * self.R[bones, :, 1], 0.0)

    @cached_property
    def joint_jacobian(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions (J, 3) and their derivative (J, 3, D + S) to motion and shape."""
        sk, L = self.skeleton, self.lengths_m
        where = sk.joint_bones
        bones = np.array([b for b, _ in where])
        at_tail = np.array([tail for _, tail in where])
        direction = self.R[:, :, 1]
        X = self.head_m[bones] + np.where(at_tail[:, None], L[bones, None] * direction[bones], 0.0)
        jacobian = np.zeros((len(where), 3, self.n_motion + self.n_shape))
        turns = np.cross(self.axes, X[:, None] - self.head_m[sk.dof_bone])
        turns[:, : len(sk.base_dofs)] = np.eye(3)
        jacobian[:, :, : self.n_motion] = np.where(sk.moved_by[bones][..., None], turns, 0.0).transpose(0, 2, 1)
        stretched = sk.offset_by[bones].copy()
        stretched[np.flatnonzero(at_tail), bones[at_tail]] = True
        jacobian[:, :, self.n_motion : self.n_motion + len(L)] = (stretched[..., None] * (L[:, None] * direction)).transpose(0, 2, 1)
        return X, jacobian


def shape_vector(state: BodyState) -> np.ndarray:
    """(S,) of a body: ln of lengths and cross radii, and of weights where they are parameters."""
    return _vector(state.lengths_m, state.balls, state.weights)


def _vector(lengths_m: np.ndarray, balls: Metaballs, weights: bool) -> np.ndarray:
    return np.log(np.concatenate([lengths_m, balls.radii_m[:, CROSS].ravel(), *([balls.weight] if weights else [])]))


def free_bones(parameters: "ShapeParameters") -> np.ndarray:
    """Whether each bone (B,) has balls and a posture that must be seen, because the model does not believe it firmly beforehand."""
    bones, found = parameters.skeleton.bones, np.zeros(parameters.n_lengths, dtype=bool)
    found[parameters.template.metaballs.bone_index] = True
    return found & np.array([any(dof.prior_sigma > FIRM_PRIOR for dof in bone.dofs) for bone in bones])


class ShapeParameters:
    """The owner of the shape vector (S,): names, sets ("lengths", "radii", "weights", "flesh": both, "shape": all), and the way from
    vectors to bodies and back. Weights are parameters only where that is wanted."""

    def __init__(self, template: BodyShape, weights: bool = False) -> None:
        self.template, self.weights = template, weights
        self.skeleton = template.skeleton
        self.n_lengths = len(template.lengths_m)
        self.parts = tuple(Part(self.skeleton, b, template.metaballs.bone_index, weights) for b in range(self.n_lengths))
        self.counted = chain_neighbours(template)
        self._last_body: tuple[bytes, tuple[np.ndarray, Metaballs], dict[int, BoneProfile]] | None = None
        self._last_states: tuple[bytes, list[BodyState]] = (b"", [])
        self.layout = Layout(_names(template, weights), _sets(self.n_lengths, len(template.metaballs.weight), weights))

    def vector(self, shape: BodyShape | None = None) -> np.ndarray:
        """The shape vector (S,) of a body (default: the template)."""
        shape = self.template if shape is None else shape
        return _vector(shape.lengths_m, shape.metaballs, self.weights)

    def body(self, vector: np.ndarray) -> tuple[np.ndarray, Metaballs]:
        """Lengths (B,) [m] and balls of a shape vector; what is not estimated comes from the template. The last one is kept."""
        key = vector.tobytes()
        if self._last_body is None or self._last_body[0] != key:
            self._last_body = key, self._body(vector), {}
        return self._last_body[1]

    def _body(self, vector: np.ndarray) -> tuple[np.ndarray, Metaballs]:
        balls, old = self.template.metaballs, self.template.lengths_m
        lengths, radii = np.exp(vector[: self.n_lengths]), balls.radii_m.copy()
        radii[:, 1] *= (lengths / old)[balls.bone_index]
        radii[:, CROSS] = np.exp(vector[self.layout.group("radii")]).reshape(-1, 2)
        weight = np.exp(vector[self.layout.group("weights")]) if self.weights else balls.weight
        return lengths, Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=radii, weight=weight)

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices (K,), (K,) of the parameters that a left and a right limb share by name."""
        names = self.layout.names
        right = [i for i, name in enumerate(names) if ".R" in name and name.replace(".R", ".L") in names]
        left = [self.layout[names[i].replace(".R", ".L")] for i in right]
        return np.array(left, dtype=np.intp), np.array(right, dtype=np.intp)

    def state(self, motion: np.ndarray, vector: np.ndarray) -> BodyState:
        """The body of a shape vector (S,) in the posture of a motion vector (D,)."""
        return self.states(np.asarray(motion)[None], vector)[0]

    def profiles(self, vector: np.ndarray) -> dict[int, BoneProfile]:
        """The profiles of the bones of a shape vector (S,); the last ones are kept."""
        lengths, balls = self.body(vector)
        assert self._last_body is not None
        found = self._last_body[2]
        if not found:
            found.update(bone_profiles(self.skeleton, lengths, balls, self.counted))
        return found

    def states(self, motion: np.ndarray, vector: np.ndarray) -> list[BodyState]:
        """The body of a shape vector (S,) in T postures (T, D). The last are kept: derivatives follow a cost at the same place."""
        key = b"".join((vector.tobytes(), np.asarray(motion, dtype=np.float64).tobytes()))
        if self._last_states[0] != key:
            self._last_states = key, self._states(np.asarray(motion, dtype=np.float64), np.array(vector))
        return self._last_states[1]

    def _states(self, motion: np.ndarray, vector: np.ndarray) -> list[BodyState]:
        lengths, balls = self.body(vector)
        forward = frames_and_axes(self.skeleton, lengths, motion)
        return [
            BodyState(
                skeleton=self.skeleton,
                lengths_m=lengths,
                balls=balls,
                motion=m,
                parts=self.parts,
                R=R,
                head_m=head,
                axes=axes,
                weights=self.weights,
                find_profiles=partial(self.profiles, vector),
            )
            for m, R, head, axes in zip(motion, *forward)
        ]

    def shape(self, vector: np.ndarray, sigma: np.ndarray) -> BodyShape:
        """The body's shape with sigmas, from the vector (S,) and the sigma of its logarithms (S,)."""
        lengths, balls = self.body(vector)
        n = self.n_lengths
        length_sigma, radius_sigma = sigma[:n] * lengths, np.empty_like(balls.radii_m)
        radius_sigma[:, CROSS] = sigma[self.layout.group("radii")].reshape(-1, 2) * balls.radii_m[:, CROSS]
        radius_sigma[:, 1] = sigma[balls.bone_index] * balls.radii_m[:, 1]
        return BodyShape(
            model=self.template.model,
            skeleton=self.skeleton,
            lengths_m=lengths,
            metaballs=balls,
            length_sigma_m=length_sigma,
            radius_sigma_m=radius_sigma,
            weight_sigma=sigma[self.layout.group("weights")] * balls.weight if self.weights else None,
        )


def _names(shape: BodyShape, weights: bool) -> list[str]:
    bones = shape.skeleton.bones
    names, count, balls = [f"length {bone.name}" for bone in bones], [0] * len(bones), []
    for b in shape.metaballs.bone_index.tolist():
        count[b] += 1
        balls.append(f"{bones[b].name} {count[b]}")
    return names + [f"radius {ball} {axis}" for ball in balls for axis in "xz"] + [f"weight {ball}" for ball in balls if weights]


def _sets(n_lengths: int, n_balls: int, weights: bool) -> dict[str, range]:
    n, last = n_lengths + 2 * n_balls, n_lengths + (3 if weights else 2) * n_balls
    return dict(
        lengths=range(n_lengths), radii=range(n_lengths, n), weights=range(n, last), flesh=range(n_lengths, last), shape=range(last)
    )


Block = tuple[np.ndarray, np.ndarray, np.ndarray]  # rows (n,), columns (c,) of D + S, values (n, c)


class FromBlocks:
    """An observation that gives its Jacobian in blocks; every row is in one block only."""

    __slots__ = ()

    @property
    def size(self) -> int:
        """Number of residuals."""
        raise NotImplementedError

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """The blocks of the derivative to motion and shape, or to motion."""
        raise NotImplementedError

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """The whole derivative (n, D + S), or (n, D) without shape."""
        J = np.zeros((self.size, state.n_motion + (state.n_shape if shape else 0)))
        for rows, columns, block in self.blocks(state, shape):
            J[rows[:, None], columns] = block
        return J
