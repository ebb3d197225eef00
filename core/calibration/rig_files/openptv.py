"""OpenPTV's .ori and .addpar (the ETH's particle tracking software), with the image size from ptv.par next to them.

.ori: X0 Y0 Z0 [mm] / omega phi kappa / the rotation Rx(omega) Ry(phi) Rz(kappa), its columns the camera's axes in the world / xh yh [mm] /
camera constant [mm] / glass vector. .addpar: k1 k2 k3 p1 p2 scx she. The camera looks along −z with y up:

    d = Rᵀ (X − X0) ,   x = −c d_x / d_z + xh ,   y = −c d_y / d_z + yh                                  (1)
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 x²) + 2 p2 x y ,  y' = … + p2 (r² + 2 y²) + 2 p1 x y   (2)   about the sensor's middle
    x'' = scx x' − sin(she) y' ,   y'' = cos(she) y' ,   pixel = (x'' / s + W/2 − 1/2 , H/2 − y'' / s − 1/2)    (3)

Distorting about the sensor's middle, not the principal point, is another model: cameras are fitted over the image (`refit`).
"""

from pathlib import Path

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...geometry.camera import Camera, camera_of, exterior_derivatives, image_with_derivatives
from ...geometry.rig import Rig
from ...geometry.rotation import axis_rotation, rotation_from_vector
from .reading import fitted, make_camera, numbers, text_of, turned

TO_OPENCV = np.diag([1.0, -1.0, -1.0])
PIXEL_MM = 0.01  # of a file that we write: only products with it matter


def image(p: np.ndarray, xyz: np.ndarray, size_px: tuple[int, int], pixel_mm: tuple[float, float]) -> np.ndarray:
    """Pixels (M, 2) of points (M, 3) in the camera's frame (x right, y down, z forward), p = xh yh c k1 k2 k3 p1 p2 scx she."""
    xh, yh, c, k1, k2, k3, p1, p2, scx, she = p
    x, y = c * xyz[:, 0] / xyz[:, 2] + xh, -c * xyz[:, 1] / xyz[:, 2] + yh  # (1)
    r2 = x * x + y * y
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * L + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y  # (2)
    yd = y * L + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    u, v = scx * xd - np.sin(she) * yd, np.cos(she) * yd
    return np.stack([u / pixel_mm[0] + size_px[0] / 2 - 0.5, size_px[1] / 2 - v / pixel_mm[1] - 0.5], axis=-1)  # (3)


def read(path: Path) -> Rig:
    """Read all .ori files of a folder (or of the folder of one), each with its .addpar.

    Raises:
        InputError: a file is missing or damaged, or the cameras look into water.
    """
    folder = path if path.is_dir() else path.parent
    size, pixel_mm = _parameters(folder / "ptv.par")
    files = sorted(folder.glob("*.ori"))
    if not files:
        raise InputError(f"{folder} has no .ori file; choose the folder of OpenPTV's calibration.")
    return Rig(cameras=tuple(_camera(file, size, pixel_mm) for file in files))


def _parameters(path: Path) -> tuple[tuple[int, int], tuple[float, float]]:
    """Image size and pixel size from ptv.par; cameras that look through glass into water are refused."""
    lines = [line.strip() for line in text_of(path).splitlines() if line.strip()]
    try:
        rest = 1 + 2 * int(lines[0]) + 3
        width, height, px, py = (float(v) for v in lines[rest : rest + 4])
        indices = [float(v) for v in lines[rest + 5 : rest + 8]]
        size_px = int(width), int(height)
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path} is damaged: it needs the image's size, the pixel's size and the media of all cameras.") from error
    if len(indices) == 3 and max(indices) > 1.001:
        raise InputError(
            f"The cameras of {path} look through glass or into water (refractive index {max(indices)}); only air is supported."
        )
    return size_px, (px, py)


def _camera(file: Path, size: tuple[int, int], pixel_mm: tuple[float, float]) -> Camera:
    values = numbers(text_of(file).split()[:18], (18,), f"The orientation in {file}")
    extra = file.with_suffix(".addpar")
    p = numbers(text_of(extra).split()[:7], (7,), f"The parameters in {extra}")
    R = TO_OPENCV @ _rotation(*values[3:6]).T  # as OpenPTV does, which does not read the matrix
    k1, k2, k3, p1, p2, scx, she = p
    parameters = np.array([values[15], values[16], values[17], k1, k2, k3, p1, p2, scx, she])
    f, cx, cy = values[17] / pixel_mm[1], values[15] / pixel_mm[0] + size[0] / 2 - 0.5, size[1] / 2 - values[16] / pixel_mm[1] - 0.5
    c = values[17]
    if c <= 0:
        raise InputError(f"The camera constant in {file} is {c:g} mm; the file is damaged.")
    start = np.array([f, cx, cy, k1 * c**2, k2 * c**4, k3 * c**6, -p2 * c, p1 * c, scx * pixel_mm[1] / pixel_mm[0] - 1, 0.0])
    name = file.name.split(".")[0]
    if scx <= 0:
        raise InputError(f"The scale of x in {extra} is {scx:g}; the file is damaged.")
    rays = _rays(parameters, size, pixel_mm)
    ours = camera_of(name, size, start, np.eye(3), np.zeros(3))
    try:
        with np.errstate(all="ignore"):
            interior, turn = _fit_ours(ours, rays, image(parameters, rays, size, pixel_mm), start)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(f"No camera agrees with the parameters in {extra}; the file is damaged.") from error
    if not np.isfinite(interior).all():
        raise InputError(f"No camera agrees with the parameters in {extra}; the file is damaged.")
    R = turn @ R
    fitted_camera = camera_of(name, size, interior, np.eye(3), np.zeros(3))
    t = -R @ (values[:3] / 1000)
    return make_camera(name, size, fitted_camera.matrix, fitted_camera.distortions, R, t, fitted_camera.affinity)


