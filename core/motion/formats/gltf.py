"""glTF 2.0 and VRM: the JSON part, and what Blender's importer would make of a file, counted before it does (Khronos, glTF 2.0, 2021).

The importer trusts what a file says of itself: an accessor without data is zeros of any number, one accessor may be used by any number of
meshes, every node becomes an object, a mesh is made anew for each of its skins, and a buffer may lie in any file, also one that never ends.
A file of 300 bytes can ask for gigabytes, or for hours. No honest one of its size does.
"""

import math
import os
import re
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...foundation import bounded
from ...foundation.errors import InputError, damage_of

DEEPEST = 200  # nodes in each other
MOST_NODES = 10_000  # and instances, each of which becomes an object, and shapes of meshes
MOST_BONES = 3000  # of a skin: Blender's time grows with their square
MOST_ANIMATED = 1_000_000  # nodes times animations: the importer looks for every node in every animation
MOST_VALUES = 10_000_000  # of all accessors, as often as they are used
VALUES_PER_BYTE = 20  # for larger files
MOST_SCENES = 100  # Blender's time grows with the square of their number, of that of materials, and of that of meshes
MOST_LISTED = 100_000  # nodes of all scenes, with those in them
MOST_MATERIALS = 1000  # used, with or without colours of vertices
MOST_IMAGES = 200
MOST_PRIMITIVES = 1000  # of all meshes, as often as these are made, and variants of their materials
MOST_JOINTS = 50_000  # of all skins, and of all meshes with them
MOST_JOINED = 2_000_000_000  # values of a mesh times its primitives: the importer copies it for each
JOINED_PER_BYTE = 100
MOST_CHANNELS = 3000  # of all animations
BYTES_PER_CHANNEL = 100  # for larger files
MOST_FPS = 1000
RATE_TOLERANCE = 1e-4  # of a rate: times are floats of 32 bits
VALUES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
DAMAGE = (OSError, ValueError, struct.error, KeyError, IndexError, TypeError, AttributeError)


def read_table(path: Path) -> dict[str, Any]:
    """The JSON part of a binary file (.glb, .vrm), or the JSON file (.gltf).

    Raises:
        InputError: it cannot be read or is no glTF file.
    """
    try:
        with bounded.opened(path, bounded.ARRAYS_BYTES) as file:
            head, size = file.read(20), os.fstat(file.fileno()).st_size
            if head[:4] == b"glTF":
                length, kind = struct.unpack("<I4s", head[12:])
                if kind != b"JSON" or length > min(bounded.JSON_BYTES, size):
                    raise ValueError("its first part is not JSON, or longer than the file")
                table = bounded.json_of(file.read(length))
            elif path.suffix.lower() != ".gltf":
                raise ValueError("it is not a binary glTF file")
            else:
                table = bounded.json_of(bounded.bytes_of(path, bounded.JSON_BYTES))
        if not isinstance(table, dict):
            raise ValueError("it has no table")
    except DAMAGE as error:
        raise unreadable(path, error) from error
    return table


def unreadable(path: Path, error: Exception) -> InputError:
    """The sentence about a file with a fault of that kind."""
    return InputError(f"{path} is not a VRM or glTF file that can be read ({damage_of(error)}); export it again.")


def check_gltf(path: Path) -> None:
    """Check that a file does not ask for far more than it contains, nor for files outside of its folder.

    Raises:
        InputError: it does, or cannot be read.
    """
    table = read_table(path)
    try:
        _check_files(path, table)
        nodes = table.get("nodes", [])
        _check_tree(nodes)
        count = len(nodes) + sum(_instances(table, node) for node in nodes) + _shapes(table)
        bones = max((len(skin["joints"]) for skin in table.get("skins", [])), default=0)
        animated = len(nodes) * len(table.get("animations", []))
        made, size = _made(table), path.stat().st_size
        values = sum(times * _mesh_values(table, table["meshes"][mesh]) for (mesh, _), times in made.items())
        values += sum(_values(table, accessor) for accessor in _used(table)) + _decompressed(table)
        parts = list(_parts(table, made, size))
    except DAMAGE as error:
        raise unreadable(path, error) from error
    if bones > MOST_BONES:
        raise InputError(f"{path} has {bones} bones, more than {MOST_BONES}; export the rig alone.")
    if count > MOST_NODES:
        raise InputError(f"{path} has {count} nodes and shapes, more than {MOST_NODES}; export the rig alone.")
    if animated > MOST_ANIMATED:
        raise InputError(
            f"{path} has {len(table['animations'])} animations of {len(nodes)} nodes; export the rig alone, or fewer animations."
        )
    if values > max(MOST_VALUES, VALUES_PER_BYTE * size):
        raise InputError(f"{path} asks for {values} numbers, far more than it contains; it is damaged, export it again.")
    for number, most, what in parts:
        if number > most:
            raise InputError(f"{path} has {number} {what}, more than {most}; export the rig alone.")


