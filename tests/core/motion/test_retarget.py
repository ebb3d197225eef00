"""The transfer on stick people: directions, rest poses, rolls, headings, missing parts, twist, feet."""

import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rotation import (
    EULER_MODES,
    about,
    angle_of,
    continuous,
    euler_from_matrix,
    matrix_from_euler,
    quaternion_from_matrix,
    transposed,
)
from tricap.core.motion.formats.bvh import write_bvh
from tricap.core.motion.retarget.contacts import FeetSettings, find_contacts, hysteresis, planted, steady, without_short
from tricap.core.motion.retarget.feet import Stand, carry_root
from tricap.core.motion.retarget.mapping import RigMap, find_map
from tricap.core.motion.retarget.measure import measure
from tricap.core.motion.retarget.retarget import Retargeted, RetargetSettings, retarget
from tricap.core.motion.retarget.rig import Motion, Rig, channels, needed_keys, posed, resampled
from tricap.core.motion.sources import body_motion, read_motion_source

from .persons import flail, mapped, mapped_rig, person, squat

OFF = FeetSettings(mode="off")
MOCAP = Path(__file__).resolve().parents[4] / "shared" / "mocap" / "cmu"
EXACT_DEG = 1e-5  # rounding of arccos-free angles; measured 2e-6
BACK_DEG = 1e-4  # promised: 1°; the transfer is exact but for what the chains' spreading rounds, measured 3e-6


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"size": 1.7},
        {"arms_down_deg": 48.0},
        {"legs_apart_deg": 12.0},
        {"heading_deg": 180.0},
        {"heading_deg": -70.0},
        {"roll_seed": 5},
        {"thigh_part": 0.6},
        {"without": ("clavicle",)},
        {"without": ("neck", "clavicle", "toe")},
        {"size": 0.3, "arms_down_deg": 70.0, "roll_seed": 9, "heading_deg": 90.0},
    ],
    ids=str,
)
def test_limbs_point_where_the_sources_do(change: dict[str, object]) -> None:
    source, target = flail(person(roll_seed=1)), person(**change)  # type: ignore[arg-type]
    source_map, target_map = find_map(source.rig), find_map(target)
    result = retarget(mapped(source, source_map), mapped_rig(target, target_map), feet_settings=OFF)
    figures = measure(mapped(source, source_map), mapped(result.motion, target_map), None)
    assert len(figures.by_part_deg) == 8 and figures.direction_worst_deg < EXACT_DEG, figures


@pytest.mark.parametrize("other", ["plain", "twist bones beside", "limbs of two bones"])
def test_there_and_back_again(other: str) -> None:
    """Every bone returns, whatever the other rig has for twist."""
    source, rig = flail(person(roll_seed=1)), person(arms_down_deg=45.0, heading_deg=180.0, roll_seed=2, size=0.6, thigh_part=0.55)
    maps = find_map(source.rig), find_map(rig)
    if other != "plain":
        rig, maps = split_limbs(rig, beside="beside" in other), (maps[0], find_map(split_limbs(rig, beside="beside" in other)))
        assert maps[1].twist if "beside" in other else len(maps[1].bones["shin.R"]) == 2, maps[1]
    there = retarget(mapped(source, maps[0]), mapped_rig(rig, maps[1]), feet_settings=OFF)
    back = retarget(mapped(replace(there.motion, residual=None), maps[1]), mapped_rig(source.rig, maps[0]), feet_settings=OFF)
    turned = np.degrees(angle_of(transposed(source.R) @ back.motion.R))
    assert turned.max() < BACK_DEG
    rise = back.motion.head_m - source.head_m  # the floor is found anew: all one height
    np.testing.assert_allclose(rise, np.broadcast_to((0.0, 0.0, rise[0, 0, 2]), rise.shape), atol=1e-6)


