"""The settings of a run, by the names of their tables. Importing this loads the modules that define them, but no stage."""

from collections.abc import Mapping
from typing import Any

from ..body.skin.mesh import SkinSettings
from ..fitting.settings import FitSettings
from ..foundation.settings import current_tables, from_table
from ..images.enhance import EnhanceSettings
from ..images.retime import TimingSettings
from ..matching.least_squares import MatchingSettings
from ..matching.region_growing import GrowingSettings
from ..surface.cloud import SurfaceSettings
from ..tracking.contour import ContourSettings
from ..tracking.settings import KeyPointSettings, TrackingSettings
from .presets import PRESETS, MethodSettings

SETTINGS: dict[str, type] = {
    "method": MethodSettings,
    "timing": TimingSettings,
    "enhance": EnhanceSettings,
    "matching": MatchingSettings,
    "growing": GrowingSettings,
    "surface": SurfaceSettings,
    "tracking": TrackingSettings,
    "key_points": KeyPointSettings,
    "contour": ContourSettings,
    "fitting": FitSettings,
    "skin": SkinSettings,
}
Overrides = Mapping[str, Mapping[str, Any]]


def settings_of(take_settings: Overrides, overrides: Overrides, where: str) -> dict[str, Any]:
    """All settings of a run: the defaults, then those of the preset, then take.toml's, then the command's or the panel's.

    Raises:
        InputError: an unknown table or name, or a value that cannot be.
    """
    given: dict[str, dict[str, Any]] = {name: {} for name in SETTINGS}
    for source, place in ((take_settings, f" in {where}"), (overrides, "")):
        for name, table in current_tables(source, SETTINGS, place).items():
            given[name].update(table)
    method: MethodSettings = from_table(MethodSettings, given["method"], "[method]")
    preset = PRESETS[method.preset]
    return {name: from_table(cls, {**preset.get(name, {}), **given[name]}, f"[{name}]") for name, cls in SETTINGS.items()}
