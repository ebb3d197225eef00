"""Body models are data files (models/*.toml): bones, DOFs with limits, default lengths and radii. A user can write another one.

A file with `mirror_of` is the mirror image (x → −x) of another: names change side, limits about y and z change sign. In a `symmetric`
file the bones of the right side define both. A file with `part_of` is another model `without` some bones and their descendants.
The other is a built-in one by its name, or a .toml file in the same folder.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from math import inf, radians
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import bounded
from ..foundation.arrays import frozen
from ..foundation.errors import InputError, damage_of, shown
from ..foundation.settings import nearest_name
from .metaballs import STATIONS
from .skeleton import Bone, Dof, Skeleton

MOST_PARTS = 16  # files of which a model is made, one from the other
MODELS = Path(__file__).with_name("models")
MIRROR = np.array([-1.0, 1.0, 1.0])
LOCKED = radians(0.1)  # sigma of the prior of a locked DOF
RADII_M = (0.0005, 5.0)  # of a bone's flesh
MOST_LENGTHS = 10.0  # of a bone, from which anything of it may be away
OTHER_SIDE = {".R": ".L", ".L": ".R"}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BodyModel:
    """A body before any measurement: skeleton with nominal lengths, default radii, and where each bone has a surface of its own."""

    name: str
    skeleton: Skeleton
    visible_radii_m: np.ndarray  # (B, 3, 2) visible cross radii at the stations in x and z; NaN for bones without balls
    surface: np.ndarray  # (B, 2) fractions of the bone between which a measured surface is the bone's own
    stations: np.ndarray  # (B, 3) fractions of the bone where its balls are
    aside: np.ndarray  # (B, 3, 2) their offsets from the bone in its x and z, as fractions of its length
    length_sigma: np.ndarray  # (B,) relative sigma of a bone's length that clicks on its joints leave
    radius_sigma: np.ndarray  # (B,) relative sigma of the radii about a bone; 0: that of the settings
    joint_places_m: Mapping[str, np.ndarray]  # (3,) where a joint usually lies from where surfaces alone put it, in its bone's axes

    def __post_init__(self) -> None:
        b = len(self.skeleton.bones)
        object.__setattr__(self, "visible_radii_m", frozen(self.visible_radii_m, (b, 3, 2), name="visible_radii_m"))
        object.__setattr__(self, "surface", frozen(self.surface, (b, 2), name="surface"))
        object.__setattr__(self, "stations", frozen(self.stations, (b, 3), name="stations"))
        object.__setattr__(self, "aside", frozen(self.aside, (b, 3, 2), name="aside"))
        object.__setattr__(self, "length_sigma", frozen(self.length_sigma, (b,), name="length_sigma"))
        object.__setattr__(self, "radius_sigma", frozen(self.radius_sigma, (b,), name="radius_sigma"))
        for joint in set(self.joint_places_m) - set(self.skeleton.joint_names):
            raise ValueError(f"there is no joint “{joint}” to place.{nearest_name(joint, self.skeleton.joint_names)}")
        places = {joint: frozen(place, (3,), name=f"place of {joint}") for joint, place in self.joint_places_m.items()}
        object.__setattr__(self, "joint_places_m", places)


def model_names() -> tuple[str, ...]:
    """The models that come with Tricap."""
    return tuple(sorted(path.name.removesuffix(".toml") for path in MODELS.glob("*.toml")))


def smallest_model(joints: Set[str]) -> str:
    """The model that comes with Tricap and has all of these joints, or as many as any, with the fewest bones."""
    skeletons = {name: read_model(name).skeleton for name in model_names()}
    return max(skeletons, key=lambda name: (len(joints & {*skeletons[name].joint_names}), -len(skeletons[name].bones)))


def read_model(name: str | Path) -> BodyModel:
    """The model of that name, or of that .toml file.

    Raises:
        InputError: there is no such model, or its file is faulty.
    """
    sources = _sources(name)
    path, table = sources[-1]
    model = _model(table, path)
    for path, table in reversed(sources[:-1]):
        own = str(table.get("name", path.name.removesuffix(".toml")))
        model = mirrored(model, own) if "mirror_of" in table else without(model, table.get("without", ()), own)
    return model


def model_files(name: str | Path) -> list[Path]:
    """The file of a model, and the files of the models that it is a mirror image or a part of.

    Raises:
        InputError: as `read_model`.
    """
    return [path for path, _ in _sources(name)]


def _sources(name: str | Path) -> list[tuple[Path, dict[str, Any]]]:
    """A model's file and table, then those that it is made from; a file named by another is in the same folder."""
    found: list[tuple[Path, dict[str, Any]]] = []
    wanted: Any = name
    while wanted is not None:
        path = _path(wanted, found[-1][0].parent if found else Path())
        if any(bounded.real_path(path) == bounded.real_path(other) for other, _ in found):
            raise InputError(f"The body model {found[0][0]} is made from itself, by way of “{wanted}”; correct `mirror_of` or `part_of`.")
        if len(found) == MOST_PARTS:
            raise InputError(f"The body model {found[0][0]} is made from more than {MOST_PARTS} others in a row; write fewer.")
        found.append((path, _table(path)))
        table = found[-1][1]
        wanted = table.get("mirror_of", table.get("part_of"))
    return found


