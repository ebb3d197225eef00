"""Every reader of files, with what makes a sound small file for it: (files made in a folder, the reader of that folder)."""

import json
import os
import time
import wave
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from coded_movies import coded_movie
from pose_graphs import pose_graph
from scene_files import model, record, write_fbx, write_gltf, zeros

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, read_body, write_body
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import REST, read_skin, rest_skin, write_skin
from tricap.core.calibration.rig_files import FOLDERS, FORMATS, read_any, write_as
from tricap.core.checking.rig_check import geometry_findings
from tricap.core.checking.run_check import check_run
from tricap.core.foundation import bounded, store
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.images.interlace import row_grid
from tricap.core.images.sequence import open_sequence
from tricap.core.motion import tables
from tricap.core.motion.formats import bvh, c3d, keypoints_json, markers, trc
from tricap.core.motion.formats.fbx import check_fbx
from tricap.core.motion.formats.gltf import check_gltf
from tricap.core.motion.formats.markers import Markers
from tricap.core.motion.formats.ply import read_ply, write_cloud, write_mesh
from tricap.core.motion.retarget.mapping import read_preset
from tricap.core.motion.retarget.residual_motion import ResidualChain, ResidualMotion, from_text, to_text
from tricap.core.motion.retarget.roles import read_humanoid
from tricap.core.networks.onnx_file import input_shape, read_onnx
from tricap.core.report.pictures import png
from tricap.core.results.folder import Results
from tricap.core.run import record as frame_table
from tricap.core.run.inspection import patch_boxes, read_removed, read_tracks
from tricap.core.run.inspection import read_points as read_shown
from tricap.core.run.settings import settings_of
from tricap.core.run.stages import stage_keys, valid_stages
from tricap.core.run.take_run import Run
from tricap.core.synchronising.sound import read_wav
from tricap.core.synchronising.time_code import read_time_code
from tricap.core.synthetic.arm import arm_rig
from tricap.core.take.bar_file import read_bar, write_bar
from tricap.core.take.clock import read_timestamps
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take
from tricap.core.take.writing import read_table
from tricap.core.tracking.contour import ContourTable
from tricap.core.tracking.point_tables import read_key_points, read_planar, read_points, read_polygon
from tricap.core.tracking.settings import TrackStatus

__all__ = ["FAULTY", "READERS", "InputError"]
Make = Callable[[Path], list[Path]]
Read = Callable[[Path], Any]
HERE = Path(__file__).resolve().parent
RIG = arm_rig(96)
FRAMES = ",".join(("frame", *frame_table.COLUMNS, "fit")) + "\n0" + len(frame_table.COLUMNS) * ",1" + ",fitted\n"
CONTOURS = "frame,vertex,x,y,normal_x,normal_y,sigma,on_edge\n"
CONTOURS += "".join(f"{i // 4},{i % 4},{3 * i}.5,7.25,0,1,0.2,1\n" for i in range(12))
KEYS = dict.fromkeys(("measure", "track", "fit"), "k")
TAKE = """format = "tricap-take"
version = 1
fps = 25.0
interlaced = "odd"
rig = "rig.toml"
reference_view = "C"
frames = [0, 4]
[[views]]
name = "L"
images = "L/*.png"
offset_frames = 1
[[views]]
name = "C"
movie = "c.mp4"
[body]
model = "arm.R"
[seeds]
frame = 0
surface = [ { L = [20.0, 24.0], C = [55.0, 38.0] } ]
[seeds.joints]
"elbow.R" = { C = [43.0, 26.0], L = [45.0, 26.2] }
[settings.matching]
patch_px = 13
"""


def films(folder: Path) -> list[Path]:
    """A take with images, which is opened, and not only read."""
    for k, view in enumerate("LC"):
        (folder / view).mkdir()
        for n in range(6):
            store.write_bytes(folder / view / f"{n:04d}.png", png(np.full((72, 96), 40 + 9 * n + k, dtype=np.uint8)))
    write_rig(folder / "rig.toml", Rig(cameras=RIG.cameras[:2]))
    (folder / "take.toml").write_text(TAKE.replace('movie = "c.mp4"', 'images = "C/*.png"'))
    return [folder / "take.toml", folder / "rig.toml"]


def opened(folder: Path) -> None:
    footage = open_take(read_take(folder))
    stage_keys(footage, settings_of(footage.take.settings, {}, "take.toml"), folder / "out")
    footage.read(footage.frames.start)


