"""GTSAM on the bar: GeneralSFMFactor2Cal3DS2 per image point and a range factor per bar, Cauchy first, then trimmed least squares."""

import sys
import time

import gtsam
import numpy as np
from gtsam.symbol_shorthand import K, P, X


def graph_of(given, keep, robust: bool):
    """Factors of the image points that are kept, of the bars' lengths, and a prior on the first pose."""
    sigma = float(given["sigma"])
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    if robust:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(3.0), noise)
    length_noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-6)
    graph = gtsam.NonlinearFactorGraph()
    for n, c, e in np.argwhere(keep):
        graph.add(gtsam.GeneralSFMFactor2Cal3DS2(given["xy_px"][n, c, e], noise, X(c), P(2 * n + e), K(c)))
    for n in np.flatnonzero(keep.any(axis=1).all(axis=1)):
        graph.add(gtsam.RangeFactor3(P(2 * n), P(2 * n + 1), float(given["length_m"]), length_noise))
    return graph


def main() -> None:
    given = dict(np.load(sys.argv[1]))
    xy, C = given["xy_px"], len(given["R"])
    seen = np.isfinite(xy).all(axis=-1)
    keep = seen & (seen.sum(axis=1, keepdims=True) >= 2)
    values = gtsam.Values()
    cameras = []
    for c in range(C):
        f, cx, cy, k1 = given["interior"][c, :4]
        calibration = gtsam.Cal3DS2(f, f, 0.0, cx, cy, k1, 0.0, 0.0, 0.0)
        pose = gtsam.Pose3(gtsam.Rot3(given["R"][c].T), -given["R"][c].T @ given["t"][c])
        cameras.append((pose, calibration))
        values.insert(X(c), pose)
        values.insert(K(c), calibration)
    points = triangulated(given, keep)
    for n, e in np.argwhere(keep.any(axis=1)):
        values.insert(P(2 * n + e), points[n, e])
    start, iterations = time.process_time(), 0
    for robust in (True, False, False):
        graph = graph_of(given, keep, robust)
        graph.add(gtsam.PriorFactorPose3(X(0), cameras[0][0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
        used = set(graph.keyVector())
        part = gtsam.Values()
        for c in range(C):
            part.insert(X(c), values.atPose3(X(c)))
            part.insert(K(c), values.atCal3DS2(K(c)))
        for n, e in np.argwhere(keep.any(axis=1)):
            if P(2 * n + e) in used:
                part.insert(P(2 * n + e), values.atPoint3(P(2 * n + e)))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-4 if robust else 1e-9)  # the robust one only has to tell the blunders; 1e-5 later is too early
        parameters.setMaxIterations(100)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, part, parameters)
        values = optimizer.optimize()
        iterations += optimizer.iterations()
        keep = trimmed(given, values, keep)
    seconds = time.process_time() - start
    interior, R, t = [], [], []
    for c in range(C):
        fx, fy, s, u, v, k1, k2, p1, p2 = values.atCal3DS2(K(c)).vector()
        pose = values.atPose3(X(c))
        interior.append([fy, u, v, k1, k2, 0.0, p1, p2, fx / fy - 1, s / fy])
        R.append(pose.rotation().matrix().T)
        t.append(-pose.rotation().matrix().T @ pose.translation())
    np.savez(sys.argv[2], interior=interior, R=R, t=t, seconds=seconds, iterations=iterations)


def triangulated(given, keep):
    """Where rays of the start's cameras pass each other closest (N, 2, 3); its distortion is left out."""
    A, b = np.zeros((*keep.shape[::2], 3, 3)) + 1e-9 * np.eye(3), np.zeros((*keep.shape[::2], 3))
    for c in range(keep.shape[1]):
        f, cx, cy, k1 = given["interior"][c, :4]
        xy = np.where(keep[:, c, :, None], given["xy_px"][:, c], [cx, cy])
        u = v = (xy - [cx, cy]) / f
        for _ in range(6):
            u = v / (1 + k1 * np.sum(u * u, axis=-1, keepdims=True))
        d = np.concatenate([u, np.ones_like(u[..., :1])], axis=-1) @ given["R"][c]
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        across = (np.eye(3) - d[..., :, None] * d[..., None, :]) * keep[:, c, :, None, None]
        A += across
        b += across @ (-given["R"][c].T @ given["t"][c])
    return np.linalg.solve(A, b[..., None])[..., 0]


def trimmed(given, values, keep):
    """Image points within 6 sigma, of ends with two rays."""
    good = keep.copy()
    for c in range(keep.shape[1]):
        camera = gtsam.PinholeCameraCal3DS2(values.atPose3(X(c)), values.atCal3DS2(K(c)))
        for n, e in np.argwhere(keep[:, c]):
            try:
                v = given["xy_px"][n, c, e] - camera.project(values.atPoint3(P(2 * n + e)))
                good[n, c, e] = np.abs(v).max() < 6 * float(given["sigma"])
            except RuntimeError:  # behind the camera
                good[n, c, e] = False
    return good & (good.sum(axis=1, keepdims=True) >= 2)


if __name__ == "__main__":
    main()
