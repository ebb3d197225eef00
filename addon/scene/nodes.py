"""Node trees: geometry nodes with their sockets joined by name, and materials of one colour or of a named attribute's colours."""

from pathlib import Path
from typing import Any

import bpy

from ...core.foundation.errors import InputError


def new_group(name: str) -> tuple[bpy.types.NodeTree, bpy.types.Node, bpy.types.Node]:
    """A geometry-nodes group with one geometry in and one out: (group, input node, output node)."""
    group = bpy.data.node_groups.new(name, "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    return group, group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")


def length_input(group: bpy.types.NodeTree, name: str, value_m: float) -> None:
    """An input of the group that the modifier shows: a length."""
    socket = group.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
    socket.subtype, socket.min_value, socket.default_value = "DISTANCE", 0.0, value_m


def add(group: bpy.types.NodeTree, kind: str, **properties: Any) -> bpy.types.Node:
    """A node of class `kind` with its properties set."""
    node = group.nodes.new(kind)
    for name, value in properties.items():
        setattr(node, name, value)
    return node


def attribute(group: bpy.types.NodeTree, name: str, data_type: str) -> bpy.types.NodeSocket:
    """The output socket of a named attribute."""
    node = add(group, "GeometryNodeInputNamedAttribute", data_type=data_type)
    node.inputs["Name"].default_value = name
    return active(node.outputs, "Attribute")


def compare(group: bpy.types.NodeTree, operation: str, a: Any, b: Any) -> bpy.types.NodeSocket:
    """The Boolean socket of a ∘ b as floats; `a` and `b` are sockets or numbers."""
    node = add(group, "FunctionNodeCompare", data_type="FLOAT", operation=operation)
    feed(group, active(node.inputs, "A"), a)
    feed(group, active(node.inputs, "B"), b)
    if operation == "EQUAL":
        active(node.inputs, "Epsilon").default_value = 0.25
    return node.outputs["Result"]


def math(group: bpy.types.NodeTree, operation: str, a: Any, b: Any) -> bpy.types.NodeSocket:
    """The float socket of a ∘ b; `a` and `b` are sockets or numbers."""
    node = add(group, "ShaderNodeMath", operation=operation)
    feed(group, node.inputs[0], a)
    feed(group, node.inputs[1], b)
    return node.outputs["Value"]


def feed(group: bpy.types.NodeTree, socket: bpy.types.NodeSocket, value: Any) -> None:
    """Link another socket to this one, or set its value."""
    if isinstance(value, bpy.types.NodeSocket):
        group.links.new(value, socket)
    else:
        socket.default_value = value


def active(sockets: Any, name: str) -> bpy.types.NodeSocket:
    """The socket called `name` that is in use (Blender keeps one per data type, the others disabled)."""
    return next(socket for socket in sockets if socket.name == name and socket.enabled)


def arrange(group: bpy.types.NodeTree) -> None:
    """Place the nodes side by side, so that the group is readable in the editor."""
    for i, node in enumerate(group.nodes):
        node.location = (220.0 * (i % 6), -260.0 * (i // 6))


def plain_material(name: str, colour: tuple[float, float, float], roughness: float = 0.6) -> bpy.types.Material:
    """One colour, also in solid shading."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*colour, 1.0)
    shader = _shader(material)
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    return material


def image_material(name: str, file: Path, roughness: float = 0.7) -> bpy.types.Material:
    """The colours of an image file, which is packed, on the first texture coordinates; also in solid shading by textures.

    Raises:
        InputError: the file is no image.
    """
    image = bpy.data.images.load(str(file))
    if not image.size[0]:
        bpy.data.images.remove(image)
        raise InputError(f"{file} is no readable image; run the fit again, or remove it.")
    image.pack()
    image.name = f"{name} texture.png"
    material = plain_material(name, (0.8, 0.8, 0.8), roughness)
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image, node.location = image, (-320.0, 280.0)
    tree.links.new(node.outputs["Color"], _shader(material).inputs["Base Color"])
    tree.nodes.active = node
    return material


def images_of(material: bpy.types.Material) -> list[bpy.types.Image]:
    """The images in the nodes of a material."""
    tree = material.node_tree
    return [node.image for node in tree.nodes if node.type == "TEX_IMAGE" and node.image] if tree else []


# Of measured things in solid shading: legible on the grey of dark and of light themes, and over footage, most of which is of neither hue.
AZURE, ORANGE = (0.0, 0.3, 1.0), (1.0, 0.22, 0.0)


def attribute_material(name: str, attribute: str, scale: float, solid: tuple[float, float, float] = AZURE) -> bpy.types.Material:
    """Grey from the attribute times `scale`, so that the largest value is white; `solid`: the one colour of solid shading."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*solid, 1.0)
    shader = _shader(material)
    tree = material.node_tree
    value = tree.nodes.new("ShaderNodeAttribute")
    value.attribute_name = attribute
    scaled = tree.nodes.new("ShaderNodeMath")
    scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = scale
    tree.links.new(value.outputs["Fac"], scaled.inputs[0])
    tree.links.new(scaled.outputs["Value"], shader.inputs["Base Color"])
    return material


def heat_material(name: str, attribute: str, largest: float, solid: tuple[float, float, float] = ORANGE) -> bpy.types.Material:
    """From blue (0) over green to red (`largest`), by the attribute; `solid`: the one colour of solid shading."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*solid, 1.0)
    shader = _shader(material)
    tree = material.node_tree
    value, scaled, ramp = (tree.nodes.new(kind) for kind in ("ShaderNodeAttribute", "ShaderNodeMath", "ShaderNodeValToRGB"))
    value.attribute_name = attribute
    scaled.operation, scaled.inputs[1].default_value = "DIVIDE", largest
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (0.02, 0.08, 0.9, 1.0), (0.9, 0.03, 0.02, 1.0)
    ramp.color_ramp.elements.new(0.5).color = (0.05, 0.8, 0.1, 1.0)
    tree.links.new(value.outputs["Fac"], scaled.inputs[0])
    tree.links.new(scaled.outputs["Value"], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return material


def coloured_material(name: str, attribute: str) -> bpy.types.Material:
    """The colours (vectors of red, green and blue) of an attribute."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (0.9, 0.25, 0.2, 1.0)
    shader = _shader(material)
    value = material.node_tree.nodes.new("ShaderNodeAttribute")
    value.attribute_name = attribute
    material.node_tree.links.new(value.outputs["Color"], shader.inputs["Base Color"])
    return material


def tree_of(material: bpy.types.Material) -> bpy.types.NodeTree:
    """The nodes of a material."""
    if bpy.app.version < (5, 0, 0):  # later versions always use nodes, and warn about this
        material.use_nodes = True
    return material.node_tree


def _shader(material: bpy.types.Material) -> bpy.types.Node:
    return next(node for node in tree_of(material).nodes if node.type == "BSDF_PRINCIPLED")
