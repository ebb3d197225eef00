"""The shape of one person: bone lengths and metaball radii with their sigmas, and its file body.toml."""

import tomllib
from dataclasses import dataclass, replace
from math import degrees, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from .. import store
from ..errors import InputError
from ..values import frozen
from .metaballs import VISIBLE, Metaballs, three_balls
from .model_file import BodyModel, base_dofs, dof_from_table
from .skeleton import Bone, Skeleton
from .trunk_profile import smoothed, stout_chain


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BodyShape:
    """Skeleton, bone lengths (B,) and metaballs of one person. Sigmas are one standard deviation [m]; NaN or None: not estimated."""

    model: str
    skeleton: Skeleton
    lengths_m: np.ndarray  # (B,)
    metaballs: Metaballs
    length_sigma_m: np.ndarray  # (B,)
    radius_sigma_m: np.ndarray  # (M, 3) of Metaballs.radii_m
    weight_sigma: np.ndarray | None = None  # (M,) of Metaballs.weight

    def __post_init__(self) -> None:
        b, m = len(self.skeleton.bones), len(self.metaballs.weight)
        for name, shape in dict(lengths_m=(b,), length_sigma_m=(b,), radius_sigma_m=(m, 3)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))
        if self.weight_sigma is not None:
            object.__setattr__(self, "weight_sigma", frozen(self.weight_sigma, (m,), name="weight_sigma"))


def default_shape(model: BodyModel) -> BodyShape:
    """The model's nominal lengths and default radii, before any measurement."""
    lengths = np.array([bone.nominal_length_m for bone in model.skeleton.bones])
    has_balls = np.flatnonzero(np.isfinite(model.visible_radii_m).all(axis=(1, 2)))
    balls = three_balls(has_balls, lengths, model.visible_radii_m[has_balls], model.stations[has_balls])
    aside = model.aside[has_balls].reshape(-1, 2)
    balls = replace(balls, centre=np.stack([aside[:, 0], balls.centre[:, 1], aside[:, 1]], axis=1))
    chain = stout_chain(model.skeleton, lengths, model.visible_radii_m)
    if chain:
        balls = smoothed(balls, model.skeleton, lengths, chain, model.visible_radii_m, model.stations)
    return BodyShape(
        model=model.name,
        skeleton=model.skeleton,
        lengths_m=lengths,
        metaballs=balls,
        length_sigma_m=np.full(len(lengths), np.nan),
        radius_sigma_m=np.full((len(balls.weight), 3), np.nan),
    )


def one_ball_shape(shape: BodyShape) -> BodyShape:
    """The same body with one ellipsoid a bone, from joint to joint: what bodies were made of before metaballs, for comparison."""
    balls = shape.metaballs
    bones = np.unique(balls.bone_index)
    cross = np.array([balls.radii_m[balls.bone_index == b][:, [0, 2]].mean(axis=0) for b in bones]) / (1.534 * VISIBLE)
    radii = np.stack([cross[:, 0], shape.lengths_m[bones] / (2 * VISIBLE), cross[:, 1]], axis=1)
    single = Metaballs(bone_index=bones, centre=np.tile([0.0, 0.5, 0.0], (len(bones), 1)), radii_m=radii, weight=np.ones(len(bones)))
    return replace(shape, metaballs=single, radius_sigma_m=np.full((len(bones), 3), np.nan))


def scaled_shape(shape: BodyShape, factor: float) -> BodyShape:
    """The same body, taller (`factor` > 1) or smaller in all its lengths and radii."""
    balls = shape.metaballs
    scaled = Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=factor * balls.radii_m, weight=balls.weight)
    return replace(shape, lengths_m=factor * shape.lengths_m, metaballs=scaled)


