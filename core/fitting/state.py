"""The state vector of the fit, [S_motion, S_skel] of D'Apuzzo et al. 1999: the layout of its parameters, and the body that a vector means.

The pose of one frame (D,) [rad, m] is followed by the shape (S,), which all frames share: ln of the bone lengths (B,), then ln of the cross
radii l_x and l_z of every ball (M, 2), where they are free ln of the balls' weights w (M), and ln (bend + BACK) of the fingers of each hand
(H), which metaballs do not have. Logarithms keep lengths positive and make their sigmas relative. A ball's centre and its radius along the
bone scale with the bone.

Jacobians in blocks: an observation of one body part depends on few parameters; the zeros are neither stored nor multiplied.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from ..body.metaballs import Metaballs
from ..body.parts import BoneProfile, ProfileTable, bone_profiles, chain_neighbours
from ..body.shape import BodyShape, FingerBend
from ..body.skeleton import Layout, Skeleton, frames_and_axes
from ..body.skin.hand_template import BENDS, RELAXED
from ..geometry.rotation import cross, cross_matrix
from .hands import BACK, hands_of

CROSS = [0, 2]  # the two axes across a bone
FIRM_PRIOR = float(np.radians(20.5))  # a DOF whose prior has a smaller sigma needs no observations of its own


class ParameterLayout(Layout):
    """The one owner of the order of the parameters.

    Names and groups ("lengths", "radii", "weights", "flesh": radii and weights, "bends", "shape": all) give indices in the shape vector
    (S,), as in any `Layout`. The methods give columns of Jacobians:

        of one frame:    pose (D) | ln L (B) | ln l_x, ln l_z, ball by ball (2M) | ln w (M), where weights are free | bends (H)
        of two frames:   pose of the first (D) | pose of the second (D) | shape (S)
    """

    def __init__(self, template: BodyShape, free_weights: bool) -> None:
        self.n_pose, self.n_bones, self.n_balls = len(template.skeleton.dofs), len(template.lengths_m), len(template.metaballs.weight)
        self.free_weights, self.hands = free_weights, hands_of(template.skeleton)
        first_weight = self.n_bones + 2 * self.n_balls
        end = first_weight + (self.n_balls if free_weights else 0)
        groups = dict(
            lengths=range(self.n_bones),
            radii=range(self.n_bones, first_weight),
            weights=range(first_weight, end),
            flesh=range(self.n_bones, end),
            bends=range(end, end + len(self.hands)),
            shape=range(end + len(self.hands)),
        )
        super().__init__(_names(template, free_weights), groups)

    @property
    def n_shape(self) -> int:
        """S."""
        return len(self)

    def size(self, shape: bool = True) -> int:
        """The number of columns: D + S, or D without the shape."""
        return self.n_pose + (self.n_shape if shape else 0)

    def empty_jacobian(self, rows: int, shape: bool = True) -> np.ndarray:
        """Zeros (rows, D + S), or (rows, D) without the shape."""
        return np.zeros((rows, self.size(shape)))

    def columns(self, group: str) -> np.ndarray:
        """The columns of a group of shape parameters."""
        return self.shape_columns(self.group(group))

    def shape_columns(self, indices: np.ndarray) -> np.ndarray:
        """The columns of some shape parameters, by their indices (K,) in the shape vector."""
        return self.n_pose + indices

    def lengths(self, bones: np.ndarray) -> np.ndarray:
        """The columns of the lengths of some bones (K,)."""
        return self.n_pose + bones

    def radii(self, balls: np.ndarray) -> np.ndarray:
        """The columns (K, 2) of l_x and l_z of some balls (K,)."""
        return np.asarray(self.n_pose + self.n_bones + 2 * balls[:, None] + np.arange(2))

    def weights(self, balls: np.ndarray) -> np.ndarray:
        """The columns of the weights of some balls (K,), where weights are free."""
        return self.n_pose + self.n_bones + 2 * self.n_balls + balls

    def bend(self, hand: int) -> int:
        """The column of the bend of the fingers of a hand, a bone."""
        return int(self.columns("bends")[self.hands.index(hand)])

    def split(self, columns: np.ndarray, frames: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Ascending columns (c,) of a Jacobian of one or two frames, as pose columns and indices of shape parameters."""
        first = frames * self.n_pose
        n = int(np.searchsorted(columns, first))
        return columns[:n], columns[n:] - first

    def two_frames(self, dofs: np.ndarray, bones: np.ndarray, shape: bool) -> np.ndarray:
        """The columns, in a Jacobian of two frames, of some DOFs (d,) of the first, the same of the second, and lengths of bones (l,)."""
        return np.concatenate([dofs, self.n_pose + dofs, *([2 * self.n_pose + bones] if shape else [])])

    def one_of_two(self, columns: np.ndarray, second: bool) -> tuple[np.ndarray, np.ndarray]:
        """Which columns (c,) of a Jacobian of two frames belong to one of them, or to the shape, and their columns in its own."""
        D, first = self.n_pose, self.n_pose if second else 0
        own = ((columns >= first) & (columns < first + D)) | (columns >= 2 * D)
        mine = columns[own]
        return own, np.where(mine < 2 * D, mine - first, mine - D)


