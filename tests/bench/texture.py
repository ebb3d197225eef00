"""How much of a surface is measured, and how well, against the contrast of its texture, noise, blur and the size of the patch.

    python dev.py bench texture [--json FILE]

A trunk's cylinder of 120 mm radius, 2 mm a pixel, three cameras 12° apart. Contrast is the texture's standard deviation over its mean,
noise that of a pixel in grey values (of a mean of 120), blur the way in pixels during the exposure. Shown are the whole measurement of
a run with its default settings; the patches alone, without what is measured from their neighbours' surface; cv2.StereoSGBM in one
pair of views and in both, as `matching.semi_global` uses it, inside the true outline; and cv2's PyrLK on the same grid, checked backwards,
and triangulated.

coverage: share of the surface that all views see with a point within 12 mm; median and 95 % of the distances from the surface; gross: share
beyond 10 mm; z: robust scale of the distances over their own sigmas, 1 if these are true.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import _surfaces as surfaces
import cv2
import numpy as np
from scipy.spatial import cKDTree
from surface import told

from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.intersection import forward_intersection
from tricap.core.geometry.rig import Rig, write_rig
from tricap.core.matching.semi_global import coarse_surface
from tricap.core.results.folder import Results
from tricap.core.run.take_run import settings_of
from tricap.core.surface.measure import NothingMeasured, measure_frames
from tricap.core.surface.starts import MeasureSettings
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

BODY, SEED, GRID_PX = surfaces.cylinder(0.12), 3, 4
CONTRASTS, NOISES, BLURS, PATCHES = (0.02, 0.04, 0.08, 0.15, 0.3, 0.6), (1.0, 2.0, 4.0, 8.0), (1, 3, 6, 12), (9, 13, 17, 25)
USUAL, WEAK = 0.3, 0.08  # contrasts at which the others vary
COVERED_M, GROSS_M, FACING, BACKWARDS_PX = 0.012, 0.010, 0.35, 0.5
Row = dict[str, str | float]


def rows() -> Iterator[Row]:
    """Contrast with the usual noise; then noise, blur and patch, with strong and with weak texture."""
    for contrast in CONTRASTS:
        yield from of_images(f"contrast {100 * contrast:.0f} %", contrast)
    for contrast in (USUAL, WEAK):
        for noise in NOISES:
            yield from of_images(f"contrast {100 * contrast:.0f} %, noise {noise:g}", contrast, noise=noise)
        for blur in BLURS:
            yield from of_images(f"contrast {100 * contrast:.0f} %, blur {blur} px", contrast, blur_px=blur)
        for patch in PATCHES:
            yield from of_images(f"contrast {100 * contrast:.0f} %, patch {patch} px", contrast, patch_px=patch, peers=False)


def of_images(what: str, contrast: float, *, noise: float = 2.0, blur_px: int = 1, patch_px: int = 13, peers: bool = True) -> Iterator[Row]:
    """One row for every method."""
    rig, grey = surfaces.render(BODY, contrast, noise=noise, seed=SEED, blur_px=blur_px)
    truth = visible(rig)
    xyz, sigma, extended = measured(rig, grey, patch_px)
    yield scored(what, "default", truth, xyz, sigma)
    yield scored(what, "patches alone", truth, xyz[~extended], sigma[~extended])
    if peers:
        for name, views in (("StereoSGBM, a pair", (0, 1)), ("StereoSGBM, both pairs", (0, 1, 2))):
            found = coarse_surface([grey[k] for k in views], [rig[k] for k in views], 1, truth)
            on = np.isfinite(BODY.hit(rig[1].centre_m, rig[1].rays(rig[1].project(found.xyz_m)))[0])  # it is told the person's outline
            yield scored(what, name, truth, found.xyz_m[on], found.sigma_m[on])
        xyz = by_flow(rig, grey, truth)
        yield scored(what, "PyrLK", truth, xyz, np.full(len(xyz), np.nan))


def visible(rig: list[Camera]) -> np.ndarray:
    """Places (N, 3) of the surface, one for each pixel of a grid in the middle view, that face all views."""
    x, y = np.meshgrid(np.arange(0.0, surfaces.WIDTH, GRID_PX), np.arange(0.0, surfaces.HEIGHT, GRID_PX))
    rays = rig[1].rays(np.stack([x, y], axis=-1))
    depth = BODY.hit(rig[1].centre_m, rays)[0]
    xyz = (rig[1].centre_m + depth[..., None] * rays)[np.isfinite(depth)]
    seen = np.ones(len(xyz), dtype=bool)
    for camera in rig:
        ray = xyz - camera.centre_m
        seen &= np.einsum("ni,ni->n", -ray, BODY.normal(xyz)) > FACING * np.linalg.norm(ray, axis=1)
        seen &= camera.sees(camera.project(xyz))
    return xyz[seen]


def measured(rig: list[Camera], grey: list[np.ndarray], patch_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points (N, 3) of a run, their sigmas across the surface (N,), and which were measured from their neighbours' surface (N,)."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_rig(folder / "rig.toml", Rig(cameras=tuple(rig)))
        views = ""
        for camera, image in zip(rig, grey):
            (folder / camera.name).mkdir()
            cv2.imwrite(str(folder / camera.name / "0000.png"), image.astype(np.uint8))
            views += f'[[views]]\nname = "{camera.name}"\nimages = "{camera.name}/*.png"\n'
        head = 'format = "tricap-take"\nversion = 1\nfps = 25.0\ninterlaced = "none"\nrig = "rig.toml"\n'
        (folder / "take.toml").write_text(f'{head}{views}[body]\nmodel = "none"\n')
        settings = MeasureSettings.of(settings_of({}, {"matching": {"patch_px": patch_px}}, "bench"))
        with Results(folder / "out").opened() as results:
            try:
                found = next(iter(measure_frames(open_take(read_take(folder)), settings, results, Monitor())))
            except NothingMeasured:
                return np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool)
    cloud = found.cloud
    normal = BODY.normal(cloud.xyz_m)
    return cloud.xyz_m, np.sqrt(np.einsum("ni,nij,nj->n", normal, cloud.covariance_m2, normal)), cloud.extended


def by_flow(rig: list[Camera], grey: list[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """The places of the same pixels (N, 3) by pyramidal optical flow from the middle view, and back again, intersected."""
    images = [image.astype(np.uint8) for image in grey]
    at = rig[1].project(truth).astype(np.float32)[:, None]
    found, good = [at] * 3, np.ones(len(at), dtype=bool)
    for k in (0, 2):
        there, ok, _ = cv2.calcOpticalFlowPyrLK(images[1], images[k], at, None)
        back, also, _ = cv2.calcOpticalFlowPyrLK(images[k], images[1], there, None)
        good &= (ok[:, 0] > 0) & (also[:, 0] > 0) & (np.linalg.norm((back - at)[:, 0], axis=1) < BACKWARDS_PX)
        found[k] = there
    xy = np.concatenate(found, axis=1).astype(np.float64)[good]
    return forward_intersection(rig, xy, np.tile(np.eye(2), (*xy.shape[:2], 1, 1))).xyz_m


def scored(what: str, method: str, truth: np.ndarray, xyz: np.ndarray, sigma: np.ndarray) -> Row:
    """The figures of some points."""
    row: Row = {"what": what, "method": method, "points": len(xyz), "coverage": 0.0}
    if not len(xyz):
        return row
    error = np.abs(BODY.distance_m(xyz))
    row["coverage"] = float((cKDTree(xyz).query(truth)[0] < COVERED_M).mean())
    row |= {"median [mm]": 1e3 * float(np.median(error)), "95 % [mm]": 1e3 * float(np.percentile(error, 95))}
    row["gross [%]"] = 100 * float((error > GROSS_M).mean())
    if np.isfinite(sigma).all():
        row["z"] = 1.4826 * float(np.median(np.abs(BODY.distance_m(xyz) / sigma)))
    return row


def main() -> int:
    """Print the table; `--json FILE` keeps it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    found = list(rows())
    print(told(found))
    if options.json:
        Path(options.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
