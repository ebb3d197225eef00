"""The start without clicks: the person is found, rivals get probabilities, and what is uncertain is asked."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model, smallest_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.inputs.start_joints import StartJoints
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages import set_up
from tricap.core.fitting.stages.set_up import NobodyFound, find_joints, needs_start, with_start
from tricap.core.fitting.start import find, refine, search, taken_back
from tricap.core.fitting.start.find import Followed, _decisive, _difference, _least_sure, _with_limbs, is_confirmed, judged, surely
from tricap.core.fitting.start.limb_places import LimbPlaces, limb_places
from tricap.core.fitting.start.pose_dictionary import known_poses
from tricap.core.fitting.start.refine import EXCHANGES, Explanation, explanation, missed_m
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.run.joints import pixels_of, write_joints_as_clicks
from tricap.core.take.take import AUTO_BODY, read_take
from tricap.core.take.writing import read_table

from .limb_scene import front_rig, measured_cloud

MODEL = read_model("full")
SHAPE = default_shape(MODEL)
SKELETON, NAMES = SHAPE.skeleton, SHAPE.skeleton.joint_names
RARE = ("fair1_dab", "fair1_zombie", "rokoko_jesse_dance", "02_06_bend_scoop_lift_arm", "11_01_kick_soccer_ball", "cgspeed_05_06_dance")
SETTINGS, WIDE_PX = FitSettings(), 800.0
STANDING = {"shoulder.R flexion": 50, "elbow.R flexion": 70, "shoulder.L abduction": -20, "hip.R flexion": 25, "knee.R flexion": 35}


def _pose(heading_deg: float) -> np.ndarray:
    pose = np.zeros(len(SKELETON.dofs))
    for name, degrees in (STANDING | {"pelvis rotation": heading_deg}).items():
        pose[SKELETON.layout[name]] = np.radians(degrees)
    return pose


def _input(pose: np.ndarray, points: int = 900, **changes) -> FitInput:
    rng = np.random.default_rng(0)
    cloud = measured_cloud(SHAPE, pose, 0, rng, points=points, noise=0.002, gross=0.01)
    return FitInput(**{"rig": front_rig(WIDE_PX), "model": "full", "clouds": [cloud], "time_s": np.zeros(1), **changes})


def _joints(pose: np.ndarray) -> np.ndarray:
    return np.stack([*joint_positions(SKELETON, SHAPE.lengths_m, pose).values()])


def test_the_dictionary_has_poses_with_their_mirror_images() -> None:
    poses = known_poses(SKELETON)
    low, high = np.degrees([dof.limits for dof in SKELETON.dofs]).T
    assert len(poses) > 200 and not poses[:, :3].any() and len(known_poses(SKELETON, RARE)) < len(poses) / 2
    assert (np.degrees(poses) > low - 15).all() and (np.degrees(poses) < high + 15).all()
    one, other = (_joints(pose) for pose in poses[:2])
    sides = [NAMES.index(n.replace(".L", ".X").replace(".R", ".L").replace(".X", ".R")) for n in NAMES]
    assert np.allclose(other[sides] * [-1, 1, 1], one, atol=1e-9)
    assert known_poses(read_model("upper_body").skeleton).shape[1] == len(read_model("upper_body").skeleton.dofs)


@pytest.fixture
def quick(monkeypatch):
    """A coarser search among fewer poses."""
    monkeypatch.setattr(search, "HEADINGS", 12)
    monkeypatch.setattr(find, "TRIED", 4)
    monkeypatch.setattr(find, "COMPLETED", 2)


@pytest.mark.slow
def test_a_person_is_found_from_points_alone(quick) -> None:
    pose = _pose(30.0)
    found = find_joints(_input(pose), SETTINGS, Monitor(), RARE)
    assert found is not None and found.frame == 0 and abs(found.stature - 1) < 0.06
    off = {name: np.linalg.norm(found.xyz_m[name] - place) for name, place in zip(NAMES, _joints(pose)) if name[:-2] in find.JUDGED}
    assert max(off.values()) < 0.15, off
    assert StartJoints.sigma_m("wrist.R") >= 2 * StartJoints.sigma_m("knee.R")  # one frame hardly shows where an arm lies
    assert (
        0 < found.probability <= 1 - find.UNCONFIRMED < SETTINGS.least_start_probability and find.UNTRIED in found.rivals
    )  # a single frame


def _limbs(given: FitInput, pose: np.ndarray, monkeypatch) -> dict[str, LimbPlaces]:
    """Where the limbs of a pose may be in a frame, by the first of their joints."""
    used = []
    monkeypatch.setattr(set_up, "find_start", lambda fit, points_of, *_: used.append((fit, points_of(0))))
    find_joints(given, SETTINGS, Monitor())
    fit, points = used[0]
    found = explanation(fit, 0, points, pose, fit.parameters.vector())
    return {next(iter(limb.doubt)): limb for limb in limb_places(fit, points, found, Monitor())}


@pytest.mark.slow
def test_a_leg_that_was_lost_on_the_way_to_another_frame_is_found_again(monkeypatch) -> None:
    """An adjustment draws it to the other leg's points; where it was found, all of the body explains more."""
    used, pose = {}, _pose(0.0)
    monkeypatch.setattr(set_up, "find_start", lambda fit, points_of, *_: used.update(fit=fit, points=points_of(0)))
    find_joints(_input(pose, points=6000), SETTINGS, Monitor())
    fit, points = used["fit"], used["points"]
    astray = pose.copy()
    astray[SKELETON.layout["hip.R abduction"]] = np.radians(-25.0)
    monkeypatch.setattr(refine, "adjusted", lambda fit, points, start, *_: explanation(fit, 0, points, astray, start.vector))
    found = explanation(fit, 0, refine.thinned_points(points), astray, fit.parameters.vector())
    limbs = limb_places(fit, points, found, Monitor())
    assert min(limb.certainty for limb in find._legs(limbs)) < find.ELSEWHERE
    better, again = find._with_legs(fit, points, found, limbs, Monitor())
    assert better.score > found.score and min(limb.certainty for limb in find._legs(again)) > find.ELSEWHERE
    ankle, true = NAMES.index("ankle.R"), _joints(pose)
    assert np.linalg.norm(better.joints_m[ankle] - true[ankle]) < 0.1 < np.linalg.norm(found.joints_m[ankle] - true[ankle])
    assert find._with_legs(fit, points, better, again, Monitor())[0] is better


