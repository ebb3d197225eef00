"""The residual motion: finding what a target rig cannot show of a motion, and restoring it when the motion goes on to another rig.

The rotations and shifts that planted the feet are undone, so that the next rig's feet are planted from the same motion at the same times;
bones that the rig lacks are added to it for as long as it is a source. A lacking bone v has the rotation since its rest pose

    D_v(t) = exp(e(t)) · D_ref(t),    D_v = D_s · A,    D_ref = R_ref · R_rest,refᵀ        (1)

with D_s of the source, A as in `transfer` (2) and ref a bone of the rig; e is stored.
"""

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from ...geometry.rotation import matrix_from_vector, transposed, vector_from_matrix
from .contacts import Contacts, FeetSettings
from .mapping import MappedMotion, MappedRig
from .residual_motion import ResidualChain
from .rest_pose import hip_centre, outwards
from .rig import Rig
from .roles import FINGERS, SPREAD, above, part_of
from .transfer import body_axes, fractions_of, partners_of, untwisted_bone

PLANTED = ("hips", "thigh", "shin", "foot", "toe")  # parts that planting the feet turns
ATTACHED = ("neck", "head", "clavicle", "hand", "toe", *(f"{finger}.{k}" for finger in FINGERS for k in (1, 2, 3)))  # if lacking
SMALLEST_TURN = 1e-7  # [rad] smaller ones are not stored