def _path(name: Any, folder: Path) -> Path:
    if not isinstance(name, str | Path):
        raise InputError(f'A body model in {folder} is made from {shown(name)}; write the name of a model ("arm.R") or of a .toml file.')
    if str(name).endswith(".toml"):
        if folder != Path() and Path(name).name != str(name):
            raise InputError(f"A body model in {folder} is made from “{name}”; the file must be in the same folder.")
        return folder / name
    if name not in model_names():
        raise InputError(f"There is no body model “{name}”.{nearest_name(str(name), model_names())}")
    return MODELS / f"{name}.toml"


def _table(path: Path) -> dict[str, Any]:
    try:
        return bounded.toml_of(bounded.text_of(path, bounded.TOML_BYTES))
    except (OSError, ValueError) as error:
        raise InputError(f"The body model {path} cannot be read: {getattr(error, 'strerror', None) or error}.") from error


def joint_depths_m(model: BodyModel) -> dict[str, float]:
    """Depth [m] of each joint below the skin in a view from the front: the mean radius of the bones that meet there."""
    found: dict[str, list[float]] = {}
    for bone, radii in zip(model.skeleton.bones, model.visible_radii_m):
        for joint, radius in ((bone.head_joint, radii[0, 1]), (bone.tail_joint, radii[2, 1])):
            found.setdefault(joint, []).extend([float(radius)] if np.isfinite(radius) else [])
    return {joint: float(np.mean(radii)) for joint, radii in found.items() if radii}


def without(model: BodyModel, bones: Sequence[str], name: str) -> BodyModel:
    """A model without some bones and their descendants.

    Raises:
        InputError: the model has no such bone, or nothing is left.
    """
    names = [bone.name for bone in model.skeleton.bones]
    for missing in set(bones) - set(names):
        raise InputError(f"The model “{name}” leaves out “{missing}”, which “{model.name}” does not have.{nearest_name(missing, names)}")
    gone = set(bones)
    for bone in model.skeleton.bones:
        if bone.parent in gone:
            gone.add(bone.name)
    rows = [i for i, left in enumerate(names) if left not in gone]
    skeleton = Skeleton(name=name, bones=tuple(model.skeleton.bones[i] for i in rows), base_dofs=model.skeleton.base_dofs)
    return BodyModel(
        name=name,
        skeleton=skeleton,
        visible_radii_m=model.visible_radii_m[rows],
        surface=model.surface[rows],
        stations=model.stations[rows],
        aside=model.aside[rows],
        length_sigma=model.length_sigma[rows],
        radius_sigma=model.radius_sigma[rows],
        joint_places_m={joint: place for joint, place in model.joint_places_m.items() if joint in skeleton.joint_names},
    )