@pytest.mark.parametrize("own", [1, 3])
def test_spines_return_from_one_of_as_many_bones_or_more(own: int) -> None:
    """Cut at other places; of a spine on one of fewer bones only some can return."""
    mine = in_three(person(roll_seed=1), 0.2, 0.5) if own == 3 else person(roll_seed=1)
    source, rig = flail(mine), in_three(person(size=0.7), 0.4, 0.9)
    maps = find_map(source.rig), find_map(rig)
    assert (len(maps[0].bones["spine"]), len(maps[1].bones["spine"])) == (own, 3)
    there = retarget(mapped(source, maps[0]), mapped_rig(rig, maps[1]), feet_settings=OFF)
    back = retarget(mapped(replace(there.motion, residual=None), maps[1]), mapped_rig(source.rig, maps[0]), feet_settings=OFF)
    assert np.degrees(angle_of(transposed(source.R) @ back.motion.R)).max() < BACK_DEG


def in_three(rig: Rig, first: float, second: float) -> Rig:
    """The spine cut at two parts of its length."""
    b = rig.index["spine"]
    cuts = rig.head_m[b] + np.array([[0.0], [first], [second], [1.0]]) * (rig.tail_m[b] - rig.head_m[b])
    after = np.where(rig.parents >= b, rig.parents + 2, rig.parents)[b + 1 :]
    return Rig(
        names=(*rig.names[:b], "spine", "spine_2", "spine_3", *rig.names[b + 1 :]),
        parents=np.concatenate([rig.parents[: b + 1], [b, b + 1], after]),
        R_rest=np.insert(rig.R_rest, [b, b], rig.R_rest[b], axis=0),
        head_m=np.concatenate([rig.head_m[:b], cuts[:3], rig.head_m[b + 1 :]]),
        tail_m=np.concatenate([rig.tail_m[:b], cuts[1:], rig.tail_m[b + 1 :]]),
        connected=np.zeros(len(rig.names) + 2, dtype=bool),
        inherits_rotation=np.ones(len(rig.names) + 2, dtype=bool),
    )


def split_limbs(rig: Rig, *, beside: bool) -> Rig:
    """Forearms, shins, upper arms and thighs with a twist bone on their outer half; or cut in two, what follows hanging on the second."""
    names, parents = list(rig.names), list(rig.parents)
    R, head, tail = list(rig.R_rest), list(rig.head_m), list(rig.tail_m)
    for b, name in [(b, name) for b, name in enumerate(rig.names) if name.startswith(("forearm", "shin", "upper_arm", "thigh"))]:
        middle = (head[b] + tail[b]) / 2
        if not beside:
            parents = [len(names) if p == b else p for p in parents]
            tail[b] = middle
        names.append(f"{name[:-2]}_twist{name[-2:]}" if beside else f"{name[:-2]}_b{name[-2:]}")
        parents.append(b)
        R, head, tail = [*R, R[b]], [*head, middle], [*tail, rig.tail_m[b]]
    order = sorted(range(len(names)), key=lambda b: depth(parents, b))
    place = {b: i for i, b in enumerate(order)}
    n = len(names)
    return Rig(
        names=tuple(names[b] for b in order),
        parents=np.array([place.get(parents[b], -1) for b in order]),
        R_rest=np.array(R)[order],
        head_m=np.array(head)[order],
        tail_m=np.array(tail)[order],
        connected=np.zeros(n, dtype=bool),
        inherits_rotation=np.ones(n, dtype=bool),
    )


def depth(parents: list[int], b: int) -> int:
    return 0 if parents[b] < 0 else 1 + depth(parents, parents[b])


@pytest.mark.parametrize("name", ["squat", "02_01_walk", "02_04_jump_balance"])
def test_every_bone_returns_from_a_rig_on_which_feet_were_held(name: str) -> None:
    """Promised: 1°. Feet are held on both ways, on legs of other proportions; measured for single bones 0.5° RMS (walk) and 0.1° (jump)."""
    own, other = person(roll_seed=1), person(arms_down_deg=45.0, heading_deg=180.0, roll_seed=2, size=0.6, thigh_part=0.55)
    source = on_our_own(name).motion
    there = retarget(mapped(replace(source, residual=None), find_map(own)), mapped_rig(other))
    back = retarget(mapped(replace(there.motion, residual=None), find_map(other)), mapped_rig(own))  # as through a file
    turned = np.degrees(angle_of(transposed(source.R) @ back.motion.R))
    rms = dict(zip(own.names, np.sqrt(np.mean(turned**2, axis=0))))
    assert max(rms.values()) < 1.0, rms
    for motion, rig, result in ((there.motion, other, there), (back.motion, own, back)):
        figures = measure(mapped(source, find_map(own)), mapped(motion, find_map(rig)), result.contacts)
        assert max(figures.slide_mm, figures.penetration_mm) < 5.0 and figures.largest_step_deg < 90.0, figures


