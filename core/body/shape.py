"""The shape of one person: bone lengths and metaball radii with their sigmas, and its file body.toml.

Radii of the balls of a body with a trunk, adjusted together so that their summed field has the model's outline.

Radii computed bone by bone (metaballs.three_balls) leave ledges at the trunk's joints, because its balls reach far into the next bone, and
they make a body too thick at hips and shoulders, where the balls of trunk and limbs add. Here the visible radii are joined along the whole
chain of stout bones, and the cross radii l of all balls are adjusted to the outlines of all bones together, as the fit sums them:

    √(−½ ln F(X)) − √(½ ln 2) = 0 at points X of the outline,   ln l = its value bone by bone ± `FREE`
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as attribute
from math import degrees, isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..foundation import bounded, store
from ..foundation.arrays import frozen
from ..foundation.errors import InputError, damage_of
from .anatomy import ball_names
from .metaballs import ACROSS, THRESHOLD, VISIBLE, Metaballs, field, field_and_derivatives, three_balls
from .model_file import MOST_LENGTHS, BodyModel, base_dofs, dof_from_table
from .skeleton import LENGTHS_M, Bone, Skeleton, bone_frames
from .skin.hand_template import BENDS, RELAXED

SAMPLES = 10  # of the outline, per bone
FREE = 0.3  # sigma of the prior on ln l
TOLERANCE = 0.02  # sigma of the equations
STEPS = 25  # Gauss-Newton iterations
LARGEST_STEP = 0.2  # of ln l
LEAST_F = 1e-6  # bounds of F, so that its logarithm …
MOST_F = 0.99
LEAST_ROOT_SQUARED = 0.03  # … and the derivative of the root stay finite
MOST_BONES, MOST_BALLS = 500, 2000  # of a body: ten times as many as a person with fingers has; Blender needs the square of the time
LAST_LINE = "# end"  # of body.toml: without it the file was cut
LARGEST_SIGMA = 0.48  # of ln (bend − BENDS[0]) of relaxed or bent fingers, up to where they count as measured; 0.8 of its prior's
STOUT = 0.4  # mean radius over length: bones above it belong to the trunk
PARALLEL = 0.98  # least cosine between consecutive bones of one chain


def stout_chain(skeleton: Skeleton, lengths_m: np.ndarray, visible_radii_m: np.ndarray) -> list[int]:
    """The first bone and those that continue it in its direction, as long as they are stout; `visible_radii_m` (B, 3, 2)."""
    chain, stout = [0], visible_radii_m.mean(axis=(1, 2)) / lengths_m > STOUT  # False where there are no balls (NaN)
    for b in range(1, len(skeleton.bones)):
        direction = skeleton.bones[b].R_rest[:, 1] @ skeleton.bones[chain[-1]].R_rest[:, 1]
        if skeleton.parents[b] == chain[-1] and skeleton.starts_at_tail[b] and stout[b] and direction > PARALLEL:
            chain.append(b)
    return chain if stout[0] and len(chain) > 1 else []


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FieldSamples:
    """Values that the field shall have: √(−½ ln F) is `root` (N,) at points xyz_m (N, 3), with weights (N,)."""

    xyz_m: np.ndarray
    active: np.ndarray  # (N, M) the balls that count at each point, as in `metaballs.field`
    root: np.ndarray
    weight: np.ndarray


def smoothed(balls: Metaballs, model: BodyModel, lengths_m: np.ndarray, chain: list[int]) -> Metaballs:
    """The balls with their cross radii adjusted to the outlines of all bones, where these do not lie within another part."""
    R, head = bone_frames(model.skeleton, lengths_m, np.zeros(len(model.skeleton.dofs)))
    X, bone = _outline(R, head, model, lengths_m, chain)
    active = model.skeleton.neighbours[bone][:, balls.bone_index]
    own = (bone[:, None] == balls.bone_index) | (np.isin(bone, chain)[:, None] & np.isin(balls.bone_index, chain))
    seen = field(balls, lengths_m, R, head, X, active & ~own) < THRESHOLD
    X, active = X[seen], active[seen]
    samples = FieldSamples(xyz_m=X, active=active, root=np.full(len(X), VISIBLE), weight=np.ones(len(X)))
    return with_radii_for(balls, np.arange(len(balls.weight)), lengths_m, R, head, samples)


def with_radii_for(
    balls: Metaballs,
    mine: np.ndarray,
    lengths_m: np.ndarray,
    R: np.ndarray,
    head: np.ndarray,
    samples: FieldSamples,
    free: float = FREE,
) -> Metaballs:
    """The balls with the cross radii of `mine` (K,) such that their field agrees with the samples.

    ln l keeps its value ± `free`; Gauss-Newton steps are limited to LARGEST_STEP.
    """
    root, weight = samples.root, samples.weight
    start = np.log(balls.radii_m[mine][:, [0, 2]])
    x, prior = start.copy(), (weight.sum() / start.size) * (TOLERANCE / free) ** 2
    for _ in range(STEPS):
        radii = balls.radii_m.copy()
        radii[np.ix_(mine, np.array([0, 2]))] = np.exp(x)
        balls = replace(balls, radii_m=radii)
        F, _, dF, _ = field_and_derivatives(balls, lengths_m, R, head, samples.xyz_m, samples.active)
        F = np.maximum(F, LEAST_F)
        found = root_of(F)
        J = (-0.25 / (F * found))[:, None] * dF[:, mine][..., [0, 2]].reshape(len(F), -1)
        N = (J.T * weight) @ J + np.eye(x.size) * prior
        g = J.T @ (weight * (found - root)) + prior * (x - start).ravel()
        x = x - np.clip(np.linalg.solve(N, g), -LARGEST_STEP, LARGEST_STEP).reshape(x.shape)
    return balls


def root_of(F: np.ndarray) -> np.ndarray:
    """√(−½ ln F): the distance from the axis over l, of one ball; bounded where the field is near 1, inside the body."""
    return np.asarray(np.sqrt(np.maximum(-0.5 * np.log(np.minimum(F, MOST_F)), LEAST_ROOT_SQUARED)))


def _outline(R: np.ndarray, head: np.ndarray, model: BodyModel, lengths_m: np.ndarray, chain: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of the outline in the rest pose where it is a bone's own, on its four sides, and their bones (N,)."""
    groups = [chain, *([b] for b in np.flatnonzero(np.isfinite(model.visible_radii_m).all(axis=(1, 2))).tolist() if b not in chain)]
    points, bones = [], []
    for group in filter(None, groups):
        axis, base = R[group[0]][:, 1], head[group[0]]
        first = [(head[b] - base) @ axis for b in group]
        known = np.concatenate([f + model.stations[b] * lengths_m[b] for f, b in zip(first, group)])
        order = np.argsort(known)
        across = np.concatenate([model.visible_radii_m[b] for b in group])[order]
        aside = np.concatenate([model.aside[b] * lengths_m[b] for b in group])[order]
        for f, b in zip(first, group):
            along = f + lengths_m[b] * np.linspace(model.surface[b, 0], model.surface[b, 1], SAMPLES)
            along = np.clip(along, known.min(), known.max())
            radius, middle = (np.stack([np.interp(along, known[order], c) for c in both.T], axis=1) for both in (across, aside))
            centre, sides = base + along[:, None] * axis + middle @ R[b][:, [0, 2]].T, R[b][:, [0, 2]].T
            for column, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
                points.append(centre + sign * radius[:, column, None] * sides[column])
                bones.append(np.full(SAMPLES, b))
    return np.concatenate(points), np.concatenate(bones)


