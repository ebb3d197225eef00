"""An empty Blender file for every test of the scene, and a small run's results written with core's own writers."""

import importlib.util
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.motion import BodyMotion
from tricap.core.body.shape import BodyShape, default_shape, write_body
from tricap.core.body.skeleton import joint_positions
from tricap.core.body.skin.contour_skin import body_skin
from tricap.core.foundation import store
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, write_rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.motion.formats.ply import write_cloud, write_mesh
from tricap.core.motion.tables import write_joints, write_motion

from .walking import walking_out, walking_person, walking_skin  # noqa: F401  fixtures

if importlib.util.find_spec("bpy"):
    import bpy  # noqa: F401  Blender's own modules, such as addon_utils, are found only after it

SIZE = (192, 144)
FRAMES = range(2, 8)
FPS = 29.97
TAKE = """format = "tricap-take"
version = 1
fps = {fps}
interlaced = "odd"
frames = [{start}, {stop}]
views = [ {views} ]
[body]
model = "arm.R"
"""


def with_small_texture(take: Path, more: str = "") -> Path:
    """A take whose skin gets a small texture: the usual one takes as long as all else of a run of a few frames. `more` settings."""
    with (take / "take.toml").open("a", encoding="utf-8") as file:
        file.write(f"[settings.skin]\ntexture_px = 64\n{more}")
    return take


