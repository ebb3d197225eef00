"""The conventions of other programs: names of bones, unit, axes, and the order of rotations."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...core.motion.retarget.mapping import Preset, find_map, read_preset
from ...core.motion.retarget.points import joint_of
from ...core.motion.retarget.rig import Motion, Rig
from ...core.motion.retarget.root_motion import root_of, with_root

IMPORTED_BY_BLENDER = (".blend", ".fbx", ".glb", ".gltf", ".vrm")  # motions in these files are opened by Blender
PRESETS = Path(__file__).resolve().parent.parent / "presets"


@dataclass(frozen=True, kw_only=True)
class Program:
    """`names`: a file in presets/ with the names of bones; `prefix`: in front of them, None for the prefix in that file; `unit` and `axes`
    (see core.motion.markers): empty for those of the format; `bvh_order`: the order of BVH's rotation channels; `root`: the name of the
    bone that carries path and heading, which is added where the rig has none."""

    names: str = ""
    prefix: str | None = None
    unit: str = ""
    axes: str = ""
    bvh_order: str = "ZXY"
    root: str = ""


PROGRAMS = {
    "plain": Program(),
    "mixamo": Program(names="mixamo", unit="cm", axes="Y up"),
    "unreal": Program(names="unreal", unit="cm", axes="Z up", root="root"),
    "unity": Program(names="unity", unit="m", axes="Y up", root="Root"),
    "maya": Program(names="mixamo", prefix="", unit="cm", axes="Y up", bvh_order="ZYX"),  # HumanIK's names; a colon would be a name space
    "motionbuilder": Program(names="mixamo", prefix="", unit="cm", axes="Y up", bvh_order="ZYX"),  # its own order: x rotates first
    "opensim": Program(axes="OpenSim"),
}


def presets(controls: bool = False) -> list[Preset]:
    """The mappings that come with Tricap; with `controls` also those of control rigs.

    Raises:
        InputError: one of them was edited and is damaged.
    """
    return [preset for preset in map(read_preset, sorted(PRESETS.glob("*.json"))) if controls or preset.control_rig is None]


def bone_names(rig: Rig, program: Program) -> dict[str, str]:
    """The program's names by the rig's own names, for bones that the program has a name for."""
    if not program.names:
        return {}
    wanted_by_role, prefix = _wanted(program)
    rig_map = find_map(rig, presets())
    own_root = root_of(rig, rig_map)
    given = {own_root: program.root} if own_root and program.root else {}
    for role, chain in rig_map.bones.items():
        wanted = wanted_by_role.get(role, ())
        for bone, name in zip(chain, wanted if len(wanted) >= len(chain) else wanted[:1]):
            given[bone] = prefix + name
    kept = {name for name in rig.names if name not in given}
    return {bone: name for bone, name in given.items() if name not in kept}


def rooted(motion: Motion, program: Program) -> Motion:
    """The motion with a bone that carries path and heading, if the program needs one and the body has legs."""
    return with_root(motion, find_map(motion.rig, presets()), program.root) if program.root else motion


def joint_names(joints: Sequence[str], program: Program) -> tuple[str, ...]:
    """The joints' names: each gets that of the bone that begins at it, if there is one."""
    if not program.names:
        return tuple(joints)
    wanted, prefix = _wanted(program)
    named: list[str] = []
    for joint in joints:
        names = wanted.get(joint_of(joint), ())
        name = prefix + names[0] if names else joint
        named.append(joint if name in named or name in joints else name)
    return tuple(named)


def _wanted(program: Program) -> tuple[dict[str, tuple[str, ...]], str]:
    preset = read_preset(PRESETS / f"{program.names}.json")
    return dict(preset.bones), preset.prefixes[0] if program.prefix is None else program.prefix


def is_imported_by_blender(path: Path) -> bool:
    """Whether Blender itself opens the motion at `path`; a run's folder and the other formats are read by core."""
    return path.suffix.lower() in IMPORTED_BY_BLENDER and not path.is_dir()
