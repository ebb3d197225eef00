"""What Blender's importers would make of a small FBX or glTF file is counted before they read it."""

import os
import struct
import time
from pathlib import Path
from typing import Any

import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.motion.formats import gltf
from tricap.core.motion.formats.fbx import MOST_OBJECTS, check_fbx
from tricap.core.motion.formats.gltf import MOST_BONES, MOST_NODES, check_gltf

from ...mutations import memory_mb
from ...scene_files import model, number, record, text, write_fbx, write_gltf, zeros


def geometry(*arrays: bytes) -> list[Any]:
    return record(b"Geometry", [number(1), text(b"g\0\1Geometry"), text(b"Mesh")], [record(b"Vertices", [a]) for a in arrays])


@pytest.mark.parametrize("version", [7400, 7500])
def test_a_sound_fbx_file_is_let_through(tmp_path: Path, version: int) -> None:
    check_fbx(write_fbx(tmp_path / "a.fbx", [model(1), geometry(zeros(300))], version))
    (tmp_path / "text.fbx").write_text("; FBX 7.4.0 project file\n")
    check_fbx(tmp_path / "text.fbx")  # Blender says that it reads binary files only


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        ([record(b"Model", [number(1)], claimed=400_000_000)], "does not fit into the file"),
        ([geometry(zeros(112_500_000))], "would unpack to more than 0.9 GB"),
        ([geometry(*[zeros(2_000_000)] * 7)], "would unpack to more than 0.1 GB"),
        ([geometry(zeros(12_000_000, claimed=3))], "an array whose length is not as it claims"),
        ([geometry(zeros(3, claimed=4_000_000_000))], "would unpack to more than 32.0 GB"),
        ([model(i) for i in range(MOST_OBJECTS + 1)], "more than 5000 objects; export the rig alone"),
        ([record(b"Material", [number(i)]) for i in range(1001)], "more than 1000 objects of the kind “Material”; export the rig alone"),
        ([record(b"Geometry", [number(i)]) for i in range(1001)], "more than 1000 objects of the kind “Geometry”"),
        ([model(1), record(b"Model", [b"?"])], "a value of an unknown kind"),
        ([record(b"Model", [b"S" + struct.pack("<I", 2**32 - 1)])], "a value that does not fit"),
    ],
)
def test_an_fbx_file_that_asks_for_more_than_it_contains(tmp_path: Path, objects: list[Any], said: str) -> None:
    path = write_fbx(tmp_path / "a.fbx", objects)
    assert path.stat().st_size < 1_000_000
    before, began = memory_mb()[1], time.process_time()
    with pytest.raises(InputError, match=said):
        check_fbx(path)
    assert time.process_time() - began < 2.0 and memory_mb()[1] - before < 200


@pytest.mark.parametrize(
    ("children", "said"),
    [({0: [1, 1]}, "two parents"), ({0: [2], 1: [2]}, "two parents"), ({0: [1], 1: [0]}, "in itself"), ({1: [1]}, "in itself"),
     ({i: [i + 1] for i in range(300)}, "in more than 200 others"), ({0: ["a"]}, "can be read"), ({0: [-1]}, "can be read")],
)  # fmt: skip
def test_nodes_that_are_no_trees(tmp_path: Path, children: dict[int, list[Any]], said: str) -> None:
    count = max(*children, 1) + 2
    nodes = [{"name": f"n{i}", "children": children.get(i, [])} for i in range(count)]
    with pytest.raises(InputError, match=said):
        check_gltf(write_gltf(tmp_path / "a.glb", nodes=nodes))
    nodes = [{"name": f"n{i}", "children": [i + 1] if i < 150 else []} for i in range(151)]
    check_gltf(write_gltf(tmp_path / "b.glb", nodes=nodes))


