"""PLY round trips, files of others, and damaged files, each of which must be refused with a sentence."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.motion.formats.ply import read_ply, write_cloud, write_mesh


def cloud(n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    return dict(
        xyz_m=rng.normal(size=(n, 3)), sigma_m=rng.uniform(size=n), normals=rng.normal(size=(n, 3)), intensity=rng.uniform(0, 255, n)
    )


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_cloud_round_trip(tmp_path: Path, n: int) -> None:
    given = cloud(n)
    write_cloud(tmp_path / "a" / "0000.ply", **given)
    back = read_ply(tmp_path / "a" / "0000.ply")
    assert list(back.vertex) == ["x", "y", "z", "sigma", "nx", "ny", "nz", "intensity"]
    assert np.array_equal(back.xyz_m, given["xyz_m"].astype(np.float32))
    assert np.array_equal(back.vertex["sigma"], given["sigma_m"].astype(np.float32)) and back.vertex["ny"].dtype == np.float32
    assert back.faces.shape == (0, 3) and list((tmp_path / "a").iterdir()) == [tmp_path / "a" / "0000.ply"]


def test_more_of_a_cloud_follows_what_every_cloud_has(tmp_path: Path) -> None:
    write_cloud(tmp_path / "0000.ply", **cloud(3), rays=np.array([3, 2, 3]), extended=np.array([False, True, False]))
    back = read_ply(tmp_path / "0000.ply").vertex
    assert list(back) == ["x", "y", "z", "sigma", "nx", "ny", "nz", "intensity", "rays", "extended"]
    assert back["rays"].tolist() == [3, 2, 3] and back["extended"].tolist() == [0, 1, 0]


@pytest.mark.parametrize("place", [np.nan, np.inf])
def test_vertices_without_coordinates_and_more_bytes_than_promised_are_refused(tmp_path: Path, place: float) -> None:
    given = cloud(4)
    given["xyz_m"][2, 1] = place
    write_cloud(tmp_path / "0000.ply", **given)
    with pytest.raises(InputError, match="0000.ply has vertices without coordinates"):
        read_ply(tmp_path / "0000.ply")
    write_cloud(tmp_path / "0001.ply", **cloud(4))
    whole = (tmp_path / "0001.ply").read_bytes()
    (tmp_path / "0001.ply").write_bytes(whole.replace(b"element vertex 4", b"element vertex 3"))
    with pytest.raises(InputError, match="0001.ply is longer than its header says"):
        read_ply(tmp_path / "0001.ply")


@pytest.mark.parametrize("corners", [3, 4])
def test_mesh_round_trip(tmp_path: Path, corners: int) -> None:
    vertices = np.random.default_rng(1).normal(size=(50, 3))
    faces = np.random.default_rng(2).integers(0, 50, (70, corners))
    write_mesh(tmp_path / "m.ply", vertices, faces)
    back = read_ply(tmp_path / "m.ply")
    assert np.array_equal(back.xyz_m, vertices.astype(np.float32)) and np.array_equal(back.faces, faces)
    assert len(back.triangles) == 70 * (corners - 2)


def ply(header: str, body: bytes) -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{header}\nend_header\n".encode() + body


XYZ = "element vertex 3\nproperty double x\nproperty double y\nproperty double z"
THREE = np.arange(9.0).astype("<f8").tobytes()


def test_files_of_others(tmp_path: Path) -> None:
    faces = bytes([3]) + np.array([0, 1, 2], "<u4").tobytes() + bytes([4]) + np.array([2, 1, 0, 1], "<u4").tobytes()
    header = f"comment made elsewhere\nobj_info x\n{XYZ}\nproperty uchar red\nelement face 2\nproperty list uchar uint vertex_index"
    rows = b"".join(THREE[24 * i : 24 * i + 24] + bytes([9 + i]) for i in range(3))
    (tmp_path / "o.ply").write_bytes(ply(header, rows + faces))
    back = read_ply(tmp_path / "o.ply")
    assert back.vertex["x"].dtype == np.float64 and back.vertex["red"].tolist() == [9, 10, 11]
    assert back.faces.tolist() == [[0, 1, 2, -1], [2, 1, 0, 1]] and len(back.triangles) == 3


def with_face(header: str, *indices: int) -> bytes:
    return ply(f"{XYZ}\nelement face {header}", THREE + bytes([3]) + np.array(indices, "<i4").tobytes())


DAMAGED = {
    "no ply": (b"solid\n", "not a PLY"),
    "no end": (b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n", "end_header"),
    "end of file in end_header": (b"ply\nformat binary_little_endian 1.0\nend_header", "end_header"),
    "ascii": (ply(XYZ, THREE).replace(b"binary_little_endian", b"ascii"), "ascii"),
    "no format": (b"ply\nelement vertex 0\nend_header\n", "format"),
    "no vertices": (ply("element edge 1\nproperty int a", bytes(4)), "no vertices"),
    "short": (ply(XYZ, THREE[:-1]), "too early"),
    "huge count": (ply(XYZ.replace("3", "99999999999999999"), THREE), "too early"),
    "count no number": (ply(XYZ.replace("3", "-3"), THREE), "no sense"),
    "unknown type": (ply(XYZ.replace("double y", "float128 y"), THREE), "unknown type"),
    "twice the same": (ply(XYZ + "\nproperty double z", THREE), "no sense"),
    "property of nothing": (ply("property float x", b""), "no sense"),
    "list in vertices": (ply(XYZ + "\nproperty list uchar int a", THREE), "not supported"),
    "float indices": (with_face("1\nproperty list uchar float i", 0, 1, 2), "not supported"),
    "face beyond": (with_face("1\nproperty list uchar int i", 0, 1, 3), "beyond"),
    "face below": (with_face("1\nproperty list uchar int i", 0, 1, -1), "negative"),
    "faces missing": (ply(XYZ + "\nelement face 4000000000\nproperty list uchar int i", THREE), "too early"),
    "faces short": (with_face("2\nproperty list uchar int i", 0, 1, 2), "too early"),
    "negative corners": (ply(XYZ + "\nelement face 1\nproperty list char int i", THREE + b"\xff" + bytes(12)), "damaged"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_files_are_refused(tmp_path: Path, case: str) -> None:
    data, word = DAMAGED[case]
    (tmp_path / "d.ply").write_bytes(data)
    with pytest.raises(InputError, match=word) as caught:
        read_ply(tmp_path / "d.ply")
    assert "\n" not in str(caught.value) and "d.ply" in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot read"):
        read_ply(tmp_path / "none.ply")
