"""Other tools' files: what is written is read again; files as those tools write them are understood; broken ones are refused."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.rig_files import FOLDERS, FORMATS, lens_note, read_any, write_as
from tricap.core.calibration.rig_files.openptv import image
from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.synthetic.bar import bar_ends, benchmark_cameras

ENDING = {"agisoft": "rig.xml", "opencv": "rig.yml"}
# Half of a shear is a turn, the other half cannot be said without b2: b2 / 2 × half the diagonal = 1e-4 × 480 px = 0.048 px at the corner
# of camera C; without k3 another 0.02 px. Agisoft's format holds everything.
TOLERANCE_PX = {"agisoft": 1e-9}
FITTED_PX = 0.08


def target(folder: Path, name: str) -> Path:
    return folder / name if name in FOLDERS else folder / ENDING.get(name, "rig.toml")


def without_shear(camera: Camera) -> Camera:
    return Camera(
        name=camera.name,
        size_px=camera.size_px,
        matrix=camera.matrix,
        distortions=camera.distortions,
        R_cam_world=camera.R_cam_world,
        t_cam_world_m=camera.t_cam_world_m,
    )


def distance(a: Rig, b: Rig) -> float:
    points = bar_ends(50, np.random.default_rng(0), 0.5).reshape(-1, 3)
    return max(float(np.nanmax(np.linalg.norm(p.project(points) - q.project(points), axis=1))) for p, q in zip(a.cameras, b.cameras))


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_what_is_written_is_read_again(name: str, tmp_path: Path) -> None:
    rig = Rig(cameras=benchmark_cameras())
    path = target(tmp_path, name)
    write_as(path, rig, name)
    again = read_any(path)
    assert [c.size_px for c in again.cameras] == [c.size_px for c in rig.cameras]
    by_name = Rig(cameras=tuple(again[c.name] for c in rig.cameras))
    assert distance(rig, by_name) < TOLERANCE_PX.get(name, FITTED_PX)


def test_our_own_file_keeps_its_sigmas_and_what_it_says_of_itself(tmp_path: Path) -> None:
    rig = Rig(cameras=benchmark_cameras(), metadata={"unit": "m", "bar_length_m": 0.5}, sigmas={"C": {"f": 0.12}})
    write_rig(tmp_path / "rig.toml", rig)
    again = read_any(tmp_path / "rig.toml")
    assert again.sigmas == rig.sigmas and again.metadata == rig.metadata and distance(rig, again) < 1e-9


@pytest.mark.parametrize("name", ["anipose", "caliscope", "opencv", "easymocap", "colmap", "agisoft"])
def test_cameras_without_shear_are_exact(name: str, tmp_path: Path) -> None:
    rig = Rig(cameras=tuple(without_shear(c) for c in benchmark_cameras()))
    path = target(tmp_path, name)
    write_as(path, rig, name)
    again = read_any(path)
    assert distance(rig, Rig(cameras=tuple(again[c.name] for c in rig.cameras))) < 1e-6


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_lens_that_a_format_cannot_hold_is_told(name: str, tmp_path: Path) -> None:
    """Exported lenses were silently wrong by up to 5.6 px."""
    strong = tuple(replace(without_shear(c), distortions=np.array([-0.3, 0.3, 0.002, 0.001, -0.4])) for c in benchmark_cameras())
    for rig, without in ((Rig(cameras=strong), ("openptv", "pose2sim")), (sheared(strong), {*FORMATS} - {"agisoft"})):
        write_as(target(tmp_path, name), rig, name)
        note = lens_note(target(tmp_path, name), rig, name)
        assert (f"{name} lacks terms of its lens" in note) == (name in without) and (name in without or not note)


def sheared(cameras: tuple[Camera, ...]) -> Rig:
    return Rig(cameras=tuple(replace(camera, affinity=np.array([0.0, 0.02])) for camera in cameras))


def test_opencv_xml(tmp_path: Path) -> None:
    rig = Rig(cameras=tuple(without_shear(c) for c in benchmark_cameras()))
    write_as(tmp_path / "rig.xml", rig, "opencv")
    assert distance(rig, read_any(tmp_path / "rig.xml")) < 1e-6


def test_our_rig_is_read_by_the_anipose_reader(tmp_path: Path) -> None:
    rig = Rig(cameras=tuple(without_shear(c) for c in benchmark_cameras()))
    write_as(tmp_path / "rig.toml", rig, "anipose")
    assert distance(rig, read_rig(tmp_path / "rig.toml")) < 1e-6


ANIPOSE = """[cam_0]
name = "A"
size = [ 1280, 720,]
matrix = [ [ 900.5, 0.0, 639.5,], [ 0.0, 900.5, 359.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.12, 0.03, 0.001, -0.002, 0.004,]
rotation = [ 0.1, -0.2, 0.3,]
translation = [ 100.0, -200.0, 1500.0,]

[cam_1]
name = "B"
size = [ 1280, 720,]
matrix = [ [ 910.0, 0.0, 639.5,], [ 0.0, 910.0, 359.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.0, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.0, 0.0, 0.0,]
translation = [ 0.0, 0.0, 0.0,]

[metadata]
adjusted = false
error = 0.43
"""


def test_a_matrix_may_be_rounded_but_not_skew(tmp_path: Path) -> None:
    rounded = "[ [ 900.5, 0.5, 639.5,], [ 1e-10, 900.5, 359.5,], [ -1e-17, 0.0, 1.000000000001,],]"
    path, first = tmp_path / "calibration.toml", ANIPOSE.index("matrix = ") + len("matrix = ")
    end = ANIPOSE.index("\n", first)
    path.write_text(ANIPOSE[:first] + rounded + ANIPOSE[end:])
    assert read_any(path)["A"].matrix.tolist() == [[900.5, 0.5, 639.5], [0, 900.5, 359.5], [0, 0, 1]]
    for wrong in (rounded.replace("0.5, 639", "100.0, 639"), rounded.replace("1.000000000001", "2.0")):
        path.write_text(ANIPOSE[:first] + wrong + ANIPOSE[end:])
        with pytest.raises(InputError, match="Camera “A” has an impossible matrix or size: .* the skew at most 0.05 of the focal length"):
            read_any(path)


def test_anipose_file(tmp_path: Path) -> None:
    """As aniposelib's CameraGroup.dump writes it: a table of Camera.get_dict() per camera, [metadata] (aniposelib/cameras.py)."""
    path = tmp_path / "calibration.toml"
    path.write_text(ANIPOSE + 'unit = "mm"\n')
    rig = read_any(path)
    assert [c.name for c in rig.cameras] == ["A", "B"] and rig["A"].size_px == (1280, 720)
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 1.0], (50, 3))
    K = np.array([[900.5, 0, 639.5], [0, 900.5, 359.5], [0, 0, 1]])
    D = np.array([-0.12, 0.03, 0.001, -0.002, 0.004])
    expected, _ = cv2.projectPoints(points * 1000, np.array([0.1, -0.2, 0.3]), np.array([100.0, -200.0, 1500.0]), K, D)
    assert np.abs(rig["A"].project(points) - expected[:, 0]).max() < 1e-6
    five = ANIPOSE.replace("[cam_1]", "fisheye = true\n\n[cam_1]")
    path.write_text(five)
    with pytest.raises(InputError, match="more than k1, k2, k3, k4"):
        read_any(path)
    path.write_text(five.replace(" 0.004,]", "]", 1))
    curved = read_any(path)
    assert curved["A"].fisheye and curved["A"].distortions.tolist() == [-0.12, 0.03, 0.001, -0.002, 0.0]
    with pytest.raises(InputError, match="opencv has no fisheye lens, as camera A has; choose one of anipose"):
        write_as(tmp_path / "a.yml", curved, "opencv")
    for kind in ("anipose", "caliscope"):
        write_as(tmp_path / "again.toml", curved, kind)
        again = read_any(tmp_path / "again.toml").cameras[0]
        assert again.fisheye and again.distortions.tolist() == curved["A"].distortions.tolist()


