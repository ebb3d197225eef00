"""The measured surface on bodies of known form and on recordings.

    python tests/bench/surface.py [--json FILE] [--stills 5] [--only NAME ...]

bodies: a cylinder of 40 mm and a sphere of 60 mm radius at 3.6 mm per pixel, for patches of 7–25 px: bias along the normal (median, out of
the body positive) and scatter (robust), with affine patches, those corrected for the measured curvature, quadrics that are free, and the
default, quadrics held by their neighbours. A texture's own bias scatters by 0.1 mm on the cylinder and 0.16 mm on the sphere (40 points of
patches that overlap), so that the patch of 13 px is measured with more textures; the standard error is told.
boards, faces, steps, pairs, speckle: recordings of ../shared/takes (see `_recordings.py`); what is not there is left out, and that is said.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import _recordings as recordings
import _surfaces as surfaces
import numpy as np
from _recordings import Row

from tricap.core.images.sampling import SplineImage
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.matching.object_space import SurfaceStarts, match_surface
from tricap.core.matching.patches import monomials
from tricap.core.matching.region_growing import GrowingSettings, MatchedField
from tricap.core.matching.views import Views
from tricap.core.surface.cloud import SurfaceSettings

BODIES = {"cylinder 40 mm": surfaces.cylinder(0.04), "sphere 60 mm": surfaces.sphere(0.06)}
MM_PER_PX, PATCHES, TEXTURES = 3.6, (7, 9, 11, 13, 17, 21, 25), 6
MORE_TEXTURES, USUAL_PATCH = 36, 13
DEPTH_M = (1.1, 1.8)
FACING = 0.5  # cosine between normal and ray
FAR_M = 0.005
SHARED = {
    "boards": "face_3cam_twente",
    "faces": "face_3cam_twente",
    "steps": "cylinder_2cam_multidic",
    "pairs": "stereo_gt_middlebury",
    "speckle": "dic_challenge",
}


def bodies() -> Iterator[Row]:
    """One row for every body, patch and warp."""
    for name, surface in BODIES.items():
        for patch in PATCHES:
            found: dict[str, list[np.ndarray]] = {}
            for seed in range(MORE_TEXTURES if patch == USUAL_PATCH else TEXTURES):
                for warp, xyz in _clouds(surface, patch, seed):
                    found.setdefault(warp, []).append(_errors(surface, xyz))
            for warp, parts in found.items():
                error = 1e3 * np.concatenate(parts)
                yield {
                    "what": f"{name}, {patch}×{patch}, {warp}",
                    "points": len(error) // len(parts),
                    "bias [mm]": float(np.median(error)),
                    "its sigma [mm]": float(1e3 * np.std([np.median(p) for p in parts if len(p)]) / np.sqrt(len(parts))),
                    "scatter [mm]": float(1.4826 * np.median(np.abs(error - np.median(error)))),
                }


def _clouds(surface: surfaces.Surface, patch: int, seed: int) -> Iterator[tuple[str, np.ndarray]]:
    """The points (N, 3) of one textured body by each warp."""
    rig, grey = surfaces.render(surface, "strong", seed=seed, focal_px=surfaces.FOCAL_PX * 2 / MM_PER_PX)
    matching = MatchingSettings(patch_px=patch)
    free = replace(matching, constraint="none")
    for warp, settings, corrected in (("affine", free, False), ("affine, corrected", free, True), ("default", matching, True)):
        made = SurfaceSettings(correct_curvature=corrected, min_island=5)
        cloud, field = recordings.measured(rig, grey, 1, DEPTH_M, settings, GrowingSettings(bigger_patches=0), made)
        yield warp, cloud.xyz_m
        if warp == "affine":
            yield "quadric, free", _quadrics(field, rig, grey, matching)


def _quadrics(field: MatchedField, rig: list, grey: list[np.ndarray], settings: MatchingSettings) -> np.ndarray:
    """The points of a field measured again as pieces of surface whose curvatures nothing holds."""
    xy, base = field.xy[:, 1], rig[1]
    start = np.zeros((len(xy), 6))
    start[:, 0] = 1 / base.to_camera(field.xyz_m)[:, 2]
    views = Views(images=[SplineImage(g) for g in grey], cameras=rig, reference=1, rows=field.grid.rows)
    found = match_surface(views, SurfaceStarts(xy=xy, theta=start), replace(settings, max_sigma_px=1.0), sigma_across_px=0.03)
    w = np.einsum("ni,ni->n", monomials(found.offset[:, 0], found.offset[:, 1], 2).astype(np.float64), found.theta)
    return base.points_at_depth(xy[found.ok] + found.offset[found.ok], 1 / w[found.ok])


def _errors(surface: surfaces.Surface, xyz_m: np.ndarray) -> np.ndarray:
    """Distances (N,) [m] from the surface, of points that face the centre camera."""
    ray = xyz_m / np.linalg.norm(xyz_m, axis=-1, keepdims=True)
    error = surface.distance_m(xyz_m)
    return error[(np.einsum("ni,ni->n", -ray, surface.normal(xyz_m)) > FACING) & (np.abs(error) < FAR_M)]


def told(rows: list[Row]) -> str:
    """Rows as a table; columns that a row does not have stay empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    cells = [columns] + [[_cell(row.get(name)) for name in columns] for row in rows]
    width = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return "\n".join("  ".join(text.ljust(n) for text, n in zip(line, width)).rstrip() for line in cells)


def _cell(value: object) -> str:
    return "" if value is None else f"{value:.4f}" if isinstance(value, float) else str(value)


def main() -> int:
    """Print the tables; `--json FILE` keeps them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--stills", type=int, default=1, help="of each face; there are 5")
    parser.add_argument("--only", nargs="+", choices=("bodies", *SHARED), help="these tables")
    options = parser.parse_args()
    made: dict[str, Callable[[], Iterator[Row]]] = {
        "bodies": bodies,
        "boards": lambda: recordings.boards(20),
        "faces": lambda: recordings.faces(options.stills),
        "steps": lambda: recordings.load_steps(5),
        "pairs": recordings.disparities,
        "speckle": recordings.challenge,
    }
    tables: dict[str, list[Row]] = {}
    for name, rows in made.items():
        if options.only and name not in options.only:
            continue
        if name in SHARED and not (recordings.TAKES / SHARED[name]).is_dir():
            print(f"{name}: left out, {SHARED[name]} is not in {recordings.TAKES}.\n")
            continue
        tables[name] = list(rows())
        print(f"{name}\n{told(tables[name])}\n", flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps(tables, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
