"""Rotations: Rodrigues vectors, matrices (…, 3, 3) and quaternions (…, 4), w x y z. Radians, right-handed."""

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


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of vectors (…, 3); a fifth of numpy.cross's time for few of them."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


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


EULER_MODES = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (…, 3) of length one; zero vectors stay zero."""
    v = np.asarray(vectors, dtype=np.float64)
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 1e-12)


def rotate(R: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """R (…, 3, 3) times vectors (…, 3)."""
    return np.einsum("...ij,...j->...i", R, vectors)


def transposed(R: np.ndarray) -> np.ndarray:
    """The inverse rotations."""
    return np.swapaxes(R, -1, -2)


def shortest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotations (…, 3, 3) that take the directions a (…, 3) to b (…, 3). Opposite directions are rotated about any normal."""
    a, b = np.broadcast_arrays(unit(a), unit(b))
    cosine = np.sum(a * b, axis=-1, keepdims=True)
    q = np.concatenate([1.0 + cosine, np.cross(a, b)], axis=-1)
    opposite = cosine[..., 0] < -1.0 + 1e-9
    if opposite.any():
        other = np.eye(3)[np.argmin(np.abs(a[opposite]), axis=-1)]
        q[opposite] = np.concatenate([np.zeros((opposite.sum(), 1)), np.cross(a[opposite], other)], axis=-1)
    return matrix_from_quaternion(q / np.linalg.norm(q, axis=-1, keepdims=True))


def about(axis: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Rotations (…, 3, 3) by `angle` (…) [rad] about the unit vectors `axis` (…, 3)."""
    axis, angle = np.asarray(axis, dtype=np.float64), np.asarray(angle, dtype=np.float64)
    axis = np.broadcast_to(axis, (*np.broadcast_shapes(axis.shape[:-1], angle.shape), 3))
    half = np.broadcast_to(angle, axis.shape[:-1])[..., None] / 2
    return matrix_from_quaternion(np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1))


def between(R0: np.ndarray, R1: np.ndarray, part: float | np.ndarray) -> np.ndarray:
    """The rotation at the fraction `part` (0…1) between R0 (…, 3, 3) and R1, along the shorter arc."""
    step = vector_from_matrix(transposed(R0) @ R1)
    return R0 @ matrix_from_vector(step * np.asarray(part)[..., None])


def matrix_from_quaternion(q: np.ndarray) -> np.ndarray:
    """Matrices (…, 3, 3) of unit quaternions (…, 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return np.stack(rows, axis=-1).reshape(*np.shape(w), 3, 3)


def quaternion_from_matrix(R: np.ndarray) -> np.ndarray:
    """Unit quaternions (…, 4) of matrices (…, 3, 3)."""
    from scipy.spatial.transform import Rotation

    R = np.asarray(R, dtype=np.float64)
    xyzw = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat()
    return np.roll(xyzw, 1, axis=-1).reshape(*R.shape[:-2], 4)


def vector_from_matrix(R: np.ndarray) -> np.ndarray:
    """Rodrigues vectors (…, 3) [rad] of matrices (…, 3, 3), angles 0…π."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(np.reshape(R, (-1, 3, 3))).as_rotvec().reshape(*np.shape(R)[:-2], 3)


def matrix_from_vector(v: np.ndarray) -> np.ndarray:
    """Matrices (…, 3, 3) of Rodrigues vectors (…, 3) [rad], which may be read-only (older scipy needs a copy)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.array(v, dtype=np.float64).reshape(-1, 3)).as_matrix().reshape(*np.shape(v)[:-1], 3, 3)


def angle_of(R: np.ndarray) -> np.ndarray:
    """Angles (…) [rad], 0…π, of rotations (…, 3, 3)."""
    return np.linalg.norm(vector_from_matrix(R), axis=-1)


def twist_about(R: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Angle (…) [rad], −π…π, of the part of R (…, 3, 3) that turns about the unit vector `axis` (…, 3) (swing–twist decomposition)."""
    q = quaternion_from_matrix(R)
    angle = 2.0 * np.arctan2(np.sum(q[..., 1:] * axis, axis=-1), q[..., 0])
    return (angle + np.pi) % (2 * np.pi) - np.pi


def continuous(q: np.ndarray) -> np.ndarray:
    """Quaternions (T, …, 4) with signs chosen so that none flips from one frame to the next."""
    q = np.array(q, dtype=np.float64)
    if len(q) > 1:
        flips = np.sum(q[1:] * q[:-1], axis=-1) < 0
        q[1:] *= np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)[..., None]
    return q


def euler_from_matrix(R: np.ndarray, mode: str) -> np.ndarray:
    """Angles (T, 3) about x, y, z [rad] in Blender's rotation mode, such as "XYZ" (x turns first), without jumps along T.

    Of the two triples that give the same rotation the one nearest to the frame before is taken, and whole turns are added.
    """
    R = np.asarray(R, dtype=np.float64)
    order = ["XYZ".index(letter) for letter in mode]
    angles = np.empty((len(R), 3))
    angles[:, order] = _first_to_last(R, order)
    other = angles.copy()
    first, middle, last = order
    other[:, [first, last]] += np.pi
    other[:, middle] = np.pi - other[:, middle]
    for t in range(1, len(R)):
        both = np.stack([angles[t], other[t]])
        both += 2 * np.pi * np.round((angles[t - 1] - both) / (2 * np.pi))
        angles[t] = both[np.argmin(np.abs(both - angles[t - 1]).sum(axis=1))]
    return angles


def _first_to_last(R: np.ndarray, order: list[int]) -> np.ndarray:
    """R = R_k(c) R_j(b) R_i(a) for the axes i, j, k of `order`; at the singularity c is 0."""
    i, j, k = order
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    b = np.arcsin(np.clip(-sign * R[:, k, i], -1.0, 1.0))
    level = np.abs(R[:, k, i]) < 1.0 - 1e-12
    a = np.where(level, np.arctan2(sign * R[:, k, j], R[:, k, k]), np.arctan2(-sign * R[:, j, k], R[:, j, j]))
    c = np.where(level, np.arctan2(sign * R[:, j, i], R[:, i, i]), 0.0)
    return np.stack([a, b, c], axis=-1)


def matrix_from_euler(angles: np.ndarray, mode: str) -> np.ndarray:
    """Matrices (…, 3, 3) of angles (…, 3) about x, y, z [rad]; the first letter of `mode` turns first (Blender)."""
    R = np.broadcast_to(np.eye(3), (*np.shape(angles)[:-1], 3, 3))
    for letter in mode:
        axis = "XYZ".index(letter)
        R = about(np.eye(3)[axis], np.asarray(angles)[..., axis]) @ R
    return R