def test_pose2sim_file(tmp_path: Path) -> None:
    """Pose2Sim's documented layout: a table per camera, sizes as floats, four distortions, [metadata]."""
    text = """
[cam_01]
name = "cam_01"
size = [ 1088.0, 1920.0]
matrix = [ [ 1681.24, 0.0, 532.04], [ 0.0, 1681.07, 948.93], [ 0.0, 0.0, 1.0]]
distortions = [ -0.0474, 0.0464, -0.0001, 0.0]
rotation = [ 1.1, -1.3, 1.2]
translation = [ 0.31, 0.80, 4.57]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""
    (tmp_path / "Calib.toml").write_text(text)
    camera = read_any(tmp_path / "Calib.toml")["cam_01"]
    assert camera.size_px == (1088, 1920) and camera.distortions.tolist() == [-0.0474, 0.0464, -0.0001, 0.0, 0.0]
    R, _ = cv2.Rodrigues(np.array([1.1, -1.3, 1.2]))
    assert np.allclose(camera.R_cam_world, R) and camera.t_cam_world_m.tolist() == [0.31, 0.80, 4.57]


def test_caliscope_file(shared_takes: Path) -> None:
    """A file that caliscope wrote, with rotations as matrices."""
    rig = read_any(shared_takes / "upperbody_4cam_charuco_caliscope" / "camera_array.toml")
    assert [c.name for c in rig.cameras] == ["cam_0", "cam_1", "cam_2", "cam_3"]
    assert rig.cameras[0].matrix[0, 0] == pytest.approx(903.5501) and rig.cameras[0].size_px == (1280, 720)


def test_opencv_stereo_sample(tmp_path: Path) -> None:
    """What OpenCV's stereo_calib sample writes: M1 D1 M2 D2 in intrinsics.yml, R T in extrinsics.yml."""

    def matrix(name: str, rows: int, cols: int, data: list[float]) -> str:
        return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {data}\n"

    K = [534.0, 0.0, 341.5, 0.0, 534.5, 234.5, 0.0, 0.0, 1.0]
    D = [-0.28, 0.07, 0.0012, -0.0001, 0.02]
    head = "%YAML:1.0\n---\n"
    (tmp_path / "intrinsics.yml").write_text(head + "".join(matrix(f"M{n}", 3, 3, K) + matrix(f"D{n}", 1, 5, D) for n in (1, 2)))
    eye = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    (tmp_path / "extrinsics.yml").write_text(head + matrix("R", 3, 3, eye) + matrix("T", 3, 1, [-3.3, 0.0, 0.1]))
    rig = read_any(tmp_path / "intrinsics.yml")
    assert rig["cam_2"].centre_m == pytest.approx([3.3, 0.0, -0.1]) and rig["cam_1"].distortions.tolist() == D


