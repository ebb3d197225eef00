"""A recording with known truth: a person's right arm in a patterned sleeve swings in front of three cameras in a row.

The folder has a complete take (docs/formats.md: take.toml with clicks, rig.toml, L/ C/ R/) and truth.npz:

    vertices_m (T, V, 3) f4, triangles (F, 3) i4, textured (V,) bool (cloth), visible (T, ⌈V/8⌉) u1 packed bits: visible in all three
    cameras, joints_m (T, J, 3), joint_names (those of motion capture files), time_s (T,), and the values of the body model:
    dof_names, motion_values (T, D) rad and m, bone_names, lengths_m (B,), radii_m (M, 3), ball_bone (M,);
    settings (JSON of ArmTakeSettings)

all at the instants of the field that take.toml selects; the other field is exposed half a frame later.
"""

import io
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..body.metaballs import three_balls
from ..body.model_file import read_model
from ..body.shape import BodyShape
from ..body.skeleton import joint_positions
from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import from_table, knob, to_table
from ..geometry.camera import Camera
from ..geometry.rig import Rig, write_rig
from ..geometry.rotation import axis_rotation
from ..images.interlace import BOTH, INTERLACE, field_layout, frame_time_s
from ..images.sequence import IMAGE_ENDINGS
from ..take.writing import copy_aside, has_comments
from .figure import Part, arm_parts, joined, torso_parts, wall
from .film import Layer, Sensor, SolidNoise, digitize, expose, paint, solid_noise, visible_vertices
from .person import person
from .subject import Subject
from .truth import motion_capture_name, read_truth

