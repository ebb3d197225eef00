"""aniposelib on the bar: its iterated bundle adjustment of all ends as a cloud of points; the bar only gives the scale afterwards.

Its cameras have f and k1, the principal point in the image's middle, and no term for a known distance; so it is slower and less exact on
lenses that need more.
"""

import sys
import time

import cv2
import numpy as np
from aniposelib.cameras import Camera, CameraGroup


def main() -> None:
    """Adjust from the start's cameras, and scale by the bars."""
    given = dict(np.load(sys.argv[1]))
    np.random.seed(0)
    C = len(given["R"])
    points = np.moveaxis(given["xy_px"], 2, 1).reshape(-1, C, 2).transpose(1, 0, 2)
    points = np.ascontiguousarray(points[:, np.isfinite(points[..., 0]).sum(axis=0) >= 2])
    cameras = []
    for c in range(C):
        f, _, _, k1 = given["interior"][c, :4]
        middle = (given["size_px"] - 1) / 2
        matrix = [[f, 0, middle[0]], [0, f, middle[1]], [0, 0, 1]]
        cameras.append(
            Camera(
                matrix=matrix,
                dist=[k1, 0, 0, 0, 0],
                size=given["size_px"].tolist(),
                rvec=cv2.Rodrigues(given["R"][c])[0],
                tvec=given["t"][c],
                name=str(c),
            )
        )
    group = CameraGroup(cameras)
    group.triangulate(points[:, :10])  # what it compiles first is not its time
    start = time.process_time()
    sigma = float(given["sigma"])
    group.bundle_adjust_iter(points, start_mu=15, end_mu=max(6 * sigma, 0.3), ftol=1e-6, n_samp_full=points.shape[1], error_threshold=0.0)
    seconds = time.process_time() - start
    scale = float(given["length_m"]) / median_length(group, given["xy_px"])
    interior, R, t = [], [], []
    for camera in group.cameras:
        matrix, k = camera.get_camera_matrix(), camera.get_distortions()
        interior.append([matrix[1, 1], matrix[0, 2], matrix[1, 2], k[0], k[1], 0.0, 0.0, 0.0, 0.0, 0.0])
        R.append(cv2.Rodrigues(camera.get_rotation())[0])
        t.append(scale * camera.get_translation())
    np.savez(sys.argv[2], interior=interior, R=R, t=t, seconds=seconds)


def median_length(group: CameraGroup, xy_px: np.ndarray) -> float:
    """Of the bars that all cameras see, in the group's unit."""
    whole = xy_px[np.isfinite(xy_px).all(axis=(1, 2, 3))]
    ends = [np.asarray(group.triangulate(np.ascontiguousarray(whole[:, :, e].transpose(1, 0, 2)))) for e in (0, 1)]
    return float(np.median(np.linalg.norm(ends[0] - ends[1], axis=1)))


if __name__ == "__main__":
    main()