@dataclass(frozen=True, eq=False)
class Part:
    """The balls that make the surface of one bone's part (its own, its parent's, its children's), and the parameters that move them."""

    skeleton: Skeleton
    bone: int
    bone_index: np.ndarray  # (M,) of all balls
    layout: ParameterLayout

    @cached_property
    def balls(self) -> np.ndarray:
        """(m,) indices of the part's balls, bone after bone."""
        mine = np.flatnonzero(self.skeleton.neighbours[self.bone, self.bone_index])
        return mine[np.argsort(self.bone_index[mine], kind="stable")]

    @cached_property
    def bones(self) -> list[tuple[int, slice]]:
        """The bones of the part's balls, each with the slice of its balls in `balls`."""
        bones, first = np.unique(self.bone_index[self.balls], return_index=True)
        ends = [*first[1:].tolist(), len(self.balls)]
        return [(int(b), slice(int(i), int(j))) for b, i, j in zip(bones, first, ends)]

    @cached_property
    def bone_of_ball(self) -> np.ndarray:
        """(m,) for each of `balls` the index of its bone in `bones`."""
        return np.repeat(np.arange(len(self.bones)), [own.stop - own.start for _, own in self.bones])

    @cached_property
    def dofs(self) -> np.ndarray:
        """(d,) the DOFs that move any of the balls, base first."""
        n = len(self.skeleton.base_dofs)
        moved = np.any([self.skeleton.moved_by[b] for b, _ in self.bones], axis=0)
        moved[:n] = True
        return np.flatnonzero(moved)

    @cached_property
    def lengths(self) -> np.ndarray:
        """(k,) the bones whose lengths move any of the balls."""
        on = np.any([self.skeleton.offset_by[b] for b, _ in self.bones], axis=0)
        on[[b for b, _ in self.bones]] = True
        return np.flatnonzero(on)

    @cached_property
    def chain(self) -> tuple[np.ndarray, np.ndarray]:
        """The DOFs (d,), base first, and the bones (l,) whose lengths move the bone itself."""
        moved = self.skeleton.moved_by[self.bone].copy()
        moved[: len(self.skeleton.base_dofs)] = True
        return np.flatnonzero(moved), np.flatnonzero(self.skeleton.offset_by[self.bone])

    def columns(self, shape: bool) -> np.ndarray:
        """The part's columns (c,) in a Jacobian of the whole state (D + S)."""
        return self._all_columns if shape else self.dofs

    @cached_property
    def _all_columns(self) -> np.ndarray:
        at, balls = self.layout, self.balls
        weights = at.weights(balls) if at.free_weights else balls[:0]
        return np.concatenate([self.dofs, at.lengths(self.lengths), at.radii(balls).ravel(), weights])

    @cached_property
    def radius_columns(self) -> slice:
        """The positions of the balls' cross radii (2m) within `columns`."""
        first = len(self.dofs) + len(self.lengths)
        return slice(first, first + 2 * len(self.balls))

    @cached_property
    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """For each of `bones` whether each of `dofs` moves it (k, d), and whether each of `lengths` shifts it (k, l)."""
        bones, n = np.array([b for b, _ in self.bones]), len(self.skeleton.base_dofs)
        moved = self.skeleton.moved_by[np.ix_(bones, self.dofs)].astype(float)
        moved[:, :n] = 1.0
        return moved, self.skeleton.offset_by[np.ix_(bones, self.lengths)].astype(float)