def kept_motion(folder: Path) -> None:
    """The text that an action keeps, which comes from a .blend file."""
    try:
        kept = bounded.text_of(folder / "a.txt", bounded.JSON_BYTES, errors="replace")
    except OSError as error:
        raise InputError(str(error)) from error
    from_text(kept).at(np.arange(3))


def sound(path: Path) -> None:
    with wave.open(str(path), "wb") as wav:
        wav.setparams((2, 2, 16000, 0, "NONE", ""))
        wav.writeframes(np.random.default_rng(0).integers(-9000, 9000, 800).astype("<i2").tobytes())


def points() -> Markers:
    xyz = np.random.default_rng(0).uniform(-1, 1, (12, 2, 3))
    xyz[3, 1] = np.nan
    return Markers(names=("elbow.R", "wrist.R"), fps=50.0, frames=np.arange(12), xyz_m=xyz, sigma_m=np.full((12, 2), 1e-3))


def segments() -> c3d.Segments:
    R = np.broadcast_to(np.eye(3), (12, 2, 3, 3))
    return c3d.Segments(names=("forearm.R", "hand.R"), frames=np.arange(12), R=R, origin_m=points().xyz_m)


def residual_motion() -> str:
    one = np.full((1, 2, 3), 0.25)
    chain = ResidualChain(role="neck", order=(-1,), ends=np.ones(1), along_m=np.ones(3), parent="spine", size=1, turn=one)
    stands = {state: {"L": np.ones(2, dtype=bool)} for state in ("ankle", "toe", "flat")}
    return to_text(
        ResidualMotion(
            frames=np.arange(2.0),
            planting_turns={"foot.L": one},
            planting_shift_m=one[0],
            forearm_twists={},
            contacts=stands,
            contact_settings={"mode": "auto"},
            ankle_level_m=0.1,
            chains=(chain,),
        )
    )


def key_point_files(folder: Path) -> list[Path]:
    """The tables of two followed points."""
    space, images = folder / "points3d.csv", folder / "points2d.csv"
    space.write_text("frame,time_s,point,x,y,z,sigma,status\n0,0.0,a,1,2,3,0.001,measured\n1,0.04,a,,,,,lost\n", encoding="utf-8")
    images.write_text("frame,view,point,x,y\n0,L,a,10,12\n0,C,a,20,12.5\n", encoding="utf-8")
    return [space, images]


def text(name: str, content: str) -> Make:
    def make(folder: Path) -> list[Path]:
        (folder / name).write_text(content, encoding="utf-8")
        return [folder / name]

    return make


def written(name: str, write: Callable[[Path], Any]) -> Make:
    def make(folder: Path) -> list[Path]:
        write(folder / name)
        return [folder / name]

    return make


def calibration(kind: str) -> tuple[Make, Read]:
    name = "" if kind in FOLDERS else "rig.xml" if kind == "agisoft" else "rig.yml" if kind == "opencv" else "rig.toml"

    def make(folder: Path) -> list[Path]:
        return [p for p in write_as(folder / name, RIG, kind) if p.is_file()]

    return make, lambda folder: geometry_findings(read_any(folder / name))


def picture(ending: str, dtype: type = np.uint8, shape: tuple[int, ...] = (24, 32)) -> tuple[Make, Read]:
    def make(folder: Path) -> list[Path]:
        image = np.random.default_rng(1).integers(0, 255, shape)
        image = (image / 255).astype(np.float32) if ending == ".exr" else (image * (257 if dtype == np.uint16 else 1)).astype(dtype)
        data = cv2.imencode(ending, image)[1].tobytes()
        (folder / f"0{ending}").write_bytes(data)
        return [folder / f"0{ending}"]

    return make, lambda folder: open_sequence(folder, images=f"*{ending}", movie=None, view="C").read(0)


def movie(ending: str, code: str) -> tuple[Make, Read]:
    def make(folder: Path) -> list[Path]:
        writer = cv2.VideoWriter(str(folder / f"c{ending}"), cv2.VideoWriter_fourcc(*code), 25.0, (64, 48))
        for i in range(6):
            writer.write(np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8))
        writer.release()
        return [folder / f"c{ending}"]

    def read(folder: Path) -> None:
        sequence = open_sequence(folder, images=None, movie=f"c{ending}", view="C")
        for i in (0, min(5, sequence.count - 1)):
            sequence.read(i)

    return make, read