class NeedsBlender(pytest.Module):
    """A module of tests that is skipped, and says why, in a Python without bpy."""

    def collect(self) -> list[pytest.Item]:
        """Nothing."""
        pytest.skip("bpy is not installed for this Python", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
    """Modules of this folder import bpy; without it they are not imported."""
    return NeedsBlender.from_parent(parent, path=module_path) if importlib.util.find_spec("bpy") is None else None


@pytest.fixture(autouse=True)
def no_mappings_of_other_tests() -> None:
    """The extension finds the mapping of a rig again that was used last, also in another test."""
    shutil.rmtree(
        Path(os.environ["BLENDER_USER_RESOURCES"]) / "extensions" / ".user" / "user_default" / "tricap" / "mappings", ignore_errors=True
    )


@pytest.fixture
def empty() -> Iterator[ModuleType]:
    """bpy with an empty file open."""
    bpy = pytest.importorskip("bpy")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    yield bpy
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def small_rig() -> Rig:
    """Three cameras in a row that look along +y at an arm near the origin; distorted, principal points off the centre."""
    cameras = []
    for name, x in (("L", -0.4), ("C", 0.0), ("R", 0.4)):
        matrix = np.array([[390.0, 0, 97.3 + 10 * x], [0, 390.0, 68.9], [0, 0, 1]])
        R = rotation_from_vector(np.array([0.0, 0.15 * x / 0.4, 0.0])) @ rotation_from_vector(np.array([np.pi / 2, 0, 0]))
        centre = np.array([x - 0.2, -2.2, 0.0])
        cameras.append(
            Camera(
                name=name,
                size_px=SIZE,
                matrix=matrix,
                distortions=np.array([-0.12, 0.05, 6e-4, -4e-4, 0.01]),
                R_cam_world=R,
                t_cam_world_m=-R @ centre,
            )
        )
    return Rig(cameras=tuple(cameras), metadata={"floor": True})


def arm() -> tuple[BodyShape, np.ndarray, np.ndarray]:
    """The default right arm, a motion (T, D) [rad, m] through most of its range, and its sigmas."""
    shape = default_shape(read_model("arm.R"))
    phase = np.linspace(0, 1, len(FRAMES))[:, None]
    first = np.array([0.05, 0.02, 0.1, -0.4, -1.1, -0.5, 0.1, -1.2])
    last = np.array([-0.02, 0.12, 0.2, 1.9, 0.9, 0.9, 2.4, 1.1])
    motion = first + (last - first) * phase
    return shape, motion, np.linspace(0.001, 0.01, motion.size).reshape(motion.shape)


@dataclass
class SmallRun:
    """An OUT folder and what is in it."""

    out: Path
    take: Path
    rig: Rig
    shape: BodyShape
    motion: np.ndarray
    sigma: np.ndarray
    joints_m: dict[str, np.ndarray]


@pytest.fixture
def small_run(tmp_path: Path) -> SmallRun:
    """A take of eight images a view, of which frames 2…7 were run, and the results of that run."""
    return make_small_run(tmp_path)


def make_small_run(folder: Path) -> SmallRun:
    """The same in a folder."""
    take, out = folder / "swing", folder / "out"
    rig = small_rig()
    write_take(take, rig)
    shape, motion, sigma = arm()
    joints = joint_positions(shape.skeleton, shape.lengths_m, motion)
    store.write_json(out / "run.json", {"format": "tricap-run", "version": 1, "take": str(take)})
    write_result(out, shape, np.array(FRAMES), motion, sigma)
    for frame, posture in zip(FRAMES, motion):
        skin = body_skin(shape, posture)
        write_mesh(out / "skin" / f"{frame:04d}.ply", skin.vertices_m, skin.faces)
    random = np.random.default_rng(7)
    for i, frame in enumerate(FRAMES):
        n = 40 + i
        xyz = joints["elbow.R"][i] + random.normal(0, 0.03, (n, 3))
        write_cloud(
            out / "clouds" / f"{frame:04d}.ply",
            xyz_m=xyz,
            sigma_m=np.full(n, 1e-3),
            normals=np.tile([0.0, -1.0, 0.0], (n, 1)),
            intensity=random.uniform(0, 255, n),
        )
    xyz = np.stack([joints["elbow.R"], joints["wrist.R"]], axis=1)
    xyz[0, 1] = np.nan
    store.save(
        out / "trajectories.npz",
        dict(
            frames=np.array(FRAMES),
            time_s=np.array(FRAMES) / FPS,
            xyz_m=xyz,
            velocity_m_s=np.gradient(xyz, axis=0) * FPS,
            acceleration_m_s2=np.zeros_like(xyz),
            sigma_m=np.full(xyz.shape[:2], 1e-3),
            status=np.zeros(xyz.shape[:2], dtype=np.int8),
        ),
        {},
    )
    return SmallRun(out=out, take=take, rig=rig, shape=shape, motion=motion, sigma=sigma, joints_m=joints)


def write_result(out: Path, shape: BodyShape, frames: np.ndarray, motion: np.ndarray, sigma: np.ndarray) -> None:
    """body.toml, joints.csv and motion.csv of a body that moves as `motion` (T, D) says."""
    joints = joint_positions(shape.skeleton, shape.lengths_m, motion)
    write_body(out / "body.toml", shape)
    fit = BodyMotion(
        frames=frames,
        time_s=frames / FPS,
        dof_names=shape.skeleton.dof_names,
        values=motion,
        covariance=np.eye(motion.shape[1]) * sigma[..., None] ** 2,
        joint_names=tuple(joints),
        joints_m=np.stack(list(joints.values()), axis=1),
        joint_sigma_m=np.full((len(frames), len(joints)), 1e-3),
        joint_frame_sigma_m=np.full((len(frames), len(joints)), 1e-3),
        known=(("seen",) * len(joints),) * len(frames),
        status=("fitted",) * len(frames),
        sigma0=np.ones(len(frames)),
    )
    write_joints(out / "joints.csv", fit)
    write_motion(out / "motion.csv", fit, shape.skeleton)


@pytest.fixture
def full_run(tmp_path: Path) -> Path:
    """The results of a run of one frame, numbered 0: a whole body that lowers its right shoulder by 30°."""
    shape = default_shape(read_model("full"))
    values = np.zeros((1, len(shape.skeleton.dof_names)))
    values[0, shape.skeleton.dof_names.index("clavicle.R depression")] = np.radians(-30.0)
    write_result(tmp_path / "full", shape, np.zeros(1, dtype=np.int64), values, np.full(values.shape, 1e-3))
    return tmp_path / "full"


def write_take(folder: Path, rig: Rig) -> None:
    """take.toml, rig.toml and noise for footage, whose brightness tells the frame."""
    folder.mkdir(parents=True)
    random = np.random.default_rng(0)
    for camera in rig.cameras:
        (folder / camera.name).mkdir()
        for frame in range(FRAMES.stop):
            image = random.integers(0, 30, SIZE[::-1]) + 20 * frame
            cv2.imwrite(str(folder / camera.name / f"{frame:04d}.png"), image.astype(np.uint8))
    write_rig(folder / "rig.toml", rig)
    views = ", ".join(f'{{ name = "{c.name}", images = "{c.name}/*.png" }}' for c in rig.cameras)
    (folder / "take.toml").write_text(TAKE.format(fps=FPS, start=FRAMES.start, stop=FRAMES.stop, views=views), encoding="utf-8")
