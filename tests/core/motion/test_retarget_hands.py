"""Hands that hold each other, or rest on the hips, do so on a body of other proportions."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.motion.retarget.contacts import FeetSettings
from tricap.core.motion.retarget.feet import bend_limb
from tricap.core.motion.retarget.hands import find_arms, middle
from tricap.core.motion.retarget.mapping import find_map
from tricap.core.motion.retarget.retarget import RetargetSettings, retarget
from tricap.core.motion.retarget.rig import Motion, Rig, channels, posed

from .persons import flail, mapped, mapped_rig, person

OFF = FeetSettings(mode="off")


def longer_arms(rig: Rig, by_m: float) -> Rig:
    """The same person, with longer upper arms and forearms; in the T-pose arms run along x."""
    head, tail = np.array(rig.head_m), np.array(rig.tail_m)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        for part, before, after in (("upper_arm", 0, 1), ("forearm", 1, 2), ("hand", 2, 2)):
            b = rig.index[f"{part}.{side}"]
            head[b, 0] += sign * by_m * before
            tail[b, 0] += sign * by_m * after
    return replace(rig, head_m=head, tail_m=tail)


def reaching(rig: Rig, goals: dict[str, tuple[float, float, float]], frames: int = 30) -> Motion:
    """The wrists go from where the arms hang out to places beside the body, and back."""
    R = np.array(posed(rig, np.broadcast_to(np.eye(3), (frames, len(rig.names), 3, 3)))[0])
    head = np.broadcast_to(rig.head_m, (frames, *rig.head_m.shape))
    part = np.sin(np.linspace(0, np.pi, frames))[:, None]
    for side, arm in find_arms(rig, find_map(rig)).items():
        start = rig.head_m[arm.end]
        goal = start + part * (np.array(goals[side]) - start)
        back = np.broadcast_to([0.0, 1.0, 0.0], goal.shape)
        R = bend_limb(arm, R, head[:, arm.upper[0]], goal, back)
    basis = channels(rig, R)
    for side in "LR":
        basis[:, rig.index[f"hand.{side}"]] = np.eye(3)
    R, head = posed(rig, basis)
    return Motion(rig=rig, fps=30.0, frames=np.arange(frames), R=R, head_m=head)


def palms(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    known = find_map(motion.rig)
    return middle(motion, known, "hand.L"), middle(motion, known, "hand.R")


def moved(source: Motion, target: Rig, hands: str) -> Motion:
    return retarget(mapped(source), mapped_rig(target), RetargetSettings(hands=hands), OFF).motion


@pytest.mark.parametrize("size", [1.0, 1.4])
def test_hands_that_hold_each_other_still_do(size: float) -> None:
    source = reaching(person(), {"L": (0.14, -0.35, 1.2), "R": (-0.14, -0.35, 1.2)})
    target = person(size=size, roll_seed=4) if size != 1.0 else longer_arms(person(), 0.06)
    apart = {}
    for hands in ("free", "keep"):
        a, b = palms(moved(source, target, hands))
        apart[hands] = np.linalg.norm(a - b, axis=1)[15]
    true = np.linalg.norm(np.subtract(*palms(source)), axis=1)[15] * size
    assert abs(apart["keep"] - true) < 0.005 * size
    assert size != 1.0 or abs(apart["free"] - true) > 0.015


def test_hands_on_the_hips_and_far_from_everything() -> None:
    source = reaching(person(), {"L": (0.22, -0.05, 1.02), "R": (-0.22, -0.05, 1.02)})
    target = longer_arms(person(), 0.05)
    known = find_map(target)
    free, kept = (moved(source, target, hands) for hands in ("free", "keep"))

    def off(motion: Motion) -> np.ndarray:
        hips = [middle(m, find_map(m.rig), "hips") for m in (motion, source)]
        return np.linalg.norm((palms(motion)[0] - hips[0]) - (palms(source)[0] - hips[1]), axis=1)

    assert off(kept)[15] < 0.4 * off(free)[15]
    np.testing.assert_array_equal(kept.R[0], free.R[0])  # arms stretched out: nothing is near
    steps = np.linalg.norm(np.diff(middle(kept, known, "hand.L"), axis=0), axis=1)
    assert steps.max() < 1.6 * np.linalg.norm(np.diff(middle(free, known, "hand.L"), axis=0), axis=1).max()  # no jump


def test_rigs_without_hands_are_left_alone() -> None:
    source = flail(person())
    target = person(without=("hand",))
    np.testing.assert_array_equal(moved(source, target, "keep").R, moved(source, target, "free").R)
