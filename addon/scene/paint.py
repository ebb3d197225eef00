"""Materials: plain colours, and greys or heat colours from a named attribute."""

import bpy


def plain_material(name: str, colour: tuple[float, float, float], roughness: float = 0.6) -> bpy.types.Material:
    """One colour, also in the solid viewport."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*colour, 1.0)
    shader = _shader(material)
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    return material


def attribute_material(name: str, attribute: str, scale: float) -> bpy.types.Material:
    """Grey from the attribute times `scale`, so that the largest value is white."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (0.2, 0.7, 1.0, 1.0)
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


def _shader(material: bpy.types.Material) -> bpy.types.Node:
    if bpy.app.version < (5, 0, 0):  # later versions always use nodes, and warn when told to
        material.use_nodes = True
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
