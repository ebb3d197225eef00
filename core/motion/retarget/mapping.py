"""The mapping of a rig's bones to the parts of a body: found by names, completed by the hierarchy, or read from a file.

The spine and the neck need no names: they are the bones between hips, arms and head. Parts that could not be mapped are listed in
`missing` with the reason; `notes` name what was found by shape alone.
"""

from collections.abc import Mapping as Map
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...foundation import store
from ...foundation.errors import InputError
from ...foundation.settings import nearest_name
from .rig import ControlRig, Motion, Rig
from .roles import ARM, FINGERS, LEG, ROLES, SIDES, Reading, read_name, sided
from .shape import ShapeMatch, by_shape

FITS = 0.9  # fraction of a preset's bones that a rig must have for the preset to be chosen
LIMB_ROLES = 8  # a rig with whole limbs but at most so many parts is a limb or half a body, not an unrecognised person
HEAD_OFF_AXIS = 0.02  # by the rig's height: the bones of neck and head are not farther from the chest's vertical
MOST_DEG = 360.0  # of a rotation offset
MOST_NAMES, LONGEST_NAME = 100, 255  # of a part or of the prefixes, in a mapping
MOST_ON_NECK = 3  # a bone with more children is not part of a neck
NEEDED = ("hips", *(sided(part, side) for side in SIDES for part in ("upper_arm", "forearm", "thigh", "shin")))


@dataclass(frozen=True, eq=False, kw_only=True)
class RigMap:
    """`bones`: by role, a chain of bone names from the body outwards. `twist`: by role, the twist bones. `restored`: roles that the rig
    lacks, whose rotations come from the residual motion. `offsets_deg`: by role, a rotation of the target's part relative to
    the source's, as Euler angles XYZ [°] about the part's axes in its rest pose."""

    bones: Map[str, tuple[str, ...]]
    twist: Map[str, tuple[str, ...]] = field(default_factory=dict)
    missing: Map[str, str] = field(default_factory=dict)  # by role, why it has no bones
    notes: tuple[str, ...] = ()
    origin: str = "names"
    control_rig: ControlRig | None = None  # of a rig whose mapped bones are controls
    restored: frozenset[str] = frozenset()
    offsets_deg: Map[str, tuple[float, float, float]] = field(default_factory=dict)

    def first(self, role: str) -> str | None:
        """The bone at whose head the part begins."""
        return self.bones[role][0] if role in self.bones else None

    @property
    def missing_notes(self) -> tuple[str, ...]:
        """A sentence for each reason why parts are missing."""
        roles: dict[str, list[str]] = {}
        for role, reason in self.missing.items():
            roles.setdefault(reason, []).append(role)
        return tuple(f"{', '.join(missing)}: {reason}" for reason, missing in roles.items())


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MappedRig:
    """A rig with its mapping."""

    rig: Rig
    map: RigMap


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MappedMotion:
    """A motion with the mapping of its rig."""

    motion: Motion
    map: RigMap

    @property
    def rig(self) -> Rig:
        """The rig that moves."""
        return self.motion.rig

    @property
    def mapped_rig(self) -> MappedRig:
        """The rig alone, with its mapping."""
        return MappedRig(rig=self.rig, map=self.map)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A mapping for a family of rigs: the bones' names by role, each preceded by one of `prefixes`."""

    name: str
    bones: Map[str, tuple[str, ...]]
    twist: Map[str, tuple[str, ...]] = field(default_factory=dict)
    prefixes: tuple[str, ...] = ("",)
    control_rig: ControlRig | None = None
    offsets_deg: Map[str, tuple[float, float, float]] = field(default_factory=dict)


def read_preset(path: Path) -> Preset:
    """A preset from a JSON file; "{s}" in a role or name stands for both sides, spelled as in `sides`.

    Raises:
        InputError: the file cannot be read, or is no mapping.
    """
    table = store.read_json(path)
    if not isinstance(table, dict) or not isinstance(table.get("bones"), dict):
        raise InputError(f"{path} is no mapping of bones; it needs a table “bones” with a name or list of names by role.")
    sides = table.get("sides", {"L": "L", "R": "R"})
    prefixes = table.get("prefixes", [""])
    spelt = isinstance(sides, dict) and set(sides) == {"L", "R"} and _are_names([*sides.values()])
    if not spelt or not _are_names(prefixes):
        raise InputError(
            f'{path} has invalid “sides” or “prefixes”; write {{"L": "Left", "R": "Right"}} and a list of at most {MOST_NAMES} short texts.'
        )
    parts = {key: _by_role(table.get(key, {}), sides, key, path) for key in ("bones", "twist")}
    control_rig = control_rig_of(table["steering"], sides, path) if "steering" in table else None
    offsets = _offsets(table.get("offsets_deg", {}), path)
    name = str(table.get("name", Path(path).stem))
    return Preset(name=name, prefixes=tuple(prefixes), control_rig=control_rig, offsets_deg=offsets, **parts)


