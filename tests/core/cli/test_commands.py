"""The command line of the core: exit codes, one sentence on stderr, no partial results, cancelling, and `tricap new`."""

import json
import os
import shutil
import signal
import time
import warnings
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import MODELS
from tricap.core.calibration.rig_files import write_as
from tricap.core.cli import main, stages
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Course, Monitor
from tricap.core.geometry.rig import read_rig
from tricap.core.results.folder import FIELDS
from tricap.core.run import pipeline
from tricap.core.run.settings import SETTINGS
from tricap.core.take import writing
from tricap.core.take.bar_file import bar_path, read_bar, write_bar
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

from ...waiting import when

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def small(tmp_path: Path, scenes: Any) -> Path:
    """A take of five flat frames; nothing can be measured in it, everything can be checked."""
    return scenes.write_take(tmp_path / "my take é", scenes.three_cameras(width=96, height=72), [[]] * 5, noise=0.0)


@pytest.fixture
def take(plane_take: Path, tmp_path: Path) -> Path:
    """A copy of the take of a plane, which may be changed."""
    return Path(shutil.copytree(plane_take, tmp_path / "plane"))


def edit(take: Path, old: str, new: str, name: str = "take.toml") -> None:
    path = take / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def click(take: Path, more: str) -> None:
    (take / "take.toml").write_text((take / "take.toml").read_text() + more)


FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no take": (lambda t: (t / "take.toml").unlink(), "is not a take"),
    "missing image": (lambda t: (t / "L" / "0002.png").unlink(), "View L lacks the image(s) between 0001.png and 0003.png"),
    "unequal length": (lambda t: (t / "R" / "0004.png").unlink(), "R ends with frame 3; write `frames = [0, 4]`"),
    "no images": (lambda t: shutil.rmtree(t / "R"), "View R has no images"),
    "rig missing": (lambda t: (t / "rig.toml").unlink(), "Cannot read the rig"),
    "rig lacks a view": (lambda t: edit(t, 'name = "R"', 'name = "X"', "rig.toml"), "The rig has no camera “R”"),
    "rig with NaN": (lambda t: edit(t, "translation = [", "translation = [nan, 1.0, 2.0] # ", "rig.toml"), "must be 3 finite numbers"),
    "unknown key": (lambda t: edit(t, "fps", "fqs"), "unknown key “fqs”. Did you mean “fps”?"),
    "wrong version": (lambda t: edit(t, "version = 1", "version = 7"), 'version = 1; it has "tricap-take" and 7'),
    "a folder for a pattern": (lambda t: edit(t, "L/*.png", "L"), "“L” is a folder; write “L/*.png”"),
    "offset true": (lambda t: edit(t, 'name = "L"\n', 'name = "L"\noffset_frames = true\n'), '`offset_frames` of view "L" of'),
    "offset in parts": (lambda t: edit(t, 'name = "L"\n', 'name = "L"\noffset_frames = 1.5\n'), "is 1.5; write a whole number"),
    "offset endless": (lambda t: edit(t, 'name = "L"\n', f'name = "L"\noffset_frames = {10**15}\n'), "write a whole number of frames"),
    "path outside": (lambda t: edit(t, "L/*.png", "../L/*.png"), "lies outside the take"),
    "unknown setting": (lambda t: click(t, "[settings.matching]\npatch = 13\n"), "has no setting “patch”. Did you mean “patch_px”?"),
    "setting out of range": (lambda t: click(t, "[settings.matching]\npatch_px = 1000\n"), "it must lie between 5 and 51"),
    "unknown group": (lambda t: click(t, "[settings.matchin]\npatch_px = 13\n"), "There is no group of settings “matchin” in "),
    "seed outside": (lambda t: click(t, '[seeds.joints]\n"elbow.R" = { L = [96.0, 3], C = [3, 3] }\n'), "outside the image of 96×72"),
    "seed in one view": (lambda t: click(t, '[seeds.joints]\n"elbow.R" = { L = [6, 3] }\n'), "Click it in two views at least"),
    "contradicting clicks": (
        lambda t: click(t, '[seeds.joints]\n"elbow.R" = { L = [40, 1], C = [40, 70] }\n'),
        "“elbow.R” miss each other by",
    ),
    "text named png": (lambda t: (t / "C" / "0000.png").write_text("hello"), "0000.png is not a readable image"),
    "nothing to measure": (lambda t: None, "No surface could be measured in frame 0"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_input_that_needs_mending(small: Path, tmp_path: Path, capfd: Capture, fault: str) -> None:
    """Exit code 2, one sentence on stderr and nothing on stdout; there are no results, at most checkpoints."""
    spoil, said = FAULTS[fault]
    spoil(small)
    out = tmp_path / "out"
    assert main.main(["measure", str(small), "--out", str(out), "--quiet"]) == 2
    printed = capfd.readouterr()
    assert said in printed.err and printed.out == ""
    assert printed.err.startswith("tricap: ") and printed.err.count("\n") == 1 and "Traceback" not in printed.err
    assert not [path for path in out.rglob("*.*") if "cache" not in path.relative_to(out).parts]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--frames", "3"], "--frames 3 cannot be read"),
        (["--frames", "3:x"], "--frames 3:x cannot be read"),
        (["--frames", "²:³"], "cannot be read"),
        (["--frames", "2:2"], "Frames 2:2 are not among the take's frames 0:5"),
        (["--frames", "3:1"], "Frames 3:1 are not among"),
        (["--frames", "0:6"], "Frames 0:6 are not among"),
        (["--frames", "5:6"], "Frames 5:6 are not among"),
        (["--set", "matching.patch_px"], "--set matching.patch_px cannot be read; write GROUP.NAME=VALUE"),
        (["--set", "patch_px=3"], "--set patch_px=3 cannot be read"),
        (["--set", "matching.patch_px=3"], "it must lie between 5 and 51"),
        (["--set", "matching.patch_px=inf"], "a number in px is needed"),
        (["--set", "matching.patch_px=x"], "a number in px is needed"),
        (["--set", "matching.patch_px="], "a number in px is needed"),
        (["--set", "matching.patch=13"], "Did you mean “patch_px”"),
        (["--set", "match.patch_px=13"], "There is no group of settings “match”. Did you mean “matching”"),
        (["--set", "surface.correct_curvature=1"], "write true or false"),
    ],
)
def test_options_that_need_mending(small: Path, tmp_path: Path, capfd: Capture, more: list[str], said: str) -> None:
    assert main.main(["measure", str(small), "--out", str(tmp_path / "out"), *more]) == 2
    printed = capfd.readouterr()
    assert said in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert not (tmp_path / "out").exists()


