"""Presets: sets of settings by name. The settings of take.toml and of the command win over those of the preset.

"published" is the method of D'Apuzzo, Plänkers, Fua, Gruen & Thalmann 1999 (A) and D'Apuzzo & Plänkers 2000 (B), as far as they describe
it. What they leave open stays as by default: how the person is separated from the background; that points whose rays miss each other, or
with fewer than three neighbours, are no measured points; the values of all thresholds; robust weights in the fit; limits and weak priors
of the joints; that motion is smooth over time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..foundation.settings import knob

DEFAULT, PUBLISHED = "default", "published"


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodSettings:
    """The method of the whole run."""

    preset: str = knob(
        DEFAULT,
        "Settings that are not set otherwise: the defaults, or those of the published method, from clicked surface seeds.",
        choices=(DEFAULT, PUBLISHED),
    )


PRESETS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    DEFAULT: {},
    PUBLISHED: {
        "enhance": {"wallis": "auto"},  # B §2.2: in case of poor natural texture
        "matching": {"patch_px": 13, "constraint": "none"},  # A §2.3; constraints are future work in B §4
        "growing": {"method": "published", "seed_spacing_px": 0},  # B §2.2: from clicked seeds
        "surface": {  # B §2.2: the voxel filter, and none of our own
            "quality": "surface",
            "min_island": 1,
            "max_deviation": 20.0,
            "correct_curvature": False,
            "voxel_mm": 10.0,
            "voxel_points": 1,
        },
        "tracking": {  # A §2.4, B §2.3: all measured points, density checked in every second frame, two filters
            "scheme": "published",
            "spacing_px": 4,
            "min_coverage": 0.0,
            "regenerate_every": 2,
            "bridge_frames": 0,
            "wait_frames": 0,
            "uniformity": "voxels",
            "max_sigma_ratio": 1000.0,
        },
        "fitting": {  # A §3.3, §4: three metaballs, points only, Eq. 15, radii and pose in turns
            "method": "alternating",
            "residual": "paper",
            "use_trajectories": False,
            "closed_loop": "off",
            "use_background": False,
            "search_limbs": False,
            "complete_surface": False,
            "place_joints": "off",
        },
    },
}