def write_body(path: Path, shape: BodyShape) -> None:
    """Write body.toml: complete, so that a scene can be built from it without the model's file. Lengths in metres, limits in degrees.

    Raises:
        InputError: the file cannot be written.
    """
    skeleton = shape.skeleton
    lines = ['format = "tricap-body"', "version = 1", f"model = {_text(shape.model)}", f"base = {_text(skeleton.bones[0].head_joint)}", ""]
    for bone, length, sigma in zip(skeleton.bones, shape.lengths_m, shape.length_sigma_m):
        lines += [
            "[[bones]]",
            f"name = {_text(bone.name)}",
            *([f"parent = {_text(bone.parent)}"] if bone.parent else []),
            f"head = {_text(bone.head_joint)}",
            f"tail = {_text(bone.tail_joint)}",
            f"length_m = {float(length)!r}",
            f"sigma_m = {float(sigma)!r}",
            f"nominal_length_m = {bone.nominal_length_m!r}",
            f"rest = {bone.R_rest.tolist()!r}  # rows; the columns are the bone's axes in the world at rest",
            f"rotation_mode = {_text(bone.rotation_mode)}",
            f"dofs = [{', '.join(map(_dof, bone.dofs))}]",
            "",
        ]
    balls = shape.metaballs
    for i, bone_index in enumerate(balls.bone_index):
        lines += [
            "[[metaballs]]",
            f"bone = {_text(skeleton.bones[bone_index].name)}",
            f"centre = {balls.centre[i].tolist()!r}  # in bone lengths, in the bone's axes",
            f"radii_m = {balls.radii_m[i].tolist()!r}  # l of the field exp(-2 d), not the visible radius",
            f"sigma_m = {shape.radius_sigma_m[i].tolist()!r}",
            f"weight = {float(balls.weight[i])!r}",
            *([f"weight_sigma = {float(shape.weight_sigma[i])!r}"] if shape.weight_sigma is not None else []),
            "",
        ]
    store.write_text(Path(path), "\n".join(lines))


def read_body(path: Path) -> BodyShape:
    """Read body.toml.

    Raises:
        InputError: the file is missing, is no body.toml of this version, or lacks something.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        said = getattr(error, "strerror", None) or error
        raise InputError(f"Cannot read the body {path}: {said}; run the fit again.") from error
    if table.get("format") != "tricap-body" or table.get("version") != 1:
        raise InputError(f"{path} is no body of this version of Tricap; run the fit again.")
    try:
        return _shape(table)
    except (KeyError, TypeError, ValueError, AttributeError, StopIteration) as error:
        raise InputError(f"The body {path} lacks something or holds a wrong value ({error}); run the fit again.") from error


def _shape(table: dict[str, Any]) -> BodyShape:
    rows = table["bones"]
    bones = tuple(
        Bone(
            name=str(t["name"]),
            parent=t.get("parent"),
            head_joint=str(t["head"]),
            tail_joint=str(t["tail"]),
            nominal_length_m=float(t["nominal_length_m"]),
            R_rest=np.array(t["rest"], dtype=float),
            rotation_mode=str(t["rotation_mode"]),
            dofs=tuple(map(dof_from_table, t["dofs"])),
        )
        for t in rows
    )
    skeleton = Skeleton(name=str(table["model"]), bones=bones, base_dofs=base_dofs(str(table["base"])))
    names, balls = [bone.name for bone in bones], table.get("metaballs", [])
    metaballs = Metaballs(
        bone_index=np.array([names.index(t["bone"]) for t in balls], dtype=np.intp),
        centre=np.array([t["centre"] for t in balls], dtype=float).reshape(-1, 3),
        radii_m=np.array([t["radii_m"] for t in balls], dtype=float).reshape(-1, 3),
        weight=np.array([t["weight"] for t in balls], dtype=float),
    )
    return BodyShape(
        model=str(table["model"]),
        skeleton=skeleton,
        lengths_m=np.array([t["length_m"] for t in rows], dtype=float),
        metaballs=metaballs,
        length_sigma_m=np.array([t["sigma_m"] for t in rows], dtype=float),
        radius_sigma_m=np.array([t["sigma_m"] for t in balls], dtype=float).reshape(-1, 3),
        weight_sigma=np.array([t["weight_sigma"] for t in balls], dtype=float) if _has_weight_sigmas(balls) else None,
    )


def _has_weight_sigmas(balls: list[dict[str, Any]]) -> bool:
    return any("weight_sigma" in t for t in balls)


def _dof(dof: Any) -> str:
    low, high = map(degrees, dof.limits)
    parts = [f"name = {_text(dof.name)}", f"axis = {_text(dof.axis)}", f"limits_deg = [{low!r}, {high!r}]"]
    if isfinite(dof.prior_sigma):
        parts += [f"prior_deg = {degrees(dof.prior_mean)!r}", f"prior_sigma_deg = {degrees(dof.prior_sigma)!r}"]
    return "{ " + ", ".join(parts) + " }"


def _text(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
