"""A synthetic limb whose surface, joints and clicks are known: made from the model's own metaballs, seen from one side."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import cv2
import numpy as np

from tricap.core.body.metaballs import field, field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames, joint_positions
from tricap.core.body.skin.contour_skin import body_skin, limb_skin
from tricap.core.fitting.hands import Fingers, hand_capsules
from tricap.core.fitting.inputs.fit_input import ViewContours
from tricap.core.fitting.state import BodyState
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.raster import rasterize
from tricap.core.geometry.rig import Rig
from tricap.core.tracking.contour import contour_of_mask, outward_normals

VIEW = np.array([0.0, 1.0, 0.0])  # the cameras look along +Y, at the front of the person


def front_rig(focal_px: float = 1500.0) -> Rig:
    """Three cameras in a row, 0.4 m apart, 2.2 m before the origin. With 800 px they show a whole person."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    cameras = [
        Camera(
            name=name,
            size_px=(1000, 800),
            matrix=np.array([[focal_px, 0, 500], [0, focal_px, 400], [0, 0, 1.0]]),
            R_cam_world=R,
            t_cam_world_m=-R @ np.array([x, -2.2, 0.0]),
        )
        for name, x in zip("LCR", (-0.4, 0.0, 0.4))
    ]
    return Rig(cameras=tuple(cameras))


def hand_places(shape: BodyShape, pose: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) along the axes of the capsules of a hand, "hand.L" or "hand.R", in a pose, and their radii (N,)."""
    b = [bone.name for bone in shape.skeleton.bones].index(name)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, pose)
    ends, radii = (part * shape.lengths_m[b] for part in hand_capsules(left=name.endswith(".L")))
    share = np.linspace(0, 1, 12)[:, None, None]
    along = ((1 - share) * ends[:, 0] + share * ends[:, 1]).reshape(-1, 3)
    return head[b] + along @ R[b].T, ((1 - share[..., 0]) * radii[:, 0] + share[..., 0] * radii[:, 1]).ravel()


def points_on_hand(state: BodyState, name: str, count: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) on the back of a hand and of its fingers, with their normals, as cameras at one side see them."""
    b = [bone.name for bone in state.skeleton.bones].index(name)
    rng, fingers = np.random.default_rng(4), Fingers.bent(name.endswith(".L"), state.finger_bends[b])
    k = rng.integers(0, len(fingers.length), 4 * count)
    share, turn = rng.uniform(0, 1, len(k)), rng.normal(size=(len(k), 3))
    turn -= np.einsum("ni,ni->n", turn, fingers.axis[k])[:, None] * fingers.axis[k]
    turn *= -np.sign(turn[:, 2:]) / np.linalg.norm(turn, axis=1)[:, None]
    radius = (1 - share) * fingers.radii[k, 0] + share * fingers.radii[k, 1]
    places = fingers.first[k] + (share * fingers.length[k])[:, None] * fingers.axis[k] + radius[:, None] * turn
    outside = np.flatnonzero(np.abs(fingers.gaps(places)[0]) < 0.03)[:count]  # not within another capsule
    return state.head_m[b] + state.lengths_m[b] * places[outside] @ state.R[b].T, turn[outside] @ state.R[b].T


def person_seen(camera: Camera, shape: BodyShape, pose: np.ndarray) -> np.ndarray:
    """Where (h, w) a camera sees a body in a pose, with its fingers."""
    skin = body_skin(shape, pose)
    raster = rasterize(camera, skin.vertices_m, skin.triangles, back_faces=True)
    person = (raster.image(np.ones(len(raster.sample)), 0.0) > 0).astype(np.uint8)
    for places, radii in (hand_places(shape, pose, name) for name in ("hand.L", "hand.R")):
        for at, depth, r in zip(camera.project(places), camera.to_camera(places)[:, 2], radii):
            cv2.circle(person, tuple(at.round().astype(int).tolist()), int(r * camera.focal_px / depth), 1, -1)
    return person > 0


@dataclass(frozen=True, eq=False)
class Scene:
    """Truth and measurements of T frames."""

    model: str
    shape: BodyShape
    motion: np.ndarray  # (T, D)
    rig: Rig
    clouds: list
    clicks: dict
    trajectories: object

    @property
    def time_s(self) -> np.ndarray:
        return np.arange(len(self.motion)) / 25

    @property
    def joints_m(self) -> np.ndarray:
        """(T, J, 3)"""
        return np.stack(list(joint_positions(self.shape.skeleton, self.shape.lengths_m, self.motion).values()), axis=1)


def swing(model: str, frames: int) -> np.ndarray:
    """A motion (frames, 8): the shoulder swings, the elbow (knee) bends from 40° to 75°."""
    phase = np.linspace(0, 1.2, frames)
    side = -1.0 if model.endswith(".L") else 1.0
    degrees = np.stack(
        [
            20 + 15 * np.sin(2 * phase),
            side * (-15 + 10 * np.cos(3 * phase)),
            side * 10 * phase,
            40 + 35 * phase,
            side * 12 * np.sin(4 * phase),
        ],
        axis=1,
    )
    base = np.array([side * 0.1, 0.02, 0.1]) + 0.01 * np.stack([side * np.sin(phase), np.cos(phase), phase], axis=1)
    return np.concatenate([base, np.radians(degrees)], axis=1)