def cloud(folder: Path) -> list[Path]:
    xyz = np.random.default_rng(0).uniform(0, 1, (20, 3))
    write_cloud(folder / "a.ply", xyz_m=xyz, sigma_m=xyz[:, 0], normals=xyz, intensity=xyz[:, 0] * 255)
    write_mesh(folder / "b.ply", xyz, np.array([[0, 1, 2], [3, 4, 5]]))
    return [folder / "a.ply", folder / "b.ply"]


def run_folder(folder: Path) -> list[Path]:
    results = Results(folder)
    results.write_run({"take": str(folder / "nowhere"), "frames": [0, 2], "inputs": {}, "warnings": [],
                       "settings": {"skin": {"rays": 24}, "matching": {"patch_px": 13}},
                       "stages": {"measure": {"key": "k", "frames": 2, "points_per_frame": 20.0, "residual_px": 0.1,
                                              "sigma_mm": 1.0}}})  # fmt: skip
    cloud(folder)
    (folder / "clouds").mkdir(exist_ok=True)
    (folder / "a.ply").rename(folder / "clouds" / "0000.ply")
    (folder / "b.ply").rename(folder / "clouds" / "0001.ply")
    return [folder / "run.json", folder / "clouds" / "0000.ply"]


def done(folder: Path) -> None:
    """What a new run keeps of an earlier one, said in a line."""
    record = {"stages": valid_stages(Results(folder).read_run(), KEYS)}
    footage = SimpleNamespace(frames=range(2))
    str(Run(footage=footage, settings={}, results=None, keys=KEYS, record=record))  # type: ignore[arg-type]


def tracked(path: Path) -> None:
    xyz = np.random.default_rng(2).uniform(-1, 1, (5, 3, 3)).astype(np.float32)
    given = {"frames": np.arange(5, dtype=np.int32), "xyz_m": xyz, "status": np.ones((5, 3), np.int8), "reason": np.ones(3, np.int8)}
    store.save(path, given, {"format": "tricap-trajectories_raw", "version": 1, "fps": 25.0})


def looked_at(folder: Path) -> None:
    """What the overlays ask of the trajectories."""
    history = read_tracks(folder)
    if history is None:  # what is no file is not there
        return
    for frame in (0, 4):
        history.tails(RIG.cameras[0], frame, 3, history.kept)
        [TrackStatus(int(status)).words for status in history.at(RIG.cameras[0], frame)[1]]


def surface(folder: Path) -> list[Path]:
    """A cloud and its checkpoint, as the overlays show them."""
    random, n, k, results = np.random.default_rng(4), 20, len(RIG.cameras), Results(folder)
    cloud(folder)
    (folder / "clouds").mkdir(exist_ok=True)
    (folder / "a.ply").rename(folder / "clouds" / "0000.ply")
    xyz = read_ply(folder / "clouds" / "0000.ply").xyz_m
    results.save_checkpoint(
        "surface",
        "0000",
        "k",
        dict(
            cloud_xyz_m=xyz,
            grid=np.array([4, 0, 8, 6]),
            field_xy=random.uniform(0, 90, (n, k, 2)),
            field_cell=np.arange(n),
            field_shape=random.uniform(0, 1, (n, k, 2, 2)),
            field_residual_px=np.ones(n),
            field_correlation=np.ones(n),
            removed_px=random.uniform(0, 90, (5, k, 2)),
            removed_why=np.ones(5, np.uint8),
        ),
    )
    return [folder / "clouds" / "0000.ply", folder / "cache" / "surface" / "0000.npz"]


def shown(folder: Path) -> None:
    found = read_shown(folder, 0, RIG.cameras, row_grid("none"))
    if found is not None and len(found.xyz_m):
        patch_boxes(found, 0, RIG.cameras, 1, row_grid("none"), 13)
    read_removed(folder, 0)


def body(path: Path) -> None:
    write_body(path, default_shape(read_model("arm.R")))


def motion_table(path: Path) -> None:
    names = read_model("arm.R").skeleton.dof_names
    rows = [["frame", "time_s", *names, *(f"sigma {n}" for n in names)], *([str(i)] * (2 + 2 * len(names)) for i in range(5))]
    path.write_text("\n".join(",".join(row) for row in rows))


def person(path: Path) -> None:
    people = [{"pose_keypoints_2d": np.random.default_rng(0).uniform(0, 90, 75).round(2).tolist()}]
    path.write_text(json.dumps({"version": 1.3, "people": people}))


def coco(path: Path) -> None:
    rows = [{"image_id": i, "keypoints": np.random.default_rng(i).uniform(1, 90, 51).round(2).tolist()} for i in range(3)]
    path.write_text(json.dumps({"annotations": rows, "images": [{"id": i, "file_name": f"{i}.png"} for i in range(3)]}))


