"""The folder of a run: checkpoints that agree or are made anew, run.json, and folders that belong to somebody else."""

import json
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import body_text, default_shape
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.motion.formats.ply import read_ply
from tricap.core.results.folder import Results, check_complete, lost
from tricap.core.surface.cloud import PointCloud, write_cloud
from tricap.core.tracking.trajectories import Filtered, Trajectories, write_trajectories

ARRAYS = dict(x=np.arange(6.0).reshape(2, 3))


def test_a_checkpoint_is_found_by_its_key_only(tmp_path: Path) -> None:
    results = Results(tmp_path / "é out")
    assert results.load_checkpoint("surface", "0000", "k") is None
    results.save_checkpoint("surface", "0000", "k", ARRAYS)
    found = results.load_checkpoint("surface", "0000", "k")
    assert found is not None and np.array_equal(found["x"], ARRAYS["x"])
    for stage, name, key in (("surface", "0000", "other"), ("surface", "0001", "k"), ("tracks", "0000", "k")):
        assert results.load_checkpoint(stage, name, key) is None


def test_a_damaged_checkpoint_is_made_anew(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.save_checkpoint("surface", "0000", "k", ARRAYS)
    path = tmp_path / "cache" / "surface" / "0000.npz"
    whole = path.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"text", whole.replace(b"x.npy", b"y.npy")):
        path.write_bytes(content)
        assert results.load_checkpoint("surface", "0000", "k") is None


@pytest.mark.parametrize("forged", [np.zeros(3), np.full((2, 3), np.nan), np.zeros((2, 3), dtype=complex), np.full((2, 3), "x")])
def test_a_checkpoint_that_somebody_changed_is_made_anew(tmp_path: Path, forged: np.ndarray) -> None:
    results, path = Results(tmp_path), tmp_path / "cache" / "surface" / "0000.npz"
    for hide in (False, True):  # also with a header that does not say what the arrays were
        results.save_checkpoint("surface", "0000", "k", ARRAYS)
        file = store.load_arrays(path)
        header = json.loads(str(file["header_json"]))
        header = {name: value for name, value in header.items() if not (hide and name == store.CONTENT)}
        np.savez(path, **(file | {"header_json": np.array(json.dumps(header)), "x": forged}))  # type: ignore[arg-type]
        assert results.load_checkpoint("surface", "0000", "k") is None


def test_what_was_there_and_is_not_ours(tmp_path: Path) -> None:
    (tmp_path / "take").mkdir()
    assert Results(tmp_path).folder == tmp_path.resolve()  # other files are left alone
    for name in ("clouds", "report", "body.blend", "cache"):
        folder = tmp_path / f"with {name}"
        (folder / name).mkdir(parents=True)
        (folder / name / "thesis.txt").write_text("x")
        with pytest.raises(InputError, match=f"contains “{name}”, which was not written by Tricap"):
            Results(folder)
        Results(folder.parent / "ours").write_run({})
    (tmp_path / "ours" / "clouds").mkdir()
    Results(tmp_path / "ours")
    stopped = Results(tmp_path / "stopped early")
    stopped.save_checkpoint("surface", "0000", "k", ARRAYS)
    (tmp_path / "stopped early" / "clouds").mkdir()
    Results(tmp_path / "stopped early")


@pytest.mark.parametrize("beside", ["", "cache/", "cache/x/", "cache/x/data.npz", ".tricap-lock", "run.json", "cache/x/numbers.npz"])
def test_nothing_of_somebody_else_counts_as_the_mark_of_a_run(tmp_path: Path, beside: str) -> None:
    """A folder “report” of the user was removed, because an empty cache, an empty lock or another program's run.json lay beside it."""
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "thesis.txt").write_text("x")
    path = tmp_path / (beside or "notes.txt")
    if beside.endswith("/"):
        path.mkdir(parents=True)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('{"loss": 0.5}' if beside == "run.json" else "")
    if beside.endswith("numbers.npz"):
        np.savez(path, x=np.zeros(3))
    with pytest.raises(InputError, match="which was not written by Tricap; choose an empty or a new folder") as error:
        Results(tmp_path)
    assert "--restart" not in str(error.value)


def test_a_stopped_run_without_a_checkpoint_goes_on(tmp_path: Path) -> None:
    (tmp_path / "cache" / "starts").mkdir(parents=True)
    Results(tmp_path)


def test_folders_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file; choose a folder"):
        Results(tmp_path / "file")
    with pytest.raises(InputError, match="Cannot make the folder"):
        Results(tmp_path / "file" / "out")