def with_limits(model: BodyModel, limits: Mapping[str, tuple[float, float]], locked: Sequence[str]) -> BodyModel:
    """A model with other limits [rad], by the names of its DOFs; `locked` DOFs have their rest value (0, or the nearest limit).

    Raises:
        InputError: the model has no such degree of freedom, or it is the base's.
    """
    turning = [dof.name for bone in model.skeleton.bones for dof in bone.dofs]
    for name in (*limits, *locked):
        if name not in turning:
            raise InputError(f"The model “{model.name}” has no joint angle “{name}” to limit or lock.{nearest_name(name, turning)}")

    def changed(dof: Dof) -> Dof:
        low, high = limits.get(dof.name, dof.limits)
        rest = min(max(0.0, low), high)
        if dof.name in locked:
            return replace(dof, limits=(rest, rest), prior_mean=rest, prior_sigma=LOCKED)
        return replace(dof, limits=(low, high), prior_mean=min(max(dof.prior_mean, low), high))

    bones = tuple(replace(bone, dofs=tuple(changed(dof) for dof in bone.dofs)) for bone in model.skeleton.bones)
    return replace(model, skeleton=Skeleton(name=model.skeleton.name, bones=bones, base_dofs=model.skeleton.base_dofs))


def mirrored(model: BodyModel, name: str) -> BodyModel:
    """The mirror image of a model: equal radii and lengths, the other side's names, angles about y and z with opposite sign."""
    old = model.skeleton
    bones = tuple(_mirrored_bone(bone) for bone in old.bones)
    base = tuple(Dof(name=other_side(d.name), axis=d.axis, limits=d.limits, prior_sigma=d.prior_sigma) for d in old.base_dofs)
    return BodyModel(
        name=name,
        skeleton=Skeleton(name=name, bones=bones, base_dofs=base),
        visible_radii_m=model.visible_radii_m,
        surface=model.surface,
        stations=model.stations,
        aside=model.aside * MIRROR[[0, 2]],
        length_sigma=model.length_sigma,
        radius_sigma=model.radius_sigma,
        joint_places_m={other_side(joint): place * MIRROR for joint, place in model.joint_places_m.items()},
    )


def other_side(name: str) -> str:
    """The name of the same thing on the body's other side: “elbow.R flexion” ↔ “elbow.L flexion”."""
    word, space, rest = name.partition(" ")
    return word[:-2] + OTHER_SIDE[word[-2:]] + space + rest if word[-2:] in OTHER_SIDE else name


def _mirrored_bone(bone: Bone) -> Bone:
    dofs = []
    for d in bone.dofs:
        sign = 1.0 if d.axis == "x" else -1.0
        low, high = sorted((sign * d.limits[0], sign * d.limits[1]))
        dofs.append(
            Dof(name=other_side(d.name), axis=d.axis, limits=(low, high), prior_mean=sign * d.prior_mean, prior_sigma=d.prior_sigma)
        )
    R = MIRROR[:, None] * bone.R_rest * MIRROR  # x changes sign twice: the frame stays right-handed
    return Bone(
        name=other_side(bone.name),
        parent=None if bone.parent is None else other_side(bone.parent),
        head_joint=other_side(bone.head_joint),
        tail_joint=other_side(bone.tail_joint),
        nominal_length_m=bone.nominal_length_m,
        R_rest=R,
        rotation_mode=bone.rotation_mode,
        dofs=tuple(dofs),
    )


def rest_frame(y: Any, z: Any) -> np.ndarray:
    """A rest frame (3, 3) from the bone's direction y and a direction z across it, which is made orthogonal."""
    y, z = np.asarray(y, dtype=np.float64), np.asarray(z, dtype=np.float64)
    y = y / np.linalg.norm(y)
    z = z - y * (y @ z)
    z = z / np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z], axis=1)


def dof_from_table(table: Mapping[str, Any]) -> Dof:
    """A rotational DOF from its table in a model or body file."""
    low, high = table.get("limits_deg", (-inf, inf))
    return Dof(
        name=str(table["name"]),
        axis=str(table["axis"]),
        limits=(radians(low), radians(high)),
        prior_mean=radians(table.get("prior_deg", 0.0)),
        prior_sigma=radians(table.get("prior_sigma_deg", inf)),
    )


def base_dofs(joint: str) -> tuple[Dof, Dof, Dof]:
    """The base DOFs: the world position of a joint."""
    x, y, z = (Dof(name=f"{joint} {axis}", axis=axis) for axis in "xyz")
    return x, y, z


