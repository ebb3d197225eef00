"""OpenSim's model and coordinates, and the segments of C3D: read back by readers that follow the formats, not our code."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rotation import about, angle_of, transposed
from tricap.core.motion.formats.c3d import Segments, read_c3d, read_segments, write_c3d
from tricap.core.motion.formats.markers import AXES, Markers
from tricap.core.motion.formats.opensim import component_names, write_opensim
from tricap.core.motion.retarget.mapping import RigMap, find_map
from tricap.core.motion.retarget.rig import Motion
from tricap.core.motion.retarget.root_motion import heading, root_of, with_root

from .persons import flail, person, squat

ANGLE_DEG, PLACE_M = 0.1, 1e-4  # promised


def played_by_opensim(model: Path, storage: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Forward kinematics of a model with its coordinates: the bodies' names, rotations (T, B, 3, 3) and origins (T, B, 3) in the ground."""
    lines = storage.read_text().splitlines()
    begin = lines.index("endheader") + 1
    assert "inDegrees=yes" in lines[:begin] and f"nRows={len(lines) - begin - 1}" in lines[:begin]
    table = np.loadtxt(lines[begin + 1 :], ndmin=2)
    column = dict(zip(lines[begin].split("\t"), table.T))
    R, origin = {"/ground": np.broadcast_to(np.eye(3), (len(table), 3, 3))}, {"/ground": np.zeros((len(table), 3))}
    for joint in ElementTree.parse(model).iter("CustomJoint"):
        frame = joint.find("frames/PhysicalOffsetFrame")
        parent = frame.findtext("socket_parent")
        child = joint.findtext("socket_child_frame")
        turn, move = np.broadcast_to(np.eye(3), (len(table), 3, 3)), np.array([[float(x) for x in frame.findtext("translation").split()]])
        for axis in joint.iter("TransformAxis"):
            along = np.array([float(x) for x in axis.findtext("axis").split()])
            value = column[axis.findtext("coordinates")] if axis.findtext("coordinates") else np.zeros(len(table))
            if axis.get("name").startswith("rotation"):
                turn = turn @ about(along, np.radians(value))
            else:
                move = move + value[:, None] * along
        R[child] = R[parent] @ turn
        origin[child] = origin[parent] + np.einsum("tij,tj->ti", R[parent], np.broadcast_to(move, (len(table), 3)))
    names = [body.get("name") for body in ElementTree.parse(model).iter("Body")]
    return names, *(np.stack([found[f"/bodyset/{name}"] for name in names], axis=1) for found in (R, origin))


@pytest.mark.parametrize("loose", [False, True], ids=["rigid", "loose"])
def test_opensim_plays_the_motion(tmp_path: Path, loose: bool) -> None:
    motion = flail(person(arms_down_deg=40.0, roll_seed=2))
    if loose:  # a hand that leaves its forearm
        head = motion.head_m.copy()
        head[:, motion.rig.index["hand.L"]] += np.linspace(0, 0.05, len(head))[:, None]
        motion = replace(motion, head_m=head)
    write_opensim(tmp_path / "kick.mot", motion)
    names, R, origin = played_by_opensim(tmp_path / "kick.osim", tmp_path / "kick.mot")
    assert names == [name.replace(".", "_") for name in motion.rig.names]
    A = AXES["OpenSim"]
    wanted = A @ (motion.R @ transposed(motion.rig.R_rest)) @ A.T
    assert np.degrees(angle_of(transposed(R) @ wanted)).max() < ANGLE_DEG
    assert np.abs(origin - motion.head_m @ A.T).max() < PLACE_M


