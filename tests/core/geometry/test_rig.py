"""rig.toml: the same cameras to the last bits, the layout of Anipose and of others, and every fault with its sentence."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.geometry.rotation import rotation_from_vector

ENTRY = dict(
    name='"L"', size="[768, 576]", matrix="[[1500.0, 0.0, 380.0], [0.0, 1500.0, 290.0], [0.0, 0.0, 1.0]]",
    distortions="[-0.1, 0.0, 0.0, 0.0, 0.0]", rotation="[0.1, 0.2, 0.3]", translation="[1.0, 2.0, 3.0]",
)  # fmt: skip


def text(*changes: dict, metadata: str = "") -> str:
    """A rig.toml with one camera per table of changes; None leaves a line out."""
    said = ""
    for i, change in enumerate(changes):
        lines = {k: v for k, v in (ENTRY | change).items() if v is not None}
        said += f"[cam_{i}]\n" + "".join(f"{k} = {v}\n" for k, v in lines.items())
    return said + metadata


def read(folder: Path, content: str) -> Rig:
    (folder / "rig.toml").write_text(content, encoding="utf-8")
    return read_rig(folder / "rig.toml")


def some_rig() -> Rig:
    random = np.random.default_rng(5)
    cameras = []
    for name in ("L", "centre é", 'a "quoted" \\ name é 😀'):
        f, cx, cy, skew = 1500 + random.uniform(), 380 + random.uniform(), 290 + random.uniform(), random.uniform()
        cameras.append(
            Camera(name=name, size_px=(768, 576), matrix=np.array([[f, skew, cx], [0, f + 1, cy], [0, 0, 1]]),
                   distortions=random.normal(0, 0.1, 5), affinity=random.normal(0, 1e-3, 2) * (name != "L"),
                   R_cam_world=rotation_from_vector(random.uniform(-2, 2, 3)), t_cam_world_m=random.normal(0, 2, 3))
        )  # fmt: skip
    metadata = dict(source="bundle “1”\nsecond line", sigma0=np.float64(0.1234567890123456789), count=12, bar_length_m=0.6, floor=True)
    return Rig(cameras=tuple(cameras), metadata=metadata | {"a key": 1.5, "unit": "mm"})


def test_round_trip(tmp_path: Path) -> None:
    path, rig = tmp_path / "Ordner é" / "rig.toml", some_rig()
    write_rig(path, rig)
    again = read_rig(path)
    for a, b in zip(rig.cameras, again.cameras):
        assert (a.name, a.size_px) == (b.name, b.size_px)
        for name in ("matrix", "distortions", "affinity", "t_cam_world_m"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
        assert np.abs(a.R_cam_world - b.R_cam_world).max() < 1e-15
    assert dict(again.metadata) == dict(rig.metadata) | {"unit": "m"}
    write_rig(path, again)
    third = read_rig(path)
    assert max(np.abs(a.R_cam_world - b.R_cam_world).max() for a, b in zip(again.cameras, third.cameras)) < 1e-15


def test_units_and_what_may_be_missing(tmp_path: Path) -> None:
    metre = read(tmp_path, text({})).cameras[0]
    for unit, factor in (("mm", 1000.0), ("cm", 100.0), ("m", 1.0)):
        rig = read(tmp_path, text({"translation": str([factor * v for v in (1.0, 2.0, 3.0)])}, metadata=f'[metadata]\nunit = "{unit}"'))
        assert np.allclose(rig.cameras[0].t_cam_world_m, metre.t_cam_world_m, rtol=1e-15)
    bare = read(tmp_path, text({"name": None, "distortions": "[-0.2]"})).cameras[0]
    assert bare.name == "cam_0" and bare.distortions.tolist() == [-0.2, 0, 0, 0, 0]
    assert read(tmp_path, text({"distortions": None})).cameras[0].distortions.tolist() == [0] * 5
    assert read(tmp_path, text({"affinity": "[1e-4, 2e-4]"})).cameras[0].affinity.tolist() == [1e-4, 2e-4]


def test_views_are_found_by_name(tmp_path: Path) -> None:
    rig = read(tmp_path, text({"name": '"R"'}, {"name": '"L"', "size": "[640, 480]"}))
    assert rig["L"].size_px == (640, 480)
    with pytest.raises(InputError, match="no camera “l”. Did you mean “L”"):
        rig["l"]


FAULTS = {
    "not TOML": ("[cam_0\n", "is not a TOML file"),
    "no cameras": ("[metadata]\nunit = 'm'\n", "has no cameras"),
    "unknown unit": (text({}, metadata='[metadata]\nunit = "inch"'), 'unknown unit "inch"'),
    "unit is a list": (text({}, metadata="[metadata]\nunit = [1]"), "unknown unit"),
    "metadata is a number": ("metadata = 3\n" + text({}), "unknown unit"),
    "camera is a number": ("cam_0 = 3\n", "is not a table"),
    "two alike": (text({}, {}), "has two cameras of the name “L”"),
    "a name of two lines": (text({"name": '"L\\nR"'}), 'a camera of the name "L\\\\nR"; give it a name in one line'),
    "no name": (text({"name": '" "'}), 'a camera of the name " "'),
    "very many": (text(*({"name": f'"{n}"'} for n in range(201))), "has 201 cameras; a rig has at most 200"),
    "lacks size": (text({"size": None}), "Camera “L” of the rig .*lacks “size”"),
    "lacks matrix": (text({"matrix": None}), "lacks “matrix”"),
    "lacks rotation": (text({"rotation": None}), "lacks “rotation”"),
    "lacks translation": (text({"translation": None}), "lacks “translation”"),
    "NaN": (text({"translation": "[1.0, nan, 3.0]"}), "“translation” of camera “L” .* must be 3 finite numbers"),
    "infinite": (text({"rotation": "[1.0, inf, 3.0]"}), "“rotation” of .* must be 3 finite numbers"),
    "an overflow": (text({"matrix": "[[1e308, 0, 9.0], [0, 1500.0, 9.0], [0, 0, 1.0]]"}), "must be 3x3 finite numbers, none beyond"),
    "distortions": (text({"distortions": "[-1e300, 0, 0, 0]"}), "must be n finite numbers, none beyond"),
    "words": (text({"matrix": '[["a"]]'}), "must be 3x3 finite numbers"),
    "ragged": (text({"matrix": "[[1.0], [1.0, 2.0]]"}), "must be 3x3 finite numbers"),
    "matrix too small": (text({"matrix": "[[1500.0, 0.0], [0.0, 1500.0]]"}), "must be 3x3 finite numbers"),
    "rotation as a matrix": (text({"rotation": "[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]"}), "must be 3 finite numbers"),
    "negative focal length": (text({"matrix": "[[-1500.0, 0, 380.0], [0, 1500.0, 290.0], [0, 0, 1.0]]"}), "impossible matrix"),
    "transposed matrix": (text({"matrix": "[[1500.0, 0, 0], [0, 1500.0, 0], [380.0, 290.0, 1.0]]"}), "impossible matrix"),
    "a large skew": (text({"matrix": "[[1500.0, 200.0, 380.0], [0, 1500.0, 290.0], [0, 0, 1.0]]"}), "impossible matrix"),
    "tiny size": (text({"size": "[4, 576]"}), "impossible matrix or size"),
    "too many distortions": (text({"distortions": "[0, 0, 0, 0, 0, 0, 0, 0]"}), "has 8 distortions"),
    "fisheye": (text({"fisheye": '"yes"'}), "must be true or false"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(tmp_path: Path, fault: str) -> None:
    content, said = FAULTS[fault]
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path, content)
    assert "rig.toml" in str(error.value) and "\n" not in str(error.value)


def test_files_that_are_no_rig(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot read the rig .*missing.toml.*Calibrate first"):
        read_rig(tmp_path / "missing.toml")
    with pytest.raises(InputError, match="Cannot read the rig"):
        read_rig(tmp_path)
    (tmp_path / "rig.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not a TOML file"):
        read_rig(tmp_path / "rig.toml")


def test_sigmas_are_kept_and_checked(tmp_path: Path) -> None:
    rig = some_rig()
    sigmas = {"L": {"f": 0.125, "turn x": 1e-5}, rig.cameras[2].name: {"k1": 2e-4}}
    write_rig(tmp_path / "rig.toml", Rig(cameras=rig.cameras, sigmas=sigmas))
    assert read_rig(tmp_path / "rig.toml").sigmas == sigmas
    for wrong in ("3", "{ f = nan }", "{ f = -1.0 }", '{ f = "1" }'):
        with pytest.raises(InputError, match="“sigma” of camera “L”"):
            read(tmp_path, text({"sigma": wrong}))


def test_a_fisheye_camera_is_written_as_anipose_writes_it(tmp_path: Path) -> None:
    given = text({"distortions": "[0.08, -0.03, 0.01, -0.002]"}).replace("size =", "fisheye = true\nsize =", 1)
    camera = read(tmp_path, given).cameras[0]
    assert camera.fisheye and camera.distortions.tolist() == [0.08, -0.03, 0.01, -0.002, 0.0]
    write_rig(tmp_path / "b.toml", Rig(cameras=(camera,)))
    again = read_rig(tmp_path / "b.toml").cameras[0]
    assert again.fisheye and again.distortions.tolist() == camera.distortions.tolist()
    with pytest.raises(InputError, match="a fisheye lens has k1, k2, k3, k4"):
        read(tmp_path, given.replace("-0.002]", "-0.002, 0.1]"))