def test_easymocap_file(tmp_path: Path) -> None:
    """EasyMocap's intri.yml and extri.yml: `names`, K_, dist_, R_ as a rotation vector, Rot_, T_; no image size in older ones."""
    head = '%YAML:1.0\n---\nnames:\n  - "01"\n'
    matrix = "{}: !!opencv-matrix\n  rows: {}\n  cols: {}\n  dt: d\n  data: {}\n"
    K = matrix.format("K_01", 3, 3, "[1000.0, 0.0, 511.5, 0.0, 1001.0, 511.5, 0.0, 0.0, 1.0]")
    (tmp_path / "intri.yml").write_text(head + K + matrix.format("dist_01", 1, 5, "[-0.1, 0.02, 0.001, 0.002, 0.003]"))
    R, t = matrix.format("R_01", 3, 1, "[0.1, 0.2, 0.3]"), matrix.format("T_01", 3, 1, "[1.0, 2.0, 3.0]")
    (tmp_path / "extri.yml").write_text(head + R + t)
    camera = read_any(tmp_path)["01"]
    assert camera.size_px == (1024, 1024) and camera.distortions.tolist() == [-0.1, 0.02, 0.001, 0.002, 0.003]
    assert np.allclose(camera.R_cam_world, cv2.Rodrigues(np.array([0.1, 0.2, 0.3]))[0])


