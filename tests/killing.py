"""Runs that are killed (SIGKILL) at chosen moments and then run again: the engine of test_killed_runs.py and of `dev.py bench resume`.

A moment is a time within a stage, or a file operation: before or after a rename, a removal or an fsync, or with half of a file written.
A run is killed a few times, goes on each time, and in the end OUT must hold the bytes that a run without any kill leaves.
"""

import importlib
import json
import os
import random
import re
import select
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from tricap.core.foundation.progress import Monitor
from tricap.core.run import pipeline  # noqa: F401  loaded before the first fork
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

EXTENSION = "bl_ext.user_default.tricap"
FILE_OPERATIONS = ("replace", "unlink", "fsync")
LIMIT_S = 120.0  # a child that takes longer hangs
KILLS = 4  # of one run
SETTINGS = {"growing": {"spacing_px": 6}, "tracking": {"min_length": 3}}


@dataclass(frozen=True)
class Moment:
    """When to kill: `after_s` into `stage`, or at file operation number `operation` (`how`: before, after, half)."""

    stage: str = ""
    after_s: float = 0.0
    operation: int = -1
    how: str = ""


@dataclass
class Ended:
    """How a child ended: its exit code (−9: killed), its last stage, and when each stage began."""

    code: int
    stage: str
    began: dict[str, float]
    ended: float
    operations: int
    said: str


@dataclass
class Tally:
    """What was tried."""

    moments: Counter[str] = field(default_factory=Counter)
    runs: int = 0
    faults: list[str] = field(default_factory=list)


def prepare_profile(folder: Path) -> None:
    """A Blender profile of our own, in which the extension is this source; for the children to come."""
    repository, source = folder / "extensions" / "user_default", Path(__file__).resolve().parent.parent
    repository.mkdir(parents=True)
    (repository / "tricap").symlink_to(source, target_is_directory=True)
    os.environ["BLENDER_USER_RESOURCES"] = str(folder)


def tiny_take(folder: Path) -> Path:
    """Four frames of 192×144 pixels with a body."""
    make_arm_take(folder, ArmTakeSettings(frames=4, width_px=192, interlaced="none"))
    return folder


def command(take: Path, out: Path, tell: "Tell", in_stretches: bool = False) -> None:
    """Driver: `tricap run`, with body.blend where there is bpy."""
    from tricap.__main__ import main

    tell(Monitor)
    if in_stretches:
        short_stretches("tricap")
    code = main(["run", str(take), "--out", str(out), *_sets()])
    if code:
        raise SystemExit(code)


def operator(take: Path, out: Path, tell: "Tell", in_stretches: bool = False) -> None:
    """Driver: bpy.ops.tricap.run in a Blender without window."""
    bpy = _blender(tell)
    if in_stretches:
        short_stretches(EXTENSION)
    if bpy.ops.tricap.run(take=str(take), out=str(out)) != {"FINISHED"}:
        raise SystemExit(3)


def contours(take: Path, out: Path, tell: "Tell") -> None:
    """Driver: `tricap contour` of two views from the fitted body, where the run was done."""
    from tricap.__main__ import main

    tell(Monitor)
    code = main(["contour", str(take), "--out", str(out), "--view", "L", "C", "--from-body", *_sets()])
    if code:
        raise SystemExit(code)


def contour_operator(take: Path, out: Path, tell: "Tell") -> None:
    """Driver: bpy.ops.tricap.follow_contours of all views, where the run was done."""
    bpy = _blender(tell)
    scene = bpy.context.scene
    scene.tricap.take, scene.tricap.out = str(take), str(out)
    if bpy.ops.tricap.follow_contours() != {"FINISHED"}:
        raise SystemExit(3)