def _are_names(value: Any) -> bool:
    """Whether this is a list of names of a length that bones have: every prefix is tried with every name, and sides are put into them."""
    return isinstance(value, list) and 0 < len(value) <= MOST_NAMES and all(isinstance(x, str) and len(x) <= LONGEST_NAME for x in value)


def _offsets(table: Any, path: Path) -> dict[str, tuple[float, float, float]]:
    rows: dict[str, tuple[float, float, float]] = {}
    for role, angles in table.items() if isinstance(table, dict) else ():
        valid = isinstance(angles, list) and len(angles) == 3 and all(isinstance(a, (int, float)) and abs(a) <= MOST_DEG for a in angles)
        if role not in ROLES or not valid:
            raise InputError(f"{path} has no three angles in degrees for a part of the body at “{str(role)[:40]}” in “offsets_deg”.")
        rows[role] = (float(angles[0]), float(angles[1]), float(angles[2]))
    return rows


def control_rig_of(table: Any, sides: Map[str, str], path: Path | str) -> ControlRig:
    """The part “steering” of a preset; "{s}" in a bone's name stands for both sides.

    Raises:
        InputError: it has another layout; `path` is its name there.
    """
    if not isinstance(table, dict) or not isinstance(table.get("follows"), dict):
        raise InputError(f"{path} has no hierarchy of its controls; “steering” needs a table “follows” with a name by name.")

    def both(part: Any) -> dict[str, Any]:
        return {
            str(key).replace("{s}", side): value.replace("{s}", side) if isinstance(value, str) else value
            for key, value in (part.items() if isinstance(part, dict) else ())
            for side in sides.values()
        }

    follows, skin, properties = (both(table.get(key)) for key in ("follows", "skin", "properties"))
    if not all(isinstance(name, str) for name in [*follows.values(), *skin.values()]):
        raise InputError(f"{path} must have names of bones in “follows” and “skin” of “steering”.")
    ends: set[str] = set()  # names from which the line upwards ends
    for name in follows:
        line, above = {name: None}, follows.get(name)
        while above is not None and above not in ends:
            if above in line:
                raise InputError(f"{path} lets “{name}” follow itself; correct “follows” of “steering”.")
            line[above], above = None, follows.get(above)
        ends.update(line)
    for values in properties.values():
        if not isinstance(values, dict) or not all(isinstance(v, (int, float)) for v in values.values()):
            raise InputError(f"{path} needs numbers by name in “properties” of “steering”.")
    return ControlRig(follows=follows, properties=properties, skin=skin)


def _by_role(table: Any, sides: Map[str, str], key: str, path: Path) -> dict[str, tuple[str, ...]]:
    rows: dict[str, tuple[str, ...]] = {}
    for role, names in table.items() if isinstance(table, dict) else ():
        chain = [names] if isinstance(names, str) else names
        if not _are_names(chain):
            raise InputError(f"{path} names no bones for “{role[:40]}” in “{key}”; write a name or a list of at most {MOST_NAMES} names.")
        for side, written in sides.items() if role.endswith("{s}") else (("", ""),):
            rows[role.replace("{s}", side)] = tuple(name.replace("{s}", written) for name in chain)
    for role in rows:
        if role not in ROLES:
            raise InputError(f"{path} maps “{role}”, which is no part of the body.{nearest_name(role, list(ROLES))}")
    return rows


def write_map(path: Path, rig_map: RigMap, name: str) -> None:
    """The mapping as a preset file that `read_preset` reads and people edit.

    Raises:
        InputError: the file cannot be written.
    """
    control_rig = rig_map.control_rig
    store.write_json(
        path,
        {"name": name, "bones": {r: list(c) for r, c in rig_map.bones.items()}, "twist": {r: list(c) for r, c in rig_map.twist.items()}}
        | ({"offsets_deg": {r: list(angles) for r, angles in rig_map.offsets_deg.items()}} if rig_map.offsets_deg else {})
        | ({"steering": control_rig.table()} if control_rig is not None else {}),
    )


