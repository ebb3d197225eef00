"""Small scenes with exact truth: an analytic texture on a plane or a cylinder, seen by cameras along exact rays."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, write_rig
from tricap.core.results.folder import Results
from tricap.core.run import take_run
from tricap.core.surface.measure import MeasuredFrame, measure_frames
from tricap.core.surface.starts import MeasureSettings
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take
from tricap.core.tracking.lost_points import Guide
from tricap.core.tracking.step import TrackedFrame
from tricap.core.tracking.track import TrackingRules, track_frames

WIDTH, HEIGHT, FOCAL_PX, DEPTH_M = 200, 150, 600.0, 2.16  # 3.6 mm a pixel


@dataclass(frozen=True, kw_only=True)
class Body:
    """A plane (radius None) or a cylinder about its own y axis, textured in its own axes, placed in the world by R, t."""

    radius_m: float | None = None
    half_m: tuple[float, float] = (9.0, 9.0)  # how far it reaches in its own x (of a plane) and y
    R: np.ndarray = field(default_factory=lambda: np.eye(3))
    t: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, DEPTH_M]))
    seed: int = 0
    shortest_m: float = 0.018  # 5 px
    contrast: float = 25.0

    def texture(self, own_m: np.ndarray) -> np.ndarray:
        """Grey values (N,) at points (N, 3) of its own axes: 60 waves of the wavelengths from `shortest_m` to four times that."""
        random = np.random.default_rng(self.seed)
        k = random.standard_normal((60, 3))
        k *= (2 * np.pi / self.shortest_m / np.exp(random.uniform(0, np.log(4), 60)) / np.linalg.norm(k, axis=1))[:, None]
        phase = random.uniform(0, 2 * np.pi, 60)
        return 127 + self.contrast * np.sqrt(2 / 60) * np.cos(own_m @ k.T + phase).sum(axis=1)

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays (N, 3) from a point meet it first: the parameter (N,), inf where they miss, and the points in its own axes."""
        o, d = self.R.T @ (origin - self.t), rays @ self.R
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.radius_m is None:
                s = -o[2] / d[:, 2]
            else:
                a, b, c = d[:, 0] ** 2 + d[:, 2] ** 2, o[0] * d[:, 0] + o[2] * d[:, 2], o[0] ** 2 + o[2] ** 2 - self.radius_m**2
                s = (-b - np.sqrt(b * b - a * c)) / a
            own = o + s[:, None] * d
            inside = (s > 0) & (np.abs(own[:, 1]) <= self.half_m[1]) & ((self.radius_m is not None) | (np.abs(own[:, 0]) <= self.half_m[0]))
        return np.where(inside, s, np.inf), np.where(inside[:, None], own, 0.0)

    def distance_m(self, xyz_m: np.ndarray) -> np.ndarray:
        """Signed distance (N,) of world points: positive before the surface (outside a cylinder)."""
        own = (xyz_m - self.t) @ self.R
        return -own[:, 2] if self.radius_m is None else np.hypot(own[:, 0], own[:, 2]) - self.radius_m

    def moved(self, rotation: np.ndarray, shift_m: Sequence[float]) -> "Body":
        """The body after a turn about its own origin and a shift."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Body(**values | dict(R=rotation @ self.R, t=self.t + np.asarray(shift_m)))


def three_cameras(
    *, width: int = WIDTH, height: int = HEIGHT, focal: float = FOCAL_PX, base_m: float = 0.35, distorted: bool = True
) -> Rig:
    """L, C and R in a row about the origin of the world, looking along +z at the point (0, 0, DEPTH_M)."""
    cameras = []
    for name, x in (("L", -base_m), ("C", 0.0), ("R", base_m)):
        ahead = np.array([-x, 0.0, DEPTH_M]) / np.hypot(x, DEPTH_M)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        R = np.stack([right, np.cross(ahead, right), ahead])
        matrix = [[focal, 0, (width - 1) / 2 + 3 * np.sign(x)], [0, focal, (height - 1) / 2 - 2 * np.sign(x)], [0, 0, 1]]
        cameras.append(
            Camera(name=name, size_px=(width, height), matrix=np.array(matrix),
                   distortions=np.array([-0.1, 0.05, 4e-4, -3e-4, 0.0]) if distorted else np.zeros(5),
                   R_cam_world=R, t_cam_world_m=-R @ np.array([x, 0.0, 0.0]))
        )  # fmt: skip
    return Rig(cameras=tuple(cameras))


def render(camera: Camera, bodies: Sequence[Body], *, noise: float = 0.0, seed: int = 0, background: float = 90.0) -> np.ndarray:
    """The picture (h, w) float32 that a camera takes of bodies: the texture at the first point that each pixel's ray meets."""
    w, h = camera.size_px
    y, x = np.mgrid[0:h, 0:w].astype(float)
    rays = camera.rays(np.stack([x, y], axis=-1).reshape(-1, 2))
    nearest, grey = np.full(len(rays), np.inf), np.full(len(rays), background)
    for body in bodies:
        s, own = body.hit(camera.centre_m, rays)
        front = s < nearest
        grey[front], nearest[front] = body.texture(own[front]), s[front]
    random = np.random.default_rng([seed, sum(map(ord, camera.name))])
    return (grey.reshape(h, w) + noise * random.standard_normal((h, w))).astype(np.float32)


