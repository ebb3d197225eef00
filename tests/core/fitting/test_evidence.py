"""What the fit uses besides points: outlines, clicks in further frames, keypoints, limits and locks."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skin.contour_skin import limb_skin
from tricap.core.fitting.inputs import background, fit_input
from tricap.core.fitting.inputs.background import BackgroundRegions
from tricap.core.fitting.inputs.fit_input import BackgroundDistances, FitInput, JointPlaces, Packed
from tricap.core.fitting.inputs.silhouettes import Silhouettes
from tricap.core.fitting.observations import PosePrior
from tricap.core.fitting.observations.joints import StandingFeet
from tricap.core.fitting.observations.self_collision import CollisionPairs
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Estimate, Problem
from tricap.core.fitting.solve.solver import solve
from tricap.core.fitting.stages.sequence import fit_sequence
from tricap.core.fitting.state import ShapeParameters
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.raster import rasterize
from tricap.core.geometry.rig import Rig

from . import limb_scene
from .limb_scene import measured_cloud, outlines

SETTINGS = FitSettings(model_sigma_m=0.001, voxel_m=0.004)


def _given(scene, **changes) -> FitInput:
    values = dict(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={0: scene.clicks}, time_s=scene.time_s)
    return FitInput(**{**values, **changes})


def _empty(scene, step_px: int = 4) -> list[BackgroundDistances]:
    """How far every place is from the true outline."""
    found = []
    for camera in scene.rig.cameras:
        tables = []
        for motion in scene.motion:
            skin = limb_skin(scene.shape, motion)
            raster = rasterize(camera, skin.vertices_m, skin.triangles)
            outside = (raster.image(np.ones(len(raster.sample)), 0.0) == 0).astype(np.uint8)
            far = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_5)[step_px // 2 :: step_px, step_px // 2 :: step_px]
            tables.append(np.minimum(2 * far, 255).astype(np.uint8))
        found.append(
            BackgroundDistances(view=camera.name, frame=np.arange(len(tables)), distance=Packed(tables), step_px=step_px, unit_px=0.5)
        )
    return found


def _blind(scene) -> list[SimpleNamespace]:
    """Clouds without points."""
    none = {"xyz_m": np.zeros((0, 3)), "normals": np.zeros((0, 3)), "covariance_m2": np.zeros((0, 3, 3))}
    return [SimpleNamespace(frame=cloud.frame, **none) for cloud in scene.clouds]


@pytest.mark.slow
def test_a_limb_without_points_keeps_out_of_the_background(make_scene) -> None:
    scene = make_scene(frames=9)
    last = len(scene.clouds) - 1
    elbow, wrist = (scene.shape.skeleton.joint_names.index(j) for j in ("elbow.R", "wrist.R"))
    clouds = []
    for t, cloud in enumerate(scene.clouds):
        a, b = scene.joints_m[t, elbow], scene.joints_m[t, wrist]
        along = (cloud.xyz_m - a) @ (b - a) / ((b - a) @ (b - a))
        keep = (along < -0.25) | (t == 0)  # the forearm is measured in the clicked frame alone
        clouds.append(
            SimpleNamespace(
                frame=cloud.frame, xyz_m=cloud.xyz_m[keep], normals=cloud.normals[keep], covariance_m2=cloud.covariance_m2[keep]
            )
        )
    errors = []
    for empty in ((), _empty(scene)):
        fit = fit_sequence(_given(scene, clouds=clouds, background=empty), SETTINGS)
        errors.append(np.linalg.norm((fit.motion.joints_m - scene.joints_m)[last, wrist]))
    assert errors[1] < 0.5 * errors[0], errors


def test_hands_keep_out_of_the_background_as_other_bones_do() -> None:
    parameters, far = ShapeParameters(default_shape(read_model("full"))), np.full((200, 250), 80, np.uint8)
    empty = [BackgroundDistances(view="C", frame=np.arange(1), distance=Packed([far]), step_px=4, unit_px=0.5)]
    given = FitInput(
        rig=limb_scene.front_rig(), model="full", clouds=[SimpleNamespace(frame=0)], clicks={}, time_s=np.zeros(1), background=empty
    )
    seen = BackgroundRegions(given, parameters, FitSettings(background_sigma_px=4.0)).observe(0)[0]
    joints = np.array(parameters.skeleton.joint_names)
    hands = np.isin(joints[seen.head], ["wrist.L", "wrist.R"])
    assert seen.fraction[hands].tolist() == [0.2, 0.5, 0.8, 1.0] * 2 and seen.sigma_px == 4.0
    r = seen.residual(parameters.state(np.zeros(len(parameters.skeleton.dofs)), parameters.vector()))
    assert (r[hands] > 0).all()  # they are 40 px outside


def test_regions_of_many_frames_are_unpacked_within_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    parameters, n = ShapeParameters(default_shape(read_model("full"))), 6
    images = [np.full((20, 30), 10 * t, np.uint8) for t in range(n)]
    for t, image in enumerate(images):
        image[:5, : t + 1] = 0
        image[-1] = 1
    empty = [BackgroundDistances(view="C", frame=np.arange(n), distance=Packed(images), step_px=4, unit_px=0.5)]
    clouds = [SimpleNamespace(frame=t) for t in range(n)]
    given = FitInput(rig=limb_scene.front_rig(), model="full", clouds=clouds, clicks={}, time_s=np.arange(n) / 30.0, background=empty)
    monkeypatch.setattr(background, "CACHED_BYTES", 3 * images[0].nbytes)
    regions = BackgroundRegions(given, parameters, FitSettings())
    for t in [*range(n), 1, *range(n)]:
        assert np.array_equal(regions.observe(t)[0].views[0].table, images[t])
        assert len(regions.cells(t)[0].xy_px) == (images[t] == 0).sum()
        assert len(regions._unpacked) <= 4 and set(regions._cells) <= set(regions._unpacked)
    assert regions.cells(n - 1) is regions.cells(n - 1)


@pytest.mark.slow
def test_outlines_tell_the_thickness_that_points_from_one_side_do_not(make_scene, other_person) -> None:
    before, after = [], []
    for seed in range(4):
        scene = make_scene(seed=seed, shape=other_person("arm.R", np.random.default_rng(seed)))
        for contours, errors in (((), before), (outlines(scene), after)):
            fit = fit_sequence(_given(scene, contours=contours), SETTINGS)
            errors.append(fit.motion.joints_m - scene.joints_m)
            assert len(fit.outline_m) == 0 if not contours else np.median(fit.outline_m) < 1e-3
    depth = [np.sqrt(np.mean(np.array(e)[..., 1] ** 2)) for e in (before, after)]
    across = [np.sqrt(np.mean(np.array(e)[..., [0, 2]] ** 2)) for e in (before, after)]
    assert depth[1] < 0.4 * depth[0]  # measured 6.4 mm and 0.5 mm
    assert across[1] < across[0]


def test_a_click_in_a_further_frame_finds_the_limb_again(make_scene) -> None:
    scene = make_scene(frames=8, seed=1)
    flexion = scene.shape.skeleton.layout["elbow.R flexion"]
    for t in range(3, 8):  # from frame 3 on the forearm has no points, and bends otherwise than before
        scene.motion[t, flexion] -= np.radians(8.0 * (t - 2))
        shoulder, elbow = scene.joints_m[t, :2]
        c = scene.clouds[t]
        upper = np.linalg.norm(c.xyz_m - shoulder, axis=1) < np.linalg.norm(elbow - shoulder) * 0.9
        scene.clouds[t] = SimpleNamespace(frame=t, xyz_m=c.xyz_m[upper], normals=c.normals[upper], covariance_m2=c.covariance_m2[upper])
    wrist = {camera.name: camera.project(scene.joints_m[7, 2]) for camera in scene.rig.cameras}
    errors = []
    for clicks in ({0: scene.clicks}, {0: scene.clicks, 7: {"wrist.R": wrist}}):
        fit = fit_sequence(_given(scene, clicks=clicks, click_frame=0), SETTINGS)
        errors.append(np.linalg.norm(fit.motion.joints_m[:, 2] - scene.joints_m[:, 2], axis=1))
    assert errors[1][7] < 0.02 < errors[0][7]
    assert errors[1][3:].mean() < 0.5 * errors[0][3:].mean()


def test_locked_and_limited_angles_stay_so(make_scene) -> None:
    scene = make_scene(frames=3, seed=2)
    layout = scene.shape.skeleton.layout
    fit = fit_sequence(_given(scene, locked=["elbow.R twist"], limits={"elbow.R flexion": (0.0, np.radians(50))}), SETTINGS)
    assert (fit.motion.values[:, layout["elbow.R twist"]] == 0).all()
    assert (fit.motion.sigma[:, layout["elbow.R twist"]] == 0).all()
    free = fit_sequence(_given(scene), SETTINGS)
    flexion = np.degrees([f.motion.values[-1, layout["elbow.R flexion"]] for f in (fit, free)])
    assert flexion[1] > 65 and flexion[0] < 60  # softly: truth is 75°
    with pytest.raises(InputError, match="elbow.R twist"):
        fit_sequence(_given(scene, locked=["elbow.R twst"]), SETTINGS)


@pytest.mark.parametrize("space", [False, True])
def test_keypoints_begin_the_fit_and_carry_it_without_clicks(make_scene, space) -> None:
    scene = make_scene(frames=6, seed=3)
    rng = np.random.default_rng(3)
    names, frame = scene.shape.skeleton.joint_names, np.repeat(np.arange(6), 3)
    X = scene.joints_m.reshape(-1, 3)
    views = (
        [("", X + rng.normal(0, 0.008, X.shape), 0.01)]
        if space
        else [(c.name, c.project(X) + rng.normal(0, 3.0, (len(X), 2)), 4.0) for c in scene.rig.cameras]
    )
    keypoints = [
        JointPlaces(view=view, frame=frame, joint=names * 6, place=place, sigma=np.full(18, sigma)) for view, place, sigma in views
    ]
    fit = fit_sequence(_given(scene, clicks={}, keypoints=keypoints), SETTINGS)
    assert set(fit.motion.status) == {"fitted"}
    assert np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2).mean() < 8e-3  # measured 6.3 mm


def test_neither_clicks_nor_keypoints_are_too_little(make_scene) -> None:
    with pytest.raises(InputError, match="at least two of the joints"):
        fit_sequence(_given(make_scene(frames=1, seed=3), clicks={}), SETTINGS)


def test_a_hidden_arm_stays_outside_of_the_trunk() -> None:
    model = read_model("full")
    shape, names = default_shape(model), [bone.name for bone in model.skeleton.bones]
    parameters, limbs = ShapeParameters(shape), CollisionPairs(model.skeleton, shape.metaballs.bone_index)
    motion = np.zeros(len(model.skeleton.dofs))
    assert limbs.observe(parameters.state(motion, parameters.vector())) == []  # nothing touches anything at rest
    layout = model.skeleton.layout
    for name, angle in {"shoulder.R abduction": 30, "shoulder.R flexion": -10, "elbow.R flexion": 80, "shoulder.R twist": -75}.items():
        motion[layout[name]] = np.radians(angle)
    inside = parameters.state(motion, parameters.vector())
    found = limbs.observe(inside)[0]
    assert {names[b] for b in found.bone[found.residual(inside) > 1]} <= {"forearm.R", "hand.R"}
    prior = PosePrior(mean=motion, sigma=np.full(len(motion), np.radians(20)))
    problem = Problem(parameters=parameters, observe=lambda t, state: [prior, *limbs.observe(state)])
    freed = parameters.state(
        solve(problem, Estimate(motion=motion[None], vector=parameters.vector()), steps=20).motion[0], parameters.vector()
    )
    before, after = (max(np.max(o.residual(state), initial=0.0) for o in limbs.observe(state)) for state in (inside, freed))
    assert before > 3 and after < 1.0  # a centimetre


@pytest.mark.slow
@pytest.mark.parametrize(("given", "limit_m"), [("outlines", 3e-3), ("background", 5e-3)])
def test_outlines_and_clicks_alone_are_enough(make_scene, other_person, given: str, limit_m: float) -> None:
    scene = make_scene(frames=8, seed=5, shape=other_person("arm.R", np.random.default_rng(5)))
    evidence = {"contours": outlines(scene)} if given == "outlines" else {"background": _empty(scene)}
    fit = fit_sequence(_given(scene, clouds=_blind(scene), **evidence), SETTINGS)
    errors = np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2)
    assert set(fit.motion.status) == {"fitted"} and fit.converged and np.isfinite(fit.motion.sigma0).all()
    assert errors.mean() < limit_m, errors.mean(axis=0)  # three persons with outlines: 0.5, 1.5, 0.8 mm; with the background: 2.6 mm


def test_without_points_and_outlines_there_is_no_body(make_scene) -> None:
    scene = make_scene(frames=2)
    with pytest.raises(InputError, match="no measured surface, and no outlines.*find outlines with `tricap contour`"):
        fit_sequence(_given(scene, clouds=_blind(scene)), SETTINGS)


def test_keypoints_alone_are_enough(make_scene) -> None:
    scene = make_scene(frames=6, seed=3)
    blind = [
        SimpleNamespace(frame=c.frame, xyz_m=np.zeros((0, 3)), normals=np.zeros((0, 3)), covariance_m2=np.zeros((0, 3, 3)))
        for c in scene.clouds
    ]
    names, frame, X = scene.shape.skeleton.joint_names, np.repeat(np.arange(6), 3), scene.joints_m.reshape(-1, 3)
    keypoints = [
        JointPlaces(view=c.name, frame=frame, joint=names * 6, place=c.project(X), sigma=np.full(18, 4.0)) for c in scene.rig.cameras
    ]
    fit = fit_sequence(_given(scene, clicks={}, keypoints=keypoints, clouds=blind), SETTINGS)
    assert set(fit.motion.status) == {"fitted"} and np.isnan(fit.motion.sigma0).all()
    assert np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2).max() < 8e-3


def test_outlines_make_a_thick_arm_thick(make_scene) -> None:
    """An arm half as thick again as the model's is no noise of its outlines."""
    shape = default_shape(read_model("arm.R"))
    r = shape.metaballs.radii_m.copy()
    r[:, [0, 2]] *= 1.5
    scene = make_scene(frames=2, seed=5, shape=replace(shape, metaballs=replace(shape.metaballs, radii_m=r)))
    blind = [
        SimpleNamespace(frame=c.frame, xyz_m=np.zeros((0, 3)), normals=np.zeros((0, 3)), covariance_m2=np.zeros((0, 3, 3)))
        for c in scene.clouds
    ]
    contours = [replace(c, sigma_px=3 * c.sigma_px) for c in outlines(scene)]
    fit = fit_sequence(_given(scene, clouds=blind, contours=contours), FitSettings())
    grown = fit.shape.metaballs.radii_m[:, [0, 2]] / shape.metaballs.radii_m[:, [0, 2]]
    assert 1.2 < np.median(grown) < 1.6, grown  # 1.29 (the model holds back); 1.02 when the misfit is taken for noise