class FingerBend(NamedTuple):
    """How far the fingers of a hand are bent, 0 straight and 1 relaxed (`skin.hand_template`), and its sigma."""

    value: float
    sigma: float

    @property
    def measured(self) -> bool:
        """Whether points tell it, and not its prior alone."""
        return not self.sigma > LARGEST_SIGMA * (max(self.value, RELAXED) - BENDS[0])


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
    finger_bends: Mapping[str, FingerBend] = attribute(default_factory=dict)  # by the name of a hand's bone

    def __post_init__(self) -> None:
        b, m = len(self.skeleton.bones), len(self.metaballs.weight)
        for name, shape in dict(lengths_m=(b,), length_sigma_m=(b,), radius_sigma_m=(m, 3)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))
        if self.weight_sigma is not None:
            object.__setattr__(self, "weight_sigma", frozen(self.weight_sigma, (m,), name="weight_sigma"))

    def finger_bend(self, bone: str) -> float:
        """How far the fingers of a hand are bent: as measured, or relaxed."""
        return self.finger_bends[bone].value if self.has_measured_fingers(bone) else RELAXED

    def has_measured_fingers(self, bone: str) -> bool:
        """Whether a bone is a hand whose fingers' bend was measured."""
        return bone in self.finger_bends and self.finger_bends[bone].measured


