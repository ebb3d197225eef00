"""`--preset published` from images to body: what the papers describe takes part, and nothing of our own."""

import importlib
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.run import pipeline
from tricap.core.run.presets import PUBLISHED
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.truth import read_truth
from tricap.core.tracking import published_step

THEIRS = (  # what must take part
    "matching.voronoi_scan.voronoi_scan",  # A §2.3, B §2.2: clicked seeds, shifts, five indicators,
    "matching.voronoi_scan._Scan._half_way",  # retries,
    "matching.voronoi_scan._Scan.close_holes",  # holes,
    "matching.voronoi_scan._Scan.filter_and_repeat",  # the neighbourhood filter and matching again,
    "surface.cloud.voxel_filtered",  # the voxel filter
    "tracking.published_step.track_step_published",  # A §2.4, B §3.1
    "tracking.published_step.predict_in_images",
    "tracking.track.regenerate",  # B §3.2
    "tracking.filters.over_thresholds",  # B §3.3: both filters
    "tracking.filters.against_voxels",
    "fitting.stages.inverse_kinematics.inverse_kinematics",  # A §3.3: clicked joints
)
OURS = (  # and what must not
    "matching.region_growing.grow_regions",
    "matching.object_space.match_surface",
    "matching.multi_image.match_multi_image",
    "tracking.step.track_step",
    "tracking.track.on_surface",
    "tracking.filters.against_neighbours",
    "fitting.inputs.completed_clouds.coarse_surfaces",
    "fitting.inputs.material_tracks.MaterialTracks.__init__",
    "fitting.stages.hidden_limbs.lost_limbs",
    "fitting.stages.limb_paths.best_way",
    "fitting.stages.joint_places.JointPlaces.applied",
)


def _count(monkeypatch: pytest.MonkeyPatch, path: str, calls: dict[str, int]) -> None:
    """Count the calls of a function or method, wherever it was imported to."""
    owner: Any
    module, _, name = path.rpartition(".")
    try:
        owner = importlib.import_module(f"tricap.core.{module}")
    except ModuleNotFoundError:  # a class
        package, _, kind = module.rpartition(".")
        owner = getattr(importlib.import_module(f"tricap.core.{package}"), kind)
    original: Callable[..., Any] = getattr(owner, name)

    @wraps(original)
    def counted(*args: Any, **named: Any) -> Any:
        calls[path] = calls.get(path, 0) + 1
        return original(*args, **named)

    places = [m for key, m in sys.modules.items() if key.startswith("tricap.core") and getattr(m, name, None) is original] or [owner]
    for place in places:
        monkeypatch.setattr(place, name, counted)


@pytest.mark.slow
def test_nothing_of_our_own_takes_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes part only in sigmas and in the report does not count."""
    make_arm_take(tmp_path / "take", ArmTakeSettings(frames=4, width_px=320, interlaced="none"))
    calls: dict[str, int] = {}
    for path in (*THEIRS, *OURS):
        _count(monkeypatch, path, calls)
    monkeypatch.setitem(published_step.STEPS, "published", published_step.track_step_published)
    monkeypatch.setitem(published_step.STEPS, "space", published_step.track_step)
    run = pipeline.run(tmp_path / "take", tmp_path / "out", {"method": {"preset": PUBLISHED}})
    assert {path for path in THEIRS if not calls.get(path)} == set() == {path for path in OURS if calls.get(path)}
    assert run.body is not None and len(run.body.shape.metaballs.radii_m) == 6  # three for each of the two segments, A §3.3
    elbow = run.body.motion.joints_m[:, run.body.motion.joint_names.index("elbow.R")]
    assert np.linalg.norm(elbow - read_truth(tmp_path / "take").joints_m["RightForeArm"], axis=1).max() < 0.05
