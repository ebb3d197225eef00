"""A rig is called foreign by matches that can be true, and by no others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.checking.rig_fit import clicked_pairs, consistent, rig_findings
from tricap.core.checking.view_matches import PairMatches
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.take import Seeds, Take, View

from ..conftest import three_cameras

NAMES, SIZE = ("L", "C", "R"), (640, 480)


def cameras() -> list[Camera]:
    return list(three_cameras(width=SIZE[0], height=SIZE[1], focal=800.0).cameras)


def knocked() -> list[Camera]:
    """C is turned by 3° about its own centre."""
    left, c, right = cameras()
    R = rotation_from_vector(np.array([0.052, 0.0, 0.01]))
    return [left, replace(c, R_cam_world=R @ c.R_cam_world, t_cam_world_m=R @ c.t_cam_world_m), right]


def seen(i: int, j: int, count: int, *, noise_px: float = 0.5, shift_px: float = 0.0) -> PairMatches:
    """Points in the room as views i and j show them, those of j too low by `shift_px`."""
    random, rig = np.random.default_rng([i, j, count]), cameras()
    xyz = random.uniform([-0.5, -0.4, 1.7], [0.5, 0.4, 2.8], (count, 3))
    xi, xj = (rig[k].project(xyz) + random.normal(0, noise_px, (count, 2)) for k in (i, j))
    return PairMatches(i=i, j=j, xi_px=xi, xj_px=xj + [0.0, shift_px])


def chance(i: int, j: int, count: int) -> PairMatches:
    """What looks alike and is not the same, as from different sides of a person."""
    random = np.random.default_rng([9, i, j])
    return PairMatches(i=i, j=j, xi_px=random.uniform(0, SIZE, (count, 2)), xj_px=random.uniform(0, SIZE, (count, 2)))


def both(a: PairMatches, b: PairMatches) -> PairMatches:
    return replace(a, xi_px=np.concatenate([a.xi_px, b.xi_px]), xj_px=np.concatenate([a.xj_px, b.xj_px]))


def test_false_matches_of_views_from_different_sides_are_no_foreign_rig() -> None:
    """One pair fits, and most matches of all pairs miss: that pair does not vouch for the others' matches."""
    pairs = [both(seen(0, 1, 80), chance(0, 1, 20)), chance(0, 2, 110), chance(1, 2, 90)]
    assert not rig_findings(pairs, [], cameras(), NAMES)
    found = rig_findings(pairs, [], knocked(), NAMES)
    assert [f.cause for f in found] == ["foreign rig"] and found[0].figures["matches"] < 100
    assert not rig_findings(pairs[1:], [], knocked(), NAMES), "nothing to judge by"


@pytest.mark.parametrize("count", [24, 60, 200])
def test_matches_by_chance_have_no_geometry_of_their_own(count: int) -> None:
    assert consistent(chance(0, 1, count)) is None
    pair = consistent(both(seen(0, 1, 3 * count), chance(0, 1, count)))
    assert pair is not None and np.mean(np.abs(pair.miss_px(cameras())) < 3) > 0.9


def test_what_rests_counts_once() -> None:
    """A few static places, found again in every frame, are no more than a few."""
    few = seen(0, 1, 10)
    assert consistent(both(few, both(few, few))) is None


def test_clicks_speak_for_the_rig_or_against_it() -> None:
    """Matches of a pattern that repeats agree with each other, and with a wrong place."""
    pairs = [seen(0, 1, 80, shift_px=17.0)]
    assert [f.cause for f in rig_findings(pairs, [], cameras(), NAMES)] == ["foreign rig"]
    assert not rig_findings(pairs, [seen(0, 1, 12, noise_px=2.0)], cameras(), NAMES)
    assert rig_findings(pairs, [seen(0, 1, 3, noise_px=2.0)], cameras(), NAMES), "three clicks are too few"
    assert rig_findings(pairs, [seen(0, 2, 12, noise_px=2.0)], cameras(), NAMES), "of other views"
    assert rig_findings(pairs, [seen(0, 1, 12, shift_px=17.0)], cameras(), NAMES)


def test_clicks_of_all_frames_by_pairs_of_views() -> None:
    def at(*xy: float) -> np.ndarray:
        return np.array(xy)

    seeds = Seeds(joints={"elbow.R": {"L": at(1, 2), "R": at(3, 4)}, "neck": {"C": at(5, 6)}})
    later = Seeds(frame=3, joints={"elbow.R": {"L": at(7, 8), "C": at(9, 10), "R": at(11, 12)}})
    views = tuple(View(name=name, images=f"{name}/*.png") for name in NAMES)
    take = Take(folder=Path(), fps=25.0, views=views, rig_path=Path(), seeds=seeds, keyframes=(later,))
    pairs = {(p.i, p.j): p for p in clicked_pairs(take)}
    assert pairs[0, 2].xi_px.tolist() == [[1, 2], [7, 8]] and pairs[0, 2].xj_px.tolist() == [[3, 4], [11, 12]]
    assert (len(pairs[0, 1].xi_px), pairs[1, 2].xi_px.tolist()) == (1, [[9, 10]])
