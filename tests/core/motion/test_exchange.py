"""BVH, TRC, C3D and CSV: round trips, readers that are not ours, and damaged files."""

import re
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rotation import angle_of, transposed
from tricap.core.motion.formats.bvh import read_bvh, write_bvh
from tricap.core.motion.formats.c3d import BLOCK, _Number, _read_parameters, read_c3d, write_c3d
from tricap.core.motion.formats.markers import Markers, read_points_csv, write_points_csv
from tricap.core.motion.formats.trc import read_trc, write_trc
from tricap.core.motion.retarget.mapping import find_map
from tricap.core.motion.retarget.points import joint_of, joint_of_bone, motion_from_points
from tricap.core.motion.retarget.retarget import lying_note, retarget
from tricap.core.motion.retarget.transfer import directions
from tricap.core.motion.sources import read_motion_source

from .persons import flail, mapped, mapped_rig, person, squat

PLACE_M = 2e-6  # text has 1e-6 of the unit, C3D float32 of millimetres
MOCAP = Path(__file__).resolve().parents[4] / "shared" / "mocap"


def cloud(sigma: bool = True) -> Markers:
    random = np.random.default_rng(0)
    xyz = random.uniform(-2, 2, (40, 3, 3))
    xyz[5:9, 1] = np.nan
    sigma_m = np.where(np.isnan(xyz[..., 0]), np.nan, 1e-4 * random.integers(1, 200, (40, 3))) if sigma else np.full((40, 3), np.nan)
    return Markers(names=("shoulder.R", "elbow.R", "wrist, right"), fps=59.94, frames=np.arange(40) + 12, xyz_m=xyz, sigma_m=sigma_m)


@pytest.mark.parametrize("scale", [np.inf, -np.inf, np.nan, 0.0, 1e30])
def test_a_c3d_file_with_a_scale_that_is_none_is_refused(tmp_path: Path, scale: float) -> None:
    file = tmp_path / "a.c3d"
    write_c3d(file, Markers(names=("a",), fps=50.0, frames=[1], xyz_m=np.ones((1, 1, 3)), sigma_m=np.full((1, 1), 1e-3)))
    data = bytearray(file.read_bytes())
    data[12:16] = np.float32(scale).tobytes()
    file.write_bytes(data)
    with pytest.raises(InputError, match="in which no point can be stored; export it again"):
        read_c3d(file)


@pytest.mark.parametrize("kind", ["trc", "c3d", "csv"])
@pytest.mark.parametrize("axes", ["Z up", "Y up", "OpenSim"])
def test_points_come_back(tmp_path: Path, kind: str, axes: str) -> None:
    points, file = cloud(), tmp_path / f"points.{kind}"
    if kind == "csv":
        write_points_csv(file, points)
        found = read_points_csv(file)
    elif kind == "trc":
        write_trc(file, points, axes=axes, unit="mm")
        found = read_trc(file, axes=axes)
    else:
        write_c3d(file, points, axes=axes)
        found = read_c3d(file, axes=axes)
    assert found.names == points.names and abs(found.fps - points.fps) < 0.01
    np.testing.assert_array_equal(found.frames, points.frames)
    np.testing.assert_allclose(found.xyz_m, points.xyz_m, atol=PLACE_M)
    if kind != "trc":
        np.testing.assert_allclose(found.sigma_m, points.sigma_m, atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "written"),
    [
        (range(40), range(1, 41)),
        (range(7, 47), range(7, 47)),
        (range(-3, 2), range(1, 6)),
        (range(70000, 70005), range(1, 6)),
        ((0, 1, 2, 10, 11), range(1, 13)),
        ((5, 9), range(5, 10)),
        ((0,), (1,)),
    ],
    ids=str,
)
def test_c3d_counts_from_one_and_the_take_keeps_its_numbers(tmp_path: Path, frames: range, written: range) -> None:
    points = cloud()
    numbers, some = np.array(frames), np.arange(len(frames))
    few = Markers(names=points.names, fps=50.0, frames=numbers, xyz_m=points.xyz_m[some], sigma_m=points.sigma_m[some])
    write_c3d(tmp_path / "a.c3d", few)
    data = (tmp_path / "a.c3d").read_bytes()
    assert struct.unpack_from("<HH", data, 6) == (written[0], written[-1])
    table = _read_parameters(data, BLOCK, _Number(order="<", dec=False), tmp_path)
    assert table["POINT", "FRAMES"] == len(written)
    assert [int(table["TRIAL", f"ACTUAL_{end}_FIELD"] @ [1, 65536]) for end in ("START", "END")] == [written[0], written[-1]]
    found = read_c3d(tmp_path / "a.c3d")
    there = np.isin(found.frames, numbers)
    np.testing.assert_array_equal(found.frames, np.arange(numbers[0], numbers[-1] + 1))
    np.testing.assert_allclose(found.xyz_m[there], few.xyz_m, atol=PLACE_M)
    assert np.isnan(found.xyz_m[~there]).all() and np.isnan(found.sigma_m[~there]).all()


