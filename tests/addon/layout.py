"""A layout without a window: what a panel draws, with every property and operator looked up in the real Blender."""

from types import SimpleNamespace
from typing import Any


class Layout:
    """Records texts, operators, which of them are highlighted, and properties; sub-layouts record into the same lists. Every section is
    unfolded."""

    def __init__(self, root: "Layout | None" = None) -> None:
        self.__dict__["texts"] = root.texts if root else []
        self.__dict__["operators"] = root.operators if root else []
        self.__dict__["highlighted"] = root.highlighted if root else []
        self.__dict__["properties"] = root.properties if root else []

    def __setattr__(self, name: str, value: Any) -> None:
        import bpy

        assert name in bpy.types.UILayout.bl_rna.properties, f"a layout has no {name}"

    def draw(self, panel: Any, context: Any) -> "Layout":
        """Draw a panel class."""
        own = SimpleNamespace(layout=self)
        own.draw_step = lambda *arguments: panel.draw_step(own, *arguments)
        panel.draw(own, context)
        return self

    def _inside(self, *_: Any, **__: Any) -> "Layout":
        return Layout(self)

    row = column = box = split = grid_flow = column_flow = _inside

    def label(self, *, text: str = "", icon: str = "NONE") -> None:
        import bpy

        assert icon in bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items, icon
        self.texts.append(text)

    def prop(self, data: Any, name: str, **words: Any) -> None:
        assert name in data.bl_rna.properties, f"{data} has no {name}"
        self.properties.append(name)

    def prop_search(self, data: Any, name: str, search: Any, search_name: str, **words: Any) -> None:
        self.prop(data, name)
        self.prop(search, search_name)

    def operator(self, name: str, **words: Any) -> Any:
        import bpy

        space, _, verb = name.partition(".")
        getattr(getattr(bpy.ops, space), verb).get_rna_type()
        self.operators.append(name)
        if words.get("depress"):
            self.highlighted.append(name)
        return SimpleNamespace()

    def operator_menu_enum(self, name: str, prop: str, **words: Any) -> Any:
        return self.operator(name)

    def template_list(self, kind: str, _: str, data: Any, name: str, active: Any, active_name: str, **words: Any) -> None:
        import bpy

        assert hasattr(bpy.types, kind)
        self.prop(data, name)
        self.prop(active, active_name)

    def progress(self, *, factor: float, text: str, type: str) -> None:
        self.texts.append(text)

    def panel(self, name: str, default_closed: bool = False) -> "tuple[Layout, Layout]":
        return Layout(self), Layout(self)

    def panel_prop(self, data: Any, name: str) -> "tuple[Layout, Layout]":
        self.prop(data, name)
        return Layout(self), Layout(self)
