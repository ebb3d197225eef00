"""The person before a still background: in other cloth or in cloth like the wall, and never as a ghost where somebody was."""

import cv2
import numpy as np
import pytest

from tricap.core.images.foreground import FEWEST, CellBackground, cells, given_background, person, still_background
from tricap.core.images.second_look import CLEAR, look_cost, second_is_background

SIZE = (90, 140)  # of an image in cells
NOISE = 1.5  # grey values, of a cell
RNG = np.random.default_rng(8)
WALL = (110 + 12 * cv2.GaussianBlur(RNG.standard_normal(SIZE), (0, 0), 1.5) * 5).astype(np.float32)
PRINT = 25 * RNG.standard_normal(SIZE)
NOBODY = np.zeros(SIZE, dtype=bool)


def _ellipse(x: float) -> np.ndarray:
    """Cells of a person who stands at x."""
    j, i = np.indices(SIZE)
    return np.asarray(((i - x) / 13) ** 2 + ((j - 45) / 30) ** 2 < 1)


def _image(x: float | None, cloth: np.ndarray, seed: int) -> np.ndarray:
    empty = WALL if x is None else np.where(_ellipse(x), cloth, WALL)
    return np.asarray(empty + NOISE * np.random.default_rng(seed).standard_normal(SIZE), dtype=np.float32)


def _walk(cloth: np.ndarray, count: int = 13) -> list[np.ndarray]:
    return [_image(x, cloth, seed) for seed, x in enumerate(np.linspace(20, 120, count))]


def _background(images: list[np.ndarray], near: list[np.ndarray] | None = None, seen: list[np.ndarray] | None = None) -> CellBackground:
    nobody = [NOBODY] * len(images)
    found = still_background(images, nobody if near is None else near, nobody if seen is None else seen, 4)
    assert found is not None
    return found


def _iou(found: np.ndarray | None, true: np.ndarray) -> float:
    assert found is not None
    return float((found & true).sum() / (found | true).sum())


def _near(x: float) -> np.ndarray:
    return cv2.dilate(_ellipse(x).astype(np.uint8), np.ones((7, 7))) > 0


def test_a_person_in_print() -> None:
    images = _walk(110 + PRINT)
    background = _background(images)
    assert np.abs(background.grey - WALL).mean() < NOISE and 0.8 * NOISE < background.noise < 1.5 * NOISE
    assert (background.known == 1).mean() > 0.995 and background.cell_px == 4  # a few cells have two looks by chance
    for t, x in ((0, 20), (6, 70), (12, 120)):
        assert _iou(person(background, images[t], NOBODY), _ellipse(x)) > 0.95
    assert not np.asarray(person(background, _image(None, WALL, 99), NOBODY)).any()


def test_a_person_in_cloth_as_bright_as_the_wall_is_found_about_a_few_measured_points() -> None:
    """Most of her differs from the wall by less than twice the noise."""
    plain = WALL + 2.5 * PRINT / PRINT.std()
    images = _walk(plain)
    true, seen = _ellipse(70), np.zeros(SIZE, dtype=bool)
    seen[20:72:4, 60:82:3] = True
    assert abs(float((plain - WALL)[true].mean())) < 0.5 and (np.abs(plain - WALL)[true] < 2 * NOISE).mean() > 0.7
    background = _background(images)
    found = person(background, images[6], seen & true)
    assert _iou(found, true) > 0.8 and not np.asarray(found)[:, :40].any()
    assert _iou(person(background, images[6], NOBODY), true) < 0.7


@pytest.mark.parametrize("drift", [0.0, 8.0])
def test_a_person_in_light_that_gets_brighter_and_before_a_lamp_that_drifts(drift: float) -> None:
    """The exposure grows by 8 % before a wall that is bright on one side; about a lamp, there are up to 8 grey values more."""
    share, i = np.linspace(-0.5, 0.5, 13), np.indices(SIZE)[1]
    ramp, lamp = 0.8 * (i - 70), drift * np.exp(-(((i - 130) / 30) ** 2))
    images = [np.float32((1 + 0.08 * s) * (image + ramp) + s * lamp) for s, image in zip(share, _walk(110 + PRINT))]
    background = _background(images)
    for t, x in ((0, 20), (6, 70), (12, 120)):
        assert _iou(person(background, images[t], NOBODY), _ellipse(x)) > 0.9


