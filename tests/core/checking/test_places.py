"""What masks, backgrounds and corrections leave out, and what a fit without a surface lacks: the check finds it before a run is refused."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.checking.openings import opening_findings
from tricap.core.fitting.settings import FitSettings
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.foundation.settings import from_table
from tricap.core.run import pipeline
from tricap.core.run.check import check_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

Record = Callable[..., Path]
Spoil = Callable[[Path], None]
WITHOUT_SURFACE = "\n[settings.fitting]\nuse_surface = false\n"


def size_of(take: Path) -> tuple[int, int]:
    h, w = cv2.imread(str(take / "C" / "0000.png"), cv2.IMREAD_GRAYSCALE).shape
    return w, h


def view(take: Path, name: str, line: str) -> None:
    text = (take / "take.toml").read_text()
    assert f'name = "{name}"\n' in text
    (take / "take.toml").write_text(text.replace(f'name = "{name}"\n', f'name = "{name}"\n{line}\n'))


def top(take: Path, line: str) -> None:
    (take / "take.toml").write_text(line + "\n" + (take / "take.toml").read_text())


def end(take: Path, text: str) -> None:
    (take / "take.toml").write_text((take / "take.toml").read_text() + text)


def region(take: Path, *polygon: tuple[float, float]) -> None:
    corners = np.array(polygon, dtype=float).tolist()
    end(take, f'\n[[corrections]]\nkind = "region"\nview = "C"\nframes = [0, 8]\npolygon = {corners}\n')


def limb(take: Path, name: str, width: float) -> np.ndarray:
    """A mask (h, w) of the clicked limb in a view."""
    mask = np.zeros(size_of(take)[::-1], np.uint8)
    clicks = read_take(take).clicks.joints
    at = [clicks[joint][name] for joint in ("shoulder.R", "elbow.R", "wrist.R") if joint in clicks]
    cv2.polylines(mask, [np.rint(at).astype(np.int32)], False, 255, round(width))
    return mask


def give_masks(take: Path, mask_of: Callable[[str], np.ndarray]) -> None:
    for name in "LCR":
        cv2.imwrite(str(take / f"m{name}.png"), mask_of(name))
        view(take, name, f'mask = "m{name}.png"')


def tiny_masks(take: Path) -> None:
    mask = np.zeros(size_of(take)[::-1], np.uint8)
    mask[10:13, 20:23] = 255
    give_masks(take, lambda name: mask)


def tiny_mask_on_the_arm(take: Path) -> None:
    """All views show something in it, but less than a limb."""
    x, y = np.rint(read_take(take).clicks.joints["elbow.R"]["C"]).astype(int)
    mask = np.zeros(size_of(take)[::-1], np.uint8)
    mask[y - 5 : y + 5, x - 5 : x + 5] = 255
    cv2.imwrite(str(take / "m.png"), mask)
    view(take, "C", 'mask = "m.png"')


def all_but_the_person(take: Path) -> None:
    give_masks(take, lambda name: 255 - limb(take, name, size_of(take)[0] / 2))


def background_with_the_person(take: Path) -> None:
    shutil.copy(take / "L" / "0000.png", take / "empty.png")
    view(take, "L", 'background = "empty.png"')


def whole_image(take: Path) -> None:
    """Its last row and column are on the polygon."""
    w, h = size_of(take)
    region(take, (0, 0), (w - 1, 0), (w - 1, h - 1), (0, h - 1))


def the_limb_of_some_body(take: Path) -> None:
    """Nobody chose the body, so that its start is not at the clicks."""
    about_the_limb(take)
    text = (take / "take.toml").read_text()
    assert 'model = "arm.R"' in text
    (take / "take.toml").write_text(text.replace('model = "arm.R"', 'model = "auto"'))


def two_halves(take: Path) -> None:
    w, h = size_of(take)
    region(take, (-1, -1), (w / 2, -1), (w / 2, h), (-1, h))
    region(take, (w / 2 - 1, -1), (w, -1), (w, h), (w / 2 - 1, h))


def about_the_limb(take: Path) -> None:
    xy = np.array([at["C"] for at in read_take(take).clicks.joints.values()])
    (x0, y0), (x1, y1) = xy.min(axis=0) - 100, xy.max(axis=0) + 100
    region(take, (x0, y0), (x1, y0), (x1, y1), (x0, y1))


def nothing_to_rest_on(take: Path) -> None:
    """Too few frames for a background."""
    top(take, "frames = [0, 3]")
    end(take, WITHOUT_SURFACE)


REFUSED: dict[str, tuple[Spoil, str]] = {
    "tiny masks": (tiny_masks, "nothing is left to be measured that all these views show as the person: mask of L, C, R."),
    "a tiny mask on the arm": (tiny_mask_on_the_arm, "next to nothing near the clicked joints is left to be measured (mask of C)."),
    "masks of all but the person": (
        all_but_the_person,
        "next to nothing near the clicked joints is left to be measured (mask of L, C, R).",
    ),
    "a background with the person": (background_with_the_person, "In frame 0 next to nothing near the clicked joints"),
    "the whole image": (whole_image, "near the clicked joints is left to be measured ([[corrections]])."),
    "the image by halves": (two_halves, "near the clicked joints is left to be measured ([[corrections]])."),
    "the limb": (about_the_limb, "near the clicked joints is left to be measured ([[corrections]])."),
    "the limb of some body": (the_limb_of_some_body, "near the clicked joints is left to be measured ([[corrections]])."),
    "nothing to rest on": (nothing_to_rest_on, "the take shows no outline of the person in frame 0 and has no keypoints"),
}


def findings(take: Path) -> list[str]:
    opened = read_take(take)
    fitting = from_table(FitSettings, opened.settings.get("fitting", {}), "[fitting]")
    return [finding.sentence for finding in opening_findings(open_take(opened), fitting, Monitor())]


@pytest.fixture
def take(arm_recording: Record, tmp_path: Path) -> Path:
    return Path(shutil.copytree(arm_recording(), tmp_path / "take"))


@pytest.mark.parametrize("fault", REFUSED)
def test_what_leaves_nothing_of_the_person_is_found(take: Path, fault: str) -> None:
    spoil, said = REFUSED[fault]
    spoil(take)
    found = findings(take)
    assert len(found) == 1 and said in found[0], found


@pytest.mark.parametrize("fault", [pytest.param("tiny masks", marks=pytest.mark.slow), "nothing to rest on"])
def test_it_is_a_finding_of_the_check(take: Path, fault: str) -> None:
    spoil, said = REFUSED[fault]
    spoil(take)
    assert [finding for finding in check_take(take, Monitor()).findings if said in finding.sentence]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["tiny masks", "a tiny mask on the arm", "masks of all but the person", "nothing to rest on"])
def test_a_run_refuses_it(take: Path, tmp_path: Path, fault: str) -> None:
    REFUSED[fault][0](take)
    with pytest.raises(InputError, match="No surface could be measured|no measured surface|no measured points near"):
        pipeline.run(take, tmp_path / "out")


def masks_of_the_limb(take: Path) -> None:
    give_masks(take, lambda name: limb(take, name, 16))


def corner(take: Path) -> None:
    region(take, (-1, -1), (20, -1), (20, 20), (-1, 20))


def keypoints_instead(take: Path) -> None:
    nothing_to_rest_on(take)
    (take / "k.csv").write_text("frame,time_s,joint,x,y,z\n" + "".join(f"{t},{t / 25},elbow.R,0,0,2\n" for t in range(3)))
    end(take, '\n[[keypoints]]\nfiles = "k.csv"\n')


def without_surface(take: Path) -> None:
    end(take, WITHOUT_SURFACE)


def without_a_body(take: Path) -> None:
    about_the_limb(take)
    text = (take / "take.toml").read_text()
    assert 'model = "arm.R"' in text
    (take / "take.toml").write_text(text.replace('model = "arm.R"', 'model = "none"'))


@pytest.mark.parametrize("change", [masks_of_the_limb, corner, keypoints_instead, without_surface, without_a_body])
def test_what_leaves_the_person_is_no_finding(take: Path, change: Spoil) -> None:
    change(take)
    assert findings(take) == []