def write_take(
    folder: Path, rig: Rig, frames: Sequence[Sequence[Body]], *, noise: float = 1.0, more: str = "", interlaced: str = "none"
) -> Path:
    """A take whose frame t shows the bodies frames[t]; gives its folder. Of "both" fields the odd lines are exposed first."""
    per = 2 if interlaced == "both" else 1
    for i in range(len(frames) // per):
        for camera in rig.cameras:
            taken = [render(camera, frames[per * i + n], noise=noise, seed=per * i + n) for n in range(per)]
            picture = np.clip(np.rint(np.where(np.arange(len(taken[0]))[:, None] % 2, taken[-1], taken[0])), 0, 255).astype(np.uint8)
            path = folder / camera.name / f"{i:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    write_rig(folder / "rig.toml", rig)
    write_take_toml(folder, [c.name for c in rig.cameras], more=more, interlaced=interlaced)
    return folder


def write_take_toml(folder: Path, views: Sequence[str], *, more: str = "", interlaced: str = "none") -> None:
    """take.toml of views whose images lie in folders of their names; `more` is appended."""
    said = "".join(f"[[views]]\nname = {json.dumps(v)}\nimages = {json.dumps(v + '/*.png')}\n" for v in views)
    text = f'format = "tricap-take"\nversion = 1\nfps = 25.0\ninterlaced = "{interlaced}"\nrig = "rig.toml"\n{said}{more}\n'
    (folder / "take.toml").write_text(text, encoding="utf-8")


def measure(
    folder: Path, out: Path, overrides: Mapping[str, Any] | None = None, monitor: Monitor | None = None,
    frames: tuple[int, int] | None = None,
) -> list[MeasuredFrame]:  # fmt: skip
    """The measured surface of a take, or of these frames, in the order of time; checkpoints lie in `out`."""
    footage = open_take(read_take(folder))
    footage = footage if frames is None else take_run.only_frames(footage, frames)
    s = take_run.settings_of(footage.take.settings, overrides or {}, "take.toml")
    done = measure_frames(footage, MeasureSettings.of(s), Results(out), monitor or Monitor())
    return sorted(done, key=lambda m: m.frame)


def track(
    folder: Path, out: Path, measured: Sequence[MeasuredFrame], overrides: Mapping[str, Any] | None = None, monitor: Monitor | None = None,
    guide: Guide | None = None,
) -> list[TrackedFrame]:  # fmt: skip
    """The tracked points of a take that was measured."""
    footage = open_take(read_take(folder))
    s = take_run.settings_of(footage.take.settings, overrides or {}, "take.toml")
    limit_px = float(np.median([m.field.limit_px for m in measured]))
    rules = TrackingRules(
        matching=s["matching"], tracking=s["tracking"], enhance=s["enhance"], limit_px=limit_px, smoothed_px=measured[0].smoothed_px
    )
    return list(track_frames(footage, measured, rules, Results(out), monitor or Monitor(), guide))


@dataclass(frozen=True)
class Scenes:
    """The tools of this file, for tests."""

    Body: type[Body] = Body
    depth_m: float = DEPTH_M
    pixel_m: float = DEPTH_M / FOCAL_PX
    three_cameras: Callable[..., Rig] = staticmethod(three_cameras)
    render: Callable[..., np.ndarray] = staticmethod(render)
    write_take: Callable[..., Path] = staticmethod(write_take)
    write_take_toml: Callable[..., None] = staticmethod(write_take_toml)
    measure: Callable[..., list[MeasuredFrame]] = staticmethod(measure)
    track: Callable[..., list[TrackedFrame]] = staticmethod(track)


@pytest.fixture(scope="session")
def scenes() -> Scenes:
    """Bodies, cameras, pictures and takes with exact truth."""
    return Scenes()


@pytest.fixture(scope="session")
def plane_take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of a tilted plane that moves by 7 mm and turns by 1.5° a frame, to be measured coarsely, without a body; do not change
    it, copy it."""
    from tricap.core.geometry.rotation import rotation_from_vector

    plane = Body(half_m=(0.26, 0.2), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))
    frames = [[plane.moved(rotation_from_vector(np.array([0.0, 0.0, 0.026 * i])), [0.007 * i, -0.003 * i, 0.0])] for i in range(4)]
    more = '[body]\nmodel = "none"\n[settings.growing]\nspacing_px = 6\n'
    return write_take(tmp_path_factory.mktemp("plane"), three_cameras(), frames, more=more)


@pytest.fixture(scope="session")
def sixty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """18 frames of a swinging arm at 60 images per second, without noise; do not change it. Every second image is a take at 30."""
    from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

    folder = tmp_path_factory.mktemp("sixty") / "take"
    make_arm_take(folder, ArmTakeSettings(width_px=224, frames=18, fps=60.0, interlaced="none", swing_s=0.8, noise=0.0))
    return folder


@pytest.fixture
def at_thirty(sixty: Path, tmp_path: Path) -> Callable[[Mapping[str, Sequence[int]]], Path]:
    """A function that makes a take at 30 images per second, whose views show some of the images of `sixty`, by their numbers."""

    def made(shown: Mapping[str, Sequence[int]]) -> Path:
        folder = tmp_path / "take"
        folder.mkdir()
        (folder / "rig.toml").write_bytes((sixty / "rig.toml").read_bytes())
        text = (sixty / "take.toml").read_text(encoding="utf-8").replace("fps = 60.0", "fps = 30.0")
        (folder / "take.toml").write_text(text, encoding="utf-8")
        for view, numbers in shown.items():
            (folder / view).mkdir()
            for i, n in enumerate(numbers):
                (folder / view / f"{i:04d}.png").symlink_to(sixty / view / f"{n:04d}.png")
        return folder

    return made