@pytest.mark.slow
def test_a_forearm_without_evidence_of_its_own_is_not_certain_until_it_is_clicked(monkeypatch) -> None:
    pose = _pose(0.0)
    given = _input(pose, points=6000)
    seen = _limbs(given, pose, monkeypatch)
    assert set(seen) == {"elbow.R", "elbow.L", "knee.R", "knee.L"} and all(0 <= limb.certainty <= 1 for limb in seen.values())
    joints, cloud = dict(zip(NAMES, _joints(pose))), given.clouds[0]
    a, b = joints["shoulder.R"], joints["wrist.R"] + 0.5 * (joints["wrist.R"] - joints["elbow.R"])
    X, elbow = cloud.xyz_m, joints["elbow.R"]
    along = [p + f * (q - p) for p, q in ((a, elbow), (elbow, b)) for f in np.linspace(0.2, 1, 9)]
    near = np.min([np.linalg.norm(X - place, axis=1) for place in along], axis=0)
    kept = {key: value if key == "frame" else value[near > 0.1] for key, value in vars(cloud).items()}
    bare = replace(given, clouds=[SimpleNamespace(**kept)])
    lost = _limbs(bare, pose, monkeypatch)
    assert lost["elbow.R"].certainty < 0.3 and seen["elbow.R"].certainty > 0.6, (lost["elbow.R"].certainty, seen["elbow.R"].certainty)
    assert surely(list(lost.values())) <= lost["elbow.R"].certainty
    assert _least_sure(list(lost.values()), 0.1, set()) in ("elbow.R", "wrist.R")
    assert _least_sure(list(lost.values()), 0.1, {"elbow.R", "wrist.R"}) is None and _least_sure(list(lost.values()), 1.0, set()) is None
    assert _with_limbs({"where the right arm is": 0.01}, list(lost.values()), 0.8)["where the right arm is"] > 0.4
    clicks = {0: {"wrist.R": {c.name: c.project(joints["wrist.R"]) for c in front_rig(WIDE_PX).cameras}}}
    assert _limbs(replace(bare, clicks=clicks), pose, monkeypatch)["elbow.R"].certainty > 0.7