def test_run_json(tmp_path: Path) -> None:
    results = Results(tmp_path)
    assert results.read_run() == {}
    results.write_run({"fps": 25.0, "sigma0": float("nan"), "name": "é"})
    assert results.read_run() == {"format": "tricap-run", "version": 1, "fps": 25.0, "sigma0": None, "name": "é", "files": {}}
    for content, said in (("{", "is not a JSON file"), ("[]", "was not written by"), ('{"format": "x"}', "was not written by")):
        (tmp_path / "run.json").write_text(content)
        with pytest.raises(InputError, match=said):
            results.read_run()
    store.write_json(tmp_path / "run.json", {"format": "tricap-run", "version": 2})
    with pytest.raises(InputError, match="was not written by this version of Tricap"):
        results.read_run()


@pytest.mark.parametrize(("name", "value", "said"), [
    ("stages", [], "stages"), ("stages", {"measure": 1}, "measure"), ("stages", {"track": {"key": 3}}, "track"), ("frames", [0], "frames"),
    ("stages", {"track": {"trajectories": "many", "mean_length_frames": 2.0}}, "track"), ("frames", [3, 1], "frames"),
    ("stages", {"fit": {"joint_sigma_mm": None}}, "fit"), ("stages", {"fit": {"joint_sigma_mm": 1.0, "frames": [3]}}, "fit"),
    ("blend", [1], "blend"), ("blend", "x", "blend"),
    ("stages", {"fit": {"joint_sigma_mm": 10**18}}, "fit"), ("settings", [], "settings"), ("settings", {"skin": 3}, "settings"),
    ("warnings", [1], "warnings"), ("inputs", {"rig.toml": 5}, "inputs"), ("views", "LCR", "views"), ("take", None, "take"),
    ("take", "a\0b", "take"), ("take", "\ud800", "take"), ("frames", [0, 10**15], "frames"), ("frames", [10**15, 10**15 + 3], "frames"),
    ("stages", {"fit": {"joint_sigma_mm": 1.0, "fitted_again": [[0, 10**15]]}}, "fit"),
])  # fmt: skip
def test_a_run_json_that_no_run_wrote(tmp_path: Path, name: str, value: object, said: str) -> None:
    store.write_json(tmp_path / "run.json", {"format": "tricap-run", "version": 1, name: value})
    with pytest.raises(InputError, match=f"run.json is damaged: “{said}” is invalid; remove the file and run again"):
        Results(tmp_path).read_run()


def test_arrays_that_were_changed_are_lost(tmp_path: Path) -> None:
    """As many bytes as before, but other ones: the stage is done again, and nobody builds on them."""
    results = Results(tmp_path)
    store.save(tmp_path / "trajectories.npz", {"xyz_m": np.arange(3000.0)}, {})
    (tmp_path / "motion.csv").write_text("frame\n0\n1\n")
    results.write_run({})
    assert lost(tmp_path, results.read_run()) == {}
    check_complete(tmp_path, ("trajectories.npz", "motion.csv"))
    content = bytearray((tmp_path / "trajectories.npz").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "trajectories.npz").write_bytes(content)
    assert lost(tmp_path, results.read_run()) == {"track": ["trajectories.npz"]}
    check_complete(tmp_path, ("motion.csv", "never made"))
    with pytest.raises(InputError, match=r"^trajectories.npz in .* is missing, cut, damaged, or lacks files; repeat the run"):
        check_complete(tmp_path, ("motion.csv", "trajectories.npz"))
    for damage in (lambda file: file.write_text("frame\n0\n"), Path.unlink):
        damage(tmp_path / "motion.csv")
        with pytest.raises(InputError, match="^motion.csv in "):
            check_complete(tmp_path, ("motion.csv",))