@pytest.mark.parametrize("name", ["02_01_walk", "02_04_jump_balance"])
def test_feet_that_were_held_are_left_alone(name: str) -> None:
    """Once more onto the same rig: the contacts are found again as they are, and nothing is to do. Measured 0.4° and 1e-3°."""
    own = person(roll_seed=1)
    once = on_our_own(name)
    twice = retarget(mapped(replace(once.motion, residual=None), find_map(own)), mapped_rig(own))
    turned = np.degrees(angle_of(transposed(once.motion.R) @ twice.motion.R))
    assert np.sqrt(np.mean(turned**2, axis=0)).max() < 0.6
    assert once.contacts is not None and twice.contacts is not None
    for side in "LR":
        assert np.mean(once.contacts.flat[side] == twice.contacts.flat[side]) > 0.98


@lru_cache
def on_our_own(name: str) -> Retargeted:
    """The motion on a stick person, feet held."""
    source, own = recorded(name), person(roll_seed=1)
    return retarget(mapped(source), mapped_rig(own))


@lru_cache
def recorded(name: str) -> Motion:
    """A real motion, or the squat of a stick person."""
    if name == "squat":
        return squat(person())
    if not (MOCAP / f"{name}.bvh").is_file():
        pytest.skip("the motions are not on this machine (no folder shared/mocap beside the repository)")
    return read_motion_source(MOCAP / f"{name}.bvh")


def test_a_heel_that_lifts_stands_no_more() -> None:
    """Of a foot whose ball stays while the heel rises the ball stands alone; a living foot's slow neighbours belong to its stand, a
    planted one's do not."""
    frames = np.arange(90)
    lift = np.radians(np.clip(frames - 60, 0, 30) + 0.5 * (-1.0) ** frames)
    flat = steady(about(np.array([1.0, 0.0, 0.0]), lift), np.ones(90, dtype=bool))
    assert flat[:63].all() and not flat[67:].any()
    drift = np.column_stack([np.where(frames < 60, 0.0, (frames - 60) * 2e-3), np.zeros(90), np.zeros(90)])
    on = np.ones(90, dtype=bool)
    assert planted(drift, on, 3.0).tolist() == [*[True] * 61, *[False] * 29]
    stirring = drift + np.random.default_rng(0).normal(0.0, 3e-4, drift.shape)
    assert planted(stirring, on, 3.0).all()


def test_the_channels_give_the_motion_again() -> None:
    target = person(roll_seed=4, arms_down_deg=30.0)
    result = retarget(mapped(flail(person()), find_map(person())), mapped_rig(target))
    R, head = posed(target, result.basis, {result.carrier: result.shift_m})
    np.testing.assert_allclose(R, result.motion.R, atol=1e-9)
    np.testing.assert_allclose(head, result.motion.head_m, atol=1e-9)


def test_twist_is_shared_and_moves_no_joint() -> None:
    source, target = flail(person()), person(roll_seed=3)
    maps = find_map(source.rig), find_map(target)
    plain, shared = (
        retarget(mapped(source, maps[0]), mapped_rig(target, maps[1]), RetargetSettings(twist=twist), OFF).motion
        for twist in ("off", "forearms")
    )
    np.testing.assert_allclose(shared.head_m, plain.head_m, atol=1e-9)
    b, hand = target.index["forearm.L"], target.index["hand.L"]
    np.testing.assert_allclose(shared.R[:, hand], plain.R[:, hand], atol=1e-12)
    assert np.degrees(angle_of(transposed(shared.R[:, b]) @ plain.R[:, b])).max() > 5.0


