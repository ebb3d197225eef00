"""Properties made from settings dataclasses, and back."""

import importlib
from dataclasses import dataclass
from types import ModuleType

import pytest

from tricap.core.foundation.settings import knob


@dataclass(frozen=True, kw_only=True, slots=True)
class Kinds:
    """One knob of every kind."""

    patch_px: int = knob(13, "Width of a patch.", unit="px", low=5, high=101)
    tolerance: float = knob(0.05, "A number that single precision cannot hold.", low=0.0, high=1.0)
    robust: bool = knob(True, "Down-weight outliers.")
    method: str = knob("fast", "How.", choices=("fast", "exact"))
    label: str = knob("x", "Any text.")


@pytest.fixture
def group(blender: ModuleType) -> object:
    """(the add-on's properties module, a registered group of `Kinds` on the scene)"""
    properties = importlib.import_module("bl_ext.user_default.tricap.addon.properties")
    cls = properties.group_class("kinds", Kinds)
    blender.utils.register_class(cls)
    blender.types.Scene.tricap_kinds = blender.props.PointerProperty(type=cls)
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    yield properties, blender.context.scene.tricap_kinds
    del blender.types.Scene.tricap_kinds
    blender.utils.unregister_class(cls)


def test_untouched_groups_are_the_defaults_and_override_nothing(group: tuple) -> None:
    properties, kinds = group
    assert properties.touched(kinds, Kinds) == {}
    assert properties.snapshot(kinds, Kinds) == Kinds()


def test_what_was_typed_is_what_core_gets(group: tuple) -> None:
    properties, kinds = group
    kinds.patch_px, kinds.tolerance, kinds.robust, kinds.method, kinds.label = 17, 0.1, False, "exact", "y"
    expected = dict(patch_px=17, tolerance=0.1, robust=False, method="exact", label="y")
    assert properties.touched(kinds, Kinds) == expected  # 0.1 exactly, though Blender keeps 0.100000001490116
    assert properties.snapshot(kinds, Kinds) == Kinds(**expected)


def test_limits_units_and_words(group: tuple) -> None:
    _, kinds = group
    kinds.patch_px = 1000
    assert kinds.patch_px == 101
    definition = kinds.bl_rna.properties["patch_px"]
    assert (definition.name, definition.description) == ("Patch [px]", "Width of a patch")
    assert [item.identifier for item in kinds.bl_rna.properties["method"].enum_items] == ["fast", "exact"]


def test_a_knob_without_a_property_is_a_bug(group: tuple) -> None:
    properties, _ = group

    @dataclass(frozen=True)
    class Odd:
        """A knob of an odd kind."""

        pair: tuple = knob((1, 2), "A pair.")

    with pytest.raises(TypeError, match="pair is a tuple"):
        properties.group_class("odd", Odd)


def test_every_stage_has_its_knobs_on_the_scene(blender: ModuleType) -> None:
    properties = importlib.import_module("bl_ext.user_default.tricap.addon.properties")
    for name, settings in properties.stages().items():
        assert properties.snapshot(getattr(blender.context.scene.tricap, name), settings) == settings()
    assert properties.overrides(blender.context.scene) == {}


def test_a_knob_under_its_earlier_name_is_shown(blender: ModuleType) -> None:
    """A take.toml of an earlier version sets tracking.markers; the panel has it as key_points.markers, and unsets it with the next take."""
    scene, properties = blender.context.scene, importlib.import_module("bl_ext.user_default.tricap.addon.properties")
    properties.show_settings(scene, {"tracking": {"markers": True, "box_px": 9}})
    assert properties.overrides(scene) == {"tracking": {"box_px": 9}, "key_points": {"markers": True}}
    properties.show_settings(scene, {})
    assert properties.overrides(scene) == {}
