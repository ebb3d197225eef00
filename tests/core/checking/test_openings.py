"""What a run refuses, `tricap check` finds: the same sentence, before anything is measured."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.checking.openings import opening_findings
from tricap.core.cli import main
from tricap.core.fitting.settings import FitSettings
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.run import pipeline
from tricap.core.run.check import check_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take


def png(path: Path, grey: int, size: tuple[int, int] = (150, 200)) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.full(size, grey, np.uint8))[1].tobytes())


def view(take: Path, line: str) -> None:
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace('name = "L"\n', f'name = "L"\n{line}\n'))


def more(take: Path, text: str) -> None:
    with (take / "take.toml").open("a") as file:
        file.write(text)


def arm(take: Path, text: str) -> None:
    """Add an arm's [body] with clicks, which is `text`, in place of none."""
    before = (take / "take.toml").read_text()
    (take / "take.toml").write_text(before.replace('[body]\nmodel = "none"\n', "") + text)


def masks(take: Path, count: int = 4, grey: int = 255) -> None:
    for i in range(count):
        png(take / "M" / f"{i}.png", grey)
    view(take, 'masks = "M/*.png"')


def not_white(take: Path) -> None:
    masks(take)
    png(take / "M" / "3.png", 100)


def text_instead(take: Path) -> None:
    masks(take)
    (take / "M" / "2.png").write_text("no image")


def of_another_size(take: Path) -> None:
    masks(take)
    png(take / "M" / "3.png", 255, (20, 20))


def link_to_nothing(take: Path) -> None:
    masks(take)
    (take / "M" / "1.png").unlink()
    (take / "M" / "1.png").symlink_to(take / "away.png")


def link_to_a_device(take: Path) -> None:
    masks(take)
    (take / "M" / "1.png").unlink()
    (take / "M" / "1.png").symlink_to("/dev/zero")


def black(take: Path) -> None:
    png(take / "m.png", 0)
    view(take, 'mask = "m.png"')


def checkerboard(take: Path) -> None:
    """Half of it is white, and nothing can be matched in it."""
    board = (255 * (np.indices((150, 200)).sum(axis=0) % 2)).astype(np.uint8)
    (take / "m.png").write_bytes(cv2.imencode(".png", board)[1].tobytes())
    view(take, 'mask = "m.png"')


def another_room(take: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (150, 200), dtype=np.uint8)
    (take / "b.png").write_bytes(cv2.imencode(".png", noise)[1].tobytes())
    view(take, 'background = "b.png"')


CLICKS = '[body]\nmodel = "arm.R"\n[seeds.joints]\n"elbow.R" = { C = [100.0, 75.0], L = [104.0, 75.0] }\n'
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no masks": (lambda take: view(take, 'masks = "M/*.png"'), "has no images"),
    "too few masks": (lambda take: masks(take, 2), "has 2 masks, but none for frame 2"),
    "a grey mask": (not_white, "nowhere brighter than 100"),
    "a black mask": (black, "m.png is black everywhere"),
    "a checkerboard as a mask": (checkerboard, "pattern of single white pixels"),
    "a text as a mask": (text_instead, "not a readable image"),
    "a small mask": (of_another_size, "has 20×20 pixels"),
    "no mask": (lambda take: view(take, 'mask = "m.png"'), "Cannot read the image"),
    "no background": (lambda take: view(take, 'background = "m.png"'), "Cannot read the image"),
    "another room": (another_room, "looks nothing like view L"),
    "no keypoints": (lambda take: arm(take, CLICKS + '[[keypoints]]\nfiles = "k.trc"\n'), "There are no keypoints"),
    "unknown angle": (lambda take: arm(take, CLICKS.replace("[seeds", 'locked = ["tail wag"]\n[seeds')), "tail wag"),
}
if os.name != "nt":
    FAULTS |= {
        "a broken link": (link_to_nothing, "1.png"),
        "a link to a device": (link_to_a_device, "a device, a pipe or a socket"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_what_a_run_refuses_the_check_finds(plane_take: Path, tmp_path: Path, fault: str) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    spoil, said = FAULTS[fault]
    spoil(take)
    found = [f.sentence for f in opening_findings(open_take(read_take(take)), FitSettings(), Monitor())]
    assert len(found) == 1 and said in found[0], found
    with pytest.raises(InputError) as refused:
        pipeline.run(take, tmp_path / "out", {"growing": {"spacing_px": 16}})
    assert said in str(refused.value)


def write_keypoints(take: Path, image: int, person: list[float]) -> None:
    store.write_json(take / "kp" / f"{image:04d}.json", {"people": [{"pose_keypoints_2d": person}]})


def test_keypoints_of_another_rate_are_doubtful(plane_take: Path, tmp_path: Path) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    arm(take, CLICKS + '[[keypoints]]\nfiles = "kp/*.json"\nview = "C"\n')
    table = (take / "take.toml").read_text()
    person, images = [50.0, 60.0, 0.9] * 25, len([*(take / "C").iterdir()])
    for frames, doubts in ((images, 0), (4 * images, 1)):
        for i in range(frames):
            write_keypoints(take, i, person)
        found = opening_findings(open_take(read_take(take)), FitSettings(), Monitor())
        assert [f"the footage ends with frame {images - 1}" in f.sentence and not f.certain for f in found] == [True] * doubts
    shutil.rmtree(take / "kp")
    (take / "take.toml").write_text(table.replace('"none"', '"both"', 1))
    for i in range(images):
        write_keypoints(take, i, person)
    assert not opening_findings(open_take(read_take(take)), FitSettings(), Monitor()), "each image has two frames"


def test_sound_masks_are_no_finding_and_settings_are_checked(plane_take: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    masks(take)
    assert opening_findings(open_take(read_take(take)), FitSettings(), Monitor()) == []
    for i in range(4):
        png(take / "M" / f"{i}.png", 0)
    assert [
        "All masks of view L are black" in f.sentence for f in opening_findings(open_take(read_take(take)), FitSettings(), Monitor())
    ] == [True]
    more(take, "[settings.tracking]\nno_such = 1\n")
    assert any("no_such" in f.sentence for f in check_take(take, Monitor()).findings)
    assert main.main(["check", str(take), "--quiet"]) == 1 and "no_such" in capsys.readouterr().out