def glb(path: Path) -> None:
    table = json.dumps({"nodes": [{"name": "Hips"}], "extensions": {"VRM": {"humanoid": {"humanBones": [{"bone": "hips", "node": 0}]}}}})
    data = table.encode()
    data += b" " * (-len(data) % 4)
    path.write_bytes(b"glTF" + np.array([2, 20 + len(data), len(data)], "<u4").tobytes() + b"JSON" + data)


def arrays(path: Path) -> None:
    store.save(path, {"xyz_m": np.zeros((5, 4, 3)), "status": np.zeros((5, 4), np.int8)}, {"key": "k"})


def checkpoint(path: Path) -> None:
    Results(path).save_checkpoint("surface", "0000", "k", {"field": np.zeros((40, 3))})


def own_model(path: Path) -> None:
    path.write_bytes((HERE.parent / "core" / "body" / "models" / "arm.R.toml").read_bytes())


def bvh_file(path: Path) -> None:
    offsets = "OFFSET 0 10 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    end = "End Site\n{\nOFFSET 0 8 0\n}\n"
    root = "OFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
    joints = f"ROOT Hips\n{{\n{root}JOINT Spine\n{{\n{offsets}{end}}}\n}}"
    frames = "\n".join(" ".join(f"{i + k * 0.5:.2f}" for k in range(9)) for i in range(4))
    path.write_text(f"HIERARCHY\n{joints}\nMOTION\nFrames: 4\nFrame Time: 0.04\n{frames}\n")


def bar_file(folder: Path) -> list[Path]:
    return [write_bar(folder / "rig.toml", RIG, np.arange(4), np.random.default_rng(3).uniform(-1, 1, (4, 2, 3)))]


def _raise(folder: Path) -> None:
    if (folder / "a").read_bytes() != b"sound":
        raise KeyError("what nobody caught")


def _sleep(folder: Path) -> None:
    began = time.process_time()
    while (folder / "a").read_bytes() != b"sound" and time.process_time() - began < 2.2:
        pass


def _swell(folder: Path) -> int:
    return 0 if (folder / "a").read_bytes() == b"sound" else np.ones(75_000_000).size


def _die(folder: Path) -> None:
    if (folder / "a").read_bytes() != b"sound":
        os._exit(11)


FAULTY: dict[str, tuple[Make, Read]] = {  # what the engine must find
    "test raises": (text("a", "sound"), _raise), "test sleeps": (text("a", "sound"), _sleep),
    "test swells": (text("a", "sound"), _swell), "test dies": (text("a", "sound"), _die),
}  # fmt: skip


def skin_of_rest(folder: Path) -> list[Path]:
    write_skin(folder / REST, rest_skin(default_shape(read_model("arm.R")), SkinSettings(contours=4, rays=8, cap_contours=2)))
    return [folder / REST]


