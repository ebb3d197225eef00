"""The fitted body as a checkpoint: another skin needs no other fit, another fit does."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.body.motion import BodyFit
from tricap.core.fitting.inputs.start_joints import StartJoints
from tricap.core.results.folder import Results
from tricap.core.run import pipeline
from tricap.core.run.fitted_body import FittedBody, read_fitted, write_fitted
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take

SETTINGS: dict[str, dict[str, Any]] = {"growing": {"spacing_px": 6}, "skin": {"relief": False, "texture_px": 0}}


class FittedAnew(Exception):
    """The fit began."""


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fitted") / "take"
    make_arm_take(folder, ArmTakeSettings(frames=4, width_px=320, interlaced="none"))
    pipeline.run(folder, folder.with_name("out"), SETTINGS)
    return folder


@pytest.fixture
def run_again(take: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    def forbidden(*_: object) -> None:
        raise FittedAnew

    monkeypatch.setattr(pipeline, "fit_and_start", forbidden)

    def run(changed: Mapping[str, Mapping[str, Any]]) -> BodyFit | None:
        settings = {group: {**SETTINGS.get(group, {}), **changed.get(group, {})} for group in {*SETTINGS, *changed}}
        return pipeline.run(take, take.with_name("out"), settings).body

    return run


@pytest.mark.slow
def test_another_skin_does_not_fit_the_body_anew(take: Path, run_again: Any) -> None:
    out = take.with_name("out")
    kept = {name: (out / name).read_bytes() for name in ("motion.csv", "joints.csv", "body.toml")}
    assert run_again({"skin": {"texture_px": 128}}) is not None
    assert (out / "skin" / "texture.png").is_file() and {name: (out / name).read_bytes() for name in kept} == kept
    with pytest.raises(FittedAnew):
        run_again({"fitting": {"gate_m": 0.04}})


@pytest.mark.slow
def test_a_damaged_checkpoint_of_the_body_is_fitted_anew(take: Path, run_again: Any) -> None:
    path = take.with_name("out") / "cache" / "body" / "fitted.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    try:
        with pytest.raises(FittedAnew):
            run_again({"skin": {"texture_px": 64}})
    finally:
        path.write_bytes(whole)


@pytest.mark.slow
def test_everything_that_was_fitted_is_read_back(take: Path, tmp_path: Path) -> None:
    body = pipeline.run(take, take.with_name("out"), SETTINGS).body
    assert body is not None
    start = StartJoints(
        frame=2, xyz_m={"neck": np.array([0.1, 1 / 3, 2.0])}, stature=1.02, model="full", probability=0.97, rivals={"turned": 0.03},
        ask="elbow.R", unsure=("wrist.R",), rival_m={"neck": np.array([0.2, 1 / 3, 2.0])},
    )  # fmt: skip
    write_fitted(Results(tmp_path), "k", FittedBody(body=body, model="full", start=start))
    found = read_fitted(Results(tmp_path), "k")
    assert found is not None and found.start is not None and found.model == "full" and read_fitted(Results(tmp_path), "other") is None
    assert np.array_equal(found.start.xyz_m["neck"], start.xyz_m["neck"])
    assert np.array_equal(found.start.rival_m["neck"], start.rival_m["neck"])
    for f in fields(StartJoints):
        assert f.name in ("xyz_m", "rival_m") or _same(found.start, start, f.name), f.name
    for f in fields(BodyFit):
        if f.name not in ("shape", "motion"):
            assert _same(found.body, body, f.name), f.name
    for f in fields(body.motion):
        assert _same(found.body.motion, body.motion, f.name), f.name
    assert np.array_equal(found.body.shape.metaballs.radii_m, body.shape.metaballs.radii_m)
    assert np.array_equal(found.body.shape.lengths_m, body.shape.lengths_m)


def _same(a: object, b: object, name: str) -> bool:
    one, two = getattr(a, name), getattr(b, name)
    return np.array_equal(one, two, equal_nan=True) if isinstance(two, np.ndarray) else bool(one == two)