def test_a_sigma_in_c3d_is_known_or_not(tmp_path: Path) -> None:
    """One that is unknown does not come back as 0, and one below the steps does not come back as unknown."""
    sigma = np.array([[np.nan, 1e-6, 2e-3]])
    write_c3d(tmp_path / "a.c3d", Markers(names=("a", "b", "c"), fps=50.0, frames=[1], xyz_m=np.ones((1, 3, 3)), sigma_m=sigma))
    np.testing.assert_allclose(read_c3d(tmp_path / "a.c3d").sigma_m, [[np.nan, 1e-4, 2e-3]], rtol=1e-6)


@pytest.mark.parametrize("frames", [(3, 2), (0, 1 << 40)], ids=str)
def test_frames_that_c3d_cannot_number_are_said(tmp_path: Path, frames: tuple[int, int]) -> None:
    xyz = np.zeros((2, 1, 3))
    with pytest.raises(InputError, match="frame numbers"):
        write_c3d(tmp_path / "a.c3d", Markers(names=("a",), fps=50.0, frames=frames, xyz_m=xyz, sigma_m=xyz[..., 0]))


def test_wide_tables_are_read(tmp_path: Path) -> None:
    (tmp_path / "wide.csv").write_text("frame,time_s,elbow.R x,elbow.R y,elbow.R z\n3,0.1,1,2,3\n4,0.2,,,\n5,0.3,4,5,6\n")
    found = read_points_csv(tmp_path / "wide.csv")
    (tmp_path / "long.csv").write_text("frame,time_s,joint,x,y,z\n3,0.1,elbow.R,1,2,3\n5,0.3,elbow.R,4,5,6\n")  # without a sigma
    assert np.isnan(read_points_csv(tmp_path / "long.csv").sigma_m).all()
    assert found.names == ("elbow.R",) and abs(found.fps - 10.0) < 1e-9 and np.isnan(found.xyz_m[1]).all()


def test_times_that_do_not_go_with_the_frame_numbers_are_said(tmp_path: Path) -> None:
    """A gap of ten seconds between frames 1 and 2 became 0.04 s."""

    def read(times: list[float], frames: list[int]) -> Markers:
        rows = [f"{frame},{time},1,2,3" for frame, time in zip(frames, times)]
        (tmp_path / "a.csv").write_text("\n".join(["frame,time_s,a x,a y,a z", *rows]) + "\n")
        return read_points_csv(tmp_path / "a.csv")

    with pytest.raises(InputError, match="uneven times: frame 2 comes 9.96 s after frame 1, at 25 frames per second. Number the frames"):
        read([0.0, 0.04, 10.0, 10.04, 10.08], [0, 1, 2, 3, 4])
    assert read([0.0, 0.04, 10.0, 10.04], [0, 1, 250, 251]).fps == pytest.approx(25.0)
    jitter = 0.012 * np.random.default_rng(0).normal(size=200)
    assert read([*(np.arange(200) / 30 + jitter.clip(-0.015, 0.015))], [*range(200)]).fps == pytest.approx(30.0, rel=0.01)
    assert read([round(t / 30, 2) for t in range(3000)], [*range(3000)]).fps == pytest.approx(30.0, rel=1e-4)  # the median would say 33.3