def apply_preset(rig: Rig, preset: Preset) -> RigMap:
    """The mapping that a preset gives on this rig; bones that the rig lacks are missing.

    Raises:
        InputError: none of its bones are in the rig.
    """
    best = max(preset.prefixes, key=lambda prefix: sum(prefix + name in rig.index for chain in preset.bones.values() for name in chain))
    found = {role: tuple(best + name for name in chain if best + name in rig.index) for role, chain in preset.bones.items()}
    twist = {role: tuple(best + name for name in chain if best + name in rig.index) for role, chain in preset.twist.items()}
    bones = {role: chain for role, chain in found.items() if chain}
    if not bones:
        raise InputError(f"None of the bones of the mapping “{preset.name}” are in this rig; choose another mapping, or Recognise.")
    missing = {role: f"no bone “{preset.bones[role][0]}”" for role in preset.bones if role not in bones}
    return RigMap(
        bones=bones,
        twist={role: chain for role, chain in twist.items() if chain and role in bones},
        missing=missing,
        origin=f"mapping “{preset.name}”",
        control_rig=preset.control_rig,
        offsets_deg={role: angles for role, angles in preset.offsets_deg.items() if role in bones},
    )


def fit_of(rig: Rig, preset: Preset) -> tuple[float, int]:
    """The fraction (0…1) and the number of a preset's bones that a rig has under exactly these names."""
    names = [name for chain in preset.bones.values() for name in chain]
    count = max(sum(prefix + name in rig.index for name in names) for prefix in preset.prefixes)
    return count / max(len(names), 1), count


def best_preset(rig: Rig, presets: Sequence[Preset]) -> Preset | None:
    """The preset that fits; of several, one of controls, then the one with the most bones (a mannequin of five spine bones also has the
    three of its predecessor)."""
    fitting = [preset for preset in presets if fit_of(rig, preset)[0] > FITS]
    return max(fitting, key=lambda preset: (preset.control_rig is not None, fit_of(rig, preset)[1]), default=None)


def find_map(rig: Rig, presets: Sequence[Preset] = (), *, called: str = "this rig") -> RigMap:
    """Recognise a rig: by its file's own roles, a preset's names, single names, and its shape, in that order of trust.

    `called`: what it is called in an error.

    Raises:
        InputError: no part of a body could be recognised.
    """
    best = best_preset(rig, presets)
    if best is not None:
        found = apply_preset(rig, best)
        return found if found.control_rig is not None else _completed(rig, found)
    named = by_names(rig)
    if all(role in named.bones for role in NEEDED) or _is_limb(named):
        return named
    shaped = by_shape(rig)
    if shaped is not None and len(shaped.bones) > len(named.bones):
        return _shape_map(rig, shaped)
    if named.bones:
        return named
    raise InputError(
        f"No part of a body could be recognised in {called}, neither by its bones' names nor by its shape;"
        " write a mapping (see docs/retargeting.md)."
    )


def _shape_map(rig: Rig, shaped: ShapeMatch) -> RigMap:
    notes = ("recognised by its shape, not by names: check it",) + (
        () if shaped.sides_known else ("left and right are a guess: the feet do not show which way is forward",)
    )
    return _completed(rig, RigMap(bones=shaped.bones, notes=notes, origin="shape"))


def _is_limb(named: RigMap) -> bool:
    """A measured limb, or half a body: whole limbs, but not all of them."""
    whole = [all(sided(part, side) in named.bones for part in parts) for side in SIDES for parts in (ARM[1:3], LEG[:2])]
    return any(whole) and len(named.bones) <= LIMB_ROLES


def by_names(rig: Rig) -> RigMap:
    """The parts by the names of their bones; spine and neck are the bones between."""
    readings = {name: read_name(name) for name in rig.names}
    bones: dict[str, tuple[str, ...]] = {role: (bone,) for role, bone in rig.roles.items() if role in ROLES and bone in rig.index}
    for side in SIDES:
        for parts in (ARM, LEG):
            _limb(rig, readings, side, parts, bones)
        _fingers(rig, readings, side, bones)
    _torso(rig, readings, bones)
    return _completed(rig, RigMap(bones=bones))


