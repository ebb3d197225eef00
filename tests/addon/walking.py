"""Results of a whole body that walks, as fixtures (conftest.py)."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skin.closed_skin import OneSkin
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import REST, rest_skin, write_skin
from tricap.core.foundation import store

FLOOR_M = -0.3  # of the world frame of these cameras
STEP_M, FRAMES = 0.04, 12
COARSE = SkinSettings(contours=6, rays=12)


@pytest.fixture(name="skin", scope="module")
def walking_skin() -> OneSkin:
    """The skin of the default person, coarse."""
    return rest_skin(shape_for_skin(default_shape(read_model("full")), SkinSettings()), COARSE)


@pytest.fixture(name="person", scope="module")
def walking_person(skin: OneSkin) -> tuple[BodyShape, float]:
    """The default person, and how far its soles lie below the pelvis in the rest pose."""
    return default_shape(read_model("full")), -float(skin.vertices_m[:, 2].min())


def walk(shape: BodyShape, hip_m: float) -> np.ndarray:
    """A person who slides over the floor, standing still in the second half, one arm moving."""
    values = np.zeros((FRAMES, len(shape.skeleton.dof_names)))
    values[:, 0] = 0.5 + STEP_M * np.minimum(np.arange(FRAMES), FRAMES // 2)
    values[:, 1] = -0.1 * np.arange(FRAMES) / FRAMES
    values[:, 2] = FLOOR_M + hip_m
    values[:, shape.skeleton.layout["shoulder.R flexion"]] = np.linspace(0, 1, FRAMES)
    return values


@pytest.fixture(name="out")
def walking_out(person: tuple[BodyShape, float], skin: OneSkin, tmp_path: Path) -> Path:
    """Results of a run whose take is not there."""
    shape, hip_m = person
    values = walk(shape, hip_m)
    from .conftest import write_result

    write_result(tmp_path / "out", shape, np.arange(FRAMES), values, np.full(values.shape, 1e-3))
    write_skin(tmp_path / "out" / "skin" / REST, skin)
    store.write_json(tmp_path / "out" / "run.json", {"format": "tricap-run", "version": 1, "take": str(tmp_path / "none")})
    return tmp_path / "out"
