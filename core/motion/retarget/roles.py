"""The parts of a body that rigs have in common, and their hierarchy. Names are Blender's, as everywhere in Tricap.

A limb's bones are rigid parts, whose directions define what a motion looks like. The spine, the neck and the hand are chains that bend, of
any number of bones.

Reading a bone's name: its side, and the part of the body it may be.

Names are cut into words ("mixamorig:LeftUpLeg" -> left, up, leg; "lShldrBend" -> l, shldr, bend), prefixes of tools and other noise are
dropped, and the rest is looked up. Some words mean different parts in different families ("LeftLeg" is a shin next to
"LeftUpLeg", but a thigh next to "LeftKnee"; "LeftShoulder" is a collar bone next to "LeftArm", but an upper arm next to "LeftCollar"):
these are second guesses, for parts without a bone of an unambiguous name.

The roles of bones in a VRM file: the humanoid table in the JSON of a binary glTF file (VRM 0.x and 1.0 specifications).
"""

import re
from collections.abc import Container, Iterable
from dataclasses import dataclass
from pathlib import Path

from ..formats.gltf import DAMAGE, read_table, unreadable

SIDES = ("L", "R")
ARM = ("clavicle", "upper_arm", "forearm", "hand")
LEG = ("thigh", "shin", "foot", "toe")
FINGERS = ("thumb", "index", "middle", "ring", "pinky")

SPREAD = ("spine", "neck", "hand")  # chains that bend: rotations are spread over them
TORSO = ("hips", "spine", "neck", "head")
OWN_NAMES = {"pelvis": "hips", "shoulder": "clavicle"}  # of the bones of Tricap's models that are not called like their part
# what a limb's part begins and ends at: its own first bone, and the next part's
SEGMENTS = (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))


def sided(part: str, side: str) -> str:
    """The role of a part on one side: "forearm", "L" -> "forearm.L"."""
    return f"{part}.{side}"


def part_of(role: str) -> str:
    """ "forearm.L" -> "forearm"."""
    return role[:-2] if role.endswith((".L", ".R")) else role


def side_of(role: str) -> str:
    """ "forearm.L" -> "L"; "" for the torso."""
    return role[-1] if role.endswith((".L", ".R")) else ""


def finger_roles(side: str) -> tuple[str, ...]:
    """ "thumb.1.L", … "pinky.3.L"."""
    return tuple(f"{finger}.{k}.{side}" for finger in FINGERS for k in (1, 2, 3))


ROLES = (*TORSO, *(sided(part, side) for side in SIDES for part in (*ARM, *LEG)), *(r for side in SIDES for r in finger_roles(side)))


def model_roles(names: Iterable[str]) -> dict[str, str]:
    """Bones of Tricap's own models by role. Of collar and shoulder it is the shoulder that moves like a clavicle."""
    found: dict[str, str] = {}
    for name in names:
        part, side = part_of(name), side_of(name)
        part = OWN_NAMES.get(part, part)
        role = sided(part, side) if side else part
        if role in ROLES:
            found[role] = name
    return found


def above(role: str, among: Container[str]) -> str:
    """The nearest ancestor of a role in `among`; "" if there is none."""
    found = parent_role(role)
    while found and found not in among:
        found = parent_role(found)
    return found


def parent_role(role: str) -> str:
    """The parent of a role; "" for the hips."""
    part, side = part_of(role), side_of(role)
    if part in ("clavicle", "neck"):
        return "spine"
    if part in ("spine", "thigh"):
        return "hips"
    if part == "head":
        return "neck"
    if role == "hips":
        return ""
    for line in (ARM, LEG):
        if part in line:
            return sided(line[line.index(part) - 1], side)
    finger, k = part.split(".")
    return sided("hand", side) if k == "1" else f"{finger}.{int(k) - 1}.{side}"


WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
LEFT, RIGHT = {"l", "left", "lft", "lf"}, {"r", "right", "rgt", "rt"}
NOISE = set(
    """j bip bip01 b bn sk c cc base def org jnt joint bone bones mixamorig neo character ctr m f avg valve biped g rig skin bind jt
    bend stretch sub x armature bone1 metarig anim human skeleton""".split()
)
# controls of other bones, and attachments: never a part of the body
CONTROLS = set(
    """ik pole control ctrl target end nub tip slot socket heel goal helper mch vis tweak gizmo prop weapon attach site lock
    parent master widget roll pivot offset handle look aim fk2 leaf eff effector secondary
    hair skirt cloth breast bust eye jaw tongue""".split()
)
ENDS = {"end", "nub", "tip", "leaf", "site", "eff", "effector"}  # bones that only mark the end of their parent
TWIST = {"twist", "twst", "roll"}

SURE = {
    "hips": "hips pelvis hip waistroot",
    "head": "head skull",
    "neck": "neck lowerneck upperneck cervical necklower neckupper",
    "spine": "spine back lowerback upperback torso chest thorax abdomen waist upperchest ribcage spinelower spineupper chestlower "
    "chestupper abdomenlower abdomenupper abdomen2 stomach",
    "clavicle": "clavicle collar collarbone clav",
    "upper_arm": "upperarm uparm humerus shldr armupper bicep armup",
    "forearm": "forearm lowerarm lowarm elbow radius armlower ulna armlow foarm",
    "hand": "hand wrist palm",
    "thigh": "thigh upleg upperleg femur legupper legup uleg",
    "shin": "shin calf knee lowerleg lowleg tibia leglower leglow lleg",
    "foot": "foot ankle feet",
    "toe": "toe toes toebase ball forefoot football",
}
PERHAPS = {"clavicle": "shoulder", "upper_arm": "arm shoulder", "thigh": "leg hip hipjoint", "shin": "leg"}
FINGER = re.compile(r"(thumb|index|middle|mid|ring|pinky|pinkie|little)")
FINGER_NAMES = {"mid": "middle", "pinkie": "pinky", "little": "pinky"}
SEGMENT = {"metacarpal": 0, "mcarpal": 0, "meta": 0, "proximal": 1, "intermediate": 2, "distal": 3}