def test_objects_that_are_connected_in_millions_of_ways(tmp_path: Path) -> None:
    """Curves in every layer, layers in every stack: the importer makes an action for each way. A character has one way for each bone."""
    levels = [range(40 * i + 1, 40 * i + 41) for i in range(5)]
    every = [(child, parent) for below, above in zip(levels, levels[1:]) for child in below for parent in above]
    objects = [model(i) for level in levels for i in level]
    assert write_fbx(tmp_path / "a.fbx", objects, joined=every).stat().st_size < 1_000_000
    with pytest.raises(InputError, match="connects its objects in more than 1000000 ways"):
        check_fbx(tmp_path / "a.fbx")
    stacks, layers, curves, bones = levels[:4]
    layered = [record(b"AnimationLayer", [number(i), text(b"l\0\1AnimLayer"), text(b"")]) for i in layers]
    pairs = [(i, j) for lower, upper in ((layers, stacks), (curves, layers), (curves, bones)) for i in lower for j in upper]
    write_fbx(tmp_path / "c.fbx", [*layered, *(model(i) for i in (*stacks, *curves, *bones))], joined=pairs)
    with pytest.raises(InputError, match="connects its objects in more than 1000000 ways"):
        check_fbx(tmp_path / "c.fbx")
    chain = [(i, i - 1) for i in range(1, 4000)] + [(5000, i) for i in range(1, 4000)]
    check_fbx(write_fbx(tmp_path / "b.fbx", [model(i) for i in range(1, 4000)], joined=chain))


def test_records_in_each_other(tmp_path: Path) -> None:
    deep = model(1)
    for _ in range(100):
        deep = record(b"A", [], [deep])
    with pytest.raises(InputError, match="does not fit into the file"):
        check_fbx(write_fbx(tmp_path / "a.fbx", [deep]))
    path = write_fbx(tmp_path / "b.fbx", [model(1)])
    whole = path.read_bytes()
    for cut in range(30, len(whole) - 215, 7):
        path.write_bytes(whole[:cut])
        with pytest.raises(InputError, match="is not an FBX file that can be read"):
            check_fbx(path)


FLOATS = {"componentType": 5126, "type": "VEC3"}
REUSED = [{"primitives": [{"attributes": {"POSITION": 0}}] * 4000}]
GPU = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}}
MESHOPT = {"EXT_meshopt_compression": {"buffer": 0, "byteLength": 36, "byteStride": 12, "count": 10**8}}


TRIANGLE: dict[str, Any] = {"attributes": {"POSITION": 0}}
EACH_MATERIAL = [{"primitives": [{**TRIANGLE, "material": i // 2}]} for i in range(2 * gltf.MOST_MATERIALS + 2)]
COLOURED = [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 0}, "material": i}, {**TRIANGLE, "material": i}]} for i in range(501)]
VARIANTS = {"KHR_materials_variants": {"mappings": [{"material": i, "variants": [0] * 9} for i in range(100)]}}
WIDE = {"attributes": {"POSITION": 0} | {f"TEXCOORD_{i}": 0 for i in range(8)} | {f"_{i}": 0 for i in range(100)}}
SHAPED: dict[str, Any] = {"attributes": {"POSITION": 0}, "targets": [{"POSITION": 0}] * 20}
LARGE: dict[str, Any] = {"attributes": {"POSITION": 1}}
TWO_SIZES = [{**FLOATS, "count": 3}, {**FLOATS, "count": 300_000}]


def skinned(count: int, joints: int, **more: Any) -> dict[str, Any]:
    """A mesh in nodes with skins of their own, as it is made for each."""
    nodes = [{"mesh": 0, "skin": i} for i in range(count)]
    return {"nodes": nodes, "skins": [{"joints": [0] * joints}] * count, **more}