def test_twist_bones_take_their_share_by_place_not_by_name() -> None:
    """On Unreal's mannequin the first one is next to the wrist."""
    rig, b = person(), person().index["forearm.L"]
    places = rig.head_m[b] + np.array([[0.8], [0.4]]) * (rig.tail_m[b] - rig.head_m[b])
    more = Rig(
        names=(*rig.names, "forearm_twist_01.L", "forearm_twist_02.L"),
        parents=np.array([*rig.parents, b, b]),
        R_rest=np.concatenate([rig.R_rest, rig.R_rest[[b, b]]]),
        head_m=np.concatenate([rig.head_m, places]),
        tail_m=np.concatenate([rig.tail_m, places + 0.02]),
        connected=np.zeros(len(rig.names) + 2, dtype=bool),
        inherits_rotation=np.ones(len(rig.names) + 2, dtype=bool),
    )
    R = retarget(mapped(flail(person(), frames=12), find_map(person())), mapped_rig(more), feet_settings=OFF).motion.R
    outer, inner = (angle_of(transposed(R[:, b]) @ R[:, k]).max() for k in (-2, -1))
    assert outer > 1.5 * inner > 0.01


def test_feet_that_stand_stay_on_legs_of_other_proportions() -> None:
    source, target = squat(person()), person(thigh_part=0.58, size=0.8, roll_seed=6)
    maps = find_map(source.rig), find_map(target)
    loose, firm = (
        retarget(mapped(source, maps[0]), mapped_rig(target, maps[1]), feet_settings=FeetSettings(mode=mode)) for mode in ("off", "auto")
    )
    assert firm.contacts is not None and all(on.all() for on in firm.contacts.ankle.values())
    figures = measure(mapped(source, maps[0]), mapped(firm.motion, maps[1]), firm.contacts)
    assert measure(mapped(source, maps[0]), mapped(loose.motion, maps[1]), firm.contacts).slide_mm > 20.0
    assert figures.slide_mm < 0.1 and figures.penetration_mm < 0.1 and figures.float_mm < 0.1, figures
    assert figures.direction_rms_deg < 1.0, figures


@pytest.mark.parametrize("turn_deg", [(90, 0, 0), (-90, 0, 0), (0, 90, 0), (180, 0, 0), (60, 20, 130)], ids=str)
def test_a_rig_that_lies_in_its_rest_pose_stands_as_one_that_stood(turn_deg: tuple[int, int, int]) -> None:
    """Its soles were taken where they are in the rest pose: feet turned by up to 149° from one frame to the next."""
    source, upright = squat(person()), person(thigh_part=0.58, size=0.8)
    U = matrix_from_euler(np.radians(turn_deg), "XYZ")
    away = np.array([0.4, -0.14, 0.1])  # where it lies does not matter
    lying = replace(upright, R_rest=U @ upright.R_rest, head_m=upright.head_m @ U.T + away, tail_m=upright.tail_m @ U.T + away)
    rig_map = find_map(upright)
    stood, lay = (retarget(mapped(source), mapped_rig(rig, rig_map)).motion for rig in (upright, lying))
    ankles = [upright.index[rig_map.bones[f"foot.{side}"][0]] for side in "LR"]
    np.testing.assert_allclose(lay.head_m[:, ankles, 2], stood.head_m[:, ankles, 2] - upright.head_m[:, 2].min(), atol=1e-3)
    figures = measure(mapped(source), mapped(lay, rig_map), find_contacts(source, find_map(source.rig), FeetSettings(), 0.9))
    assert figures.slide_mm < 0.1 and figures.penetration_mm < 0.1 and figures.float_mm < 0.1, figures