FROM_IMAGES = "belongs to a calibration from images, and not to --import; leave it out"
BAR = ["calibrate", "{d}", "--bar-length", "0.5", "--out", "{o}"]
IGNORED = [
    *([["calibrate", "--import", "{t}/rig.toml", "--out", "{o}", *more], f"{more[0]} {FROM_IMAGES}"] for more in (
        ["--report", "{d}"], ["--mask", "{d}"], ["--interlaced", "odd"], ["--bar-length", "0.4"], ["--lens", "fisheye"],
        ["--rates", "L=24"], ["--first-field", "even"], ["--focal-px", "900"], ["--synchronise", "30"], ["--target-diameter", "0.05"])),
    [[*BAR, "--first-field", "even", "--interlaced", "odd"], "--first-field belongs to --interlaced both; leave it out"],
    [[*BAR, "--dictionary", "DICT_5X5_50"], "--dictionary describes the markers of --board charuco"],
    [["track", "{t}", "--out", "{d}", "--points-frame", "2"], "--points-frame is the frame of --points, which were not given"],
]  # fmt: skip


@pytest.mark.parametrize("argv, said", IGNORED, ids=lambda value: " ".join(value) if isinstance(value, list) else "")
def test_an_option_that_would_be_ignored_is_refused(small: Path, tmp_path: Path, capfd: Capture, argv: list[str], said: str) -> None:
    assert main.main([word.format(t=small, d=tmp_path / "d", o=tmp_path / "o.toml") for word in argv]) == 2
    printed = capfd.readouterr()
    assert said in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert not (tmp_path / "o.toml").exists() and not (tmp_path / "d").exists()


