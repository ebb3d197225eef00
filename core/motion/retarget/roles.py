"""The parts of a body that rigs have in common, and how they hang together. Names are Blender's, as everywhere in Tricap.

A limb's bones are rigid parts: their directions are what a motion looks like. The spine, the neck and the hand are chains that
bend, of as many bones as a rig happens to have.
"""

from collections.abc import Container, Iterable

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
    """The nearest role that a role hangs on, of those `among` which one is looked for; "" where there is none."""
    found = parent_role(role)
    while found and found not in among:
        found = parent_role(found)
    return found


def parent_role(role: str) -> str:
    """The role that a role hangs on; "" for the hips."""
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