def default_shape(model: BodyModel) -> BodyShape:
    """The model's nominal lengths and default radii, before any measurement.

    Raises:
        InputError: it has more bones than any body.
    """
    if len(model.skeleton.bones) > MOST_BONES:
        raise InputError(f"The body model “{model.name}” has {len(model.skeleton.bones)} bones, more than {MOST_BONES}; use another.")
    lengths = np.array([bone.nominal_length_m for bone in model.skeleton.bones])
    has_balls = np.flatnonzero(np.isfinite(model.visible_radii_m).all(axis=(1, 2)))
    balls = three_balls(has_balls, lengths, model.visible_radii_m[has_balls], model.stations[has_balls])
    aside = model.aside[has_balls].reshape(-1, 2)
    balls = replace(balls, centre=np.stack([aside[:, 0], balls.centre[:, 1], aside[:, 1]], axis=1))
    chain = stout_chain(model.skeleton, lengths, model.visible_radii_m)
    if chain:
        balls = smoothed(balls, model, lengths, chain)
    return BodyShape(
        model=model.name,
        skeleton=model.skeleton,
        lengths_m=lengths,
        metaballs=balls,
        length_sigma_m=np.full(len(lengths), np.nan),
        radius_sigma_m=np.full((len(balls.weight), 3), np.nan),
    )


def one_ball_shape(shape: BodyShape) -> BodyShape:
    """The same body with one ellipsoid a bone, from joint to joint, as body models before metaballs; for comparison."""
    balls = shape.metaballs
    bones = np.unique(balls.bone_index)
    cross = np.array([balls.radii_m[balls.bone_index == b][:, [0, 2]].mean(axis=0) for b in bones]) / (ACROSS * VISIBLE)
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
    store.write_text(Path(path), body_text(shape))


def body_text(shape: BodyShape) -> str:
    """The text of body.toml."""
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
            *(f"finger_bend{end} = {value!r}" for end, value in zip(("", "_sigma"), shape.finger_bends.get(bone.name, ()))),
            f"dofs = [{', '.join(map(_dof, bone.dofs))}]",
            "",
        ]
    balls = shape.metaballs
    names = ball_names([bone.name for bone in skeleton.bones], balls.bone_index)
    for i, bone_index in enumerate(balls.bone_index):
        lines += [
            "[[metaballs]]",
            f"name = {_text(names[i].name)}",
            f"kind = {_text(names[i].kind)}",
            f"bone = {_text(skeleton.bones[bone_index].name)}",
            f"centre = {balls.centre[i].tolist()!r}  # in bone lengths, in the bone's axes",
            f"radii_m = {balls.radii_m[i].tolist()!r}  # l of the field exp(-2 d), not the visible radius",
            f"sigma_m = {shape.radius_sigma_m[i].tolist()!r}",
            f"weight = {float(balls.weight[i])!r}",
            *([f"weight_sigma = {float(shape.weight_sigma[i])!r}"] if shape.weight_sigma is not None else []),
            "",
        ]
    return "\n".join([*lines, LAST_LINE, ""])


