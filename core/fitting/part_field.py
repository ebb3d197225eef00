"""The field of one body part at world points, and its derivatives to the whole state (the chain rule of every surface observation).

A bone j whose balls give the gradient g_j at X moves under DOF k with the velocity a_k × (X − o_k); X stays where it was measured, so
    ∂F/∂θ_k = −Σ_j g_j · (a_k × (X − o_k))    over the bones j that k turns                              (1)
    ∂F/∂ln L_a = −L_a y_a · Σ_j g_j           over the bones j that L_a shifts, and, in bone a's own axes,
               + Σ_{i ∈ a} (∂F_i/∂ln l_y − ∇_local F_i · c_i)                                            (2)
    ∂F/∂ln l = 4 q² w exp(−2d) ,   ∂F/∂ln w = w exp(−2d)                                                 (3)

A part knows few of the parameters: derivatives are given for its own columns only.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..body.metaballs import VISIBLE
from ..body.skeleton import Skeleton

if TYPE_CHECKING:
    from .state import BodyState

CROSS = [0, 2]  # the two axes across a bone
SMALLEST, LINEAR = 1e-250, 0.03


def distance(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """D = √(−½ ln F) − √(½ ln 2) and dD/dF of values (N,) of a field; inside, where −½ ln F falls below `LINEAR`, along its tangent."""
    F = np.maximum(F, SMALLEST)
    u = -0.5 * np.log(F)
    root = np.sqrt(np.maximum(u, LINEAR))
    return root + np.minimum(u - LINEAR, 0.0) / (2 * np.sqrt(LINEAR)) - VISIBLE, -0.25 / (F * root)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of vectors (…, 3), a fifth of numpy's time for few."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


@dataclass(frozen=True, eq=False)
class Part:
    """The balls that make the surface of one bone's part (its own, its parent's, its children's), and the parameters that move them."""

    skeleton: Skeleton
    bone: int
    bone_index: np.ndarray  # (M,) of all balls
    weights: bool = False  # whether the balls' weights are parameters too

    @cached_property
    def balls(self) -> np.ndarray:
        """(m,) the part's balls among all, bone after bone."""
        mine = np.flatnonzero(self.skeleton.neighbours[self.bone, self.bone_index])
        return mine[np.argsort(self.bone_index[mine], kind="stable")]

    @cached_property
    def bones(self) -> list[tuple[int, slice]]:
        """The bones that carry the part's balls, and which of its balls each carries."""
        bones, first = np.unique(self.bone_index[self.balls], return_index=True)
        ends = [*first[1:].tolist(), len(self.balls)]
        return [(int(b), slice(int(i), int(j))) for b, i, j in zip(bones, first, ends)]

    @cached_property
    def bone_of_ball(self) -> np.ndarray:
        """(m,) which of its bones carries each of its balls."""
        return np.repeat(np.arange(len(self.bones)), [own.stop - own.start for _, own in self.bones])

    @cached_property
    def dofs(self) -> np.ndarray:
        """(d,) the DOFs that move any of its balls, base first."""
        n = len(self.skeleton.base_dofs)
        moved = np.any([self.skeleton.moved_by[b] for b, _ in self.bones], axis=0)
        moved[:n] = True
        return np.flatnonzero(moved)

    @cached_property
    def lengths(self) -> np.ndarray:
        """(k,) the bones whose lengths move any of its balls."""
        on = np.any([self.skeleton.offset_by[b] for b, _ in self.bones], axis=0)
        on[[b for b, _ in self.bones]] = True
        return np.flatnonzero(on)

    @cached_property
    def chain(self) -> tuple[np.ndarray, np.ndarray]:
        """The DOFs (d,), base first, and the lengths (l,) that move the bone itself."""
        moved = self.skeleton.moved_by[self.bone].copy()
        moved[: len(self.skeleton.base_dofs)] = True
        return np.flatnonzero(moved), np.flatnonzero(self.skeleton.offset_by[self.bone])

    def columns(self, shape: bool) -> np.ndarray:
        """Its columns (c,) in a Jacobian of the whole state (D + S)."""
        return self._all_columns if shape else self.dofs

    @cached_property
    def _all_columns(self) -> np.ndarray:
        D, B = len(self.skeleton.dofs), len(self.skeleton.bones)
        radii = D + B + 2 * self.balls[:, None] + np.arange(2)
        weights = D + B + 2 * len(self.bone_index) + self.balls if self.weights else self.balls[:0]
        return np.concatenate([self.dofs, D + self.lengths, radii.ravel(), weights])

    @cached_property
    def of_radii(self) -> slice:
        """Where the cross radii of its balls (2m) stand among its columns."""
        first = len(self.dofs) + len(self.lengths)
        return slice(first, first + 2 * len(self.balls))

    @cached_property
    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """For each of its bones whether each of its DOFs moves it (k, d), and whether each of its lengths shifts it (k, l)."""
        bones, n = np.array([b for b, _ in self.bones]), len(self.skeleton.base_dofs)
        moved = self.skeleton.moved_by[np.ix_(bones, self.dofs)].astype(float)
        moved[:, :n] = 1.0
        return moved, self.skeleton.offset_by[np.ix_(bones, self.lengths)].astype(float)