def test_colmap_file(tmp_path: Path) -> None:
    """COLMAP's documented example: https://colmap.github.io/format.html; its first pixel's middle is (0.5, 0.5)."""
    (tmp_path / "cameras.txt").write_text("# comment\n1 SIMPLE_RADIAL 3072 2304 2559.81 1536 1152 -0.0218531\n")
    pose = "0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354"
    (tmp_path / "images.txt").write_text(f"# comment\n1 {pose} 1 P1180141.JPG\n2362.39 248.498 58396 1784.7 268.254 59027\n")
    camera = read_any(tmp_path)["P1180141"]
    assert camera.matrix[0].tolist() == [2559.81, 0.0, 1535.5] and camera.distortions[0] == -0.0218531
    w, x, y, z = (float(v) for v in pose.split()[:4])
    assert camera.R_cam_world[0, 1] == pytest.approx(2 * (x * y - w * z), abs=1e-5)


@pytest.mark.parametrize(("changed", "said"), [
    (("images.txt", "1 0.851773 0.0165051 0.503764 -0.142941", "1 0 0 0 0"), "no rotation: its quaternion is 0 long, not 1"),
    (("images.txt", "L.png\n\n", "L x y.png\n"), "an image needs ten entries, and a second line, of three numbers a point or empty"),
    (("cameras.txt", "1152 -0.02", "1152 -0.02 1 2"), "Camera 1 in .* must be 6 numbers"),
    (("images.txt", "1 0.851773", "\n\n".join(["3 0.851773 0.0165051 0.503764 -0.142941 0 0 0 1 C.png"] * 200) + "\n\n1 0.851773"),
     "images.txt has 202 images; a rig has at most 200 cameras"),
    (("images.txt", "1 0.851773", "1 0.951773"), "its quaternion is 1.09 long, not 1"),
])  # fmt: skip
def test_colmap_files_that_contradict_themselves(tmp_path: Path, changed: tuple[str, str, str], said: str) -> None:
    """A zero quaternion ended in a traceback; a file without the lines of points lost every other camera."""
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 3072 2304 2559.81 1536 1152 -0.02\n")
    line = "0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1"
    (tmp_path / "images.txt").write_text(f"1 {line} L.png\n\n2 {line} R.png\n\n")
    assert [camera.name for camera in read_any(tmp_path).cameras] == ["L", "R"]
    name, old, new = changed
    text = (tmp_path / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=said):
        read_any(tmp_path)


@pytest.mark.parametrize(("name", "old", "new", "note"), [
    ("agisoft", "<transform>", "<other>", "Left out, because they are not aligned in Metashape: L."),
    ("caliscope", "rotation_count = 0", "ignore = true", "Left out, because they are marked `ignore`: L."),
    ("anipose", "size = [768, ", "size = [768.4, ", "The file has sizes that are no whole pixels, which were rounded (L)"),
    ("easymocap", "W_L:", "w_L:", "The file lacks the image size of some cameras, derived from the principal points (L 783×576);"),
])  # fmt: skip
def test_what_is_left_out_or_taken_for_granted_is_told(name: str, old: str, new: str, note: str, tmp_path: Path) -> None:
    write_as(target(tmp_path, name), Rig(cameras=tuple(without_shear(c) for c in benchmark_cameras())), name)
    path = target(tmp_path, name) / "intri.yml" if name == "easymocap" else target(tmp_path, name)
    first, found, rest = path.read_text().partition(old)
    if name == "agisoft":
        rest = rest.replace("</transform>", "</other>", 1)
    assert found and not read_any(path).remarks
    path.write_text(first + new + rest)
    (said,) = read_any(path).remarks
    assert said.startswith(note)


