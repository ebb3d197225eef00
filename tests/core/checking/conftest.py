"""Small recordings of the swinging arm, sound ones and others with a view that is late."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take


@pytest.fixture(scope="session")
def arm_recording(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Gives the folder of a recording with these settings, made once; copy it before you change it."""
    made: dict[str, Path] = {}

    def record(**settings: object) -> Path:
        key = repr(sorted(settings.items()))
        if key not in made:
            made[key] = tmp_path_factory.mktemp("arm") / "take"
            make_arm_take(made[key], ArmTakeSettings(**({"width_px": 320, "frames": 8, "interlaced": "none"} | settings)))  # type: ignore[arg-type]
        return made[key]

    return record