@lru_cache(maxsize=16)
def balls_of_parts(parts: tuple[Part, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The balls of each bone's part in a table (B, m), filled up with ball 0, and which of its places are filled (B, m)."""
    filled = np.arange(max(len(part.balls) for part in parts)) < np.array([len(part.balls) for part in parts])[:, None]
    table = np.zeros(filled.shape, dtype=np.intp)
    table[filled] = np.concatenate([part.balls for part in parts])
    return table, filled


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyState:
    """A body in one pose."""

    skeleton: Skeleton
    lengths_m: np.ndarray  # (B,)
    balls: Metaballs
    motion: np.ndarray  # (D,)
    parts: tuple[Part, ...]  # B
    layout: ParameterLayout
    R: np.ndarray  # (B, 3, 3) bone frames
    head_m: np.ndarray  # (B, 3) bone heads in the world
    axes: np.ndarray  # (D, 3) axes of the DOFs in the world
    find_profiles: Callable[[], Mapping[int, BoneProfile]]
    finger_bends: Mapping[int, float]  # by the hand's bone

    @property
    def profiles(self) -> Mapping[int, BoneProfile]:
        """The visible radii about each bone that has balls, by the bone's index."""
        return self.find_profiles()

    @cached_property
    def profile_table(self) -> ProfileTable:
        """The same for all bones at once."""
        return ProfileTable.of(self.profiles, len(self.lengths_m))

    @cached_property
    def ball_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """From a world point X to q = (x/l_x, y/l_y, z/l_z) of every ball: X @ (M, 3, 3) − (M, 3)."""
        of, radii = self.balls.bone_index, self.balls.radii_m
        frames = self.R[of] / radii[:, None, :]
        return frames, np.einsum("mi,mij->mj", self.head_m[of], frames) + self.balls.centres_m(self.lengths_m) / radii

    @cached_property
    def screws(self) -> np.ndarray:
        """(D, 4, 3) for a gradient g at X: −g · (a × (X − o)) = (1, X) · (screw g); for base DOFs, which shift by a, −g · a."""
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
        """Joint positions (J, 3) and their derivative (J, 3, D + S) with respect to pose and shape."""
        sk, L, at = self.skeleton, self.lengths_m, self.layout
        where = sk.joint_bones
        bones = np.array([b for b, _ in where])
        at_tail = np.array([tail for _, tail in where])
        direction = self.R[:, :, 1]
        X = self.head_m[bones] + np.where(at_tail[:, None], L[bones, None] * direction[bones], 0.0)
        jacobian = np.zeros((len(where), 3, at.size()))
        turns = np.cross(self.axes, X[:, None] - self.head_m[sk.dof_bone])
        turns[:, : len(sk.base_dofs)] = np.eye(3)
        jacobian[:, :, : at.n_pose] = np.where(sk.moved_by[bones][..., None], turns, 0.0).transpose(0, 2, 1)
        stretched = sk.offset_by[bones].copy()
        stretched[np.flatnonzero(at_tail), bones[at_tail]] = True
        jacobian[:, :, at.columns("lengths")] = (stretched[..., None] * (L[:, None] * direction)).transpose(0, 2, 1)
        return X, jacobian


def shape_vector(state: BodyState) -> np.ndarray:
    """(S,) of a body: ln of lengths and cross radii, of weights where they are parameters, and bends."""
    return _vector(state.lengths_m, state.balls, state.layout.free_weights, [*state.finger_bends.values()])


def _vector(lengths_m: np.ndarray, balls: Metaballs, weights: bool, bends: Sequence[float]) -> np.ndarray:
    positive = [lengths_m, balls.radii_m[:, CROSS].ravel(), *([balls.weight] if weights else []), np.array(bends) + BACK]
    return np.log(np.concatenate(positive))


def free_bones(parameters: "ShapeParameters") -> np.ndarray:
    """Whether each bone (B,) has balls and a pose that must be observed, because its prior is not firm."""
    bones, found = parameters.skeleton.bones, np.zeros(len(parameters.skeleton.bones), dtype=bool)
    found[parameters.template.metaballs.bone_index] = True
    return found & np.array([any(dof.prior_sigma > FIRM_PRIOR for dof in bone.dofs) for bone in bones])


class ShapeParameters:
    """A body model's shape as a vector (S,): from vectors to bodies and back. Weights are parameters only where that is asked for."""

    def __init__(self, template: BodyShape, weights: bool = False) -> None:
        self.template = template
        self.skeleton = template.skeleton
        self.layout = ParameterLayout(template, weights)
        bones = range(len(template.lengths_m))
        self.parts = tuple(Part(self.skeleton, b, template.metaballs.bone_index, self.layout) for b in bones)
        self.neighbours = chain_neighbours(template)
        self._last_body: tuple[bytes, tuple[np.ndarray, Metaballs], dict[int, BoneProfile]] | None = None
        self._last_states: tuple[bytes, list[BodyState]] = (b"", [])

    def vector(self, shape: BodyShape | None = None) -> np.ndarray:
        """The shape vector (S,) of a body (default: the template)."""
        shape = self.template if shape is None else shape
        names = [shape.skeleton.bones[b].name for b in self.layout.hands]
        bends = [shape.finger_bends[name].value if name in shape.finger_bends else RELAXED for name in names]
        return _vector(shape.lengths_m, shape.metaballs, self.layout.free_weights, bends)

    def bends(self, vector: np.ndarray) -> dict[int, float]:
        """The bends of the fingers of a shape vector, by the hand's bone."""
        return dict(zip(self.layout.hands, np.minimum(np.exp(vector[self.layout.group("bends")]) - BACK, BENDS[1]).tolist()))

    def body(self, vector: np.ndarray) -> tuple[np.ndarray, Metaballs]:
        """Lengths (B,) [m] and balls of a shape vector; what is not estimated comes from the template. The last result is cached."""
        key = vector.tobytes()
        if self._last_body is None or self._last_body[0] != key:
            self._last_body = key, self._body(vector), {}
        return self._last_body[1]

    def _body(self, vector: np.ndarray) -> tuple[np.ndarray, Metaballs]:
        balls, old = self.template.metaballs, self.template.lengths_m
        lengths, radii = np.exp(vector[self.layout.group("lengths")]), balls.radii_m.copy()
        radii[:, 1] *= (lengths / old)[balls.bone_index]
        radii[:, CROSS] = np.exp(vector[self.layout.group("radii")]).reshape(-1, 2)
        weight = np.exp(vector[self.layout.group("weights")]) if self.layout.free_weights else balls.weight
        return lengths, Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=radii, weight=weight)

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices (K,), (K,) of the lengths, radii and weights of left and right limbs that correspond by name."""
        names = self.layout.names[: len(self.layout) - len(self.layout.hands)]
        right = [i for i, name in enumerate(names) if ".R" in name and name.replace(".R", ".L") in names]
        left = [self.layout[names[i].replace(".R", ".L")] for i in right]
        return np.array(left, dtype=np.intp), np.array(right, dtype=np.intp)

    def state(self, motion: np.ndarray, vector: np.ndarray) -> BodyState:
        """The body of a shape vector (S,) in a pose (D,)."""
        return self.states(np.asarray(motion)[None], vector)[0]

    def profiles(self, vector: np.ndarray) -> dict[int, BoneProfile]:
        """The profiles of the bones of a shape vector (S,); the last ones are cached."""
        lengths, balls = self.body(vector)
        assert self._last_body is not None
        found = self._last_body[2]
        if not found:
            found.update(bone_profiles(self.skeleton, lengths, balls, self.neighbours))
        return found

    def states(self, motion: np.ndarray, vector: np.ndarray) -> list[BodyState]:
        """The body of a shape vector (S,) in T poses (T, D). The last are cached: derivatives are evaluated where the cost was."""
        key = b"".join((vector.tobytes(), np.asarray(motion, dtype=np.float64).tobytes()))
        if self._last_states[0] != key:
            self._last_states = key, self._states(np.asarray(motion, dtype=np.float64), np.array(vector))
        return self._last_states[1]

    def _states(self, motion: np.ndarray, vector: np.ndarray) -> list[BodyState]:
        (lengths, balls), bends = self.body(vector), self.bends(vector)
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
                layout=self.layout,
                find_profiles=partial(self.profiles, vector),
                finger_bends=bends,
            )
            for m, R, head, axes in zip(motion, *forward)
        ]

    def shape(self, vector: np.ndarray, sigma: np.ndarray) -> BodyShape:
        """The body's shape with sigmas, from the vector (S,) and the sigma of its logarithms (S,)."""
        lengths, balls = self.body(vector)
        relative = sigma[self.layout.group("lengths")]
        length_sigma, radius_sigma = relative * lengths, np.empty_like(balls.radii_m)
        radius_sigma[:, CROSS] = sigma[self.layout.group("radii")].reshape(-1, 2) * balls.radii_m[:, CROSS]
        radius_sigma[:, 1] = relative[balls.bone_index] * balls.radii_m[:, 1]
        return BodyShape(
            model=self.template.model,
            skeleton=self.skeleton,
            lengths_m=lengths,
            metaballs=balls,
            length_sigma_m=length_sigma,
            radius_sigma_m=radius_sigma,
            weight_sigma=sigma[self.layout.group("weights")] * balls.weight if self.layout.free_weights else None,
            finger_bends=self._finger_bends(vector, sigma),
        )

    def _finger_bends(self, vector: np.ndarray, sigma: np.ndarray) -> dict[str, FingerBend]:
        own = zip(self.bends(vector).items(), sigma[self.layout.group("bends")].tolist())
        return {self.skeleton.bones[b].name: FingerBend(bend, s * (bend + BACK)) for (b, bend), s in own}


def _names(shape: BodyShape, weights: bool) -> list[str]:
    bones = shape.skeleton.bones
    names, count, balls = [f"length {bone.name}" for bone in bones], [0] * len(bones), []
    for b in shape.metaballs.bone_index.tolist():
        count[b] += 1
        balls.append(f"{bones[b].name} {count[b]}")
    names += [f"radius {ball} {axis}" for ball in balls for axis in "xz"] + [f"weight {ball}" for ball in balls if weights]
    return names + [f"bend {bones[b].name}" for b in hands_of(shape.skeleton)]


Block = tuple[np.ndarray, np.ndarray, np.ndarray]  # rows (n,), columns (c,) of D + S, values (n, c)


class FromBlocks:
    """An observation whose Jacobian comes in blocks; every row is in one block only."""

    __slots__ = ()

    @property
    def size(self) -> int:
        """Number of residuals."""
        raise NotImplementedError

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """The blocks of the derivative with respect to pose and shape, or to the pose alone."""
        raise NotImplementedError

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """The whole derivative (n, D + S), or (n, D) without shape."""
        J = state.layout.empty_jacobian(self.size, shape)
        for rows, columns, block in self.blocks(state, shape):
            J[rows[:, None], columns] = block
        return J
