"""Recordings beside the repository (../shared/takes), measured for the benchmark of the surface. They are not part of the project."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.intersection import forward_intersection
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.constraints import constrain
from tricap.core.matching.foreground import Foreground
from tricap.core.matching.least_squares import MatchingSettings, SearchImage, TemplatePoints, match_patches
from tricap.core.matching.occlusion_check import fails_occlusion_check
from tricap.core.matching.region_growing import GrowingSettings, MatchedField, grow_regions
from tricap.core.matching.seeds import sweep_seeds
from tricap.core.matching.views import Views, template_grid
from tricap.core.surface.cloud import PointCloud, SurfaceSettings, clean_field, point_cloud

TAKES = Path(__file__).resolve().parents[3] / "shared" / "takes"
BOARD, SQUARE_MM = (9, 6), 10.0
LOCAL, OFF_M = 20, 0.005  # neighbours of a plane fit; what is off it
Row = dict[str, Any]


def measured(
    rig: Sequence[Camera],
    grey: Sequence[np.ndarray],
    reference: int,
    depth_range_m: tuple[float, float],
    matching: MatchingSettings,
    growing: GrowingSettings,
    surface: SurfaceSettings,
) -> tuple[PointCloud, MatchedField]:
    """The cloud of one instant as a run measures it, and its field."""
    views = Views(images=[SplineImage(g) for g in grey], cameras=rig, reference=reference, rows=RowGrid())
    where = Foreground(depth_range_m=depth_range_m, method="everything")
    grid = template_grid(views.template.shape, RowGrid(), growing.spacing_px)
    seeds = sweep_seeds(views, grid, matching, spacing_px=growing.seed_spacing_px, depth_range_m=depth_range_m, monitor=Monitor())
    field = grow_regions(views, grid, seeds, matching, growing, foreground=where, monitor=Monitor())
    field = constrain(field, views, matching, foreground=where, monitor=Monitor())
    field = clean_field(field, rig[reference], reference, surface)
    field = field.select(~fails_occlusion_check(field, views, matching))
    return point_cloud(field, grey[reference], rig[reference], reference, 0, surface), field


def read_grey(path: Path) -> np.ndarray:
    """An image (h, w) float32."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"Cannot read {path}.")
    return image.astype(np.float32)


def rig_of(path: Path) -> list[Camera]:
    """The cameras of a calibration.json in millimetres."""
    made = []
    for camera in json.loads(path.read_text(encoding="utf-8"))["cameras"]:
        made.append(
            Camera(
                name=camera["name"],
                size_px=tuple(camera["size"]),
                matrix=np.array(camera["K"]),
                distortions=np.pad(np.array(camera["D"], dtype=np.float64), (0, 5 - len(camera["D"]))),
                R_cam_world=np.array(camera["R"]),
                t_cam_world_m=np.array(camera["t"]) / 1000,
            )
        )
    return made


def boards(most: int) -> Iterator[Row]:
    """A board of squares in three views: corners matched from the middle view, RMS off their plane and of the squares' sides."""
    folder = TAKES / "face_3cam_twente"
    rig = rig_of(folder / "calibration1.json")
    off, side, poses = [], [], 0
    for path in sorted((folder / "board1").glob("*_cam1_M.jpg"))[:most]:
        grey = [read_grey(path.with_name(path.name.replace("cam1_M", name))) for name in ("cam0_L", "cam1_M", "cam2_R")]
        corners = [_corners(g) for g in grey]
        if any(c is None for c in corners):
            continue
        M = corners[1]
        L, R = (c if (c[-1] - c[0]) @ (M[-1] - M[0]) > 0 else c[::-1] for c in (corners[0], corners[2]))
        images, shape = [SplineImage(g) for g in grey], np.tile(np.eye(2), (len(M), 1, 1))
        searches = [SearchImage(image=images[k], start=start, shape=shape) for k, start in ((0, L), (2, R))]
        found = match_patches(TemplatePoints(image=images[1], xy=M), searches, MatchingSettings(patch_px=13))
        ok = found[0].ok & found[1].ok
        if not ok.any():
            continue
        xy = np.stack([found[0].xy, M, found[1].xy], axis=1)
        X = forward_intersection(rig, xy, np.tile(np.eye(2), (len(xy), 3, 1, 1))).xyz_m * 1e3
        centred = X[ok] - X[ok].mean(axis=0)
        off.append(centred @ np.linalg.svd(centred)[2][2])
        net, known = X.reshape(BOARD[1], BOARD[0], 3), ok.reshape(BOARD[1], BOARD[0])
        side += [(np.linalg.norm(np.diff(net, axis=a), axis=2) - SQUARE_MM)[_both(known, a)] for a in (0, 1)]
        poses += 1
    if poses:
        yield {"what": f"board, {poses} poses", "off its plane, RMS [mm]": _rms(off), "squares' sides, RMS [mm]": _rms(side)}


def _both(known: np.ndarray, axis: int) -> np.ndarray:
    return known[1:] & known[:-1] if axis == 0 else known[:, 1:] & known[:, :-1]