WORK: dict[str, tuple[dict[str, Any], str]] = {
    "scenes": ({"scenes": [{"nodes": [0]}] * (gltf.MOST_SCENES + 1)}, "101 scenes, more than 100; export the rig alone"),
    "a scene's nodes": ({"scenes": [{"nodes": [0] * (gltf.MOST_LISTED + 1)}]}, "100001 nodes in its scenes, more"),
    "nodes in scenes": (
        {
            "scenes": [{"nodes": [0]}] * 51,
            "nodes": [{"children": [i + 1]} for i in range(190)] + [{"children": [*range(191, 2000)]}, *[{}] * 1809],
        },
        "102000 nodes in its scenes",
    ),
    "materials": (
        {"meshes": [{"primitives": [part for mesh in EACH_MATERIAL for part in mesh["primitives"]][::2]}]},
        "1001 materials, more",
    ),
    "materials with colours": ({"meshes": COLOURED}, "1002 materials, more"),
    "primitives": ({"meshes": [{"primitives": [TRIANGLE] * (gltf.MOST_PRIMITIVES + 1)}]}, "1001 primitives in its meshes, more"),
    "meshes": ({"meshes": [{"primitives": []}] * (gltf.MOST_PRIMITIVES + 1)}, "1001 primitives in its meshes"),
    "a mesh with every skin": (skinned(1001, 1), "1001 primitives in its meshes"),
    "shapes with every weight": ({"meshes": [{"primitives": [SHAPED]}], "nodes": [{"mesh": 0}] * 1001}, "1001 primitives in its meshes"),
    "variants": ({"meshes": [{"primitives": [{**TRIANGLE, "extensions": VARIANTS}]}]}, "1001 primitives in its meshes"),
    "joined": (
        {"meshes": [{"primitives": [TRIANGLE] * 900}], "accessors": [{**FLOATS, "count": 3000}]},
        "7290000000 numbers to be copied while its meshes are joined, more than 2000000000",
    ),
    "numbers with every skin": (skinned(12, 1, accessors=[{**FLOATS, "count": 300_000}]), "asks for 10800000 numbers"),
    "attributes for all": ({"meshes": [{"primitives": [WIDE, LARGE]}], "accessors": TWO_SIZES}, "asks for 98100981 numbers"),
    "shapes for all": ({"meshes": [{"primitives": [SHAPED, LARGE]}], "accessors": TWO_SIZES}, "asks for 18900189 numbers"),
    "joints": (skinned(1, 3, skins=[{"joints": [0] * 3000}] * 17), "54000 joints in its skins"),
    "joints in meshes": (skinned(30, 1000), "60000 joints in its skins and the meshes with them"),
    "images": ({"images": [{"bufferView": 0}] * (gltf.MOST_IMAGES + 1)}, "201 images, more than 200"),
    "channels": (
        {"animations": [{"channels": [{"sampler": 0}] * (gltf.MOST_CHANNELS // 2 + 1), "samplers": [{"input": 0, "output": 0}]}] * 2},
        "3002 channels in its animations, more than 3000",
    ),
}


@pytest.mark.parametrize("case", WORK)
def test_a_gltf_file_that_makes_blender_work_for_minutes(tmp_path: Path, case: str) -> None:
    parts, said = WORK[case]
    path = write_gltf(tmp_path / "a.glb", **parts)
    assert path.stat().st_size < 1_000_000
    before, began = memory_mb()[1], time.process_time()
    with pytest.raises(InputError, match=said):
        check_gltf(path)
    assert time.process_time() - began < 1.0 and memory_mb()[1] - before < 100


def test_a_rich_character_is_let_through(tmp_path: Path) -> None:
    """A hundred meshes of three primitives on a skeleton of 300 bones, with colours, shapes and twenty animations."""
    count, bones = 100, 300
    parts = [{"attributes": {"POSITION": 0, "COLOR_0": 0}, "material": i, "targets": [{"POSITION": 0}] * 50} for i in range(3)]
    nodes = [{"children": list(range(1, bones))}, *[{}] * (bones - 1), *[{"mesh": i, "skin": 0} for i in range(count)]]
    channels = [{"sampler": 0, "target": {"node": i, "path": "rotation"}} for i in range(bones)]
    path = write_gltf(
        tmp_path / "a.gltf", nodes=nodes, skins=[{"joints": list(range(bones))}], materials=[{}] * 3,
        scenes=[{"nodes": [0, *range(bones, bones + count)]}] * 10,
        meshes=[{"primitives": parts}, *[{"primitives": [TRIANGLE] * 3}] * (count - 1)],
        animations=[{"channels": channels, "samplers": [{"input": 0, "output": 0}]}] * 10,
    )  # fmt: skip
    check_gltf(path)


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"accessors": [{**FLOATS, "count": 20_000_000}]}, "asks for 60000000 numbers, far more than it contains"),
        ({"accessors": [{**FLOATS, "count": 1000}], "meshes": REUSED}, "asks for 12000000 numbers"),
        ({"nodes": [{"name": "a"}] * (MOST_NODES + 1)}, "10001 nodes and shapes, more than 10000"),
        ({"nodes": [{"name": "a"}], "skins": [{"joints": [0] * (MOST_BONES + 1)}]}, "3001 bones, more than 3000"),
        ({"nodes": [GPU], "accessors": [{**FLOATS, "count": 10**6}]}, "1000001 nodes"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 36, "extensions": MESHOPT}]}, "asks for 300000009 numbers"),
        ({"buffers": [{"byteLength": 36, "uri": "/dev/zero"}]}, "“/dev/zero”, which lies outside its folder"),
        ({"images": [{"uri": "../a.png"}]}, "outside its folder"),
        ({"images": [{"uri": "%2E%2E/a.png"}]}, "outside its folder"),
        ({"buffers": [{"byteLength": 36, "uri": "file:///etc/hostname"}]}, "outside its folder"),
        ({"buffers": [{"byteLength": 36, "uri": "pipe"}]}, "is not a VRM or glTF file that can be read"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "targets": [{}] * 20_000}]}]}, "20001 nodes and shapes"),
        (
            {"nodes": [{"name": "a"}] * 1000, "animations": [{"channels": [], "samplers": []}] * 1001},
            "1001 animations of 1000 nodes",
        ),
        ({"nodes": 7}, "is not a VRM or glTF file that can be read"),
        ({"accessors": [{**FLOATS, "count": -1}]}, "a count that is none"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 9}}]}]}, "is not a VRM or glTF"),
    ],
)
def test_a_gltf_file_that_asks_for_more_than_it_contains(tmp_path: Path, ending: str, parts: dict[str, Any], said: str) -> None:
    (tmp_path / "pipe").mkdir()
    with pytest.raises(InputError, match=said):
        check_gltf(write_gltf(tmp_path / f"a{ending}", **parts))


