"""The skeleton: hierarchical bones whose rotations are products of single-angle degrees of freedom (D'Apuzzo et al. 1999, Eqs. 1–3).

    M_b = M_parent · Rest_rel,b · Euler_b(θ)             local → world, column vectors                      (1)
    Euler_b = R_i(θ_i) · R_j(θ_j) · R_k(θ_k)             axes read from the END of the rotation mode: Blender's Euler   (2)
    head_b = head or tail of the parent bone,  tail_b = head_b + L_b · (second column of M_b)              (3)

The papers write world → local, X_j = D_n … D_2 D_1 X_w with D_k = Rot_z(θ_k) · D_ini,k (Eqs. 2, 3): every DOF turns about its own
local z; a fixed permutation of the axes, with the bone's offset s·T in the first DOF of a joint, stands in D_ini,k. Both forms are the
same motion: D_n … D_1 is the inverse of (1) up to the last permutation, with angles of opposite sign (a test proves it). Here the angles
are those of Blender's pose channels, in a bone frame whose y runs from head to tail. Angles are 0 in the rest pose, NOT in the anatomical
one. Mirrored limbs (.L, .R) have equal angles about x and opposite angles about y and z, as in Blender.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite

import numpy as np

from ..foundation.arrays import frozen
from ..foundation.errors import InputError
from ..foundation.settings import nearest_name

ROTATION_MODES = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
LENGTHS_M = (0.0005, 20.0)  # of a bone


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Dof:
    """One degree of freedom: an angle [rad] about a bone's local `axis`, or a coordinate [m] of the base along the world's `axis`.

    `prior_mean`, `prior_sigma`: the prior before any measurement, in the same unit; an infinite sigma is no prior.
    """

    name: str
    axis: str
    limits: tuple[float, float] = (-inf, inf)  # rad or m
    prior_mean: float = 0.0
    prior_sigma: float = inf

    def __post_init__(self) -> None:
        if not (self.limits[0] <= self.limits[1] and isfinite(self.prior_mean) and self.prior_sigma > 0):
            raise InputError(
                f"The degree of freedom “{self.name}” goes from {self.limits[0]:.4g} to {self.limits[1]:.4g} rad or m, with a prior of "
                f"{self.prior_mean:.4g} ± {self.prior_sigma:.4g}; the first limit must be the smaller one, and the sigma above 0."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Bone:
    """A rigid segment between two joints. `R_rest` (3, 3): columns are its axes in the world in the rest pose, y from head to tail."""

    name: str
    parent: str | None
    head_joint: str
    tail_joint: str
    nominal_length_m: float
    R_rest: np.ndarray
    rotation_mode: str = "YZX"
    dofs: tuple[Dof, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "R_rest", frozen(self.R_rest, (3, 3), name="R_rest"))
        if not LENGTHS_M[0] <= self.nominal_length_m <= LENGTHS_M[1]:
            low, high = LENGTHS_M
            raise InputError(f"Bone “{self.name}” is {self.nominal_length_m:g} m long; {low:g} to {high:g} m are possible.")
        axes = [dof.axis for dof in self.dofs]
        if self.rotation_mode not in ROTATION_MODES or len(set(axes)) < len(axes) or not set(axes) <= set("xyz"):
            raise InputError(
                f"Bone “{self.name}” has rotation mode “{self.rotation_mode}” and axes {axes}; "
                f"use a mode of {', '.join(ROTATION_MODES)} and every axis at most once."
            )
        if not np.allclose(self.R_rest.T @ self.R_rest, np.eye(3), atol=1e-6) or np.linalg.det(self.R_rest) < 0:
            raise InputError(f"The rest frame of bone “{self.name}” is no rotation; give orthogonal y and z axes.")


class Layout:
    """The index of each parameter in a vector: `layout["elbow.R flexion"]` is its index, `layout.group("base")` the indices of a group."""

    def __init__(self, names: Sequence[str], groups: Mapping[str, Sequence[int]]) -> None:
        self.names = tuple(names)
        self._index = {name: i for i, name in enumerate(self.names)}
        self._groups = {name: np.array(indices, dtype=np.intp) for name, indices in groups.items()}

    def __getitem__(self, name: str) -> int:
        if name not in self._index:
            raise InputError(f"There is no degree of freedom “{name}”.{nearest_name(name, self.names)}")
        return self._index[name]

    def __len__(self) -> int:
        return len(self.names)

    def group(self, name: str) -> np.ndarray:
        """Indices of a group: of DOFs "motion" (all), "base", "rotation", "twist" or the name of a joint."""
        if name not in self._groups:
            raise InputError(f"There is no group of degrees of freedom “{name}”.{nearest_name(name, list(self._groups))}")
        return self._groups[name]


@dataclass(frozen=True, eq=False, kw_only=True)
class Skeleton:
    """Bones, parents first. The base DOFs are the world position [m] of the first bone's head, which is the world's origin at rest."""

    name: str
    bones: tuple[Bone, ...]
    base_dofs: tuple[Dof, ...] = field(default=())

    def __post_init__(self) -> None:
        names = [bone.name for bone in self.bones]
        if not names or len(set(names)) < len(names) or len(set(self.dof_names)) < len(self.dof_names):
            raise InputError(f"Skeleton “{self.name}” needs bones and DOFs with names of their own.")
        if [dof.axis for dof in self.base_dofs] != ["x", "y", "z"]:
            raise InputError(f"Skeleton “{self.name}” needs the three base DOFs x, y, z.")
        for i, bone in enumerate(self.bones):
            if (bone.parent is None) != (i == 0) or (i and bone.parent not in names[:i]):
                raise InputError(f"Bone “{bone.name}” of “{self.name}” must come after its parent; only the first bone has none.")
            if i and bone.head_joint not in (self._bone(bone.parent).head_joint, self._bone(bone.parent).tail_joint):
                raise InputError(f"Bone “{bone.name}” of “{self.name}” must begin at a joint of its parent “{bone.parent}”.")

    def _bone(self, name: str | None) -> Bone:
        return next(bone for bone in self.bones if bone.name == name)

    @cached_property
    def dof_names(self) -> tuple[str, ...]:
        """Names in the order of the motion vector: base first, then bone after bone."""
        return tuple(dof.name for dof in self.dofs)

    @cached_property
    def dofs(self) -> tuple[Dof, ...]:
        """All DOFs in the order of the motion vector."""
        return (*self.base_dofs, *(dof for bone in self.bones for dof in bone.dofs))

    @cached_property
    def layout(self) -> Layout:
        """The owner of the order of the motion vector."""
        n = len(self.base_dofs)
        groups: dict[str, list[int]] = dict(
            motion=list(range(len(self.dofs))), base=list(range(n)), rotation=list(range(n, len(self.dofs))), twist=[]
        )
        for i, dof in enumerate(self.dofs[n:], n):
            groups.setdefault(dof.name.rpartition(" ")[0], []).append(i)
            if dof.axis == "y":
                groups["twist"].append(i)
        return Layout(self.dof_names, groups)

    @cached_property
    def locked(self) -> np.ndarray:
        """The DOFs whose limits are equal, so that they have one value only."""
        return np.flatnonzero([dof.limits[0] == dof.limits[1] for dof in self.dofs])

    @cached_property
    def parents(self) -> np.ndarray:
        """Index of each bone's parent (B,), −1 for the first."""
        names = [bone.name for bone in self.bones]
        return np.array([-1 if bone.parent is None else names.index(bone.parent) for bone in self.bones])

    @cached_property
    def dof_bone(self) -> np.ndarray:
        """Index of the bone that each DOF turns (D,); 0 for the base."""
        return np.array([0] * len(self.base_dofs) + [i for i, bone in enumerate(self.bones) for _ in bone.dofs])

    @cached_property
    def starts_at_tail(self) -> np.ndarray:
        """Whether each bone (B,) begins at its parent's tail; otherwise it begins at its parent's head."""
        return np.array([p >= 0 and bone.head_joint == self.bones[p].tail_joint for bone, p in zip(self.bones, self.parents)])

    @cached_property
    def moved_by(self) -> np.ndarray:
        """(B, D) whether a DOF moves a bone."""
        return self.ancestors[:, self.dof_bone]

    @cached_property
    def offset_by(self) -> np.ndarray:
        """(B, B) whether the length of bone [·, a] shifts the head of bone [b, ·]."""
        table = np.zeros((len(self.bones), len(self.bones)), dtype=bool)
        for b, p in enumerate(self.parents):
            if p >= 0:
                table[b] = table[p]
                table[b, p] |= self.starts_at_tail[b]
        return table

    @cached_property
    def rest_to_parent(self) -> np.ndarray:
        """(B, 3, 3) Rest_rel of (1): each bone's rest frame in its parent's; of the first bone its own."""
        return np.stack([bone.R_rest if p < 0 else self.bones[p].R_rest.T @ bone.R_rest for bone, p in zip(self.bones, self.parents)])

    @cached_property
    def turn_order(self) -> tuple[tuple[tuple[int, int], ...], ...]:
        """For each bone its DOFs and their axes (0, 1, 2), outermost first."""
        order, n = [], len(self.base_dofs)
        for bone in self.bones:
            index = {dof.axis: n + i for i, dof in enumerate(bone.dofs)}
            n += len(bone.dofs)
            order.append(tuple((index[a], "xyz".index(a)) for a in reversed(bone.rotation_mode.lower()) if a in index))
        return tuple(order)

    @cached_property
    def dofs_about(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The DOFs that turn about local x, y and z."""
        n = len(self.base_dofs)
        x, y, z = (np.array([i for i, dof in enumerate(self.dofs) if i >= n and dof.axis == a], dtype=np.intp) for a in "xyz")
        return x, y, z

    @cached_property
    def neighbours(self) -> np.ndarray:
        """(B, B) symmetric: a bone itself, its parent and its children; their fields add where they meet (consistent mode).

        A bone without DOFs is a rigid part of its parent: its children count as the parent's.
        """
        rigid = list(range(len(self.bones)))
        for b, p in enumerate(self.parents):
            if p >= 0 and not self.bones[b].dofs:
                rigid[b] = rigid[p]
        table = np.eye(len(self.bones), dtype=bool)
        for b, p in enumerate(self.parents):
            for c in (p, rigid[p]) if p >= 0 else ():
                table[b, c] = table[c, b] = True
        return table

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Every joint once, from the base outwards."""
        return tuple(dict.fromkeys(joint for bone in self.bones for joint in (bone.head_joint, bone.tail_joint)))

    @cached_property
    def joint_bones(self) -> tuple[tuple[int, bool], ...]:
        """For each joint a bone that begins or ends there, and whether with its tail (else with its head)."""
        where: dict[str, tuple[int, bool]] = {}
        for b, bone in enumerate(self.bones):
            where.setdefault(bone.head_joint, (b, False))
            where.setdefault(bone.tail_joint, (b, True))
        return tuple(where[joint] for joint in self.joint_names)

    @cached_property
    def ancestors(self) -> np.ndarray:
        """(B, B) whether the second bone is the first, or one of its ancestors."""
        table = np.eye(len(self.bones), dtype=bool)
        for b, p in enumerate(self.parents):
            if p >= 0:
                table[b] |= table[p]
        return table


def bone_frames(skeleton: Skeleton, lengths_m: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes R (…, B, 3, 3) (columns, in the world) and heads (…, B, 3) [m] of all bones.  (1)–(3)

    `lengths_m` (B,), `motion` (…, D) in rad and metres, in the order of `skeleton.dof_names`.
    """
    return _forward(skeleton, lengths_m, motion)[:2]


def frames_of_bones(skeleton: Skeleton, lengths_m: np.ndarray, motion: np.ndarray, bones: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`bone_frames` of some bones (K,) in N poses (N, D) that differ in few DOFs: R (N, K, 3, 3) and heads (N, K, 3).

    What all poses have in common is computed once, and other bones than these and those that carry them are left out.
    """
    n = len(skeleton.base_dofs)
    varies = (motion != motion[:1]).any(axis=0)
    base = motion[:, :n] if varies[:n].any() else motion[:1, :n]
    frames: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # of one pose where all are the same
    for b in np.flatnonzero(skeleton.ancestors[bones].any(axis=0)).tolist():
        p = skeleton.parents[b]
        if p < 0:
            frame, head = skeleton.bones[b].R_rest[None], base
        else:
            R, head = frames[p]
            frame = R @ skeleton.rest_to_parent[b]
            head = head + (lengths_m[p] * R[:, :, 1] if skeleton.starts_at_tail[b] else 0.0)
        for dof, axis in skeleton.turn_order[b]:
            frame = _turned(frame, axis, motion[:, dof] if varies[dof] else motion[:1, dof])
        frames[b] = frame, head
    R, head = np.empty((len(motion), len(bones), 3, 3)), np.empty((len(motion), len(bones), 3))
    for i, b in enumerate(bones.tolist()):
        R[:, i], head[:, i] = frames[b]
    return R, head


def frames_and_axes(skeleton: Skeleton, lengths_m: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`bone_frames` and the DOFs' axes in the world (…, D, 3): the rotation axis a_k, or the direction in which a base DOF shifts.

    The derivative of a point X fixed to a bone that DOF k turns is a_k × (X − head of the bone of k).
    """
    return _forward(skeleton, lengths_m, motion)


def joint_positions(skeleton: Skeleton, lengths_m: np.ndarray, motion: np.ndarray) -> dict[str, np.ndarray]:
    """World position (…, 3) [m] of every joint by name; arguments as in `bone_frames`."""
    R, head = bone_frames(skeleton, lengths_m, motion)
    tail = head + np.asarray(lengths_m)[:, None] * R[..., :, 1]
    return {joint: (tail if at_tail else head)[..., b, :] for joint, (b, at_tail) in zip(skeleton.joint_names, skeleton.joint_bones)}


def _forward(skeleton: Skeleton, lengths_m: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    motion = np.asarray(motion, dtype=np.float64)
    shape, n_bones = motion.shape[:-1], len(skeleton.bones)
    R, head = np.empty((*shape, n_bones, 3, 3)), np.empty((*shape, n_bones, 3))
    axes = np.zeros((*shape, motion.shape[-1], 3))
    n = len(skeleton.base_dofs)
    axes[..., np.arange(n), np.arange(n)] = 1.0
    turns = _turns(skeleton, motion)
    for b, (bone, p) in enumerate(zip(skeleton.bones, skeleton.parents)):
        if p < 0:
            frame, head[..., b, :] = np.broadcast_to(bone.R_rest, (*shape, 3, 3)), motion[..., :n]
        else:
            frame = R[..., p, :, :] @ skeleton.rest_to_parent[b]
            offset = lengths_m[p] * R[..., p, :, 1] if skeleton.starts_at_tail[b] else 0.0
            head[..., b, :] = head[..., p, :] + offset
        for dof, axis in skeleton.turn_order[b]:  # (2)
            axes[..., dof, :] = frame[..., :, axis]
            frame = frame @ turns[..., dof, :, :]
        R[..., b, :, :] = frame
    return R, head, axes


def _turned(frame: np.ndarray, axis: int, angle: np.ndarray) -> np.ndarray:
    """Frames (N or 1, 3, 3) turned about one of their axes by angles (N or 1,)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    turned = np.empty((max(len(frame), len(angle)), 3, 3))
    turned[:, :, axis] = frame[:, :, axis]
    turned[:, :, i] = cos * frame[:, :, i] + sin * frame[:, :, j]
    turned[:, :, j] = cos * frame[:, :, j] - sin * frame[:, :, i]
    return turned


def _turns(skeleton: Skeleton, motion: np.ndarray) -> np.ndarray:
    """The rotation matrix (…, D, 3, 3) of every DOF about its axis; of base DOFs without meaning."""
    cos, sin = np.cos(motion), np.sin(motion)
    turns = np.zeros((*motion.shape, 3, 3))
    for k in range(3):
        dofs = skeleton.dofs_about[k]
        i, j = (k + 1) % 3, (k + 2) % 3
        turns[..., dofs, k, k] = 1.0
        turns[..., dofs, i, i] = turns[..., dofs, j, j] = cos[..., dofs]
        turns[..., dofs, j, i], turns[..., dofs, i, j] = sin[..., dofs], -sin[..., dofs]
    return turns
