"""Finding what a rig does not show of a motion, and putting it back when the motion goes on to another rig.

What the feet's standing has turned and moved is taken back, so that the next rig's feet are held from the same motion, at the same times;
bones that the rig lacks are hung onto its own for as long as it is a source. A bone that is lacking has turned since its rest by

    D_v(t) = exp(e(t)) · D_ref(t),    D_v = D_s · A,    D_ref = R_ref · R_rest,refᵀ        (1)

with D_s of the source, A as in `transfer` (2), ref a bone of the rig's own; e is remembered.
"""

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from .contacts import Contacts, FeetSettings
from .mapping import RigMap
from .places import hip_centre, outwards
from .rig import Motion, Rig
from .roles import FINGERS, SPREAD, above, part_of
from .transfer import body_axes, fractions_of, kept, partners_of
from .turns import matrix_from_vector, transposed, vector_from_matrix
from .unshown import UnshownChain

HELD = ("hips", "thigh", "shin", "foot", "toe")
HUNG = ("neck", "head", "clavicle", "hand", "toe", *(f"{finger}.{k}" for finger in FINGERS for k in (1, 2, 3)))
LEAST = 1e-7  # rad


def turned_by(role: str, rig: Rig, rig_map: RigMap, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How far a part's bones were turned in the world (n, T, 3) from R (T, B, 3, 3) before to after."""
    chain = [rig.index[name] for name in rig_map.bones[role]]
    return np.stack([vector_from_matrix(after[:, b] @ transposed(before[:, b])) for b in chain])


def held_turns(rig: Rig, rig_map: RigMap, before: np.ndarray, after: np.ndarray) -> dict[str, np.ndarray]:
    """By role what holding the feet has turned, where it has."""
    found = {role: turned_by(role, rig, rig_map, before, after) for role in rig_map.bones if part_of(role) in HELD}
    return {role: turn for role, turn in found.items() if np.abs(turn).max() > LEAST}


def lacking(
    source: Motion, source_map: RigMap, target: Rig, target_map: RigMap, aligned: Mapping[str, np.ndarray], R: np.ndarray
) -> tuple[UnshownChain, ...]:
    """The parts, and bones of parts, that the target has not, and where it has those of chains from; the target moves as R (T, B, 3, 3)."""
    D, rig = source.R @ transposed(source.rig.R_rest), source.rig
    body = body_axes(rig, source_map) @ body_axes(target, target_map).T
    chains = []
    for role, names in source_map.bones.items():
        bones, part = [rig.index[name] for name in names], part_of(role)
        if role in aligned and part in SPREAD:
            chains.append(_part_of_chain(role, [D[:, b] @ aligned[role] for b in bones], fractions_of(rig, bones), target, target_map, R))
        elif role not in target_map.bones and part in HUNG and (beside := above(role, aligned)):
            A = body if part in ("neck", "head", "clavicle") else aligned[beside]
            bones = bones if part in SPREAD else [kept(bones, role)]
            along = target.height_m / max(rig.height_m, 1e-9) * A.T @ (rig.tail_m[bones[-1]] - rig.head_m[bones[0]])
            ref = target.index[target_map.bones[beside][-1]]
            chains.append(
                UnshownChain(
                    role=role,
                    order=(-1,) * len(bones),
                    ends=fractions_of(rig, bones),
                    along_m=along,
                    beside=beside,
                    size=len(target_map.bones[beside]),
                    turn=np.stack([_against(D[:, b] @ A, target, R, ref) for b in bones]),
                )
            )
    return tuple(chains)


def _against(D: np.ndarray, rig: Rig, R: np.ndarray, ref: int) -> np.ndarray:
    return vector_from_matrix(D @ transposed(R[:, ref] @ rig.R_rest[ref].T))  # (1)


def _part_of_chain(role: str, D: list[np.ndarray], ends: np.ndarray, target: Rig, target_map: RigMap, R: np.ndarray) -> UnshownChain:
    """A part that both have: which of the target's bones go with the source's, and the source's bones that are more."""
    own = [target.index[name] for name in target_map.bones[role]]
    places = fractions_of(target, own)
    if len(own) < len(D):
        taken = partners_of(places, ends)
        order = tuple(taken.index(k) if k in taken else -1 for k in range(len(D)))
    else:
        order = tuple(partners_of(ends, places))
    turn = [_against(D[k], target, R, own[_next(order, k)]) for k in range(len(order)) if order[k] < 0]
    return UnshownChain(
        role=role, order=order, ends=ends, along_m=np.zeros(3), beside=role, size=len(own), turn=np.reshape(turn, (-1, len(R), 3))
    )


def _next(order: tuple[int, ...], k: int) -> int:
    """The rig's own bone that comes next in a part; the last of a part is always its own."""
    return next(i for i in order[k:] if i >= 0)


def restored(motion: Motion, rig_map: RigMap, feet: FeetSettings) -> tuple[Motion, RigMap, Contacts | None]:
    """The motion with what is known of it beyond what its rig shows, the mapping of the bones that this adds, and when its feet stand if
    that is known for these settings. With feet that shall not be held those that are held stay so."""
    unshown = motion.unshown
    if unshown is None:
        return motion, rig_map, None
    contacts = None
    motion = _turned_back(motion, rig_map, unshown.twisted, np.zeros(3))
    if feet.mode != "off":
        motion = _turned_back(motion, rig_map, unshown.held, unshown.moved_m)
        if dict(unshown.feet) == asdict(feet) and unshown.stands["ankle"]:
            contacts = Contacts(**unshown.stands, ankle_level_m=unshown.level_m)
    longer = rig_map
    for chain in unshown.chains:
        beside = rig_map.bones.get(chain.beside, ())
        if len(beside) == chain.size and (chain.beside == chain.role or chain.role not in rig_map.bones):
            motion, longer = _with_chain(motion, longer, chain, [motion.rig.index[name] for name in beside])
    return motion, longer, contacts


def _turned_back(motion: Motion, rig_map: RigMap, turns: Mapping[str, np.ndarray], moved_m: np.ndarray) -> Motion:
    """The motion with parts turned back by their turns (n, T, 3), all that hangs on them carried along, and the hips moved back."""
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
    if "hips" not in rig_map.bones:
        return replace(motion, R=R, head_m=head)
    middle = hip_centre(motion, rig_map) - moved_m - hip_centre(replace(motion, R=R, head_m=head), rig_map)
    return replace(motion, R=R, head_m=head + middle[:, None])


def _with_chain(motion: Motion, rig_map: RigMap, chain: UnshownChain, beside: list[int]) -> tuple[Motion, RigMap]:
    """The motion with the bones that a part lacks, in its rig after the others.  (1)"""
    rig, hung, last = motion.rig, chain.beside != chain.role, beside[-1]
    bounds, start = _bounds(rig, chain, beside), motion.head_m[:, beside[0]]
    if hung:
        start = motion.head_m[:, last] + motion.R[:, last] @ (rig.R_rest[last].T @ (rig.tail_m[last] - rig.head_m[last]))
    head, tail, moving = rig.head_m.copy(), rig.tail_m.copy(), motion.head_m.copy()
    own = [(k, beside[i]) for k, i in enumerate(chain.order) if i >= 0]
    new = [(k, last if hung else beside[_next(chain.order, k)]) for k, i in enumerate(chain.order) if i < 0]
    for k, b in own:
        head[b], tail[b] = bounds[k], bounds[k + 1]
        if k == 0:
            moving[:, b] = start
    R = [matrix_from_vector(turn) @ motion.R[:, ref] @ rig.R_rest[ref].T for turn, (_, ref) in zip(chain.turn, new)]
    places, n = [k for k, _ in new], len(new)
    names = {k: rig.names[b] for k, b in own} | {k: f"{chain.role}, {k + 1} (unshown)" for k in places}
    longer = Rig(
        names=(*rig.names, *(names[k] for k in places)),
        parents=np.array([*rig.parents, *(ref for _, ref in new)]),
        R_rest=np.concatenate([rig.R_rest, np.broadcast_to(np.eye(3), (n, 3, 3))]),
        head_m=np.concatenate([head, bounds[places]]),
        tail_m=np.concatenate([tail, bounds[1:][places]]),
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
    return more, replace(rig_map, bones={**rig_map.bones, chain.role: chain_names}, hung=rig_map.hung | ({chain.role} if hung else set()))


def _bounds(rig: Rig, chain: UnshownChain, beside: list[int]) -> np.ndarray:
    """Where the bones of a part begin and end in the rest pose (n + 1, 3): along the rig's own, or from their end on."""
    if chain.beside != chain.role:
        return np.asarray(rig.tail_m[beside[-1]] + np.append(0.0, chain.ends)[:, None] * chain.along_m)
    knots, places = np.append(0.0, fractions_of(rig, beside)), np.stack([*rig.head_m[beside], rig.tail_m[beside[-1]]])
    return np.column_stack([np.interp([0.0, *chain.ends], knots, column) for column in places.T])
