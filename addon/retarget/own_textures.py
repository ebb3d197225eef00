"""Pictures of an exported USD file under names that no other file has.

Blender stores them in a folder `textures` next to the file, under the names that they have already. Two exports into one folder, such as
two persons whose pictures are both called texture.png, or two pictures of one scene with the same name, would share one.
"""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy


@contextmanager
def own_textures(scene: bpy.types.Scene, name: str) -> Iterator[None]:
    """While it lasts, the materials of a scene use copies of their pictures with the names `name`_1.png, `name`_2.jpg and so on.

    Movies, sequences and tiles keep their names.
    """
    copies = dict[bpy.types.Image, bpy.types.Image]()
    with tempfile.TemporaryDirectory() as folder:
        for image in _images(scene):
            path = _copied(image, Path(folder) / f"{name}_{len(copies) + 1}")
            if path is not None:
                copies[image] = bpy.data.images.load(str(path))
        for image, copy in copies.items():
            copy.colorspace_settings.name, copy.alpha_mode = image.colorspace_settings.name, image.alpha_mode
            image.user_remap(copy)
        try:
            yield
        finally:
            for image, copy in copies.items():
                copy.user_remap(image)
                bpy.data.images.remove(copy)


def _copied(image: bpy.types.Image, bare: Path) -> Path | None:
    """The file of the copy, with an ending; None where there is no picture."""
    source = Path(bpy.path.abspath(image.filepath_from_user(), library=image.library))
    path = bare.with_name(bare.name + (source.suffix or f".{image.file_format.lower()}"))
    if image.source == "GENERATED" or (image.source == "FILE" and image.is_dirty):
        path = bare.with_name(f"{bare.name}.png")
        image.save(filepath=str(path), save_copy=True)
    elif image.source == "FILE" and image.packed_file is not None:
        path.write_bytes(image.packed_file.data)
    elif image.source == "FILE" and source.is_file():
        shutil.copyfile(source, path)
    else:
        return None
    return path


def _images(scene: bpy.types.Scene) -> list[bpy.types.Image]:
    """The pictures in the materials of a scene's objects, each once."""
    materials = dict.fromkeys(slot.material for thing in scene.objects for slot in thing.material_slots if slot.material is not None)
    trees, images = [m.node_tree for m in materials if m.node_tree is not None], dict[bpy.types.Image, None]()
    for tree in trees:  # grows by the groups within
        for node in tree.nodes:
            inner = getattr(node, "node_tree", None)
            if inner is not None and inner not in trees:
                trees.append(inner)
            if getattr(node, "image", None) is not None:
                images[node.image] = None
    return list(images)