@pytest.mark.parametrize("model", [AUTO_BODY, "full", "arm.R"])
def test_a_search_keeps_to_the_limits_of_the_take(model: str, monkeypatch) -> None:
    limits, used = {"elbow.R flexion": (0.1, 2.0)}, {}
    monkeypatch.setattr(set_up, "find_start", lambda fit, *_: used.setdefault("model", fit.model))
    find_joints(_input(_pose(0.0), model=model, limits=limits), SETTINGS, Monitor())
    dofs = {dof.name: dof.limits for dof in used["model"].skeleton.dofs}
    assert used["model"].name == "full" and dofs["elbow.R flexion"] == limits["elbow.R flexion"] and dofs["elbow.L flexion"][0] == 0.0


def test_points_of_nobody_ask_for_clicks(make_scene) -> None:
    scene = make_scene(points=50)
    given = FitInput(rig=scene.rig, model="arm.R", clouds=scene.clouds, time_s=np.zeros(1))
    with pytest.raises(NobodyFound, match="cannot start by itself.*at least two of the joints shoulder.R, elbow.R, wrist.R in two views"):
        with_start(given, SETTINGS, Monitor())


def test_a_search_can_be_cancelled() -> None:
    monitor = Monitor()
    monitor.cancel()
    with pytest.raises(Cancelled):
        find_joints(_input(_pose(0.0)), SETTINGS, monitor)


def test_what_the_image_shows_of_the_person() -> None:
    camera = SimpleNamespace(name="C", size_px=(640, 480), focal_px=480.0, to_camera=lambda X: X, project=lambda X: X[:, :2])
    X = np.array([[300.0, 200.0, 1.5]])

    def shown(low: tuple[float, float], high: tuple[float, float]) -> search.Framing:
        cells = SimpleNamespace(xy_px=np.array([low, high]), camera=camera, distance=SimpleNamespace(step_px=4))
        return search.framing(SimpleNamespace(cells=[cells], points=SimpleNamespace(xyz_m=X)), camera)

    assert shown((100, 50), (300, 400)) is search.Framing.WHOLE and shown((100, 50), (300, 477)) is search.Framing.UPPER
    cut = [((2, 50), (300, 400)), ((100, 2), (300, 477)), ((100, 50), (637, 477)), ((100, 300), (300, 400))]  # the last one is too small
    assert {shown(*at) for at in cut} == {search.Framing.CUT}

    def of_points(first: float, last: float) -> search.Framing:
        rows = np.linspace(first, last, 100)
        X = np.stack([np.full(100, 300.0), rows, np.full(100, 1.5)], axis=1)
        return search.framing(SimpleNamespace(cells=[], points=SimpleNamespace(xyz_m=X)), camera)

    assert [of_points(60, 420), of_points(60, 478), of_points(2, 300), of_points(300, 340)] == [
        search.Framing.WHOLE, search.Framing.UPPER, search.Framing.CUT, search.Framing.CUT,
    ]  # fmt: skip


def _cut(model: str = AUTO_BODY) -> tuple[FitInput, np.ndarray]:
    """A person of whom the image shows the head, the arms and the trunk, and the pose."""
    pose, rig = _pose(20.0), front_rig(1500.0)
    pose[SKELETON.layout.group("base")] = 0.0, 0.0, -0.45
    cloud = measured_cloud(SHAPE, pose, 0, np.random.default_rng(0), points=4000, noise=0.002, gross=0.01)
    seen = np.all([camera.sees(camera.project(cloud.xyz_m)) for camera in rig.cameras], axis=0)
    inside = SimpleNamespace(**{key: value if key == "frame" else value[seen] for key, value in vars(cloud).items()})
    return FitInput(rig=rig, model=model, clouds=[inside], time_s=np.zeros(1)), pose