@pytest.mark.parametrize(("name", "inside", "old", "new", "said"), [
    ("agisoft", "", "<p1>", "<p3>0.5</p3><p1>", "uses p3"),
    ("caliscope", "", r"rotation = \[", "rotation = [90.0, 0.0, 0.0] # [", "radians, not in degrees"),
])  # fmt: skip
def test_files_that_contradict_themselves_are_refused(name: str, inside: str, old: str, new: str, said: str, tmp_path: Path) -> None:
    write_as(target(tmp_path, name), Rig(cameras=benchmark_cameras()), name)
    path = target(tmp_path, name) / inside
    text, count = re.subn(old, new, path.read_text(), count=1)
    path.write_text(text)
    assert count
    with pytest.raises(InputError, match=said):
        read_any(path)


def test_cameras_of_which_intri_knows_nothing_are_told(tmp_path: Path) -> None:
    left, *others = (without_shear(camera) for camera in benchmark_cameras())
    write_as(tmp_path / "all", Rig(cameras=(left, *others)), "easymocap")
    write_as(tmp_path / "two", Rig(cameras=tuple(others)), "easymocap")
    (tmp_path / "two" / "extri.yml").write_bytes((tmp_path / "all" / "extri.yml").read_bytes())
    assert read_any(tmp_path / "two").remarks == ("Left out, because intri.yml does not name them: L.",)


def test_a_matrix_that_openptv_does_not_read_is_not_read(tmp_path: Path) -> None:
    write_as(tmp_path, rig := Rig(cameras=tuple(without_shear(camera) for camera in benchmark_cameras())), "openptv")
    lines = (tmp_path / "L.ori").read_text().splitlines()
    (tmp_path / "L.ori").write_text("\n".join([*lines[:3], "1 0 0", "0 1 0", "0 0 1", *lines[6:]]))
    assert np.abs(read_any(tmp_path)["L"].R_cam_world - rig["L"].R_cam_world).max() < 1e-3


@pytest.mark.parametrize(("name", "file"), [("opencv", "rig"), ("agisoft", "rig.yml"), ("anipose", "rig.xml")])
def test_a_name_by_which_the_format_is_not_found_again_is_refused(
    name: str, file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=f"{file} is no name of a file of {name}; let it end in"):
        write_as(tmp_path / file, Rig(cameras=benchmark_cameras()), name)
    assert not list(tmp_path.iterdir())
    (tmp_path / "bar").mkdir()  # refused before anything is measured
    command = ["calibrate", str(tmp_path / "bar"), "--bar-length", "0.5", "--export", name, "--out", str(tmp_path / file), "--quiet"]
    assert main(command) == 2 and f"is no name of a file of {name}" in capsys.readouterr().err


ORI = """  101.6620   -54.7000   -70.0000
    -0.05 0.03 0.02

      0.0000   0.0000   0.0000
      0.0000   0.0000   0.0000
      0.0000   0.0000   0.0000

      0.0500   -0.0300
      8.5000

    0.0 0.0 1.0
"""


