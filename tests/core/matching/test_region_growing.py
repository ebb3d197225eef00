"""Region growing: what is tried again, and with what."""

from types import ModuleType

import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.foreground import Foreground
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.matching.region_growing import GrowingSettings, grow_regions
from tricap.core.matching.seeds import approximations_at_depth
from tricap.core.matching.views import Views, template_grid

EVERYWHERE = Foreground(depth_range_m=(1.0, 2.0), method="everything")


@pytest.mark.parametrize(("fewer", "gain"), [({"bigger_patches": 0}, 1.1), ({"attempts": 1}, 1.05)], ids=["patches", "attempts"])
def test_points_are_tried_again_with_other_parameters(surfaces: ModuleType, fewer: dict[str, int], gain: float) -> None:
    """On a limb of weak texture: in patches 4 px larger, and from other neighbours. All points are within 5 mm of the surface."""
    surface, settings = surfaces.cylinder(0.06), MatchingSettings()
    rig, grey = surfaces.render(surface, "weak")
    views = Views(images=[SplineImage(g) for g in grey], cameras=rig, reference=1, rows=RowGrid())
    xy = np.array([[160.0, y] for y in range(40, 200, 20)], dtype=float)
    seeds = approximations_at_depth(rig, 1, RowGrid(), xy, surface.hit(rig[1].centre_m, rig[1].rays(xy))[0])
    grid, count = template_grid(views.template.shape, RowGrid(), 6), []
    for growing in ({}, fewer):
        field = grow_regions(views, grid, seeds, settings, GrowingSettings(**growing), foreground=EVERYWHERE, monitor=Monitor())
        assert np.mean(np.abs(surface.distance_m(field.xyz_m)) < 0.005) > 0.98
        count.append(len(field.cell))
    assert count[0] > gain * count[1] > 0
