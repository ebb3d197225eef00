"""Corrections, locks and limits: from the scene to the table of take.toml and back.

A number that equals the one in the file in Blender's single precision stays as it is in the file.
"""

from typing import Any

import bpy
import numpy as np

from ...core.body.model_file import BodyModel, read_model
from ...core.foundation.errors import InputError
from ...core.take.writing import Table
from .. import project, properties

UNLIMITED_DEG = 360.0  # stands for no limit


def write(scene: bpy.types.Scene, made: Table) -> None:
    """Put the scene's corrections into the table.

    Raises:
        InputError: a lower limit is not below the upper one.
    """
    correcting, old = scene.tricap_correcting, made.get("corrections", [])
    corrections = [_entry(correction) for correction in correcting.corrections]
    if corrections:
        made["corrections"] = [next((before for before in old if _alike(before, entry)), entry) for entry in corrections]
    else:
        made.pop("corrections", None)
    if "body" in made and correcting.dofs and correcting.dofs_model == project.model_of(scene):
        made["body"] = _with_dofs(scene, dict(made["body"]))


def read(scene: bpy.types.Scene, table: Table) -> None:
    """Show the corrections of the table in the scene."""
    correcting = scene.tricap_correcting
    correcting.corrections.clear()
    for entry in table.get("corrections", []):
        if entry["kind"] == "trajectory":
            add(scene, "trajectory", entry["view"], entry["frame"], entry["frame"], [entry["xy"]])
        else:
            add(scene, "region", entry["view"], entry["frames"][0], entry["frames"][1] - 1, entry["polygon"])
    body = table.get("body", {})
    correcting.dofs.clear()
    correcting.dofs_model = ""
    if body.get("locked") or body.get("limits"):
        list_dofs(scene, body.get("locked", []), body.get("limits", {}))


def add(scene: bpy.types.Scene, kind: str, view: str, first: int, last: int, corners: Any) -> None:
    """Add a correction and make it the active one."""
    correcting = scene.tricap_correcting
    correction = correcting.corrections.add()
    correction.kind, correction.view, correction.first, correction.last = kind, view, first, last
    for x, y in corners:
        corner = correction.corners.add()
        corner.x, corner.y = float(x), float(y)
    correcting.active = len(correcting.corrections) - 1


def list_dofs(scene: bpy.types.Scene, locked: Any = (), limits: Any = None) -> None:
    """List all angles of the scene's body model with its limits; `locked` and `limits` (degrees) as in take.toml.

    Raises:
        InputError: there is no body model.
    """
    correcting = scene.tricap_correcting
    model = model_of(scene)
    correcting.dofs.clear()
    for name, (low, high) in model_limits(model).items():
        dof = correcting.dofs.add()
        dof.name, dof.locked = name, name in locked
        dof.low, dof.high = (limits or {}).get(name, (low, high))
    correcting.dofs_model = project.model_of(scene)
    correcting.active_dof = 0


def model_of(scene: bpy.types.Scene) -> BodyModel:
    """The scene's body model.

    Raises:
        InputError: none is chosen, or its file is faulty.
    """
    name = project.joints_model(scene)
    if name is None:
        raise InputError("Choose a body model first; the degrees of freedom are those of the model.")
    return read_model(name)


def model_limits(model: BodyModel) -> dict[str, tuple[float, float]]:
    """The limits [degrees] of a model's angles, ±360 where there is none."""
    skeleton = model.skeleton
    base = set(skeleton.layout.group("base").tolist())
    rounded = {}
    for i, dof in enumerate(skeleton.dofs):
        if i not in base:
            low, high = (float(np.clip(np.degrees(v), -UNLIMITED_DEG, UNLIMITED_DEG)) for v in dof.limits)
            rounded[dof.name] = (round(low, 6), round(high, 6))
    return rounded


def _with_dofs(scene: bpy.types.Scene, body: Table) -> Table:
    correcting, usual = scene.tricap_correcting, model_limits(model_of(scene))
    old = body.get("limits", {})
    locked = [dof.name for dof in correcting.dofs if dof.locked and dof.name in usual]
    limits = {}
    for dof in correcting.dofs:
        if dof.name in usual and not _same((dof.low, dof.high), usual[dof.name]):
            if not dof.low < dof.high:
                raise InputError(f"The limits of “{dof.name}” are {dof.low:g}° to {dof.high:g}°; the first must be the lower one.")
            before = old.get(dof.name)
            limits[dof.name] = before if before and _same(before, (dof.low, dof.high)) else [_number(dof.low), _number(dof.high)]
    for key, value in (("locked", locked), ("limits", limits)):
        if value or body.get(key) == value:
            body[key] = value
        else:
            body.pop(key, None)
    return body


def _entry(correction: Any) -> Table:
    corners = [[_number(c.x), _number(c.y)] for c in correction.corners]
    if correction.kind == "trajectory":
        return {"kind": "trajectory", "view": correction.view, "frame": correction.first, "xy": corners[0]}
    frames = [correction.first, max(correction.first, correction.last) + 1]
    return {"kind": "region", "view": correction.view, "frames": frames, "polygon": corners}


def _alike(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(_alike(x, y) for x, y in zip(a, b))
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return bool(np.float32(a) == np.float32(b))
    return bool(a == b)


def _same(a: Any, b: Any) -> bool:
    return _alike([float(v) for v in a], [float(v) for v in b])


def _number(value: float) -> float:
    return float(properties.exact(value))