def test_openptv_file(tmp_path: Path) -> None:
    """OpenPTV's documented layout (.ori, .addpar, ptv.par); its own equations give the same pixels."""
    from tricap.core.geometry.rotation import axis_rotation

    R = axis_rotation("x", -0.05) @ axis_rotation("y", 0.03) @ axis_rotation("z", 0.02)
    rows = "\n".join(" ".join(f"{v:.15f}" for v in row) for row in R)
    start, end = ORI.index("      0.0000   0.0000   0.0000"), ORI.index("\n\n      0.0500")
    (tmp_path / "cam1.tif.ori").write_text(ORI[:start] + rows + ORI[end:])
    p = [-0.0012, 0.00001, 0.0, 0.0001, -0.00005, 1.0005, 0.0002]
    (tmp_path / "cam1.tif.addpar").write_text(" ".join(map(str, p)) + "\n")
    par = [1, "img/cam1.", "cal/cam1.tif", 1, 0, 1, 768, 576, 0.0083, 0.0083, 0, 1, 1, 1, 0]
    (tmp_path / "ptv.par").write_text("\n".join(map(str, par)) + "\n")
    camera = read_any(tmp_path)["cam1"]
    X = np.random.default_rng(0).uniform([-400, -300, -2500], [400, 300, -1500], (200, 3))
    d = (X - [101.662, -54.7, -70.0]) @ R * [1, -1, -1]
    expected = image(np.array([0.05, -0.03, 8.5, *p]), d, (768, 576), (0.0083, 0.0083))
    inside = camera.sees(expected)
    assert inside.sum() > 50
    assert np.linalg.norm(camera.project(X / 1000) - expected, axis=1)[inside].max() < 0.05


@pytest.mark.parametrize("name", ["{other}/L", "../L", "a/L", "..", "a\\L", "con", "L:", "c"])
def test_no_camera_leads_the_files_of_openptv_elsewhere(tmp_path: Path, name: str) -> None:
    """An absolute name, or one with “..”, wrote outside of the folder; on Windows and macOS “c” and “C” are one file."""
    other, out = tmp_path / "other", tmp_path / "new" / "out"
    other.mkdir()
    left, *more = benchmark_cameras()
    rig = Rig(cameras=(replace(left, name=name.format(other=other)), *more))
    with pytest.raises(InputError, match="is no name of a file of its own"):
        write_as(out, rig, "openptv")
    assert list(tmp_path.iterdir()) == [other] and not list(other.iterdir())


@pytest.mark.parametrize("kind", sorted(FORMATS))
@pytest.mark.parametrize("name", ["", "L\n2 1 0 0", "L\x1b[2J"])
def test_a_name_of_several_lines_is_written_nowhere(tmp_path: Path, kind: str, name: str) -> None:
    """It would be lines of its own in COLMAP's file."""
    left, *more = benchmark_cameras()
    with pytest.raises(InputError, match="give it a name in one line"):
        write_as(target(tmp_path, kind), Rig(cameras=(replace(left, name=name), *more)), kind)
    assert not list(tmp_path.iterdir())


def test_openptv_cameras_that_look_into_water_are_refused(shared_takes: Path) -> None:
    with pytest.raises(InputError, match="only air"):
        read_any(shared_takes / "calibbody_4cam_openptv_cavity")


def test_agisoft_file(tmp_path: Path) -> None:
    """Metashape's documented layout; the image's middle is (w/2, h/2), P1 and P2 are swapped against OpenCV's."""
    text = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.4.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1">
