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


def heat_material(name: str, attribute: str, largest: float) -> bpy.types.Material:
    """From blue (0) over green to red (`largest`) by the attribute."""
    material = bpy.data.materials.new(name)
    material.diffuse_color = (0.2, 0.7, 1.0, 1.0)
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


def _shader(material: bpy.types.Material) -> bpy.types.Node:
    if bpy.app.version < (5, 0, 0):  # later versions always use nodes, and warn when told to
        material.use_nodes = True
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