def sampled_fps(path: Path) -> float | None:
    """The rate at which an animation has keys [1/s]: that of its curve with most keys, from the times of its first and last key, if it is a
    rate of video. None: the keys are elsewhere. glTF has no rate of its own.

    Raises:
        InputError: the file cannot be read.
    """
    table = read_table(path)
    try:
        accessors = table.get("accessors", [])
        times = [accessors[sampler["input"]] for animation in table.get("animations", []) for sampler in animation["samplers"]]
        longest = max(times, key=lambda accessor: int(accessor["count"]), default=None)
        if longest is None or longest["count"] < 2 or not (seconds := float(longest["max"][0]) - float(longest["min"][0])) > 0:
            return None
        rate = (int(longest["count"]) - 1) / seconds
    except DAMAGE as error:
        raise unreadable(path, error) from error
    video = min((round(rate), round(rate * 1.001) / 1.001), key=lambda fps: abs(fps - rate))
    return video if 1 <= video <= MOST_FPS and abs(video - rate) < RATE_TOLERANCE * rate else None


def _check_tree(nodes: list[dict[str, Any]]) -> None:
    """Nodes must be trees (glTF 2.0, 5.25), not deeper than the importer can follow.

    Raises:
        ValueError: a node has several parents, is its own ancestor, or lies too deep.
    """
    children = [node.get("children", []) for node in nodes]
    named = [child for one in children for child in one]
    if any(not 0 <= child < len(nodes) for child in named):
        raise ValueError("a node that is none")
    if len(set(named)) < len(named):
        raise ValueError("a node has two parents")
    level, seen = list(set(range(len(nodes))) - set(named)), 0
    for _ in range(DEEPEST):
        seen += len(level)
        level = [child for node in level for child in children[node]]
    if seen < len(nodes):
        raise ValueError(f"a node is in itself, or in more than {DEEPEST} others")


def _check_files(path: Path, table: dict[str, Any]) -> None:
    """Buffers and images in files of their own must be files in the folder of this one."""
    for part in (*table.get("buffers", []), *table.get("images", [])):
        uri = part.get("uri")
        if uri is None or uri.startswith("data:"):
            continue
        name = Path(_unquoted(uri))
        if name.is_absolute() or ".." in name.parts or ":" in uri:
            raise InputError(f"{path} reads “{uri}”, which lies outside its folder; export it again as .glb.")
        if (path.parent / name).exists():  # what is missing, Blender tells
            bounded.check_file(path.parent / name, bounded.ARRAYS_BYTES)


def _unquoted(uri: str) -> str:
    """A reference with its %XX as characters (RFC 3986, 2.1)."""
    return re.sub(rb"%([0-9A-Fa-f]{2})", lambda m: bytes([int(m[1], 16)]), uri.encode()).decode(errors="replace")


def _made(table: dict[str, Any]) -> Counter[tuple[int, int | None]]:
    """How often the importer makes each mesh with each skin: once, but where it has shapes, for every node, whose weights may differ."""
    made = Counter[tuple[int, int | None]]()
    meshes = table.get("meshes", [])
    shaped = [any(primitive.get("targets") for primitive in mesh["primitives"]) for mesh in meshes]
    for node in table.get("nodes", []):
        if "mesh" in node and 0 <= node["mesh"] < len(meshes):
            key = node["mesh"], node.get("skin")
            made[key] = made[key] + 1 if shaped[key[0]] else 1
    for mesh in set(range(len(meshes))) - {mesh for mesh, _ in made}:
        made[mesh, None] = 1
    return made


def _mesh_values(table: dict[str, Any], mesh: dict[str, Any]) -> int:
    """The numbers of a mesh, made once: the attributes and shapes of any primitive become those of all of its vertices or corners."""
    of_vertex, of_corner = dict[str, int](), dict[str, int]()
    vertices, corners, indices, shapes = 0, 0, 0, 0
    for primitive in mesh["primitives"]:
        attributes, targets = primitive["attributes"], primitive.get("targets", [])
        read = {*attributes.values(), *(number for target in targets for number in target.values())}
        longest = max((_rows(table, number) for number in read), default=0)
        own = _rows(table, primitive["indices"]) if "indices" in primitive else 0
        vertices, corners, indices, shapes = vertices + longest, corners + (own or longest), indices + own, max(shapes, len(targets))
        for name, number in attributes.items():
            widths = of_corner if name.startswith(("TEXCOORD", "COLOR")) else of_vertex
            widths[name] = max(widths.get(name, 0), VALUES[table["accessors"][number]["type"]])
    return vertices * (sum(of_vertex.values()) + 3 * shapes) + corners * sum(of_corner.values()) + indices


