"""Points followed in one view: they stay on what moves, are given up where it disappears, and are taken from the person alone."""

import cv2
import numpy as np
import pytest

from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.tracking.image_points import ImageStep, followed

SIZE = (240, 320)
SHIFT = np.array([3.3, -1.7])  # px a frame


def _picture(t: int, texture: float = 1.0) -> np.ndarray:
    """A patterned square that moves before a wall that stands still, without what leaves the picture."""
    rng = np.random.default_rng(4)
    wall, cloth = (cv2.GaussianBlur(rng.normal(size=SIZE), (0, 0), 2.0).astype(np.float32) for _ in range(2))
    M = np.array([[1, 0, SHIFT[0] * t], [0, 1, SHIFT[1] * t]])
    square = np.zeros(SIZE, np.float32)
    square[90:190, 60:160] = 1.0
    cloth, square = (cv2.warpAffine(image, M, SIZE[::-1], flags=cv2.INTER_CUBIC) for image in (cloth, square))
    return np.where(square > 0.5, 120 + 250 * texture * cloth, 90 + 250 * wall) + np.random.default_rng(t).normal(0, 1.5, SIZE)


def _square(t: int) -> np.ndarray:
    y, x = np.indices(SIZE)
    x, y = x - SHIFT[0] * t, y - SHIFT[1] * t
    return np.asarray((x > 66) & (x < 153) & (y > 96) & (y < 183))


def _steps(frames: int = 6) -> list[ImageStep]:
    return list(followed(_picture, range(frames), _square, Monitor()))


def test_they_move_with_the_cloth() -> None:
    for t, step in enumerate(_steps()):
        at = np.rint(step.from_px).astype(int)
        moved = step.to_px - step.from_px - SHIFT
        assert len(step.from_px) > 60 and _square(t)[at[:, 1], at[:, 0]].mean() > 0.98
        assert np.median(np.linalg.norm(moved, axis=1)) < 0.15 and (np.linalg.norm(moved, axis=1) < 0.5).mean() > 0.94


def test_a_point_goes_on_from_frame_to_frame() -> None:
    first, *_, last = _steps()
    kept = [(np.linalg.norm(last.to_px - (p + 5 * SHIFT), axis=1) < 1.0).any() for p in first.from_px]
    assert np.mean(kept) > 0.7


def test_what_disappears_is_given_up() -> None:
    def read(t: int) -> np.ndarray:
        return _picture(t) if t < 2 else np.random.default_rng(t).normal(100, 20, SIZE)  # something else

    before, then = followed(read, range(3), _square, Monitor())
    assert len(then.from_px) < 0.2 * len(before.from_px)


def test_without_texture_or_person_there_are_none() -> None:
    blank = list(followed(lambda t: np.full(SIZE, 80.0, np.float32), range(3), _square, Monitor()))
    nobody = list(followed(_picture, range(3), lambda t: np.zeros(SIZE, dtype=bool), Monitor()))
    assert [len(step.to_px) for step in blank + nobody] == [0] * 4


def test_they_can_be_cancelled() -> None:
    monitor = Monitor()
    monitor.cancel()
    with pytest.raises(Cancelled):
        list(followed(_picture, range(3), _square, monitor))