<sensor id="0" label="unknown" type="frame"><resolution width="4000" height="3000"/>
<calibration type="frame" class="adjusted"><resolution width="4000" height="3000"/><f>3000.5</f><cx>10.5</cx><cy>-4.5</cy>
<b1>1.5</b1><b2>-0.5</b2><k1>-0.05</k1><k2>0.02</k2><p1>0.001</p1><p2>-0.0005</p2></calibration></sensor></sensors>
<cameras next_id="2"><camera id="0" sensor_id="0" label="IMG_1"><transform>1 0 0 2 0 1 0 3 0 0 1 4 0 0 0 1</transform></camera>
<camera id="1" sensor_id="0" label="IMG_2"/></cameras></chunk></document>"""
    (tmp_path / "cameras.xml").write_text(text)
    rig = read_any(tmp_path / "cameras.xml")
    (camera,) = rig.cameras
    assert camera.centre_m.tolist() == [2, 3, 4] and camera.distortions[2:4].tolist() == [-0.0005, 0.001]
    a, b = 0.2, 0.1
    r2 = a * a + b * b
    L = 1 - 0.05 * r2 + 0.02 * r2**2
    x = a * L + 0.001 * (r2 + 2 * a * a) - 2 * 0.0005 * a * b
    y = b * L - 0.0005 * (r2 + 2 * b * b) + 2 * 0.001 * a * b
    expected = [2000 + 10.5 + x * 3000.5 + x * 1.5 - y * 0.5 - 0.5, 1500 - 4.5 + y * 3000.5 - 0.5]
    assert camera.project(np.array([2 + a, 3 + b, 5.0])) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rig.toml", "[cam_0]\nname = 'a'\n"),
        ("rig.toml", "[cam_0\n"),
        ("rig.yml", "nonsense"),
        ("rig.xml", "<document><chunk/></document>"),
        ("rig.xml", "<broken"),
        ("cameras.txt", "1 FISHEYE 10 10 1 2 3 4\n"),
        ("rig.ori", "1 2 3"),
        ("rig.dat", "1 2 3"),
    ],
)
def test_broken_files_are_refused_with_a_sentence(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError):
        read_any(tmp_path / name)


def test_a_name_of_a_megabyte_is_not_said_in_full(tmp_path: Path) -> None:
    (tmp_path / "rig.yml").write_text(f"%YAML:1.0\nnames: [ {'x' * 10**6} ]\n")
    with pytest.raises(InputError, match="lacks the matrix “camera_matrix_x") as refused:
        read_any(tmp_path / "rig.yml")
    assert len(str(refused.value)) < 250 + len(str(tmp_path))


def test_an_entity_bomb_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rig.xml").write_text('<!DOCTYPE a [<!ENTITY b "c">]><document>&b;</document>')
    with pytest.raises(InputError, match="entities"):
        read_any(tmp_path / "rig.xml")


def test_the_command_converts(tmp_path: Path) -> None:

    write_as(tmp_path / "cameras.xml", Rig(cameras=benchmark_cameras()), "agisoft")
    assert main(["calibrate", "--import", str(tmp_path / "cameras.xml"), "--out", str(tmp_path / "rig.toml"), "--quiet"]) == 0
    assert distance(Rig(cameras=benchmark_cameras()), read_rig(tmp_path / "rig.toml")) < 1e-9
    out = tmp_path / "colmap"
    assert main(["calibrate", "--import", str(tmp_path / "rig.toml"), "--export", "colmap", "--out", str(out), "--quiet"]) == 0
    assert (out / "images.txt").exists()
    assert main(["calibrate", "--import", str(tmp_path / "none.toml"), "--out", str(out), "--quiet"]) == 2


def test_images_of_one_name_in_several_folders_are_told_apart(tmp_path: Path) -> None:
    write_as(tmp_path, Rig(cameras=benchmark_cameras()), "colmap")
    text = (tmp_path / "images.txt").read_text()
    for name in "LCR":
        text = text.replace(f" {name}.png", f" cam{name}/0001.png").replace(f" {name}\n", f" cam{name}/0001.png\n")
    (tmp_path / "images.txt").write_text(text)
    rig = read_any(tmp_path)
    assert [c.name for c in rig.cameras] == ["camL_0001", "camC_0001", "camR_0001"] and "no unit" in rig.metadata["scale"]
    (tmp_path / "images.txt").write_text(text.replace("camL", "camC"))
    with pytest.raises(InputError, match="two cameras"):
        read_any(tmp_path)


def test_an_unknown_unit_is_refused(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", Rig(cameras=benchmark_cameras()))
    (tmp_path / "rig.toml").write_text((tmp_path / "rig.toml").read_text().replace('unit = "m"', 'unit = "inch"'))
    with pytest.raises(InputError, match="unknown unit “inch”"):
        read_any(tmp_path / "rig.toml")
