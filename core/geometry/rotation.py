"""Rotations: Rodrigues vectors and matrices about the coordinate axes. Radians, right-handed."""

import numpy as np


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Rotation matrices (…, 3, 3) of Rodrigues vectors (…, 3) [rad]."""
    v = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    K = cross_matrix(v)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    c = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + s * K + c * (K @ K)


def vector_from_rotation(R: np.ndarray) -> np.ndarray:
    """Rodrigues vector (3,) [rad] of one rotation matrix (3, 3); the angle lies in [0, π]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(np.asarray(R, dtype=np.float64)).as_rotvec()


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]× (…, 3, 3) so that [v]× w = v × w."""
    v = np.asarray(v, dtype=np.float64)
    zero = np.zeros(v.shape[:-1])
    rows = [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero]
    return np.stack(rows, axis=-1).reshape(*v.shape[:-1], 3, 3)


def axis_rotation(axis: str, angle: np.ndarray | float) -> np.ndarray:
    """Rotation matrices (…, 3, 3) about a coordinate axis "x", "y" or "z" by `angle` (…) [rad]."""
    a = np.asarray(angle, dtype=np.float64)
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    R = np.zeros((*a.shape, 3, 3))
    R[..., i, i] = 1.0
    R[..., j, j] = R[..., k, k] = np.cos(a)
    R[..., k, j] = np.sin(a)
    R[..., j, k] = -np.sin(a)
    return R