@pytest.mark.parametrize("told", [False, True])
def test_who_lingers_is_not_the_background_whether_or_not_it_is_told_where_she_is(told: bool) -> None:
    at = [40.0] * 9 + [100.0] * 4
    images = [_image(x, 150 + PRINT, seed) for seed, x in enumerate(at)]
    background = _background(images, [_near(x) for x in at] if told else None)
    stands, gone = (person(background, images[t], _near(x) & _ellipse(x)) for t, x in ((0, 40), (12, 100)))
    ghost = np.asarray(gone)[_ellipse(40)].mean()
    assert ghost == 0 and _iou(gone, _ellipse(100)) > 0.95 and _iou(stands, _ellipse(40)) > 0.95
    assert np.abs(background.grey - WALL)[_ellipse(40)].mean() < NOISE


def test_where_somebody_was_always_near_the_background_is_doubtful_and_where_nothing_stays_unknown() -> None:
    images, near = _walk(110 + PRINT), NOBODY.copy()
    for seed, image in enumerate(images):
        image[:20, :20] = 110 + 60 * np.random.default_rng([5, seed]).standard_normal((20, 20))  # leaves in the wind
    near[60:, 100:] = True
    background = _background(images, [near] * len(images))
    known = background.known
    assert (known[near] < 0.5).all() and (known[near] > 0).all() and (known[:20, :20] == 0).mean() > 0.9
    assert (known[25:55, 25:95] == 1).mean() > 0.99
    assert not np.asarray(person(background, images[6], NOBODY))[:18, :18].any()  # what differs from something unknown is not the person


def test_who_stood_there_all_the_time_and_was_not_always_measured_is_no_background() -> None:
    foot = (np.indices(SIZE)[0] > 60) & _ellipse(40)  # while the rest of her walks on
    images = [np.where(foot, _image(40, 150 + PRINT, seed), image) for seed, image in enumerate(_walk(150 + PRINT))]
    at = np.linspace(20, 120, 13)
    seen = [_ellipse(x) & ~foot | (foot if seed % 3 == 0 else NOBODY) for seed, x in enumerate(at)]
    near = [cv2.dilate(cells.astype(np.uint8), np.ones((7, 7))) > 0 for cells in seen]
    standing = foot & ~np.any([_near(x) for x in at[3::3]], axis=0)
    assert (_background(images, near).known[standing] == 1).any(), "or the test shows nothing"
    known = _background(images, near, seen).known
    assert (known[foot] == 0).mean() > 0.9 and (known[:55] == 1).all()


@pytest.mark.parametrize("standing", [8, 5])
def test_a_leg_that_stood_for_most_of_a_clip_is_the_person_and_what_it_uncovers_is_the_background(standing: int) -> None:
    """Nothing was measured on it. With `standing` 5 of 13 the wall is the more frequent look."""
    cloth = 150 + 0.2 * PRINT
    images = [_image(40 if t < standing else None, cloth, t) for t in range(13)]
    background = _background(images)
    inside = cv2.erode(_ellipse(40).astype(np.uint8), np.ones((3, 3))) > 0
    assert np.abs(background.grey - WALL)[inside].mean() < NOISE and (background.known[inside] == 1).mean() > 0.95
    assert _iou(person(background, images[0], NOBODY), _ellipse(40)) > 0.95
    assert not np.asarray(person(background, images[12], NOBODY)).any()


