"""What a bone's name says: its side, and which part of the body it may be.

Names are cut into words ("mixamorig:LeftUpLeg" -> left, up, leg; "lShldrBend" -> l, shldr, bend), prefixes of tools and other noise are
dropped, and what is left is looked up. Some words mean different parts in different families ("LeftLeg" is a shin beside
"LeftUpLeg", but a thigh beside "LeftKnee"; "LeftShoulder" is a collar bone beside "LeftArm", but an upper arm beside "LeftCollar"):
these are kept as second guesses, for parts that nothing else is called.
"""

import re
from dataclasses import dataclass

WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
LEFT, RIGHT = {"l", "left", "lft", "lf"}, {"r", "right", "rgt", "rt"}
NOISE = set(
    """j bip bip01 b bn sk c cc base def org jnt joint bone bones mixamorig neo character ctr m f avg valve biped g rig skin bind jt
    bend stretch sub x armature bone1 metarig anim human skeleton""".split()
)
# bones that steer others or carry things: never a part of the body
STEERING = set(
    """ik pole control ctrl target end nub tip slot socket heel goal helper mch vis tweak gizmo prop weapon attach site lock
    parent master widget roll pivot offset handle look aim fk2 leaf eff effector secondary
    hair skirt cloth breast bust eye jaw tongue""".split()
)
ENDS = {"end", "nub", "tip", "leaf", "site", "eff", "effector"}  # bones that only tell where the one before ends
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
    """What a name says. `part` for certain, or one of `perhaps`; `finger` such as "thumb.1"; `twist`: it shares a part's twist."""

    side: str = ""
    part: str = ""
    perhaps: tuple[str, ...] = ()
    finger: str = ""
    twist: bool = False


def read_name(name: str) -> Reading:
    """What the name of a bone says; an empty Reading if nothing."""
    words = [word.lower() for word in WORD.findall(_without_prefix(name))]
    side, words = side_of_words(words)
    twist = bool(TWIST & set(words)) and not ({"control", "ctrl", "ik"} & set(words))
    words = [word for word in words if word not in TWIST or not twist]
    if STEERING & set(words):
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
    """Whether a bone's name says that it only tells where another one ends ("head_end", "HeadTop_End", "Bip01 HeadNub")."""
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
