"""`tricap check rig.toml`: cameras that no calibration should have given, and what the calibration said of itself."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.rig import Rig, read_rig
from .findings import Checked, Finding, doubtful, wrong

FOCAL = (0.4, 12.0)  # of the image's longer side: 103° and 5° of view
OFF_CENTRE = 0.2  # of the image's longer side
FAR_APART_M = 100.0
SAME_PLACE = 0.005  # of the longest base
SIGMA0_PX = 1.0


def check_rig(path: Path) -> Checked:
    """Everything that can be said of a rig without footage."""
    try:
        rig = read_rig(path)
    except InputError as error:
        return Checked(subject=str(path), kind="rig", findings=(wrong("input", str(error)),), figures={})
    found = [*geometry_findings(rig), *_own_word(rig)]
    if len(rig.cameras) < 2:
        found.append(wrong("one camera", f"{path.name} has one camera only; depth needs two.", "Calibrate all cameras together."))
    figures = {"cameras": [c.name for c in rig.cameras], "bases_m": _bases(rig.cameras), "metadata": dict(rig.metadata)}
    return Checked(subject=str(path), kind="rig", findings=tuple(found), figures=figures)


def geometry_findings(rig: Rig) -> list[Finding]:
    """Cameras with impossible or doubtful interiors, at one place, or that look at nothing together."""
    found = [finding for camera in rig.cameras for finding in _interior(camera)]
    if len(rig.cameras) > 1:
        longest = max(_bases(rig.cameras).values())
        for pair, base in _bases(rig.cameras).items():
            if base <= SAME_PLACE * longest or longest == 0:
                found.append(
                    wrong(
                        "same place",
                        f"The cameras {pair} stand at the same place; depth needs a distance between them.",
                        "Calibrate again, or take one of them out.",
                        base_m=base,
                    )
                )
        found += unit_findings(rig)
        if longest > 0 and not _look_together(rig.cameras, longest):
            found.append(
                wrong(
                    "no common view",
                    "No place in space is seen by two of the rig's cameras.",
                    "Is the rig in metres, and are its rotations from the world to the camera?",
                )
            )
    return found


def unit_findings(rig: Rig) -> list[Finding]:
    """Cameras that stand further apart than any hall is long: their places are in another unit than it says."""
    longest = max(_bases(rig.cameras).values(), default=0.0)
    if longest < FAR_APART_M:
        return []
    said = f"The cameras stand up to {longest:.0f} m apart: rig.toml seems to be in millimetres or centimetres, not in metres."
    return [wrong("unit", said, 'Write its unit, such as unit = "mm", under [metadata] of rig.toml.', base_m=longest)]


def _interior(camera: Camera) -> list[Finding]:
    side = max(camera.size_px)
    focal, centre = camera.focal_px / side, np.abs(camera.matrix[:2, 2] - (np.array(camera.size_px) - 1) / 2).max() / side
    said = []
    if not FOCAL[0] < focal < FOCAL[1]:
        said.append(f"a focal length of {camera.focal_px:.0f} px, {focal:.2g} times its image's width")
    if centre > OFF_CENTRE:
        said.append(f"a principal point {centre * side:.0f} px off the image's middle")
    if _folds(camera):
        said.append("a distortion that folds the image over before its corners")
    return (
        [
            doubtful(
                "odd camera",
                f"Camera {camera.name} has {' and '.join(said)}.",
                "Was it calibrated in the footage's resolution, not cropped or scaled since? Calibrate again.",
                focal_px=camera.focal_px,
                off_centre_px=float(centre * side),
            )
        ]
        if said
        else []
    )


def _folds(camera: Camera) -> bool:
    """Whether the radial distortion stops growing outwards inside the image:  d/dr (r L(r)) ≤ 0."""
    k1, k2, _, _, k3 = camera.distortions
    w, h = camera.size_px
    corners = np.abs(np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]) - camera.matrix[:2, 2]) / np.diag(camera.matrix)[:2]
    reached, want = 0.0, float(np.linalg.norm(corners, axis=1).max())
    for r in np.linspace(0, 2 * want, 400):
        if 1 + 3 * k1 * r**2 + 5 * k2 * r**4 + 7 * k3 * r**6 <= 0:
            return reached < want
        reached = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
        if reached >= want:
            return False
    return reached < want


def _bases(cameras: Sequence[Camera]) -> dict[str, float]:
    return {f"{a.name}-{b.name}": float(np.linalg.norm(a.centre_m - b.centre_m)) for i, a in enumerate(cameras) for b in cameras[i + 1 :]}


def _look_together(cameras: Sequence[Camera], base_m: float) -> bool:
    """Whether some place before one camera, at any depth that could be meant, is inside another camera's image."""
    for a in cameras:
        w, h = a.size_px
        xy = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 9)), axis=-1).reshape(-1, 1, 2)
        points = a.points_at_depth(xy, np.broadcast_to(np.geomspace(0.3, 100, 24) * base_m, (len(xy), 24)))
        if any(b.sees(b.project(points)).any() for b in cameras if b is not a):
            return True
    return False


def _own_word(rig: Rig) -> list[Finding]:
    """What the calibration wrote about itself."""
    found = []
    sigma0, error = rig.metadata.get("sigma0_px"), rig.metadata.get("predicted_error_m")
    verdict = rig.metadata.get("verdict")
    if isinstance(verdict, str) and verdict.startswith("Poor"):
        found.append(
            doubtful(
                "poor calibration",
                f"The calibration said of itself: {verdict}",
                "Calibrate again; `tricap calibrate --report` says what to do better.",
                predicted_error_m=error,
            )
        )
    if isinstance(sigma0, float) and sigma0 > SIGMA0_PX:
        found.append(
            doubtful(
                "poor calibration",
                f"The calibration's residuals are {sigma0:.1f} px (sigma0).",
                "Were the cameras in step and the targets in focus? Calibrate again.",
                sigma0_px=sigma0,
            )
        )
    return found