def _limb(rig: Rig, readings: Map[str, Reading], side: str, parts: Sequence[str], bones: dict[str, tuple[str, ...]]) -> None:
    """Fill in one limb from the body outwards: each part's bones must descend from those of the part before."""
    sure = {part: [n for n, r in readings.items() if r.side == side and r.part == part and not r.twist] for part in parts}
    _guess(rig, readings, side, parts, sure)
    above: str | None = None
    for part in parts:
        role = sided(part, side)
        if role not in bones:
            chain = _chain(rig, [n for n in sure[part] if above is None or _descends(rig, n, above)])
            if chain:
                bones[role] = chain
        above = bones[role][-1] if role in bones else above


def _guess(rig: Rig, readings: Map[str, Reading], side: str, parts: Sequence[str], sure: dict[str, list[str]]) -> None:
    """Fill parts without an unambiguous name from names with several meanings: the deepest bone is the outermost possible part, but thigh
    and upper arm come first if there are too few bones."""
    taken = {n for names in sure.values() for n in names}
    free = [n for n, r in readings.items() if r.side == side and r.perhaps and not r.twist and n not in taken]
    order = [part for part in ("upper_arm", "clavicle", "shin", "thigh") if part in parts and not sure[part]]
    if "shin" in order and "thigh" in order and len(free) < 2:
        order.remove("shin")
    for part in order:
        guesses = [n for n in free if part in readings[n].perhaps]
        if guesses:
            deepest = max(guesses, key=lambda n: len(rig.ancestors(rig.index[n])))
            sure[part] = [deepest]
            free.remove(deepest)


def _descends(rig: Rig, name: str, above: str) -> bool:
    return rig.index[above] in rig.ancestors(rig.index[name])[1:]


def _chain(rig: Rig, names: Sequence[str]) -> tuple[str, ...]:
    """The longest chain, from the body outwards, of bones with the same meaning."""
    lines = []
    for bottom in names:
        line = [rig.names[b] for b in reversed(rig.ancestors(rig.index[bottom])) if rig.names[b] in names]
        lines.append(tuple(line))
    return max(lines, key=len, default=())


def _fingers(rig: Rig, readings: Map[str, Reading], side: str, bones: dict[str, tuple[str, ...]]) -> None:
    hand = bones.get(sided("hand", side))
    for finger in FINGERS if hand else ():
        found = sorted(
            (int(r.finger.split(".")[1]), n)
            for n, r in readings.items()
            if r.side == side and r.finger.startswith(finger) and hand and _descends(rig, n, hand[-1])
        )
        numbers = [n for k, n in found if k > 0]
        if len({k for k, _ in found if k > 0}) == len(numbers):
            for k, name in enumerate(numbers[:3], 1):
                bones.setdefault(f"{finger}.{k}.{side}", (name,))


def _torso(rig: Rig, readings: Map[str, Reading], bones: dict[str, tuple[str, ...]]) -> None:
    """Hips, spine, neck and head: between the limbs, named or not."""
    thighs = [rig.index[bones[r][0]] for r in ("thigh.L", "thigh.R") if r in bones]
    arms = [rig.index[bones[r][0]] for side in SIDES for r in (sided("clavicle", side), sided("upper_arm", side)) if r in bones]
    central = [(r.part, rig.index[n]) for n, r in readings.items() if not r.side]
    named = {part: [b for p, b in central if p == part] for part in ("hips", "head", "neck", "spine")}
    hips = rig.index[bones["hips"][0]] if "hips" in bones else None
    if hips is None and len(thighs) == 2:
        fork = rig.common(*thighs)
        hips = next((b for b in rig.ancestors(fork) if b in named["hips"]), fork) if fork is not None else None
    if hips is None and named["hips"]:
        hips = min(named["hips"])
    if hips is not None:
        bones.setdefault("hips", (rig.names[hips],))
    head = rig.index[bones["head"][0]] if "head" in bones else min(named["head"], default=None)
    chest = _fork(rig, arms, head, hips, named["spine"])
    if chest is not None and hips is not None:
        fork = rig.common(hips, chest)
        line = rig.path(hips, chest)[1:] or (rig.path(fork, chest)[1:] if fork is not None and chest != hips else [])
        if line:
            bones["spine"] = tuple(rig.names[b] for b in line)
    top = chest if chest is not None else hips
    if head is None and top is not None:
        head = _central_end(rig, top, arms, named["neck"])
    if head is not None:
        bones.setdefault("head", (rig.names[head],))
        line = rig.path(top, head)[1:-1] if top is not None else [b for b in rig.ancestors(head)[:0:-1] if b in named["neck"]]
        if line:
            bones["neck"] = tuple(rig.names[b] for b in line)


