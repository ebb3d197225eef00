"""pycolmap on the bar: all ends as one static cloud in as many images as cameras; the bar only gives the scale afterwards."""

import sys
import tempfile
import time
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap


def main() -> None:
    given = dict(np.load(sys.argv[1]))
    xy = given["xy_px"]
    N, C = xy.shape[:2]
    flat = np.moveaxis(xy, 2, 1).reshape(2 * N, C, 2)
    seen = np.isfinite(flat).all(axis=2)
    w, h = (int(v) for v in given["size_px"])
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        database = pycolmap.Database.open(str(Path(folder) / "bar.db"))
        rows = []
        for c in range(C):
            camera = pycolmap.Camera.create(c + 1, pycolmap.CameraModelId.OPENCV, 1.2 * w, w, h)
            camera_id = database.write_camera(camera)
            image_id = database.write_image(pycolmap.Image(name=f"{c}.png", camera_id=camera_id))
            index = np.full(2 * N, -1)
            index[seen[:, c]] = np.arange(seen[:, c].sum())
            rows.append((image_id, index))
            database.write_keypoints(image_id, (flat[seen[:, c], c] + 0.5).astype(np.float32))
        for a, b in combinations(range(C), 2):
            both = seen[:, a] & seen[:, b]
            matches = np.stack([rows[a][1][both], rows[b][1][both]], axis=1).astype(np.uint32)
            geometry = pycolmap.TwoViewGeometry(inlier_matches=matches, config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
            database.write_matches(rows[a][0], rows[b][0], matches)
            database.write_two_view_geometry(rows[a][0], rows[b][0], geometry)
        database.close()
        options = pycolmap.IncrementalPipelineOptions(min_num_matches=15)
        made = pycolmap.incremental_mapping(str(Path(folder) / "bar.db"), folder, folder, options)
    seconds = time.process_time() - start
    save(made[max(made, key=lambda m: made[m].num_reg_images())], given, C, seconds)


def save(model, given, C: int, seconds: float) -> None:
    """Cameras in the layout of the benchmark, scaled by the bar's median length."""
    interior, R, t = np.zeros((C, 10)), np.zeros((C, 3, 3)), np.zeros((C, 3))
    if model.num_reg_images() < C:
        sys.exit("COLMAP lost a camera")
    for image in model.images.values():
        c = int(Path(image.name).stem)
        fx, fy, cx, cy, k1, k2, p1, p2 = model.cameras[image.camera_id].params
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        interior[c] = [fy, cx - 0.5, cy - 0.5, k1, k2, 0, p1, p2, fx / fy - 1, 0]
        R[c], t[c] = pose.rotation.matrix(), pose.translation
    sys.path.insert(0, str(Path(__file__).parent))
    from gtsam_bar import triangulated

    seen = np.isfinite(given["xy_px"]).all(axis=-1)
    ends = triangulated(dict(given, interior=interior, R=R, t=t), seen)
    whole = (seen.sum(axis=1) >= 2).all(axis=1)
    scale = float(given["length_m"]) / np.median(np.linalg.norm(ends[whole, 0] - ends[whole, 1], axis=1))
    np.savez(sys.argv[2], interior=interior, R=R, t=t * scale, seconds=seconds)


if __name__ == "__main__":
    main()
