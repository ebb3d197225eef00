"""What run.json says before anything was computed: what is run, with which settings and inputs, and how to repeat it."""

from collections.abc import Mapping
from typing import Any

from . import store
from .settings import to_table
from .stages import command_of
from .take import Footage


def new_account(footage: Footage, settings: Mapping[str, Any]) -> dict[str, Any]:
    """An account without stages and warnings."""
    take = footage.take
    return {
        "take": str(take.folder),
        "frames": [footage.frames.start, footage.frames.stop],
        "fps": take.fps,
        "interlaced": take.interlaced,
        "views": [v.name for v in take.views],
        "reference_view": take.reference_view,
        "model": take.body_model,
        "settings": {name: to_table(value) for name, value in settings.items()},
        "inputs": {"take.toml": store.digest(take.folder / "take.toml"), take.rig_path.name: store.digest(take.rig_path)},
        "rig": {k: v for k, v in footage.rig.metadata.items() if isinstance(v, (str, int, float))},
        "repeat": command_of(footage, settings),
        "stages": {},
        "warnings": [],
    }