def _parts(table: dict[str, Any], made: Counter[tuple[int, int | None]], size: int) -> Iterator[tuple[int, int, str]]:
    """What else the importer makes or passes over: how many there are, how many there may be in a file of `size` bytes, and their name."""
    meshes, skins, scenes = table.get("meshes", []), table.get("skins", []), table.get("scenes", [])
    yield len(scenes), MOST_SCENES, "scenes"
    inside = _inside(table.get("nodes", []))
    yield sum(inside[node] for scene in scenes for node in scene.get("nodes", [])), MOST_LISTED, "nodes in its scenes"
    primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
    yield len({pair for one in primitives for pair in _materials(one)}), MOST_MATERIALS, "materials"
    yield len(table.get("images", [])), MOST_IMAGES, "images"
    pieces = [max(1, sum(1 + _variants(primitive) for primitive in mesh["primitives"])) for mesh in meshes]
    yield sum(times * pieces[mesh] for (mesh, _), times in made.items()), MOST_PRIMITIVES, "primitives in its meshes"
    joined = sum(times * pieces[mesh] * _mesh_values(table, meshes[mesh]) for (mesh, _), times in made.items())
    yield joined, max(MOST_JOINED, JOINED_PER_BYTE * size), "numbers to be copied while its meshes are joined"
    joints = [len(skin["joints"]) for skin in skins]
    named = sum(times * joints[skin] for (_, skin), times in made.items() if skin is not None)
    yield sum(joints) + named, MOST_JOINTS, "joints in its skins and the meshes with them"
    channels = sum(len(animation["channels"]) for animation in table.get("animations", []))
    yield channels, max(MOST_CHANNELS, size // BYTES_PER_CHANNEL), "channels in its animations"


def _inside(nodes: list[dict[str, Any]]) -> list[int]:
    """How many nodes each of them has in it, itself included; they are trees."""
    children = [node.get("children", []) for node in nodes]
    inside = [1] * len(nodes)
    order = list({*range(len(nodes))} - {child for one in children for child in one})
    for node in order:
        order += children[node]
    for node in reversed(order):
        inside[node] += sum(inside[child] for child in children[node])
    return inside


def _materials(primitive: dict[str, Any]) -> set[tuple[int | None, bool]]:
    """The materials of a primitive, each with whether it is made for colours of vertices."""
    mappings = primitive.get("extensions", {}).get("KHR_materials_variants", {}).get("mappings", [])
    return {(part.get("material"), "COLOR_0" in primitive["attributes"]) for part in (primitive, *mappings)}


def _variants(primitive: dict[str, Any]) -> int:
    """How many variants of materials a primitive has."""
    mappings = primitive.get("extensions", {}).get("KHR_materials_variants", {}).get("mappings", [])
    return sum(1 + len(part.get("variants", [])) for part in mappings)


def _used(table: dict[str, Any]) -> list[int]:
    """The accessors that the importer reads beside those of meshes, as often as it reads them."""
    used = []
    for animation in table.get("animations", []):
        used += [animation["samplers"][channel["sampler"]][end] for channel in animation["channels"] for end in ("input", "output")]
    return used + [skin["inverseBindMatrices"] for skin in table.get("skins", []) if "inverseBindMatrices" in skin]


def _values(table: dict[str, Any], number: int) -> int:
    return _rows(table, number) * VALUES[table["accessors"][number]["type"]]


def _rows(table: dict[str, Any], number: int) -> int:
    return _count(table["accessors"][number]["count"])


def _count(value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError("a count that is none")
    return value


def _shapes(table: dict[str, Any]) -> int:
    """How many shape keys the meshes would get."""
    return sum(len(primitive.get("targets", [])) for mesh in table.get("meshes", []) for primitive in mesh["primitives"])


def _instances(table: dict[str, Any], node: dict[str, Any]) -> int:
    """How often a node is repeated (EXT_mesh_gpu_instancing)."""
    attributes = node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes", {})
    return max((_count(table["accessors"][number]["count"]) for number in attributes.values()), default=0)


def _decompressed(table: dict[str, Any]) -> int:
    """Numbers of four bytes in compressed views of buffers."""
    packed = [view.get("extensions", {}).get(name) for view in table.get("bufferViews", []) for name in COMPRESSED]
    return math.ceil(sum(_count(part["count"]) * _count(part["byteStride"]) for part in packed if part) / 4)