@pytest.mark.slow
def test_an_upper_body_is_found_where_the_image_cuts_the_person(quick, monkeypatch) -> None:
    given, pose = _cut()
    found = find_joints(given, SETTINGS, Monitor(), RARE)
    assert found is not None and found.model == "upper_body" and "hip.R" not in found.xyz_m
    truth = dict(zip(NAMES, _joints(pose)))
    off = {name: np.linalg.norm(found.xyz_m[name] - truth[name]) for name in ("shoulder.R", "shoulder.L", "neck")}
    assert max(off.values()) < 0.12, off
    assert find_joints(replace(given, model="full"), SETTINGS, Monitor()) is None  # a whole body is not begun by a part of it
    monkeypatch.setattr(set_up, "find_joints", lambda *_: replace(found, probability=0.99))
    limits = {"elbow.R flexion": (0.0, 2.0), "knee.R flexion": (0.0, 2.0)}
    started = with_start(replace(given, limits=limits, locked=("hip.L flexion",)), SETTINGS, Monitor())
    assert started.model == "upper_body" and [*started.limits] == ["elbow.R flexion"] and not started.locked
    assert with_start(replace(given, model="arm.R"), SETTINGS, Monitor()).model == "arm.R"


@pytest.mark.slow
def test_a_click_finds_a_person_whom_other_borders_cut_but_not_instead_of_a_clicked_limb(quick, monkeypatch) -> None:
    """Something that moves at the border of the image counts as the person until somebody says where that is."""
    monkeypatch.setattr(find, "framing", lambda *_: search.Framing.CUT)
    given, pose = _cut()
    joints, cameras = dict(zip(NAMES, _joints(pose))), given.rig.cameras

    def clicked(*names: str) -> FitInput:
        return replace(given, clicks={0: {name: {c.name: c.project(joints[name]) for c in cameras} for name in names}})

    assert find_joints(given, SETTINGS, Monitor(), RARE) is None
    found = find_joints(clicked("shoulder.L"), SETTINGS, Monitor(), RARE)
    assert found is not None and found.model == "upper_body"
    assert np.linalg.norm(found.xyz_m["shoulder.L"] - joints["shoulder.L"]) < 0.05
    assert find_joints(clicked("shoulder.R", "elbow.R", "wrist.R"), SETTINGS, Monitor(), RARE) is None


def test_without_a_model_clicks_on_a_limb_choose_it(monkeypatch) -> None:
    given, joints = _input(_pose(0.0), model=AUTO_BODY), dict(zip(NAMES, _joints(_pose(0.0))))
    monkeypatch.setattr(set_up, "find_joints", lambda *_: None)
    start = StartJoints(frame=0, xyz_m=joints, stature=1.0, model="full", probability=0.1, rivals={"front and back": 0.9}, ask="elbow.R")
    with monkeypatch.context() as improbable, pytest.raises(NobodyFound, match="may be no person that is seen. It is not certain how"):
        improbable.setattr(set_up, "find_joints", lambda *_: start)
        with_start(given, SETTINGS, Monitor())
    with pytest.raises(
        NobodyFound, match="or cut by nothing but its lower border. Click at least three.*or choose the limb that is filmed"
    ):
        with_start(given, SETTINGS, Monitor())
    for model, names in (
        ("arm.R", ("shoulder.R", "elbow.R", "wrist.R")),
        ("leg.L", ("hip.L", "knee.L")),
        ("upper_body", ("neck", "wrist.L")),
    ):
        clicks = {0: {name: {c.name: c.project(joints[name]) for c in front_rig(WIDE_PX).cameras} for name in names}}
        assert smallest_model({*names}) == model
        if model != "upper_body":
            assert with_start(replace(given, clicks=clicks), SETTINGS, Monitor()).model == model
    trunk = ("hip.R", "hip.L", "neck")
    clicks = {0: {name: {c.name: c.project(joints[name]) for c in front_rig(WIDE_PX).cameras} for name in trunk}}
    assert with_start(replace(given, clicks=clicks), SETTINGS, Monitor()).model == "full"