def _corners(grey: np.ndarray) -> np.ndarray | None:
    image = grey.astype(np.uint8)
    found, corners = cv2.findChessboardCorners(image, BOARD)
    if not found:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)
    return np.asarray(cv2.cornerSubPix(image, corners, (4, 4), (-1, -1), criteria), dtype=np.float64).reshape(-1, 2)


def faces(stills: int) -> Iterator[Row]:
    """Faces of weak texture, three views: points, three-ray residual, and the share of points off a plane through their neighbours."""
    folder = TAKES / "face_3cam_twente"
    rig = rig_of(folder / "calibration1.json")
    for subject in ("subject1", "subject2"):
        for still in range(stills):
            grey = [read_grey(folder / subject / f"expr{still}_{name}.jpg") for name in ("cam0_L", "cam1_M", "cam2_R")]
            cloud, field = measured(rig, grey, 1, (0.4, 0.75), MatchingSettings(), GrowingSettings(), SurfaceSettings())
            yield {
                "what": f"{subject}, still {still}",
                "points": len(cloud.xyz_m),
                "residual, median [px]": float(np.median(field.residual_px)),
                "5 mm off a local plane": float((_off_plane_m(cloud.xyz_m) > OFF_M).mean()),
            }


def _off_plane_m(xyz_m: np.ndarray) -> np.ndarray:
    """Distances (N,) of points from planes through their nearest neighbours."""
    around = xyz_m[cKDTree(xyz_m).query(xyz_m, k=LOCAL + 1)[1][:, 1:]]
    centred = around - around.mean(axis=1, keepdims=True)
    normal = np.linalg.svd(centred, full_matrices=False)[2][:, 2]
    return np.abs(np.einsum("ni,ni->n", xyz_m - around.mean(axis=1), normal))


def load_steps(steps: int) -> Iterator[Row]:
    """A speckled cylinder in two views: how constant its radius is in each step, and how many of its points are found in the next step."""
    folder, before = TAKES / "cylinder_2cam_multidic", None
    rig = rig_of(folder / "calibration.json")
    matching, growing = MatchingSettings(patch_px=21), GrowingSettings(spacing_px=16, seed_spacing_px=96)
    for step in range(1, steps + 1):
        grey = [read_grey(folder / f"{camera}_{step}.jpg") for camera in ("201", "202")]
        cloud, field = measured(rig, grey, 0, (0.2, 0.5), matching, growing, SurfaceSettings())
        around, radius = fitted_cylinder(cloud.xyz_m * 1e3)
        near = np.abs(around) < 1
        row = {"what": f"cylinder, step {step}", "points": len(around), "radius [mm]": radius}
        row |= {"RMS of those within 1 mm": _rms([around[near]]), "beyond 1 mm": float(1 - near.mean())}
        if before is not None:
            row["found from the step before"] = _found_again(*before, grey[0])
        before = (grey[0], field.xy[:, 0])
        yield row


def _found_again(grey: np.ndarray, xy: np.ndarray, later: np.ndarray) -> float:
    """Share of points (N, 2) matched in a later image, from where OpenCV's pyramid sees them."""
    images = [image.astype(np.uint8) for image in (grey, later)]
    start, _, _ = cv2.calcOpticalFlowPyrLK(*images, xy.astype(np.float32), None, winSize=(31, 31), maxLevel=4)
    shape = np.tile(np.eye(2), (len(xy), 1, 1))
    settings = MatchingSettings(patch_px=21)
    search = SearchImage(image=SplineImage(later), start=start.astype(np.float64), shape=shape)
    found = match_patches(TemplatePoints(image=SplineImage(grey), xy=xy), [search], settings)[0]
    return float(found.ok.mean())


def fitted_cylinder(xyz_mm: np.ndarray) -> tuple[np.ndarray, float]:
    """Distances (N,) [mm] of points from the cylinder fitted to them, its axis near z and its radius free; and the radius."""
    x, y, z = xyz_mm.T
    centre, slope = np.array([np.median(x), np.median(y)]), np.zeros(2)
    zc = z - z.mean()
    p = np.array([*centre, *slope, 50.0])
    for _ in range(50):
        d = np.stack([x - p[0] - p[2] * zc, y - p[1] - p[3] * zc])
        rho = np.hypot(*d)
        J = np.stack([-d[0] / rho, -d[1] / rho, -d[0] / rho * zc, -d[1] / rho * zc, -np.ones_like(rho)], axis=1)
        robust = 1 / (1 + ((rho - p[4]) / 1.0) ** 2)
        p = p - np.linalg.solve(J.T @ (robust[:, None] * J), J.T @ (robust * (rho - p[4])))
    d = np.stack([x - p[0] - p[2] * zc, y - p[1] - p[3] * zc])
    return np.hypot(*d) - p[4], float(p[4])