def test_a_second_look_needs_to_be_clear() -> None:
    """A cell alone in a flat wall: 12 images look like the wall, 4 otherwise; and two looks that the neighbours do not tell apart."""
    wall, other, one = np.full((9, 9), 100.0), np.full((9, 9), 100.0), np.zeros((9, 9), dtype=int)
    other[4, 4], one[4, 4] = 130.0, 4
    first, second = look_cost(np.full((9, 9), 12), 0 * one), look_cost(one, 0 * one)
    gain = second_is_background(wall, other, first, second, 1.0)
    assert gain[4, 4] < -CLEAR and np.isneginf(np.delete(gain.ravel(), 40)).all()
    swapped = np.where(one > 0, other, wall), np.where(one > 0, wall, other)
    assert second_is_background(*swapped, first, second, 1.0)[4, 4] > CLEAR  # the less frequent look continues the wall
    far = np.where(one > 0, 70.0, wall), other
    assert abs(second_is_background(*far, first, look_cost(3 * one, 0 * one), 1.0)[4, 4]) < CLEAR  # neither does
    measured = second_is_background(*far, look_cost(np.full((9, 9), 12), 4 * (one > 0)), look_cost(3 * one, 0 * one), 1.0)
    assert measured[4, 4] > CLEAR  # the person was measured there whenever it looked so
    assert np.isneginf(second_is_background(wall, other, first, look_cost(0 * one, 0 * one), 1.0)).all()


def test_the_background_stays_known_behind_a_measured_walker_in_cloth_like_it() -> None:
    at, plain = np.linspace(20, 120, 13), WALL + 2.5 * PRINT / PRINT.std()
    background = _background(_walk(plain), [_near(x) for x in at], [_ellipse(x) for x in at])
    assert (background.known == 0).mean() < 0.02


def test_too_few_images_have_no_background() -> None:
    images = _walk(110 + PRINT, FEWEST)
    for count in (FEWEST - 1, FEWEST):
        nobody = [NOBODY] * count
        assert (still_background(images[:count], nobody, nobody, 4) is None) == (count < FEWEST)


def test_a_black_image_or_another_light_shows_nobody_and_a_slightly_different_one_does() -> None:
    background = _background(_walk(110 + PRINT))
    assert person(background, np.zeros(SIZE, np.float32), NOBODY) is None
    assert person(background, _image(70, 110 + PRINT, 3) + 15, NOBODY) is None
    for change in (-4.0, -1.0, 2.0, 3.0):  # times the noise
        image = np.asarray(_image(70, 110 + PRINT, 3) + change * NOISE)
        assert _iou(person(background, image, NOBODY), _ellipse(70)) > 0.95


def test_cells_are_means_without_what_is_left_at_the_far_edges() -> None:
    image = np.arange(7 * 11, dtype=np.float64).reshape(7, 11)
    assert np.array_equal(cells(image, 3), [[12, 15, 18], [45, 48, 51]])
    assert cells(image, 4).shape == (1, 2) and cells(image, 7).shape == (1, 1)
    assert np.array_equal(cells(image, 1), image) and cells(image, 1).dtype == np.float32
    assert cells(image > 40, 3)[1, 0] == pytest.approx(2 / 3)


@pytest.mark.parametrize("noise", [0.1, 2.0, 5.0])
def test_the_noise_of_a_given_background_is_that_of_the_images_that_show_it(noise: float) -> None:
    rng = np.random.default_rng(1)
    images = [np.where(_ellipse(x), 200.0, WALL) + noise * rng.standard_normal(SIZE) for x in (40, 60, 80)]
    dark = [np.zeros(SIZE)] * 4  # the light was off at first
    background = given_background(WALL, [*dark, *images], 4)
    assert background is not None and (background.known == 1).all()
    assert background.noise == pytest.approx(max(0.3, noise), rel=0.35)
    assert given_background(WALL, dark, 4) is None


def test_a_bright_person_before_a_background_without_noise() -> None:
    """The probability of the background is then smaller than any number: its logarithm must not be taken."""
    image = np.where(_ellipse(70), np.float32(255), np.float32(0))
    background = CellBackground(
        grey=np.zeros(SIZE, np.float32), noise=0.02, sigma=np.full(SIZE, 0.02, np.float32), known=np.ones(SIZE), cell_px=4
    )
    with np.errstate(divide="raise", over="raise"):
        assert _iou(person(background, image, NOBODY), _ellipse(70)) > 0.95