def turned_by(role: str, target: MappedRig, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Rodrigues vectors in the world (n, T, 3) of a part's bones from R (T, B, 3, 3) before to after."""
    chain = [target.rig.index[name] for name in target.map.bones[role]]
    return np.stack([vector_from_matrix(after[:, b] @ transposed(before[:, b])) for b in chain])


def planting_turns(target: MappedRig, before: np.ndarray, after: np.ndarray) -> dict[str, np.ndarray]:
    """By role the rotations that planted the feet, where there are any."""
    found = {role: turned_by(role, target, before, after) for role in target.map.bones if part_of(role) in PLANTED}
    return {role: turn for role, turn in found.items() if np.abs(turn).max() > SMALLEST_TURN}


def lacking(source: MappedMotion, target: MappedRig, aligned: Mapping[str, np.ndarray], R: np.ndarray) -> tuple[ResidualChain, ...]:
    """The parts, and bones of parts, that the target lacks, and the pairing of its bones with the source's; the target moves as
    R (T, B, 3, 3)."""
    rig, names_t = source.rig, target.map.bones
    D = source.motion.R @ transposed(rig.R_rest)
    body = body_axes(rig, source.map) @ body_axes(target.rig, target.map).T
    chains = []
    for role, names in source.map.bones.items():
        bones, part = [rig.index[name] for name in names], part_of(role)
        if role in aligned and part in SPREAD:
            chains.append(_paired_chain(role, [D[:, b] @ aligned[role] for b in bones], fractions_of(rig, bones), target, R))
        elif role not in names_t and part in ATTACHED and (parent := above(role, aligned)):
            A = body if part in ("neck", "head", "clavicle") else aligned[parent]
            bones = bones if part in SPREAD else [untwisted_bone(bones, role)]
            along = target.rig.height_m / max(rig.height_m, 1e-9) * A.T @ (rig.tail_m[bones[-1]] - rig.head_m[bones[0]])
            ref = target.rig.index[names_t[parent][-1]]
            chains.append(
                ResidualChain(
                    role=role,
                    order=(-1,) * len(bones),
                    ends=fractions_of(rig, bones),
                    along_m=along,
                    parent=parent,
                    size=len(names_t[parent]),
                    turn=np.stack([_relative(D[:, b] @ A, target.rig, R, ref) for b in bones]),
                )
            )
    return tuple(chains)


def _relative(D: np.ndarray, rig: Rig, R: np.ndarray, ref: int) -> np.ndarray:
    return vector_from_matrix(D @ transposed(R[:, ref] @ rig.R_rest[ref].T))  # (1)


def _paired_chain(role: str, D: list[np.ndarray], ends: np.ndarray, target: MappedRig, R: np.ndarray) -> ResidualChain:
    """A part that both have: the pairing of the target's bones with the source's, and the source's surplus bones."""
    own = [target.rig.index[name] for name in target.map.bones[role]]
    fractions = fractions_of(target.rig, own)
    if len(own) < len(D):
        taken = partners_of(fractions, ends)
        order = tuple(taken.index(k) if k in taken else -1 for k in range(len(D)))
    else:
        order = tuple(partners_of(ends, fractions))
    turn = [_relative(D[k], target.rig, R, own[_next(order, k)]) for k in range(len(order)) if order[k] < 0]
    return ResidualChain(
        role=role, order=order, ends=ends, along_m=np.zeros(3), parent=role, size=len(own), turn=np.reshape(turn, (-1, len(R), 3))
    )


def _next(order: tuple[int, ...], k: int) -> int:
    """The rig's own bone that comes next in a part; the last of a part is always its own."""
    return next(i for i in order[k:] if i >= 0)


def with_residual(source: MappedMotion, settings: FeetSettings) -> tuple[MappedMotion, Contacts | None]:
    """The motion with its residual restored, the mapping extended by the bones that this adds, and the foot contacts if they are stored
    for these settings. With feet mode “off” planted feet stay planted."""
    residual = source.motion.residual
    if residual is None:
        return source, None
    contacts = None
    source = _turned_back(source, residual.forearm_twists, np.zeros(3))
    if settings.mode != "off":
        source = _turned_back(source, residual.planting_turns, residual.planting_shift_m)
        if dict(residual.contact_settings) == asdict(settings) and residual.contacts["ankle"]:
            contacts = Contacts(**residual.contacts, ankle_level_m=residual.ankle_level_m)
    own = source.map
    for chain in residual.chains:
        parent = own.bones.get(chain.parent, ())
        if len(parent) == chain.size and (chain.parent == chain.role or chain.role not in own.bones):
            source = _with_chain(source, chain, [source.rig.index[name] for name in parent])
    return source, contacts


def _turned_back(source: MappedMotion, turns: Mapping[str, np.ndarray], moved_m: np.ndarray) -> MappedMotion:
    """The motion with parts turned back by their turns (n, T, 3), their descendants carried along, and the hips moved back."""
    motion, rig_map = source.motion, source.map
    rig, back = motion.rig, dict[int, np.ndarray]()
    for role in rig_map.bones:
        for k, name in enumerate(rig_map.bones[role]):
            back[rig.index[name]] = turns[role][min(k, len(turns[role]) - 1)] if role in turns else np.zeros((len(motion.frames), 3))
    R, head = motion.R.copy(), motion.head_m.copy()
    for b, a in outwards(rig, rig_map):
        if b in back:
            R[:, b] = matrix_from_vector(-back[b]) @ motion.R[:, b]
        elif a >= 0:
            R[:, b] = R[:, a] @ transposed(motion.R[:, a]) @ motion.R[:, b]
        if a >= 0:
            arm = transposed(motion.R[:, a]) @ (motion.head_m[:, b] - motion.head_m[:, a])[..., None]
            head[:, b] = head[:, a] + (R[:, a] @ arm)[..., 0]
    if "hips" in rig_map.bones:
        middle = hip_centre(motion, rig_map) - moved_m - hip_centre(replace(motion, R=R, head_m=head), rig_map)
        head = head + middle[:, None]
    return MappedMotion(motion=replace(motion, R=R, head_m=head), map=rig_map)


def _with_chain(source: MappedMotion, chain: ResidualChain, parent: list[int]) -> MappedMotion:
    """The motion with the lacking bones of a part appended to its rig; `parent` are the bones of the part they belong to.  (1)"""
    motion, rig_map = source.motion, source.map
    rig, attached, last = motion.rig, chain.parent != chain.role, parent[-1]
    bounds, start = _bounds(rig, chain, parent), motion.head_m[:, parent[0]]
    if attached:
        start = motion.head_m[:, last] + motion.R[:, last] @ (rig.R_rest[last].T @ (rig.tail_m[last] - rig.head_m[last]))
    head, tail, moving = rig.head_m.copy(), rig.tail_m.copy(), motion.head_m.copy()
    own = [(k, parent[i]) for k, i in enumerate(chain.order) if i >= 0]
    new = [(k, last if attached else parent[_next(chain.order, k)]) for k, i in enumerate(chain.order) if i < 0]
    for k, b in own:
        head[b], tail[b] = bounds[k], bounds[k + 1]
        if k == 0:
            moving[:, b] = start
    R = [matrix_from_vector(turn) @ motion.R[:, ref] @ rig.R_rest[ref].T for turn, (_, ref) in zip(chain.turn, new)]
    added, n = [k for k, _ in new], len(new)
    names = {k: rig.names[b] for k, b in own} | {k: f"{chain.role}, {k + 1} (residual)" for k in added}
    longer = Rig(
        names=(*rig.names, *(names[k] for k in added)),
        parents=np.array([*rig.parents, *(ref for _, ref in new)]),
        R_rest=np.concatenate([rig.R_rest, np.broadcast_to(np.eye(3), (n, 3, 3))]),
        head_m=np.concatenate([head, bounds[added]]),
        tail_m=np.concatenate([tail, bounds[1:][added]]),
        connected=np.append(rig.connected, np.zeros(n, dtype=bool)),
        inherits_rotation=np.append(rig.inherits_rotation, np.ones(n, dtype=bool)),
        roles=rig.roles,
        sole_m=rig.sole_m,
    )
    more = replace(
        motion,
        rig=longer,
        R=np.concatenate([motion.R, *(turned[:, None] for turned in R)], axis=1),
        head_m=np.concatenate([moving, np.repeat(start[:, None], n, axis=1)], axis=1),
    )
    chain_names = tuple(names[k] for k in range(len(chain.order)))
    restored = rig_map.restored | ({chain.role} if attached else set())
    return MappedMotion(motion=more, map=replace(rig_map, bones={**rig_map.bones, chain.role: chain_names}, restored=restored))


def _bounds(rig: Rig, chain: ResidualChain, parent: list[int]) -> np.ndarray:
    """The ends of a part's bones in the rest pose (n + 1, 3): along the rig's own bones, or beyond the end of the parent's."""
    if chain.parent != chain.role:
        return np.asarray(rig.tail_m[parent[-1]] + np.append(0.0, chain.ends)[:, None] * chain.along_m)
    knots, joints = np.append(0.0, fractions_of(rig, parent)), np.stack([*rig.head_m[parent], rig.tail_m[parent[-1]]])
    return np.column_stack([np.interp([0.0, *chain.ends], knots, column) for column in joints.T])