def _rotation(omega: float, phi: float, kappa: float) -> np.ndarray:
    """The matrix (3, 3) of the angles [rad] of an .ori file."""
    return axis_rotation("x", omega) @ axis_rotation("y", phi) @ axis_rotation("z", kappa)


def _rays(p: np.ndarray, size: tuple[int, int], pixel_mm: tuple[float, float]) -> np.ndarray:
    """Points (M, 3) at z = 1 whose images fill the frame."""
    half = np.array([size[0] * pixel_mm[0], size[1] * pixel_mm[1]]) / 2 / p[2] * 1.02
    x, y = np.meshgrid(np.linspace(-half[0], half[0], 30), np.linspace(-half[1], half[1], 30))
    return np.stack([x.ravel() - p[0] / p[2], y.ravel() + p[1] / p[2], np.ones(x.size)], axis=-1)


def _fit_ours(camera: Camera, rays: np.ndarray, xy_px: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interior unknowns (10,) and a turn with which our model reproduces these pixels, by Gauss–Newton with the camera's derivatives."""
    interior, turn = start.copy(), np.eye(3)
    for _ in range(12):
        points = rays @ turn.T
        xy, J, G = image_with_derivatives(interior, points)
        A = np.concatenate([J, exterior_derivatives(G, points)[..., :3]], axis=-1).reshape(-1, 13)
        if not np.isfinite(A).all():
            raise np.linalg.LinAlgError("no finite derivatives")
        scale = np.linalg.norm(A, axis=0)
        step = np.linalg.lstsq(A / scale, (xy_px - xy).ravel(), rcond=1e-13)[0] / scale
        interior, turn = interior + step[:10], rotation_from_vector(step[10:]) @ turn
    return interior, turn


def write(folder: Path, rig: Rig) -> list[Path]:
    """Write NAME.ori, NAME.addpar of every camera and ptv.par into a folder.

    Raises:
        InputError: the cameras have different sizes, which ptv.par cannot say, or a name that no file may have.
    """
    names = [camera.name.casefold() for camera in rig.cameras]
    unfit = next((c.name for c in rig.cameras if not bounded.fits_file_names(c.name) or names.count(c.name.casefold()) > 1), None)
    if unfit is not None:
        raise InputError(f"OpenPTV's files are named after the cameras, and “{unfit}” is no name of a file of its own; rename that camera.")
    sizes = {camera.size_px for camera in rig.cameras}
    if len(sizes) > 1:
        raise InputError("OpenPTV needs cameras of one image size; export them one by one.")
    paths = []
    for camera in rig.cameras:
        p, posed = _fitted(camera)
        R = (TO_OPENCV @ posed.R_cam_world).T
        omega, phi, kappa = np.arctan2(-R[1, 2], R[2, 2]), np.arcsin(np.clip(R[0, 2], -1, 1)), np.arctan2(-R[0, 1], R[0, 0])
        R = _rotation(omega, phi, kappa)
        blocks = [posed.centre_m * 1000, np.array([omega, phi, kappa]), None, *R, None, p[:2], p[2:3], None, np.array([0.0, 0.0, 0.0001])]
        lines = ["" if b is None else " ".join(repr(float(v)) for v in b) for b in blocks]
        paths += [folder / f"{camera.name}.ori", folder / f"{camera.name}.addpar"]
        store.write_text(paths[-2], "\n".join(lines) + "\n")
        store.write_text(paths[-1], " ".join(repr(float(v)) for v in p[3:]) + "\n")
    w, h = rig.cameras[0].size_px
    entries = [line for camera in rig.cameras for line in (f"img/{camera.name}.", f"cal/{camera.name}")]
    par = [len(rig.cameras), *entries, 1, 0, 1, w, h, PIXEL_MM, PIXEL_MM, 0, 1.0, 1.0, 1.0, 0.0]
    paths.append(folder / "ptv.par")
    store.write_text(paths[-1], "\n".join(map(str, par)) + "\n")
    return paths


def _fitted(camera: Camera) -> tuple[np.ndarray, Camera]:
    """Parameters (10,) of `image` with scx = 1, she = 0, and the camera rotated slightly to fit."""
    w, h = camera.size_px
    c = float(camera.matrix[1, 1]) * PIXEL_MM
    k1, k2, p1, p2, k3 = camera.distortions
    xh, yh = (camera.matrix[0, 2] + 0.5 - w / 2) * PIXEL_MM, -(camera.matrix[1, 2] + 0.5 - h / 2) * PIXEL_MM
    start = np.array([xh, yh, c, k1 / c**2, k2 / c**4, k3 / c**6, p2 / c, -p1 / c, 1.0])
    scale = np.array([PIXEL_MM, PIXEL_MM, PIXEL_MM, 1e-3 / c**2, 1e-3 / c**4, 1e-3 / c**6, 1e-4 / c, 1e-4 / c, 1e-4])
    p, turn, _ = fitted(camera, lambda q, rays: image(np.append(q, 0.0), rays, (w, h), (PIXEL_MM, PIXEL_MM)), start, scale)
    return np.append(p, 0.0), turned(camera, turn)