_SURE = {word: part for part, words in SURE.items() for word in words.split()}
_PERHAPS: dict[str, tuple[str, ...]] = {}
for _part, _words in PERHAPS.items():
    for _word in _words.split():
        _PERHAPS[_word] = (*_PERHAPS.get(_word, ()), _part)
_SIDED_WORDS = {*_SURE, *_PERHAPS, "fingers", "thumb", "index", "middle", "ring", "pinky"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Reading:
    """The meaning of a name. `part` for certain, or one of `perhaps`; `finger` such as "thumb.1"; `twist`: a twist bone."""

    side: str = ""
    part: str = ""
    perhaps: tuple[str, ...] = ()
    finger: str = ""
    twist: bool = False


def read_name(name: str) -> Reading:
    """The meaning of a bone's name; an empty Reading if it has none."""
    words = [word.lower() for word in WORD.findall(_without_prefix(name))]
    side, words = side_of_words(words)
    twist = bool(TWIST & set(words)) and not ({"control", "ctrl", "ik"} & set(words))
    words = [word for word in words if word not in TWIST or not twist]
    if CONTROLS & set(words):
        return Reading(side=side)
    plain = [word for word in words if not word.isdigit() and word not in NOISE]
    core = "".join(plain)
    finger = _finger(core, plain, words) if side else ""
    if finger:
        return Reading(side=side, finger=finger)
    part, perhaps = _SURE.get(core, ""), _PERHAPS.get(core, ())
    if side and part == "hips":  # a sided hip is a hip joint
        part, perhaps = "", ("thigh",) if core == "hip" else ()
    if not side and part not in ("", "hips", "spine", "neck", "head"):
        part = ""
    return Reading(side=side, part=part, perhaps=perhaps if side else (), twist=twist)


def marks_an_end(name: str) -> bool:
    """Whether a bone only marks the end of its parent, by its name ("head_end", "HeadTop_End", "Bip01 HeadNub")."""
    return bool(ENDS & {word.lower() for word in WORD.findall(name)})


def _without_prefix(name: str) -> str:
    """Without name spaces ("mixamorig:Hips", "ValveBiped.Bip01_…", "Armature|…") and the counters that importers add."""
    name = re.split(r"[:|]", name)[-1]
    name = re.sub(r"(?i)^(valvebiped\.)?bip\s?\d*[\s_]+", "", name)
    name = re.sub(r"(?i)^(def|org)[-_]", "", name)
    return re.sub(r"(?i)^(j_(bip|sec|adj)|cc_base|neo|character\d*|m_avg|f_avg)_", "", name)


def side_of_words(words: list[str]) -> tuple[str, list[str]]:
    """Side (“L”, “R” or none) of a name that was cut into lower-case words, and the other words."""
    sides = [("L" if word in LEFT else "R") for word in words if word in LEFT | RIGHT]
    rest = [word for word in words if word not in LEFT | RIGHT]
    if sides:
        return sides[0], rest
    if words and words[0][0] in "lr" and words[0][1:] in _SIDED_WORDS:  # lfemur, rhumerus
        return words[0][0].upper(), [words[0][1:], *words[1:]]
    for prefix, side in (("left", "L"), ("right", "R")):
        if words and words[0].startswith(prefix):
            return side, [words[0][len(prefix) :], *words[1:]]
    return "", words


def _finger(core: str, plain: list[str], words: list[str]) -> str:
    """ "LeftHandIndex1" -> "index.1"; the base in the palm counts as 0."""
    found = FINGER.search(core)
    if not found or "toe" in core or "foot" in core:
        return ""
    finger = FINGER_NAMES.get(found[1], found[1])
    if "in" in plain:
        return f"{finger}.0"
    named = [SEGMENT[word] for word in plain if word in SEGMENT]
    if named:
        metacarpal_first = finger == "thumb" and 0 in named
        return f"{finger}.{1 if metacarpal_first else named[0]}"
    numbers = [int(word) for word in words if word.isdecimal()]
    return f"{finger}.{numbers[0] if numbers else 1}"


PARTS = {
    "shoulder": "clavicle",
    "upperarm": "upper_arm",
    "lowerarm": "forearm",
    "hand": "hand",
    "upperleg": "thigh",
    "lowerleg": "shin",
    "foot": "foot",
    "toes": "toe",
}


def read_humanoid(path: Path) -> dict[str, str]:
    """Names of nodes by role; empty for a glTF file that is no VRM.

    Raises:
        InputError: it cannot be read or is no glTF file.
    """
    table = read_table(path)
    try:
        nodes, extensions = table.get("nodes", []), table.get("extensions", {})
        bones = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
        pairs = [(row["bone"], row["node"]) for row in bones]
        pairs += [(bone, row["node"]) for bone, row in extensions.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {}).items()]
        return {role: nodes[node]["name"] for bone, node in pairs if (role := role_of(bone)) and "name" in nodes[node]}
    except DAMAGE as error:
        raise unreadable(path, error) from error


def role_of(bone: str) -> str:
    """ "leftUpperArm" -> "upper_arm.L"; "" for bones without a role."""
    if bone in ("hips", "head", "neck"):
        return bone if bone != "neck" else ""
    for word, side in (("left", "L"), ("right", "R")):
        if bone.startswith(word):
            part = PARTS.get(bone[len(word) :].lower())
            return sided(part, side) if part else ""
    return ""
