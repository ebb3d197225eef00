"""take.toml: what it says is what comes out, and every fault is one sentence that names the place and the remedy."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.foundation.errors import InputError
from tricap.core.images.sequence import ImageFiles
from tricap.core.take.footage import open_take
from tricap.core.take.take import AUTO_BODY, JOINTS, Take, read_take

HEAD = dict(format='"tricap-take"', version="1", fps="25.0", rig='"rig.toml"')
CORNER = "[1, 2], "
CLICK = "{ L = [1, 2], C = [1, 2] }, "
VIEWS = "".join(f'[[views]]\nname = "{v}"\nimages = "{v}/*.png"\n' for v in "LCR")


def text(head: dict[str, str | None] | None = None, views: str = VIEWS, more: str = "") -> str:
    lines = {k: v for k, v in (HEAD | (head or {})).items() if v is not None}
    return "".join(f"{k} = {v}\n" for k, v in lines.items()) + views + more


def read(folder: Path, content: str) -> Take:
    folder.mkdir(exist_ok=True)
    (folder / "take.toml").write_text(content, encoding="utf-8")
    return read_take(folder)


@pytest.fixture
def footage(tmp_path: Path, scenes: Any) -> Path:
    """A take of five small flat frames, whose files may be changed."""
    folder = tmp_path / "Prise é 1"
    rig = scenes.three_cameras(width=40, height=30)
    scenes.write_take(folder, rig, [[]] * 5, noise=0.0)
    return folder


def rewrite(folder: Path, head: dict[str, str | None] | None = None, views: str = VIEWS, more: str = "") -> Take:
    return read(folder, text(head, views, more))


def test_everything_that_it_says(tmp_path: Path) -> None:
    more = (
        '[body]\nmodel = "arm.R"\n[seeds]\nframe = 3\nsurface = [{ L = [1.0, 2], C = [3, 4.5] }]\n'
        '[seeds.joints]\n"elbow.R" = { C = [5.0, 6.0], R = [7.0, 8.0] }\n[settings.matching]\npatch_px = 17\n'
    )
    take = read(tmp_path, text(dict(interlaced='"even"', reference_view='"L"', frames="[2, 9]", fps="30"), more=more))
    assert (take.fps, take.interlaced, take.reference_view, take.reference, take.frames) == (30.0, "even", "L", 0, (2, 9))
    assert [(v.name, v.images, v.movie, v.offset_frames) for v in take.views] == [(v, f"{v}/*.png", None, 0) for v in "LCR"]
    assert take.rig_path == take.folder / "rig.toml" and take.body_model == "arm.R"
    assert (take.rows_at(3).step, take.rows_at(3).offset) == (2, 1)
    assert take.clicks.frame == 3 and take.clicks.surface[0]["C"].tolist() == [3, 4.5]
    assert list(take.clicks.joints) == ["elbow.R"] and take.clicks.joints["elbow.R"]["R"].tolist() == [7, 8]
    assert take.settings == {"matching": {"patch_px": 17}}
    assert read_take(tmp_path / "take.toml").folder == take.folder


def test_both_fields(footage: Path) -> None:
    """Five images of 25 a second are ten frames of 50 a second; offsets count images, all other numbers frames."""
    late = VIEWS.replace('"R/*.png"', '"R/*.png"\noffset_frames = 1')
    take = rewrite(footage, dict(interlaced='"both"', first_field='"even"', frames="[3, 8]"), late, "[seeds]\nframe = 5\n")
    assert (take.fps, take.frames, take.clicks.frame) == (50.0, (3, 8), 5)
    assert [take.rows_at(n).offset for n in range(4)] == [1, 0, 1, 0]
    opened = open_take(take)
    assert [opened.number(0, n) for n in range(3, 8)] == [1, 2, 2, 3, 3] and [opened.number(2, n) for n in (3, 4)] == [2, 3]
    assert [path.name for path in opened.files(7)] == ["0003.png", "0003.png", "0004.png"]
    single = opened.single()
    assert (single.take.interlaced, single.take.fps, single.take.clicks.frame, single.frames) == ("even", 25.0, 2, range(1, 4))
    assert open_take(rewrite(footage, dict(interlaced='"both"'))).frames == range(10)
    with pytest.raises(InputError, match=r"the footage has frames 0 to 8 \(half-open\)"):
        open_take(rewrite(footage, dict(interlaced='"both"', frames="[0, 9]"), late))


def test_corrections_and_keyframes(tmp_path: Path) -> None:
    more = (
        '[body]\nmodel = "arm.R"\nlocked = ["elbow.R twist"]\n[body.limits]\n"elbow.R flexion" = [0, 140]\n'
        + KEYFRAME
        + KEYFRAME.replace("frame = 3", "frame = 1")
        + '[[corrections]]\nkind = "trajectory"\nview = "L"\nframe = 4\nxy = [3, 4.5]\n'
        + '[[corrections]]\nkind = "region"\nview = "C"\nframes = [2, 9]\npolygon = [[0, 0], [9, 0], [0, 9.5]]\n'
    )
    take = read(tmp_path, text(more=more))
    assert take.locked == ("elbow.R twist",) and take.limits == {"elbow.R flexion": (0.0, 140.0)}
    assert [k.frame for k in take.keyframes] == [1, 3] and take.keyframes[1].joints["elbow.R"]["L"].tolist() == [5, 5]
    assert take.clicked_joints >= {"elbow.R"}
    one, region = take.corrections
    assert (one.kind, one.view, one.frames, one.xy_px.tolist()) == ("trajectory", "L", range(4, 5), [[3, 4.5]])
    assert (region.kind, region.view, region.frames, region.xy_px.shape) == ("region", "C", range(2, 9), (3, 2))


def test_no_body_and_a_body_of_ones_own(tmp_path: Path) -> None:
    none = read(tmp_path, text(more='[body]\nmodel = "none"\n'))
    assert none.body_model is None and read(tmp_path, text()).body_model == AUTO_BODY and read(tmp_path, text()).joints_model == "full"
    own = read(tmp_path, text(more='[body]\nmodel = "my arm é.toml"\n'))
    assert own.body_model == str(own.folder / "my arm é.toml") and own.joints_model == own.body_model
    for outside in ("../arm.toml", str(tmp_path / "arm.toml")):
        with pytest.raises(InputError, match="a file inside the take's folder"):
            read(tmp_path, text(more=f"[body]\nmodel = '{outside}'\n"))


def test_what_may_be_left_out(tmp_path: Path) -> None:
    take = read(tmp_path, text(dict(rig=None)))
    assert (take.reference_view, take.interlaced, take.frames, take.body_model) == ("C", "none", None, AUTO_BODY)
    assert take.rig_path.name == "rig.toml" and not take.clicks.joints and not take.clicks.surface
    two = read(tmp_path, text(views=VIEWS.split('[[views]]\nname = "R"')[0]))
    assert two.reference_view == "C"


KEYFRAME = '[[keyframes]]\nframe = 3\n[keyframes.joints]\n"elbow.R" = { L = [5, 5], C = [5, 5] }\n'
CORNER = "[1, 2], "
CLICK = "{ L = [1, 2], C = [1, 2] }, "
REGION = '[[corrections]]\nkind = "region"\nview = "C"\nframes = [2, 9]\n'
TRAJECTORY = REGION.replace("region", "trajectory").replace("frames = [2, 9]", "frame = 1")
SEED, JOINT = "[seeds]\n", "[seeds.joints]\n"
FAULTS = {
    "not TOML": ("fps = \n", "is not a TOML file"),
    "no format": (text(dict(format=None)), 'must have format = "tricap-take"'),
    "another format": (text(dict(format='"x"')), 'it has "x" and 1'),
    "newer version": (text(dict(version="2")), 'and version = 1; it has "tricap-take" and 2'),
    "unknown key": (text(dict(interlace='"odd"')), "unknown key “interlace”. Did you mean “interlaced”?"),
    "unknown key of a view": (text(views=VIEWS + "ofset_frames = 1\n"), "unknown key “ofset_frames”. Did you mean “offset_frames”?"),
    "unknown key of the body": (text(more='[body]\nmodle = "arm.R"\n'), "unknown key “modle”. Did you mean “model”?"),
    "unknown key of the seeds": (text(more="[seeds]\nframes = 1\n"), "unknown key “frames”. Did you mean “frame”?"),
    "unknown joint": (text(more=JOINT + '"elbow.r" = { L = [1, 2] }\n'), "unknown key “elbow.r”. Did you mean “elbow.R”?"),
    "unknown view of a joint": (text(more=JOINT + '"elbow.R" = { l = [1, 2] }\n'), "unknown key “l”. Did you mean “L”?"),
    "no fps": (text(dict(fps=None)), "`fps` of .* is missing; write the frames per second"),
    "fps of a word": (text(dict(fps='"25"')), '`fps` of .* is "25"'),
    "fps true": (text(dict(fps="true")), "`fps` of .* is true"),
    "fps 0": (text(dict(fps="0.0")), "`fps` of .* is 0.0"),
    "fps NaN": (text(dict(fps="nan")), "`fps` of .* is nan"),
    "fps infinite": (text(dict(fps="inf")), "`fps` of .* is inf"),
    "interlaced": (text(dict(interlaced='"od"')), '`interlaced` of .* is "od"; write one of: none, odd, even, both'),
    "first_field": (text(dict(interlaced='"both"', first_field='"top"')), '`first_field` of .* is "top"; write "odd" or "even"'),
    "first_field alone": (text(dict(interlaced='"odd"', first_field='"even"')), 'only with interlaced = "both"'),
    "interlaced true": (text(dict(interlaced="true")), "`interlaced` of .* is true"),
    "reference view": (text(dict(reference_view='"M"')), '`reference_view` of .* is "M"'),
    "frames a number": (text(dict(frames="3")), "`frames` of .* is 3; write"),
    "frames of three": (text(dict(frames="[1, 2, 3]")), "write \\[first, one after the last\\]"),
    "frames that are no numbers": (text(dict(frames="[false, true]")), "write \\[first, one after the last\\]"),
    "frames backwards": (text(dict(frames="[5, 5]")), "write \\[first, one after the last\\]"),
    "frames negative": (text(dict(frames="[-1, 5]")), "write \\[first, one after the last\\]"),
    "frames not whole": (text(dict(frames="[0.5, 5]")), "write \\[first, one after the last\\]"),
    "rig outside": (text(dict(rig='"../rig.toml"')), "`rig` of .* must be a file inside the take's folder"),
    "rig elsewhere": (text(dict(rig='"/rig.toml"')), "must be a file inside"),
    "rig a number": (text(dict(rig="1")), "must be a file inside"),
    "no views": (text(views=""), "needs at least two \\[\\[views\\]\\]"),
    "one view": (text(views='[[views]]\nname = "L"\nimages = "*.png"\n'), "needs at least two"),
    "views no list": (text(views="views = 3\n"), "needs at least two"),
    "view without name": (text(views=VIEWS + '[[views]]\nimages = "x"\n'), "needs a name"),
    "view with an empty name": (text(views=VIEWS + '[[views]]\nname = ""\nimages = "x"\n'), "needs a name"),
    "view with a number for a name": (text(views=VIEWS + '[[views]]\nname = 3\nimages = "x"\n'), "needs a name"),
    "view that leaves the folder": (text(views=VIEWS + '[[views]]\nname = "../x"\nimages = "x"\n'), "a character in its name"),
    "view with a line in its name": (text(views=VIEWS + '[[views]]\nname = "a\\nb"\nimages = "x"\n'), "a character in its name"),
    "a date for a number": (text({"fps": "1979-05-27T07:32:00Z"}), "`fps` of .* is 1979-05-27 07:32:00\\+00:00; write"),
    "a truth for a number": (text({"fps": "true"}), "`fps` of .* is true; write"),
    "view with a long name": (
        text(views=VIEWS + f'[[views]]\nname = "{"é" * 61}"\nimages = "x"\n'),
        "too long for the files that are named after it",
    ),
    "view that Windows takes for a device": (text(views=VIEWS + '[[views]]\nname = "con"\nimages = "x"\n'), "that no file may have"),
    "view with a blank at its end": (text(views=VIEWS + '[[views]]\nname = "side "\nimages = "x"\n'), "that no file may have"),
    "two views alike but for capitals": (text(views=VIEWS + '[[views]]\nname = "l"\nimages = "x"\n'), "differ only in capitals"),
    "very many views": (text(views="".join(f'[[views]]\nname = "{n}"\nimages = "x"\n' for n in range(201))), "has 201 views; a take has"),
    "two views of one footage": (text(views=VIEWS + '[[views]]\nname = "X"\nimages = "L/*.png"\n'), "View X of .* footage of another view"),
    "two views alike": (text(views=VIEWS + '[[views]]\nname = "L"\nimages = "x"\n'), "Two views of .* have the same name"),
    "offset": (text(views=VIEWS + "offset_frames = 0.5\n"), "`offset_frames` of view .* write a whole number of frames"),
    "view without footage": (text(views=VIEWS + '[[views]]\nname = "X"\n'), "needs either `images`"),
    "view with two kinds": (text(views=VIEWS + 'movie = "a.mp4"\n'), "needs either `images`"),
    "footage a number": (text(views=VIEWS + '[[views]]\nname = "X"\nimages = 3\n'), "needs either `images`"),
    "footage at any depth twice": (text(views=VIEWS + '[[views]]\nname = "X"\nimages = "**/a/**/*.png"\n'), "with more than one"),
    "masks at any depth twice": (text(views=VIEWS + 'masks = "**/**/*.png"\n'), "with more than one"),
    "an endless pattern": (text(views=VIEWS.replace("L/*", "L/" + "[" * 50_000, 1)), "pattern of 5.* characters"),
    "axes of pixels": (
        text(more='[[keypoints]]\nfiles = "kp/*.json"\nview = "C"\naxes = "Y up"\n'),
        "`axes` of the .*kp/.* is for files in space, and these are of pixels; remove it",
    ),
    "keypoints at any depth twice": (text(more='[[keypoints]]\nfiles = "**/**/*.json"\nview = "C"\n'), "with more than one"),
    "keypoints twice": (
        text(more='[[keypoints]]\nfiles = "kp/*.json"\nview = "C"\n' * 2),
        "files “kp/\\*.json” for the same",
    ),
    "very many keypoints": (text(more='[[keypoints]]\nfiles = "kp/*.json"\nview = "C"\n' * 201), "has 201 tables ..keypoints..; 200 is"),
    "body a word": (text(dict(body='"arm.R"')), "\\[body\\] of .* must be a table"),
    "model a number": (text(more="[body]\nmodel = 3\n"), "`model` under \\[body\\] of .* is 3"),
    "seeds a word": (text(dict(seeds='"x"')), "\\[seeds\\] of .* must be a table"),
    "seed frame": (text(more=SEED + 'frame = "0"\n'), "needs frame \\(a whole number\\)"),
    "surface no list": (text(more=SEED + "surface = { L = [1, 2] }\n"), "surface \\(a list\\)"),
    "surface of pairs": (text(more=SEED + "surface = [[1, 2]]\n"), "surface seed 1 of .* must name views and pixels"),
    "20,000 surface seeds": (text(more=SEED + f"surface = [{CLICK * 20_000}]\n"), "has 20000 surface seeds; 1000 is the most"),
    "a polygon of 100,000 corners": (text(more=REGION + f"polygon = [{CORNER * 100_000}]\n"), "has 100000 corners; 1000 is the most"),
    "10,000 corrections": (text(more=(REGION + f"polygon = [{CORNER * 3}]\n") * 10_000), "has 10000 ..corrections..; 5000 is the most"),
    "click of three": (text(more=JOINT + '"elbow.R" = { L = [1, 2, 3] }\n'), "is \\[1, 2, 3\\]; write two pixel coordinates"),
    "click NaN": (text(more=JOINT + '"elbow.R" = { L = [nan, 2] }\n'), "joint “elbow.R” of .* in view L is \\[NaN, 2\\]"),
    "click of words": (text(more=JOINT + '"elbow.R" = { L = ["1", 2] }\n'), "write two pixel coordinates"),
    "locked a word": (text(more='[body]\nlocked = "elbow.R twist"\n'), "`locked` under \\[body\\] of .* write a list"),
    "limits a list": (text(more="[body]\nlimits = [1, 2]\n"), "\\[body.limits\\] of .* must be a table"),
    "limits turned": (text(more='[body.limits]\n"knee.R flexion" = [140, 0]\n'), "limits of “knee.R flexion” in .* are \\[140, 0\\]"),
    "keyframes a table": (text(more="[keyframes]\nframe = 3\n"), "must be written as \\[\\[keyframes\\]\\] tables"),
    "two keyframes alike": (text(more=KEYFRAME + KEYFRAME), "Two \\[\\[keyframes\\]\\] of .* are for the same frame"),
    "unknown joint of a keyframe": (
        text(more='[[keyframes]]\nframe = 3\n[keyframes.joints]\n"knuckle.R" = { L = [1, 2] }\n'),
        "\\[keyframes.joints\\] of .* has an unknown key “knuckle.R”. Did you mean “knuckles.R”",
    ),
    "surface in a keyframe": (text(more="[[keyframes]]\nframe = 3\nsurface = []\n"), "unknown key “surface”"),
    "a keyframe for the frame of the seeds": (
        text(more=KEYFRAME + '[seeds]\nframe = 3\n[seeds.joints]\n"wrist.R" = { L = [5, 5] }\n'),
        r"A \[\[keyframes\]\] of .* is for frame 3, as \[seeds.joints\] is; write its joints there",
    ),
    "keyframe of an unknown joint": (text(more=KEYFRAME.replace("elbow.R", "elbow.r")), "Did you mean “elbow.R”?"),
    "corrections a table": (text(more="[corrections]\nframe = 3\n"), "must be written as \\[\\[corrections\\]\\] tables"),
    "movie of a number": (text(views=VIEWS + "movie = 5\n"), "needs either `images`"),
    "time stamps of no name": (text(views=VIEWS + 'timestamps = "\\u0000"\n'), "`timestamps` of .* must be a file inside"),
    "background of no name": (text(views=VIEWS + 'background = "\\u0000"\n'), "`background` of .* must be a file inside"),
    "correction of a list of kinds": (text(more="[[corrections]]\nkind = [1]\n"), "`kind` of .* is \\[1\\]; write one of"),
    "correction of no kind": (text(more="[[corrections]]\nframe = 3\n"), "`kind` of .* is missing; write one of: trajectory, region"),
    "correction of no view": (text(more='[[corrections]]\nkind = "region"\n'), "`view` of .* is missing"),
    "region without polygon": (text(more=REGION), "needs frames = .* and a polygon of three or more"),
    "a corner beyond numbers": (text(more=REGION + "polygon = [[1, 2], [3, 1e308], [5, 6]]\n"), "a polygon of three or more"),
    "region of two corners": (text(more=REGION + "polygon = [[1, 2], [3, 4]]\n"), "a polygon of three or more"),
    "region of a keyframe": (text(more=REGION + "frame = 3\n"), "unknown key “frame”"),
    "trajectory without pixel": (text(more=TRAJECTORY), "a frame and xy"),
    "settings a word": (text(dict(settings='"x"')), "\\[settings\\] of .* must be a table"),
    "setting outside a group": (text(more="[settings]\npatch_px = 13\n"), "such as \\[settings.matching\\]; “patch_px” is not a table"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(tmp_path: Path, fault: str) -> None:
    content, said = FAULTS[fault]
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path / "the take", content)
    assert "the take" in str(error.value) and "\n" not in str(error.value)


def test_every_joint_of_the_body_but_its_top_can_be_clicked() -> None:
    """The report named the knuckles as least certain, and their clicks were refused."""
    assert {*read_model("full").skeleton.joint_names} == {*JOINTS, "crown"}


def test_folders_that_are_no_take(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError, match="is not a take: cannot read take.toml in it .* Make one with `tricap new`"):
            read_take(folder)
    (tmp_path / "take.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="is not a text in UTF-8 .* save it as UTF-8"):
        read_take(tmp_path)


def test_files_that_an_editor_saved_with_a_byte_order_mark(footage: Path) -> None:
    sound = open_take(read_take(footage))
    for name in ("take.toml", "rig.toml"):
        (footage / name).write_bytes(b"\xef\xbb\xbf" + (footage / name).read_bytes().replace(b"\n", b"\r\n"))
    marked = open_take(read_take(footage))
    assert marked.take.views == sound.take.views and [c.name for c in marked.rig.cameras] == [c.name for c in sound.rig.cameras]


def test_an_opened_take_has_its_cameras_in_the_order_of_its_views(footage: Path) -> None:
    views = "".join(f'[[views]]\nname = "{v}"\nimages = "{v}/*.png"\n' for v in "RLC")
    opened = open_take(rewrite(footage, views=views))
    assert [c.name for c in opened.rig.cameras] == ["R", "L", "C"] and opened.frames == range(5)
    assert [p.parent.name for p in opened.files(2)] == ["R", "L", "C"] and opened.files(2)[0].name == "0002.png"


def mark(folder: Path, view: str) -> None:
    """Let every image of a view show its own number."""
    for i, path in enumerate(sorted((folder / view).iterdir())):
        path.write_bytes(cv2.imencode(".png", np.full((30, 40), 10 * i, np.uint8))[1].tobytes())


def test_offsets_bring_views_into_step(footage: Path) -> None:
    """The image of take frame t is number t + offset."""
    for view in "LCR":
        mark(footage, view)
    views = VIEWS.replace('images = "C/*.png"', 'images = "C/*.png"\noffset_frames = 2').replace(
        'images = "R/*.png"', 'images = "R/*.png"\noffset_frames = -1'
    )
    opened = open_take(rewrite(footage, dict(frames="[1, 3]"), views))
    assert [image[0, 0] for image in opened.read(1)] == [10, 30, 0]
    assert [p.name for p in opened.files(2)] == ["0002.png", "0004.png", "0001.png"]
    for frames in ("[0, 3]", "[1, 4]"):
        with pytest.raises(InputError, match="`frames` of Prise é 1 is .* but the footage has frames 1 to 3"):
            open_take(rewrite(footage, dict(frames=frames), views))
    with pytest.raises(InputError, match=r"L ends with frame 4, C ends with frame 2, R ends with frame 5; write `frames = \[\d, 3\]`"):
        open_take(rewrite(footage, None, views))


def test_offsets_beyond_the_footage(footage: Path) -> None:
    views = VIEWS.replace('.png"\n', '.png"\noffset_frames = 5\n')
    with pytest.raises(InputError, match="no common frame"):
        open_take(rewrite(footage, None, views))


def test_views_of_unequal_length(footage: Path) -> None:
    (footage / "R" / "0004.png").unlink()
    with pytest.raises(
        InputError, match=r"The views of Prise é 1 end differently: .* R ends with frame 3; write `frames = \[0, 4\]` in take.toml"
    ):
        open_take(rewrite(footage))
    assert open_take(rewrite(footage, dict(frames="[0, 4]"))).frames == range(4)


def test_a_missing_image_is_named_also_where_the_lengths_agree(footage: Path) -> None:
    for view in "LCR":
        (footage / view / "0002.png").unlink()
    with pytest.raises(InputError, match="View L lacks the image.* between 0001.png and 0003.png"):
        open_take(rewrite(footage))


def test_a_rig_that_lacks_a_view(footage: Path) -> None:
    rig = footage / "rig.toml"
    rig.write_text(rig.read_text().replace('name = "C"', 'name = "centre"'))
    with pytest.raises(InputError, match="The rig has no camera “C”.* Give the views in take.toml the names of the cameras in rig.toml"):
        open_take(rewrite(footage))
    rig.unlink()
    with pytest.raises(InputError, match="Cannot read the rig .*rig.toml"):
        open_take(rewrite(footage))


@pytest.mark.parametrize("xy", [(-0.1, 5.0), (39.1, 5.0), (5.0, 29.5), (1e6, 1e6)])
def test_seeds_outside_the_image(footage: Path, xy: tuple[float, float]) -> None:
    at = f"{{ L = [{xy[0]}, {xy[1]}], C = [5.0, 5.0] }}"
    with pytest.raises(InputError, match="The joint “elbow.R” in view L lies at .* outside the image of 40×30 pixels; click it again"):
        open_take(rewrite(footage, more=f'[seeds.joints]\n"elbow.R" = {at}\n'))
    with pytest.raises(InputError, match="The surface seed 1 in view L lies at"):
        open_take(rewrite(footage, more=f"[seeds]\nsurface = [{at}]\n"))


def test_seeds_of_a_frame_that_is_not_there(footage: Path) -> None:
    clicked = '[seeds]\nframe = 5\n[seeds.joints]\n"elbow.R" = { L = [5, 5], C = [5, 5] }\n'
    with pytest.raises(InputError, match="clicks of .* in frame 5 are not among the frames 0 to 4"):
        open_take(rewrite(footage, more=clicked))
    with pytest.raises(InputError, match="clicks of .* in frame 5"):
        open_take(rewrite(footage, more=KEYFRAME.replace("frame = 3", "frame = 5")))
    assert open_take(rewrite(footage, more="[seeds]\nframe = 5\n")).frames == range(5)  # without clicks it means nothing


def test_images_of_another_size_than_the_camera(footage: Path) -> None:
    path = footage / "C" / "0003.png"
    path.write_bytes(cv2.imencode(".png", np.zeros((40, 30), np.uint8))[1].tobytes())
    opened = open_take(rewrite(footage))
    assert len(opened.read(2)) == 3
    with pytest.raises(InputError, match="0003.png has 30×40 pixels, but its camera has 40×30"):
        opened.read(3)
    unmeasured = tuple(ImageFiles(sequence.files(), sequence.source) for sequence in opened.sequences)
    with pytest.raises(InputError, match="Frame 3 of view C has 30×40 pixels, but its camera in rig.toml has 40×30"):
        open_take(rewrite(footage), unmeasured).read(3)


def test_images_of_another_size_are_not_decoded(footage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """280 kB of 6000×6000 pixels took 900 MB to say so."""
    opened = open_take(rewrite(footage))
    assert len(opened.read(2)) == 3
    (footage / "C" / "0003.png").write_bytes(cv2.imencode(".png", np.zeros((60, 60), np.uint8))[1].tobytes())
    monkeypatch.setattr(cv2, "imdecode", lambda *a: pytest.fail("decoded"))
    with pytest.raises(InputError, match="0003.png has 60×60 pixels, but its camera has 40×30"):
        opened.sequences[1].read(3)


def test_a_text_file_named_png(footage: Path) -> None:
    (footage / "L" / "0001.png").write_text("hello")
    with pytest.raises(InputError, match="0001.png is not a readable image"):
        open_take(rewrite(footage)).read(1)


def test_movies_and_images_side_by_side(footage: Path) -> None:
    for view in "LCR":
        mark(footage, view)
    writer = cv2.VideoWriter(str(footage / "centre é.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (40, 30))
    for i in range(5):
        writer.write(np.full((30, 40, 3), 10 * i, np.uint8))
    writer.release()
    shutil.rmtree(footage / "C")
    opened = open_take(rewrite(footage, None, VIEWS.replace('images = "C/*.png"', 'movie = "centre é.avi"')))
    for frame in (0, 3, 1):
        assert np.allclose([image.mean() for image in opened.read(frame)], 10 * frame, atol=1.5)
    assert [p.name for p in opened.files(3)] == ["0003.png", "centre é.avi", "0003.png"]