def test_a_body_in_the_air_does_not_go_on_as_its_feet_had_it_move() -> None:
    """Over ten frames on the ground the path must be corrected by a centimetre more in each; after the jump no such thing goes on."""
    still, stiff = np.zeros((40, 3)), np.broadcast_to(np.eye(3), (40, 3, 3))
    stand = Stand(side="L", begin=0, end=11, path_m=np.linspace(0.0, 0.1, 11)[:, None] * (0.0, 0.0, 1.0))
    shift, _, _ = carry_root([stand], {"L": still}, {"L": still}, {"L": stiff}, 30.0, 0.9)
    np.testing.assert_allclose(shift[1:10, 2], stand.path_m[1:10, 2], atol=2e-3)
    assert 0.0 < shift[39, 2] - shift[10, 2] < 0.06, shift[:, 2]  # 0.23 without


@pytest.mark.parametrize("frames", [1, 2])
def test_a_motion_of_one_frame(frames: int, tmp_path: Path) -> None:
    write_bvh(tmp_path / "one.bvh", squat(person(), frames=frames))
    source, target = read_motion_source(tmp_path / "one.bvh"), person(thigh_part=0.55)
    result = retarget(mapped(source), mapped_rig(target))
    assert (
        len(result.motion.frames) == frames
        and measure(mapped(source), mapped(result.motion, find_map(target)), result.contacts).direction_rms_deg < 1.0
    )
    assert len(resampled(result.motion, 60.0, 1.0).frames) == 2 * frames - 1


@pytest.mark.parametrize("part", ["shoulder", "thigh"])
def test_the_full_models_clavicle_moves_the_targets(part: str) -> None:
    """30° of a joint of our own body are 30° on the target, and in the names of other programs, too."""
    shape, target = default_shape(read_model("full")), person(arms_down_deg=45.0)
    values = np.zeros((2, len(shape.skeleton.dof_names)))
    values[1, shape.skeleton.dof_names.index({"shoulder": "clavicle.R depression", "thigh": "hip.R flexion"}[part])] = np.radians(-30.0)
    source = body_motion(shape, values, np.arange(2), 25.0)
    found, bone = find_map(source.rig), target.index[{"shoulder": "clavicle.R", "thigh": "thigh.R"}[part]]
    assert found.bones["clavicle.R"] == ("shoulder.R",) and found.bones["spine"] == ("spine", "chest") and not found.missing
    R = retarget(mapped(source, found), mapped_rig(target), feet_settings=OFF).motion.R[:, bone]
    assert abs(np.degrees(angle_of(R[0].T @ R[1])) - 30.0) < 1e-6