def test_a_start_is_needed_without_three_joints_of_the_trunk() -> None:
    given, at = _input(_pose(0.0)), dict(zip(NAMES, _joints(_pose(0.0))))
    clicks = {name: {c.name: c.project(xyz) for c in front_rig(WIDE_PX).cameras} for name, xyz in at.items()}

    def clicked(*names: str) -> FitInput:
        return replace(given, clicks={0: {name: clicks[name] for name in names}})

    assert needs_start(given, SETTINGS) and needs_start(clicked("elbow.R", "wrist.R"), SETTINGS)
    assert not needs_start(clicked("hip.R", "hip.L", "neck", "wrist.R"), SETTINGS)
    arm = replace(clicked("shoulder.R", "elbow.R"), model="arm.R")
    assert not needs_start(arm, SETTINGS)


def test_clicks_where_the_start_is_not_certain_correct_a_start_elsewhere(monkeypatch) -> None:
    """A click on an arm that is guessed must not make a start uncertain that was certain without it."""
    at = dict(zip(NAMES, _joints(_pose(0.0))))
    clicks = {1: {"elbow.L": {c.name: c.project(at["elbow.L"]) for c in front_rig(WIDE_PX).cameras}}}
    given = _input(_pose(0.0))
    given = replace(given, clouds=given.clouds * 3, time_s=np.arange(3) / 25.0, frames=range(3), clicks=clicks)
    joints = dict(xyz_m=at, stature=1.0, model="full", unsure=(), rivals={}, ask="ankle.R")

    for (sure, p), frame in {(2, 0.99): 2, (2, 0.9): 1, (1, 0.99): 1}.items():
        free = StartJoints(frame=sure, probability=p, **joints)
        bound = StartJoints(frame=1, probability=0.9, **joints)
        monkeypatch.setattr(set_up, "find_start", lambda fit, *_, free=free, bound=bound: bound if fit.clicked else free)
        start = find_joints(given, SETTINGS, Monitor())
        assert start is not None and start.frame == frame
    one = [_explained(_joints(_pose(0.0)), 0.0)]
    assert _decisive(one, np.ones(1), ("pelvis", "elbow.L", "elbow.R", "knee.L"), np.array([2])) == "elbow.L"
    assert _decisive(one, np.ones(1), ("pelvis", "elbow.L", "knee.L"), np.array([1])) == "knee.L"


def test_an_uncertain_start_is_not_used(monkeypatch) -> None:
    joints = dict(zip(NAMES, _joints(_pose(0.0))))
    start = StartJoints(frame=0, xyz_m=joints, stature=1.0, model="full", probability=0.7, rivals={"front and back": 0.28}, ask="elbow.R")
    monkeypatch.setattr(set_up, "find_joints", lambda *_: start)
    given = _input(_pose(0.0))
    with pytest.raises(InputError, match=r"not certain.*front and back. Click the right elbow in two views of frame 0"):
        with_start(given, SETTINGS, Monitor())
    monkeypatch.setattr(set_up, "find_joints", lambda *_: replace(start, probability=0.99))
    used = with_start(given, SETTINGS, Monitor())
    fit = set_up.fit_context(used, SETTINGS)
    assert fit.click == 0 and not fit.located.any() and np.allclose(fit.clicks.xyz_m, _joints(_pose(0.0)))
    assert "wrist.L" in fit.found and not fit.unsure
    hidden = replace(used, start=replace(start, unsure=("wrist.R",)))
    assert set_up.fit_context(hidden, SETTINGS).unsure == ("wrist.R",)