@pytest.mark.parametrize(("kind", "axes"), [("trc", "Z up"), ("c3d", "Y up"), ("csv", "Y up")])
def test_up_and_unit_are_said(tmp_path: Path, kind: str, axes: str) -> None:
    """A file with another axis up lies down unless it is said; and one in another unit than it says is as large as it is."""
    standing = squat(person(), frames=4)
    joint = {"thigh": "hip", "shin": "knee", "foot": "ankle", "upper_arm": "shoulder"}
    names = tuple(".".join([joint.get(part, part), *side]) for part, *side in (name.split(".") for name in standing.rig.names))
    markers = Markers(
        names=names, fps=30.0, frames=standing.frames, xyz_m=standing.head_m, sigma_m=np.full(standing.head_m.shape[:2], np.nan)
    )
    file, write = tmp_path / f"a.{kind}", {"trc": write_trc, "c3d": write_c3d, "csv": write_points_csv}[kind]
    write(file, markers, axes=axes, unit="m")  # type: ignore[operator]
    flat, up = read_motion_source(file), read_motion_source(file, up=axes[0], unit="dm")
    target = person()
    maps = find_map(flat.rig), find_map(up.rig), find_map(target)
    assert "axis is up" in lying_note(mapped(flat, maps[0])) and not lying_note(mapped(up, maps[1]))
    assert abs(np.ptp(up.head_m[0, :, 2]) - 0.1 * np.ptp(standing.head_m[0, :, 2])) < 0.02
    assert any("axis is up" in note for note in retarget(mapped(flat, maps[0]), mapped_rig(target, maps[2])).notes)
    write_bvh(tmp_path / "a.bvh", standing)
    with pytest.raises(InputError, match="fathom"):
        read_motion_source(tmp_path / "a.bvh", unit="fathom")
    assert np.ptp(read_motion_source(tmp_path / "a.bvh", up="Z", unit="cm").head_m[0, :, 1]) < 0.02


def test_another_reader_of_c3d_agrees(tmp_path: Path) -> None:
    import c3d

    points = cloud()
    write_c3d(tmp_path / "points.c3d", points)
    with (tmp_path / "points.c3d").open("rb") as file:
        reader = c3d.Reader(file)
        frames = [(i, data) for i, data, _ in reader.read_frames()]
        assert [label.strip() for label in reader.point_labels] == list(points.names) and abs(reader.point_rate - 59.94) < 1e-3
    data = np.array([rows for _, rows in frames])
    known = np.isfinite(points.xyz_m[..., 0])
    np.testing.assert_allclose(data[known][:, :3] / 1000.0, points.xyz_m[known], atol=PLACE_M)
    np.testing.assert_allclose(data[known][:, 3] / 1000.0, points.sigma_m[known], atol=1e-6)
    write_c3d(tmp_path / "gaps.c3d", replace(points, frames=[*range(20), *range(25, 45)]))
    with (tmp_path / "gaps.c3d").open("rb") as file:
        reader = c3d.Reader(file)
        found = {i: rows for i, rows, _ in reader.read_frames()}
    assert (reader.first_frame, reader.last_frame) == (1, 45) and list(found) == list(range(1, 46))
    assert (np.array([found[i][:, 3] for i in range(21, 26)]) < 0).all() and (np.array([found[i][0, 3] for i in range(26, 46)]) >= 0).all()
    assert (data[~known][:, 3] < 0).all() and [i for i, _ in frames] == points.frames.tolist()


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YZX"])
@pytest.mark.parametrize("unit_m", [1.0, 0.01])
def test_a_motion_comes_back_from_bvh(tmp_path: Path, order: str, unit_m: float) -> None:
    motion = flail(person(roll_seed=3))
    write_bvh(tmp_path / "a.bvh", motion, order=order, unit_m=unit_m)
    found = read_bvh(tmp_path / "a.bvh")
    index = [found.rig.index[name] for name in motion.rig.names]
    np.testing.assert_allclose(found.head_m[:, index], motion.head_m, atol=1e-5)  # 1e-6 per joint of a chain
    np.testing.assert_allclose(found.rig.head_m[index], motion.rig.head_m, atol=1e-5)
    since = [m.R[:, i] @ transposed(m.rig.R_rest[i]) for m, i in ((found, index), (motion, slice(None)))]
    assert np.degrees(angle_of(transposed(since[0]) @ since[1])).max() < 1e-4
    assert abs(found.fps - motion.fps) < 1e-6


