"""What is empty in the views of a filmed take: the wall, and nothing of the person."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.fitting.inputs import background
from tricap.core.fitting.inputs.background import find_background
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.images.foreground import cells
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take


@pytest.mark.slow
def test_nothing_of_a_moving_arm_is_empty(tmp_path: Path) -> None:
    make_arm_take(tmp_path, ArmTakeSettings(frames=8, width_px=384, interlaced="none"), Monitor())
    truth, footage = np.load(tmp_path / "truth.npz"), open_take(read_take(tmp_path))
    seen = np.unpackbits(truth["visible"], axis=1)[:, : truth["vertices_m"].shape[1]].astype(bool)
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=truth["vertices_m"][t][seen[t]][::4]) for t in range(8)]
    views = find_background(footage, clouds, Monitor())
    assert [view.view for view in views] == ["L", "C", "R"]
    for view in views:
        camera = footage.rig[view.view]
        for t in (0, 4, 7):
            distance = view.of_frame(t)
            assert distance is not None and 0.2 < (distance > 0).mean() < 0.9
            at = np.floor(camera.project(truth["vertices_m"][t][seen[t]]) / view.step_px).astype(int)
            assert (distance[at[:, 1], at[:, 0]] > 0).mean() < 0.01
    assert find_background(footage, clouds[:4], Monitor()) == []  # too few to find what stands still
    assert views[0].of_frame(99) is None


def test_who_never_moves_is_told_by_the_background_in_take_toml(tmp_path: Path, scenes: Any) -> None:
    """A board that hangs in the room through all frames is taken for the room where no background is given, and nowhere else."""
    rig, board = scenes.three_cameras(), scenes.Body(half_m=(0.2, 0.15))
    take = scenes.write_take(tmp_path, rig, [[board]] * 6, more='[body]\nmodel = "arm.R"')
    text = (take / "take.toml").read_text().replace('images = "C/*.png"', 'images = "C/*.png"\nbackground = "empty.png"')
    (take / "take.toml").write_text(text)
    cv2.imwrite(str(take / "empty.png"), scenes.render(rig["C"], [], noise=1.0, seed=99))
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=np.zeros((0, 3))) for t in range(6)]
    board_px = scenes.render(rig["C"], [board], background=-1.0) >= 0
    found = {view.view: view for view in find_background(open_take(read_take(take)), clouds, Monitor())}
    step, distance = found["C"].step_px, found["C"].of_frame(3)
    shares, around = cells(board_px, step), np.ones((5, 5))
    assert (distance[cv2.erode(shares, around) == 1] == 0).all() and (distance[cv2.dilate(shares, around) == 0] > 0).all()
    far = cells(cv2.distanceTransform((~board_px).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5), step)
    assert np.abs(distance * found["C"].unit_px - far)[far > 3 * step].max() < 2 * step
    assert (found["L"].of_frame(3) > 0).mean() > 0.95
    assert [view.view for view in find_background(open_take(read_take(take)), clouds[:2], Monitor())] == ["C"]  # the others are too few
    cv2.imwrite(str(take / "empty.png"), scenes.render(rig["C"], [], background=200.0))
    with pytest.raises(InputError, match="is nothing like view C in any frame"):
        find_background(open_take(read_take(take)), clouds, Monitor())


def test_the_background_is_not_learnt_where_the_body_is_said_to_be(tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A board in five of eight frames at one place, and elsewhere in the others; without measured points."""
    rig, boards = scenes.three_cameras(), [scenes.Body(half_m=(0.2, 0.15), t=scenes.Body().t + (x, 0.0, 0.0)) for x in (-0.1, 0.5)]
    places = [0, 0, 0, 0, 0, 1, 1, 1]
    footage = open_take(read_take(scenes.write_take(tmp_path, rig, [[boards[i]] for i in places], more='[body]\nmodel = "arm.R"')))
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=np.zeros((0, 3))) for t in range(8)]
    grid = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 15), np.linspace(-0.15, 0.15, 12), [0.0]), axis=-1).reshape(-1, 3)
    given, real = list[Any](), background.still_background

    def learnt(images: Any, near: Any, seen: Any, cell_px: int) -> Any:
        given.append((near, cell_px))
        return real(images, near, seen, cell_px)

    monkeypatch.setattr(background, "still_background", learnt)
    monkeypatch.setattr(background, "in_threads", lambda work, of: [work(k) for k in of])  # view after view, as `given` is read
    views = find_background(footage, clouds, Monitor(), bodies=[grid + boards[i].t for i in places])
    assert [view.estimated for view in views] == [True] * 3 and len(given) == 3
    for camera, (near, size) in zip(rig.cameras, given):
        for t in (2, 6):
            board = cells(scenes.render(camera, [boards[places[t]]], background=-1.0) >= 0, size)
            assert near[t][board == 1].all() and not near[t][cv2.dilate(board, np.ones((41, 41))) == 0].any()
    shown = views[1].of_frame(2)
    board = cells(scenes.render(rig["C"], [boards[0]], background=-1.0) >= 0, views[1].step_px)
    assert shown is not None and (shown[cv2.erode(board, np.ones((5, 5))) == 1] == 0).mean() > 0.95