def surface(shape: BodyShape, motion: np.ndarray, along: np.ndarray, angle: np.ndarray, bone: np.ndarray):
    """Points and outward normals of the true surface at fractions along bones and angles about them."""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    axis = head[bone] + along[:, None] * shape.lengths_m[bone, None] * R[bone, :, 1]
    ray = np.cos(angle)[:, None] * R[bone, :, 0] + np.sin(angle)[:, None] * R[bone, :, 2]
    low, high = np.zeros(len(bone)), np.full(len(bone), 0.2)
    for _ in range(40):
        middle = (low + high) / 2
        inside = field(shape.metaballs, shape.lengths_m, R, head, axis + middle[:, None] * ray) > 0.5
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    X = axis + low[:, None] * ray
    gradient = field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, X)[1]
    return X, -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


def measured_cloud(shape, motion, frame, rng, *, points, noise, gross):
    """A one-sided cloud with noise along the normal and gross errors of 20–100 mm."""
    bone = rng.integers(0, len(shape.lengths_m), 3 * points)
    X, normal = surface(shape, motion, rng.uniform(0.05, 0.95, len(bone)), rng.uniform(0, 2 * np.pi, len(bone)), bone)
    keep = np.flatnonzero(normal @ VIEW < -0.3)[:points]
    X = X[keep] + noise * rng.normal(size=(len(keep), 1)) * normal[keep]
    wild = rng.random(len(X)) < gross
    away = rng.normal(size=(len(X), 3))
    X[wild] += (away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(0.02, 0.1, (len(X), 1)))[wild]
    covariance = np.repeat(np.eye(3)[None] * noise**2, len(X), axis=0)
    return SimpleNamespace(frame=frame, xyz_m=X, normals=normal[keep], covariance_m2=covariance)


def tracked(shape, motion, rng, noise):
    """Trajectories of points fixed on the surface, seen in all frames."""
    bone = np.repeat([0, 1], 60)
    along, angle = rng.uniform(0.3, 0.9, 120), rng.uniform(0, 2 * np.pi, 120)
    X = np.stack([surface(shape, m, along, angle, bone)[0] for m in motion])
    return SimpleNamespace(frames=np.arange(len(motion)), xyz_m=X + noise * rng.normal(size=X.shape), sigma_m=np.full(X.shape[:2], noise))


def make_scene(model="arm.R", frames=1, seed=0, points=260, noise=0.003, gross=0.0, click_px=3.0, shape=None, click=0) -> Scene:
    """Truth and measurements; `gross`: share of gross points, `click_px`: error of clicks, `click`: the frame they are in."""
    rng = np.random.default_rng(seed)
    shape = default_shape(read_model(model)) if shape is None else shape
    motion, rig = swing(model, frames), front_rig()
    clouds = [measured_cloud(shape, m, t, rng, points=points, noise=noise, gross=gross) for t, m in enumerate(motion)]
    joints = joint_positions(shape.skeleton, shape.lengths_m, motion[click])
    clicks = {name: {c.name: c.project(X) + click_px * rng.uniform(-1, 1, 2) for c in rig.cameras} for name, X in joints.items()}
    return Scene(model, shape, motion, rig, clouds, clicks, tracked(shape, motion, rng, 0.001))


def other_person(model: str, rng: np.random.Generator, lengths: float = 0.08, radii: float = 0.1) -> BodyShape:
    """A model's shape with other lengths and radii."""
    shape = default_shape(read_model(model))
    L = shape.lengths_m * np.exp(rng.normal(0, lengths, len(shape.lengths_m)))
    r = shape.metaballs.radii_m.copy()
    r[:, 1] *= (L / shape.lengths_m)[shape.metaballs.bone_index]
    r[:, [0, 2]] *= np.exp(rng.normal(0, radii, (len(r), 1)))
    return replace(shape, lengths_m=L, metaballs=replace(shape.metaballs, radii_m=r))


def outlines(scene: Scene) -> list[ViewContours]:
    """The true outlines of every frame and view, found in a mask of four samples a pixel."""
    found = []
    for camera in scene.rig.cameras:
        parts = []
        for frame, motion in enumerate(scene.motion):
            skin = limb_skin(scene.shape, motion)
            raster = rasterize(camera, skin.vertices_m, skin.triangles, factor=4)
            xy = contour_of_mask(raster.image(np.ones(len(raster.sample)), 0.0) > 0, 16.0)
            normal = outward_normals(xy)
            parts.append(np.column_stack([np.full(len(xy), frame), (xy + 0.5) / 4 - 0.5, normal]))
        table = np.concatenate(parts)
        found.append(
            ViewContours(view=camera.name, frame=table[:, 0], xy_px=table[:, 1:3], normal=table[:, 3:], sigma_px=np.full(len(table), 0.5))
        )
    return found
