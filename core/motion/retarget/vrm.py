"""What a VRM file says its bones are: the humanoid table in the JSON of a binary glTF file (VRM 0.x and 1.0 specifications)."""

import json
import struct
from pathlib import Path

from ...errors import InputError
from .roles import sided

LARGEST_JSON = 1 << 28
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
        InputError: it cannot be read or is no binary glTF file.
    """
    try:
        with Path(path).open("rb") as file:
            magic, _, _, length, kind = struct.unpack("<4sIII4s", file.read(20))
            if magic != b"glTF" or kind != b"JSON" or length > min(LARGEST_JSON, Path(path).stat().st_size):
                raise InputError(f"{path} is not a binary glTF file or is damaged; export it again.")
            table = json.loads(file.read(length))
        nodes, extensions = table.get("nodes", []), table.get("extensions", {})
        bones = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
        pairs = [(row["bone"], row["node"]) for row in bones]
        pairs += [(bone, row["node"]) for bone, row in extensions.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {}).items()]
        return {role: nodes[node]["name"] for bone, node in pairs if (role := role_of(bone)) and "name" in nodes[node]}
    except (OSError, ValueError, struct.error, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path} is not a VRM or glTF file that can be read ({error}); export it again.") from error


def role_of(bone: str) -> str:
    """ "leftUpperArm" -> "upper_arm.L"; "" for bones that are no role of ours."""
    if bone in ("hips", "head", "neck"):
        return bone if bone != "neck" else ""
    for word, side in (("left", "L"), ("right", "R")):
        if bone.startswith(word):
            part = PARTS.get(bone[len(word) :].lower())
            return sided(part, side) if part else ""
    return ""