def test_root_modes() -> None:
    source, target = flail(person()), person(size=2.0)
    maps = find_map(source.rig), find_map(target)
    travel, spot, still = (
        retarget(mapped(source, maps[0]), mapped_rig(target, maps[1]), RetargetSettings(root=root), OFF)
        for root in ("travel", "in place", "still")
    )
    went = travel.motion.head_m[:, 0] - travel.motion.head_m[0, 0]
    np.testing.assert_allclose(went[-1], 2.0 * (source.head_m[-1, 0] - source.head_m[0, 0]), atol=1e-6)
    np.testing.assert_allclose(np.ptp(spot.motion.head_m[:, 0, :2], axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(spot.travelling.head_m, travel.motion.head_m, atol=1e-9)  # where feet are measured
    np.testing.assert_allclose(still.motion.head_m[:, 0], np.broadcast_to(target.head_m[0], went.shape))


def test_a_measured_arm_alone_moves_an_arm_alone() -> None:
    whole = flail(person())
    keep = [whole.rig.index[n] for n in ("upper_arm.R", "forearm.R")]
    rig = Rig(
        names=("upper_arm.R", "forearm.R"),
        parents=np.array([-1, 0]),
        R_rest=whole.rig.R_rest[keep],
        head_m=whole.rig.head_m[keep],
        tail_m=whole.rig.tail_m[keep],
        connected=np.zeros(2, dtype=bool),
        inherits_rotation=np.ones(2, dtype=bool),
    )
    source = Motion(rig=rig, fps=30.0, frames=whole.frames, R=whole.R[:, keep], head_m=whole.head_m[:, keep])
    target = person(arms_down_deg=45.0)
    result = retarget(mapped(source, find_map(rig)), mapped_rig(target))
    assert {target.names[b] for b in np.flatnonzero(result.driven)} == {"upper_arm.R", "forearm.R"}
    assert result.carrier == -1 and any("travel" in note for note in result.notes)
    still = retarget(mapped(flail(person()), find_map(person())), mapped_rig(target), RetargetSettings(root="still"), OFF)
    assert still.carrier == -1 and not any("travel" in note for note in still.notes)


def test_parts_that_hang_elsewhere_are_carried() -> None:
    """A rig whose arms and legs are not children of the trunk, as in control rigs."""
    source, whole = flail(person()), person(arms_down_deg=30.0)
    cut = np.array([-1 if name.startswith(("clavicle", "thigh", "shin")) else p for name, p in zip(whole.names, whole.parents)])
    target = Rig(**{f: getattr(whole, f) for f in whole.__dataclass_fields__ if f != "parents"}, parents=cut)
    names = find_map(whole)
    one, other = (retarget(mapped(source), mapped_rig(rig, names), feet_settings=OFF) for rig in (whole, target))
    np.testing.assert_allclose(other.motion.head_m, one.motion.head_m, atol=1e-9)
    shifts = dict(other.loose_m) | {other.carrier: other.shift_m}
    assert {target.names[b][:-2] for b in other.loose_m} == {"clavicle", "thigh", "shin"}
    np.testing.assert_allclose(posed(target, other.basis, shifts)[1], one.motion.head_m, atol=1e-9)


def test_zero_pose_that_is_no_pose() -> None:
    """A source whose bones all lie along X in the rest pose, as some files have it."""
    true = flail(person(), reach=0.5)
    rig = true.rig
    along = np.array([1.0, 0.0, 0.0])
    head = np.zeros_like(rig.head_m)
    for b, p in enumerate(rig.parents):
        head[b] = head[p] + 0.3 * along if p >= 0 else 0.0
    broken = Rig(
        names=rig.names,
        parents=rig.parents,
        R_rest=np.broadcast_to(np.eye(3), rig.R_rest.shape),
        head_m=head,
        tail_m=head + along,
        connected=rig.connected,
        inherits_rotation=rig.inherits_rotation,
    )
    source = Motion(rig=broken, fps=30.0, frames=true.frames, R=true.R, head_m=true.head_m)
    target = person(arms_down_deg=45.0)
    result = retarget(mapped(source, find_map(rig)), mapped_rig(target), feet_settings=OFF)
    assert measure(mapped(source, find_map(rig)), mapped(result.motion, find_map(target)), None).direction_worst_deg < EXACT_DEG
    assert any("rest pose" in note for note in result.notes)


def test_bad_input_is_said() -> None:
    source, target = flail(person()), person()
    source_map = find_map(source.rig)
    with pytest.raises(InputError, match="in common"):
        retarget(mapped(source, source_map), mapped_rig(target, RigMap(bones={})))
    head = target.head_m.copy()
    head[target.index["shin.L"]] = head[target.index["thigh.L"]]
    with pytest.raises(InputError, match="thigh.L.*no length"):
        flat = Rig(
            names=target.names,
            parents=target.parents,
            R_rest=target.R_rest,
            head_m=head,
            tail_m=target.tail_m,
            connected=target.connected,
            inherits_rotation=target.inherits_rotation,
        )
        retarget(mapped(source, source_map), mapped_rig(flat, find_map(target)))
    with pytest.raises(InputError, match="not numbers"):
        Motion(rig=target, fps=30.0, frames=source.frames, R=source.R * np.nan, head_m=source.head_m)


def test_a_thousand_frames_take_seconds() -> None:
    source, target = squat(person(), frames=1000), person(thigh_part=0.55)
    began = time.perf_counter()
    retarget(mapped(source), mapped_rig(target))
    assert time.perf_counter() - began < 10.0  # measured 1 s alone on one slow core


def test_hysteresis_needs_both_thresholds() -> None:
    begin = np.array([0, 0, 1, 0, 0, 0, 0, 1, 0], dtype=bool)
    end = np.array([1, 0, 0, 0, 1, 1, 0, 0, 1], dtype=bool)
    assert hysteresis(begin, end).tolist() == [False, True, True, True, False, False, True, True, False]
    assert without_short(np.array([1, 1, 0, 1, 1, 0, 0, 0, 1, 0, 0, 0], dtype=bool), False, 2).tolist()[:5] == [True] * 5


@pytest.mark.parametrize("mode", EULER_MODES)
def test_euler_angles_are_blenders_and_do_not_jump(mode: str) -> None:
    t = np.linspace(0, 4 * np.pi, 200)
    angles = np.stack([t, 1.4 * np.sin(t), -2 * t], axis=1)
    R = matrix_from_euler(angles, mode)
    found = euler_from_matrix(R, mode)
    np.testing.assert_allclose(matrix_from_euler(found, mode), R, atol=1e-9)
    assert np.abs(np.diff(found, axis=0)).max() < 0.6


def test_quaternions_do_not_jump() -> None:
    R = matrix_from_euler(np.stack([np.linspace(0, 20, 300), np.zeros(300), np.zeros(300)], axis=1), "XYZ")
    q = continuous(quaternion_from_matrix(R))
    assert np.abs(np.diff(q, axis=0)).max() < 0.1


def test_channels_of_bones_that_do_not_inherit_rotation() -> None:
    rig = person(roll_seed=2)
    free = Rig(
        **{f: getattr(rig, f) for f in rig.__dataclass_fields__ if f != "inherits_rotation"},
        inherits_rotation=np.array(["head" not in name for name in rig.names]),
    )
    motion = flail(rig)
    R, _ = posed(free, channels(free, motion.R))
    np.testing.assert_allclose(R, motion.R, atol=1e-12)


def test_fewer_keys_within_the_tolerance() -> None:
    t = np.arange(200.0)
    values = np.stack([np.sin(t / 20), np.where(t < 100, 0.0, 1.0)], axis=1)
    keep = needed_keys(t, values, 0.01)
    again = np.stack([np.interp(t, t[keep], values[keep, i]) for i in range(2)], axis=1)
    assert len(keep) < 60 and np.abs(again - values).max() <= 0.01
    assert needed_keys(t, np.ones((200, 3)), 0.01).tolist() == [0]
    assert len(needed_keys(t, values, 0.0)) == 200


def test_keys_of_one_channel() -> None:
    frames = np.array([0, 1, 2, 5, 9])
    assert needed_keys(frames, 2.0 * frames, 1e-9).tolist() == [0, 4]
    assert needed_keys(frames, np.array([0, 0, 5, 0, 0]), 1.0).tolist() == [0, 1, 2, 3, 4]
    assert needed_keys(frames, np.array([3.0, 3.5, 2.5, 3.0, 3.0]), 0.5).tolist() == [0]
    assert needed_keys(frames[:1], frames[:1], 1.0).tolist() == [0] and needed_keys(frames[:0], frames[:0], 1.0).tolist() == []


def test_another_frame_rate() -> None:
    motion = flail(person(), frames=61)
    twice = resampled(motion, 60.0, 5.0)
    assert len(twice.frames) == 121 and twice.frames[0] == 5.0
    np.testing.assert_allclose(twice.R[::2], motion.R, atol=1e-9)
    np.testing.assert_allclose(twice.head_m[::2], motion.head_m, atol=1e-9)


def test_a_target_that_would_begin_in_its_source_is_moved_across_the_path() -> None:
    from tricap.core.motion.retarget.retarget import BESIDE_M, _beside_m

    walks = np.array([[0.0, 0.0, 0.9], [0.0, 1.0, 0.9], [0.0, 2.0, 0.9]])
    np.testing.assert_allclose(_beside_m(np.array([0.1, 0.0, 0.8]), walks), [BESIDE_M, 0, 0])
    np.testing.assert_allclose(_beside_m(np.array([0.0, 0.1, 0.8]), walks[:1].repeat(3, axis=0)), [BESIDE_M, 0, 0])
    np.testing.assert_array_equal(_beside_m(np.array([0.6, 0.0, 0.8]), walks), 0)