def test_clouds_and_trajectories(tmp_path: Path) -> None:
    random, results = np.random.default_rng(0), Results(tmp_path)
    K = np.tile(np.diag([1e-6, 4e-6, 4e-6]), (5, 1, 1))
    cloud = PointCloud(frame=7, xyz_m=random.standard_normal((5, 3)), covariance_m2=K, normals=np.tile([0, 0, -1.0], (5, 1)),
                       intensity=np.arange(5), xy_px=np.zeros((5, 3, 2)), residual_px=np.zeros(5), extended=[0, 1, 0, 1, 1])  # fmt: skip
    write_cloud(results.cloud_path(cloud.frame), cloud)
    ply = read_ply(tmp_path / "clouds" / "0007.ply")
    assert np.allclose(ply.xyz_m, cloud.xyz_m, atol=1e-6) and np.allclose(ply.vertex["sigma"], 3e-3)
    assert ply.vertex["extended"].dtype == np.uint8 and ply.vertex["extended"].tolist() == [0, 1, 0, 1, 1]
    xyz = random.standard_normal((3, 4, 3))
    xyz[0, 1] = np.nan
    sigma = np.where(np.isnan(xyz[..., 0]), np.nan, 1e-3)
    tracks = Trajectories(frames=np.arange(3), time_s=np.arange(3) / 25, xyz_m=xyz, velocity_m_s=xyz, acceleration_m_s2=xyz,
                          sigma_m=sigma, status=np.isfinite(sigma))  # fmt: skip
    write_trajectories(results.folder, Filtered(kept=tracks, source=np.arange(4), raw=tracks), 25.0)
    arrays, header = store.load(tmp_path / "trajectories.npz")
    assert header["format"] == "tricap-trajectories" and arrays["xyz_m"].shape == (3, 4, 3)
    assert np.array_equal(np.isnan(arrays["xyz_m"][..., 0]), np.isnan(xyz[..., 0])) and arrays["time_s"].dtype == np.float64
    with np.load(tmp_path / "trajectories.npz", allow_pickle=False) as promised:
        assert {"time_s", "frames", "xyz_m", "velocity_m_s", "acceleration_m_s2", "sigma_m", "status"} <= set(promised.files)
    with np.load(tmp_path / "trajectories_raw.npz", allow_pickle=False) as removed:
        assert {"frames", "xyz_m", "status", "reason"} <= set(removed.files) and removed["reason"].shape == (4,)
    with pytest.raises(ValueError, match="sigma_m|covariance"):
        PointCloud(**{n: getattr(cloud, n) for n in PointCloud.__dataclass_fields__} | dict(covariance_m2=K[:4]))


def test_removing(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.save_checkpoint("surface", "0000", "k", ARRAYS)
    (tmp_path / "body.toml").write_text("x")
    results.remove("body.toml", "cache", "missing")
    assert not any(tmp_path.iterdir())


def test_what_was_written_and_is_gone_or_cut_is_known(tmp_path: Path) -> None:
    results = Results(tmp_path)
    for name in (
        "clouds/0000.ply",
        "clouds/0001.ply",
        "joints.csv",
        "skin/0000.ply",
        "skin/texture.png",
        "report/report.html",
        "report/figures.csv",
    ):
        store.write_bytes(tmp_path / name, b"some bytes")
    results.write_run({"stages": {}})
    run = results.read_run()
    assert run["files"] == {"clouds": [2, 20], "joints.csv": [1, 10], "skin": [2, 20], "report": [2, 20]} and lost(tmp_path, run) == {}
    (tmp_path / "clouds" / "Thumbs.db").write_bytes(b"of the system")
    (tmp_path / "skin" / ".DS_Store.png").write_bytes(b"of the system")
    (tmp_path / "clouds" / "0002.ply").write_bytes(b"more harms nothing")
    assert lost(tmp_path, run) == {} and lost(tmp_path, {"stages": {}}) == {}, "and an earlier version does not know"
    (tmp_path / "joints.csv").write_bytes(b"cut")
    (tmp_path / "skin" / "texture.png").unlink()
    (tmp_path / "report" / "figures.csv").unlink()
    assert lost(tmp_path, run) == {"fit": ["joints.csv", "skin"], "report": ["report"]}
    run["frames"], rows = [0, 3], ["frame,x\r\n", "0,1.5\r\n", "1,1.5\r\n", "2,1\r\n"]
    run["files"]["joints.csv"] = [1, 100]
    for kept, complete in ((rows, True), (rows[:-1], False), ([*rows[:-1], "2,1"], True), ([*rows[:-1], "2\r\n"], False), ([], False)):
        (tmp_path / "joints.csv").write_text("".join(kept), newline="")
        assert ("joints.csv" not in lost(tmp_path, run)["fit"]) == complete, "an edited table may be shorter, a cut one may not"
    run["files"]["body.toml"], whole = [1, 10_000], body_text(default_shape(read_model("arm.R")))
    for text, complete in ((whole, True), (whole + "\n", True), (whole[: len(whole) // 2], False), (whole.removesuffix("# end\n"), False)):
        (tmp_path / "body.toml").write_text(text)
        assert ("body.toml" not in lost(tmp_path, run)["fit"]) == complete, "nor a body"
    for size in (3, [1], ["1", 2], [1, 2.5]):
        store.write_json(tmp_path / "run.json", {**run, "files": {"clouds": size}})
        with pytest.raises(InputError, match="“files” is invalid"):
            results.read_run()
