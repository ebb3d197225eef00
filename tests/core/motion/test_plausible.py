"""Files whose frames, times, rates or places contradict themselves are refused by every reader, without a warning of numpy."""

import warnings
from pathlib import Path

import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.motion.plausible import MOST_FRAMES, MOST_POSES, check_span
from tricap.core.motion.sources import read_motion_source

TIMES = {"falling": (0.08, 0.04, 0.0), "equal": (0.0, 0.0, 0.0), "none": ("", "", ""), "a second last": (0.0, 0.04, 0.04)}
FRAMES = {"falling": (2, 1, 0), "equal": (0, 0, 0), "no number": (0, "", 2), "huge": (0, 1e20, 2e20)}


def wide(frames: tuple[object, ...] = (0, 1, 2), times: tuple[object, ...] = (0.0, 0.04, 0.08), x: float = 0.1) -> str:
    rows = "".join(f"{f},{t},{x},0,1,0,0,1.3,0.1,0,1.6\n" for f, t in zip(frames, times))
    return f"frame,time_s,{','.join(f'{joint} {axis}' for joint in ('shoulder.R', 'elbow.R', 'wrist.R') for axis in 'xyz')}\n{rows}"


def long(times: tuple[object, ...] = (0.0, 0.04, 0.08), again: bool = False) -> str:
    rows = [f"{f},{t},{joint},{z},0,{z},0.001" for f, t in enumerate(times) for z, joint in enumerate(("shoulder.R", "elbow.R", "wrist.R"))]
    return "frame,time_s,joint,x,y,z,sigma\n" + "".join(f"{row}\n" for row in [*rows, *(rows[:1] if again else [])])


def trc(frames: tuple[object, ...] = (0, 1, 2), rate: str = "25", x: float = 0.1) -> str:
    heads = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    names = "Frame#\tTime\tshoulder.R\t\t\telbow.R\t\t\twrist.R\t\t"
    rows = "".join(f"{f}\t0\t{x}\t0\t1\t0\t0\t1.3\t0.1\t0\t1.6\n" for f in frames)
    return f"PathFileType\t4\t(X/Y/Z)\ta.trc\n{heads}\n{rate}\t{rate}\t3\t3\tm\t{rate}\t0\t3\n{names}\n\tX1\n\n{rows}"


def bvh(offset: str = "0 0.3 0", time: str = "0.04", turn: str = "10") -> str:
    joint = f"ROOT a\n{{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\nJOINT b\n{{\nOFFSET {offset}\nEnd Site\n{{\nOFFSET 0 0.3 0\n}}\n}}\n}}\n"
    return f"HIERARCHY\n{joint}MOTION\nFrames: 2\nFrame Time: {time}\n0\n{turn}\n"


FAULTS = {
    **{f"times {name}.csv": (wide(times=times), "times must increase") for name, times in TIMES.items()},
    **{f"times {name} long.csv": (long(times), "times must increase") for name, times in TIMES.items() if name != "none"},
    **{f"frames {name}.csv": (wide(frames), "frame number") for name, frames in FRAMES.items()},
    **{f"frames {name}.trc": (trc(frames), "frame number") for name, frames in FRAMES.items()},
    "twice.csv": (long(again=True), "is the second for “shoulder.R” in frame 0"),
    "slow.csv": (wide(times=(0, 1e300, 2e300)), "1e-300 frames per second"),
    "slow.trc": (trc(rate="1e-300"), "1e-300 frames per second"),
    "fast.trc": (trc(rate="inf"), "inf frames per second"),
    "slow.bvh": (bvh(time="1e300"), "1e-300 frames per second"),
    "sparse.csv": (wide((0, 10**6, 10**6 + 1), (0, 10**6, 10**6 + 1)), "from frame 0 to 1e\\+06, with values for 3 alone"),
    "far.csv": (wide(x=1e308), "positions beyond"),
    "far.trc": (trc(x=1e308), "positions beyond"),
    "far.bvh": (bvh(offset="0 1e308 0"), "positions beyond"),
    "turned.bvh": (bvh(turn="1e308"), "positions beyond"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_contradicts_itself_is_refused(tmp_path: Path, name: str) -> None:
    text, said = FAULTS[name]
    (tmp_path / name).write_text(text)
    with warnings.catch_warnings(), pytest.raises(InputError, match=said):
        warnings.simplefilter("error")
        read_motion_source(tmp_path / name)


@pytest.mark.parametrize(("name", "text"), {"a.csv": wide(), "long.csv": long(), "a.trc": trc(), "a.bvh": bvh()}.items())
def test_what_does_not_is_read_and_exported(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert read_motion_source(tmp_path / name).fps == pytest.approx(25.0)


def test_few_keys_of_many_bones_reach_less_far() -> None:
    check_span(0, MOST_FRAMES, 2, "It reaches", bones=MOST_POSES // MOST_FRAMES)
    check_span(0, MOST_FRAMES, MOST_FRAMES // 100, "It reaches", bones=1000)
    check_span(0, 10**9, 10**9, "It reaches", bones=1000)
    for last, bones in ((MOST_FRAMES + 1, 1), (MOST_FRAMES, 150), (MOST_POSES // 150 + 1, 150)):
        with pytest.raises(InputError, match="It reaches from frame 0 to [0-9]*, with values for 2 alone"):
            check_span(0, last, 2, "It reaches", bones=bones)
