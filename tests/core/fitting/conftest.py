"""Scenes of a synthetic limb, as fixtures."""

import pytest

from . import limb_scene


@pytest.fixture
def make_scene():
    """A function that makes a scene."""
    return limb_scene.make_scene


@pytest.fixture
def other_person():
    """A function that changes a model's shape."""
    return limb_scene.other_person