def test_a_motion_that_a_rival_explains_better_takes_its_start_back(monkeypatch) -> None:
    points = [SimpleNamespace(xyz_m=np.zeros((200, 3)))] * 9
    start = StartJoints(frame=0, xyz_m={}, stature=1.0, model="full", probability=0.99, rivals={}, ask="elbow.R")
    monkeypatch.setattr(taken_back, "thinned_points", lambda one: one)
    monkeypatch.setattr(taken_back, "explanation", lambda _fit, t, *_: _explained(np.zeros((1, 3)), 1000.0, t))
    monkeypatch.setattr(taken_back, "adjusted", lambda _fit, _points, found, *_: found)
    gain = dict.fromkeys(EXCHANGES.values(), -50.0)
    monkeypatch.setattr(taken_back, "exchanged", lambda _fit, _p, found, parts, *_, **__: replace(found, score=found.score + gain[parts]))
    fit = SimpleNamespace(model=MODEL)
    judge = partial(taken_back.taken_back, fit, start, points, np.zeros((9, 1)), np.zeros(1), Monitor())
    assert judge() is None
    gain[EXCHANGES["front and back"]] = 30.0
    assert judge() is None  # 90 voxels in three frames
    gain[EXCHANGES["front and back"]] = 60.0
    assert "front and back. Click the right elbow" in judge().question


def test_joints_that_are_left_to_other_frames_are_not_written_as_clicks() -> None:
    joints = dict(zip(NAMES, _joints(_pose(0.0))))
    start = StartJoints(frame=0, xyz_m=joints, stature=1.0, model="full", probability=0.99, rivals={}, ask="elbow.R", unsure=("wrist.R",))
    footage = SimpleNamespace(rig=front_rig(WIDE_PX))
    every, some = pixels_of(footage, start.xyz_m, ()), pixels_of(footage, start.xyz_m, start.unsure)
    assert set(every) - set(some) == {"wrist.R"} and "wrist.L" in some


def _explained(joints: np.ndarray, score: float, t: int = 0) -> Explanation:
    return Explanation(t=t, pose=np.zeros(1), vector=np.zeros(1), score=score, joints_m=joints)


def _turned(joints: np.ndarray) -> np.ndarray:
    """The same limbs of a person who faces the other way."""
    sides = [NAMES.index(n.replace(".L", ".X").replace(".R", ".L").replace(".X", ".R")) for n in NAMES]
    return joints[sides]


class _Fit:
    model = MODEL