def _blender(tell: "Tell") -> Any:
    """bpy with the extension, and its panel's knobs set."""
    bpy, addon_utils = importlib.import_module("bpy"), importlib.import_module("addon_utils")
    addon_utils.extensions_refresh()
    assert addon_utils.enable(EXTENSION, default_set=True) is not None
    tell(importlib.import_module(f"{EXTENSION}.core.foundation.progress").Monitor)
    for group, table in SETTINGS.items():
        for name, value in table.items():
            setattr(getattr(bpy.context.scene.tricap, group), name, value)
    return bpy


def _sets() -> list[str]:
    return [f"--set={group}.{name}={value}" for group, table in SETTINGS.items() for name, value in table.items()]


def short_stretches(package: str) -> None:
    """The fit is done in stretches of two frames, as that of a long clip is in longer ones."""
    sequence, long_sequence = (importlib.import_module(f"{package}.core.fitting.stages.{name}") for name in ("sequence", "long_sequence"))
    vars(sequence)["AT_ONCE"] = vars(long_sequence)["AT_ONCE"] = 3
    vars(long_sequence)["MARGIN"] = 2


Tell = Callable[[type], None]  # makes a Monitor class tell its stages to the parent
Driver = Callable[[Path, Path, Tell], None]
DRIVERS: dict[str, Driver] = {
    "tricap run": command,
    "operator": operator,
    "tricap run, in stretches": partial(command, in_stretches=True),
    "operator, in stretches": partial(operator, in_stretches=True),
    "tricap contour": contours,
    "contour operator": contour_operator,
}
BEFORE: dict[str, Driver] = {"tricap contour": command, "contour operator": operator}  # what is done, and not killed, first


def start(driver: Driver, take: Path, out: Path, moment: Moment | None = None) -> Ended:
    """Run in a child process, killed at `moment` if it gets that far."""
    heard, say = os.pipe()
    log = out.with_name(out.name + ".log")
    child = os.fork()
    if child == 0:
        os.close(heard)
        _be_the_child(driver, take, out, moment, say, log)
    os.close(say)
    try:
        return _watch(child, heard, moment, log)
    finally:
        os.close(heard)


def _watch(child: int, heard: int, moment: Moment | None, log: Path) -> Ended:
    stage, text, began, first = "start", b"", {"start": 0.0}, time.monotonic()
    kill_at = first + moment.after_s if moment and moment.stage == "start" else first + LIMIT_S
    hung, operations = True, 0
    while True:
        if not select.select([heard], [], [], max(0.0, kill_at - time.monotonic()))[0]:
            os.kill(child, signal.SIGKILL)
            hung = time.monotonic() - first > LIMIT_S
            break
        more = os.read(heard, 4096)
        if not more:
            hung = False
            break
        *lines, text = (text + more).split(b"\n")
        for line in lines:
            if line.startswith(b"#"):
                operations = int(line[1:])
                continue
            stage = line.decode()
            if stage not in began:
                began[stage] = time.monotonic() - first
                if moment and moment.stage == stage:
                    kill_at = time.monotonic() + moment.after_s
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    assert not hung, f"a child hangs in “{stage}”"
    return Ended(code, stage, began, time.monotonic() - first, operations, log.read_text(errors="replace") if log.exists() else "")


def _be_the_child(driver: Driver, take: Path, out: Path, moment: Moment | None, say: int, log: Path) -> None:
    code = 1
    try:
        to = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(to, 1)
        os.dup2(to, 2)
        _count_operations(say, moment)
        driver(take, out, lambda monitor: _tell_stages(say, monitor))
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _tell_stages(say: int, monitor: Any) -> None:
    step, last = monitor.step, [""]

    def telling(self: Any, stage: str, done: float, total: float) -> None:
        if type(self) is monitor and stage != last[0]:
            last[0] = stage
            os.write(say, stage.encode() + b"\n")
        step(self, stage, done, total)

    monitor.step = telling