def disparities(names: Sequence[str] = ("Cloth3", "cones")) -> Iterator[Row]:
    """Pairs with true disparity: error and coverage beside cv2.StereoSGBM, where both say something and over all true pixels."""
    folder, focal, base = TAKES / "stereo_gt_middlebury", 700.0, 0.2
    for name in names:
        old = name == "cones"
        left, right = (read_grey(folder / f"{name}_{v}.png") for v in (("im2", "im6") if old else ("view1", "view5")))
        truth = read_grey(folder / (f"{name}_disp2.pgm" if old else f"{name}_disp1.png")) / (4 if old else 2)
        h, w = left.shape
        rig = [
            Camera(
                name=view,
                size_px=(w, h),
                matrix=np.array([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]]),
                distortions=np.zeros(5),
                R_cam_world=np.eye(3),
                t_cam_world_m=np.array([-x, 0.0, 0.0]),
            )
            for view, x in (("left", 0.0), ("right", base))
        ]
        depth = focal * base / np.percentile(truth[truth > 0], [99.9, 0.1])
        growing = GrowingSettings(spacing_px=4, seed_spacing_px=16)
        cloud, _ = measured(rig, [left, right], 0, (0.9 * depth[0], 1.1 * depth[1]), MatchingSettings(), growing, SurfaceSettings())
        xy = cloud.xy_px[:, 0]
        ours = focal * base / rig[0].to_camera(cloud.xyz_m)[:, 2]
        at = tuple(np.rint(xy).astype(int).T[::-1])
        known = truth[at] > 0
        cells = (truth[2::4, 2::4] > 0).sum()
        most = 16 * int(np.ceil(truth.max() / 16))
        sgbm = cv2.StereoSGBM.create(0, most, 5, 8 * 25, 32 * 25, 1, 0, 10, 100, 2)
        theirs = sgbm.compute(left.astype(np.uint8), right.astype(np.uint8)).astype(np.float64) / 16
        theirs_there = np.where(theirs > 0, theirs, np.nan)
        yield _disparity_row(f"{name}, Tricap", ours[known] - truth[at][known], cells)
        yield _disparity_row(f"{name}, StereoSGBM, same points", theirs_there[at][known] - truth[at][known], cells)
        net = theirs_there[2::4, 2::4] - np.where(truth[2::4, 2::4] > 0, truth[2::4, 2::4], np.nan)
        yield _disparity_row(f"{name}, StereoSGBM, all", net[truth[2::4, 2::4] > 0], cells)


def _disparity_row(what: str, error: np.ndarray, cells: int) -> Row:
    error = error[np.isfinite(error)]
    good = error[np.abs(error) <= 1]
    return {
        "what": what,
        "median |error| [px]": float(np.median(np.abs(error))),
        "RMS of those within 1 px": _rms([good]),
        "beyond 1 px": float((np.abs(error) > 1).mean()),
        "coverage": len(error) / cells,
    }


def challenge() -> Iterator[Row]:
    """Speckle with known displacement: RMS and bias of matching against the commanded shift, and what is lost.

    A measurement takes a patch's texture centre over, not its middle; RMS at both.
    """
    folder = TAKES / "dic_challenge"
    base = read_grey(folder / "sample5" / "Sample5 Reference.tif")
    for path in sorted((folder / "sample5").glob("Sample5-*.tif")):
        shift = np.array([float(word[1:]) for word in path.stem.split() if word[0] in "XY"])
        yield _displacement_row(f"sample5, shift {shift[0]:g}", base, read_grey(path), 13, lambda xy, s=shift: np.broadcast_to(s, xy.shape))
    columns = np.loadtxt(folder / "sample14" / "command.csv", delimiter=",")
    base = read_grey(folder / "sample14" / "Sample14 Reference.tif")
    for level in (1, 3, 5):
        later = read_grey(folder / "sample14" / f"Sample14 L{level} Amp0.1b.tif")
        for patch in (13, 21, 33):

            def moved(xy: np.ndarray, level: int = level) -> np.ndarray:
                return np.stack([np.interp(xy[:, 0], columns[:, 0], columns[:, level]), np.zeros(len(xy))], axis=1)

            yield _displacement_row(f"sample14 L{level}, {patch}×{patch}", base, later, patch, moved)


def _displacement_row(what: str, base: np.ndarray, later: np.ndarray, patch: int, moved: Callable[[np.ndarray], np.ndarray]) -> Row:
    h, w = base.shape
    y, x = np.mgrid[30 : h - 30 : 7, 30 : w - 30 : 7]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    shape, settings = np.tile(np.eye(2), (len(xy), 1, 1)), MatchingSettings(patch_px=patch, min_correlation=0.5)
    search = SearchImage(image=SplineImage(later), start=xy, shape=shape)
    found = match_patches(TemplatePoints(image=SplineImage(base), xy=xy), [search], settings)[0]
    error = (found.xy - xy - moved(xy))[found.ok]
    centre = xy + found.offset
    taken_over = (found.transfer_xy - centre - moved(centre))[found.ok]
    return {
        "what": what,
        "RMS of x [px]": _rms([error[:, 0]]),
        "at the texture's centre": _rms([taken_over[:, 0]]),
        "bias [px]": float(error[:, 0].mean()),
        "lost": float(1 - found.ok.mean()),
    }


def _rms(parts: Sequence[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate([np.ravel(p) for p in parts]) ** 2)))
