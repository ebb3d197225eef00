"""Constraints earn their place: unconstrained, epipolar and object-space matching, with and without what the neighbours say, on strong,
weak and repetitive texture, on a receding plane and an upright cylinder of 60 mm radius at 2 mm per pixel. The truth is exact.

coverage: share of the template's cells on the surface that have a point within 5 mm of it; gross: share of points beyond; RMS, bias:
along the normal, of the others; z: RMS of error over reported sigma along the normal; cpu: of growing, and of the constraint after it.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import _surfaces as surfaces
import numpy as np

from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.constraints import constrain
from tricap.core.matching.foreground import Foreground
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.matching.region_growing import GrowingSettings, MatchedField, grow_regions
from tricap.core.matching.seeds import sweep_seeds
from tricap.core.matching.views import Views, template_grid
from tricap.core.surface.cloud import PointCloud, SurfaceSettings, clean_field, point_cloud

GROSS_M = 0.005
SCENES = {"plane": surfaces.plane(), "cylinder": surfaces.cylinder(0.06)}
TEXTURES = ("strong", "weak", "repetitive")
VARIANTS = [(c, n) for c in ("none", "epipolar", "object") for n in (False, True)]
EVERYWHERE = Foreground(depth_range_m=(1.0, 2.0), method="everything")


def grown(views: Views, matching: MatchingSettings) -> tuple[MatchedField, float]:
    """The unconstrained field of the centre image, and its CPU seconds."""
    began, monitor = time.process_time(), Monitor()
    grid = template_grid(views.template.shape, RowGrid(), 4)
    seeds = sweep_seeds(views, grid, matching, spacing_px=24, depth_range_m=(1.1, 1.8), monitor=monitor)
    field = grow_regions(views, grid, seeds, matching, GrowingSettings(), foreground=EVERYWHERE, monitor=monitor)
    return field, time.process_time() - began


def judged(cloud: PointCloud, field: MatchedField, surface: surfaces.Surface, rig: list) -> dict[str, float]:
    """Coverage, gross share, RMS, bias and z of a cloud against the surface's equation."""
    error = surface.distance_m(cloud.xyz_m)
    normal = surface.normal(cloud.xyz_m)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, cloud.covariance_m2, normal))
    fine = np.abs(error) < GROSS_M
    every = field.grid.xy(np.arange(field.grid.shape[0] * field.grid.shape[1]))
    on_surface = np.isfinite(surface.hit(rig[1].centre_m, rig[1].rays(every))[0])
    return dict(
        points=len(error),
        coverage=float(fine.sum() / on_surface.sum()),
        gross=float(np.mean(~fine)) if len(error) else 0.0,
        rms_mm=1e3 * float(np.sqrt(np.mean(error[fine] ** 2))) if fine.any() else float("nan"),
        bias_mm=1e3 * float(np.median(error[fine])) if fine.any() else float("nan"),
        z=float(np.sqrt(np.mean((error[fine] / sigma[fine]) ** 2))) if fine.any() else float("nan"),
    )


def measure(scene: str, texture: str, seed: int) -> list[dict]:
    """One row for every variant."""
    surface, matching, rows = SCENES[scene], MatchingSettings(), []
    rig, grey = surfaces.render(surface, texture, seed=seed)
    views = Views(images=[SplineImage(g) for g in grey], cameras=rig, reference=1, rows=RowGrid())
    field, grow_s = grown(views, matching)
    for constraint, neighbours in VARIANTS:
        began = time.process_time()
        settings = replace(matching, constraint=constraint, neighbours=neighbours)
        found = constrain(field, views, settings, foreground=EVERYWHERE, monitor=Monitor())
        spent = time.process_time() - began
        if neighbours:
            found = clean_field(found, rig[1], 1, SurfaceSettings())
        cloud = point_cloud(found, grey[1], rig[1], 1, 0, SurfaceSettings())
        row = dict(scene=scene, texture=texture, constraint=constraint, neighbours=neighbours)
        rows.append(row | judged(cloud, found, surface, rig) | dict(grow_cpu_s=round(grow_s, 2), cpu_s=round(spent, 2)))
    return rows


def main() -> int:
    """Print the table; `--json FILE` keeps it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--seeds", type=int, default=2, help="textures of each kind")
    options = parser.parse_args()
    table = []
    print("scene     texture     constraint  neighbours  points  coverage  gross   rms mm  bias mm  z     cpu s (growing)")
    for scene in SCENES:
        for texture in TEXTURES:
            runs = [measure(scene, texture, seed) for seed in range(options.seeds)]
            for rows in zip(*runs):
                mean = {
                    k: float(np.mean([r[k] for r in rows])) for k, v in rows[0].items() if isinstance(v, (int, float)) and v is not True
                }
                row = rows[0] | {k: v for k, v in mean.items() if k != "neighbours"}
                table.append(row)
                print(
                    f"{scene:9s} {texture:11s} {row['constraint']:11s} {'yes' if row['neighbours'] else 'no':10s} {row['points']:7.0f}"
                    f"  {row['coverage']:8.3f}  {row['gross']:.4f}  {row['rms_mm']:6.3f}  {row['bias_mm']:+7.3f}  {row['z']:5.2f}"
                    f"  {row['cpu_s']:.2f} ({row['grow_cpu_s']:.2f})"
                )
    if options.json:
        Path(options.json).write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