def _count_operations(say: int, moment: Moment | None) -> None:
    count = [0]

    def counted(name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def operation(*args: Any, **more: Any) -> Any:
            due = moment is not None and count[0] == moment.operation
            count[0] += 1
            os.write(say, b"#%d\n" % count[0])
            if due and moment and moment.how == "half" and name == "fsync":
                os.ftruncate(args[0], os.fstat(args[0]).st_size // 2)
            if due and moment and moment.how != "after":
                os.kill(os.getpid(), signal.SIGKILL)
            done = real(*args, **more)
            if due:
                os.kill(os.getpid(), signal.SIGKILL)
            return done

        return operation

    for name in FILE_OPERATIONS:
        setattr(os, name, counted(name))


def contents(out: Path) -> dict[str, bytes]:
    """Every file of OUT by name, without what tells the time: seconds in run.json and the page, and so the page's bytes; of a .blend only
    that it is there."""
    found = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        name, data = path.relative_to(out).as_posix(), path.read_bytes()
        if name == "run.json":
            run = json.loads(data)
            for stage in run["stages"].values():
                stage.pop("seconds")
            run.get("files", {}).pop("report", None)
            run.pop("blend", None)
            data = json.dumps(run).encode()
        elif name.startswith("report/") and path.suffix in (".html", ".json"):
            data = re.sub(rb'("?seconds"?: *)[0-9.e+-]+', rb"\1", data)
        elif path.suffix == ".blend":
            data = b"there"
        found[name] = data
    return found


def differences(a: dict[str, bytes], b: dict[str, bytes]) -> list[str]:
    """Names that only one has, or that differ."""
    return sorted({n for n in a.keys() | b.keys() if a.get(n) != b.get(n)})


def moments(whole: Ended, seed: int) -> Iterator[Moment]:
    """Moments without end: every stage in turn, and as many file operations."""
    chance = random.Random(seed)
    ends = [*list(whole.began.values())[1:], whole.ended]
    lasted = {stage: end - begin for (stage, begin), end in zip(whole.began.items(), ends)}
    while True:
        for stage, seconds in lasted.items():
            yield Moment(stage=stage, after_s=chance.random() * seconds)
            yield Moment(operation=chance.randrange(whole.operations), how=chance.choice(("before", "after", "half")))


def _begun(folder: Path, name: str) -> Path:
    """A folder for results, with those of what is done first if there are any."""
    if (folder / "before").exists():
        shutil.copytree(folder / "before", folder / name)
    return folder / name


def kill_runs(driver_name: str, take: Path, folder: Path, count: int, seed: int = 0) -> Tally:
    """Kill runs at `count` moments; what did not end as a run without a kill stands in `faults`."""
    driver, tally = DRIVERS[driver_name], Tally()
    if driver_name in BEFORE:
        before = start(BEFORE[driver_name], take, folder / "before")
        assert before.code == 0, f"ended with {before.code}: {before.said}"
    whole = start(driver, take, _begun(folder, "whole"))
    assert whole.code == 0, f"ended with {whole.code}: {whole.said}"
    expected = contents(folder / "whole")
    chosen, number = moments(whole, seed), 0
    while sum(tally.moments.values()) < count:
        out, number, history = _begun(folder, f"out{number}"), number + 1, []
        tally.runs += 1
        for _ in range(KILLS):
            moment = next(chosen)
            ended = start(driver, take, out, moment)
            if ended.code != -signal.SIGKILL:
                if ended.code:
                    tally.faults.append(f"after {history} a run ended with {ended.code}: {ended.said[-500:]}")
                break
            history.append((ended.stage, moment))
            tally.moments[f"{ended.stage}{' (file operation)' if moment.how else ''}"] += 1
            if sum(tally.moments.values()) >= count:
                break
        last = start(driver, take, out)
        wrong = [f"it ended with {last.code}: {last.said[-500:]}"] if last.code else differences(expected, contents(out))
        if wrong:
            tally.faults.append(f"after {history}: {wrong}")
    return tally