STAGE = "sample recording"
ARM, PERSON = "arm", "person"
SHOULDER_M = np.array([-0.185, -0.010, 1.450])
LENGTHS_M = np.array([0.272, 0.248])  # upper arm, forearm
VISIBLE_RADII_M = np.array([[[0.053, 0.050], [0.047, 0.045], [0.043, 0.041]], [[0.044, 0.041], [0.039, 0.036], [0.032, 0.029]]])  # x, z
TARGET_M = np.array([-0.34, -0.06, 1.35])  # where the cameras look
WALL_Y_M = 1.20
SWING_S = 1.36  # there and back
IMAGE = r"\d{4,}\.(png|jpg)"  # name of one of the recording
VIEWS, LATE = ("L", "C", "R"), "R"
JOINTS = ("shoulder.R", "elbow.R", "wrist.R")
MARK = "synthetic arm"  # in rig.toml's metadata
SENSORS = dict(L=Sensor(gain=1.06, offset=-4.0), C=Sensor(), R=Sensor(gain=0.94, offset=7.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmTakeSettings:
    """The synthetic recording."""

    subject: str = knob(ARM, "Who is filmed: an arm of metaballs, or a whole person who is not made of metaballs.", choices=(ARM, PERSON))
    frames: int = knob(16, "Frames of the recording.", low=2, high=1000)
    fps: float = knob(25.0, "Frame rate.", unit="1/s", low=1.0, high=1000.0)
    width_px: int = knob(768, "Width of the pictures; the height is three quarters of it.", unit="px", low=96, high=4096)
    interlaced: str = knob("odd", "Lines that take.toml keeps; the others are exposed half a frame later.", choices=(*INTERLACE, BOTH))
    noise: float = knob(1.0, "Multiplies the sensors' noise.", low=0.0, high=20.0)
    texture: float = knob(1.0, "Multiplies the contrast of all textures; 0.2 is as weak as bare skin.", low=0.0, high=2.0)
    swing_s: float = knob(SWING_S, "Duration of a swing of the arm, or of a double step, there and back.", unit="s", low=0.2, high=1000.0)
    click_error_px: float = knob(4.0, "Largest error of the joint clicks, in x and in y.", unit="px", low=0.0, high=100.0)
    late_frames: float = knob(0.0, "Frame offset of view R relative to the others.", unit="frames", low=-100.0, high=100.0)
    seed: int = knob(1, "Seed of the random textures, noise and clicks.", low=0, high=2**31 - 1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Studio:
    """The constant parts of the recording."""

    settings: ArmTakeSettings
    rig: Rig
    subject: Subject
    noise: SolidNoise
    backdrops: tuple[Layer, ...]  # the wall in each camera


def make_arm_take(folder: Path, settings: ArmTakeSettings | None = None, monitor: Monitor | None = None) -> None:
    """Make the recording in `folder`: a take and truth.npz. The same settings give the same pictures and truth. About 15 s for
    16 frames.

    take.toml is written last: as long as it is missing, the recording is not complete.

    Raises:
        InputError: the folder has other content than a recording of this function, or cannot be written.
        Cancelled: the monitor was cancelled; the folder then has no take.
    """
    settings, monitor, folder = settings or ArmTakeSettings(), monitor or Monitor(), Path(folder)
    clear_recording(folder)
    studio = _studio(settings)
    write_rig(folder / "rig.toml", studio.rig)
    visible = []
    for frame in range(settings.frames):
        visible.append(_film_frame(folder, studio, frame, monitor))
    store.write_bytes(folder / "truth.npz", _truth(studio, np.concatenate(visible)))
    store.write_text(folder / "take.toml", _take_toml(settings, studio.subject, studio.rig))
    monitor.step(STAGE, 1, 1)


def is_arm_take(folder: Path, settings: ArmTakeSettings | None = None) -> bool:
    """True for a complete recording that `make_arm_take` made, with these settings if they are given."""
    if not (folder / "take.toml").is_file() or not _made_here(folder):
        return False
    return settings is None or read_truth(folder).settings == json.dumps(to_table(settings))


def _made_here(folder: Path) -> bool:
    """True when the rig of the folder bears our mark."""
    rig = folder / "rig.toml"
    return rig.exists() and MARK in bounded.text_of(rig, bounded.TOML_BYTES, errors="replace")


def _studio(settings: ArmTakeSettings) -> _Studio:
    (subject, rig), noise = _subject_and_rig(settings), solid_noise(settings.seed).scaled(settings.texture)
    backdrops = tuple(paint(camera, [subject.backdrop], noise) for camera in rig.cameras)
    return _Studio(settings=settings, rig=rig, subject=subject, noise=noise, backdrops=backdrops)


def _subject_and_rig(settings: ArmTakeSettings) -> tuple[Subject, Rig]:
    subject = person(settings.swing_s) if settings.subject == PERSON else arm(settings.swing_s)
    return subject, rig_for(subject, settings.width_px)


def arm(swing_s: float) -> Subject:
    """The right arm of a person whose torso sways with it."""
    shape = arm_shape()
    at_rest = arm_parts(shape, np.zeros(len(shape.skeleton.dof_names)))

    def parts(time_s: float) -> tuple[Part, ...]:
        motion = arm_motion(time_s, swing_s)
        return (*arm_parts(shape, motion, at_rest), *torso_parts(motion[:3]))

    return Subject(
        shape=shape,
        joints=JOINTS,
        motion=lambda time_s: arm_motion(time_s, swing_s),
        parts=parts,
        backdrop=wall(WALL_Y_M),
        target_m=TARGET_M,
        scale=1.0,
        is_metaballs=True,
    )


def arm_shape() -> BodyShape:
    """The person's true arm."""
    model = read_model("arm.R")
    balls = three_balls(np.array([0, 1]), LENGTHS_M, VISIBLE_RADII_M)
    return BodyShape(
        model=model.name,
        skeleton=model.skeleton,
        lengths_m=LENGTHS_M,
        metaballs=balls,
        length_sigma_m=np.zeros(2),
        radius_sigma_m=np.zeros((len(balls.weight), 3)),
    )


def arm_motion(time_s: np.ndarray | float, swing_s: float = SWING_S) -> np.ndarray:
    """True values (…, D) of the degrees of freedom [m, rad]: in swings of 1.36 s the wrist reaches 0.95 m/s."""
    time = np.asarray(time_s, dtype=np.float64)
    swing = 0.5 - 0.5 * np.cos(2 * np.pi * time / swing_s)  # 0 … 1 … 0
    late = 0.5 - 0.5 * np.cos(2 * np.pi * (time - 0.10) / swing_s)
    columns = {
        "shoulder.R x": SHOULDER_M[0] - 0.010 * swing,
        "shoulder.R y": SHOULDER_M[1] - 0.008 * late,
        "shoulder.R z": SHOULDER_M[2] + 0.012 * swing,
        "shoulder.R flexion": np.radians(14 + 18 * swing),
        "shoulder.R abduction": np.radians(-14 - 12 * late),
        "shoulder.R twist": np.radians(34 + 10 * late),
        "elbow.R flexion": np.radians(24 + 56 * swing),
        "elbow.R twist": np.radians(-10 + 20 * late),
    }
    return np.stack([columns[name] + 0 * time for name in arm_shape().skeleton.dof_names], axis=-1)


def arm_rig(width_px: int) -> Rig:
    """Three cameras in a row, 1.9 m before the arm and 0.35 m apart."""
    return _rig(width_px, TARGET_M, 1.0)


def rig_for(subject: Subject, width_px: int) -> Rig:
    """The cameras for a subject."""
    return _rig(width_px, subject.target_m, subject.scale)


def _rig(width_px: int, target_m: np.ndarray, size: float) -> Rig:
    """Three cameras in a row, turned inwards to a target (3,), each with a distortion of its own; `size` multiplies their distances."""
    scale = width_px / 768
    cameras = []
    for name, x, y, z, roll, focal, cx, cy, k1, p1, p2 in (
        ("L", -0.352, 0.035, 0.012, 0.012, 1503.2, 386.1, 284.9, -0.112, 5e-4, -3e-4),
        ("C", 0.0, 0.0, 0.025, -0.006, 1498.7, 381.7, 290.3, -0.118, 4e-4, -4e-4),
        ("R", 0.345, 0.028, 0.004, 0.009, 1507.9, 384.6, 282.2, -0.107, 6e-4, -2e-4),
    ):
        centre = target_m + size * np.array([x, y - 1.9, z])
        ahead = (target_m - centre) / np.linalg.norm(target_m - centre)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R = axis_rotation("z", roll) @ np.stack([right, np.cross(ahead, right), ahead])
        matrix = np.array([[focal * scale, 0, (cx + 0.5) * scale - 0.5], [0, focal * scale, (cy + 0.5) * scale - 0.5], [0, 0, 1]])
        cameras.append(
            Camera(
                name=name,
                size_px=(width_px, width_px * 3 // 4),
                matrix=matrix,
                distortions=np.array([k1, 0.05, p1, p2, 0.0]),
                R_cam_world=R,
                t_cam_world_m=-R @ centre,
            )
        )
    return Rig(cameras=tuple(cameras), metadata=dict(source=MARK))


def clear_recording(folder: Path) -> None:
    """Clear the folder for a new recording. Only a synthetic recording is removed; rig.toml, which marks it, stays until it is replaced. A
    take.toml with changes is copied to take.toml.bak before.

    Raises:
        InputError: the folder has other content, or images among those of the recording; then nothing is removed.
    """
    try:
        if folder.exists() and not _made_here(folder) and any(folder.iterdir()):
            raise InputError(f"{folder} is not empty and holds no sample recording; choose a new folder for it.")
        made, frames = [path for view in VIEWS for path in _images(folder / view)], _frames_of(folder)
        if others := [path for path in made if not (re.fullmatch(IMAGE, path.name) and int(path.stem) < frames)]:
            raise InputError(f"{others[0]} is not of the recording in {folder}, and would become part of it; move it elsewhere.")
        _keep_changes(folder)
        for path in (*made, folder / "take.toml", folder / "truth.npz"):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make room for a recording in {folder}: {error.strerror or error}; choose another folder.") from error


def _images(folder: Path) -> list[Path]:
    """All files of a folder of images that a take would read."""
    return [path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGE_ENDINGS] if folder.is_dir() else []


def _frames_of(folder: Path) -> float:
    """The number of images in each view of a complete recording; of another one nobody knows it."""
    try:
        return int(bounded.json_of(read_truth(folder).settings)["frames"])
    except (InputError, ValueError, KeyError, TypeError):
        return math.inf


def _keep_changes(folder: Path) -> None:
    """Copy a take.toml that is not as this function's recording has it."""
    try:
        settings = from_table(ArmTakeSettings, bounded.json_of(read_truth(folder).settings), "truth.npz")
        written = _take_toml(settings, *_subject_and_rig(settings))
        changed = written.splitlines() != bounded.text_of(folder / "take.toml", bounded.TOML_BYTES).replace(".jpg", ".png").splitlines()
    except (InputError, OSError, ValueError):
        changed = has_comments(folder)
    if changed and (folder / "take.toml").is_file():
        copy_aside(folder / "take.toml")


def _film_frame(folder: Path, studio: _Studio, frame: int, monitor: Monitor) -> np.ndarray:
    """Write one image of all views; return the vertices (V,) visible in all of them, a row for each instant of the selected fields."""
    settings, kept = studio.settings, field_layout(studio.settings.interlaced).first
    moments = [frame_time_s(frame, settings.fps)] + ([frame_time_s(frame + 0.5, settings.fps)] if kept.step == 2 else [])
    bodies = [studio.subject.parts(time) for time in moments]
    late = [studio.subject.parts(time + settings.late_frames / settings.fps) for time in moments] if settings.late_frames else bodies
    scenes = [joined(body) for body in bodies[: field_layout(settings.interlaced).per_image]]
    seen = np.ones((len(scenes), len(scenes[0].vertices_m)), dtype=bool)
    for i, camera in enumerate(studio.rig.cameras):
        monitor.step(STAGE, frame * len(VIEWS) + i, settings.frames * len(VIEWS))
        sensor = SENSORS[camera.name]
        layers = [paint(camera, parts, studio.noise, studio.backdrops[i]) for parts in (late if camera.name == LATE else bodies)]
        for row, scene, layer in zip(seen, scenes, layers):
            row &= visible_vertices(camera, scene.vertices_m, scene.normals, layer)
        picture = expose(layers[0], sensor)
        if kept.step == 2:
            picture[1 - kept.offset :: 2] = expose(layers[1], sensor)[1 - kept.offset :: 2]
        rng = np.random.default_rng([settings.seed, frame, i])
        _write_png(folder / camera.name / f"{frame:04d}.png", digitize(picture, sensor, settings.noise, rng))
    return seen


def _write_png(path: Path, picture: np.ndarray) -> None:
    store.write_bytes(path, cv2.imencode(".png", picture)[1].tobytes())


def _truth(studio: _Studio, visible: np.ndarray) -> bytes:
    shape, per = studio.subject.shape, field_layout(studio.settings.interlaced).per_image
    time = frame_time_s(np.arange(per * studio.settings.frames), per * studio.settings.fps)
    motion, bodies = studio.subject.motion(time), [studio.subject.parts(moment) for moment in time]
    joints = joint_positions(shape.skeleton, shape.lengths_m, motion)
    textured = np.concatenate([np.full(len(p.vertices_m), p.material.textured) for p in bodies[0]])
    arrays = dict(
        vertices_m=np.array([np.concatenate([p.vertices_m for p in body]) for body in bodies], dtype=np.float32),
        triangles=joined(bodies[0]).triangles.astype(np.int32),
        textured=textured,
        visible=np.packbits(visible, axis=1),
        joints_m=np.stack([joints[name] for name in studio.subject.joints], axis=1),
        joint_names=np.array([motion_capture_name(name) for name in studio.subject.joints]),
        time_s=time,
        motion_values=motion,
        dof_names=np.array(shape.skeleton.dof_names),
        bone_names=np.array([bone.name for bone in shape.skeleton.bones]),
        lengths_m=shape.lengths_m,
        settings=np.array(json.dumps(to_table(studio.settings))),
    )
    if studio.subject.is_metaballs:
        arrays |= dict(radii_m=shape.metaballs.radii_m, ball_bone=shape.metaballs.bone_index)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _take_toml(settings: ArmTakeSettings, subject: Subject, rig: Rig) -> str:
    rng = np.random.default_rng([settings.seed, 77])
    joints = joint_positions(subject.shape.skeleton, subject.shape.lengths_m, subject.motion(0.0))
    lines = [
        'format = "tricap-take"',
        "version = 1",
        f"fps = {settings.fps!r}",
        f'interlaced = "{settings.interlaced}"',
        'rig = "rig.toml"',
        "",
    ]
    for camera in rig.cameras:
        lines += ["[[views]]", f'name = "{camera.name}"', f'images = "{camera.name}/*.png"', ""]
    lines += ["[body]", f'model = "{subject.shape.model}"', "", "[seeds]", "frame = 0", "[seeds.joints]"]
    for name in subject.joints:
        clicks = [camera.project(joints[name]) + rng.uniform(-1, 1, 2) * settings.click_error_px for camera in rig.cameras]
        lines.append(f'"{name}" = {{ ' + ", ".join(f"{c.name} = [{x:.1f}, {y:.1f}]" for c, (x, y) in zip(rig.cameras, clicks)) + " }")
    return "\n".join(lines) + "\n"
