"""A project from a stranger, opened in Blender: none of its code runs, nothing outside of it is read or written, no file of it takes the
memory, and each fault is one sentence."""

import json
import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tricap.__main__ import main
from tricap.addon.retarget.build import build_armature
from tricap.addon.retarget.files import open_rig
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.store import write_bytes
from tricap.core.motion.formats.bvh import write_bvh
from tricap.core.report.pictures import png

from ..core.motion.persons import person, squat
from .conftest import SmallRun
from .test_wrong_moves import refused


class Runs:
    """Unpickled, it writes a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return os.mkdir, (str(self._path),)


@pytest.fixture
def ran(tmp_path: Path) -> Path:
    """What code of the stranger's would make."""
    return tmp_path / "ran"


def with_code(folder: Path, ran: Path) -> None:
    """Modules that somebody may import by their names, and a start-up file."""
    for name in ("click.py", "numpy.py", "sitecustomize.py", "startup.py", "__init__.py", "L.py"):
        (folder / name).write_text(f"import os; os.mkdir({str(ran)!r})\n")


def pickled(path: Path, ran: Path) -> None:
    """An .npz whose array is code."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, xyz_m=np.array([Runs(ran)], dtype=object), header_json=np.array([Runs(ran)], dtype=object))


def test_the_harm_is_real(ran: Path) -> None:
    pickle.loads(pickle.dumps(Runs(ran)))
    assert ran.is_dir()


def test_no_code_of_a_project_runs(blender: ModuleType, small_run: SmallRun, ran: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    for folder in (small_run.take, small_run.out):
        with_code(folder, ran)
    for name in ("surface/0003", "tracks/0003", "fit/pose_tracking"):
        pickled(small_run.out / "cache" / f"{name}.npz", ran)
    monkeypatch.chdir(small_run.take)
    scene = blender.context.scene
    scene.tricap.take = str(small_run.take)
    assert blender.ops.tricap.open_take() == {"FINISHED"}
    scene.tricap.out = str(small_run.out)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    pickled(small_run.out / "trajectories.npz", ran)
    refused(lambda: blender.ops.tricap.build_scene(out=str(small_run.out)), "trajectories.npz")
    pickled(small_run.out / "trajectories.npz", ran)
    refused(lambda: blender.ops.tricap.run(take=str(small_run.take), out=str(small_run.out)))
    assert not ran.exists()


@pytest.mark.parametrize(
    "line",
    [
        'rig = "../secret/rig.toml"',
        'rig = "/etc/hostname"',
        'model = "../secret/m.toml"',
        'images = "../secret/*.png"',
        'images = "/etc/*"',
    ],
)
def test_a_take_reads_nothing_outside_its_folder(blender: ModuleType, small_run: SmallRun, tmp_path: Path, line: str) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    (tmp_path / "secret").mkdir()
    for name in ("rig.toml", "m.toml"):
        (tmp_path / "secret" / name).write_text("my secret")
    path, key = small_run.take / "take.toml", line.split(" ")[0]
    text = re.sub(rf'\b{key} = "[^"]*"', line, path.read_text(), count=1)
    path.write_text(text if line in text else text.replace("version = 1", f"version = 1\n{line}"))
    blender.context.scene.tricap.take = str(small_run.take)
    with pytest.raises(RuntimeError) as caught:
        blender.ops.tricap.open_take()
    assert re.search("must be a file inside the take's folder|lies outside the take", str(caught.value))
    assert "my secret" not in str(caught.value)
    assert not blender.context.scene.tricap.views


def test_results_that_would_fill_the_memory(blender: ModuleType, small_run: SmallRun) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\n" + "".join(f"property float {a}\n" for a in "xyz")
    (small_run.out / "clouds" / "0003.ply").write_bytes(head.encode() + b"end_header\n" + b"\0" * 120)
    refused(lambda: blender.ops.tricap.build_scene(out=str(small_run.out)), "0003.ply")


def test_scripts_in_the_file_of_a_rig_do_not_run(blender: ModuleType, empty: ModuleType, ran: Path, tmp_path: Path) -> None:
    build_armature(squat(person(), frames=2), "Hero")
    text = empty.data.texts.new("register.py")
    text.from_string(f"import os\nos.makedirs({str(ran)!r}, exist_ok=True)\n")
    text.use_module = True
    empty.ops.wm.save_as_mainfile(filepath=str(tmp_path / "hero.blend"))
    write_bvh(tmp_path / "move.bvh", squat(person(), frames=3))
    argv = ["retarget", str(tmp_path / "move.bvh"), "--rig", str(tmp_path / "hero.blend"), "--out", str(tmp_path / "out.blend"), "--quiet"]
    assert main(argv) == 0 and not ran.exists()
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "hero.blend"), load_ui=False, use_scripts=True)
    assert ran.exists(), "they would run where they are let"


def with_a_rig(bpy: ModuleType, folder: Path) -> Path:
    """A .blend with a moving person, and a cube."""
    build_armature(squat(person()), "Rig")
    mesh = bpy.data.meshes.new("cube")
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    mesh.from_pydata(corners, [], [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("cube", mesh))
    return folder / "rig.blend"


def test_simulations_in_the_file_of_a_rig_write_nothing(empty: ModuleType, tmp_path: Path) -> None:
    path, outside = with_a_rig(empty, tmp_path), tmp_path / "outside"
    cube = empty.data.objects["cube"]
    cloth = cube.modifiers.new("cloth", "CLOTH")
    cloth.point_cache.use_disk_cache = True
    fluid = cube.modifiers.new("fluid", "FLUID")
    fluid.show_viewport = False  # in this process Blender would write, too
    fluid.fluid_type = "DOMAIN"
    fluid.domain_settings.cache_directory = str(outside)
    empty.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    open_rig(path)
    opened = empty.data.objects["cube"].modifiers
    assert not opened["cloth"].point_cache.use_disk_cache and not opened["fluid"].show_render
    for frame in (1, 2, 3):
        empty.context.scene.frame_set(frame)
    assert not outside.exists() and not (tmp_path / "blendcache_rig").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_a_folder_is_no_rig(empty: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder; choose a file"):
        open_rig(tmp_path)


def test_a_rig_that_names_a_pipe_is_refused(empty: ModuleType, tmp_path: Path) -> None:
    path, picture = with_a_rig(empty, tmp_path), tmp_path / "skin.png"
    write_bytes(picture, png(np.zeros((4, 4), dtype=np.uint8)))
    empty.data.images.load(str(picture)).use_fake_user = True
    empty.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    open_rig(path)
    picture.unlink()
    os.mkfifo(picture)
    with pytest.raises(InputError, match="skin.png, which is a device, a pipe or a socket"):
        open_rig(path)
    assert not empty.data.objects


def test_two_keys_in_a_million_frames_are_refused(empty: ModuleType) -> None:
    """Each frame would be posed: a glTF file of 2 kB took hours."""
    from tricap.addon.retarget.read import action_frames
    from tricap.core.foundation.errors import InputError

    moving = build_armature(squat(person(), frames=2), "Hero")
    assert len(action_frames(moving)) == 2
    curve = moving.animation_data.action.layers[0].strips[0].channelbags[0].fcurves[0]
    curve.keyframe_points[-1].co[0] = 1e6
    with pytest.raises(InputError, match="reaches from frame .* to 1e\\+06, with values for"):
        action_frames(moving)
    moving.animation_data.nla_tracks.new().strips.new("Strip", 0, moving.animation_data.action)
    moving.animation_data.action, empty.context.scene.frame_end = None, 1_000_000
    with pytest.raises(InputError, match="reaches from frame 0 to 1e\\+06"):
        action_frames(moving)


def test_two_keys_of_many_curves_are_two_keys(empty: ModuleType) -> None:
    """A glTF file of 20 kB with two keys of 150 bones took minutes and gigabytes."""
    from tricap.addon.retarget.playing import exported_frames
    from tricap.addon.retarget.read import action_frames
    from tricap.core.foundation.errors import InputError

    moving = build_armature(squat(person(), frames=3), "Hero")
    curves = moving.animation_data.action.layers[0].strips[0].channelbags[0].fcurves
    for curve in curves:
        curve.keyframe_points[-1].co[0] = 20_100
    assert sum(len(curve.keyframe_points) for curve in curves) > 210
    with pytest.raises(InputError, match="reaches from frame .* to 20100, with values for 3 alone"):
        action_frames(moving)
    empty.context.scene.frame_start, empty.context.scene.frame_end = 0, 20_100
    with pytest.raises(InputError, match="The scene plays from frame 0 to 20100, with values for 3 alone"):
        exported_frames(empty.context.scene)


def test_a_map_of_a_stranger_is_data_alone(small_run: SmallRun, tmp_path: Path, ran: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "map.json").write_text(json.dumps({"name": f"__import__('os').mkdir({str(ran)!r})", "bones": {"hips": "__class__"}}))
    write_bvh(tmp_path / "rig.bvh", squat(person(), frames=2))
    argv = ["retarget", str(small_run.out), "--rig", str(tmp_path / "rig.bvh"), "--out", str(tmp_path / "o.blend"), "--quiet"]
    assert main([*argv, "--map", str(tmp_path / "map.json")]) == 2
    assert "Traceback" not in capfd.readouterr().err and not ran.exists() and not (tmp_path / "o.blend").exists()