def test_a_sound_gltf_file_is_let_through(tmp_path: Path) -> None:
    (tmp_path / "a é.bin").write_bytes(b"\0" * 36)
    for uri in ("a%20%C3%A9.bin", "data:application/octet-stream;base64,AAAA", "missing.bin"):
        check_gltf(write_gltf(tmp_path / "a.gltf", buffers=[{"byteLength": 36, "uri": uri}]))
    check_gltf(write_gltf(tmp_path / "a.glb"))


@pytest.mark.skipif(os.name == "nt", reason="pipes are elsewhere on Windows")
@pytest.mark.parametrize("kind", ["Texture", "Video"])
@pytest.mark.parametrize("name", ["{folder}/pipe", "pipe", "sub\\\\..\\\\pipe", "/dev/zero", "gone/pipe"])
def test_pictures_of_an_fbx_file_are_files(tmp_path: Path, kind: str, name: str) -> None:
    """Blender's importer waits for ever for a pipe."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "sub").mkdir()
    named = [text(name.format(folder=tmp_path).encode())]
    inner = [record(b"RelativeFilename", named), record(b"FileName" if kind == "Texture" else b"Filename", named)]
    objects = [model(1), record(kind.encode(), [number(5), text(b"t")], inner)]
    with pytest.raises(InputError, match="it is a device, a pipe or a socket"):
        check_fbx(write_fbx(tmp_path / "a.fbx", objects))
    if name == "pipe":
        (tmp_path / "pipe").unlink()
        check_fbx(write_fbx(tmp_path / "a.fbx", objects))  # what is missing, Blender tells
