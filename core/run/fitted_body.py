"""The fitted body as a checkpoint (cache/body): another skin does not fit it anew, nor does a run that was stopped at its skin."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..body.motion import BodyFit, BodyMotion
from ..body.shape import body_of, body_text, read_body
from ..fitting.inputs.start_joints import StartJoints
from ..foundation import bounded
from ..foundation.errors import InputError
from ..motion.tables import read_joints, read_motion
from ..results.folder import Results

STAGE, NAME = "body", "fitted"
OF_SHAPE = ("dof_names", "joint_names")  # of the motion: they follow from the skeleton
PLACES = ("xyz_m", "rival_m")  # of a start: places by joint


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedBody:
    """What the fit found, before a skin is made."""

    body: BodyFit
    model: str  # that was fitted; the take's, or the chosen one
    start: StartJoints | None  # found without clicks


def write_fitted(results: Results, key: str, fitted: FittedBody) -> None:
    """Write the checkpoint."""
    body, start = fitted.body, fitted.start
    motion = {f.name: np.array(getattr(body.motion, f.name)) for f in fields(BodyMotion) if f.name not in OF_SHAPE}
    values = dict(
        shape=body_text(body.shape),
        iterations=body.iterations,
        converged=body.converged,
        contradicted=body.contradicted,
        model=fitted.model,
        start=None if start is None else _start_table(start),
    )
    arrays = {"points": body.points, "outline_m": body.outline_m, "values_json": np.array(json.dumps(values))}
    results.save_checkpoint(STAGE, NAME, key, {**arrays, **{f"motion_{name}": array for name, array in motion.items()}})


def read_fitted(results: Results, key: str) -> FittedBody | None:
    """The body that was fitted to the same input; None where there is none, or it is damaged.

    Raises:
        InputError: it has a shape of an earlier version.
    """
    arrays = results.load_checkpoint(STAGE, NAME, key)
    if arrays is None:
        return None
    values = bounded.json_of(str(arrays["values_json"]))
    shape = body_of(values["shape"])
    motion: dict[str, Any] = {f.name: arrays[f"motion_{f.name}"] for f in fields(BodyMotion) if f.name not in OF_SHAPE}
    motion |= dict(known=tuple(map(tuple, motion["known"].tolist())), status=tuple(motion["status"].tolist()))
    body = BodyFit(
        shape=shape,
        motion=BodyMotion(dof_names=shape.skeleton.dof_names, joint_names=shape.skeleton.joint_names, **motion),
        iterations=values["iterations"],
        converged=values["converged"],
        points=arrays["points"],
        outline_m=arrays["outline_m"],
        contradicted={bone: tuple(frames) for bone, frames in values["contradicted"].items()},
    )
    start = None if values["start"] is None else _start(values["start"])
    return FittedBody(body=body, model=values["model"], start=start)


def can_be_read(results: Results) -> bool:
    """Whether body.toml, motion.csv and joints.csv of a finished fit can be read: a damaged file may be as long as before."""
    try:
        read_motion(results.path("motion.csv"), read_body(results.path("body.toml")).skeleton)
        read_joints(results.path("joints.csv"))
    except InputError:
        return False
    return True


def _start_table(start: StartJoints) -> dict[str, Any]:
    table = {f.name: getattr(start, f.name) for f in fields(StartJoints)}
    return table | {name: {joint: xyz.tolist() for joint, xyz in table[name].items()} for name in PLACES}


def _start(table: Mapping[str, Any]) -> StartJoints:
    places = {name: {joint: np.array(xyz) for joint, xyz in table.get(name, {}).items()} for name in PLACES}
    return StartJoints(**{**table, **places, "unsure": tuple(table["unsure"])})