def _fork(rig: Rig, arms: Sequence[int], head: int | None, hips: int | None, spine: Sequence[int]) -> int | None:
    """The chest: the bone where the arms (and the head) fork."""
    ends = [rig.ancestors(b)[1] for b in arms if len(rig.ancestors(b)) > 1]
    chest: int | None = ends[0] if ends else None
    for end in ends[1:]:
        chest = rig.common(chest, end) if chest is not None else None
    if chest is not None and head is not None:
        chest = rig.common(chest, head)
    if chest is None or chest == hips:
        below = [b for b in spine if hips is None or hips in rig.ancestors(b)]
        chest = max(below, key=lambda b: len(rig.ancestors(b)), default=None)
    return chest


def _central_end(rig: Rig, top: int, arms: Sequence[int], necks: Sequence[int]) -> int | None:
    """A head without a name: the last bone of the chain that leads upwards from the chest, between the arms."""
    on_arms = {b for arm in arms for b in rig.ancestors(arm)}
    bone, found = top, None
    while True:
        width = rig.height_m * HEAD_OFF_AXIS
        ahead = [
            c
            for c in rig.children[bone]
            if c not in on_arms
            and abs(rig.head_m[c][0] - rig.head_m[top][0]) < width
            and rig.head_m[c][2] > rig.head_m[bone][2] - width
            and rig.tail_m[c][2] > rig.head_m[c][2]
        ]
        if not ahead or len(rig.children[bone]) > MOST_ON_NECK and bone != top:
            return found
        bone = found = max(ahead, key=lambda c: rig.tail_m[c][2])


def _completed(rig: Rig, found: RigMap) -> RigMap:
    """Add the intermediate bones of limbs and trunk, and twist bones, and list the missing parts."""
    bones, twist = dict(found.bones), dict(found.twist)
    used = {name for chain in bones.values() for name in chain} | {name for names in twist.values() for name in names}
    for side in SIDES:
        for part, after in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot")):
            role, following = sided(part, side), bones.get(sided(after, side))
            if role not in bones:
                continue
            first = rig.index[bones[role][0]]
            if following:
                line = [rig.names[b] for b in rig.path(first, rig.index[following[0]])[:-1]]
                bones[role] = tuple(n for n in line if n in bones[role] or n not in used) or bones[role]
            line_bones = {rig.index[n] for n in bones[role]}
            twist_bones = [
                n
                for b, n in enumerate(rig.names)
                if n not in used and n not in bones[role] and rig.parents[b] in line_bones and read_name(n).twist and not rig.children[b]
            ]
            if twist_bones:
                twist[role] = (*twist.get(role, ()), *twist_bones)
    bones |= _up_to_the_head(rig, bones)
    known = {name for chain in bones.values() for name in chain}
    unrecognised = {role: "no bone was recognised" for role in NEEDED if role not in bones and role not in found.missing}
    return RigMap(
        bones={role: bones[role] for role in ROLES if role in bones},
        twist=twist,
        missing={**found.missing, **unrecognised},
        notes=found.notes + ((f"{len(rig.names) - len(known)} other bones follow their parents",) if len(rig.names) > len(known) else ()),
        origin=found.origin,
        offsets_deg=found.offsets_deg,
    )


def _up_to_the_head(rig: Rig, bones: Map[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Spine and neck, extended up to the arms and the head where a preset's names stop earlier."""
    longer = {}
    arms = [bones[role][0] for part in ("clavicle", "upper_arm") for role in (sided(part, "L"), sided(part, "R")) if role in bones]
    for role, ends in (("spine", [*arms[:2], *bones.get("neck", bones.get("head", ()))[:1]]), ("neck", bones.get("head", ()))):
        if role in bones and ends:
            lines = [rig.path(rig.index[bones[role][-1]], rig.index[end])[1:-1] for end in ends]
            longer[role] = (*bones[role], *(rig.names[b] for b in lines[0] if all(b in line for line in lines)))
    return longer