@pytest.mark.parametrize("argv", [["run", "TAKE", "--out", ""], ["run", "", "--out", "o"], ["check", " "], ["batch", "TAKE", "--out", ""]])
def test_an_empty_name_is_not_the_working_folder(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture, argv: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main.main([str(small) if word == "TAKE" else word for word in argv])
    assert stop.value.code == 2 and "is empty; name a file or a folder" in capfd.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == [small.name]


def test_negative_frames_are_frames(small: Path, tmp_path: Path, capfd: Capture) -> None:
    for more in (["--frames", "-5:3"], ["--frames=-5:3"]):
        assert main.main(["measure", str(small), "--out", str(tmp_path / "out"), *more]) == 2
        assert "--frames -5:3 cannot be read; write the first frame" in capfd.readouterr().err


BODY = '[body]\nmodel = "{model}"\n{more}\n[seeds.joints]\n"elbow.R" = {{ {at} }}\n"{second}" = {{ {at} }}\n'
BODY_FAULTS = {
    "one joint": (dict(second="hip.R"), "needs at least two of the joints"),
    "another limb": (dict(model="leg.L"), "needs at least two of the joints"),
    "locked": (dict(more='locked = ["elbow twist"]'), "has no joint angle “elbow twist”"),
    "limits": (dict(more='limits = { "knee.L flexion" = [0, 90] }'), "has no joint angle “knee.L flexion”"),
}


@pytest.mark.parametrize("fault", BODY_FAULTS)
@pytest.mark.parametrize("command", ["run", "fit"])
def test_a_body_that_cannot_be_fitted_is_told_before_anything_is_measured(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture, fault: str, command: str
) -> None:
    changed, said = BODY_FAULTS[fault]
    rig = read_rig(small / "rig.toml")
    places = {name: rig[name].project(np.array([0.02, 0.01, 2.1])) for name in "CR"}
    at = ", ".join(f"{view} = [{x:.1f}, {y:.1f}]" for view, (x, y) in places.items())
    click(small, BODY.format(**{"model": "arm.R", "more": "", "second": "wrist.R", "at": at, **changed}))
    monkeypatch.setattr(pipeline, "measure_frames", lambda *args: pytest.fail("measured first"))
    assert main.main([command, str(small), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert said in capfd.readouterr().err


@pytest.mark.parametrize("argv", [[], ["measure"], ["mesure", "x"], ["measure", "x", "--out"], ["run", "x", "--out", "y", "--nonsense"]])
def test_a_wrong_command_line_has_exit_code_2(argv: list[str], capfd: Capture) -> None:
    with pytest.raises(SystemExit) as stop:
        main.main(argv)
    assert stop.value.code == 2
    assert "Traceback" not in capfd.readouterr().err


def test_folders_for_results_that_cannot_be_used(small: Path, tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "foreign" / "report").mkdir(parents=True)
    (tmp_path / "home" / "cache").mkdir(parents=True)
    (tmp_path / "home" / "cache" / "thesis.txt").write_text("x")
    faults = dict(file="is a file; choose a folder", foreign="contains “report”, which was not written by Tricap", home="contains “cache”")
    for out, said in (faults | {"file/deep": "Cannot make the folder"}).items():
        assert main.main(["measure", str(small), "--out", str(tmp_path / out)]) == 2
        printed = capfd.readouterr()
        assert said in printed.err and printed.err.count("\n") == 1
    assert [p.name for p in (tmp_path / "foreign").iterdir()] == ["report"] and (tmp_path / "home" / "cache" / "thesis.txt").exists()


def test_a_text_file_named_mp4_is_one_sentence_too(small: Path, tmp_path: Path, capfd: Capture) -> None:
    (small / "left.mp4").write_text("no movie")
    edit(small, 'images = "L/*.png"', 'movie = "left.mp4"')
    assert main.main(["measure", str(small), "--out", str(tmp_path / "out")]) == 2
    said = capfd.readouterr().err.splitlines()[-1]  # a decoder that an earlier test opened may have said its own before
    assert said == f"tricap: {small / 'left.mp4'} is not a movie that can be decoded; convert it to H.264 in .mp4, or to PNG files."


def test_measuring_from_the_command_line(take: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "out"
    argv = ["measure", str(take), "--out", str(out), "--frames", "0:2", "--set", "matching.patch_px=11"]
    assert main.main(argv) == 0
    printed = capfd.readouterr()
    assert "2 frames" in printed.out and "surface: 0 %" in printed.err
    run = json.loads((out / "run.json").read_text())
    assert run["frames"] == [0, 2] and run["settings"]["matching"]["patch_px"] == 11 and run["stages"]["measure"]["frames"] == 2
    assert sorted(p.name for p in (out / "clouds").iterdir()) == ["0000.ply", "0001.ply"]
    assert not list(out.rglob("*.part"))
    assert main.main([*argv, "--json", "--quiet"]) == 0
    printed = capfd.readouterr()
    assert json.loads(printed.out)["stages"]["measure"]["points_per_frame"] > 300 and printed.err == ""
    assert main.main([*argv, "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")


def test_seeds_from_the_command_line(take: Path, capfd: Capture) -> None:
    assert main.main(["seeds", str(take), "--quiet"]) == 0
    assert "surface seeds between" in capfd.readouterr().out


def test_quiet_keeps_no_finding_back(take: Path, capfd: Capture) -> None:
    """What is asked for is the answer of `check`; quiet are progress, and what is good."""
    assert main.main(["check", str(take / "rig.toml"), "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")
    edit(take, 'unit = "m"', 'unit = "m"\nsigma0_px = 9.0', "rig.toml")
    assert main.main(["check", str(take / "rig.toml")]) == 1
    told = capfd.readouterr().out
    assert main.main(["check", str(take / "rig.toml"), "--quiet"]) == 1
    assert capfd.readouterr() == (told, "") and told


def test_progress_on_stderr_is_a_line_per_tenth(capfd: Capture) -> None:
    report = main._plain_progress(Monitor())
    for i in range(101):
        report("surface", i, 100)
    assert capfd.readouterr().err.splitlines() == [f"surface: {10 * i} %" for i in range(11)]


def test_progress_of_a_run_on_stderr_is_a_line_per_twentieth_with_the_time_left(capfd: Capture) -> None:
    now = iter(range(10_000))
    monitor = Monitor()
    monitor.report, monitor.course = main._plain_progress(monitor), Course([("surface", 60.0), ("skin", 40.0)], clock=lambda: next(now))
    for stage, steps in (("surface", 60), ("skin", 40)):
        for i in range(steps + 1):
            monitor.step(stage, i, steps)
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(" %")[0] for line in lines] == [str(5 * i) for i in range(21)]
    assert lines[0] == "0 % (surface)" and lines[12].endswith(" s left (surface)") and lines[13].endswith(" s left (skin)"), lines


def test_all_settings_are_listed(capfd: Capture) -> None:
    """There was no other list than the one in the message about a wrong name."""
    assert main.main(["settings"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert "matching.patch_px=13 px   (5 to 51)" in lines
    knobs = [f"{group}.{knob.name}" for group, settings in SETTINGS.items() for knob in fields(settings)]
    assert [line.split("=")[0] for line in lines[::2]] == knobs and all(
        line.startswith("    ") and line.endswith(".") for line in lines[1::2]
    )
    assert main.main(["settings", "skin"]) == 0
    assert all(line.startswith(("skin.", "    ")) for line in capfd.readouterr().out.splitlines())
    assert main.main(["settings", "fiting"]) == 2
    assert "Did you mean “fitting”?" in capfd.readouterr().err


def test_ctrl_c_stops_within_a_second_and_says_what_is_kept(take: Path, tmp_path: Path, capfd: Capture) -> None:
    """SIGINT while the second frame is measured: exit code 130, the first frame's cloud and checkpoints stay, the handler is put back."""
    out, before, pressed = tmp_path / "out", signal.getsignal(signal.SIGINT), []

    def press() -> None:
        pressed.append(time.process_time())
        os.kill(os.getpid(), signal.SIGINT)

    thread = when((out / "clouds" / "0000.ply").exists, press)
    assert main.main(["run", str(take), "--out", str(out)]) == 130
    took = time.process_time() - pressed[0]
    thread.join()
    assert took < 1.0 and signal.getsignal(signal.SIGINT) is before
    printed = capfd.readouterr()
    last = printed.err.splitlines()[-1]
    assert last.startswith("tricap: Stopped: the surface of ") and "is kept; run it again to go on." in last
    kept = int(last.split("surface of ")[1].split()[0])
    assert sorted(p.name for p in (out / "clouds").iterdir()) == [f"{i:04d}.ply" for i in range(kept)]
    assert len(list((out / "cache" / "surface").iterdir())) == kept and not list(out.rglob("*.part"))
    assert not (out / "trajectories.npz").exists() and printed.out == ""
    assert main.main(["check", str(out)]) == 1 and "was stopped before its surface was measured" in capfd.readouterr().out


@pytest.mark.parametrize("stage", ["seeds", "surface", "tracks"])
def test_a_cancel_in_any_stage_is_exit_code_130(
    take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture, stage: str
) -> None:
    step = Monitor.step

    def cancelling(self: Monitor, name: str, done: float, total: float) -> None:
        if name == stage:
            self.cancel()
        step(self, name, done, total)

    monkeypatch.setattr(Monitor, "step", cancelling)
    argv = ["seeds", str(take)] if stage == "seeds" else ["track", str(take), "--out", str(tmp_path / "out"), "--frames", "0:2"]
    assert main.main(argv) == 130
    assert "Stopped" in capfd.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out" / "trajectories.npz").exists()


def test_commands_that_others_join_see_errors_and_cancels_alike(capfd: Capture) -> None:
    def add(sub: Any) -> None:
        for name, what in (("mend", InputError("Mend it.")), ("stop", Cancelled("Stopped."))):
            sub.add_parser(name).set_defaults(run=lambda args, monitor, what=what: (_ for _ in ()).throw(what))
        sub.add_parser("fine").set_defaults(run=lambda args, monitor: ["Done."])
        sub.add_parser("bug").set_defaults(run=lambda args, monitor: [][0])

    assert [main.main([name], (add,)) for name in ("mend", "stop", "fine")] == [2, 130, 0]
    assert capfd.readouterr() == ("Done.\n", "tricap: Mend it.\ntricap: Stopped.\n")
    with pytest.raises(IndexError):  # ours: Python prints the traceback and ends with 1
        main.main(["bug"], (add,))


def test_a_monitor_cancelled_before_it_begins(take: Path, tmp_path: Path) -> None:
    monitor = Monitor()
    monitor.cancel()
    with pytest.raises(Cancelled, match="0 of 4 frames"):
        pipeline.run(take, tmp_path / "out", monitor=monitor)
    assert not list((tmp_path / "out").rglob("*.*"))


# tricap new


def test_new_makes_a_take_of_movies_and_folders(take: Path, tmp_path: Path, capfd: Capture) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "centre é 1.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (200, 150))
    for _ in range(4):
        writer.write(np.zeros((150, 200, 3), np.uint8))
    writer.release()
    views = [f"L={take / 'L'}", f"C={tmp_path / 'centre é 1.avi'}", f"R={take / 'R'}"]
    made = tmp_path / "new é"
    argv = ["new", str(made), "--views", *views, "--interlaced", "both", "--fps", "25", "--rig", str(take / "rig.toml"), "--model", "arm.R"]
    assert main.main(argv) == 0
    opened = open_take(read_take(made))
    assert opened.frames == range(8) and opened.take.fps == 50 and opened.take.interlaced == "both" and opened.take.body_model == "arm.R"
    decoder = opened.sequences[1]._capture  # type: ignore[attr-defined]
    assert len(opened.read(2)) == len(opened.read(3)) == 3  # the second field's image need not be decoded again
    said = capfd.readouterr().out
    assert opened.sequences[1]._capture is decoder and "a take of 3 views, 25 images per second. Next: click joints in Blender" in said
    assert main.main(argv) == 2
    assert "is a take already" in capfd.readouterr().err


def test_new_takes_the_movies_frame_rate_and_says_what_it_assumes(take: Path, tmp_path: Path, capfd: Capture) -> None:
    for name in "LCR":
        writer = cv2.VideoWriter(str(tmp_path / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 29.97, (200, 150))
        for _ in range(4):
            writer.write(np.zeros((150, 200, 3), np.uint8))
        writer.release()
    movies, images = ([f"{name}={folder / (name + ending)}" for name in "LCR"] for folder, ending in ((tmp_path, ".avi"), (take, "")))
    for made, views, more, fps, said in (
        ("movies", movies, [], 29.97, "29.97 images per second. Next"),
        ("told", movies, ["--fps", "60"], 60.0, "60 images per second. Next"),
        ("images", images, [], 25.0, "The footage states no frame rate, so 25 is assumed"),
        ("told too", images, ["--fps", "25"], 25.0, "25 images per second. Next"),
    ):
        assert main.main(["new", str(tmp_path / made), "--views", *views, *more]) == 0
        printed = capfd.readouterr().out
        assert read_take(tmp_path / made).fps == pytest.approx(fps, abs=1e-5) and said in printed
        assert ("assumed" in printed) == (made == "images")


def test_new_names_the_cameras_that_the_views_should_have(take: Path, tmp_path: Path, capfd: Capture) -> None:
    views = [f"{name}={take / folder}" for name, folder in (("left", "L"), ("C", "C"), ("R", "R"))]
    assert main.main(["new", str(tmp_path / "new"), "--views", *views, "--rig", str(take / "rig.toml")]) == 2
    said = capfd.readouterr().err
    assert "has no camera “left”, but L, C, R; give --views these names, such as L=FILE." in said and not (tmp_path / "new").exists()


def test_new_refuses_a_rig_for_images_of_another_size(take: Path, tmp_path: Path, capfd: Capture) -> None:
    """Before the first file is written, not when it is measured."""
    views, rig = [f"{name}={take / name}" for name in "LCR"], tmp_path / "other.toml"
    h, w = cv2.imread(str(take / "L" / "0000.png")).shape[:2]
    rig.write_text((take / "rig.toml").read_text().replace(f"size = [{w}, {h}]", f"size = [{2 * w}, {2 * h}]"))
    assert main.main(["new", str(tmp_path / "new"), "--views", *views, "--rig", str(rig)]) == 2
    assert f"has {w}×{h} pixels, but its camera has {2 * w}×{2 * h}; use the footage as it was calibrated." in capfd.readouterr().err
    assert not (tmp_path / "new").exists()
    assert main.main(["new", str(tmp_path / "new"), "--views", *views, "--rig", str(take / "rig.toml")]) == 0


def test_new_makes_a_take_without_a_body(take: Path, tmp_path: Path, capfd: Capture) -> None:
    views = [f"{name}={take / name}" for name in "LCR"]
    assert main.main(["new", str(tmp_path / "new"), "--views", *views, "--model", "none"]) == 0
    assert read_take(tmp_path / "new").body_model is None and "click" not in capfd.readouterr().out
    assert main.main(["new", str(tmp_path / "auto"), "--views", *views, "--model", "auto"]) == 0
    assert read_take(tmp_path / "auto").joints_model == "full"


@pytest.mark.parametrize(
    ("change", "said"), [({"--model": "fulll"}, "no body model “fulll”. Did you mean “full”"), ({"L": "rig.toml"}, "neither a folder")]
)
def test_new_refuses_what_no_run_could_read(take: Path, tmp_path: Path, capfd: Capture, change: dict[str, str], said: str) -> None:
    views = [f"{name}={take / change.get(name, name)}" for name in "LCR"]
    assert main.main(["new", str(tmp_path / "new"), "--views", *views, "--model", change.get("--model", "full")]) == 2
    assert said in capfd.readouterr().err and not (tmp_path / "new").exists()


def test_new_takes_cameras_of_another_tool_and_the_bar_beside_them(take: Path, tmp_path: Path) -> None:
    rig = read_rig(take / "rig.toml")
    write_as(tmp_path / "camera_array.toml", rig, "caliscope")
    write_bar(tmp_path / "camera_array.toml", rig, np.arange(2), np.ones((2, 2, 3)))
    argv = ["new", str(tmp_path / "new"), "--views", *(f"{v}={take / v}" for v in "LCR")]
    assert main.main([*argv, "--rig", str(tmp_path / "camera_array.toml")]) == 0
    made = open_take(read_take(tmp_path / "new")).rig
    assert np.allclose([c.t_cam_world_m for c in made.cameras], [c.t_cam_world_m for c in rig.cameras])
    assert (bar := read_bar(tmp_path / "new" / "rig.toml", made)) is not None and np.allclose(bar[1], 1.0)


def test_new_takes_footage_that_lies_in_the_folder_already(take: Path) -> None:
    (take / "take.toml").unlink()
    assert main.main(["new", str(take), "--views", *(f"{v}={take / v}" for v in "LCR")]) == 0
    assert open_take(read_take(take)).frames == range(4)


NEW_FAULTS = {
    "no name": (["{t}/L", "C={t}/C"], [], "Write each view as NAME=FILE"),
    "empty name": (["={t}/L", "C={t}/C"], [], "Write each view as NAME=FILE"),
    "missing": (["L={t}/L", "C={t}/missing.mp4"], [], "missing.mp4 of view C is missing"),
    "pattern": (["L={t}/L", "C={t}/C/*.png"], [], "for a pattern give its folder"),
    "twice": (["L={t}/L", "C={t}/C/../L"], [], "View L has the same footage as another"),
    "in the footage": (["L={t}/..", "C={t}/C"], [], "made is the folder of the images of view L, or lies in it"),
    "no images": (["L={t}/L", "C={t}"], [], "has no images"),
    "one view": (["L={t}/L"], [], "needs at least two"),
    "two alike": (["L={t}/L", "L={t}/C"], [], "have the same name"),
    "name leaves the folder": (["L={t}/L", "../C={t}/C"], [], "a character in its name"),
    "name with quotes": (["L={t}/L", 'C"\nx={t}/C'], [], "a character in its name"),
    "fps": (["L={t}/L", "C={t}/C"], ["--fps", "nan"], "`fps` of"),
    "fps 0": (["L={t}/L", "C={t}/C"], ["--fps", "0"], "`fps` of"),
    "rig missing": (["L={t}/L", "C={t}/C"], ["--rig", "{t}/none.toml"], "none.toml is missing"),
    "rig of others": (["L={t}/L", "X={t}/C"], ["--rig", "{t}/rig.toml"], "has no camera “X”, but L, C, R"),
    "named take.toml": (["take.toml={t}/L", "C={t}/C"], [], "cannot be named “take.toml”"),
    "named rig.toml": (["Rig.TOML={t}/L", "C={t}/C"], ["--rig", "{t}/rig.toml"], "cannot be named “Rig.TOML”, as a file of the take"),
    "named as the bar": (["rig_bar.csv={t}/L", "C={t}/C"], [], "cannot be named “rig_bar.csv”"),
    "named as the fields": (["Fields={t}/L", "C={t}/C"], [], "cannot be named “Fields”"),
    "model missing": (["L={t}/L", "C={t}/C"], ["--model", "mine.toml"], "made/mine.toml is missing; copy it into that folder first"),
    "rig is none": (["L={t}/L", "C={t}/C"], ["--rig", "{t}/L/0000.png"], "is of no known kind"),
}


@pytest.mark.parametrize("fault", NEW_FAULTS)
def test_new_checks_everything_before_it_makes_a_file(take: Path, tmp_path: Path, capfd: Capture, fault: str) -> None:
    views, more, said = NEW_FAULTS[fault]
    argv = ["new", str(tmp_path / "made"), "--views", *views, *more]
    assert main.main([a.replace("{t}", str(take)) for a in argv]) == 2
    printed = capfd.readouterr()
    assert said in printed.err and printed.err.count("\n") == 1
    assert not (tmp_path / "made").exists()


def test_the_names_that_views_cannot_have_are_those_of_the_takes_files() -> None:
    assert {FIELDS, "take.toml", bar_path(Path("rig.toml")).name} < {*writing.OWN_NAMES}
    assert [name for name in writing.OWN_NAMES if name != name.casefold()] == []


@pytest.mark.parametrize(("text", "said"), [
    ("x", "cannot be read"),
    ('format = "tricap-model"\nversion = 1\n', "lacks an entry or has a wrong value"),
    ("# " + "x" * (4 << 20), "it is larger than 4 MB"),
])  # fmt: skip
def test_new_reads_a_model_that_lies_in_the_folder(take: Path, tmp_path: Path, capfd: Capture, text: str, said: str) -> None:
    made = tmp_path / "made"
    made.mkdir()
    argv = ["new", str(made), "--views", *(f"{v}={take / v}" for v in "LCR"), "--model", "mine.toml"]
    (made / "mine.toml").write_text(text)
    assert main.main(argv) == 2 and [p.name for p in made.iterdir()] == ["mine.toml"]
    printed = capfd.readouterr().err
    assert "mine.toml" in printed and said in printed and printed.count("\n") == 1
    shutil.copy(MODELS / "arm.R.toml", made / "mine.toml")
    assert main.main(argv) == 0 and read_take(made).joints_model == str(made / "mine.toml")


def test_new_does_not_touch_what_is_there(take: Path, tmp_path: Path, capfd: Capture) -> None:
    made = tmp_path / "made"
    (made / "C").mkdir(parents=True)
    (made / "C" / "mine.png").write_text("x")
    views = ["--views", f"L={take / 'L'}", f"C={take / 'C'}"]
    assert main.main(["new", str(made), *views]) == 2
    assert "exists and is not the footage" in capfd.readouterr().err
    assert [p.name for p in made.iterdir()] == ["C"]
    (tmp_path / "file").write_text("x")
    assert main.main(["new", str(tmp_path / "file"), *views]) == 2
    assert "Cannot make the take" in capfd.readouterr().err


def test_new_leaves_nothing_when_the_disk_is_full(take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writing.store, "write_text", full)
    made = tmp_path / "made"
    assert main.main(["new", str(made), "--views", *(f"{v}={take / v}" for v in "LC")]) == 2
    assert "No space left on device" in capfd.readouterr().err and not any(made.iterdir())
    assert len(list((take / "L").iterdir())) == 4  # what the links pointed to stays


def test_a_finished_run_is_not_computed_again(take: Path, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    argv, out = ["run", str(take), "--out", str(tmp_path / "out"), "--frames", "0:2"], tmp_path / "out"
    assert main.main([*argv, "--quiet"]) == 0
    before, computed = (out / "run.json").read_bytes(), []
    monkeypatch.setattr(pipeline, "all_stages", lambda *_: computed.append(1))
    capfd.readouterr()
    assert main.main(argv) == 0 and not computed and (out / "run.json").read_bytes() == before
    said = capfd.readouterr().out
    assert "Nothing has changed" in said and "2 frames" in said
    with monkeypatch.context() as blender:
        built: list[int] = []
        blender.setattr(stages, "_has_scene", lambda *_: False)
        blender.setattr(stages, "_build_scene", lambda *_: [str(built.append(1))])
        assert main.main([*argv, "--quiet"]) == 0 and built and not computed, "the Blender file alone is missing: it alone is made"
    for more in (["--restart"], ["--pictures", "1"], ["--set", "growing.spacing_px=5"]):
        shutil.copytree(out, tmp_path / "copy", dirs_exist_ok=True)
        main.main(["run", str(take), "--out", str(tmp_path / "copy"), "--frames", "0:2", *more, "--quiet"])
        assert computed.pop()
    shutil.rmtree(out / "report")
    main.main([*argv, "--quiet"])
    assert computed.pop()


def test_numbers_that_overflow_are_no_second_sentence(small: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def seeds(args: Any, monitor: Monitor) -> list[str]:
        assert np.isnan(np.float64(np.inf) * np.zeros(1)).all()
        raise InputError("The file is damaged.")

    monkeypatch.setattr(stages, "seeds", seeds)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert main.main(["seeds", str(small), "--quiet"]) == 2
    assert not told and capsys.readouterr().err.splitlines() == ["tricap: The file is damaged."]