def test_a_model_of_somebody_else_is_not_replaced(tmp_path: Path) -> None:
    motion, model = flail(person()), tmp_path / "kick.osim"
    model.write_text("<OpenSimDocument/>")
    with pytest.raises(InputError, match="not of an earlier export"):
        write_opensim(tmp_path / "kick.mot", motion)
    assert model.read_text() == "<OpenSimDocument/>" and not (tmp_path / "kick.mot").exists()
    model.unlink()
    for _ in range(2):  # its own model is replaced
        write_opensim(tmp_path / "kick.mot", motion)
    model.write_text(model.read_text(encoding="utf-8").replace("<mass>1</mass>", "<mass>4.2</mass>"), encoding="utf-8")
    with pytest.raises(InputError, match="not of an earlier export, or was edited"):
        write_opensim(tmp_path / "kick.mot", motion)
    assert "4.2" in model.read_text(encoding="utf-8")


def test_names_of_components_are_plain_and_different() -> None:
    assert component_names(["hand.L", "hand_L", "Main gauche é", "", "ground"]) == [
        "hand_L",
        "hand_L_2",
        "Main_gauche__",
        "bone",
        "ground_2",
    ]


def test_the_root_bone_carries_path_and_heading() -> None:
    motion = squat(person(arms_down_deg=40.0))
    rig_map = find_map(motion.rig)
    turned = about(np.array([0.0, 0.0, 1.0]), np.linspace(0, 4 * np.pi, len(motion.frames)))
    path_m = np.stack([np.linspace(0, 3, len(motion.frames))] * 2 + [np.zeros(len(motion.frames))], axis=1)
    walking = replace(motion, R=turned[:, None] @ motion.R, head_m=np.einsum("tij,tbj->tbi", turned, motion.head_m) + path_m[:, None])
    rooted = with_root(walking, rig_map, "root")
    assert rooted.rig.names == ("root", *motion.rig.names) and root_of(rooted.rig, rig_map) == "root" and not root_of(motion.rig, rig_map)
    np.testing.assert_array_equal(rooted.R[:, 1:], walking.R)
    np.testing.assert_array_equal(rooted.head_m[:, 1:], walking.head_m)
    hips = rooted.rig.index["hips"]
    np.testing.assert_allclose(rooted.head_m[:, 0, :2], rooted.head_m[:, hips, :2])
    assert np.ptp(rooted.head_m[:, 0, 2]) == 0 and abs(rooted.head_m[0, 0, 2] - 0.02) < 0.05, "on the ground"
    in_root = transposed(rooted.R[:, :1]) @ rooted.R
    plain = with_root(motion, rig_map, "root")
    assert np.degrees(angle_of(transposed(in_root) @ transposed(plain.R[:, :1]) @ plain.R)).max() < 1e-3, (
        "relative to it the body turns as before"
    )
    assert with_root(rooted, rig_map, "root") is rooted and with_root(motion, RigMap(bones={"hips": ("hips",)}), "root") is motion


def test_a_root_of_the_rigs_own_gets_what_it_lacks() -> None:
    """The root of our own body travels, and gets the heading; one that stays where it is gets both; one that is animated is not touched."""
    motion = squat(person(arms_down_deg=40.0))
    count, rig_map = len(motion.frames), find_map(motion.rig)
    turned = about(np.array([0.0, 0.0, 1.0]), np.linspace(0, 4 * np.pi, count))
    path_m = np.linspace(0, 3, count)[:, None] * (1.0, -1.0, 0.0)
    walking = replace(motion, R=turned[:, None] @ motion.R, head_m=np.einsum("tij,tbj->tbi", turned, motion.head_m) + path_m[:, None])
    full = with_root(walking, rig_map, "root")
    level, still = full.R.copy(), full.head_m.copy()
    level[:, 0], still[:, 0] = full.rig.R_rest[0], full.rig.head_m[0]
    for given in (replace(full, R=level), replace(full, R=level, head_m=still)):
        found = with_root(given, rig_map, "root")
        assert found.rig.names == full.rig.names
        assert np.degrees(angle_of(transposed(found.R) @ full.R)).max() < 1e-5
        np.testing.assert_allclose(found.head_m[..., :2], full.head_m[..., :2], atol=1e-9)
        np.testing.assert_array_equal(found.head_m[:, 1:], full.head_m[:, 1:])
        np.testing.assert_array_equal(found.R[:, 1:], full.R[:, 1:])