def read_body(path: Path) -> BodyShape:
    """Read body.toml.

    Raises:
        InputError: the file is missing, is not a body.toml of this version, or lacks an entry.
    """
    try:
        return body_of(bounded.text_of(path, bounded.TOML_BYTES), str(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"Cannot read the body {path}: {reason}; run the fit again.") from error


def body_of(text: str, path: str = "of a checkpoint") -> BodyShape:
    """The body of a text of body.toml; `path` for messages.

    Raises:
        InputError: see `read_body`.
    """
    try:
        table = bounded.toml_of(text)
    except ValueError as error:
        raise InputError(f"Cannot read the body {path}: {error}; run the fit again.") from error
    if table.get("format") != "tricap-body" or table.get("version") != 1:
        raise InputError(f"{path} is not a body.toml of this version of Tricap; run the fit again.")
    try:
        return _shape(table)
    except (InputError, KeyError, TypeError, ValueError, AttributeError, StopIteration) as error:
        raise InputError(f"The body {path} lacks an entry or has a wrong value ({damage_of(error)}); run the fit again.") from error


def _shape(table: dict[str, Any]) -> BodyShape:
    rows = table["bones"]
    if len(rows) > MOST_BONES or len(table.get("metaballs", [])) > MOST_BALLS:
        raise ValueError(f"more than {MOST_BONES} bones or {MOST_BALLS} metaballs")
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
    lengths_m = np.array([t["length_m"] for t in rows], dtype=float)
    if not ((lengths_m >= LENGTHS_M[0]) & (lengths_m <= LENGTHS_M[1])).all():
        raise ValueError(f"length_m: {LENGTHS_M[0]:g} to {LENGTHS_M[1]:g} m are possible")
    names, balls = [bone.name for bone in bones], table.get("metaballs", [])
    if homeless := {str(t["bone"]) for t in balls} - {*names}:
        raise ValueError(f"a metaball belongs to the bone “{min(homeless)[:40]}”, which does not exist")
    metaballs = Metaballs(
        bone_index=np.array([names.index(t["bone"]) for t in balls], dtype=np.intp),
        centre=np.array([t["centre"] for t in balls], dtype=float).reshape(-1, 3),
        radii_m=np.array([t["radii_m"] for t in balls], dtype=float).reshape(-1, 3),
        weight=np.array([t["weight"] for t in balls], dtype=float),
    )
    bends = {
        str(t["name"]): FingerBend(float(t["finger_bend"]), float(t.get("finger_bend_sigma", np.nan))) for t in rows if "finger_bend" in t
    }
    if not all(BENDS[0] < bend.value <= BENDS[1] for bend in bends.values()):
        raise ValueError(f"finger_bend: more than {BENDS[0]:g} and at most {BENDS[1]:g} is possible")
    r = metaballs.radii_m
    if not (((r > 0) & (r <= LENGTHS_M[1])).all() and (np.abs([*metaballs.centre.ravel(), *metaballs.weight]) <= MOST_LENGTHS).all()):
        raise ValueError("radii_m, centre or weight of a metaball: no body has such a one")
    return BodyShape(
        model=str(table["model"]),
        skeleton=skeleton,
        lengths_m=lengths_m,
        metaballs=metaballs,
        length_sigma_m=np.array([t["sigma_m"] for t in rows], dtype=float),
        radius_sigma_m=np.array([t["sigma_m"] for t in balls], dtype=float).reshape(-1, 3),
        weight_sigma=np.array([t["weight_sigma"] for t in balls], dtype=float) if _has_weight_sigmas(balls) else None,
        finger_bends=bends,
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