def _model(table: Mapping[str, Any], path: Path) -> BodyModel:
    if table.get("format") != "tricap-model" or table.get("version") != 1:
        raise InputError(f'{path} is not a body model of this version of Tricap; begin it with format = "tricap-model" and version = 1.')
    try:
        stature = float(table["stature_m"])
        rows = list(table["bones"])
        bones = [_bone(t, stature) for t in rows]
        radii = [np.broadcast_to(np.array(t.get("radii_m", [np.nan] * 3), dtype=float).reshape(3, -1), (3, 2)) for t in rows]
        surface, stations = [t.get("surface", (0.0, 1.0)) for t in rows], [t.get("stations", STATIONS) for t in rows]
        aside = [np.array(t.get("aside", np.zeros((3, 2))), dtype=float) for t in rows]
        open_lengths, open_radii = ([float(t.get(name, 0.0)) for t in rows] for name in ("length_sigma", "radius_sigma"))
        places = {str(joint): np.array(place, dtype=float) for joint, place in table.get("joint_places_m", {}).items()}
        if table.get("symmetric", False):
            right = [i for i, bone in enumerate(bones) if bone.name.endswith(".R")]
            bones += [_mirrored_bone(bones[i]) for i in right]
            aside += [aside[i] * MIRROR[[0, 2]] for i in right]
            places |= {other_side(joint): place * MIRROR for joint, place in places.items() if joint.endswith(".R")}
            columns: tuple[list[Any], ...] = (radii, surface, stations, open_lengths, open_radii)
            radii, surface, stations, open_lengths, open_radii = ([*column, *(column[i] for i in right)] for column in columns)
        _check_numbers(bones, radii, surface, stations, aside, open_lengths)
        if wrong := next((bone.name for bone, sigma in zip(bones, open_radii) if not 0 <= sigma <= 1), None):
            raise ValueError(f"radius_sigma of “{wrong}” is no share of its radii")
        if table["base"] != bones[0].head_joint:
            raise ValueError(f"its base is {shown(table['base'])}, and its first bone begins at “{bones[0].head_joint}”")
        skeleton = Skeleton(name=str(table["name"]), bones=tuple(bones), base_dofs=base_dofs(str(table["base"])))
        return BodyModel(
            name=skeleton.name,
            skeleton=skeleton,
            visible_radii_m=np.array(radii),
            surface=np.array(surface),
            stations=np.array(stations),
            aside=np.array(aside),
            length_sigma=np.array(open_lengths),
            radius_sigma=np.array(open_radii),
            joint_places_m=places,
        )
    except InputError as error:
        raise InputError(f"The body model {path}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"The body model {path} lacks an entry or has a wrong value: {damage_of(error)}.") from error


def _check_numbers(
    bones: Sequence[Bone],
    radii: Sequence[np.ndarray],
    surface: Sequence[Any],
    stations: Sequence[Any],
    aside: Sequence[np.ndarray],
    open_lengths: Sequence[float],
) -> None:
    """Raise ValueError for what no body has."""
    for bone, r, (low, high), along, across, relative in zip(bones, radii, surface, stations, aside, open_lengths):
        if not (np.isnan(r).all() or ((r >= RADII_M[0]) & (r <= RADII_M[1])).all()):
            raise ValueError(f"radii_m of “{bone.name}”: {RADII_M[0]:g} to {RADII_M[1]:g} m are possible")
        if not -MOST_LENGTHS <= low < high <= MOST_LENGTHS:
            raise ValueError(f"surface of “{bone.name}” is {low} to {high}")
        if not (len(along) == 3 and np.abs([*along, *np.ravel(across)]).max() <= MOST_LENGTHS and 0 <= relative <= MOST_LENGTHS):
            raise ValueError(f"stations, aside or length_sigma of “{bone.name}” is no distance in lengths of the bone")


def _bone(t: Mapping[str, Any], stature: float) -> Bone:
    return Bone(
        name=str(t["name"]),
        parent=t.get("parent"),
        head_joint=str(t["head"]),
        tail_joint=str(t["tail"]),
        nominal_length_m=stature * float(t["length_per_stature"]),
        R_rest=rest_frame(t["y"], t["z"]),
        rotation_mode=str(t.get("rotation_mode", "YZX")),
        dofs=tuple(map(dof_from_table, t.get("dofs", ()))),
    )
