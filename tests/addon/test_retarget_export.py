"""Exports read back by readers that are not ours: Blender's importers."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from tricap.addon.command import main
from tricap.addon.retarget.export import export_file
from tricap.addon.retarget.files import open_motion
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import matrix_from_euler, shortest
from tricap.core.motion.formats.bvh import read_bvh, write_bvh
from tricap.core.motion.formats.gltf import sampled_fps
from tricap.core.motion.formats.ply import write_mesh
from tricap.core.motion.retarget.rig import Motion, Rig, posed
from tricap.core.results.folder import Results
from tricap.core.results.run_json import FORMAT, VERSION
from tricap.core.synthetic.sample import unpack

from .conftest import SmallRun

SAMPLE = Path(__file__).resolve().parents[2] / "addon" / "sample.zip"
PLACE_M = 1e-4  # promised: 0.1 mm; measured 2e-6 (bvh, usd), 5e-6 (glb), 3e-6 (fbx)
ANGLE_DEG = 0.1  # promised; measured 2e-3


def wave() -> Motion:
    """A trunk and two limbs that turn about all their axes while they travel."""
    head = np.array([[0.1, 0.0, 0.9], [0.1, 0.02, 1.1], [0.3, 0.0, 1.4], [0.6, 0.0, 1.4], [-0.1, 0.0, 0.85]])
    tail = np.array([[0.1, 0.02, 1.1], [0.1, 0.0, 1.45], [0.6, 0.0, 1.4], [0.85, -0.05, 1.4], [-0.12, 0.05, 0.4]])
    rig = Rig(
        names=("hips", "spine", "upper_arm.L", "forearm.L", "thigh.R"),
        parents=np.array([-1, 0, 1, 2, 0]),
        R_rest=shortest(np.array([0.0, 1.0, 0.0]), tail - head),
        head_m=head,
        tail_m=tail,
        connected=np.zeros(5, dtype=bool),
        inherits_rotation=np.ones(5, dtype=bool),
    )
    phase = np.linspace(0, 2 * np.pi, 30)[:, None]
    k = np.arange(5)
    angles = np.stack([np.sin(phase + k), 0.8 * np.cos(phase * 2 + k), 1.2 * np.sin(phase + 2 * k)], axis=-1)
    shift = np.stack([0.5 * phase[:, 0], 0.2 * np.sin(phase[:, 0]), 0.1 * np.cos(phase[:, 0])], axis=1)
    R, place = posed(rig, matrix_from_euler(angles, "XYZ"), {0: shift})
    return Motion(rig=rig, fps=50.0, frames=np.arange(30) + 1, R=R, head_m=place)


@pytest.fixture
def wave_file(tmp_path: Path) -> Path:
    write_bvh(tmp_path / "wave.bvh", wave())
    return tmp_path / "wave.bvh"


def read_back(bpy: ModuleType, file: Path) -> None:
    scene = bpy.context.scene
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.fps = 50
    if file.suffix == ".bvh":
        bpy.ops.import_anim.bvh(filepath=str(file))
    elif file.suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=str(file))
    elif file.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(file))
    elif file.suffix == ".abc":
        bpy.ops.wm.alembic_import(filepath=str(file), as_background_job=False)
    else:
        bpy.ops.wm.usd_import(filepath=str(file))


def heads(bpy: ModuleType, names: tuple[str, ...], frames: np.ndarray) -> np.ndarray:
    armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
    bones = {name.replace(".", "_"): name for name in armature.pose.bones.keys()}
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(int(frame))
        found.append([armature.matrix_world @ armature.pose.bones[bones[name.replace(".", "_")]].head for name in names])
    return np.array(found)


@pytest.mark.parametrize("kind", ["bvh", "fbx", "glb", "usd"])
def test_a_motion_comes_back_through_blender(empty: ModuleType, wave_file: Path, tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"out.{kind}"
    export_file(wave_file, kind, file, "plain", Monitor())
    source = wave()
    read_back(empty, file)
    first = {"glb": 0 if kind == "glb" else 1}.get(kind, 1)
    found = heads(empty, source.rig.names, np.arange(30) + _first_key(empty, first))
    off = np.linalg.norm(found - source.head_m, axis=-1)
    assert off.max() < PLACE_M, (kind, off.max(), off.max(axis=0))
    for parent, child in ((0, 1), (2, 3)):
        a, b = (x[:, child] - x[:, parent] for x in (found, source.head_m))
        cosine = np.sum(a * b, axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < ANGLE_DEG


def _first_key(bpy: ModuleType, otherwise: int) -> int:
    """Importers begin at frame 0 or 1."""
    actions = [a for a in bpy.data.actions if a.frame_range[1] > a.frame_range[0]]
    return round(actions[0].frame_range[0]) if actions else otherwise


@pytest.mark.parametrize("kind", ["bvh", "glb", "fbx", "trc", "c3d", "csv", "ply"])
def test_a_run_goes_out_in_every_format(empty: ModuleType, small_run: SmallRun, tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"out.{kind}"
    said = export_file(small_run.out, kind, file, "plain", Monitor())
    assert file.exists() and "6 f" in said, said


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fbx", "glb", "usd", "abc"])
def test_fingers_and_toes_go_with_the_measured_skin(empty: ModuleType, tmp_path: Path, kind: str) -> None:
    """The sample walks 0.2 m: what does not move with the rest stretches the skin."""
    unpack(SAMPLE, tmp_path / "sample")
    file = tmp_path / f"walk.{kind}"
    export_file(tmp_path / "sample" / "results", kind, file, "plain", Monitor())
    read_back(empty, file)
    (skin,) = [thing for thing in empty.data.objects if thing.type == "MESH" and len(thing.data.polygons) > 5_000]
    for rig in (thing for thing in empty.data.objects if thing.type == "ARMATURE"):  # at rest the person stands on the floor
        heights = {bone.name.replace("_", "."): (rig.matrix_world @ bone.matrix_local).translation.z for bone in rig.data.bones}
        assert 0.6 < heights["pelvis"] < 1.2 and 0.0 < heights["foot.L"] < 0.2, heights
        soles = min((skin.matrix_world @ vertex.co).z for vertex in skin.data.vertices)
        assert abs(soles) < 0.01, soles
    empty.context.scene.frame_set(round(empty.context.scene.frame_end))
    played = skin.evaluated_get(empty.context.evaluated_depsgraph_get()).to_mesh()
    places, edges = np.empty(3 * len(played.vertices)), np.empty(2 * len(played.edges), dtype=np.int32)
    played.vertices.foreach_get("co", places)
    played.edges.foreach_get("vertices", edges)
    ends = places.reshape(-1, 3)[edges.reshape(-1, 2)] * skin.matrix_world.to_scale()[0]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() < 0.06


def test_clouds_and_tracked_clouds_by_name(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for folder in ("skin", "clouds", "tracked"):
        write_mesh(out / folder / "0003.ply", np.full((3, 3), len(folder)), np.array([[0, 1, 2]]))
    for name in ("rest.npz", "texture.png"):  # what a run has beside the skins
        (out / "skin" / name).write_bytes(b"no PLY")
    for of, found in (("", "skin"), ("clouds", "clouds"), ("tracked", "tracked")):
        assert export_file(out, "ply", tmp_path / f"of {of}", "plain", Monitor(), of=of) == f"1 files from {found}/"
        assert (tmp_path / f"of {of}" / "0003.ply").read_bytes() == (out / found / "0003.ply").read_bytes()
    shutil.copy(out / "clouds" / "0003.ply", out / "clouds" / "0009.ply")
    (out / "cache").mkdir()  # what a killed run leaves
    with pytest.raises(InputError, match="clouds is not finished: the run that makes it was stopped, or goes on"):
        export_file(out, "ply", tmp_path / "of a part", "plain", Monitor(), of="clouds")
    (out / "run.json").write_text(json.dumps({"format": FORMAT, "version": VERSION, "frames": [0, 4], "stages": {}}))
    with pytest.raises(InputError, match="skin is not finished"):
        export_file(out, "ply", tmp_path / "of a part", "plain", Monitor())
    assert not (tmp_path / "of a part").exists()
    (out / "run.json").write_text(json.dumps({"format": FORMAT, "version": VERSION, "frames": [0, 4]}))
    assert export_file(out, "ply", tmp_path / "of the run", "plain", Monitor(), of="clouds") == "1 files from clouds/"
    (out / "clouds" / "0003.ply").write_bytes(b"ply\n, cut")
    with pytest.raises(InputError, match="0003.ply is a PLY file without “end_header”"):
        export_file(out, "ply", tmp_path / "damaged", "plain", Monitor(), of="clouds")
    assert not (tmp_path / "damaged").exists()
    (out / "tracked" / "0003.ply").unlink()
    with pytest.raises(InputError, match="has no folder tracked/ with files; run the take first"):
        export_file(out, "ply", tmp_path / "none", "plain", Monitor(), of="tracked")


def test_names_by_preset(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    export_file(small_run.out, "bvh", tmp_path / "a.bvh", "mixamo", Monitor())
    assert read_bvh(tmp_path / "a.bvh").rig.names == ("mixamorig:RightArm", "mixamorig:RightForeArm")


def test_the_full_models_names(empty: ModuleType, full_run: Path, tmp_path: Path) -> None:
    export_file(full_run, "bvh", tmp_path / "a.bvh", "mixamo", Monitor())
    found = read_bvh(tmp_path / "a.bvh")
    parents = {name: found.rig.names[p] for name, p in zip(found.rig.names, found.rig.parents)}
    assert parents["mixamorig:RightArm"] == "mixamorig:RightShoulder" and parents["mixamorig:RightShoulder"] == "collar.R"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bvh", "glb", "c3d"])
def test_a_run_of_one_frame_goes_out(empty: ModuleType, full_run: Path, tmp_path: Path, kind: str) -> None:
    assert export_file(full_run, kind, tmp_path / f"a.{kind}", "plain", Monitor()).partition(", ")[0].endswith("1 frames")


@pytest.mark.parametrize("fps", [30.0, 30000 / 1001, 50.0, 12.5])
def test_a_motion_comes_back_from_gltf_with_all_of_its_frames(empty: ModuleType, wave_file: Path, tmp_path: Path, fps: float) -> None:
    """glTF has times but no rate, and Blender imports at 24 images per second: 24 frames of 30 came back as 19."""
    wave = replace(read_bvh(wave_file), fps=fps)
    write_bvh(tmp_path / "a.bvh", wave)
    export_file(tmp_path / "a.bvh", "glb", tmp_path / "a.glb", "plain", Monitor())
    rate = sampled_fps(tmp_path / "a.glb")
    back = open_motion(tmp_path / "a.glb", Monitor())
    if fps == round(fps, 1) == 12.5:
        assert rate is None, "no rate of video"
    else:
        assert rate == pytest.approx(fps, rel=1e-6) and back.fps == pytest.approx(fps, rel=1e-6) and len(back.frames) == len(wave.frames)


def test_what_cannot_go_out_is_said(empty: ModuleType, wave_file: Path, small_run: SmallRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="meshes"):
        export_file(wave_file, "abc", tmp_path / "a.abc", "plain", Monitor())
    with pytest.raises(InputError, match="neither skins nor clouds"):
        export_file(tmp_path, "ply", tmp_path / "ply", "plain", Monitor())
    with pytest.raises(InputError, match="Cannot write"):
        export_file(small_run.out, "glb", wave_file / "a.glb", "plain", Monitor())
    assert not list(tmp_path.glob(".*part*"))


@pytest.mark.parametrize("more, said", [
    (["--format", "trc", "--unit", "mm"], "--unit is that of a BVH, TRC, C3D or CSV file that is read, and"),
    (["--format", "bvh", "--up", "Z"], "--up is that of a BVH, TRC, C3D or CSV file that is read, and"),
    (["--format", "ply", "--preset", "unreal"], "--preset changes no PLY files"),
])  # fmt: skip
def test_an_option_of_another_input_is_refused(
    empty: ModuleType, small_run: SmallRun, tmp_path: Path, capfd: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    assert main(["export", str(small_run.out), *more, "--out", str(tmp_path / "a")]) == 2
    assert said in capfd.readouterr().err and not list(tmp_path.glob("a*"))
    if said.startswith("--u"):
        command = ["retarget", str(small_run.out), "--rig", str(tmp_path / "r.blend"), "--out", str(tmp_path / "a.blend"), *more[2:]]
        assert main(command) == 2 and said in capfd.readouterr().err


def test_a_file_whose_name_is_no_text_is_not_given_to_blender(empty: ModuleType, tmp_path: Path) -> None:
    from tricap.addon.retarget.by_blender import write_whole

    with pytest.raises(InputError, match="is not UTF-8; rename it"):
        write_whole(tmp_path / "a\udcff.fbx", lambda part: pytest.fail("the exporter was called"))
    assert not list(tmp_path.iterdir())


def test_bones_whose_names_blender_would_cut_are_named(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    export_file(small_run.out, "bvh", tmp_path / "a.bvh", "plain", Monitor())
    text = (tmp_path / "a.bvh").read_text()
    for name, refused in (("x" * 63, False), ("x" * 64, True), (32 * "ä", True)):
        (tmp_path / "b.bvh").write_text(text.replace("upper_arm.R", name), encoding="utf-8")
        if refused:
            with pytest.raises(InputError, match="has a longer name than Blender allows, 63 bytes; shorten it"):
                export_file(tmp_path / "b.bvh", "glb", tmp_path / "b.glb", "plain", Monitor())
        else:
            export_file(tmp_path / "b.bvh", "glb", tmp_path / "b.glb", "plain", Monitor())


def test_places_that_points_lack_are_said(small_run: SmallRun, tmp_path: Path) -> None:
    lines = (small_run.out / "joints.csv").read_text().splitlines()
    last = max(int(line.split(",")[0]) for line in lines[1:])
    lacking = [line for line in lines if not line.startswith(f"{last},") or "wrist.R" not in line]
    assert len(lacking) == len(lines) - 1
    (tmp_path / "points.csv").write_text("\n".join(lacking) + "\n")
    said = export_file(tmp_path / "points.csv", "bvh", tmp_path / "a.bvh", "plain", Monitor())
    assert said.endswith("; frames without a place, which are filled: wrist.R in 1")
    (tmp_path / "points.csv").write_text("\n".join(lines) + "\n")
    assert "without a place" not in export_file(tmp_path / "points.csv", "bvh", tmp_path / "b.bvh", "plain", Monitor())


def test_results_that_are_gone_are_not_left_out_in_silence(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    out = small_run.out
    Results(out).write_run(json.loads((out / "run.json").read_text()))
    shutil.rmtree(out / "skin")
    for kind in ("fbx", "bvh", "ply"):
        with pytest.raises(InputError, match="^skin in .* is missing, cut, damaged, or lacks files; repeat the run"):
            export_file(out, kind, tmp_path / f"a.{kind}", "plain", Monitor())
    assert "files from clouds/" in export_file(out, "ply", tmp_path / "ply", "plain", Monitor(), of="clouds")


def test_a_full_disk_is_noticed_before_and_after(empty: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """USD and Alembic end as if all were well, with a part of the file."""
    from tricap.addon.retarget import by_blender

    left = [100 << 20]
    monkeypatch.setattr(by_blender.shutil, "disk_usage", lambda folder: SimpleNamespace(free=left[0]))

    def export(part: str) -> None:
        Path(part).write_text("half of")
        left[0] = 0

    with pytest.raises(InputError, match="a.usd: 0 kB are left on the disk"):
        by_blender.write_whole(tmp_path / "a.usd", export)
    with pytest.raises(InputError, match="32 MB are needed"):
        by_blender.write_whole(tmp_path / "a.usd", lambda part: pytest.fail("the exporter was called"))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_a_limit_of_the_size_of_files_is_noticed_before(empty: ModuleType, tmp_path: Path) -> None:
    """Alembic ended the process, and left a part of the file."""
    import resource

    from tricap.addon.retarget import by_blender

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, before[1]))
    try:
        with pytest.raises(InputError, match="no file may be larger than 1024 kB here, and 32 MB are needed"):
            by_blender.write_whole(tmp_path / "a.abc", lambda part: pytest.fail("the exporter was called"))
        resource.setrlimit(resource.RLIMIT_FSIZE, (33 << 20, before[1]))
        with pytest.raises(InputError, match="no file may be larger than 33792 kB here"):
            by_blender.write_whole(tmp_path / "a.usdc", lambda part: (Path(part).touch(), os.truncate(part, 33 << 20)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has /dev/full")
def test_exporters_do_not_print_into_full_streams(empty: ModuleType, tmp_path: Path) -> None:
    from tricap.addon.retarget.by_blender import write_whole

    def export(part: str) -> None:
        os.write(1, b"libraries print"), os.write(2, b"and complain")
        print("so do add-ons", file=sys.stderr, flush=True)
        Path(part).write_text("motion")

    full, kept = os.open("/dev/full", os.O_WRONLY), [os.dup(n) for n in (1, 2)]
    try:
        os.dup2(full, 1), os.dup2(full, 2)
        write_whole(tmp_path / "a.usd", export)
        with pytest.raises(OSError, match="No space"):
            os.write(2, b"afterwards they are as before")
    finally:
        for n, before in zip((1, 2), kept):
            os.dup2(before, n)
            os.close(before)
        os.close(full)
    assert (tmp_path / "a.usd").read_text() == "motion"