def test_the_heading_has_no_jumps_upside_down() -> None:
    """A somersault, and a handstand in which the hips' twist about the vertical is noise."""
    motion = flail(person())
    count, h, x = 90, motion.rig.index["hips"], np.array([1.0, 0.0, 0.0])
    tilt = np.interp(np.arange(count), [10, 40, 50, 80], [0, np.pi, np.pi, 2 * np.pi])
    noise = np.radians(2.0) * np.random.default_rng(3).normal(size=count)
    turned = about(np.array([0.0, 0.0, 1.0]), 0.5) @ about(x, tilt) @ about(np.array([0.0, 1.0, 0.0]), noise)
    R = np.repeat(motion.R[:1], count, axis=0)
    R[:, h] = turned @ motion.rig.R_rest[h]
    found = heading(
        replace(motion, frames=np.arange(count), R=R, head_m=np.repeat(motion.head_m[:1], count, axis=0), residual=None), "hips"
    )
    steps = np.degrees(np.abs(np.diff(found)))
    assert steps.max() < 25.0 and np.degrees(np.abs(found - 0.5)).max() < 45.0
    assert found[0] == pytest.approx(0.5, abs=0.01) and found[-1] == pytest.approx(0.5, abs=0.01)


def points_and_segments() -> tuple[Markers, Segments, Motion]:
    motion = flail(person(roll_seed=5))
    sigma = np.full(motion.head_m.shape[:2], 0.002)
    points = Markers(names=motion.rig.names, fps=motion.fps, frames=motion.frames, xyz_m=motion.head_m, sigma_m=sigma)
    some = slice(3, None)  # the first frames have no pose
    segments = Segments(names=motion.rig.names, frames=motion.frames[some], R=motion.R[some], origin_m=motion.head_m[some])
    return points, segments, motion


@pytest.mark.parametrize("axes", ["Z up", "Y up"])
def test_segments_of_c3d_come_back(tmp_path: Path, axes: str) -> None:
    points, segments, _ = points_and_segments()
    write_c3d(tmp_path / "a.c3d", points, axes=axes, segments=segments)
    found, again = read_segments(tmp_path / "a.c3d", axes=axes), read_c3d(tmp_path / "a.c3d", axes=axes)
    assert found is not None and found.names == segments.names
    np.testing.assert_array_equal(found.frames, points.frames)
    assert np.isnan(found.R[:3]).all() and np.isnan(found.origin_m[:3]).all()
    np.testing.assert_allclose(found.R[3:], segments.R, atol=1e-6)
    np.testing.assert_allclose(found.origin_m[3:], segments.origin_m, atol=1e-6)
    np.testing.assert_allclose(again.xyz_m, points.xyz_m, atol=2e-6)
    write_c3d(tmp_path / "b.c3d", points, axes=axes)
    assert read_segments(tmp_path / "b.c3d") is None


def test_a_file_without_its_poses_is_refused(tmp_path: Path) -> None:
    points, segments, _ = points_and_segments()
    write_c3d(tmp_path / "a.c3d", points, segments=segments)
    (tmp_path / "a.c3d").write_bytes((tmp_path / "a.c3d").read_bytes()[:-512])
    with pytest.raises(InputError, match="segments but is too short"):
        read_segments(tmp_path / "a.c3d")


def test_ezc3d_reads_the_same_poses(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    points, segments, _ = points_and_segments()
    write_c3d(tmp_path / "a.c3d", points, segments=segments)
    found = ezc3d.c3d(str(tmp_path / "a.c3d"))
    pose = np.moveaxis(found["data"]["rotations"], [2, 3], [1, 0])
    np.testing.assert_allclose(pose[3:, :, :3, :3], segments.R, atol=1e-6)
    np.testing.assert_allclose(pose[3:, :, :3, 3] * 1e-3, segments.origin_m, atol=1e-6)
    assert found["parameters"]["ROTATION"]["LABELS"]["value"] == list(segments.names)
