"""The pictures of a USD file: each under a name of its own, whatever they are called in the scene."""

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

GREYS = {"file": 51, "packed": 102, "painted": 153, "generated": 204}


@pytest.fixture
def painted(empty: ModuleType, tmp_path: Path) -> dict[str, Any]:
    """Planes in the scene, and their pictures by kind: all are called same.png; “lost” has no file any more."""
    made = {}
    for kind in (*GREYS, "lost"):
        path = tmp_path / kind / "same.png"
        image = empty.data.images.new("same.png", 2, 2)
        image.pixels = _pixels(kind)
        if kind != "generated":
            image.filepath_raw, image.file_format = str(path), "PNG"
            image.save()
            empty.data.images.remove(image)
            image = empty.data.images.load(str(path))
        if kind == "packed":
            image.pack()
            path.unlink()
        if kind == "painted":
            image.pixels = _pixels(kind)
            path.write_bytes((tmp_path / "file" / "same.png").read_bytes())
        made[kind] = image
        _add_plane(empty, image)
    (tmp_path / "lost" / "same.png").unlink()
    return made


def _pixels(kind: str) -> list[float]:
    """Four opaque pixels of one grey."""
    return [*[GREYS.get(kind, 0) / 255] * 3, 1.0] * 4


def _add_plane(bpy: ModuleType, image: Any) -> None:
    bpy.ops.mesh.primitive_plane_add()
    material = bpy.data.materials.new("Painted")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    node = nodes.new("ShaderNodeTexImage")
    node.image = image
    material.node_tree.links.new(node.outputs[0], nodes["Principled BSDF"].inputs[0])
    bpy.context.object.data.materials.append(material)


def _used(bpy: ModuleType) -> list[str]:
    """The name of the picture of each plane."""
    planes = sorted((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: o.name)
    return [next(n.image.name for n in o.active_material.node_tree.nodes if n.type == "TEX_IMAGE") for o in planes]


def test_pictures_of_one_name_stay_apart_and_the_scene_is_as_before(empty: ModuleType, painted: dict[str, Any], tmp_path: Path) -> None:
    from tricap.addon.retarget.own_textures import own_textures

    before, names = _used(empty), set(empty.data.images.keys())
    with own_textures(empty.context.scene, "é #.usd"):
        empty.ops.wm.usd_export(filepath=str(tmp_path / "é #.usda"))
    assert _used(empty) == before and set(empty.data.images.keys()) == names
    empty.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    empty.ops.wm.usd_import(filepath=str(tmp_path / "é #.usda"))
    found = {image.name: round(255 * image.pixels[0]) for image in empty.data.images if image.has_data or image.size[0]}
    assert found == {f"é #.usd_{n}.png": grey for n, grey in enumerate(GREYS.values(), start=1)}