def test_a_standing_foot_keeps_its_height(make_scene) -> None:
    """A leg whose foot stands in the first half and swings in the second; a noisy start shows when, and its height is constrained."""
    time_s, rng = np.arange(30) / 30, np.random.default_rng(0)
    names = ("hip.R", "knee.R", "ankle.R", "toe.R")
    joints = np.zeros((30, 4, 3))
    joints[:, 2, 2], joints[:, 3, 2] = 0.09, 0.02
    joints[15:, 2:, 0] = np.linspace(0, 0.8, 15)[:, None]  # it goes forward, low over the floor
    joints[15:, 2:, 2] += 0.1 * np.sin(np.linspace(0, np.pi, 15))[:, None]
    feet = StandingFeet(joints + rng.normal(0, 0.002, joints.shape), names, time_s)
    assert feet.stands[:13, 2:].all() and not feet.stands[17:28, 2:].any() and not feet.stands[:, :2].any()
    assert feet.level_m[2:] == pytest.approx([0.09, 0.02], abs=0.004)
    assert feet.observe(20) == [] and feet.observe(3)[0].joint.tolist() == [2, 3]
    assert not StandingFeet(joints[:1], names, time_s[:1]).stands.any()


def test_the_floor_steadies_a_foot_that_stands(make_scene) -> None:
    scene, rng = make_scene(model="leg.R", seed=4), np.random.default_rng(1)
    clouds = [measured_cloud(scene.shape, scene.motion[0], t, rng, points=60, noise=0.008, gross=0.0) for t in range(8)]
    ankle = scene.shape.skeleton.joint_names.index("ankle.R")
    given = _given(scene, clouds=clouds, time_s=np.arange(8) / 25)
    free, held = (fit_sequence(given, replace(SETTINGS, floor=floor)).motion.joints_m[:, ankle, 2] for floor in (False, True))
    assert np.ptp(held) < 0.85 * np.ptp(free), (np.ptp(held), np.ptp(free))