def _with_source(take: Path, line: str) -> Path:
    """The take after the line was written below view C."""
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace('images = "C/*.png"', f'images = "C/*.png"\n{line}'))
    return take


def test_the_masks_of_the_user_are_the_person(tmp_path: Path, scenes: Any) -> None:
    """A board that never moves, and masks of the upper half of it: neither the rest of the board nor points beside it are the person."""
    rig, board = scenes.three_cameras(), scenes.Body(half_m=(0.2, 0.15))
    take = scenes.write_take(tmp_path, rig, [[board]] * 6, more='[body]\nmodel = "arm.R"')
    masks = [scenes.render(rig["C"], [board], background=-1.0) >= 0 for _ in range(6)]
    (take / "M").mkdir()
    for t, mask in enumerate(masks):
        mask[75 + 4 * t :] = False
        cv2.imwrite(str(take / "M" / f"{t}.png"), 255 * mask.astype(np.uint8))
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=np.array([[0.3, 0.2, 2.16]])) for t in range(6)]
    found = {view.view: view for view in find_background(open_take(read_take(_with_source(take, 'masks = "M/*.png"'))), clouds, Monitor())}
    assert set(found) == {"L", "C", "R"}
    for t, mask in enumerate(masks):
        assert np.array_equal(found["C"].of_frame(t) == 0, cells(mask, found["C"].step_px) > 0.5)
    (take / "M" / "5.png").unlink()
    with pytest.raises(InputError, match="5 masks"):
        find_background(open_take(read_take(take)), clouds, Monitor())


def test_images_of_another_size_than_their_camera_are_refused(tmp_path: Path, scenes: Any) -> None:
    rig = scenes.three_cameras()
    take = scenes.write_take(tmp_path, rig, [[scenes.Body()]] * 5, more='[body]\nmodel = "arm.R"')
    cv2.imwrite(str(take / "empty.png"), np.full((150, 200), 90, np.uint8))
    for path in (take / "C").glob("*.png"):
        cv2.imwrite(str(path), np.full((100, 130), 90, np.uint8))
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=np.zeros((0, 3))) for t in range(5)]
    with pytest.raises(InputError, match="130×100 pixels"):
        find_background(open_take(read_take(_with_source(take, 'background = "empty.png"'))), clouds, Monitor())


def test_one_mask_for_all_images_limits_where_the_person_is(tmp_path: Path, scenes: Any) -> None:
    """Two boards move; the mask is white on the way of one of them. In a single image the mask is the person."""
    rig, board = scenes.three_cameras(), scenes.Body(half_m=(0.07, 0.07))
    frames = [[board.moved(np.eye(3), [0.15 * t - 0.3, -0.12, 0]), board.moved(np.eye(3), [0.3 - 0.15 * t, 0.12, 0])] for t in range(5)]
    take = scenes.write_take(tmp_path, rig, frames, more='[body]\nmodel = "arm.R"')
    mask = np.zeros((150, 200), np.uint8)
    mask[:75] = 255
    cv2.imwrite(str(take / "mask.png"), mask)
    clouds: list[Any] = [SimpleNamespace(frame=t, xyz_m=np.zeros((0, 3))) for t in range(5)]
    found = {view.view: view for view in find_background(open_take(read_take(_with_source(take, 'mask = "mask.png"'))), clouds, Monitor())}
    first, both = (scenes.render(rig["C"], boards, background=-1.0) >= 0 for boards in (frames[1][:1], frames[1]))
    for view, true in (("C", first), ("L", scenes.render(rig["L"], frames[1], background=-1.0) >= 0)):
        person = found[view].of_frame(1) == 0
        assert (person & true).sum() / (person | true).sum() > 0.8, view
    assert both[75:].any() and found["C"].step_px == 1
    for path in take.glob("?/000[1-4].png"):
        path.unlink()
    alone = find_background(open_take(read_take(take)), clouds[:1], Monitor())
    assert [view.view for view in alone] == ["C"] and np.array_equal(alone[0].of_frame(0) == 0, mask > 0)