READERS: dict[str, tuple[Make, Read]] = {
    "take.toml": (text("take.toml", TAKE), read_take),
    "rig.toml": (written("rig.toml", lambda p: write_rig(p, RIG)), lambda f: geometry_findings(read_rig(f / "rig.toml"))),
    "opened take": (films, opened),
    **{f"calibration {kind}": calibration(kind) for kind in sorted(FORMATS)},
    "ply": (cloud, lambda f: [read_ply(f / "a.ply"), read_ply(f / "b.ply")]),
    "network": (written("a.onnx", lambda p: p.write_bytes(pose_graph("simcc", 17, (32, 32)))),
                lambda f: input_shape(read_onnx(f / "a.onnx"), f)),
    "skin": (skin_of_rest, lambda f: read_skin(f / REST, default_shape(read_model("arm.R")))),
    "npz": (written("a.npz", arrays), lambda f: store.load(f / "a.npz")),
    "checkpoint": (lambda f: (checkpoint(f), [f / "cache" / "surface" / "0000.npz"])[1],
                   lambda f: Results(f).load_checkpoint("surface", "0000", "k")),
    "run.json": (run_folder, lambda f: Results(f).read_run()),
    "what a run keeps": (run_folder, done),
    "trajectories": (written("trajectories_raw.npz", tracked), looked_at),
    "surface to be shown": (surface, shown),
    "table of a take": (text("take.toml", TAKE), read_table),
    "contours": (text("C.csv", CONTOURS), lambda f: list(ContourTable(f / "C.csv").values())),
    "check of a run": (run_folder, lambda f: check_run(f, Monitor())),
    "trc": (written("a.trc", lambda p: trc.write_trc(p, points())), lambda f: trc.read_trc(f / "a.trc")),
    "c3d": (written("a.c3d", lambda p: c3d.write_c3d(p, points())), lambda f: c3d.read_c3d(f / "a.c3d")),
    "c3d segments": (written("a.c3d", lambda p: c3d.write_c3d(p, points(), segments=segments())), lambda f: c3d.read_segments(f / "a.c3d")),
    "csv of points": (written("a.csv", lambda p: markers.write_points_csv(p, points())),
                      lambda f: markers.read_points_csv(f / "a.csv")),
    "bvh": (written("a.bvh", bvh_file), lambda f: bvh.read_bvh(f / "a.bvh")),
    "joints.csv": (text("joints.csv", "frame,time_s,joint,x,y,z,sigma\n0,0.0,elbow.R,1,2,3,0.1\n1,0.04,elbow.R,1,2,3,0.1\n"),
                   lambda f: tables.read_joints(f / "joints.csv")),
    "timestamps": (text("t.csv", "cam_id,frame_index,frame_time\n0,1,20.1\n0,0,20.0\n1,0,20.2\n0,2,20.25\n"),
                   lambda f: read_timestamps(f / "t.csv", "cam_0")),
    "time code": (written("a.mov", lambda p: p.write_bytes(coded_movie(90_000))), lambda f: read_time_code(f / "a.mov")),
    "wav": (written("a.wav", sound), lambda f: read_wav(f / "a.wav")),
    "motion.csv": (written("motion.csv", motion_table), lambda f: tables.read_motion(f / "motion.csv", read_model("arm.R").skeleton)),
    "frames.csv": (text("frames.csv", FRAMES),
                   lambda f: frame_table.read_frame_table(f / "frames.csv")),
    "chosen points": (text("points.csv", "point,x,y,joined_to\na,10,12,b\nb,20,30,\nc,5,6.5,a\n"),
                      lambda f: read_points(f / "points.csv")),
    "2-D tracks": (text("a.csv", "frame,point,x,y,sigma,correlation,status\n0,a,10,12,0.1,0.9,measured\n1,a,11,12,,,lost\n"),
                   lambda f: read_planar(f / "a.csv")),
    "followed points": (key_point_files, lambda f: read_key_points(f / "points3d.csv", f / "points2d.csv")),
    "bar": (bar_file, lambda f: read_bar(f / "rig.toml", RIG)),
    "chosen points in views": (text("points.csv", "point,view,x,y\na,L,10,12\na,C,20,30\n"),
                               lambda f: read_points(f / "points.csv", with_views=True)),
    "polygon": (text("polygon.csv", "x,y\n10,12\n40,13\n38,60\n9,55\n"), lambda f: read_polygon(f / "polygon.csv")),
    "body.toml": (written("body.toml", body), lambda f: read_body(f / "body.toml")),
    "own model": (written("own.toml", own_model), lambda f: read_model(f / "own.toml")),
    "mapping": (text("map.json", (HERE.parent / "addon" / "presets" / "mixamo.json").read_text()), lambda f: read_preset(f / "map.json")),
    "residual motion": (text("a.txt", residual_motion()), kept_motion),
    "keypoints of OpenPose": (written("a.json", person), lambda f: keypoints_json.read_keypoints([f / "a.json"])),
    "keypoints of COCO": (written("a.json", coco), lambda f: keypoints_json.read_keypoints([f / "a.json"])),
    "vrm": (written("a.vrm", glb), lambda f: read_humanoid(f / "a.vrm")),
    "fbx before Blender": (written("a.fbx", lambda p: write_fbx(p, [model(1), record(b"Geometry", [zeros(90)], [model(2)])])),
                           lambda f: check_fbx(f / "a.fbx")),
    "gltf before Blender": (written("a.gltf", lambda p: write_gltf(p, nodes=[{"name": "a", "mesh": 0}, {"name": "b"}])),
                            lambda f: check_gltf(f / "a.gltf")),
    **{f"picture {ending[1:]}": picture(ending) for ending in (".png", ".jpg", ".tif", ".bmp", ".webp", ".pgm")},
    "picture png 16 bit colour": picture(".png", np.uint16, (24, 32, 3)),
    "picture tif 16 bit colour": picture(".tif", np.uint16, (24, 32, 3)),
    "movie avi": movie(".avi", "MJPG"),
    "movie mp4": movie(".mp4", "mp4v"),
}  # fmt: skip