class PartField:
    """The field of a part of one body at world points (N, 3). What is asked for is computed once."""

    def __init__(self, part: Part, state: "BodyState", xyz_m: np.ndarray) -> None:
        self.part, self.state, self.xyz_m = part, state, xyz_m
        frames, shifts = state.ball_frames
        m = len(part.balls)
        self._W = frames[part.balls].transpose(1, 2, 0).reshape(3, 3 * m)  # columns: the balls' x axes, then y, then z, in units of 1/l
        self._q = xyz_m @ self._W - shifts[part.balls].T.ravel()  # (N, 3m)
        squares = self._q * self._q
        d = squares[:, :m] + squares[:, m : 2 * m] + squares[:, 2 * m :]
        self.terms = state.balls.weight[part.balls] * np.exp(-2 * d)

    @cached_property
    def F(self) -> np.ndarray:
        """(N,)"""
        return self.terms.sum(axis=1)

    @cached_property
    def distance(self) -> tuple[np.ndarray, np.ndarray]:
        """D (N,) and dD/dF (N,) of the values."""
        return distance(self.F)

    @cached_property
    def gradient(self) -> np.ndarray:
        """(N, 3) in the world's axes."""
        return np.asarray(np.add.reduce(self._bone_gradients, axis=1))

    @cached_property
    def shares(self) -> np.ndarray:
        """(N, m) which part of F comes from which of the balls."""
        return self.terms / np.maximum(self.F, 1e-300)[:, None]

    def jacobian(self, shape: bool) -> np.ndarray:
        """Derivative (N, c) of F to the part's columns."""
        motion = self._to_motion()
        return np.concatenate([motion, self._to_shape()], axis=1) if shape else motion

    @cached_property
    def _bone_gradients(self) -> np.ndarray:
        """(N, k, 3) the part of the gradient that comes from each of the part's bones."""
        (n, m), k = self.terms.shape, len(self.part.bones)
        pulls = (self._q.reshape(n, 3, m) * self.terms[:, None]).reshape(n, 3 * m)
        table = np.zeros((3, m, k, 3))
        table[:, np.arange(m), self.part.bone_of_ball] = -4 * self._W.reshape(3, 3, m).transpose(1, 2, 0)
        return (pulls @ table.reshape(3 * m, 3 * k)).reshape(-1, k, 3)

    def _to_motion(self) -> np.ndarray:
        """(1), for all bones at once: the sum over the bones is a product with a table of the DOFs' screws."""
        part, X, (n, k, _) = self.part, self.xyz_m, self._bone_gradients.shape
        screws = self.state.screws[part.dofs].transpose(2, 1, 0)  # (3, 4, d)
        table = (part.tables[0][:, None, None] * screws).reshape(3 * k, -1)
        terms = (self._bone_gradients.reshape(n, 3 * k) @ table).reshape(n, 4, -1)
        J = terms[:, 0]
        for c in range(3):
            J = J + terms[:, 1 + c] * X[:, c, None]
        return np.asarray(J)

    def _to_shape(self) -> np.ndarray:
        state, part = self.state, self.part
        n, m = self.terms.shape
        q = self._q.reshape(n, 3, m)
        stretch = state.lengths_m[part.lengths, None] * state.R[part.lengths, :, 1]
        table = np.einsum("kl,li->kil", part.tables[1], stretch).reshape(-1, len(part.lengths))
        lengths = -self._bone_gradients.reshape(n, -1) @ table
        centres = state.balls.centre[part.balls] * state.lengths_m[state.balls.bone_index[part.balls], None]
        offset = (centres / state.balls.radii_m[part.balls]).T  # (3, m)
        own = 4 * self.terms * (q[:, 1] ** 2 + (q * offset).sum(axis=1))
        for b, balls in part.bones:
            lengths[:, np.searchsorted(part.lengths, b)] += own[:, balls].sum(axis=1)  # (2)
        cross = 4 * self.terms[..., None] * np.stack([q[:, 0] ** 2, q[:, 2] ** 2], axis=2)  # (3)
        weights = self.terms if part.weights else self.terms[:, :0]
        return np.concatenate([lengths, cross.reshape(n, -1), weights], axis=1)