def test_points_make_a_motion_whose_limbs_point_alike() -> None:
    source = flail(person(), reach=0.4)
    joints = {"hip": "thigh", "knee": "shin", "ankle": "foot", "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "toe": "toe"}
    places = {f"{side}{joint}": source.head_m[:, source.rig.index[f"{part}.{side}"]] for side in "LR" for joint, part in joints.items()}
    points = Markers(
        names=tuple(places),
        fps=30.0,
        frames=source.frames,
        xyz_m=np.stack(list(places.values()), axis=1),
        sigma_m=np.full((len(source.frames), len(places)), np.nan),
    )
    motion = motion_from_points(points)
    ours, theirs = directions(motion, find_map(motion.rig)), directions(source, find_map(source.rig))
    assert len(ours) == 8
    for role, along in ours.items():
        np.testing.assert_allclose(along, theirs[role], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("RKnee", "shin.R"),
        ("elbow.L", "forearm.L"),
        ("left_ankle", "foot.L"),
        ("MidHip", "hips"),
        ("LBigToe", "toe.L"),
        ("C7", ""),
        ("lfemur", "thigh.L"),
        ("mixamorig:RightForeArm", "forearm.R"),
    ],
)
def test_joints_by_name(name: str, joint: str) -> None:
    assert (joint_of(name) or joint_of_bone(name)) == joint


BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT Chest
 {
  OFFSET 0 10 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  End Site
  {
   OFFSET 0 5 0
  }
 }
}
MOTION
Frames: 2
Frame Time: 0.04
0 0 0 0 0 0 0 0 0
0 1 0 0 0 0 90 0 0
"""


def test_names_in_a_bvh_are_words(tmp_path: Path) -> None:
    """Braces and line breaks in a name were structure of the file, escape sequences those of the terminal."""
    motion = flail(person(), 3)
    names = dict(zip(motion.rig.names, ("mixamorig:Hüfte 1", "a\n{\n}", "b\x1b[31m\u2028")))
    write_bvh(tmp_path / "a.bvh", motion, names=names)
    found = read_bvh(tmp_path / "a.bvh").rig.names
    assert found[:3] == ("mixamorig:Hüfte_1", "a____", "b_[31m_") and len(found) == len(motion.rig.names)


@pytest.mark.parametrize("frames", [np.arange(0, 50, 5), [0, 1, 2, 3, 20, 21, 22, 23], [4, 6, 12], [0, 0.5, 1, 1.5], [7]])
def test_a_bvh_keeps_the_time_of_a_motion_without_all_its_frames(tmp_path: Path, frames: list[float]) -> None:
    whole = flail(person(), 50)
    t = np.asarray(frames, float)
    rows = np.linspace(0, 49, len(t)).astype(int)
    motion = replace(whole, frames=t, R=whole.R[rows], head_m=whole.head_m[rows], residual=None)
    write_bvh(tmp_path / "a.bvh", motion)
    found = read_bvh(tmp_path / "a.bvh")
    seconds = (t - t[0]) / motion.fps
    at = np.rint(seconds * found.fps).astype(int)
    assert np.allclose(at / found.fps, seconds, atol=1e-6) and at[-1] == len(found.frames) - 1
    head_m = found.head_m[:, [found.rig.names.index(name) for name in motion.rig.names]]
    assert np.abs(head_m[at] - motion.head_m).max() < 1e-4
    root_m = [np.interp(np.arange(at[-1] + 1), at, motion.head_m[:, 0, i]) for i in range(3)]
    assert np.allclose(head_m[:, 0].T, root_m, atol=1e-4), "missing frames lie in between"


def test_gaps_that_would_make_a_file_many_times_longer_are_refused(tmp_path: Path) -> None:
    """1.3 kB of text became 480 MB."""
    points = Markers(names=("a",), fps=25.0, frames=[0, 1, 2, 1_000_000], xyz_m=np.ones((4, 1, 3)), sigma_m=np.ones((4, 1)))
    with pytest.raises(InputError, match="a.c3d cannot be written: there are points from frame 0 to 1e[+]06, with values for 4 alone"):
        write_c3d(tmp_path / "a.c3d", points)
    motion = flail(person(), 2001)
    with pytest.raises(InputError, match="BVH has a row for every frame; there is a motion from frame 0 to"):
        write_bvh(tmp_path / "a.bvh", replace(motion, frames=np.append(np.arange(2000), 150_000), residual=None))
    write_trc(tmp_path / "a.trc", points)
    assert [path.name for path in tmp_path.iterdir()] == ["a.trc"] and (tmp_path / "a.trc").stat().st_size < 1000


def test_frames_that_blender_does_not_have_are_refused() -> None:
    """A motion from frame 2,000,000 on was written, and played in no frame."""
    points = dict(names=("a",), fps=25.0, xyz_m=np.ones((2, 1, 3)), sigma_m=np.ones((2, 1)))
    Markers(frames=[-1_048_574, 1_048_574], **points)
    for frames in ([0, 1_048_575], [-2_000_000, -1_999_999]):
        with pytest.raises(InputError, match="beyond 1048574, Blender's last"):
            Markers(frames=frames, **points)


def test_a_small_bvh(tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(BVH)
    motion = read_bvh(tmp_path / "a.bvh", unit_m=0.1)
    assert motion.rig.names == ("Hips", "Chest") and motion.fps == 25.0
    np.testing.assert_allclose(motion.head_m[1], [[0, 0, 0.1], [0, 0, 1.1]], atol=1e-12)
    np.testing.assert_allclose(motion.R[1, 1, :, 1], [-1, 0, 0], atol=1e-12)
    assert read_motion_source(tmp_path / "a.bvh").frames.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("HIERARCHY", "SOMETHING", "not a BVH"),
        ("Frames: 2", "Frames: 3000000000", "promises"),
        ("Frames: 2", "Frames: 0", "motion needs"),
        ("Frames: 2", "Frames: 1", "has values of 2 frames, and “Frames: 1”; correct that number"),
        ("Frames: 2", "Frames: many", "number is needed"),
        ("Xposition", "Sideways", "channels"),
        ("CHANNELS 3", "CHANNELS 300", "channels"),
        ("OFFSET 0 10 0", "OFFSET 0 ten 0", "number is needed"),
        ("OFFSET 0 10 0", "OFFSET 0 nan 0", "finite"),
        ("0 1 0 0 0 0 90 0 0", "0 1 0 0", "promises"),
        ("0 1 0 0 0 0 90 0 0", "0 1 0 0 0 inf 90 0 0", "good values"),
        ("}\nMOTION", "MOTION", "ends within"),
        ("Frame Time: 0.04", "Frame Time: 0", "motion needs"),
        ("JOINT Chest\n {", "JOINT Chest\n", "Hips|no sense|damaged|number"),
    ],
)
def test_damaged_bvh_is_said(tmp_path: Path, old: str, new: str, word: str) -> None:
    assert old in BVH
    (tmp_path / "a.bvh").write_text(BVH.replace(old, new))
    with pytest.raises(InputError, match=word):
        read_bvh(tmp_path / "a.bvh")


@pytest.mark.parametrize(("channels", "still", "frames"), [("0", 0, 2_000_000_000), ("1 Zrotation", 400, 2_000)])
def test_a_bvh_whose_joints_have_no_channels_asks_for_no_memory(tmp_path: Path, channels: str, still: int, frames: int) -> None:
    """A small file cannot promise billions of frames of no values, or many joints that never move."""
    joints = "JOINT a { OFFSET 0 0 1 }\n" * still
    head = f"HIERARCHY\nROOT r {{\nOFFSET 0 1 0\nCHANNELS {channels}\n{joints}}}\nMOTION\nFrames: {frames}\nFrame Time: 0.04\n"
    (tmp_path / "a.bvh").write_text(head + "0\n" * (frames if still else 0))
    with pytest.raises(InputError, match="only .* values for .* joints" if still else "has no CHANNELS, and so no motion"):
        read_bvh(tmp_path / "a.bvh")


def test_damaged_points_are_said(tmp_path: Path) -> None:
    write_c3d(tmp_path / "a.c3d", cloud())
    data = (tmp_path / "a.c3d").read_bytes()
    write_trc(tmp_path / "a.trc", cloud())
    text = (tmp_path / "a.trc").read_text()
    cases = [
        ("b.c3d", data[:900], "not a C3D"),
        ("b.c3d", data[:1600], "too short|damaged"),
        ("b.c3d", b"P" * 4000, "not a C3D|damaged"),
        ("b.c3d", data[:2] + struct.pack("<H", 65000) + data[4:], "too short|cannot hold"),
        ("b.c3d", data[:16] + b"\xff\xff" + data[18:], "too short"),
        ("b.trc", text.replace("PathFileType", "Path").encode(), "not a TRC"),
        ("b.trc", text.replace("\t40\t3\tm", "\t3000000000\t3\tm").encode(), "promises"),
        ("b.trc", text.replace("\t3\tm", "\t3\tfathom").encode(), "fathom"),
        ("b.trc", text[:-600].encode(), "promises"),
        ("b.trc", (text + text.splitlines()[-1] + "\n").encode(), "promises 40 frames and holds 41"),
        ("b.trc", text.rstrip("\n").rpartition("\t")[0].encode(), "ends within its last row"),
        ("b.trc", text.replace(text.splitlines()[2].split("\t")[0], "100", 1).encode(), "100 frames per second in its header"),
        ("b.csv", b"", "no columns"),
        ("b.csv", b"a,b\n1,2\n", "no columns"),
        ("b.csv", b"frame,\x83", "it is not text in UTF-8"),
        (
            "b.csv",
            b"frame,joint,x,y,z\n0,a,1,2,3\n",
            "no column “time_s”; write frame, time_s, joint, x, y, z, and sigma where",
        ),
        ("b.csv", b"frame,p x,p y,p z\n1,2\n", "rows"),
        ("b.xyz", b"", "not a motion that can be read"),
    ]
    for name, content, word in cases:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=word):
            read_motion_source(tmp_path / name)
    with pytest.raises(InputError, match="no file or folder"):
        read_motion_source(tmp_path / "nothing.bvh")


@pytest.mark.slow
def test_whatever_is_changed_in_a_c3d_file_it_is_read_or_said(tmp_path: Path) -> None:
    write_c3d(tmp_path / "a.c3d", cloud())
    data, random = bytearray((tmp_path / "a.c3d").read_bytes()), np.random.default_rng(1)
    for _ in range(400):
        changed = bytearray(data)
        for at in random.integers(0, 1400, 3):
            changed[at] = random.integers(0, 256)
        (tmp_path / "b.c3d").write_bytes(changed)
        try:
            read_c3d(tmp_path / "b.c3d")
        except InputError:
            continue


def test_all_motions_at_hand_are_read_and_mapped(tmp_path: Path) -> None:
    if not MOCAP.is_dir() or sys.platform == "win32":
        pytest.skip("the motions are not on this machine (no folder shared/mocap beside the repository)")
    for path in sorted(MOCAP.glob("*/*.bvh")):
        skeleton, _, motion = path.read_text(errors="replace").partition("Frame Time:")
        some = re.sub(r"Frames:\s*\d+", "Frames: 5", skeleton) + "Frame Time:" + "\n".join(motion.splitlines()[:6]) + "\n"
        (tmp_path / path.name).write_text(some)
        assert not find_map(read_bvh(tmp_path / path.name).rig).missing, path


def test_a_take_is_no_motion(tmp_path: Path) -> None:
    (tmp_path / "take.toml").write_text("")
    with pytest.raises(InputError, match="is a take; give the folder with its results instead"):
        read_motion_source(tmp_path)