def _judged(*found: Followed, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> find.Judged:
    return judged(_Fit(), found, {0: np.array(velocity), 1: np.array(velocity)})


def _moved(joints: np.ndarray) -> np.ndarray:
    """The same with the right ankle elsewhere."""
    return joints + np.where(np.array(NAMES)[:, None] == "ankle.R", [0.4, 0.0, 0.0], 0.0)


def test_probabilities_and_the_click_that_decides() -> None:
    right = _joints(_pose(0.0))
    scores = {1000.0: right, 990.0: right + 0.01, 1000.0 - find.TAU: _moved(right)}
    found = _judged(*(Followed(found=_explained(joints, score)) for score, joints in scores.items()))
    explanations = [one.found for one in found.followed]
    assert len(explanations) == 2 and np.allclose(found.probability, [1 / (1 + np.exp(-1)), 1 / (1 + np.exp(1))])
    assert _decisive(explanations, found.probability, NAMES, np.zeros(0, int)) == "ankle.R"
    assert _decisive(explanations, found.probability, NAMES, np.array([NAMES.index("ankle.R")])) != "ankle.R"  # clicked already
    assert _difference(*explanations, NAMES) == "where the right leg is"
    both = [Followed(found=_explained(joints, 1000.0)) for joints in (right, _turned(right))]
    back = _judged(*both, velocity=(0.0, -1.0, 0.0))
    assert back.probability[0] > 0.85 and back.followed[0].found.joints_m is right  # who walks faces forwards
    assert _difference(*(one.found for one in back.followed), NAMES) == "front and back"


def test_what_two_frames_show_decides_together() -> None:
    right = _joints(_pose(0.0))
    lucky = Followed(found=_explained(_moved(right), 1050.0, 0), elsewhere=[_explained(_moved(right), 800.0, 1)])
    true = Followed(found=_explained(right, 1000.0, 1), elsewhere=[_explained(right, 1000.0, 0)])
    met = Followed(found=_explained(_moved(right), 1040.0, 0), elsewhere=[_explained(right, 900.0, 1)])  # like others in one frame only
    found = _judged(lucky, true, met)
    assert found.followed[0] is true and found.probability[0] > 0.7 and len(found.followed) == 3


def test_an_explanation_of_one_frame_alone_is_not_certain() -> None:
    right = _joints(_pose(0.0))
    one = Followed(found=_explained(right, 1000.0, 0), elsewhere=[_explained(right, 1000.0, 1)])
    assert is_confirmed(one, [[one.found], [_explained(right + 0.05, 900.0, 1)]], NAMES)
    assert not is_confirmed(one, [[one.found], [_explained(_moved(right), 900.0, 1)]], NAMES)
    better = _explained(_moved(right), 950.0, 1)
    assert not is_confirmed(one, [[one.found], [better, _explained(right, 900.0, 1)]], NAMES)  # by a worse rival of that frame
    assert not is_confirmed(one, [[one.found]], NAMES)


def _clicked(joints: np.ndarray, name: str) -> SimpleNamespace:
    """A fit in which a joint is clicked, in all views of frame index 0."""
    cameras = front_rig(WIDE_PX).cameras
    row, xyz = NAMES.index(name), joints[NAMES.index(name)]
    xy = np.stack([camera.project(xyz[None])[0] for camera in cameras])
    return SimpleNamespace(clicked={0: SimpleNamespace(cameras=cameras, joint=np.full(len(cameras), row), xy_px=xy)})


def test_a_missed_click_is_measured_across_the_view() -> None:
    right = _joints(_pose(0.0))
    fit = _clicked(right, "ankle.R")
    assert missed_m(fit, _explained(right, 0.0)) < 1e-9 and missed_m(fit, _explained(right, 0.0, 1)) == 0.0  # no clicks in frame 1
    assert 0.3 < missed_m(fit, _explained(_moved(right), 0.0)) < 0.45
    assert np.exp(-0.5 * (0.26 / find.MISSED_M) ** 2) < 0.01  # so that a start with a clicked joint 26 cm off is not used


def _write_take(folder: Path, clicks: str) -> None:
    views = "".join(f'[[views]]\nname = "{v}"\nimages = "{v}/*.png"\n' for v in "LR")
    (folder / "take.toml").write_text(f'format = "tricap-take"\nversion = 1\nfps = 25.0\nrig = "rig.toml"\n{views}{clicks}')


ELBOW = '"elbow.R" = { L = [1.0, 2.0], R = [3.0, 4.0] }\n'


def test_found_joints_are_written_as_clicks_beside_clicked_ones(tmp_path: Path) -> None:
    _write_take(tmp_path, f"[seeds]\nframe = 3\n[seeds.joints]\n{ELBOW}")
    found = {"elbow.R": {"L": [9.0, 9.0], "R": [9.0, 9.0]}, "knee.L": {"L": [5.0, 6.0], "R": [7.0, 8.0]}}
    assert write_joints_as_clicks(tmp_path, 3, found)
    joints = read_table(tmp_path)["seeds"]["joints"]
    assert joints == {"elbow.R": {"L": [1.0, 2.0], "R": [3.0, 4.0]}, "knee.L": {"L": [5.0, 6.0], "R": [7.0, 8.0]}}
    assert not write_joints_as_clicks(tmp_path, 3, found)


@pytest.mark.parametrize("surface", ["", "surface = [ { L = [5.0, 5.0], R = [6.0, 6.0] } ]\n"])
def test_clicks_in_other_frames_stay_in_their_frames(tmp_path: Path, surface: str) -> None:
    clicks = f"[seeds]\nframe = 3\n{surface}[seeds.joints]\n{ELBOW}[[keyframes]]\nframe = 7\n[keyframes.joints]\n{ELBOW}"
    _write_take(tmp_path, clicks)
    assert write_joints_as_clicks(tmp_path, 7, {"knee.L": {"L": [5.0, 6.0], "R": [7.0, 8.0]}})
    take = read_take(tmp_path)
    assert {key.frame: set(key.joints) for key in (take.clicks, *take.keyframes) if key.joints} == {
        3: {"elbow.R"},
        7: {"elbow.R", "knee.L"},
    }
    assert (take.clicks.frame, len(take.clicks.surface)) == ((3, 1) if surface else (7, 0))