@pytest.fixture(scope="module")
def outlined():
    """A scene of one frame, and its outlines."""
    scene = limb_scene.make_scene()
    return scene, outlines(scene)


def test_views_from_around_are_witnesses_of_their_own(outlined) -> None:
    """Three views in a row follow the same wrong edge together; views at right angles do not."""
    scene, contours = outlined
    row = scene.rig.cameras
    around = []
    for k, camera in enumerate(row):
        c, s = np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)
        about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        around.append(replace(camera, R_cam_world=camera.R_cam_world @ about_z))
    parameters = ShapeParameters(scene.shape)
    state = parameters.state(scene.motion[0], parameters.vector())
    variance_inflation = []
    for cameras in (row, tuple(around)):
        given = _given(scene, rig=Rig(cameras=cameras), contours=contours)
        variance_inflation.append(
            max(np.max(o.variance_inflation) for o in Silhouettes(given, read_model("arm.R").surface, FitSettings()).observe(0, state))
        )
    assert variance_inflation[0] > 2 * variance_inflation[1] > 2


def test_outlines_past_its_end_hold_an_ellipsoid_and_are_the_hands_where_a_forearm_has_more_balls(outlined) -> None:
    scene, contours = outlined
    parameters, given = ShapeParameters(scene.shape), _given(scene, contours=contours)
    short = parameters.vector()
    short[1] += np.log(0.9)
    state = parameters.state(scene.motion[0], short)
    wrist = state.head_m[1] + state.lengths_m[1] * state.R[1, :, 1]
    past = []
    for balls in ("one", "three"):
        (rays,) = Silhouettes(given, read_model("arm.R").surface, FitSettings(balls=balls)).observe(0, state)
        away = wrist - rays.origin_m
        nearest = rays.origin_m + np.einsum("ni,ni->n", away, rays.direction)[:, None] * rays.direction
        past.append(int(((nearest - wrist) @ state.R[1, :, 1] > 0).sum()))
    assert past[0] > 10 and past[1] == 0


def test_packed_images_come_back_from_memory_and_from_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    for in_memory in (1 << 24, 100):
        monkeypatch.setattr(fit_input, "IN_MEMORY", in_memory)
        images = [np.random.default_rng(i).integers(0, 255, (7, 9)).astype(np.uint8) for i in range(12)]
        packed = Packed(images)
        assert len(packed) == 12 and all(np.array_equal(packed[i], images[i]) for i in (11, 0, -1, 5, 5))
        assert [i.tolist() for i in packed[2:4]] == [i.tolist() for i in images[2:4]]
