"""The person by masks or by an image of the empty background: nothing beside her is measured, and the run says what told her."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.checking.take_check import check_take
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.results.folder import Results
from tricap.core.run import pipeline, take_run
from tricap.core.run.stages import stage_keys
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

COARSE = {"growing": {"spacing_px": 6}}


def write(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1].tobytes())


@pytest.fixture(scope="module")
def wall(scenes: Any) -> Any:
    """So near behind the person that its depths are hers."""
    return scenes.Body(half_m=(5, 5), t=np.array([0.0, 0.0, 2.3]), seed=9)


@pytest.fixture(scope="module")
def bodies(scenes: Any) -> list[Any]:
    body = scenes.Body(radius_m=0.09, half_m=(1.0, 0.18), t=np.array([-0.1, 0.0, 2.0]))
    return [body, body.moved(np.eye(3), [0.1, 0.0, 0.0])]


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory, scenes: Any, wall: Any, bodies: list[Any]) -> Path:
    """Two frames of a cylinder before the wall, with masks and a background for every view; do not change it, copy it."""
    rig = scenes.three_cameras()
    folder = scenes.write_take(tmp_path_factory.mktemp("silhouettes") / "take", rig, [[wall, body] for body in bodies])
    for camera in rig.cameras:
        write(folder / "empty" / f"{camera.name}.png", scenes.render(camera, [wall], noise=1.0, seed=77))
        for i, body in enumerate(bodies):
            write(folder / f"M{camera.name}" / f"{i}.png", 255.0 * (scenes.render(camera, [body], background=-1e6) > -1e5))
    return Path(folder)


@pytest.mark.parametrize("line", ['masks = "L/*.png"', 'mask = "L/0000.png"'])
def test_the_footage_is_no_mask(take: Path, tmp_path: Path, line: str) -> None:
    checked = check_take(with_source(take, tmp_path / "take", {"L": line}), Monitor())
    assert [f for f in checked.findings if "L/0000.png is an image of view L, and no mask; correct `mask`" in f.sentence], checked.lines()


def test_a_background_that_is_an_image_of_its_view_is_doubtful(take: Path, tmp_path: Path) -> None:
    """It is right where nobody is in it, as before somebody enters."""
    own, empty = (check_take(with_source(take, tmp_path / name, {"L": f'background = "{file}"'}), Monitor())
                  for name, file in (("own", "L/0000.png"), ("empty", "empty/L.png")))  # fmt: skip
    said = "The background of view L, L/0000.png, is an image of this view: whoever it shows counts as background."
    assert [f.certain for f in own.findings if f.sentence == said] == [False]
    assert not [f for f in empty.findings if f.cause == "background"]


def with_source(take: Path, folder: Path, said: dict[str, str]) -> Path:
    """A copy of the take in which views have these lines in take.toml."""
    shutil.copytree(take, folder)
    text = (folder / "take.toml").read_text()
    for view, line in said.items():
        text = text.replace(f'name = "{view}"\n', f'name = "{view}"\n{line}\n')
    (folder / "take.toml").write_text(text)
    return folder


def beside(m: Any, body: Any) -> float:
    """The share of points that lie on the wall."""
    return float(np.mean(np.abs(body.distance_m(m.cloud.xyz_m)) > 0.04))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"C": 'masks = "MC/*.png"'}, "masks of C"),
        ({v: f'background = "empty/{v}.png"' for v in "LCR"}, "background of L, C, R"),
        ({"C": 'masks = "MC/*.png"', "L": 'background = "empty/L.png"'}, "masks of C and background of L"),
    ],
)
def test_nothing_beside_the_person(take: Path, tmp_path: Path, scenes: Any, bodies: list[Any], said: dict[str, str], told: str) -> None:
    plain = scenes.measure(take, tmp_path / "plain", COARSE)
    found = scenes.measure(with_source(take, tmp_path / "take", said), tmp_path / "out", COARSE)
    for a, b, body in zip(plain, found, bodies):
        near = [int((np.abs(body.distance_m(m.cloud.xyz_m)) < 0.02).sum()) for m in (a, b)]
        assert beside(a, body) > 0.5 and beside(b, body) < 0.02
        assert near[1] > 0.9 * near[0] > 50
        assert b.foreground.method.endswith(f", {told}")


def test_run_json_says_what_told_the_person(take: Path, tmp_path: Path) -> None:
    changed = with_source(take, tmp_path / "take", {"C": 'mask = "MC/0.png"'})
    with take_run.open_run(changed, tmp_path / "out", COARSE, (0, 1)) as run:
        pipeline.measure(run, Monitor())
    assert Results(tmp_path / "out").read_run()["stages"]["measure"]["foreground"] == "nearest surface, mask of C"


def test_another_mask_is_another_input(take: Path, tmp_path: Path, scenes: Any) -> None:
    """A mask that is painted anew makes the stage stale, and its frame and those after are measured again."""
    changed = with_source(take, tmp_path / "take", {"C": 'masks = "MC/*.png"'})
    settings = take_run.settings_of({}, COARSE, "")
    before, key = scenes.measure(changed, tmp_path / "out", COARSE), stage_keys(open_take(read_take(changed)), settings, tmp_path / "out")
    mask = cv2.imread(str(changed / "MC" / "1.png"), 0)
    mask[:, 100:] = 0
    write(changed / "MC" / "1.png", mask)
    after = scenes.measure(changed, tmp_path / "out", COARSE)
    assert [a.key == b.key for a, b in zip(before, after)] == [True, False]
    assert len(after[1].cloud.xyz_m) < len(before[1].cloud.xyz_m)
    assert stage_keys(open_take(read_take(changed)), settings, tmp_path / "out")["measure"] != key["measure"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('mask = "MC/0.png"\nbackground = "empty/C.png"', "has `mask` and `background`; keep one of them"),
        ('mask = "../mask.png"', "must be a file inside the take's folder"),
        ("mask = 3", "must be a file inside the take's folder"),
        ('mask = "none.png"', "Cannot read the image .*none.png"),
        ('masks = "none/*.png"', r"C \(masks\) has no images"),
        ('masks = "MC/0.png"', "has 1 masks, but none for frame 1"),
        ('mask = "small.png"', "has 20×10 pixels, the view 200×150"),
        ('mask = "dark.png"', "nowhere brighter than 1 of 255; paint the person white"),
        ('background = "other.png"', "looks nothing like view C in frame 0"),
    ],
)
def test_what_cannot_be_is_said(take: Path, tmp_path: Path, scenes: Any, line: str, said: str) -> None:
    changed = with_source(take, tmp_path / "take", {"C": line})
    write(changed / "small.png", np.full((10, 20), 255.0))
    write(changed / "dark.png", np.ones((150, 200)))
    write(changed / "other.png", np.zeros((150, 200)))
    with pytest.raises(InputError, match=said):
        scenes.measure(changed, tmp_path / "out", COARSE)


def test_a_black_frame_says_nothing(take: Path, tmp_path: Path, scenes: Any) -> None:
    """A picture that is lost differs from the background everywhere; the run goes on."""
    changed = with_source(take, tmp_path / "take", {"L": 'background = "empty/L.png"'})
    write(changed / "L" / "0001.png", np.zeros((150, 200)))
    assert [len(m.cloud.xyz_m) > 0 for m in scenes.measure(changed, tmp_path / "out", COARSE)] == [True, False]
