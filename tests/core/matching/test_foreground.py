"""Where the person is in the next frame, from seeds of which some are false."""

from typing import Any

import numpy as np

from tricap.core.images.interlace import row_grid
from tricap.core.images.sampling import SplineImage
from tricap.core.matching.foreground import MARGIN_M, Foreground, after, without_small_groups
from tricap.core.matching.seeds import at_an_end
from tricap.core.matching.views import Views

RANDOM = np.random.default_rng(5)
PERSON_M = 3.8 + RANDOM.normal(0.0, 0.12, 90)


def followed(false_m: np.ndarray, frames: int = 12) -> Foreground:
    """The depths after some frames, in each of which there are seeds of the person, and false ones wherever seeds are searched for."""
    where = Foreground(depth_range_m=(3.2, 4.4), method="nearest surface")
    for _ in range(frames):
        near, far = where.depth_range_m
        seeds = np.concatenate([PERSON_M, near + false_m * (far - near)])
        where = after(seeds[(seeds > near) & (seeds < far)], where, confirmed=False)
    return where


def test_false_seeds_before_the_person_do_not_draw_the_depths_away() -> None:
    for false_m in (np.zeros(0), RANDOM.uniform(0, 1, 60), RANDOM.uniform(0, 0.5, 60)):  # with two views, false ones are as many
        near, far = followed(false_m).depth_range_m
        assert near < PERSON_M.min() and far > PERSON_M.max() and far - near < 2.5


def test_seeds_at_an_end_of_the_range_are_no_peaks(scenes: Any) -> None:
    rig = scenes.three_cameras()
    images = [SplineImage(np.zeros((40, 60), np.float32)) for _ in rig.cameras]
    views = Views(images=images, cameras=rig.cameras, reference=1, rows=row_grid("none"))
    depth = np.array([2.0, 2.001, 2.5, 3.0, 3.99, 4.0])
    assert at_an_end(views, depth, (2.0, 4.0)).tolist() == [True, True, False, False, True, True]


def test_a_limb_before_the_person_is_within_the_depths() -> None:
    arm = np.linspace(2.9, 3.6, 12)
    for confirmed in (True, False):
        before = Foreground(depth_range_m=(2.8, 4.4), method="nearest surface")
        near, far = after(np.concatenate([PERSON_M, arm]), before, confirmed=confirmed).depth_range_m
        assert near < 2.9 - 0.7 * MARGIN_M and far > PERSON_M.max()


def test_seeds_near_a_wall_do_not_show_where_the_person_is() -> None:
    wall = Foreground(depth_range_m=(3.2, 4.4), method="nearest surface", planes=np.array([[0.0, -1.0, 0.0, -1.18]]))
    xyz = np.array([[0.0, y, 1.0] for y in (-0.2, 0.0, 0.3, 1.05, 1.12, 1.18, 1.2)])
    assert wall.off_planes(xyz)[:, 1].tolist() == [-0.2, 0.0, 0.3, 1.05]
    assert len(Foreground(depth_range_m=(3.2, 4.4), method="everything").off_planes(xyz)) == len(xyz)


def test_a_person_who_walks_away_is_followed_though_a_place_of_the_wall_is_always_matched_before_it() -> None:
    """Three false seeds held the near end of the depths, and with it the far one: the person left them within a second."""
    false, seeds = (
        np.array([[1.3, 0.9, 2.62], [1.45, 0.92, 2.68], [1.3, 0.75, 2.66]]),
        np.random.default_rng(3).normal(0, (0.2, 0.5, 0.1), (70, 3)),
    )
    for sift, followed_by in ((without_small_groups, True), (lambda xyz: xyz, False)):
        where = Foreground(depth_range_m=(2.4, 3.7), method="nearest surface")
        for middle in np.arange(3.0, 4.5, 0.04):
            seen = np.concatenate([seeds + [0, 0, middle], false])
            near, far = where.depth_range_m
            person = seen[(seen[:, 2] > near) & (seen[:, 2] < far)]
            where = after(person[:, 2], where, near_m=sift(person)[:, 2])
        assert (where.depth_range_m[1] > 4.5 + 0.15) == followed_by


def test_parts_of_a_person_that_are_apart_are_kept() -> None:
    random = np.random.default_rng(4)
    feet, head, trunk = (random.normal(middle, 0.05, (n, 3)) for middle, n in (((0, 0.9, 3), 8), ((0, -0.8, 3), 6), ((0, 0, 3), 40)))
    stray = np.array([[2.0, 0.0, 2.0], [-2.0, 0.0, 4.0]])
    together = np.concatenate([feet, head, trunk])
    assert np.array_equal(without_small_groups(np.concatenate([together, stray])), together)
    assert len(without_small_groups(stray)) == 2 and len(without_small_groups(np.zeros((0, 3)))) == 0, "without a group all stay"
