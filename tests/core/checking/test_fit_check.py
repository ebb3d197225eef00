"""Limbs of odd proportions are told; people's are not."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.checking.run_check import odd_limbs


@pytest.mark.parametrize("model", ["arm.R", "full"])
def test_an_elbow_clicked_at_the_wrist_is_told_and_a_child_is_not(model: str) -> None:
    shape = default_shape(read_model(model))
    upper = [bone.name for bone in shape.skeleton.bones].index("upper_arm.R")
    other = np.random.default_rng(0).uniform(0.9, 1.1, len(shape.lengths_m))
    assert odd_limbs(replace(shape, lengths_m=0.6 * other * shape.lengths_m)) == []
    for times, long in ((1.6, "upper_arm.R"), (0.6, "forearm.R")):
        lengths = shape.lengths_m.copy()
        lengths[upper] *= times
        (said,) = odd_limbs(replace(shape, lengths_m=lengths))
        assert said.startswith(f"{long} is ") and "elbow.R" in said
        assert odd_limbs(replace(shape, lengths_m=lengths, model="a model of one's own")) == [said]
